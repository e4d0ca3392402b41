"""Reduction of a motion style's prices until they are a small enough share of the objective."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from impactopt.planning.refinement import Additions, Guess, Outcome
from impactopt.problem.motion_style import MotionPrices
from impactopt.transcription.initial_guess import first_iterate
from impactopt.transcription.transcription import Transcription

# [N s] Objective of the initial guess of the problem `punch`, for which the prices were chosen.
_REFERENCE_OBJECTIVE = 4.0
_MIN_SCALE = 0.02  # of the prices, if the objective of the initial guess is nearly zero
# Reductions at most: lower prices permit a motion that costs more, so one may not be enough.
_MAX_REDUCTIONS = 3
_TOLERANCE = 0.02  # of the allowed share: a plan within it is not solved again
_AIM = 0.9  # of the allowed share, that a reduction aims at


def with_first_scale(t: Transcription) -> Transcription:
    """Program whose prices of the motion style are scaled by the objective of its initial guess.

    The prices are for impacts of some newton seconds. The guess has a part of the objective of the plan. If
    that is far less than `_REFERENCE_OBJECTIVE`, unscaled prices would outweigh the objective.
    """
    p = t.problem
    # A scale that a user or a solution has given stays.
    if p.price_scale != 1.0 or p.style_prices == MotionPrices():
        return t
    objective = t.objective_sum(first_iterate(t))
    scale = float(np.clip(objective / _REFERENCE_OBJECTIVE, _MIN_SCALE, 1.0))
    if not np.isfinite(objective) or scale == 1.0:
        return t
    return t.repriced(scale)


class MotionPrice:
    """Oracle that reduces the prices of the motion style if their share of the objective is larger than
    `ImpactProblem.motion_price`.
    """

    most = _MAX_REDUCTIONS
    of_refused = False

    def missing(self, outcome: Outcome[Transcription]) -> Additions[Transcription] | None:
        """Program with reduced prices, from the solution."""
        t, allowed = outcome.program, outcome.program.problem.motion_price
        if not t.problem.price_scale:
            return None
        share, style = t.price_shares(outcome.result.x)  # of all prices, and of the style's
        if share <= allowed * (1 + _TOLERANCE):
            return None
        # What the other prices leave of the aim; the style's share is proportional to
        # the scale, to first order.
        left = max(_AIM * allowed - (share - style), 0.0) if np.isfinite(share) else 0.0
        scale = t.problem.price_scale * left / style if style > 0 else 0.0

        def guesses() -> Iterator[Guess[Transcription]]:
            yield Guess.mapped(t.repriced(scale), t, outcome.result)

        why = f"the motion's style takes {100 * share:.1f} % of the objective: its prices are reduced"
        return Additions(name="lower prices of motion", why=why, guesses=guesses(), without="")
