"""Reduction of the prices of a motion style to the share of the objective that a problem allows them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from impactopt.planning.multistart import carried, one_after_the_other
from impactopt.planning.on_demand import program_for
from impactopt.problem.motion_style import MotionPrices
from impactopt.solvers.program import SolverResult
from impactopt.transcription.initial_guess import first_iterate
from impactopt.transcription.transcription import Transcription

__all__ = ["with_first_scale", "within_price"]

Array = NDArray[np.float64]
_USUAL, _LEAST = (
    4.0,
    0.02,
)  # [N s] of an initial guess (of `punch`) for which prices are as they are; least factor
_TRIES = 3  # reductions: with lower prices there is more to be priced, so one may not be enough
_TOLERANCE = 0.02  # of the share: a plan that is within it is not solved again
_BELOW = 0.9  # of the allowed share is aimed at


def with_first_scale(t: Transcription) -> Transcription:
    """The program with prices of the motion style that fit what its initial guess is worth.

    The prices are for blows of some newton seconds. A reach as the guess has it gives a part of what the plan
    will; where even `_USUAL` is far more than that, prices would outweigh the objective.
    """
    p = t.problem
    if p.price_scale != 1.0 or p.style_prices == MotionPrices():
        return t
    worth = t.worth(first_iterate(t))
    scale = float(np.clip(worth / _USUAL, _LEAST, 1.0)) if np.isfinite(worth) else 1.0
    return t if scale == 1.0 else program_for(t, replace(p, price_scale=scale), None)


def within_price(
    t: Transcription,
    result: SolverResult,
    solve: Callable[[Transcription, SolverResult | Array], tuple[Transcription, SolverResult]],
    report: Callable[[str], None] | None = None,
) -> tuple[Transcription, SolverResult]:
    """The program and its result, with the prices of the motion style reduced until they take no more of the
    objective than `ImpactProblem.motion_price`; solved again from where it is.
    """
    for _ in range(_TRIES):
        allowed = t.problem.motion_price
        if not result.status.usable or not t.problem.price_scale:
            break
        share, style = t.price_shares(result.x)
        if share <= allowed * (1 + _TOLERANCE):
            break
        left = max(_BELOW * allowed - (share - style), 0.0) if np.isfinite(share) else 0.0
        scale = t.problem.price_scale * left / style if style > 0 else 0.0
        if report is not None:
            report(f"the motion's style takes {100 * share:.1f} % of the objective: its prices are reduced")
        cheaper = program_for(t, replace(t.problem, price_scale=scale), report)
        found, new = solve(cheaper, carried(cheaper, t, result))
        if not new.status.usable:
            break
        t, result = found, one_after_the_other(result, new)
    return t, result
