"""Changes of a robot's model: joints of hinged soles, and tools in rigid or compliant (soft) grips."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin

from impactopt.arrays import Array
from impactopt.errors import InputError
from impactopt.robots import build, checks
from impactopt.robots.actuators import Actuator
from impactopt.robots.attachments import SoftGrip, Sole, Tool
from impactopt.robots.checks import check_frame


def with_joint(
    model: pin.Model, frame: str, placement: Any, joint: tuple[str, float, float, float], mark: str, body: Any
) -> pin.Model:
    """The model with one more revolute joint, about z of `placement` (pin.SE3) in a frame.

    `pin.appendModel` puts it in its place in depth-first order, which Pinocchio requires.

    joint : its name, largest torque [N m], speed [rad/s] and angle [rad] in both directions.  mark : name of
    a frame that moves with it, and coincides with `frame` at zero.  body : pin.Inertia of the moving body, in
    `mark`.
    """
    name, torque, speed, reach = joint
    one, back = pin.Model(), placement.inverse()
    bounds = [np.array([x]) for x in (torque, speed, -reach, reach)]
    index = one.addJoint(0, pin.JointModelRZ(), pin.SE3.Identity(), name, *bounds)
    one.appendBodyToJoint(index, body, back)
    one.addFrame(pin.Frame(mark, index, 0, back, pin.FrameType.BODY))
    whole = pin.appendModel(model, one, check_frame(model, frame, name), placement)
    # appendModel leaves out gravity and armatures
    whole.name, whole.gravity = model.name, model.gravity
    for old_name, old in zip(list(model.names)[1:], list(model.joints)[1:], strict=True):
        at = whole.joints[whole.getJointId(old_name)].idx_v
        whole.armature[at : at + old.nv] = model.armature[old.idx_v : old.idx_v + old.nv]
    return whole


def extended(old: pin.Model, new: pin.Model, q: Array) -> Array:
    """A configuration of `old` as one of the model `new`, which has more joints; those are at zero."""
    out = pin.neutral(new)
    for name, joint in zip(list(old.names)[1:], list(old.joints)[1:], strict=True):
        at = new.joints[new.getJointId(name)].idx_q
        out[at : at + joint.nq] = q[joint.idx_q : joint.idx_q + joint.nq]
    return out


SOLE_SHARE = 0.5  # of the foot's mass, that is below the hinge
HINGE_SPEED = 20.0  # [rad/s]: a limit that no strike reaches
SINGULAR = 1e-3  # [m] least singular value of a leg's Jacobian, at least
LEVER = 0.1  # [m]: weight x lever is the torque limit of a hinge, which only scales reported numbers


def hinged(model: pin.Model, soles: Sequence[Sole]) -> pin.Model:
    """The model with a joint for each sole that has a hinge, which then moves the sole's frame.

    The hinge is at the frame's origin. Half of the foot's mass and inertia moves with the sole.
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
        # copies: references into the old model would dangle once it is replaced
        place, whole = pin.SE3(place), pin.Inertia(model.inertias[foot])
        model = model.copy()
        model.inertias[foot] = _part(whole, 1 - SOLE_SHARE)
        # a rotation whose z is the hinge's axis
        turn = np.roll(np.eye(3), "xyz".index(sole.hinge) + 1, axis=0)
        axis, mark = pin.SE3(turn, np.zeros(3)), f"sole:{sole.name}"
        joint = (sole.hinge_joint, torque, HINGE_SPEED, sole.hinge_range)
        model = with_joint(model, sole.frame, axis, joint, mark, place.actInv(_part(whole, SOLE_SHARE)))
        # the sole's frame moves with the hinge's joint
        moved, new = model.frames[model.getFrameId(sole.frame)], model.getFrameId(mark)
        moved.parentJoint, moved.placement = model.frames[new].parentJoint, model.frames[new].placement
        moved.parentFrame = new
    return model


def with_hinges(
    model: pin.Model, soles: Sequence[Sole], numbers: dict[str, Any], postures: dict[str, Array]
) -> tuple[pin.Model, dict[str, Any], dict[str, Array]]:
    """The model with hinges (`hinged`), and fields of a `Robot` by joint and postures, extended to them."""
    whole, torque = hinged(model, soles), hinge_torque(model)
    known: dict[str, dict[str, Any]] = {}
    for sole in soles:
        own: dict[str, Any] = {"kp": 0.0, "kd": 0.0, "torque_limit": torque, "velocity_limit": HINGE_SPEED}
        own |= {"lower": -sole.hinge_range, "upper": sole.hinge_range, "actuators": Actuator()}
        known[sole.hinge_joint] = own
    for k, joint in enumerate(build.joint_names(model)):
        known[joint] = {key: values[k] for key, values in numbers.items()}
    numbers = {key: [known[joint][key] for joint in build.joint_names(whole)] for key in numbers}
    return whole, numbers, {name: extended(model, whole, q) for name, q in postures.items()}


def check_sole(model: pin.Model, sole: Sole) -> None:
    """InputError for a sole whose frame or hinge is not in the model."""
    check_frame(model, sole.frame, f"sole {sole.name!r}")
    if sole.hinge is not None and sole.hinge_joint not in build.joint_names(model):
        raise InputError(
            f"sole {sole.name!r} has a hinge, and the model no joint for it: give the sole to "
            "Robot.from_urdf, from_mjcf or from_model, which add one"
        )


