"""Whole-body controller: at every sample a QP for the torques that track the plan on its soles.

The equation of motion H a + h = S' tau + J' w with J a + dJ/dt v = 0 gives accelerations a = A tau + a0 and
contact wrenches w = B tau + b0. The QP has the torques as its only unknowns (and two slacks), where one over
accelerations and wrenches would need the equation of motion as a constraint.
"""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
import osqp
import pinocchio as pin
import scipy.sparse as sp
from scipy.linalg import block_diag
from scipy.linalg.lapack import dgesv, dpotrf, dtrtri

from impactopt.arrays import Array, Index, Mask
from impactopt.robots.robot import Robot
from impactopt.simulation.controller.clearance import MAX_CONSTRAINTS, Clearance
from impactopt.simulation.controller.sensors import Sensors, StateEstimate
from impactopt.simulation.controller.settings import ControllerSettings
from impactopt.simulation.controller.tracking_reference import Recovery, ReferenceSample, TrackingReference
from impactopt.simulation.motors import Servo
from impactopt.simulation.pinocchio_robot import DenseBody
from impactopt.simulation.result import Scene, stance_at, stance_begins

ADMM_PENALTY = 1.0  # OSQP's rho: after the change of variables the Hessian is the identity
OSQP_INFINITY = 1e30
MIN_NORM = 1e-12  # avoids a division by zero for a constraint without coefficients


class TorqueQP:
    """min 1/2 x' P x + q' x  with  C x >= c,  low <= x <= high;  P > 0 (n, n), C (m, n).

    Runs a fixed number of OSQP iterations, warm-started from the previous solution. They are few, because
    the problem is preconditioned: in y = L' x, where P = L L', the Hessian is the identity, and all
    constraints are scaled to norm one. ADMM then converges some hundred times as fast as in x: thirty
    iterations leave an error of 0.03 % of the torque limits in the median.
    """

    def __init__(self, n: int, m: int, *, iterations: int) -> None:
        self.n, self.m = n, m
        # the transpose of OSQP's matrix [C; I] L'^-1, because OSQP stores it by columns;
        # the block of the bounds, I L'^-1, is upper triangular
        self._columns = np.zeros((n, m + n))
        self._nonzero = np.hstack([np.ones((n, m), dtype=bool), np.tril(np.ones((n, n), dtype=bool))])
        self._lower, self._upper = np.zeros(m + n), np.full(m + n, OSQP_INFINITY)
        self._solver: Any = osqp.OSQP()
        self._solver.setup(
            sp.identity(n, format="csc"),
            np.zeros(n),
            sp.csc_matrix(self._nonzero.T.astype(float)),
            np.full(m + n, -OSQP_INFINITY),
            np.full(m + n, OSQP_INFINITY),
            scaling=0,
            adaptive_rho=False,
            rho=ADMM_PENALTY,
            max_iter=iterations,
            check_termination=0,
            polishing=False,
            warm_starting=True,
            verbose=False,
        )

    def solve(self, P: Array, q: Array, C: Array, c: Array, low: Array, high: Array) -> Array:
        """x (n,), clipped to its bounds."""
        L, _ = dpotrf(P, lower=1, clean=1)
        inverse, _ = dtrtri(L, lower=1)
        columns, m = self._columns, self.m
        np.matmul(inverse, C.T, out=columns[:, :m])
        # C x = (C L'^-1) y, so the transposed matrix is L^-1 C'; of the bounds, with C = I, it is L^-1
        columns[:, m:] = inverse
        scale = 1.0 / np.maximum(np.sqrt(np.einsum("ij,ij->j", columns, columns)), MIN_NORM)
        columns *= scale
        self._lower[:m], self._lower[m:] = c, low
        self._upper[m:] = high * scale[m:]
        self._solver.update(Ax=columns[self._nonzero], q=inverse @ q, l=self._lower * scale, u=self._upper)
        # back from y: x = L'^-1 y
        x = inverse.T @ self._solver.solve(raise_error=False).x
        return np.minimum(np.maximum(x, low), high)


_AXES = pin.LOCAL_WORLD_ALIGNED


