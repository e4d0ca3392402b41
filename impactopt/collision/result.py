"""The result of one collision, in numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .outputs import HISTORIES, SCALARS

__all__ = ["Collision"]

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Collision:
    """What happened from contact to separation. Histories have k entries, at the steps, first at contact,
    last at separation.

    Attributes
    ----------
    impulse : [N s] delivered to the target.
    peak_force : [N] largest contact force at the steps.
    duration : [s] from contact to separation.
    energy : [J] given to the target.
    separated : whether the contact ended within the horizon.
    velocity : (nv) Pinocchio's v after the collision.
    displacement : (nv) integral of v over the collision; the configuration after it is `pin.integrate(q,
        displacement)`.
    time : (k) [s] since contact.
    force : (k) [N] on the target along the normal.
    penetration : (k) [m] of the contact law.
    hand_speed, target_speed : (k) [m/s] along the normal.
    joint_velocity : (k, n) [rad/s].
    torque, demand : (k, n) [N m] of the servo, and what it would be without saturation.
    sole_wrench : (k, soles, 6) [N, N m] of the ground on each held sole, world axes, at the sole's frame;
        in the stance's order of soles. None on a fixed base.
    ground_wrench : (k, 6) [N, N m] of the ground on the robot, world axes, about the world's origin; None
        on a fixed base.
    zmp : (k, 2) [m] x and y of the zero-moment point on the ground z = 0; None on a fixed base.
    """

    impulse: float
    peak_force: float
    duration: float
    energy: float
    separated: bool
    velocity: Array
    displacement: Array
    time: Array
    force: Array
    penetration: Array
    hand_speed: Array
    target_speed: Array
    joint_velocity: Array
    torque: Array
    demand: Array
    sole_wrench: Array | None
    ground_wrench: Array | None
    zmp: Array | None

    @classmethod
    def from_outputs(cls, found: dict[str, Array]) -> Collision:
        """From the arrays of a collision function, without what repeats itself after separation."""
        time = found["time"].ravel()
        k = int(np.searchsorted(time, time[-1])) + 1
        out: dict[str, Any] = {}
        for name, value in found.items():
            if name in HISTORIES:
                out[name] = value.ravel()[:k] if value.shape[1] == 1 else np.ascontiguousarray(value[:, :k].T)
            else:
                out[name] = float(value.item()) if name in SCALARS else value.ravel()
        out["separated"] = bool(round(out["separated"]))
        for name in HISTORIES:
            out.setdefault(name, None)
        if out["sole_wrench"] is not None:
            out["sole_wrench"] = out["sole_wrench"].reshape(k, -1, 6)
        return cls(**out)
