"""Reference of the controller: the plan's motion, switched by the impact that the hand senses.

On its way to rest a plan may bring the capture point to the soles' edges, and joints to their torque limits.
At a slower pace the same postures need less, and legs that shift the body keep the capture point away from
edges.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.robots.checks import columns_above
from impactopt.robots.robot import Robot
from impactopt.simulation.controller.settings import ControllerSettings
from impactopt.simulation.result import Scene, distance_inside, stance_at, stance_begins

__all__ = ["Aim", "Recovery", "Target"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Aim:
    """q (nq,), v, a (nv,), torque (n,); com, its rate and acceleration (3,) each, momentum: angular about it,
    and its rate; hands (h, 3, 3): place, rate and acceleration of each striking point.
    """

    q: Array
    v: Array
    a: Array
    torque: Array
    com: Array
    momentum: Array
    hands: Array


STEPS = 30  # of Gauss-Newton, from the plan's last posture
LARGEST = 0.2  # [rad] of one
SMALLEST = 1e-3  # singular value that counts, of the largest
PARTS = (1.0, 0.75, 0.5, 0.25)  # of the shift, the most that keeps links apart
CLEAR = 3e-3  # [m] between links
SAFE = 0.015  # [m] of the capture point to the soles' edges
LOOK = 0.05  # [s] at which that is looked at
BRAKING = 0.15  # [s] from the plan's pace to the slower one
_AXES = pin.LOCAL_WORLD_ALIGNED


class Recovery:
    """place (2,) [m] : where the centre of mass goes.  shift (nv,) : of the postures, by legs and base.

    It begins `start` [s] after the blow.
    """

    def __init__(self, robot: Robot, reference: Any, scene: Scene, settings: ControllerSettings) -> None:
        self.model, self.start, self.pace = robot.model, settings.recovery_start, settings.recovery_pace
        last = np.asarray(reference.q[-1])
        shift = np.zeros(robot.nv)
        if not scene.hands:  # they would be torn off
            stood = np.asarray(reference.q[stance_begins(reference, stance_at(reference, np.inf))])
            q = _moved(robot, last, stood, scene, settings.recovery_margin)
            shift = np.array(pin.difference(self.model, last, q))
        self.shift = shift * _clear_part(self.model, reference, scene, shift)
        q = pin.integrate(self.model, last, self.shift)
        self.place = np.array(pin.centerOfMass(self.model, self.model.createData(), q)[:2])

    def clock(self, since: float) -> tuple[float, float, float]:
        """Progress in the plan [s] at a time since the recovery began, with its first and second rate."""
        slower, braked = 1.0 - self.pace, min(since, BRAKING)
        gone = since - slower * (braked**2 / (2 * BRAKING) + since - braked)
        brakes = since < BRAKING
        return gone, 1.0 - slower * braked / BRAKING, -slower / BRAKING if brakes else 0.0

    def of(self, aim: Aim, rate: float, gain: float) -> Aim:
        """The plan's at this rate and second rate, shifted, with the centre of mass at its place."""
        com, momentum = aim.com, aim.momentum
        com_aim = np.zeros((3, 3))
        com_aim[0, :2] = self.place
        com_aim[:, 2] = com[0, 2], rate * com[1, 2], rate**2 * com[2, 2] + gain * com[1, 2]
        return Aim(
            q=np.array(pin.integrate(self.model, aim.q, self.shift)),
            v=rate * aim.v,
            a=rate**2 * aim.a + gain * aim.v,
            torque=np.zeros_like(aim.torque),
            com=com_aim,
            momentum=np.array([rate * momentum[0], rate**2 * momentum[1] + gain * momentum[0]]),
            hands=aim.hands,
        )


def _clear_part(model: Any, reference: Any, scene: Scene, shift: Array) -> float:
    """Fraction of a shift (nv,) of the postures after the blow that leaves links as far apart as planned, or
    by `CLEAR`: legs that shift the body may bring thighs together. All of it, if the plan's capture point
    comes nearer to the soles' edges than `SAFE`: a robot that touches itself still stands.
    """
    time, postures = np.asarray(reference.time), np.asarray(reference.q)
    looked = np.arange(float(reference.contact_end), float(time[-1]) + LOOK, LOOK)
    rows = np.searchsorted(time, looked).clip(0, len(time) - 1)
    q = postures[rows]
    v, data = np.asarray(reference.v)[rows], model.createData()
    capture = [_capture_point(model, data, *state) for state in zip(q, v, strict=True)]
    if distance_inside(scene.polygon, np.array(capture)).min() < SAFE:
        return 1.0
    links = scene.solids.links_between(model, shift)
    least = np.minimum(links.apart(model, q), CLEAR)
    for part in PARTS:
        moved = np.array([pin.integrate(model, row, part * shift) for row in q])
        if np.all(links.apart(model, moved) >= least):
            return part
    return 0.0


