"""The whole-body controller: at every sample a QP for the torques that track the plan on its soles."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.robots.robot import Robot
from impactopt.simulation.controller.aim import Aim
from impactopt.simulation.controller.estimate import StateEstimate
from impactopt.simulation.controller.held import HeldDynamics
from impactopt.simulation.controller.quadratic import TorqueQP
from impactopt.simulation.controller.recovery import Recovery
from impactopt.simulation.controller.sensors import Sensors
from impactopt.simulation.controller.settings import ControllerSettings
from impactopt.simulation.controller.target import Target
from impactopt.simulation.result import Scene
from impactopt.simulation.servo import Servo

__all__ = ["WholeBodyController"]

Array = NDArray[np.float64]
WINDOW = 0.01  # [s] about the blow in which velocity errors are projected
FILTER = 3e-3  # [s] of the hand's force
TOUCH = 20.0  # [N] that the hand feels as a touch
LEVER = 0.1  # [m] by which moments of a sole are compared with its forces
EFFORT = 1e-3  # weight of torques over their limits in the recovery, which has no feed-forward
PRICE, SQUARE = 1e3, 1e3  # of leaving the cones, over the robot's weight: linear, and of its square


class WholeBodyController:
    """Torques of a robot on a scene's soles that follows a reference.

    reference : as of :class:`impactopt.transcription.plan.Trajectory`.
    kp, kd : factors of the feedback's stiffness and damping.  limit : of the torque limits, which it knows.
    seconds : of processor time that each QP took.
    """

    def __init__(
        self,
        robot: Robot,
        reference: Any,
        scene: Scene,
        settings: ControllerSettings,
        *,
        kp: float = 1.0,
        kd: float = 1.0,
        limit: float = 1.0,
    ) -> None:
        self.robot, self.scene, self.settings, self.kp, self.kd = robot, scene, settings, kp, kd
        self.limit = limit * robot.torque_limit
        self.sensors = Sensors(robot, noise=settings.noise, rate=settings.rate, seed=settings.seed)
        self.held = HeldDynamics(robot, scene.soles, scene.striker, scene.normal, np.asarray(reference.q[0]))
        self.data: Any = robot.model.createData()
        self.mass = float(pin.computeTotalMass(robot.model))
        self.weight = 9.81 * max(self.mass, 1e-9)
        self.cones = [self._cone(corners) for corners in scene.corners]
        rows = sum(len(c) for c in self.cones)
        self.qp = TorqueQP(robot.n + 1, rows, iterations=settings.iterations)
        self.seconds: list[float] = []
        stands = robot.floating and bool(scene.soles) and settings.follow == "recover"
        recovery = Recovery(robot, reference, scene, settings) if stands else None
        self.target = Target(robot, reference, scene.striker, spread=settings.spreads, recovery=recovery)
        self.estimate = StateEstimate(robot, scene.soles, np.asarray(reference.q[0]))
        self.loads, self.points = np.ones(len(scene.soles)), np.zeros((len(scene.soles), 3))
        self.acceleration = np.zeros(robot.nv)
        self.felt = 0.0  # [N] at the hand, filtered
        self.springs = Servo(robot, reference).springs
        # what motors steer: springs are not followed, nor where a tool swings on them
        self.passive = robot.passive
        self.steered: Array = np.append(np.ones(robot.nv - robot.n), 1.0 - self.passive)

    def miss(self, reference: Any) -> None:
        """What it tracks from now on, as it has hit nothing."""
        self.target = Target(self.robot, reference, self.scene.striker, spread=False)

    def torque(self, t: float, angles: Array, v: Array, rotation: Array, force: float) -> Array:
        """Torque demand (n,) [N m] at a time [s], from what the sensors make of the true state."""
        s = self.settings
        measured = self.sensors.read(angles, v, rotation, force)
        q, rates = self.estimate.of(measured, self.loads, self.points)
        ahead = s.delay
        q = pin.integrate(self.robot.model, q, ahead * rates)
        rates = rates + ahead * self.acceleration
        self.felt += (1 - np.exp(-s.period / FILTER)) * (measured.force - self.felt)
        self.target.feel(t, measured.force > TOUCH)
        aim = self.target.at(t + ahead)
        self.held.look(q, rates, self.felt, s.sole_bandwidth)
        if self.passive.any():
            angles = self.robot.joint_positions(q)
            self.held.pulled(self.passive, self.springs(angles, rates[-self.robot.n :]))
        x = self._solve(t, q, rates, aim)
        torque = self.limit * x[:-1]
        self._remember(torque)
        return torque

    def _solve(self, t: float, q: Array, v: Array, aim: Aim) -> Array:
        held, s, n = self.held, self.settings, self.robot.n
        recovers = self.target.recovers(t + s.delay)
        struck = s.impact == "planned" and self.target.struck and not recovers
        off = pin.difference(self.robot.model, q, aim.q)
        lag = aim.v - v
        rate_error = lag[-n:]
        if s.projects and self.target.near_blow(t, WINDOW):
            row = self.scene.normal @ held.hand
            lag = lag - held.recoil * (row @ lag) / (row @ held.recoil)
        A, B = held.A * self.limit, held.B * self.limit  # of torques over their limits
        P, g = np.zeros((n + 1, n + 1)), np.zeros(n + 1)

        def task(weight: float | Array, rows: Array, now: Array, wanted: Array) -> None:
            weighted = (np.asarray(weight) * rows.T).T if np.ndim(weight) else weight * rows
            P[:n, :n] += rows.T @ weighted
            g[:n] += weighted.T @ (now - wanted)

        w = s.recovery_bandwidth if recovers else s.posture_bandwidth
        posture = (0.0 if struck else s.posture) * self.steered
        task(posture, A, held.a0, aim.a + self.kp * w**2 * off + self.kd * 2 * w * lag)
        w, hand, swing = s.hand_bandwidth, held.hand * self.steered, held.hand * (1.0 - self.steered)
        away = aim.hand[0] - held.hand_place - swing @ off
        weight = s.hand if self.target.before else 0.0
        if self.target.bounced and self.robot.sprung.any() and not recovers:
            # a tool swings on in a soft grip, and would touch again
            weight, away = s.hand, away - s.draw_back * self.scene.normal
        wanted = aim.hand[2] - swing @ aim.a + self.kp * w**2 * away + self.kd * 2 * w * (hand @ lag)
        task(weight, hand @ A, hand @ held.a0 + held.hand_drift, wanted)
        rate, lift = np.zeros(6), np.zeros((6, 0))
        if self.robot.floating and self.cones:
            rate, lift = self._momentum(q, v, lag, aim, B, task, recovers)
        feed = aim.torque
        if struck:  # what the plan counts on in contact
            feed = feed + self.kp * self.robot.kp * off[-n:] + self.kd * self.robot.kd * rate_error
        weight = s.blow if struck else (EFFORT if recovers else s.torque)
        task(weight, np.eye(n), np.zeros(n), feed / self.limit)
        if self.cones:
            share = np.tile(np.repeat([1.0, 1.0 / LEVER], 3), len(self.cones)) / self.weight
            now, goal = held.back, B @ (feed / self.limit)
            if recovers:  # what makes the momentum's rate with the least wrenches
                spread = lift / share**2
                now, goal = held.b0, spread.T @ np.linalg.solve(spread @ lift.T, rate)
            task(s.wrench, share[:, None] * B, share * now, share * goal)
        P[n, n], g[n] = SQUARE, PRICE
        C, c = self._rows(B)
        low, high = -np.ones(n + 1), np.ones(n + 1)
        low[n], high[n] = 0.0, 1e3
        begun = time.process_time()
        x = self.qp.solve(P, g, C, c, low, high)
        self.seconds.append(time.process_time() - begun)
        return x

    def _momentum(
        self, q: Array, v: Array, lag: Array, aim: Aim, B: Array, task: Any, recovers: bool
    ) -> tuple[Array, Array]:
        """Rows of the centre of mass and of the angular momentum, whose rates are the soles' wrenches.

        What all wrenches are to make (6,), over the mass, and rows (6, 6 a sole) from wrenches to that.
        """
        held, s, model, data = self.held, self.settings, self.robot.model, self.data
        Ag = pin.ccrba(model, data, q, v)
        mass, com = self.mass, data.com[0]
        lift: Array = np.zeros((6, 6 * len(self.cones)))
        for k, place in enumerate(held.places):
            lift[:3, 6 * k : 6 * k + 3] = np.eye(3)
            lift[3:, 6 * k : 6 * k + 3] = pin.skew(place.translation - com)
            lift[3:, 6 * k + 3 : 6 * k + 6] = np.eye(3)
        lift /= mass
        rows, now = lift @ B, lift @ held.b0
        now[:3] += model.gravity.linear
        # the divergent component of motion: com + rate / omega
        gain, omega = s.capture_gain, np.sqrt(9.81 / max(com[2], 0.1))
        error = Ag @ lag
        if recovers:  # the centre of mass has an aim of its own, the joints' motion does not bring it there
            error[:3] = mass * aim.com[1] - data.hg.linear
        wanted = np.zeros(6)
        wanted[:3] = (
            aim.com[2]
            + self.kp * omega * gain * (aim.com[0] - com)
            + self.kd * (omega + gain) * error[:3] / mass
        )
        wanted[3:] = (aim.momentum[1] + s.momentum_gain * error[3:]) / mass
        weight = np.repeat([s.com, s.angular_momentum], 3)
        task(weight, rows, now, wanted)
        wanted[:3] -= model.gravity.linear
        return wanted, lift

    def _cone(self, corners: Array) -> Array:
        """Rows (k, 6) that are >= 0 of a wrench that a sole can have, in its frame.

        Its edges' rows are its own; those of torsion are of the rectangle with its extents (Caron, Pham,
        Nakamura, "Stability of surface contacts for humanoid robots", ICRA 2015).
        """
        s, mu = self.settings, self.settings.friction
        edge = np.roll(corners, -1, axis=0) - corners
        inward = np.stack([-edge[:, 1], edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
        least = (inward * corners).sum(axis=1) + s.cop_margin
        (x0, y0), (x1, y1) = corners.min(axis=0), corners.max(axis=0)
        X, Y, cx, cy = (x1 - x0) / 2, (y1 - y0) / 2, (x0 + x1) / 2, (y0 + y1) / 2
        # the wrench at the rectangle's centre
        shift = np.eye(6)
        shift[3:, :3] = -pin.skew(np.array([cx, cy, 0.0]))
        rows = [[0.0, 0, 1, 0, 0, 0]]
        rows += [[i * a, (1 - i) * a, mu, 0, 0, 0] for i in (0, 1) for a in (1, -1)]
        for turn in (1, -1):
            for a in (1, -1):
                for b in (1, -1):
                    f, m = [a * Y, b * X, mu * (X + Y)], [-turn * a * mu, -turn * b * mu, turn]
                    rows.append([*f, *m])
        out = np.array(rows, dtype=float) @ shift
        edges = [[0, 0, -c, n[1], -n[0], 0] for n, c in zip(inward, least, strict=True)]
        return np.vstack([out, np.array(edges, dtype=float)])

    def _rows(self, B: Array) -> tuple[Array, Array]:
        """Rows of the cones in torques and in what they may be left by, over the robot's weight."""
        n = self.robot.n
        C, c = np.zeros((self.qp.m, n + 1)), np.zeros(self.qp.m)
        at = 0
        for k, (cone, place) in enumerate(zip(self.cones, self.held.places, strict=True)):
            turned = cone.copy()
            turned[:, :3], turned[:, 3:] = cone[:, :3] @ place.rotation.T, cone[:, 3:] @ place.rotation.T
            rows = slice(at, at + len(cone))
            C[rows, :n] = turned @ B[6 * k : 6 * k + 6]
            c[rows] = -turned @ self.held.b0[6 * k : 6 * k + 6]
            c[rows.start] += self.settings.least_force
            at = rows.stop
        C[:, :n] /= self.weight
        C[:, n] = 1.0
        return C, c / self.weight

    def _remember(self, torque: Array) -> None:
        """What is expected until the next sample: accelerations, and where the soles are pressed."""
        held = self.held
        self.acceleration = held.A @ torque + held.a0
        wrench = held.B @ torque + held.b0
        for k, (place, corners) in enumerate(zip(held.places, self.scene.corners, strict=True)):
            force, moment = (
                place.rotation.T @ wrench[6 * k : 6 * k + 3],
                place.rotation.T @ wrench[6 * k + 3 : 6 * k + 6],
            )
            self.loads[k] = max(force[2], 1e-3 * self.weight)
            low, high = corners.min(axis=0), corners.max(axis=0)
            pressed = np.array([-moment[1], moment[0]]) / self.loads[k]
            self.points[k, :2] = np.clip(pressed, low, high)
