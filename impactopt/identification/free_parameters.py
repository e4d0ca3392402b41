"""Fitted parameters of a contact law, and initial guesses of their fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from itertools import product

import numpy as np

from impactopt.arrays import Array
from impactopt.contact.fields import abouts
from impactopt.contact.laws import ContactLaw, CustomLaw
from impactopt.errors import InputError
from impactopt.identification.log import MeasuredImpact

MASS = "effective_mass"
_MAX_LOG = 14.0  # bound of z of a logarithmic parameter: a factor of a million from the estimate
_ZERO = 1e-9  # below, z counts as 0: laws refuse parameters that are nearly 0
# Initial guesses: factors of the estimates of stiffness and mass; z of dampers, which is their fraction of
# the peak force
_FACTORS, _DAMPING_FRACTIONS = (0.3, 1.0, 3.0), (0.03, 0.3, 0.8)


@dataclass(frozen=True)
class FreeParameter:
    """A fitted parameter: scale * exp(z) if logarithmic, else scale * z, with a lower bound of z."""

    name: str
    unit: str
    scale: float
    logarithmic: bool
    lower: float = -np.inf

    @property
    def upper(self) -> float:
        """Upper bound of z."""
        return _MAX_LOG if self.logarithmic else np.inf

    def value(self, z: Array) -> Array:
        """Value of the parameter at z."""
        if self.logarithmic:
            with np.errstate(over="ignore"):  # the end of an interval may be infinite
                return np.asarray(self.scale * np.exp(z))
        return np.asarray(self.scale * np.where(np.abs(z) < _ZERO, 0.0, z))


def sample_law(kind: type[ContactLaw]) -> ContactLaw:
    """Law with a stiffness of 1 and no damping; parameters with a default keep it.

    Raises
    ------
    InputError : a parameter that is not fitted has no default.
    """
    fitted, defaulted = _fitted(kind), _defaulted(kind)
    for field, _ in abouts(kind):
        if field.name not in {*fitted, *defaulted}:
            raise InputError(
                f"laws: {kind.__name__} has no default of {field.name}, which may not be 0 and is not "
                "fitted: give the law with parameters"
            )
    return kind(**{name: float(name == "stiffness") for name in fitted})


def free_parameters(law: ContactLaw, impact: MeasuredImpact) -> tuple[FreeParameter, ...]:
    """Fitted parameters of a law, and last the mass.

    Of a law with a ``stiffness``, parameters with a default, such as exponents, and others that may not be 0
    are fixed. Of another law, and of a `CustomLaw`, all are fitted, with their present values as scales.

    Raises
    ------
    InputError : a present value is 0, which gives no scale.
    """
    mass = FreeParameter(MASS, "kg", impact.mass, True, -_MAX_LOG)
    if isinstance(law, CustomLaw) or "stiffness" not in law.parameters:
        return (*_of_custom_law(law), mass)
    units = _fitted(type(law))
    stiffness, out = _stiffness(law, impact, units), []
    for name, unit in units.items():
        if name == "stiffness":
            out.append(FreeParameter(name, unit, stiffness, True, -_MAX_LOG))
        else:
            out.append(FreeParameter(name, unit, _damping(law, impact, name, stiffness, units), False, 0.0))
    return (*out, mass)


def _of_custom_law(law: ContactLaw) -> list[FreeParameter]:
    out = []
    for name, value in law.parameters.items():
        if value == 0:
            raise InputError(f"{type(law).__name__}: {name} is 0; give parameters of about the expected size")
        out.append(FreeParameter(name, "", value, False))
    return out


def _fitted(kind: type[ContactLaw]) -> dict[str, str]:
    """Units of the fitted parameters, by name: the stiffness, and those that are 0 without damping."""
    fixed = _defaulted(kind)
    both = {f.name: about for f, about in abouts(kind) if f.name not in fixed}
    return {name: about.unit for name, about in both.items() if name == "stiffness" or about.allows(0.0)}


def _defaulted(kind: type[ContactLaw]) -> set[str]:
    """Names of the parameters with a default."""
    return {f.name for f in fields(kind) if f.default is not f.default_factory}  # type: ignore[arg-type]


def _compression(impact: MeasuredImpact) -> tuple[float, float]:
    """Largest penetration [m] if it is half a sine, and half of the speed at contact [m/s] as a typical rate.

    A sine with this slope at first reaches 2 / pi = 0.64 times the slope times the time of compression.
    """
    until = float(impact.time[np.argmax(impact.force)] - impact.time[impact.touch - 1])
    deepest = 0.64 * impact.speed * max(until, 0.2 * impact.duration)
    return deepest, 0.5 * impact.speed


def _with(law: ContactLaw, parameters: Mapping[str, float]) -> ContactLaw:
    return type(law)(**{**law.parameters, **parameters})


def _stiffness(law: ContactLaw, impact: MeasuredImpact, units: Mapping[str, str]) -> float:
    """Stiffness that gives the peak force at the largest penetration."""
    deepest, _ = _compression(impact)
    undamped = {name: 0.0 for name in units if name != "stiffness"}
    return impact.peak / float(_with(law, {**undamped, "stiffness": 1.0}).force(deepest, 0.0))


def _damping(
    law: ContactLaw, impact: MeasuredImpact, name: str, stiffness: float, units: Mapping[str, str]
) -> float:
    """Damping that adds a force as large as the peak half-way to the largest penetration."""
    deepest, rate = _compression(impact)
    undamped = dict.fromkeys(units, 0.0) | {"stiffness": stiffness}
    without, one = (_with(law, {**undamped, name: x}).force(deepest / 2, rate) for x in (0.0, 1.0))
    return impact.peak / max(float(one - without), 1e-12)


def initial_guesses(free: tuple[FreeParameter, ...]) -> Array:
    """Initial guesses (N, parameters) of z: all combinations of the values for each parameter."""
    choices = [
        tuple(np.log(_FACTORS)) if each.logarithmic else (_DAMPING_FRACTIONS if each.lower == 0 else (1.0,))
        for each in free
    ]
    return np.array(list(product(*choices)), dtype=np.float64)
