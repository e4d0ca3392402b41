"""Random robots of any size, to time computations on."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.errors import InputError
from impactopt.robots.robot import Robot, Striker

LIMBS = 4  # l of the paper's fig. 4


def random_robot(n: int, *, limbs: int = LIMBS, seed: int = 0) -> Robot:
    """A fixed base with limbs of n / limbs revolute joints each, whose last tip is the striker `tip`.

    Masses, sizes and placements are drawn; postures and dynamics mean nothing.

    Raises
    ------
    InputError : n is no positive multiple of the number of limbs.
    """
    if n <= 0 or limbs <= 0 or n % limbs:
        raise InputError(f"n: {n}; give a positive multiple of {limbs}")
    rng = np.random.default_rng(seed)
    model = pin.Model()
    model.name = f"tree of {n}"
    kinds = (pin.JointModelRX, pin.JointModelRY, pin.JointModelRZ)
    for limb in range(limbs):
        parent = 0
        for k in range(n // limbs):
            at = pin.SE3(pin.exp3(rng.normal(size=3)), rng.uniform(-0.2, 0.2, size=3))
            parent = model.addJoint(parent, kinds[k % 3](), at, f"limb {limb} joint {k}")
            model.addJointFrame(parent)
            box = pin.Inertia.FromBox(rng.uniform(0.5, 3.0), *rng.uniform(0.05, 0.2, size=3))
            model.appendBodyToJoint(parent, box, pin.SE3(np.eye(3), rng.uniform(-0.1, 0.1, size=3)))
    names = list(model.names)[1:]
    return Robot.from_model(
        model,
        armature=0.1,
        kp=0.0,
        kd=10.0,
        torque_limit=100.0,
        velocity_limit=10.0,
        position_limit=dict.fromkeys(names, (-3.0, 3.0)),
        strikers=[Striker(name="tip", frame=names[-1], point=np.array([0.1, 0.0, 0.0]))],
    )


def tip_speed(robot: Robot, q: NDArray[np.float64], v: NDArray[np.float64]) -> float:
    """Speed of `tip` along the world's x [m/s] at q (nq), v (nv)."""
    model, data = robot.model, robot.model.createData()
    pin.forwardKinematics(model, data, q, v)
    frame = model.getFrameId(robot.striker("tip").model_frame)
    pin.updateFramePlacement(model, data, frame)
    return float(pin.getFrameVelocity(model, data, frame, pin.LOCAL_WORLD_ALIGNED).linear[0])
