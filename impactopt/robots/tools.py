"""Joints that a robot's file does not have: hinges of soles that may turn, tools held firmly or softly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.errors import InputError
from impactopt.robots import build, checks
from impactopt.robots.actuators import Actuator
from impactopt.robots.attachments import SoftGrip, Sole, Tool
from impactopt.robots.checks import check_frame

__all__ = [
    "check_held",
    "check_sole",
    "grip_limits",
    "hinged",
    "holding",
    "holding_softly",
    "hung",
    "inside",
    "let_go",
    "mapped",
    "with_hinges",
    "with_tool",
    "without",
]

Array = NDArray[np.float64]


def hung(
    model: pin.Model, frame: str, placement: Any, joint: tuple[str, float, float, float], mark: str, body: Any
) -> pin.Model:
    """The model with one more joint, that turns about z of `placement` (pin.SE3) in a frame.

    Joints are in depth-first order, as Pinocchio has to have them.

    joint : its name, largest torque [N m] and speed [rad/s], and reach [rad] to both sides.  mark : name of a
    frame that moves with it, and is where `frame` is at zero.  body : pin.Inertia that moves so, in `mark`.
    """
    name, torque, speed, reach = joint
    one, back = pin.Model(), placement.inverse()
    bounds = [np.array([x]) for x in (torque, speed, -reach, reach)]
    index = one.addJoint(0, pin.JointModelRZ(), pin.SE3.Identity(), name, *bounds)
    one.appendBodyToJoint(index, body, back)
    one.addFrame(pin.Frame(mark, index, 0, back, pin.FrameType.BODY))
    one.gravity = model.gravity
    whole = pin.appendModel(model, one, check_frame(model, frame, name), placement)
    whole.name = model.name
    for old_name, old in zip(list(model.names)[1:], list(model.joints)[1:], strict=True):  # it leaves them
        at = whole.joints[whole.getJointId(old_name)].idx_v
        whole.armature[at : at + old.nv] = model.armature[old.idx_v : old.idx_v + old.nv]
    return whole


def mapped(old: pin.Model, new: pin.Model, q: Array) -> Array:
    """A configuration of a model with fewer joints: the others are at zero."""
    out = pin.neutral(new)
    for name, joint in zip(list(old.names)[1:], list(old.joints)[1:], strict=True):
        at = new.joints[new.getJointId(name)].idx_q
        out[at : at + joint.nq] = q[joint.idx_q : joint.idx_q + joint.nq]
    return out


SHARE = 0.5  # of the foot's mass that goes with the sole
SPEED = 20.0  # [rad/s]: no bound of a strike
SINGULAR = 1e-3  # a leg's Jacobian's least singular value [m], at least
LEVER = 0.1  # [m] by which the weight makes the torque that numbers of a hinge are reported in


def hinged(model: pin.Model, soles: Sequence[Sole]) -> pin.Model:
    """The model with a joint for each sole that has a hinge, which then moves the sole's frame.

    Soles and hinge turn about the frame's origin. The sole takes half of its link's mass with it, spread as
    the link's is.
    """
    torque = hinge_torque(model)
    for sole in soles:
        if sole.hinge is None:
            continue
        if sole.hinge_joint in build.joint_names(model):
            raise InputError(
                f"sole {sole.name!r}: the robot has a joint {sole.hinge_joint!r} already; rename the sole"
            )
        at = check_frame(model, sole.frame, f"sole {sole.name!r}")
        foot, place = int(model.frames[at].parentJoint), model.frames[at].placement
        if foot == 0:
            raise InputError(
                f"sole {sole.name!r}: no joint moves its frame {sole.frame!r}, so leave out the hinge"
            )
        place, whole = pin.SE3(place), pin.Inertia(model.inertias[foot])  # they outlive their model
        model = model.copy()
        model.inertias[foot] = _part(whole, 1 - SHARE)
        turn, mark = pin.SE3(_to_axis("xyz".index(sole.hinge)), np.zeros(3)), f"sole:{sole.name}"
        joint, body = (sole.hinge_joint, torque, SPEED, sole.hinge_range), place.actInv(_part(whole, SHARE))
        model = hung(model, sole.frame, turn, joint, mark, body)
        moved, its = model.frames[model.getFrameId(sole.frame)], model.getFrameId(mark)
        moved.parentJoint, moved.placement = model.frames[its].parentJoint, model.frames[its].placement
        moved.parentFrame = its
    return model


def with_hinges(
    model: pin.Model, soles: Sequence[Sole], numbers: dict[str, Any], postures: dict[str, Array]
) -> tuple[pin.Model, dict[str, Any], dict[str, Array]]:
    """Model with hinges (`hinged`), and numbers by joint, drives and postures of all joints."""
    whole, torque = hinged(model, soles), hinge_torque(model)
    known: dict[str, dict[str, Any]] = {}
    for sole in soles:
        own: dict[str, Any] = {"kp": 0.0, "kd": 0.0, "torque_limit": torque, "velocity_limit": SPEED}
        own |= {"lower": -sole.hinge_range, "upper": sole.hinge_range, "actuators": Actuator()}
        known[sole.hinge_joint] = own
    for k, joint in enumerate(build.joint_names(model)):
        known[joint] = {key: values[k] for key, values in numbers.items()}
    numbers = {key: [known[joint][key] for joint in build.joint_names(whole)] for key in numbers}
    return whole, numbers, {name: mapped(model, whole, q) for name, q in postures.items()}


def check_sole(model: pin.Model, sole: Sole) -> None:
    """InputError for a sole whose frame or hinge the model has not."""
    check_frame(model, sole.frame, f"sole {sole.name!r}")
    if sole.hinge is not None and sole.hinge_joint not in build.joint_names(model):
        raise InputError(
            f"sole {sole.name!r} has a hinge, and the model no joint for it: give the sole to "
            "Robot.from_urdf, from_mjcf or from_model, which make one"
        )


def check_held(model: pin.Model, sole: Sole, q: Array, columns: Any) -> None:
    """InputError where the joints of these columns of v, the sole's hinge among them, cannot hold it at q."""
    frame = model.getFrameId(sole.frame)
    jac = pin.computeFrameJacobian(model, model.createData(), q, frame, pin.LOCAL)[:, columns]
    if sole.hinge is not None and np.linalg.svd(jac, compute_uv=False)[-1] < SINGULAR:
        raise InputError(
            f"sole {sole.name!r} cannot be held: its hinge about {sole.hinge} turns as joints of its leg do; "
            "give the axis that they lack, or a posture with bent knees"
        )


