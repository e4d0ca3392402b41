"""Reduction of the prices of a motion style to the share of the objective that a problem allows them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from impactopt.planning.refinement import Additions, Guess, Outcome, program_for
from impactopt.problem.motion_style import MotionPrices
from impactopt.transcription.initial_guess import first_iterate
from impactopt.transcription.transcription import Transcription

__all__ = ["MotionPrice", "unpriced", "with_first_scale"]

_USUAL = 4.0  # [N s] of an initial guess, that of `punch`: prices are chosen for it
_LEAST = 0.02  # factor on prices, where a guess is worth next to nothing
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
    return t if scale == 1.0 else program_for(t, replace(p, price_scale=scale))


def unpriced(t: Transcription) -> Transcription:
    """The same program without prices of the motion style."""
    return program_for(t, replace(t.problem, price_scale=0.0))


class MotionPrice:
    """Oracle for prices of the motion style: they take no more of the objective than
    `ImpactProblem.motion_price`, or are reduced.
    """

    most = _TRIES

    def missing(self, outcome: Outcome[Transcription]) -> Additions[Transcription] | None:
        """The program with reduced prices, from where the solution is."""
        t, allowed = outcome.program, outcome.program.problem.motion_price
        if not t.problem.price_scale:
            return None
        share, style = t.price_shares(outcome.result.x)
        if share <= allowed * (1 + _TOLERANCE):
            return None
        left = max(_BELOW * allowed - (share - style), 0.0) if np.isfinite(share) else 0.0
        scale = t.problem.price_scale * left / style if style > 0 else 0.0

        def guesses() -> Iterator[Guess[Transcription]]:
            yield Guess.mapped(program_for(t, replace(t.problem, price_scale=scale)), t, outcome.result)

        why = f"the motion's style takes {100 * share:.1f} % of the objective: its prices are reduced"
        return Additions(name="lower prices of motion", why=why, guesses=guesses())
