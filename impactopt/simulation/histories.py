"""Histories that both engines record, and the displacements of soles and posture."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.errors import InputError
from impactopt.robots.loads import DriveLoads
from impactopt.robots.robot import Robot
from impactopt.simulation.contact_times import Touches
from impactopt.simulation.result import Scene, Simulation
from impactopt.simulation.soles import cop_margins, sole_names

Array = NDArray[np.float64]


def slip_and_lift(scene: Scene, corners: Array) -> tuple[Array, Array]:
    """(k, soles) [m] of each sole, of the corner that moved most since the first instant, from the places
    (k, corners, 3) of all soles' corners, in the scene's order.
    """
    moves = corners - corners[0]
    level, up = np.linalg.norm(moves[..., :2], axis=2), np.maximum(moves[..., 2], 0.0)
    first = np.cumsum([0, *(len(c) for c in scene.corners)])
    soles = [slice(a, b) for a, b in itertools.pairwise(first)]
    slip, lift = np.zeros((2, len(corners), len(soles)))
    for i, its in enumerate(soles):
        slip[:, i], lift[:, i] = level[:, its].max(axis=1), up[:, its].max(axis=1)
    return slip, lift


def check_not_diverged(rates: Array, t: float, step: float) -> None:
    """InputError with the time [s] if the rates [rad/s, m/s] are of no robot."""
    if not np.abs(rates).max() <= 1e4:  # nan is not, either
        raise InputError(
            f"the simulation diverged at t = {t:.4f} s: take a smaller step than {step:g} s, or softer gains"
        )


def posture_error(model: Any, q: Array, planned: Array) -> float:
    """[rad] of the joint, or of the base's orientation, that is farthest from where it should be."""
    error = np.abs(pin.difference(model, planned, q))
    if model.joints[1].nv == 6:
        return float(max(np.linalg.norm(error[3:6]), error[6:].max(initial=0.0)))
    return float(error.max())


def simulation_of(
    robot: Robot, scene: Scene, rows: list[tuple[Any, ...]], touches: Touches, **rest: Any
) -> Simulation:
    """Histories of recorded instants: rows of time, q, v, force, target speed, hand speed, demand, torque,
    wrench of each sole and each hand that holds on, places of the soles' corners, torque through the gears
    since the row before; ``rest``: the other fields.
    """
    if not rows:
        raise InputError("the step of the simulation is longer than its motion: give a shorter one (--step)")
    columns = [np.array(c) for c in zip(*rows, strict=True)]
    time, q, v, force, target_speed, hand_speed, demand, torque, sole_ground, corners, gear = columns
    slip, lift = slip_and_lift(scene, corners)
    contact_start, contact_end = touches.blow()
    joints, soles = v[:, -robot.n :], len(scene.soles)
    sole_ground, grips = sole_ground[:, :soles], sole_ground[:, soles:]
    return Simulation(
        time=time,
        q=q,
        v=v,
        force=force,
        target_speed=target_speed,
        hand_speed=hand_speed,
        demand=demand,
        torque=torque,
        sole_ground=sole_ground,
        soles=sole_names(robot, scene),
        cop_margin=cop_margins(robot, scene, q, sole_ground),
        slip=slip,
        lift=lift,
        grip_force=np.linalg.norm(grips[:, :, :3], axis=2),
        gear=gear,
        loads=DriveLoads.of(
            robot,
            gear=gear,
            torque=torque,
            velocity=joints,
            jump=_jump(time, joints, contact_start, contact_end),
        ),
        contact_start=contact_start,
        contact_end=contact_end,
        touches=tuple((start, end, impulse) for start, end, impulse in touches.intervals),
        **rest,
    )


def _jump(time: Array, rates: Array, start: float, end: float) -> Array:
    """(n,) Change of the joints' rates (k, n) from before the contact to after it; nan: there was none."""
    if not (np.isfinite(start) and end <= time[-1]):
        return np.full(rates.shape[1], np.nan)
    before = max(int(np.searchsorted(time, start, side="right")) - 1, 0)
    return np.asarray(rates[int(np.searchsorted(time, end))] - rates[before])
