"""Velocities and accelerations of all joints, as terms write them: at nodes and in contact alike."""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca

from impactopt.kinematics.coordinates import StanceCoordinates

__all__ = ["JointMotion", "joint_motion"]


class JointMotion(NamedTuple):
    """Velocities and accelerations of all joints.

    z : what it is a function of, as `ContactProgram.drive_points` has slots for it.  velocity (n) [rad/s],
    acceleration (n) [rad/s^2].  through : of `impactopt.problem.block.make_block`.
    """

    z: list[Any]
    velocity: Any
    acceleration: Any
    through: list[tuple[Any, Any]]


def joint_motion(c: StanceCoordinates) -> JointMotion:
    """z = y0; d1, T1, d, T: y = y0 + T1 d1 + T d; r, r', S: ydot = r/S, yddot = r'/(S T); legs (nl)."""
    names = ("y0", "d1", "d", "r", "r1", "y", "u", "udot")
    y0, d1, d, r, r1, y, u, udot = (ca.SX.sym(name, c.ny) for name in names)
    T1, T, S, legs = ca.SX.sym("T1"), ca.SX.sym("T"), ca.SX.sym("S"), ca.SX.sym("legs", c.nl)
    v, a = c.motion(y, legs, u, udot)
    through = [(y, y0 + T1 * d1 + T * d), (u, r / S), (udot, r1 / (S * T))]
    return JointMotion([y0, d1, T1, d, T, r, r1, S, legs], v[c.base :], a[c.base :], through)
