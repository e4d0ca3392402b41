"""The compiled collision as a CasADi function that can be differentiated: by the C that has its derivatives.

CasADi asks an external function for derivatives by names of its own, and before it knows whether they will
ever be needed. Here they come through a custom Jacobian, whose blocks are compiled when one of them is first
evaluated:

    `native_gradient`     the adjoint, of a single number by q and v
    `native_jacobian`     tangents, of numbers and histories by q, v and the feed-forward torque
    `native_differences`  differences of collisions with tight steps, of all else

q's blocks are in the basis of v there. The chain rule to Pinocchio's q is T(q) (nv, nq) with v = T dq/dt: of
the base R' for its position and 2 Im(conj(p) dp) for its quaternion p, ones at the joints. The function makes
quaternions, and cosines and sines, unit ones first, so that it does not change along their lengths.
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
from numpy.typing import NDArray

from impactopt.codegen.compiler import CompileError, NativeCode, find_compiler, why_no_compiler
from impactopt.collision.native import native_collision, native_differences, native_gradient, native_jacobian
from impactopt.collision.native.sizes import directions, shapes_out
from impactopt.collision.native.source import least_size
from impactopt.collision.outputs import HISTORIES, SCALARS
from impactopt.collision.stepped import SteppedModel
from impactopt.errors import InputError
from impactopt.robots.rigid_body import RigidBody

__all__ = [
    "CollisionFunction",
    "Part",
    "differentiable",
    "export",
    "in_order",
    "native_part",
    "with_jacobian",
]

Array = NDArray[np.float64]
Compile = Callable[[str, tuple[Any, ...], Callable[[], Any]], Any]

# of the differences that give second derivatives, of an input's size; those of first derivatives that are
# differences themselves are longer, as what is left in them is divided by it once more
_SECOND = {"collision_gradient": 1e-4, "collision_jacobian": 1e-4, "collision_differences": 1e-3}
_TANGENTS = ("q", "v", "feedforward")
# of the steps whose tangents are taken: those of 1e-7 are off by up to 4e-6
_OF_TANGENTS = 1e-9


@dataclass(frozen=True)
class Part:
    """A compiled function of derivatives, and what it gives: (output, input) pairs."""

    name: str
    outputs: tuple[str, ...]
    by: tuple[str, ...]


class CollisionFunction(ca.Function):
    """A ca.Function that says how it is taken to another process, where CasADi would say so too late."""

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
    model : of the collision.
    whole : its compiled function, with all settings as inputs.
    by : inputs that derivatives are by; None: all.
    every : keep every so many steps of the histories.
    compiled : (name, what, build) -> the compiled function of these, as `SymbolicModel._compiled`.
    """

    def late(part: Part) -> tuple[Any, Mapping[str, Any]]:
        function = _late(model, whole, part, every, compiled)
        return function, function.sizes

    value, jacobian = with_jacobian(model, whole, parameters, by, late)
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
    """(ca.Function of q, v[, feedforward] and the parameters; its Jacobian's blocks, in CasADi's own form).

    derivatives : of a part, the function that gives it, and what its inputs are divided by, by name.
    name : of the first; the other's has jac_ before it.
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
    """Functions that give each derivative by these inputs; those of `separated` are zero."""
    outputs = tuple(name for name in outputs if name != "separated")
    refrozen, name = model.n_freezes > 0, ""
    carried: tuple[str, ...]
    by: tuple[str, ...]
    single = len(outputs) == 1 and outputs[0] in SCALARS and outputs[0] != "step_error"
    if single and not refrozen and model.contact_friction is None:
        carried, name = outputs, "collision_gradient"
        by = tuple(x for x in ("q", "v") if x in inputs)
        if "feedforward" in inputs and model.stepping == "implicit":
            name, by = "collision_jacobian", tuple(x for x in _TANGENTS if x in inputs)
    elif not refrozen and model.stepping == "implicit":
        carried = tuple(name for name in outputs if name in (*SCALARS, *HISTORIES))
        name, by = "collision_jacobian", tuple(x for x in _TANGENTS if x in inputs)
    else:
        carried = by = ()
    others = tuple(x for x in outputs if x not in carried)
    rest = inputs if others else tuple(x for x in inputs if x not in by)
    parts = [Part("collision_differences", outputs if rest else others, rest), Part(name, carried, by)]
    return [part for part in parts if part.outputs and part.by]


# ---------------------------------------------------------------- compiled when needed
# A callback has to outlive what calls it, of which CasADi says nothing: one of each kind of model and its
# outputs is kept.
_KEPT: dict[Any, _Late] = {}


def _late(model: SteppedModel, whole: Any, part: Part, every: int, compiled: Compile) -> _Late:
    key: Any = (model._recipe, part, every)
    try:
        found = _KEPT.get(key)
    except TypeError:
        key, found = object(), None
    if found is None:
        found = _KEPT[key] = _Late(model, whole, part, every, compiled)
    return found


class _Late(ca.Callback):
    """A compiled function of derivatives that is compiled when it is first evaluated.

    Its inputs are those of the collision over their sizes, so that the lengths of CasADi's differences, from
    which second derivatives come, suit all of them.
    """

    def __init__(self, model: SteppedModel, whole: Any, part: Part, every: int, compiled: Compile) -> None:
        ca.Callback.__init__(self)
        self._in = [(name, whole.size_in(name)) for name in whole.name_in()]
        seeds, shapes = directions(model), shapes_out(model, part.outputs, every)
        self._names = [f"{output}_by_{given}" for output, given in product(part.outputs, part.by)]
        self._out = [
            (int(np.prod(shapes[output])), seeds[given]) for output, given in product(part.outputs, part.by)
        ]
        # of the model that it is made for first: settings of another may differ
        self.sizes = {name: _size(model, name) for name, _ in self._in}
        self._flat_sizes = [size.ravel(order="F") for size in self.sizes.values()]
        self._make = lambda: _compiled(model, part, every, compiled)
        self._function: Any = None
        self._room = [np.empty(rows * columns) for _, (rows, columns) in self._in]
        self._runs: dict[tuple[bool, ...], Any] = {}
        differences = {"enable_fd": True, "fd_method": "central", "fd_options": {"h": _SECOND[part.name]}}
        self.construct(f"{part.name}_late", differences)

    # ------------------------------------------------------------ what CasADi asks
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
            self._function = self._make()  # type: ignore[no-untyped-call]
        for given, size, room in zip(arg, self._flat_sizes, self._room, strict=True):
            if given is None:
                room[:] = 0.0
            else:
                np.multiply(np.frombuffer(given), size, out=room)
        wanted = tuple(x is not None and len(x) > 0 for x in res)
        if wanted not in self._runs:
            buffer, run = self._function.buffer()
            for i, room in enumerate(self._room):
                buffer.set_arg(i, room.data)
            self._runs[wanted] = buffer, run
        buffer, run = self._runs[wanted]
        for name, x, is_wanted in zip(self._names, res, wanted, strict=True):
            if is_wanted:
                buffer.set_res(self._function.index_out(name), x)
        run()
        return 0


def _compiled(model: SteppedModel, part: Part, every: int, compiled: Compile) -> Any:
    return compiled(part.name, *native_part(model, part, every))


def native_part(
    model: SteppedModel, part: Part, every: int
) -> tuple[tuple[Any, ...], Callable[[], NativeCode]]:
    """(what a part's code depends on besides the model, what makes it)."""
    if part.name == "collision_gradient":
        return part.outputs, lambda: native_gradient(model, *part.outputs)
    if part.name == "collision_jacobian":
        tight = replace(model, tolerance=min(model.tolerance, _OF_TANGENTS))
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
    """(q -> q with unit quaternions, cosines and sines, None where there are none; q -> T (nv, nq))."""
    robot = model.robot
    units = _units(robot.model)
    q = ca.MX.sym("q", robot.nq)
    if not units:
        return None, ca.Function("to_tangent", [q], [ca.MX.eye(robot.nv)])
    rb = RigidBody(robot.model)
    given, lengths, square = ca.SX.sym("q", robot.nq), ca.SX.ones(robot.nq), np.ones(robot.nv)
    for begin, end, way in units:
        lengths[begin:end] = ca.norm_2(given[begin:end])
        square[way] = (end - begin) ** 2 / 4  # the columns of dq/dv have length 1/2 for a quaternion
    unit = given / lengths
    basis = ca.Function("basis", [rb.q], [rb.tangent_map()])
    to_tangent = ca.mtimes(ca.diag(ca.DM(square)), basis(unit).T)
    to_tangent = ca.mtimes(to_tangent, ca.diag(1 / lengths))
    return ca.Function("unit", [given], [unit]), ca.Function("to_tangent", [given], [to_tangent])


def _units(model: Any) -> list[tuple[int, int, slice]]:
    """Unit-length parts of q: their ends there, and the slice of their velocities."""
    found = []
    for joint in model.joints:
        if joint.nq == 7:
            found.append((joint.idx_q + 3, joint.idx_q + 7, slice(joint.idx_v + 3, joint.idx_v + 6)))
        elif joint.nq > joint.nv:
            found.append((joint.idx_q, joint.idx_q + joint.nq, slice(joint.idx_v, joint.idx_v + joint.nv)))
    return found


_TAKEN = ("collision", "collision_gradient", "collision_jacobian", "collision_differences")
_SEEN = "-DGCC_HASCLASSVISIBILITY"  # of the function that CasADi writes, where nothing else is


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
    """The library, from arguments as of `differentiable`; see `SymbolicModel.export`."""
    if not name.isidentifier() or name in _TAKEN or not ca.Function.check_name(name):
        raise InputError(f"name {name!r}: give a name for C that is none of {', '.join(_TAKEN)}")
    compiler = find_compiler()
    if compiler is None:
        raise InputError(f"export: it needs a C compiler that works; {why_no_compiler()}")
    native = native_collision(model, tuple(whole.name_out()), every=every)
    codes = {native.name: native.code}

    def derivatives(part: Part) -> tuple[Any, Mapping[str, Any]]:
        what, build = native_part(model, part, every)
        codes[part.name] = build().code
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
            compiler.run(sources[0], made, f"{native.level} {_SEEN}", *sources[1:])
            return made.replace(folder / made.name).resolve()
    except (CompileError, OSError) as error:
        raise InputError(f"export to {folder}: {error}") from None
