"""The first of several events along Taylor's polynomials."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca

from impactopt.collision.jets import Jet, value_at

__all__ = ["BEYOND", "first_event", "level_jet", "newton", "refine"]

# a step that ends on an event goes on by this fraction of its full length, so that the next one starts in
# the new phase
BEYOND = 1e-5


def level_jet(jet: Jet, level: Any, length: Any) -> list[Any]:
    """A jet that is zero where |value| is at `level`, on the side where the value is, or else is going."""
    side = ca.sign(ca.if_else(ca.fabs(jet[0]) > level, jet[0], value_at(jet, length)))
    return [side * jet[0] - level, *[side * x for x in jet[1:]]]


def first_event(jets: Sequence[Jet], length: Any) -> tuple[Any, Any]:
    """(time [s] of the first sign change of any jet within `length`, 1 at this jet and 0 at the others).

    Sign changes are those between the polynomials' ends; one that is undone within the step goes unseen,
    and has next to no effect. Where there is none, the time is `length` and all are 0.
    """
    first, which = ca.SX(length), ca.SX(-1.0)
    for i, jet in enumerate(jets):
        end = value_at(jet, length)
        crosses = jet[0] * end < 0
        # regula falsi, which ends up inside, and two of Newton's iterations
        time = length * jet[0] / ca.if_else(crosses, jet[0] - end, 1.0)
        time = ca.if_else(crosses, time, 0.0)
        for _ in range(2):
            time = ca.fmin(ca.fmax(newton(jet, time), 0.0), length)
        earlier = ca.logic_and(crosses, time < first)
        first = ca.if_else(earlier, time, first)
        which = ca.if_else(earlier, float(i), which)
    return first, ca.vertcat(*[which == i for i in range(len(jets))])


def refine(jets: Sequence[Jet], length: Any, first: Any, at: Any) -> Any:
    """Time [s] to just beyond the event that `first_event` has found, at most `length`.

    It is the result of Newton's last iteration, and so has the event time's true derivative even where
    `first` and `at` are taken as constants.
    """
    size = max(len(jet) for jet in jets)
    padded = [[*jet, *[ca.SX(0.0)] * (size - len(jet))] for jet in jets]
    chosen = [ca.dot(at, ca.vertcat(*[jet[k] for jet in padded])) for k in range(size)]
    time = ca.fmax(newton(chosen, first), 0.0) + BEYOND * length
    return ca.if_else(ca.sum1(at) > 0, ca.fmin(time, length), length)


def newton(jet: Jet, t: Any) -> Any:
    """A root's next guess, by Newton's iteration."""
    value, slope = value_at(jet, t), value_at(jet[1:], t)
    return t - value / ca.if_else(slope == 0, 1.0, slope)
