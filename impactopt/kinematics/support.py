"""Support of soles on level ground: polygon, ZMP, contact wrench cone.

A wrench (f, m) at the sole's frame can be transmitted by unilateral frictional forces at the corners if and
only if it lies in the cone spanned by them; CoP, friction and yaw torsion are bounded *together* (torsion
capacity vanishes as the CoP nears a corner). Source: Caron, Pham, Nakamura, "Stability of surface contacts
for humanoid robots", ICRA 2015, whose closed form for a rectangle the tests compare with.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, QhullError

from impactopt.errors import InputError

Array = NDArray[np.float64]
_ON_LINE = 1e-9  # [m] corners nearer to a line than this lie on it


def inward_edges(polygon: Array) -> tuple[Array, Array]:
    """Inward unit normals (k, 2), offsets (k,) [m] of a counter-clockwise polygon; inside, n.p >= offset."""
    edge = np.roll(polygon, -1, axis=0) - polygon
    inward = np.stack([-edge[:, 1], edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
    return inward, np.einsum("ij,ij->i", inward, polygon)


def shrink(polygon: ArrayLike, margin: float) -> Array:
    """The convex polygon (k, 2) [m], counter-clockwise, with every edge moved inwards by ``margin`` [m]."""
    p = np.array(polygon, dtype=float)
    if margin == 0.0:
        return p
    inward, offset = inward_edges(p)
    for normal, least in zip(
        inward, offset + margin, strict=True
    ):  # an edge shorter than the margin may vanish
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
        a, b = inside[k - 1], inside[k]
        if min(a, b) < -_ON_LINE and max(a, b) > _ON_LINE:  # the edge that ends here is cut
            out.append(corners[k - 1] + a / (a - b) * (corners[k] - corners[k - 1]))
        if b >= -_ON_LINE:
            out.append(corners[k])
    return np.array(out) if len(out) > 2 and max(inside) > _ON_LINE else np.zeros((0, 2))


def contact_wrench_cone(polygon: ArrayLike, friction: float, *, margin: float = 0.0) -> Array:
    """Rows F (k, 6) with  F @ (f, m) >= 0  exactly for the wrenches that the sole can transmit.

    polygon (c, 2) [m]: corners in the sole's frame, counter-clockwise; friction: coefficient of the pyramid
    inscribed along the sole's axes (|f_x|, |f_y| <= mu f_z); margin [m]: how far the CoP stays inside. Rows
    are scaled so that a unit normal force at the middle gives values of the order of one (forces [N], moments
    [N m]).
    """
    if not friction > 0:
        raise InputError(f"friction must be positive, not {friction}")
    corners = shrink(polygon, margin)
    return _facets(tuple(map(tuple, corners.tolist())), float(friction)).copy()


@functools.lru_cache(maxsize=64)  # asked for at every node of a program, for the same few soles
def _facets(corners: tuple[tuple[float, float], ...], friction: float) -> Array:
    rays = []
    for x, y in corners:
        for fx, fy in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            f = np.array([friction * fx, friction * fy, 1.0])
            rays.append(np.concatenate([f, np.cross([x, y, 0.0], f)]))
    r = np.array(rays)
    # every ray has f_z = 1, so the cone is the one over the 5-dimensional polytope of the other components
    size = np.maximum(np.abs(np.delete(r, 2, axis=1)).max(axis=0), _ON_LINE)
    points = np.delete(r, 2, axis=1) / size
    try:
        hull = ConvexHull(points)
    except QhullError as error:  # pragma: no cover - degenerate polygons are refused by Sole
        raise InputError(
            "the sole's polygon is degenerate: give at least three corners that span an area"
        ) from error
    facets = np.unique(np.round(hull.equations, 10), axis=0)  # one simplex per row: coplanar ones coincide
    rows = np.zeros((len(facets), 6))
    rows[:, [0, 1, 3, 4, 5]] = -facets[:, :5] / size
    rows[:, 2] = -facets[:, 5]
    return rows


MERGED = 1e-6  # [m] a corner nearer than this to the line of its neighbours is no corner


def corners_at(polygon: Array, placement: Any) -> Array:
    """Corners (k, 3) [m] of a sole's polygon (k, 2) at the sole's placement, a pin.SE3."""
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
    """Convex hull (k, 2) [m] of points (n, 2), counter-clockwise; none of its corners is inside an edge."""
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


def overlap(one: Array, other: Array) -> bool:
    """True if two convex polygons (k, 2) [m], counter-clockwise, overlap: no edge parts them."""
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
    return np.stack([-w[:, 4] / w[:, 2], w[:, 3] / w[:, 2]], axis=1)
