"""Effects that the simplified dynamics computation takes into account, and the joints' friction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from impactopt.errors import MOST, InputError, check_array, raw_array

__all__ = ["Effects", "JointFriction"]


@dataclass(frozen=True, kw_only=True)
class Effects:
    """Effects that a collision model takes into account. The servo's damping (paper, eq. 11) is always there.

    Attributes
    ----------
    stiffness : servo stiffness Kp (phi_ref - phi) (eq. 10); the reference coasts at the joint velocity at
        contact, or follows the setting `reference`.
    feedforward : a feed-forward torque, an input of the functions, inside the saturation.
    saturation : the torque limits (eq. 12).
    friction : joint friction F (eqs. 5, 6), see `JointFriction`.
    bias : Coriolis, centrifugal and gravity terms c + g (eqs. 5, 6), frozen at contact.
    jdot : the Jacobians' rates times velocity (eq. 14), of hand and fixed soles, frozen at contact.
    """

    stiffness: bool = True
    feedforward: bool = True
    saturation: bool = True
    friction: bool = False
    bias: bool = True
    jdot: bool = True

    @classmethod
    def paper(cls, *, friction: bool = False) -> Effects:
        """The paper's set: damping and saturation, and friction where it is known."""
        return cls(
            stiffness=False, feedforward=False, saturation=True, friction=friction, bias=False, jdot=False
        )

    @classmethod
    def none(cls) -> Effects:
        """Nothing but the servo's damping."""
        return cls(stiffness=False, feedforward=False, saturation=False, bias=False, jdot=False)


@dataclass(frozen=True, kw_only=True, eq=False)
class JointFriction:
    """F = viscous phidot + coulomb sign(phidot), with the sign made linear at |phidot| < transition.

    Attributes
    ----------
    viscous : (n,) or one number for all joints, >= 0 [N m s/rad].
    coulomb : (n,) or one number for all joints, >= 0 [N m].
    transition : [rad/s] > 0. Inside this band Coulomb friction damps with coulomb / transition [N m s/rad],
        which the step length has to follow (see `SDC.stable_step`); a joint does not stick, it creeps.
    """

    viscous: ArrayLike = 0.0
    coulomb: ArrayLike = 0.0
    transition: float = 0.01

    def __post_init__(self) -> None:
        for name in ("viscous", "coulomb"):
            value: Any = getattr(self, name)
            shape = (None,) * min(raw_array(f"JointFriction: {name}", value).ndim, 1)
            number = check_array(f"JointFriction: {name}", value, shape, most=MOST)
            if (number < 0).any():
                raise InputError(f"JointFriction: {name} must be >= 0")
        if not check_array("JointFriction: transition [rad/s]", self.transition, (), most=MOST) > 0:
            raise InputError(f"JointFriction: transition [rad/s]: {self.transition:g}; give a number > 0")

    def arrays(self, n: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(viscous, coulomb), each (n,)."""
        out = []
        for name in ("viscous", "coulomb"):
            value = np.asarray(getattr(self, name), dtype=float)
            value = np.full(n, float(value)) if value.ndim == 0 else value
            out.append(check_array(f"JointFriction: {name} (one a joint)", value, (n,)))
        return out[0], out[1]
