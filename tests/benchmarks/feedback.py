"""What is feedback worth to a plan? Balance as stated and loosened, with the joints' servos and a controller.

With a controller that can catch it, a plan may leave its balance to it: its centres of pressure come up to
the soles' edges, and its capture point is anywhere. Each plan is replayed under the same draws.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.kept import Kept
from benchmarks.pictures.feedback import feedback_picture
from benchmarks.planning import controller_in, solved
from benchmarks.report import Report, Say, columns_table
from impactopt import Solution
from impactopt.files.named_problems import problem_file
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import Balance, ContactWrenchCone
from impactopt.simulation import Perturbation
from impactopt.simulation.controller import CONTROLLERS
from impactopt.simulation.robustness import STEP, PerturbationRanges, Robustness, robustness

ROWS = Path("results/bench/feedback.jsonl")


def loosened(problem: ImpactProblem) -> ImpactProblem:
    """The problem with centres of pressure up to the soles' edges, and the capture point anywhere."""
    others = [term for term in problem.terms if not isinstance(term, (ContactWrenchCone, Balance))]
    cone, balance = problem.term(ContactWrenchCone), problem.term(Balance)
    loose = replace(cone, margin=0.0, collision_margin=0.0), replace(balance, capture_margin=None)
    return replace(problem, terms=(*others, *loose))


PROBLEMS = ("punch", "punch_strongest")
KEYS = ("problem", "balance", "controller", "draws", "seed")
BALANCE = {"stated": None, "loosened": loosened}  # what is done to a problem
COLUMNS = (
    ("problem", "problem", 0),
    ("balance", "balance", 0),
    ("controller", "controller", 0),
    ("planned N s", "impulse_planned_Ns", 2),
    ("as planned", "impulse_replayed_Ns", 2),
    ("stands", "nominal_standing", 0),
    ("of draws", "standing_rate", 2),
    ("slip mm", "slip_median_mm", 1),
    ("most", "slip_most_mm", 0),
)


def run(
    say: Say,
    *,
    problems: Sequence[str] | None = None,
    draws: int = 50,
    seed: int = 0,
    workers: int = 2,
    resume: bool = False,
) -> Report:
    """One row a problem, its balance as stated or loosened, and a controller.

    problems : names, or files; none: `PROBLEMS`.
    resume : rows of the same draws in results/bench/feedback.jsonl are not measured again.

    Raises
    ------
    InputError : no file of that name.
    """
    files = [problem_file(name) for name in problems or PROBLEMS]
    kept = Kept(ROWS, KEYS, resume=resume)
    rows: list[dict[str, Any]] = []
    for file, (balance, change) in product(files, BALANCE.items()):
        solution = None
        for controller in CONTROLLERS:
            case = (file.stem, balance, controller, draws, seed)
            found = kept.found.get(case)
            if found is None:
                solution = solved(file, say, change) if solution is None else solution
                row = _row(solution, file, controller, draws, seed, workers, say)
                found = kept.add({**dict(zip(KEYS, case, strict=True)), **row})
            rows.append(found)
    return Report(
        name="feedback",
        numbers={"rows": rows, "step_s": STEP},
        tables=(columns_table("plans, and what keeps them on their feet", COLUMNS, rows),),
        figures={"feedback": partial(feedback_picture, rows)},
    )


def _row(
    solution: Solution, file: Path, controller: str, draws: int, seed: int, workers: int, say: Say
) -> dict[str, Any]:
    """A plan that is none is its status."""
    out: dict[str, Any] = {"status": solution.status.value, **{key: None for _, key, _ in COLUMNS[3:]}}
    if not solution.status.usable:
        return out
    say(f"replaying {file} with {controller}: {draws} draws")
    settings = controller_in(file, controller)
    as_planned = Perturbation(period=PerturbationRanges().period)
    nominal = solution.validate(engine="mujoco", step=STEP, perturbation=as_planned, controller=settings)
    given = solution.problem, solution.trajectory, solution.impulse
    many = robustness(*given, draws=draws, seed=seed, workers=workers, controller=settings)
    return out | {
        "impulse_planned_Ns": solution.impulse,
        "impulse_replayed_Ns": nominal.impulse,
        "nominal_standing": bool(nominal.standing),
        **_share(many),
    }


def _share(many: Robustness) -> dict[str, Any]:
    """Slip is of the draws that stand."""
    slip = 1e3 * many.slip[many.standing]
    return {
        "standing": int(np.sum(many.standing)),
        "standing_rate": many.rate,
        "standing_interval_95": list(many.interval),
        "impulse_mean_Ns": many.impulse_mean,
        "impulse_std_Ns": many.impulse_std,
        "slip_median_mm": float(np.median(slip)) if slip.size else None,
        "slip_most_mm": float(slip.max()) if slip.size else None,
        "reasons": many.reasons(),
    }
