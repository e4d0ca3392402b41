"""The numbers of an animation: solids on the robot's joints, target, soles, and every motion."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.bodies.solids import Solid, box, cylinder, joined, simplified
from impactopt.contact.board import Board
from impactopt.contact.nail import Nail
from impactopt.contact.targets import RigidWall, Target
from impactopt.output import Record
from impactopt.problem import ImpactProblem
from impactopt.report.tracks import AROUND, FAR, Track, tracks_of
from impactopt.report.visuals import Visual, visuals_of
from impactopt.shapes import face_axes

__all__ = ["stage_of"]

Array = NDArray[np.float64]
Arrays = dict[str, NDArray[Any]]
TRIANGLES = 120_000  # at most, of a robot
CELL = 0.004  # [m] that solids are simplified to at least
SMALL = 0.3  # [m] smaller solids have smaller cells, but not below a third
GRID = 65535  # steps of a vertex's coordinate in its solid's bounds
# [m] what is drawn of targets: depth along the normal, width, height
BOX, WALL, BOARD, WOOD = (0.18, 0.18, 0.18), (0.06, 0.5, 0.5), (0.02, 0.24, 0.3), (0.06, 0.2, 0.2)
NAIL = (0.004, 0.07)  # [m] radius, length


def stage_of(record: Record, problem: ImpactProblem) -> tuple[dict[str, Any], Arrays]:
    """Header and arrays, for :func:`impactopt.report.pack.pack`, of the record's motions."""
    arrays: Arrays = {}
    bodies = []
    for k, body in enumerate(_bodies(visuals_of(problem.robot))):
        bodies.append(
            {"joint": body.joint, "colour": body.colour, **_pack_solid(f"body{k}", body.solid, arrays)}
        )
    axes = face_axes(problem.normal)
    target = []
    for k, (solid, moves) in enumerate(target_solids(problem.target)):
        placed = solid.moved(axes.T, problem.point)
        target.append({"moves": moves, **_pack_solid(f"target{k}", placed, arrays)})
    tracks = [_pack_track(f"track{k}", track, arrays) for k, track in enumerate(tracks_of(record, problem))]
    soles = {n: a for n, a in record.arrays.items() if n.startswith("sole_")} | {
        "polygon": record.arrays["polygon"]
    }
    arrays |= {f"ground_{name}": corners for name, corners in soles.items()}
    header = {
        "bodies": bodies,
        "target": target,
        "tracks": tracks,
        "soles": [f"ground_{name}" for name in soles if name != "polygon"],
        "normal": problem.normal,
        "point": problem.point,
        "side": _middle(arrays["track0_places"]),
        "weight": 9.81 * float(sum(i.mass for i in problem.robot.model.inertias)),
        "around": AROUND,
        "far": FAR,
        "legged": len(record.arrays["polygon"]) > 0,
    }
    return header, arrays


def target_solids(target: Target) -> list[tuple[Solid, bool]]:
    """What is drawn of a target, its face at the origin and x along its normal; whether the blow moves it."""

    def slab(sides: tuple[float, float, float], start: float = 0.0) -> Solid:
        return box(sides).moved(np.eye(3), np.array([start + sides[0] / 2, 0.0, 0.0]))

    if isinstance(target, Nail):
        radius, length = NAIL
        along = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # z to x
        shank = cylinder(radius, length).moved(along, np.array([length / 2, 0.0, 0.0]))
        head = cylinder(2.5 * radius, radius).moved(along, np.array([radius / 2, 0.0, 0.0]))
        return [(joined([shank, head]), True), (slab(WOOD, max(length - target.depth, 0.0)), False)]
    if isinstance(target, RigidWall):
        return [(slab(WALL), False)]
    return [(slab(BOARD if isinstance(target, Board) else BOX), True)]


def _middle(places: Array) -> float:
    """y [m] of the robot's middle, from which side it strikes: of its joints, at the start."""
    return float(places[0, 1:, 1].mean())


def _bodies(visuals: list[Visual]) -> list[Visual]:
    """One for each joint and colour, with few enough triangles in all."""
    groups: dict[tuple[int, tuple[float, float, float]], list[Solid]] = {}
    for visual in visuals:
        groups.setdefault((visual.joint, visual.colour), []).append(visual.solid)
    whole = {key: joined(solids) for key, solids in groups.items()}
    if sum(len(solid.triangles) for solid in whole.values()) > TRIANGLES:
        whole = _few(whole)
    return [
        Visual(joint=joint, solid=solid, colour=colour)
        for (joint, colour), solid in whole.items()
        if len(solid.triangles)
    ]


def _few(whole: dict[Any, Solid]) -> dict[Any, Solid]:
    """The same with cells that grow until there are few enough triangles."""
    cell = CELL
    while True:
        few = {key: simplified(solid, cell * _share(solid)) for key, solid in whole.items()}
        count = sum(len(solid.triangles) for solid in few.values())
        if count <= TRIANGLES:
            return few
        cell *= max(1.1, (count / TRIANGLES) ** 0.8)


def _share(solid: Solid) -> float:
    return float(np.clip(np.linalg.norm(np.ptp(solid.vertices, axis=0)) / SMALL, 1 / 3, 1.0))


def _pack_solid(name: str, solid: Solid, arrays: Arrays) -> dict[str, Any]:
    low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
    span = np.maximum(high - low, 1e-9)
    arrays[f"{name}_vertices"] = np.round((solid.vertices - low) / span * GRID).astype("<u2")
    kind = "<u2" if len(solid.vertices) <= GRID else "<u4"
    arrays[f"{name}_triangles"] = solid.triangles.astype(kind)
    return {"name": name, "low": low, "step": span / GRID}


def _pack_track(name: str, track: Track, arrays: Arrays) -> dict[str, Any]:
    given = ("time", "places", "hand", "mass", "force", "travel", "zmp", "ground")
    arrays |= {f"{name}_{part}": getattr(track, part) for part in given}
    return {
        "name": name,
        "label": track.name,
        "contact_start": track.contact_start,
        "contact_end": track.contact_end,
    }
