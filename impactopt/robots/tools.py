"""Tools that a robot's link holds firmly, or softly by a joint of their own."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.errors import InputError
from impactopt.robots import build, checks
from impactopt.robots.actuators import Actuator
from impactopt.robots.attachments import SoftGrip, Tool
from impactopt.robots.joints import hung, mapped

__all__ = ["grip_limits", "holding", "holding_softly", "let_go", "with_tool", "without"]

Array = NDArray[np.float64]
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
