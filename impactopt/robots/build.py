"""Functions that make a `pin.Model` and arrays by joint, for the constructors of `Robot`."""

from __future__ import annotations

import contextlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Iterable, Mapping, Sequence
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from impactopt.arrays import Array, Mask
from impactopt.codegen.files import is_plain_file
from impactopt.errors import InputError, check_array, check_choice, named_table, raw_array, shortened
from impactopt.robots.actuators import Actuator
from impactopt.robots.attachments import Striker
from impactopt.robots.checks import HEAVIEST, check_configuration, check_frame, reduced, tell_apart
from impactopt.robots.model import JointAngles

MAX_ATTACHMENTS = 100  # soles, strikers or tools of a robot; more are a mistake


def locked_angles(locked: Iterable[str] | Mapping[str, float]) -> dict[str, float]:
    """Angles [rad] of locked joints by name, 0 for bare names."""
    if isinstance(locked, str):
        raise InputError(
            f"locked: give a list of joint names or a mapping to angles, not the text {locked!r}"
        )
    locked = named_table(locked)
    return dict(locked) if isinstance(locked, Mapping) else dict.fromkeys(locked, 0.0)


def lock_joints(model: pin.Model, locked: Iterable[str] | Mapping[str, float]) -> pin.Model:
    """The model without the locked joints, which stay at the given angles [rad] (0 for bare names)."""
    angles = locked_angles(locked)
    if not angles:
        model = model.copy()
        tell_apart(model)
        return model
    names = joint_names(model)
    for name in angles:
        joint_index(names, name, "locked")
    q = set_joints(model, pin.neutral(model), angles, "locked")
    return reduced(model, [model.getJointId(name) for name in angles], q)


def is_floating(model: pin.Model) -> bool:
    return bool(model.njoints > 1 and model.joints[1].shortname() == "JointModelFreeFlyer")


def joint_indices(model: pin.Model) -> list[int]:
    """Indices of the joints in the order of v, without the free-flyer and followers (which share the
    coordinates of their leaders).
    """
    return [joint.id for joint in moving_joints(model)]


def joint_names(model: pin.Model) -> tuple[str, ...]:
    """Names of the joints of `joint_indices`."""
    return tuple(str(model.names[j]) for j in joint_indices(model))


def prismatic(model: pin.Model) -> Mask:
    """Mask of the prismatic joints among those of `joint_indices`."""
    return np.array(["JointModelP" in joint.shortname() for joint in moving_joints(model)], dtype=bool)


def joint_index(names: Sequence[str], name: str, what: str) -> int:
    check_choice(f"{what}: no joint", name, names)
    return list(names).index(name)


def parent_body(model: pin.Model, joint: int) -> int:
    """Joint that moves the parent body of a joint's body; 0 for the ground.

    It is not always the parent joint, since several joints may move one body: those but the last have no
    mass.
    """
    above = int(model.parents[joint])
    while above and not model.inertias[above].mass:
        above = int(model.parents[above])
    return above


def joints_to(model: pin.Model, frames: Iterable[str]) -> set[int]:
    """Joints that move any of these frames, and 0, the world."""
    joints = (model.frames[model.getFrameId(name)].parentJoint for name in frames)
    return {int(j) for joint in joints for j in model.supports[joint]}


def per_joint(
    what: str, value: float | Mapping[str, float] | ArrayLike | None, joints: Sequence[str], default: Array
) -> Array:
    """(n,) numbers: `default`, with those of a mapping by joint in their places, or one number for all, or
    the array given.
    """
    result = np.array(default, dtype=np.float64)
    if value is None:
        return result
    if isinstance(value := named_table(value), Mapping):
        for name, number in value.items():
            result[joint_index(joints, name, what)] = check_array(f"{what} of joint {name!r}", number, ())
        return result
    if raw_array(what, value).ndim == 0:
        result[:] = check_array(what, value, ())
        return result
    return check_array(what, value, (len(joints),))


