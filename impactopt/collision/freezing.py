"""Estimates the error of freezing by the same collision once more, frozen more often.

With N freezes the error of the impulse falls as 1/N^2 where the robot moves little, and by leaps where a push
ends or not by a hair. So no constant is a bound of it, but the difference from a collision that is frozen
more often tells both. Twice the difference, and a thousandth, is what is said; `python -m benchmarks freezes`
measures against full dynamics how often the error is more.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["FREEZE_ERROR", "caution", "freeze_error", "more_often"]

Array = NDArray[np.float64]

# name of the output of a batch
FREEZE_ERROR = "freeze_error"
# the least that is said, relative: below it differences are as often luck
_LEAST = 1e-3
_SAFETY = 2.0


def more_often(freezes: int) -> int:
    """Freezes on the way of the collision that one is compared with: 4, 8, or twice as many.

    Fewer are too like it: of 204 drawn collisions, those frozen at contact only were off by more than was
    said in four beside two freezes, and in none beside four; those frozen twice in two beside four, and in
    none beside eight.
    """
    return max(4, 2 * freezes, min(4 * freezes, 8))


def freeze_error(impulse: Array, better: Array, ends: NDArray[Any]) -> Array:
    """Estimated relative error (N) of each impulse that freezing causes.

    impulse, better : (N) [N s], and of the collisions frozen more often.  ends : (N) whether those separate;
    where they do not, the error is infinite.
    """
    off = np.abs(impulse - better)
    # nothing delivered by both is no difference
    apart = np.divide(off, np.abs(better), out=np.where(off > 0, np.inf, 0.0), where=better != 0)
    return np.where(np.isfinite(better) & ends, _SAFETY * apart + _LEAST, np.inf)


def caution(error: float, accuracy: float, freezes: int) -> str:
    """A sentence where the error is above the accuracy, both relative; else nothing."""
    if not error > accuracy:
        return ""
    off = f"{100 * error:.2g} %" if error < 1 else "any amount"
    often = f"at contact and {freezes} times on the way" if freezes else "at contact only"
    return (
        f"the impulse may be off by {off}, and {100 * accuracy:g} % is asked for, as H, J and the bias are "
        f"frozen {often}: give freezes={more_often(freezes)} (--freezes) or more, or take the full dynamics"
    )
