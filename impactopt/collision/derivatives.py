"""Derivatives of the compiled collision function in CasADi, by compiled C.

CasADi requests derivatives of an external function by names of its own, and before it knows whether they are
needed. Here they come through a custom Jacobian instead, whose blocks are compiled when first evaluated:

    `native_gradient`     adjoint, of a single number by q and v
    `native_jacobian`     tangents, of numbers and histories by q, v and the feed-forward torque
    `native_differences`  differences of collisions with tight steps, for all other derivatives

Their derivatives by q are in the basis of v. The chain rule to Pinocchio's q has the matrix T(q) (nv, nq)
with v = T dq/dt: R' for the base's position, 2 Im(conj(p) dp) for its quaternion p, and one for each joint.
The function normalizes quaternions, and the cosine and sine of continuous joints, so that it is constant
along their lengths.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from impactopt.arrays import Array
from impactopt.codegen.compiler import CompileError, NativeCode, find_compiler, why_no_compiler
from impactopt.collision.native import native_collision, native_differences, native_gradient, native_jacobian
from impactopt.collision.native.sizes import directions, shapes_out
from impactopt.collision.native.source import least_size
from impactopt.collision.outputs import HISTORIES, SCALARS
from impactopt.collision.stepped import SteppedModel
from impactopt.errors import InputError
from impactopt.robots.checks import unit_parts
from impactopt.robots.rigid_body import RigidBody

Compile = Callable[[str, tuple[Any, ...], Callable[[], Any]], Any]

# Step of the differences that give second derivatives, relative to an input's size. It is longer if the first
# derivatives are differences themselves, as their error is divided by it.
_SECOND_DIFFERENCE_STEP = {
    "collision_gradient": 1e-4,
    "collision_jacobian": 1e-4,
    "collision_differences": 1e-3,
}
_TANGENT_INPUTS = ("q", "v", "feedforward")
# Tolerance of the integration for tangents: with 1e-7 they are off by up to 4e-6.
_TANGENT_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Part:
    """A compiled function of derivatives, of each of its `outputs` by each input in `by`."""

    name: str
    outputs: tuple[str, ...]
    by: tuple[str, ...]


class CollisionFunction(ca.Function):
    """A ca.Function that refuses serialization with advice, where CasADi would fail later."""

    def _refuse(self, *_: Any, **__: Any) -> Any:
        raise InputError(
            "a collision's function cannot be saved, pickled or turned into C by itself: its derivatives are "
            "compiled when they are first needed. The model's `export` makes a library with all of them, and "
            "its C; ca.external loads it in any process"
        )

    save = serialize = generate = export_code = generate_dependencies = _refuse
    __getstate__ = __reduce__ = __deepcopy__ = _refuse


def differentiable(
    model: SteppedModel,
    whole: Any,
    parameters: tuple[str, ...],
    by: tuple[str, ...] | None,
    every: int,
    compiled: Compile,
) -> CollisionFunction:
    """ca.Function of q, v[, feedforward] and the settings in `parameters`, with derivatives.

    Parameters
    ----------
    model : collision model.
    whole : its compiled function, with all settings as inputs.
    by : inputs to differentiate with respect to; None: all.
    every : keep every so many steps of the histories.
    compiled : (name, what, build) -> compiled function, as `SymbolicModel._compiled`.
    """

    def on_demand(part: Part) -> tuple[Any, Mapping[str, Any]]:
        function = _on_demand(model, whole, part, every, compiled)
        return function, function.sizes

    value, jacobian = with_jacobian(model, whole, parameters, by, on_demand)
    # no penalty, as the Jacobian is all there is: directional derivatives are switched off below
    own = {"custom_jacobian": jacobian, "jac_penalty": 0, "never_inline": True}
    own |= {"enable_forward": False, "enable_reverse": False}
    moving = value.name_in() if by is None else by
    own |= {"is_diff_in": [name in moving for name in value.name_in()]}
    inputs = [ca.MX.sym(name, *value.size_in(name)) for name in value.name_in()]
    found = value.call(inputs, True, False)
    return CollisionFunction(ca.Function(whole.name(), inputs, found, value.name_in(), value.name_out(), own))


def with_jacobian(
    model: SteppedModel,
    whole: Any,
    parameters: tuple[str, ...],
    by: tuple[str, ...] | None,
    derivatives: Callable[[Part], tuple[Any, Mapping[str, Any]]],
    name: str = "",
) -> tuple[Any, Any]:
    """ca.Functions of q, v[, feedforward] and the parameters: the values, and CasADi's Jacobian blocks.

    derivatives : part -> (its function, divisors of its inputs by name).
    name : of the first function; the other's has jac_ before it.
    """
    name, outputs = name or whole.name(), tuple(whole.name_out())
    inputs = {name: ca.MX.sym(name, *whole.size_in(name)) for name in whole.name_in()}
    kept = in_order(inputs, model.settings, parameters)
    moving = tuple(kept) if by is None else by
    if unknown := [name for name in moving if name not in kept]:
        raise InputError(f"by {unknown[0]!r}: no input of this function; it has {', '.join(kept)}")
    unit, to_tangent = _configuration(model)
    values = {name: kept.get(name, model.settings.get(name)) for name in inputs}
    values["q"] = inputs["q"] if unit is None else unit(inputs["q"])

    blocks: dict[tuple[str, str], Any] = {}
    for part in _parts(model, outputs, moving):
        function, sizes = derivatives(part)
        # divided by their sizes, which `_OnDemand` multiplies by again
        found = function.call([ca.rdivide(values[name], ca.DM(size)) for name, size in sizes.items()])
        named = dict(zip(function.name_out(), found, strict=True))
        pairs = [pair for pair in product(part.outputs, part.by) if pair[1] in moving]
        blocks |= {(output, given): named[f"{output}_by_{given}"] for output, given in pairs}
    to_q = to_tangent(inputs["q"])
    jacobians: dict[str, Any] = {}
    for output, given in product(outputs, kept):
        block = blocks.get((output, given), ca.MX(whole.numel_out(output), kept[given].numel()))
        is_q = given == "q" and (output, given) in blocks
        jacobians[f"jac_{output}_{given}"] = ca.mtimes(block, to_q) if is_q else block
    results = {f"out_{name}": ca.MX.sym(f"out_{name}", whole.sparsity_out(name)) for name in outputs}
    given = {**kept, **results}
    jacobian = ca.Function(f"jac_{name}", [*given.values()], [*jacobians.values()], [*given], [*jacobians])
    value = ca.Function(name, [*kept.values()], whole.call([*values.values()]), [*kept], [*outputs])
    return value, jacobian


def in_order(
    inputs: Mapping[str, Any], settings: Mapping[str, Any], parameters: Sequence[str]
) -> dict[str, Any]:
    """Inputs that are no settings, followed by the parameters in the order they are named in."""
    return {name: x for name, x in inputs.items() if name not in settings} | {
        name: inputs[name] for name in parameters
    }


def _parts(model: SteppedModel, outputs: tuple[str, ...], inputs: tuple[str, ...]) -> list[Part]:
    """Functions that together give all derivatives by these inputs; those of `separated` are zero."""
    outputs = tuple(name for name in outputs if name != "separated")
    refrozen, name = model.n_freezes > 0, ""
    carried: tuple[str, ...]
    by: tuple[str, ...]
    single = len(outputs) == 1 and outputs[0] in SCALARS and outputs[0] != "step_error"
    if single and not refrozen and model.contact_friction is None:
        carried, name = outputs, "collision_gradient"
        by = tuple(x for x in ("q", "v") if x in inputs)
        if "feedforward" in inputs and model.stepping == "implicit":
            name, by = "collision_jacobian", tuple(x for x in _TANGENT_INPUTS if x in inputs)
    elif not refrozen and model.stepping == "implicit":
        carried = tuple(name for name in outputs if name in (*SCALARS, *HISTORIES))
        name, by = "collision_jacobian", tuple(x for x in _TANGENT_INPUTS if x in inputs)
    else:
        carried = by = ()
    others = tuple(x for x in outputs if x not in carried)
    rest = inputs if others else tuple(x for x in inputs if x not in by)
    parts = [Part("collision_differences", outputs if rest else others, rest), Part(name, carried, by)]
    return [part for part in parts if part.outputs and part.by]


# ---------------------------------------------------------------- compiled when needed
# A callback has to outlive the functions that call it, and CasADi does not tell when these are gone: one for
# each kind of model and its outputs is kept.
_KEPT: dict[Any, _OnDemand] = {}


def _on_demand(model: SteppedModel, whole: Any, part: Part, every: int, compiled: Compile) -> _OnDemand:
    key: Any = (model._recipe, part, every)
    try:
        found = _KEPT.get(key)
    except TypeError:  # a recipe that is not hashable
        key, found = object(), None
    if found is None:
        found = _KEPT[key] = _OnDemand(model, whole, part, every, compiled)
    return found


class _OnDemand(ca.Callback):
    """A function of derivatives that is compiled when it is first evaluated.

    Its inputs are those of the collision divided by their sizes: CasADi has one step length for the
    differences that give second derivatives, and it should suit all of them.
    """

    def __init__(self, model: SteppedModel, whole: Any, part: Part, every: int, compiled: Compile) -> None:
        ca.Callback.__init__(self)
        self._in = [(name, whole.size_in(name)) for name in whole.name_in()]
        seeds, shapes = directions(model), shapes_out(model, part.outputs, every)
        self._names = [f"{output}_by_{given}" for output, given in product(part.outputs, part.by)]
        self._out = [
            (int(np.prod(shapes[output])), seeds[given]) for output, given in product(part.outputs, part.by)
        ]
        # of the first such model; the settings of others may differ
        self.sizes = {name: _size(model, name) for name, _ in self._in}
        self._flat_sizes = [size.ravel(order="F") for size in self.sizes.values()]
        self._compile = lambda: compiled(part.name, *native_part(model, part, every))
        self._function: Any = None
        self._buffers = [np.empty(rows * columns) for _, (rows, columns) in self._in]
        self._runs: dict[tuple[bool, ...], Any] = {}
        step = _SECOND_DIFFERENCE_STEP[part.name]
        differences = {"enable_fd": True, "fd_method": "central", "fd_options": {"h": step}}
        self.construct(f"{part.name}_on_demand", differences)

    # ------------------------------------------------------------ interface of ca.Callback
    def get_n_in(self) -> int:
        return len(self._in)

    def get_n_out(self) -> int:
        return len(self._out)

    def get_name_in(self, i: int) -> str:
        return self._in[i][0]

    def get_name_out(self, i: int) -> str:
        return self._names[i]

    def get_sparsity_in(self, i: int) -> Any:
        return ca.Sparsity.dense(*self._in[i][1])

    def get_sparsity_out(self, i: int) -> Any:
        return ca.Sparsity.dense(*self._out[i])

    def has_eval_buffer(self) -> bool:
        return True

    def eval_buffer(self, arg: Sequence[Any], res: Sequence[Any]) -> int:
        """Evaluates the outputs; null results are not computed."""
        if self._function is None:
            self._function = self._compile()  # type: ignore[no-untyped-call]
        for given, size, buffer in zip(arg, self._flat_sizes, self._buffers, strict=True):
            if given is None:
                # CasADi passes no pointer for an argument that is zero
                buffer[:] = 0.0
            else:
                np.multiply(np.frombuffer(given), size, out=buffer)
        wanted = tuple(x is not None and len(x) > 0 for x in res)
        # a CasADi buffer remembers its results: one for each set of results that has been requested
        if wanted not in self._runs:
            memory, run = self._function.buffer()
            for i, buffer in enumerate(self._buffers):
                memory.set_arg(i, buffer.data)
            self._runs[wanted] = memory, run
        memory, run = self._runs[wanted]
        for name, x, is_wanted in zip(self._names, res, wanted, strict=True):
            if is_wanted:
                memory.set_res(self._function.index_out(name), x)
        run()
        return 0


def native_part(
    model: SteppedModel, part: Part, every: int
) -> tuple[tuple[Any, ...], Callable[[], NativeCode]]:
    """Cache key of a part's code, besides the model; and the function that generates the code."""
    if part.name == "collision_gradient":
        return part.outputs, lambda: native_gradient(model, *part.outputs)
    if part.name == "collision_jacobian":
        tight = replace(model, tolerance=min(model.tolerance, _TANGENT_TOLERANCE))
        what = (*part.outputs, every, tight.tolerance)
        return what, lambda: native_jacobian(tight, part.outputs, every=every)
    what = (part.outputs, part.by, every)
    return what, lambda: native_differences(model, part.outputs, part.by, every=every)


