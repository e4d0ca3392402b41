"""The whole-body controller: at every sample a QP for the torques that track the plan on its soles.

In y = L' x with P = L L', and with rows of length one, OSQP's steps converge some hundred times as fast as in
x: thirty of them leave 0.03 % of the torque limits in the median.

H a + h = S' tau + J' w and J a + dJ/dt v = 0 give a = A tau + a0 and w = B tau + b0. So a QP over
accelerations and wrenches under the equation of motion has as many unknowns as there are torques.
"""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
import osqp
import pinocchio as pin
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.linalg.lapack import dgesv, dpotrf, dtrtri

from impactopt.robots.mass_matrix import mass_matrix
from impactopt.robots.robot import Robot
from impactopt.simulation.controller.clearance import MOST, Clearance
from impactopt.simulation.controller.sensors import Sensors, StateEstimate
from impactopt.simulation.controller.settings import ControllerSettings
from impactopt.simulation.controller.tracking_reference import Aim, Recovery, Target
from impactopt.simulation.motors import Servo
from impactopt.simulation.result import Scene, stance_at, stance_begins

__all__ = ["Cones", "Footing", "HeldDynamics", "Tasks", "TorqueQP", "WholeBodyController", "cone_of"]

Array = NDArray[np.float64]
RHO = 1.0  # of OSQP's ADMM, where P is the identity
ENDLESS = 1e30  # OSQP's infinity
LEAST = 1e-12  # of a row's length, which may be nothing


class TorqueQP:
    """min 1/2 x' P x + q' x  with  C x >= c,  low <= x <= high, for n unknowns and m rows C; P > 0.

    A fixed number of iterations from the answer to the QP before.
    """

    def __init__(self, n: int, m: int, *, iterations: int) -> None:
        self.n, self.m = n, m
        # by columns, as OSQP has them; those of the bounds are an upper triangle
        self._columns = np.zeros((n, m + n))
        self._there = np.hstack([np.ones((n, m), dtype=bool), np.tril(np.ones((n, n), dtype=bool))])
        self._lower, self._upper = np.zeros(m + n), np.full(m + n, ENDLESS)
        self._solver: Any = osqp.OSQP()
        self._solver.setup(
            sp.identity(n, format="csc"),
            np.zeros(n),
            sp.csc_matrix(self._there.T.astype(float)),
            np.full(m + n, -ENDLESS),
            np.full(m + n, ENDLESS),
            scaling=0,
            adaptive_rho=False,
            rho=RHO,
            max_iter=iterations,
            check_termination=0,
            polishing=False,
            warm_starting=True,
            verbose=False,
        )

    def solve(self, P: Array, q: Array, C: Array, c: Array, low: Array, high: Array) -> Array:
        """x (n,), inside its bounds."""
        root, _ = dpotrf(P, lower=1, clean=1)
        inverse, _ = dtrtri(root, lower=1)
        columns, m = self._columns, self.m
        np.matmul(inverse, C.T, out=columns[:, :m])
        columns[:, m:] = inverse
        scale = 1.0 / np.maximum(np.sqrt(np.einsum("ij,ij->j", columns, columns)), LEAST)
        columns *= scale
        self._lower[:m], self._lower[m:] = c, low
        self._upper[m:] = high * scale[m:]
        self._solver.update(Ax=columns[self._there], q=inverse @ q, l=self._lower * scale, u=self._upper)
        x = inverse.T @ self._solver.solve(raise_error=False).x
        return np.minimum(np.maximum(x, low), high)


_AXES = pin.LOCAL_WORLD_ALIGNED


