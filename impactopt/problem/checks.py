"""Checks of the parts of an `impactopt.ImpactProblem` against each other.

Each check replaces a field by its normalized value (a tuple, a float) where it has one, and raises
`InputError`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from impactopt.arrays import Array
from impactopt.bodies.world import Ground, Obstacle, TargetBody
from impactopt.contact.fields import snake_case
from impactopt.contact.friction import check_friction, moves_target
from impactopt.contact.laws import ContactLaw, SpringDamper, rough_at
from impactopt.contact.targets import Board, FreeMass, RigidWall, Target
from impactopt.contact.targets.base import SEPARATION, TOUCH, TURN, is_order
from impactopt.errors import (
    MANY,
    MOST,
    InputError,
    check_array,
    check_choice,
    check_kind,
    check_number,
    check_whole,
    did_you_mean,
    shortened,
)
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.kinematics.operational_space import ConstrainedDynamics
from impactopt.kinematics.stance import margin, shrink, support_polygon
from impactopt.problem.objectives import OBJECTIVES, STYLES, PeakForce, Penetration, TargetEnergy
from impactopt.problem.scenario import SecondStriker
from impactopt.problem.terms import (
    TERMS,
    ContactWrenchCone,
    Grip,
    HitCone,
    HitRegion,
    JointJerk,
    MotorCurve,
    PowerLimit,
    Slide,
    Term,
)
from impactopt.robots.actuators import numbers_of
from impactopt.robots.checks import LEG, check_arms
from impactopt.robots.gains import GainFactor, scaled_gains
from impactopt.robots.robot import Robot

INSTANT = ("rigid", "virtual-mass")  # collision models without duration
# collision models, the cheapest first; "auto" is the cheapest that is accurate enough
COLLISIONS = (*INSTANT, "sdc-paper", "sdc", "full", "auto")
MOST_FREEZES = 64
LONGEST_CONTACT = 10.0  # [s]
MOST_ELEMENTS = 100  # of compression or restitution: two are accurate to a few per mille
MOST_TOUCHES = 4
# Smaller mobilities along the normal, over the largest in any direction, count as zero.
MIN_MOBILITY = 1e-12


def check_parts(problem: Any, name: str, kind: type) -> None:
    """Makes a tuple of the parts of a problem with this name; InputError unless all are of a kind."""
    given = getattr(problem, name)
    if not isinstance(given, (list, tuple)) or not all(isinstance(part, kind) for part in given):
        raise InputError(f"{name} must be a tuple of {kind.__name__}, not {given!r}")
    object.__setattr__(problem, name, tuple(given))


def check_apart(kind: str, names: Sequence[str]) -> None:
    """InputError if there are too many things of a kind, or two with the same name."""
    if len(names) > MANY:
        raise InputError(
            f"there are {len(names)} {kind}s; give at most {MANY}, each of which is part of the program"
        )
    twice = next((name for name, count in Counter(names).items() if count > 1), None)
    if twice is not None:
        raise InputError(f"two {kind}s are called {twice!r}: give each a name of its own")


def check_at_rest(robot: Robot, coordinates: StanceCoordinates, soles: Sequence[str], posture: Array) -> None:
    """InputError if the posture's centre of mass is not above the fixed soles, so that the robot falls."""
    polygon = support_polygon(robot, coordinates)
    if not len(polygon):
        return
    centre = np.array(pin.centerOfMass(robot.model, robot.model.createData(), posture))[:2]
    inside = float(margin(polygon, centre[None])[0])
    if inside < 0:
        raise InputError(
            f"the start posture cannot be held at rest: its centre of mass is {-1e3 * inside:.0f} mm "
            f"outside the support polygon of {', '.join(soles)}; start from a posture with its weight on "
            "these soles, or stand on more"
        )


