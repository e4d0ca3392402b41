"""Striking-point mobility and coasting torques of a constrained robot, compiled for many states.

`impactopt.kinematics.operational_space` has the same for one state, by Pinocchio and least squares; they
are tested against each other. That takes some milliseconds a state, which for millions would be hours.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from impactopt.codegen.cache import cached, model_hash
from impactopt.collision.frozen import _inverse_of_cholesky
from impactopt.kinematics.stance import Stance
from impactopt.robots.rigid_body import RigidBody
from impactopt.robots.robot import Robot

__all__ = ["striking_functions"]

_BASE = 100.0  # [m/s], [rad/s]


def striking_functions(robot: Robot, *, striker: str, stance: Stance) -> dict[str, Any]:
    """Compiled ca.Functions of a robot on a stance whose soles are held exactly.

    * ``least_energy`` (q (nq), -) -> (B (nv, 3), G (3, 3), J (3, nv)): J is the striking point's linear
      Jacobian, and with P the inverse inertia of the robot as held B = P J' and G = J P J'. A velocity
      v = B x has the least kinetic energy of all that move the striking point at G x.
    * ``least_rates``: likewise with the sum of squares of the joints' speeds over their limits in place of
      the kinetic energy.
    * ``holding`` ((q, v), -) -> tau (n) [N m]: the least-norm torque and wrenches that keep all velocities as
      they are.

    The second input of each is empty, and outputs lie one after the other by columns.
    """
    frame, held = robot.striker(striker).model_frame, stance.constraint_frames(robot)

    def build() -> list[Any]:
        tree = _StrikingGraphs(robot, held, frame)
        return [tree.least_energy(), tree.least_rates(), tree.holding()]

    recipe = (model_hash(robot.model), frame, held, robot.velocity_limit)
    return cached("striking", recipe, build)


class _StrikingGraphs:
    """Quantities that depend on the robot's tree in SX, dense algebra in MX, as in `FrozenDynamics`."""

    def __init__(self, robot: Robot, held: tuple[str, ...], frame: str) -> None:
        self.rb, self.n, self.base = RigidBody(robot.model), robot.n, robot.nv - robot.n
        self.nq, self.nv, self.held, self.frame = robot.nq, robot.nv, held, frame
        # the base's speeds are those that the legs leave it: they cost next to nothing
        self.ease = np.concatenate([np.full(self.base, _BASE), robot.velocity_limit])

    def least_energy(self) -> Any:
        H = self.rb.mass_matrix()
        entries = ca.SX.sym("H", H.sparsity())
        factor = self.rb.factorize(entries)
        root = ca.mtimes(ca.diag(1 / ca.sqrt(factor.diagonal)), factor.half_solve(ca.SX.eye(self.nv)))
        inverse_root = ca.Function("inverse_root", [entries], [root])
        inertia = ca.Function("inertia", [self.rb.q], [H])
        return self._mobility("least_energy", lambda q: inverse_root(inertia(q)))

    def least_rates(self) -> Any:
        return self._mobility("least_rates", lambda q: ca.MX(ca.diag(ca.DM(self.ease))))

    def _mobility(self, name: str, root: Callable[[Any], Any]) -> Any:
        """Function of the mobility W of a configuration, with W' W the inverse of the least quantity."""
        q, none = ca.MX.sym("q", self.nq), ca.MX.sym("none", 0)
        rows = ca.Function("rows", [self.rb.q], [ca.densify(self.rb.jacobian(self.frame)[:3, :]), self._held])
        J, J_c = rows(q)
        W = root(q)
        hand = ca.mtimes(W, J.T)
        if self.held:
            soles = ca.mtimes(W, J_c.T)
            R = _inverse_of_cholesky(soles.size2())(ca.mtimes(soles.T, soles))
            hand = hand - ca.mtimes(soles, ca.mtimes(R.T, ca.mtimes(R, ca.mtimes(soles.T, hand))))
        return ca.Function(name, [q, none], [_column(ca.mtimes(W.T, hand), ca.mtimes(hand.T, hand), J)])

    def holding(self) -> Any:
        state, none = ca.MX.sym("state", self.nq + self.nv), ca.MX.sym("none", 0)
        rb = self.rb
        bias = ca.Function("bias", [rb.q, rb.v], [rb.rnea(rb.v, None), self._held])
        b, J_c = bias(state[: self.nq], state[self.nq :])
        of_base, of_joints = b[: self.base, :], b[self.base :, :]
        if not self.held:
            return ca.Function("holding", [state, none], [_column(of_joints)])
        J_b, J_j = J_c[:, : self.base], J_c[:, self.base :]
        # least |tau|^2 + |w|^2 with J_b' w = b_base and tau = b_joints - J_j' w
        R = _inverse_of_cholesky(J_c.size1())(ca.DM.eye(J_c.size1()) + ca.mtimes(J_j, J_j.T))
        y, U = ca.mtimes(R, ca.mtimes(J_j, of_joints)), ca.mtimes(R, J_b)
        if self.base:
            S = _inverse_of_cholesky(self.base)(ca.mtimes(U.T, U))
            y = y + ca.mtimes(U, ca.mtimes(S.T, ca.mtimes(S, of_base - ca.mtimes(U.T, y))))
        torque = of_joints - ca.mtimes(J_j.T, ca.mtimes(R.T, y))
        return ca.Function("holding", [state, none], [_column(torque)])

    @property
    def _held(self) -> Any:
        """J_c (c, nv)."""
        frames = [self.rb.jacobian(frame) for frame in self.held]
        return ca.densify(ca.vertcat(ca.SX(0, self.nv), *frames))


def _column(*parts: Any) -> Any:
    return ca.densify(ca.vertcat(*[ca.vec(part) for part in parts]))