def armature(
    model: pin.Model,
    joints: Sequence[str],
    value: float | Mapping[str, float] | ArrayLike | None,
    rotor: Mapping[str, tuple[float, float]],
) -> Array:
    """(n,) reflected rotor inertias [kg m2]: of `value`, else of `rotor`, else of the model."""
    reflected = {}
    for name, pair in rotor.items():
        inertia, gear = check_array(f"rotor of joint {name!r} (inertia [kg m2], gear ratio)", pair, (2,))
        reflected[name] = inertia * gear**2
    own = np.array(model.armature[model.nv - len(joints) :], dtype=np.float64)
    result = per_joint("armature", value, joints, per_joint("rotor", reflected, joints, own))
    for name, number in zip(joints, result, strict=True):
        if not 0 <= number <= HEAVIEST:
            raise InputError(
                f"armature of joint {name!r} is {number:g} kg m2; give rotor inertia x gear^2, "
                f"0 to {HEAVIEST:g}"
            )
    return result


def effort_limit(model: pin.Model) -> Array:
    """(nv,) largest torques [N m]; the attribute was renamed in Pinocchio 4."""
    return np.array(model.upperEffortLimit if hasattr(model, "upperEffortLimit") else model.effortLimit)


def friction(model: pin.Model) -> tuple[Array, Array]:
    """(nv,) viscous [N m s/rad] and dry friction [N m] of joints; the latter was renamed in Pinocchio 4."""
    dry = model.upperDryFrictionLimit if hasattr(model, "upperDryFrictionLimit") else model.friction
    return np.array(model.damping), np.array(dry)


def set_friction(model: pin.Model, viscous: Array, dry: Array) -> None:
    """Set the friction (nv,) of a model in place."""
    model.damping = viscous
    if hasattr(model, "upperDryFrictionLimit"):
        model.upperDryFrictionLimit, model.lowerDryFrictionLimit = dry, -dry
    else:
        model.friction = dry


def frictions(model: pin.Model, joints: Sequence[str]) -> tuple[Actuator, ...]:
    """One actuator per joint, with the model's friction and nothing else."""
    out = []
    for name, viscous, dry in zip(
        joints, *(x[model.nv - len(joints) :] for x in friction(model)), strict=True
    ):
        try:
            out.append(Actuator(viscous_friction=viscous, coulomb_friction=dry))
        except InputError as error:
            raise InputError(f"joint {name!r}: damping {viscous:g}, friction {dry:g}: {error}") from error
    return tuple(out)


def velocity_limit(model: pin.Model) -> Array:
    """(nv,) largest velocities [rad/s]; the attribute was renamed in Pinocchio 4."""
    return np.array(model.upperVelocityLimit if hasattr(model, "upperVelocityLimit") else model.velocityLimit)


def set_velocity_limit(model: pin.Model, limit: Array) -> None:
    """Set the largest velocities (nv,) [rad/s] of a model in place."""
    if hasattr(model, "upperVelocityLimit"):
        model.upperVelocityLimit, model.lowerVelocityLimit = limit, -limit
    else:
        model.velocityLimit = limit


def position_limit(
    model: pin.Model, joints: Sequence[str], value: Mapping[str, tuple[float, float]] | ArrayLike | None
) -> tuple[Array, Array]:
    """(n,) lower and upper joint positions [rad]; infinite for continuous joints unless given."""
    # for a continuous joint Pinocchio has bounds of its cosine and sine, +-1.01, which are none of the angle
    limits = np.array(
        [
            (-np.inf, np.inf)
            if joint.nq == 2
            else (model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q])
            for joint in moving_joints(model)
        ]
    ).reshape(-1, 2)
    if isinstance(value := named_table(value), Mapping):
        for name, pair in value.items():
            limits[joint_index(joints, name, "position_limit")] = check_array(
                f"position_limit of joint {name!r} (lower, upper)", pair, (2,), finite=False
            )
    elif value is not None:
        limits = check_array("position_limit", value, (len(joints), 2), finite=False)
    return limits[:, 0].copy(), limits[:, 1].copy()


