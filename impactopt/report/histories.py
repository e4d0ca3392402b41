"""Planned and simulated histories of a result; planned ones in contact are those of the collision model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from impactopt.arrays import Array, Mask
from impactopt.files.record import Record
from impactopt.kinematics.stance import convex_polygon, margin
from impactopt.simulation.result import centre_of_pressure

BUCKETS = 400  # of a thinned history


def thinned(time: Array, *columns: Array, whole: Sequence[float] = (np.inf, -np.inf)) -> list[Array]:
    """Time (k,) and columns at fewer instants: of each bucket, its ends and the extrema of each column.

    Lines through these look the same as through all instants. Between the two times of `whole`, where the
    reader zooms in, all instants are kept.

    Source: U. Jugel et al., "M4: a visualization-oriented time series data aggregation", VLDB 2014.
    """
    if len(time) <= 3 * BUCKETS:
        return [time, *columns]
    edges = np.linspace(0, len(time), BUCKETS + 1).astype(int)
    close = np.flatnonzero((time >= whole[0]) & (time <= whole[1]))
    kept = {*edges[:-1].tolist(), *(edges[1:] - 1).tolist(), *close.tolist()}
    for low, high in pairwise(edges.tolist()):
        for column in columns:
            part = column[low:high]
            if np.isfinite(part).any():
                kept |= {low + int(np.nanargmin(part)), low + int(np.nanargmax(part))}
            if not np.isfinite(part).all():  # keep gaps
                kept.add(low + int(np.argmin(np.isfinite(part))))
    chosen = np.array(sorted(kept))
    return [time[chosen], *(column[chosen] for column in columns)]


def contact_force(record: Record, prefix: str) -> tuple[Array, Array]:
    """Times (k,) [s] and force (k,) [N] on the target: planned, or of a replay; zero before and after."""
    a = record.arrays
    if prefix == "reference":
        return at_contact(record, a["collision_force"], 0.0)
    if f"{prefix}_contact_force" not in a:  # records of older versions
        return a[f"{prefix}_time"], a[f"{prefix}_force"]
    time, force = a[f"{prefix}_contact_time"], a[f"{prefix}_contact_force"]
    first, last = a[f"{prefix}_time"][[0, -1]]
    return np.concatenate([[first], time, [time.max(initial=last)]]), np.concatenate([[0.0], force, [0.0]])


def at_contact(record: Record, values: Array, otherwise: float) -> tuple[Array, Array]:
    """Time [s] and values of a history of the planned collision, with a constant value before and after."""
    a = record.arrays
    start, end, last = (float(a[f"reference_{n}"]) for n in ("contact_start", "contact_end", "end"))
    time = np.concatenate([[0.0, start], start + a["collision_time"], [end, last]])
    return time, np.concatenate([[otherwise] * 2, values, [otherwise] * 2])


def ground_wrenches(record: Record, prefix: str) -> tuple[Array, Array]:
    """Time and the ground's wrench (k, 6) about the origin; in planned contact, of the collision model."""
    a = record.arrays
    time = a[f"{prefix}_time"]
    if prefix != "reference":
        return time, a[f"{prefix}_sole_ground"].sum(axis=1)
    keep, ground = a["reference_phase"] != 1, a["collision_ground"]
    if not len(ground):
        return time[keep], a["reference_ground"][keep]
    return _spliced(record, a["reference_ground"][keep], a["collision_time"][-len(ground) :], ground)


def _spliced(record: Record, outside: Array, hit: Array, inside: Array) -> tuple[Array, Array]:
    """Time [s] and values of the plan outside of contact, and at times `hit` [s] since contact in it."""
    a = record.arrays
    start = float(a["reference_contact_start"])
    time = np.concatenate([a["reference_time"][a["reference_phase"] != 1], start + hit])
    order = np.argsort(time, kind="stable")
    return time[order], np.concatenate([outside, inside])[order]


def soles_standing(record: Record, time: Array) -> dict[str, Mask]:
    """Mask (k,) of the times [s] at which each sole is planned to stand, by name; empty with one stance."""
    phases = record.summary.get("stances") or []
    names = [name.removeprefix("sole_") for name in record.arrays if name.startswith("sole_")]
    last = len(phases) - 1
    return {
        name: np.any(
            [
                (time >= phase["from_s"]) & ((time < phase["to_s"]) | (k == last))
                for k, phase in enumerate(phases)
                if name in phase["soles"]
            ],
            axis=0,
        )
        for name in (names if phases else ())
    }


def zmp_margins(record: Record, time: Array, wrench: Array) -> Array:
    """Distance (k,) [m] of the ZMP of ground wrenches (k, 6) to the edges of the support polygon then."""
    place, phases = centre_of_pressure(wrench), record.summary.get("stances") or []
    if not phases:
        return margin(record.arrays["polygon"], place)
    out = np.full(len(time), np.nan)
    for phase in phases:
        here = (time >= phase["from_s"]) & ((time < phase["to_s"]) | (phase is phases[-1]))
        polygon = convex_polygon(np.vstack([_footprint(record, phase, name) for name in phase["soles"]]))
        out[here] = margin(polygon, place[here])
    return out


def footprints(record: Record) -> dict[str, Array]:
    """Corners (k, 2) [m] of each sole on the ground by ``sole_<name>``, also after each step."""
    out = {name: corners for name, corners in record.arrays.items() if name.startswith("sole_")}
    for k, phase in enumerate(record.summary.get("stances") or []):
        for name in phase.get("moved_m", {}):
            there = _footprint(record, phase, name)
            if not any(np.array_equal(there, known) for known in out.values()):
                out[f"sole_{name}, phase {k + 1}"] = there
    return out


def _footprint(record: Record, phase: Mapping[str, Any], name: str) -> Array:
    """Corners (k, 2) [m] of a sole on the ground in a stance phase."""
    return np.asarray(
        record.arrays[f"sole_{name}"] + np.array(phase.get("moved_m", {}).get(name, (0.0, 0.0)))
    )


def planned_torque(record: Record) -> tuple[Array, Array]:
    """Time (k,) [s] and the plan's torques (k, n) [N m]."""
    a = record.arrays
    torque, hit = a["reference_torque"], a["collision_torque"]
    if len(hit) != len(a["collision_time"]) or not len(a["collision_ground"]):
        return a["reference_time"], torque
    return _spliced(record, torque[a["reference_phase"] != 1], a["collision_time"], hit)
