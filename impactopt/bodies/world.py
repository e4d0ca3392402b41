"""The bodies of the world: the ground, the target and what holds it, and the user's obstacles."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import coal
import numpy as np
from numpy.typing import NDArray

from impactopt.bodies.shapes import Obstacle, TargetBody, face_axes
from impactopt.bodies.solids import Solid, capsule
from impactopt.bodies.solids import box as cuboid
from impactopt.contact.targets import Board, Nail, RigidWall, Target

__all__ = ["BEHIND", "WorldBody", "ground_body", "obstacle_bodies", "target_bodies"]

Array = NDArray[np.float64]
BEHIND = 0.08  # [m] behind its face a target is its core, which the striker has not to reach before contact
DEEP = 0.5  # [m] how far the core goes
FLOOR, THICK = 10.0, 0.5  # [m] half sides of the ground
# [m] of targets: (across, up, deep)
BOX, WALL, BOARD, BLOCK = (0.18, 0.18, 0.18), (1.5, 1.5, 0.1), (0.30, 0.24, 0.02), (0.2, 0.2, 0.06)
SUPPORT = (0.04, 0.24, 0.12)  # under either end of a board
NAIL_LENGTH, NAIL_RADIUS = 0.07, 0.004
# by the target's kind: in a word, and its sides; of others a box
USUAL: dict[type[Target], tuple[str, tuple[float, ...]]] = {
    RigidWall: ("wall", WALL),
    Board: ("board on two supports", BOARD),
    Nail: ("nail in a block", BLOCK),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class WorldBody:
    """A box of half sides ``half`` (3,) [m], inflated by ``radius`` [m], at ``place``, axes ``rotation``.

    half zero: a sphere; only its last number not zero: a capsule along its z axis.
    of_target : it comes and goes with the target.  moves : with it, along the normal.
    strikable : the link that strikes may touch it.  before : it is there until contact only.
    core : of the target, which the striker is to reach from its face.  ground : it is the floor.
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
        """Shape for coal."""
        if not self.radius:
            return coal.Box(*(2 * self.half))
        return coal.Capsule(self.radius, 2 * self.half[2]) if self.half[2] > 0 else coal.Sphere(self.radius)

    @property
    def solid(self) -> Solid:
        """Its surface as triangles, to draw, in the world."""
        own = capsule(self.radius, 2 * self.half[2]) if self.radius else cuboid(2 * self.half)
        return own.moved(self.rotation, self.place)


def ground_body(height: float) -> WorldBody:
    """The half-space below a height [m], as a large box."""
    return WorldBody(
        name="ground",
        half=np.array([FLOOR, FLOOR, THICK]),
        place=np.array([0.0, 0.0, height - THICK]),
        rotation=np.eye(3),
        ground=True,
    )


def _usual(body: TargetBody, target: Target) -> tuple[str, tuple[float, ...]]:
    """Default appearance of a target for which the problem gives no size: its shape, and its sides [m]."""
    if body.shape == "ball":
        return "ball", BOX[:1]
    for kind, usual in USUAL.items():
        if isinstance(target, kind):
            return usual
    return "box", BOX


def body_message(body: TargetBody, target: Target) -> str:
    """The target's body in words, with its size, and whether that was assumed."""
    if body.shape == "none":
        return "none: nothing keeps off it"
    word, size = _usual(body, target)
    sides = " x ".join(f"{100 * side:.3g}" for side in body.size or size)
    return f"{'assumed: ' if body.size is None else ''}{word}, {sides} cm"


def target_bodies(body: TargetBody, target: Target, point: Array, normal: Array) -> list[WorldBody]:
    """Bodies of a target: its face's middle is at the point, and it extends from there along the normal."""
    rows = face_axes(normal)  # normal, across, up
    axes = np.column_stack([rows[1], rows[2], rows[0]])  # of boxes: across, up, deep

    def solid(name: str, half: Array, deep: float, across: float = 0.0, **how: Any) -> WorldBody:
        """Its middle is so deep behind the face [m]."""
        place = point + axes @ np.array([across, 0.0, deep])
        return WorldBody(name=name, half=half, place=place, rotation=axes, of_target=True, **how)

    def box(name: str, size: Any, start: float = 0.0, across: float = 0.0, **how: Any) -> WorldBody:
        half = np.asarray(size, dtype=float) / 2
        return solid(name, half, start + half[2], across, **how)

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
        if out < 2 * NAIL_RADIUS:
            return [block]
        half = np.array([0.0, 0.0, out / 2 - NAIL_RADIUS])
        shank = solid("target", half, out / 2, radius=NAIL_RADIUS, moves=True, strikable=True)
        return [shank, block]
    if isinstance(target, Board):
        across = (size[0] - SUPPORT[0]) / 2
        post = (SUPPORT[0], size[1], SUPPORT[2])
        supports = [
            box("target's support", post, size[2], way * across) for way in (-1.0, 1.0)
        ]  # what held the board stays when it is broken
        main = box("target", size, moves=True, strikable=True, before=True)
        return [main, *supports, _core(box, size)]
    return [box("target", size, moves=moves, strikable=True), _core(box, size)]


def _core(box: Any, size: tuple[float, ...]) -> WorldBody:
    """Core behind the face, which keeps a striking link from coming through from behind."""
    body: WorldBody = box("target from behind", (size[0], size[1], DEEP), BEHIND, before=True, core=True)
    return body


def obstacle_bodies(obstacles: tuple[Obstacle, ...]) -> list[WorldBody]:
    """The user's boxes and capsules."""
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
