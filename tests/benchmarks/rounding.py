"""The same plan everywhere? Each problem again and again, its hit point moved by less than any machine tells.

One row a problem: how many of the runs are solved, the least and the most iterations, and the spread of the
impulse. What rounding decides here it decides on another machine, too.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.kept import Kept
from benchmarks.report import Report, Say, columns_table
from impactopt.files.problem_file import load_problem, problem_names
from impactopt.planning.solve import solve

ROWS = Path("results/bench/rounding.jsonl")
MOVED = 1e-10  # [m]
COLUMNS = (
    ("problem", "problem", 0),
    ("runs", "runs", 0),
    ("solved", "solved", 0),
    ("iterations, least", "iterations_least", 0),
    ("most", "iterations_most", 0),
    ("impulse N s", "impulse_Ns", 3),
    ("spread %", "spread_pct", 2),
)


def run(
    say: Say,
    *,
    problems: Sequence[str] | None = None,
    draws: int = 5,
    seed: int = 0,
    resume: bool = False,
    rows: Path = ROWS,
) -> Report:
    """One row a problem.

    problems : names; all that are solved by default.  draws : runs of each, the first of them as it is.
    resume : do not repeat rows that the file has.
    """
    names = problems or [name for name in problem_names() if not name.endswith("infeasible")]
    kept = Kept(rows, ("problem", "runs"), resume=resume)
    found = []
    for name in names:
        if (name, draws) not in kept.found:
            kept.add(_row(name, draws, seed))
        found.append(kept.found[name, draws])
        say(", ".join(f"{key} {found[-1][key]}" for _, key, _ in COLUMNS))
    title = f"hit points moved by {MOVED:g} m"
    return Report(
        name="rounding", numbers={"rows": found, "seed": seed}, tables=(columns_table(title, COLUMNS, found),)
    )


def _row(name: str, draws: int, seed: int) -> dict[str, Any]:
    problem, rng = load_problem(name), np.random.default_rng(seed)
    plans = []
    for k in range(draws):
        point = problem.point + (MOVED * rng.standard_normal(3) if k else 0.0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the row says which are solved
            plans.append(solve(replace(problem, point=point)))
    iterations = [plan.result.iterations for plan in plans]
    impulses = np.array([plan.impulse for plan in plans])
    return {
        "problem": name,
        "runs": draws,
        "solved": sum(plan.status.usable for plan in plans),
        "iterations_least": min(iterations),
        "iterations_most": max(iterations),
        "impulse_Ns": float(np.median(impulses)),
        "spread_pct": float(100 * np.ptp(impulses) / np.median(impulses)),
    }
