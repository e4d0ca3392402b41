"""Checks of a robot and its configurations; every failure names the thing and the fix."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from impactopt.errors import FARTHEST, InputError, Mistakes, check_array, did_you_mean
from impactopt.robots.mass_matrix import mass_matrix

__all__ = [
    "GIVEN",
    "HEAVIEST",
    "INERTIAS",
    "LEG",
    "REPAIRED",
    "STRONGEST",
    "check_arms",
    "check_configuration",
    "check_frame",
    "check_inertias",
    "check_legs",
    "columns_above",
    "reduced",
    "repair_inertias",
    "tell_apart",
]

_MARK = "\x00"  # in no name of a file


def tell_apart(model: pin.Model) -> None:
    """Rename frames of joints that have a link's name: `elbow` is the link, `joint elbow` its joint."""
    count = Counter(str(frame.name) for frame in model.frames)
    for frame in model.frames:
        if count[str(frame.name)] > 1 and frame.type in (pin.FrameType.JOINT, pin.FrameType.FIXED_JOINT):
            frame.name = f"joint {frame.name}"


def reduced(model: pin.Model, locked: Sequence[int], q: NDArray[np.float64], *geometry: Any) -> Any:
    """The model without locked joints, held at q (nq,), as of `pin.buildReducedModel`; and a
    pin.GeometryModel where one is given.

    Pinocchio 4.1 looks frames up by joints' names, and fails where a link has the same, or a fixed joint has
    its link's.
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


Array = NDArray[np.float64]

# Fastest servo that makes sense [1/s]: a time constant of 33 us is below a tenth of any servo's sampling
# time. Light wrists without armature reach 1e5.
MAX_SERVO_RATE = 3e4
HEAVIEST = 1e6  # [kg], [kg m2] of a link, a tool, a rotor: a ship
LEG = 6  # joints that hold a sole: as many as it has directions
_LIMITS = ("torque_limit", "velocity_limit", "position_limit")
STRONGEST = 1e15  # [N m], [rad/s] of a joint: a test may ask for no limit


def check_joint_types(model: pin.Model) -> None:
    """InputError unless all joints but a free-flyer at the root have one degree of freedom, or follow one."""
    for i in range(1, model.njoints):
        joint = model.joints[i]
        if joint.nv > 1 and not (i == 1 and joint.shortname() == "JointModelFreeFlyer"):
            raise InputError(
                f"joint {model.names[i]!r} is a {joint.shortname()} with {joint.nv} degrees of freedom; "
                "besides a free-flyer at the root, joints have one: split it into such joints, or lock it"
            )
        if not joint.nv and any(other.idx_v == joint.idx_v and other.nq == 2 for other in model.joints):
            raise InputError(
                f"joint {model.names[i]!r} follows one that turns without end; give both of them position "
                "limits"
            )


def check_joints(joints: Sequence[str], name: str) -> None:
    """InputError if there is no joint to drive."""
    if not joints:
        raise InputError(
            f"robot {name!r} has no joints that move: there is nothing to plan; see its <joint>s"
        )
    for joint in joints:
        if not joint.isprintable():
            raise InputError(f"the name of joint {joint!r} has control characters; take them out")


# how a limit is fixed in a file of that kind
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

    kind : of the file that they are from, "URDF" or "MJCF", "" for none.
    """
    fixes = _FIXES[kind]
    found = Mistakes()
    for name, value, unit, option in (
        *((j, x, "N m", "torque_limit") for j, x in zip(joints, torque, strict=True)),
        *((j, x, "rad/s", "velocity_limit") for j, x in zip(joints, velocity, strict=True)),
    ):
        # Pinocchio writes a missing limit as infinity or the largest double
        if not 0 < value <= STRONGEST:
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
    """InputError unless there is one a joint, none of which has an armature of its own."""
    if len(actuators) != len(joints):
        raise InputError(f"there are {len(actuators)} actuators for {len(joints)} joints; give one a joint")
    for name, actuator in zip(joints, actuators, strict=True):
        if actuator.armature is not None:
            raise InputError(
                f"the actuator of joint {name!r} has an armature of {actuator.armature:g} kg m2, and the "
                "model has one too; give it with Robot.with_actuators, which sets the model's"
            )


def check_springs(model: pin.Model, springs: Iterable[str]) -> None:
    """InputError if a joint, by name, has a spring and no end of its turns."""
    for name in springs:
        if model.joints[model.getJointId(name)].nq > 1:
            raise InputError(
                f"joint {name!r} has a spring and turns without end, so that its angle is not known; give it "
                "position limits in its file, or take the spring out"
            )