def _size(model: SteppedModel, name: str) -> Array:
    """Typical size of an input's numbers, which scales the steps of differences."""
    shapes = {"q": (model.robot.nq,), "v": (model.robot.nv,), "feedforward": (model.robot.n,)}
    usual: Array = np.abs(model.settings[name]) if name in model.settings else np.zeros(shapes[name])
    size = np.maximum(usual, least_size(name))
    return np.where(size > 0, size, 1.0)


# ---------------------------------------------------------------- configurations
def _configuration(model: SteppedModel) -> tuple[Any, Any]:
    """ca.Functions q -> q with unit-length parts normalized (None without any), and q -> T (nv, nq)."""
    robot = model.robot
    units = unit_parts(robot.model)
    q = ca.MX.sym("q", robot.nq)
    if not units:
        return None, ca.Function("to_tangent", [q], [ca.MX.eye(robot.nv)])
    rb = RigidBody(robot.model)
    given, lengths, square = ca.SX.sym("q", robot.nq), ca.SX.ones(robot.nq), np.ones(robot.nv)
    for i, part in units:
        lengths[part] = ca.norm_2(given[part])
        if robot.model.joints[i].nq == 7:  # a free-flyer, the root
            square[3:6] = 4.0  # the columns of dq/dv have length 1/2 for a quaternion
    unit = given / lengths
    basis = ca.Function("basis", [rb.q], [rb.tangent_map()])
    to_tangent = ca.mtimes(ca.diag(ca.DM(square)), basis(unit).T)
    # T is constant along a ray of q, so its derivative there is over the length; along the ray it is zero
    to_tangent = ca.mtimes(to_tangent, ca.diag(1 / lengths))
    return ca.Function("unit", [given], [unit]), ca.Function("to_tangent", [given], [to_tangent])


