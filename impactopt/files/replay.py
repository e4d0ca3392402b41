"""Saved results read back: problem, reference and solution; their replays by an engine."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from impactopt.bodies.robot_bodies import bodies_of
from impactopt.errors import InputError
from impactopt.files.output import replay_arrays
from impactopt.files.problem_file import ProblemFile, read_problem_file
from impactopt.files.record import Record, load_record, plain
from impactopt.planning.gain_selection import ChosenGains, with_chosen
from impactopt.planning.lazy_constraints import gear_caution, with_lazy_constraints
from impactopt.planning.refinement import Outcome
from impactopt.planning.solution import Solution, program_on, solution_of
from impactopt.planning.solve import solve
from impactopt.problem.problem import ImpactProblem
from impactopt.simulation import Perturbation, Simulation, scene_of, simulate
from impactopt.simulation.controller import ControllerSettings, controller_of
from impactopt.simulation.engines import check_steps
from impactopt.solvers.program import SolverResult, Status, max_violation
from impactopt.transcription.clearance import ClearanceKey, SeparatingDirection
from impactopt.transcription.mesh import Elements, MoreNodes
from impactopt.transcription.plan import Trajectory
from impactopt.transcription.transcription import Transcription

# Tolerance of the recorded violation of constraints. A program that differs from the record's, as of another
# version, has a larger violation at its variables.
_SAME = 1e-6


def resumed(record: Record, problem: ImpactProblem, *, other: bool = False) -> Solution:
    """The solution of a record, for a warm start; without the history of its solve.

    The program is rebuilt from its description in the record. If there is none, or the program differs today,
    the problem is solved again, from the record's solution if the number of variables is the same.

    problem : the record's, as `impactopt.files.replay.load_planned` builds it.
    other : it is not the record's, and solved again: the record may meet its constraints, and be no optimum.
    """
    x, made = np.asarray(record.arrays["solver_x"]), None
    with contextlib.suppress(ValueError, LookupError):  # of other bodies, stances or phases
        made = program_of_record(record, problem)
    if made is not None and not other and _same_program(made, record):
        return solution_of_record(record, made)
    if made is None or made.program.n != len(x):
        return solve(problem)
    arrays = dict(record.arrays)
    if len(arrays["solver_multipliers"]) != made.program.m:
        arrays["solver_multipliers"] = np.zeros(made.program.m)
    # A solution, not its variables: these are of the record's mesh.
    return solve(problem, start=solution_of_record(dataclasses.replace(record, arrays=arrays), made))


def program_of_record(record: Record, problem: ImpactProblem) -> Transcription | None:
    """The program of a record, rebuilt from its description; None if the record has none."""
    if "program_statement" not in record.arrays:
        return None
    statement: dict[str, Any] = json.loads(str(record.arrays["program_statement"]))
    elements: Elements = tuple(tuple(e) for e in statement["elements"]) if statement["guarded"] else ()
    swing, follow, *stances = (tuple(added) for added in statement["added_nodes"])
    nodes = MoreNodes(swing, follow, tuple(stances), bool(statement.get("nodes_in_contact")))
    t = program_on(problem, nodes, elements, tuple(statement.get("shares", ())))
    clearances = {
        ClearanceKey(*(entry[key] for key in ClearanceKey._fields)): SeparatingDirection(
            tuple(entry["vector"]), entry["least_distance"]
        )
        for entry in statement["clearance"]
    }
    return t.with_clearance(clearances) if clearances else t


def _same_program(t: Transcription, record: Record) -> bool:
    """True if a program has the sizes of the record's, and the recorded violation at its variables."""
    x, multipliers = record.arrays["solver_x"], record.arrays["solver_multipliers"]
    if (t.program.n, t.program.m) != (len(x), len(multipliers)):
        return False
    violation = max_violation(t.program, x, t.program.constraints(x))
    return bool(violation <= float(record.arrays["solver_max_violation"]) + _SAME)


