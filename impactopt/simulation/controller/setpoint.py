"""Reference of a controller at one instant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Aim"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Aim:
    """q (nq,), v, a (nv,), torque (n,); com, its rate and acceleration (3,) each, momentum: angular about it,
    and its rate; hands (h, 3, 3): place, rate and acceleration of each striking point.
    """

    q: Array
    v: Array
    a: Array
    torque: Array
    com: Array
    momentum: Array
    hands: Array