def check_world(problem: Any) -> None:
    """InputError for wrong bodies of the world, and for a ground other than that of the soles."""
    if not isinstance(problem.body, TargetBody):
        raise InputError(f"body must be a TargetBody, not {problem.body!r}")
    check_parts(problem, "obstacles", Obstacle)
    check_apart("obstacle", [o.name for o in problem.obstacles])
    ground = problem.ground
    if ground is not None and not isinstance(ground, Ground):
        raise InputError(f"ground must be a Ground, such as Ground(height=-0.8), not {ground!r}")
    if ground is not None and ground.height and problem.stands:
        raise InputError(
            f"the ground of {problem.robot.name!r} is z = 0, where its soles stand: leave `ground` out"
        )


def check_stance(problem: Any) -> None:
    """InputError for a stance that cannot be planned: with a virtual base, a supporting hand that shares its
    arm, or soles on a ground that is not level.
    """
    robot, stance = problem.robot, problem.stance
    gravity = np.array(robot.model.gravity.linear)
    if stance.sole_frames(robot) and not (gravity[2] < 0 and not gravity[:2].any()):
        raise InputError(
            f"gravity is {gravity.tolist()} m/s2, and soles that stand need one along -z: turn it, as "
            "[robot] gravity_m_s2 or <option gravity> of an MJCF, or bolt the robot to the ground "
            "(floating = false)"
        )
    if np.any(stance.compliance > 0):
        raise InputError(
            f"a plan holds its soles exactly: give {type(stance).__name__} without the virtual base "
            "(base_mass, base_inertia), which is for collision models"
        )
    hands = [(hand.name, hand.model_frame) for hand in stance.held_hands(robot)]
    check_arms(robot, stance.sole_frames(robot), hands)


def check_hinges(problem: Any) -> None:
    """InputError for a sole whose hinge leaves the centre of pressure no place.

    A sole transmits no moment about its hinge, so the centre of pressure is on the hinge's axis.
    """
    cone = problem.term(ContactWrenchCone)
    for sole in problem.soles:
        across = {"x": 1, "y": 0}.get(sole.hinge)  # a hinge about z bounds no centre of pressure
        if across is None:
            continue
        least = max(cone.margin, cone.collision_margin or 0.0)
        ends = shrink(sole.polygon, least)[:, across]
        if not min(ends) < 0 < max(ends):
            raise InputError(
                f"the centre of pressure of the sole {sole.name!r} is on its hinge, the {sole.hinge} axis "
                f"of the frame {sole.frame!r}, which does not cross the sole at the margin of {least:g} m "
                "from the edges: put the frame in the middle of the sole, or reduce the margins of "
                "[terms.contact_wrench_cone]"
            )


def check_hands(problem: Any) -> None:
    """InputError for a supporting hand without a known grip, or in a model without it."""
    p, robot, grip = problem, problem.robot, problem.extra(Grip)
    hands = p.stance.held_hands(robot)
    if not hands:
        if grip is not None:
            raise InputError(
                "Grip is about hands that hold on, and none does: name them in the stance (hands=), or leave "
                "it out"
            )
        return
    if grip is None:
        raise InputError(
            f"the hand {hands[0].name!r} holds on: give the limits of its grip, by the term "
            "Grip(force=, moment=)"
        )
    if p.collision != "full":
        raise InputError(f'a plan whose hand holds on needs collision="full", not {p.collision!r}')


def check_motors(problem: Any) -> None:
    """InputError for a bound on motors none of which has the data, so that a plan would ignore it."""
    robot = problem.robot
    for kind, name, other in ((MotorCurve, "stall_torque", ""), (PowerLimit, "power_limit", "a limit, or ")):
        term = problem.extra(kind)
        limited = term is None or getattr(term, "limit", None) is not None
        if not limited and np.isnan(numbers_of(robot.actuators, name)).all():
            raise InputError(
                f"{kind.__name__} is about motors whose {name} is known, and none of {robot.name!r} is: give "
                f"{other}their data as [[robot.actuators]], or leave it out"
            )


