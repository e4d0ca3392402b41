"""Constraints between bodies: the rounded distance of two convex pieces, written down a second time.

The largest separation over unit vectors u is where its slope is a multiple of u. Here that is one Newton
iteration on u and the multiplier together, for all pairs of a place at once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import KeepOut, SelfCollision
from oracle.robot_motion import RobotMotion
from oracle.variables import Piece, Variables

Array = NDArray[np.float64]
ROUND = 1e-3  # [m] of supports
LONGEST, STEPS, DONE = 0.3, 60, 1e-11  # of u a step, and how many; [m] of slope across u that is none


def apart_pieces(
    problem: ImpactProblem,
    robot: RobotMotion,
    postures: Mapping[str, Callable[[Variables], Array]],
    moved: Mapping[str, Callable[[Variables], Array]],
    rows: Sequence[Mapping[str, Any]],
) -> tuple[list[Piece], list[str]]:
    """The constraints that a result says it had, in its order; and what is not known of them.

    postures (nq,), moved (3,) [m] : configuration, and displacement of the target, at all nodes, by their
    places.  rows : place, joint, other and number, vector and least_distance [m], as
    `impactopt.transcription.clearance` has them.
    """
    known: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        known.setdefault(str(row["place"]), []).append(row)
    missing = [f"rows between bodies at {place!r}" for place in known if place not in postures]
    pieces = [
        _piece(problem, robot, place, postures[place], moved[place], at)
        for place, at in known.items()
        if place in postures
    ]
    return pieces, missing


class _Hulls:
    """Vertices (m, most, 3) of m hulls, and which of them are not there."""

    def __init__(self, vertices: Array, missing: NDArray[np.bool_]) -> None:
        self.vertices, self.missing = vertices, missing

    @classmethod
    def of(cls, points: Array, which: NDArray[np.int64]) -> _Hulls:
        most = int(which[:, 1].max())
        vertices = points[which[:, :1] + np.minimum(np.arange(most), which[:, 1:] - 1)]
        return cls(vertices, np.arange(most) >= which[:, 1:])

    def __getitem__(self, which: NDArray[np.bool_]) -> _Hulls:
        return _Hulls(self.vertices[which], self.missing[which])

    def support(self, u: Array) -> tuple[Array, Array, Array]:
        """Rounded supports (m,), their gradients (m, 3) and second derivatives (m, 3, 3) in directions."""
        height = (self.vertices @ u[:, :, None])[:, :, 0] / ROUND
        height[self.missing] = -np.inf
        most = height.max(axis=1, keepdims=True)
        weight = np.exp(height - most)
        total = weight.sum(axis=1, keepdims=True)
        weight /= total
        mean = (weight[:, None] @ self.vertices)[:, 0]
        square = (weight[:, :, None] * self.vertices).transpose(0, 2, 1) @ self.vertices  # not einsum: slow
        second = (square - mean[:, :, None] * mean[:, None]) / ROUND
        return ROUND * (most + np.log(total))[:, 0], mean, second


def _distances(one: _Hulls, two: _Hulls, turn: Array, shift: Array, u: Array) -> tuple[Array, Array]:
    """Of pairs whose first is so turned (m, 3, 3) and shifted (m, 3) as the second sees it; directions."""

    def separation(u: Array) -> tuple[Array, Array, Array]:
        a, b = one.support(-np.einsum("mji,mj->mi", turn, u)), two.support(u)
        slope = np.einsum("mij,mj->mi", turn, a[1]) + shift - b[1]
        second = -turn @ a[2] @ turn.transpose(0, 2, 1) - b[2]
        return (u * shift).sum(axis=1) - a[0] - b[0], slope, second

    value, slope, second = separation(u)
    for _ in range(STEPS):
        along = (u * slope).sum(axis=1)
        across = slope - along[:, None] * u
        if np.abs(across).max() < DONE:
            break
        kkt = np.zeros((len(u), 4, 4))
        # where it curves the wrong way, as bodies are in each other, less of a step
        bent = np.linalg.eigvalsh(second - along[:, None, None] * np.eye(3))[:, -1]
        kkt[:, :3, :3] = second - (along + np.maximum(bent, 0.0))[:, None, None] * np.eye(3)
        kkt[:, :3, 3] = kkt[:, 3, :3] = u
        given = np.concatenate([-across, np.zeros((len(u), 1))], axis=1)
        step = np.linalg.solve(kkt, given[:, :, None])[:, :3, 0]
        size = np.linalg.norm(step, axis=1)
        part = np.minimum(1.0, LONGEST / np.maximum(size, 1e-12))
        for _ in range(30):
            new = u + part[:, None] * step
            new /= np.linalg.norm(new, axis=1, keepdims=True)
            found = separation(new)
            worse = (found[0] < value) & (size > 1e-6)
            if not worse.any():
                break
            part[worse] *= 0.5
        u, (value, slope, second) = new, found
    return value, u


def _piece(
    problem: ImpactProblem,
    robot: RobotMotion,
    place: str,
    posture: Callable[[Variables], Array],
    moved: Callable[[Variables], Array],
    at: Sequence[Mapping[str, Any]],
) -> Piece:
    """All constraints at a place."""
    bodies, shapes = problem.bodies, problem.bodies.shapes
    flat = [(int(row["joint"]), int(row["other"]), row) for row in at]
    numbers = [shapes.index[joint, other, int(row["number"])] for joint, other, row in flat]
    one, two = (
        _Hulls.of(shapes.points, shapes.hulls[numbers, :2]),
        _Hulls.of(shapes.points, shapes.hulls[numbers, 2:]),
    )
    reach = np.array([row["least_distance"] for _, _, row in flat], dtype=float) + shapes.radius[numbers]
    ways = np.array([row["vector"] for _, _, row in flat], dtype=float)
    # frames: those of joints, and behind them one for each row whose other body is the world's
    joints = sorted({joint for joint, _, _ in flat} | {other for _, other, _ in flat if other >= 0})
    index = {joint: k for k, joint in enumerate(joints)}
    turns, shifts, moves = list[Array](), list[Array](), list[bool]()
    # of the first variables: the second body's view of the first (`_distances`), distances and directions
    kept = list[Array]()
    first, second = list[int](), list[int]()
    for joint, other, _ in flat:
        first.append(index[joint])
        if other >= 0:
            second.append(index[other])
            continue
        body = bodies.world[-1 - other]
        second.append(len(joints) + len(turns))
        turns.append(np.asarray(body.rotation))
        shifts.append(body.place)
        moves.append(body.moves)

    def value(v: Variables) -> Array:
        pin.forwardKinematics(robot.model, robot.data, posture(v))
        placed = [robot.data.oMi[joint] for joint in joints]
        turn = np.array([*(at.rotation for at in placed), *turns])
        world = [place + moved(v) * k for place, k in zip(shifts, moves, strict=True)]
        shift = np.array([*(at.translation for at in placed), *world])
        back = turn[second].transpose(0, 2, 1)
        apart = np.einsum("kij,kj->ki", back, shift[first] - shift[second])
        turned = back @ turn[first]
        if not kept:
            kept.extend((turned, apart, *_distances(one, two, turned, apart, ways)))
        # one joint moves some pairs: a difference computes the others once
        new = (turned != kept[0]).any(axis=(1, 2)) | (apart != kept[1]).any(axis=1)
        found, start = kept[2].copy(), kept[3]
        if new.any():
            found[new], _ = _distances(one[new], two[new], turned[new], apart[new], start[new])
        return found - reach

    rows = [
        (
            (SelfCollision if other >= 0 else KeepOut).name,
            place,
            [_named(bodies.names((joint, other)), int(row["number"]))],
            0.0,
            np.inf,
        )
        for joint, other, row in flat
    ]
    return Piece.of(value, rows)


def _named(names: tuple[str, str], number: int) -> str:
    """What a constraint between two bodies is called; those of further pieces by their number, from 2."""
    return " and ".join(names) + (f" {number + 1}" if number else "")
