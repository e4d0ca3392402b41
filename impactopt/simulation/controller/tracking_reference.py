"""Reference of the controller: the plan's motion, switched by the impact that the hand senses.

On its way to rest a plan may bring the capture point to the soles' edges, and joints to their torque limits.
The recovery plays the same postures at a slower pace, which needs less torque, and has the legs shift the
body, which keeps the capture point away from the edges.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from impactopt.arrays import Array
from impactopt.robots.checks import columns_above
from impactopt.robots.robot import Robot
from impactopt.simulation.controller.settings import ControllerSettings
from impactopt.simulation.result import Scene, distance_inside, stance_at, stance_begins


@dataclass(frozen=True)
class ReferenceSample:
    """Reference at an instant.

    q (nq,), v, a (nv,), torque (n,) : of the robot
    com (3, 3) : centre of mass, its velocity and acceleration
    angular_momentum (2, 3) : about the centre of mass, and its rate
    striking_points (h, 3, 3) : position, velocity and acceleration of each
    """

    q: Array
    v: Array
    a: Array
    torque: Array
    com: Array
    angular_momentum: Array
    striking_points: Array


# Gauss-Newton iterations from the plan's last posture to the shifted one
ITERATIONS = 30
MAX_STEP = 0.2  # [rad] of a coordinate in one iteration
RELATIVE_RANK_TOLERANCE = 1e-3  # smaller singular values, relative to the largest, count as zero
SHIFT_FRACTIONS = (1.0, 0.75, 0.5, 0.25)  # tried in turn, until links stay apart
LINK_CLEARANCE = 3e-3  # [m] between links
MIN_CAPTURE_MARGIN = 0.015  # [m] of the capture point to the soles' edges
SAMPLING = 0.05  # [s] between the instants at which clearance and capture point are checked
BRAKING = 0.15  # [s] from the plan's pace to the slower one
_AXES = pin.LOCAL_WORLD_ALIGNED


class Recovery:
    """Slower follow-through with shifted postures, which begins ``start`` [s] after the impact.

    com_goal (2,) [m] : where the centre of mass goes.  shift (nv,) : of all postures, by legs and base.
    """

    def __init__(self, robot: Robot, reference: Any, scene: Scene, settings: ControllerSettings) -> None:
        self.model, self.start, self.pace = robot.model, settings.recovery_start, settings.recovery_pace
        last = np.asarray(reference.q[-1])
        shift = np.zeros(robot.nv)
        if not scene.hands:  # a shift would tear off supporting hands
            stance = stance_at(reference, np.inf)
            standing = np.asarray(reference.q[stance_begins(reference, stance)])
            q = _shifted_posture(robot, last, standing, scene, stance, settings.recovery_margin)
            shift = np.array(pin.difference(self.model, last, q))
        self.shift = shift * _clear_fraction(robot, reference, scene, shift)
        q = pin.integrate(self.model, last, self.shift)
        self.com_goal = np.array(pin.centerOfMass(self.model, self.model.createData(), q)[:2])

    def progress(self, since: float) -> tuple[float, float, float]:
        """Time [s] passed in the plan, its rate and second rate, at a time since the recovery began.

        The rate falls linearly from 1 to the recovery's pace during `BRAKING`.
        """
        slower, braked = 1.0 - self.pace, min(since, BRAKING)
        # the integral of the rate below
        passed = since - slower * (braked**2 / (2 * BRAKING) + since - braked)
        brakes = since < BRAKING
        return passed, 1.0 - slower * braked / BRAKING, -slower / BRAKING if brakes else 0.0

    def apply(self, sample: ReferenceSample, rate: float, second_rate: float) -> ReferenceSample:
        """The plan's sample at another rate of time, shifted, with the centre of mass at its goal."""
        com, (momentum, momentum_rate) = sample.com, sample.angular_momentum
        com_aim = np.zeros((3, 3))
        com_aim[0, :2] = self.com_goal  # at rest there; only the height follows the plan
        com_aim[:, 2] = com[0, 2], rate * com[1, 2], rate**2 * com[2, 2] + second_rate * com[1, 2]
        return ReferenceSample(
            q=np.array(pin.integrate(self.model, sample.q, self.shift)),
            v=rate * sample.v,
            # chain rule of q(passed(t)); so for the centre of mass and the momentum
            a=rate**2 * sample.a + second_rate * sample.v,
            torque=np.zeros_like(sample.torque),
            com=com_aim,
            angular_momentum=np.array([rate * momentum, rate**2 * momentum_rate + second_rate * momentum]),
            striking_points=sample.striking_points,
        )


