"""Replay of a plan's contact in full dynamics with all events, and the model error of its collision model.

A program has one branch of each force in each phase, and one event at each phase's end. It cannot know
whether another event comes first: a board that breaks earlier, a nail that starts again, bodies that part in
between. So the contact of a solution is integrated again, by the engine of replays, from its own state at
contact and under its own reference.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from impactopt.arrays import Array
from impactopt.collision.interface import CollisionModel
from impactopt.collision.sdc import frozen_model
from impactopt.collision.settings import coasting_reference
from impactopt.errors import InputError
from impactopt.kinematics.coordinates import independent_rates
from impactopt.planning.budget import VIOLATED
from impactopt.problem.checks import MOST_TOUCHES, met_once
from impactopt.problem.problem import ImpactProblem
from impactopt.simulation.cases import errors_against
from impactopt.simulation.engines import scene_of
from impactopt.simulation.pinocchio_engine import Followed, follow_contact
from impactopt.solvers.program import SolverResult, Status
from impactopt.transcription.contact_guess import contact_order, fastest_at_contact, mass_at_contact
from impactopt.transcription.contact_program import ContactProgram
from impactopt.transcription.plan import Plan, PlannedStrike, Trajectory

# [%] Largest differences between planned and replayed impulse of a solved, and of an acceptable plan.
SOLVED_WITHIN, ACCEPTABLE_WITHIN = 1.0, 5.0
# With these the impulse is within 0.013 % of that with steps of 0.2 ms.
_MAX_STEP, _MIN_STEPS = 8e-4, 60  # of the replay: [s], and steps of the planned contact
# Length of the replay over that of the planned contact, so that bodies that meet again are seen; and its most
# where contact lasts.
_REPLAY_LENGTH, _MAX_REPLAY_LENGTH = 1.5, 4.0
_SAMPLE_STEP = 1e-3  # [s] of a strike's coasting reference
# Model errors compare with an SDC frozen at least so often, in place of full dynamics; and at most so often.
_MIN_FREEZES, _MAX_FREEZES = 8, 64
_MIN_HORIZON = 0.2  # [s] of the collisions that models are compared in
_MIN_GAP = 1e-3  # of the planned contact's duration: shorter gaps between touches do not count


@dataclass(frozen=True, kw_only=True)
class ModelError:
    """Error of a collision model against full dynamics, at a plan's state at contact.

    impulse_pct : [%], positive if the model's impulse is too large.  zmp_mm : largest distance between the
    ZMPs; None if one of them has no ZMP.
    """

    impulse_pct: float
    zmp_mm: float | None

    def __str__(self) -> str:
        zmp = "" if self.zmp_mm is None else f", ZMP off by {self.zmp_mm:.2g} mm"
        return f"impulse {self.impulse_pct:+.2g} %{zmp}"


@dataclass(frozen=True, kw_only=True)
class ContactReplay:
    """A planned contact in full dynamics, from the plan's state at contact.

    planned, impulse [N s] : to the target, as planned and as replayed.  peak [N] : largest force.
    outcome : of the target, by name and unit.  contact [s] : from the first touch to the end of the last one.
    events [s] : times since contact at which the target switches its mode, such as a board that breaks.
    partings, planned_partings : numbers of times that striker and target part and meet again.
    guards : names of the target's events, in their order.  may_plan : a plan may have so many touches.
    known [%] : part of `impulse_pct` that is reported as the model error.
    """

    planned: float
    impulse: float
    peak: float
    outcome: dict[str, float]
    contact: float
    events: tuple[float, ...]
    partings: int
    guards: tuple[str, ...]
    planned_partings: int = 0
    may_plan: bool = False
    known: float = 0.0

    @property
    def unforeseen(self) -> bool:
        """True if striker and target part more often, or less often, than planned."""
        return self.partings != self.planned_partings

    @property
    def impulse_pct(self) -> float:
        """Error of the planned impulse against full dynamics [%]; positive if it is too large."""
        return 100 * (self.planned / self.impulse - 1) if self.impulse > 0 else np.inf

    @property
    def off(self) -> float:
        """Difference of the impulses [%] beyond the reported model error."""
        # The model error is reported by itself, and must not refuse a plan a second time; nor must it refuse
        # one that is more accurate than its model.
        least, most = sorted((0.0, self.known))
        return max(least - self.impulse_pct, self.impulse_pct - most, 0.0)

    def __str__(self) -> str:
        """Message: how the replayed contact differs from the planned one."""
        off = f"its impulse is {self.impulse:.4g} N s, {self.planned:.4g} N s as planned"
        if self.unforeseen:
            times = "once" if self.partings == 1 else f"{self.partings} times"
            contacts = f"{self.planned_partings + 1} touches" if self.planned_partings else "one contact"
            return (
                f"striker and target part and meet again {times} within the impact, which is planned as "
                f"{contacts}: {off}, and the largest force is {self.peak:.0f} N, whatever is planned"
                + (f"; plan them by `[collision] touches = {self.partings + 1}`" if self.may_plan else "")
            )
        names = [self.guards[k % len(self.guards)] for k in range(len(self.events))] if self.guards else []
        events = [f"{name} at {1e3 * t:.3g} ms" for name, t in zip(names, self.events, strict=False)]
        when = f" (the target's events: {', '.join(events)})" if events else ""
        return (
            "the contact, followed in full dynamics from the plan's state at contact, lasts "
            f"{1e3 * self.contact:.3g} ms{when}: {off}"
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class PlannedContact:
    """The contact of a plan or a strike, and its replay, which runs on first access.

    model_error : of the collision model, estimated; None if the model freezes nothing.
    """

    problem: ImpactProblem
    planned: Plan | PlannedStrike
    model_error: ModelError | None = None

    @cached_property
    def reference(self) -> Trajectory:
        """Reference of the servo; a strike's coasts."""
        if isinstance(self.planned, Plan):
            return self.planned.coarse_reference
        return _coasting(self.problem, self.planned)

    @cached_property
    def replay(self) -> ContactReplay | None:
        """Replay of the contact; None for an impact without duration, and where legs do not reach."""
        problem, planned = self.problem, self.planned
        duration = planned.compression + planned.restitution
        if not problem.lasts or not duration > 0:
            return None
        try:
            # a strike plans no motion after contact that moves the striker away
            length = _REPLAY_LENGTH if isinstance(planned, Plan) else 1.0
            found = _followed(problem, self.reference, duration, length * duration)
        except InputError:  # legs out of reach
            return None
        known = 0.0 if self.model_error is None else self.model_error.impulse_pct
        return _contact_replay(problem, planned, found, known)


