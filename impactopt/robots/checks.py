"""Checks of a robot and its configurations; every message names the thing and the fix. Repair of inertias."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from impactopt.arrays import Array
from impactopt.errors import FARTHEST, InputError, Mistakes, check_array, counted, did_you_mean
from impactopt.robots.model import mass_matrix, principal_moments

_MARK = "\x00"  # no name in a file contains it


def tell_apart(model: pin.Model) -> None:
    """Rename joint frames that have the name of a link: `elbow` is the link, `joint elbow` its joint."""
    count = Counter(str(frame.name) for frame in model.frames)
    for frame in model.frames:
        if count[str(frame.name)] > 1 and frame.type in (pin.FrameType.JOINT, pin.FrameType.FIXED_JOINT):
            frame.name = f"joint {frame.name}"


def reduced(model: pin.Model, locked: Sequence[int], q: Array, *geometry: Any) -> Any:
    """`pin.buildReducedModel`: the model without joints that are locked at q (nq,); with `geometry`, also the
    reduced pin.GeometryModel.

    Pinocchio 4.1 looks frames up by the joints' names, and fails if a link has the same name as a joint, or a
    fixed joint the same as its link. So frames are renamed before, and named back after.
    """
    model = model.copy()
    joints, count = set(map(str, model.names)), Counter(str(frame.name) for frame in model.frames)
    for frame in model.frames:
        name, fixed = str(frame.name), frame.type == pin.FrameType.FIXED_JOINT
        if frame.type == pin.FrameType.JOINT:
            frame.name = model.names[frame.parentJoint]
        elif (fixed and count[name] > 1) or (not fixed and name in joints):
            frame.name = f"{name}{_MARK}"
    out = pin.buildReducedModel(model, *geometry, list(locked), q)
    found = out[0] if geometry else out
    for frame in found.frames:
        frame.name = str(frame.name).removesuffix(_MARK)
    tell_apart(found)
    return out


# Fastest plausible servo [1/s]: its time constant of 33 us is below a tenth of any servo's sampling time.
# Light wrists without armature reach 1e5.
MAX_SERVO_RATE = 3e4
HEAVIEST = 1e6  # [kg], [kg m2] of a link, a tool or a rotor: the mass of a ship
LEG = 6  # joints that a leg needs to fix its sole's six degrees of freedom
_LIMITS = ("torque_limit", "velocity_limit", "position_limit")
STRONGEST = 1e15  # [N m], [rad/s] of a joint: large enough for "no limit"


def check_joint_types(model: pin.Model) -> None:
    """InputError unless all joints, except a free-flyer at the root, have one degree of freedom or follow a
    joint that has position limits.
    """
    for i in range(1, model.njoints):
        joint = model.joints[i]
        if joint.nv > 1 and not (i == 1 and joint.shortname() == "JointModelFreeFlyer"):
            raise InputError(
                f"joint {model.names[i]!r} is a {joint.shortname()} with {joint.nv} degrees of freedom; "
                "besides a free-flyer at the root, joints have one: split it into such joints, or lock it"
            )
        if not joint.nv and any(other.idx_v == joint.idx_v and other.nq == 2 for other in model.joints):
            raise InputError(
                f"joint {model.names[i]!r} follows a continuous joint; give both of them position limits"
            )


def check_joints(joints: Sequence[str], name: str) -> None:
    """InputError if there is no joint to drive."""
    if not joints:
        raise InputError(
            f"robot {name!r} has no movable joints: there is nothing to plan; check its <joint>s"
        )
    for joint in joints:
        if not joint.isprintable():
            raise InputError(f"the name of joint {joint!r} has control characters; take them out")


# fix of a missing limit, by kind of file
_FIXES = {
    "URDF": dict.fromkeys(_LIMITS, "set it in the URDF's <limit>, or "),
    "MJCF": {
        "torque_limit": "set the joint's `actuatorfrcrange` in the MJCF, or ",
        "velocity_limit": "an MJCF has none: ",
        "position_limit": "set the joint's `range` in the MJCF, or ",
    },
    "": dict.fromkeys(_LIMITS, ""),
}


def check_limits(
    joints: Sequence[str], torque: Array, velocity: Array, lower: Array, upper: Array, kind: str = ""
) -> None:
    """InputError with all limits that are missing (zero or infinite in a URDF), negative or crossed.

    kind : kind of the robot's file, "URDF" or "MJCF"; "" without a file.
    """
    fixes = _FIXES[kind]
    found = Mistakes()
    for name, value, unit, option in (
        *((j, x, "N m", "torque_limit") for j, x in zip(joints, torque, strict=True)),
        *((j, x, "rad/s", "velocity_limit") for j, x in zip(joints, velocity, strict=True)),
    ):
        if not 0 < value <= STRONGEST:  # Pinocchio has infinity or the largest double for a missing limit
            found.found.append(
                f"joint {name!r} has no usable {option.replace('_', ' ')} ({value:g} {unit}); "
                f"{fixes[option]}give {option}={{{name!r}: ...}}"
            )
    for name, low, high in zip(joints, lower, upper, strict=True):
        if not low < high:
            found.found.append(
                f"joint {name!r} has no usable position limits (lower {low:g}, upper {high:g} rad); "
                f"{fixes['position_limit']}give position_limit={{{name!r}: (lower, upper)}}"
            )
    found.raise_if_any("the robot")


def check_actuators(joints: Sequence[str], actuators: Sequence[Any]) -> None:
    """InputError unless there is one actuator per joint, and all armatures are in the model."""
    if len(actuators) != len(joints):
        raise InputError(f"there are {len(actuators)} actuators for {len(joints)} joints; give one a joint")
    for name, actuator in zip(joints, actuators, strict=True):
        if actuator.armature is not None:
            raise InputError(
                f"the actuator of joint {name!r} has an armature of {actuator.armature:g} kg m2, and the "
                "model has one too; give it with Robot.with_actuators, which sets the model's"
            )


def check_springs(model: pin.Model, springs: Iterable[str]) -> None:
    """InputError if one of the joints with springs, by name, is continuous."""
    for name in springs:
        if model.joints[model.getJointId(name)].nq > 1:
            raise InputError(
                f"joint {name!r} has a spring and is continuous, so that its number of turns is not known; "
                "give it position limits in its file, or take the spring out"
            )


def check_gains(
    model: pin.Model, joints: Sequence[str], kp: Array, kd: Array, configurations: Iterable[Array]
) -> None:
    """InputError if a gain is negative, or makes a joint's servo faster than MAX_SERVO_RATE at one of the
    configurations.

    The effective inertia of joint i is least when all other joints are free: 1 / (H^-1)_ii, with armature.
    Then damping alone has the rate Kd (H^-1)_ii [1/s], and stiffness alone the frequency
    sqrt(Kp (H^-1)_ii) [rad/s].
    """
    for option, gains in (("kp", kp), ("kd", kd)):
        for name, gain in zip(joints, gains, strict=True):
            if not 0 <= gain < np.inf:
                raise InputError(f"{option} of joint {name!r} is {gain:g}; give a finite number, 0 or more")
    data = model.createData()
    for q in configurations:
        try:
            mobility = np.diag(np.linalg.inv(mass_matrix(model, data, q)))[model.nv - len(joints) :]
        except np.linalg.LinAlgError:
            mobility = np.full(len(joints), np.nan)
        if not np.all(np.isfinite(mobility)):
            raise InputError(
                "the robot's inertia matrix is singular: its links' inertias differ by too many orders of "
                "magnitude; correct the smallest and the largest <inertial>, or give armature"
            )
        rates = np.maximum(kd * mobility, np.sqrt(kp * np.maximum(mobility, 0)))
        worst = int(np.argmax(rates))
        if rates[worst] > MAX_SERVO_RATE:
            inertia = 1 / mobility[worst]
            armature = model.armature[model.nv - len(joints) + worst]
            raise InputError(
                f"servo of joint {joints[worst]!r}: Kp = {kp[worst]:g} N m/rad and Kd = {kd[worst]:g} "
                f"N m s/rad on only {inertia:.2g} kg m2 have a rate of {rates[worst]:.2g} 1/s, and at most "
                f"{MAX_SERVO_RATE:g} is allowed; give the joint its armature (rotor inertia x gear^2, now "
                f"{armature:.2g} kg m2), or lower Kd below {MAX_SERVO_RATE * inertia:.2g} and Kp below "
                f"{MAX_SERVO_RATE**2 * inertia:.2g}"
            )


def check_polygon(name: str, polygon: Array) -> None:
    """InputError unless the corners (k, 2) make a convex polygon, counter-clockwise."""
    if len(polygon) < 3:
        raise InputError(f"sole {name!r}: its polygon has {len(polygon)} corners; give at least 3")
    edges = np.roll(polygon, -1, axis=0) - polygon
    following = np.roll(edges, -1, axis=0)
    turns = edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0]
    if np.all(turns < 0):
        raise InputError(f"sole {name!r}: its corners run clockwise; reverse their order")
    # the exterior angles of a simple polygon add up to one turn, those of a self-intersecting one to more
    angles = np.arctan2(turns, np.sum(edges * following, axis=1))
    if not np.all(turns > 0) or angles.sum() > 3 * np.pi:
        raise InputError(
            f"sole {name!r}: its polygon is not convex, or repeats a corner; give the corners of its hull"
        )


def check_frame(model: pin.Model, frame: str, what: str) -> int:
    """Index of a frame of the model; InputError if there is none."""
    if not model.existFrame(frame):
        names = [str(f.name) for f in model.frames]
        raise InputError(
            f"{what}: the model has no frame {frame!r}{did_you_mean(frame, names)}; "
            "frames are links, joints and sites"
        )
    try:
        return int(model.getFrameId(frame))
    except (ValueError, RuntimeError):  # a link and a joint of the same name
        return int(model.getFrameId(frame, pin.FrameType.BODY))


def columns_above(model: pin.Model, joint: int) -> list[int]:
    """Indices in v of the joints from the root to a joint, each once, without the free-flyer's six. For a
    follower it is its leader's.
    """
    above = (model.joints[j] for j in model.supports[joint] if j)
    return list(dict.fromkeys(int(each.idx_v) for each in above if each.nv <= 1))


def check_legs(model: pin.Model, soles: Sequence[tuple[str, str]]) -> None:
    """InputError with all fixed soles, (name, frame) each, without a leg of their own.

    The last six joints before a sole are its leg. They fix the sole's six degrees of freedom, so none of them
    may move another fixed sole.
    """
    found, chains = Mistakes(), []
    names = {
        int(joint.idx_v): str(name) for name, joint in zip(model.names, model.joints, strict=True) if joint.nv
    }
    for name, frame in soles:
        parent = model.frames[check_frame(model, frame, f"sole {name!r}")].parentJoint
        chains.append([names[k] for k in columns_above(model, parent)])
    for k, ((name, frame), joints) in enumerate(zip(soles, chains, strict=True)):
        others = {joint for other in chains[:k] + chains[k + 1 :] for joint in other}
        leg = joints[-LEG:]
        listed = f": {', '.join(joints)}" if joints else ""
        if len(joints) == LEG - 1 and not others & set(leg):
            found.found.append(
                f"the leg of sole {name!r} has {len(joints)} joints between the base and {frame!r}{listed}, "
                f"and a fixed sole has {LEG} constraints: give the axis about which the foot may turn on the "
                'ground, such as hinge = "x", its long axis, if the leg lacks an ankle roll'
            )
        elif len(joints) < LEG:
            found.found.append(
                f"the leg of sole {name!r} has {len(joints)} joints between the base and {frame!r}{listed}; "
                f"a fixed sole needs {LEG} or more, or {LEG - 1} and a hinge"
            )
        elif others & set(leg):
            shared = ", ".join(joint for joint in leg if joint in others)
            found.found.append(
                f"the fixed soles' legs share joints: of the last {LEG} before sole {name!r}, {shared} also "
                f"move another fixed sole; each leg needs {LEG} of its own"
            )
    found.raise_if_any("the stance")


def check_arms(robot: Any, soles: Sequence[str], hands: Sequence[tuple[str, str]]) -> None:
    """InputError with all supporting hands, (name, frame) each, without an arm of their own.

    The last six joints before a hand are its arm. None of them may move a fixed sole, by its frame, or
    another supporting hand.
    """
    found = Mistakes()
    chains = {frame: robot.limb(frame) for frame in (*soles, *(frame for _, frame in hands))}
    for name, frame in hands:
        arm = chains[frame][-LEG:]
        listed = ", ".join(robot.joint_names[j] for j in arm)
        others = {j for other, chain in chains.items() if other != frame for j in chain}
        shared = ", ".join(robot.joint_names[j] for j in arm if j in others)
        if len(arm) < LEG:
            found.found.append(
                f"hand {name!r} cannot be fixed in all six directions: it has "
                f"{counted(len(arm), 'joint')} from the base on{': ' if listed else ''}{listed}; "
                f"give a hand with {LEG} or more"
            )
        elif shared:
            found.found.append(
                f"hand {name!r} cannot be fixed: of the last {LEG} joints before it, {shared} also move a "
                "fixed sole or another supporting hand; give a hand on an arm of its own"
            )
        elif np.any(robot.sprung[list(arm)]):
            found.found.append(f"hand {name!r} cannot be fixed by a soft grip: give the hand, not its tool")
    found.raise_if_any("the stance")


def check_configuration(model: pin.Model, q: ArrayLike, name: str) -> Array:
    """`q` as a float64 copy (nq,); InputError unless it is a configuration of the model."""
    q = check_array(name, q, (model.nq,))
    for i, part in unit_parts(model):
        if not abs((length := np.linalg.norm(q[part])) - 1) <= UNIT_TOLERANCE:
            kind = "quaternion (x, y, z, w)" if model.joints[i].nq == 7 else "(cosine, sine)"
            raise InputError(
                f"{name}: the {kind} of joint {model.names[i]!r} has norm {length:.6g}; "
                "normalize it (pin.normalize(model, q))"
            )
    return q


POSITION_SLACK = 1e-9  # [rad], [m] of rounding beyond a range
UNIT_TOLERANCE = 1e-6  # of the length of a part of a configuration that should be one


def unit_parts(model: pin.Model) -> list[tuple[int, slice]]:
    """Parts of q whose length is one: quaternion of a free-flyer, cosine and sine of a continuous joint.

    Each has the index of its joint, and its slice in q.
    """
    joints = ((i, model.joints[i]) for i in range(1, model.njoints))
    return [
        (i, slice(joint.idx_q + (3 if joint.nq == 7 else 0), joint.idx_q + joint.nq))
        for i, joint in joints
        if joint.nq > max(joint.nv, 1)
    ]


def check_positions(joints: Sequence[str], angles: Array, lower: Array, upper: Array, name: str) -> None:
    """InputError with the joints outside their position limits."""
    outside = [
        f"{joint!r} at {x:.4g} (limits {low:.4g} to {high:.4g})"
        for joint, x, low, high in zip(joints, angles, lower, upper, strict=True)
        if not low - POSITION_SLACK <= x <= high + POSITION_SLACK
    ]
    if outside:
        raise InputError(f"{name}: outside its position limits [rad]: {', '.join(outside)}; move it inside")


def check_stance(
    model: pin.Model, q: Array, soles: Sequence[tuple[str, str]], height: float, tilt: float
) -> None:
    """InputError unless the soles, (name, frame) each, lie flat at z = 0 within height [m] and tilt [rad]."""
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    for name, frame in soles:
        pose = data.oMf[check_frame(model, frame, f"sole {name!r}")]
        z = float(pose.translation[2])
        normal = pose.rotation[:, 2]
        angle = float(np.arctan2(np.linalg.norm(normal[:2]), normal[2]))
        if angle > tilt:
            raise InputError(
                f"sole {name!r} is tilted by {angle:.4g} rad (at most {tilt:g}): not flat on the ground; "
                "turn its ankle until the sole is level"
            )
        if abs(z) > height:
            side = "above" if z > 0 else "below"
            raise InputError(
                f"sole {name!r} is {1e3 * abs(z):.3g} mm {side} the ground (at most {1e3 * height:g} mm): "
                "move its leg's joints; if all soles are off by the same height, use Robot.place"
            )


GIVEN, REPAIRED = "given", "repaired"
INERTIAS = (GIVEN, REPAIRED)
# Principal moments of a body obey the triangle inequality: each is at most the sum of the other two. Relative
# tolerance, for the rounded decimals of files.
TRIANGLE_TOLERANCE = 1e-3
MIN_THICKNESS = 0.01  # [m] of a repaired body, along each principal axis
BALL_DENSITY = 2000.0  # [kg/m3] of the ball that replaces a point mass: motors, gears and housing
MIN_EXTENT = 10.0  # [m] of a robot, when the largest inertia that one of its links can have is estimated
_FIX = f'correct its <inertial>, with moments about the centre of mass, or take inertias="{REPAIRED}"'


def _is_between_joints(model: pin.Model, i: int) -> bool:
    """True if joint i moves a body only through its one child joint, as one of several joints of a body."""
    weightless = not model.inertias[i].mass and not np.any(np.array(model.inertias[i].inertia))
    return weightless and model.joints[i].nv <= 1 and list(model.parents)[1:].count(i) == 1


def check_inertias(model: pin.Model) -> None:
    """InputError with all moving bodies whose mass or inertia is not physical."""
    found, largest = Mistakes(), _largest_inertia(model)
    for i in range(1, model.njoints):
        if not _is_between_joints(model, i):
            found.found += _inertia_mistake(model, i, largest)
    found.raise_if_any(f"the robot {model.name!r}")


def _largest_inertia(model: pin.Model) -> float:
    """Moment of inertia [kg m2] that no link exceeds: that of all moving mass, as far away as joints and
    centres of mass in one line, or `MIN_EXTENT`. Moments in g mm2 or kg mm2 are larger.
    """
    bodies, places = list(model.inertias)[1:], list(model.jointPlacements)[1:]
    steps = [*(body.lever for body in bodies), *(place.translation for place in places)]
    extent = max(sum(float(np.linalg.norm(step)) for step in steps), MIN_EXTENT)
    return sum(float(body.mass) for body in bodies) * extent**2


def _inertia_mistake(model: pin.Model, i: int, largest: float) -> Iterator[str]:
    """Message about the first physically impossible property of the body of joint i, if there is one.

    largest : of `_largest_inertia`.
    """
    body = model.inertias[i]
    root = model.joints[i].nq == 7  # a free-flyer, which has no joint in the file
    link = _root(model) if root else f"the link moved by joint {model.names[i]!r}"
    where = f"{link} (with what is fixed to it)"
    inertia, placed = np.array(body.inertia), model.jointPlacements[i].translation
    if not 0 < body.mass <= HEAVIEST:
        bolt = ", or bolt the robot to the ground (floating = false)" if root else ""
        yield f"{where} has mass {body.mass:g} kg; give its <inertial> one > 0 and <= {HEAVIEST:g}{bolt}"
    elif not (np.isfinite(inertia).all() and np.isfinite(body.lever).all()):
        yield f"{where} has NaN or infinity in its <inertial>; give finite numbers"
    elif not (np.abs(inertia).max() <= HEAVIEST and max(np.abs(body.lever)) <= FARTHEST):
        yield (
            f"{where} has more than {HEAVIEST:g} kg m2, or its centre of mass more than {FARTHEST:g} m "
            "from its joint; correct its <inertial>"
        )
    elif not max(np.abs(placed)) <= FARTHEST:
        yield (
            f"joint {model.names[i]!r} is {max(np.abs(placed)):g} m from its parent joint, and at most "
            f"{FARTHEST:g} m is allowed; correct its <origin>"
        )
    else:
        small, middle, large = np.linalg.eigvalsh(inertia)
        moments = f"{small:.3g}, {middle:.3g}, {large:.3g} kg m2"
        if small <= 0:
            yield f"{where} has principal moments of inertia {moments}: not positive definite; {_FIX}"
        elif small + middle < large * (1 - TRIANGLE_TOLERANCE):
            yield (
                f"{where} has principal moments of inertia {moments}: one exceeds the sum of the others, "
                f"which no body has; {_FIX}"
            )
        elif large > largest:
            yield (
                f"{where} has principal moments of inertia {moments}, more than all of the robot's mass can "
                f"have: are they in g mm2 or kg mm2? {_FIX[0].upper()}{_FIX[1:]}"
            )


def _root(model: pin.Model) -> str:
    """The root link in words."""
    links = (f for f in model.frames if f.parentJoint == 1 and f.type == pin.FrameType.BODY)
    link = next(links, None)
    return f"the root link {link.name!r}" if link is not None else "the root link"


def repair_inertias(model: pin.Model) -> list[str]:
    """Change inertias that no body of this mass can have, in place; messages about the changes.

    Mass and centre of mass stay. The second moments of mass along the principal axes are raised to those of a
    slab 1 cm thick. If all three are smaller than that, or a moment is larger than all of the robot's mass
    can have, the body becomes a ball of 2000 kg/m3. Other physical inertias are not changed.
    """
    messages, largest = [], _largest_inertia(model)
    for i in range(1, model.njoints):
        body = model.inertias[i]
        if not (0 < body.mass <= HEAVIEST and np.isfinite(np.array(body.inertia)).all()):
            continue  # without a mass nothing can be repaired: `check_inertias` refuses it
        moments, second, axes = principal_moments(body.inertia)
        least = body.mass * MIN_THICKNESS**2 / 12
        ball = bool((second < least).all()) or moments[2] > largest
        if not ball and moments[0] > 0 and moments[0] + moments[1] >= moments[2] * (1 - TRIANGLE_TOLERANCE):
            continue
        if ball:
            radius_squared = (3 * body.mass / (4 * np.pi * BALL_DENSITY)) ** (2 / 3)
            second = np.full(3, body.mass / 5 * radius_squared)
        second = np.maximum(second, least)
        new = second.sum() - second
        model.inertias[i] = pin.Inertia(
            body.mass, np.array(body.lever), axes @ np.diag(new) @ axes.T if not ball else np.diag(new)
        )
        how = f"a ball of {BALL_DENSITY:g} kg/m3" if ball else "the nearest that a body can have"
        messages.append(
            f"the link moved by joint {model.names[i]!r}, {body.mass:.3g} kg: {_three(moments)} became "
            f"{_three(np.sort(new))} kg m2, {how}"
        )
    return messages


def _three(numbers: Any) -> str:
    return ", ".join(f"{x:.3g}" for x in numbers)
