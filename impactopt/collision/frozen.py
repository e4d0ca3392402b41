"""Steps 1b and 2b of the paper: what is computed once, at the moment of contact, and then kept constant.

With H the generalized inertia, J_c the fixed soles' Jacobians (c rows), Gamma the diagonal compliance of a
virtual base (zero for exactly fixed soles) and S the selection of the n joints out of the nv velocities,

    P = H^-1 - H^-1 J_c' (J_c H^-1 J_c' + Gamma)^-1 J_c H^-1

is the inverse inertia of the robot as held. In place of the paper's H*, J* with the base eliminated, which
lose the contact force from the base's momentum balance, H is factorized whole and the soles enter by their
(c, c) Delassus matrix. All that the time loop needs then lives in joint space and at the hand; with
j = n' J_hand,

    du/dt = A tau - s f + d,    A = S P S', s = S P j'
    dw/dt = s' tau - m f + e,   m = j P j' = 1 / effective mass
    wrenches of what is held = L_tau tau - L_f f + L_0

With friction the force on the target is f n + f_t, and the same with J_hand in the place of j (`s_point`,
`m_point`, `e_point`, `L_point`) tells what f_t does, and the striking point's velocity.

The drifts d, e, L_0 are quadratic in the velocity, and the blow changes the velocity within the first few
milliseconds. So they are frozen at the velocity with which hand and target have met, at the end of
compression, as two point masses would reach it,

    v_meet = v - P j' v_c / (m + 1 / target's mass),

and not at the velocity before: that takes the impulse's error from 2 % to below 1 %.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from impactopt.codegen.cache import cached, model_hash
from impactopt.errors import check_direction
from impactopt.kinematics.stance import Stance, usual_stance
from impactopt.robots.rigid_body import RigidBody
from impactopt.robots.robot import Robot

__all__ = ["FrozenDynamics", "effective_mass"]


class FrozenDynamics:
    """The frozen quantities as MX expressions of q, v, the normal, and the target's yield [1/kg]: one over
    its mass, infinite where v is itself the velocity to freeze the drifts at. Each is built when first asked
    for.

    Tree-shaped algebra is done in SX, dense algebra in MX, which keeps the code short.

    Parameters
    ----------
    robot, stance : what moves, and what holds it.
    frame : the striking frame of the model.
    bias : let Coriolis, centrifugal and gravity terms act (paper, eq. 6).
    jdot : let dJ/dt v act, of hand and soles (paper, eq. 14).
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
        """(nv): v when hand and target have met; see above. v itself where the two do not approach."""
        if not (self.bias or self.jdot):
            return self.v
        w, z = self._roots, self._held
        inner = w["hand"] - ca.mtimes(w["held"], ca.mtimes(self._cholesky.T, z["hand"]))
        closing = self.hand_speed - self.target_start[1]
        impulse = ca.fmax(closing, 0.0) / (self.m + self.target_start[0])
        return self.v - ca.mtimes(self._inverse_root.T, inner) * impulse

    # ------------------------------------------------------------ inverse inertias
    # With H = L' D L, roots W = D^-1/2 L^-T X' of rows X make X H^-1 Y' = W_X' W_Y; and with R R' the
    # Cholesky factorization of the Delassus matrix and Z = R^-1 W_c' W,  X P Y' = W_X' W_Y - Z_X' Z_Y.
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
        root = self._inverse_root
        names = {"hand": "hand_row", "held": "held_jacobian", "point": "point_jacobian"}
        rows = {key: self._call(name).T for key, name in names.items()}
        return {k: ca.mtimes(root, x) for k, x in rows.items()} | {"joints": root[:, -self.robot.n :]}

    @cached_property
    def _held(self) -> dict[str, Any]:
        """Z of each root W; without rows where nothing is held."""
        return {k: self._z(w) for k, w in self._roots.items() if k != "held"}

    def _z(self, root: Any) -> Any:
        return ca.mtimes(self._cholesky, ca.mtimes(self._roots["held"].T, root))

    def _form(self, rows: str, columns: str) -> Any:
        """X P Y'."""
        w, z = self._roots, self._held
        return ca.mtimes(w[rows].T, w[columns]) - ca.mtimes(z[rows].T, z[columns])

    @cached_property
    def A(self) -> Any:
        """Lower triangle, by columns, of S P S' [1/(kg m2)]: joint accelerations per joint torque."""
        dense = ca.densify(self._form("joints", "joints"))
        return ca.project(dense, ca.Sparsity.lower(self.robot.n)).nz[:]

    @cached_property
    def s(self) -> Any:
        """S P j' (n): joint accelerations per normal force at the hand [rad/(kg m)]."""
        return self._form("joints", "hand")

    @cached_property
    def m(self) -> Any:
        """j P j' [1/kg]: one over the effective mass."""
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

    # ------------------------------------------------------------ what rounding leaves
    @cached_property
    def pivots(self) -> Any:
        """(c): what is left of each diagonal entry of the constrained frames' Delassus matrix in its
        factorization.

        Zero where the frame's direction is held already by those before it: a relative rounding error of
        1e-16 over this is left in all that is computed.
        """
        held = self._roots["held"]
        diagonal = ca.sum1(held**2).T + ca.diag(self._gamma)
        return 1 / (ca.diag(self._cholesky) ** 2 * diagonal)

    @cached_property
    def freedom(self) -> Any:
        """`m` over what it is with nothing held; zero where the hand is held fast."""
        return self.m / ca.sumsqr(self._roots["hand"])

    # ------------------------------------------------------------ drifts
    # Accelerations without torque or contact force.
    @cached_property
    def _bias_root(self) -> Any:
        return ca.mtimes(self._inverse_root, self._call("bias_force", drifting=True))

    @cached_property
    def _held_push(self) -> Any:
        """R^-1 (J_c H^-1 bias - dJ_c/dt v): minus the acceleration of what is held if it were free."""
        push = self._z(self._bias_root) if self.bias else ca.MX.zeros(6 * len(self.held), 1)
        if not self.jdot:
            return push
        return push - ca.mtimes(self._cholesky, self._call("held_drift", drifting=True))

    def _drift(self, rows: str) -> Any:
        drift = ca.mtimes(self._held[rows].T, self._held_push)
        return drift - ca.mtimes(self._roots[rows].T, self._bias_root) if self.bias else drift

    @cached_property
    def d(self) -> Any:
        """(n) [rad/s2]: drift of the joint velocities."""
        return self._drift("joints")

    @cached_property
    def e(self) -> Any:
        """[m/s2]: drift of the hand's normal speed."""
        drift = self._drift("hand")
        return drift + self._call("hand_drift", drifting=True) if self.jdot else drift

    @cached_property
    def e_point(self) -> Any:
        """(3) [m/s2]: drift of the striking point's velocity."""
        drift = self._drift("point")
        return drift + self._call("point_drift", drifting=True) if self.jdot else drift

    # ------------------------------------------------------------ wrenches
    @cached_property
    def L_tau(self) -> Any:
        """(c, n): wrenches [N, N m] of the world on what is held per joint torque."""
        return -ca.mtimes(self._cholesky.T, self._held["joints"])

    @cached_property
    def L_f(self) -> Any:
        """(c): wrenches lost per normal force at the hand."""
        return -ca.mtimes(self._cholesky.T, self._held["hand"])

    @cached_property
    def L_point(self) -> Any:
        """(c, 3): wrenches lost per force at the hand."""
        return -ca.mtimes(self._cholesky.T, self._held["point"])

    @cached_property
    def L_0(self) -> Any:
        """(c): wrenches without torque or contact force [N, N m]."""
        return ca.mtimes(self._cholesky.T, self._held_push)

    @cached_property
    def sole_positions(self) -> Any:
        """(3, number of fixed soles) [m]: origins of the sole frames in the world."""
        return self._call("sole_positions")

    @cached_property
    def unmodelled_wrench(self) -> Any:
        """(6) about the world's origin: what carries the weight where `bias` is left out.

        The whole robot's momentum balance has gravity, Coriolis and centrifugal forces in any case.
        """
        return ca.MX.zeros(6) if self.bias else self._call("carrying_wrench")

    # ------------------------------------------------------------ whole motion
    @cached_property
    def velocity_change(self) -> Any:
        """ca.Function (q, drift velocity, normal, torque, force, friction, wrenches, time) -> change of v
        (nv).

        From time, and integrals over it of torque (n), contact force, friction (3) and wrenches of what is
        held (c), with what was frozen at (q, drift velocity). With double integrals in their place and
        time^2 / 2, the change of position.
        """
        return self._tree.velocity_change(self.bias)

    @cached_property
    def integrate(self) -> Any:
        """ca.Function (q, d) -> q after moving by d (nv), as pin.integrate."""
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
    """Quantities that depend on the robot's tree, each as an SX function of q, v and the normal."""

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
        """j (1, nv)."""
        return ca.mtimes(self.normal.T, self.point_jacobian)

    @cached_property
    def point_jacobian(self) -> Any:
        """J_hand (3, nv)."""
        return self.rb.jacobian(self.frame)[:3, :]

    @cached_property
    def held_jacobian(self) -> Any:
        """J_c (c, nv), LOCAL_WORLD_ALIGNED at the constrained frames."""
        return ca.vertcat(ca.SX(0, self.rb.nv), *[self.rb.jacobian(frame) for frame in self.held])

    @cached_property
    def bias_force(self) -> Any:
        """C v + g (nv)."""
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
        # the base's rows of c + g, carried to a sole by that sole's Jacobian, and on to the origin
        J, p, bias = self.rb.jacobian(self.soles[0]), self.rb.frame(self.soles[0])[1], self.bias_force
        R = J[:3, :3]
        force = ca.mtimes(R, bias[:3])
        moment = ca.mtimes(R, bias[3:6] - ca.mtimes(J[:3, 3:6].T, force))
        return ca.vertcat(force, moment + ca.cross(p, force))

    def velocity_change(self, bias: bool) -> Any:
        torque, force, time = ca.SX.sym("torque", self.robot.n), ca.SX.sym("force"), ca.SX.sym("time")
        friction = ca.SX.sym("friction", 3)
        wrench = ca.SX.sym("wrench", 6 * len(self.held))
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
    R, inverse = ca.SX.zeros(size, size), ca.SX.zeros(size, size)
    for j in range(size):
        R[j, j] = ca.sqrt(G[j, j] - ca.mtimes(R[j, :j], R[j, :j].T))
        for i in range(j + 1, size):
            R[i, j] = (G[i, j] - ca.mtimes(R[i, :j], R[j, :j].T)) / R[j, j]
    for i in range(size):
        inverse[i, i] = 1 / R[i, i]
        for j in range(i):
            inverse[i, j] = -ca.mtimes(R[i, j:i], inverse[j:i, j]) / R[i, i]
    return ca.Function("inverse_of_cholesky", [G], [inverse])


def effective_mass(robot: Robot, *, striker: str, normal: ArrayLike, stance: Stance | None = None) -> Any:
    """Compiled ca.Function q (nq) -> 1 / (n' J P J' n) [kg], the mass that the target meets at first.

    P is the inverse inertia of the robot as held by `stance` (None: all soles, or the fixed base); free
    joints, no servo. The paper calls it virtual mass (its section III, after Asada and Ogawa, and Khatib).

    Raises
    ------
    InputError : an unknown striker; a normal that is not a unit vector; a stance the robot cannot take.
    """
    frame = robot.striker(striker).model_frame
    n = check_direction("normal", normal)
    held_by = usual_stance(robot) if stance is None else stance

    def build() -> list[Any]:
        frozen = FrozenDynamics(robot, held_by, frame, bias=False, jdot=False)
        m = frozen.function("frozen", ("m",))(frozen.q, np.zeros(robot.nv), n, 0.0)
        return [ca.Function("effective_mass", [frozen.q], [1.0 / m], ["q"], ["mass"])]

    recipe = (model_hash(robot.model), frame, repr(held_by), held_by.constraint_frames(robot), tuple(n))
    return cached("effective_mass", recipe, build)["effective_mass"]