def _capture_point(model: Any, data: Any, q: Array, v: Array) -> Array:
    """(2,) [m] on the ground."""
    com = pin.centerOfMass(model, data, q, v)
    return np.asarray(com[:2] + data.vcom[0][:2] * np.sqrt(com[2] / np.linalg.norm(model.gravity.linear)))


def _inside(scene: Scene, com: Array, margin: float) -> Array:
    """The place (2,) [m] next to com (2,), on the way to the soles' middle, with a margin [m] to their edges;
    else the middle.
    """
    middle = (scene.polygon.min(axis=0) + scene.polygon.max(axis=0)) / 2
    has, most = distance_inside(scene.polygon, np.stack([com, middle]))
    way = 1.0 if most <= margin else np.clip((margin - has) / (most - has), 0.0, 1.0)
    return np.asarray(com + way * (middle - com))


def _moved(robot: Robot, q: Array, q0: Array, scene: Scene, margin: float) -> Array:
    """q (nq,), moved by base and legs until the centre of mass is inside the soles by a margin [m]; these are
    where q0 has them, and the base keeps its orientation.
    """
    model, data = robot.model, robot.model.createData()
    soles = [model.getFrameId(name) for name in scene.soles]
    pin.framesForwardKinematics(model, data, q0)
    stood = [data.oMf[i].copy() for i in soles]
    upright = pin.Quaternion(q[3:7]).toRotationMatrix()
    place = _inside(scene, np.array(pin.centerOfMass(model, data, q)[:2]), margin)
    moves = np.zeros(robot.nv)
    moves[:6] = 1.0
    for i in soles:
        moves[columns_above(model, model.frames[i].parentJoint)] = 1.0
    turns = np.zeros((3, robot.nv))
    for _ in range(STEPS):
        now = pin.Quaternion(q[3:7]).toRotationMatrix()
        turns[:, 3:6] = now
        com = pin.centerOfMass(model, data, q)
        rows, off = [pin.jacobianCenterOfMass(model, data, q)[:2], turns], [place - com[:2]]
        off.append(pin.log3(upright @ now.T))
        pin.computeJointJacobians(model, data, q)
        for i, sole in zip(soles, stood, strict=True):
            at = pin.updateFramePlacement(model, data, i)
            rows.append(np.array(pin.getFrameJacobian(model, data, i, _AXES)))
            off += [sole.translation - at.translation, pin.log3(sole.rotation @ at.rotation.T)]
        step = np.linalg.lstsq(np.vstack(rows) * moves, np.concatenate(off), rcond=SMALLEST)[0]
        q = pin.integrate(model, q, step * min(1.0, LARGEST / max(float(np.abs(step).max()), LARGEST)))
    return np.asarray(q)


PATIENCE = 0.02  # [s] beyond twice the planned contact; then the motion after it begins in any case