class TorqueResponse(DenseBody):
    """Dynamics of a robot with its soles and supporting hands fixed, affine in the torques tau (n,).

    frames = soles, then supporting hands; h = number of striking points.

    A (nv, n), a0 (nv,) : accelerations A tau + a0
    B (6 frames, n), b0 : wrenches of the ground on the frames at their origins, world axes
    striking_drift (h, 3) [m/s^2] : accelerations of the striking points for a = 0
    stabilizing_wrenches : part of b0 that returns the soles to their initial height and tilt
    impulse_response (nv, h) : change of v by a unit impulse against the normal at each striking point
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
        super().__init__(robot, (*soles, *holding), np.zeros(6), strikers, normal)
        # Columns of right-hand sides: each torque (n), no torque, stabilization of the soles, each striking
        # force (h)
        self._columns = np.zeros((len(self._right), self.n + 2 + len(strikers)), order="F")
        self._columns[self.nv - self.n : self.nv, : self.n] = np.eye(self.n)
        pin.framesForwardKinematics(self.model, self.data, q0)
        self._initial = self.placements()[: len(soles)]  # a grip needs no stabilization

    def update(self, q: Array, v: Array, forces: Array | float = 0.0, bandwidth: float = 0.0) -> None:
        """Evaluates the dynamics at q (nq,), v (nv,).

        forces : (h,) [N] on the striking points, against the normal.
        bandwidth : [rad/s] of the stabilization of the soles (Baumgarte's, in height, roll and pitch).
        """
        super().update(q, v)
        self.update_contact()
        nv, n, right = self.nv, self.n, self._columns
        right[:nv, n] = self._generalized_forces(np.zeros(n), None) - self._bias
        right[nv:, n] = self._right[nv:]
        for k, (now, initial) in enumerate(zip(self.placements(), self._initial, strict=False)):
            rows = slice(nv + 6 * k, nv + 6 * k + 6)
            rotation_error = pin.log3(now.rotation @ initial.rotation.T)
            error = np.zeros(6)  # horizontal position and yaw stay zero: a sole that slid is not pulled back
            error[2], error[3:5] = now.translation[2] - initial.translation[2], rotation_error[:2]
            right[rows, n + 1] = -(bandwidth**2) * error - 2 * bandwidth * (self._matrix[rows, :nv] @ v)
        drifts = [pin.getFrameClassicalAcceleration(self.model, self.data, i, _AXES) for i in self.strikers]
        self.striking_drift = np.array([drift.linear for drift in drifts])
        right[:nv, n + 2 :] = -self.normal_jacobian.T
        _, _, solved, _ = dgesv(self._matrix, right)
        by_forces = solved[:, n + 2 :] @ np.broadcast_to(forces, len(self.strikers))
        constant = solved[:, n] + by_forces + solved[:, n + 1]
        self.A, self.a0 = solved[:nv, :n], constant[:nv]
        self.impulse_response = solved[:nv, n + 2 :]
        self.B, self.b0 = solved[nv:, :n], constant[nv:]
        self.stabilizing_wrenches = solved[nv:, n + 1]

    def fix_torques(self, which: Mask, torque: Array) -> None:
        """Moves the torques (n,) [N m] of some joints, as of springs, from the unknowns to a0 and b0."""
        fixed = np.where(which, torque, 0.0)
        self.a0, self.b0 = self.a0 + self.A @ fixed, self.b0 + self.B @ fixed
        self.A, self.B = self.A * ~which, self.B * ~which


def wrench_cone(corners: Array, settings: ControllerSettings) -> Array:
    """Matrix (k, 6) whose product with a wrench of a sole, in the sole's frame, is >= 0 if it is feasible.

    corners (c, 2) [m] : of the sole, counter-clockwise.

    Rows: unilateral force, linearized friction, torsion, centre of pressure inside each edge. The centre of
    pressure is constrained by the sole's own edges; torsion by those of the rectangle with its extents
    (Caron, Pham, Nakamura, "Stability of surface contacts for humanoid robots", ICRA 2015).
    """
    mu = settings.friction
    edge = np.roll(corners, -1, axis=0) - corners
    inward = np.stack([-edge[:, 1], edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
    offset = (inward * corners).sum(axis=1) + settings.cop_margin  # inward . cop >= offset
    (x0, y0), (x1, y1) = corners.min(axis=0), corners.max(axis=0)
    X, Y, cx, cy = (x1 - x0) / 2, (y1 - y0) / 2, (x0 + x1) / 2, (y0 + y1) / 2
    # from a wrench about the frame's origin to one about the rectangle's centre
    shift = np.eye(6)
    # moment about the rectangle's centre: m - centre x f
    shift[3:, :3] = -pin.skew(np.array([cx, cy, 0.0]))
    rows = [[0.0, 0, 1, 0, 0, 0]]
    rows += [[i * a, (1 - i) * a, mu, 0, 0, 0] for i in (0, 1) for a in (1, -1)]
    # torsion: the eight combinations of signs of Caron's bounds on the yaw moment
    for turn in (1, -1):
        for a in (1, -1):
            for b in (1, -1):
                f, m = [a * Y, b * X, mu * (X + Y)], [-turn * a * mu, -turn * b * mu, turn]
                rows.append([*f, *m])
    out = np.array(rows, dtype=float) @ shift
    # cop = (-m_y, m_x) / f_z, multiplied by f_z
    edges = [[0, 0, -c, n[1], -n[0], 0] for n, c in zip(inward, offset, strict=True)]
    return np.vstack([out, np.array(edges, dtype=float)])


class WrenchCones:
    """Constraints that keep the wrenches of all soles inside their cones.

    corners : (c, 2) [m] of each sole.  n : number of joints.  weight : [N] of the robot.
    m : number of constraints.
    """

    def __init__(
        self, corners: tuple[Array, ...], settings: ControllerSettings, n: int, weight: float
    ) -> None:
        cones = [wrench_cone(c, settings) for c in corners]
        self.m = sum(len(cone) for cone in cones)
        self._weight, self._soles = weight, len(cones)
        self._matrix = block_diag(*cones) / weight if cones else np.zeros((0, 0))
        self._lower = np.zeros(self.m)  # least normal force, on the first constraint of each cone
        # Soles that were to carry more than the robot weighs would leave all cones to the slack.
        least = min(settings.least_force / weight, MAX_LEAST_LOAD / max(len(cones), 1))
        self._lower[np.cumsum([0, *map(len, cones)])[:-1]] = least
        self._low = np.array([[*c.min(axis=0), 0.0] for c in corners])
        self._high = np.array([[*c.max(axis=0), 0.0] for c in corners])
        self._rotation = np.zeros((6 * len(cones), 6 * len(cones)))  # from world axes to those of the soles
        # wrenches in the axes of the soles: coefficients of the n scaled torques, and the constant
        self._local = np.zeros((6 * len(cones), n + 1))

    def constraints(self, placements: list[Any], B: Array, b0: Array) -> tuple[Array, Array]:
        """C (m, n + 1) and c (m,) with C x >= c; x: n torques over their limits, and a slack over the weight.

        B (6 frames, n), b0 : wrenches B x + b0 in world axes.  placements : of the frames.  The soles come
        first; supporting hands, which come after them, have no cone.
        """
        rotation, local = self._rotation, self._local
        for k, placement in enumerate(placements[: self._soles]):
            at, R = 6 * k, placement.rotation.T
            rotation[at : at + 3, at : at + 3] = rotation[at + 3 : at + 6, at + 3 : at + 6] = R
        local[:, :-1], local[:, -1] = rotation @ B[: len(rotation)], rotation @ b0[: len(rotation)]
        C = self._matrix @ local
        c = self._lower - C[:, -1]
        C[:, -1] = 1.0
        return C, c

    def loads(self, x: Array) -> tuple[Array, Array]:
        """Normal forces (soles,) [N] and centres of pressure (soles, 3) [m], in the frames of the soles.

        x (n,) : torques over their limits, in the state of the last call of `constraints`.
        """
        wrench = self._local[:, :-1] @ x + self._local[:, -1]
        loads = np.maximum(wrench[2::6], 1e-3 * self._weight)
        points = np.zeros((self._soles, 3))
        points[:, 0], points[:, 1] = -wrench[4::6] / loads, wrench[3::6] / loads
        np.clip(points, self._low, self._high, out=points)
        return loads, points


PROJECTION_WINDOW = 0.01  # [s] before and after the impact in which velocity errors are projected
FORCE_FILTER = 3e-3  # [s] time constant of the low-pass filter of the striking force
MAX_LEAST_LOAD = 0.25  # largest sum of the soles' least forces, over the weight
MOMENT_ARM = 0.1  # [m] that makes the moments of a sole comparable with its forces
RECOVERY_TORQUE_WEIGHT = 1e-3  # of torques over their limits; the recovery has no feed-forward to follow
MIN_TORQUE_WEIGHT = 1e-6  # the tasks alone may leave torques free, and the Hessian has to be regular
SWING_FOOT_BANDWIDTH = 40.0  # [rad/s]
CLEARANCE_SCALE = 10.0  # [m/s^2] over which clearance constraints are of order one
# Weights of the slacks: the linear one, large enough to leave cones only where they cannot be kept, and that
# of the squares.
SLACK_WEIGHT, SLACK_SQUARE_WEIGHT = 1e3, 1e3
MAX_SLACK = 1e3  # no limit in practice


class StanceProblem:
    """QP of the controller, and its data, for one set of standing soles.

    frames : of these soles.  swing_feet : frame numbers of the other soles.
    dynamics, cones, tasks, qp : parts of the QP.
    wrench_scale (6 frames,) : 1 / weight for forces, 1 / (weight * MOMENT_ARM) for moments.
    momentum_map (6, 6 frames) : from wrenches to the rate of the centroidal momentum, over the mass.
    loads (soles,), points (soles, 3) [m] : predicted normal forces and centres of pressure.
    """

    def __init__(
        self, robot: Robot, scene: Scene, standing: Index, settings: ControllerSettings, q0: Array
    ) -> None:
        """standing : indices of the scene's soles that stand.  q0 (nq,) : configuration with them placed."""
        self.frames = tuple(scene.soles[k] for k in standing)
        self.swing_feet = [robot.model.getFrameId(name) for name in scene.soles if name not in self.frames]
        self.dynamics = TorqueResponse(
            robot, self.frames, scene.strikers, scene.normal, q0, holding=scene.hands
        )
        mass, n, fixed = float(pin.computeTotalMass(robot.model)), robot.n, len(standing) + len(scene.hands)
        weight = 9.81 * max(mass, 1e-9)
        self.cones = WrenchCones(tuple(scene.corners[k] for k in standing), settings, n, weight)
        balances = robot.floating and len(standing) > 0
        errors = robot.nv + 3 * len(scene.strikers) + 6 * (balances + fixed + len(self.swing_feet))
        self.tasks = Tasks(n, errors)
        # unknowns: torques over their limits, and two slacks: of the cones, and of clearance constraints
        self.qp = TorqueQP(n + 2, self.cones.m + MAX_CONSTRAINTS, iterations=settings.iterations)
        self.wrench_scale = np.tile(np.repeat([1.0, 1.0 / MOMENT_ARM], 3), fixed) / weight
        self.momentum_map = np.tile(np.eye(6), fixed) / max(mass, 1e-9)
        self.loads, self.points = np.ones(len(standing)), np.zeros((len(standing), 3))


class WholeBodyController:
    """Torques of a robot on a scene's soles that tracks a reference and its schedule of stance phases.

    reference : as :class:`impactopt.transcription.plan.Trajectory`.
    kp, kd : factors of the feedback's stiffness and damping.
    limit : factor of the torque limits, known to the controller.
    seconds : processor time of each QP.
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
        self.low[self.n :], self.high[self.n :] = 0.0, MAX_SLACK
        self.momentum_weights = np.repeat([settings.com, settings.angular_momentum], 3)
        self.seconds: list[float] = []
        # the recovery shifts the body over fixed soles: a plan that steps after the impact has none
        steps_after = stance_at(reference, reference.contact_end) != stance_at(reference, np.inf)
        recovers = self.balances and settings.follow == "recover" and not steps_after
        recovery = Recovery(robot, reference, scene, settings) if recovers else None
        self.planned = reference
        self.planned_tracking = TrackingReference(
            robot, reference, scene.strikers, spread=settings.spreads, recovery=recovery
        )
        self.reference, self.tracking = self.planned, self.planned_tracking
        q0 = np.asarray(reference.q[0])
        self.stance, self.stance_problem = 0, self._stance_problem(0)
        self.estimate = StateEstimate(robot, self.stance_problem.frames, q0)
        self.acceleration = np.zeros(robot.nv)  # predicted at the last sample
        self.striking_force = np.zeros(len(scene.strikers))  # [N], filtered
        self.springs = Servo(robot, reference).springs
        # joints without a motor are not tracked: no torque moves them
        self.passive, self.has_passive = robot.passive, bool(robot.passive.any())
        self.has_soft_grip = bool(robot.sprung.any())
        self.actuated: Array = np.append(np.ones(robot.nv - robot.n), 1.0 - self.passive)  # (nv,) 0 or 1

    def follow(self, missed: Any | None) -> None:
        """Tracks the plan from now on (None), or the reference after a missed impact."""
        self.tracking, self.reference = self.planned_tracking, self.planned
        if missed is not None:
            self.reference = missed
            self.tracking = TrackingReference(self.robot, missed, self.scene.strikers, spread=False)

    def _stance_problem(self, stance: int) -> StanceProblem:
        """QP of a stance phase, with its soles where the reference has them at the beginning of the phase."""
        standing = self.scene.standing_soles(stance)
        q0 = np.asarray(self.reference.q[stance_begins(self.reference, stance)])
        return StanceProblem(self.robot, self.scene, standing, self.settings, q0)

    def torque(self, t: float, angles: Array, v: Array, rotation: Array, forces: Array) -> Array:
        """Torque demand (n,) [N m] at a time [s], from sensor readings of the true state.

        angles (n,), v (nv,), rotation (3, 3) of the base, forces (h,) [N] : the true state and striking
        forces, which the sensors disturb.
        """
        s = self.settings
        measured = self.sensors.read(angles, v, rotation, forces)
        q, rates = self.estimate.of(measured, self.stance_problem.loads, self.stance_problem.points)
        stance = stance_at(self.reference, self.tracking.clock(t)[0])
        if stance != self.stance:  # soles lift off; those that land are assumed to stand where they are now
            self.stance, self.stance_problem = stance, self._stance_problem(stance)
            self.estimate.stand(self.stance_problem.frames, q)
        # predict the state at the time when the torque takes effect
        delay = s.delay
        q = pin.integrate(self.robot.model, q, delay * rates)
        rates = rates + delay * self.acceleration
        self.striking_force += (1 - math.exp(-s.period / FORCE_FILTER)) * (
            measured.forces - self.striking_force
        )
        self.tracking.update_contact(t, bool((measured.forces > self.sensors.contact_force).any()))
        aim = self.tracking.at(t + delay)
        dynamics = self.stance_problem.dynamics
        dynamics.update(q, rates, self.striking_force, s.sole_bandwidth)
        if self.has_passive:
            angles = self.robot.angles.of(q)
            dynamics.fix_torques(self.passive, self.springs(angles, rates[-self.n :]))
        x = self._solve(t, q, rates, aim)[: self.n]
        torque = self.limit * x
        # predictions for the next sample
        self.acceleration = dynamics.A @ torque + dynamics.a0
        if self.balances:
            self.stance_problem.loads, self.stance_problem.points = self.stance_problem.cones.loads(x)
        return torque

    def _solve(self, t: float, q: Array, v: Array, aim: ReferenceSample) -> Array:
        """x (n + 2,): torques over their limits, and the slacks, at q (nq,), v (nv,)."""
        problem, s, n = self.stance_problem, self.settings, self.n
        dynamics, tasks = problem.dynamics, problem.tasks
        recovers = self.tracking.recovers(t + s.delay)
        # in contact the plan's impulse relies on the servos: follow their torques instead of the tasks
        servo_torques = s.impact == "planned" and self.tracking.in_contact and not recovers
        q_error = pin.difference(self.robot.model, q, aim.q)
        v_error = aim.v - v
        rate_error = v_error[-n:]
        if s.projects and self.tracking.near_impact(t, PROJECTION_WINDOW):
            # remove the part of the error that an impulse at the striking points can explain (Yang and
            # Posa 2021): an impact that comes early or late makes just such an error
            J = dynamics.normal_jacobian
            response = dynamics.impulse_response
            v_error = v_error - response @ dgesv(J @ response, J @ v_error)[2]
        A, B = dynamics.A * self.limit, dynamics.B * self.limit  # of x
        tasks.clear()
        if not servo_torques:
            w = s.recovery_bandwidth if recovers else s.posture_bandwidth
            wanted = aim.a + self.kp * w**2 * q_error + self.kd * 2 * w * v_error
            tasks.add(s.posture * self.actuated, A, dynamics.a0 - wanted)
            self._add_swing_feet(aim, v, A)
        self._add_striking_points(q_error, v_error, aim, A, recovers)
        momentum_rate, momentum_map = np.zeros(6), problem.momentum_map
        if self.balances:
            momentum_rate = self._add_momentum(q, v, v_error, aim, B, recovers)
        feed = aim.torque
        if servo_torques:
            feed = feed + self.kp * self.robot.kp * q_error[-n:] + self.kd * self.robot.kd * rate_error
        feed = feed / self.limit
        scale = problem.wrench_scale
        if scale.size:
            # wrenches of the feed-forward; constants that both sides share (gravity, drift) cancel
            constant, goal = dynamics.stabilizing_wrenches, B @ feed
            if recovers:  # without feed-forward: the least scaled wrenches that give the momentum's rate
                weighted = momentum_map / scale**2
                constant = dynamics.b0
                goal = weighted.T @ dgesv(weighted @ momentum_map.T, momentum_rate)[2]
            tasks.add(s.wrench, scale[:, None] * B, scale * (constant - goal))
        P, g = np.zeros((n + 2, n + 2)), np.zeros(n + 2)
        P[:n, :n], g[:n] = tasks.quadratic_form()
        effort = s.blow if servo_torques else (RECOVERY_TORQUE_WEIGHT if recovers else s.torque)
        effort = max(effort, MIN_TORQUE_WEIGHT)
        # flat stride n + 3 of the n + 2 columns is the diagonal
        P.flat[: n * (n + 2) : n + 3] += effort  # diagonal of the torques
        g[:n] -= effort * feed
        P.flat[n * (n + 3) :: n + 3], g[n:] = SLACK_SQUARE_WEIGHT, SLACK_WEIGHT  # diagonal of the slacks
        m = problem.cones.m
        # clearance constraints that no pair of bodies needs read 0 x >= -1, which always holds
        C, c = np.zeros((m + MAX_CONSTRAINTS, n + 2)), np.full(m + MAX_CONSTRAINTS, -1.0)
        C[:m, : n + 1], c[:m] = problem.cones.constraints(dynamics.placements(), B, dynamics.b0)
        if recovers or self.tracking.bounced:  # up to the impact the plan keeps bodies apart, at speed
            J, lower = self.clearance.constraints(dynamics.data)
            its = slice(m, m + len(lower))
            C[its, :n], C[its, n + 1] = J @ A / CLEARANCE_SCALE, 1.0
            c[its] = (lower - J @ dynamics.a0) / CLEARANCE_SCALE
        begun = time.process_time()
        x = problem.qp.solve(P, g, C, c, self.low, self.high)
        self.seconds.append(time.process_time() - begun)
        return x

    def _add_striking_points(
        self, q_error: Array, v_error: Array, aim: ReferenceSample, A: Array, recovers: bool
    ) -> None:
        """Adds the task of the striking points: tracked until contact, and drawn back with a soft grip."""
        dynamics, s, w = self.stance_problem.dynamics, self.settings, self.settings.hand_bandwidth
        draws_back = self.has_soft_grip and self.tracking.bounced and not recovers
        if not (self.tracking.before_contact or draws_back):
            return
        for J, point, drift, goal in zip(
            dynamics.jacobians,
            dynamics.striking_points(),
            dynamics.striking_drift,
            aim.striking_points,
            strict=True,
        ):
            error, acceleration = goal[0] - point, goal[2]
            if self.has_soft_grip:
                # no torque controls the tool's swing in the grip: take it out of the errors
                swing, J = J * (1.0 - self.actuated), J * self.actuated
                error, acceleration = error - swing @ q_error, acceleration - swing @ aim.a
            if draws_back:  # the tool swings on in its grip, and would touch again
                error = error - s.draw_back * self.scene.normal
            wanted = acceleration + self.kp * w**2 * error + self.kd * 2 * w * (J @ v_error)
            self.stance_problem.tasks.add(s.hand, J @ A, J @ dynamics.a0 + drift - wanted)

    def _add_swing_feet(self, aim: ReferenceSample, v: Array, A: Array) -> None:
        """Adds the task of the soles in the air; with the posture's task alone they would land at speed."""
        model, planned, w = self.robot.model, self.data, SWING_FOOT_BANDWIDTH
        dynamics = self.stance_problem.dynamics
        if self.stance_problem.swing_feet:
            pin.forwardKinematics(model, planned, aim.q, aim.v, aim.a)
        for i in self.stance_problem.swing_feet:
            goal, now = (
                pin.updateFramePlacement(model, planned, i),
                pin.updateFramePlacement(model, dynamics.data, i),
            )
            J = np.array(pin.getFrameJacobian(model, dynamics.data, i, _AXES))
            drift = pin.getFrameClassicalAcceleration(model, dynamics.data, i, _AXES).vector
            rate_error = pin.getFrameVelocity(model, planned, i, _AXES).vector - J @ v
            error = np.append(goal.translation - now.translation, pin.log3(goal.rotation @ now.rotation.T))
            wanted = pin.getFrameClassicalAcceleration(model, planned, i, _AXES).vector
            wanted = wanted + self.kp * w**2 * error + self.kd * 2 * w * rate_error
            self.stance_problem.tasks.add(self.settings.hand, J @ A, J @ dynamics.a0 + drift - wanted)

    def _add_momentum(
        self, q: Array, v: Array, v_error: Array, aim: ReferenceSample, B: Array, recovers: bool
    ) -> Array:
        """Adds the task of the centroidal momentum, whose rate the wrenches give.

        Returns the total wrench (6,) about the centre of mass, over the mass, that gives the wanted rate.
        """
        dynamics, momentum_map = self.stance_problem.dynamics, self.stance_problem.momentum_map
        s, data, mass = self.settings, self.data, self.mass
        Ag = pin.ccrba(self.robot.model, data, q, v)
        com = np.array(data.com[0])
        for k, placement in enumerate(dynamics.placements()):
            momentum_map[3:, 6 * k : 6 * k + 3] = pin.skew((placement.translation - com) / mass)
        # feedback on the divergent component of motion com + rate / omega: its error decays at `gain`
        gain, omega = s.capture_gain, math.sqrt(np.linalg.norm(self.gravity) / max(com[2], 0.1))
        error = Ag @ v_error
        if recovers:  # the reference of the centre of mass is no longer that of the joints
            error[:3] = mass * aim.com[1] - data.hg.linear
        wanted = np.zeros(6)
        # (c' + c''/omega) = -gain (c + c'/omega) for the errors: c'' = -omega gain c - (omega + gain) c'. The
        # soles' wrenches over the mass are c'' - g.
        wanted[:3] = (
            aim.com[2]
            + self.kp * omega * gain * (aim.com[0] - com)
            + self.kd * (omega + gain) * error[:3] / mass
            - self.gravity
        )
        wanted[3:] = (aim.angular_momentum[1] + s.momentum_gain * error[3:]) / mass
        self.stance_problem.tasks.add(
            self.momentum_weights, momentum_map @ B, momentum_map @ dynamics.b0 - wanted
        )
        return wanted


class Tasks:
    """Sum of 1/2 weight (J x + offset)^2 over tasks, for x (n,).

    Tasks are stacked in one array, so that a single matrix product gives the Hessian of all of them.

    most : number of errors of all tasks together.
    """

    def __init__(self, n: int, most: int) -> None:
        self._J, self._offset, self._weight = np.zeros((most, n)), np.zeros(most), np.zeros(most)
        self._used = 0

    def clear(self) -> None:
        """Removes all tasks."""
        self._used = 0

    def add(self, weight: float | Array, J: Array, offset: Array) -> None:
        """Adds a task with J (k, n), offset (k,) and one weight or (k,)."""
        its = slice(self._used, self._used + len(offset))
        self._J[its], self._offset[its], self._weight[its] = J, offset, weight
        self._used = its.stop

    def quadratic_form(self) -> tuple[Array, Array]:
        """Hessian (n, n), and gradient (n,) at x = 0."""
        J = self._J[: self._used]
        weighted = J.T * self._weight[: self._used]
        return weighted @ J, weighted @ self._offset[: self._used]
