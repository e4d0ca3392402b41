"""Support of soles on level ground: polygon, ZMP, contact wrench cone.

Unilateral frictional forces at the corners can transmit a wrench (f, m) at the sole's frame if and only if it
lies in the cone spanned by them. The cone bounds centre of pressure (CoP), friction and yaw torsion
*together*; torsion capacity vanishes as the CoP nears a corner. Source: Caron, Pham, Nakamura, "Stability of
surface contacts for humanoid robots", ICRA 2015, whose closed form for a rectangle the tests compare with.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, QhullError

from impactopt.errors import InputError

Array = NDArray[np.float64]
_ON_LINE = 1e-9  # [m] a corner nearer to a line than this lies on it


def inward_edges(polygon: Array) -> tuple[Array, Array]:
    """Inward unit normals (k, 2), offsets (k,) [m] of a counter-clockwise polygon; inside, n.p >= offset."""
    edge = np.roll(polygon, -1, axis=0) - polygon
    # A quarter turn to the left of an edge points inside, as corners are counter-clockwise.
    inward = np.stack([-edge[:, 1], edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
    return inward, np.einsum("ij,ij->i", inward, polygon)


def shrink(polygon: ArrayLike, margin: float) -> Array:
    """Convex polygon (k, 2) [m], counter-clockwise, with every edge moved inwards by ``margin`` [m].

    It may have fewer corners, as short edges can vanish. InputError if nothing is left.
    """
    p = np.array(polygon, dtype=float)
    if margin == 0.0:
        return p
    inward, offset = inward_edges(p)
    for normal, least in zip(inward, offset + margin, strict=True):
        p = _clip(p, p @ normal - least)
    if len(p) < 3:
        raise InputError(
            f"a margin of {margin:g} m leaves nothing of the sole: make it smaller than half the sole's width"
        )
    return p


def _clip(corners: Array, inside: Array) -> Array:
    """Part of a convex polygon where the signed distances ``inside`` [m] of its corners are positive."""
    out: list[Array] = []
    for k in range(len(corners)):
        # Sutherland and Hodgman's clipping, by one line.
        a, b = inside[k - 1], inside[k]
        if min(a, b) < -_ON_LINE and max(a, b) > _ON_LINE:  # the line cuts the edge that ends at corner k
            out.append(corners[k - 1] + a / (a - b) * (corners[k] - corners[k - 1]))
        if b >= -_ON_LINE:
            out.append(corners[k])
    return np.array(out) if len(out) > 2 and max(inside) > _ON_LINE else np.zeros((0, 2))


def contact_wrench_cone(polygon: ArrayLike, friction: float, *, margin: float = 0.0) -> Array:
    """Facets F (k, 6) of the contact wrench cone:  F @ (f, m) >= 0  for what the sole can transmit only.

    polygon (c, 2) : corners in the sole's frame, counter-clockwise [m].
    friction : coefficient mu of the pyramid |f_x|, |f_y| <= mu f_z along the sole's axes.
    margin : distance of the CoP from the edges [m].
    Facets are scaled so that a unit normal force at the middle gives values of order one.
    """
    if not friction > 0:
        raise InputError(f"friction must be positive, not {friction}")
    corners = np.asarray(polygon, dtype=float).tolist()
    return _facets(tuple(map(tuple, corners)), float(friction), float(margin)).copy()


@functools.lru_cache(maxsize=64)  # every node of a program needs those of the same few soles
def _facets(polygon: tuple[tuple[float, float], ...], friction: float, margin: float) -> Array:
    # rays of the cone: forces along the four edges of the friction pyramid at each corner
    rays = []
    for x, y in shrink(polygon, margin):
        for fx, fy in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            # Facets do not depend on the length of rays, so f_z = 1.
            f = np.array([friction * fx, friction * fy, 1.0])
            rays.append(np.concatenate([f, np.cross([x, y, 0.0], f)]))
    r = np.array(rays)
    # Every ray has f_z = 1, so the cone's facets are those of the 5-dimensional polytope of the other
    # components.
    size = np.maximum(np.abs(np.delete(r, 2, axis=1)).max(axis=0), _ON_LINE)
    points = np.delete(r, 2, axis=1) / size
    try:
        hull = ConvexHull(points)
    except QhullError as error:  # pragma: no cover - degenerate polygons are refused by Sole
        raise InputError(
            "the sole's polygon is degenerate: give at least three corners that span an area"
        ) from error
    # Qhull cuts a facet into simplices, which have equal equations: normal (5,) and offset, <= 0 inside
    equations = np.unique(np.round(hull.equations, 10), axis=0)
    facets = np.zeros((len(equations), 6))
    # normal . p + offset <= 0 for p = (others / size) / f_z, times -f_z: the offset
    # is the coefficient of f_z.
    facets[:, [0, 1, 3, 4, 5]] = -equations[:, :5] / size
    facets[:, 2] = -equations[:, 5]
    return facets


COLLINEAR = 1e-6  # [m] a corner nearer than this to the line of its neighbours is no corner


def corners_at(polygon: Array, placement: Any) -> Array:
    """World positions (k, 3) [m] of the corners of a sole's polygon (k, 2); ``placement``: pin.SE3."""
    flat = np.column_stack([polygon, np.zeros(len(polygon))])
    return np.asarray(flat @ placement.rotation.T + placement.translation)


def support_polygon(robot: Any, coordinates: Any) -> Array:
    """Convex hull (k, 2) [m] of the fixed soles' corners on the ground, counter-clockwise, world x and y.

    (0, 2) without soles.
    """
    standing = [leg for leg in coordinates.legs if leg.sole is not None]
    corners = [corners_at(leg.sole.polygon, leg.placement)[:, :2] for leg in standing]
    return convex_polygon(np.vstack(corners)) if corners else np.zeros((0, 2))


def convex_polygon(points: Array) -> Array:
    """Convex hull (k, 2) [m] of points (n, 2), counter-clockwise, without corners inside an edge."""
    hull = list(points[ConvexHull(points).vertices])
    k = 0
    while k < len(hull):  # by rounding a point in the middle of an edge may be a corner of the hull
        before, after = hull[k - 1], hull[(k + 1) % len(hull)]
        along, arm = (after - before) / np.linalg.norm(after - before), hull[k] - before
        # `along` is a unit vector: the cross product is the corner's distance from the line.
        if len(hull) > 3 and abs(along[0] * arm[1] - along[1] * arm[0]) < COLLINEAR:
            hull.pop(k)
        else:
            k += 1
    return np.array(hull)


def overlap(one: Array, other: Array) -> bool:
    """True if two convex polygons (k, 2) [m], counter-clockwise, overlap: no edge separates them."""
    for a, b in ((one, other), (other, one)):
        inward, offset = inward_edges(a)
        if (b @ inward.T < offset).all(axis=0).any():
            return False
    return True


def margin(polygon: Array, points: Array) -> Array:
    """Distance (n,) [m] of points (n, 2) from the polygon's nearest edge line, positive inside."""
    inward, offset = inward_edges(polygon)
    return np.asarray((points @ inward.T - offset).min(axis=1))


def zmp(wrench: Array) -> Array:
    """ZMP (n, 2) [m] on the ground z = 0 from ground wrenches (n, 6) [N, N m] about the world's origin."""
    w = np.atleast_2d(wrench)
    # Where the horizontal moment vanishes (paper, section II-B): m_x = p_y f_z and m_y = -p_x f_z on z = 0.
    return np.stack([-w[:, 4] / w[:, 2], w[:, 3] / w[:, 2]], axis=1)