class HeldDynamics:
    """A robot on soles, at a state; h points of it strike.

    A (nv, n), a0 (nv,) : accelerations.  B (6 a sole and a hand that holds on, n), b0 : wrenches of the
    ground on the frames at their origins, in world axes.  places : of these frames.
    hands (h, 3, nv) : Jacobians of the striking points.  hand_places (h, 3) [m] : where they are.
    hand_drift (h, 3) [m/s^2] : their accelerations where joints have none.
    back : the part of b0 that would bring soles back to where they stood.
    recoil (nv, h) : how velocities change by a unit impulse against the normal at each.
    """

    def __init__(
        self,
        robot: Robot,
        soles: tuple[str, ...],
        strikers: tuple[str, ...],
        normal: Array,
        q0: Array,
        *,
        holding: tuple[str, ...] = (),
    ) -> None:
        self._robot, self.model, self.normal = robot, robot.model, normal
        self.data: Any = robot.model.createData()
        self._soles = [self.model.getFrameId(name) for name in soles]
        self._held = [*self._soles, *(self.model.getFrameId(name) for name in holding)]
        self._strikers = [self.model.getFrameId(name) for name in strikers]
        nv, n, rows, h = robot.nv, robot.n, 6 * len(self._held), len(strikers)
        self._n, self._nv = n, nv
        # as LAPACK has them, by columns: torques, none, what brings soles back, unit forces at the hands
        self._left = np.zeros((nv + rows, nv + rows), order="F")
        self._right = np.zeros((nv + rows, n + 2 + h), order="F")
        self.hands = np.zeros((h, 3, nv))
        self.hand_places, self.hand_drift = np.zeros((2, h, 3))
        self._right[nv - n : nv, :n] = np.eye(n)
        self._none = np.zeros(nv)
        pin.framesForwardKinematics(self.model, self.data, q0)
        self._stood = [self.data.oMf[i].copy() for i in self._soles]

    def look(self, q: Array, v: Array, forces: Array | float = 0.0, bandwidth: float = 0.0) -> None:
        """Go to q (nq), v (nv), with forces (h,) [N] on the striking points, against the normal."""
        model, data, nv, n = self.model, self.data, self._nv, self._n
        left, right = self._left, self._right
        pin.forwardKinematics(model, data, q, v, self._none)
        pin.computeJointJacobians(model, data)
        left[:nv, :nv] = mass_matrix(model, data, q)
        right[:nv, n] = -self._robot.nonlinear_effects(data, q, v)
        self.places = []
        for k, i in enumerate(self._held):
            rows = slice(nv + 6 * k, nv + 6 * k + 6)
            self.places.append(pin.updateFramePlacement(model, data, i).copy())
            J = pin.getFrameJacobian(model, data, i, _AXES)
            left[rows, :nv], left[:nv, rows] = J, -J.T
            right[rows, n] = -pin.getFrameClassicalAcceleration(model, data, i, _AXES).vector
            if k >= len(self._soles):  # a grip holds by itself
                continue
            at, stood = self.places[-1], self._stood[k]
            turned = pin.log3(at.rotation @ stood.rotation.T)
            away = np.zeros(6)  # a sole that has slid stays where it is
            away[2], away[3:5] = at.translation[2] - stood.translation[2], turned[:2]
            right[rows, n + 1] = -(bandwidth**2) * away - 2 * bandwidth * (J @ v)
        for k, i in enumerate(self._strikers):
            self.hand_places[k] = pin.updateFramePlacement(model, data, i).translation
            self.hands[k] = np.reshape(pin.getFrameJacobian(model, data, i, _AXES), (6, nv))[:3]
            self.hand_drift[k] = pin.getFrameClassicalAcceleration(model, data, i, _AXES).linear
            right[:nv, n + 2 + k] = -self.normal @ self.hands[k]
        _, _, found, _ = dgesv(left, right)
        push = found[:, n + 2 :] @ np.broadcast_to(forces, len(self._strikers))
        self.A, self.a0 = found[:nv, :n], (found[:, n] + push + found[:, n + 1])[:nv]
        self.recoil = found[:nv, n + 2 :]
        self.B, self.b0 = found[nv:, :n], (found[:, n] + push + found[:, n + 1])[nv:]
        self.back = found[nv:, n + 1]

    def pulled(self, which: NDArray[np.bool_], torque: Array) -> None:
        """Joints (n,) have torques (n,) [N m] that are no choice: springs'."""
        pull = np.where(which, torque, 0.0)
        self.a0, self.b0 = self.a0 + self.A @ pull, self.b0 + self.B @ pull
        self.A, self.B = self.A * ~which, self.B * ~which


def cone_of(corners: Array, settings: ControllerSettings) -> Array:
    """Rows (k, 6) that are >= 0 of a wrench that a sole with these corners (c, 2) [m] can have, in its frame.

    Its edges' rows are its own; those of torsion are of the rectangle with its extents (Caron, Pham,
    Nakamura, "Stability of surface contacts for humanoid robots", ICRA 2015).
    """
    s, mu = settings, settings.friction
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


