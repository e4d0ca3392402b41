"""Steps 1b and 2b of the paper: what is computed once, at the moment of contact, and then kept constant.

With H the generalized inertia, J_c the held soles' Jacobians (c rows), Gamma the diagonal compliance of a
virtual base (zero for exactly held soles) and S the selection of the n joints out of the nv velocities,

    P = H^-1 - H^-1 J_c' (J_c H^-1 J_c' + Gamma)^-1 J_c H^-1

is the inverse inertia of the robot as held. In place of the paper's H*, J* with the base eliminated, which
lose the contact force from the base's momentum balance, H is factorized whole and the soles enter by their
(c, c) Delassus matrix. All that the time loop needs then lives in joint space and at the hand; with
j = n' J_hand,

    du/dt = A tau - s f + d,    A = S P S', s = S P j'
    dw/dt = s' tau - m f + e,   m = j P j' = 1 / effective mass
    sole wrenches = L_tau tau - L_f f + L_0
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import casadi as ca

from ..rigid_body import RigidBody
from ..robot import Robot
from ..stance import Stance

__all__ = ["FrozenDynamics"]


class FrozenDynamics:
    """The frozen quantities as MX expressions of q, v and the normal; each is built when first asked for.

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
        self.soles = stance.constraint_frames(robot)
        self.q, self.v = ca.MX.sym("q", robot.nq), ca.MX.sym("v", robot.nv)
        self.normal = ca.MX.sym("normal", 3)
        self._tree = _TreeQuantities(robot, self.soles, frame)
        self._gamma = ca.diag(ca.repmat(ca.DM(stance.compliance), len(self.soles), 1))

    def function(self, name: str, outputs: tuple[str, ...]) -> Any:
        """ca.Function (q (nq), v (nv), normal (3)) -> the named attributes of this class."""
        out = [ca.densify(getattr(self, key)) for key in outputs]
        return ca.Function(name, [self.q, self.v, self.normal], out, ["q", "v", "normal"], list(outputs))

    def _call(self, name: str) -> Any:
        return self._tree.function(name)(self.q, self.v, self.normal)

    # ------------------------------------------------------------ at the hand
    @cached_property
    def hand_speed(self) -> Any:
        """v_c = j v [m/s] (paper, eq. 16)."""
        return self._call("hand_speed")

    @cached_property
    def joint_velocity(self) -> Any:
        """(n) [rad/s] at contact, at which the servo's reference coasts on."""
        return self.v[-self.robot.n :]

    # ------------------------------------------------------------ inverse inertias
    # With H = L' D L, roots W = D^-1/2 L^-T X' of rows X make X H^-1 Y' = W_X' W_Y; and with R R' the
    # Cholesky factorization of the Delassus matrix and Z = R^-1 W_c' W,  X P Y' = W_X' W_Y - Z_X' Z_Y.
    @cached_property
    def _cholesky(self) -> Any:
        """R^-1 (c, c)."""
        w = self._roots["soles"]
        return _inverse_of_cholesky(w.size2())(ca.mtimes(w.T, w) + self._gamma)

    @cached_property
    def _roots(self) -> dict[str, Any]:
        root = self._tree.inverse_root(self._call("mass_matrix"))
        roots = {"hand": ca.mtimes(root, self._call("hand_row").T), "joints": root[:, -self.robot.n :]}
        roots["soles"] = ca.mtimes(root, self._call("sole_jacobian").T)
        if self.bias:
            roots["bias"] = ca.mtimes(root, self._call("bias_force"))
        return roots

    @cached_property
    def _held(self) -> dict[str, Any]:
        """Z of each root W; without rows where no sole is held."""
        soles = self._roots["soles"].T
        return {
            k: ca.mtimes(self._cholesky, ca.mtimes(soles, w)) for k, w in self._roots.items() if k != "soles"
        }

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

    # ------------------------------------------------------------ drifts
    # Accelerations without torque or contact force.
    @cached_property
    def _sole_push(self) -> Any:
        """R^-1 (J_c H^-1 bias - dJ_c/dt v): minus the soles' acceleration if they were free."""
        push = self._held["bias"] if self.bias else ca.MX.zeros(6 * len(self.soles), 1)
        return push - ca.mtimes(self._cholesky, self._call("sole_drift")) if self.jdot else push

    def _drift(self, rows: str) -> Any:
        drift = ca.mtimes(self._held[rows].T, self._sole_push)
        return drift - ca.mtimes(self._roots[rows].T, self._roots["bias"]) if self.bias else drift

    @cached_property
    def d(self) -> Any:
        """(n) [rad/s2]: drift of the joint velocities."""
        return self._drift("joints")

    @cached_property
    def e(self) -> Any:
        """[m/s2]: drift of the hand's normal speed."""
        drift = self._drift("hand")
        return drift + self._call("hand_drift") if self.jdot else drift

    # ------------------------------------------------------------ wrenches
    @cached_property
    def L_tau(self) -> Any:
        """(c, n): sole wrenches [N, N m] of the ground on the robot per joint torque."""
        return -ca.mtimes(self._cholesky.T, self._held["joints"])

    @cached_property
    def L_f(self) -> Any:
        """(c): sole wrenches lost per normal force at the hand."""
        return -ca.mtimes(self._cholesky.T, self._held["hand"])

    @cached_property
    def L_0(self) -> Any:
        """(c): sole wrenches without torque or contact force [N, N m]."""
        return ca.mtimes(self._cholesky.T, self._sole_push)

    @cached_property
    def sole_positions(self) -> Any:
        """(3, number of held soles) [m]: origins of the sole frames in the world."""
        return self._call("sole_positions")

    @cached_property
    def unmodelled_wrench(self) -> Any:
        """(6) about the world's origin: what carries the weight where `bias` is left out.

        The whole robot's momentum balance has gravity, Coriolis and centrifugal forces in any case.
        """
        return ca.MX.zeros(6) if self.bias else self._call("carrying_wrench")

    def velocity_change(self, torque: Any, force: Any, wrench: Any, time: Any) -> Any:
        """Change of v (nv) from integrals of torque (n), contact force and sole wrenches (c), and from time.

        With double integrals in the arguments' place and time^2 / 2, the change of position.
        """
        weight = time if self.bias else 0.0
        change = self._tree.velocity_change()
        return change(self.q, self.v, self.normal, torque, force, wrench, weight)


