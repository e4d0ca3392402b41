"""Simple shapes on a robot's frames, and the axes of a target's face."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from impactopt.errors import InputError, check_array

Vector = tuple[float, float, float]


def vector(name: str, value: Sequence[float]) -> Vector:
    """Three finite numbers; InputError names what is wrong."""
    x, y, z = check_array(name, value, (3,)).tolist()
    return x, y, z


@dataclass(frozen=True, kw_only=True)
class Capsule:
    """All points within ``radius`` [m] of the line from ``start`` to ``end`` [m], in ``frame``.

    end None: a sphere about ``start``.

    Raises
    ------
    InputError : a negative radius, points that are not three finite numbers.
    """

    frame: str
    radius: float
    start: Vector = (0.0, 0.0, 0.0)
    end: Vector | None = None

    def __post_init__(self) -> None:
        where = f"shape on {self.frame!r}"
        if not 0 <= self.radius < np.inf:
            raise InputError(f"{where}: radius is {self.radius:g} m; give a number >= 0")
        object.__setattr__(self, "start", vector(f"{where}: start [m]", self.start))
        if self.end is not None:
            object.__setattr__(self, "end", vector(f"{where}: end [m]", self.end))
            if np.allclose(self.start, self.end):
                raise InputError(f"{where}: start and end coincide; leave the end out for a sphere")


def face_axes(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) rows: the normal, the direction across (level, to the left), and up, at right angles to both.

    Of a normal that is vertical, across is the world's y.
    """
    level = np.cross([0.0, 0.0, 1.0], normal)
    size = float(np.linalg.norm(level))
    across = level / size if size > 1e-6 else np.array([0.0, 1.0, 0.0])
    return np.stack([normal, across, np.cross(normal, across)])