def inside(robot: Any, margin: float) -> tuple[Array, Array]:
    """(n + tendons,) lower and upper limits [rad] of a `Robot`'s `ranges`, less a margin; of hinges and
    tendons, whose range may be small, less a quarter of it at most.
    """
    own = robot.ranges
    small = np.append(robot.hinges, np.ones(len(robot.tendons), dtype=bool))
    less = np.where(small, np.minimum(margin, (own.upper - own.lower) / 8), margin)
    return own.lower + less, own.upper - less


def hinge_torque(model: pin.Model) -> float:
    """Torque [N m] in which those of hinges are reported: the weight at a lever."""
    return LEVER * 9.81 * float(sum(body.mass for body in model.inertias))


def _part(body: Any, share: float) -> Any:
    return pin.Inertia(share * body.mass, body.lever, share * np.array(body.inertia))


def _to_axis(k: int) -> Array:
    """The rotation (3, 3) whose z is the k-th axis."""
    return np.roll(np.eye(3), k - 2, axis=0) if k < 2 else np.eye(3)


GRIP_SPEED = 60.0  # [rad/s] of a tool in a soft grip; no bound of a blow


def holding(robot: Any, tool: Tool) -> dict[str, Any]:
    """Fields of a `Robot` that change when it takes a tool."""
    if tool.name in robot.strikers:
        raise InputError(f"robot {robot.name!r} has a striker {tool.name!r} already; rename the tool")
    source = robot.source and replace(robot.source, tools=(*robot.source.tools, tool))
    return {"source": source, "tools": (*robot.tools, tool), **_changes(robot, robot.model, tool)}


