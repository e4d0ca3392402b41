"""Signed distances of convex bodies that are smooth everywhere: what a plan's constraints between bodies are.

The separation of two bodies A and B along a unit vector u from B to A is u . t less their supports. Its
largest value over all u is their distance; where they penetrate it is, near the direction that they
came from, how deep they are. With supports max_i a_i . u of vertices it has kinks, where faces are parallel.
So supports are rounded,

    h(u) = e log sum_i exp(a_i . u / e),

which is never less than the hull's own and at most e log k more, k vertices being within about e of a face.
Then the distance has derivatives of all orders, and the best direction tells them: by the envelope theorem
the gradient is the separation's at that u, and the Hessian is s_qq - s_qu (s_uu)^-1 s_uq on its tangents.

The vertices are those of a hull that is within `THIN` of the body's own. In C (native/separation.c) a
distance takes 2 to 10 us; without a compiler `separation_numpy` does the same.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import io
import weakref
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from impactopt.bodies import separation_numpy
from impactopt.bodies.convex_hulls import Piece
from impactopt.bodies.robot_bodies import Pair, RobotBodies
from impactopt.bodies.separation_numpy import ROUNDING
from impactopt.bodies.world import WorldBody
from impactopt.codegen.compiler import address, native_library
from impactopt.codegen.files import kept

__all__ = ["ROUNDING", "THIN", "Looked", "Placed", "Separations", "Shapes", "packed", "thinned"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
THIN = 1e-3  # [m] by which vertices left out are outside of the hull of the others, at most
_FEW = 12  # vertices of which none is left out
_EIGHT = 8  # vertices at once
_SIDE = 33  # numbers that the C code keeps of a pair


@dataclass(frozen=True, eq=False)
class Placed:
    """Placements at K instants of joints (K, J, 12) and of bodies of the world (K, W, 12), each a rotation
    by rows and a translation [m]; and a mask of the bodies that are present (K, W).
    """

    joints: Array
    world: Array
    present: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Looked:
    """Gaps of pairs (K, P) [m], lower bounds for those that are not near; instants (m,) and pair numbers
    (m,) of those that are.
    """

    gaps: Array
    spot: Index
    pair: Index

    @property
    def gap(self) -> Array:
        """(m,) [m] of those that are near."""
        return np.asarray(self.gaps[self.spot, self.pair])


class Shapes:
    """The pairs of convex pieces in a scene that are not to touch.

    Attributes
    ----------
    pairs (P, 2) : joint of the first; joint of the second, or -1 - the number of the world's body.
    number (P,) : of the two pieces among those of the same pair of bodies.
    between (P,) : joints between the two.
    radius (P,) [m] : of the second beside its vertices: a capsule's or a sphere's.
    points (k, 3) [m], blocks (k / 8, 3, 8) : vertices of all, as of `packed`.  hulls (P, 4) : first vertex
        and number of vertices of both.
    """

    def __init__(
        self,
        links: RobotBodies,
        world: Sequence[WorldBody],
        pairs_of_links: Mapping[Pair, Sequence[tuple[Any, Any]]],
        pairs_with_world: Iterable[Pair],
    ) -> None:
        """pairs_of_links : of two joints, with their pairs of pieces.  pairs_with_world : joint and number
        of a body of the world.
        """
        corners = [_corners(body.half) for body in world]
        own = {id(piece): _few_of(piece) for piece in links.pieces}
        ball = {id(piece): _ball(piece.vertices) for piece in links.pieces}
        self.points, self.blocks, places = packed([*own.values(), *corners])
        names: list[Any] = [*own, *(("world", w) for w in range(len(corners)))]
        where = dict(zip(names, places, strict=True))
        self.room = np.zeros(self.points.shape[0] + 1)
        pairs, number, hulls, balls, radius = [], [], [], [], []
        for (a, b), pieces in pairs_of_links.items():
            for k, (one, two) in enumerate(pieces):
                pairs.append((a, b))
                number.append(k)
                hulls.append((*where[id(one)], *where[id(two)]))
                balls.append((*ball[id(one)], *ball[id(two)]))
                radius.append(0.0)
        for j, w in pairs_with_world:
            body = world[w]
            for k, one in enumerate(links.of_joint[j]):
                pairs.append((j, -1 - w))
                number.append(k)
                hulls.append((*where[id(one)], *where["world", w]))
                balls.append((*ball[id(one)], *body.half, body.radius))
                radius.append(body.radius)
        self.pairs = np.array(pairs, dtype=np.int64).reshape(-1, 2)
        self.number = np.array(number, dtype=np.int64)
        self.hulls = np.array(hulls, dtype=np.int64).reshape(-1, 4)
        self.radius = np.array(radius, dtype=float)
        self._balls = np.array(balls, dtype=float).reshape(-1, 8)
        up = [set(joints) for joints in links.robot.model.supports]
        self.between = np.array([len(up[a] ^ up[b]) if b >= 0 else len(up) for a, b in pairs])
        self.index = {(a, b, k): n for n, ((a, b), k) in enumerate(zip(pairs, number, strict=True))}

    def __len__(self) -> int:
        return len(self.pairs)

    def look(self, at: Placed, within: float, ways: Array, wanted: NDArray[np.bool_]) -> Looked:
        """Gaps of the pairs ``wanted`` (P,), exact where they are less than ``within`` [m].

        ways (K, P, 3) : directions that separate them, zero where none is known; what is looked at moves
        there.
        """
        (k, j), w, p = at.joints.shape[:2], at.world.shape[1], len(self)
        gaps, near = np.empty((k, p)), np.empty((k * p, 2), dtype=np.int64)
        chosen, library = wanted.astype(np.uint8), _library()
        if library is None:
            found = separation_numpy.look(self, at, within, ways, wanted, gaps)
            return Looked(gaps, *found)
        counts = (ctypes.c_int64(n) for n in (k, j, w, p))
        arrays = (at.joints, at.world, self.pairs, self._balls, self.hulls, self.radius, at.present, chosen)
        n = library.look(
            *counts,
            *map(address, (*arrays, self.blocks)),
            ctypes.c_double(1 / ROUNDING),
            ctypes.c_double(within),
            *map(address, (ways, gaps, self.room)),
            ctypes.c_int64(len(near)),
            address(near),
        )
        return Looked(gaps, near[:n, 0].copy(), near[:n, 1].copy())

    def may_meet(
        self, one: tuple[Placed, Looked], two: tuple[Placed, Looked], wanted: NDArray[np.bool_]
    ) -> tuple[Index, Index]:
        """Instants and numbers of pairs that are apart in both, but may have met on the straight way between:
        the first moves farther, as the second sees it, than both gaps are wide.
        """
        (k, j), w, p = one[0].joints.shape[:2], one[0].world.shape[1], len(self)
        near = np.empty((k * p, 2), dtype=np.int64)
        chosen, library = wanted.astype(np.uint8), _library()
        if library is None:
            return separation_numpy.may_meet(self, one, two, wanted)
        counts = (ctypes.c_int64(n) for n in (k, j, w, p))
        places = (one[0].joints, one[0].world, two[0].joints, two[0].world)
        arrays = (*places, self.pairs, self._balls, chosen, one[1].gaps, two[1].gaps)
        n = library.may_meet(*counts, *map(address, arrays), ctypes.c_int64(len(near)), address(near))
        return near[:n, 0].copy(), near[:n, 1].copy()


class Separations:
    """Distances of pairs at the ends of chains of n joints, less their reach, with derivatives.

    z (count, n + 3) : shift of the second body's frame [m], joints [rad, m].
    """

    def __init__(self, shapes: Shapes, joints: int, pairs: Index, numbers: Array, ways: Array) -> None:
        """pairs (count,) : numbers of pairs.  numbers (count, 13 joints + 13) : n + 1 placements, which
        joints turn, and the reach [m].  ways (count, 3) : directions to begin at.
        """
        self._shapes, self._pairs, self.joints, self.count = shapes, pairs, joints, len(pairs)
        self.numbers, self.ways = np.ascontiguousarray(numbers), np.ascontiguousarray(ways, dtype=float)
        self._hulls = np.ascontiguousarray(shapes.hulls[pairs])
        self._known, self._room = np.zeros((self.count, _SIDE)), shapes.room
        self.forget()

    def copy(self) -> Separations:
        """The same, with numbers of its own."""
        return Separations(self._shapes, self.joints, self._pairs, self.numbers.copy(), self.ways.copy())

    def forget(self) -> None:
        """Clears the last result, as ``numbers`` have changed."""
        self._seen = np.full((self.count, self.joints + 3), np.nan)

    def write(self, what: int, z: Array, out: Array, factors: Array | None = None) -> None:
        """Writes values (what = 0), gradients (1), or ``factors`` times the Hessians' lower triangles, column
        by column (2), to ``out``.

        Derivatives are those of an iterate: directions stay there. Values are of any trial.
        """
        z, library = np.ascontiguousarray(z), _library()
        if library is None:
            separation_numpy.write(self, self._shapes.points, self._hulls, what, z, out, factors)
            return
        by = np.zeros(self.count) if factors is None else np.ascontiguousarray(factors)
        library.separation(
            ctypes.c_int64(self.count),
            ctypes.c_int64(self.joints),
            *map(address, (z, self.numbers, self._hulls, self._shapes.blocks)),
            ctypes.c_double(1 / ROUNDING),
            *map(address, (self.ways, self._known, self._seen, self._room)),
            ctypes.c_int64(what),
            *map(address, (by, out)),
        )


def packed(hulls: Sequence[Array]) -> tuple[Array, Array, list[tuple[int, int]]]:
    """Vertices of all hulls one after the other (k, 3), each filled up to a multiple of eight; the same eight
    by eight, with coordinates of a kind side by side (k / 8, 3, 8); first vertex and number of each hull.
    """
    parts, where, size = [np.zeros((0, 3))], list[tuple[int, int]](), 0
    for hull in hulls:
        vertices = hull[_neighbours(hull)]
        where.append((size, len(vertices)))
        more = -len(vertices) % _EIGHT
        parts += [vertices, np.repeat(vertices[-1:], more, axis=0)]
        size += len(vertices) + more
    points = np.concatenate(parts)
    return points, np.ascontiguousarray(points.reshape(-1, _EIGHT, 3).transpose(0, 2, 1)), where


def _neighbours(vertices: Array) -> Index:
    """Order (k,) of vertices (k, 3) in which eight by eight are close together: most of these are far below
    the highest one in any direction, and cost no exponentials.
    """
    order, parts = np.arange(len(vertices)), [slice(0, len(vertices))]
    while parts:
        own = parts.pop()
        blocks = -(-(own.stop - own.start) // _EIGHT)
        if blocks < 2:
            continue
        points, middle = vertices[order[own]], own.start + blocks // 2 * _EIGHT
        longest = int(np.ptp(points, axis=0).argmax())
        order[own] = order[own][np.argsort(points[:, longest], kind="stable")]
        parts += [slice(own.start, middle), slice(middle, own.stop)]
    return order


_FEW_OF: weakref.WeakKeyDictionary[Piece, Array] = weakref.WeakKeyDictionary()


def _few_of(piece: Piece) -> Array:
    """`thinned` of a piece's vertices, found once: scenes about one robot share its pieces."""
    if piece not in _FEW_OF:
        _FEW_OF[piece] = thinned(piece.vertices)
    return _FEW_OF[piece]