_RESERVED_NAMES = ("collision", "collision_gradient", "collision_jacobian", "collision_differences")
_EXPORT_SYMBOLS = "-DGCC_HASCLASSVISIBILITY"  # of CasADi's function; all else is hidden


def export(
    model: SteppedModel,
    whole: Any,
    parameters: tuple[str, ...],
    by: tuple[str, ...] | None,
    every: int,
    compiled: Compile,
    folder: Path,
    name: str,
) -> Path:
    """Builds the library of `SymbolicModel.export` and returns its path; arguments as of `differentiable`."""
    if not name.isidentifier() or name in _RESERVED_NAMES or not ca.Function.check_name(name):
        raise InputError(f"name {name!r}: give a name for C that is none of {', '.join(_RESERVED_NAMES)}")
    compiler = find_compiler()
    if compiler is None:
        raise InputError(f"export: it needs a C compiler that works; {why_no_compiler()}")
    native = native_collision(model, tuple(whole.name_out()), every=every)
    codes = {native.name: native.whole}

    def derivatives(part: Part) -> tuple[Any, Mapping[str, Any]]:
        what, build = native_part(model, part, every)
        codes[part.name] = build().whole
        function = compiled(part.name, what, build)
        return function, dict.fromkeys(function.name_in(), 1.0)

    functions = with_jacobian(model, whole, parameters, by, derivatives, name)
    generator = ca.CodeGenerator(f"{name}.c", {"with_header": True})
    for function in functions if by is None or by else functions[:1]:
        generator.add(function)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        generator.generate(f"{folder.resolve()}/")
        sources = [folder / f"{name}.c"]
        for part, code in codes.items():
            sources.append(folder / f"{name}_{part}.c")
            sources[-1].write_text(code, encoding="utf-8")
        with tempfile.TemporaryDirectory(dir=folder, prefix="tmp-") as scratch:
            made = Path(scratch) / f"{name}.so"
            compiler.run(sources[0], made, f"{native.level} {_EXPORT_SYMBOLS}", *sources[1:])
            return made.replace(folder / made.name).resolve()
    except (CompileError, OSError) as error:
        raise InputError(f"export to {folder}: {error}") from None