def _followed(problem: ImpactProblem, reference: Trajectory, duration: float, until: float) -> Followed:
    """The contact of about this duration [s] in full dynamics, at least `until` [s] after it began."""
    step, longest = min(_MAX_STEP, duration / _MIN_STEPS), _MAX_REPLAY_LENGTH * duration
    return follow_contact(
        problem.robot, reference, scene_of(problem), step=step, until=until, longest=longest
    )


def _contact_replay(
    problem: ImpactProblem, planned: Plan | PlannedStrike, found: Followed, known: float
) -> ContactReplay:
    duration = planned.compression + planned.restitution
    # touches: (start, end) of each, in their order.
    gaps = [after[0] - before[1] for before, after in pairwise(found.touches)]
    partings = sum(gap > _MIN_GAP * duration for gap in gaps)
    return ContactReplay(
        planned=planned.impulse,
        impulse=found.impulse,
        peak=found.peak,
        outcome=found.outcome,
        contact=found.touches[-1][1] - found.touches[0][0] if found.touches else 0.0,
        events=found.events,
        partings=partings,
        planned_partings=problem.planned_touches - 1,
        guards=problem.target.guards,
        may_plan=0 < partings < MOST_TOUCHES and not met_once(problem) and _meet(problem, partings + 1),
        known=known,
    )


def _meet(problem: ImpactProblem, touches: int) -> bool:
    """True unless a plan of so many touches is refused, as point masses never meet so often.

    A nail that stops in a gap and is driven again has no such order of events.
    """
    fastest = fastest_at_contact(problem)
    if not np.isfinite(fastest):
        return True
    order = contact_order(problem.law, problem.target, mass_at_contact(problem), fastest, touches)
    return order is not None


def checked(result: SolverResult, replay: ContactReplay | None) -> SolverResult:
    """The result itself if its replay agrees; else acceptable or failed, by the impulses' difference."""
    if replay is None or not result.status.usable or replay.off <= SOLVED_WITHIN:
        return result
    off, message = replay.off, f"The planned contact is off by {abs(replay.impulse_pct):.2g} %: {replay}."
    if off <= ACCEPTABLE_WITHIN:
        return replace(result, status=Status.ACCEPTABLE, message=message)
    # Counted as a violation, so that results of other guesses rank before it (`rank_of`), and
    # `Outcome.refused` tells it from violated constraints.
    worst = max(result.max_violation, min(off / 100, 1.0), 2 * VIOLATED)
    return replace(result, status=Status.FAILED, max_violation=worst, message=message)


