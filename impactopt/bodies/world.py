"""Bodies of the world: shapes that users give, the ground, the target with its supports, obstacles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from impactopt.arrays import Array
from impactopt.bodies.solids import Solid, capsule
from impactopt.bodies.solids import box as cuboid
from impactopt.contact.fields import Described, about
from impactopt.contact.targets import Board, Nail, RigidWall, Target
from impactopt.errors import FARTHEST, InputError, check_array, check_choice, check_name

Vector = tuple[float, float, float]


def vector(name: str, value: Sequence[float]) -> Vector:
    """Checked vector of three finite numbers."""
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
        metadata=about("left out: the one of the target's kind", choices=TARGET_SHAPES),
    )
    size: tuple[float, ...] | None = field(
        default=None,
        metadata=about("of a box [across, up, deep], of a ball [diameter]", unit="m", above=0),
    )

    def __post_init__(self) -> None:
        if self.shape is not None:
            check_choice("TargetBody.shape", self.shape, TARGET_SHAPES)
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
    position: Vector = field(default=(0.0, 0.0, 0.0), metadata=about("middle of the box", unit="m"))
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
    def centre(self) -> Array:
        """Centre (3,) [m]."""
        if self.size is not None or self.start is None or self.end is None:
            return np.array(self.position)
        return (np.array(self.start) + np.array(self.end)) / 2

    @property
    def half(self) -> Array:
        """Half sides (3,) [m] of the box; of a capsule's axis, along z."""
        if self.size is not None:
            return np.array(self.size) / 2
        return np.array([0.0, 0.0, self._length / 2])

    @property
    def _length(self) -> float:
        return float(np.linalg.norm(np.subtract(self.end or (), self.start or ())))

    @property
    def rotation(self) -> Array:
        """Rotation (3, 3); columns are the axes in the world."""
        if self.size is None:
            if self._length < 1e-9:
                return np.eye(3)
            along = np.subtract(self.end or (), self.start or ()) / self._length
            # Columns across, up, along: z is the capsule's axis, and a cyclic order stays right-handed.
            return face_axes(along)[[1, 2, 0]].T
        return np.asarray(pin.rpy.rpyToMatrix(*self.rpy))


@dataclass(frozen=True, kw_only=True)
class Ground(Described):
    """The floor below a robot on a fixed base, which nothing of the robot may touch.

    Left out: there is none. A robot on soles stands on the ground z = 0.
    """

    height: float = field(default=0.0, metadata=about("height in the root link's frame", unit="m"))

    def __post_init__(self) -> None:
        height = check_array("Ground.height [m]", self.height, (), most=FARTHEST)
        object.__setattr__(self, "height", float(height))


def face_axes(normal: Array) -> Array:
    """Orthonormal axes of a target's face as rows (3, 3): normal, across (level, to the left), up.

    For a vertical normal, across is the world's y.
    """
    level = np.cross([0.0, 0.0, 1.0], normal)
    size = float(np.linalg.norm(level))
    across = level / size if size > 1e-6 else np.array([0.0, 1.0, 0.0])
    return np.stack([normal, across, np.cross(normal, across)])