def check_gains(
    model: pin.Model, joints: Sequence[str], kp: Array, kd: Array, configurations: Iterable[Array]
) -> None:
    """InputError if a gain is negative, or makes a joint's servo faster than MAX_SERVO_RATE.

    The inertia that joint i's servo feels is least when no other joint resists: 1 / (H^-1)_ii, with armature.
    There a damper alone decays at Kd (H^-1)_ii [1/s], and a spring alone swings at sqrt(Kp (H^-1)_ii)
    [rad/s].
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
                "the robot's inertia matrix is singular: its links' inertias are too far apart for numbers "
                "of 16 digits; correct the smallest and the largest <inertial>, or give armature"
            )
        rates = np.maximum(kd * mobility, np.sqrt(kp * np.maximum(mobility, 0)))
        worst = int(np.argmax(rates))
        if rates[worst] > MAX_SERVO_RATE:
            inertia = 1 / mobility[worst]
            armature = model.armature[model.nv - len(joints) + worst]
            raise InputError(
                f"servo of joint {joints[worst]!r}: Kp = {kp[worst]:g} N m/rad and Kd = {kd[worst]:g} "
                f"N m s/rad on only {inertia:.2g} kg m2 make a rate of {rates[worst]:.2g} 1/s, and "
                f"{MAX_SERVO_RATE:g} is the most; give the joint its armature (rotor inertia x gear^2, now "
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
    # the turning angles of a simple polygon add up to one turn, those of a star to more
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
    """Columns in v, each once, of the joints that move the body of a joint, from the root on; without a
    free-flyer's. A follower's is its leader's.
    """
    above = (model.joints[j] for j in model.supports[joint] if j)
    return list(dict.fromkeys(int(each.idx_v) for each in above if each.nv <= 1))


def check_legs(model: pin.Model, soles: Sequence[tuple[str, str]]) -> None:
    """InputError with all fixed soles, (name, frame) each, that are on no leg of their own: its last six
    joints, which move no other fixed sole.
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
        own = joints[-LEG:]
        told = f": {', '.join(joints)}" if joints else ""
        if len(joints) == LEG - 1 and not others & set(own):
            found.found.append(
                f"the leg of sole {name!r} has {len(joints)} joints between the base and {frame!r}{told}, "
                f"and a sole is held in {LEG} directions: say about which of its axes the foot may turn on "
                'the ground, as by hinge = "x", its long axis, where the leg lacks an ankle roll'
            )
        elif len(joints) < LEG:
            found.found.append(
                f"the leg of sole {name!r} has {len(joints)} joints between the base and {frame!r}{told}; a "
                f"held sole needs {LEG} or more, or {LEG - 1} and a hinge"
            )
        elif others & set(own):
            shared = ", ".join(joint for joint in own if joint in others)
            found.found.append(
                f"the held soles' legs share joints: of the last {LEG} that lead to sole {name!r}, {shared} "
                "move another held sole too; each leg needs as many of its own"
            )
    found.raise_if_any("the stance")


def check_arms(robot: Any, soles: Sequence[str], hands: Sequence[tuple[str, str]]) -> None:
    """InputError with all hands, (name, frame) each, that hold on with no arm of their own: its last six
    joints, which move neither a fixed sole, by its frame, nor another hand.
    """
    found = Mistakes()
    chains = {frame: robot.limb(frame) for frame in (*soles, *(frame for _, frame in hands))}
    for name, frame in hands:
        arm = chains[frame][-LEG:]
        told = ", ".join(robot.joint_names[j] for j in arm)
        others = {j for other, chain in chains.items() if other != frame for j in chain}
        shared = ", ".join(robot.joint_names[j] for j in arm if j in others)
        if len(arm) < LEG:
            found.found.append(
                f"hand {name!r} cannot hold on in all six directions: between the base and it there are "
                f"{len(arm)} joints{': ' if told else ''}{told}; give a hand with {LEG} or more"
            )
        elif shared:
            found.found.append(
                f"hand {name!r} cannot hold on: of the last {LEG} joints that lead to it, {shared} move "
                "something else that is held; give a hand on an arm of its own"
            )
        elif np.any(robot.sprung[list(arm)]):
            found.found.append(f"hand {name!r} cannot hold on by a soft grip: give the hand, not its tool")
    found.raise_if_any("the stance")


def check_configuration(model: pin.Model, q: ArrayLike, name: str) -> Array:
    """`q` as a float64 copy, known to be a configuration of the model."""
    q = check_array(name, q, (model.nq,))
    for i in range(1, model.njoints):
        joint = model.joints[i]
        part = (
            q[joint.idx_q + 3 : joint.idx_q + 7] if joint.nq == 7 else q[joint.idx_q : joint.idx_q + joint.nq]
        )
        if joint.nq > 1 and abs(np.linalg.norm(part) - 1) > 1e-6:
            kind = "quaternion (x, y, z, w)" if joint.nq == 7 else "(cosine, sine)"
            raise InputError(
                f"{name}: the {kind} of joint {model.names[i]!r} has norm {np.linalg.norm(part):.6g}; "
                "normalize it (pin.normalize(model, q))"
            )
    return q


