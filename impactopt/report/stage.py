"""Data of an animation: solids on the robot's joints, bodies of the world, soles, and motions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.arrays import Array
from impactopt.bodies.solids import Solid, simplified
from impactopt.bodies.visuals import Visual, joined_visuals, surroundings_of
from impactopt.bodies.world import WorldBody
from impactopt.files.record import Record
from impactopt.problem.problem import ImpactProblem
from impactopt.report.histories import footprints
from impactopt.report.tracks import AROUND, FAR, Track, tracks_of
from impactopt.robots.loads import weight_of
from impactopt.robots.robot import Robot

Arrays = dict[str, NDArray[Any]]
MAX_TRIANGLES = 120_000  # of a robot
MIN_CELL = 0.004  # [m] of simplified solids
SMALL = 0.3  # [m] size below which solids have smaller cells, down to a third
GRID = 65535  # steps of a vertex's coordinate within its solid's bounds


def stage_of(record: Record, problem: ImpactProblem) -> tuple[dict[str, Any], Arrays]:
    """Header and arrays of a record's motions, for :func:`impactopt.report.page.pack`."""
    arrays: Arrays = {}
    bodies = pack_robot(problem.robot, arrays)
    world = pack_world(problem.world, arrays)
    tracks = [pack_track(f"track{k}", track, arrays) for k, track in enumerate(tracks_of(record, problem))]
    soles = footprints(record) | {"polygon": record.arrays["polygon"]}
    arrays |= {f"ground_{name}": corners for name, corners in soles.items()}
    header = {
        "bodies": bodies,
        "world": world,
        "tracks": tracks,
        "soles": [f"ground_{name}" for name in soles if name != "polygon"],
        "normal": problem.normal,
        "point": problem.point,
        "side": middle(arrays["track0_places"]),
        "weight": max(weight_of(problem.robot), 1.0),
        "around": AROUND,
        "far": FAR,
        "floor": problem.ground_height,
        "legged": len(record.arrays["polygon"]) > 0,
        "both": problem.second is not None,  # the force is drawn at the first hand
        "stances": bool(record.summary.get("stances")),
    }
    return header, arrays


def pack_robot(robot: Robot, arrays: Arrays) -> list[dict[str, Any]]:
    """Robot's solids for the page's header; their triangles are added to `arrays`."""
    return [
        {"joint": body.joint, "colour": body.colour, **pack_solid(f"body{k}", body.solid, arrays)}
        for k, body in enumerate(bodies_drawn(robot))
    ]


def pack_world(world: tuple[WorldBody, ...], arrays: Arrays) -> list[dict[str, Any]]:
    """Solids of the world's bodies for the page's header; their triangles are added to `arrays`."""
    return [
        {
            "kind": part.kind,
            "moves": part.moves,
            "clear": part.clear,
            "hinge": None if part.hinge is None else part.hinge._asdict(),
            **pack_solid(f"world{k}", part.solid, arrays),
        }
        for k, part in enumerate(surroundings_of(world))
    ]


def middle(places: Array) -> float:
    """Mean y [m] of the robot's joints at the start, by which the view's side is chosen."""
    return float(places[0, 1:, 1].mean())


def bodies_drawn(robot: Robot) -> list[Visual]:
    """Solids of a robot, one for each joint and colour, with few enough triangles in all."""
    whole = joined_visuals(robot)
    if sum(len(solid.triangles) for solid in whole.values()) > MAX_TRIANGLES:
        whole = _few(whole)
    return [
        Visual(joint=joint, solid=solid, colour=colour)
        for (joint, colour), solid in whole.items()
        if len(solid.triangles)
    ]


def _few(whole: dict[Any, Solid]) -> dict[Any, Solid]:
    """Simplified solids, with cells large enough for `MAX_TRIANGLES` in all."""
    cell = MIN_CELL
    while True:
        few = {key: simplified(solid, cell * _cell_factor(solid)) for key, solid in whole.items()}
        count = sum(len(solid.triangles) for solid in few.values())
        if count <= MAX_TRIANGLES:
            return few
        cell *= max(1.1, (count / MAX_TRIANGLES) ** 0.8)


def _cell_factor(solid: Solid) -> float:
    return float(np.clip(np.linalg.norm(np.ptp(solid.vertices, axis=0)) / SMALL, 1 / 3, 1.0))


def pack_solid(name: str, solid: Solid, arrays: Arrays) -> dict[str, Any]:
    """Name and scale of a solid for the header; its triangles are added to `arrays`."""
    low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
    span = np.maximum(high - low, 1e-9)
    arrays[f"{name}_vertices"] = np.round((solid.vertices - low) / span * GRID).astype("<u2")
    kind = "<u2" if len(solid.vertices) <= GRID else "<u4"
    arrays[f"{name}_triangles"] = solid.triangles.astype(kind)
    return {"name": name, "low": low, "step": span / GRID}


def pack_track(name: str, track: Track, arrays: Arrays) -> dict[str, Any]:
    """Name and contact of a motion for the header; its histories are added to `arrays`."""
    given = ("time", "places", "hand", "mass", "force", "travel", "aside", "zmp", "ground")
    arrays |= {f"{name}_{part}": getattr(track, part) for part in given}
    return {
        "name": name,
        "label": track.name,
        "contact_start": track.contact_start,
        "contact_end": track.contact_end,
        "missing": track.missing,
    }
