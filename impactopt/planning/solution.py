"""Solutions of planned problems, their summaries for ``summary.json``, and the programs that they are of.

A summary has measures of the motion: detours, jerk, work, ground load, first touch of the target.
"""

from __future__ import annotations

import platform
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from importlib.metadata import version
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.integrate import cumulative_trapezoid, trapezoid

from impactopt import __version__
from impactopt.arrays import Array
from impactopt.bodies.clearance import MISSED, Places
from impactopt.errors import InputError, counted
from impactopt.planning.bounds import Cause
from impactopt.planning.contact_replay import (
    ACCEPTABLE_WITHIN,
    SOLVED_WITHIN,
    ContactReplay,
    ModelError,
    PlannedContact,
)
from impactopt.planning.gain_selection import ChosenGains
from impactopt.planning.lazy_constraints import (
    gear_caution,
    lazy_terms_of,
    nail_caution,
    slide,
    slide_caution,
    touch_caution,
    window_caution,
)
from impactopt.planning.refinement import Attempt, Outcome
from impactopt.problem.feasibility import overlapping
from impactopt.problem.problem import ImpactProblem
from impactopt.robots.loads import DriveLoads, weight_of
from impactopt.simulation.collision_geometry import UnintendedContact
from impactopt.simulation.result import check_simulations
from impactopt.solvers.program import SolverResult, Status, Violation
from impactopt.transcription.contact_refinement import ContactError, finest
from impactopt.transcription.mesh import NO_MORE, Elements, MoreNodes, Shares, contact_elements
from impactopt.transcription.plan import Plan, PlannedCollision, PlannedStrike, Trajectory, motion_loads
from impactopt.transcription.transcription import Transcription, block_functions

REVERSAL = 0.02  # [rad] by which a joint has to move back to count as a reversal
TOUCH_WINDOW, TOUCH_STEP = 0.05, 2.5e-4  # [s] time before contact that is searched for a touch, and step


def motion_measures(problem: ImpactProblem, reference: Trajectory) -> dict[str, Any]:
    """Measures of a reference, by the keys of ``summary.json``.

    idle_travel_rad : total travel of idle joints over the whole motion [rad].
    reversals : median over the joints of their numbers of reversals by 0.02 rad or more before contact.
    peak_jerk_rad_s3 : largest jerk of a joint in swing and follow-through [rad/s^3].
    work_J : positive mechanical work of all joints before contact [J].
    end_posture_rad : largest distance of a joint at the end from the start posture [rad].
    ground_force_share : least and largest normal force of the ground, over the weight; None without soles.
    """
    robot, n = problem.robot, problem.robot.n
    rate, acceleration = reference.v[:, -n:], reference.a[:, -n:]
    angle = cumulative_trapezoid(rate, reference.time, axis=0, initial=0.0)
    # continuous joints have no angle of their own, but a difference of at most pi
    apart = pin.difference(robot.model, reference.q[0], reference.q[-1])[-n:]
    before = reference.phase == 0
    power = np.maximum(reference.torque * rate, 0.0).sum(axis=1)[before]
    idle = problem.idle_joints
    phases = [k for k in (before, reference.phase == 2) if k.sum() > 1]
    jerk = [_slope(reference.time[k], acceleration[k]) for k in phases]
    reversals = [_reversals(column) for column in angle[before].T]
    return {
        "idle_travel_rad": float(np.abs(np.diff(angle[:, idle], axis=0)).sum()),
        "reversals": float(np.median(reversals)),
        "peak_jerk_rad_s3": float(max((np.abs(j).max() for j in jerk if j.size), default=0.0)),
        "work_J": float(trapezoid(power, reference.time[before])),
        "end_posture_rad": float(np.abs(apart).max()),
        "ground_force_share": ground_force_share(problem, reference.ground[:, 2]),
    }


