"""Shapes of the world that a problem gives, and the axes of a target's face."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from impactopt.contact.fields import Described, about
from impactopt.errors import FARTHEST, InputError, check_array, check_name, did_you_mean, shortened

Vector = tuple[float, float, float]


def vector(name: str, value: Sequence[float]) -> Vector:
    """Three finite numbers; InputError names what is wrong."""
    x, y, z = check_array(name, value, (3,), most=FARTHEST).tolist()
    return x, y, z


TARGET_SHAPES = ("box", "ball", "none")


@dataclass(frozen=True, kw_only=True)
class TargetBody(Described):
    """The target's shape; the hit point is the middle of its face.

    All of the robot but the striking point keeps off it. Without a size it is assumed, and results say so: a
    box of 18 cm for a free mass, a wall of 1.5 x 1.5 m, a board of 30 x 24 x 2 cm on two supports, or a nail
    of 7 cm in a block of 20 x 20 x 6 cm. `size` is that of the box, the board or the nail's block. With the
    shape "none" there is nothing to keep off.
    """

    shape: str | None = field(
        default=None,
        metadata=about("shape; left out: the one that belongs to the target's kind", choices=TARGET_SHAPES),
    )
    size: tuple[float, ...] | None = field(
        default=None,
        metadata=about("size: of a box [across, up, deep], of a ball [diameter]", unit="m", above=0),
    )

    def __post_init__(self) -> None:
        if self.shape is not None and not (isinstance(self.shape, str) and self.shape in TARGET_SHAPES):
            near = did_you_mean(str(self.shape), TARGET_SHAPES)
            raise InputError(
                f"TargetBody.shape is {shortened(repr(self.shape))}{near}; "
                f"give one of {', '.join(TARGET_SHAPES)}"
            )
        if self.size is None:
            return
        wanted = 1 if self.shape == "ball" else 3
        size = check_array("TargetBody.size [m]", self.size, (wanted,), most=FARTHEST)
        if self.shape == "none" or not np.all(size > 0):
            raise InputError(
                f"TargetBody.size is {size.tolist()} m; give lengths > 0, and none of shape 'none'"
            )
        object.__setattr__(self, "size", tuple(size.tolist()))


@dataclass(frozen=True, kw_only=True)
class Obstacle(Described):
    """A box or a capsule that nothing of the robot may touch.

    It is fixed in the world: a box of a size about a position, or a capsule of a radius from start to end.
    Give one of the two.
    """

    name: str = field(metadata=about("what reports call it"))
    size: Vector | None = field(default=None, metadata=about("sides of a box", unit="m"))
    position: Vector = field(
        default=(0.0, 0.0, 0.0), metadata=about("middle of the box, in the world frame", unit="m")
    )
    rpy: Vector = field(default=(0.0, 0.0, 0.0), metadata=about("roll, pitch and yaw of the box", unit="rad"))
    start: Vector | None = field(
        default=None, metadata=about("start of a capsule's axis, in the world frame", unit="m")
    )
    end: Vector | None = field(
        default=None, metadata=about("end of its axis; left out: the capsule is a sphere", unit="m")
    )
    radius: float | None = field(default=None, metadata=about("radius of the capsule", unit="m", above=0))

    def __post_init__(self) -> None:
        where = f"obstacle {self.name!r}"
        check_name("an obstacle", self.name)
        if (self.size is None) == (self.start is None):
            raise InputError(f"{where}: give either size, of a box, or start and radius, of a capsule")
        for key in ("size", "position", "rpy", "start", "end"):
            value = getattr(self, key)
            if value is not None:
                object.__setattr__(self, key, vector(f"{where}: {key}", value))
        if self.size is not None:
            if min(self.size) <= 0 or self.radius is not None or self.end is not None:
                raise InputError(f"{where}: a box has a size of three lengths > 0 m, no end and no radius")
            return
        if self.radius is None or not 0 < self.radius <= FARTHEST or any(self.rpy) or any(self.position):
            raise InputError(
                f"{where}: a capsule has a radius > 0 m, a start and an end, and no position or rpy"
            )
        if self.end is None:
            object.__setattr__(self, "end", self.start)

    @property
    def centre(self) -> NDArray[np.float64]:
        """Its middle (3,) [m]."""
        if self.size is not None or self.start is None or self.end is None:
            return np.array(self.position)
        return (np.array(self.start) + np.array(self.end)) / 2

    @property
    def half(self) -> NDArray[np.float64]:
        """Half sides (3,) [m] of the box; of a capsule's axis, along z."""
        if self.size is not None:
            return np.array(self.size) / 2
        return np.array([0.0, 0.0, self._length / 2])

    @property
    def _length(self) -> float:
        return float(np.linalg.norm(np.subtract(self.end or (), self.start or ())))

    @property
    def rotation(self) -> NDArray[np.float64]:
        """(3, 3) axes in the world, as columns."""
        if self.size is None:
            if self._length < 1e-9:
                return np.eye(3)
            along = np.subtract(self.end or (), self.start or ()) / self._length
            return face_axes(along)[[1, 2, 0]].T
        (cr, cp, cy), (sr, sp, sy) = np.cos(self.rpy), np.sin(self.rpy)
        about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
        return np.asarray(about_z @ about_y @ about_x)


@dataclass(frozen=True, kw_only=True)
class Ground(Described):
    """The floor below a robot on a fixed base, which nothing of the robot may touch.

    Left out: there is none. A robot on soles stands on the ground z = 0.
    """

    height: float = field(
        default=0.0, metadata=about("height of the floor, in the frame of the robot's root link", unit="m")
    )

    def __post_init__(self) -> None:
        height = check_array("Ground.height [m]", self.height, (), most=FARTHEST)
        object.__setattr__(self, "height", float(height))


def face_axes(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) rows: the normal, the direction across (level, to the left), and up, at right angles to both.

    Of a normal that is vertical, across is the world's y.
    """
    level = np.cross([0.0, 0.0, 1.0], normal)
    size = float(np.linalg.norm(level))
    across = level / size if size > 1e-6 else np.array([0.0, 1.0, 0.0])
    return np.stack([normal, across, np.cross(normal, across)])
