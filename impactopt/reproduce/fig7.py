"""Fig. 7: contact force over time, motions of type C (8 kg) at three speeds, on the stand-in."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from impactopt.bench.report import Report, Say, columns_table
from impactopt.collision import Collision
from impactopt.reproduce.motions import LADDER, WHOSE, motions, reference
from impactopt.reproduce.paper import OPENHRP3, TABLE_2, TABLE_3

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["run"]

ROBOT, TYPE = "standin", "C"
SHOWN = (("virtual-mass", None), ("sdc-paper", 0), ("sdc", 0))
# as the legend has them
LABELS = {
    "full": "full dynamics",
    "sdc": "SDC",
    "sdc-paper": "SDC as in the paper",
    "virtual-mass": "virtual mass",
}
PRINTED = {"full": OPENHRP3, "sdc-paper": TABLE_2, "virtual-mass": TABLE_3}
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


def run(say: Say, *, robot: str = ROBOT) -> Report:
    """Force histories of full dynamics, both kinds of SDC, and the virtual mass."""
    rows: list[dict[str, Any]] = []
    found: dict[str, dict[str, Collision]] = {}
    speeds = {}
    for _, cases in motions((robot,), say):
        models = {r.model: r.build(cases[0].robot) for r in LADDER if (r.model, r.freezes) in SHOWN}
        for case in (case for case in cases if case.name.startswith(TYPE)):
            say(f"{case.name}: full dynamics, and {len(models)} models (compile the first time)")
            results = {"full": reference(case)[0]}
            results |= {name: case.collide(model) for name, model in models.items()}
            found[case.name], speeds[case.name] = results, case.speed
            rows += [_row(case.name, case.speed, name, result) for name, result in results.items()]
    table = columns_table(
        f"Fig. 7: type {TYPE} on {robot}, {WHOSE[robot]}; the paper's full dynamics are OpenHRP3's",
        COLUMNS,
        [{**r, "model": LABELS[r["model"]], "duration_ms": 1e3 * r["duration_s"]} for r in rows],
    )
    return Report(
        name="fig7",
        numbers={"robot": robot, "rows": rows},
        tables=(table,),
        figures={"fig7": lambda: draw(found, speeds, robot)},
    )


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


def draw(found: dict[str, dict[str, Collision]], speeds: dict[str, float], robot: str) -> Figure:
    """One panel a speed, as in the paper."""
    from matplotlib.figure import Figure

    from impactopt.plotting.style import BLACK, BLUE, GREEN, VERMILION

    styles: dict[str, dict[str, Any]] = {
        "full": {"color": BLACK, "linewidth": 3.2, "alpha": 0.35},
        "sdc": {"color": BLUE, "linewidth": 1.4},
        "sdc-paper": {"color": VERMILION, "linestyle": "--"},
        "virtual-mass": {"color": GREEN, "linestyle": ":", "linewidth": 2.0},
    }
    figure = Figure(figsize=(7.0, 7.4))
    panels: list[Any] = list(figure.subplots(len(found), 1, sharex=True, squeeze=False)[:, 0])
    last = max(result.duration for results in found.values() for result in results.values())
    for axes, (motion, results) in zip(panels, found.items(), strict=True):
        for model, style in styles.items():
            result = results[model]
            # force begins with a jump, by the damper, and ends at separation
            time = 1e3 * np.concatenate([[-0.03 * last, 0.0], result.time, [1.06 * last]])
            force = np.concatenate([[0.0, 0.0], result.force, [0.0]])
            axes.plot(time, force, label=f"{LABELS[model]}: {result.impulse:.2f} N s", **style)
        axes.set_title(f"{motion}: {speeds[motion]:g} m/s", loc="left")
        axes.set(ylabel="force on the target [N]", xlim=(-30 * last, 1060 * last))
        axes.set_ylim(bottom=0.0)
        axes.legend(title="impulse", loc="upper right")
    panels[-1].set_xlabel("time since contact [ms]")
    figure.suptitle(f"Contact force, 8 kg of effective mass ({robot})")
    return figure
