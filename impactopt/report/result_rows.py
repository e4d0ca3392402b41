"""Rows of text for the tables of results, on the console and in reports."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from impactopt.arrays import Array
from impactopt.files.record import replay_name
from impactopt.robots.loads import SHARE, margin_between_nodes
from impactopt.solvers.program import MINOR

PHASES = ("swing", "contact", "collision", "follow", "missed")  # contact: the state of a strike
MAX_SLIP = 5.0  # [mm] on free soles: a plan within its friction slips less
TOLERANCE = 0.1  # [mm, N] of sole margins: a sole that tips on its edge may seem to be slightly outside
Columns = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class Cell:
    """A value as text, and whether it is within its limit."""

    text: str
    good: bool = True


@dataclass(frozen=True)
class Row:
    """Row of a table: a label with its unit, and a cell for each column."""

    label: str
    cells: tuple[Cell, ...]


def result_columns(summary: Mapping[str, Any]) -> Columns:
    """Columns of the plan, its simulation on fixed soles, and its replay on free ones, as far as they exist.

    summary : the content of ``summary.json``.
    """
    replayed = _by_phase(summary.get("replayed", {}))
    simulated = summary.get("simulated", {})
    return _present({"planned": summary, "simulated": simulated, replay_name(summary): replayed})


def replay_columns(report: Mapping[str, Any], summary: Mapping[str, Any]) -> Columns:
    """Columns of the plan and one replay; `report` as in `impactopt validate --json`."""
    fixed = "fixed soles" if summary.get("sole_cop_margin_mm") else "Pinocchio"
    name = replay_name(summary) if report["engine"] == "mujoco" else fixed
    return _present({"planned": summary, name: _by_phase(report)})


def result_rows(columns: Columns) -> list[Row]:
    """Rows with a value in at least one column; the first column is the plan's."""
    return [row for row in _rows(list(columns.values())) if row is not None]


def _rows(sources: Sequence[Mapping[str, Any]]) -> Iterator[Row | None]:
    yield from contact_rows(sources)
    yield from phase_rows(sources, PHASES)
    yield from _sole_rows(sources)
    captured = [source.get("capture_margin_m") for source in sources]
    yield number_row("capture point's margin after contact [mm]", captured, 1, scale=1e3, least=-1e-6)
    for label, key, joint, digits, most in (
        ("gear load / torque limit", "gear_ratio", "gear_joint", 2, np.inf),
        ("motor load / torque-speed line", "motor_ratio", "motor_joint", 2, 1.0),
        ("cut by the motor's line [ms]", "motor_cut_ms", "motor_cut_joint", 1, 0.0),
        ("power of a motor [W]", "power_W", "power_joint", 0, np.inf),
        ("joint out of its range [rad or m]", "beyond_range_rad", "beyond_range", 3, 0.0),
        ("jump of a joint's speed [rad/s or m/s]", "velocity_jump_rad_s", "velocity_jump_joint", 2, np.inf),
    ):
        row = number_row(label, [source.get(key) for source in sources], digits, most=most)
        if row is not None:  # names get a row of their own: beside the values they would be too wide
            yield row
            if any(names := [source.get(joint) for source in sources]):
                yield _of_joints(names)
    slips = [None, *(source.get("sole_slip_mm") for source in sources[1:])]
    yield _of_replays(number_row("largest slip of a sole [mm]", slips, 2, most=MAX_SLIP))
    for label, key, digits in (
        ("largest lift of a sole [mm]", "sole_lift_mm", 2),
        ("impulse error [%]", "impulse_error_pct", 2),
        ("impulse, uncertainty by steps [%]", "step_error_pct", 3),
    ):
        yield _of_replays(number_row(label, [None, *(source.get(key) for source in sources[1:])], digits))
    yield from _gain_rows(sources)
    yield from _model_rows(sources)
    stands = [None, *(standing(source) for source in sources[1:])]
    yield _of_replays(word_row("stands at the end", stands, no_is_bad=True))