# [m] The core of a target begins so far behind its face. The striker must not touch it before contact, so
# that it cannot come through the target from behind.
BEHIND = 0.08
CORE_DEPTH = 0.5  # [m]
FLOOR, THICK = 10.0, 0.5  # [m] half sides of the ground
# [m] sizes of targets: (across, up, deep)
BOX, WALL, BOARD, BLOCK = (0.18, 0.18, 0.18), (1.5, 1.5, 0.1), (0.30, 0.24, 0.02), (0.2, 0.2, 0.06)
SUPPORT = (0.04, 0.24, 0.12)  # [m] of the supports at both ends of a board
NAIL_LENGTH, NAIL_RADIUS = 0.07, 0.004  # [m]
# description and default size by the target's class; others are a box
USUAL: dict[type[Target], tuple[str, tuple[float, ...]]] = {
    RigidWall: ("wall", WALL),
    Board: ("board on two supports", BOARD),
    Nail: ("nail in a block", BLOCK),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class WorldBody:
    """Box of half sides ``half`` (3,) [m], inflated by ``radius`` [m], at ``place``, with axes ``rotation``.

    It is a sphere if half is zero, and a capsule along z if only its last number is not zero.

    of_target : is present only if the target is.  moves : moves with the target along the normal.
    strikable : the striking link may touch it.  before : is present until contact only.
    core : core of the target, see `BEHIND`.  ground : is the floor.
    """

    name: str
    half: Array
    place: Array
    rotation: Array
    radius: float = 0.0
    of_target: bool = False
    moves: bool = False
    strikable: bool = False
    before: bool = False
    core: bool = False
    ground: bool = False

    @cached_property
    def shape(self) -> Any:
        """Its shape in coal."""
        if not self.radius:
            return coal.Box(*(2 * self.half))
        return coal.Capsule(self.radius, 2 * self.half[2]) if self.half[2] > 0 else coal.Sphere(self.radius)

    @property
    def solid(self) -> Solid:
        """Its surface as triangles in the world, for pictures."""
        own = capsule(self.radius, 2 * self.half[2]) if self.radius else cuboid(2 * self.half)
        return own.moved(self.rotation, self.place)


def ground_body(height: float) -> WorldBody:
    """Half-space below a height [m], as a large box."""
    return WorldBody(
        name="ground",
        half=np.array([FLOOR, FLOOR, THICK]),
        place=np.array([0.0, 0.0, height - THICK]),
        rotation=np.eye(3),
        ground=True,
    )


def _usual(body: TargetBody, target: Target) -> tuple[str, tuple[float, ...]]:
    """Description and sides [m] of a target for which the problem gives no size."""
    if body.shape == "ball":
        return "ball", BOX[:1]
    for kind, usual in USUAL.items():
        if isinstance(target, kind):
            return usual
    return "box", BOX


def body_message(body: TargetBody, target: Target) -> str:
    """Description of the target's body with its size, and whether that is assumed."""
    if body.shape == "none":
        return "none: nothing keeps off it"
    word, size = _usual(body, target)
    sides = " x ".join(f"{100 * side:.3g}" for side in body.size or size)
    return f"{'assumed: ' if body.size is None else ''}{word}, {sides} cm"


def target_bodies(body: TargetBody, target: Target, point: Array, normal: Array) -> list[WorldBody]:
    """Bodies of a target, whose face has its middle at the point; they extend from there along the normal."""
    normal, left, up = face_axes(normal)
    axes = np.column_stack([left, up, normal])  # of boxes: across, up, deep

    def solid(name: str, half: Array, deep: float, across: float = 0.0, **flags: Any) -> WorldBody:
        """Body with its middle so deep behind the face, and so far across [m]."""
        place = point + axes @ np.array([across, 0.0, deep])
        return WorldBody(name=name, half=half, place=place, rotation=axes, of_target=True, **flags)

    def box(name: str, size: Any, start: float = 0.0, across: float = 0.0, **flags: Any) -> WorldBody:
        """Box of these sides [m] that begins so deep behind the face."""
        half = np.asarray(size, dtype=float) / 2
        return solid(name, half, start + half[2], across, **flags)

    if body.shape == "none":
        return []
    moves = not isinstance(target, RigidWall)
    size = body.size or _usual(body, target)[1]
    if body.shape == "ball":
        radius = size[0] / 2
        return [solid("target", np.zeros(3), radius, radius=radius, moves=moves, strikable=True)]
    if isinstance(target, Nail):
        out = max(NAIL_LENGTH - target.depth, 0.0)
        block = box("target's block", size, out, strikable=True)
        # Too short for a capsule, whose ends are half spheres.
        if out < 2 * NAIL_RADIUS:
            return [block]
        # A capsule's ends extend beyond its axis by the radius.
        half = np.array([0.0, 0.0, out / 2 - NAIL_RADIUS])
        shank = solid("target", half, out / 2, radius=NAIL_RADIUS, moves=True, strikable=True)
        return [shank, block]
    if isinstance(target, Board):
        across = (size[0] - SUPPORT[0]) / 2
        post = (SUPPORT[0], size[1], SUPPORT[2])
        # the supports stay when the board is broken
        supports = [box("target's support", post, size[2], side * across) for side in (-1.0, 1.0)]
        main = box("target", size, moves=True, strikable=True, before=True)
        return [main, *supports, _core(box, size)]
    return [box("target", size, moves=moves, strikable=True), _core(box, size)]


def _core(box: Any, size: tuple[float, ...]) -> WorldBody:
    """Core of the target behind its face, see `BEHIND`."""
    body: WorldBody = box(
        "target from behind", (size[0], size[1], CORE_DEPTH), BEHIND, before=True, core=True
    )
    return body


def obstacle_bodies(obstacles: tuple[Obstacle, ...]) -> list[WorldBody]:
    """Bodies of the user's boxes and capsules."""
    return [
        WorldBody(
            name=o.name,
            half=o.half,
            place=o.centre,
            rotation=o.rotation,
            radius=o.radius or 0.0,
        )
        for o in obstacles
    ]
