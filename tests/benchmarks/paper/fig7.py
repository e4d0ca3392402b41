"""Fig. 7: contact force over time, motions of type C (8 kg) at three speeds, on the stand-in.

Every model of the hierarchy is drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.paper.motions import HIERARCHY, WHOSE, Fidelity, motions, reference
from benchmarks.paper.paper import OPENHRP3, TABLE_2, TABLE_3
from benchmarks.report import Report, Say, columns_table
from impactopt.collision import Collision

if TYPE_CHECKING:
    from impactopt.report.pictures.style import Picture

ROBOT, TYPE = "standin", "C"
# as the legend has them; the reference
FULL = "full dynamics"
LABELS = {
    "virtual-mass": "virtual mass",
    "sdc-paper": "SDC as in the paper",
    "sdc": "SDC",
}
PRINTED = {FULL: OPENHRP3, LABELS["sdc-paper"]: TABLE_2, LABELS["virtual-mass"]: TABLE_3}
COLUMNS = (
    ("motion", "motion", 0),
    ("model", "model", 0),
    ("v_c m/s", "v_c_m_s", 1),
    ("f_max N", "f_max_N", 1),
    ("paper", "f_max_paper_N", 1),
    ("f_n N s", "impulse_Ns", 2),
    ("paper", "impulse_paper_Ns", 1),
    ("ms", "duration_ms", 1),
)


def run(say: Say, *, robot: str = ROBOT, fidelities: Sequence[Fidelity] = HIERARCHY) -> Report:
    """Force histories of the virtual mass, both kinds of SDC, ours frozen again on the way, full dynamics."""
    rows: list[dict[str, Any]] = []
    found: dict[str, dict[str, Collision]] = {}
    speeds = {}
    for _, cases in motions((robot,), say):
        models = {label(fidelity): fidelity.build(cases[0].robot) for fidelity in fidelities}
        for case in (case for case in cases if case.name.startswith(TYPE)):
            say(f"{case.name}: full dynamics, and {len(models)} models (compile the first time)")
            results = {name: case.collide(model) for name, model in models.items()}
            results[FULL] = reference(case)[0]
            found[case.name], speeds[case.name] = results, case.speed
            rows += [_row(case.name, case.speed, name, result) for name, result in results.items()]
    table = columns_table(
        f"Fig. 7: type {TYPE} on {robot}, {WHOSE[robot]}; the paper's full dynamics are OpenHRP3's",
        COLUMNS,
        [{**r, "duration_ms": 1e3 * r["duration_s"]} for r in rows],
    )
    return Report(
        name="fig7",
        numbers={"robot": robot, "rows": rows},
        tables=(table,),
        figures={"fig7": lambda: draw(found, speeds)},
    )


def label(fidelity: Fidelity) -> str:
    """What the table and the legend call a fidelity."""
    name = LABELS[fidelity.model]
    if fidelity.model != "sdc":
        return name
    return f"{name}, frozen {fidelity.freezes} x more" if fidelity.freezes else f"{name}, frozen at contact"


def _row(motion: str, speed: float, model: str, result: Collision) -> dict[str, Any]:
    printed = PRINTED[model][motion] if model in PRINTED else None
    # a quarter of a millisecond apart is enough for a picture
    time = np.append(np.arange(0.0, result.duration, 2.5e-4), result.duration)
    return {
        "motion": motion,
        "v_c_m_s": speed,
        "model": model,
        "f_max_N": result.peak_force,
        "f_max_paper_N": printed.f_max if printed else None,
        "impulse_Ns": result.impulse,
        "impulse_paper_Ns": printed.impulse if printed else None,
        "duration_s": result.duration,
        "time_s": time,
        "force_N": np.interp(time, result.time, result.force),
    }


def draw(found: dict[str, dict[str, Collision]], speeds: dict[str, float]) -> Picture:
    """A row a speed, as in the paper; beside each history what the models are off."""
    from impactopt.report.pictures.hierarchy import hierarchy

    rows = {f"{motion}, {speeds[motion]:g} m/s": models for motion, models in found.items()}
    return hierarchy(rows, reference=FULL)
