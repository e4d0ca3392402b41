"""Collisions with frozen dynamics by an independent integration, and random ones to try it on.

It shares no code with the package, and of its objects takes but the numbers: Pinocchio's own algorithms, a
full KKT matrix in place of factorizations, SciPy's integrator step by step, events located by integrating up
to them again.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.integrate import DOP853, solve_ivp
from scipy.optimize import brentq

from impactopt import (
    SDC,
    Board,
    BothSoles,
    Effects,
    FreeMass,
    JointFriction,
    KelvinVoigt,
    Nail,
    RigidWall,
    Robot,
    SpringDamper,
    standin,
    talos,
)
from support import small_robots
from support.exact import ExactCollision

TOLERANCES = {"rtol": 1e-13, "atol": 1e-16}
LONGEST = 1e-4  # [s] of a step
SAMPLES = np.linspace(0.0, 1.0, 9)[1:]


def frozen_numbers(sdc: SDC, q: Any, v: Any, mass: float) -> dict[str, Any]:
    """Accelerations per generalized force, as frozen at contact; drifts at the velocity of meeting."""
    robot, model = sdc.robot, sdc.robot.model
    ids = [model.getFrameId(name) for name in sdc.held_by.constraint_frames(robot)]
    hand = model.getFrameId(robot.striker(sdc.striker).model_frame)
    normal, axes = np.asarray(sdc.normal), pin.LOCAL_WORLD_ALIGNED

    def kinematics(velocity: Any) -> Any:
        data = model.createData()
        pin.forwardKinematics(model, data, q, velocity, np.zeros(model.nv))
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        Jc = [pin.getFrameJacobian(model, data, i, axes).reshape(6, -1).copy() for i in ids]
        drift = [pin.getFrameClassicalAcceleration(model, data, i, axes).vector.copy() for i in ids]
        j = normal @ pin.getFrameJacobian(model, data, hand, axes).reshape(6, -1)[:3]
        hand_drift = normal @ pin.getFrameClassicalAcceleration(model, data, hand, axes).linear
        rows = np.vstack([np.zeros((0, model.nv)), *Jc]), np.concatenate([np.zeros(0), *drift])
        return *rows, j, hand_drift

    Jc, _, j, _ = kinematics(v)
    H = pin.crba(model, model.createData(), q)
    H = np.triu(H) + np.triu(H, 1).T
    compliance = np.tile(sdc.held_by.compliance, len(ids))
    kkt = np.block([[H, -Jc.T], [Jc, np.diag(compliance)]])
    inverse = np.linalg.inv(kkt)
    P = inverse[: robot.nv, : robot.nv]
    met = v
    if sdc.effects.bias or sdc.effects.jdot:
        met = v - P @ j * (j @ v) / (j @ P @ j + 1.0 / mass)
    _, drift, _, hand_drift = kinematics(met)
    free = np.zeros(robot.nv)
    if sdc.effects.jdot:
        free = -inverse[: robot.nv, robot.nv :] @ drift
    if sdc.effects.bias:
        free = free - P @ pin.nonLinearEffects(model, model.createData(), q, met)
    return {"P": P, "j": j, "Jc": Jc, "free": free, "hand_drift": hand_drift if sdc.effects.jdot else 0.0}


class Reference:
    """One collision; y = (v, displacement, hand speed, penetration, impulse, target's state)."""

    def __init__(self, sdc: SDC, q: Any, v: Any, torque: Any, gains: dict[str, Any]) -> None:
        robot, effects = sdc.robot, sdc.effects
        self.sdc, self.n, self.nv, self.v0 = sdc, robot.n, robot.nv, v
        target = sdc.target
        self.mass = target.mass if isinstance(target, (FreeMass, Board)) else np.inf
        frozen = frozen_numbers(sdc, q, v, self.mass)
        self.P, self.j, self.free = frozen["P"], frozen["j"], frozen["free"]
        self.hand_drift = frozen["hand_drift"]
        self.kd = gains["kd"] if np.ndim(gains["kd"]) == 2 else np.diag(gains["kd"])
        self.kp = np.diag(gains["kp"]) * effects.stiffness
        self.limit = robot.torque_limit if effects.saturation else np.full(self.n, np.inf)
        self.ff = torque if effects.feedforward else np.zeros(self.n)
        friction = sdc.friction or JointFriction(transition=1e9)
        (self.viscous, self.coulomb), self.band = friction.arrays(self.n), friction.transition
        self.k, self.d = sdc.law.stiffness, sdc.law.damping
        self.always_damped = isinstance(sdc.law, KelvinVoigt)

    # ------------------------------------------------------------ one instant in one phase
    def demand(self, t: float, y: Any) -> Any:
        v, p = y[: self.nv], y[self.nv : 2 * self.nv]
        n = self.n
        return self.ff + self.kp @ (self.v0 * t - p)[-n:] + self.kd @ (self.v0 - v)[-n:]

    def rate(self, y: Any, mode: dict[str, Any]) -> float:
        held = isinstance(self.sdc.target, RigidWall) or mode["target"] == "still"
        return float(y[2 * self.nv] - (0.0 if held else y[2 * self.nv + 3]))

    def force(self, y: Any, mode: dict[str, Any]) -> float:
        damped = mode["compressing"] or self.always_damped
        return float(self.k * y[2 * self.nv + 1] + (self.d * self.rate(y, mode) if damped else 0.0))

    def flow(self, t: float, y: Any, mode: dict[str, Any]) -> Any:
        n, nv = self.n, self.nv
        v, f, rate = y[:nv], self.force(y, mode), self.rate(y, mode)
        limits = np.where(np.isfinite(self.limit), self.limit, 0.0)
        tau = np.where(mode["saturated"] == 0, self.demand(t, y), mode["saturated"] * limits)
        sign = np.where(mode["sliding"] == 0, v[-n:] / self.band, mode["sliding"])
        push = -self.j * f
        push[-n:] += tau - self.viscous * v[-n:] - self.coulomb * sign
        a = self.P @ push + self.free
        return np.concatenate([a, v, [self.j @ a + self.hand_drift, rate, f], self.target(y, f, mode)])

    def target(self, y: Any, f: float, mode: dict[str, Any]) -> list[float]:
        target, z = self.sdc.target, y[2 * self.nv + 3 :]
        if isinstance(target, FreeMass):
            return [f / target.mass]
        if isinstance(target, Nail):
            moving = mode["target"] == "moves"
            return [(f - self.wood(z)) / target.mass, z[0]] if moving else [0.0, 0.0]
        if isinstance(target, Board):
            bent = target.stiffness * z[1] + target.damping * z[0]
            return [(f - (bent if mode["target"] == "whole" else 0.0)) / target.mass, z[0]]
        return []

    def wood(self, z: Any) -> float:
        nail = self.sdc.target
        return float(nail.resistance + nail.hardening * (nail.depth + z[1]))

    def margins(self, t: float, y: Any, mode: dict[str, Any]) -> Any:
        """Each above zero while the phase lasts; of the size of one."""
        s, c, v, d = mode["saturated"], mode["sliding"], y[: self.nv][-self.n :], self.demand(t, y)
        rate, f, speed = self.rate(y, mode), self.force(y, mode), abs(self.j @ self.v0)
        limited = np.where(s == 0, 1.0 - np.abs(d) / self.limit, s * d / self.limit - 1.0)
        slides = np.where(c == 0, self.band - np.abs(v), c * v - self.band) / self.band
        contact = [(rate if mode["compressing"] else -rate) / speed]
        contact.append(1.0 if mode["compressing"] else f / (self.k * 1e-3))
        z = y[2 * self.nv + 3 :]
        contact.append(
            {
                "none": lambda: 1.0,
                "still": lambda: (self.wood(z) - f) / self.wood(z),
                "moves": lambda: z[0] / speed,
                "whole": lambda: 1.0 - z[1] * self.sdc.target.stiffness / self.sdc.target.breaking_force,
            }[mode["target"]]()
        )
        return np.concatenate([limited, slides, contact])

    def switched(self, i: int, t: float, y: Any, mode: dict[str, Any]) -> dict[str, Any]:
        n = self.n
        if i < 2 * n:
            name = "saturated" if i < n else "sliding"
            value = self.demand(t, y)[i] if i < n else y[: self.nv][-n:][i - n]
            signs = mode[name].copy()
            signs[i % n] = np.sign(value) if signs[i % n] == 0 else 0.0
            return {**mode, name: signs}
        if i == 2 * n:
            return {**mode, "compressing": not mode["compressing"]}
        following = {"still": "moves", "moves": "still", "whole": "none"}
        return {**mode, "target": following[mode["target"]]}

    # ------------------------------------------------------------ from contact to separation
    def run(self, horizon: float) -> dict[str, Any]:
        n, nv, target = self.n, self.nv, self.sdc.target
        y = np.concatenate([self.v0, np.zeros(nv), [self.j @ self.v0, 0.0, 0.0], np.zeros(target.n_states)])
        first = {Nail: "still", Board: "whole"}.get(type(target), "none")
        d, w = self.demand(0.0, y), self.v0[-n:]
        mode = {
            "compressing": True,
            "saturated": np.where(np.abs(d) > self.limit, np.sign(d), 0.0),
            "sliding": np.where(np.abs(w) > self.band, np.sign(w), 0.0),
            "target": first,
        }
        t, self.phases, self.peak, separated = 0.0, 1, self.force(y, mode), False
        while t < horizon:
            t, y, i = self.phase(t, y, mode, horizon)
            if i is None:
                break
            if i == 2 * n + 1:
                separated = True
                break
            mode = self.switched(i, t, y, mode)
            self.phases += 1
        return {
            "impulse": y[2 * nv + 2],
            "duration": t,
            "peak_force": self.peak,
            "separated": separated,
            "velocity": y[:nv],
            "displacement": y[nv : 2 * nv],
            "phases": self.phases,
        }

    def phase(self, t: float, y: Any, mode: dict[str, Any], horizon: float) -> Any:
        """(time, state, number of the margin that ended it, or None at the horizon) of a phase."""

        def flow(t: float, y: Any) -> Any:
            return self.flow(t, y, mode)

        over = np.flatnonzero(self.margins(t, y, mode) < -1e-12)
        if over.size:  # as a nail's, where the blow starts with more force than holds it
            return t, y, int(over[0])
        solver = DOP853(flow, t, y, horizon, max_step=LONGEST, **TOLERANCES)
        while solver.status == "running":
            start = solver.y
            solver.step()
            begin, dense = solver.t_old, solver.dense_output()
            times = begin + (solver.t - begin) * SAMPLES
            table = np.array([self.margins(s, dense(s), mode) for s in times])
            gone = np.flatnonzero((table < -1e-12).any(axis=1))
            if not gone.size:
                self.look_for_peak(begin, solver.t, dense, mode)
                continue
            row, hits = gone[0], []
            before = times[row - 1] if row else begin
            for i in np.flatnonzero(table[row] < -1e-12):
                at = functools.partial(self._margin, dense, mode, i)
                hits.append((before if at(before) <= 0 else brentq(at, before, times[row]), int(i)))
            end, i = min(hits)
            end, y = self.located(flow, begin, start, end, i, mode)
            self.look_for_peak(begin, end, dense, mode)
            return end, y, i
        return solver.t, solver.y, None

    def _margin(self, dense: Any, mode: dict[str, Any], i: int, t: float) -> float:
        return float(self.margins(t, dense(t), mode)[i])

    def located(self, flow: Any, begin: float, start: Any, t: float, i: int, mode: Any) -> tuple[float, Any]:
        """The event by Newton's method, each time integrated up to anew: better than dense output."""

        def state(t: float) -> Any:
            return solve_ivp(flow, (begin, t), start, method="DOP853", **TOLERANCES).y[:, -1]

        for _ in range(3):
            y, h = state(t), 1e-7
            margin = self.margins(t, y, mode)[i]
            slope = (self.margins(t + h, y + h * flow(t, y), mode)[i] - margin) / h
            t = max(t - margin / slope, begin)
        return t, state(t)

    def look_for_peak(self, begin: float, end: float, dense: Any, mode: dict[str, Any]) -> None:
        def slope(t: float) -> float:
            # the force is linear in the state, and so its slope is the force of the state's slope
            return self.force(self.flow(t, dense(t), mode), mode)

        self.peak = max(self.peak, self.force(dense(begin), mode), self.force(dense(end), mode))
        if end > begin and slope(begin) > 0 > slope(end):
            self.peak = max(self.peak, self.force(dense(brentq(slope, begin, end)), mode))


# ------------------------------------------------------------ random cases
@functools.cache
def robot_named(name: str) -> Robot:
    made = {"arm": small_robots.arm, "biped": small_robots.biped, "talos": talos, "standin": standin}
    return small_robots.slider(4.0) if name == "slider" else made[name]()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """A collision in numbers, and `gains` as `collide` takes them."""

    sdc: SDC
    q: Any
    v: Any
    torque: Any
    gains: dict[str, Any]

    def reference(self) -> dict[str, Any]:
        return Reference(self.sdc, self.q, self.v, self.torque, self.gains).run(self.sdc.horizon)

    def collide(self, spacing: float | None = None, **options: Any) -> Any:
        """Exact, or by steps where options of the model are given."""
        exact = ExactCollision(self.sdc, spacing=spacing)
        sdc = dataclasses.replace(self.sdc, **options) if options else exact
        gains = self.gains if self.sdc.effects.stiffness else {"kd": self.gains["kd"]}
        torque = self.torque if self.sdc.effects.feedforward else None
        return sdc.collide(self.q, self.v, torque, require_separation=False, **gains)


def random_case(seed: int, name: str) -> Case:
    """A robot's random collision, whose servo saturates and whose joints stick and slide."""
    rng, robot = np.random.default_rng(seed), robot_named(name)
    model = robot.model
    effects = Effects(**{field.name: bool(rng.random() < 0.75) for field in dataclasses.fields(Effects)})
    friction = JointFriction(
        viscous=rng.uniform(0.0, 3.0, robot.n),
        coulomb=rng.uniform(0.0, 3.0, robot.n),
        transition=10 ** rng.uniform(-1.7, -0.3),
    )
    stiffness = 10 ** rng.uniform(3.3, 4.7)
    damped = SpringDamper(stiffness=stiffness, damping=rng.uniform(0.0, 500.0))
    law = damped if rng.random() < 0.6 else KelvinVoigt(stiffness=stiffness, damping=rng.uniform(0.0, 200.0))
    mass = 10 ** rng.uniform(-0.5, 1.0)
    resistance, bending = rng.uniform(50.0, 400.0), 10 ** rng.uniform(4.0, 5.0)
    target = (
        FreeMass(mass=mass),
        RigidWall(),
        Nail(mass=0.1 * mass, resistance=resistance, hardening=rng.uniform(0.0, 2e4), depth=0.01),
        Board(mass=mass, stiffness=bending, breaking_force=resistance, damping=rng.uniform(0.0, 50.0)),
    )[rng.choice(4, p=[0.4, 0.2, 0.2, 0.2])]
    posture = {"arm": "start", "slider": None}.get(name, "half_sitting")
    q = robot.posture(posture) if posture else np.zeros(robot.nq)
    dq = np.zeros(robot.nv)
    dq[-robot.n :] = rng.uniform(-0.15, 0.15, robot.n)
    normal = np.array([1.0, 0.0, 0.0])
    if robot.floating:
        normal = np.array([1.0, *rng.uniform(-0.3, 0.3, 2)])
        normal /= np.linalg.norm(normal)
    heavy = robot.floating and rng.random() < 0.3
    sdc = SDC(
        robot=robot,
        striker=next(iter(robot.strikers)),
        normal=normal,
        law=law,
        target=target,
        effects=effects,
        friction=friction if effects.friction else None,
        stance=BothSoles(base_mass=1e4, base_inertia=1e3) if heavy else None,
        horizon=0.2,
    )
    q = pin.integrate(model, q, dq)
    frozen = frozen_numbers(sdc, q, np.zeros(robot.nv), 1.0)
    rows = np.vstack([frozen["Jc"], frozen["j"]])
    speed = rng.uniform(0.2, 3.0)
    v = 0.3 * speed * rng.normal(size=robot.nv)
    v += np.linalg.pinv(rows) @ (np.append(np.zeros(len(rows) - 1), speed) - rows @ v)
    torque = rng.normal(scale=0.25, size=robot.n) * robot.torque_limit
    kd = robot.kd * 10 ** rng.uniform(-1.0, 0.5)
    return Case(sdc=sdc, q=q, v=v, torque=torque, gains={"kd": kd, "kp": 30.0 * kd})
