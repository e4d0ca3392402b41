"""Directions in space."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["across"]

Array = NDArray[np.float64]


def across(direction: Array) -> Array:
    """(2, 3) rows: two unit vectors at right angles to a direction (3,) and to each other."""
    return np.asarray(np.linalg.svd(direction.reshape(1, 3))[2][1:])