def first_touch(plan: Plan) -> dict[str, float | None]:
    """First touch of the striking links and the target, by exact distances of their hulls.

    first_touch_mm : penetration of a link into the target at the planned contact [mm]; < 0: a gap.
    first_touch_ms : time from the first touch to the planned contact [ms].
    Both are None if link or target has no body.
    """
    p = plan.problem
    targets = [w for w, body in enumerate(p.world) if body.strikable]
    bodies = p.bodies if targets and p.keeps_apart else None
    pairs = [] if bodies is None else [(j, -1 - w) for j in bodies.striking for w in targets]
    pairs = [pair for pair in pairs if bodies is not None and pair[0] in bodies.links.of_joint]
    if bodies is None or not pairs:
        return {"first_touch_mm": None, "first_touch_ms": None}
    end = plan.contact_start
    time = end - np.arange(0.0, min(TOUCH_WINDOW, end), TOUCH_STEP)  # backward from contact
    q = plan.closed(plan.independent(0, time)[0][::-1])[::-1]  # legs follow continuously forward in time
    at = Places.of(p.robot, q, np.zeros(len(time), dtype=np.intp), plan.displacement(time))
    distance = np.array([min(bodies.exact(at, k, pair) for pair in pairs) for k in range(len(time))])
    clear = np.flatnonzero(distance > 0)
    # the last instant that still touches, going back from contact; 0 if bodies are clear there
    early = time[0] - time[clear[0] - 1] if clear.size and clear[0] else 0.0
    if not clear.size:
        early = time[0] - time[-1]
    return {"first_touch_mm": float(-1e3 * distance[0]), "first_touch_ms": float(1e3 * early)}


def ground_force_share(problem: ImpactProblem, normal: Array) -> list[float] | None:
    """Smallest and largest of normal forces (k,) [N], over the weight; None without soles."""
    if not problem.soles or not len(normal):
        return None
    weight = weight_of(problem.robot)
    return [float(normal.min() / weight), float(normal.max() / weight)]


def _slope(time: Array, values: Array) -> Array:
    """Difference quotients (< k, n) of values (k, n) at times (k,), without steps between equal times."""
    # an instant stands twice where the reference jumps, which is no jerk
    step = np.diff(time)
    keep = step > 1e-9
    return np.diff(values, axis=0)[keep] / step[keep, None]


def _reversals(angle: Array) -> int:
    """Number of reversals of an angle (k,) [rad] by `REVERSAL` or more.

    SciPy's `find_peaks` by prominence finds as many, and takes half a second to import.
    """
    count, direction, low, high = 0, 0, angle[0], angle[0]  # direction 0: none yet
    for value in angle.tolist():
        # extremes since the last reversal
        low, high = min(low, value), max(high, value)
        up, down = value - low >= REVERSAL and direction <= 0, high - value >= REVERSAL and direction >= 0
        if up or down:
            count += direction != 0
            direction, low, high = 1 if up else -1, value, value
    return count


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Solved:
    """Result of a solver on a problem's nonlinear program, solved or stopped.

    result : of the solver from the best start, with its history.
    build_seconds : time to compile or load functions and to assemble the program.  solve_seconds : time of
        the solver, for all starts.
    violations : violated constraints, worst first.
    objectives : value of each of the problem's objectives, by name, in its own unit.
    attempts : result of each start.
    clearance_constraints : of the program.
    elements : lengths of the collocation elements of each phase of the contact, as fractions of the phase, if
        they are finer than the problem's; else ().
    shares : each phase's fraction of the contact's duration, if the model freezes during contact; else ().
    gains : chosen values of the gains that the problem left open; `problem` has the robot with these.
    contact : the planned contact and its replay in full dynamics; None without a usable plan.
    """

    problem: ImpactProblem
    result: SolverResult
    solver: str
    build_seconds: float
    solve_seconds: float
    violations: tuple[Violation, ...]
    objectives: Mapping[str, float] = field(default_factory=dict)
    attempts: tuple[Attempt, ...] = ()
    contact: PlannedContact | None = None
    clearance_constraints: Mapping[Any, Any] = field(default_factory=dict)
    elements: Elements = ()
    shares: Shares = ()
    gains: tuple[ChosenGains, ...] = ()

    def __repr__(self) -> str:
        """One line without arrays, which would fill pages."""
        impulse = getattr(self, "impulse", np.nan)
        return (
            f"<{type(self).__name__} of {self.problem.name or self.problem.robot.name!r}: "
            f"{self.status.value}, {impulse:.2f} N s, {counted(self.result.iterations, 'iteration')}>"
        )

    def __reduce__(self) -> tuple[Any, ...]:
        """The version comes first in a pickle, as another one may not know what follows."""
        return _of_version, (type(self), __version__), self.__dict__

    @property
    def model_error(self) -> ModelError | None:
        """Estimated error of the collision model; None if it freezes nothing."""
        return None if self.contact is None else self.contact.model_error

    @property
    def contact_replay(self) -> ContactReplay | None:
        """Replay of the planned contact in full dynamics, from the plan's state at contact; None for an
        impact without duration, and without a usable plan.
        """
        return None if self.contact is None else self.contact.replay

    @property
    def caution(self) -> str:
        """Warning about effects that the planned contact leaves out, or a large error of its collision model;
        empty if the replay agrees with it.
        """
        replay, error = self.contact_replay, self.model_error
        if replay is not None and (replay.unforeseen or replay.off > SOLVED_WITHIN):
            return str(replay)
        if error is not None and abs(error.impulse_pct) > ACCEPTABLE_WITHIN:
            return (
                f"The impulse by the collision model {self.problem.collision!r} is off by "
                f'{error.impulse_pct:+.2g} % against full dynamics: plan with collision.model = "full".'
            )
        return ""

    @property
    def status(self) -> Status:
        return self.result.status

    def outcome(self) -> dict[str, Any]:
        """Outcome of the solve, as in ``summary.json``; also for a plan whose motion cannot be completed."""
        return {
            "status": self.status.value,
            "message": self.result.message,
            "solver": self.solver,
            "iterations": self.result.iterations,
            "solve_seconds": self.solve_seconds,
            "build_seconds": self.build_seconds,
            "max_violation": self.result.max_violation,
            "violations": [{"row": v.what, "by": v.by, "amount": v.amount} for v in self.violations],
            "starts": [attempt.summary() for attempt in self.attempts],
            "collision_model": self.problem.collision,
            "freezes": self.problem.freezes,
            **({"touches": list(self.problem.order)} if self.problem.order else {}),
            "rows_on_demand": list(lazy_terms_of(self.problem)),
            "style": self.problem.style,
            "price_scale": self.problem.price_scale,
            "model_error_pct": None if self.model_error is None else self.model_error.impulse_pct,
            "model_error_zmp_mm": None if self.model_error is None else self.model_error.zmp_mm,
            "problem": self.problem.describe(),
            **({"gains": [chosen.summary() for chosen in self.gains]} if self.gains else {}),
            "contact_replay_pct": None if self.contact_replay is None else self.contact_replay.impulse_pct,
            **({"caution": self.caution} if self.caution else {}),
        }