def holding_softly(robot: Any, name: str, grip: SoftGrip) -> dict[str, Any]:
    """Fields of a `Robot` that change when its firmly held tool of that name gets a soft grip."""
    tool = build.pick("tool", name, {tool.name: tool for tool in robot.tools}, robot.name)
    if tool.grip is not None:
        raise InputError(f"robot {robot.name!r} holds {name!r} softly already; give it one grip")
    soft = replace(tool, grip=grip)

    def held(tools: tuple[Tool, ...]) -> tuple[Tool, ...]:
        return tuple(soft if t is tool else t for t in tools)

    source = robot.source and replace(robot.source, tools=held(robot.source.tools))
    return {"source": source, "tools": held(robot.tools), **_changes(robot, let_go(robot.model, tool), soft)}


def _changes(robot: Any, free: pin.Model, tool: Tool) -> dict[str, Any]:
    """Its model, made of that without the tool, and strikers; with a soft grip's joint also numbers and
    postures of all joints.
    """
    model = with_tool(free, tool)
    out: dict[str, Any] = {"model": model, "strikers": {**robot.strikers, tool.name: tool.striker}}
    if tool.grip is None:
        return out
    at, (torque, speed) = build.joint_names(model).index(tool.grip_joint), grip_limits(tool.grip)
    own = {
        "kp": tool.grip.stiffness,
        "kd": tool.grip.damping,
        "torque_limit": torque,
        "velocity_limit": speed,
        "lower": -tool.grip.range,
        "upper": tool.grip.range,
    }
    out |= {name: np.insert(getattr(robot, name), at, x) for name, x in own.items()}
    out["actuators"] = (*robot.actuators[:at], Actuator(), *robot.actuators[at:])
    out["postures"] = {name: mapped(robot.model, model, q) for name, q in robot.postures.items()}
    return out


def with_tool(model: pin.Model, tool: Tool) -> pin.Model:
    """The model with the tool's mass on the link that holds it, or on a joint of its soft grip, and with its
    striker's frame.
    """
    frame = model.frames[checks.check_frame(model, tool.frame, f"tool {tool.name!r}")]
    if frame.parentJoint == 0:
        raise InputError(
            f"tool {tool.name!r}: no joint moves the frame {tool.frame!r}; give one of a link that moves"
        )
    body = pin.Inertia(tool.mass, tool.center, tool.inertia)
    if tool.grip is None:
        model = model.copy()
        model.appendBodyToJoint(frame.parentJoint, body, frame.placement)
    else:
        model = _hung(model, tool, body)
    build.add_striker(model, tool.striker)
    return model


def without(whole: Any, part: Any) -> Any:
    """The pin.Inertia that is left of a link when what it holds is taken away."""
    mass = whole.mass - part.mass
    if mass <= 1e-6:
        return pin.Inertia.Zero()
    lever = (whole.mass * whole.lever - part.mass * part.lever) / mass

    def about_origin(body: Any) -> Array:
        c = np.array(body.lever)
        return np.array(body.inertia) + body.mass * (c @ c * np.eye(3) - np.outer(c, c))

    left = about_origin(whole) - about_origin(part)
    left -= mass * (lever @ lever * np.eye(3) - np.outer(lever, lever))
    return pin.Inertia(mass, lever, left)


def let_go(model: pin.Model, tool: Tool) -> pin.Model:
    """The model whose link does not hold a tool that it has held firmly."""
    model = model.copy()
    frame = model.frames[model.getFrameId(tool.frame)]
    body = frame.placement.act(pin.Inertia(tool.mass, tool.center, tool.inertia))
    model.inertias[frame.parentJoint] = without(model.inertias[frame.parentJoint], body)
    return model


def _hung(model: pin.Model, tool: Tool, body: Any) -> pin.Model:
    """The model with one more joint, a soft grip's."""
    grip: Any = tool.grip
    if tool.grip_joint in build.joint_names(model):
        raise InputError(
            f"tool {tool.name!r}: the robot has a joint {tool.grip_joint!r} already; rename the tool"
        )
    joint = (tool.grip_joint, *grip_limits(grip), grip.range)
    return hung(model, tool.frame, grip.placement, joint, tool.own_frame, body)


def grip_limits(grip: SoftGrip) -> tuple[float, float]:
    """Largest torque [N m] of a soft grip, that of its spring and damper at the ends of their ranges; largest
    speed [rad/s].
    """
    return grip.stiffness * grip.range + grip.damping * GRIP_SPEED, GRIP_SPEED
