"""A fair baseline: what people do today, on the same robot and in the same limits, beside our plans.

Every reference is replayed in MuJoCo with free soles, as planned and under drawn perturbations. All plans
keep the same limits in the swing and in the follow-through, but the minimum-jerk reach, which needs no margin
to the soles' edges; the rows of the collision are ours only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.crocoddyl_peer import crocoddyl_plan
from benchmarks.planning import DEMO, controller_in, plan_of
from benchmarks.report import Report, Say, columns_table
from impactopt import Solution
from impactopt.errors import InputError
from impactopt.planning.minimum_jerk import minimum_jerk_baseline
from impactopt.planning.solve import solve
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import Balance
from impactopt.simulation import ControllerSettings, Simulation, simulate
from impactopt.simulation.robustness import robustness
from impactopt.transcription.plan import Trajectory

TIME_LIMIT = 120.0  # [s] of the solver
CROCODDYL = "Crocoddyl, rigid impulse"
ANY_BALANCE = Balance(capture_margin=None, vertical_speed=np.inf, angular_momentum=np.inf)
OURS = ("punch_strongest.toml", "punch_robust.toml")  # beside the demo, where they are


@dataclass(frozen=True, kw_only=True, eq=False)
class Method:
    """One way to plan a punch: its reference, and the impulse [N s] that it promises."""

    name: str
    problem: ImpactProblem
    reference: Trajectory
    impulse: float


def run(
    say: Say,
    *,
    file: Path = DEMO,
    draws: int = 50,
    seed: int = 0,
    workers: int = 2,
    controller: str = "servo",
    crocoddyl: Path | None = None,
) -> Report:
    """One row a method; ``draws`` perturbations are drawn for each.

    controller : "servo" or "wbc".  crocoddyl : an interpreter that has it, for a plan by it.
    """
    rows, settings = [], controller_in(file, controller)
    for name, make in methods(file, say, crocoddyl):
        try:
            rows.append(row(make(), say, draws, seed, workers, settings))
        except InputError as error:  # a method that finds no plan stays in
            say(f"{name}: {error}")
            rows.append({**dict.fromkeys(KEYS), "method": name, "reason": str(error), "standing": False})
        rows[-1]["controller"] = controller
    title = f"what people do today, and ours: {file}, replayed on free soles"
    table = columns_table(title, COLUMNS, rows)
    numbers = {"rows": rows, "problem": str(file), "draws": draws, "seed": seed}
    return Report(name="baselines", numbers=numbers, tables=(table,))


COLUMNS = (
    ("method", "method", 0),
    ("planned N s", "impulse_planned_Ns", 2),
    ("replayed N s", "impulse_replayed_Ns", 2),
    ("stands", "standing", 0),
    ("of draws", "standing_rate", 2),
    ("slip mm", "sole_slip_mm", 1),
    ("lift mm", "sole_lift_mm", 1),
    ("torque demand", "torque_ratio", 2),
)
KEYS = (*(key for _, key, _ in COLUMNS), "reason")


def methods(
    file: Path, say: Say, crocoddyl: Path | None = None
) -> Iterator[tuple[str, Callable[[], Method]]]:
    """Names, and what plans them."""
    ours = plan_of(file, say)
    problem = ours.problem
    loose = tuple(t for t in problem.terms if not isinstance(t, Balance))
    yield "minimum-jerk reach", lambda: _minimum_jerk(problem)
    if crocoddyl is not None:
        yield CROCODDYL, lambda: _crocoddyl(problem, crocoddyl, say)
    for kind, label in (("rigid", "rigid impact"), ("virtual-mass", "virtual-mass collision")):
        for terms, what in (((*loose, ANY_BALANCE), ""), (problem.terms, ", balance after it")):
            changed = replace(problem, collision=kind, terms=terms, scenarios=())
            full = f"{label}{what}"
            yield full, lambda p=changed, n=full: _of(n, solve(p, time_limit=TIME_LIMIT))  # type: ignore[misc]
    yield f"ours, {file.name}", lambda: _of(f"ours, {file.name}", ours)
    for other in OURS:
        path = file.parent / other
        if path.exists():
            yield f"ours, {other}", lambda p=path: _of(f"ours, {p.name}", plan_of(p, say))  # type: ignore[misc]


def _minimum_jerk(problem: ImpactProblem) -> Method:
    found = minimum_jerk_baseline(problem)
    return Method(
        name="minimum-jerk reach", problem=problem, reference=found.reference, impulse=found.impulse
    )


def _crocoddyl(problem: ImpactProblem, python: Path, say: Say) -> Method:
    found = crocoddyl_plan(problem, python)
    how = "solved" if found.solved else "stopped"
    say(f"{CROCODDYL}: {how} after {found.iterations} iterations, {found.seconds:.1f} s")
    return Method(name=CROCODDYL, problem=problem, reference=found.reference, impulse=found.impulse)


def _of(name: str, solution: Solution) -> Method:
    if not solution.status.usable:
        raise InputError(f"no plan: {solution.result.message}")
    return Method(
        name=name, problem=solution.problem, reference=solution.trajectory, impulse=solution.impulse
    )


def row(
    method: Method,
    say: Say,
    draws: int,
    seed: int,
    workers: int,
    controller: ControllerSettings | None = None,
) -> dict[str, Any]:
    """What a method promises, and what comes of it."""
    say(f"replaying {method.name}")
    replay: Simulation = simulate(method.problem, method.reference, engine="mujoco", controller=controller)
    limit = method.problem.robot.torque_limit
    out = {
        "method": method.name,
        "impulse_planned_Ns": method.impulse,
        "impulse_replayed_Ns": replay.impulse,
        "standing": bool(replay.standing),
        "reason": replay.fall,
        "sole_slip_mm": 1e3 * float(replay.slip.max(initial=0.0)),
        "sole_lift_mm": 1e3 * float(replay.lift.max(initial=0.0)),
        "torque_ratio": float(np.abs(replay.demand / limit).max()),
    }
    if draws:
        many = robustness(
            method.problem,
            method.reference,
            method.impulse,
            draws=draws,
            seed=seed,
            workers=workers,
            controller=controller,
        )
        out["standing_rate"] = many.rate
    return out