def check_jerk(problem: Any) -> None:
    """InputError for a limit of the jerk of a joint that others determine, which a plan would ignore."""
    term, robot = problem.extra(JointJerk), problem.robot
    if term is None or not term.joints:
        return
    for k in problem.coordinates.dependent:
        if (joint := robot.joint_names[k]) in term.joints:
            raise InputError(
                f"JointJerk.limit: {joint!r} is determined by the other joints and a fixed sole or hand; "
                "leave it out"
            )


def check_second(problem: Any) -> None:
    """InputError for a second striker that does not fit the rest of a problem."""
    p, robot, second = problem, problem.robot, problem.second
    if second is None:
        return
    if not isinstance(second, SecondStriker):
        raise InputError(f"second must be a SecondStriker, not {second!r}")
    # each needs a joint that does not move the other
    one, other = (set(robot.limb(robot.striker(s).model_frame)) for s in (p.striker, second.striker))
    if not (one - other and other - one):
        raise InputError(
            f"the second striker {second.striker!r} moves with {p.striker!r}: give one on a limb of its own"
        )
    if p.collision != "full":
        raise InputError(f'two strikers need collision="full", not {p.collision!r}')
    if not isinstance(p.target, (FreeMass, RigidWall)):
        raise InputError(
            f"two strikers hit a FreeMass or a RigidWall, not a {type(p.target).__name__}, which takes one"
        )
    for thing in (*(term for term in p.terms if term.active), *p.objectives):
        if isinstance(thing, (HitCone, HitRegion, Slide, PeakForce, Penetration)) or (
            getattr(thing, "first_instant", False)
        ):
            kind, section = type(thing), "objectives" if thing in p.objectives else "terms"
            own = kind not in (*TERMS, *OBJECTIVES)  # a user's class, which files do not have
            in_file = "" if own else f", in a file [{section}.{snake_case(kind.__name__)}],"
            raise InputError(f"{kind.__name__}{in_file} is for one striker: leave it out, or the second one")


def check_strikers(problem: Any) -> None:
    """InputError for a striker on the limb of a sole that stands or of a hand that holds on.

    A plan computes the striking point from the coordinates that these joints follow from, without them.
    """
    p, robot = problem, problem.robot
    ends = [(f"sole {sole.name!r} stands", sole.frame, "stand on") for sole in p.stance.soles(robot)]
    hands = p.stance.held_hands(robot)
    ends += [(f"hand {hand.name!r} holds on", hand.model_frame, "hold on with") for hand in hands]
    for end, frame, verb in ends:
        limb = set(robot.limb(frame)[-LEG:])
        for name in p.strikers:
            if not (both := limb & set(robot.limb(robot.striker(name).model_frame))):
                continue
            raise InputError(
                f"the {end}, so it cannot carry the striker {name!r} (both move "
                f"by {', '.join(robot.joint_names[j] for j in sorted(both))}): {verb} another one"
            )


def check_gains(problem: Any) -> None:
    """InputError for gains that cannot be chosen: two factors for a joint, a servo that is too fast, or a
    contact without duration.
    """
    check_parts(problem, "gains", GainFactor)
    if not problem.gains:
        return
    if problem.collision in INSTANT:
        raise InputError(
            f"gains act while a contact lasts, and collision={problem.collision!r} has no duration: give "
            "them, or take another model"
        )
    names = problem.robot.joint_names
    joints = Counter(k for each in problem.gain_joints for k in each)
    twice = next((names[k] for k, count in joints.items() if count > 1), None)
    if twice is not None:
        raise InputError(f"gains: joint {twice!r} is in two of them; give it one factor")
    largest = {names[k]: g.factor[1] for g in problem.gains for k in g.indices(problem.robot)}
    scaled_gains(problem.robot, largest)


def check_moves(problem: Any) -> None:
    """InputError if no joint moves the striking point along the normal where it meets the target."""
    c, n = problem.coordinates, problem.normal
    striker = problem.robot.striker(problem.striker).model_frame
    mobility = ConstrainedDynamics.at(c.model, problem.contact_posture, c.frames, striker).inverse_mass()
    if n @ mobility @ n <= MIN_MOBILITY * np.linalg.norm(mobility):
        raise InputError(
            f"no joint of {problem.robot.name!r} moves {problem.striker!r} along the normal "
            f"{np.round(n, 6).tolist()} at the point: turn the normal, move the point, or take another robot"
        )


