"""Planned beside simulated, as rows of text: for tables on the console and in reports."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.files.output import replay_name
from impactopt.robots.loads import SHARE, least_kept
from impactopt.solvers.program import MINOR

__all__ = [
    "Cell",
    "Row",
    "blow_rows",
    "collision_rows",
    "number_row",
    "phase_rows",
    "replay_columns",
    "result_columns",
    "result_rows",
    "standing",
    "target_rows",
    "word_row",
    "worst_rows",
]

PHASES = ("swing", "collision", "follow", "missed")
SLIP = 5.0  # [mm] on free soles: a plan within its friction slides less
EDGE = 0.1  # [mm, N] by which a sole that tips on its edge may seem to be outside
Columns = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class Cell:
    """A number as text, and whether it is within its limit."""

    text: str
    good: bool = True


@dataclass(frozen=True)
class Row:
    """Row of a table: a label with its unit, and a cell for each column."""

    label: str
    cells: tuple[Cell, ...]


def result_columns(summary: Mapping[str, Any]) -> Columns:
    """The plan, its simulation on fixed soles, and its replay on free ones, as far as there are any.

    summary : the content of ``summary.json``.
    """
    replayed = _by_phase(summary.get("replayed", {}))
    simulated = summary.get("simulated", {})
    return _said({"planned": summary, "simulated": simulated, replay_name(summary): replayed})


def replay_columns(report: Mapping[str, Any], summary: Mapping[str, Any]) -> Columns:
    """The plan and one replay; `report` as in `impactopt validate --json`."""
    held = "held soles" if summary.get("sole_cop_margin_mm") else "Pinocchio"
    name = replay_name(summary) if report["engine"] == "mujoco" else held
    return _said({"planned": summary, name: _by_phase(report)})


def result_rows(columns: Columns, phases: Sequence[str] = PHASES) -> list[Row]:
    """Rows that some column has something to say in; the first column is the plan's."""
    return [row for row in _rows(list(columns.values()), phases) if row is not None]


def _rows(sources: Sequence[Mapping[str, Any]], phases: Sequence[str]) -> Iterator[Row | None]:
    yield from blow_rows(sources)
    yield from phase_rows(sources, phases)
    yield from _sole_rows(sources)
    for label, key, joint, digits, most in (
        ("gear load / torque limit", "gear_ratio", "gear_joint", 2, np.inf),
        ("motor's use of its line", "motor_ratio", "motor_joint", 2, 1.0),
        ("cut by the motor's line [ms]", "motor_cut_ms", "motor_cut_joint", 1, 0.0),
        ("power of a motor [W]", "power_W", "power_joint", 0, np.inf),
        ("joint out of its range [rad]", "beyond_range_rad", "beyond_range", 3, 0.0),
        ("jump of a joint's speed [rad/s]", "velocity_jump_rad_s", "velocity_jump_joint", 2, np.inf),
    ):
        row = number_row(label, [source.get(key) for source in sources], digits, most=most)
        if row is not None:  # names in a line of their own: beside the numbers they would fill a terminal
            yield row
            if any(names := [source.get(joint) for source in sources]):
                yield _of_joints(names)
    slips = [None, *(source.get("sole_slip_mm") for source in sources[1:])]
    yield _of_replays(number_row("largest slip of a sole [mm]", slips, 2, most=SLIP))
    for label, key, digits in (
        ("largest lift of a sole [mm]", "sole_lift_mm", 2),
        ("impulse error [%]", "impulse_error_pct", 2),
        ("left uncertain by steps [%]", "step_error_pct", 3),
    ):
        yield _of_replays(number_row(label, [None, *(source.get(key) for source in sources[1:])], digits))
    yield from _gain_rows(sources)
    yield from _model_rows(sources)
    stands = [None, *(standing(source) for source in sources[1:])]
    yield _of_replays(word_row("stands at the end", stands, no_is_bad=True))