def solution_of_record(record: Record, t: Transcription) -> Solution:
    """The solution of a program at the variables in a record."""
    summary = record.summary
    given = {f.name: record.arrays.get(f"solver_{f.name}") for f in dataclasses.fields(SolverResult)}
    numbers: dict[str, Any] = {k: v if v.ndim else v.item() for k, v in given.items() if v is not None}
    status = Status(summary["status"])
    result = SolverResult(**numbers, status=status, message=str(summary["message"]))
    outcome = Outcome.of(t, result)
    estimated = outcome.usable and summary.get("collision_error_pct") is not None
    return solution_of(
        outcome,
        solver=str(summary["solver"]),
        seconds=(float(summary["build_seconds"]), float(summary["solve_seconds"])),
        statement=str(record.arrays["program_statement"]),
        gains=tuple(map(ChosenGains.from_summary, summary.get("gains", ()))),
        contact_error=outcome.at.contact_error if estimated else None,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Planned:
    """Input of a replay: a record, its problem, the servo's reference, the reference for a missed target if
    the plan has one, and settings of a whole-body controller.

    given : the problem is of a file that the user gives, not of the record's own text.
    """

    record: Record
    problem: ImpactProblem
    reference: Trajectory
    missed: Trajectory | None = None
    controller: ControllerSettings = field(default_factory=ControllerSettings)
    given: bool = False

    @property
    def of_other_problem(self) -> bool:
        """True if `problem` is given, and known not to be the one that the record's plan was made for."""
        return self.given and not _may_be_of(self.record, self.problem)


def _may_be_of(record: Record, problem: ImpactProblem) -> bool:
    """True unless a record's plan is known to be of another problem."""
    known = record.summary.get("problem", {})
    if known.get("hash") not in (None, problem.hash):
        return False
    return "hulls" not in known or known["hulls"] == bodies_of(problem.robot).hash


@dataclass(frozen=True, kw_only=True, eq=False)
class Replay:
    """A replay: its perturbation, its histories, and its numbers as in `impactopt validate --json`.

    record : the plan's, with this replay instead of an earlier one.
    """

    planned: Planned
    perturbation: Perturbation
    simulation: Simulation
    report: dict[str, Any]
    record: Record


def load_planned(
    result: str | os.PathLike[str],
    *,
    problem_file: str | os.PathLike[str] | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Planned:
    """The plan in a directory that `impactopt solve` wrote, or in its `solution.npz`.

    problem_file : used instead of the record's own text, such as when that is missing or its URDF has moved.
    settings : changed values of the problem, by key path.

    Raises
    ------
    InputError : there is no record, it holds no motion, or its joints are not those of the problem's robot.

    Warns
    -----
    UserWarning : the record's own problem is another one today.
    """
    record = load_record(result)
    if not record.completed:
        strike = "strike_posture" in record.arrays
        usual = "it is a strike, the impact alone" if strike else "the solve was stopped before there was one"
        note = record.summary.get("note", usual)
        raise InputError(f"{result} holds no motion to replay: {note}")
    file, given = _problem_file(record, Path(result), problem_file, settings), problem_file is not None
    problem = _built(record, file, Path(result), given=given)
    a, robot = record.arrays, problem.robot
    if list(a["joints"]) != list(robot.joint_names) or a["reference_q"].shape[1] != robot.model.nq:
        raise InputError(
            f"{result} was planned for other joints than those of the robot {robot.name!r} today; "
            "solve again, or give the file of its problem with --problem"
        )
    if not (given or settings or _may_be_of(record, problem)):
        warnings.warn(
            f"the problem of {result} is another one today than it was planned for, as after a change of its "
            "robot's files: robot, target and limits are today's",
            stacklevel=3,
        )
    missed = _trajectory(record, "missed") if "missed_time" in a else None
    return Planned(
        record=record,
        problem=problem,
        reference=_trajectory(record, "reference"),
        missed=missed,
        controller=file.controller,
        given=given,
    )


def _trajectory(record: Record, prefix: str) -> Trajectory:
    """The trajectory whose arrays in a record have this prefix."""
    named = {f.name: f"{prefix}_{f.name}" for f in dataclasses.fields(Trajectory)}
    given = {name: record.arrays[key] for name, key in named.items() if key in record.arrays}
    fields: dict[str, Any] = {name: value if value.ndim else float(value) for name, value in given.items()}
    return Trajectory(**fields)


def problem_of(
    record: Record, result: Path, problem_file: str | os.PathLike[str] | None = None
) -> ImpactProblem:
    """The problem of a record, rebuilt; arguments as of `load_planned`.

    Raises
    ------
    InputError : the record has no problem file, or the problem cannot be rebuilt.
    """
    file = _problem_file(record, result, problem_file, None)
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
        return ProblemFile.parse(record.problem, path, settings)
    except InputError as error:
        raise _cannot_rebuild(result, error) from error


def _built(record: Record, file: ProblemFile, result: Path, *, given: bool) -> ImpactProblem:
    """The problem as the record's plan has it; of another one, given by the user, as it stands.

    given : the file is one given by the user, not the record's own text.
    """
    try:
        problem = file.build()
        if problem.collision == "auto":
            problem = replace(problem, collision=record.summary.get("collision_model", "full"))
        if not given:
            return _as_planned(record, problem)
    except InputError as error:
        if given:
            raise
        raise _cannot_rebuild(result, error) from error
    # another problem may refuse what the plan has, such as its order of touches, or have no plan with it
    with contextlib.suppress(InputError):
        own = _as_planned(record, problem)
        if _may_be_of(record, own):
            return own
    return problem


def _as_planned(record: Record, problem: ImpactProblem) -> ImpactProblem:
    """The problem with the lazy constraints, order of touches, optimized gains and prices of a plan."""
    gains, names = record.summary.get("gains", ()), problem.robot.joint_names
    opened = zip(problem.gain_joints, problem.gains, strict=True)
    # another problem may open other gains, which are not those that the plan has chosen
    if [([names[k] for k in joints], [*gain.factor]) for joints, gain in opened] == [
        ([*each["joints"]], [*each["between"]]) for each in gains
    ]:
        problem = with_chosen(problem, [each["factor"] for each in gains])
    if (scale := record.summary.get("price_scale", 1.0)) != problem.price_scale:
        problem = replace(problem, price_scale=scale)
    if touches := record.summary.get("touches"):
        problem = replace(problem, touches=tuple(touches) if isinstance(touches, list) else touches)
    return with_lazy_constraints(problem, record.summary.get("rows_on_demand", ()))


def _cannot_rebuild(result: Path, error: InputError) -> InputError:
    return InputError(
        f"the problem in {result} cannot be rebuilt ({error}); if its files have moved, give the "
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
    """Track the plan's reference in an engine; with "mujoco" the robot may slip, lift its soles and fall.

    perturbation : deviations of the world from the plan's ("mujoco"; for "pinocchio" a missing target only).
    controller : "servo", or "wbc" ("mujoco" only).
    contact : "point", or "link" ("mujoco" only): collision of the striking link's hull with the target's
        body. The report then has impulse and first touch of both.
    options : of the engine, such as ``step`` [s].

    Raises
    ------
    InputError : an unknown engine or option, a missing package, a simulation that diverges, or steps that
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
        raise InputError(f"engine {engine!r} has striking points only; take engine 'mujoco'")
    link_contact: dict[str, Any] = {} if contact == "point" else {"contact": contact}
    simulation = simulate(problem, planned.reference, engine=engine, **options, **link_contact)
    check_steps(simulation, options.get("step"))
    if link_contact:
        point = simulate(problem, planned.reference, engine=engine, **options)
        link_contact |= {**_touch(simulation), "point": _touch(point)}
    report = plain(
        simulation.report(
            torque_limit=world.torque_limit * problem.robot.torque_limit,
            polygon=scene_of(problem).polygon,
            planned_impulse=float(planned.record.summary["impulse_Ns"]),
        )
        | {"controller": controller}
        | link_contact
    )
    arrays = {n: v for n, v in planned.record.arrays.items() if not n.startswith("replayed_")}
    arrays |= {name: np.asarray(value) for name, value in replay_arrays(simulation).items()}
    caution = gear_caution(problem, [simulation.loads])
    summary = {**planned.record.summary, "replayed": report, **caution}
    record = dataclasses.replace(planned.record, arrays=arrays, summary=summary)
    return Replay(planned=planned, perturbation=world, simulation=simulation, report=report, record=record)


def _touch(simulation: Simulation) -> dict[str, float]:
    """Impulse [N s], and time by which contact begins earlier than planned [ms]."""
    early = simulation.expected - simulation.contact_start
    return {"impulse_Ns": simulation.impulse, "first_touch_ms": 1e3 * early}
