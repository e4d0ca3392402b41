"""NumPy version of separation.c, for machines without a compiler: same results, 100 times slower."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from impactopt.arrays import Array, Index, Mask

ROUNDING = 1e-3  # [m] e of the smoothed support functions, see separation.py
_SHARP = 1 / ROUNDING
_MIN_CURVATURE = 1e-4  # of a separation along the tangents of its direction, in Newton steps and Hessians
_MAX_STEP, _MAX_STEPS, _MAX_TRIES = 0.5, 100, 30  # [rad]; of Newton's method, and of a line search


class _Support(NamedTuple):
    """Smoothed support functions of m bodies in directions u, with their weights exp(a_i . u / e) normalized.

    height (m,) : values.  mean (m, 3), spread (m, 3, 3) : weighted mean, the gradient, and covariance of
        vertices.
    """

    height: Array
    mean: Array
    spread: Array


class _Side(NamedTuple):
    """Separations of m pairs in directions u from the second to the first, in the second's frame.

    separation (m,).  slope (m, 3) : gradient by u.  point (m, 3) : support point of the first.
    spread_one (m, 3, 3) : covariance of the first.  tangents (m, 2, 3) : unit vectors at right angles to u.
    neg_hessian (m, 2, 2) : minus the Hessian by u on the tangents.
    """

    separation: Array
    slope: Array
    point: Array
    spread_one: Array
    tangents: Array
    neg_hessian: Array


def _gathered(points: Array, hulls: Index) -> tuple[Array, Mask]:
    """Vertices (m, most, 3) of hulls (m, 2), padded with copies, and a mask of those that are no copies."""
    most = int(hulls[:, 1].max(initial=1))
    at = hulls[:, :1] + np.minimum(np.arange(most), hulls[:, 1:] - 1)
    return points[at], np.arange(most) < hulls[:, 1:]


def _support(vertices: Array, real: Mask, u: Array) -> _Support:
    sharp = _SHARP
    # Padding has weight exp(-inf) = 0.
    height = np.where(real, np.einsum("mki,mi->mk", vertices, u), -np.inf)
    most = height.max(axis=1)
    # exponents relative to the largest, against overflow
    weight = np.exp(sharp * (height - most[:, None]))
    total = weight.sum(axis=1)
    weight /= total[:, None]
    mean = np.einsum("mk,mki->mi", weight, vertices)
    off = vertices - mean[:, None]
    return _Support(most + np.log(total) / sharp, mean, np.einsum("mk,mki,mkj->mij", weight, off, off))


class _Pairs:
    """m pairs of bodies; rotation (m, 3, 3) and translation (m, 3) of the first relative to the second."""

    def __init__(self, points: Array, hulls: Index, rotation: Array, translation: Array) -> None:
        self.one, self.two = _gathered(points, hulls[:, :2]), _gathered(points, hulls[:, 2:])
        self.rotation, self.translation = rotation, translation

    def only(self, chosen: Mask) -> _Pairs:
        out = object.__new__(_Pairs)
        out.one = self.one[0][chosen], self.one[1][chosen]
        out.two = self.two[0][chosen], self.two[1][chosen]
        out.rotation, out.translation = self.rotation[chosen], self.translation[chosen]
        return out

    def side(self, u: Array) -> _Side:
        """Separations in directions u (m, 3)."""
        turn = self.rotation
        # h_A(-u) of the moved body: u turned back into its own frame.
        a = _support(*self.one, -np.einsum("mji,mj->mi", turn, u))
        b = _support(*self.two, u)
        point = np.einsum("mij,mj->mi", turn, a.mean) + self.translation
        one = turn @ a.spread @ turn.transpose(0, 2, 1)
        away = np.eye(3)[np.abs(u).argmin(axis=1)]  # the axis that is least parallel to u
        x = np.cross(u, away)
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        tangents = np.stack([x, np.cross(u, x)], axis=1)
        # Gradient of u . t - h_A(-u) - h_B(u): the vector between the two support points.
        slope = point - b.mean
        along = np.einsum("mi,mi->m", u, slope)
        # Covariances over e are the Hessians of the smoothed support functions. On the sphere the gradient's
        # own component along u is added to the curvature.
        neg_hessian = _SHARP * tangents @ (one + b.spread) @ tangents.transpose(0, 2, 1)
        neg_hessian += along[:, None, None] * np.eye(2)
        separation = np.einsum("mi,mi->m", u, self.translation) - a.height - b.height
        return _Side(separation, slope, point, one, tangents, neg_hessian)

    def separate(self, u: Array) -> tuple[Array, _Side]:
        """Local maxima of the separation near directions u (m, 3), and their directions.

        Newton's method on the unit sphere with line search, for all pairs at once.
        """
        u, at = u.copy(), self.side(u)
        going = np.ones(len(u), dtype=bool)
        for _ in range(_MAX_STEPS):
            step2, gain = self._step(at)
            size = np.linalg.norm(step2, axis=1)
            # stationary but no maximum, as may be if bodies penetrate: leave the saddle where it curves up
            curved, axes = np.linalg.eigh(at.neg_hessian)
            saddle = going & (size < 1e-9) & (curved[:, 0] < -1e-9)
            up = axes[saddle, :, 0]
            slope2 = np.einsum("mki,mi->mk", at.tangents[saddle], at.slope[saddle])
            step2[saddle] = 0.1 * up * np.where((up * slope2).sum(axis=1) < 0, -1.0, 1.0)[:, None]
            # 0.1 rad along the direction of positive curvature, on the side that the slope favours.
            size[saddle], gain[saddle] = 0.1, 0.0
            going &= size >= 1e-11
            if not going.any():
                break
            # A tangent step is a rotation only while it is small against a radian.
            part = np.minimum(1.0, _MAX_STEP / np.maximum(size, 1e-300))
            waiting = going.copy()  # pairs whose step has not been accepted
            for _ in range(_MAX_TRIES):
                n = np.flatnonzero(waiting)
                if not len(n):
                    break
                found_u = u[n] + part[n, None] * np.einsum("mki,mk->mi", at.tangents[n], step2[n])
                found_u /= np.linalg.norm(found_u, axis=1, keepdims=True)
                found = self.only(_mask(n, len(u))).side(found_u)
                # Armijo's condition; steps below 1e-5 rad are accepted without it
                accepted = (found.separation >= at.separation[n] + 1e-4 * part[n] * gain[n]) | (
                    size[n] < 1e-5
                )
                u[n[accepted]] = found_u[accepted]
                for old, new in zip(at, found, strict=True):
                    old[n[accepted]] = new[accepted]
                waiting[n[accepted]] = False
                part[n[~accepted]] *= 0.4
            low = np.linalg.eigvalsh(at.neg_hessian)[:, 0]
            # Quadratic convergence: after a step of 1e-7 rad the next one would be rounding.
            going &= ~waiting & ((part * size >= 1e-7) | (low < -1e-9))
        return u, at

    @staticmethod
    def _step(at: _Side) -> tuple[Array, Array]:
        """Newton steps on the tangents (m, 2), and the first-order gain of each (m,)."""
        slope2 = np.einsum("mki,mi->mk", at.tangents, at.slope)
        step2 = np.einsum("mkl,ml->mk", _inverse(at.neg_hessian), slope2)
        return step2, np.einsum("mk,mk->m", step2, slope2)


def _mask(numbers: Index, size: int) -> Mask:
    out = np.zeros(size, dtype=bool)
    out[numbers] = True
    return out


def _inverse(neg_hessian: Array) -> Array:
    """Inverse of ``neg_hessian`` (m, 2, 2), shifted to be positive definite."""
    least = np.linalg.eigvalsh(neg_hessian)[:, 0]
    return np.linalg.inv(neg_hessian + np.maximum(_MIN_CURVATURE - least, 0.0)[:, None, None] * np.eye(2))


# ---------------------------------------------------------------- chains
def _chain(n: int, z: Array, numbers: Array) -> tuple[Array, Array, Array, Array, Mask]:
    """Forward kinematics of chains of n joints, with z and numbers as of `Separations`.

    Returns rotation (m, 3, 3) and translation (m, 3) of the end, axes and origins (m, n, 3) of the joints,
    and a mask of the revolute ones (m, n).
    """
    m = len(z)
    places = numbers[:, : 12 * (n + 1)].reshape(m, n + 1, 12)
    # Layout of `numbers` (13 n + 13): n + 1 placements of 12, n flags, the reach.
    turns = numbers[:, 12 * (n + 1) : 13 * n + 12] > 0.5
    turn, shift = places[:, 0, :9].reshape(m, 3, 3).copy(), places[:, 0, 9:] + z[:, :3]
    axis, origin = np.zeros((m, n, 3)), np.zeros((m, n, 3))
    for k in range(n):
        # Joints turn about, or slide along, z of their frame.
        axis[:, k], origin[:, k] = turn[:, :, 2], shift
        angle, along = np.where(turns[:, k], z[:, 3 + k], 0.0), np.where(turns[:, k], 0.0, z[:, 3 + k])
        c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
        shift = shift + along[:, None] * turn[:, :, 2]
        turn = np.stack(
            [c * turn[:, :, 0] + s * turn[:, :, 1], c * turn[:, :, 1] - s * turn[:, :, 0], turn[:, :, 2]],
            axis=2,
        )
        shift = shift + np.einsum("mij,mj->mi", turn, places[:, k + 1, 9:])
        turn = turn @ places[:, k + 1, :9].reshape(m, 3, 3)
    return turn, shift, axis, origin, turns


def write(
    of: Any, points: Array, hulls: Index, what: int, z: Array, out: Array, factors: Array | None
) -> None:
    """NumPy version of `Separations.write`."""
    n = of.joints
    turn, shift, axis, origin, turns = _chain(n, z, of.numbers)
    u, at = _Pairs(points, hulls, turn, shift).separate(of.directions)
    if what:
        of.directions[...] = u
    if what == 0:
        out[...] = (at.separation - of.numbers[:, -1]).reshape(out.shape)
        return
    # velocity of the first body's support point with each joint (m, n, 3)
    arm = np.where(turns[:, :, None], np.cross(axis, at.point[:, None] - origin), axis)
    if what == 1:
        out[...] = np.concatenate([u, np.einsum("mi,mki->mk", u, arm)], axis=1).reshape(out.shape)
        return
    # Hessian s_qq - s_qu (s_uu)^-1 s_uq, see separation.py: `own` is s_qq by joints, `mixed` is s_qu on the
    # tangents
    # u x axis: how the direction u moves, seen from the first body, when the joint turns.
    turning = np.where(turns[:, :, None], np.cross(u[:, None], axis), 0.0)
    spread = np.einsum("mij,mkj->mki", at.spread_one, turning)
    moved = np.concatenate([np.broadcast_to(np.eye(3), (len(z), 3, 3)), arm - _SHARP * spread], axis=1)
    mixed = np.einsum("mki,mli->mkl", moved, at.tangents)
    found = mixed @ _inverse(at.neg_hessian) @ mixed.transpose(0, 2, 1)
    own = np.einsum("mki,mli->mkl", turning, arm) - _SHARP * np.einsum("mki,mli->mkl", turning, spread)
    columns, rows = np.triu_indices(n + 3)  # lower triangle, column by column
    # The first three of z shift the body without turning it: the support functions do not change with them.
    inner = columns >= 3
    values = found[:, rows, columns]
    values[:, inner] += own[:, columns[inner] - 3, rows[inner] - 3]
    assert factors is not None
    out[...] = (values * factors.reshape(-1, 1)).reshape(out.shape)


# ---------------------------------------------------------------- all pairs
def _relative(one: Array, two: Array) -> tuple[Array, Array]:
    """Rotations (m, 3, 3) and translations (m, 3) of placements (m, 12) relative to others (m, 12)."""
    a, b = (x[:, :9].reshape(-1, 3, 3) for x in (one, two))
    return b.transpose(0, 2, 1) @ a, np.einsum("mji,mj->mi", b, one[:, 9:] - two[:, 9:])


def _of_pairs(shapes: Any, at: Any, spot: Index, pair: Index) -> tuple[Array, Array]:
    """Placements of the first body relative to the second, of pairs (m,) at instants (m,)."""
    one, other = shapes.pairs[pair].T
    first = at.joints[spot, one]
    second = at.joints[spot, np.maximum(other, 0)].copy()
    world = other < 0
    second[world] = at.world[spot[world], -1 - other[world]]
    return _relative(first, second)


def look(
    shapes: Any,
    at: Any,
    within: Array,
    directions: Array,
    wanted: Mask,
    gaps: Array,
    before: tuple[Any, Any] | None,
) -> tuple[Index, Index]:
    """NumPy version of `Shapes.look`: writes gaps and directions, returns the near pairs."""
    spot, pair = (a.ravel() for a in np.indices(gaps.shape))
    other = shapes.pairs[pair, 1]
    present = wanted[pair] & (
        (other >= 0) | (at.present[spot, np.maximum(-1 - other, 0)] > 0 if at.present.size else True)
    )
    gaps[...] = 1e3  # [m] of pairs that are not wanted or not present
    spot, pair = spot[present], pair[present]
    turn, shift = _of_pairs(shapes, at, spot, pair)
    # lower bounds: distance of the first's bounding ball from that of the second, or from a box of the world
    one, second = shapes.pieces[pair].T
    other, ball = shapes.pairs[pair, 1], shapes.balls[one]
    world = other < 0
    two = shapes.balls[second]  # centre or half sides, and the radius that is subtracted
    two[world] = shapes.boxes[-1 - other[world]]
    x = np.einsum("mij,mj->mi", turn, ball[:, :3]) + shift - np.where(world[:, None], 0.0, two[:, :3])
    out = np.abs(x) - two[:, :3]
    outside, deepest = np.maximum(out, 0.0), out.max(axis=1)
    box = np.where(deepest > 0, np.linalg.norm(outside, axis=1), deepest)
    bound = np.where(world, box, np.linalg.norm(x, axis=1)) - ball[:, 3] - two[:, 3]
    # initial direction: between the centres; from a box, its nearest corner's, edge's or face's
    face = np.where(outside.any(axis=1)[:, None], outside, np.eye(3)[out.argmax(axis=1)]) * np.where(
        x > 0, 1.0, -1.0
    )
    u = np.where(world[:, None], face, x)
    u /= np.maximum(np.linalg.norm(u, axis=1, keepdims=True), 1e-300)
    if before is not None:
        places, known_gaps = before[0], before[1].gaps
        bound = np.maximum(bound, known_gaps[spot, pair] - _ways(shapes, places, at, spot, pair))
    gaps[spot, pair] = bound
    close = bound <= within[spot, pair]
    spot, pair, turn, shift, u = spot[close], pair[close], turn[close], shift[close], u[close]
    known = directions[spot, pair]
    u = np.where(np.any(known != 0, axis=1)[:, None], known, u)
    if len(u):
        u, found = _Pairs(shapes.points, shapes.hulls[pair], turn, shift).separate(u)
        gaps[spot, pair] = found.separation - shapes.radius[pair]
        directions[spot, pair] = u
    near = gaps[spot, pair] < within[spot, pair]
    return spot[near], pair[near]


def _ways(shapes: Any, one: Any, two: Any, spot: Index, pair: Index) -> Array:
    """Upper bounds (m,) [m] of how far pairs have approached each other between two placements.

    They are the ways of both bodies, or that of the first relative to the second if it is less.
    """
    first, second = shapes.pieces[pair].T
    moved = _moved(one.joints, two.joints, shapes.of, shapes.balls)
    of_second, other = moved[spot, second], shapes.pairs[pair, 1]
    world = other < 0  # bodies of the world do not turn
    at = spot[world], -1 - other[world]
    of_second[world] = np.linalg.norm((two.world[at] - one.world[at])[:, 9:], axis=1)
    (turn0, shift0), (turn1, shift1) = (_of_pairs(shapes, p, spot, pair) for p in (one, two))
    balls = shapes.balls[first]
    way = np.einsum("mij,mj->mi", turn1 - turn0, balls[:, :3]) + shift1 - shift0
    relative = np.linalg.norm(way, axis=1) + _angle(turn0, turn1) * balls[:, 3]
    return np.minimum(moved[spot, first] + of_second, relative)


def _moved(before: Array, after: Array, of: Index, balls: Array) -> Array:
    """Largest way (K, B) [m] of any point of the pieces' balls between placements of joints (K, J, 12)."""
    turn0, turn1 = (x[:, of, :9].reshape(len(x), -1, 3, 3) for x in (before, after))
    way = np.einsum("kbij,bj->kbi", turn1 - turn0, balls[:, :3]) + (after - before)[:, of, 9:]
    return np.asarray(np.linalg.norm(way, axis=2) + _angle(turn0, turn1) * balls[:, 3])


def _angle(one: Array, two: Array) -> Array:
    """Angles [rad] between rotations (..., 3, 3): trace(R0' R1) = 1 + 2 cos."""
    cosine = (np.einsum("...ij,...ij->...", one, two) - 1) / 2
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)))