def add_frame(model: pin.Model, name: str, parent: str, placement: Any, what: str) -> None:
    """Add an OP_FRAME at `placement` (pin.SE3) in the frame `parent`."""
    if model.existFrame(name):
        raise InputError(
            f"{what}: the model has a frame {name!r} already; choose another name, or leave out the parent"
        )
    above = check_frame(model, parent, what)
    joint = model.frames[above].parentJoint
    at = model.frames[above].placement * placement
    model.addFrame(pin.Frame(name, joint, above, at, pin.FrameType.OP_FRAME))


def add_striker(model: pin.Model, striker: Striker) -> None:
    """Add the striker's frame, or move the existing one."""
    placement = pin.SE3(np.eye(3), striker.point)
    if not model.existFrame(striker.model_frame):
        add_frame(model, striker.model_frame, striker.frame, placement, f"striker {striker.name!r}")
        return
    above = model.frames[check_frame(model, striker.frame, f"striker {striker.name!r}")]
    frame = model.frames[model.getFrameId(striker.model_frame)]
    frame.parentJoint, frame.placement = above.parentJoint, above.placement * placement
    frame.parentFrame = model.getFrameId(striker.frame)


def link_pairs(model: pin.Model, pairs: Sequence[tuple[str, str]]) -> tuple[tuple[str, str], ...]:
    """Pairs of link names, checked; InputError for anything else."""
    for pair in pairs:
        if len(pair) != 2 or any(not isinstance(name, str) for name in pair):
            raise InputError(f"disable_collisions: {pair!r} is no pair of links' names")
        for name in pair:
            check_frame(model, name, "disable_collisions")
    return tuple((one, other) for one, other in pairs)


def srdf_pairs(srdf: str | PathLike[str] | None) -> list[tuple[str, str]]:
    """Pairs of links that an SRDF excludes from collisions, without those of the reason "Never".

    An assistant finds the latter by random samples, so a plan could collide there all the same, and checking
    them costs little.
    """
    if srdf is None:
        return []
    try:
        root = ElementTree.parse(fspath(srdf)).getroot()
    except (OSError, ElementTree.ParseError):
        return []
    excluded = (e for e in root.findall("disable_collisions") if e.get("reason") != "Never")
    return [(e.get("link1", ""), e.get("link2", "")) for e in excluded]


ROOT = "root of the MJCF"  # reference configuration with the root's orientation only; no posture


def neutral(model: pin.Model) -> Array:
    """(nq,) with all joints at zero, and the root at the roll and pitch of its MJCF, at yaw 0."""
    q = pin.neutral(model)
    for entry in model.referenceConfigurations:
        if entry.key() == ROOT:
            roll, pitch, _ = pin.rpy.matrixToRpy(
                pin.Quaternion(*np.array(entry.data())[[6, 3, 4, 5]]).matrix()
            )
            q[3:7] = pin.Quaternion(pin.rpy.rpyToMatrix(roll, pitch, 0.0)).coeffs()
    return q


def set_joints(model: pin.Model, q: Array, angles: Mapping[str, float], what: str) -> Array:
    """A copy of the configuration with some joint angles set by name."""
    names, joints = joint_names(model), moving_joints(model)
    own = [joints[joint_index(names, name, what)] for name in angles]
    values = [float(check_array(f"{what}: joint {name!r}", angle, ())) for name, angle in angles.items()]
    return JointAngles(own).put(np.array(q, dtype=np.float64), values)


def reference_configurations(model: pin.Model) -> dict[str, Array]:
    """The model's own named configurations (an SRDF's), with normalized quaternions."""
    return {
        str(entry.key()): pin.normalize(model, np.array(entry.data(), dtype=np.float64))
        for entry in model.referenceConfigurations
        if entry.key() != ROOT
    }


