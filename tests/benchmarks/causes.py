"""Whether an infeasible plan names its cause: drawn variants of the arms, each named bound moved and solved.

Stiffness of the contact, duration and intervals of the swing and the torque's share are drawn; most of what
comes out asks too much of the arm. A cause is confirmed if the problem is solved from a plain start once that
bound is moved to the value that the message names.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.report import Report, Say, columns_table
from impactopt.errors import check_whole
from impactopt.files.problem_file import load_problem
from impactopt.planning.solve import solve
from impactopt.problem.phases import Phase
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import TorqueLimit

PROBLEMS = ("arm_planar", "arm7", "chop_arm")
# logarithms to base 10 of stiffness [N/m] and of the swing's duration [s]; intervals; torque over its limit
STIFFNESS, DURATION, INTERVALS, TORQUE = (3.5, 7.5), (-0.82, 0.48), (6, 40), (0.3, 1.0)
MOST = 10_000
COLUMNS = (
    ("problem", "problem", 0),
    ("N/m", "stiffness_N_m", ".2g"),
    ("swing [s]", "swing_s", 2),
    ("intervals", "intervals", 0),
    ("torque", "torque", 2),
    ("status", "status", 0),
    ("cause", "cause", 0),
    ("moved", "moved", 0),
)


def run(say: Say, *, draws: int = 26, seed: int = 0, problems: Sequence[str] = PROBLEMS) -> Report:
    """One row a draw.

    Raises
    ------
    InputError : no whole number of draws; no problem of that name.
    """
    rng = np.random.default_rng(seed)
    given = [load_problem(name) for name in problems]
    rows = []
    for k in range(check_whole("draws", draws, least=1, most=MOST)):
        numbers: dict[str, Any] = {
            "stiffness_N_m": float(10.0 ** rng.uniform(*STIFFNESS)),
            "swing_s": float(10.0 ** rng.uniform(*DURATION)),
            "intervals": int(rng.integers(INTERVALS[0], INTERVALS[1] + 1)),
            "torque": float(rng.uniform(*TORQUE)),
        }
        name = problems[k % len(problems)]
        say(f"draw {k + 1} of {draws}: {name}")
        rows.append({"problem": name, **numbers} | _found(_drawn(given[k % len(problems)], **numbers)))
    counts = Counter(row["kind"] for row in rows)
    kinds = ("solved", "confirmed", "not confirmed", "point masses", "no cause")
    found = {kind.replace(" ", "_"): counts[kind] for kind in kinds}
    title = ", ".join(f"{counts[kind]} {kind}" for kind in kinds)
    return Report(
        name="causes",
        numbers={**found, "draws": draws, "rows": rows},
        tables=(columns_table(f"infeasible arms and the bound that is named: {title}", COLUMNS, rows),),
    )


def _drawn(
    problem: ImpactProblem, *, stiffness_N_m: float, swing_s: float, intervals: int, torque: float
) -> ImpactProblem:
    law: Any = problem.law
    swing = Phase(duration=(swing_s, swing_s), intervals=intervals, grading=problem.swing.grading)
    terms = (*(t for t in problem.terms if not isinstance(t, TorqueLimit)), TorqueLimit(fraction=torque))
    return replace(problem, law=replace(law, stiffness=stiffness_N_m), swing=swing, terms=terms)


def _found(problem: ImpactProblem) -> dict[str, Any]:
    """Status, the first cause, what becomes of the problem with it moved, and which kind of row this is."""
    solution = solve(problem)
    status = solution.status.value
    if solution.status.usable:
        return {"status": status, "cause": "", "moved": "", "kind": "solved"}
    if not solution.causes or solution.causes[0].problem is None:
        said = solution.result.message.split(".")[0]
        known = "point masses" in said
        return {
            "status": status,
            "cause": said if known else "",
            "moved": "",
            "kind": "point masses" if known else "no cause",
        }
    moved = solve(solution.causes[0].problem).status
    kind = "confirmed" if moved.usable else "not confirmed"
    return {"status": status, "cause": str(solution.causes[0]), "moved": moved.value, "kind": kind}
