"""Soles and strikers: the parts of a robot that touch the world."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from impactopt import _robot_checks as checks
from impactopt.errors import InputError, check_array

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Sole:
    """A flat, convex sole.

    Attributes
    ----------
    name : what problems and messages call it.
    frame : frame of the model at the sole: z up out of the ground, x forward.
    polygon : (k, 2) corners [m] in the x-y plane of the frame, counter-clockwise seen from above, convex.
    parent, placement : for a model without that frame: it is added at `placement` (pin.SE3) in the frame
        `parent`.
    """

    name: str
    frame: str
    polygon: Array
    parent: str | None = None
    placement: Any = None

    def __post_init__(self) -> None:
        polygon = check_array(f"sole {self.name!r}: polygon [m]", self.polygon, (None, 2))
        checks.check_polygon(self.name, polygon)
        object.__setattr__(self, "polygon", read_only(polygon))
        if (self.parent is None) != (self.placement is None):
            raise InputError(f"sole {self.name!r}: give parent and placement together, or neither")

    @classmethod
    def box(
        cls,
        *,
        name: str,
        frame: str,
        length: float,
        width: float,
        center: ArrayLike = (0.0, 0.0),
        **kwargs: Any,
    ) -> Sole:
        """A rectangle, `length` [m] along x and `width` [m] along y, about `center` (2,) [m]."""
        half = np.array([length, width]) / 2
        corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * half + np.asarray(center)
        return cls(name=name, frame=frame, polygon=corners, **kwargs)


@dataclass(frozen=True, kw_only=True, eq=False)
class Striker:
    """The point that hits: `point` (3,) [m] in the model's frame `frame`."""

    name: str
    frame: str
    point: Array

    def __post_init__(self) -> None:
        point = check_array(f"striker {self.name!r}: point [m]", self.point, (3,))
        object.__setattr__(self, "point", read_only(point))

    @property
    def model_frame(self) -> str:
        """Name of the frame that the robot's model has at this point."""
        return f"striker:{self.name}"


def read_only(array: ArrayLike) -> Array:
    """A float64 copy that cannot be written to."""
    copy = np.array(array, dtype=np.float64)
    copy.flags.writeable = False
    return copy