class Cones:
    """Wrench cones of soles with corners (c, 2) [m] each, for a robot of n joints and a weight [N].

    m : rows of all of them.
    """

    def __init__(
        self, corners: tuple[Array, ...], settings: ControllerSettings, n: int, weight: float
    ) -> None:
        cones = [cone_of(c, settings) for c in corners]
        self.m = sum(len(cone) for cone in cones)
        self._weight, self._soles = weight, len(cones)
        self._rows = block_diag(*cones) / weight if cones else np.zeros((0, 0))
        self._least = np.zeros(self.m)  # of the normal force, which is each cone's first row
        self._least[np.cumsum([0, *map(len, cones)])[:-1]] = settings.least_force / weight
        self._low = np.array([[*c.min(axis=0), 0.0] for c in corners])
        self._high = np.array([[*c.max(axis=0), 0.0] for c in corners])
        self._turn = np.zeros((6 * len(cones), 6 * len(cones)))  # from the world's axes to the soles'
        # wrenches by torques over their limits, and at none: in the soles' axes
        self._local = np.zeros((6 * len(cones), n + 1))

    def look(self, places: list[Any], B: Array, b0: Array) -> tuple[Array, Array]:
        """C (m, n + 1) and c (m,), C x >= c, of x: n torques over their limits, and what the cones may be
        left by, over the weight.

        B (6 a frame, n), b0 : wrenches in world axes, B x + b0.  places : of the frames.  Those of the soles
        come first, and are looked at alone.
        """
        turn, local = self._turn, self._local
        for k, place in enumerate(places[: self._soles]):
            at, back = 6 * k, place.rotation.T
            turn[at : at + 3, at : at + 3] = turn[at + 3 : at + 6, at + 3 : at + 6] = back
        local[:, :-1], local[:, -1] = turn @ B[: len(turn)], turn @ b0[: len(turn)]
        C = self._rows @ local
        c = self._least - C[:, -1]
        C[:, -1] = 1.0
        return C, c

    def pressed(self, x: Array) -> tuple[Array, Array]:
        """Normal forces (soles,) [N] and centres of pressure (soles, 3) [m], in the soles' frames, at torques
        over their limits x (n,), where `look` was last.
        """
        wrench = self._local[:, :-1] @ x + self._local[:, -1]
        loads = np.maximum(wrench[2::6], 1e-3 * self._weight)
        points = np.zeros((self._soles, 3))
        points[:, 0], points[:, 1] = -wrench[4::6] / loads, wrench[3::6] / loads
        np.clip(points, self._low, self._high, out=points)
        return loads, points


WINDOW = 0.01  # [s] about the blow in which velocity errors are projected
FILTER = 3e-3  # [s] of the hand's force
TOUCH = 20.0  # [N] that the hand feels as a touch
LEVER = 0.1  # [m] by which moments of a sole are compared with its forces
EFFORT = 1e-3  # weight of torques over their limits in the recovery, which has no feed-forward
FEET = 40.0  # [rad/s] of the feedback of soles in the air
FAST = 10.0  # [m/s^2] by which clearance constraints are scaled
PRICE, SQUARE = 1e3, 1e3  # of leaving the cones, over the robot's weight, and those: linear, and of squares


class Footing:
    """Parts of the controller that depend on the soles that stand.

    frames : of these soles.  air : of the others, numbers in the model.  held : the robot on them.
    cones, tasks, qp : of its wrenches.
    share, lift : of wrenches, over the weight; and to what they make, the momentum's rate over the mass.
    loads (soles,), points (soles, 3) [m] : where they are pressed.
    """

    def __init__(
        self, robot: Robot, scene: Scene, on: NDArray[np.intp], settings: ControllerSettings, q0: Array
    ) -> None:
        """on : indices of the scene's soles that stand.  q0 (nq,) : a configuration with them in place."""
        self.frames = tuple(scene.soles[k] for k in on)
        self.air = [robot.model.getFrameId(name) for name in scene.soles if name not in self.frames]
        self.held = HeldDynamics(robot, self.frames, scene.strikers, scene.normal, q0, holding=scene.hands)
        mass, n, held = float(pin.computeTotalMass(robot.model)), robot.n, len(on) + len(scene.hands)
        weight = 9.81 * max(mass, 1e-9)
        self.cones = Cones(tuple(scene.corners[k] for k in on), settings, n, weight)
        balances = robot.floating and len(on) > 0
        self.tasks = Tasks(n, robot.nv + 3 * len(scene.strikers) + 6 * (balances + held + len(self.air)))
        # torques over their limits, and two slacks: of the cones, and of clearance constraints
        self.qp = TorqueQP(n + 2, self.cones.m + MOST, iterations=settings.iterations)
        # of a wrench's parts over the weight
        self.share = np.tile(np.repeat([1.0, 1.0 / LEVER], 3), held) / weight
        self.lift = np.tile(np.eye(6), held) / max(mass, 1e-9)
        self.loads, self.points = np.ones(len(on)), np.zeros((len(on), 3))


