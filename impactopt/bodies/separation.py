"""Smooth signed distances of convex bodies, for the clearance constraints of a plan.

The separation s of two bodies A and B along a unit vector u from B to A is u . t, with t from B's origin to
A's, minus their support functions. Its maximum over u is the distance. For bodies that penetrate, its local
maximum near the direction they came from is minus the depth. Support functions of vertices, max_i a_i . u,
make the distance nonsmooth where faces are parallel. So they are smoothed, with e = `ROUNDING`,

    h(u) = e log sum_i exp(a_i . u / e).

This is never less than the hull's own and at most e log k more, if k vertices are within about e of a face.
The distance then has derivatives of all orders. By the envelope theorem its gradient is that of s at the best
u, and its Hessian is s_qq - s_qu (s_uu)^-1 s_uq, with derivatives by u on the tangents of the unit sphere.

The vertices are those of a hull within `THIN` of the body's own. In C (separation.c) a
distance takes 1 to 2 us in `punch`; without a compiler `separation_numpy` does the same.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import weakref
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from impactopt.arrays import Array, Index, Mask
from impactopt.bodies import separation_numpy
from impactopt.bodies.convex_hulls import Piece
from impactopt.bodies.robot_bodies import Pair, RobotBodies, bounding_ball
from impactopt.bodies.separation_numpy import ROUNDING
from impactopt.bodies.solids import cached_arrays
from impactopt.bodies.world import WorldBody
from impactopt.codegen.compiler import address, native_library

__all__ = ["ROUNDING", "THIN", "Looked", "Placed", "Separations", "Shapes", "packed", "thinned"]

THIN = 1e-3  # [m] largest distance of omitted vertices from the hull of the others
_SMALL_HULL = 12  # vertices; hulls with no more keep them all
_BLOCK = 8  # vertices that the C code handles at once
_SIDE = 33  # numbers of the C code's struct Side


@dataclass(frozen=True, eq=False)
class Placed:
    """Placements at K instants of joints (K, J, 12) and bodies of the world (K, W, 12), and a mask (K, W).

    A placement is a rotation by rows and a translation [m]. The mask is of the bodies of the world that are
    present.
    """

    joints: Array
    world: Array
    present: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Looked:
    """Distances `gaps` (K, P) [m] of P pairs at K instants; instants (m,) and pairs (m,) of the near ones.

    For pairs that are not near, the gaps are lower bounds.
    """

    gaps: Array
    spot: Index
    pair: Index

    @property
    def gap(self) -> Array:
        """Distances of the near pairs (m,) [m]."""
        return np.asarray(self.gaps[self.spot, self.pair])


class Shapes:
    """Pairs of convex pieces in a scene that must not touch.

    Attributes
    ----------
    pairs (P, 2) : joint of the first; joint of the second, or -1 - the index of a body of the world.
    number (P,) : index of the pair of pieces among those of the same two bodies.
    between (P,) : number of joints between the two.
    radius (P,) [m] : of the second if it is a capsule or a sphere, else zero.
    points (k, 3) [m], blocks (k / 8, 3, 8) : all vertices, see `packed`.
    hulls (P, 4) : first vertex and number of vertices of both.
    of (B,), balls (B, 4) : joint of each piece of a link, and its bounding ball in the joint's frame: centre
        and radius [m].
    boxes (W, 4) : half sides of the bodies of the world, and their radius [m]. They have no balls: those of
        large ones, such as walls, would be huge.
    pieces (P, 2) : index of both pieces in ``of``; for a body of the world zero.
    """

    def __init__(
        self,
        links: RobotBodies,
        world: Sequence[WorldBody],
        pairs_of_links: Mapping[Pair, Sequence[tuple[Any, Any]]],
        pairs_with_world: Iterable[Pair],
    ) -> None:
        """pairs_of_links : pairs of pieces by joints.  pairs_with_world : joint, index of a world body."""
        # A capsule or sphere is its axis or point, and its radius is subtracted from the distance.
        corners = [_corners(body.half) for body in world]
        own = {id(piece): _thinned_piece(piece) for piece in links.pieces}
        joint_of = {id(piece): j for j, pieces in links.of_joint.items() for piece in pieces}
        self.of = np.array([joint_of[id(piece)] for piece in links.pieces], dtype=np.int64)
        balls = [np.append(*bounding_ball(piece.vertices)) for piece in links.pieces]
        self.balls = np.array(balls, dtype=float).reshape(-1, 4)
        self.boxes = np.array([(*body.half, body.radius) for body in world], dtype=float).reshape(-1, 4)
        self.points, self.blocks, ranges = packed([*own.values(), *corners])
        keys: list[Any] = [*own, *(("world", w) for w in range(len(corners)))]
        where = dict(zip(keys, ranges, strict=True))
        # work memory of the C code
        self.room = np.zeros(len(self.points) + 4 * len(self.of) + links.model.njoints + 1)
        piece_index = {id(piece): k for k, piece in enumerate(links.pieces)}
        pairs, number, hulls, pieces_of, radius = [], [], [], [], []
        for (a, b), pieces in pairs_of_links.items():
            for k, (one, two) in enumerate(pieces):
                pairs.append((a, b))
                number.append(k)
                hulls.append((*where[id(one)], *where[id(two)]))
                pieces_of.append((piece_index[id(one)], piece_index[id(two)]))
                radius.append(0.0)
        for j, w in pairs_with_world:
            body = world[w]
            for k, one in enumerate(links.of_joint[j]):
                pairs.append((j, -1 - w))
                number.append(k)
                hulls.append((*where[id(one)], *where["world", w]))
                pieces_of.append((piece_index[id(one)], 0))
                radius.append(body.radius)
        self.pairs = np.array(pairs, dtype=np.int64).reshape(-1, 2)
        self.number = np.array(number, dtype=np.int64)
        self.hulls = np.array(hulls, dtype=np.int64).reshape(-1, 4)
        self.radius = np.array(radius, dtype=float)
        self.pieces = np.array(pieces_of, dtype=np.int64).reshape(-1, 2)
        everything = links.model.njoints  # a body of the world is no neighbour
        self.between = np.array([links.joints_between(a, b) if b >= 0 else everything for a, b in pairs])
        self.index = {(a, b, k): n for n, ((a, b), k) in enumerate(zip(pairs, number, strict=True))}

    def __len__(self) -> int:
        return len(self.pairs)

    def look(
        self,
        at: Placed,
        within: float | Array,
        directions: Array,
        wanted: Mask,
        before: tuple[Placed, Looked] | None = None,
    ) -> Looked:
        """Distances of the pairs ``wanted`` (P,); those above ``within`` [m] may be lower bounds.

        within : a number, or one for each instant and pair (K, P).
        directions (K, P, 3) : initial guesses of separating directions, zero if unknown; those found are
            written to it.
        before : distances at other placements, which bound those here by how far both bodies have moved.
        """
        (k, j), w, p = at.joints.shape[:2], at.world.shape[1], len(self)
        gaps, near = np.empty((k, p)), np.empty((k * p, 2), dtype=np.int64)
        within = np.ascontiguousarray(np.broadcast_to(within, gaps.shape), dtype=float)
        # `near` has room for all pairs at all instants; the C code returns how many it has written.
        chosen, library = wanted.astype(np.uint8), _library()
        if library is None:
            found = separation_numpy.look(self, at, within, directions, wanted, gaps, before)
            return Looked(gaps, *found)
        counts = (ctypes.c_int64(n) for n in (k, j, w, p, len(self.of)))
        bodies = (self.of, self.balls, self.boxes, self.pairs, self.pieces, self.hulls, self.radius)
        known = (None,) * 3 if before is None else (before[0].joints, before[0].world, before[1].gaps)
        n = library.look(
            *counts,
            *map(address, (at.joints, at.world, *bodies, at.present, chosen, self.blocks)),
            ctypes.c_double(1 / ROUNDING),
            address(within),
            *(None if array is None else address(array) for array in known),
            *map(address, (directions, gaps, self.room)),
            ctypes.c_int64(len(near)),
            address(near),
        )
        return Looked(gaps, near[:n, 0].copy(), near[:n, 1].copy())


class Separations:
    """Distances of pairs at the ends of chains of n joints, minus their reach, with derivatives.

    z (count, n + 3) : shift of the second body's frame [m], joint positions [rad, m].
    """

    def __init__(self, shapes: Shapes, joints: int, pairs: Index, numbers: Array, directions: Array) -> None:
        """pairs (count,) : indices of pairs.  directions (count, 3) : separating directions, initial guesses.

        numbers (count, 13 n + 13) : n + 1 placements, flags of the revolute joints, and the reach [m].
        """
        self._shapes, self._pairs, self.joints, self.count = shapes, pairs, joints, len(pairs)
        self.numbers = np.ascontiguousarray(numbers)
        self.directions = np.ascontiguousarray(directions, dtype=float)
        self._hulls = np.ascontiguousarray(shapes.hulls[pairs])
        self._known, self._room = np.zeros((self.count, _SIDE)), shapes.room
        self.forget()

    def copy(self) -> Separations:
        """Copy with separate numbers and directions."""
        numbers, directions = self.numbers.copy(), self.directions.copy()
        return Separations(self._shapes, self.joints, self._pairs, numbers, directions)

    def forget(self) -> None:
        """Clears the last results, as ``numbers`` have changed."""
        # z at the last Hessians, and the derivatives of the directions by z; zeros foresee no change.
        self._turn = np.zeros((self.count, 4 * (self.joints + 3)))
        # nan equals no z, so everything is computed anew.
        self._seen = np.full((self.count, self.joints + 3), np.nan)
        # once, as a solve calls `write` ten thousand times
        self._chains = [*map(address, (self.numbers, self._hulls, self._shapes.blocks))]
        kept = (self.directions, self._known, self._seen, self._turn, self._room)
        self._kept = [*map(address, kept)]

    def write(self, what: int, z: Array, out: Array, factors: Array | None = None) -> None:
        """Writes to ``out`` values (what = 0), gradients (1), or Hessians times ``factors`` (2).

        Of Hessians, the lower triangles are written column by column. Derivatives are evaluated at iterates
        and keep the directions found there as initial guesses; values are of any trial point, and do not.
        """
        z, library = np.ascontiguousarray(z), _library()
        if library is None:
            separation_numpy.write(self, self._shapes.points, self._hulls, what, z, out, factors)
            return
        by = np.zeros(self.count) if factors is None else np.ascontiguousarray(factors)
        library.separation(
            ctypes.c_int64(self.count),
            ctypes.c_int64(self.joints),
            address(z),
            *self._chains,
            ctypes.c_double(1 / ROUNDING),
            *self._kept,
            ctypes.c_int64(what),
            *map(address, (by, out)),
        )


def packed(hulls: Sequence[Array]) -> tuple[Array, Array, list[tuple[int, int]]]:
    """Vertices of all hulls, in two layouts; first vertex and number of vertices of each hull.

    The first array is (k, 3), where copies of its last vertex fill each hull up to a multiple of eight. The
    second has blocks of eight vertices with their x, y and z side by side (k / 8, 3, 8), for SIMD.
    """
    parts, where, size = [np.zeros((0, 3))], list[tuple[int, int]](), 0
    for hull in hulls:
        vertices = hull[_clustered(hull)]
        where.append((size, len(vertices)))
        more = -len(vertices) % _BLOCK
        parts += [vertices, np.repeat(vertices[-1:], more, axis=0)]
        size += len(vertices) + more
    points = np.concatenate(parts)
    return points, np.ascontiguousarray(points.reshape(-1, _BLOCK, 3).transpose(0, 2, 1)), where


def _clustered(vertices: Array) -> Index:
    """Order (k,) of vertices (k, 3) in which each eight are close together.

    In any direction most of these blocks are then far below the highest vertex, and need no exponentials.
    """
    order, parts = np.arange(len(vertices)), [slice(0, len(vertices))]
    while parts:
        own = parts.pop()
        blocks = -(-(own.stop - own.start) // _BLOCK)
        if blocks < 2:
            continue
        points, middle = vertices[order[own]], own.start + blocks // 2 * _BLOCK
        longest = int(np.ptp(points, axis=0).argmax())
        # Split at the median along the longest side, as in a k-d tree, at a multiple of the block.
        order[own] = order[own][np.argsort(points[:, longest], kind="stable")]
        parts += [slice(own.start, middle), slice(middle, own.stop)]
    return order


_THINNED: weakref.WeakKeyDictionary[Piece, Array] = weakref.WeakKeyDictionary()


def _thinned_piece(piece: Piece) -> Array:
    """`thinned` vertices of a piece, cached, as the scenes with one robot share its pieces."""
    if piece not in _THINNED:
        _THINNED[piece] = thinned(piece.vertices)
    return _THINNED[piece]


def thinned(vertices: Array) -> Array:
    """Subset of a hull's vertices (k, 3) [m] such that the others are outside its hull by `THIN` at most.

    It is built greedily: the vertex farthest outside is added next. The result is cached on disk.
    """
    if len(vertices) <= _SMALL_HULL:
        return vertices
    # "2" is the version of the algorithm; rounding makes the key independent of the last digits.
    digest = hashlib.sha256(f"2 {THIN}".encode() + np.round(vertices, 9).tobytes()).hexdigest()
    return vertices[cached_arrays("thin", digest, lambda: {"chosen": _chosen(vertices)})["chosen"]]


def _chosen(vertices: Array) -> Index:
    """Indices of `thinned` vertices; the first are the extreme ones in 26 directions of a grid."""
    grid = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3)
    first = (grid[np.any(grid != 0, axis=1)] @ vertices.T).argmax(axis=1)
    chosen = sorted(set(first.tolist()))
    while len(chosen) < len(vertices):
        try:
            planes = ConvexHull(vertices[chosen]).equations
        except QhullError:  # the first vertices are in a plane
            return np.arange(len(vertices))
        # Signed distance to the farthest facet's plane, which is at most the distance to the hull: beyond a
        # sharp edge an omitted vertex may be farther out than THIN (one of TALOS's hulls, by 2 %).
        out = (vertices @ planes[:, :3].T + planes[:, 3]).max(axis=1)
        k = int(out.argmax())
        if out[k] <= THIN:
            break
        chosen.append(k)
    return np.array(chosen, dtype=np.int64)


def _corners(half: Array) -> Array:
    """Distinct corners of a box with half sides (3,), some of which may be zero."""
    # Zero half sides make corners coincide, and copies would count twice in the smoothed support function.
    return np.unique(half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]), axis=0)


@functools.cache
def _library() -> Any:
    library = native_library("impactopt.bodies", "separation")
    if library is not None:
        library.look.restype = ctypes.c_int64
        library.separation.restype = None
    return library
