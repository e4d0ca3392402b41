"""Closed legs in numbers: joints that hold the soles, and full motions of independent coordinates.

References and distances between bodies ask for thousands of them, so what all have in common is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.linalg.lapack import dgesv

from impactopt.errors import InputError

__all__ = ["Closing", "Limb", "base_motion"]

Array = NDArray[np.float64]
Index = NDArray[np.intp]
_STEPS = 50  # of Newton, at most
_LONGEST = 0.3  # [rad] of a Newton step
_NEAR = 1e-7  # [m, rad]: Newton's next step leaves its square, so it is the last
_OFF = 1e-6  # [m, rad] and no more, where Newton ends without getting there
_DAMPING = 1e-12 * np.eye(6)  # a stretched leg's Jacobian is singular


class Limb(NamedTuple):
    """A limb that holds a frame in its place in the world, by six joints: their columns (6,) in v."""

    frame: str
    placement: pin.SE3
    columns: Index


class Closing:
    """Inverse kinematics of a stance's legs, and velocities and accelerations from the soles' constraint."""

    def __init__(
        self,
        model: pin.Model,
        data: pin.Data,
        limbs: Sequence[Limb],
        *,
        base: int,
        independent: Index,
        join: Callable[[Array, Array], Array],
    ) -> None:
        """base : number of the base's coordinates, 6 or 0.  independent : columns in v of the other joints
        that are coordinates.  join : q of coordinates (ny,) and legs (nl,).
        """
        self._model, self._data, self._base, self._join = model, data, base, join
        self._frames = [model.getFrameId(limb.frame) for limb in limbs]
        self._limbs = [
            (frame, limb.placement, limb.columns, slice(6 * k, 6 * k + 6))
            for k, (frame, limb) in enumerate(zip(self._frames, limbs, strict=True))
        ]
        none = np.zeros(0, dtype=np.intp)
        self._dependent = np.concatenate([none, *(limb.columns for limb in limbs)])
        self._independent = independent
        of_column = {joint.idx_v: joint for joint in model.joints}
        joints = [of_column[int(column)] for column in self._dependent]
        turning = all(joint.nq == 1 for joint in joints)  # no joint without limits, which has two numbers
        self._places = np.array([joint.idx_q for joint in joints], dtype=np.intp) if turning else None

    def legs(self, y: Array, guess: Array) -> Array:
        """`StanceCoordinates.solve_legs`."""
        legs = np.array(guess, dtype=float)
        if not self._limbs:
            return legs
        model, data, worst = self._model, self._data, np.inf
        q = self._join(y, legs)
        for _ in range(_STEPS):
            if self._places is None:
                q = self._join(y, legs)
            else:
                q[self._places] = legs
            pin.computeJointJacobians(model, data, q)
            worst = 0.0
            for frame, placement, columns, own in self._limbs:
                m = pin.updateFramePlacement(model, data, frame)
                error = pin.log6(m.actInv(placement)).vector
                worst = max(worst, float(np.abs(error).max()))
                jac = pin.getFrameJacobian(model, data, frame, pin.LOCAL)[:, columns]
                step = dgesv(jac.T @ jac + _DAMPING, jac.T @ error)[2]
                legs[own] += np.minimum(np.maximum(step, -_LONGEST), _LONGEST)
            if worst < _NEAR:
                return legs
        if worst < _OFF:
            return legs
        raise InputError(
            f"the legs cannot hold the soles in place here (off by {worst:.2g} m or rad): the base is out of "
            "the legs' reach"
        )

    def follow(self, rows: Iterable[Array], guess: Array) -> Iterator[Array]:
        """Legs (nl,) of one row of coordinates (ny,) after the other, each near the next."""
        before, legs = None, guess
        for y in rows:
            ahead = legs if before is None else 2 * legs - before
            found = self.legs(y, ahead)
            before, legs = None if legs is guess else legs, found
            yield found

    def jacobians(self, q: Array) -> Array:
        """(6 a sole, nv) of the fixed soles, each in its own frame, at a pin configuration."""
        model, data = self._model, self._data
        pin.computeJointJacobians(model, data, q)
        out = np.zeros((6 * len(self._frames), model.nv))
        for k, frame in enumerate(self._frames):
            out[6 * k : 6 * k + 6] = pin.getFrameJacobian(model, data, frame, pin.LOCAL)
        return out

    def motion(self, y: Array, yd: Array, ydd: Array, legs: Array) -> tuple[Array, Array, Array, Array]:
        """`StanceCoordinates.complete_motion`, and the soles' Jacobians at its configuration."""
        model, data, b = self._model, self._data, self._base
        q = self._join(y, legs)
        v, a = np.zeros(model.nv), np.zeros(model.nv)
        if b:
            v[:6], a[:6] = base_motion(y[:6], yd[:6], ydd[:6])
        v[self._independent], a[self._independent] = yd[b:], ydd[b:]
        jac = self.jacobians(q)
        if self._frames:
            block = jac[:, self._dependent]
            v[self._dependent] = np.linalg.solve(block, -jac @ v)
            pin.forwardKinematics(model, data, q, v, a)
            drift = [pin.getFrameAcceleration(model, data, k, pin.LOCAL).vector for k in self._frames]
            a[self._dependent] = np.linalg.solve(block, -np.concatenate(drift))
        return q, v, a, jac


def base_motion(y: Array, yd: Array, ydd: Array) -> tuple[Array, Array]:
    """Free-flyer velocity and acceleration (6,), in its own frame, of (p, roll, pitch, yaw) and rates.

    The numeric twin of the symbolic map.
    """
    rotation = pin.rpy.rpyToMatrix(y[3:6])
    jac = pin.rpy.computeRpyJacobian(y[3:6], pin.LOCAL)
    omega = jac @ yd[3:6]
    alpha = jac @ ydd[3:6] + pin.rpy.computeRpyJacobianTimeDerivative(y[3:6], yd[3:6], pin.LOCAL) @ yd[3:6]
    linear = rotation.T @ yd[:3]
    # body components of a vector that turns with the base: d/dt (R' pdot) = R' pddot - omega x (R' pdot)
    return np.concatenate([linear, omega]), np.concatenate(
        [rotation.T @ ydd[:3] - pin.skew(omega) @ linear, alpha]
    )
