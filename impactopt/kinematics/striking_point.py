"""The point of the robot that strikes, symbolic."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import casadi as ca

if TYPE_CHECKING:
    from impactopt.kinematics.coordinates import StanceCoordinates

__all__ = ["striker_kinematics"]


def striker_kinematics(c: StanceCoordinates, striker: str) -> Any:
    """CasADi function (q, v, a) -> point [m], velocity [m/s], acceleration [m/s^2] of the striking point.

    World axes.
    """
    rb, frame = c.rb, f"striker:{striker}"
    _, point = rb.frame(frame)
    outs = [point, rb.frame_velocity(frame, rb.v)[:3], rb.frame_acceleration(frame, rb.v, rb.a)[:3]]
    return ca.Function("striker", [rb.q, rb.v, rb.a], outs)
