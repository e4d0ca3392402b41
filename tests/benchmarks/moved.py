"""Plans bent for other numbers: how long that takes, and how near the first order comes to the polished plan.

Shifts are drawn: the point by up to 2 cm along each axis, the target's mass by up to 30 %, the contact's
stiffness between half and twice.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import Report, Say, columns_table
from impactopt import Solution, solve
from impactopt.errors import InputError
from impactopt.files.problem_file import load_problem
from impactopt.problem.problem import ImpactProblem

PROBLEMS, QUICK = ("punch", "arm_planar"), ("arm_planar",)
FAR, HEAVIER, STIFFER = 0.02, 0.3, 2.0  # [m], of the mass, of the stiffness
COLUMNS = (
    ("problem", "problem", 0),
    ("shifts", "shifts", 0),
    ("first order ms", "first_order_ms_median", 1),
    ("impulse error %", "first_order_impulse_error_pct_worst", 2),
    ("median", "first_order_impulse_error_pct_median", 3),
    ("rows within 1e-3", "first_order_rows_met", 0),
    ("polished ms", "polished_ms_median", 1),
    ("worst", "polished_ms_worst", 1),
    ("solved", "polished_solved", 0),
    ("iterations", "iterations_median", 0),
)


def run(
    say: Say, *, quick: bool = False, shifts: int = 200, seed: int = 0, problems: Sequence[str] = ()
) -> Report:
    """One row a problem.  shifts : of each.  quick : the planar arm only, if no problems are named."""
    rows = []
    for name in problems or (QUICK if quick else PROBLEMS):
        say(f"{name}: a plan, and {shifts} of it bent")
        solution = solve(load_problem(name), report=say)
        rows.append({"problem": name, **_row(solution, shifts, np.random.default_rng(seed))})
    return Report(
        name="moved",
        numbers={**{key: rows[0][key] for key in rows[0] if key != "problem"}, "rows": rows},
        tables=(columns_table("plans bent for other numbers of their problem", COLUMNS, rows),),
    )


def _row(solution: Solution, shifts: int, draw: np.random.Generator) -> dict[str, Any]:
    problem = solution.problem
    moves = "mass" in problem.target.parameters
    found = []
    for k in range(shifts + 1):
        changes: dict[str, Any] = {
            "point": problem.point + draw.uniform(-FAR, FAR, 3) * _free(problem),
            "stiffness": problem.law.parameters["stiffness"] * STIFFER ** draw.uniform(-1, 1),
        }
        if moves:
            factor = 1 + draw.uniform(-HEAVIER, HEAVIER)
            changes["mass"] = problem.target.parameters["mass"] * factor
        try:
            one = _timed(solution, changes)
        except InputError:  # a point that is out of reach
            continue
        if k:  # the first factors the KKT system, and builds what all share
            found.append(one)
    if not found:
        raise InputError("no shift has a problem: give more of them")
    first, polished, error, met, solved, iterations = (
        np.array(column) for column in zip(*found, strict=True)
    )
    error = error[solved & np.isfinite(error)]
    return {
        "shifts": len(found),
        "first_order_ms_median": float(np.median(first)),
        "first_order_impulse_error_pct_worst": float(error.max(initial=0.0)),
        "first_order_impulse_error_pct_median": float(np.median(error)) if error.size else None,
        "first_order_rows_met": int(met.sum()),
        "polished_ms_median": float(np.median(polished)),
        "polished_ms_worst": float(polished.max()),
        "polished_solved": int(solved.sum()),
        "iterations_median": float(np.median(iterations)),
    }


def _free(problem: ImpactProblem) -> NDArray[np.float64]:
    """1 along the axes in which the point can be moved: the planar arm does not leave its plane."""
    return np.array([1.0, float(problem.robot.n > 3), 1.0])


def _timed(solution: Solution, changes: dict[str, Any]) -> tuple[float, float, float, bool, bool, int]:
    began = time.process_time()
    first = solution.moved(**changes, polish=False)
    middle = time.process_time()
    polished = solution.moved(**changes)
    end = time.process_time()
    error = 100 * abs(first.impulse / polished.impulse - 1)
    return (
        1e3 * (middle - began),
        1e3 * (end - middle),
        error,
        first.status.usable,
        polished.status.usable,
        polished.result.iterations,
    )
