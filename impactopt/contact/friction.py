"""Regularized Coulomb friction of the striking point on the target."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.contact.fields import Described, about, check_numbers
from impactopt.errors import InputError


@dataclass(frozen=True, kw_only=True)
class ContactFriction(Described):
    """Coulomb friction between the striking point and the target's surface, which does not move sideways.

    The tangential force is against the slide v_t, and mu f |v_t| / sqrt(|v_t|^2 + v_s^2): below the slip
    speed v_s it is less than Coulomb's, so that it has a slope at rest (Andersson, Soderberg, Bjorklund,
    "Friction models for sliding dry, boundary and mixed lubricated contacts", Tribology International 40,
    2007).
    In the paper's equation (17) F_h = [f_r n; 0] becomes [f_r n + f_t; 0].
    """

    coefficient: float = field(metadata=about("Coulomb friction of the striking point", above=0, most=10))
    slip_speed: float = field(
        default=0.1,
        metadata=about(
            "slide at which friction is 0.7 of the full one; less is stiffer", unit="m/s", above=0
        ),
    )

    def __post_init__(self) -> None:
        check_numbers(self)

    @property
    def parameters(self) -> tuple[float, float]:
        """Parameters (coefficient, slip_speed [m/s])."""
        return self.coefficient, self.slip_speed

    def way(self, normal: NDArray[np.float64], speed: NDArray[np.float64]) -> NDArray[np.float64]:
        """Force on the target (3,) over its normal part, for a velocity (3,) [m/s] of the striking point.

        It is the normal (3,) plus the friction per normal force, in the direction of sliding.
        """
        return np.asarray(pushed_way(normal, speed, *self.parameters))


def check_friction(name: str, given: Any) -> None:
    """InputError unless it is a ContactFriction or None."""
    if given is not None and not isinstance(given, ContactFriction):
        raise InputError(f"{name} must be a ContactFriction, not {given!r}")


def pushed_way(normal: Any, speed: Any, coefficient: Any, slip_speed: Any) -> Any:
    """`ContactFriction.way` for arrays or CasADi expressions."""
    slide = speed - normal * _dot(normal, speed)
    return normal + slide * (coefficient / (_dot(slide, slide) + slip_speed**2) ** 0.5)


def _dot(a: Any, b: Any) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
