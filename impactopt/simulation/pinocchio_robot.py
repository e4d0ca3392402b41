"""The constrained robot in Pinocchio, with H, J and bias anew at every call: what replays and references
move.

Two ways to the same numbers: the paper's dense system, and Pinocchio's own algorithms along the tree.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.contact.friction import ContactFriction
from impactopt.errors import InputError
from impactopt.robots.mass_matrix import mass_matrix
from impactopt.robots.robot import Robot

__all__ = ["FORMS", "Body", "DenseBody", "PinocchioBody"]

Array = NDArray[np.float64]
_AXES = pin.LOCAL_WORLD_ALIGNED


class Body(ABC):
    """A robot held by some of its frames, struck at another.

    Parameters
    ----------
    robot : what moves.
    frames : held in all six directions.
    compliance : (6,) of each constrained frame, as `Stance.compliance`.
    striker : the striking frame, or several.
    normal : (3,) of the blow.
    friction : of the striking points on the target.
    """

    def __init__(
        self,
        robot: Robot,
        frames: tuple[str, ...],
        compliance: Array,
        striker: str | tuple[str, ...],
        normal: Array,
        friction: ContactFriction | None = None,
    ) -> None:
        self.robot, self.model, self.n, self.nv = robot, robot.model, robot.n, robot.nv
        self._springs = np.zeros(self.n)
        self.data: Any = robot.model.createData()
        self.frames = [self.model.getFrameId(frame) for frame in frames]
        self.compliance, self.normal = np.tile(compliance, len(frames)), normal
        strikers = (striker,) if isinstance(striker, str) else striker
        self.hands = [self.model.getFrameId(name) for name in strikers]
        self.friction = friction
        self.rows = self.pushes = np.zeros((len(strikers), self.nv))

    @abstractmethod
    def look(self, q: Array, v: Array) -> float:
        """Speed of the first striking point along the normal [m/s] at q (nq), v (nv), to which it goes."""

    @abstractmethod
    def accelerate(self, torque: Array, force: float | Array) -> Array:
        """Acceleration (nv) where it has been last.

        torque : (n) [N m] at the joints, friction included.
        force : [N] of the contact, pushing the hand against the normal; of several, (hands,).
        """

    @abstractmethod
    def wrenches(self) -> Array:
        """Wrenches on the constrained frames (frames, 6), at their origins in world axes, of the last
        acceleration.
        """

    def fastest_rate(self, damping: Array) -> float:
        """[1/s] Largest rate at which joint damping (n, n) alone slows the joints, where it has been last."""
        none = np.zeros(len(self.hands))
        still = self.accelerate(np.zeros(self.n), none)
        gains = [(self.accelerate(unit, none) - still)[-self.n :] for unit in np.eye(self.n)]
        return float(np.abs(np.linalg.eigvals(np.column_stack(gains) @ damping)).max())

    def hand_places(self) -> Array:
        """(hands, 3) [m] of the striking points, where they have been last."""
        return np.array(
            [pin.updateFramePlacement(self.model, self.data, hand).translation for hand in self.hands]
        )

    def placements(self) -> list[pin.SE3]:
        """Placements of the constrained frames in the world, at the last evaluation."""
        return [pin.updateFramePlacement(self.model, self.data, i).copy() for i in self.frames]

    def places(self) -> Array:
        """(constrained frames, 3) [m]: their origins in the world, where it has been last."""
        return np.array([placement.translation for placement in self.placements()]).reshape(-1, 3)

    def _jacobian(self, frame: int) -> Array:
        J = pin.getFrameJacobian(self.model, self.data, frame, _AXES)
        return np.reshape(J, (6, self.nv))  # a single column comes without its second dimension

    def _meet(self, q: Array, v: Array) -> None:
        """Sets rows and pushes (hands, nv), once all Jacobians are known: the striking points' speeds along
        the normal, and what a unit of the contact's normal force does, friction included; and the springs.
        """
        if self.robot.springs:
            self._springs = self.robot.spring_torque(q)
        jacobians = [self._jacobian(hand)[:3] for hand in self.hands]
        self.rows = self.pushes = np.array([self.normal @ J for J in jacobians])
        if self.friction is not None:
            self.pushes = np.array([self.friction.way(self.normal, J @ v) @ J for J in jacobians])

    def _push(self, torque: Array, force: float | Array) -> Array:
        push = -np.atleast_1d(force) @ self.pushes
        push[-self.n :] += torque - self._springs
        return push


class DenseBody(Body):
    """Steps 1a to 4a of the paper (fig. 2a): H by the composite-rigid-body algorithm, all Jacobians, and one
    dense system for accelerations and wrenches, solved by LU:

        [H  -J_c'] [a]   [S' tau - j' f - c - g]
        [J_c Gamma] [w] = [-dJ_c/dt v          ]
    """

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        size = self.nv + 6 * len(self.frames)
        self._matrix, self._right = np.zeros((size, size)), np.zeros(size)
        self._matrix[self.nv :, self.nv :] = np.diag(self.compliance)
        self._none = np.zeros(self.nv)

    def look(self, q: Array, v: Array) -> float:
        model, data, nv = self.model, self.data, self.nv
        pin.forwardKinematics(model, data, q, v, self._none)
        pin.computeJointJacobians(model, data)
        for k, i in enumerate(self.frames):
            rows = slice(nv + 6 * k, nv + 6 * k + 6)
            J = self._jacobian(i)
            self._matrix[rows, :nv] = J
            self._matrix[:nv, rows] = -J.T
            self._right[rows] = -pin.getFrameClassicalAcceleration(model, data, i, _AXES).vector
        self._meet(q, v)
        self._matrix[:nv, :nv] = mass_matrix(model, data, q)
        self._bias = pin.nonLinearEffects(model, data, q, v)
        return float(self.rows[0] @ v)

    def accelerate(self, torque: Array, force: float | Array) -> Array:
        self._right[: self.nv] = self._push(torque, force) - self._bias
        found = np.array(np.linalg.solve(self._matrix, self._right), dtype=np.float64)
        self._wrenches = found[self.nv :].reshape(-1, 6)
        return found[: self.nv]

    def wrenches(self) -> Array:
        return self._wrenches


class PinocchioBody(Body):
    """Pinocchio's own way along the tree: its constrained dynamics, or the articulated-body algorithm where
    nothing is held. Neither has joints that follow others (Pinocchio 4.1): such robots take the dense system.

    Raises
    ------
    InputError : a compliant stance, for which Pinocchio has no place.
    """

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        if np.any(self.compliance):
            raise InputError(
                "form 'pinocchio': holds soles exactly only; take form='lagrange' for a virtual base, "
                "or a stance without base_mass and base_inertia"
            )
        model, self._dense = self.model, DenseBody(*args) if self.robot.couplings else None
        self._constraints = pin.StdVec_RigidConstraintModel()
        self._found = pin.StdVec_RigidConstraintData()
        for i in self.frames:
            frame = model.frames[i]
            constraint = pin.RigidConstraintModel(
                pin.ContactType.CONTACT_6D,
                model,
                frame.parentJoint,
                frame.placement,
                0,
                pin.SE3.Identity(),
                pin.LOCAL,
            )
            self._constraints.append(constraint)
            self._found.append(constraint.createData())
        self._dynamics = model.createData()
        if self.frames and self._dense is None:
            pin.initConstraintDynamics(model, self._dynamics, self._constraints, self._found)
        self._proximal = pin.ProximalSettings(1e-14, 1e-12, 5)

    def look(self, q: Array, v: Array) -> float:
        self._at = q, v
        pin.forwardKinematics(self.model, self.data, q, v)
        pin.computeJointJacobians(self.model, self.data)
        self._meet(q, v)
        return float(self.rows[0] @ v)

    def accelerate(self, torque: Array, force: float | Array) -> Array:
        if self._dense is not None:
            self._dense.look(*self._at)
            return self._dense.accelerate(torque, force)
        push, model = self._push(torque, force), self.model
        if not self.frames:
            return np.array(pin.aba(model, self._dynamics, *self._at, push))
        a = pin.constraintDynamics(
            model, self._dynamics, *self._at, push, self._constraints, self._found, self._proximal
        )
        return np.array(a)

    def stopped(self, v: Array) -> Array:
        """Velocity (nv) after constrained frames that still move have stopped at once, where it has been
        last.
        """
        jac = np.vstack([self._jacobian(frame) for frame in self.frames])
        inertia = mass_matrix(self.model, self._dynamics, self._at[0])
        yields = np.linalg.solve(inertia, jac.T)
        return np.asarray(v - yields @ np.linalg.solve(jac @ yields, jac @ v))

    def wrenches(self) -> Array:
        if self._dense is not None:
            return self._dense.wrenches()
        out = np.empty((len(self.frames), 6))
        for k, placement in enumerate(self.placements()):
            local = self._found[k].contact_force
            out[k, :3] = placement.rotation @ local.linear
            out[k, 3:] = placement.rotation @ local.angular
        return out

    def drifts(self, a: Array) -> Array:
        """(hands,) [m/s2] of the striking points along the normal at accelerations (nv), where they have been
        last.
        """
        model, data = self.model, self.data
        pin.forwardKinematics(model, data, *self._at, a)
        found = [pin.getFrameClassicalAcceleration(model, data, hand, _AXES) for hand in self.hands]
        return np.array([self.normal @ one.linear for one in found])


FORMS: dict[str, type[Body]] = {"lagrange": DenseBody, "pinocchio": PinocchioBody}