def check_collision(problem: Any) -> None:
    """InputError for a law, target and collision model that do not fit together."""
    for name, kind in (("law", ContactLaw), ("target", Target)):
        check_kind(name, getattr(problem, name), kind)
    law = problem.law
    rough = rough_at([lambda x, rate: law.branch(x, rate, True), lambda x, rate: law.branch(x, rate, False)])
    if rough is not None:
        raise InputError(
            f"the law {type(law).__name__} has no finite force, slope or curvature at a penetration of "
            f"{1e3 * rough:g} mm, where a plan's search passes: write its powers with "
            "impactopt.contact.power, as power(x, 1.5)"
        )
    check_choice("unknown collision", problem.collision, COLLISIONS)
    e = check_number("coefficient_of_restitution", problem.coefficient_of_restitution)
    object.__setattr__(problem, "coefficient_of_restitution", e)
    if not 0 <= e <= 1:
        raise InputError(f"coefficient_of_restitution must be between 0 and 1, not {e}")
    if e and problem.collision != "rigid":
        raise InputError(
            f'coefficient_of_restitution is for collision="rigid"; with {problem.collision!r} leave it out'
        )
    check_freezes(problem)
    if problem.collision == "virtual-mass" and not isinstance(problem.law, SpringDamper):
        raise InputError(
            'collision="virtual-mass" has a closed form for the law SpringDamper only, not '
            f"{type(problem.law).__name__}"
        )
    check_friction("friction", problem.friction, problem.target)
    if problem.friction is not None and problem.collision != "full":
        raise InputError(
            f'friction: the model {problem.collision!r} of the collision has none: take collision="full", or '
            "leave friction out"
        )
    instant = problem.collision in INSTANT
    if instant and not isinstance(problem.target, (FreeMass, RigidWall)):
        raise InputError(
            f"collision={problem.collision!r} knows the targets FreeMass and RigidWall only, not "
            f'{type(problem.target).__name__}; take collision="full"'
        )
    if not instant:
        target = problem.target
        target.smooth([0.0] * target.n_states, 0.0, 0)  # raises for switches without a `smooth` of their own
        if not target.turns and law.switches:
            raise InputError(
                f"a plan for a {type(target).__name__} needs a law that is the same in compression and "
                f"restitution, as KelvinVoigt or HuntCrossley, not {type(law).__name__}: hammer and nail "
                "approach and part several times in one blow"
            )


def check_energy(problem: Any) -> None:
    """InputError for the objective `TargetEnergy` where the target's energy is not all that it absorbs."""
    if not any(isinstance(o, TargetEnergy) for o in problem.objectives):
        return
    if isinstance(problem.target, Board) and problem.target.damping:
        raise InputError(
            "objectives: TargetEnergy lacks the work of a board's damping: give the Board damping=0, or "
            "another objective"
        )
    if moves_target(problem.friction):
        raise InputError(
            "objectives: TargetEnergy is of motion along the normal, and friction's moves_target adds some "
            "across it: leave one of them out"
        )


def check_touches(problem: Any) -> None:
    """InputError for touches that a plan cannot have."""
    touches = problem.touches
    if touches is None:
        return
    order = tuple(touches) if isinstance(touches, (tuple, list)) else ()
    number = order.count(TOUCH) + 1 if order else touches
    number = check_whole("touches", number, least=1, most=MOST_TOUCHES)
    object.__setattr__(problem, "touches", order or number)
    if (order or number > 1) and (why := met_once(problem)):
        raise InputError(f"touches is {touches}, but {why}: leave it out")
    law, target = problem.law, problem.target
    if order and isinstance(law, ContactLaw) and not is_order(law, target, order):
        first = int(target.at_once)
        turn = [TURN] if law.switches else []
        possible = [*target.guards[:first], *turn, SEPARATION, *target.guards[first:]]
        raise InputError(
            f"touches: {list(order)} are no ends of a contact's phases, such as {possible} under the law "
            f"{type(law).__name__}: leave it out"
        )


