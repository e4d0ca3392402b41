"""Striking point of a constrained robot: position, effective mass, mobility; torques and wrenches at rest.

Numeric, for one configuration, by Pinocchio and least squares. `impactopt.collision.effective_mass` and
`impactopt.collide.contact_states` have compiled graphs for many configurations and for gradients; tests
compare them with this module.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from impactopt.arrays import Array
from impactopt.errors import MOST, InputError, check_direction, check_number
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.kinematics.stance import Stance, stance_of
from impactopt.robots.model import mass_matrix
from impactopt.robots.robot import Robot


def across(direction: Array) -> Array:
    """(2, 3) Two unit vectors at right angles to a direction (3,) and to each other."""
    # The right singular vectors of a row: the row itself, then two that span its null space.
    return np.asarray(np.linalg.svd(direction.reshape(1, 3))[2][1:])


def striking_point(robot: Robot, striker: str, q: Array) -> Array:
    """Position (3,) [m] of a striker's striking point in the world, at a configuration q (nq,); (k, 3) at
    configurations (k, nq).
    """
    model, data = robot.model, robot.model.createData()
    frame = model.getFrameId(robot.striker(striker).model_frame)
    points = []
    for posture in np.atleast_2d(q):
        pin.framesForwardKinematics(model, data, posture)
        points.append(data.oMf[frame].translation.copy())
    return np.reshape(points, (*q.shape[:-1], 3))


def static_wrenches(c: StanceCoordinates, y: Array, legs: Array) -> Array:
    """Sole wrenches (6 a sole) of least norm that carry the robot at rest; zero on hands and about hinges."""
    if not c.legs:
        return np.zeros(0)
    q = c.join(y, legs)
    tau = c.robot.generalized_gravity(c.model.createData(), q)
    # Only undriven coordinates constrain wrenches: the joints' torques supply the rest.
    jac = c.sole_jacobians(q)[0][: 6 * len(c.soles), c.undriven]
    # moments weigh more, which keeps the centre of pressure inside the sole
    lever = np.array([1, 1, 1, 10, 10, 10] * len(c.soles))
    # Least norm of lever x wrench.
    found = np.linalg.lstsq(jac.T / lever, tau[c.undriven], rcond=None)[0] / lever
    return np.concatenate([found, np.zeros(6 * len(c.hands))])


# Singular values below this fraction of the largest count as zero: with few joints, constraints may be
# dependent.
_DEPENDENT = 1e-12


@dataclass(frozen=True, eq=False)
class ConstrainedDynamics:
    """Dynamics of a model with fixed frames, at one configuration, in world axes.

    inertia (nv, nv); held (c, nv) : Jacobian of the fixed frames; hand (3, nv) : linear Jacobian of the
    striking point.
    """

    inertia: Array
    held: Array
    hand: Array

    @classmethod
    def at(cls, model: pin.Model, q: Array, frames: Sequence[str], striker: str) -> ConstrainedDynamics:
        """Dynamics at a configuration q (nq,).  frames : fixed ones.  striker : striking point's frame."""
        inertia = mass_matrix(model, model.createData(), q)
        jacobians = _jacobians(model, q, [*frames, striker])
        # Of the striking point the linear part only: its rotation is free.
        return cls(inertia, jacobians[:-6], jacobians[-6:-3])

    def inverse_mass(self) -> Array:
        """Inverse operational-space inertia J P J' (3, 3) [1/kg] of the striking point.

        P = H^-1 - H^-1 J_c' (J_c H^-1 J_c')^-1 J_c H^-1 is the inverse inertia of the robot with its fixed
        frames.

        1 / (n' J P J' n) is the effective mass along n (the paper's virtual mass, its section III).
        """
        return np.asarray(self.hand @ self.by_impulses(self.hand))

    def by_impulses(self, jacobian: Array, compliance: Array | float = 0.0) -> Array:
        """P J' (nv, k): velocities after unit impulses along the rows of a Jacobian J (k, nv).

        compliance (c,) : added to the diagonal of J_c H^-1 J_c', as of `Stance.compliance`.
        """
        responses = np.linalg.solve(self.inertia, np.vstack([self.held, jacobian]).T)  # H^-1 [J_c' J']
        held, free = np.split(responses, [len(self.held)], axis=1)
        # Paper, eqs. 1-4: compliances of the virtual base; 0 is the exact constraint.
        inner = self.held @ held + compliance * np.eye(len(self.held))
        return np.asarray(free - held @ np.linalg.lstsq(inner, self.held @ free, rcond=_DEPENDENT)[0])