def _of_version(kind: type[Solved], made_by: str) -> Solved:
    """Solution without attributes, into which a pickle is read; InputError if another version wrote that."""
    if made_by != __version__:
        raise InputError(
            f"this {kind.__name__} was pickled by impactopt {made_by}, and only that reads it; this is "
            f"{__version__}. There, `save` it: other versions read that by load_solution"
        )
    return object.__new__(kind)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Solution(Solved):
    """Solution of an impact problem, solved or stopped.

    plan : the motion; of the best iterate if the status is not usable.
    nodes : nodes that mesh refinement has added to the ends and middles of the splines' intervals.
    contact_error : estimated discretization error of the impulse; None for an impact without duration, and
        without a usable plan.
    statement : names of the program's variables and constraints, as `impactopt.transcription.transcription`
        writes them.
    causes : of an infeasible problem, bounds each of which alone, with another value, makes it solvable. Each
        has the ``problem`` with that value. Empty if none is known.
    window : warning about a bound on the contact's duration that limits the objective; else "".
    Its other attributes are those of :class:`Solved`.
    """

    plan: Plan
    nodes: MoreNodes = NO_MORE
    contact_error: ContactError | None = None
    statement: str = ""
    causes: tuple[Cause, ...] = ()
    window: str = ""

    @property
    def impulse(self) -> float:
        """Planned impulse to the target [N s]."""
        return self.plan.impulse

    @property
    def contact_elements(self) -> list[int]:
        """Number of collocation elements in each phase of the contact; none if it has no duration."""
        if not self.problem.lasts:
            return []
        return [len(phase) for phase in self.elements or contact_elements(self.problem)]

    @property
    def contact_error_pct(self) -> float | None:
        """Estimated error of the impulse [%]; None without an estimate, as when an event is missed."""
        error = self.contact_error
        return error.pct if error is not None and np.isfinite(error.pct) else None

    @property
    def motion_price_pct(self) -> float:
        """Prices on motion, sole wrenches and end posture, over the objective [%].

        These, ``ImpactProblem.smoothness``, ``wrench_price`` and ``return_price``, select one optimum among
        motions with equal objectives.  nan if the objectives are zero, or not known.
        """
        if any(o.name not in self.objectives for o in self.problem.objectives):
            return np.nan
        total = sum(
            (-o.weight if o.cost else o.weight) * self.objectives[o.name] for o in self.problem.objectives
        )
        # The program minimizes prices minus objectives, so this sum is the prices.
        return 100 * (self.result.objective + total) / abs(total) if total else np.nan

    @property
    def trajectory(self) -> Trajectory:
        """Sampled reference of the servo.

        With ``k = np.flatnonzero(trajectory.phase == 0)[-1]``, ``q[k]``, ``v[k]`` and ``torque[k]`` are the
        state at contact: arguments of `CollisionModel.collide`, as in ``impactopt collide RESULT``.
        """
        return self.plan.reference

    @property
    def missed_trajectory(self) -> Trajectory:
        """Sampled reference of the servo for a missed target; InputError if the plan has no abort motion."""
        return self.plan.missed_reference

    @property
    def _missed(self) -> Trajectory | None:
        return self.missed_trajectory if self.plan.abort is not None else None

    def validate(self, *, engine: str = "pinocchio", **options: Any) -> Any:
        """Re-simulate the plan in full dynamics; a :class:`impactopt.simulation.Simulation`.

        engine : "pinocchio" fixes the soles to the ground; with "mujoco" they are free and the robot can fall
            (extra ``validate``).  options : of the engine, such as ``step`` [s], or of "pinocchio"
            ``missing=True``: there is no target.

        Raises
        ------
        InputError : an unknown engine or option.
        """
        from impactopt.simulation import simulate

        options.setdefault("missed", self._missed)
        return simulate(self.problem, self.trajectory, engine=engine, **options)

    def clearance(self) -> dict[str, Any]:
        """Clearances and unintended contacts in the plan, by exact geometry at 1 ms: the keys
        ``clearance_mm``, ``nearest`` and ``contacts_besides`` of ``summary.json``. They include the motion
        after a missed target, whose contacts are marked. ``clearance_mm`` is None if all bodies stay
        farther apart than 0.1 m.
        """
        least, nearest, touches = self._clearance
        return {
            "clearance_mm": 1e3 * least if nearest else None,
            "nearest": nearest,
            "contacts_besides": [{**t} for t in touches],
        }

    @cached_property
    def _clearance(self) -> tuple[float, str, list[dict[str, Any]]]:
        problem, bodies = self.problem, self.problem.bodies
        least, nearest, touches = np.inf, "", list[dict[str, Any]]()
        for missed in (False, True) if self.plan.abort is not None else (False,):
            motion = self.plan.motion(self.missed_trajectory if missed else self.trajectory, missed=missed)
            phase = np.where(missed, MISSED, motion.phase)
            at = Places.of(problem.robot, motion.q, phase, motion.displacement)
            found = bodies.survey(motion.time, at)
            if found.clearance < least:
                least, nearest = found.clearance, " and ".join(found.nearest)
            contacts = (UnintendedContact(**touch._asdict()).summary() for touch in found.touches)
            touches += [contact | ({"missed": True} if missed else {}) for contact in contacts]
        return least, nearest, touches

    @cached_property
    def slide(self) -> float:
        """Distance [m] that the striking point slides across the target during contact, as planned."""
        return slide(self.problem, self.plan)

    @property
    def collision(self) -> PlannedCollision:
        """The expected collision, on the finer mesh of the error estimate if there is one."""
        return finest(self.plan, self.contact_error)[0]

    def margins(self) -> dict[str, dict[str, float]]:
        """ZMP margin [m] and ratio of torque demand to limit, by phase, as of `Plan.margins`."""
        return self.plan.margins(self.collision)

    def sole_margins(self) -> dict[str, Any]:
        """Margins of each sole by itself, as of `Plan.sole_margins`."""
        return self.plan.sole_margins(self.collision)

    def _stances(self) -> dict[str, Any]:
        """Stance phases and landing speeds of soles, as in ``summary.json``."""
        if not self.problem.stances:
            return {}
        return {"stances": self.plan.stances(), "landing_speed_m_s": self.plan.landing_speeds()}

    @cached_property
    def loads(self) -> DriveLoads:
        """Peak loads of gears and motors in the plan, with the expected target."""
        return motion_loads(self.problem.robot, self.trajectory, self.collision)

    def summary(self, simulation: Any | None = None, replay: Any | None = None) -> dict[str, Any]:
        """Entries of ``summary.json``, with ``simulated``, and ``replayed`` on free soles, if these are
        given.

        Raises
        ------
        InputError : one of these is no `Simulation`, or of another plan; `simulation` had a target, and
            never touched it.
        """
        plan = self.plan
        check_simulations(self.trajectory, simulation=simulation, replay=replay)
        expected, *others = finest(self.plan, self.contact_error)
        out: dict[str, Any] = {
            **self.outcome(),
            **impact_summary(plan, expected, self.contact_replay),
            "objectives": dict(self.objectives),
            "motion_price_pct": self.motion_price_pct,
            "duration_s": plan.duration,
            **self._stances(),
            "nodes_added": self.nodes.total,
            "collision_elements": self.contact_elements,
            "collision_error_pct": self.contact_error_pct,
            **self.margins(),
            **self.sole_margins(),
            **self.loads.summary(),
            **self.clearance(),
            "slide_mm": 1e3 * self.slide,
            **motion_measures(self.problem, self.trajectory),
            **first_touch(plan),
            "versions": versions(),
        }
        known: dict[str, Any] = {
            "torque_limit": self.problem.robot.torque_limit,
            "polygon": plan.polygon,
            "planned_impulse": plan.impulse,
        }
        if plan.scenarios:
            limits = {name: known[name] for name in ("torque_limit", "polygon")}
            out["scenarios"] = [
                replace(scenario, collision=hit).summary(**limits)
                for scenario, hit in zip(plan.scenarios, others, strict=True)
            ]
        if simulation is not None:
            out["simulated"] = simulation.summary(**known)
        if replay is not None:
            out["replayed"] = replay.report(**known)
        runs = [run for run in (replay, simulation) if run is not None]
        slides = slide_caution(self.problem, self.slide)
        again = touch_caution(self.problem, plan, runs[-1].impulse if runs else None)
        undriven = nail_caution(self.problem, plan)
        cautions = (out.get("caution"), undriven, again, slides, self.window, overlapping(self.problem))
        if caution := " ".join(filter(None, cautions)):
            out["caution"] = caution
        return out | gear_caution(self.problem, [self.loads, *(run.loads for run in runs)])


