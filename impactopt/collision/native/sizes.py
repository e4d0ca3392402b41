"""Sizes and switches of a model for the kernel, as C macros and tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from impactopt.collision.checks import LEAST_PIVOT
from impactopt.collision.contact_slopes import law_is_linear, target_is_linear
from impactopt.collision.course import GIVES_WAY, cuts
from impactopt.collision.graph import MOST_STEPS, columns_of, joint_space_model
from impactopt.collision.implicit import NODES, STAGES, gamma, tables
from impactopt.collision.loop import BLOCK
from impactopt.collision.model import shape_of
from impactopt.collision.native.generated import TreeFunctions, gamma_of
from impactopt.collision.outputs import HISTORIES, OF_SOLES, frozen_for
from impactopt.collision.runge_kutta import LEFT_OUT_BY_RK4
from impactopt.collision.stepped import SteppedModel, number_of_steps

__all__ = [
    "directions",
    "names_table",
    "shapes_in",
    "shapes_out",
    "shapes_table",
    "sizes",
    "with_derivatives",
    "with_jacobians",
]


def shapes_in(collision: SteppedModel) -> dict[str, tuple[int, int]]:
    """Shapes of the inputs by name."""
    robot = collision.robot
    shapes = {"q": (robot.nq, 1), "v": (robot.nv, 1)}
    if collision.effects.feedforward:
        shapes["feedforward"] = (robot.n, 1)
    return shapes | {name: shape_of(value) for name, value in collision.settings.items()}


def shapes_out(collision: SteppedModel, outputs: tuple[str, ...], every: int) -> dict[str, tuple[int, int]]:
    """Shapes of the outputs by name."""
    robot, columns = collision.robot, sum(_columns(collision, every))
    shapes = dict.fromkeys(outputs, (1, 1))
    shapes |= {
        "velocity": (robot.nv, 1),
        "configuration": (robot.nq, 1),
        "target_result": (len(collision.target.results), 1),
    }
    for name in HISTORIES:
        rows = _rows(collision, name)
        shapes[name] = (columns, 1) if rows == 1 else (rows, columns)
    return {name: shapes[name] for name in outputs}


def directions(collision: SteppedModel) -> dict[str, int]:
    """Number of directions of each input by name; q has as many as v."""
    shapes = {name: rows * columns for name, (rows, columns) in shapes_in(collision).items()}
    return {**shapes, "q": collision.robot.nv}


def with_derivatives(
    shapes: dict[str, tuple[int, int]], by: Mapping[str, int], *, values: bool = False
) -> dict[str, tuple[int, int]]:
    """Outputs with their Jacobians by inputs, of which `by` has the number of directions; each output
    itself first if with `values`.
    """
    made: dict[str, tuple[int, int]] = {}
    for name, (rows, columns) in shapes.items():
        made |= {name: (rows, columns)} if values else {}
        made |= {f"{name}_by_{given}": (rows * columns, count) for given, count in by.items()}
    return made


def with_jacobians(shapes: dict[str, tuple[int, int]], by: Mapping[str, int]) -> dict[str, tuple[int, int]]:
    """Each output followed by its Jacobians by what tangents carry."""
    carried = {name: by[name] for name in ("q", "v", "feedforward") if name in by}
    return with_derivatives(shapes, carried, values=True)


def _rows(collision: SteppedModel, history: str) -> int:
    n, soles = collision.n_servos, 6 * len(collision.held_by.sole_frames(collision.robot))
    hands = 6 * len(collision.held_by.hand_frames(collision.robot))
    rows = {"joint_velocity": n, "torque": n, "demand": n, "sole_wrench": soles, "hand_wrench": hands}
    return {**rows, "ground_wrench": 6, "zmp": 2}.get(history, 1)


def _ends(collision: SteppedModel) -> list[float]:
    """Ends of the segments, as fractions of the contact's duration."""
    return cuts(max(collision.n_freezes, 1))


