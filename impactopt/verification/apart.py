"""Rows between bodies: a sphere of a link is out of planes about another body."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import KeepOut, SelfCollision
from impactopt.verification.robot_motion import RobotMotion
from impactopt.verification.variables import Piece, Variables

__all__ = ["apart_pieces"]

Array = NDArray[np.float64]
ROUND = 4e-3  # [m] over which planes about a body are rounded into each other


def apart_pieces(
    problem: ImpactProblem,
    robot: RobotMotion,
    nodes: Mapping[str, Callable[[Variables], Any]],
    rows: Sequence[Mapping[str, Any]],
) -> tuple[list[Piece], list[str]]:
    """The rows that a result says it had, in its order; and what is not known of them.

    nodes : of all motions, by their places.  rows : place, joint and other, centre [m], reach [m], facing and
    travel [m], as `impactopt.transcription.apart` has them.
    """
    known: dict[str, dict[tuple[int, int], list[Mapping[str, Any]]]] = {}
    for row in rows:
        at = known.setdefault(str(row["place"]), {})
        at.setdefault((int(row["joint"]), int(row["other"])), []).append(row)
    missing = [f"rows between bodies at {place!r}" for place in known if place not in nodes]
    pieces = [
        _piece(problem, robot, place, nodes[place], at) for place, at in known.items() if place in nodes
    ]
    return pieces, missing


def _piece(
    problem: ImpactProblem,
    robot: RobotMotion,
    place: str,
    node: Callable[[Variables], Any],
    of_pair: Mapping[tuple[int, int], Sequence[Mapping[str, Any]]],
) -> Piece:
    """All rows at a place, pair by pair."""
    bodies = problem.bodies
    flat = [(joint, other, row) for (joint, other), rows in of_pair.items() for row in rows]
    centres = np.array([row["centre"] for _, _, row in flat], dtype=float)
    reach = np.array([row["reach"] for _, _, row in flat], dtype=float)
    facing = [None if row["facing"] is None else tuple(row["facing"]) for _, _, row in flat]
    planes = np.array(
        [bodies.planes(other).with_facing(f) for (_, other, _), f in zip(flat, facing, strict=True)]
    )
    split = 3 * (planes.shape[1] // 4)
    normals, offsets = planes[:, :split].reshape(len(flat), -1, 3), planes[:, split:]
    # frames: those of joints, and behind them one for each row whose other body is the world's
    joints = sorted({joint for joint, _, _ in flat} | {other for _, other, _ in flat if other >= 0})
    index = {joint: k for k, joint in enumerate(joints)}
    turns, shifts = list[Array](), list[Array]()
    one, two = list[int](), list[int]()
    for joint, other, row in flat:
        one.append(index[joint])
        if other >= 0:
            two.append(index[other])
            continue
        body = bodies.world[-1 - other]
        two.append(len(joints) + len(turns))
        turns.append(np.asarray(body.rotation))
        shifts.append(body.place + float(row["travel"]) * bodies.normal * body.moves)

    def value(v: Variables) -> Array:
        y, _, _, legs, _, _ = node(v)
        pin.forwardKinematics(robot.model, robot.data, robot.posture(y, legs))
        placed = [robot.data.oMi[joint] for joint in joints]
        turn = np.array([*(at.rotation for at in placed), *turns])
        shift = np.array([*(at.translation for at in placed), *shifts])
        points = np.einsum("kij,kj->ki", turn[one], centres) + shift[one]
        inside = np.einsum("kji,kj->ki", turn[two], points - shift[two])
        far = np.einsum("kij,kj->ki", normals, inside) - offsets
        while far.shape[1] > 1:  # the largest, rounded in pairs
            a, b = far[:, ::2], far[:, 1::2]
            far = (a + b + np.sqrt((a - b) ** 2 + ROUND**2)) / 2
        return np.asarray(far[:, 0] - reach)

    rows = [
        (
            (SelfCollision if other >= 0 else KeepOut).name,
            place,
            [" and ".join(bodies.names((joint, other)))],
            0.0,
            np.inf,
        )
        for joint, other, _ in flat
    ]
    return Piece.of(value, rows)
