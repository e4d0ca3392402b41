"""How large is the replay's own error? The demo's plan with other steps, solver settings and floors.

Other steps are compared with the smallest one, other settings with the default ones at the same step.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.pictures.convergence import convergence_picture
from benchmarks.planning import DEMO, plan_of
from benchmarks.report import Report, Say, columns_table
from impactopt import Solution
from impactopt.errors import InputError
from impactopt.simulation import Perturbation, Simulation

STEPS = (7e-4, 2e-4, 1e-4, 5e-5, 2.5e-5)  # [s]; longer ones are shortened for the servo
STEP = 2e-4  # of the rows that change something else
FLOOR = Perturbation().floor_time
COLUMNS = (
    ("impulse N s", "impulse_Ns", 3),
    ("change %", "impulse_change_pct", 3),
    ("peak N", "peak_force_N", 1),
    ("change %", "peak_force_change_pct", 2),
    ("slip mm", "slip_mm", 2),
    ("base mm", "base_change_mm", 2),
    ("stands", "standing", 0),
)
OTHERS: dict[str, dict[str, Any]] = {
    "iterations 50": {"iterations": 50},
    "iterations 10": {"iterations": 10},
    "tolerance 1e-8": {"tolerance": 1e-8},
    "tolerance 1e-6": {"tolerance": 1e-6},
    f"floor time {500 * FLOOR:g} ms": {"perturbation": Perturbation(floor_time=FLOOR / 2)},
    **{
        f"floor time {1e3 * times * FLOOR:g} ms": {"perturbation": Perturbation(floor_time=times * FLOOR)}
        for times in (1.5, 2.0, 2.5)
    },
    "servo every 1 ms": {"perturbation": Perturbation(period=1e-3)},
    "friction 0.6": {"perturbation": Perturbation(friction=0.6)},
}


def run(say: Say, *, file: Path = DEMO, steps: tuple[float, ...] = STEPS) -> Report:
    """Replay the plan of a problem file with one setting changed at a time.

    steps [s] : descending; the last is what all is compared with.
    """
    solution = plan_of(file, say)
    finest = _replay(solution, say, step=steps[-1])
    if isinstance(finest, str):
        raise InputError(f"the replay with the smallest step, {steps[-1]:g} s, fails: {finest}")
    rows = [
        row({"step": step}, _replay(solution, say, step=step), finest) for step in steps[:-1] if step != STEP
    ]
    rows.append(row({"step": steps[-1]}, finest, finest))
    default = _replay(solution, say, step=STEP)
    rows.append(row({"step": STEP}, default, finest))
    rows.sort(key=lambda r: -float(r["step"]))
    others = []
    for name, options in OTHERS.items():
        found = _replay(solution, say, step=STEP, **options)
        if isinstance(default, Simulation):
            others.append(row({"step": STEP, "setting": name}, found, default))
    plan = f"{file}, planned {solution.impulse:.3f} N s"
    title = f"{plan}: changes from the replay with the smallest step"
    other = f"{plan}: changes from the replay with a step of {STEP:g} s and default settings"
    tables = (
        columns_table(title, (("step [s]", "step", "g"), *COLUMNS), rows),
        columns_table(other, (("setting", "setting", 0), *COLUMNS), others),
    )
    return Report(
        name="replay",
        numbers={
            "steps": rows,
            "settings": others,
            "problem": str(file),
            "planned_impulse_Ns": solution.impulse,
            "order": order(rows, "impulse_change_pct"),
        },
        tables=tables,
        figures={"replay": lambda: convergence_picture(rows, others)},
    )


def row(settings: dict[str, Any], simulation: Simulation | str, other: Simulation) -> dict[str, Any]:
    """Numbers of one replay and their changes from another one's."""
    out = dict(settings)
    if isinstance(simulation, str):
        return {**out, "standing": None, "reason": simulation}
    peak, other_peak = simulation.peak_force, other.peak_force
    moved = simulation.q[-1][:3] - other.q[-1][:3]
    return {
        **out,
        "impulse_Ns": simulation.impulse,
        "impulse_change_pct": 100 * (simulation.impulse / other.impulse - 1),
        "peak_force_N": peak,
        "peak_force_change_pct": 100 * (peak / other_peak - 1),
        "slip_mm": 1e3 * float(simulation.slip.max(initial=0.0)),
        "base_change_mm": 1e3 * float(np.linalg.norm(moved)),
        "standing": simulation.standing,
        "reason": simulation.fall,
    }


def order(rows: list[dict[str, Any]], key: str) -> float | None:
    """Slope of a change over the step, log-log; of steps at least eight times the smallest, so that its own
    error does not bend the line.
    """
    finest = min((r["step"] for r in rows), default=0.0)
    used = [(r["step"], abs(r[key])) for r in rows if r.get(key) and r["step"] > 7.9 * finest]
    if len(used) < 2:
        return None
    x, y = np.log(np.array(used)).T
    return float(np.polyfit(x, y, 1)[0])


def _replay(solution: Solution, say: Say, **options: Any) -> Simulation | str:
    """The replay, or why there is none."""
    say("replaying with " + ", ".join(f"{k} {_short(v)}" for k, v in options.items()))
    try:
        simulation: Simulation = solution.validate(engine="mujoco", **options)
    except InputError as error:
        return str(error)
    return simulation


def _short(value: Any) -> str:
    if not isinstance(value, Perturbation):
        return f"{value:g}"
    plan = Perturbation()
    changed = {k: v for k, v in vars(value).items() if v != getattr(plan, k)}
    return " ".join(f"{k}={v:g}" for k, v in changed.items())
