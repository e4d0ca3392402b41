"""Cases and helpers that several tests share: those of `test_native.py`."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin

from impactopt import SDC, CustomLaw, FreeMass, JointFriction, SpringDamper, standin
from impactopt.codegen.cache import cached
from impactopt.collision.native import native_collision
from support import small_robots
from support.frozen_cases import Kinematics

X = np.array([1.0, 0.0, 0.0])


LAW, TARGET = SpringDamper(stiffness=1e4, damping=300.0), FreeMass(mass=1.0)


HARDENING = CustomLaw(
    compression=lambda x, rate, k, h, d: k * x + h * x**3 + d * rate,
    restitution=lambda x, rate, k, h, d: k * x + h * x**3,
    analytic=True,
    k=1e4,
    h=4e8,
    d=200.0,
)


FRICTION = JointFriction(viscous=2.0, coulomb=3.0, transition=0.05)


ROBOTS = {
    "arm": (small_robots.arm, "hand", "start"),
    "biped": (small_robots.biped, "fist", "half_sitting"),
    "standin": (standin, "right_hand", "half_sitting"),
}


@functools.cache
def robot_named(name: str) -> Any:
    return ROBOTS[name][0]()


def sdc(name: str, kind: Any = SDC, **options: Any) -> Any:
    given = {
        "robot": robot_named(name),
        "striker": ROBOTS[name][1],
        "normal": X,
        "law": LAW,
        "target": TARGET,
    }
    model = kind(**{**given, **options})
    # implicit steps are not in the graphs
    return dataclasses.replace(model, method="rk4") if model.stepping == "implicit" else model


def situation(name: str, model: Any, *, seed: int = 0, speed: float = 1.5) -> list[Any]:
    """Inputs of the model's functions: what is held is at rest, and the hand hits at `speed`."""
    robot, rng = model.robot, np.random.default_rng(seed)
    change = np.zeros(robot.nv)
    change[-3:] = rng.uniform(-0.2, 0.2, 3)
    q = pin.integrate(robot.model, robot.posture(ROBOTS[name][2]), change)
    frames = model.held_by.constraint_frames(robot)
    k = Kinematics(robot, q, np.zeros(robot.nv), frames, model.striker, X)
    rows, wanted = np.vstack([k.Jc, k.j]), np.zeros(len(k.Jc) + 1)
    wanted[-1] = speed
    v = 0.3 * rng.normal(size=robot.nv)
    v += np.linalg.pinv(rows) @ (wanted - rows @ v)
    torque = rng.normal(scale=0.5, size=robot.n) * robot.torque_limit
    return inputs(model, q, v, torque)


def inputs(model: Any, q: Any, v: Any, torque: Any) -> list[Any]:
    values = dict(model.settings)
    if "reference" in values:  # a servo whose reference bends, by some rad/s in 20 ms
        random = np.random.default_rng(7).normal(size=values["reference"].shape)
        values["reference_until"] = np.array(0.02)
        values["reference"] = 0.5 * random * 50.0 ** np.arange(1, random.shape[1] + 1)
    return [q, v, *([torque] if model.effects.feedforward else []), *values.values()]


def native(model: Any, outputs: tuple[str, ...], every: int = 1) -> Any:
    recipe = (*model._recipe, *outputs, every)
    return cached("native", recipe, lambda: [native_collision(model, outputs, every=every)])["collision"]


def call(function: Any, values: list[Any]) -> dict[str, Any]:
    found = function.call([ca.DM(x) for x in values])
    return {name: np.array(x) for name, x in zip(function.name_out(), found, strict=True)}
