"""Face of a striking link: its direction, and the corners of its hull that may touch first."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from impactopt.bodies.robot_bodies import bodies_of
from impactopt.robots.robot import Robot

__all__ = ["StrikerFace", "striker_face"]

Array = NDArray[np.float64]
CONE = np.pi / 3  # [rad] about the face's normal: corners that lead in none of these directions never do
DIRECTIONS = 400
MERGED = 0.004  # [m] corners nearer to each other than this count as one
FLAT = 0.9  # cosine: facets turned less belong to the face that the striking point lies on


class StrikerFace(NamedTuple):
    """Face of a striking link about its striking point, in the frame of the striker.

    normal (3,) : outward unit vector.  corners (k, 3) [m] : of the link's hull, from the striking point on.
    """

    normal: Array
    corners: Array

    @property
    def ahead(self) -> float:
        """Distance [m] by which the link sticks out beyond its striking point along the normal."""
        return float(max(0.0, (self.corners @ self.normal).max()))


def striker_face(robot: Robot, striker: str, axis: Array | None = None) -> StrikerFace | None:
    """The face of one of a robot's strikers; None for a link without a shape that is known.

    axis (3,) : its outward unit vector in the striker's frame, if known. Else it is that of the hull's facets
    next to the striking point; facets count by their areas.
    """
    hit = robot.striker(striker)
    model, bodies = robot.model, bodies_of(robot)
    frame = model.frames[model.getFrameId(hit.frame)]
    pieces = [piece for piece in bodies.of_joint.get(int(frame.parentJoint), ()) if not piece.assumed]
    if not pieces:
        return None
    to_frame = frame.placement.inverse()
    vertices = np.concatenate([p.vertices for p in pieces]) @ to_frame.rotation.T + to_frame.translation
    away = vertices - np.asarray(hit.point)
    hull = ConvexHull(away)
    if axis is not None:
        return StrikerFace(np.asarray(axis, dtype=float), _leading(away[hull.vertices], np.asarray(axis)))
    normals, offsets = hull.equations[:, :3], hull.equations[:, 3]
    nearest = normals[np.argmax(offsets)]  # the facet that the point is least inside of, or farthest outside
    corners = away[hull.simplices]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    same = (normals @ nearest > FLAT) & (np.abs(offsets - offsets.max()) < MERGED)
    normal = (normals * areas[:, None])[same].sum(axis=0)
    normal /= np.linalg.norm(normal)
    return StrikerFace(normal, _leading(away[hull.vertices], normal))


def _leading(points: Array, normal: Array) -> Array:
    """The points that lie farthest ahead in some direction within a cone about the normal."""
    # a Fibonacci lattice on the cap covers it evenly
    k = np.arange(DIRECTIONS) + 0.5
    height, turn = 1 - (1 - np.cos(CONE)) * k / DIRECTIONS, np.pi * (1 + np.sqrt(5)) * k
    wide = np.sqrt(1 - height**2)
    across = np.linalg.svd(normal[None])[2][1:]
    directions = height[:, None] * normal + wide[:, None] * (
        np.cos(turn)[:, None] * across[0] + np.sin(turn)[:, None] * across[1]
    )
    farthest, chosen = set((points @ directions.T).argmax(axis=0).tolist()), list[Array]()
    for index in np.argsort(-(points @ normal)):
        if index in farthest and all(np.linalg.norm(points[index] - c) > MERGED for c in chosen):
            chosen.append(points[index])
    return np.array(chosen)
