"""The whole-body controller: at every sample a QP for the torques that track the plan on its soles."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.linalg.lapack import dgesv

from impactopt.robots.robot import Robot
from impactopt.simulation.controller.clearance import MOST, Clearance
from impactopt.simulation.controller.cones import Cones
from impactopt.simulation.controller.constrained_dynamics import HeldDynamics
from impactopt.simulation.controller.estimate import StateEstimate
from impactopt.simulation.controller.quadratic import TorqueQP
from impactopt.simulation.controller.recovery import Recovery
from impactopt.simulation.controller.sensors import Sensors
from impactopt.simulation.controller.setpoint import Aim
from impactopt.simulation.controller.settings import ControllerSettings
from impactopt.simulation.controller.tracking_reference import Target
from impactopt.simulation.result import Scene
from impactopt.simulation.servo import Servo

__all__ = ["Tasks", "WholeBodyController"]

Array = NDArray[np.float64]
WINDOW = 0.01  # [s] about the blow in which velocity errors are projected
FILTER = 3e-3  # [s] of the hand's force
TOUCH = 20.0  # [N] that the hand feels as a touch
LEVER = 0.1  # [m] by which moments of a sole are compared with its forces
EFFORT = 1e-3  # weight of torques over their limits in the recovery, which has no feed-forward
FAST = 10.0  # [m/s^2] by which clearance constraints are scaled
PRICE, SQUARE = 1e3, 1e3  # of leaving the cones, over the robot's weight, and those: linear, and of squares


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
        q0 = np.asarray(reference.q[0])
        self.held = HeldDynamics(robot, scene.soles, scene.strikers, scene.normal, q0, holding=scene.hands)
        self.data: Any = robot.model.createData()
        self.mass = float(pin.computeTotalMass(robot.model))
        self.weight = 9.81 * max(self.mass, 1e-9)
        n, soles, held = robot.n, len(scene.soles), len(scene.soles) + len(scene.hands)
        self.n, self.gravity = n, np.array(robot.model.gravity.linear)
        self.balances = robot.floating and soles > 0
        self.cones = Cones(scene.corners, settings, n, self.weight)
        self.tasks = Tasks(n, robot.nv + 3 * len(scene.strikers) + 6 * self.balances + 6 * held)
        self.clearance = Clearance(robot.model, scene.solids, period=settings.period)
        # torques over their limits, and two slacks: of the cones, and of clearance constraints
        self.qp = TorqueQP(n + 2, self.cones.m + MOST, iterations=settings.iterations)
        self.low, self.high = -np.ones(n + 2), np.ones(n + 2)
        self.low[n:], self.high[n:] = 0.0, 1e3
        # of a wrench's parts over the weight, and of rates of momentum
        self.share = np.tile(np.repeat([1.0, 1.0 / LEVER], 3), held) / self.weight
        self.moves = np.repeat([settings.com, settings.angular_momentum], 3)
        # from wrenches to what they make: the momentum's rate over the mass
        self.lift = np.tile(np.eye(6), held) / max(self.mass, 1e-9)
        self.seconds: list[float] = []
        stands = robot.floating and bool(scene.soles) and settings.follow == "recover"
        recovery = Recovery(robot, reference, scene, settings) if stands else None
        self.target = Target(robot, reference, scene.strikers, spread=settings.spreads, recovery=recovery)
        self.of_blow = self.target
        self.estimate = StateEstimate(robot, scene.soles, q0)
        self.loads, self.points = np.ones(soles), np.zeros((soles, 3))
        self.acceleration = np.zeros(robot.nv)
        self.felt = np.zeros(len(scene.strikers))  # [N] at the hands, filtered
        self.springs = Servo(robot, reference).springs
        # what motors steer: springs are not followed, nor where a tool swings on them
        self.passive, self.undriven = robot.passive, bool(robot.passive.any())
        self.sprung = bool(robot.sprung.any())
        self.steered: Array = np.append(np.ones(robot.nv - robot.n), 1.0 - self.passive)

    def follow(self, missed: Any | None) -> None:
        """Track from now on the plan's blow (None), or the reference of a robot that hits nothing."""
        self.target = self.of_blow
        if missed is not None:
            self.target = Target(self.robot, missed, self.scene.strikers, spread=False)

    def torque(self, t: float, angles: Array, v: Array, rotation: Array, forces: Array) -> Array:
        """Torque demand (n,) [N m] at a time [s], from what the sensors make of the true state."""
        s = self.settings
        measured = self.sensors.read(angles, v, rotation, forces)
        q, rates = self.estimate.of(measured, self.loads, self.points)
        ahead = s.delay
        q = pin.integrate(self.robot.model, q, ahead * rates)
        rates = rates + ahead * self.acceleration
        self.felt += (1 - math.exp(-s.period / FILTER)) * (measured.forces - self.felt)
        self.target.feel(t, bool((measured.forces > TOUCH).any()))
        aim = self.target.at(t + ahead)
        self.held.look(q, rates, self.felt, s.sole_bandwidth)
        if self.undriven:
            angles = self.robot.joint_positions(q)
            self.held.pulled(self.passive, self.springs(angles, rates[-self.n :]))
        x = self._solve(t, q, rates, aim)[: self.n]
        torque = self.limit * x
        # what is expected until the next sample: accelerations, and where the soles are pressed
        self.acceleration = self.held.A @ torque + self.held.a0
        if self.balances:
            self.loads, self.points = self.cones.pressed(x)
        return torque

    def _solve(self, t: float, q: Array, v: Array, aim: Aim) -> Array:
        held, s, n, tasks = self.held, self.settings, self.n, self.tasks
        recovers = self.target.recovers(t + s.delay)
        struck = s.impact == "planned" and self.target.struck and not recovers
        off = pin.difference(self.robot.model, q, aim.q)
        lag = aim.v - v
        rate_error = lag[-n:]
        if s.projects and self.target.near_blow(t, WINDOW):
            rows = self.scene.normal @ held.hands
            lag = lag - held.recoil @ dgesv(rows @ held.recoil, rows @ lag)[2]
        A, B = held.A * self.limit, held.B * self.limit  # of torques over their limits
        tasks.begin()
        if not struck:
            w = s.recovery_bandwidth if recovers else s.posture_bandwidth
            wanted = aim.a + self.kp * w**2 * off + self.kd * 2 * w * lag
            tasks.add(s.posture * self.steered, A, held.a0 - wanted)
        self._hands(off, lag, aim, A, recovers)
        rate, lift = np.zeros(6), self.lift
        if self.balances:
            rate = self._momentum(q, v, lag, aim, B, recovers)
        feed = aim.torque
        if struck:  # what the plan counts on in contact
            feed = feed + self.kp * self.robot.kp * off[-n:] + self.kd * self.robot.kd * rate_error
        feed = feed / self.limit
        if self.share.size:
            now, goal = held.back, B @ feed
            if recovers:  # what makes the momentum's rate with the least wrenches
                spread = lift / self.share**2
                now, goal = held.b0, spread.T @ dgesv(spread @ lift.T, rate)[2]
            tasks.add(s.wrench, self.share[:, None] * B, self.share * (now - goal))
        P, g = np.zeros((n + 2, n + 2)), np.zeros(n + 2)
        P[:n, :n], g[:n] = tasks.sums()
        effort = s.blow if struck else (EFFORT if recovers else s.torque)
        P.flat[: n * (n + 2) : n + 3] += effort
        g[:n] -= effort * feed
        P.flat[n * (n + 3) :: n + 3], g[n:] = SQUARE, PRICE
        m = self.cones.m
        C, c = np.zeros((m + MOST, n + 2)), np.full(m + MOST, -1.0)  # what there is no pair for holds
        C[:m, : n + 1], c[:m] = self.cones.look(held.places, B, held.b0)
        if recovers or self.target.bounced:  # up to the blow the plan keeps bodies apart, at speed
            rows, least = self.clearance.constraints(held.data)
            its = slice(m, m + len(least))
            C[its, :n], C[its, n + 1] = rows @ A / FAST, 1.0
            c[its] = (least - rows @ held.a0) / FAST
        begun = time.process_time()
        x = self.qp.solve(P, g, C, c, self.low, self.high)
        self.seconds.append(time.process_time() - begun)
        return x

    def _hands(self, off: Array, lag: Array, aim: Aim, A: Array, recovers: bool) -> None:
        """Rows of the striking points."""
        held, s, w = self.held, self.settings, self.settings.hand_bandwidth
        back = self.sprung and self.target.bounced and not recovers
        if not (self.target.before or back):
            return
        for hand, place, drift, goal in zip(
            held.hands, held.hand_places, held.hand_drift, aim.hands, strict=True
        ):
            away, gain = goal[0] - place, goal[2]
            if self.sprung:
                swing, hand = hand * (1.0 - self.steered), hand * self.steered
                away, gain = away - swing @ off, gain - swing @ aim.a
            if back:  # a tool swings on in a soft grip, and would touch again
                away = away - s.draw_back * self.scene.normal
            wanted = gain + self.kp * w**2 * away + self.kd * 2 * w * (hand @ lag)
            self.tasks.add(s.hand, hand @ A, hand @ held.a0 + drift - wanted)

    def _momentum(self, q: Array, v: Array, lag: Array, aim: Aim, B: Array, recovers: bool) -> Array:
        """Rows of the centre of mass and of the angular momentum, whose rates are the soles' wrenches.

        What all wrenches are to make (6,), over the mass.
        """
        held, s, data, mass, lift = self.held, self.settings, self.data, self.mass, self.lift
        Ag = pin.ccrba(self.robot.model, data, q, v)
        com = np.array(data.com[0])
        for k, place in enumerate(held.places):
            lift[3:, 6 * k : 6 * k + 3] = pin.skew((place.translation - com) / mass)
        # the divergent component of motion: com + rate / omega
        gain, omega = s.capture_gain, math.sqrt(np.linalg.norm(self.gravity) / max(com[2], 0.1))
        error = Ag @ lag
        if recovers:  # the centre of mass has an aim of its own, the joints' motion does not bring it there
            error[:3] = mass * aim.com[1] - data.hg.linear
        wanted = np.zeros(6)
        wanted[:3] = (
            aim.com[2]
            + self.kp * omega * gain * (aim.com[0] - com)
            + self.kd * (omega + gain) * error[:3] / mass
            - self.gravity
        )
        wanted[3:] = (aim.momentum[1] + s.momentum_gain * error[3:]) / mass
        self.tasks.add(self.moves, lift @ B, lift @ held.b0 - wanted)
        return wanted


class Tasks:
    """Sum of 1/2 weight (rows x + off)^2 over tasks, for n unknowns; one product for all of them.

    most : rows of all tasks together.
    """

    def __init__(self, n: int, most: int) -> None:
        self._rows, self._off, self._weight = np.zeros((most, n)), np.zeros(most), np.zeros(most)
        self._used = 0

    def begin(self) -> None:
        """There is none."""
        self._used = 0

    def add(self, weight: float | Array, rows: Array, off: Array) -> None:
        """Rows (k, n) and off (k,), with one weight or (k,)."""
        its = slice(self._used, self._used + len(off))
        self._rows[its], self._off[its], self._weight[its] = rows, off, weight
        self._used = its.stop

    def sums(self) -> tuple[Array, Array]:
        """Hessian (n, n) and gradient (n,) at x = 0."""
        rows = self._rows[: self._used]
        weighted = rows.T * self._weight[: self._used]
        return weighted @ rows, weighted @ self._off[: self._used]
