"""Motion on fixed soles in stages, for derivatives with fewer operations.

Rates and accelerations of a leg depend only on its angles and the base's motion, and the base's motion on its
own coordinates. One expression of all coordinates would hide this structure from differentiation. Stages keep
it; `impactopt.transcription.structured.derivatives` applies the chain rule to them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca

from impactopt.arrays import Index
from impactopt.kinematics.coordinates import StanceCoordinates, solve_in_order


@dataclass(frozen=True, eq=False)
class Stage:
    """Intermediate quantity of a function: symbols (k,), and the expression (k,) that they replace.

    The expression is one of variables, parameters and symbols of earlier stages.

    zero (k,) : implicit definition, from which derivatives are taken instead: an expression of the same and
        of the symbols, linear in these, that is zero where symbols and expression are equal.
    blocks : diagonal blocks (m, m) of its Jacobian by the symbols, which is block diagonal, each with its
        elimination order.
    """

    symbols: Any
    expression: Any
    zero: Any = None
    blocks: tuple[tuple[Any, tuple[Index, Index]], ...] = ()


def velocity_in_stages(c: StanceCoordinates, y: Any, legs: Any, rates: Any) -> tuple[Any, list[Stage]]:
    """`StanceCoordinates.velocity` of one ydot (ny,) in stages: v (nv,), and the stages."""
    if not c.base:
        return c.velocity(y, legs, rates), []
    v, _, stages = _in_stages(c, y, legs, rates, None)
    return v, stages


def motion_in_stages(
    c: StanceCoordinates, y: Any, legs: Any, rates: Any, second: Any
) -> tuple[Any, Any, list[Stage]]:
    """`StanceCoordinates.motion` in stages: v and a (nv,), and the stages."""
    return (*c.motion(y, legs, rates, second), []) if not c.base else _in_stages(c, y, legs, rates, second)


def _in_stages(
    c: StanceCoordinates, y: Any, legs: Any, rates: Any, second: Any
) -> tuple[Any, Any, list[Stage]]:
    """v, a (None if ``second`` is None) and stages: base motion, leg rates, leg accelerations."""
    q, still = c.configuration(y, legs), ca.SX.zeros(c.nl)
    nothing = ca.SX.zeros(c.rb.nv)
    qd = c.embed(rates[:6], rates[6:], still)
    qdd = nothing if second is None else c.embed(second[:6], second[6:], still)
    base = c.base_motion(q, qd, qdd)[: 1 if second is None else 2]
    of_base = [ca.SX.sym(name, 6) for name in ("base_v", "base_a")[: len(base)]]
    stages = [Stage(ca.vertcat(*of_base), ca.vertcat(*base))]
    v, stage = _of_legs(c, "leg_v", lambda x: (c.embed(of_base[0], rates[6:], x), nothing), y, legs, 3)
    stages += stage
    if second is None:
        return v[0], None, stages
    va, stage = _of_legs(c, "leg_a", lambda x: (v[0], c.embed(of_base[1], second[6:], x)), y, legs, 4)
    return *va, stages + stage


def _of_legs(
    c: StanceCoordinates, name: str, motion: Any, y: Any, legs: Any, term: int
) -> tuple[tuple[Any, Any], list[Stage]]:
    """v and a with symbols for the legs' rates or accelerations, and the stage that defines these.

    motion : function that gives v and a from legs' rates or accelerations (nl,).
    term : index in `StanceCoordinates.sole_terms` of the quantity that has to be zero: twist or acceleration.
    """
    symbols, count = ca.SX.sym(name, c.nl), range(len(c.legs))
    found = motion(symbols)
    if not c.legs:
        return found, []
    # Implicit definition: the sole's twist or acceleration vanishes.
    zero = [c.sole_terms(k, y, legs, *found)[term] for k in count]
    # With zero in place of the symbols it is the right-hand side, as it is affine in them.
    rest = [c.sole_terms(k, y, legs, *motion(ca.SX.zeros(c.nl))) for k in count]
    blocks = tuple((terms[2], leg.order) for terms, leg in zip(rest, c.legs, strict=True))
    solved = [
        solve_in_order(jac, -terms[term], order)[0] for terms, (jac, order) in zip(rest, blocks, strict=True)
    ]
    return found, [Stage(symbols, ca.vertcat(*solved), ca.vertcat(*zero), blocks)]
