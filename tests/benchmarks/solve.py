"""Which solver solves which problem, how reliably and how fast?

Every problem from several starts, by every solver of the table in `solvers.py`; each solve in a process of
its own (`attempts.py`), kept in a file as soon as it is done.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.attempts import Attempt, Make, attempt
from benchmarks.kept import Kept
from benchmarks.report import Report, Say, columns_table
from benchmarks.solvers import SOLVERS
from impactopt.errors import InputError, did_you_mean
from impactopt.files.named_problems import problem_file, problem_names
from impactopt.files.problem_file import read_problem_file
from impactopt.solvers.program import NonlinearProgram, Status, Vector

if TYPE_CHECKING:
    from impactopt.transcription.transcription import Transcription

ATTEMPTS = Path("results/bench/solve.jsonl")
VIOLATION, KKT, LOSS = 1e-6, 1e-4, 0.01  # at most, of a success; loss: relative to the best known objective
NOISE = 0.1  # [rad] of the posture at contact in a perturbed start
SPEEDS = (0.5, 1.5)  # [m/s] of the strike in a perturbed start
QUICK = ("ipm", "ipopt")
KINDS = ("motion", "clear", "strike")
KEYS = ("problem", "solver", "start", "time_limit")  # of an attempt

COLUMNS = (
    ("problem", "problem", 0),
    ("solver", "label", 0),
    ("success", "success", 2),
    ("s", "median_seconds", 1),
    ("QP s", "seconds_qp", 1),
    ("steps", "median_iterations", 0),
    ("objective", "objective", 3),
    ("violation", "max_violation", ".0e"),
    ("KKT", "kkt", ".0e"),
)


def run(
    say: Say,
    *,
    problem: str | None = None,
    kind: str = "motion",
    starts: int = 3,
    time_limit: float = 60.0,
    seed: int = 0,
    solvers: Sequence[str] = (),
    quick: bool = False,
    attempts: Path = ATTEMPTS,
    resume: bool = False,
) -> Report:
    """One row a problem and solver.

    problem : one of `problem_names()`, or a file; default: all.  kind : "motion", without clearance of
    bodies; "clear", with it; or the "strike" alone, of collocated contact.  starts : the plain first iterate,
    and perturbed ones.  time_limit [s] : of one solve.  solvers : labels in `SOLVERS`; default: all.
    quick : one start, our default and IPOPT.  attempts : file that keeps every solve, a JSON object a line.
    resume : do not repeat solves that it has.

    Raises
    ------
    InputError : an unknown problem, kind or solver; the file cannot be written or read.
    """
    if kind not in KINDS:
        raise InputError(f"kind {kind!r}{did_you_mean(kind, KINDS)}: give {' or '.join(KINDS)}")
    made = {"motion": planning_program, "clear": clear_program, "strike": strike_program}[kind]
    makes: dict[str, Make] = {path.stem: partial(made, path, seed) for path in _files(problem)}
    chosen = _chosen(solvers or (QUICK if quick else tuple(SOLVERS)))
    number = 1 if quick else starts
    kept = Kept(attempts, KEYS, resume=resume)
    rows = []
    for name, make in makes.items():
        found = {
            label: [_one(say, kept, _told(name, kind), make, label, k, time_limit) for k in range(number)]
            for label in chosen
        }
        rows += summary(name, found)
    shown = [{**row, "label": f"{row['solver']}:{row['qp']}".rstrip(":")} for row in rows]
    table = columns_table(f"starts: {number}, of at most {time_limit:g} s each", COLUMNS, shown)
    settings = {"kind": kind, "starts": number, "time_limit": time_limit, "seed": seed}
    return Report(name="solve", numbers={"rows": rows, **settings}, tables=(table,))


def planning_program(file: Path, seed: int, start: int) -> tuple[NonlinearProgram, Vector]:
    """The program of a problem file, and a start: number 0 is the plain reach, others strike at another speed
    from another posture.
    """
    from impactopt.transcription.initial_guess import first_iterate

    transcription = _transcription(file)
    return transcription.program, first_iterate(transcription, **_drawn(seed, start))


def clear_program(file: Path, seed: int, start: int) -> tuple[NonlinearProgram, Vector]:
    """As :func:`planning_program`, with clearance constraints from the start: those that our solver has at
    the end of its solve from the plain start. So all solvers have the same.
    """
    from impactopt.planning.budget import Budget
    from impactopt.planning.clearance_constraints import Margins, solve_with_clearance
    from impactopt.planning.refinement import Guess
    from impactopt.transcription.initial_guess import first_iterate

    plain = _transcription(file)
    budget = Budget(solver="ipm", options=None, time_limit=None, callback=None)
    margins = Margins(plain.problem) if plain.problem.keeps_apart else None
    solved = solve_with_clearance(budget, margins, Guess(program=plain, start=first_iterate(plain)))
    return solved.program.program, first_iterate(plain, **_drawn(seed, start))


def _transcription(file: Path) -> Transcription:
    from impactopt.files.problem_file import load_problem
    from impactopt.transcription.transcription import Transcription, block_functions

    problem = load_problem(file)
    return Transcription(problem, block_functions(problem))


def strike_program(file: Path, seed: int, start: int) -> tuple[NonlinearProgram, Vector]:
    """As :func:`planning_program`, of the strike."""
    from impactopt.files.problem_file import load_problem
    from impactopt.transcription.initial_guess import strike_iterate
    from impactopt.transcription.strike import StrikeTranscription
    from impactopt.transcription.transcription import block_functions

    problem = load_problem(file)
    transcription = StrikeTranscription(problem, block_functions(problem))
    return transcription.program, strike_iterate(transcription, **_drawn(seed, start))


def _drawn(seed: int, start: int) -> dict[str, Any]:
    if start == 0:
        return {}
    speed = float(np.random.default_rng([seed, start]).uniform(*SPEEDS))
    return {"speed": speed, "noise": NOISE, "seed": 1000 * seed + start}


def _told(problem: str, kind: str) -> str:
    """What the file of attempts calls a problem's motion, or its strike."""
    return problem if kind == "motion" else f"{problem}, {kind}"