def lowest(model: pin.Model, q: Array, frames: Sequence[str], *, within: float = 0.01) -> list[str]:
    """Frames at most `within` [m] higher than the lowest one."""
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    heights = [float(data.oMf[check_frame(model, frame, "place")].translation[2]) for frame in frames]
    return [frame for frame, z in zip(frames, heights, strict=True) if z <= min(heights) + within]


def place(model: pin.Model, q: Array, frames: Sequence[str]) -> Array:
    """The configuration with the free-flyer moved so that the mean of some frames is at the origin, and their
    mean direction at yaw 0.
    """
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    poses = [data.oMf[check_frame(model, frame, "place")] for frame in frames]
    forward = sum(pose.rotation[:2, 0] for pose in poses)
    yaw = np.arctan2(forward[1], forward[0])
    mean = np.mean([pose.translation for pose in poses], axis=0)
    turn = pin.SE3(pin.utils.rotate("z", -yaw), np.zeros(3))
    q = q.copy()
    q[:7] = pin.SE3ToXYZQUAT(turn * pin.SE3(np.eye(3), -mean) * pin.XYZQUATToSE3(q[:7]))
    return q


def check_count(kind: str, things: Collection[Any]) -> None:
    """InputError if a robot has more than `MAX_ATTACHMENTS` of a kind."""
    if len(things) > MAX_ATTACHMENTS:
        raise InputError(f"the robot has {len(things)} {kind}s; give at most {MAX_ATTACHMENTS}")


def check_parts(name: str, things: Any, kind: type) -> None:
    """InputError unless an argument is a list of parts of a class, such as soles, and not of too many."""
    if not isinstance(things, Collection) or not all(isinstance(thing, kind) for thing in things):
        raise InputError(f"{name} must be a list of {kind.__name__}s, not {shortened(repr(things))}")
    check_count(kind.__name__.lower(), things)


def by_name(kind: str, things: Sequence[Any]) -> dict[str, Any]:
    """Dictionary of things by their names; InputError if two have the same."""
    named = {thing.name: thing for thing in things}
    if len(named) != len(things):
        raise InputError(f"two {kind}s have the same name in {[thing.name for thing in things]}; rename one")
    return named


def pick(kind: str, name: str, options: Mapping[str, Any], robot: str) -> Any:
    """The thing of that name; InputError, with the known names, if there is none."""
    check_choice(f"robot {robot!r} has no {kind}", name, options)
    return options[name]


def moving_joints(model: pin.Model) -> list[Any]:
    """Pinocchio's joint models of `joint_indices`."""
    return [joint for joint in list(model.joints)[2 if is_floating(model) else 1 :] if joint.nv]


def existing(path: str | PathLike[str], kind: str) -> str:
    """The path of a file; InputError if there is none."""
    file = Path(fspath(path))
    with contextlib.suppress(RuntimeError):  # "~name" of a user that does not exist
        file = file.expanduser()
    if not is_plain_file(file):
        raise InputError(f"{kind} {shortened(str(file), 300)}: no such file")
    return str(file)


def read_postures(model: pin.Model, given: Mapping[str, Mapping[str, float] | ArrayLike]) -> dict[str, Array]:
    """The model's own postures, and those given: configurations (nq,), or angles of some joints by name."""
    found = reference_configurations(model)
    postures = dict(found)
    for name, value in given.items():
        what = f"posture {name!r}"
        if isinstance(value := named_table(value), Mapping):
            postures[name] = set_joints(model, found.get(name, neutral(model)), value, what)
        else:
            postures[name] = check_configuration(model, value, what)
    return postures


def default_kd(torque_limit: Array) -> Array:
    """Default servo damping (n,) [N m s/rad]."""
    return np.asarray(1.5 * np.minimum(100.0, torque_limit))


def default_kp(kd: Array) -> Array:
    """Default servo stiffness (n,) [N m/rad] for a damping (n,)."""
    return np.asarray(30.0 * kd)