def met_once(problem: Any) -> str:
    """Reason that a plan has a single touch; "" if it may have several."""
    target = problem.target
    if not getattr(target, "met_again", False):  # not a target at all: `check_collision` refuses it
        return f"a {type(target).__name__} is met once in a plan"
    if problem.collision != "full":
        return f"the model {problem.collision!r} of the collision has one contact"
    if problem.second is not None:
        return "two strikers meet it"
    if any(isinstance(objective, Penetration) for objective in problem.objectives):
        return "the objective Penetration is for one touch"
    return ""


def check_elements(problem: Any) -> None:
    """InputError for invalid collocation elements and durations of the contact."""
    given: Any = problem.collision_elements
    given = given.tolist() if isinstance(given, np.ndarray) else given
    if not isinstance(given, (list, tuple)) or len(given) != 2:
        raise InputError(
            "collision_elements are those of compression and those of restitution, two tuples, not "
            f"{shortened(str(given))}"
        )
    elements = tuple(tuple(check_array("collision_elements", x, (None,)).tolist()) for x in given)
    object.__setattr__(problem, "collision_elements", elements)
    stages = check_whole("collision_stages", problem.collision_stages, least=2, most=3)
    object.__setattr__(problem, "collision_stages", stages)
    for lengths in elements:
        if not 0 < len(lengths) <= MOST_ELEMENTS or min(lengths) <= 0 or abs(sum(lengths) - 1) > 1e-9:
            raise InputError(
                f"collision_elements must be 1 to {MOST_ELEMENTS} positive fractions that sum to 1, not "
                f"{shortened(str(lengths))}"
            )
    lo, hi = check_array("contact_duration [s]", problem.contact_duration, (2,), most=LONGEST_CONTACT)
    if not (0 <= lo <= hi and hi > 0):
        raise InputError(
            f"contact_duration must be (shortest, longest) in seconds, not {problem.contact_duration}"
        )
    object.__setattr__(problem, "contact_duration", (float(lo), float(hi)))


def check_prices(problem: Any) -> None:
    """InputError for an unknown style, and for prices on motion that are not numbers >= 0."""
    check_choice("unknown style", problem.style, STYLES)
    for name in ("smoothness", "wrench_price", "return_price", "motion_price", "price_scale"):
        number = check_number(name, getattr(problem, name))
        object.__setattr__(problem, name, number)
        if not 0 <= number <= MOST:
            raise InputError(f"{name} must be a number of 0 to {MOST:g}, not {number:g}")


def check_freezes(problem: Any) -> None:
    """InputError for freezes of a model without them, and for tolerances of "auto" that are not positive."""
    freezes = check_whole("freezes", problem.freezes, least=0, most=MOST_FREEZES)
    object.__setattr__(problem, "freezes", freezes)
    if freezes and problem.collision != "sdc":
        raise InputError(f'freezes are for collision="sdc"; with {problem.collision!r} leave them out')
    for name in ("auto_impulse_pct", "auto_zmp_mm"):
        tolerance = check_number(name, getattr(problem, name))
        object.__setattr__(problem, name, tolerance)
        if not 0 < tolerance <= MOST:
            raise InputError(f"{name} must be a number > 0, at most {MOST:g}, not {tolerance:g}")


def check_names(robot: Robot, term: Term) -> None:
    """InputError for frames and joints of a term that the robot does not have."""
    frames = [f.name for f in robot.model.frames]
    wrong = [
        f"{type(term).__name__}: {robot.name} has no {kind} {name!r}{did_you_mean(name, known)}"
        for kind, names, known in (("frame", term.frames, frames), ("joint", term.joints, robot.joint_names))
        for name in dict.fromkeys(names)
        if name not in known
    ]
    if wrong:
        raise InputError("\n".join(wrong), wrong)
