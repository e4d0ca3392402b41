"""Time derivatives of a smooth function along a motion that is known by its own time derivatives.

A jet is the list [g, dg/dt, d2g/dt2, ...] at one instant.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import factorial
from typing import Any

import casadi as ca

__all__ = ["Jet", "derivative", "value_at"]

Jet = Sequence[Any]


def derivative(function: Callable[..., Any], jets: Sequence[Jet], order: int) -> Any:
    """The `order`-th time derivative of function(*arguments), from the jets of its scalar arguments up to
    that order.

    `function` may also depend on other symbols, the same for all times.
    """
    t = ca.SX.sym("t")
    symbols = [[ca.SX.sym("g") for _ in range(order + 1)] for _ in jets]
    expression = ca.SX(function(*[value_at(jet, t) for jet in symbols]))
    for _ in range(order):
        expression = ca.jacobian(expression, t)
    # put in by a call, which folds what t = 0 makes constant, and leaves the jets' own expressions alone
    inputs = [t, *[g for jet in symbols for g in jet]]
    others = [x for x in ca.symvar(expression) if not any(ca.is_equal(x, g) for g in inputs)]
    at_start = ca.Function("derivative", [*inputs, *others], [expression])
    known = [ca.SX(jet[k]) for jet in jets for k in range(order + 1)]
    return at_start.call([ca.SX(0), *known, *others])[0]


def value_at(jet: Jet, t: Any) -> Any:
    """Taylor's polynomial of a jet, t [s] later."""
    value = jet[-1] * (1.0 / factorial(len(jet) - 1))
    for k in range(len(jet) - 2, -1, -1):
        value = value * t + jet[k] * (1.0 / factorial(k))
    return value
