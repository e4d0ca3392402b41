"""Frozen dynamics: quantities computed at contact and then kept constant (paper, steps 1b, 2b).

With H the generalized inertia (nv, nv), J_c the Jacobians of the fixed soles and hands (c, nv), Gamma the
diagonal compliance of a virtual base (zero for exact constraints) and S (n, nv) the selection of the joints,

    P = H^-1 - H^-1 J_c' (J_c H^-1 J_c' + Gamma)^-1 J_c H^-1

is the inverse inertia of the constrained robot. The paper eliminates the base instead (its H*, J*), which
loses the contact force from the base's momentum balance. Here H is factorized as a whole, and the constraints
enter by their Delassus matrix (c, c). The time loop then needs quantities of the joints and of the hand only.
With j = n' J_hand, joint velocities u, and the hand's speed w along the normal,

    du/dt = A tau - s f + d,    A = S P S', s = S P j'
    dw/dt = s' tau - m f + e,   m = j P j' = 1 / effective mass
    constraint wrenches = L_tau tau - L_f f + L_0

With friction the force on the target is f n + f_t. `s_point`, `m_point`, `e_point` and `L_point`, with J_hand
in the place of j, give the effect of f_t and the velocity of the striking point.

The drifts d, e, L_0 are quadratic in the velocity, which an impact changes within a few milliseconds. They
are frozen at the velocity at the end of compression, when hand and target move at one speed, estimated from
two point masses,

    v_meet = v - P j' v_c / (m + 1 / target's mass).

With the velocity before the impact instead, the error of the impulse is 2 %; with v_meet, below 1 %.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from impactopt.codegen.cache import cached, model_hash
from impactopt.errors import check_direction
from impactopt.kinematics.stance import Stance, stance_of
from impactopt.robots.rigid_body import RigidBody
from impactopt.robots.robot import Robot


class FrozenDynamics:
    """Frozen quantities as MX expressions of q, v, the normal and `target_start`, built on first access.

    `target_start` (2) has the inverse mass of the target's surface [1/kg] and its speed [m/s]; the inverse
    mass is infinite if v is itself the velocity at which the drifts are frozen.

    Algebra on the kinematic tree is sparse and done in SX; dense algebra is done in MX, for short C code.

    Parameters
    ----------
    robot, stance : the robot, and its constraints to the world.
    frame : the striking frame of the model.
    bias : with Coriolis, centrifugal and gravity terms (paper, eq. 6).
    jdot : with dJ/dt v, of hand and constrained frames (paper, eq. 14).
    """

    def __init__(self, robot: Robot, stance: Stance, frame: str, *, bias: bool, jdot: bool) -> None:
        self.robot, self.bias, self.jdot = robot, bias, jdot
        self.held = stance.constraint_frames(robot)
        self.soles = stance.sole_frames(robot)
        self.q, self.v = ca.MX.sym("q", robot.nq), ca.MX.sym("v", robot.nv)
        self.normal, self.target_start = ca.MX.sym("normal", 3), ca.MX.sym("target_start", 2)
        self._tree = _TreeQuantities(robot, self.held, self.soles, frame)
        self._gamma = ca.diag(ca.repmat(ca.DM(stance.compliance), len(self.held), 1))

    def function(self, name: str, outputs: tuple[str, ...]) -> Any:
        """ca.Function (q (nq), v (nv), normal (3), `target_start` (2)) -> these attributes of this class."""
        inputs = {"q": self.q, "v": self.v, "normal": self.normal, "target_start": self.target_start}
        out = [ca.densify(getattr(self, key)) for key in outputs]
        return ca.Function(name, list(inputs.values()), out, list(inputs), list(outputs))

    def _call(self, name: str, *, drifting: bool = False) -> Any:
        return self._tree.function(name)(self.q, self.drift_velocity if drifting else self.v, self.normal)

    # ------------------------------------------------------------ at the hand
    @cached_property
    def hand_speed(self) -> Any:
        """v_c = j v [m/s] (paper, eq. 16)."""
        return self._call("hand_speed")

    @cached_property
    def drift_velocity(self) -> Any:
        """Velocity v_meet (nv) at the end of compression; v itself if hand and target do not approach."""
        if not (self.bias or self.jdot):
            return self.v
        w, z = self._roots, self._held
        # P j' = W' (W_j - W_c R^-T Z_j), with W = D^-1/2 L^-T of the comment below
        inner = w["hand"] - ca.mtimes(w["held"], ca.mtimes(self._cholesky.T, z["hand"]))
        closing = self.hand_speed - self.target_start[1]
        impulse = ca.fmax(closing, 0.0) / (self.m + self.target_start[0])
        return self.v - ca.mtimes(self._inverse_root.T, inner) * impulse

    # ------------------------------------------------------------ inverse inertias
    # With H = L' D L and W_X = D^-1/2 L^-T X' of a Jacobian X,  X H^-1 Y' = W_X' W_Y. With R R' the Cholesky
    # factorization of the Delassus matrix and Z_X = R^-1 W_c' W_X,  X P Y' = W_X' W_Y - Z_X' Z_Y.
    @cached_property
    def _cholesky(self) -> Any:
        """R^-1 (c, c)."""
        w = self._roots["held"]
        return _inverse_of_cholesky(w.size2())(ca.mtimes(w.T, w) + self._gamma)

    @cached_property
    def _inverse_root(self) -> Any:
        return self._tree.inverse_root(self._call("mass_matrix"))

    @cached_property
    def _roots(self) -> dict[str, Any]:
        """W_X of the Jacobians of hand, constrained frames and striking point, and of S."""
        root = self._inverse_root
        names = {"hand": "hand_row", "held": "held_jacobian", "point": "point_jacobian"}
        jacobians = {key: self._call(name).T for key, name in names.items()}
        return {k: ca.mtimes(root, x) for k, x in jacobians.items()} | {"joints": root[:, -self.robot.n :]}

    @cached_property
    def _held(self) -> dict[str, Any]:
        """Z_X of each W_X; with no rows if nothing is constrained (c = 0)."""
        return {k: self._z(w) for k, w in self._roots.items() if k != "held"}

    def _z(self, root: Any) -> Any:
        return ca.mtimes(self._cholesky, ca.mtimes(self._roots["held"].T, root))

    def _form(self, left: str, right: str) -> Any:
        """X P Y'."""
        w, z = self._roots, self._held
        return ca.mtimes(w[left].T, w[right]) - ca.mtimes(z[left].T, z[right])

    @cached_property
    def A(self) -> Any:
        """Joint accelerations per joint torque, S P S' [1/(kg m2)]: its lower triangle, by columns."""
        dense = ca.densify(self._form("joints", "joints"))
        return ca.project(dense, ca.Sparsity.lower(self.robot.n)).nz[:]

    @cached_property
    def s(self) -> Any:
        """Joint accelerations per normal force at the hand, S P j' (n) [rad/(kg m)]."""
        return self._form("joints", "hand")

    @cached_property
    def m(self) -> Any:
        """Inverse effective mass at the hand, j P j' [1/kg]."""
        return self._form("hand", "hand")

    @cached_property
    def point_velocity(self) -> Any:
        """J_hand v (3) [m/s]."""
        return self._call("point_velocity")

    @cached_property
    def s_point(self) -> Any:
        """S P J_hand' (n, 3) [rad/(kg m)]."""
        return self._form("joints", "point")

    @cached_property
    def m_point(self) -> Any:
        """J_hand P J_hand' (3, 3) [1/kg]."""
        return self._form("point", "point")

    # ------------------------------------------------------------ conditioning
    @cached_property
    def pivots(self) -> Any:
        """Pivots of the Delassus matrix's factorization, relative to its diagonal (c).

        A pivot is zero if the constraints before it already imply its constraint. All results have a relative
        rounding error of 1e-16 over the smallest pivot.
        """
        held = self._roots["held"]
        diagonal = ca.sum1(held**2).T + ca.diag(self._gamma)
        # 1 / (R^-1)_ii^2 = R_ii^2: what is left of diagonal i after the constraints before it are eliminated
        return 1 / (ca.diag(self._cholesky) ** 2 * diagonal)

    @cached_property
    def freedom(self) -> Any:
        """`m` over its value without constraints; zero if the constraints do not let the hand move."""
        return self.m / ca.sumsqr(self._roots["hand"])

    # ------------------------------------------------------------ drifts: accelerations without torque or
    # force
    @cached_property
    def _bias_root(self) -> Any:
        return ca.mtimes(self._inverse_root, self._call("bias_force", drifting=True))

    @cached_property
    def _held_push(self) -> Any:
        """R^-1 (J_c H^-1 bias - dJ_c/dt v): R^-1 times minus the acceleration of the frames if free."""
        push = self._z(self._bias_root) if self.bias else ca.MX.zeros(6 * len(self.held), 1)
        if not self.jdot:
            return push
        return push - ca.mtimes(self._cholesky, self._call("held_drift", drifting=True))

    def _drift(self, jacobian: str) -> Any:
        drift = ca.mtimes(self._held[jacobian].T, self._held_push)
        return drift - ca.mtimes(self._roots[jacobian].T, self._bias_root) if self.bias else drift

    @cached_property
    def d(self) -> Any:
        """Drift of the joint velocities (n) [rad/s2]."""
        return self._drift("joints")

    @cached_property
    def e(self) -> Any:
        """Drift of the hand's speed along the normal [m/s2]."""
        drift = self._drift("hand")
        return drift + self._call("hand_drift", drifting=True) if self.jdot else drift

    @cached_property
    def e_point(self) -> Any:
        """Drift of the striking point's velocity (3) [m/s2]."""
        drift = self._drift("point")
        return drift + self._call("point_drift", drifting=True) if self.jdot else drift

    # ------------------------------------------------------------ wrenches
    @cached_property
    def L_tau(self) -> Any:
        """Wrenches of the world on the constrained frames per joint torque (c, n) [N/(N m), -]."""
        # w = -G^-1 (J_c H^-1 (S' tau - j' f - bias) + dJ_c/dt v), where G^-1 = R^-T R^-1 is of the Delassus
        # matrix: so is the sign of each of the four parts below.
        return -ca.mtimes(self._cholesky.T, self._held["joints"])

    @cached_property
    def L_f(self) -> Any:
        """Decrease of these wrenches per normal force at the hand (c) [-, m]."""
        return -ca.mtimes(self._cholesky.T, self._held["hand"])

    @cached_property
    def L_point(self) -> Any:
        """Decrease of these wrenches per force at the striking point (c, 3) [-, m]."""
        return -ca.mtimes(self._cholesky.T, self._held["point"])

    @cached_property
    def L_0(self) -> Any:
        """Wrenches without torque or contact force (c) [N, N m]."""
        return ca.mtimes(self._cholesky.T, self._held_push)

    @cached_property
    def sole_positions(self) -> Any:
        """Origins of the fixed soles' frames in the world (3, soles) [m]."""
        return self._call("sole_positions")

    @cached_property
    def unmodelled_wrench(self) -> Any:
        """Ground wrench (6) about the world's origin that balances the bias if `bias` is off, else zero.

        The momentum balance of the whole robot includes gravity, Coriolis and centrifugal forces in any case.
        """
        return ca.MX.zeros(6) if self.bias else self._call("carrying_wrench")

    # ------------------------------------------------------------ whole motion
    @cached_property
    def velocity_change(self) -> Any:
        """ca.Function (q, drift velocity, normal, torque, force, friction, wrenches, time) -> change of v.

        torque (n), force, friction (3) and wrenches (c) are time integrals, with H and the bias frozen at (q,
        drift velocity). With double integrals, and time^2 / 2 in the place of time, it gives the change of
        position.
        """
        return self._tree.velocity_change(self.bias)

    @cached_property
    def integrate(self) -> Any:
        """ca.Function (q, d) -> q moved by d (nv), as pin.integrate."""
        d = ca.SX.sym("d", self.robot.nv)
        return ca.Function("integrate", [self._tree.rb.q, d], [self._tree.rb.integrate(d)])

    @cached_property
    def speed_of_hand(self) -> Any:
        """ca.Function (q, v, normal) -> `hand_speed`."""
        return self._tree.function("hand_speed")

    @cached_property
    def velocity_of_point(self) -> Any:
        """ca.Function (q, v, normal) -> `point_velocity`."""
        return self._tree.function("point_velocity")


