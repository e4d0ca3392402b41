"""Spheres that cover a convex hull, and planes that enclose it: what a plan's smooth constraints know of
bodies.

A point x is at least max_i (n_i . x - h_i) from a body whose support function is h_i in the directions n_i,
and a sphere that much less its radius. Inside the body that is how deep it is, so that constraints show the
way out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

__all__ = ["PLANES", "Planes", "Spheres", "enclose", "fill", "surface_points"]

Array = NDArray[np.float64]

PLANES = 32  # about every body
# how far spheres may stick out of the hull [m]: the least with which so many of them cover it
STEPS = (
    0.004,
    0.006,
    0.008,
    0.01,
    0.0125,
    0.015,
    0.0175,
    0.02,
    0.025,
    0.03,
    0.04,
    0.05,
    0.06,
    0.08,
    0.1,
    0.15,
)
SMALL, FEW, MOST = 0.3, 10, 16  # [m] extent of a hull that is covered by few; how many
INSETS = (0.98, 0.85, 0.7, 0.5, 0.3)  # of the largest sphere's radius: how deep centres may lie
CENTRES = 40  # at each of these depths
COARSE, FINE = 400, 3000  # points of the surface to cover, and to check with
SHORT = 1e-3  # [m] of the coarse points that may be left out of the spheres
AWAY = 0.05  # [m] from a body: where the planes about it are to tell how far it is
SPREAD = 200  # directions all around that planes may have, beside those of the hull's facets


@dataclass(frozen=True, kw_only=True)
class Spheres:
    """k spheres: centre (k, 3) [m], radius (k,) [m].

    out, short [m] : how far they stick out of the hull that they cover, and what of its surface they leave
        out, at most.
    """

    centre: Array
    radius: Array
    out: float
    short: float


@dataclass(frozen=True, kw_only=True)
class Planes:
    """`PLANES` planes about a body: unit normals (PLANES, 3), offsets (PLANES,) [m]: n . x <= h inside.

    out [m] : by how much a point at `AWAY` from it is farther than they say, at most.
    """

    normal: Array
    offset: Array
    out: float


def fill(hull: ConvexHull, points: Array) -> Spheres:
    """Spheres that cover surface points (m, 3) [m] in a hull, and stick out of it as little as may be.

    A sphere about a point at depth a in a convex hull with the radius a + t sticks out by t. For a bound t a
    greedy set cover takes those that cover most; the least t of a list that needs few enough of them is
    taken.
    """
    centres = _centres(hull)
    depth = _depth(hull, centres)
    coarse = _spread(points, COARSE)
    far = np.linalg.norm(coarse - centres[:, None], axis=2)
    most = FEW if float(np.ptp(points, axis=0).max()) < SMALL else MOST
    chosen, step = list[int](), 0.0
    for step in STEPS:
        chosen = _greedy(far <= (depth + step + SHORT)[:, None], most)
        if chosen:
            break
    if not chosen:  # as nearly flat ones: one about it
        middle = (points.max(axis=0) + points.min(axis=0)) / 2
        radius = float(np.linalg.norm(points - middle, axis=1).max())
        return Spheres(centre=middle[None], radius=np.array([radius]), out=radius, short=0.0)
    centre, reach = centres[chosen], depth[chosen] + step
    fine = points[:: len(points) // FINE + 1]
    away = np.linalg.norm(fine - centre[:, None], axis=2) - reach[:, None]
    nearest = away.argmin(axis=0)
    # each as large as what it covers best needs
    grow = np.array([away[k, nearest == k].max(initial=SHORT - reach[k]) for k in range(len(chosen))])
    radius = reach + np.minimum(grow, 2 * SHORT)
    gaps = float((away + (reach - radius)[:, None]).min(axis=0).max())
    radius += max(0.0, gaps - 2 * SHORT)
    return Spheres(
        centre=centre,
        radius=radius,
        out=float((radius - depth[chosen]).max()),
        short=float(np.clip(gaps, 0.0, 2 * SHORT)),
    )


def enclose(vertices: Array, normals: Array, radius: float = 0.0) -> Planes:
    """Planes about the hull of vertices (k, 3) [m], inflated by ``radius`` [m], that tell best how far it is.

    normals (m, 3) : of its facets. Directions are taken one by one: that which removes most of what those
    before it miss, at points about the body, against all directions together.
    """
    directions = np.concatenate([_rounded(normals), _sphere(SPREAD)])
    support = (directions @ vertices.T).max(axis=1)
    # points away from the body, along all directions, from its farthest vertices and from its surface
    far = vertices[(directions @ vertices.T).argmax(axis=1)] + AWAY * directions
    middle = vertices.mean(axis=0)
    facing = (far - middle) / np.linalg.norm(far - middle, axis=1, keepdims=True)
    depth = (support[None] - directions @ middle)[0]
    along = np.maximum(facing @ directions.T, 1e-6)
    out = middle + facing * ((depth / along).min(axis=1) + AWAY)[:, None]
    points = np.concatenate([far, out])
    told = points @ directions.T - support  # (points, directions): how far each direction says the body is
    best, known = told.max(axis=1), np.full(len(points), -np.inf)
    chosen: list[int] = []
    for _ in range(PLANES):
        gain = np.minimum(np.maximum(told, known[:, None]) - np.maximum(known, best - 1.0)[:, None], 1.0).sum(
            axis=0
        )
        k = int(gain.argmax())
        chosen.append(k)
        known = np.maximum(known, told[:, k])
    return Planes(normal=directions[chosen], offset=support[chosen] + radius, out=float((best - known).max()))


def _rounded(normals: Array) -> Array:
    """Unit vectors, those that are nearly the same once."""
    if not len(normals):
        return normals
    unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    _, first = np.unique(np.round(unit / 0.15).astype(int), axis=0, return_index=True)
    return np.asarray(unit[np.sort(first)])


def _sphere(count: int) -> Array:
    """Directions (count, 3) all around: Fibonacci's lattice."""
    k = np.arange(count) + 0.5
    polar, turn = np.arccos(1 - 2 * k / count), np.pi * (1 + 5**0.5) * k
    return np.column_stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)])


