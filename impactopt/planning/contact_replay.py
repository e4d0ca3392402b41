"""The check of a plan's contact: integrated once more from the state at contact, with its events.

A program has one branch of each force in each phase, and events where its phases end. What it cannot know is
whether they come there first: whether a board has broken before, a nail starts again, bodies have parted in
between. So what is solved is followed in full dynamics, by the engine of replays, from its own state at
contact and under its own reference.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.collision.sdc import frozen_model
from impactopt.errors import InputError
from impactopt.kinematics.coordinates import independent_rates
from impactopt.planning.budget import VIOLATED
from impactopt.problem.problem import ImpactProblem
from impactopt.simulation.cases import errors_against
from impactopt.simulation.engines import scene_of
from impactopt.simulation.pinocchio_engine import Followed, follow_contact
from impactopt.simulation.reference.coasting import coasting_reference
from impactopt.solvers.program import SolverResult, Status
from impactopt.transcription.contact_program import ContactProgram
from impactopt.transcription.plan import Plan, PlannedStrike, Trajectory

__all__ = [
    "AGREED",
    "ContactReplay",
    "ModelError",
    "PlannedContact",
    "checked",
    "collision_error",
    "model_error",
    "planned_contact",
]

Array = NDArray[np.float64]
AGREED, REFUTED = 1.0, 5.0  # [%] of the impulse: a plan that is off by more is not solved; is none
_STEP, _STEPS = 8e-4, 60  # [s] at most; of the planned contact, at least
_LONGER, _LONGEST = 1.5, 4.0  # than the planned contact, so that one that comes back, or goes on, is seen
_SAMPLED = 1e-3  # [s] of a coasting reference
# freezes of the SDC that stands for full dynamics
_OFTEN, _MOST_FREEZES = 8, 64
_HORIZON = 0.2  # [s] at least, of the collisions that a model is compared in
_REPORTED_GAP = 1e-3  # of the planned contact's duration: a gap that is reported


@dataclass(frozen=True, kw_only=True)
class ModelError:
    """Error of a collision model against full dynamics, at a plan's state at contact.

    impulse_pct : [%], positive where it promises too much.  zmp_mm : largest distance; None where one of them
    has no ZMP.
    """

    impulse_pct: float
    zmp_mm: float | None

    def __str__(self) -> str:
        zmp = "" if self.zmp_mm is None else f", ZMP off by {self.zmp_mm:.2g} mm"
        return f"impulse {self.impulse_pct:+.2g} %{zmp}"


@dataclass(frozen=True, kw_only=True)
class ContactReplay:
    """A planned contact in full dynamics, from the plan's state at contact.

    planned, impulse [N s] : to the target, as planned and as it is.  peak [N] : largest force.  outcome : of
    the target, by name and unit.  contact [s] : from the first touch to the end of the last.  events [s] :
    since contact, when the target has switched, such as a board that breaks.  partings : how often striker
    and target part and meet again.  planned_partings : how often they are planned to.
    guards : names of the target's events, in their order.  known [%] : what of `impulse_pct` is reported as
    the error of the model of the collision.
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
    known: float = 0.0

    @property
    def unforeseen(self) -> bool:
        """True if they part more often, or less often, than is planned."""
        return self.partings != self.planned_partings

    @property
    def impulse_pct(self) -> float:
        """Planned impulse over that in full dynamics, less one [%]: positive where a plan promises too
        much.
        """
        return 100 * (self.planned / self.impulse - 1) if self.impulse > 0 else np.inf

    @property
    def off(self) -> float:
        """[%] of the impulse that nothing else tells."""
        return abs(self.impulse_pct - self.known)

    def __str__(self) -> str:
        """Message: how the replayed contact differs from the planned one."""
        off = f"its impulse is {self.impulse:.4g} N s, {self.planned:.4g} N s as planned"
        if self.unforeseen:
            times = "once" if self.partings == 1 else f"{self.partings} times"
            contacts = f"{self.planned_partings + 1} touches" if self.planned_partings else "one contact"
            return (
                f"striker and target part and meet again {times} within the blow, which is planned as "
                f"{contacts}: {off}, and the largest force is {self.peak:.0f} N, whatever is planned"
            )
        names = [self.guards[k % len(self.guards)] for k in range(len(self.events))] if self.guards else []
        told = [f"{name} at {1e3 * t:.3g} ms" for name, t in zip(names, self.events, strict=False)]
        when = f" (the target's events: {', '.join(told)})" if told else ""
        return (
            "the contact, followed in full dynamics from the plan's state at contact, lasts "
            f"{1e3 * self.contact:.3g} ms{when}: {off}"
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class PlannedContact:
    """The contact of a plan or a strike, with what comes of it in full dynamics once that is asked for.

    model_error : estimated one of the model of the collision; None where nothing is frozen in it.
    """

    problem: ImpactProblem
    planned: Plan | PlannedStrike
    model_error: ModelError | None = None

    @cached_property
    def reference(self) -> Trajectory:
        """The servo's; of a strike, one that coasts."""
        if isinstance(self.planned, Plan):
            return self.planned.reference
        return _coasting(self.problem, self.planned)

    @cached_property
    def replay(self) -> ContactReplay | None:
        """None of an impact without duration, and where the motion cannot be followed."""
        problem, planned = self.problem, self.planned
        duration = planned.compression + planned.restitution
        if not problem.lasts or not duration > 0:
            return None
        try:
            found = follow_contact(
                problem.robot,
                self.reference,
                scene_of(problem),
                step=min(_STEP, duration / _STEPS),
                # a strike has no motion that takes the striker away
                until=duration * (_LONGER if isinstance(planned, Plan) else 1.0),
                longest=_LONGEST * duration,
            )
        except InputError:  # legs that do not reach
            return None
        known = 0.0 if self.model_error is None else self.model_error.impulse_pct
        return _told(problem, planned, found, known)


def _told(
    problem: ImpactProblem, planned: Plan | PlannedStrike, found: Followed, known: float
) -> ContactReplay:
    duration = planned.compression + planned.restitution
    gaps = [after[0] - before[1] for before, after in pairwise(found.touches)]
    return ContactReplay(
        planned=planned.impulse,
        impulse=found.impulse,
        peak=found.peak,
        outcome=found.outcome,
        contact=found.touches[-1][1] - found.touches[0][0] if found.touches else 0.0,
        events=found.events,
        partings=sum(gap > _REPORTED_GAP * duration for gap in gaps),
        planned_partings=problem.planned_touches - 1,
        guards=problem.target.guards,
        known=known,
    )


def checked(result: SolverResult, replay: ContactReplay | None) -> SolverResult:
    """A result whose contact is what it says, as it is; else not a solved one, or none at all."""
    if replay is None or not result.status.usable or replay.off <= AGREED:
        return result
    off, message = replay.off, f"The planned contact is off by {replay.off:.2g} %: {replay}."
    if off <= REFUTED:
        return replace(result, status=Status.ACCEPTABLE, message=message)
    # counted as a violation, so that other guesses rank before it (`rank_of`), and `Outcome.refused` knows it
    worst = max(result.max_violation, min(off / 100, 1.0), 2 * VIOLATED)
    return replace(result, status=Status.FAILED, max_violation=worst, message=message)


def _coasting(problem: ImpactProblem, strike: PlannedStrike) -> Trajectory:
    """The reference of a strike: it goes on at the rates at contact, as a plan's does while contact lasts.

    Raises
    ------
    InputError : legs that do not reach.
    """
    c, longest = problem.coordinates, _LONGEST * (strike.compression + strike.restitution)
    y, legs = c.split(strike.posture)
    rates, still = independent_rates(c, y, strike.velocity), np.zeros(c.ny)
    times, rows = np.linspace(0.0, longest, max(2, round(longest / _SAMPLED) + 1)), []
    for t in times:
        legs = c.solve_legs(y + rates * t, legs)
        rows.append(c.complete_motion(y + rates * t, rates, still, legs))
    q, v, a = (np.array(column) for column in zip(*[rows[0], *rows], strict=True))
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


def model_error(t: ContactProgram, x: Array, problem: ImpactProblem | None = None) -> ModelError | None:
    """Error of a program's collision model against full dynamics, for solver variables (n,).

    problem : whose model it is, if not the program's problem's.
    None where nothing is frozen; for an impact with a given restitution; and where a contact has no end.
    """
    problem, c = problem or t.problem, t.coordinates
    if problem.collision in ("full", "auto", "rigid"):
        return None
    y, legs = t.contact_state[0].evaluate(x), t.contact_legs.evaluate(x)
    q, v, _ = c.complete_motion(y, t.u0.read(x)[0], np.zeros(c.ny), legs)
    torque = t.feedforward.read(x)[0] * problem.robot.torque_limit
    return collision_error(problem, q, v, torque, max(sum(t.expected.durations(x)), 1e-2))


def planned_contact(
    t: ContactProgram, x: Array, planned: Plan | PlannedStrike, problem: ImpactProblem | None = None
) -> PlannedContact:
    """The contact that a program plans at solver variables (n,); ``problem``: as of `model_error`."""
    error = model_error(t, x, problem)
    return PlannedContact(problem=problem or t.problem, planned=planned, model_error=error)


def collision_error(
    problem: ImpactProblem, q: Array, v: Array, torque: Array, duration: float
) -> ModelError | None:
    """Model error for a collision of about this duration [s]."""
    names = ("robot", "striker", "normal", "law", "target", "stance")
    scene: dict[str, Any] = {name: getattr(problem, name) for name in names}
    scene["horizon"] = max(_HORIZON, 4 * duration)
    own = frozen_model(problem.collision, problem.freezes, **scene)
    often = min(max(_OFTEN, 4 * problem.freezes), _MOST_FREEZES)
    try:
        bend: dict[str, Any] = {**coasting_reference(problem.coordinates, q, v, until=2 * duration)}
        known = {name: x for name, x in bend.items() if name in own.settings}
        alone = own.collide(q, v, torque, **known)
        full = frozen_model("sdc", often, **scene).collide(q, v, torque, **bend)
    except InputError:  # a contact that does not end
        return None
    told = errors_against(alone, full)
    return ModelError(impulse_pct=float(told["impulse_error_pct"] or 0.0), zmp_mm=told["zmp_error_mm"])
