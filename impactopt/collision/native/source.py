"""The C of one collision model: its sizes and switches, CasADi's functions, and the kernel."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np

from ...codegen import NativeCode
from ..course import _GRADING
from ..events import _BEYOND
from ..graph import collision_graph, frozen_dynamics, joint_space_model, number_of_steps
from ..loop import _BLOCK
from ..model import shape_of
from ..outputs import HISTORIES, OF_SOLES, frozen_for
from ..taylor import ORDER
from .generated import Tree, c_code, gamma_of, scalar_functions, tree_functions

if TYPE_CHECKING:
    from ..symbolic import SymbolicModel

__all__ = ["native_collision"]

# the kernel's files in their order; the one named here is that of the steps
_STEPS = {"events": "taylor.h", "rk4": "rk4.h"}
# the straight-line code of the tree is long, and gains nothing from more
_TREE = ('#pragma GCC push_options\n#pragma GCC optimize ("O1")\n', "#pragma GCC pop_options\n")


def native_collision(collision: SymbolicModel, outputs: tuple[str, ...], *, every: int = 1) -> NativeCode:
    """C code of the function that `collision_graph` gives, with the same inputs and outputs.

    Its numbers agree with the graph's to rounding. It has no derivatives. Where there is no compiler, the
    graph takes its place.
    """
    frozen = frozen_dynamics(collision)
    ground = bool({"ground_wrench", "zmp"} & {*outputs})
    tree = tree_functions(frozen, collision.n_servos, ground=ground)
    model = joint_space_model(collision, outputs, freezes=collision.n_freezes)
    scalars = scalar_functions(model, taylor=collision.stepping == "events")
    parts = [
        "#define CASADI_SYMBOL_EXPORT static\n",
        _TREE[0],
        c_code("tree", tree.functions),
        _TREE[1],
        c_code("scalars", scalars),
        _sizes(collision, outputs, every, tree),
    ]
    names = ("vectors.h", "freeze.h", "instant.h", _STEPS[collision.stepping], "outputs.h", "course.h")
    folder = files(__package__)
    parts += [folder.joinpath(name).read_text(encoding="utf-8") for name in (*names, "collision.c")]
    return NativeCode(
        name="collision",
        code="\n".join(parts),
        graph=lambda: collision_graph(collision, outputs, every=every),
    )


def _sizes(collision: SymbolicModel, outputs: tuple[str, ...], every: int, tree: Tree) -> str:
    """Everything that the kernel has to know of the model, as macros and tables."""
    robot, terms, settings, n = collision.robot, collision.terms, collision.settings, collision.n_servos
    model = joint_space_model(collision, outputs, freezes=collision.n_freezes)
    held = collision.held_by.constraint_frames(robot)
    soles = collision.held_by.sole_frames(robot)
    shapes_in = {"q": (robot.nq, 1), "v": (robot.nv, 1)}
    if terms.feedforward:
        shapes_in["feedforward"] = (robot.n, 1)
    shapes_in |= {name: shape_of(value) for name, value in settings.items()}
    names = list(shapes_in)
    laws, targets = list(model.law.parameters), list(model.target.parameters)
    switch_count = len(
        model.target.switches([0.0] * model.target.n_states, 0.0, dict(model.target.parameters))
    )
    freezes = collision.n_freezes
    ends = (np.arange(freezes + 1) / max(freezes, 1)) ** _GRADING
    shares = np.diff(ends) if freezes else np.ones(1)

    def steps(fraction: float) -> int:
        return -(-number_of_steps(collision, fraction) // _BLOCK) * _BLOCK

    stretches = [steps(1.0 if i == len(shares) - 1 else float(x)) for i, x in enumerate(shares)]
    columns = [-(-count // every) + 1 for count in stretches]
    held_rows = 6 * len(held)
    rows = {
        "joint_velocity": n,
        "torque": n,
        "demand": n,
        "sole_wrench": 6 * len(soles),
        "hand_wrench": held_rows - 6 * len(soles),
        "ground_wrench": 6,
        "zmp": 2,
    }
    histories = [rows.get(name, 1) if name in HISTORIES else 0 for name in outputs]
    single = {
        "velocity": (robot.nv, 1),
        "configuration": (robot.nq, 1),
        "target_result": (len(model.target.results), 1),
    }
    total = sum(columns)
    shapes_out = [
        ((total, 1) if count == 1 else (count, total)) if count else single.get(name, (1, 1))
        for name, count in zip(outputs, histories, strict=True)
    ]
    numbers: dict[str, Any] = {
        "N": n,
        "NQ": robot.nq,
        "NV": robot.nv,
        "C": held_rows,
        "SOLES": len(soles),
        "NZ": model.target.n_states,
        "N_LAW": len(laws),
        "N_TARGET": len(targets),
        "SWITCHES": switch_count,
        "ORDER": ORDER,
        "SIZE": ORDER + 1,
        "COLUMN(i)": f"((i) >= {robot.nv - n} ? (i) - {robot.nv - n} : {n + 1} + (i))",
        "LENGTH": repr(float(collision.step_length)),
        "BEYOND": repr(_BEYOND),
        "HORIZON": repr(float(collision.horizon)),
        "TRANSITION": repr(float(model.transition)),
        "STIFFNESS": int(terms.stiffness and n > 0),
        "FEEDFORWARD": int(terms.feedforward and n > 0),
        "SATURATION": int(terms.saturation and n > 0),
        "FRICTION": int(terms.friction and n > 0),
        "BIAS": int(terms.bias),
        "JDOT": int(terms.jdot),
        "KD_MATRIX": int(n > 0 and settings["kd"].ndim == 2),
        "KP_MATRIX": int(n > 0 and terms.stiffness and settings["kp"].ndim == 2),
        "PEAK": int(model.peak),
        "SECOND_INTEGRALS": int(model.second_integrals),
        "FREEZES": freezes,
        "WRENCHES": int(bool(frozen_for(outputs)) or freezes > 0),
        "HELD_HISTORY": int(bool({*OF_SOLES, "hand_wrench"} & {*outputs})),
        "HISTORIES": int(any(histories)),
        "EVERY": every,
        "STEPS_AT_ALL": steps(1.0),
        "N_IN": len(names),
        "N_OUT": len(outputs),
        "NAME": "collision",
        "OF_NAME(part)": "collision_##part",
        "ARG_law": names.index(f"contact_{laws[0]}") if laws else 0,
        "ARG_target": names.index(f"target_{targets[0]}") if targets else 0,
        "ROOT_NONZEROS": len(tree.root),
        "HELD_NONZEROS": len(tree.held),
        **{f"ARG_{name}": i for i, name in enumerate(names)},
        **{f"OUT_{name}": i for i, name in enumerate(outputs)},
    }
    text = [f"#define {name} {value}" for name, value in numbers.items()]
    width, held_width = 8 * -(-(robot.nv + 1) // 8), 8 * max(1, -(-held_rows // 8))
    text += [
        _table("int", "ROOT_AT", [r * width + c for r, c in tree.root]),
        _table("int", "HELD_AT", [r * held_width + c for r, c in tree.held]),
        *_rows_of_columns("ROOT", tree.root, n + 1),
        *_rows_of_columns("HELD", tree.held, held_rows),
        _table("double", "GAMMA", gamma_of(collision.held_by, len(held))),
        _table("int", "ROWS", histories),
        _table("int", "STEPS", stretches),
        _table("int", "N_COLUMNS", columns),
        _table("int", "STEPS_TO_MIDDLE", [steps(float(x) / 2) for x in shares]),
        _table("double", "ENDS", [float(x) for x in ends]),
        _names("NAMES_IN", names),
        _names("NAMES_OUT", outputs),
        _shapes("SHAPES_IN", shapes_in.values()),
        _shapes("SHAPES_OUT", shapes_out),
    ]
    return "\n".join(text) + "\n"


def _rows_of_columns(name: str, places: list[tuple[int, int]], columns: int) -> list[str]:
    """Tables of the rows of each column's nonzeros, and of where they begin."""
    rows = [[r for r, c in places if c == column] for column in range(columns)]
    starts = [0, *(int(x) for x in np.cumsum([len(x) for x in rows]))]
    return [
        _table("int", f"{name}_ROWS", starts),
        _table("int", f"{name}_ROW", [r for column in rows for r in column]),
    ]


def _table(kind: str, name: str, values: Iterable[Any]) -> str:
    return f"static const {kind} {name}[] = {{{', '.join(map(repr, values)) or '0'}}};"


def _names(name: str, values: Iterable[str]) -> str:
    return f"static const char *const {name}[] = {{{', '.join(f'{chr(34)}{x}{chr(34)}' for x in values)}}};"


def _shapes(name: str, shapes: Iterable[tuple[int, int]]) -> str:
    # a 1 after the shape says dense
    return f"static const long long {name}[][3] = {{{', '.join(f'{{{a}, {b}, 1}}' for a, b in shapes)}}};"