def check_positions(joints: Sequence[str], angles: Array, lower: Array, upper: Array, name: str) -> None:
    """InputError naming the joints outside their position limits."""
    slack = 1e-9
    outside = [
        f"{joint!r} at {x:.4g} (limits {low:.4g} to {high:.4g})"
        for joint, x, low, high in zip(joints, angles, lower, upper, strict=True)
        if not low - slack <= x <= high + slack
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
                "move its leg's joints; if all soles are off by the same, put the robot down with Robot.place"
            )


GIVEN, REPAIRED = "given", "repaired"
INERTIAS = (GIVEN, REPAIRED)
TRIANGLE = 1e-3  # relative, of the triangle inequality: room for rounded decimals
THIN = 0.01  # [m] of the slab that a repaired body has at least the second moments of
DENSITY = 2000.0  # [kg/m3] of the ball that takes the place of a point: motors, gears and housing
_MEND = f'correct its <inertial>, with moments about the centre of mass, or take inertias="{REPAIRED}"'


def _is_between_joints(model: pin.Model, i: int) -> bool:
    """True if joint i moves no body of its own, but the joint after it: both move the same body."""
    weightless = not model.inertias[i].mass and not np.any(np.array(model.inertias[i].inertia))
    return weightless and model.joints[i].nv <= 1 and list(model.parents)[1:].count(i) == 1


def check_inertias(model: pin.Model) -> None:
    """InputError with all moving bodies whose mass or inertia cannot be those of matter."""
    found = Mistakes()
    for i in range(1, model.njoints):
        if not _is_between_joints(model, i):
            found.found += _wrong(model, i)
    found.raise_if_any(f"the robot {model.name!r}")


def _wrong(model: pin.Model, i: int) -> Iterator[str]:
    """First physically impossible property of the body that joint i moves."""
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
            f"joint {model.names[i]!r} is {max(np.abs(placed)):g} m from the one before, and "
            f"{FARTHEST:g} is the most; correct its <origin>"
        )
    else:
        small, middle, large = np.linalg.eigvalsh(inertia)
        moments = f"{small:.3g}, {middle:.3g}, {large:.3g} kg m2"
        if small <= 0:
            yield f"{where} has principal moments of inertia {moments}: not positive definite; {_MEND}"
        elif small + middle < large * (1 - TRIANGLE):
            yield (
                f"{where} has principal moments of inertia {moments}: one exceeds the sum of the others, "
                f"which no body has; {_MEND}"
            )


def _root(model: pin.Model) -> str:
    links = (f for f in model.frames if f.parentJoint == 1 and f.type == pin.FrameType.BODY)
    link = next(links, None)
    return f"the root link {link.name!r}" if link is not None else "the root link"


def repair_inertias(model: pin.Model) -> list[str]:
    """Change inertias that no body of this mass can have, in place, and say in words which.

    Mass and centre of mass stay. Moments come from second moments of mass along the principal axes, which are
    raised to those of a slab 1 cm thick where they are less; where all three are, the body becomes a ball of
    2000 kg/m3. A body that passes both is left alone.
    """
    said = []
    for i in range(1, model.njoints):
        body = model.inertias[i]
        if not (0 < body.mass <= HEAVIEST and np.isfinite(np.array(body.inertia)).all()):
            continue  # there is nothing to go by: it is refused
        moments, axes = np.linalg.eigh(np.array(body.inertia))
        second = moments.sum() / 2 - moments  # of mass, along the axes
        least = body.mass * THIN**2 / 12
        point = bool((second < least).all())
        if not point and moments[0] > 0 and moments[0] + moments[1] >= moments[2] * (1 - TRIANGLE):
            continue
        if point:
            second = np.full(3, body.mass / 5 * (3 * body.mass / (4 * np.pi * DENSITY)) ** (2 / 3))
        second = np.maximum(second, least)
        new = second.sum() - second
        model.inertias[i] = pin.Inertia(
            body.mass, np.array(body.lever), axes @ np.diag(new) @ axes.T if not point else np.diag(new)
        )
        how = f"a ball of {DENSITY:g} kg/m3" if point else "the nearest that a body can have"
        said.append(
            f"the link moved by joint {model.names[i]!r}, {body.mass:.3g} kg: {_three(moments)} became "
            f"{_three(np.sort(new))} kg m2, {how}"
        )
    return said


def _three(numbers: Any) -> str:
    return ", ".join(f"{x:.3g}" for x in numbers)
