"""Plans that a solve left on disk: problem, reference, the solution again, and replays by an engine."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from impactopt.errors import InputError
from impactopt.files.output import Record, load_record, plain, replay_arrays
from impactopt.files.problem_file import ProblemFile, parse_problem_file, read_problem_file
from impactopt.planning.gain_selection import ChosenGains, with_chosen
from impactopt.planning.lazy_constraints import gear_caution, with_lazy_constraints
from impactopt.planning.reconstruction import program_on, solution_of
from impactopt.planning.refinement import Outcome
from impactopt.planning.solution import Solution
from impactopt.planning.solve import solve
from impactopt.problem.problem import ImpactProblem
from impactopt.simulation import Perturbation, Simulation, scene_of, simulate
from impactopt.simulation.controller import ControllerSettings, controller_of
from impactopt.simulation.engines import check_steps
from impactopt.solvers.program import SolverResult, Status, max_violation
from impactopt.transcription.clearance import ApartRow, Held
from impactopt.transcription.mesh import Elements, MoreNodes
from impactopt.transcription.plan import Trajectory
from impactopt.transcription.transcription import Transcription

__all__ = [
    "Planned",
    "Replay",
    "has_mujoco",
    "load_planned",
    "problem_of",
    "program_of_record",
    "replay",
    "resumed",
    "solution_of_record",
]

_SAME = 1e-6  # of constraints: those of a program that is not the record's are off by more


def resumed(record: Record, problem: ImpactProblem) -> Solution:
    """The solution that a record is of, as far as a start has to know it: of its history it knows nothing.

    The program is made again from what the record says of it. Where it says nothing, or the program is
    another one today, the problem is solved anew, from the record's variables if they fit.

    problem : the record's, as `impactopt.files.replay.load_planned` builds it.
    """
    made = program_of_record(record, problem)
    x = np.asarray(record.arrays["solver_x"])
    if made is not None and _is_of(made, record):
        return solution_of_record(record, made)
    if made is None or made.program.n != len(x):
        return solve(problem)
    return solve(problem, start=x)


def program_of_record(record: Record, problem: ImpactProblem) -> Transcription | None:
    """The program that a record says it is of, made again; None where it says nothing."""
    if "program_statement" not in record.arrays:
        return None
    told: dict[str, Any] = json.loads(str(record.arrays["program_statement"]))
    elements: Elements = tuple(tuple(e) for e in told["elements"]) if told["guarded"] else ()
    swing, follow, *stands = (tuple(places) for places in told["more"])
    nodes = MoreNodes(swing, follow, tuple(stands))
    t = program_on(problem, nodes, elements, tuple(told.get("shares", ())))
    return t.with_apart(_apart(told["apart"])) if told["apart"] else t


def _apart(told: list[dict[str, Any]]) -> dict[ApartRow, Held]:
    """Constraints between bodies."""
    return {
        ApartRow(*(row[key] for key in ApartRow._fields)): Held(
            tuple(row["way"]), row["reach"], row["travel"]
        )
        for row in told
    }


def _is_of(t: Transcription, record: Record) -> bool:
    """True if a program has the record's variables and constraints, with the violation that it reports."""
    x, rows = record.arrays["solver_x"], record.arrays["solver_multipliers"]
    if (t.program.n, t.program.m) != (len(x), len(rows)):
        return False
    found = max_violation(t.program, x, t.program.constraints(x))
    return bool(found <= float(record.arrays["solver_max_violation"]) + _SAME)


