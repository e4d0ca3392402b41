"""The equation of a collision whose dynamics are frozen, by other means than the models'.

Pinocchio's numeric functions freeze the robot, on its base or on its soles, where hand and target have met;
laws and targets are written out again as plain numbers, and SciPy's Radau goes from switch to switch:
approach and parting, a nail that starts and stops, a board that breaks.
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
from impactopt.contact import Board, FreeMass, HertzDamped, HuntCrossley, SpringDamper
from impactopt.robots.robot import Robot

Array = NDArray[np.float64]

_MOST_PIECES, _MOST_SLOPES = 2_000, 400_000


class Unjudged(Exception):
    """The equation would take minutes."""


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


# ------------------------------------------------------------ the robot at one posture
class Frozen:
    """A robot at a posture, what holds it as constraints.

    row (nv,): hand speed along the normal by velocity.  yields (nv, nv): velocity by generalized impulse.
    """

    def __init__(self, robot: Robot, q: Array, striker: str, normal: Array, held: tuple[str, ...]) -> None:
        model, self.data = robot.model, robot.model.createData()
        self.model, self.q, self.normal = model, q, normal
        self.hand = model.getFrameId(robot.striker(striker).model_frame)
        self.held = [model.getFrameId(name) for name in held]
        upper = np.triu(pin.crba(model, self.data, q))  # with armature
        free = np.linalg.inv(upper + np.triu(upper, 1).T)
        self.row: Array = normal @ self._jacobian(self.hand)[:3]
        self.rows = np.vstack([np.zeros((0, model.nv)), *[self._jacobian(frame) for frame in self.held]])
        # what constraints take of a velocity: (nv, 6 frames)
        self.back: Array = free @ self.rows.T @ np.linalg.inv(self.rows @ free @ self.rows.T)
        self.yields: Array = free - self.back @ self.rows @ free

    def _jacobian(self, frame: int) -> Array:
        j = pin.computeFrameJacobian(self.model, self.data, self.q, frame, pin.LOCAL_WORLD_ALIGNED)
        return np.array(j).reshape(6, self.model.nv)

    def allowed(self, v: Array) -> Array:
        """What constraints leave of a velocity (nv,)."""
        return v - self.back @ (self.rows @ v)

    def drift(self, v: Array) -> tuple[Array, float]:
        """Acceleration (nv,) without torques and contact, and dJ/dt v of the hand along the normal."""
        bias = pin.rnea(self.model, self.data, self.q, v, np.zeros(self.model.nv))
        pin.forwardKinematics(self.model, self.data, self.q, v, np.zeros(self.model.nv))
        pin.updateFramePlacements(self.model, self.data)
        of = [self._acceleration(frame) for frame in self.held]
        turning = np.concatenate([np.zeros(0), *of])
        a = -self.yields @ bias - self.back @ turning
        return a, float(self.normal @ self._acceleration(self.hand)[:3])

    def _acceleration(self, frame: int) -> Array:
        a = pin.getFrameClassicalAcceleration(self.model, self.data, frame, pin.LOCAL_WORLD_ALIGNED)
        return np.array(a.vector)


# ------------------------------------------------------------ the equation
def truth(model: SDC, blow: Blow) -> Truth:
    """The collision, its dynamics frozen where hand and target have met.

    Raises
    ------
    Unjudged : it would take minutes.
    """
    robot, n = model.robot, model.robot.n
    p = {name: np.asarray(x, dtype=float) for name, x in {**dict(model.settings), **blow.numbers}.items()}
    held = model.held_by.constraint_frames(robot)
    frozen = Frozen(robot, blow.q, model.striker, np.asarray(model.normal), held)
    joints = slice(robot.nv - n, robot.nv)
    s = frozen.yields @ frozen.row
    m, speed = float(frozen.row @ s), float(frozen.row @ blow.v)
    gives = 1.0 / float(p["target_mass"]) if isinstance(model.target, (FreeMass, Board)) else 0.0
    scale = abs(speed) / (m + gives)
    if speed <= 0:
        return Truth(impulse=0.0, duration=0.0, separated=True, scale=scale)
    d, turning = frozen.drift(blow.v - s * speed / (m + gives))
    e = float(frozen.row @ d) + turning
    A, by_torque, s, d = frozen.yields[joints, joints], s[joints], s[joints], d[joints]
    force, over = force_of(model.law, p)
    target = StruckTarget(model.target, p)
    slopes, horizon = 0, model.horizon

    def hand(t: float, y: Array) -> float:
        return speed + float(y[4])

    def rate(t: float, y: Array) -> float:
        return hand(t, y) - target.speed(y)

    def flow(t: float, y: Array) -> Array:
        nonlocal slopes
        slopes += 1
        if slopes > _MOST_SLOPES:
            raise Unjudged
        r = rate(t, y)
        f = max(force(y[0], r), 0.0)
        u = y[5 : 5 + n]
        tau = blow.torque - p["kd"] * u - p["kp"] * y[5 + n :]
        tau = np.clip(tau, -p["torque_limit"], p["torque_limit"])
        gain = float(by_torque @ tau) - m * f + e
        return np.concatenate([[r, f], target.slope(y, f), [gain], A @ tau - s * f + d, u])

    def ends(t: float, y: Array) -> float:
        return over(y[0], rate(t, y))

    t, y = 0.0, np.zeros(5 + 2 * n)
    closing = True
    size = np.full(y.size, 1e-10)
    size[0], size[1] = 1e-10 * min(speed * 1e-4, 1e-4), 1e-9 * scale
    for _ in range(_MOST_PIECES):
        f = max(force(y[0], rate(t, y)), 0.0)
        target.enter(y, f)
        events = [switch_of(rate, -1 if closing else 1)]
        events.append(switch_of(lambda t, y: target.switch(y, max(force(y[0], rate(t, y)), 0.0)), 0))
        if not closing:
            events.append(switch_of(ends, -1))
        way = solve_ivp(
            flow, (t, horizon), y, method="Radau", rtol=1e-9, atol=size, events=events,
            first_step=min(1e-9, horizon - t),
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
        if horizon - t < 1e-9:
            return Truth(impulse=float(y[1]), duration=t, separated=False, scale=scale)
    raise Unjudged


def switch_of(function: Callable[[float, Array], float], direction: int) -> Any:
    """A function's zero as an end of `solve_ivp`, where it is passed in a direction (0: in either)."""

    def event(t: float, y: Array) -> float:
        return float(function(t, y))

    event.terminal, event.direction = True, direction  # type: ignore[attr-defined]
    return event


def force_of(
    law: Any, p: dict[str, Any]
) -> tuple[Callable[[float, float], float], Callable[[float, float], float]]:
    """(force of depth and rate, what falls through zero where contact ends), in plain numbers.

    p : of `contact_stiffness` and so on.
    """
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


class StruckTarget:
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
