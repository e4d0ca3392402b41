"""Constrained robot dynamics in Pinocchio, for the replay engine and the reference models.

H, J and bias are evaluated at every call. Two formulations give the same numbers: the paper's dense system,
and Pinocchio's recursive algorithms.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin

from impactopt.arrays import Array
from impactopt.contact.friction import ContactFriction
from impactopt.errors import InputError
from impactopt.robots.model import mass_matrix
from impactopt.robots.robot import Robot
from impactopt.simulation.target_dynamics import SlidingPoints

_AXES = pin.LOCAL_WORLD_ALIGNED


class Body(ABC):
    """Dynamics of a robot with some frames fixed, and a contact force at the striking points.

    Parameters
    ----------
    robot : with joints, springs and frames.
    frames : fixed in all six directions.
    compliance : (6,) of each fixed frame, as `Stance.compliance`.
    striker : the striking frame, or several.
    normal : (3,) of the impact.
    friction : of the striking points on the target.

    `update_contact` sets, for contact forces at the h striking points, their `jacobians` (3, nv);
    `normal_jacobian` (h, nv), of their speeds along the normal; and `force_map` (h, nv), which maps a unit of
    normal force at each, friction included, to generalized forces. Without friction the latter two are the
    same. The force map of bristles, and of a target that friction moves, is set by `bend`.
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
        self._unbent = np.zeros((len(strikers), 3)), np.zeros(len(strikers))
        self.strikers = [self.model.getFrameId(name) for name in strikers]
        self.sliding = None if friction is None else SlidingPoints(friction)
        self.jacobians: list[Array] = []
        self.normal_jacobian = self.force_map = np.zeros((len(strikers), self.nv))

    def update(self, q: Array, v: Array) -> None:
        """Sets q (nq,), v (nv,)."""
        self._state = q, v
        if self.robot.springs:
            self._springs = self.robot.spring_torque(q)

    @abstractmethod
    def accelerate(self, torque: Array, force: float | Array | None) -> Array:
        """Acceleration (nv,) in the current state.

        torque : (n,) [N m] at the joints, friction included.
        force : [N] on the striking point against the normal; of several, (h,); None: there is no contact.
            Others need `update_contact`.
        """

    @abstractmethod
    def wrenches(self) -> Array:
        """Wrenches (frames, 6) on the fixed frames at their origins, world axes, of the last acceleration."""

    def fastest_rate(self, damping: Array) -> float:
        """Largest rate [1/s] at which joint damping (n, n) alone slows the joints, in the current state."""
        without = self.accelerate(np.zeros(self.n), None)
        # columns of d a / d tau; times the damping, they give the rates at which velocities decay
        by_torque = [(self.accelerate(unit, None) - without)[-self.n :] for unit in np.eye(self.n)]
        return float(np.abs(np.linalg.eigvals(np.column_stack(by_torque) @ damping)).max())

    def striking_points(self) -> Array:
        """Positions (h, 3) [m] of the striking points, in the current state."""
        return np.array(
            [pin.updateFramePlacement(self.model, self.data, i).translation for i in self.strikers]
        )

    def speeds(self) -> Array:
        """Speeds (h,) [m/s] of the striking points along the normal, in the current state."""
        velocities = [pin.getFrameVelocity(self.model, self.data, i, _AXES).linear for i in self.strikers]
        return np.array(velocities) @ self.normal

    def placements(self) -> list[pin.SE3]:
        """Placements of the fixed frames in the world, in the current state."""
        return [pin.updateFramePlacement(self.model, self.data, i).copy() for i in self.frames]

    def origins(self) -> Array:
        """Origins (frames, 3) [m] of the fixed frames in the world, in the current state."""
        return np.array([placement.translation for placement in self.placements()]).reshape(-1, 3)

    def _jacobian(self, frame: int) -> Array:
        J = pin.getFrameJacobian(self.model, self.data, frame, _AXES)
        return np.reshape(J, (6, self.nv))  # a single column comes without its second dimension

    def update_contact(self) -> None:
        """Sets `jacobians`, `normal_jacobian` and `force_map` in the current state."""
        self.jacobians = [self._jacobian(i)[:3] for i in self.strikers]
        self.normal_jacobian = self.force_map = np.array([self.normal @ J for J in self.jacobians])
        if self.sliding is not None:
            self.sliding.update(self.normal, self.jacobians, self._state[1])
            self.force_map = self.sliding.force_map(*self._unbent)

    def bend(self, deflections: Array, forces: Array, surface: Array) -> None:
        """Sets `force_map` for bristles with deflections (h, 3) [m] under normal forces (h,) [N].

        surface (3,) : velocity [m/s] of the target across the normal, if friction moves it.
        """
        if self.sliding is not None and (self.sliding.bristles or self.sliding.friction.moves_target):
            self.sliding.surface = surface
            self.force_map = self.sliding.force_map(deflections, forces)

    def deflected(self, deflections: Array, forces: Array | None, step: float) -> Array:
        """Deflections (h, 3) [m] of bristles after a step [s] from the current state under normal forces.

        Without contact, forces None, they are zero.
        """
        if self.sliding is None or not self.sliding.bristles:
            return deflections
        if forces is None:
            return self._unbent[0]
        return self.sliding.deflected(deflections, forces, step)

    def after_touchdown(self, v: Array) -> Array:
        """Velocity (nv,) after an inelastic impact that stops the fixed frames, in the current state."""
        # v - H^-1 J' (J H^-1 J')^-1 J v: the impulse at the frames that makes J v zero
        J = np.vstack([self._jacobian(frame) for frame in self.frames])
        response = np.linalg.solve(mass_matrix(self.model, self.data, self._state[0]), J.T)
        return np.asarray(v - response @ np.linalg.solve(J @ response, J @ v))

    def normal_accelerations(self, a: Array) -> Array:
        """Accelerations (h,) [m/s2] of the striking points along the normal, for accelerations a (nv,)."""
        model, data = self.model, self.data
        pin.forwardKinematics(model, data, *self._state, a)
        motions = [pin.getFrameClassicalAcceleration(model, data, i, _AXES) for i in self.strikers]
        return np.array([self.normal @ motion.linear for motion in motions])

    def _generalized_forces(self, torque: Array, force: float | Array | None) -> Array:
        """Generalized forces (nv,) of joint torques (n,), springs and contact forces (h,)."""
        out = np.zeros(self.nv) if force is None else -np.atleast_1d(force) @ self.force_map
        out[-self.n :] += torque - self._springs
        return out