def _coasting(problem: ImpactProblem, strike: PlannedStrike) -> Trajectory:
    """Reference of a strike: it continues at the rates at contact, as a plan's does during contact.

    Raises
    ------
    InputError : legs out of reach.
    """
    c, longest = problem.coordinates, _MAX_REPLAY_LENGTH * (strike.compression + strike.restitution)
    y, legs = c.split(strike.posture)
    rates, zero = independent_rates(c, y, strike.velocity), np.zeros(c.ny)
    times, samples = np.linspace(0.0, longest, max(2, round(longest / _SAMPLE_STEP) + 1)), []
    for t in times:
        # The last legs are the guess of the next: they move little in a millisecond.
        legs = c.solve_legs(y + rates * t, legs)
        samples.append(c.complete_motion(y + rates * t, rates, zero, legs))
    # the first sample stands twice: in the phase before contact (0), and in contact (1)
    q, v, a = (np.array(column) for column in zip(*[samples[0], *samples], strict=True))
    return Trajectory(
        time=np.concatenate([[0.0], times]),
        phase=np.array([0] + [1] * len(times)),
        q=q,
        v=v,
        a=a,
        torque=np.tile(strike.torque, (len(times) + 1, 1)),
        ground=np.tile(strike.ground, (len(times) + 1, 1)),
        contact_start=0.0,
        contact_end=longest,
        end=longest,
        stance=np.full(len(times) + 1 if problem.stances else 0, problem.blow),
    )


def model_error(t: ContactProgram, x: Array, planned: Plan | PlannedStrike) -> ModelError | None:
    """Error of a program's collision model against full dynamics, for solver variables (n,), as planned.

    None for full dynamics, for an impact with a given restitution, and if a contact does not end.
    """
    problem, c = t.problem, t.coordinates
    if problem.collision in ("full", "auto", "rigid"):
        return None
    duration = max(sum(t.expected.durations(x)), 1e-2)
    if not problem.lasts:  # the virtual mass: half a period on the contact's spring
        duration = np.pi * float(np.sqrt(mass_at_contact(problem) / problem.law.parameters["stiffness"]))
        if isinstance(planned, Plan):
            return _error_without_duration(problem, planned, duration)
    y, legs = t.contact_state[0].evaluate(x), t.contact_legs.evaluate(x)
    q, v, _ = c.complete_motion(y, t.u0.read(x)[0], np.zeros(c.ny), legs)
    # The variable is scaled by the limit.
    torque = t.feedforward.read(x)[0] * problem.robot.torque_limit
    return collision_error(problem, q, v, torque, duration)


def _error_without_duration(problem: ImpactProblem, plan: Plan, duration: float) -> ModelError | None:
    """Error of a plan's impulse without duration against a contact of about this duration [s].

    Its reference does not coast in contact, but begins the follow-through at once, which takes impulse away.
    """
    with contextlib.suppress(InputError):  # legs out of reach
        found = _followed(problem, plan.coarse_reference, duration, until=duration)
        if found.impulse > 0:
            return ModelError(impulse_pct=100 * (plan.impulse / found.impulse - 1), zmp_mm=None)
    return None


def collision_error(
    problem: ImpactProblem, q: Array, v: Array, torque: Array, duration: float
) -> ModelError | None:
    """Error of a problem's collision model against the often frozen SDC, for a collision of about this
    duration [s] that begins at q (nq,) and v (nv,) with the feed-forward ``torque`` (n,) [N m].

    None if a contact does not end, and for an SDC of a robot with soft grips. With these, full dynamics are
    in the place of the often frozen SDC.
    """
    # Time for the contact to end with either model.
    scene = {**problem.scene, "horizon": max(_MIN_HORIZON, 4 * duration)}
    own = frozen_model(problem.collision, problem.freezes, **scene)
    # Four times as often as the model itself, to be more accurate than it.
    freezes = min(max(_MIN_FREEZES, 4 * problem.freezes), _MAX_FREEZES)
    try:
        reference: dict[str, Any] = {**coasting_reference(problem.coordinates, q, v, until=2 * duration)}
        # the coarser models have no settings for all of the reference
        known = {name: x for name, x in reference.items() if name in own.settings}
        coarse = own.collide(q, v, torque, **known)
        full = _accurate(scene, freezes).collide(q, v, torque, **reference)
    except InputError:  # a contact that does not end, or a model without the springs of soft grips
        return None
    errors = errors_against(coarse, full)
    return ModelError(impulse_pct=float(errors["impulse_error_pct"] or 0.0), zmp_mm=errors["zmp_error_mm"])


def _accurate(scene: dict[str, Any], freezes: int) -> CollisionModel:
    """Accurate collision model of a scene: the SDC with so many freezes, or full dynamics of soft grips."""
    if not scene["robot"].sprung.any():
        return frozen_model("sdc", freezes, **scene)
    from impactopt.simulation.reference import FullDynamics  # loads MuJoCo

    return FullDynamics(**scene)
