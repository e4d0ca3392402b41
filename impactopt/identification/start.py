"""Free parameters of a law, and the initial guess of their fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from itertools import product

import numpy as np
from numpy.typing import NDArray

from impactopt.contact.fields import abouts
from impactopt.contact.laws import ContactLaw, CustomLaw
from impactopt.errors import InputError
from impactopt.identification.log import Blow

__all__ = ["MASS", "Free", "free_numbers", "sample_law", "starts"]

Array = NDArray[np.float64]
MASS = "effective_mass"
_FARTHEST = 14.0  # a factor of a million from a start
_NOTHING = 1e-9  # of a scale: laws refuse numbers that are nearly 0
# of what a start is tried with: stiffness and mass, as factors; dampers, as a share of the force
_FACTORS, _SHARES = (0.3, 1.0, 3.0), (0.03, 0.3, 0.8)


@dataclass(frozen=True)
class Free:
    """A number that is looked for: scale x exp(z), or scale x z, with z from a lower bound."""

    name: str
    unit: str
    scale: float
    logarithmic: bool
    lower: float = -np.inf

    @property
    def upper(self) -> float:
        """Bound of z."""
        return _FARTHEST if self.logarithmic else np.inf

    def number(self, z: Array) -> Array:
        if self.logarithmic:
            with np.errstate(over="ignore"):  # the end of an interval may be nowhere
                return np.asarray(self.scale * np.exp(z))
        return np.asarray(self.scale * np.where(np.abs(z) < _NOTHING, 0.0, z))

    def place(self, number: float) -> float:
        """z of a number."""
        return float(np.log(number / self.scale)) if self.logarithmic else number / self.scale


def sample_law(kind: type[ContactLaw]) -> ContactLaw:
    """One with a stiffness of 1 and no damping; what has a default has it."""
    unset = [f.name for f, _ in abouts(kind) if f.name not in _defaulted(kind)]
    return kind(**{name: float(name == "stiffness") for name in unset})


def free_numbers(law: ContactLaw, blow: Blow) -> tuple[Free, ...]:
    """Free parameters of a law, and the mass: of a known law those without a default, which an exponent has;
    of a custom law all of them, from the values that they have.

    Raises
    ------
    InputError : a number of one's own law is 0, which says nothing of its size.
    """
    mass = Free(MASS, "kg", blow.mass, True, -_FARTHEST)
    if isinstance(law, CustomLaw) or "stiffness" not in law.parameters:
        return (*_own(law), mass)
    units = {f.name: told.unit for f, told in abouts(type(law)) if f.name not in _defaulted(type(law))}
    stiff, out = _stiffness(law, blow, units), []
    for name, unit in units.items():
        if name == "stiffness":
            out.append(Free(name, unit, stiff, True, -_FARTHEST))
        else:
            out.append(Free(name, unit, _damper(law, blow, name, stiff, units), False, 0.0))
    return (*out, mass)


def _own(law: ContactLaw) -> list[Free]:
    out = []
    for name, value in law.parameters.items():
        if value == 0:
            raise InputError(
                f"{type(law).__name__}: {name} is 0; give numbers of about the size that is expected"
            )
        out.append(Free(name, "", value, False))
    return out


def _defaulted(kind: type[ContactLaw]) -> set[str]:
    return {f.name for f in fields(kind) if f.default is not f.default_factory}  # type: ignore[arg-type]


def _middle(blow: Blow) -> tuple[float, float]:
    """Penetration [m] and rate [m/s] half-way in, of a half sine."""
    until = float(blow.time[np.argmax(blow.force)] - blow.time[blow.touch - 1])
    deepest = 0.64 * blow.speed * max(until, 0.2 * blow.duration)
    return deepest, 0.5 * blow.speed


def _with(law: ContactLaw, numbers: Mapping[str, float]) -> ContactLaw:
    return type(law)(**{**law.parameters, **numbers})


def _stiffness(law: ContactLaw, blow: Blow, units: Mapping[str, str]) -> float:
    """Stiffness that gives the peak force where the hand is deepest."""
    deepest, _ = _middle(blow)
    none = {name: 0.0 for name in units if name != "stiffness"}
    return blow.peak / float(_with(law, {**none, "stiffness": 1.0}).force(deepest, 0.0))


def _damper(law: ContactLaw, blow: Blow, name: str, stiff: float, units: Mapping[str, str]) -> float:
    """Damping that adds the peak force half-way in."""
    deepest, rate = _middle(blow)
    none = dict.fromkeys(units, 0.0) | {"stiffness": stiff}
    without, one = (_with(law, {**none, name: x}).force(deepest / 2, rate) for x in (0.0, 1.0))
    return blow.peak / max(float(one - without), 1e-12)


def starts(free: tuple[Free, ...]) -> Array:
    """(N, numbers) z to choose a start from."""
    choices = [
        tuple(np.log(_FACTORS)) if each.logarithmic else (_SHARES if each.lower == 0 else (1.0,))
        for each in free
    ]
    return np.array(list(product(*choices)), dtype=np.float64)