class _TreeQuantities:
    """What depends on the robot's tree, each as an SX function of q, v and the normal."""

    def __init__(self, robot: Robot, soles: tuple[str, ...], frame: str) -> None:
        self.robot, self.soles, self.frame = robot, soles, frame
        self.rb = RigidBody(robot.model)
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
        return ca.mtimes(self.normal.T, self.rb.jacobian(self.frame)[:3, :])

    @cached_property
    def sole_jacobian(self) -> Any:
        """J_c (c, nv), LOCAL_WORLD_ALIGNED at the sole frames."""
        return ca.vertcat(ca.SX(0, self.rb.nv), *[self.rb.jacobian(frame) for frame in self.soles])

    @cached_property
    def bias_force(self) -> Any:
        """C v + g (nv)."""
        return self.rb.rnea(self.rb.v, None)

    @property
    def hand_speed(self) -> Any:
        return ca.dot(self.normal, self.rb.frame_velocity(self.frame, self.rb.v)[:3])

    @property
    def hand_drift(self) -> Any:
        return ca.dot(self.normal, self.rb.frame_acceleration(self.frame, self.rb.v, None)[:3])

    @property
    def sole_drift(self) -> Any:
        drifts = [self.rb.frame_acceleration(frame, self.rb.v, None) for frame in self.soles]
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

    def velocity_change(self) -> Any:
        torque, force, weight = ca.SX.sym("torque", self.robot.n), ca.SX.sym("force"), ca.SX.sym("weight")
        wrench = ca.SX.sym("wrench", 6 * len(self.soles))
        push = ca.vertcat(ca.SX.zeros(self.base, 1), torque) - self.hand_row.T * force
        push += ca.mtimes(self.sole_jacobian.T, wrench) - self.bias_force * weight
        change = ca.densify(self.rb.factorize().solve(push))
        inputs = [self.rb.q, self.rb.v, self.normal, torque, force, wrench, weight]
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
