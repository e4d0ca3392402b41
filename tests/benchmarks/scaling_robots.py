"""The blows that cost is measured on over degrees of freedom: of random chains and trees, and of humanoids.

All against a light target that bounces off, and random robots without torque limits: what is to be compared
is the cost of robots, not of how long their servos push, and of which joints saturate when.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.cases import Case
from benchmarks.report import Say
from benchmarks.setup import Setup
from benchmarks.trees import LIMBS, random_robot, tip_speed
from impactopt.contact import FreeMass, SpringDamper
from impactopt.errors import InputError
from impactopt.kinematics.operational_space import holding_torque, striking_velocity
from impactopt.robots.presets import load_robot
from impactopt.robots.robot import Robot

Array = NDArray[np.float64]

X = np.array([1.0, 0.0, 0.0])
SPEED = 1.0  # [m/s] of the striking point
LAW, TARGET = SpringDamper(stiffness=1e4, damping=30.0), FreeMass(mass=1.0)
NO_LIMIT = 1e6  # [N m]
KINDS = {"chain": 1, "tree": LIMBS}


def tip_setup(kind: str, n: int) -> Setup:
    """A random "chain" or "tree" of n joints whose tip strikes, with the least joint velocities that do."""
    robot = replace(random_robot(n, limbs=KINDS[kind]), torque_limit=np.full(n, NO_LIMIT))
    q = np.random.default_rng(1).uniform(-1, 1, size=n)
    row = np.array([tip_speed(robot, q, e) for e in np.eye(n)])
    return _setup(kind, robot, "tip", q, SPEED * row / (row @ row), np.zeros(n))


def humanoid_setups(names: Sequence[str], say: Say) -> list[Setup]:
    """Robots that half-sit and strike with the right hand; one whose files are not installed is left out,
    and named."""
    setups = []
    for name in names:
        try:
            robot = load_robot(name)
        except InputError as error:
            say(f"{name} is left out: {error}")
            continue
        q = robot.posture("half_sitting")
        v = striking_velocity(robot, q, "right_hand", X, SPEED)
        setups.append(_setup(name, robot, "right_hand", q, v, holding_torque(robot, q, v)))
    return setups


def depth(robot: Robot) -> int:
    """Joints from the root to the farthest one."""
    return max(len(path) - 1 for path in robot.model.supports)


def _setup(kind: str, robot: Robot, striker: str, q: Array, v: Array, torque: Array) -> Setup:
    case = Case(
        robot=robot,
        name=f"{robot.n} joints",
        striker=striker,
        normal=X,
        q=q,
        v=v,
        torque=torque,
        effective_mass=np.nan,
        speed=SPEED,
    )
    return Setup(name=kind, case=case, law=LAW, target=TARGET)