def _clear_fraction(robot: Robot, reference: Any, scene: Scene, shift: Array) -> float:
    """Largest of `SHIFT_FRACTIONS` of a shift (nv,) that keeps links apart after the impact; else 0.

    Links stay as far apart as planned, or by `LINK_CLEARANCE`: legs that shift the body may bring thighs
    together. If the plan's capture point comes nearer to the soles' edges than `MIN_CAPTURE_MARGIN`, the
    fraction is 1: a robot that touches itself still stands.
    """
    time, postures = np.asarray(reference.time), np.asarray(reference.q)
    sampled = np.arange(float(reference.contact_end), float(time[-1]) + SAMPLING, SAMPLING)
    instants = np.searchsorted(time, sampled).clip(0, len(time) - 1)
    q = postures[instants]
    v, model = np.asarray(reference.v)[instants], robot.model
    data = model.createData()
    inside = [
        distance_inside(scene.polygon_of(stance_at(reference, t)), robot.capture_point(data, *state)[None])[0]
        for t, *state in zip(sampled, q, v, strict=True)
    ]
    if min(inside) < MIN_CAPTURE_MARGIN:
        return 1.0
    links = scene.solids.links_between(model, shift)
    required = np.minimum(links.least_distance(model, q), LINK_CLEARANCE)
    for fraction in SHIFT_FRACTIONS:
        shifted = np.array([pin.integrate(model, posture, fraction * shift) for posture in q])
        if np.all(links.least_distance(model, shifted) >= required):
            return fraction
    return 0.0


def _com_goal(polygon: Array, com: Array, margin: float) -> Array:
    """Point (2,) [m] next to com (2,), towards the soles' centre, with a margin [m] to their edges.

    It is the centre, if that has no such margin.
    """
    centre = (polygon.min(axis=0) + polygon.max(axis=0)) / 2
    has, most = distance_inside(polygon, np.stack([com, centre]))
    # distance from the edges is concave, so this point has at least the margin
    fraction = 1.0 if most <= margin else np.clip((margin - has) / (most - has), 0.0, 1.0)
    return np.asarray(com + fraction * (centre - com))


def _shifted_posture(robot: Robot, q: Array, q0: Array, scene: Scene, stance: int, margin: float) -> Array:
    """q (nq,), shifted by base and legs until the centre of mass is inside the soles by a margin [m].

    The soles that stand in a stance phase stay where q0 has them, and the base keeps its orientation.
    """
    model, data = robot.model, robot.model.createData()
    soles = [model.getFrameId(scene.soles[k]) for k in scene.standing_soles(stance)]
    pin.framesForwardKinematics(model, data, q0)
    fixed = [data.oMf[i].copy() for i in soles]
    upright = pin.Quaternion(q[3:7]).toRotationMatrix()
    goal = _com_goal(scene.polygon_of(stance), np.array(pin.centerOfMass(model, data, q)[:2]), margin)
    free = np.zeros(robot.nv)  # 1: base and joints between base and soles
    free[:6] = 1.0
    for i in soles:
        free[columns_above(model, model.frames[i].parentJoint)] = 1.0
    base_rotation = np.zeros((3, robot.nv))  # Jacobian of the base's orientation, world axes
    for _ in range(ITERATIONS):
        now = pin.Quaternion(q[3:7]).toRotationMatrix()
        base_rotation[:, 3:6] = now
        com = pin.centerOfMass(model, data, q)
        jacobians, errors = [pin.jacobianCenterOfMass(model, data, q)[:2], base_rotation], [goal - com[:2]]
        errors.append(pin.log3(upright @ now.T))
        pin.computeJointJacobians(model, data)
        for i, sole in zip(soles, fixed, strict=True):
            at = pin.updateFramePlacement(model, data, i)
            jacobians.append(np.array(pin.getFrameJacobian(model, data, i, _AXES)))
            errors += [sole.translation - at.translation, pin.log3(sole.rotation @ at.rotation.T)]
        J, error = np.vstack(jacobians) * free, np.concatenate(errors)
        step = np.linalg.lstsq(J, error, rcond=RELATIVE_RANK_TOLERANCE)[0]
        q = pin.integrate(model, q, step * min(1.0, MAX_STEP / max(float(np.abs(step).max()), MAX_STEP)))
    return np.asarray(q)


MAX_OVERTIME = 0.02  # [s] beyond twice the planned contact, after which the impact counts as over