def summary(problem: str, attempts: Mapping[str, Sequence[Attempt]]) -> list[dict[str, Any]]:
    """The rows of a problem from its attempts by solver.

    A problem whose name ends in "infeasible" is solved by who says that it is; any other by a usable status
    at a point that is feasible, stationary and within 1 % of the best that any solver found.
    """
    everything = [a for some in attempts.values() for a in some]
    best = min((a.objective for a in everything if a.max_violation <= VIOLATION), default=None)
    hopeless = problem.endswith("infeasible")

    def success(a: Attempt) -> bool:
        if hopeless:
            return a.status == Status.INFEASIBLE.value
        return (
            a.status in (Status.SOLVED.value, Status.ACCEPTABLE.value)
            and a.max_violation <= VIOLATION
            and a.kkt <= KKT
            and best is not None
            and a.objective <= best + LOSS * abs(best)
        )

    rows = []
    for label, some in attempts.items():
        shown = min(some, key=_rank)
        rows.append(
            {
                "problem": problem,
                "solver": SOLVERS[label].name,
                "qp": SOLVERS[label].qp,
                "starts": len(some),
                "success": sum(map(success, some)) / len(some),
                "median_seconds": _median([a.seconds for a in some]),
                "median_iterations": _median([a.iterations for a in some]),
                "objective": _number(shown.objective),
                "best_known": best,
                "max_violation": _number(shown.max_violation),
                "kkt": _number(shown.kkt),
                "seconds_functions": _median([a.seconds_functions for a in some]),
                "seconds_qp": _median([a.seconds_qp for a in some]),
            }
        )
    return rows


def _rank(a: Attempt) -> tuple[float, float]:
    """Least violation first; of what is feasible, the best objective."""
    violation = np.inf if np.isnan(a.max_violation) else max(a.max_violation, VIOLATION)
    return violation, np.inf if np.isnan(a.objective) else a.objective


def _median(values: Sequence[float]) -> float | None:
    known = [v for v in values if np.isfinite(v)]
    return float(np.median(known)) if known else None


def _number(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _one(
    say: Say, kept: Kept, problem: str, make: Make, label: str, start: int, time_limit: float
) -> Attempt:
    key = dict(zip(KEYS, (problem, label, start, time_limit), strict=True))
    row = kept.found.get(tuple(key.values()))
    if row is None:
        row = kept.add({**key, **dataclasses.asdict(attempt(make, start, label, time_limit))})
    given: dict[str, Any] = {k: np.nan if v is None else v for k, v in row.items() if k not in KEYS}
    try:
        found = Attempt(**given)
    except TypeError as error:
        raise InputError(f"the file of attempts has lines of another kind: {error}") from error
    say(f"{problem}, {label}, start {start}: {found.status}, {found.seconds:.2f} s, {found.objective:.4f}")
    return found


def _files(problem: str | None) -> list[Path]:
    files = [problem_file(name) for name in (problem_names() if problem is None else (problem,))]
    for file in files:
        read_problem_file(file)  # what is wrong in it is said before hours are spent on others
    return files


def _chosen(labels: Sequence[str]) -> list[str]:
    for label in labels:
        if label not in SOLVERS:
            raise InputError(
                f"there is no solver {label!r}{did_you_mean(label, SOLVERS)}: there are {', '.join(SOLVERS)}"
            )
    return list(labels)
