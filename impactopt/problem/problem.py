"""Declarative impact problem: robot, striker, target and contact law, terms, objectives and scenarios."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, TypeVar

import numpy as np
import pinocchio as pin

from impactopt.arrays import Array, Mask
from impactopt.bodies.clearance import Bodies
from impactopt.bodies.robot_bodies import bodies_of
from impactopt.bodies.world import (
    Ground,
    Obstacle,
    TargetBody,
    WorldBody,
    body_message,
    ground_body,
    obstacle_bodies,
    target_bodies,
)
from impactopt.collision.settings import Effects
from impactopt.contact.fields import in_order
from impactopt.contact.friction import ContactFriction
from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import Target
from impactopt.contact.targets.base import TOUCH, ContactPhase, contact_phases, order_of_touches
from impactopt.errors import FARTHEST, InputError, Mistakes, check_array, check_kind, check_name
from impactopt.kinematics.coordinates import MAX_START_PITCH, StanceCoordinates
from impactopt.kinematics.inverse_kinematics import inverse_kinematics
from impactopt.kinematics.stance import USUAL_POSTURE, BothSoles, Free, Stance, support_polygon
from impactopt.problem import checks
from impactopt.problem.checks import COLLISIONS, INSTANT
from impactopt.problem.hashing import problem_hash
from impactopt.problem.objectives import DEFAULT_OBJECTIVES, STYLES, MotionPrices, Objective, check_objectives
from impactopt.problem.phases import (
    Phase,
    StancePhase,
    check_stances,
    impact_phase,
    names_of,
    phase_coordinates,
)
from impactopt.problem.scenario import Scenario, SecondStriker
from impactopt.problem.terms import (
    DEFAULT_TERMS,
    ON_DEMAND_TERMS,
    TERMS,
    GearLoad,
    HandOrientation,
    HitCone,
    Incidence,
    KeepOut,
    SelfCollision,
    Term,
)
from impactopt.problem.terms.base import check_known, kind_of
from impactopt.robots.attachments import Sole
from impactopt.robots.build import joints_to
from impactopt.robots.gains import GainFactor
from impactopt.robots.robot import Robot

__all__ = ["COLLISIONS", "ImpactProblem", "Phase"]

AnyTerm = TypeVar("AnyTerm", bound=Term)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class ImpactProblem:
    """Problem of an impact: maximize the objectives, by default the impulse to the target, within the terms.

    Attributes
    ----------
    robot, striker : robot, and name of its striker that hits the target.
    point (3,) [m] : where the striking point meets the target, in the world frame. That is the frame of a
        fixed base; otherwise z = 0 is the ground on which the soles stand, and the origin is in the middle of
        the soles in the start posture.
    normal (3,) : unit vector in the world frame, along which the target is pushed.
    friction : between the striking points and the target; None: no friction.
    second : another striker that hits the same target at the same time, at its own point.
    law, target : contact law and target. In a plan a `Nail` moves once, and stops before the striker leaves
        it.
    stance : fixed soles and supporting hands, which stay where they are in the start posture.
    stances : stance phases of the motion, each with the soles that stand in it; (): one stance throughout.
        With phases, `stance` is that of the phase with the impact.
    start : posture at the start of the motion, at rest: a name of ``robot.postures`` or a pin configuration
        (nq,).
    near_contact : likewise a posture from which the first initial guess at contact is found, by inverse
        kinematics; None: it is chosen. Plans do not depend on it but by their local optimum; checks and
        `minimum_jerk_baseline` take it, too.
    swing, follow : phases from rest to contact, and from contact to rest (follow-through).
    contact_duration : (shortest, longest) [s], of each of compression (of a nail: until it stops) and
        restitution. A phase that ends by an event, such as a board's break, may be shorter. If the shortest
        is 0, it follows from law and masses.
    collision_elements : lengths of the collocation elements of compression, and of restitution, as fractions
        that sum to 1. With a `Nail` or a `Board` those of compression are used before and after the event,
        and every element is halved.
    collision_stages : Radau IIA stages of an element, 2 or 3 (order 3 or 5).
    touches : number of contacts with a `Board` or a `Nail` in the impact; or what ends each phase of the
        contact, as ("separation", "break") for a board that swings on and breaks after one touch. None: as
        for point masses in place of robot and target, of a nail one.
    collision : model of the collision. "full": the equations of motion, at every instant. "sdc": H, J and
        bias are frozen at contact, and ``freezes`` times during it, as in :class:`impactopt.SDC`.
        "sdc-paper": the same with the effects of `SDC.paper`. "auto": "sdc", or "full" if full dynamics at
        the plan's state at contact would change the impulse by more than ``auto_impulse_pct`` or the ZMP by
        more than ``auto_zmp_mm``. Two models without duration, and so without torque, ZMP and servo, are for
        comparison: "virtual-mass", with the restitution of two masses under the contact law, and "rigid",
        with ``coefficient_of_restitution`` (speed of separation over speed of approach).
    scenarios : other targets, or a missing one, that the robot has to survive with the same swing.
    body : shape of the target, which no part of the robot but the striking link may touch.
    obstacles : bodies in the world that the robot must not touch.
    ground : floor below a robot that does not stand on soles; None: no floor. Soles stand on the ground
        z = 0.
    terms : constraints. Terms of DEFAULT_TERMS that are not given have their defaults, and so have the lazy
        ones of ON_DEMAND_TERMS, whose constraints enter once a plan violates them.
    objectives : their weighted sum is maximized.
    style : "natural", with prices on jerk, on the motion of joints, above all of idle ones, and on the
        distance of the end posture from the start (`impactopt.problem.objectives`); or "strongest", without
        prices.
    motion_price : largest share of all prices on motion in the objective; those of the style are reduced to
        it.  price_scale : factor on these; 1: the planner chooses it.
    smoothness : price of accelerations [N s per (rad/s^2)^2 s].  wrench_price : price of sole wrenches.
        return_price : price of the end posture's distance from the start [N s per rad^2]. These three are
        small; they make the optimum unique.
    gains : factors of the gains of servos, and of the springs of soft grips, which the planner chooses.

    Raises
    ------
    InputError : one message with all mistakes: a NaN, a wrong shape, an unknown striker or posture, a normal
        that is not a unit vector, a start posture outside its limits or off the ground, a point out of reach.
    """

    robot: Robot
    striker: str
    point: Array
    normal: Array
    law: ContactLaw
    target: Target
    friction: ContactFriction | None = None
    second: SecondStriker | None = None
    stance: Stance = field(default_factory=BothSoles)
    stances: tuple[StancePhase, ...] = ()
    start: str | Array = USUAL_POSTURE
    near_contact: str | Array | None = None
    swing: Phase = field(default_factory=lambda: Phase(duration=(0.8, 0.8)))
    follow: Phase = field(default_factory=lambda: Phase(duration=(1.0, 1.0)))
    contact_duration: tuple[float, float] = (0.0, 0.2)
    collision_elements: tuple[tuple[float, ...], tuple[float, ...]] = ((0.2, 0.8), (1.0,))
    collision_stages: int = 3
    touches: int | tuple[str, ...] | None = None
    collision: str = "full"
    freezes: int = 0
    auto_impulse_pct: float = 0.5
    auto_zmp_mm: float = 2.0
    coefficient_of_restitution: float = 0.0
    scenarios: tuple[Scenario, ...] = ()
    body: TargetBody = field(default_factory=TargetBody)
    obstacles: tuple[Obstacle, ...] = ()
    ground: Ground | None = None
    terms: tuple[Term, ...] = ()
    objectives: tuple[Objective, ...] = DEFAULT_OBJECTIVES
    style: str = "natural"
    motion_price: float = 0.1
    price_scale: float = 1.0
    smoothness: float = 1e-5
    wrench_price: float = 1e-3
    return_price: float = 0.1
    gains: tuple[GainFactor, ...] = ()
    name: str = "impact"

    def __repr__(self) -> str:
        """One line; `describe` has more."""
        return f"<ImpactProblem {self.name!r}: {self.striker} of {self.robot.name} on {self.target!r}>"

    def __getstate__(self) -> dict[str, Any]:
        """State without the cached coordinates, whose symbols CasADi does not pickle."""
        return {name: value for name, value in vars(self).items() if name != "stance_coordinates"}

    def __post_init__(self) -> None:
        # `attempt` collects the error of a check and returns False. A check that needs parts which have
        # failed is skipped, so that the message has independent mistakes only.
        kinds = {"robot": Robot, "stance": Stance, "swing": Phase, "follow": Phase}
        for name, kind in kinds.items():
            check_kind(name, getattr(self, name), kind)
        mistakes = Mistakes()
        mistakes.attempt(lambda: check_name("the problem", self.name, empty=True))
        striker = mistakes.attempt(lambda: self.robot.striker(self.striker))
        aim = mistakes.attempt(self._check_aim)
        stance = mistakes.attempt(partial(check_stances, self)) and mistakes.attempt(
            partial(checks.check_stance, self)
        )
        stance = stance and mistakes.attempt(self._check_start)
        for check in (checks.check_elements, checks.check_prices):
            mistakes.attempt(partial(check, self))
        collision = mistakes.attempt(partial(checks.check_collision, self))
        mistakes.attempt(partial(checks.check_touches, self))
        if mistakes.attempt(self._check_scenarios):
            for scenario in self.scenarios:
                mistakes.attempt(partial(scenario.numbers, self.law, self.target))
        mistakes.attempt(partial(checks.check_world, self))
        mistakes.attempt(partial(checks.check_gains, self))
        terms = mistakes.attempt(self._check_terms)
        if terms:
            for term in self.terms:
                mistakes.attempt(partial(checks.check_names, self.robot, term))
            mistakes.attempt(partial(checks.check_motors, self))
        if mistakes.attempt(self._check_objectives) and collision:
            mistakes.attempt(partial(checks.check_energy, self))
        sound = striker and stance and terms and mistakes.attempt(partial(checks.check_second, self))
        if sound:
            mistakes.attempt(partial(checks.check_hands, self))
            mistakes.attempt(partial(checks.check_hinges, self))
        sound = sound and mistakes.attempt(partial(checks.check_strikers, self))
        if sound:
            mistakes.attempt(partial(checks.check_jerk, self))
        if sound and aim and mistakes.attempt(lambda: self.contact_posture):
            mistakes.attempt(partial(checks.check_moves, self))
        mistakes.raise_if_any("the problem")

    def _check_aim(self) -> None:
        object.__setattr__(self, "point", check_array("point [m]", self.point, (3,), most=FARTHEST))
        normal = check_array("normal", self.normal, (3,))
        if abs(np.linalg.norm(normal) - 1) > 1e-6:
            length = float(np.linalg.norm(normal))
            unit = f": did you mean {np.round(normal / length, 6).tolist()}?" if length > 0 else ""
            raise InputError(f"normal must be a unit vector, its length is {length:.6g}{unit}")
        object.__setattr__(self, "normal", normal / np.linalg.norm(normal))

    def _check_scenarios(self) -> None:
        checks.check_parts(self, "scenarios", Scenario)
        if self.scenarios and not self.lasts:
            raise InputError(f'scenarios need a contact that lasts, as "full", not {self.collision!r}')
        checks.check_apart("scenario", [s.name for s in self.scenarios])
        aborts = sorted({s.abort_after for s in self.scenarios if s.abort_after is not None})
        if len(aborts) > 1:
            raise InputError(
                f"scenarios give abort_after of {' and '.join(f'{each:g}' for each in aborts)} s, and a plan "
                "has one abort motion: give one of them"
            )
        if self.floats and self.abort_after is not None:
            raise InputError(
                f"robot {self.robot.name!r} floats freely, and has no abort motion: leave abort_after out of "
                "its scenarios"
            )

    def _check_terms(self) -> None:
        listed = isinstance(self.terms, (list, tuple))
        if not listed or not all(isinstance(t, Term) for t in self.terms):
            raise InputError(f"terms must be a tuple of terms, such as (TorqueLimit(),), not {self.terms!r}")
        check_known(self.terms, Term, "add_constraints")
        object.__setattr__(self, "terms", tuple(self.terms))
        kinds = [kind_of(t, Term) for t in self.terms]
        for kind in kinds:
            if kinds.count(kind) > 1:
                raise InputError(f"two terms of kind {kind.__name__}: give one")
        if HitCone in kinds and Incidence in kinds:
            raise InputError("HitCone takes the place of Incidence: give one of them")

    def _check_objectives(self) -> None:
        turns = not isinstance(self.target, Target) or self.target.turns
        allowed = {"contact": self.lasts, "turns": turns, "balance": self.stands}
        checked = check_objectives(self.objectives, **allowed)
        object.__setattr__(self, "objectives", checked)

    def _check_start(self) -> None:
        posture = self.start_posture
        if not isinstance(self.start, str):  # a copy, which does not follow the caller's array
            object.__setattr__(self, "start", posture.copy())
        if (near := self.posture_near_contact) is not None:
            self.robot.check_limits(near, name="near_contact")
            if not isinstance(self.near_contact, str):
                object.__setattr__(self, "near_contact", near)
        self.robot.check_limits(posture, name="the start posture")
        self.robot.check_stance(posture, [sole.name for sole in self.soles])
        first = self.stance_coordinates[0]
        checks.check_at_rest(self.robot, first, [sole.name for sole in first.soles], posture)
        if first.drifts and abs(first.start[4]) > MAX_START_PITCH:
            raise InputError(
                f"the start posture's base is pitched by {first.start[4]:.2f} rad; a robot that floats "
                f"freely may start with at most {MAX_START_PITCH:g}: turn start, point, normal and gravity"
            )

    @property
    def style_prices(self) -> MotionPrices:
        """Prices of the problem's style, scaled by `price_scale`."""
        return STYLES[self.style].scaled(self.price_scale)

    @cached_property
    def idle_joints(self) -> Mask:
        """Mask (n,) of the joints that move no striker, no sole on the ground and no supporting hand, such as
        those of an idle arm or the head.
        """
        model = self.robot.model
        strikers = [self.robot.striker(name).model_frame for name in self.strikers]
        fixed = [*(leg.frame for leg in self.coordinates.legs), *(sole.frame for sole in self.soles)]
        moving = [model.joints[j].idx_v for j in joints_to(model, [*strikers, *fixed]) if j]
        return ~np.isin(np.arange(model.nv - self.robot.n, model.nv), moving)

    @property
    def planned_touches(self) -> int:
        """Number of touches in a plan; 1 if it is left open."""
        return self.order.count(TOUCH) + 1

    @property
    def order(self) -> tuple[str, ...]:
        """Ends of the contact's phases in a plan; (): the phases are the target's own."""
        if isinstance(self.touches, tuple):
            return self.touches
        return order_of_touches(self.law, self.target, self.touches or 1)

    @property
    def contact_phases(self) -> tuple[ContactPhase, ...]:
        """Phases of the contact in a plan."""
        return contact_phases(self.target, self.order)

    @property
    def lasts(self) -> bool:
        """True if the contact has a duration in the collision model."""
        return self.collision not in INSTANT

    @property
    def frozen(self) -> Effects | None:
        """Effects of a collision model with frozen dynamics; None for other models."""
        if self.collision == "sdc":
            return Effects()
        return Effects.paper() if self.collision == "sdc-paper" else None

    @property
    def scene(self) -> dict[str, Any]:
        """Arguments of a collision model that are about the robot and what it hits."""
        names = ("robot", "striker", "normal", "law", "target", "stance")
        return {name: getattr(self, name) for name in names}

    @property
    def gain_joints(self) -> tuple[tuple[int, ...], ...]:
        """Indices of the joints of each `GainFactor` in `gains`."""
        return tuple(gain.indices(self.robot) for gain in self.gains)

    @property
    def of_drives(self) -> bool:
        """True if a term bounds motors or gears."""
        return any(term.of_drives for term in self.active_terms)

    @property
    def first_instant(self) -> bool:
        """True if a term has constraints at the first instant of contact, and the law's force jumps there."""
        required = self.lasts and any(term.first_instant for term in self.active_terms)
        return required and float(self.law.branch(0.0, 1.0, True)) != 0.0

    @property
    def abort_after(self) -> float | None:
        """Time [s] after the planned contact at which the motion is aborted if nothing is hit; None:
        never.
        """
        return next((s.abort_after for s in self.scenarios if s.abort_after is not None), None)

    def term(self, kind: type[AnyTerm]) -> AnyTerm:
        """Term of a kind: the problem's own, or the default; InputError if it has neither."""
        for t in (*self.terms, *DEFAULT_TERMS, *ON_DEMAND_TERMS):
            if isinstance(t, kind):
                return t
        raise InputError(f"the problem has no term {kind.__name__}; add one to its `terms`")

    def extra(self, kind: type[AnyTerm]) -> AnyTerm | None:
        """The problem's own term of a kind; None if it has none."""
        return next((t for t in self.terms if isinstance(t, kind)), None)

    @cached_property
    def hash(self) -> str:
        """Hash of this problem, 16 hexadecimal digits: see `impactopt.problem.hashing.problem_hash`."""
        return problem_hash(self)

    @cached_property
    def start_posture(self) -> Array:
        """Start posture, a pin configuration (nq,)."""
        return self.robot.given_posture(self.start, name="the start posture")

    @property
    def coordinates(self) -> StanceCoordinates:
        """Independent coordinates of the stance at the impact, with supporting hands."""
        return self.stance_coordinates[self.blow]

    @cached_property
    def stance_coordinates(self) -> tuple[StanceCoordinates, ...]:
        """Independent coordinates of each stance phase, or of the single stance."""
        robot, start = self.robot, self.start_posture
        if not self.stances:
            hands = self.stance.held_hands(robot)
            return (StanceCoordinates(robot, self.stance.soles(robot), start, hands),)
        return phase_coordinates(robot, self.stances, start)

    @property
    def blow(self) -> int:
        """Index of the stance phase with the impact."""
        return impact_phase(self.stances)

    def change_posture(self, k: int) -> Array:
        """Guess of the posture (nq,) between stance phases k and k + 1: all soles of both in place, and the
        centre of mass above those that stand in both. Before the first phase and after the last one, that of
        the phase.
        """
        if not 0 <= k < len(self.stances) - 1:
            return self.stance_coordinates[min(max(k, 0), len(self.stances) - 1)].posture
        one, other = self.stance_coordinates[k : k + 2]
        more, fewer = (one, other) if len(one.legs) > len(other.legs) else (other, one)
        middle = support_polygon(self.robot, fewer).mean(axis=0)
        y, legs, data = more.start.copy(), more.start_legs, self.robot.model.createData()
        for _ in range(20):
            y[:2] += middle - np.array(pin.centerOfMass(self.robot.model, data, more.join(y, legs)))[:2]
            try:
                legs = more.solve_legs(y, legs)
            except InputError:
                y[2] -= 0.02  # the legs do not reach from so high
        return more.join(y, legs)

    @property
    def standing(self) -> Mask:
        """Mask (phases, soles) of the `soles` that stand in each stance phase."""
        names = [sole.name for sole in self.soles]
        stand = [[name in stance.soles for name in names] for stance in self.stances]
        return np.array(stand or [[True] * len(names)], dtype=bool)

    @property
    def floats(self) -> bool:
        """True if the robot floats freely: no sole, hand or base is fixed."""
        return isinstance(self.stance, Free)

    @property
    def stands(self) -> bool:
        """True if the robot stands on soles: it neither floats freely, nor has a fixed base."""
        return self.robot.floating and not self.floats

    @property
    def soles(self) -> tuple[Sole, ...]:
        """Soles that stand in any phase, in the robot's order."""
        if not self.stances:
            return self.stance.soles(self.robot)
        names = {name for stance in self.stances for name in stance.soles}
        return tuple(sole for sole in self.robot.soles if sole.name in names)

    @cached_property
    def contact_posture(self) -> Array:
        """Posture (nq,) at contact, as of `contact_posture_near` the given posture near it, or that in which
        the last stance begins.

        Raises
        ------
        InputError : the point is out of reach.
        """
        near = self.posture_near_contact
        return self.contact_posture_near(self.change_posture(self.blow - 1) if near is None else near)

    @property
    def posture_near_contact(self) -> Array | None:
        """Posture (nq,) of `near_contact`."""
        given = self.near_contact
        return None if given is None else self.robot.given_posture(given, name="near_contact")

    def contact_posture_near(self, guess: Array) -> Array:
        """Posture (nq,) with the strikers at their points and the soles in place, by inverse kinematics from
        a posture (nq,).

        The hand has the orientation of `HandOrientation` if that is possible.

        Raises
        ------
        InputError : the point is out of reach.
        """
        given = self.coordinates, self.striker, self.point, guess
        also = self.contacts[1:]
        if (hand := self.extra(HandOrientation)) is not None:
            direction = self.normal if hand.direction is None else np.array(hand.direction)
            with suppress(InputError):
                return inverse_kinematics(*given, also=also, facing=(np.array(hand.axis), direction))
        return inverse_kinematics(*given, also=also)

    @property
    def active_terms(self) -> tuple[Term, ...]:
        """The problem's own terms and the default terms that add constraints, but not those switched off.

        They are in the order of a problem file, which leaves out defaults, so that a plan that was read from
        one has the same program.
        """
        own = in_order((term for term in self.terms if term not in DEFAULT_TERMS), TERMS)
        given = {type(term) for term in own}
        defaults = [
            t
            for t in DEFAULT_TERMS
            if type(t).add_constraints is not Term.add_constraints and type(t) not in given
        ]
        return tuple(term for term in (*own, *defaults) if term.active)

    @property
    def on_demand(self) -> tuple[Term, ...]:
        """Lazy terms (ON_DEMAND_TERMS) that hold: all that are not switched off; none with two strikers."""
        terms = tuple(self.term(type(term)) for term in ON_DEMAND_TERMS)
        return tuple(term for term in terms if term.active and self.second is None)

    @property
    def gear_load(self) -> GearLoad:
        """Term that limits gear loads."""
        return self.term(GearLoad)

    @property
    def self_collision(self) -> SelfCollision:
        """Term that requires clearance between the robot's links."""
        return self.term(SelfCollision)

    @property
    def keep_out(self) -> KeepOut:
        """Term that requires clearance from the bodies of the world."""
        return self.term(KeepOut)

    @property
    def keeps_apart(self) -> bool:
        """True if clearance is required between any two bodies."""
        return self.self_collision.enabled or self.keep_out.enabled

    @property
    def middle(self) -> Array:
        """Middle (3,) [m] of the target's face: the hit point, or the mean of the two."""
        return self.point if self.second is None else (self.point + self.second.point) / 2

    @property
    def strikers(self) -> tuple[str, ...]:
        """Names of the strikers that hit."""
        return tuple(striker for striker, _ in self.contacts)

    @property
    def contacts(self) -> tuple[tuple[str, Array], ...]:
        """Strikers, each with its hit point [m]."""
        first = (self.striker, self.point)
        return (first,) if self.second is None else (first, (self.second.striker, self.second.point))

    @property
    def ground_height(self) -> float | None:
        """Height [m] of the floor; None if there is none."""
        if self.stands:
            return 0.0
        return None if self.ground is None else self.ground.height

    @cached_property
    def world(self) -> tuple[WorldBody, ...]:
        """Bodies of the world: the ground if there is one, the target and its supports, the obstacles."""
        return (
            *([] if self.ground_height is None else [ground_body(self.ground_height)]),
            *target_bodies(self.body, self.target, self.middle, self.normal),
            *obstacle_bodies(self.obstacles),
        )

    @cached_property
    def bodies(self) -> Bodies:
        """The robot's links and the bodies of the world, and the pairs of them that must not touch.

        Raises
        ------
        InputError : the start posture penetrates the target, its supports, or an obstacle.
        """
        robot, model = self.robot, self.robot.model
        strikers = [robot.striker(name).model_frame for name in self.strikers]
        frames = [*strikers, *(s.frame for s in self.soles)]
        joints = [int(model.frames[model.getFrameId(name)].parentJoint) for name in frames]
        # A hinged sole is at its foot's bottom.
        joints += [int(model.parents[model.getJointId(s.hinge_joint)]) for s in self.soles if s.hinge]
        return Bodies(
            self.robot,
            self.world,
            self.start_posture,
            striking=tuple(joints[: len(strikers)]),
            strict=self.keep_out.enabled,
            standing=tuple(joints[len(strikers) :]),
        )

    def describe(self) -> dict[str, Any]:
        """Short description of the problem, as JSON data for reports."""
        out: dict[str, Any] = {
            "name": self.name,
            "robot": self.robot.name,
            "striker": self.striker,
            "point_m": self.point.tolist(),
            "normal": self.normal.tolist(),
            "target": repr(self.target),
            "target_body": body_message(self.body, self.target),
            "law": repr(self.law),
            "hash": self.hash,
        }
        if self.keeps_apart:
            out["hulls"] = bodies_of(self.robot).hash
        if not self.stands:
            out["ground"] = "none" if self.ground_height is None else f"z = {self.ground_height:g} m"
        if self.collision != "full":
            frozen = f", {self.freezes} freezes" if self.freezes else ""
            more = {"rigid": f", restitution {self.coefficient_of_restitution:g}", "sdc": frozen}
            out["collision"] = self.collision + more.get(self.collision, "")
        if self.second is not None:
            out["second"] = {"striker": self.second.striker, "point_m": self.second.point.tolist()}
        if self.stances:
            out["stances"] = names_of(self.stances)
        if hands := self.stance.held_hands(self.robot):
            out["holds_on_with"] = [hand.name for hand in hands]
        if self.robot.couplings:
            out["followers"] = [
                f"{joint} = {ratio:g} {leader} {offset:+g}"
                for joint, (leader, ratio, offset) in self.robot.couplings.items()
            ]
        if self.robot.tendons:
            out["tendons"] = list(map(str, self.robot.tendons))
        if self.robot.source and self.robot.source.repairs:
            out["inertias"] = [f"repaired: {text}" for text in self.robot.source.repairs]
        if self.robot.source and self.robot.source.notes:
            out["notes"] = list(self.robot.source.notes)
        out |= {"scenarios": [str(s) for s in self.scenarios]} if self.scenarios else {}
        if self.gains:
            out["gains"] = [
                f"{', '.join(g.joints)}: {g.factor[0]:g} to {g.factor[1]:g} times" for g in self.gains
            ]
        if self.objectives != DEFAULT_OBJECTIVES:
            out["objectives"] = [f"{o.weight:g} x {o.name} [{o.unit}]" for o in self.objectives]
        off = [term.name for term in DEFAULT_TERMS if not self.term(type(term)).active]
        off += [term.name for term in ON_DEMAND_TERMS if self.term(type(term)) not in self.on_demand]
        if off:
            out["off"] = off
        return out