class DenseBody(Body):
    """Steps 1a to 4a of the paper (fig. 2a): one dense system for accelerations and wrenches, solved by LU.

        [H   -J_c'] [a]   [S' tau - j' f - c - g]
        [J_c Gamma] [w] = [-dJ_c/dt v           ]

    H is computed by the composite-rigid-body algorithm. Gamma is the compliance of the fixed frames.
    """

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        size = self.nv + 6 * len(self.frames)
        self._matrix, self._right = np.zeros((size, size), order="F"), np.zeros(size)  # LAPACK's order
        # constant; the other blocks are written at every update
        self._matrix[self.nv :, self.nv :] = np.diag(self.compliance)
        self._zero = np.zeros(self.nv)

    def update(self, q: Array, v: Array) -> None:
        super().update(q, v)
        model, data, nv = self.model, self.data, self.nv
        # with zero acceleration, a frame's classical acceleration is its drift dJ/dt v
        pin.forwardKinematics(model, data, q, v, self._zero)
        pin.computeJointJacobians(model, data)
        for k, i in enumerate(self.frames):
            rows = slice(nv + 6 * k, nv + 6 * k + 6)
            J = self._jacobian(i)
            self._matrix[rows, :nv] = J
            self._matrix[:nv, rows] = -J.T
            self._right[rows] = -pin.getFrameClassicalAcceleration(model, data, i, _AXES).vector
        self._matrix[:nv, :nv] = mass_matrix(model, data, q)
        self._bias = pin.nonLinearEffects(model, data, q, v)  # springs are in `_generalized_forces`

    def accelerate(self, torque: Array, force: float | Array | None) -> Array:
        self._right[: self.nv] = self._generalized_forces(torque, force) - self._bias
        solved = np.array(np.linalg.solve(self._matrix, self._right), dtype=np.float64)
        self._wrenches = solved[self.nv :].reshape(-1, 6)
        return solved[: self.nv]

    def wrenches(self) -> Array:
        return self._wrenches


class PinocchioBody(Body):
    """Pinocchio's constrained dynamics, or its articulated-body algorithm without fixed frames.

    Raises
    ------
    InputError : the stance is compliant, which Pinocchio does not support.
    """

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        if np.any(self.compliance):
            raise InputError(
                "form 'pinocchio' fixes soles exactly only; take form='lagrange' for a virtual base, "
                "or a stance without base_mass and base_inertia"
            )
        model = self.model
        self._constraints = pin.StdVec_RigidConstraintModel()
        self._constraint_data = pin.StdVec_RigidConstraintData()
        for i in self.frames:
            frame = model.frames[i]
            # between the frame and the universe, joint 0
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
            self._constraint_data.append(constraint.createData())
        self._dynamics = model.createData()
        if self.frames:
            pin.initConstraintDynamics(model, self._dynamics, self._constraints, self._constraint_data)
        # accuracy, regularization, and iterations, which remove the error of the regularization
        self._proximal = pin.ProximalSettings(1e-14, 1e-12, 5)

    def update(self, q: Array, v: Array) -> None:
        super().update(q, v)
        pin.forwardKinematics(self.model, self.data, q, v)
        pin.computeJointJacobians(self.model, self.data)

    def accelerate(self, torque: Array, force: float | Array | None) -> Array:
        tau, model = self._generalized_forces(torque, force), self.model
        if not self.frames:
            return np.array(pin.aba(model, self._dynamics, *self._state, tau))
        a = pin.constraintDynamics(
            model, self._dynamics, *self._state, tau, self._constraints, self._constraint_data, self._proximal
        )
        return np.array(a)

    def wrenches(self) -> Array:
        out = np.empty((len(self.frames), 6))
        for k, placement in enumerate(self.placements()):
            local = self._constraint_data[k].contact_force  # in the frame's axes
            out[k, :3] = placement.rotation @ local.linear
            out[k, 3:] = placement.rotation @ local.angular
        return out


def recursive_body(robot: Robot, *args: Any) -> Body:
    """`PinocchioBody`; or the dense system for joints that follow others, which Pinocchio lacks (4.1)."""
    return (DenseBody if robot.couplings else PinocchioBody)(robot, *args)


FORMS: dict[str, Callable[..., Body]] = {"lagrange": DenseBody, "pinocchio": recursive_body}
