"""Motions of an animation at sampled instants: robot, target, force, ZMP and centre of mass."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.interpolate import CubicHermiteSpline

from impactopt.arrays import Array, Index
from impactopt.files.record import Record, replay_name
from impactopt.planning.solution import Solution
from impactopt.problem.problem import ImpactProblem
from impactopt.robots.robot import Robot
from impactopt.simulation.result import centre_of_pressure, travelled
from impactopt.transcription.plan import Trajectory, pushed_aside

AROUND = 0.05  # [s] before and after contact that are shown slowly
FRAME, FINE = 1 / 30, 1 / 500  # [s] between instants, and around contact
AFTER = 1.0  # [s] shown beyond the end of the planned motion
FAR = 3.0  # [m] travel of a flying target that is shown; it fades out on the second half

# name of each motion in a record, and the prefix of its arrays
MISSED = "missed"
MOTIONS = (
    ("planned", "reference"),
    ("simulated", "simulated"),
    ("free soles", "replayed"),
    ("planned, target missing", MISSED),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Track:
    """One motion at k instants.

    time (k,) [s]
    places (k, joints, 7) : position [m] and quaternion x, y, z, w of each joint of the model in the world,
        the universe first
    hand, mass (k, 3) [m] : striking point, centre of mass
    force (k,) [N] : on the target along its normal
    travel (k,), aside (k, 3) [m] : of the target along its normal, at most FAR, and across it by friction
    zmp (k, 2) [m], ground (k, 3) [N] : ZMP, and force of the ground on the robot; nan if unknown
    contact_start, contact_end [s] : nan without contact
    missing : whether there is no target
    """

    name: str
    time: Array
    places: Array
    hand: Array
    mass: Array
    force: Array
    travel: Array
    aside: Array
    zmp: Array
    ground: Array
    contact_start: float
    contact_end: float
    missing: bool = False


def tracks_of(record: Record, problem: ImpactProblem) -> list[Track]:
    """Tracks of the planned motion, of the simulated ones, and of the planned one for a missing target.

    The servo's reference coasts through contact; the planned robot, which does not, is drawn.
    """
    present = [(name, prefix) for name, prefix in MOTIONS if f"{prefix}_q" in record.arrays]
    free = replay_name(record.summary)
    return [_track(record, problem, free if p == "replayed" else name, p) for name, p in present]


def planned_track(solution: Solution, reference: Trajectory | None = None) -> Track:
    """Track of the planned motion of a solution without a record.

    reference : of the servo, if sampled otherwise than `Solution.trajectory`.

    Raises
    ------
    InputError : the plan's motion cannot be completed.
    """
    reference, plan = reference or solution.trajectory, solution.plan
    parts: dict[str, Any] = {"reference": reference, "collision": solution.collision}
    arrays = {"polygon": plan.polygon, "collision_q": plan.in_contact(reference)}
    for prefix, part in parts.items():
        arrays |= {f"{prefix}_{f.name}": getattr(part, f.name) for f in fields(part)}
    record = Record(summary={"target": solution.collision.outcome}, arrays=arrays)
    return _track(record, solution.problem, *MOTIONS[0])


def _track(record: Record, problem: ImpactProblem, name: str, prefix: str) -> Track:
    """Track of a motion by the prefix of its arrays in the record."""
    a, robot = record.arrays, problem.robot
    time = a[f"{prefix}_time"]
    start, end = float(a[f"{prefix}_contact_start"]), float(a[f"{prefix}_contact_end"])
    chosen = _instants(time, start, end, float(a["reference_end"]) + AFTER)
    shown = time[chosen]
    if prefix == "reference":
        q = _planned(robot.model, record, chosen)
        wrench, force, speed = _predicted(record, chosen)
    elif prefix == MISSED:
        q, wrench, start, end = a["missed_q"][chosen], a["missed_ground"][chosen], np.nan, np.nan
        force, speed = np.zeros(len(chosen)), np.zeros(len(time))
    else:
        q, force = a[f"{prefix}_q"][chosen], a[f"{prefix}_force"][chosen]
        wrench, speed = a[f"{prefix}_sole_ground"].sum(axis=1)[chosen], a[f"{prefix}_target_speed"]
    # records of older versions do not have it
    travel = a.get(f"{prefix}_target_travel", travelled(time, speed, start))
    if prefix == "reference" and record.summary.get("target", {}).get("broken", 1.0) < 0.5:
        travel[time > end] = 0.0  # an unbroken board springs back
    travel, aside = travel[chosen], _aside(a, prefix, shown, start)
    places, hand, mass = places_of(robot, robot.striker(problem.striker).model_frame, q)
    legged = len(a["polygon"]) > 0
    return Track(
        name=name,
        time=shown,
        places=places,
        hand=hand,
        mass=mass,
        force=force,
        travel=np.clip(travel, -FAR, FAR),
        aside=aside,
        zmp=centre_of_pressure(wrench) if legged else np.full((len(shown), 2), np.nan),
        ground=wrench[:, :3] if legged else np.full((len(shown), 3), np.nan),
        contact_start=start,
        contact_end=end,
        missing=prefix == MISSED,
    )


def _aside(a: Mapping[str, Array], prefix: str, shown: Array, start: float) -> Array:
    """Displacement (k, 3) [m] of the target across its normal at the shown instants (k,) [s].

    Zero, if friction does not move the target, or the record does not have it.
    """
    velocity, found = a.get("collision_tangential_velocity"), a.get(f"{prefix}_target_aside")
    if prefix == "reference" and velocity is not None:
        return pushed_aside(a["collision_time"], velocity, shown - start)
    if found is not None and len(found):
        return np.column_stack([np.interp(shown, a[f"{prefix}_time"], x) for x in np.transpose(found)])
    return np.zeros((len(shown), 3))


def places_of(robot: Robot, frame: str, postures: Array) -> tuple[Array, Array, Array]:
    """Fields `places`, `hand` and `mass` of a `Track` for postures (k, nq); frame : of the striking point."""
    model, data = robot.model, robot.model.createData()
    striker = model.getFrameId(frame)
    places, hand, mass = [], [], []
    for q in postures:
        pin.framesForwardKinematics(model, data, q)
        places.append([pin.SE3ToXYZQUAT(place) for place in data.oMi])
        hand.append(np.array(data.oMf[striker].translation))
        mass.append(np.array(pin.centerOfMass(model, data, q)))
    return np.array(places), np.array(hand), np.array(mass)


def _instants(time: Array, start: float, end: float, last: float) -> Index:
    """Indices of the shown instants: dense around contact, until `last` [s]."""
    last = min(last, float(time[-1]))
    grid = np.arange(0.0, last + FRAME / 2, FRAME)
    if np.isfinite(start):
        stop = min(end if np.isfinite(end) else start, last)
        grid = np.union1d(grid, np.arange(start - AROUND, stop + AROUND, FINE))
        grid = np.union1d(grid, [start, stop])
    grid = grid.clip(0.0, last)
    before, at = np.searchsorted(time, grid), np.searchsorted(time, grid, side="right") - 1
    return np.unique(np.concatenate([before, at]).clip(0, len(time) - 1))  # both sides of a jump


def _planned(model: Any, record: Record, chosen: Index) -> Array:
    """Configurations (k, nq) of the plan at instants of its reference."""
    a = record.arrays
    time, q, contact = a["reference_time"], a["reference_q"].copy(), np.flatnonzero(a["reference_phase"] == 1)
    if len(moved := a.get("collision_q", ())) == len(contact):
        q[contact] = moved
    elif len(contact):  # records of older versions do not have it: between the states before and after
        ends = [contact[0], min(contact[-1] + 1, len(time) - 1)]
        if time[ends[1]] > time[ends[0]]:
            offsets = [np.zeros(model.nv), pin.difference(model, *q[ends])]
            between = CubicHermiteSpline(time[ends], offsets, a["reference_v"][ends])
            q[contact] = [pin.integrate(model, q[ends[0]], offset) for offset in between(time[contact])]
    return np.asarray(q[chosen])


def _predicted(record: Record, chosen: Index) -> tuple[Array, Array, Array]:
    """Planned ground wrench and force at the chosen instants, and the target's speed at all instants."""
    a = record.arrays
    time, phase, wrench = a["reference_time"], a["reference_phase"], a["reference_ground"][chosen].copy()
    since = time - float(a["reference_contact_start"])
    hit, ground = a["collision_time"], a["collision_ground"]
    contact = phase[chosen] == 1
    if len(ground):
        at = hit[-len(ground) :]
        wrench[contact] = np.column_stack([np.interp(since[chosen][contact], at, w) for w in ground.T])
    force = np.where(contact, np.interp(since[chosen], hit, a["collision_force"]), 0.0)
    speed = np.interp(since, hit, a["collision_target_speed"])
    if "depth_m" in record.summary.get("target", {}):  # a nail stays in the wood
        speed = np.where(since > hit[-1], 0.0, speed)
    return wrench, force, speed


def planned_hand_speed(record: Record, problem: ImpactProblem) -> Array:
    """Planned speed (k,) [m/s] of the hand along the normal, at the reference's instants.

    It is nan in contact, where the servo's reference coasts, unlike the plan.
    """
    a, robot = record.arrays, problem.robot
    model, data = robot.model, robot.model.createData()
    striker = model.getFrameId(robot.striker(problem.striker).model_frame)
    speed = np.full(len(a["reference_time"]), np.nan)
    # the first instant in contact still has the swing's velocity
    known = (a["reference_phase"] != 1) | (a["reference_time"] <= float(a["reference_contact_start"]))
    for k in np.flatnonzero(known):
        pin.forwardKinematics(model, data, a["reference_q"][k], a["reference_v"][k])
        moved = pin.getFrameVelocity(model, data, striker, pin.LOCAL_WORLD_ALIGNED)
        speed[k] = problem.normal @ moved.linear
    return speed