def impact_summary(
    hit: Plan | PlannedStrike, collision: PlannedCollision, replay: ContactReplay | None
) -> dict[str, Any]:
    """Entries of ``summary.json`` for a planned impact; one without duration has no force."""
    duration, peak = hit.compression + hit.restitution, collision.peak_force
    # the force between the program's points, where no finer mesh has it
    if collision is hit.collision and replay is not None and not replay.unforeseen:
        peak = replay.peak
    return {
        "impulse_Ns": hit.impulse,
        "target": collision.outcome,
        "peak_force_N": peak if duration > 0 else None,
        "contact_ms": 1e3 * hit.collision.last_touch if duration > 0 else 0.0,
        "hand_speed_m_s": hit.hand_speed,
    }


_version = cache(version)  # reads a file each time


def versions() -> dict[str, str]:
    """Versions of the packages that computed the results."""
    names = ("casadi", "pin", "numpy", "scipy", "osqp")
    found = {name: _version(name) for name in names}
    return {"impactopt": __version__, "python": platform.python_version(), **found}


def program_on(
    problem: ImpactProblem,
    nodes: MoreNodes,
    elements: Elements,
    shares: Shares,
    report: Callable[[str], None] | None = None,
) -> Transcription:
    """Program of a problem on a given mesh, without clearance constraints."""
    functions = block_functions(problem, report, elements)
    return Transcription(problem, functions, nodes, elements, shares)


