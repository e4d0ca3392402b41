"""What gears cost a blow: each problem with less and less that a gear may bear, planned and replayed.

One row a problem, a factor on its robot's armature and a limit of `GearLoad`, and one without. Planned and
replayed (MuJoCo, nothing held) load of the worst gear over its torque limit, the joint that it is of, and
what moves with the limit: the striking point's speed, and what becomes of the target. What fails stays in.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.planning import solved
from benchmarks.report import Report, Say, columns_table
from impactopt import Solution
from impactopt.errors import InputError
from impactopt.files.named_problems import problem_file, problem_names
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import GearLoad
from impactopt.robots.robot import Robot

LIMITS: tuple[float | None, ...] = (None, 3.0, 2.0, 1.5, 1.0)
COLUMNS = (
    ("problem", "problem", 0),
    ("armature x", "armature", 2),
    ("gear limit", "gear_limit", 1),
    ("status", "status", 0),
    ("N s", "impulse_Ns", 2),
    ("target", "target", 3),
    ("speed m/s", "speed_m_s", 2),
    ("gear", "gear_planned", 2),
    ("replayed", "gear_replayed", 2),
    ("joint", "joint", 0),
    ("s", "seconds", 1),
    ("stands", "stands", 0),
)


def run(
    say: Say,
    *,
    problems: Sequence[str] | None = None,
    limits: Sequence[float | str | None] | None = None,
    armatures: Sequence[float] | None = None,
) -> Report:
    """One row a problem, a factor on its armature, and a limit.

    problems : names, or files; none: all of the package whose name does not end in "infeasible".
    limits : over the torque limit; None or "none" among them: gears bear what they have to; none: LIMITS.
    armatures : of all joints, times the problem's.

    Raises
    ------
    InputError : no file of that name; a limit or a factor that is none.
    """
    cases = [
        (_above_0("armature", factor), None if limit in (None, "none") else _above_0("limit", limit))
        for factor in armatures or (1.0,)
        for limit in limits or LIMITS
    ]
    chosen = problems or [name for name in problem_names() if not name.endswith("infeasible")]
    files = [problem_file(name) for name in chosen]
    rows = [_row(file.stem, file, case, say) for file in files for case in cases]

    def picture() -> Any:
        from benchmarks.pictures.machine import machine_picture

        return machine_picture(rows)

    return Report(
        name="machine",
        numbers={"rows": rows},
        tables=(columns_table("loads that gears may carry, and those of an impact", COLUMNS, rows),),
        figures={"machine": picture},
    )


def _above_0(name: str, given: Any) -> float:
    try:
        number = float(given)
    except ValueError:
        number = np.nan
    if not 0 < number < np.inf:
        raise InputError(f"{name} is {given!r}; give a number > 0")
    return number


def _heavier(factor: float, robot: Robot) -> Robot:
    """The robot with so much times its armature."""
    if factor == 1.0:
        return robot
    of_joints = zip(robot.joint_names, robot.actuators, robot.armature, strict=True)
    return robot.with_actuators({name: replace(own, armature=factor * a) for name, own, a in of_joints})


def _changed(factor: float, limit: float | None, problem: ImpactProblem) -> ImpactProblem:
    others = tuple(term for term in problem.terms if not isinstance(term, GearLoad))
    own = GearLoad(enabled=False) if limit is None else GearLoad(limit=limit)
    return replace(problem, robot=_heavier(factor, problem.robot), terms=(*others, own))


def _row(name: str, file: Path, case: tuple[float, float | None], say: Say) -> dict[str, Any]:
    """An error is its status, and ends what can be said; so does a plan that is none."""
    factor, limit = case
    out: dict[str, Any] = {"problem": name, "armature": factor, "gear_limit": limit}
    try:
        solution = solved(file, say, partial(_changed, factor, limit))
        out |= {"status": solution.status.value, "seconds": solution.solve_seconds}
        if solution.status.usable:
            out |= _found(solution)
    except InputError as error:
        out |= {"status": out.get("status", "error"), "error": str(error)}
        say(f"{name}: {error}")
    return out


def _found(solution: Solution) -> dict[str, Any]:
    replay = solution.validate(engine="mujoco")
    planned = {} if solution.loads is None else solution.loads.summary()
    said = solution.summary(replay=replay)["replayed"]
    outcome = solution.plan.collision.outcome
    return {
        "impulse_Ns": solution.impulse,
        "impulse_error_pct": said["impulse_error_pct"],
        "target": next(iter(outcome.values()), None),
        "outcome": outcome,
        "speed_m_s": solution.plan.hand_speed,
        "gear_planned": planned.get("gear_ratio"),
        "gear_replayed": replay.loads.summary()["gear_ratio"],
        "joint": planned.get("gear_joint"),
        "stands": said["standing"],
    }