def _blocks(collision: SteppedModel, fraction: float) -> int:
    """Steps for a fraction of the horizon, in whole blocks; or the most, where they find their own length."""
    if collision.stepping == "implicit":
        return MOST_STEPS
    return -(-number_of_steps(collision, fraction) // BLOCK) * BLOCK


def _steps(collision: SteppedModel) -> list[int]:
    """Steps of each segment; the last may take as long as the horizon."""
    shares = [b - a for a, b in pairwise(_ends(collision))]
    return [_blocks(collision, share) for share in (*shares[:-1], 1.0)]


def _columns(collision: SteppedModel, every: int) -> list[int]:
    if collision.stepping == "implicit":
        shares = [b - a for a, b in pairwise(_ends(collision))]
        return [columns_of(collision, share, every) for share in (*shares[:-1], 1.0)]
    return [-(-count // every) + 1 for count in _steps(collision)]


def sizes(collision: SteppedModel, outputs: tuple[str, ...], every: int, tree: TreeFunctions) -> str:
    """Everything that the kernel has to know of the model, as macros and tables."""
    robot, effects, settings, n = collision.robot, collision.effects, collision.settings, collision.n_servos
    model = joint_space_model(collision, outputs, freezes=collision.n_freezes)
    held = collision.held_by.constraint_frames(robot)
    soles = collision.held_by.sole_frames(robot)
    shapes = shapes_in(collision)
    names = list(shapes)
    laws, targets = list(model.law.parameters), list(model.target.parameters)
    switch_count = len(
        model.target.switches([0.0] * model.target.n_states, 0.0, dict(model.target.parameters))
    )
    freezes, ends, counts = collision.n_freezes, _ends(collision), _steps(collision)
    held_rows = 6 * len(held)
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
        "COLUMN(i)": f"((i) >= {robot.nv - n} ? (i) - {robot.nv - n} : {n + 1} + (i))",
        "LENGTH": repr(float(collision.step_length)),
        "STAGES": STAGES,
        "NODES": NODES,
        "LAW_BENDS": int(not law_is_linear(collision.law)),
        "TARGET_BENDS": int(not target_is_linear(collision.target)),
        "TOLERANCE": repr(float(collision.tolerance)),
        "GAMMA_OF_STEPS": repr(gamma()),
        "GIVES_WAY": repr(GIVES_WAY),
        "LEAST_PIVOT": repr(LEAST_PIVOT),
        "HORIZON": repr(float(collision.horizon)),
        "TRANSITION": repr(float(model.transition)),
        "STIFFNESS": int(effects.stiffness and n > 0),
        "FEEDFORWARD": int(effects.feedforward and n > 0),
        "SATURATION": int(effects.saturation and n > 0),
        "FRICTION": int(effects.friction and n > 0),
        "REFERENCE": settings["reference"].shape[1] if "reference" in settings else 0,
        "BIAS": int(effects.bias),
        "JDOT": int(effects.jdot),
        "KD_MATRIX": int(n > 0 and settings["kd"].ndim == 2),
        "KP_MATRIX": int(n > 0 and effects.stiffness and settings["kp"].ndim == 2),
        "PEAK": int(model.peak),
        "STEP_ERROR": int(model.error),
        "LEFT_OUT_BY_RK4": repr(LEFT_OUT_BY_RK4),
        "SECOND_INTEGRALS": int(model.second_integrals),
        "FREEZES": freezes,
        "WRENCHES": int(bool(frozen_for(outputs)) or freezes > 0),
        "HELD_HISTORY": int(bool({*OF_SOLES, "hand_wrench"} & {*outputs})),
        "HISTORIES": int(bool({*HISTORIES} & {*outputs})),
        "EVERY": every,
        "STEPS_AT_ALL": _blocks(collision, 1.0),
        "N_IN": len(names),
        "ARG_law": names.index(f"contact_{laws[0]}") if laws else 0,
        "ARG_target": names.index(f"target_{targets[0]}") if targets else 0,
        "ROOT_NONZEROS": len(tree.root),
        "HELD_NONZEROS": len(tree.held),
        **{f"ARG_{name}": i for i, name in enumerate(names)},
        **{f"OUT_{name}": i for i, name in enumerate(outputs)},
    }
    text = [f"#define {name} {value}" for name, value in numbers.items()]
    text += [
        _places("ROOT", tree.root),
        _places("HELD", tree.held),
        *_rows_of_columns("ROOT", tree.root, n + 1),
        *_rows_of_columns("HELD", tree.held, held_rows),
        _table("double", "GAMMA", gamma_of(collision.held_by, len(held))),
        _table("int", "ROWS", [_rows(collision, x) if x in HISTORIES else 0 for x in outputs]),
        _table("int", "STEPS", counts),
        _table("int", "N_COLUMNS", _columns(collision, every)),
        _table("int", "STEPS_TO_MIDDLE", [_blocks(collision, float(x) / 2) for x in np.diff(ends)]),
        _table("double", "ENDS", list(ends)),
        names_table("NAMES_IN", names),
        shapes_table("SHAPES_IN", shapes.values()),
    ]
    if collision.stepping == "implicit":
        text += [_matrix(name, x) for name, x in tables().items()]
    return "\n".join(text) + "\n"


def _places(name: str, places: list[tuple[int, int]]) -> str:
    entries = ", ".join(f"OF_{name}({r}, {c})" for r, c in places)
    return f"static const int {name}_AT[] = {{{entries or '0'}}};"


def _rows_of_columns(name: str, places: list[tuple[int, int]], columns: int) -> list[str]:
    """Tables of the rows of each column's nonzeros, and of where they begin."""
    rows = [[r for r, c in places if c == column] for column in range(columns)]
    starts = [0, *(int(x) for x in np.cumsum([len(x) for x in rows]))]
    return [
        _table("int", f"{name}_ROWS", starts),
        _table("int", f"{name}_ROW", [r for column in rows for r in column]),
    ]


def _matrix(name: str, values: Any) -> str:
    if np.ndim(values) == 0:
        return f"#define {name} {values!r}"
    shape = "".join(f"[{size}]" for size in values.shape)
    entries = str(values.tolist()).replace("[", "{").replace("]", "}")
    return f"static const double {name}{shape} __attribute__((aligned(64))) = {entries};"


def _table(kind: str, name: str, values: Iterable[Any]) -> str:
    return f"static const {kind} {name}[] = {{{', '.join(map(repr, values)) or '0'}}};"


def names_table(name: str, values: Iterable[str]) -> str:
    return f"static const char *const {name}[] = {{{', '.join(f'{chr(34)}{x}{chr(34)}' for x in values)}}};"


def shapes_table(name: str, shapes: Iterable[tuple[int, int]]) -> str:
    # a 1 after the shape says dense
    return f"static const long long {name}[][3] = {{{', '.join(f'{{{a}, {b}, 1}}' for a, b in shapes)}}};"
