"""Kinds of cases: a whole motion, a strike, or one collision of many; each makes a row from its settings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from impactopt.files.output import Record, plain, record_of, record_of_strike, summary_of
from impactopt.files.problem_file import ProblemFile, problem_file_from_data
from impactopt.files.solution_library import SolvedFolder
from impactopt.planning.solution import Solution
from impactopt.planning.solve import solve
from impactopt.planning.strike import StrikeSolution, optimize_strike
from impactopt.problem.problem import ImpactProblem
from impactopt.sweeps.collisions import Collisions
from impactopt.sweeps.progress import START
from impactopt.sweeps.units import Columns, Unit, Work
from impactopt.sweeps.watchdog import Watchdog

__all__ = ["CASE_KINDS"]

Rows = tuple[Columns, Mapping[int, Record]]

_PLAIN = (
    START,
    "impulse_Ns",
    "peak_force_N",
    "contact_ms",
    "hand_speed_m_s",
    "duration_s",
    "capture_margin_m",
    "max_violation",
    "iterations",
    "solve_seconds",
    "build_seconds",
)
_UNITS = {"N s": "_Ns", "N": "_N", "J": "_J", "m": "_m", "s": "_s", "(N m s)^2": "_N2m2s2"}


def _plan(work: Work, unit: Unit, watchdog: Watchdog) -> Rows:
    file = _file(work, unit)
    problem = file.build()
    options = {
        "starts": work.starts,
        "seed": work.seed,
        "report": watchdog.building,
        "callback": watchdog.iteration,
        **_arguments(file, work),
    }
    solution: Solution | StrikeSolution
    started: dict[str, str] = {}
    if work.case_kind == "strike":
        solution = optimize_strike(problem, **options)
    elif work.solved is not None:
        folder = SolvedFolder(work.solved)
        solution, near = folder.solve(problem, file, **options)
        folder.keep(solution, file, f"{unit.first:06d}")
        started = {START: near.path.name if near is not None else ""}
    else:
        solution = solve(problem, start=work.start, **options)
    if not work.trajectories:
        return _row({**summary_of(solution), **started}, problem), {}
    from_file: Any = {"problem": file.text, "problem_path": file.path}
    if isinstance(solution, StrikeSolution):
        record = record_of_strike(solution, **from_file)
    else:
        record = record_of(solution, **from_file)
    return _row({**record.summary, **started}, problem), {unit.first: record}


def _collide(work: Work, unit: Unit, watchdog: Watchdog) -> Rows:
    global _kept
    if _kept is None or _kept[0] != work:  # what rows share is made once a worker
        file = problem_file_from_data(work.data, where=work.path)
        keys, folder = tuple(unit.columns), work.folder
        _kept = work, Collisions(file, work.at_contact, work.outputs, keys=keys, folder=folder)
    rows = _kept[1](unit.columns, threads=1)
    return {"reason": rows.pop("reason").tolist(), **rows}, {}


_kept: tuple[Work, Collisions] | None = None
CASE_KINDS: dict[str, Callable[[Work, Unit, Watchdog], Rows]] = {
    "solve": _plan,
    "strike": _plan,
    "collision": _collide,
}


def _file(work: Work, unit: Unit) -> ProblemFile:
    settings = {key: values[0] for key, values in unit.columns.items()}
    return problem_file_from_data(work.data, where=work.path).changed(settings)


def _arguments(file: ProblemFile, work: Work) -> dict[str, Any]:
    own = file.solver.time_limit
    limits = [seconds for seconds in (own, work.time_limit) if seconds is not None]
    return file.solver.arguments(time_limit=min(limits, default=None))


def _row(summary: Mapping[str, Any], problem: ImpactProblem) -> Columns:
    """The numbers of a summary as columns, each named with its unit."""
    usable = summary["status"] in ("solved", "acceptable") and "note" not in summary
    row = {
        "status": summary["status"],
        "reason": "" if usable else " ".join(filter(None, (summary["message"], summary.get("note")))),
    }
    row |= {name: summary[name] for name in _PLAIN if name in summary}
    row |= {f"target_{name}": value for name, value in (summary.get("target") or {}).items()}
    row |= {f"torque_ratio_{phase}": x for phase, x in summary.get("torque_ratio", {}).items()}
    row |= {f"zmp_margin_{phase}_m": x for phase, x in summary.get("zmp_margin_m", {}).items()}
    units = {objective.name: _UNITS.get(objective.unit, "") for objective in problem.objectives}
    for name, value in summary.get("objectives", {}).items():
        row[f"objective_{name.replace(' ', '_')}{units[name]}"] = value
    for scenario in summary.get("scenarios", ()):
        name = str(scenario["name"]).replace(" ", "_")
        row |= {f"{name}_{key}": x for key, x in scenario.items() if isinstance(x, (int, float))}
    return {name: [value] for name, value in plain(row).items()}