def check_held(model: pin.Model, sole: Sole, q: Array, columns: Any) -> None:
    """InputError if a hinged sole's Jacobian is singular at q: leg and hinge cannot fix all its directions.

    columns : indices in v of the leg's joints and the hinge.
    """
    frame = model.getFrameId(sole.frame)
    jac = pin.computeFrameJacobian(model, model.createData(), q, frame, pin.LOCAL)[:, columns]
    if sole.hinge is not None and np.linalg.svd(jac, compute_uv=False)[-1] < SINGULAR:
        raise InputError(
            f"sole {sole.name!r} cannot be fixed: joints of its leg turn it about the axis {sole.hinge} of "
            "its hinge already; give the axis that they lack, or a posture with bent knees"
        )


def inside(robot: Any, margin: float) -> tuple[Array, Array]:
    """Lower and upper limits (n + tendons,) [rad] of a `Robot`'s `ranges`, tightened by a margin [rad].

    Hinges and tendons may have small ranges, so there the margin is at most an eighth of the range.
    """
    own = robot.ranges
    small = np.append(robot.hinges, np.ones(len(robot.tendons), dtype=bool))
    margins = np.where(small, np.minimum(margin, (own.upper - own.lower) / 8), margin)
    return own.lower + margins, own.upper - margins


def hinge_torque(model: pin.Model) -> float:
    """Torque [N m] by which torques of hinges are scaled: the weight times a lever."""
    return LEVER * 9.81 * float(sum(body.mass for body in model.inertias))


def _part(body: Any, share: float) -> Any:
    """pin.Inertia of a share of a body, with the same centre of mass."""
    return pin.Inertia(share * body.mass, body.lever, share * np.array(body.inertia))


GRIP_SPEED = 60.0  # [rad/s] of a tool in a soft grip: a limit that no impact reaches


def fields_with_tool(robot: Any, tool: Tool) -> dict[str, Any]:
    """Fields of a `Robot` that an additional tool changes."""
    if tool.name in robot.strikers:
        raise InputError(f"robot {robot.name!r} has a striker {tool.name!r} already; rename the tool")
    source = robot.source and replace(robot.source, tools=(*robot.source.tools, tool))
    return {"source": source, "tools": (*robot.tools, tool), **_attached(robot, robot.model, tool)}


def fields_with_grip(robot: Any, name: str, grip: SoftGrip) -> dict[str, Any]:
    """Fields of a `Robot` that change if its rigidly held tool of that name gets a soft grip."""
    tool = build.pick("tool", name, {tool.name: tool for tool in robot.tools}, robot.name)
    if tool.grip is not None:
        raise InputError(f"robot {robot.name!r} holds {name!r} softly already; give it one grip")
    attached = _attached(robot, without_tool(robot.model, tool), replace(tool, grip=grip))
    return {**replaced_grips(robot, {name: grip}), **attached}


def replaced_grips(robot: Any, grips: Mapping[str, SoftGrip]) -> dict[str, Any]:
    """Fields `tools` and `source` of a `Robot` with other grips, by the tools' names."""

    def replaced(tools: tuple[Tool, ...]) -> tuple[Tool, ...]:
        return tuple(replace(t, grip=grips[t.name]) if t.name in grips else t for t in tools)

    source = robot.source and replace(robot.source, tools=replaced(robot.source.tools))
    return {"tools": replaced(robot.tools), "source": source}


def _attached(robot: Any, free: pin.Model, tool: Tool) -> dict[str, Any]:
    """Fields `model` and `strikers` of a `Robot` with a tool, and for a soft grip, which adds a joint, all
    fields by joint and the postures.

    free : the model without the tool.
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
    out["postures"] = {name: extended(robot.model, model, q) for name, q in robot.postures.items()}
    return out


def with_tool(model: pin.Model, tool: Tool) -> pin.Model:
    """The model with the tool's inertia, on the link that holds it or on the joint of its soft grip, and with
    its striker's frame.
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
    elif tool.grip_joint in build.joint_names(model):
        raise InputError(
            f"tool {tool.name!r}: the robot has a joint {tool.grip_joint!r} already; rename the tool"
        )
    else:
        joint = (tool.grip_joint, *grip_limits(tool.grip), tool.grip.range)
        model = with_joint(model, tool.frame, tool.grip.placement, joint, tool.own_frame, body)
    build.add_striker(model, tool.striker)
    return model


def without(whole: Any, part: Any) -> Any:
    """pin.Inertia of a body without a part of it, both in the same frame; zero if nothing is left."""
    return whole - part if whole.mass - part.mass > 1e-6 else pin.Inertia.Zero()


def without_tool(model: pin.Model, tool: Tool) -> pin.Model:
    """The model without a rigidly held tool."""
    model = model.copy()
    frame = model.frames[model.getFrameId(tool.frame)]
    body = frame.placement.act(pin.Inertia(tool.mass, tool.center, tool.inertia))
    model.inertias[frame.parentJoint] = without(model.inertias[frame.parentJoint], body)
    return model


def grip_limits(grip: SoftGrip) -> tuple[float, float]:
    """Torque limit [N m] of a soft grip, which spring and damper reach at the range's end and the largest
    speed; and that speed [rad/s].
    """
    return grip.stiffness * grip.range + grip.damping * GRIP_SPEED, GRIP_SPEED