class TrackingReference:
    """A plan's reference, sampled on a clock that the sensed contact sets.

    reference : time (k,), q, v, a, torque, contact_start, contact_end, as
        :class:`impactopt.transcription.plan.Trajectory`.
    spread : reference spreading: the motion before the impact goes on until the hand is free again; then
        that after it begins.
    recovery : replaces the follow-through; None: it stays as planned.
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
        self._samples = np.array([self._sample(data, reference, k, frames) for k in range(len(self.time))])
        self.contact_began = self.contact_ended = np.nan  # [s] as sensed
        # a time that stands twice is a jump of velocities: the first one after contact ends the motion before
        jumps = np.flatnonzero(np.diff(self.time) == 0)
        after = jumps[self.time[jumps] >= self.contact[1] - 1e-9]
        self._last_before = int(after[0]) if after.size else len(self.time) - 1

    def _sample(self, data: Any, r: Any, k: int, frames: list[int]) -> Array:
        """All of a sample but q, in one array that can be interpolated linearly."""
        model = self.model
        q, v, a = r.q[k], r.v[k], r.a[k]
        pin.computeCentroidalMomentumTimeVariation(model, data, q, v, a)
        mass = max(float(pin.computeTotalMass(model)), 1e-9)
        h, dh = data.hg, data.dhg
        points = []
        for i in frames:
            points.append(pin.updateFramePlacement(model, data, i).translation)
            points.append(pin.getFrameVelocity(model, data, i, _AXES).linear)
            points.append(pin.getFrameClassicalAcceleration(model, data, i, _AXES).linear)
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
            *points,
        )
        return np.concatenate(parts)

    def update_contact(self, t: float, touching: bool) -> None:
        """Updates the contact state from the hand's sensor at a time [s]."""
        if touching and self.before_contact:
            self.contact_began = t
        elif not touching and self.in_contact:
            self.contact_ended = t

    @property
    def before_contact(self) -> bool:
        """True if the hand has sensed no contact yet."""
        return math.isnan(self.contact_began)

    @property
    def in_contact(self) -> bool:
        """True if the hand is in contact, for the first time."""
        return math.isfinite(self.contact_began) and math.isnan(self.contact_ended)

    @property
    def bounced(self) -> bool:
        """True if the hand was in contact, and is free again."""
        return math.isfinite(self.contact_ended)

    def near_impact(self, t: float, window: float) -> bool:
        """True during the impact and within a window [s] of it."""
        if math.isfinite(self.contact_began):
            return math.isnan(self.contact_ended) or t < self.contact_ended + window
        return bool(self.contact[0] - window <= t <= self.contact[1] + window)

    @property
    def impact_over(self) -> float:
        """Time [s] at which the impact counts as over at the latest; nan before the sensed contact."""
        start, end = self.contact
        if math.isfinite(self.contact_ended):
            return self.contact_ended
        return self.contact_began + 2 * (end - start) + MAX_OVERTIME

    def recovers(self, t: float) -> bool:
        """True once the robot recovers from the impact."""
        return self.recovery is not None and bool(t >= self.impact_over + self.recovery.start)

    def clock(self, t: float) -> tuple[float, int]:
        """Time [s] in the reference, and the last instant of it that may be used."""
        end, final = self.contact[1], len(self.time) - 1
        if not self.spread:
            return t, final
        over = self.impact_over
        if math.isfinite(over):
            return (t, self._last_before) if t < over else (end + t - over, final)
        # the planned contact has not come yet, or was missed
        return (t, self._last_before) if t < end + MAX_OVERTIME else (t, final)

    def at(self, t: float) -> ReferenceSample:
        """Reference at a time [s]."""
        if self.recovery is None or not self.recovers(t):
            return self._planned(*self.clock(t))
        begun = self.impact_over + self.recovery.start
        passed, rate, second_rate = self.recovery.progress(t - begun)
        now, last = self.clock(begun)
        return self.recovery.apply(self._planned(now + passed, last), rate, second_rate)

    def _planned(self, now: float, last: int) -> ReferenceSample:
        """The plan at a time [s], with no instant used after the one numbered last."""
        i = int(np.searchsorted(self.time[: last + 1], now, side="right")) - 1
        i = min(max(i, 0), last - 1)
        span = self.time[i + 1] - self.time[i]
        f = (now - self.time[i]) / span if span > 0 else 1.0
        beyond = max(now - self.time[last], 0.0) if last < len(self.time) - 1 else 0.0
        f = min(f, 1.0)
        sample = (1 - f) * self._samples[i] + f * self._samples[i + 1]
        q = pin.interpolate(self.model, self.q[i], self.q[i + 1], f)
        n, nv = self._n, self._nv
        v, a, torque = sample[:nv], sample[nv : 2 * nv], sample[2 * nv : 2 * nv + n]
        rest = sample[2 * nv + n :]
        com, momentum, points = rest[:9], rest[9:15], rest[15:].reshape(-1, 3, 3)
        if beyond:  # the motion before the impact coasts on at its last velocity
            q = pin.integrate(self.model, q, beyond * v)
            com = np.concatenate([com[:3] + beyond * com[3:6], com[3:]])
            points = points.copy()
            points[:, 0] += beyond * points[:, 1]
        return ReferenceSample(q, v, a, torque, com.reshape(3, 3), momentum.reshape(2, 3), points)
