"""Requests of the live page: another hit point, and other parameters of the problem."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import ContactWrenchCone

__all__ = ["Number", "PlanRequest", "numbers_of", "request_of"]

_RANGE = 4.0  # a slider goes from so much below a problem's number to so much above
_STEPS = 200
_MARGIN = 0.06  # [m] the largest margin of the ZMP that can be asked for, at least


@dataclass(frozen=True, kw_only=True)
class Number:
    """One that a slider sets.

    name : as an argument of `Solution.moved`.  label : with its unit.  value, least, most, step : in that
    unit.
    """

    name: str
    label: str
    value: float
    least: float
    most: float
    step: float


@dataclass(frozen=True, kw_only=True)
class PlanRequest:
    """A problem that is asked for. point [m]; numbers : by their names, those that the problem has."""

    point: tuple[float, float, float]
    numbers: tuple[tuple[str, float], ...]

    def changes(self, problem: ImpactProblem) -> dict[str, Any]:
        """Differences from this problem: arguments of `Solution.moved`."""
        own = request_of(problem)
        out: dict[str, Any] = {} if self.point == own.point else {"point": np.array(self.point)}
        return out | dict(sorted(set(self.numbers) - set(own.numbers)))


def request_of(problem: ImpactProblem) -> PlanRequest:
    """Request that corresponds to the problem as it is."""
    x, y, z = (float(v) for v in problem.point)
    return PlanRequest(point=(x, y, z), numbers=tuple((n.name, n.value) for n in numbers_of(problem)))


def numbers_of(problem: ImpactProblem) -> tuple[Number, ...]:
    """Parameters that a plan can be adapted to: mass of the target, stiffness of the contact, margin of the
    ZMP.

    A wall has no mass, and an arm that is bolted down no ZMP.
    """
    found = []
    parts: tuple[tuple[str, str, Any], ...] = (
        ("mass", "target's mass", problem.target),
        ("stiffness", "contact's stiffness", problem.law),
    )
    for name, what, thing in parts:
        for field in dataclasses.fields(thing):
            if field.name == name:
                value = float(getattr(thing, name))
                unit = field.metadata["about"].unit
                found.append(_between(name, f"{what} [{unit}]", value, value / _RANGE, value * _RANGE))
    if problem.coordinates.legs:
        margin = 1e3 * problem.term(ContactWrenchCone).margin
        found.append(
            _between("margin", "margin of the ZMP [m]", margin / 1e3, 0.0, max(2e-3 * margin, _MARGIN))
        )
    return tuple(found)


def _between(name: str, label: str, value: float, least: float, most: float) -> Number:
    return Number(name=name, label=label, value=value, least=least, most=most, step=(most - least) / _STEPS)
