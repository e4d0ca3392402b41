"""C source of a collision model: macros and tables, generated functions, and the kernel's files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from importlib.resources import files
from typing import Any

import casadi as ca
import numpy as np

from impactopt.codegen.compiler import NATIVE_FLAGS, NativeCode, SharedCode, quick_to_compile
from impactopt.collision.checks import LEAST_PIVOT
from impactopt.collision.graph import collision_graph, frozen_dynamics, gradient_graph, joint_space_model
from impactopt.collision.native.sizes import (
    backwards,
    c_code,
    directions,
    names_table,
    scalar_functions,
    shapes_in,
    shapes_out,
    shapes_table,
    simd_tree,
    sizes,
    to_velocity_basis,
    tree_functions,
    with_derivatives,
    with_jacobians,
)
from impactopt.collision.stepped import SteppedModel
from impactopt.errors import InputError

_IMPLICIT = ("", "_factor", "_step", "_remainders", "_events", "_run")  # parts of implicit.h
# The generated code of the tree is long and without branches. These options make it a sixth faster than -Og
# for half a second more of the compiler; -O2 takes another half and gains nothing.
_TREE = f"-O1 -fexpensive-optimizations -freciprocal-math -fschedule-insns2 {NATIVE_FLAGS}"
_QUICK_TREE = f"-O0 {NATIVE_FLAGS}"
_STATIC = "#define CASADI_SYMBOL_EXPORT static\n#ifndef SHARED\n#define SHARED\n#endif\n"
_ARGUMENTS = "(const double **arg, double **res, long long *iw, double *w, int mem)"
_OF_DIFFERENCES = 1e-12
# Relative length of central differences. The error of implicit steps differs between two collisions, and a
# longer difference divides it by more; the error of steps of constant length does not.
_DIFFERENCE = {"implicit": 5e-5, "rk4": 1e-6}
# Least magnitude that a difference is relative to, for inputs that are often zero; of others it is 1 at zero.
_LEAST_SIZES = {"q": 1.0, "v": 1.0, "normal": 1.0, "feedforward": 1e1, "reference": 1e2}
_LEAST_SIZES |= {"viscous": 1e1, "coulomb": 1e1}
_NEEDS_COMPILER = (
    "{}: derivatives need a C compiler that works: install gcc or clang, or name one in "
    "the environment variable CC{}"
)
# Tangents are sums and products of whole vectors, where optimization gains nothing: compile them fast.
_LANES = ('#pragma GCC push_options\n#pragma GCC optimize ("Og")\n', "#pragma GCC pop_options\n")


def native_collision(collision: SteppedModel, outputs: tuple[str, ...], *, every: int = 1) -> NativeCode:
    """C code of the function that `collision_graph` builds, with the same inputs and outputs.

    Values agree with the graph's to rounding; the graph has no implicit steps, though. The C function has no
    derivatives. Without a compiler the graph, or one with implicit steps, is used in its place.
    """

    def graph() -> ca.Function:
        return _guarded(collision, _over(collision, outputs, every))

    return _native(graph, collision, "collision", outputs, every)


def native_gradient(collision: SteppedModel, output: str) -> NativeCode | ca.Function:
    """C code of the function that `gradient_graph` builds.

    Without a compiler the graph is used in its place, but not for implicit steps: its Runge-Kutta steps
    diverge under stiff contacts or servos without an error, and have no derivative of the contact's duration.
    For one freeze only.
    """

    def graph() -> Any:
        if collision.stepping == "implicit":
            raise InputError(
                _NEEDS_COMPILER.format("gradient_function", "; or take method 'rk4' and no freezes")
            )
        return _guarded(collision, gradient_graph(collision, output))

    if collision.contact_friction is not None:
        return graph()
    return _native(graph, collision, "collision_gradient", (output,))


def native_jacobian(collision: SteppedModel, outputs: tuple[str, ...], *, every: int = 1) -> NativeCode:
    """C code of `SteppedModel.jacobian_function`, for implicit steps and one freeze."""

    def none() -> Any:
        raise InputError(_NEEDS_COMPILER.format("jacobian_function", ""))

    return _native(none, collision, "collision_jacobian", outputs, every)


def least_size(name: str) -> float:
    """Least magnitude that the differences by an input are relative to; 0: the input's own, or 1 at zero."""
    return _LEAST_SIZES.get(name, 0.0)


def native_differences(
    collision: SteppedModel, outputs: tuple[str, ...], by: tuple[str, ...], *, every: int = 1
) -> NativeCode:
    """C code of the Jacobians `<output>_by_<input>` (entries of the output, entries of the input; nv for q).

    One for each output and each input of `by`. Its inputs are those of `native_collision`; for any model.
    """

    def none() -> Any:
        raise InputError(_NEEDS_COMPILER.format("function", "; or differentiate what `graph` gives"))

    return _native(none, collision, "collision_differences", outputs, every, by)


def _over(collision: SteppedModel, outputs: tuple[str, ...], every: int) -> ca.Function:
    """The graph, with NaN where the contact has not ended and no output shows that, as in C."""
    named = outputs if {"separated", "duration"} & {*outputs} else (*outputs, "separated")
    graph = collision_graph(collision, named, every=every, as_compiled=True)
    if named is outputs:
        return graph
    inputs = [ca.MX.sym(graph.name_in(k), graph.sparsity_in(k)) for k in range(graph.n_in())]
    *out, separated = graph.call(inputs)
    out = [ca.if_else(separated, x, np.nan) for x in out]
    return ca.Function(graph.name(), inputs, out, graph.name_in(), [*outputs])


