"""Table II: what each model of the hierarchy says of the nine motions, against full dynamics.

Errors are (estimate - reference) / reference; the paper's own error columns are by its eq. (24), which has
the other sign. HRP-2 and its gains are not public: what is to be compared is which model errs by how much.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from benchmarks.cases import Case
from benchmarks.paper.motions import (
    HIERARCHY,
    HORIZON,
    ROBOTS,
    WHOSE,
    Fidelity,
    motions,
    reference,
)
from benchmarks.paper.paper import OPENHRP3, TABLE_2, TABLE_3
from benchmarks.report import Report, Say, columns_table
from impactopt.collision import Collision, CollisionModel
from impactopt.simulation.cases import errors_against

ERRORS = ("impulse_error_pct", "f_max_error_pct", "zmp_error_mm", "torque_error_pct")
PRINTED = {"sdc-paper": TABLE_2, "virtual-mass": TABLE_3}
COLUMNS = (
    ("motion", "motion", 0),
    ("model", "model", 0),
    ("freezes", "freezes", 0),
    ("f_n N s", "impulse_Ns", 3),
    ("err %", "impulse_error_pct", 2),
    ("paper f_n", "impulse_paper_Ns", 1),
    ("err %", "impulse_error_paper_pct", 1),
    ("ZMP mm", "zmp_error_mm", 2),
    ("torque %", "torque_error_pct", 2),
    ("parted", "separated", 0),
)
WORST_COLUMNS = (
    ("robot", "robot", 0),
    ("model", "model", 0),
    ("freezes", "freezes", 0),
    ("worst", "worst_impulse_motion", 0),
    ("f_n %", "worst_impulse_error_pct", 2),
    ("median", "median_impulse_error_pct", 2),
    ("f_max %", "worst_f_max_error_pct", 3),
    ("ZMP mm", "worst_zmp_error_mm", 2),
    ("torque %", "worst_torque_error_pct", 2),
)


def run(say: Say, *, robots: Sequence[str] = ROBOTS, fidelities: Sequence[Fidelity] = HIERARCHY) -> Report:
    """Every motion of each robot through every model."""
    rows: list[dict[str, Any]] = []
    references: list[dict[str, Any]] = []
    forms: list[dict[str, Any]] = []
    tables = []
    for robot, cases in motions(robots, say):
        models = [(fidelity, fidelity.build(cases[0].robot)) for fidelity in fidelities]
        own = []
        for case in cases:
            say(f"{robot} {case.name}: full dynamics, and {len(models)} models (compile the first time)")
            true, change = reference(case)
            references.append(_reference_row(robot, case, true, change))
            own += [row(robot, case, fidelity, model, true) for fidelity, model in models]
        other, _ = reference(cases[0], form="pinocchio")
        one = references[-len(cases)]
        forms.append(
            {
                "robot": robot,
                "motion": cases[0].name,
                "lagrange_impulse_Ns": one["impulse_Ns"],
                "pinocchio_impulse_Ns": other.impulse,
                "relative_difference": abs(other.impulse / one["impulse_Ns"] - 1),
            }
        )
        rows += own
        title = f"Table II on {robot}, {WHOSE[robot]} (errors against full dynamics; the paper's: eq. 24)"
        tables.append(columns_table(title, COLUMNS, _by_motion(references[-len(cases) :], own)))
    worst = _worst(rows)
    tables.append(columns_table("largest errors over the nine motions", WORST_COLUMNS, worst))
    numbers: dict[str, Any] = {
        "rows": rows,
        "worst": worst,
        "reference": references,
        "forms": forms,
        "horizon_s": HORIZON,
    }
    return Report(name="table2", numbers=numbers, tables=tables)


def row(robot: str, case: Case, fidelity: Fidelity, model: CollisionModel, true: Collision) -> dict[str, Any]:
    """One model's collision; the paper's numbers beside it where the robot is its robot's stand-in."""
    found = case.collide(model)
    standin = robot == "standin"
    printed = PRINTED.get(fidelity.model, {}).get(case.name) if standin else None
    openhrp3 = OPENHRP3[case.name] if standin else None
    return {
        "robot": robot,
        "motion": case.name,
        "m_a_kg": case.effective_mass,
        "v_c_m_s": case.speed,
        "model": fidelity.model,
        "freezes": fidelity.freezes,
        "impulse_Ns": found.impulse,
        "impulse_reference_Ns": true.impulse,
        "f_max_N": found.peak_force,
        "f_max_reference_N": true.peak_force,
        **errors_against(found, true, torque_limit=case.robot.torque_limit),
        "duration_s": found.duration,
        "separated": found.separated,
        "reference_separated": true.separated,
        "impulse_paper_Ns": printed.impulse if printed else None,
        "f_max_paper_N": printed.f_max if printed else None,
        "impulse_error_paper_pct": printed.impulse_error if printed else None,
        "f_max_error_paper_pct": printed.f_max_error if printed else None,
        "impulse_openhrp3_Ns": openhrp3.impulse if openhrp3 else None,
        "f_max_openhrp3_N": openhrp3.f_max if openhrp3 else None,
    }


def _reference_row(robot: str, case: Case, true: Collision, change: float) -> dict[str, Any]:
    openhrp3 = OPENHRP3[case.name] if robot == "standin" else None
    return {
        "robot": robot,
        "motion": case.name,
        "impulse_Ns": true.impulse,
        "impulse_openhrp3_Ns": openhrp3.impulse if openhrp3 else None,
        "f_max_N": true.peak_force,
        "f_max_openhrp3_N": openhrp3.f_max if openhrp3 else None,
        "duration_s": true.duration,
        "separated": true.separated,
        "tighter_tolerance_changed_Ns": change,
    }


def _worst(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Largest errors of each model on each robot, in size."""
    found: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for r in rows:
        found.setdefault((r["robot"], r["model"], r["freezes"]), []).append(r)
    out = []
    for (robot, model, freezes), group in found.items():
        values = {key: [abs(r[key]) for r in group if r[key] is not None] for key in ERRORS}
        largest = {f"worst_{key}": max(some, default=None) for key, some in values.items()}
        impulses = sorted(values["impulse_error_pct"])
        hardest = max(group, key=lambda r: abs(r["impulse_error_pct"]))
        out.append(
            {
                "robot": robot,
                "model": model,
                "freezes": freezes,
                **largest,
                "worst_impulse_motion": hardest["motion"],
                "median_impulse_error_pct": impulses[len(impulses) // 2],
            }
        )
    return out


def _by_motion(references: list[dict[str, Any]], rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Each motion's reference, and below it its models."""
    out = []
    for true in references:
        out.append({**true, "model": "full", "impulse_paper_Ns": true["impulse_openhrp3_Ns"]})
        out += [{**r, "motion": ""} for r in rows if r["motion"] == true["motion"]]
    return out