def striking_velocity(
    robot: Robot,
    q: ArrayLike,
    striker: str,
    normal: ArrayLike,
    speed: float,
    *,
    stance: Stance | None = None,
) -> Array:
    """Velocity (nv,) of least kinetic energy with the striking point at `speed` [m/s] along the normal.

    Frames fixed by the stance (None: all soles, or the fixed base) are at rest. The striking point does not
    move at right angles to the normal (3,), a unit vector; its rotation is free. Least energy, unlike a least
    norm, does not depend on the joints' units, and makes heavy links move little. A robot that floats freely
    then has momentum, which it cannot give itself.

    Raises
    ------
    InputError : wrong shapes or NaN; no unit vector; an unknown striker; a stance the robot cannot take; a
        posture in which the striking point cannot move like that.
    """
    frames = stance_of(robot, stance).constraint_frames(robot)
    q, n = robot.check_configuration(q), check_direction("normal", normal)
    speed = check_number("speed [m/s]", speed, most=MOST)
    body = ConstrainedDynamics.at(robot.model, q, frames, robot.striker(striker).model_frame)
    J = np.vstack([body.held, body.hand])
    required = np.concatenate([np.zeros(len(body.held)), speed * n])
    # minimum of v'Hv/2 subject to J v = required: v = H^-1 J' (J H^-1 J')^-1 required
    responses = np.linalg.solve(body.inertia, J.T)
    v = responses @ np.linalg.lstsq(J @ responses, required, rcond=_DEPENDENT)[0]
    off = float(np.abs(J @ v - required).max())
    # `not <=` refuses nan, too.
    if not off <= 1e-6 * max(1.0, abs(speed)):
        raise InputError(
            f"q: here {striker!r} cannot move along {np.round(n, 3).tolist()} with the stance's frames at "
            f"rest (off by {off:.2g} m/s): choose another posture"
        )
    return np.array(v)


def holding_torque(
    robot: Robot, q: ArrayLike, v: ArrayLike | None = None, *, stance: Stance | None = None
) -> Array:
    """Torque (n,) [N m] at which the driven joints do not accelerate, on a stance; hinges of soles have none.

    The least-norm solution (tau, lambda) of S' tau + J_c' lambda = c + g at q (nq,), v (nv,; None: at rest).
    If nothing is fixed, the base accelerates: S' tau = H a + c + g, with a of the base alone.

    Raises
    ------
    InputError : wrong shapes or NaN; a stance the robot cannot take.
    """
    frames = stance_of(robot, stance).constraint_frames(robot)
    q = robot.check_configuration(q)
    v = np.zeros(robot.nv) if v is None else robot.check_velocity(v)
    bias = robot.nonlinear_effects(robot.model.createData(), q, v)
    if not np.all(np.isfinite(bias)):
        raise InputError("q, v: the forces of this motion are no finite numbers; give smaller ones")
    driven = np.append(np.zeros(robot.nv - robot.n, dtype=bool), ~robot.hinges)
    # Columns S' and J_c', or -H: driven joints' torques, and wrenches of fixed frames or accelerations.
    if frames:
        others = _jacobians(robot.model, q, frames).T
    else:
        others = -mass_matrix(robot.model, robot.model.createData(), q)[:, ~driven]
    columns = np.hstack([np.eye(robot.nv)[:, driven], others])
    torque = np.zeros(robot.n)
    torque[~robot.hinges] = np.linalg.lstsq(columns, bias, rcond=None)[0][: driven.sum()]
    return torque


def _jacobians(model: pin.Model, q: Array, frames: Sequence[str]) -> Array:
    """Stacked Jacobians (6 a frame, nv) of frames, in world axes."""
    data = model.createData()
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    out = np.zeros((len(frames), 6, model.nv))
    for k, frame in enumerate(frames):
        J = pin.getFrameJacobian(model, data, model.getFrameId(frame), pin.LOCAL_WORLD_ALIGNED)
        out[k] = np.reshape(J, (6, model.nv))  # a single column comes without its second dimension
    return out.reshape(-1, model.nv)
