"""What is struck, and how: models that are compiled once, and random cases for them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from benchmarks.stability_robots import make_robot
from impactopt.collision import SDC, Effects, JointFriction, VirtualMass
from impactopt.collision.symbolic import SymbolicModel
from impactopt.contact import (
    Board,
    FreeMass,
    HertzDamped,
    HuntCrossley,
    KelvinVoigt,
    Nail,
    RigidWall,
    SpringDamper,
)

Array = NDArray[np.float64]

LAWS: dict[str, Any] = {
    "spring": SpringDamper(stiffness=1e4, damping=300.0),
    "kelvin": KelvinVoigt(stiffness=1e4, damping=100.0),
    "hertz": HertzDamped(stiffness=1e6, damping=10.0),
    "hunt": HuntCrossley(stiffness=1e5, dissipation=0.3),
}
TARGETS: dict[str, Any] = {
    "mass": FreeMass(mass=5.0),
    "wall": RigidWall(),
    "nail": Nail(mass=0.1, resistance=300.0, hardening=1e4),
    "board": Board(mass=0.5, stiffness=1e5, breaking_force=400.0, damping=20.0),
}


@dataclass(frozen=True, kw_only=True)
class Rig:
    """A model that is compiled once, and struck many times; `share` of the cases are its."""

    robot: str
    law: str = "spring"
    target: str = "mass"
    share: float = 1.0
    friction: bool = False
    paper: bool = False
    point: bool = False
    method: str | None = None
    step: float | None = None
    horizon: float = 0.1
    seed: int = 0

    @property
    def name(self) -> str:
        kind = "paper" if self.paper else "point" if self.point else "SDC"
        kind += " with friction" if self.friction else ""
        kind += f" by {self.method}" if self.method else ""
        return f"{self.robot}, {self.law}, {self.target}, {kind}" + (
            f", {self.step:g} s" if self.step else ""
        )

    def model(self) -> SymbolicModel:
        """The collision model."""
        robot = make_robot(self.robot)
        striker = "tip" if "tip" in robot.strikers else "right_hand"
        options: dict[str, Any] = {
            "robot": robot,
            "striker": striker,
            "normal": np.array([1.0, 0.0, 0.0]),
            "law": LAWS[self.law],
            "target": TARGETS[self.target],
            "horizon": self.horizon,
        }
        if self.paper:
            return SDC.paper(**options)
        if self.point:
            return VirtualMass(**options, method=self.method, step=self.step)
        friction = JointFriction(viscous=0.5, coulomb=1.0, transition=0.05) if self.friction else None
        options |= {"method": self.method, "step": self.step}
        return SDC(**options, effects=Effects(friction=self.friction), friction=friction, accuracy=None)


# steps of a fixed length for slow contacts, for fast and for the fastest
_FINE: dict[str, Any] = {"step": 1e-5, "horizon": 0.01}
_FINEST: dict[str, Any] = {"step": 1e-6, "horizon": 1e-3}
RIGS = (
    *(Rig(robot=r) for r in ("arm", "slider", "bare arm", "whip", "mace")),
    *(Rig(robot="arm", horizon=horizon) for horizon in (1e-3, 1.0)),
    *(Rig(robot="arm", target=t) for t in ("wall", "nail", "board")),
    Rig(robot="arm", law="kelvin"),
    Rig(robot="whip", law="kelvin", target="nail"),
    Rig(robot="arm", friction=True),
    Rig(robot="walker", share=0.5),
    Rig(robot="planar walker", share=0.1),
    Rig(robot="arm", point=True),
    Rig(robot="whip", point=True),
    Rig(robot="standin", share=0.25),
    Rig(robot="talos", share=0.25),
    *(Rig(robot=r, law=law) for r in ("arm", "mace") for law in ("hertz", "hunt")),
    *(Rig(robot="arm", law=law, target=t) for t in ("wall", "nail", "board") for law in ("hertz", "hunt")),
    Rig(robot="arm", law="hunt", friction=True),
    Rig(robot="slider", law="hunt", target="wall"),
    *(Rig(robot="arm", law=law, method="rk4", **_FINE) for law in ("spring", "hertz", "hunt")),
    Rig(robot="mace", method="rk4", **_FINEST),
    Rig(robot="arm", paper=True),
)


# ---------------------------------------------------------------- cases
@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """Arguments of one `collide`."""

    q: Any
    v: Any
    torque: Any
    overrides: dict[str, Any] = field(default_factory=dict)


# decades on either side of the default, or between values; narrow: of half the draws
_FACTORS = {"kp": (-3, 4), "kd": (-3, 4), "torque_limit": (-9, 12), "viscous": (-3, 3), "coulomb": (-3, 3)}
_VALUES = {
    "contact_stiffness": (2, 9),
    "contact_damping": (0, 6),
    "contact_dissipation": (-3, 2),
    "target_mass": (-4, 6),
    "target_resistance": (-2, 5),
    "target_hardening": (0, 7),
    "target_breaking_force": (-2, 5),
    "target_stiffness": (2, 8),
    "target_damping": (0, 5),
}
_SPEED = (-6.0, np.log10(30.0))


def draw(model: SymbolicModel, rng: Any, number: int) -> Case:
    """A case: one thing at an edge, all drawn over their whole ranges, or over a third of these."""
    names = [name for name in model.settings if name in _FACTORS or name in _VALUES]
    kind = ("edge", "narrow", "whole", "narrow")[number % 4]
    at_edge = names[number // 4 % len(names)]
    overrides: dict[str, Any] = {}
    for name in names:
        own = model.settings[name]
        if kind == "edge":
            if name == at_edge:
                ends = _FACTORS.get(name) or _VALUES[name]
                overrides[name] = 10.0 ** ends[rng.integers(2)] * (own if name in _FACTORS else 1.0)
        elif name in _FACTORS:
            low, high = (x / (3 if kind == "narrow" else 1) for x in _FACTORS[name])
            overrides[name] = own * 10 ** rng.uniform(low, high)
        else:
            low, high = _VALUES[name]
            if kind == "narrow":
                middle = np.clip(np.log10(float(own) or 1.0), low, high)
                low, high = middle + (low - middle) / 3, middle + (high - middle) / 3
            overrides[name] = 10 ** rng.uniform(low, high)
    if "contact_damping" in overrides and rng.random() < 0.1:
        overrides["contact_damping"] = 0.0
    speed = 10 ** (rng.uniform(*_SPEED) if kind == "whole" else rng.uniform(-1.0, 0.7))
    speed *= rng.choice([1.0, 0.0, -1.0], p=[0.9, 0.04, 0.06])
    q: Any = _posture(model, rng)
    v: Any = speed * _towards(model, q, rng)
    torque: Any = rng.normal(size=model.robot.n) * model.robot.torque_limit * 0.3
    if rng.random() < 0.1:  # numbers of single precision are numbers
        q, v, torque = (x.astype(np.float32) for x in (q, v, torque))
        overrides = {name: np.float32(x) for name, x in overrides.items()}
    return Case(q=q, v=v, torque=torque, overrides=overrides)


def _posture(model: SymbolicModel, rng: Any) -> Array:
    """A posture: as the robot stands, bent at random, or with straight limbs, where arm or knees are
    singular."""
    robot = model.robot
    q = robot.posture("half_sitting") if "half_sitting" in robot.postures else pin.neutral(robot.model)
    bent = np.zeros(robot.nv)
    kind = rng.integers(4)
    if kind == 0:
        q = pin.neutral(robot.model)
        if robot.n == 3:  # the arm straight, in any direction, along the blow too
            bent[0] = rng.choice([0.0, np.pi / 4, np.pi / 2])
            bent[1:] = rng.choice([0.0, 1e-9, 1e-4])
    else:
        bent[-robot.n :] = rng.uniform(-0.8, 0.8, robot.n) * (0.3 if robot.floating else 1.0)
    return np.array(pin.integrate(robot.model, q, bent))


def _towards(model: SymbolicModel, q: Array, rng: Any) -> Array:
    """v (nv) that moves the hand along the normal at 1 m/s, the soles at rest, where that can be."""
    robot, axes = model.robot, pin.LOCAL_WORLD_ALIGNED
    data = robot.model.createData()
    held = model.held_by.constraint_frames(robot)
    frames = [*held, robot.striker(model.striker).model_frame]
    J = [
        pin.computeFrameJacobian(robot.model, data, q, robot.model.getFrameId(f), axes).reshape(6, -1).copy()
        for f in frames
    ]
    j = np.asarray(model.normal) @ J[-1][:3]
    rows = np.vstack([*J[:-1], j])
    v = np.linalg.pinv(rows, rcond=1e-6) @ np.append(np.zeros(len(rows) - 1), 1.0)
    other = rng.normal(size=robot.nv) * 0.3 * np.linalg.norm(v)
    v = v + other - np.linalg.pinv(rows, rcond=1e-6) @ (rows @ other)
    # a hand that can hardly move that way is swung as fast as joints go
    size = np.linalg.norm(v)
    return v * min(1.0, 30.0 / size) if size > 0.1 else rng.normal(size=robot.nv)
