"""Replays of a plan in both engines, and its baseline, in parallel processes if requested."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

from impactopt.errors import InputError, missing_package
from impactopt.files.output import record_of
from impactopt.files.problem_file import ProblemFile
from impactopt.files.record import Record
from impactopt.planning.budget import VIOLATED
from impactopt.planning.minimum_jerk import minimum_jerk_baseline
from impactopt.planning.solution import Solution
from impactopt.report.console import SolveConsole
from impactopt.simulation.engines import has_mujoco
from impactopt.simulation.workers import Died, each_on_workers
from impactopt.solvers.program import Status

BASELINE = "baseline"
METHOD = "minimum jerk"


def compared_record(
    solution: Solution,
    read: ProblemFile,
    progress: SolveConsole,
    *,
    validate: bool,
    baseline: bool,
    workers: int,
) -> Record:
    """Record of a solution with its replays and its baseline, if it can be replayed.

    After Ctrl-C, or if processes do not start, the record has the results that are finished.

    workers : parallel processes; 1: none, one job after the other.
    """
    jobs = [*(_engines(solution, progress) if validate else ()), *([BASELINE] if baseline else ())]
    if solution.status is Status.INTERRUPTED:
        jobs = []
    names = {
        "pinocchio": "replay in full dynamics",
        "mujoco": f"replay {'on free soles' if solution.problem.soles else 'in MuJoCo'}",
        BASELINE: "search for the hardest minimum-jerk reach",
    }
    done, failed = dict[str, Any](), dict[str, str]()
    why = ""
    try:
        for job, found in _in_parallel(solution, jobs, names, min(workers, len(jobs)), progress):
            if isinstance(found, str):
                failed[job] = found
                progress.say(f"no result of the {names[job]}: {found}")
            else:
                done[job] = found
    except KeyboardInterrupt:
        why = "interrupted"
    except InputError as error:  # the processes do not start
        why = str(error)
    if missing := [job for job in jobs if job not in done and job not in failed]:
        progress.say(
            f"{why}; the plan is kept without results of: {', '.join(names[job] for job in missing)}"
        )
        failed |= dict.fromkeys(missing, why)
    record = record_of(
        solution,
        simulation=done.get("pinocchio"),
        replay=done.get("mujoco"),
        problem=read.text,
        problem_path=read.path,
    )
    lost = [f"no result of the {names[job]}: {reason}" for job, reason in failed.items() if job != BASELINE]
    if lost:  # readers of files and pages have not seen the progress
        record.summary["note"] = "; ".join(filter(None, [record.summary.get("note"), *lost]))
    if BASELINE in jobs:
        record.summary[BASELINE] = done.get(BASELINE) or {"method": METHOD, "error": failed[BASELINE]}
    return record


def _engines(solution: Solution, progress: SolveConsole) -> list[str]:
    """Engines that can replay the plan; if there are none, the console shows the reason."""
    violation = solution.result.max_violation
    if solution.status is Status.INTERRUPTED:
        progress.say("no replay after an interruption; `impactopt validate` does it")
    elif not violation <= VIOLATED:
        progress.say(f"no replay: the constraints are violated by up to {violation:.2g}")
    elif has_mujoco():
        return ["pinocchio", "mujoco"]
    else:
        unknown = ": whether the robot stands is not checked" if solution.problem.soles else ""
        progress.say(f"{missing_package('no replay in MuJoCo', 'mujoco', 'validate')}{unknown}")
        return ["pinocchio"]
    return []


def _in_parallel(
    solution: Solution, jobs: list[str], names: dict[str, str], workers: int, progress: SolveConsole
) -> Iterator[tuple[str, Any]]:
    """Each job with its result, or with the reason why there is none.

    names : names of the jobs in messages.

    Raises
    ------
    InputError : the processes do not start.
    """
    if workers < 2:
        for job in jobs:
            progress.say(names[job])
            yield job, _done(solution, job)
        return
    progress.say(f"in parallel: {', '.join(names[job] for job in jobs)}")
    with contextlib.closing(each_on_workers(_done, solution, enumerate(jobs), workers=workers)) as results:  # type: ignore[type-var]
        for k, found in results:
            died = isinstance(found, Died)
            yield jobs[k], f"its process has died (exit code {found.code})" if died else found


def _done(solution: Solution, job: str) -> Any:
    """Result of the replay in an engine, or of the baseline; the reason as text if there is none."""
    try:
        if job == BASELINE:
            return minimum_jerk_baseline(solution.problem).describe()
        return solution.validate(engine=job)
    except InputError as error:
        return str(error)
    except Exception as error:  # whatever fails after the plan, the plan is kept
        return f"{type(error).__name__}: {error}"
