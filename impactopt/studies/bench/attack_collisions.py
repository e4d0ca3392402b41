"""Collisions against an ordinary differential equation that shares nothing with the models but the physics.

Pinocchio's numeric functions freeze the arm at contact, laws and targets are written out again as plain
numbers, and SciPy's Radau goes from switch to switch: approach and parting, a nail that starts and stops, a
board that breaks. A collision is off where its impulse differs by more than its method says of itself
(`impactopt.studies.bench.stability.TOLERANCES`), alone or in a batch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

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
from impactopt.studies.bench.attack_cases import Generator
from impactopt.studies.bench.stability import TOLERANCES

__all__ = ["LAWS", "ROBOTS", "TARGETS", "Struck", "Truth", "Unjudged", "strike", "truth"]

Array = NDArray[np.float64]

ROBOTS = {"planar_arm": "hammer", "arm7": "fist"}
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
_MOST_PIECES, _MOST_SLOPES = 300, 400_000


class Unjudged(Exception):
    """The equation would take minutes."""


@dataclass(frozen=True, kw_only=True)
class Struck:
    """Collisions of one model: how many were judged, were off, and were refused; what was off, in words."""

    collisions: int = 0
    off: int = 0
    refused: int = 0
    unjudged: int = 0
    faults: tuple[str, ...] = ()
    largest: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Truth:
    """What the equation says, and the impulse [N s] of a plastic blow of the same masses."""

    impulse: float
    duration: float
    separated: bool
    scale: float


@dataclass(frozen=True, kw_only=True)
class Blow:
    """One collision: where and how fast, and the numbers of servo, law and target."""

    q: Array
    v: Array
    torque: Array
    numbers: dict[str, Any] = field(default_factory=dict)


# ------------------------------------------------------------ judging
def strike(robot: str, law: str, target: str, count: int, seed: int) -> Struck:
    """So many random collisions, each alone and all as rows of a batch."""
    model = SDC(
        robot=load_robot(robot),
        striker=ROBOTS[robot],
        normal=np.array([1.0, 0.0, 0.0]),
        law=LAWS[law],
        target=TARGETS[target],
        horizon=HORIZON,
    )
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
    q = rng.uniform(lower, upper)
    data = robot.model.createData()
    j = np.asarray(model.normal) @ _jacobian(robot, data, q, model.striker)
    speed = 10 ** rng.uniform(-1.0, 0.7)
    way = j / max(float(j @ j), 1e-2) * speed
    other = rng.normal(size=robot.nv) * 0.5
    v = way + other - j * (j @ other) / max(float(j @ j), 1e-12)
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
    mine = 1.0 / max(float(j @ np.linalg.solve(_inertia(robot, data, q), j)), 1e-6)
    mu = mine if target == "wall" else 1.0 / (1.0 / mine + 1.0 / mass)
    ratio = float(rng.choice([0.0, rng.uniform(0.0, 0.8)], p=[0.2, 0.8]))
    if law == "Hunt-Crossley":
        numbers["contact_dissipation"] = ratio
        numbers["contact_exponent"] = float(rng.choice([1.0, 1.5, 2.0]))
    else:
        numbers["contact_damping"] = 2.0 * ratio * np.sqrt(k * mu)
    torque = rng.normal(size=robot.n) * 0.3 * robot.torque_limit
    return Blow(q=q, v=v, torque=torque, numbers=numbers)


def _jacobian(robot: Any, data: Any, q: Array, striker: str) -> Array:
    frame = robot.model.getFrameId(robot.striker(striker).model_frame)
    J = pin.computeFrameJacobian(robot.model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)
    return np.array(J[:3])


def _inertia(robot: Any, data: Any, q: Array) -> Array:
    upper = np.triu(pin.crba(robot.model, data, q))  # with armature
    return np.array(upper + np.triu(upper, 1).T)


# ------------------------------------------------------------ the equation
def truth(model: SDC, blow: Blow) -> Truth:
    """The collision of an arm on a fixed base, its dynamics frozen where hand and target have met.

    Raises
    ------
    Unjudged : it would take minutes.
    """
    robot, n = model.robot, model.robot.n
    p = {name: np.asarray(x, dtype=float) for name, x in {**dict(model.settings), **blow.numbers}.items()}
    data, normal = robot.model.createData(), np.asarray(model.normal)
    H = _inertia(robot, data, blow.q)
    j = normal @ _jacobian(robot, data, blow.q, model.striker)
    s = np.linalg.solve(H, j)
    m, speed = float(j @ s), float(j @ blow.v)
    gives = 1.0 / float(p["target_mass"]) if isinstance(model.target, (FreeMass, Board)) else 0.0
    scale = abs(speed) / (m + gives)
    if speed <= 0:
        return Truth(impulse=0.0, duration=0.0, separated=True, scale=scale)
    met = blow.v - s * speed / (m + gives)
    d = -np.linalg.solve(H, pin.rnea(robot.model, data, blow.q, met, np.zeros(n)))
    e = float(j @ d) + float(normal @ _drift(robot, data, blow.q, met, model.striker))
    A = np.linalg.inv(H)
    force, over = _law(model.law, p)
    target = _Target(model.target, p)
    slopes = 0

    def hand(t: float, y: Array) -> float:
        # s' x integral of the torque - m x impulse is j times the change of velocity but for the drift
        return speed + float(j @ y[4 : 4 + n]) + (e - float(j @ d)) * t

    def rate(t: float, y: Array) -> float:
        return hand(t, y) - target.speed(y)

    def flow(t: float, y: Array) -> Array:
        nonlocal slopes
        slopes += 1
        if slopes > _MOST_SLOPES:
            raise Unjudged
        r = rate(t, y)
        f = max(force(y[0], r), 0.0)
        u = y[4 : 4 + n]
        tau = blow.torque - p["kd"] * u - p["kp"] * y[4 + n :]
        tau = np.clip(tau, -p["torque_limit"], p["torque_limit"])
        return np.concatenate([[r, f], target.slope(y, f), A @ tau - s * f + d, u])

    def ends(t: float, y: Array) -> float:
        return over(y[0], rate(t, y))

    t, y = 0.0, np.zeros(4 + 2 * n)
    closing = True
    size = np.full(y.size, 1e-10)
    size[0], size[1] = 1e-10 * min(speed * 1e-4, 1e-4), 1e-9 * scale
    for _ in range(_MOST_PIECES):
        f = max(force(y[0], rate(t, y)), 0.0)
        target.enter(y, f)
        events = [_event(rate, -1 if closing else 1)]
        events.append(_event(lambda t, y: target.switch(y, max(force(y[0], rate(t, y)), 0.0)), 0))
        if not closing:
            events.append(_event(ends, -1))
        way = solve_ivp(
            flow, (t, HORIZON), y, method="Radau", rtol=1e-9, atol=size, events=events,
            first_step=min(1e-9, HORIZON - t),
        )  # fmt: skip
        t, y = float(way.t[-1]), way.y[:, -1].copy()
        if way.status == 0:
            return Truth(impulse=float(y[1]), duration=t, separated=False, scale=scale)
        if way.status < 0:
            raise Unjudged
        hit = [len(times) > 0 and times[-1] == t for times in way.t_events]
        if len(hit) > 2 and hit[2]:
            return Truth(impulse=float(y[1]), duration=t, separated=True, scale=scale)
        if hit[0]:
            closing = not closing
            if not closing and over(y[0], rate(t, y)) <= 0:
                return Truth(impulse=float(y[1]), duration=t, separated=True, scale=scale)
        if hit[1]:
            target.cross(y)
        if HORIZON - t < 1e-9:
            return Truth(impulse=float(y[1]), duration=t, separated=False, scale=scale)
    raise Unjudged


def _event(function: Callable[[float, Array], float], direction: int) -> Any:
    def event(t: float, y: Array) -> float:
        return float(function(t, y))

    event.terminal, event.direction = True, direction  # type: ignore[attr-defined]
    return event


def _drift(robot: Any, data: Any, q: Array, v: Array, striker: str) -> Array:
    """(3,) dJ/dt v of the striking point."""
    frame = robot.model.getFrameId(robot.striker(striker).model_frame)
    pin.forwardKinematics(robot.model, data, q, v, np.zeros(robot.nv))
    pin.updateFramePlacements(robot.model, data)
    return np.array(
        pin.getFrameClassicalAcceleration(robot.model, data, frame, pin.LOCAL_WORLD_ALIGNED).linear
    )


def _law(
    law: Any, p: dict[str, Any]
) -> tuple[Callable[[float, float], float], Callable[[float, float], float]]:
    """(force of depth and rate, what falls through zero where contact ends), in plain numbers."""
    k = float(p["contact_stiffness"])
    if isinstance(law, HuntCrossley):
        alpha, exponent = float(p["contact_dissipation"]), float(p["contact_exponent"])
        return (
            lambda x, r: k * max(x, 0.0) ** exponent * (1 + 1.5 * alpha * r),
            lambda x, r: x if 1 + 1.5 * alpha * r > 0 else -1.0,
        )
    damping = float(p["contact_damping"])
    if isinstance(law, HertzDamped):

        def hertz(x: float, r: float) -> float:
            if x <= 0:
                return 0.0
            s = x / 1e-6
            quarter = x**0.25 if s > 1 else 1e-6**0.25 / 4 * s * (7 - 3 * s)
            return float(k * x**1.5 + damping * quarter * r)

        # the force has no slope where it ends: this has, and the same sign
        return hertz, lambda x, r: hertz(x, r) / (k * max(x, 1e-12) ** 0.5) if damping else x
    if isinstance(law, SpringDamper):
        return (lambda x, r: k * x + damping * r if r > 0 else k * x), lambda x, r: k * x
    return (lambda x, r: k * x + damping * r), (lambda x, r: k * x + damping * r)


class _Target:
    """What is hit, in plain numbers: its speed and place are y[2] and y[3]; which of two ways it is in."""

    def __init__(self, target: Any, p: dict[str, Any]) -> None:
        self.kind = type(target).__name__
        self.p = {
            name.removeprefix("target_"): float(x) for name, x in p.items() if name.startswith("target_")
        }
        self.moves = self.kind in ("FreeMass", "Board")
        self.whole = True

    def speed(self, y: Array) -> float:
        return float(y[2]) if self.moves else 0.0

    def _resists(self, y: Array) -> float:
        return self.p["resistance"] + self.p["hardening"] * (self.p["depth"] + float(y[3]))

    def enter(self, y: Array, force: float) -> None:
        """Which way a nail is in where a piece of the motion begins."""
        if self.kind == "Nail" and not self.moves:
            self.moves = force > self._resists(y)

    def slope(self, y: Array, force: float) -> list[float]:
        if not self.moves:
            return [0.0, 0.0]
        held = 0.0
        if self.kind == "Nail":
            held = self._resists(y)
        elif self.kind == "Board" and self.whole:
            held = self.p["stiffness"] * y[3] + self.p["damping"] * y[2]
        return [(force - held) / self.p["mass"], float(y[2])]

    def switch(self, y: Array, force: float) -> float:
        """Changes its sign where the way changes."""
        if self.kind == "Nail":
            # off zero where it has just begun to move
            return float(y[2]) + 1e-13 if self.moves else force - self._resists(y)
        if self.kind == "Board" and self.whole:
            return float(y[3]) - self.p["breaking_force"] / self.p["stiffness"]
        return 1.0

    def cross(self, y: Array) -> None:
        if self.kind == "Nail":
            self.moves = not self.moves
            if not self.moves:
                y[2] = 0.0
        else:
            self.whole = False