def solution_of_record(record: Record, t: Transcription) -> Solution:
    """The solution that a program's variables in a record are."""
    summary = record.summary
    given = {f.name: record.arrays.get(f"solver_{f.name}") for f in dataclasses.fields(SolverResult)}
    numbers: dict[str, Any] = {k: v if v.ndim else v.item() for k, v in given.items() if v is not None}
    status = Status(summary["status"])
    result = SolverResult(**numbers, status=status, message=str(summary["message"]))
    return solution_of(
        Outcome.of(t, result),
        solver=str(summary["solver"]),
        seconds=(float(summary["build_seconds"]), float(summary["solve_seconds"])),
        statement=str(record.arrays["program_statement"]),
        gains=tuple(map(ChosenGains.from_summary, summary.get("gains", ()))),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Planned:
    """Data of a replay: a record, its problem, the servo's reference and, if the plan has one, the reference
    that follows a missed blow; settings of a whole-body controller.
    """

    record: Record
    problem: ImpactProblem
    reference: Trajectory
    missed: Trajectory | None = None
    controller: ControllerSettings = field(default_factory=ControllerSettings)


@dataclass(frozen=True, kw_only=True, eq=False)
class Replay:
    """A replay: the world it found, its histories, and its numbers as in `impactopt validate --json`.

    record : the plan's, with this replay in place of its own.
    """

    planned: Planned
    perturbation: Perturbation
    simulation: Simulation
    report: dict[str, Any]
    record: Record


def has_mujoco() -> bool:
    """True if the engine "mujoco" is installed."""
    return importlib.util.find_spec("mujoco") is not None


def load_planned(
    result: str | os.PathLike[str],
    *,
    problem_file: str | os.PathLike[str] | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Planned:
    """The plan in a directory that `impactopt solve` wrote, or in its `solution.npz`.

    problem_file : instead of the record's own text, such as when that is missing or its URDF has moved.
    settings : other values of the problem, by key path.

    Raises
    ------
    InputError : there is no record, it holds no motion, or it does not fit the robot that the problem names.
    """
    record = load_record(result)
    if not record.completed:
        strike = "strike_posture" in record.arrays
        usual = "it is a strike, the blow alone" if strike else "the solve was stopped before there was one"
        note = record.summary.get("note", usual)
        raise InputError(f"{result} holds no motion to replay: {note}")
    file = _problem_file(record, Path(result), problem_file, settings)
    problem = _built(record, file, Path(result), given=problem_file is not None)
    a, robot = record.arrays, problem.robot
    if list(a["joints"]) != list(robot.joint_names) or a["reference_q"].shape[1] != robot.model.nq:
        raise InputError(
            f"{result} was planned for another robot than {robot.name!r} is today: its joints differ; "
            "solve again, or give the file of its problem with --problem"
        )
    missed = _trajectory(record, "missed") if "missed_time" in a else None
    return Planned(
        record=record,
        problem=problem,
        reference=_trajectory(record, "reference"),
        missed=missed,
        controller=file.controller,
    )


def _trajectory(record: Record, prefix: str) -> Trajectory:
    named = {f.name: f"{prefix}_{f.name}" for f in dataclasses.fields(Trajectory)}
    given = {name: record.arrays[key] for name, key in named.items() if key in record.arrays}
    fields: dict[str, Any] = {name: value if value.ndim else float(value) for name, value in given.items()}
    return Trajectory(**fields)


def problem_of(
    record: Record,
    result: Path,
    problem_file: str | os.PathLike[str] | None,
    settings: Mapping[str, Any] | None,
) -> ImpactProblem:
    """The problem of a record, built again; arguments as of `load_planned`.

    Raises
    ------
    InputError : the record has no problem file, or it cannot be built again.
    """
    file = _problem_file(record, result, problem_file, settings)
    return _built(record, file, result, given=problem_file is not None)


def _problem_file(
    record: Record,
    result: Path,
    problem_file: str | os.PathLike[str] | None,
    settings: Mapping[str, Any] | None,
) -> ProblemFile:
    if problem_file is not None:
        return read_problem_file(problem_file, settings)
    if not record.problem:
        raise InputError(f"{result} holds no problem file: give it with --problem FILE")
    path = record.problem_path or result / "problem.toml"
    try:
        return parse_problem_file(record.problem, path, settings)
    except InputError as error:
        raise _not_again(result, error) from error


def _built(record: Record, file: ProblemFile, result: Path, *, given: bool) -> ImpactProblem:
    """Problem with the lazy constraints and the touches that the record's plan needed, its chosen gains, and
    its style's prices.

    given : the file was, and is not the record's own text.
    """
    try:
        problem = file.build()
        told = record.summary.get("gains", ())
        problem = with_chosen(problem, [each["factor"] for each in told])
        if (scale := record.summary.get("price_scale", 1.0)) != problem.price_scale:
            problem = replace(problem, price_scale=scale)
        if problem.touches is None and (touches := record.summary.get("touches")) is not None:
            problem = replace(problem, touches=touches)
        return with_lazy_constraints(problem, record.summary.get("rows_on_demand", ()))
    except InputError as error:
        if given:
            raise
        raise _not_again(result, error) from error


def _not_again(result: Path, error: InputError) -> InputError:
    return InputError(
        f"the problem in {result} cannot be built again ({error}); if its files have moved, give the "
        "problem file with --problem FILE"
    )


def replay(
    planned: Planned,
    *,
    engine: str = "mujoco",
    perturbation: Perturbation | None = None,
    controller: str = "servo",
    contact: str = "point",
    **options: Any,
) -> Replay:
    """Follow the plan's reference in an engine; "mujoco" lets the robot slip, lift its soles and fall.

    perturbation : where the world differs from what was planned ("mujoco"; with "pinocchio" the target may
        be missing, no more).  controller : "servo", or "wbc" ("mujoco" only).  contact : "point", or "link"
        ("mujoco" only): the striking link's hull meets the target's body. The report then has impulse and
        first touch of both.  options : of the engine, such as ``step`` [s].

    Raises
    ------
    InputError : an unknown engine or option, a missing package, a simulation that diverges, or whose steps
        leave more than 1 % of its impulse uncertain.
    """
    world = perturbation if perturbation is not None else Perturbation()
    if engine == "pinocchio" and world == Perturbation(missing=True):
        options["missing"] = True
    elif world != Perturbation():
        options["perturbation"] = world
    options["missed"] = planned.missed
    options["controller"] = controller_of(controller, planned.controller)
    problem = planned.problem
    if contact != "point" and engine != "mujoco":
        raise InputError(f"engine {engine!r} knows striking points only; take engine 'mujoco'")
    met: dict[str, Any] = {} if contact == "point" else {"contact": contact}
    simulation = simulate(problem, planned.reference, engine=engine, **options, **met)
    check_steps(simulation, options.get("step"))
    if met:
        point = simulate(problem, planned.reference, engine=engine, **options)
        met |= {**_touch(simulation), "point": _touch(point)}
    report = plain(
        simulation.report(
            torque_limit=world.torque_limit * problem.robot.torque_limit,
            polygon=scene_of(problem).polygon,
            planned_impulse=float(planned.record.summary["impulse_Ns"]),
        )
        | {"controller": controller}
        | met
    )
    kept = {n: v for n, v in planned.record.arrays.items() if not n.startswith("replayed_")}
    kept |= {name: np.asarray(value) for name, value in replay_arrays(simulation).items()}
    beyond = gear_caution(problem, [simulation.loads])
    summary = {**planned.record.summary, "replayed": report, **beyond}
    record = dataclasses.replace(planned.record, arrays=kept, summary=summary)
    return Replay(planned=planned, perturbation=world, simulation=simulation, report=report, record=record)


def _touch(simulation: Simulation) -> dict[str, float]:
    """Impulse [N s], and how much earlier than planned contact begins [ms]."""
    early = simulation.expected - simulation.contact_start
    return {"impulse_Ns": simulation.impulse, "first_touch_ms": 1e3 * early}
