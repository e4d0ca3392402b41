"""Support polygon and ZMP of soles on level ground."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from impactopt.kinematics.wrench_cone import inward_edges

Array = NDArray[np.float64]
MERGED = 1e-6  # [m] a corner nearer than this to the line of its neighbours is no corner


def support_polygon(robot: Any, coordinates: Any) -> Array:
    """Convex hull (k, 2) [m] of the fixed soles' corners on the ground, counter-clockwise, world x and y.

    (0, 2) without soles.
    """
    corners = [
        (leg.placement.rotation @ np.array([x, y, 0.0]) + leg.placement.translation)[:2]
        for leg in coordinates.legs
        if leg.sole is not None
        for x, y in leg.sole.polygon
    ]
    if not corners:
        return np.zeros((0, 2))
    points = np.array(corners)
    hull = list(points[ConvexHull(points).vertices])
    k = 0
    while k < len(hull):  # rounding decides whether a corner in the middle of an edge belongs to the hull
        before, after = hull[k - 1], hull[(k + 1) % len(hull)]
        way, arm = (after - before) / np.linalg.norm(after - before), hull[k] - before
        if len(hull) > 3 and abs(way[0] * arm[1] - way[1] * arm[0]) < MERGED:
            hull.pop(k)
        else:
            k += 1
    return np.array(hull)


def margin(polygon: Array, points: Array) -> Array:
    """Distance (n,) [m] of points (n, 2) from the polygon's nearest edge line, positive inside."""
    inward, offset = inward_edges(polygon)
    return np.asarray((points @ inward.T - offset).min(axis=1))


def zmp(wrench: Array) -> Array:
    """ZMP (n, 2) [m] on the ground z = 0 from ground wrenches (n, 6) [N, N m] about the world's origin."""
    w = np.atleast_2d(wrench)
    return np.stack([-w[:, 4] / w[:, 2], w[:, 3] / w[:, 2]], axis=1)
