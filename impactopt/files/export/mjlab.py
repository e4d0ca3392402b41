"""mjlab (and BeyondMimic's whole_body_tracking): a reference motion for tracking policies, as one npz.

Frames are 1 / fps apart, so the reference's jumps are between two of them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from impactopt.arrays import Array, Mask
from impactopt.errors import InputError
from impactopt.files.export.content import Export, body_name
from impactopt.files.export.motion import Motion, motion_at
from impactopt.robots.model import JointAngles


def write(export: Export, directory: Path) -> None:
    """`motion.npz`, and `missed.npz` of a plan with an abort motion.

    Raises
    ------
    InputError : a robot with followers: policies have all joints of their MJCF, in its order.
    """
    if followers := ", ".join(map(repr, export.robot.couplings)):
        raise InputError(
            f"mjlab: policies have all joints, and those that follow others ({followers}) are no joints of "
            "the plan: export to mujoco or csv instead"
        )
    planned = export.planned
    for name, reference in (("motion", planned.reference), ("missed", planned.missed)):
        if reference is not None:
            even = motion_at(reference, export.robot, export.rate, export.order, {}, jumps=False)
            np.savez(directory / f"{name}.npz", **_arrays(export, even))


def _arrays(export: Export, motion: Motion) -> dict[str, Any]:
    """Arrays of mjlab's MotionLoader, and names of joints and bodies.

    The bodies are the root link and the link of each joint, in the order of the joints. Passive joints are
    left out: no MJCF has them, as soft grips and soles' hinges are added to the robot.
    """
    robot, model = export.robot, export.robot.model
    data, n = model.createData(), len(motion.time)
    driven = ~robot.passive[export.order]
    names = np.array(export.joints)[driven]
    joints = [1 if robot.floating else 0, *(model.getJointId(str(name)) for name in names)]
    place, turn, linear, angular = (np.zeros((n, len(joints), size)) for size in (3, 4, 3, 3))
    for k in range(n):
        pin.forwardKinematics(model, data, *_state(export, motion, k))
        for b, j in enumerate(joints):
            place[k, b] = data.oMi[j].translation
            turn[k, b] = pin.Quaternion(data.oMi[j].rotation).coeffs()[[3, 0, 1, 2]]
            velocity = pin.getVelocity(model, data, j, pin.LOCAL_WORLD_ALIGNED)
            linear[k, b], angular[k, b] = velocity.linear, velocity.angular
    # of the quaternions q and -q of a rotation, the one nearer to the frame before
    turn[1:] *= np.where(np.cumsum((turn[1:] * turn[:-1]).sum(-1) < 0, axis=0) % 2, -1.0, 1.0)[..., None]
    return {
        "fps": np.array([export.rate]),
        "joint_pos": motion.position[:, driven],
        "joint_vel": motion.velocity[:, driven],
        "body_pos_w": place,
        "body_quat_w": turn,
        "body_lin_vel_w": linear,
        "body_ang_vel_w": angular,
        "joint_names": names,
        "body_names": np.array([body_name(robot, j) for j in joints]),
        **_contacts(export.standing(motion)),
    }


def _contacts(standing: dict[str, Mask]) -> dict[str, Any]:
    """Mask (k, soles) of the soles that stand, and their names; {} without stance phases."""
    if not standing:
        return {}
    return {"sole_contact": np.column_stack(list(standing.values())), "sole_names": np.array(list(standing))}


def _state(export: Export, motion: Motion, k: int) -> tuple[Array, Array]:
    """q (nq,) and v (nv,) of Pinocchio at a frame."""
    robot = export.robot
    q, v = pin.neutral(robot.model), np.zeros(robot.nv)
    own = [robot.joint_models[at] for at in export.order]
    JointAngles(own).put(q, motion.position[k])
    v[[joint.idx_v for joint in own]] = motion.velocity[k]
    if (base := motion.base) is not None:
        q[:3], q[3:7] = base.position[k], base.quaternion[k, [1, 2, 3, 0]]
        turned = pin.Quaternion(q[3:7]).toRotationMatrix().T
        v[:3], v[3:6] = turned @ base.linear[k], turned @ base.angular[k]
    return q, v
