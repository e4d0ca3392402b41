"""Coulomb friction of the striking point on the target: regularized in velocity, or with elastic bristles."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from impactopt.arrays import Array
from impactopt.contact.fields import Described, Parameters, about, check_numbers, described
from impactopt.contact.targets.base import Target
from impactopt.errors import InputError

UNBENT: Array = np.zeros(3)  # deflection [m] of bristles before contact
TINY = 1e-9  # [m] added to a deflection, whose length has no slope at zero


@dataclass(frozen=True, kw_only=True)
class ContactFriction(Described):
    """Coulomb friction between the striking point and the target's surface.

    The tangential force f_t on the target is along the slide v_t of the striking point, as that on the point
    is against it: f_t = mu f v_t / sqrt(|v_t|^2 + v_s^2). Below the slip speed v_s it is less than Coulomb's,
    so that it has a slope at rest (Andersson, Soderberg, Bjorklund, "Friction models for sliding dry,
    boundary and mixed lubricated contacts", Tribology International 40, 2007).
    In the paper's equation (17) F_h = [f_r n; 0] becomes [f_r n + f_t; 0].

    With a stiffness the surfaces stick by bristles, and swing back: a spring across the normal whose
    deflection z breaks away at mu f. With s = stiffness z / max(mu f, stiffness |z|),

        f_t = mu f s,    dz/dt = v_t - sqrt(|v_t|^2 + v_s^2) s

    This is Dahl's model (Dahl, "A solid friction model", Aerospace Corp. TOR-158, 1968; Canudas de Wit,
    Olsson, Astrom, Lischinsky, "A new model for control of systems with friction", IEEE TAC 40, 1995), within
    the cone also while the normal force falls, as the sliders of Cundall and Strack (Geotechnique 29, 1979).
    It never gives more energy than it took. The limit of a high stiffness is the friction without bristles.
    Bodies that part release the bristles: each touch begins with unbent ones.

    The surface moves along the normal alone, as that of a target on a rail. With `moves_target` it moves
    across it too, as a point mass m, without rotation: m dv_s/dt is the friction on it, and v_t is relative
    to v_s.
    """

    coefficient: float = field(metadata=about("Coulomb friction of the striking point", above=0, most=10))
    slip_speed: float = described(
        0.1, "slide at which friction is 0.7 of the full one; less is stiffer", unit="m/s", above=0
    )
    stiffness: float = described(
        0.0, "stiffness of the bristles across the normal; 0: none", unit="N/m", least=0
    )
    moves_target: bool = described(
        False, "true: a free mass is also pushed across the normal, as a point mass"
    )

    def __post_init__(self) -> None:
        check_numbers(self)

    @property
    def parameters(self) -> tuple[float, ...]:
        """Parameters (coefficient, slip_speed [m/s]), with bristles also their stiffness [N/m]."""
        return (self.coefficient, self.slip_speed, *((self.stiffness,) if self.bristles else ()))

    @property
    def bristles(self) -> bool:
        return self.stiffness > 0

    def way(self, normal: Array, speed: Array, deflection: Array = UNBENT, force: float = 0.0) -> Array:
        """Force on the target (3,) over its normal part, for a velocity (3,) [m/s] of the striking point.

        It is the normal (3,) plus the friction per normal force. With bristles that depends on their
        deflection (3,) [m] and the normal force [N].
        """
        if not self.bristles:
            return np.asarray(pushed_way(normal, speed, *self.parameters))
        return normal + self.coefficient * lean(deflection, force, self.coefficient, self.stiffness)

    def deflected(self, normal: Array, speed: Array, deflection: Array, force: float, step: float) -> Array:
        """Deflection (3,) [m] of the bristles after a semi-implicit Euler step [s]; zero without force.

        normal, speed, deflection, force : as of `way`.
        """
        if not (self.bristles and force > 0):
            return UNBENT
        slide = speed - normal * (normal @ speed)
        # lean is linear in the deflection but for its denominator, which stays that of the step's start
        per_deflection = self.stiffness / _breakaway(deflection, force, self.coefficient, self.stiffness)
        speed_of_return = float(np.sqrt(slide @ slide + self.slip_speed**2)) * per_deflection
        return np.asarray((deflection + step * slide) / (1 + step * speed_of_return))


def check_friction(name: str, given: Any, target: Target) -> None:
    """InputError unless it is a ContactFriction that the target can have, or None."""
    if given is None:
        return
    if not isinstance(given, ContactFriction):
        raise InputError(f"{name} must be a ContactFriction, not {given!r}")
    if given.moves_target and target.tangential_mass() is None:
        raise InputError(
            f"{name}: moves_target is for a FreeMass; a {type(target).__name__} is held across the normal: "
            "leave it out"
        )


def moves_target(friction: ContactFriction | None) -> bool:
    """True if there is friction that moves the target across the normal."""
    return friction is not None and friction.moves_target


def tangential_mobility(friction: ContactFriction | None, target: Target, parameters: Parameters) -> Any:
    """Inverse mass [1/kg] of the target across the normal; 0 if friction does not move it."""
    return 1 / target.tangential_mass(parameters) if moves_target(friction) else 0.0


def tangential_outcome(velocity: Array) -> dict[str, float]:
    """Outcome of a target that friction moves, from its velocity (3,) [m/s] across the normal."""
    return {"tangential_speed_m_s": float(np.linalg.norm(velocity))}


def pushed_way(normal: Any, speed: Any, coefficient: Any, slip_speed: Any) -> Any:
    """`ContactFriction.way` for arrays or CasADi expressions."""
    slide = speed - normal * _dot(normal, speed)
    return normal + slide * (coefficient / (_dot(slide, slide) + slip_speed**2) ** 0.5)


def lean(deflection: Any, force: Any, coefficient: Any, stiffness: Any) -> Any:
    """Friction (3) of bristles over its limit, for arrays or CasADi expressions."""
    return deflection * (stiffness / _breakaway(deflection, force, coefficient, stiffness))


def deflection_rate(normal: Any, speed: Any, leaning: Any, slip_speed: Any) -> Any:
    """Rate (3) [m/s] of the bristles' deflection, from a velocity (3) [m/s] and their `lean` (3)."""
    slide = speed - normal * _dot(normal, speed)
    return slide - leaning * (_dot(slide, slide) + slip_speed**2) ** 0.5


def _breakaway(deflection: Any, force: Any, coefficient: Any, stiffness: Any) -> Any:
    """Larger of the friction's limit and the bristles' elastic force [N]."""
    limit, elastic = coefficient * force, stiffness * (_dot(deflection, deflection) + TINY**2) ** 0.5
    return (limit + elastic + abs(limit - elastic)) / 2


def _dot(a: Any, b: Any) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
