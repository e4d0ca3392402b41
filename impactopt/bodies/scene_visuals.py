"""Drawable bodies of the world, which a plan keeps clear of, and their motion under an impact."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from impactopt.bodies.solids import Solid, box
from impactopt.bodies.world import WorldBody

__all__ = ["Hinge", "Part", "surroundings_of"]

Array = NDArray[np.float64]
LARGE = 0.6  # [m] sides of what stands still and would hide the robot


class Hinge(NamedTuple):
    """A line through ``place`` (3,) [m] along ``axis`` (3,), and how far [m] from it the blow comes down."""

    place: Array
    axis: Array
    arm: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """A solid in the world, before the blow.

    kind : "target", what the blow moves; "held", what holds it, or a target that stands still; "obstacle".
    moves : along the normal with the target; with a hinge it turns about that instead.
    clear : the robot is to be seen through it.
    """

    kind: str
    solid: Solid
    moves: bool = False
    hinge: Hinge | None = None
    clear: bool = False

    def placed(self, travel: float, normal: Array) -> Array:
        """Its vertices (k, 3) [m] when the target has moved so far [m] along the normal."""
        vertices = self.solid.vertices
        if self.hinge is None:
            return vertices + travel * normal if self.moves else vertices
        turn = Rotation.from_rotvec(np.arctan2(travel, self.hinge.arm) * self.hinge.axis).as_matrix()
        return np.asarray((vertices - self.hinge.place) @ turn.T + self.hinge.place)


def surroundings_of(world: Sequence[WorldBody]) -> list[Part]:
    """Drawable parts of `ImpactProblem.world`: all but the ground, and cores, which are no objects.

    A board that lies on two supports is drawn as two halves. Each tips over the inner edge of its support as
    far as the blow has moved the middle, so that it bends a little, and opens when it is broken.
    """
    parts: list[Part] = []
    for body in world:
        if body.ground or body.core:
            continue
        supports = [b for b in world if b.of_target and not (b.moves or b.core)] if body.before else []
        if supports:
            parts += [_half(body, support) for support in supports]
            continue
        kind = "target" if body.moves else "held" if body.of_target else "obstacle"
        clear = not body.of_target or (not body.moves and 2 * float(body.half.max()) > LARGE)
        parts.append(Part(kind=kind, solid=body.solid, moves=body.moves, clear=clear))
    return parts


def _half(board: WorldBody, support: WorldBody) -> Part:
    """The half of a board that lies on this support."""
    wide, high, thick = board.half
    across, _, _ = board.rotation.T @ (support.place - board.place)
    way = float(np.sign(across))
    edge = float(abs(across) - support.half[0])
    middle, inner = np.array([way * wide / 2, 0.0, 0.0]), np.array([way * edge, 0.0, thick])
    solid = box([wide, 2 * high, 2 * thick]).moved(board.rotation, board.place + board.rotation @ middle)
    hinge = Hinge(board.place + board.rotation @ inner, way * board.rotation[:, 1], edge)
    return Part(kind="target", solid=solid, moves=True, hinge=hinge)