class _TreeQuantities:
    """Quantities of the kinematic tree, each as an SX function of q, v and the normal."""

    def __init__(self, robot: Robot, held: tuple[str, ...], soles: tuple[str, ...], frame: str) -> None:
        self.robot, self.held, self.soles, self.frame = robot, held, soles, frame
        self.rb = RigidBody(robot.model, springs=robot.springs)
        self.normal = ca.SX.sym("normal", 3)
        self.base = robot.nv - robot.n

    def function(self, name: str) -> Any:
        return ca.Function(name, [self.rb.q, self.rb.v, self.normal], [getattr(self, name)])

    @cached_property
    def mass_matrix(self) -> Any:
        """H (nv, nv), sparse."""
        return self.rb.mass_matrix()

    @cached_property
    def inverse_root(self) -> Any:
        """ca.Function H -> D^-1/2 L^-T (nv, nv), sparse, with H = L' D L."""
        H = ca.SX.sym("H", self.mass_matrix.sparsity())
        factor = self.rb.factorize(H)
        root = ca.mtimes(ca.diag(1 / ca.sqrt(factor.diagonal)), factor.half_solve(ca.SX.eye(self.rb.nv)))
        return ca.Function("inverse_root", [H], [root])

    @cached_property
    def hand_row(self) -> Any:
        """Jacobian of the striking point along the normal, j (1, nv)."""
        return ca.mtimes(self.normal.T, self.point_jacobian)

    @cached_property
    def point_jacobian(self) -> Any:
        """Jacobian of the striking point's position, J_hand (3, nv)."""
        return self.rb.jacobian(self.frame)[:3, :]

    @cached_property
    def held_jacobian(self) -> Any:
        """Jacobians of the constrained frames, J_c (c, nv), LOCAL_WORLD_ALIGNED."""
        return ca.vertcat(ca.SX(0, self.rb.nv), *[self.rb.jacobian(frame) for frame in self.held])

    @cached_property
    def bias_force(self) -> Any:
        """Bias C v + g (nv)."""
        return self.rb.rnea(self.rb.v, None)

    @property
    def point_velocity(self) -> Any:
        return self.rb.frame_velocity(self.frame, self.rb.v)[:3]

    @property
    def point_drift(self) -> Any:
        return self.rb.frame_acceleration(self.frame, self.rb.v, None)[:3]

    @property
    def hand_speed(self) -> Any:
        return ca.dot(self.normal, self.point_velocity)

    @property
    def hand_drift(self) -> Any:
        return ca.dot(self.normal, self.point_drift)

    @property
    def held_drift(self) -> Any:
        drifts = [self.rb.frame_acceleration(frame, self.rb.v, None) for frame in self.held]
        return ca.vertcat(ca.SX(0, 1), *drifts)

    @property
    def sole_positions(self) -> Any:
        return ca.horzcat(*[self.rb.frame(frame)[1] for frame in self.soles])

    @property
    def carrying_wrench(self) -> Any:
        # the bias on the base, expressed as a wrench at a sole by its Jacobian, then about the world's origin
        J, p, bias = self.rb.jacobian(self.soles[0]), self.rb.frame(self.soles[0])[1], self.bias_force
        R = J[:3, :3]
        # Columns of the base in J: R = J[:3, :3] turns its own axes to the world's. J' (force, moment) = bias
        # of the base has force in its first three equations, and moment and force in the next.
        force = ca.mtimes(R, bias[:3])
        moment = ca.mtimes(R, bias[3:6] - ca.mtimes(J[:3, 3:6].T, force))
        return ca.vertcat(force, moment + ca.cross(p, force))

    def velocity_change(self, bias: bool) -> Any:
        torque, force, time = ca.SX.sym("torque", self.robot.n), ca.SX.sym("force"), ca.SX.sym("time")
        friction = ca.SX.sym("friction", 3)
        wrench = ca.SX.sym("wrench", 6 * len(self.held))
        # the base has no actuator; the contact force is -f n on the hand
        push = ca.vertcat(ca.SX.zeros(self.base, 1), torque) - self.hand_row.T * force
        push += ca.mtimes(self.held_jacobian.T, wrench) - ca.mtimes(self.point_jacobian.T, friction)
        if bias:
            push -= self.bias_force * time
        change = ca.densify(self.rb.factorize().solve(push))
        inputs = [self.rb.q, self.rb.v, self.normal, torque, force, friction, wrench, time]
        return ca.Function("velocity_change", inputs, [change])