def _sole_rows(sources: Sequence[Mapping[str, Any]]) -> Iterator[Row | None]:
    """Rows of each sole: margin of its centre of pressure to its own edges in each phase, and least force.

    Labels have the margins required of the plan. Good is at least half of them in a plan and on fixed soles;
    on free ones, a sole that does not tip.
    """
    required, force = (
        sources[0].get("sole_cop_margin_asked_mm") or {},
        sources[0].get("sole_force_asked_N") or 0,
    )
    free = np.array([source.get("engine") == "mujoco" for source in sources])
    margins, forces = (
        [source.get(key) or {} for source in sources] for key in ("sole_cop_margin_mm", "sole_force_N")
    )
    for sole in dict.fromkeys(name for source in margins for name in source):
        own = [source.get(sole, {}) for source in margins]
        for phase in dict.fromkeys(name for by_phase in own for name in by_phase):
            of, half = "", -np.inf
            if phase in required:
                of, half = f" (of {required[phase]:g})", 1e3 * margin_between_nodes(1e-3 * required[phase])
            label = f"{sole} CoP margin [mm], {phase}{of}"
            least = np.where(free, 0.0, half) - TOLERANCE
            yield number_row(label, [by_phase.get(phase) for by_phase in own], 1, least=least)
        label = f"{sole} least force [N]{f' (of {force:g})' if force else ''}"
        values = [min(source.get(sole, {}).values(), default=None) for source in forces]
        yield number_row(label, values, 0, least=np.where(free, 0.0, SHARE * force) - TOLERANCE)


def standing(replay: Mapping[str, Any]) -> bool | None:
    """True if the robot stands at the end of a replay; None without soles: a bolted robot cannot fall."""
    return replay.get("standing") if replay.get("sole_force_N") else None


def contact_rows(sources: Sequence[Mapping[str, Any]]) -> Iterator[Row | None]:
    """Rows of the contact and of its result for the target."""
    for label, key, digits in (
        ("impulse [N s]", "impulse_Ns", 2),
        ("peak force [N]", "peak_force_N", 0),
        ("contact time [ms]", "contact_ms", 1),
        ("speed at contact [m/s]", "hand_speed_m_s", 3),
    ):
        yield number_row(label, [source.get(key) for source in sources], digits, small=True)
    yield from target_rows([source.get("target") or {} for source in sources])


def phase_rows(sources: Sequence[Mapping[str, Any]], phases: Iterable[str]) -> Iterator[Row | None]:
    """Rows of the quantities that have a value in each phase."""
    for label, key, digits, scale, least, most in (
        ("ZMP margin [mm]", "zmp_margin_m", 1, 1e3, 0.0, np.inf),
        ("torque demand / limit", "torque_ratio", 2, 1.0, 0.0, 1.0),
    ):
        for phase in phases:
            values = [source.get(key, {}).get(phase) for source in sources]
            yield number_row(f"{label}, {phase}", values, digits, scale=scale, least=least, most=most)


# numbers of a collision that have a limit, or are per cent of the impulse: less than a digit is none
_COARSE = ("freeze_error_pct", "zmp_margin_m", "sole_force_N", "torque_ratio", "velocity_ratio")


