"""How often does a plan stand when target, contact, servo and floor are not quite as planned?"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.pictures.robustness import robustness_picture
from benchmarks.planning import DEMO, controller_in, plan_of
from benchmarks.report import Report, Say, cell, make_table
from impactopt.simulation import Perturbation, Simulation
from impactopt.simulation.robustness import STEP, PerturbationRanges, Robustness, robustness

ROBUST = Path("problems/punch_robust.toml")
SAID_EVERY = 20  # draws


def run(
    say: Say,
    *,
    file: Path | None = None,
    draws: int = 200,
    seed: int = 0,
    workers: int = 2,
    controller: str = "servo",
) -> Report:
    """Plan a problem file, and replay the plan under drawn perturbations.

    file : default: problems/punch_robust.toml, and where it is not there the demo's.
    controller : "servo", or "wbc" with the file's settings.
    """
    chosen = file if file is not None else ROBUST if ROBUST.exists() else DEMO
    settings = controller_in(chosen, controller)
    solution = plan_of(chosen, say)
    as_planned = Perturbation(period=PerturbationRanges().period)
    nominal = solution.validate(engine="mujoco", step=STEP, perturbation=as_planned, controller=settings)

    def progress(done: int, of: int) -> None:
        if done % SAID_EVERY == 0 or done == of:
            say(f"{done} of {of} replays")

    result = robustness(
        solution.problem,
        solution.trajectory,
        solution.impulse,
        draws=draws,
        seed=seed,
        workers=workers,
        controller=settings,
        progress=progress,
    )
    numbers = {
        **numbers_of(result),
        "seed": seed,
        "controller": controller,
        "problem": str(chosen),
        "nominal_standing": nominal.standing,
        "nominal_impulse_Ns": nominal.impulse,
    }
    return Report(
        name="robustness",
        numbers=numbers,
        tables=tables_of(result, str(chosen), nominal),
        figures={"robustness": lambda: robustness_picture(result)},
    )


def numbers_of(result: Robustness) -> dict[str, Any]:
    """For JSON; ``standing`` is the number of draws that stand."""
    return {
        "draws": result.draws,
        "standing": int(np.sum(result.standing)),
        "impulse_mean_Ns": result.impulse_mean,
        "impulse_std_Ns": result.impulse_std,
        "standing_rate": result.rate,
        "standing_interval_95": result.interval,
        "planned_impulse_Ns": result.planned_impulse,
        "without_result": int(np.sum(~np.isfinite(result.impulse))),
        "reasons": result.reasons(),
        "separation": result.separation(),
        "standing_by_third": result.by_third(),
        "ranges": asdict(result.drawn_from),
        "rows": {
            **{name: list(value) for name, value in result.table().items()},
            "standing": [bool(x) for x in result.standing],
            "reason": list(result.reason),
            "impulse_Ns": list(result.impulse),
            "slip_m": list(result.slip),
            "lift_m": list(result.lift),
        },
    }


def tables_of(result: Robustness, title: str, nominal: Simulation) -> tuple[Any, ...]:
    """Rate, impulse and reasons; and what tells the draws apart that stand and that do not."""
    low, high = result.interval
    stands = f"{int(result.standing.sum())} of {result.draws}"
    rows = [
        ["stand", f"{stands}: {100 * result.rate:.0f} % (95 %: {100 * low:.0f} to {100 * high:.0f})"],
        ["impulse [N s]", f"{cell(result.impulse_mean, 2)} +- {cell(result.impulse_std, 2)}"],
        ["planned [N s]", f"{result.planned_impulse:.2f}"],
        ["as planned", f"{nominal.fall or 'stands'}, {nominal.impulse:.2f} N s"],
        *([reason, str(count)] for reason, count in result.reasons().items()),
    ]
    thirds = result.by_third()
    ordered = sorted(thirds.items(), key=lambda item: np.nanmin(item[1]) - np.nanmax(item[1]))
    means = result.separation()
    parts = [
        [
            name,
            *("-" if np.isnan(x) else f"{100 * x:.0f} %" for x in shares),
            *(cell(means[name][key], 3) for key in ("stands", "falls")),
            cell(means[name]["apart"], "+.2f"),
        ]
        for name, shares in ordered
    ]
    columns = ["stand in its", "lower third", "middle", "upper", "mean: stands", "falls", "apart [std]"]
    return (
        make_table(f"robustness: {title}", ["", ""], rows),
        make_table("what tells them apart", columns, parts),
    )