def _inverse_of_cholesky(size: int) -> Any:
    """ca.Function G (size, size) symmetric positive definite -> R^-1 with R R' = G, R lower triangular."""
    G = ca.SX.sym("G", size, size)
    return ca.Function("inverse_of_cholesky", [G], [ca.solve(ca.chol(G).T, ca.SX.eye(size))])


def effective_mass(robot: Robot, *, striker: str, normal: ArrayLike, stance: Stance | None = None) -> Any:
    """Effective mass at the striking point along a normal, as a compiled ca.Function q (nq) -> mass [kg].

    It is 1 / (n' J P J' n) with the inverse inertia P of the robot as constrained by `stance` (None: all
    soles, or the fixed base), with free joints and without a servo. The paper calls it virtual mass (its
    section III, after Asada and Ogawa, and Khatib).

    Raises
    ------
    InputError : an unknown striker; a normal that is not a unit vector; a stance the robot cannot take.
    """
    held_by = stance_of(robot, stance)
    frame = robot.striker(striker).model_frame
    n = check_direction("normal", normal)

    def build() -> list[Any]:
        frozen = FrozenDynamics(robot, held_by, frame, bias=False, jdot=False)
        m = frozen.function("frozen", ("m",))(frozen.q, np.zeros(robot.nv), n, 0.0)
        return [ca.Function("effective_mass", [frozen.q], [1.0 / m], ["q"], ["mass"])]

    recipe = (model_hash(robot.model), frame, repr(held_by), held_by.constraint_frames(robot), tuple(n))
    return cached("effective_mass", recipe, build)["effective_mass"]