def program_of(solution: Solution) -> Transcription:
    """Program of a solution, without clearance constraints."""
    return program_on(solution.problem, solution.nodes, solution.elements, solution.shares)


def solution_of(
    outcome: Outcome[Transcription],
    *,
    solver: str,
    seconds: tuple[float, float],
    statement: str,
    gains: tuple[ChosenGains, ...] = (),
    causes: tuple[Cause, ...] = (),
    contact_error: ContactError | None = None,
) -> Solution:
    """The `Solution` of a refinement's outcome.

    seconds [s] : to build the program, and to solve it.
    """
    t, at = outcome.program, outcome.at
    return Solution(
        problem=t.problem,
        result=outcome.result,
        solver=solver,
        build_seconds=seconds[0],
        solve_seconds=seconds[1],
        violations=outcome.violations,
        objectives=t.achieved(at.x),
        attempts=outcome.attempts,
        statement=statement,
        gains=gains,
        causes=causes,
        window=window_caution(t, outcome.result) if outcome.usable else "",
        contact_error=contact_error,
        plan=at.planned,
        nodes=t.nodes,
        # (): the default elements, which a program of this problem has again.
        elements=t.hit.elements if t.hit.guarded else (),
        shares=t.hit.shares,
        clearance_constraints=t.clearance_constraints,
        contact=at.contact if outcome.usable else None,
    )