def collision_rows(found: Mapping[str, Any]) -> list[Row]:
    """Rows of one collision and those of a saved result; `found` as in `impactopt collide --json`."""
    # null: at some instant the ground carries no load, or would have to pull
    sources: list[Mapping[str, Any]] = [
        {key: -np.inf if key == "zmp_margin_m" and value is None else value for key, value in source.items()}
        for source in (found, *(found.get("saved") or {}).values())
    ]
    most_uncertain = -np.inf if found.get("caution") else np.inf
    rows = [
        number_row(
            label,
            [x.get(key) for x in sources],
            digits,
            scale=scale,
            least=least,
            most=most,
            small=key not in _COARSE,
        )
        for label, key, digits, scale, least, most in (
            ("speed at contact [m/s]", "hand_speed_m_s", 3, 1.0, -np.inf, np.inf),
            ("effective mass [kg]", "effective_mass_kg", 2, 1.0, -np.inf, np.inf),
            ("impulse [N s]", "impulse_Ns", 3, 1.0, -np.inf, np.inf),
            ("impulse, uncertainty by freezing [%]", "freeze_error_pct", 1, 1.0, -np.inf, most_uncertain),
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


def worst_constraints(violations: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    """Violated constraints and amounts, worst first: the worst of each term, and the number of the others.

    violations : as in ``summary.json``. Those below `MINOR` times the worst are consequences of it, and are
        left out.
    """
    worst = max((v.get("amount") or 0.0 for v in violations), default=0.0)
    terms: dict[str, list[Mapping[str, Any]]] = {}
    for v in violations:
        if v.get("amount") is None or v["amount"] >= MINOR * worst:
            terms.setdefault(str(v["row"]).partition(",")[0], []).append(v)

    def more(count: int) -> str:
        return f" (and {count} more)" if count else ""

    return [(f"{first['row']}{more(len(others))}", str(first["by"])) for first, *others in terms.values()]


def target_rows(targets: Sequence[Mapping[str, Any]]) -> Iterator[Row | None]:
    """Rows of the impact's effects on the target."""
    speeds = [target.get("speed_m_s") for target in targets]
    yield number_row("speed of the target [m/s]", speeds, 3, small=True)
    across = [target.get("tangential_speed_m_s") for target in targets]
    yield number_row("speed of the target across the normal [m/s]", across, 3, small=True)
    depths = [target.get("depth_m") for target in targets]
    yield number_row("driven into the wood [mm]", depths, 2, scale=1e3, small=True)
    yield word_row("the board breaks", [target.get("broken") for target in targets])


def _gain_rows(sources: Sequence[Mapping[str, Any]]) -> Iterator[Row]:
    """Rows of the gains that the plan has chosen."""
    others = (Cell(""),) * (len(sources) - 1)
    for chosen in sources[0].get("gains") or ():
        least, largest = chosen["between"]
        label = f"stiffness chosen, of {least:g} to {largest:g} times"
        yield Row(label, (Cell(f"{chosen['factor']:.3g}"), *others))
        first, *more = (f"{joint}: {k:.3g} N m/rad" for joint, k in chosen["stiffness_N_m_rad"].items())
        yield _of_joints([f"{first}, and {len(more)} more" if more else first, *[""] * len(others)])


def _model_rows(sources: Sequence[Mapping[str, Any]]) -> Iterator[Row | None]:
    """Rows of the plan's collision model, and of its errors against full dynamics."""
    plan, others = sources[0], (Cell(""),) * (len(sources) - 1)
    if (name := plan.get("collision_model")) is not None:
        freezes = plan.get("freezes") or 0
        again = f", {freezes:g} freeze{'s' if freezes > 1 else ''} on the way" if freezes else ""
        yield Row("model of the collision", (Cell(f"{name}{again}"), *others))
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
    least: float | Array = -np.inf,
    most: float = np.inf,
    small: bool = False,
) -> Row | None:
    """Row of numbers, good between `least` (of all, or of each) and `most`; None without any number.

    small : numbers keep two digits however small they are, as impulses of a target of grams.
    """
    if all(value is None for value in values):
        return None
    cells = [
        Cell("-") if v is None else Cell(_rounded(scale * v, digits, small=small), bool(low <= v <= most))
        for v, low in zip(values, np.broadcast_to(least, len(values)), strict=True)
    ]
    return Row(label, tuple(cells))


def _rounded(value: float, digits: int, *, small: bool = False) -> str:
    """Rounded number as text; a zero has no sign."""
    if small and 0 < abs(value) < 10.0 ** (1 - digits):
        return f"{value:.2g}"
    text = f"{value:.{digits}f}"
    return text.lstrip("-") if float(text) == 0 else text


def word_row(label: str, values: Sequence[Any], *, no_is_bad: bool = False) -> Row | None:
    """Row of yes and no; None if no column has either."""
    if all(value is None for value in values):
        return None
    cells = [
        Cell("-" if v is None else "yes" if v else "no", v is None or bool(v) or not no_is_bad)
        for v in values
    ]
    return Row(label, tuple(cells))


def _of_joints(names: Sequence[Any]) -> Row:
    """Row with the joints of the values above, from the left."""
    different = dict.fromkeys(str(name) for name in names if name)
    return Row(f"  at {', '.join(different)}", (Cell(""),) * len(names))


def _of_replays(row: Row | None) -> Row | None:
    """Row with an empty cell for the plan, which has no such value."""
    return None if row is None else Row(row.label, (Cell(""), *row.cells[1:]))


def _by_phase(report: Mapping[str, Any]) -> dict[str, Any]:
    """Report with its values by phase, under the keys of a summary."""
    names = {"zmp_margin_m": "zmp_margin_by_phase_m", "torque_ratio": "torque_ratio_by_phase"}
    return {**report, **{name: report.get(other) or {} for name, other in names.items()}} if report else {}


def _present(sources: Columns) -> Columns:
    """Columns with values, without those of simulations that failed."""
    return {name: source for name, source in sources.items() if source and "error" not in source}