def _sole_rows(sources: Sequence[Mapping[str, Any]]) -> Iterator[Row | None]:
    """Margins of each sole by itself, beside what is asked of the plan: of its centre of pressure to its own
    edges in each phase, and its least normal force.

    Good is half of that in a plan and on fixed soles, and a sole that does not tip on free ones.
    """
    asked, force = sources[0].get("sole_cop_margin_asked_mm") or {}, sources[0].get("sole_force_asked_N") or 0
    free = np.array([source.get("engine") == "mujoco" for source in sources])
    margins, forces = (
        [source.get(key) or {} for source in sources] for key in ("sole_cop_margin_mm", "sole_force_N")
    )
    for sole in dict.fromkeys(name for source in margins for name in source):
        own = [source.get(sole, {}) for source in margins]
        for phase in dict.fromkeys(name for found in own for name in found):
            wanted, half = "", -np.inf
            if phase in asked:
                wanted, half = f" (of {asked[phase]:g})", 1e3 * least_kept(1e-3 * asked[phase])
            label = f"{sole} CoP margin [mm], {phase}{wanted}"
            yield number_row(label, [f.get(phase) for f in own], 1, least=np.where(free, 0.0, half) - EDGE)
        label = f"{sole} least force [N]{f' (of {force:g})' if force else ''}"
        values = [min(source.get(sole, {}).values(), default=None) for source in forces]
        yield number_row(label, values, 0, least=np.where(free, 0.0, SHARE * force) - EDGE)


def standing(replay: Mapping[str, Any]) -> bool | None:
    """True if a replay stands at the end; None if there are no soles, as a bolted robot cannot fall."""
    return replay.get("standing") if replay.get("sole_force_N") else None


def blow_rows(sources: Sequence[Mapping[str, Any]]) -> Iterator[Row | None]:
    """The blow itself, and what it has brought the target."""
    for label, key, digits in (
        ("impulse [N s]", "impulse_Ns", 2),
        ("peak force [N]", "peak_force_N", 0),
        ("contact time [ms]", "contact_ms", 1),
        ("speed at contact [m/s]", "hand_speed_m_s", 3),
    ):
        yield number_row(label, [source.get(key) for source in sources], digits)
    yield from target_rows([source.get("target") or {} for source in sources])


def phase_rows(sources: Sequence[Mapping[str, Any]], phases: Iterable[str]) -> Iterator[Row | None]:
    """Rows with a number of their own in each phase."""
    for label, key, digits, scale, least, most in (
        ("ZMP margin [mm]", "zmp_margin_m", 1, 1e3, 0.0, np.inf),
        ("torque demand / limit", "torque_ratio", 2, 1.0, 0.0, 1.0),
    ):
        for phase in phases:
            values = [source.get(key, {}).get(phase) for source in sources]
            yield number_row(f"{label}, {phase}", values, digits, scale=scale, least=least, most=most)


def collision_rows(found: Mapping[str, Any]) -> list[Row]:
    """One collision, and what a saved result says of it; `found` as in `impactopt collide --json`."""
    sources = [found, *(found.get("saved") or {}).values()]
    most_uncertain = -np.inf if found.get("caution") else np.inf
    rows = [
        number_row(label, [x.get(key) for x in sources], digits, scale=scale, least=least, most=most)
        for label, key, digits, scale, least, most in (
            ("speed at contact [m/s]", "hand_speed_m_s", 3, 1.0, -np.inf, np.inf),
            ("effective mass [kg]", "effective_mass_kg", 2, 1.0, -np.inf, np.inf),
            ("impulse [N s]", "impulse_Ns", 3, 1.0, -np.inf, np.inf),
            ("left uncertain by freezing [%]", "freeze_error_pct", 1, 1.0, -np.inf, most_uncertain),
            ("peak force [N]", "peak_force_N", 1, 1.0, -np.inf, np.inf),
            ("contact time [ms]", "contact_ms", 2, 1.0, -np.inf, np.inf),
            ("energy to the target [J]", "energy_J", 3, 1.0, -np.inf, np.inf),
            ("ZMP margin [mm]", "zmp_margin_m", 1, 1e3, 0.0, np.inf),
            ("least force on a sole [N]", "sole_force_N", 0, 1.0, 0.0, np.inf),
            ("torque demand / limit", "torque_ratio", 2, 1.0, 0.0, 1.0),
            ("joint speed / limit", "velocity_ratio", 2, 1.0, 0.0, 1.0),
        )
    ]
    rows += target_rows([source.get("target") or {} for source in sources])
    return [row for row in rows if row is not None]