def thinned(vertices: Array) -> Array:
    """Some of a hull's vertices (k, 3) [m]: the others are outside of their hull by `THIN` at most.

    They are chosen one by one, that which is farthest outside of those before. Kept on disk.
    """
    if len(vertices) <= _FEW:
        return vertices
    digest = hashlib.sha256(f"1 {THIN}".encode() + np.round(vertices, 9).tobytes()).hexdigest()

    def make() -> bytes:
        file = io.BytesIO()
        np.save(file, _chosen(vertices))
        return file.getvalue()

    return vertices[np.load(io.BytesIO(kept("thin", digest, make)), allow_pickle=False)]


def _chosen(vertices: Array) -> Index:
    grid = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3)
    first = (grid[np.any(grid != 0, axis=1)] @ vertices.T).argmax(axis=1)
    chosen = sorted(set(first.tolist()))
    while len(chosen) < len(vertices):
        try:
            planes = ConvexHull(vertices[chosen]).equations
        except QhullError:  # those first ones are flat
            return np.arange(len(vertices))
        out = (vertices @ planes[:, :3].T + planes[:, 3]).max(axis=1)
        k = int(out.argmax())
        if out[k] <= THIN:
            break
        chosen.append(k)
    return np.array(chosen, dtype=np.int64)


def _corners(half: Array) -> Array:
    """Corners of a box; those of a flat or line-like box once each."""
    return np.unique(half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]), axis=0)


def _ball(vertices: Array) -> tuple[float, float, float, float]:
    """Centre and radius [m] of a sphere about them."""
    centre = (vertices.max(axis=0) + vertices.min(axis=0)) / 2
    x, y, z = centre.tolist()
    return x, y, z, float(np.linalg.norm(vertices - centre, axis=1).max())


@functools.cache
def _library() -> Any:
    library = native_library("impactopt.bodies", "separation")
    if library is not None:
        library.look.restype = library.may_meet.restype = ctypes.c_int64
        library.separation.restype = None
    return library
