"""Parametric sensitivity and active constraints of a plan, from its KKT system."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from impactopt.planning.parameter_changes import Parameter, parameter_of
from impactopt.planning.parametric_program import Bent, bent_of
from impactopt.planning.solution import Solution
from impactopt.solvers.predictor import Offset

__all__ = ["Binding", "Sensitivity", "sensitivity_of"]

Array = NDArray[np.float64]
# of a parameter's size: half of a difference. The least durations of a contact's phases come from a point
# mass's blow, whose integration leaves 1e-6 of them: a smaller step would see that
_STEP = 1e-2
_SMALL = 1e-6  # a shadow price that is nothing


@dataclass(frozen=True, kw_only=True)
class Binding:
    """A constraint that a plan is at, and its shadow price: what the objective gains by its bound, per unit.

    row : as messages name it.  price : [objective's unit / unit]; ``unit`` of what the bound is moved by.
    """

    row: str
    price: float
    unit: str

    def __str__(self) -> str:
        return f"{self.row}: {self.price:.3g} per {self.unit}"


@dataclass(frozen=True, kw_only=True, repr=False)
class Sensitivity:
    """First-order sensitivity of a plan to a parameter of its problem.

    parameter, value : its name and value.  impulse : d impulse / d parameter [N s / unit].
    objective : d (weighted sum of the objectives, less the prices on motion) / d parameter.
    binding : constraints and bounds that the plan is at, dearest first.
    """

    parameter: str
    value: float
    impulse: float
    objective: float
    binding: tuple[Binding, ...]

    def __repr__(self) -> str:
        return f"<Sensitivity to {self.parameter}: {self.impulse:.4g} N s per unit>"


def sensitivity_of(solution: Solution, parameter: str) -> Sensitivity:
    """Sensitivity of impulse and objective to a parameter, and the active constraints:
    `Solution.sensitivity`.

    Derivatives of the program by the parameter are central differences at the solution; the solution's own
    follow from the KKT system.
    """
    bent = bent_of(solution)
    number, x = parameter_of(solution.problem, parameter), solution.result.x
    whole, half = (_slope(bent, number, _STEP * number.typical / k) for k in (1, 2))
    offset, impulse, objective = (_extrapolated(*pair) for pair in zip(whole, half, strict=True))
    n, m = len(x), len(solution.result.multipliers)
    # implicit function theorem: the KKT matrix times dz/dp is minus the slope of the KKT residual at fixed z
    change = bent.system.step(Offset(dual=offset[:n], rows=offset[n : n + m], variables=offset[n + m :]))
    # impulse and objective may depend on the number at the same motion too
    program = bent.program
    slope = float(impulse) + _along(program.impulse, x, change.x)
    cost_slope = float(objective) + float(program.program.gradient(x) @ change.x)
    return Sensitivity(
        parameter=parameter,
        value=number.value,
        impulse=slope,
        objective=-cost_slope,
        binding=_binding(bent),
    )


def _slope(bent: Bent, number: Parameter, half: float) -> tuple[Array, Array, Array]:
    """Central differences by a number at the solution: of KKT conditions, impulse and what is minimized."""
    x, sides = bent.solution.result.x, []
    for value in (number.value + half, number.value - half):
        t = bent.program_for(number.at(value))
        off = bent.system.offset(t.program)
        parts = np.concatenate([getattr(off, name) for name in Offset.PARTS])
        sides.append((parts, np.array(t.impulse(x)), np.array(t.program.objective(x))))
    parts, impulse, objective = ((one - other) / (2 * half) for one, other in zip(*sides, strict=True))
    return parts, impulse, objective


def _extrapolated(whole: Array, half: Array) -> Array:
    """Richardson extrapolation of central differences with a step and its half."""
    # both errors are even in the step: four times the half's less the whole's leaves those of fourth order
    return (4 * half - whole) / 3


def _along(function: Callable[[Array], float], x: Array, d: Array) -> float:
    """Derivative of a smooth function along d, by central differences."""
    size = float(np.abs(d).max(initial=0.0))
    if not size:
        return 0.0
    h = 1e-4 / size
    return (function(x + h * d) - function(x - h * d)) / (2 * h)


def _binding(bent: Bent) -> tuple[Binding, ...]:
    """Inequalities and bounds that hold with a price, dearest first."""
    t, system = bent.program, bent.system
    program, out = t.program, list[Binding]()
    unequal = program.g_lower < program.g_upper
    for i in np.flatnonzero(system.rows * unequal):
        price, origin = abs(float(system.y[i])), t.rows.origins[int(i)]
        measure = origin.measure
        unit, factor = ("1", 1.0) if measure is None else (measure.unit, measure.factor)
        if measure is not None and measure.over is not None:
            factor /= max(float(measure.over.evaluate(system.x)[0]), measure.least)
        if price > _SMALL:
            out.append(Binding(row=origin.told(system.x, 0.0)[0], price=price / factor, unit=unit))
    moves = program.x_lower < program.x_upper
    for j in np.flatnonzero(system.bounds * moves):
        price = abs(float(system.z[j]))
        if price > _SMALL:
            group = next(g for g in t.layout.groups.values() if g.offset <= j < g.offset + g.count * g.size)
            scale = float(group.scale[(int(j) - group.offset) % group.size])
            out.append(Binding(row=f"bound of {t.layout.name(int(j))}", price=price / scale, unit="SI unit"))
    return tuple(sorted(out, key=lambda binding: -binding.price))