def _greedy(covers: NDArray[np.bool_], most: int) -> list[int]:
    """Rows that together cover every column; none if it takes more than ``most``."""
    left, chosen = np.ones(covers.shape[1], dtype=np.float32), list[int]()
    table = covers.astype(np.float32)
    while left.any():
        gain = table @ left
        best = int(gain.argmax())
        if gain[best] == 0 or len(chosen) == most:
            return []
        chosen.append(best)
        left[covers[best]] = 0.0
    return chosen


def _depth(hull: ConvexHull, points: Array) -> Array:
    """Depth (k,) [m] of points in the hull, < 0 outside."""
    return np.asarray(-(points @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1))


def _centres(hull: ConvexHull) -> Array:
    """Points in the hull: its deepest one, corners of what is left of it further in, and between these."""
    normals, offsets = hull.equations[:, :3], hull.equations[:, 3]
    best = linprog(
        [0.0, 0.0, 0.0, -1.0],
        A_ub=np.column_stack([normals, np.ones(len(normals))]),
        b_ub=-offsets,
        bounds=[(None, None)] * 3 + [(0, None)],
    )
    centre, radius = best.x[:3], float(best.x[3])
    found, rng = [centre[None]], np.random.default_rng(0)
    for inset in INSETS:
        planes = hull.equations.copy()
        planes[:, 3] += inset * radius
        try:
            corners = HalfspaceIntersection(planes, centre).intersections
        except QhullError:  # nothing is left so deep
            continue
        corners = _spread(corners[np.isfinite(corners).all(axis=1)], CENTRES)
        found.append(corners)
        one, two = rng.integers(len(corners), size=(2, 2 * CENTRES))
        mix = rng.random((2 * CENTRES, 1))
        found.append(corners[one] + mix * (corners[two] - corners[one]))
    centres = np.concatenate(found)
    return np.asarray(centres[_depth(hull, centres) > 0])


def _spread(points: Array, count: int) -> Array:
    """Spread of at most ``count`` of the points, far from each other."""
    if len(points) <= count:
        return points
    if len(points) > 20 * count:  # the greedy choice below takes count x points
        points = points[:: len(points) // (20 * count) + 1]
    chosen = [int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmax())]
    away = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.asarray(points[chosen])


def surface_points(vertices: Array, triangles: NDArray[np.intp], spacing: float) -> Array:
    """Vertices, and points on triangles, no further apart than ``spacing`` [m]."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    sides = np.max([np.linalg.norm(x - y, axis=1) for x, y in ((a, b), (b, c), (c, a))], axis=0)
    pieces = np.ceil(sides / spacing).astype(int)
    found = [vertices]
    for n in np.unique(pieces[pieces > 1]):
        of = pieces == n
        i, j = np.triu_indices(n + 1)
        u, w = i[None, :, None] / n, (j - i)[None, :, None] / n
        found.append((a[of, None] + u * (b - a)[of, None] + w * (c - a)[of, None]).reshape(-1, 3))
    points = np.concatenate(found)
    _, kept = np.unique(np.round(points / (0.7 * spacing)).astype(np.int64), axis=0, return_index=True)
    return np.asarray(points[np.sort(kept)])
