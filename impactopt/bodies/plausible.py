"""Shapes that are hard to believe: farther from their link than they are large."""

from __future__ import annotations

from collections.abc import Sequence

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.bodies.convex_hulls import Piece

__all__ = ["distance_to_link", "is_far", "size_of"]

Array = NDArray[np.float64]
FAR = 0.1  # [m] from all that is known of a link at least, and the shape's own size


def is_far(model: pin.Model, piece: Piece, beside: Sequence[Piece]) -> bool:
    """True if a shape is farther from its link than its size; beside : all shapes that the joint moves."""
    return distance_to_link(model, piece, beside) > max(FAR, size_of(piece))


def size_of(piece: Piece) -> float:
    """Diagonal of a shape's bounds [m]."""
    return float(np.linalg.norm(np.ptp(piece.vertices, axis=0)))


def distance_to_link(model: pin.Model, piece: Piece, beside: Sequence[Piece]) -> float:
    """Distance [m] of a shape to the nearest of what is known of its link otherwise.

    That is the joint that moves it, the centre of mass, frames on it, the joints that it carries, and its
    other shapes.
    """
    own = piece.joint
    places = [np.zeros(3), np.array(model.inertias[own].lever)]
    places += [
        np.array(f.placement.translation) for f in model.frames if f.parentJoint == own and _is_link(f)
    ]
    places += [
        np.array(model.jointPlacements[j].translation)
        for j in range(1, model.njoints)
        if int(model.parents[j]) == own
    ]
    shapes = [(coal.Sphere(1e-9), coal.Transform3s(np.eye(3), place)) for place in places]
    shapes += [(other.shape, coal.Transform3s()) for other in beside if other is not piece]
    return min(_distance(piece, shape, at) for shape, at in shapes)


def _is_link(frame: pin.Frame) -> bool:
    return frame.type in (pin.FrameType.BODY, pin.FrameType.FIXED_JOINT)


def _distance(piece: Piece, shape: object, at: object) -> float:
    found = coal.DistanceResult()
    coal.distance(piece.shape, coal.Transform3s(), shape, at, coal.DistanceRequest(), found)
    return max(float(found.min_distance), 0.0)
