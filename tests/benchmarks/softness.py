"""What soft grips and soft gains bring: stiffer and stiffer joints, and those that a plan chooses.

One row a problem and a factor on the stiffness of some joints, and one where the factor is a variable of the
plan, between the least and the largest of these; each from one plain start. Planned and replayed (MuJoCo,
nothing held) load of the worst gear over its torque limit, and what becomes of the target.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.planning import solved
from benchmarks.report import Report, Say, columns_table
from impactopt import Solution
from impactopt.errors import InputError, check_number
from impactopt.files.named_problems import problem_file
from impactopt.problem.problem import ImpactProblem
from impactopt.robots.gains import GainFactor, scaled_gains

PROBLEMS = ("arm7", "nailing")  # gains of servos, and a tool that is held softly
FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)
COLUMNS = (
    ("problem", "problem", 0),
    ("stiffness x", "factor", 3),
    ("N m/rad", "stiffness_N_m_rad", 2),
    ("chosen", "chosen", 0),
    ("status", "status", 0),
    ("N s", "impulse_Ns", 2),
    ("J", "energy_J", 2),
    ("target", "target", 4),
    ("gear", "gear_planned", 2),
    ("replayed", "gear_replayed", 2),
    ("joint", "joint", 0),
    ("iterations", "iterations", 0),
    ("stands", "stands", 0),
)


def run(
    say: Say,
    *,
    problems: Sequence[str] | None = None,
    joints: Sequence[str] | None = None,
    factors: Sequence[float] | None = None,
) -> Report:
    """One row a problem and a factor, and one with what it chooses.

    problems : names, or files; none: PROBLEMS.  joints : whose stiffness it is, names or patterns; none:
    those of soft grips, or where there are none all.  factors : two or more; none: FACTORS.

    Raises
    ------
    InputError : no file of that name; no such joint; factors that are none, or fewer than two.
    """
    given = sorted({check_number("factor", factor) for factor in factors or FACTORS})
    if len(given) < 2 or not given[0] > 0:
        raise InputError(f"factors are {given}; give at least two, each > 0")
    files = [problem_file(name) for name in problems or PROBLEMS]
    rows = [
        _row(file, tuple(joints or ()), given, factor, say) for file in files for factor in (*given, None)
    ]

    def picture() -> Any:
        from benchmarks.pictures.softness import softness_picture

        return softness_picture(rows)

    return Report(
        name="softness",
        numbers={"rows": rows},
        tables=(columns_table("how soft, and what the plan chooses", COLUMNS, rows),),
        figures={"softness": picture},
    )


def _row(
    file: Path, joints: tuple[str, ...], given: Sequence[float], factor: float | None, say: Say
) -> dict[str, Any]:
    """factor : None: the plan chooses one. What is no plan is a row too."""
    out: dict[str, Any] = {"problem": file.stem, "chosen": factor is None, "factor": factor}

    def changed(problem: ImpactProblem) -> ImpactProblem:
        robot = problem.robot
        problem = replace(problem, gains=())  # a file may leave others open
        soft = [name for name, passive in zip(robot.joint_names, robot.sprung, strict=True) if passive]
        names = joints or tuple(soft) or ("*",)
        if factor is None:
            return replace(problem, gains=(GainFactor(joints=names, factor=(given[0], given[-1])),))
        return replace(problem, robot=scaled_gains(robot, dict.fromkeys(names, factor)))

    solution = solved(file, say, changed)
    out |= {"status": solution.status.value, "iterations": solution.result.iterations}
    if solution.gains:
        (chosen,) = solution.gains
        out |= {"factor": chosen.factor, "at_bound": chosen.at_bound}
    robot = solution.problem.robot
    if robot.sprung.sum() == 1:
        out["stiffness_N_m_rad"] = float(robot.kp[np.flatnonzero(robot.sprung)[0]])
    return out | (_found(solution) if solution.status.usable else {})


def _found(solution: Solution) -> dict[str, Any]:
    planned, replay = solution.loads.summary(), solution.validate(engine="mujoco")
    said = solution.summary(replay=replay)["replayed"]
    outcome = solution.plan.collision.outcome
    return {
        "impulse_Ns": solution.impulse,
        "energy_J": solution.objectives.get("target energy"),
        "target": next(iter(outcome.values()), None),
        "outcome": outcome,
        "gear_planned": planned["gear_ratio"],
        "gear_replayed": replay.loads.summary()["gear_ratio"],
        "joint": planned["gear_joint"],
        "stands": said["standing"],
    }