class WholeBodyController:
    """Torques of a robot on a scene's soles that follows a reference, and its schedule of stance phases.

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
        self.data: Any = robot.model.createData()
        self.mass = float(pin.computeTotalMass(robot.model))
        self.n, self.gravity = robot.n, np.array(robot.model.gravity.linear)
        self.balances = robot.floating and bool(scene.soles)
        self.clearance = Clearance(robot.model, scene.solids, period=settings.period)
        self.low, self.high = -np.ones(self.n + 2), np.ones(self.n + 2)
        self.low[self.n :], self.high[self.n :] = 0.0, 1e3
        self.moves = np.repeat([settings.com, settings.angular_momentum], 3)  # of rates of momentum
        self.seconds: list[float] = []
        steps_on = stance_at(reference, reference.contact_end) != stance_at(reference, np.inf)
        stands = self.balances and settings.follow == "recover" and not steps_on
        recovery = Recovery(robot, reference, scene, settings) if stands else None
        self.target = Target(robot, reference, scene.strikers, spread=settings.spreads, recovery=recovery)
        self.of_blow, self.planned, self.followed = self.target, reference, reference
        q0 = np.asarray(reference.q[0])
        self.stance, self.footing = 0, self._footing(0)
        self.estimate = StateEstimate(robot, self.footing.frames, q0)
        self.acceleration = np.zeros(robot.nv)
        self.felt = np.zeros(len(scene.strikers))  # [N] at the hands, filtered
        self.springs = Servo(robot, reference).springs
        # what motors steer: springs are not followed, nor where a tool swings on them
        self.passive, self.undriven = robot.passive, bool(robot.passive.any())
        self.sprung = bool(robot.sprung.any())
        self.steered: Array = np.append(np.ones(robot.nv - robot.n), 1.0 - self.passive)

    def follow(self, missed: Any | None) -> None:
        """Track from now on the plan's blow (None), or the reference of a robot that hits nothing."""
        self.target, self.followed = self.of_blow, self.planned
        if missed is not None:
            self.target, self.followed = Target(self.robot, missed, self.scene.strikers, spread=False), missed

    def _footing(self, stance: int) -> Footing:
        """Parts on the soles of a stance phase, which stand where the reference has them as it begins."""
        scene = self.scene
        on = np.flatnonzero(scene.standing[stance]) if scene.standing.size else np.arange(len(scene.soles))
        q0 = np.asarray(self.followed.q[stance_begins(self.followed, stance)])
        return Footing(self.robot, scene, on, self.settings, q0)

    def torque(self, t: float, angles: Array, v: Array, rotation: Array, forces: Array) -> Array:
        """Torque demand (n,) [N m] at a time [s], from what the sensors make of the true state."""
        s = self.settings
        measured = self.sensors.read(angles, v, rotation, forces)
        q, rates = self.estimate.of(measured, self.footing.loads, self.footing.points)
        stance = stance_at(self.followed, self.target.clock(t)[0])
        if stance != self.stance:  # soles lift off, or are taken to stand where they are
            self.stance, self.footing = stance, self._footing(stance)
            self.estimate.stand(self.footing.frames, q)
        ahead = s.delay
        q = pin.integrate(self.robot.model, q, ahead * rates)
        rates = rates + ahead * self.acceleration
        self.felt += (1 - math.exp(-s.period / FILTER)) * (measured.forces - self.felt)
        self.target.feel(t, bool((measured.forces > TOUCH).any()))
        aim = self.target.at(t + ahead)
        held = self.footing.held
        held.look(q, rates, self.felt, s.sole_bandwidth)
        if self.undriven:
            angles = self.robot.joint_positions(q)
            held.pulled(self.passive, self.springs(angles, rates[-self.n :]))
        x = self._solve(t, q, rates, aim)[: self.n]
        torque = self.limit * x
        # what is expected until the next sample: accelerations, and where the soles are pressed
        self.acceleration = held.A @ torque + held.a0
        if self.balances:
            self.footing.loads, self.footing.points = self.footing.cones.pressed(x)
        return torque

    def _solve(self, t: float, q: Array, v: Array, aim: Aim) -> Array:
        on, s, n = self.footing, self.settings, self.n
        held, tasks = on.held, on.tasks
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
            self._feet(aim, v, A)
        self._hands(off, lag, aim, A, recovers)
        rate, lift = np.zeros(6), on.lift
        if self.balances:
            rate = self._momentum(q, v, lag, aim, B, recovers)
        feed = aim.torque
        if struck:  # what the plan counts on in contact
            feed = feed + self.kp * self.robot.kp * off[-n:] + self.kd * self.robot.kd * rate_error
        feed = feed / self.limit
        if on.share.size:
            now, goal = held.back, B @ feed
            if recovers:  # what makes the momentum's rate with the least wrenches
                spread = lift / on.share**2
                now, goal = held.b0, spread.T @ dgesv(spread @ lift.T, rate)[2]
            tasks.add(s.wrench, on.share[:, None] * B, on.share * (now - goal))
        P, g = np.zeros((n + 2, n + 2)), np.zeros(n + 2)
        P[:n, :n], g[:n] = tasks.sums()
        effort = s.blow if struck else (EFFORT if recovers else s.torque)
        P.flat[: n * (n + 2) : n + 3] += effort
        g[:n] -= effort * feed
        P.flat[n * (n + 3) :: n + 3], g[n:] = SQUARE, PRICE
        m = on.cones.m
        C, c = np.zeros((m + MOST, n + 2)), np.full(m + MOST, -1.0)  # what there is no pair for holds
        C[:m, : n + 1], c[:m] = on.cones.look(held.places, B, held.b0)
        if recovers or self.target.bounced:  # up to the blow the plan keeps bodies apart, at speed
            rows, least = self.clearance.constraints(held.data)
            its = slice(m, m + len(least))
            C[its, :n], C[its, n + 1] = rows @ A / FAST, 1.0
            c[its] = (least - rows @ held.a0) / FAST
        begun = time.process_time()
        x = on.qp.solve(P, g, C, c, self.low, self.high)
        self.seconds.append(time.process_time() - begun)
        return x

    def _hands(self, off: Array, lag: Array, aim: Aim, A: Array, recovers: bool) -> None:
        """Rows of the striking points."""
        held, s, w = self.footing.held, self.settings, self.settings.hand_bandwidth
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
            self.footing.tasks.add(s.hand, hand @ A, hand @ held.a0 + drift - wanted)

    def _feet(self, aim: Aim, v: Array, A: Array) -> None:
        """Rows of the soles in the air: posture alone would have them land at speed."""
        model, of_aim, w = self.robot.model, self.data, FEET
        held, air = self.footing.held, self.footing.air
        if air:
            pin.forwardKinematics(model, of_aim, aim.q, aim.v, aim.a)
        for i in air:
            goal, place = (
                pin.updateFramePlacement(model, of_aim, i),
                pin.updateFramePlacement(model, held.data, i),
            )
            rows = np.array(pin.getFrameJacobian(model, held.data, i, _AXES))
            drift = pin.getFrameClassicalAcceleration(model, held.data, i, _AXES).vector
            lag = pin.getFrameVelocity(model, of_aim, i, _AXES).vector - rows @ v
            off = np.append(goal.translation - place.translation, pin.log3(goal.rotation @ place.rotation.T))
            wanted = pin.getFrameClassicalAcceleration(model, of_aim, i, _AXES).vector
            wanted = wanted + self.kp * w**2 * off + self.kd * 2 * w * lag
            self.footing.tasks.add(self.settings.hand, rows @ A, rows @ held.a0 + drift - wanted)

    def _momentum(self, q: Array, v: Array, lag: Array, aim: Aim, B: Array, recovers: bool) -> Array:
        """Rows of the centre of mass and of the angular momentum, whose rates are the soles' wrenches.

        What all wrenches are to make (6,), over the mass.
        """
        held, lift = self.footing.held, self.footing.lift
        s, data, mass = self.settings, self.data, self.mass
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
        self.footing.tasks.add(self.moves, lift @ B, lift @ held.b0 - wanted)
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
