"""What both engines make of their steps: histories, and how far soles and posture moved."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.errors import InputError
from impactopt.robots.loads import DriveLoads
from impactopt.robots.robot import Robot
from impactopt.simulation.result import Scene, Simulation
from impactopt.simulation.soles import cop_margin, sole_names
from impactopt.simulation.touch import Touches

Array = NDArray[np.float64]


def slip_and_lift(corners: list[Array], start: list[Array]) -> tuple[list[float], list[float]]:
    """[m] of each sole, of the corner that moved most, from places (k, 3) of its corners now and at first."""
    moves = [now - then for now, then in zip(corners, start, strict=True)]
    slip = [float(np.linalg.norm(m[:, :2], axis=1).max()) for m in moves]
    return slip, [max(0.0, float(m[:, 2].max())) for m in moves]


def check_not_diverged(rates: Array, t: float, step: float) -> None:
    """InputError with the time [s] if the rates [rad/s, m/s] are of no robot."""
    if not np.all(np.isfinite(rates)) or np.abs(rates).max() > 1e4:
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
    wrench of each sole and each hand that holds on, slip and lift of each sole, torque through the gears
    since the row before; ``rest``: the other fields.
    """
    if not rows:
        raise InputError("the step of the simulation is longer than its motion: give a shorter one (--step)")
    columns = [np.array(c) for c in zip(*rows, strict=True)]
    time, q, v, force, target_speed, hand_speed, demand, torque, sole_ground, slip, lift, gear = columns
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
        cop_margin=cop_margin(robot, scene, q, sole_ground),
        slip=slip.reshape(len(time), -1),
        lift=lift.reshape(len(time), -1),
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