def worst_rows(violations: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    """Violated constraints and amounts, worst first: the worst one of each term, and the number of its
    others.

    violations : as in ``summary.json``. What is off by less than `MINOR` of the worst only follows from it.
    """
    worst = max((v.get("amount") or 0.0 for v in violations), default=0.0)
    terms: dict[str, list[Mapping[str, Any]]] = {}
    for v in violations:
        if v.get("amount") is None or v["amount"] >= MINOR * worst:
            terms.setdefault(str(v["row"]).partition(",")[0], []).append(v)

    def more(count: int) -> str:
        return f" (and {count} more)" if count else ""

    return [(f"{rows[0]['row']}{more(len(rows) - 1)}", str(rows[0]["by"])) for rows in terms.values()]


def target_rows(targets: Sequence[Mapping[str, Any]]) -> Iterator[Row | None]:
    """Rows for the impact's effects on the targets."""
    yield number_row("speed of the target [m/s]", [target.get("speed_m_s") for target in targets], 3)
    yield number_row("driven into the wood [mm]", [target.get("depth_m") for target in targets], 2, scale=1e3)
    yield word_row("the board breaks", [target.get("broken") for target in targets])


def _gain_rows(sources: Sequence[Mapping[str, Any]]) -> Iterator[Row]:
    """Gains that the plan has chosen."""
    others = (Cell(""),) * (len(sources) - 1)
    for chosen in sources[0].get("gains") or ():
        least, largest = chosen["between"]
        label = f"stiffness chosen, of {least:g} to {largest:g} times"
        yield Row(label, (Cell(f"{chosen['factor']:.3g}"), *others))
        first, *more = (f"{joint}: {k:.3g} N m/rad" for joint, k in chosen["stiffness_N_m_rad"].items())
        yield _of_joints([f"{first}, and {len(more)} more" if more else first, *[""] * len(others)])


def _model_rows(sources: Sequence[Mapping[str, Any]]) -> Iterator[Row | None]:
    """The model of the collision that the plan has in it, and how far it is from full dynamics."""
    plan, others = sources[0], (Cell(""),) * (len(sources) - 1)
    if (name := plan.get("collision_model")) is not None:
        freezes = plan.get("freezes") or 0
        often = f", {freezes:g} freeze{'s' if freezes > 1 else ''} on the way" if freezes else ""
        yield Row("model of the collision", (Cell(f"{name}{often}"), *others))
    for label, key, digits in (
        ("model error, impulse [%]", "model_error_pct", 2),
        ("model error, ZMP [mm]", "model_error_zmp_mm", 1),
    ):
        row = number_row(label, [plan.get(key)], digits)
        yield None if row is None else Row(row.label, (*row.cells, *others))


def number_row(
    label: str,
    values: Sequence[float | None],
    digits: int,
    *,
    scale: float = 1.0,
    least: float | NDArray[np.float64] = -np.inf,
    most: float = np.inf,
) -> Row | None:
    """None where no column has a number; what is not between `least`, of each or all, and `most` is not
    good.
    """
    if all(value is None for value in values):
        return None
    cells = [
        Cell("-") if v is None else Cell(_rounded(scale * v, digits), bool(low <= v <= most))
        for v, low in zip(values, np.broadcast_to(least, len(values)), strict=True)
    ]
    return Row(label, tuple(cells))


def _rounded(value: float, digits: int) -> str:
    """Rounded number as text; a zero has no sign."""
    text = f"{value:.{digits}f}"
    return text.lstrip("-") if float(text) == 0 else text


def word_row(label: str, values: Sequence[Any], *, no_is_bad: bool = False) -> Row | None:
    """Yes or no; None where no column has either."""
    if all(value is None for value in values):
        return None
    cells = [
        Cell("-" if v is None else "yes" if v else "no", v is None or bool(v) or not no_is_bad)
        for v in values
    ]
    return Row(label, tuple(cells))


def _of_joints(names: Sequence[Any]) -> Row:
    """Row with the joints that the numbers above belong to, from the left."""
    different = dict.fromkeys(str(name) for name in names if name)
    return Row(f"  at {', '.join(different)}", (Cell(""),) * len(names))


def _of_replays(row: Row | None) -> Row | None:
    """Row with an empty cell for the plan, which has no such number."""
    return None if row is None else Row(row.label, (Cell(""), *row.cells[1:]))


def _by_phase(report: Mapping[str, Any]) -> dict[str, Any]:
    """A report with its numbers by phase, named as in a summary."""
    names = {"zmp_margin_m": "zmp_margin_by_phase_m", "torque_ratio": "torque_ratio_by_phase"}
    return {**report, **{name: report.get(other) or {} for name, other in names.items()}} if report else {}


def _said(sources: Columns) -> Columns:
    return {name: source for name, source in sources.items() if source and "error" not in source}
