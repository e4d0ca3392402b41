"""Replays of a plan in both engines and its baseline, side by side on processes where that was asked for."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

from impactopt.errors import InputError
from impactopt.files.output import Record, record_of
from impactopt.files.problem_file import ProblemFile
from impactopt.files.replay import has_mujoco
from impactopt.planning.budget import VIOLATED
from impactopt.planning.minimum_jerk import minimum_jerk_baseline
from impactopt.planning.solution import Solution
from impactopt.report.console import SolveConsole
from impactopt.simulation.workers import Died, each_on_workers
from impactopt.solvers.program import Status

__all__ = ["compared_record"]

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
    """The solution as numbers, with its replays and its baseline, where there is something to replay.

    workers : processes that do these side by side; 1: one after the other, here.

    Ctrl-C, and processes that do not start, keep the plan with what is done.
    """
    jobs = [*(_engines(solution, progress) if validate else ()), *([BASELINE] if baseline else ())]
    if solution.status is Status.INTERRUPTED:
        jobs = []
    told = {
        "pinocchio": "replay in full dynamics",
        "mujoco": f"replay {'on free soles' if solution.problem.soles else 'in MuJoCo'}",
        BASELINE: "search for the hardest minimum-jerk reach",
    }
    done, failed = dict[str, Any](), dict[str, str]()
    why = ""
    try:
        for job, found in _side_by_side(solution, jobs, told, min(workers, len(jobs)), progress):
            if isinstance(found, str):
                failed[job] = found
                progress.say(f"no result of the {told[job]}: {found}")
            else:
                done[job] = found
    except KeyboardInterrupt:
        why = "interrupted"
    except InputError as error:  # the processes do not start
        why = str(error)
    if left := [job for job in jobs if job not in done and job not in failed]:
        progress.say(f"{why}; the plan is kept without results of: {', '.join(told[job] for job in left)}")
        failed |= dict.fromkeys(left, why)
    record = record_of(
        solution,
        simulation=done.get("pinocchio"),
        replay=done.get("mujoco"),
        problem=read.text,
        problem_path=read.path,
    )
    if BASELINE in jobs:
        record.summary[BASELINE] = done.get(BASELINE) or {"method": METHOD, "error": failed[BASELINE]}
    return record


def _engines(solution: Solution, progress: SolveConsole) -> list[str]:
    """The engines that can replay the plan; why there are none is told."""
    violation = solution.result.max_violation
    if solution.status is Status.INTERRUPTED:
        progress.say("no replay of what was interrupted; `impactopt validate` does it")
    elif not violation <= VIOLATED:
        progress.say(f"no replay: what meets its constraints only to {violation:.2g} is no plan")
    else:
        return ["pinocchio", *(["mujoco"] if has_mujoco() else [])]
    return []


def _side_by_side(
    solution: Solution, jobs: list[str], told: dict[str, str], workers: int, progress: SolveConsole
) -> Iterator[tuple[str, Any]]:
    """Each job's name with its result, or with the reason why there is none.

    told : what each job is, for the user.

    Raises
    ------
    InputError : the processes do not start.
    """
    if workers < 2:
        for job in jobs:
            progress.say(told[job])
            yield job, _done(solution, job)
        return
    progress.say(f"side by side: {', '.join(told[job] for job in jobs)}")
    with contextlib.closing(each_on_workers(_done, solution, enumerate(jobs), workers=workers)) as results:  # type: ignore[type-var]
        for k, found in results:
            died = isinstance(found, Died)
            yield jobs[k], f"its process has died (exit code {found.code})" if died else found


def _done(solution: Solution, job: str) -> Any:
    """The replay in an engine, or the baseline's numbers; a text where that cannot be had."""
    try:
        if job == BASELINE:
            return minimum_jerk_baseline(solution.problem).describe()
        return solution.validate(engine=job)
    except InputError as error:
        return str(error)
