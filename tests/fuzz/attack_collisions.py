"""Random collisions against `attack_equation`, which shares nothing with the models but the physics.

A collision is off where its impulse differs by more than its method says of itself
(`benchmarks.stability.TOLERANCES`), alone or in a batch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from benchmarks.stability import TOLERANCES
from numpy.typing import NDArray

from fuzz.attack_cases import Generator
from fuzz.attack_equation import Blow, Frozen, Unjudged, truth
from impactopt.collision import SDC
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
from impactopt.errors import InputError
from impactopt.robots.presets import load_robot

Array = NDArray[np.float64]

# with their strikers
ROBOTS = {
    "planar_arm": "hammer",
    "arm7": "fist",
    "standin": "right_hand",
    "g1": "right_hand",
    "talos": "right_hand",
}
FLOATING = ("standin", "g1", "talos")
LAWS: dict[str, Any] = {
    "spring-damper": SpringDamper(stiffness=1e5, damping=10.0),
    "Kelvin-Voigt": KelvinVoigt(stiffness=1e5, damping=10.0),
    "Hunt-Crossley": HuntCrossley(stiffness=1e6, dissipation=0.3),
    "Hertz": HertzDamped(stiffness=1e6, damping=10.0),
}
TARGETS: dict[str, Any] = {
    "mass": FreeMass(mass=1.0),
    "wall": RigidWall(),
    "nail": Nail(mass=0.05, resistance=500.0, hardening=1e4),
    "board": Board(mass=0.5, stiffness=1e5, breaking_force=400.0, damping=20.0),
}
HORIZON = 0.2  # [s]
NORMAL = np.array([1.0, 0.0, 0.0])


@dataclass(frozen=True, kw_only=True)
class Struck:
    """Collisions of one model: how many were judged, were off, and were refused; what was off, in words."""

    collisions: int = 0
    off: int = 0
    refused: int = 0
    unjudged: int = 0
    faults: tuple[str, ...] = ()
    largest: float = 0.0


def pairs_of(robot: str) -> list[tuple[str, str]]:
    """Names of laws and targets: all pairs, or on a humanoid, each of whose models compiles for minutes, each
    law with a mass and each target with a spring and damper."""
    pairs = [(law, target) for law in LAWS for target in TARGETS]
    few = robot in FLOATING
    return [(law, target) for law, target in pairs if not few or target == "mass" or law == "spring-damper"]


def model_of(robot: str, law: str, target: str) -> SDC:
    """What collides, by names."""
    return SDC(
        robot=load_robot(robot),
        striker=ROBOTS[robot],
        normal=NORMAL,
        law=LAWS[law],
        target=TARGETS[target],
        horizon=HORIZON,
        accuracy=None,  # the equation freezes too: what that costs is for the bench freezes
    )


# ------------------------------------------------------------ judging
def strike(robot: str, law: str, target: str, count: int, seed: int) -> Struck:
    """So many random collisions, each alone and all as rows of a batch."""
    model = model_of(robot, law, target)
    rng = np.random.default_rng([seed, *map(ord, robot + law + target)])
    blows = [draw(model, law, target, rng) for _ in range(count)]
    rows = _rows(model, blows)
    tolerance, found = TOLERANCES[model.stepping], []
    for blow, row in zip(blows, rows, strict=True):
        what = f"{robot}, {law}, {target}: {blow}"
        alone, why = _alone(model, blow)
        given = {"alone": alone, "in a batch": row}
        numbers = {way: x for way, x in given.items() if np.isfinite(x)}
        if not numbers:
            crash = () if not why else (f"{what}: {why}",)
            found.append(Struck(collisions=1, refused=0 if why else 1, off=1 if why else 0, faults=crash))
            continue
        try:
            true = truth(model, blow)
        except Unjudged:
            found.append(Struck(unjudged=1))
            continue
        size = max(abs(true.impulse), true.scale)
        errors = {way: abs(x - true.impulse) / size for way, x in numbers.items()}
        off = {way: e for way, e in errors.items() if not e <= tolerance}
        told = f"{what}: " + ", ".join(f"{way} off by {e:.2g}" for way, e in off.items())
        told += f"; {true.impulse!r} N s in {true.duration:.3g} s"
        found.append(
            Struck(
                collisions=1, off=int(bool(off)), faults=(told,) if off else (), largest=max(errors.values())
            )
        )
    return Struck(
        **{
            name: sum(getattr(s, name) for s in found)
            for name in ("collisions", "off", "refused", "unjudged")
        },
        faults=tuple(text for s in found for text in s.faults),
        largest=max((s.largest for s in found if not s.off), default=0.0),
    )


def _alone(model: SDC, blow: Blow) -> tuple[float, str]:
    """(impulse or NaN where it is refused, what went wrong otherwise)."""
    try:
        found = model.collide(blow.q, blow.v, blow.torque, require_separation=False, **blow.numbers)
    except InputError:
        return np.nan, ""
    except Exception as error:
        return np.nan, f"{type(error).__name__}: {error}"
    return (found.impulse, "") if np.isfinite(found.impulse) else (np.nan, "no number")


def _rows(model: SDC, blows: list[Blow]) -> Array:
    """Impulses in a batch; NaN where a row, or the batch, is refused."""
    names = list(blows[0].numbers) if blows else []
    columns: dict[str, Any] = {name: np.array([b.numbers[name] for b in blows]) for name in names}
    try:
        found = model.batch(
            np.array([b.q for b in blows]),
            np.array([b.v for b in blows]),
            np.array([b.torque for b in blows]),
            outputs=("impulse",),
            threads=1,
            **columns,
        )
    except InputError:
        return np.full(len(blows), np.nan)
    return found["impulse"]


# ------------------------------------------------------------ cases
def draw(model: SDC, law: str, target: str, rng: Generator) -> Blow:
    """Gains x 0.1 to 10, k of 1e3 to 1e9 N/m and what goes with it, targets of 0.01 to 100 kg."""
    robot = model.robot
    lower, upper = np.maximum(robot.lower, -2.5), np.minimum(robot.upper, 2.5)
    if robot.floating:
        q = robot.posture("half_sitting")
        joints = np.clip(robot.joint_positions(q) + rng.uniform(-0.5, 0.5, robot.n), lower, upper)
        change = joints - robot.joint_positions(q)
        q = pin.integrate(robot.model, q, np.concatenate([np.zeros(robot.nv - robot.n), change]))
    else:
        q = rng.uniform(lower, upper)
    held = model.held_by.constraint_frames(robot)
    frozen = Frozen(robot, q, model.striker, np.asarray(model.normal), held)
    speed = 10 ** rng.uniform(-1.0, 0.7)
    s = frozen.yields @ frozen.row
    m = float(frozen.row @ s)
    # the hand's, by a push, or by joints alone where they are the base's too; what is held stays at rest
    along = s / max(m, 1e-6) if robot.floating else frozen.row / max(float(frozen.row @ frozen.row), 1e-2)
    other = frozen.allowed(rng.normal(size=robot.nv) * 0.5)
    unit = along / max(float(frozen.row @ along), 1e-12)
    v = along * speed + other - unit * float(frozen.row @ other)
    numbers: dict[str, Any] = {
        "kp": robot.kp * 10 ** rng.uniform(-1, 1, robot.n),
        "kd": robot.kd * 10 ** rng.uniform(-1, 1, robot.n),
    }
    mass = 10 ** rng.uniform(-2, 2)
    if target in ("mass", "nail", "board"):
        mass = {"mass": mass, "nail": 0.1 * mass**0.5, "board": mass**0.5}[target]
        numbers["target_mass"] = mass
    if target == "nail":
        numbers["target_resistance"] = 10 ** rng.uniform(1.5, 3.5)
        numbers["target_hardening"] = float(rng.choice([0.0, 10 ** rng.uniform(3, 6)]))
    if target == "board":
        numbers["target_stiffness"] = 10 ** rng.uniform(4, 6)
        numbers["target_breaking_force"] = 10 ** rng.uniform(1.5, 4)
        numbers["target_damping"] = float(rng.choice([0.0, 10 ** rng.uniform(0, 2)]))
    k = 10 ** rng.uniform(3, 9)
    numbers["contact_stiffness"] = k
    mine = 1.0 / max(m, 1e-6)
    mu = mine if target == "wall" else 1.0 / (1.0 / mine + 1.0 / mass)
    ratio = float(rng.choice([0.0, rng.uniform(0.0, 0.8)], p=[0.2, 0.8]))
    if law == "Hunt-Crossley":
        numbers["contact_dissipation"] = ratio
        numbers["contact_exponent"] = float(rng.choice([1.0, 1.5, 2.0]))
    else:
        numbers["contact_damping"] = 2.0 * ratio * np.sqrt(k * mu)
    torque = rng.normal(size=robot.n) * 0.3 * robot.torque_limit
    return Blow(q=q, v=v, torque=torque, numbers=numbers)
