"""The declarative problem: which robot hits what, where, and what it must respect meanwhile."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, TypeVar

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.bodies.clearance import Bodies
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
from impactopt.contact.friction import ContactFriction
from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import Target
from impactopt.contact.targets.base import ContactPhase, contact_phases
from impactopt.errors import (
    FARTHEST,
    InputError,
    Mistakes,
    check_array,
    check_name,
)
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.kinematics.inverse_kinematics import inverse_kinematics
from impactopt.kinematics.stance import BothSoles, Free, Stance
from impactopt.kinematics.support import support_polygon
from impactopt.problem.checks import (
    COLLISIONS,
    INSTANT,
    check_apart,
    check_at_rest,
    check_collision,
    check_elements,
    check_gains,
    check_hands,
    check_moves,
    check_names,
    check_prices,
    check_stance,
    check_touches,
    check_world,
)
from impactopt.problem.hashing import problem_hash
from impactopt.problem.motion_style import STYLES, MotionPrices, idle_joints
from impactopt.problem.objectives import DEFAULT_OBJECTIVES, Objective, check_objectives
from impactopt.problem.scenario import Phase, Scenario, SecondStriker, check_second
from impactopt.problem.stances import (
    StancePhase,
    check_stances,
    names_of,
    places_of_soles,
    stepped_posture,
)
from impactopt.problem.terms import (
    DEFAULT_TERMS,
    ON_DEMAND_TERMS,
    GearLoad,
    HandOrientation,
    HitCone,
    Incidence,
    KeepOut,
    SelfCollision,
    Term,
    check_known,
    kind_of,
)
from impactopt.robots.attachments import Sole
from impactopt.robots.gains import GainFactor
from impactopt.robots.robot import Robot

Array = NDArray[np.float64]
__all__ = ["COLLISIONS", "ImpactProblem", "Phase"]

AnyTerm = TypeVar("AnyTerm", bound=Term)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class ImpactProblem:
    """Maximize what ``robot`` does to ``target`` with ``striker``: by default the impulse.

    Attributes
    ----------
    robot, striker : the robot, and the name of the one of its strikers that hits.
    point (3,) [m] : where the striking point meets the target, in the world frame: that of a fixed base, or
        with z = 0 at the ground on which the soles stand, and the soles of the start posture centred on the
        origin.
    normal (3,) : unit vector in the world frame, along which the target is pushed.
    friction : of the striking points on the target, which does not move sideways; None: there is none.
    second : another striker that hits the same target at the same time, at a point of its own.
    law, target : contact law and target. In a plan a `Board` breaks during compression, and a `Nail` moves
        once and stands again before the striker leaves it.
    stance : which soles are held, and which hands hold on: to where they are in the start posture.
    stances : the motion as a sequence of phases, each with the soles that stand in it; (): `stance` from the
        first to the last instant. With phases `stance` is that of the one with the blow.
    start : the posture that the motion starts from at rest: a name of ``robot.postures`` or a pin
        configuration (nq,).
    swing, follow : wind-up and strike; follow-through to rest.
    contact_duration : (shortest, longest) [s], of compression (of a nail: until it stands) and of restitution
        alike. A phase that an event splits in two, as a board's break does, may be shorter than this. With 0
        as the shortest, law and masses decide.
    collision_elements : lengths of the collocation elements of compression, and of restitution, each as
        fractions that sum to 1. With a `Nail` or a `Board` those of compression are used before and after the
        event, and every element is cut in two halves.
    collision_stages : 2 or 3, Radau IIA stages an element (order 3 or 5).
    touches : how many times the striker meets the target in the blow: more than once a `Board` that breaks in
        the last touch. None: as many times as point masses in place of robot and target do.
    collision : the model of the impact. "full": the whole equation of motion while the contact lasts. "sdc":
        H, J and bias are frozen at contact, and ``freezes`` times during it, as in :class:`impactopt.SDC`.
        "sdc-paper": likewise, with the effects of `SDC.paper`. "auto": "sdc" where it is good enough, else
        "full", where full dynamics at the plan's state at contact would change the impulse by more than
        ``auto_impulse_pct`` or the ZMP by more than ``auto_zmp_mm``. Two impacts without duration are there
        to compare with; they know nothing of torque, ZMP and servo meanwhile: "virtual-mass", with the
        restitution of two masses under the contact law, and "rigid", with ``coefficient_of_restitution``
        (speed of separation over speed of approach).
    scenarios : other targets, or none, that the robot has to survive with the same swing.
    body : the target's shape, which all of the robot but the striking point keeps off.
    obstacles : bodies in the world that the robot keeps off.
    ground : the floor below a robot on a fixed base, or one that floats freely; None: there is none. Soles
        stand on the ground z = 0.
    terms : constraints. Those of DEFAULT_TERMS that are not given take their defaults, and so does
        `GearLoad`, whose constraints a program gets once a plan without them goes beyond it.
    objectives : their weighted sum is maximized.
    style : "natural", with prices on jerk, on the travel of joints, above all of idle ones, and on ending
        away from the start posture (`impactopt.problem.motion_style`); or "strongest", with none.
    motion_price : largest share of the objective that prices on motion may take; those of the style are
        reduced until they take no more.  price_scale : factor on these; 1: a plan chooses it.
    smoothness : price of accelerations [N s per (rad/s^2)^2 s].  wrench_price : price of sole wrenches.
        return_price : price of ending away from the start posture [N s per rad^2]. These three are small;
        they make the optimum unique, and bring the robot back to its start.
    gains : factors on gains of servos and of springs of soft grips, which the plan chooses.

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
    start: str | Array = "half_sitting"
    swing: Phase = field(default_factory=lambda: Phase(duration=(0.8, 0.8)))
    follow: Phase = field(default_factory=lambda: Phase(duration=(1.0, 1.0)))
    contact_duration: tuple[float, float] = (0.0, 0.2)
    collision_elements: tuple[tuple[float, ...], tuple[float, ...]] = ((0.2, 0.8), (1.0,))
    collision_stages: int = 3
    touches: int | None = None
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
        """All but its coordinates, whose symbols CasADi does not pickle: they are made anew when needed."""
        return {name: value for name, value in vars(self).items() if name != "stance_coordinates"}

    def __post_init__(self) -> None:
        found = Mistakes()
        found.attempt(lambda: check_name("the problem", self.name, empty=True))
        hits = found.attempt(lambda: self.robot.striker(self.striker))
        aimed = found.attempt(self._check_aim)
        stands = found.attempt(partial(check_stances, self)) and found.attempt(partial(check_stance, self))
        stands = stands and found.attempt(self._check_start)
        for check in (check_elements, check_prices, check_collision, check_touches):
            found.attempt(partial(check, self))
        if found.attempt(self._check_scenarios):
            for scenario in self.scenarios:
                found.attempt(partial(scenario.numbers, self.law, self.target))
        found.attempt(partial(check_world, self))
        found.attempt(partial(check_gains, self))
        termed = found.attempt(self._check_terms)
        if termed:
            for term in self.terms:
                found.attempt(partial(check_names, self.robot, term))
        found.attempt(self._check_objectives)
        sound = hits and stands and termed and found.attempt(partial(check_second, self))
        if sound:
            found.attempt(partial(check_hands, self))
        if sound and aimed and found.attempt(lambda: self.contact_posture):
            found.attempt(partial(check_moves, self))
        found.raise_if_any("the problem")

    def _check_aim(self) -> None:
        object.__setattr__(self, "point", check_array("point [m]", self.point, (3,), most=FARTHEST))
        normal = check_array("normal", self.normal, (3,))
        if abs(np.linalg.norm(normal) - 1) > 1e-6:
            length = float(np.linalg.norm(normal))
            unit = f": did you mean {np.round(normal / length, 6).tolist()}?" if length > 0 else ""
            raise InputError(f"normal must be a unit vector, its length is {length:.6g}{unit}")
        object.__setattr__(self, "normal", normal / np.linalg.norm(normal))

    def _check_scenarios(self) -> None:
        listed = isinstance(self.scenarios, (list, tuple))
        if not listed or not all(isinstance(s, Scenario) for s in self.scenarios):
            raise InputError(f"scenarios must be a tuple of Scenario, not {self.scenarios!r}")
        object.__setattr__(self, "scenarios", tuple(self.scenarios))
        if self.scenarios and not self.lasts:
            raise InputError(f'scenarios need a contact that lasts, as "full", not {self.collision!r}')
        check_apart("scenario", [s.name for s in self.scenarios])
        if self.floats and self.abort_after is not None:
            raise InputError(
                f"robot {self.robot.name!r} floats freely, and has no abort motion: leave abort_after out of "
                "its scenarios"
            )

    def _check_terms(self) -> None:
        listed = isinstance(self.terms, (list, tuple))
        if not listed or not all(isinstance(t, Term) for t in self.terms):
            raise InputError(f"terms must be a tuple of terms, such as (TorqueLimit(),), not {self.terms!r}")
        check_known(self.terms, Term, "add_rows")
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
        self.robot.check_limits(posture, name="the start posture")
        self.robot.check_stance(posture, [sole.name for sole in self.soles])
        first = self.stance_coordinates[0]
        check_at_rest(self.robot, first, [sole.name for sole in first.soles], posture)

    @property
    def style_prices(self) -> MotionPrices:
        """The prices of its style, as far as they are reduced."""
        return STYLES[self.style].scaled(self.price_scale)

    @cached_property
    def idle_joints(self) -> NDArray[np.bool_]:
        """Mask (n,) of the joints that move no striker, no sole on the ground and no hand that holds on."""
        strikers = [self.robot.striker(name).model_frame for name in self.strikers]
        held = [*(leg.frame for leg in self.coordinates.legs), *(sole.frame for sole in self.soles)]
        return idle_joints(self.robot, [*strikers, *held])

    @property
    def planned_touches(self) -> int:
        """Touches of the target in a plan: one where their number is open."""
        return self.touches or 1

    @property
    def contact_phases(self) -> tuple[ContactPhase, ...]:
        """Phases of the contact in a plan."""
        return contact_phases(self.target, self.planned_touches)

    @property
    def lasts(self) -> bool:
        """True if the model of the collision gives the contact a duration."""
        return self.collision not in INSTANT

    @property
    def frozen(self) -> Effects | None:
        """The effects of a model of the collision with frozen dynamics; None of the others."""
        return {"sdc": Effects(), "sdc-paper": Effects.paper()}.get(self.collision)

    @property
    def gain_joints(self) -> tuple[tuple[int, ...], ...]:
        """Indices of the joints of each of its `gains`."""
        return tuple(gain.indices(self.robot) for gain in self.gains)

    @property
    def of_drives(self) -> bool:
        """True if a term is about motors or gears."""
        return any(term.of_drives for term in self.active_terms)

    @property
    def first_instant(self) -> bool:
        """True if a term needs the first instant of a contact whose force begins with a jump."""
        wanted = self.lasts and any(term.first_instant for term in self.active_terms)
        return wanted and float(self.law.branch(0.0, 1.0, True)) != 0.0

    @property
    def abort_after(self) -> float | None:
        """Time after the planned contact at which the motion is aborted if nothing is hit [s]; None:
        never.
        """
        return next((s.abort_after for s in self.scenarios if s.abort_after is not None), None)

    def term(self, kind: type[AnyTerm]) -> AnyTerm:
        """The term of a kind: the problem's own, or the default."""
        for t in (*self.terms, *DEFAULT_TERMS, *ON_DEMAND_TERMS):
            if isinstance(t, kind):
                return t
        raise InputError(f"unknown kind of term {kind.__name__}")

    def extra(self, kind: type[AnyTerm]) -> AnyTerm | None:
        """The problem's own term of a kind that has no default; None if it has none."""
        return next((t for t in self.terms if isinstance(t, kind)), None)

    @cached_property
    def hash(self) -> str:
        """Hash of this problem, 16 hexadecimal digits: see `impactopt.problem.hashing.problem_hash`."""
        return problem_hash(self)

    @cached_property
    def start_posture(self) -> Array:
        """pin configuration (nq,) of the start."""
        if isinstance(self.start, str):
            return np.array(self.robot.posture(self.start))
        return self.robot.check_configuration(self.start, name="the start posture")

    @property
    def coordinates(self) -> StanceCoordinates:
        """Independent coordinates of the stance with the blow, in which hands hold on, too."""
        return self.stance_coordinates[self.blow]

    @cached_property
    def stance_coordinates(self) -> tuple[StanceCoordinates, ...]:
        """Independent coordinates of each of its stance phases; of its one stance if it has none."""
        robot, start = self.robot, self.start_posture
        if not self.stances:
            hands = self.stance.held_hands(robot)
            return (StanceCoordinates(robot, self.stance.soles(robot), start, hands),)
        known: dict[Any, StanceCoordinates] = {}
        out = []
        for places in places_of_soles(self.stances, [sole.name for sole in robot.soles]):
            soles = tuple(robot.sole(name) for name in places)
            names, key = tuple(places), tuple((name, *at) for name, at in places.items())
            if names not in known:
                known[names] = StanceCoordinates(robot, soles, start)
            if key not in known:
                c = known[names]
                if any(at.any() for at in places.values()):
                    c = StanceCoordinates(robot, soles, stepped_posture(c, places))
                known[key] = c
            out.append(known[key])
        return tuple(out)

    @property
    def blow(self) -> int:
        """Index of the stance phase with the blow."""
        return next((k for k, stance in enumerate(self.stances) if stance.phase is None), 0)

    def change_posture(self, k: int) -> Array:
        """Some posture (nq,) between stance phases k and k + 1: that of the heavier one, with the centre of
        mass above the soles that stand in both. That of the stance before the first and after the last one.
        """
        if not 0 <= k < len(self.stances) - 1:
            return self.stance_coordinates[min(max(k, 0), len(self.stances) - 1)].posture
        one, other = self.stance_coordinates[k : k + 2]
        heavy, light = (one, other) if len(one.legs) > len(other.legs) else (other, one)
        middle = support_polygon(self.robot, light).mean(axis=0)
        y, legs, data = heavy.start.copy(), heavy.start_legs, self.robot.model.createData()
        for _ in range(20):
            y[:2] += middle - np.array(pin.centerOfMass(self.robot.model, data, heavy.join(y, legs)))[:2]
            try:
                legs = heavy.solve_legs(y, legs)
            except InputError:
                y[2] -= 0.02  # the legs do not reach: lower
        return heavy.join(y, legs)

    @property
    def standing(self) -> NDArray[np.bool_]:
        """Mask (phases, soles) of its `soles` that stand in each stance phase."""
        names = [sole.name for sole in self.soles]
        found = [[name in stance.soles for name in names] for stance in self.stances]
        return np.array(found or [[True] * len(names)], dtype=bool)

    @property
    def floats(self) -> bool:
        """True if nothing holds the robot."""
        return isinstance(self.stance, Free)

    @property
    def stands(self) -> bool:
        """True if soles bear the robot: it neither floats freely, nor is its base fixed."""
        return self.robot.floating and not self.floats

    @property
    def soles(self) -> tuple[Sole, ...]:
        """The soles that stand at some time, in the robot's order."""
        if not self.stances:
            return self.stance.soles(self.robot)
        names = {name for stance in self.stances for name in stance.soles}
        return tuple(sole for sole in self.robot.soles if sole.name in names)

    @cached_property
    def contact_posture(self) -> Array:
        """Some posture (nq,) with the striking point at ``point`` and the soles in place.

        The hand has the orientation that is asked for, as nearly as may be.

        Raises InputError if none is found: the point is out of reach.
        """
        given = self.coordinates, self.striker, self.point, self.change_posture(self.blow - 1)
        also = self.contacts[1:]
        if (hand := self.extra(HandOrientation)) is not None:
            direction = self.normal if hand.direction is None else np.array(hand.direction)
            with suppress(InputError):
                return inverse_kinematics(*given, also=also, facing=(np.array(hand.axis), direction))
        return inverse_kinematics(*given, also=also)

    @property
    def active_terms(self) -> tuple[Term, ...]:
        """Its own terms, and those by default that bring constraints of their own; none that is off."""
        mine = {type(term) for term in self.terms}
        own = [t for t in DEFAULT_TERMS if type(t).add_rows is not Term.add_rows and type(t) not in mine]
        return tuple(term for term in (*self.terms, *own) if term.active)

    @property
    def on_demand(self) -> tuple[Term, ...]:
        """Lazy terms (ON_DEMAND_TERMS) that hold: they are not switched off, and about one striker."""
        terms = tuple(self.term(type(term)) for term in ON_DEMAND_TERMS)
        return tuple(term for term in terms if term.active and self.second is None)

    @property
    def gear_load(self) -> GearLoad:
        """Its term on its gears."""
        return self.term(GearLoad)

    @property
    def self_collision(self) -> SelfCollision:
        """Its term on its own links."""
        return self.term(SelfCollision)

    @property
    def keep_out(self) -> KeepOut:
        """Its term on the world."""
        return self.term(KeepOut)

    @property
    def keeps_apart(self) -> bool:
        """True if any two bodies must not touch."""
        return self.self_collision.enabled or self.keep_out.enabled

    @property
    def middle(self) -> Array:
        """(3,) [m] of the target's face: the point, or what is between the two."""
        return self.point if self.second is None else (self.point + self.second.point) / 2

    @property
    def strikers(self) -> tuple[str, ...]:
        """Names of all that hit."""
        return tuple(striker for striker, _ in self.contacts)

    @property
    def contacts(self) -> tuple[tuple[str, Array], ...]:
        """Strikers, each with the point [m] that it meets."""
        mine = (self.striker, self.point)
        return (mine,) if self.second is None else (mine, (self.second.striker, self.second.point))

    @property
    def ground_height(self) -> float | None:
        """[m] of the floor; None: there is none."""
        if self.stands:
            return 0.0
        return None if self.ground is None else self.ground.height

    @cached_property
    def world(self) -> tuple[WorldBody, ...]:
        """The bodies that are not the robot's: the ground if there is one, the target and what holds it, the
        obstacles.
        """
        return (
            *([] if self.ground_height is None else [ground_body(self.ground_height)]),
            *target_bodies(self.body, self.target, self.middle, self.normal),
            *obstacle_bodies(self.obstacles),
        )

    @cached_property
    def bodies(self) -> Bodies:
        """All that can touch something: the robot's links and the world, and which pairs are not to.

        Raises
        ------
        InputError : the start posture is in the target, in what holds it, or in an obstacle.
        """
        robot, model = self.robot, self.robot.model
        hits = [robot.striker(name).model_frame for name in self.strikers]
        frames = [*hits, *(s.frame for s in self.soles)]
        joints = [int(model.frames[model.getFrameId(name)].parentJoint) for name in frames]
        return Bodies(
            self.robot,
            self.world,
            self.start_posture,
            normal=self.normal,
            striking=tuple(joints[: len(hits)]),
            strict=self.keep_out.enabled,
            standing=tuple(joints[len(hits) :]),
        )

    def describe(self) -> dict[str, Any]:
        """The problem in a few plain words and numbers, for reports."""
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
        off = [term.name for term in (self.self_collision, self.keep_out) if not term.active]
        off += [term.name for term in ON_DEMAND_TERMS if self.term(type(term)) not in self.on_demand]
        if off:
            out["off"] = off
        return out
