"""Warning about a plan limited by the longest permitted contact, which is no property of the impact."""

from __future__ import annotations

from impactopt.solvers.program import SolverResult
from impactopt.transcription.collision import Collision
from impactopt.transcription.transcription import Transcription

__all__ = ["window_caution"]

_AT = 1e-3  # of the bound: so near is at it
_COSTLY = 0.1  # of the objective, for a window twice as long and to first order: what is said


def window_caution(t: Transcription, result: SolverResult) -> str:
    """Warning about a contact that ends because it may not last longer; "" if none does.

    The price is the multiplier of the bound times the bound.
    """
    longest = t.problem.contact_duration[1]
    objective = abs(
        float(sum(o.weight * t.achieved(result.x).get(o.name, 0.0) for o in t.problem.objectives))
    )
    price, named = 0.0, list[str]()
    for hit in t.hit.collisions:
        if not isinstance(hit, Collision):
            continue
        for phase, group in zip(t.problem.target.phases, hit.T, strict=True):
            j = group.offset
            if result.x[j] * group.scale[0] >= (1 - _AT) * longest:
                # multiplier: slope of the objective by the bound; a window twice as long moves it by itself
                price += max(float(result.bound_multipliers[j]), 0.0) * float(result.x[j])
                named.append(phase)
    if not named or objective <= 0 or price < _COSTLY * objective:
        return ""
    share = 100 * min(price / objective, 9.99)
    return (
        f"The contact's {' and '.join(dict.fromkeys(named))} takes all the time that [collision] duration_s "
        f"leaves it, {1e3 * longest:.3g} ms, and that bound is costly: twice as long gains {share:.0f} % of "
        "the objective, to first order. The contact is softer than that: give it longer."
    )