def _guarded(collision: SteppedModel, graph: ca.Function) -> ca.Function:
    """A function with NaN outputs where an input is NaN or the frozen model is ill-conditioned, as in C."""
    inputs = [ca.MX.sym(graph.name_in(k), graph.sparsity_in(k)) for k in range(graph.n_in())]
    # a comparison with NaN is false; CasADi would simplify x == x
    finite = ca.mmin(ca.vertcat(1, *[ca.vec(ca.densify(x)) >= -np.inf for x in inputs]))
    q, v, normal = (inputs[graph.name_in().index(name)] for name in ("q", "v", "normal"))
    frozen = frozen_dynamics(collision).function("frozen", ("pivots", "freedom", "m"))
    pivots, freedom, m = frozen.call([q, v, normal, 0.0])
    # the same condition as in `check_frozen`
    known = ca.logic_or(freedom > LEAST_PIVOT, m == 0)
    sound = ca.logic_and(known, ca.mmin(ca.vertcat(1, pivots)) > LEAST_PIVOT)
    out = [ca.if_else(ca.logic_and(finite, sound), x, np.nan) for x in graph.call(inputs)]
    return ca.Function(graph.name(), inputs, out, graph.name_in(), graph.name_out())


def _native(
    graph: Callable[[], ca.Function],
    collision: SteppedModel,
    name: str,
    outputs: tuple[str, ...],
    every: int = 1,
    by: tuple[str, ...] = (),
) -> NativeCode:
    frozen, gradient = frozen_dynamics(collision), name == "collision_gradient"
    jacobian = name == "collision_jacobian"
    # the soles' places cost nothing beside the rest, and with them all outputs have one tree
    ground = bool({"ground_wrench", "zmp"} & {*outputs}) or (name == "collision" and frozen.bias)
    model = joint_space_model(collision, outputs, freezes=collision.n_freezes)
    tree = tree_functions(frozen, collision.n_servos, ground=ground, slides=model.slides)
    scalars = scalar_functions(model, method=collision.stepping)
    shapes, of_tree = shapes_out(collision, outputs, every), tree.functions
    differs = name == "collision_differences"
    of_differences: list[str] = []
    if differs:
        # errors of the steps have to be small beside the differences
        collision = replace(collision, tolerance=min(collision.tolerance, _OF_DIFFERENCES))
    if gradient:
        of_tree = [*of_tree, *backwards(of_tree), to_velocity_basis(frozen)]
        scalars += backwards(scalars)
        by_both = (f"{outputs[0]}_by_q", f"{outputs[0]}_by_v")
        shapes |= dict.fromkeys(by_both, (collision.robot.nv, 1))
    lanes: list[str] = []
    if jacobian:
        moved = simd_tree(frozen, tree)
        of_tree = [*of_tree, *[parts for parts, _ in moved]]
        lanes = [_LANES[0], *[code for _, code in moved], _LANES[1]]
        scalars += backwards([f for f in scalars if f.name() == "target_energy"])
        shapes = with_jacobians(shapes, directions(collision))
    if differs:
        entries = [rows * columns for rows, columns in shapes.values()]
        inputs = shapes_in(collision)
        of_differences = [
            f"#define DIFFERENCE {_DIFFERENCE[collision.stepping]}",
            f"#define N_BY {len(by)}",
            f"#define ENTRIES {sum(entries) + 1}",
            f"#define LONGEST {max(rows * columns for rows, columns in inputs.values())}",
            f"static const int SIZES[] = {{{', '.join(map(str, entries))}}};",
            f"static const int BY[] = {{{', '.join(f'ARG_{name}' for name in by)}}};",
            f"static const double SCALES[] = {{{', '.join(str(least_size(name)) for name in by)}}};",
        ]
        shapes = with_derivatives(shapes, {name: directions(collision)[name] for name in by})
    folder = files(__package__)

    def text(*names: str) -> list[str]:
        return [folder.joinpath(name).read_text(encoding="utf-8") for name in names]

    parts = [
        _STATIC,
        *(f"SHARED int {f.name()}{_ARGUMENTS};" for f in of_tree),
        c_code("scalars", scalars),
        f"#define GRADIENT {int(gradient or jacobian)}",
        f"#define NAME {name}\n#define OF_NAME(part) {name}_##part",
        *text("vectors.h"),
        *lanes,
        sizes(collision, outputs, every, tree),
        names_table("NAMES_OUT", shapes),
        shapes_table("SHAPES_OUT", shapes.values()),
        f"#define N_OUT {len(shapes)}",
        *of_differences,
    ]
    method = collision.stepping
    steps = ["rk4.h"] if method == "rk4" else [f"implicit{part}.h" for part in _IMPLICIT]
    files_used = ["freeze.h", "instant.h", "histories.h", *steps, "segments.h"]
    if gradient:
        files_used += ["adjoint.h", f"{method}_adjoint.h", "freeze_adjoint.h", "gradient.c"]
    elif jacobian:
        tangents = [f"{name}_tangent.h" for name in ("freeze", "implicit", "histories", "run")]
        files_used += ["final_outputs.h", "tangent.h", *tangents, "jacobian.c"]
    else:
        files_used += ["final_outputs.h", "differences.c" if differs else "collision.c"]
    code = "\n".join([*parts, *text(*files_used, "interface.c")])
    # The tree is five sixths of a humanoid's code, and the same for all laws, targets and outputs.
    tree_c = c_code("tree", of_tree, linkage="SHARED")
    shared = "\n".join([_STATIC, *text("angles.h"), tree_c, "#undef sin\n#undef cos\n"])
    level = _QUICK_TREE if quick_to_compile() else _TREE
    tree_code = SharedCode(name="tree", code=shared, level=level)
    return NativeCode(name=name, code=code, graph=graph, shared=tree_code)