class Target:
    """The reference of a plan, sampled, on the clock of what has happened.

    reference : time (k,), q, v, a, torque, contact_start, contact_end, as of
        :class:`impactopt.transcription.plan.Trajectory`.
    spread : the motion before the blow goes on until the hand is free again, and then that after it begins.
    recovery : what becomes of the follow-through; None: it stays as planned.
    """

    def __init__(
        self,
        robot: Robot,
        reference: Any,
        strikers: tuple[str, ...],
        *,
        spread: bool,
        recovery: Recovery | None = None,
    ) -> None:
        self.model, self.spread, self.recovery = robot.model, spread, recovery
        self._n, self._nv = robot.n, robot.nv
        self.time = np.asarray(reference.time)
        self.q, self.v = np.asarray(reference.q), np.asarray(reference.v)
        self.contact = float(reference.contact_start), float(reference.contact_end)
        data, frames = self.model.createData(), [self.model.getFrameId(name) for name in strikers]
        self.rows = np.array([self._row(data, reference, k, frames) for k in range(len(self.time))])
        self.felt = self.free = np.nan  # [s] when the hand began and ceased to feel a force
        jump = np.flatnonzero(np.diff(self.time) == 0)
        after = jump[self.time[jump] >= self.contact[1] - 1e-9]
        self.last = int(after[0]) if after.size else len(self.time) - 1  # of the motion before

    def _row(self, data: Any, r: Any, k: int, frames: list[int]) -> Array:
        model = self.model
        q, v, a = r.q[k], r.v[k], r.a[k]
        pin.computeCentroidalMomentumTimeVariation(model, data, q, v, a)
        mass = max(float(pin.computeTotalMass(model)), 1e-9)
        h, dh = data.hg, data.dhg
        hands = []
        for i in frames:
            hands.append(pin.updateFramePlacement(model, data, i).translation)
            hands.append(pin.getFrameVelocity(model, data, i, pin.LOCAL_WORLD_ALIGNED).linear)
            hands.append(pin.getFrameClassicalAcceleration(model, data, i, pin.LOCAL_WORLD_ALIGNED).linear)
        com = data.com[0]
        parts = (
            v,
            a,
            r.torque[k],
            com,
            h.linear / mass,
            dh.linear / mass,
            h.angular,
            dh.angular,
            *hands,
        )
        return np.concatenate(parts)

    def feel(self, t: float, touching: bool) -> None:
        """Updates the contact state from the hand's sensor at a time [s]."""
        if touching and self.before:
            self.felt = t
        elif not touching and self.struck:
            self.free = t

    @property
    def before(self) -> bool:
        """True if the hand has sensed no contact yet."""
        return math.isnan(self.felt)

    @property
    def bounced(self) -> bool:
        """True if the hand was in contact, and is free again."""
        return math.isfinite(self.free)

    @property
    def struck(self) -> bool:
        """True if the hand is in contact, for the first time."""
        return math.isfinite(self.felt) and math.isnan(self.free)

    def near_blow(self, t: float, window: float) -> bool:
        """True during the impact and within a window [s] of it."""
        if math.isfinite(self.felt):
            return math.isnan(self.free) or t < self.free + window
        return bool(self.contact[0] - window <= t <= self.contact[1] + window)

    @property
    def over(self) -> float:
        """[s] when the blow is over, at the latest; nan: the hand has felt nothing yet."""
        start, end = self.contact
        return self.free if math.isfinite(self.free) else self.felt + 2 * (end - start) + PATIENCE

    def recovers(self, t: float) -> bool:
        """True once the robot recovers from the impact."""
        return self.recovery is not None and bool(t >= self.over + self.recovery.start)

    def clock(self, t: float) -> tuple[float, int]:
        """Time [s] in the reference, and the last row that it may take."""
        end, final = self.contact[1], len(self.time) - 1
        if not self.spread:
            return t, final
        if math.isfinite(self.felt):
            return (t, self.last) if t < self.over else (end + t - self.over, final)
        return (t, self.last) if t < end + PATIENCE else (t, final)

    def at(self, t: float) -> Aim:
        """Reference at a time [s]."""
        if self.recovery is None or not self.recovers(t):
            return self._planned(*self.clock(t))
        begun = self.over + self.recovery.start
        gone, rate, gain = self.recovery.clock(t - begun)
        now, last = self.clock(begun)
        return self.recovery.of(self._planned(now + gone, last), rate, gain)

    def _planned(self, now: float, last: int) -> Aim:
        i = int(np.searchsorted(self.time[: last + 1], now, side="right")) - 1
        i = min(max(i, 0), last - 1)
        span = self.time[i + 1] - self.time[i]
        f = (now - self.time[i]) / span if span > 0 else 1.0
        beyond = max(now - self.time[last], 0.0) if last < len(self.time) - 1 else 0.0
        f = min(f, 1.0)
        row = (1 - f) * self.rows[i] + f * self.rows[i + 1]
        q = pin.interpolate(self.model, self.q[i], self.q[i + 1], f)
        n, nv = self._n, self._nv
        v, a, torque = row[:nv], row[nv : 2 * nv], row[2 * nv : 2 * nv + n]
        rest = row[2 * nv + n :]
        com, momentum, hands = rest[:9], rest[9:15], rest[15:].reshape(-1, 3, 3)
        if beyond:  # the motion before the blow coasts on
            q = pin.integrate(self.model, q, beyond * v)
            com = np.concatenate([com[:3] + beyond * com[3:6], com[3:]])
            hands = hands.copy()
            hands[:, 0] += beyond * hands[:, 1]
        return Aim(q, v, a, torque, com.reshape(3, 3), momentum.reshape(2, 3), hands)
