"""What a sound robot and a sound problem are, said anew: nothing here asks the checks of the package."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from fuzz.attack_cases import numbers_in
from impactopt.problem.problem import ImpactProblem
from impactopt.robots.robot import Robot

LARGEST = 1e16
_POSITIVE = ("mass", "stiffness", "resistance", "breaking_force", "exponent")
_NOT_NEGATIVE = ("damping", "dissipation", "hardening", "depth", "smoothness", "wrench_price", "return_price")


def wrong_with_robot(robot: Robot) -> str:
    """What no robot of matter has, or ""."""
    model = robot.model
    for i in range(1, model.njoints):
        body = model.inertias[i]
        moments = np.linalg.eigvalsh(np.array(body.inertia))
        if not (np.isfinite(body.mass) and 0 < body.mass < LARGEST):
            return f"a link of mass {body.mass}"
        if not (np.isfinite(moments).all() and moments[0] > 0):
            return f"moments of inertia {moments}"
        if moments[0] + moments[1] < moments[2] * 0.99:
            return f"moments of inertia {moments} of no body"
        if not np.isfinite(np.array(model.jointPlacements[i])).all():
            return "a joint that is nowhere"
    for name in ("kp", "kd", "torque_limit", "velocity_limit", "armature"):
        values = np.array(getattr(robot, name))
        if not (np.isfinite(values).all() and (values >= 0).all() and (values <= LARGEST).all()):
            return f"{name} {values}"
        if name.endswith("limit") and not (values > 0).all():
            return f"{name} {values}"
    if not (robot.lower < robot.upper).all():
        return "crossed limits"
    for sole in robot.soles:
        if not (np.isfinite(sole.polygon).all() and _area(sole.polygon) > 0):
            return f"a sole {sole.polygon.tolist()}"
    for striker in robot.strikers.values():
        if not np.isfinite(striker.point).all():
            return f"a striker at {striker.point}"
    for name, q in robot.postures.items():
        if not np.isfinite(q).all():
            return f"posture {name!r} {q}"
        inertia = pin.crba(model, model.createData(), q)
        upper = np.triu(inertia)
        if not np.linalg.eigvalsh(upper + np.triu(upper, 1).T)[0] > 0:
            return f"an inertia matrix that is not positive definite at posture {name!r}"
    return ""


def _area(polygon: Any) -> float:
    x, y = np.array(polygon).T
    return float(0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum())


def wrong_with_problem(problem: ImpactProblem) -> str:
    """What no problem that can be solved has, or ""."""
    if wrong := wrong_with_robot(problem.robot):
        return wrong
    parts: dict[str, Any] = {
        "law": problem.law.parameters,
        "target": problem.target.parameters,
        "point": np.asarray(problem.point),
        "normal": np.asarray(problem.normal),
        "swing": problem.swing,
        "follow": problem.follow,
        "contact_duration": np.asarray(problem.contact_duration),
        "scenarios": problem.scenarios,
        "obstacles": problem.obstacles,
        "terms": problem.terms,
        "objectives": problem.objectives,
        "smoothness": problem.smoothness,
        "wrench_price": problem.wrench_price,
        "return_price": problem.return_price,
        "elements": problem.collision_elements,
    }
    for name, value in numbers_in(parts):
        if np.isnan(value):
            return f"{name} is no number"
        any_is_allowed = name.rpartition(".")[2] in ("vertical_speed", "angular_momentum", "speed")
        if (np.isinf(value) and not any_is_allowed) or LARGEST < abs(value) < np.inf:
            return f"{name} is {value}"
    for owner in ("law", "target"):
        for name, value in parts[owner].items():
            if (name in _POSITIVE and value <= 0) or (name in _NOT_NEGATIVE and value < 0):
                return f"{owner}.{name} is {value}"
    for name in ("smoothness", "wrench_price", "return_price"):
        if parts[name] < 0:
            return f"{name} is {parts[name]}"
    for name in ("swing", "follow"):
        phase = parts[name]
        shortest, longest = np.broadcast_to(phase.duration, 2)
        if not 0 < shortest <= longest or phase.intervals < 2:
            return f"{name} of {phase}"
    if abs(np.linalg.norm(parts["normal"]) - 1) > 1e-5:
        return f"the normal is {parts['normal']}"
    if not 0 <= problem.contact_duration[0] <= problem.contact_duration[1] > 0:
        return f"contact lasts {problem.contact_duration}"
    return _out_of_reach(problem)


def _out_of_reach(problem: ImpactProblem) -> str:
    """Whether a point is farther from the robot's first joint than all its links together are long."""
    robot = problem.robot
    model, data = robot.model, robot.model.createData()
    longest, frame = 0.0, model.frames[model.getFrameId(robot.striker(problem.striker).model_frame)]
    joint = frame.parentJoint
    longest += float(np.linalg.norm(frame.placement.translation))
    while joint and model.parents[joint]:
        longest += float(np.linalg.norm(model.jointPlacements[joint].translation))
        if model.joints[joint].shortname().startswith("JointModelP"):
            longest += float(np.ptp([robot.lower, robot.upper]))
        joint = model.parents[joint]
    pin.forwardKinematics(model, data, pin.neutral(model))
    away = float(np.linalg.norm(np.asarray(problem.point) - data.oMi[joint].translation))
    floating = 2.0 if robot.floating else 0.0  # its trunk moves too
    if away > longest + floating + 1e-6:
        return f"the point is {away:.3g} m away, and the robot reaches {longest:.3g} m"
    return ""
