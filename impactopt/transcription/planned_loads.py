"""Gear and motor loads of a plan and of a strike."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import GearLoad
from impactopt.robots.loads import DriveLoads, gear_torque
from impactopt.robots.robot import Robot
from impactopt.transcription.plan import Plan, PlannedCollision, Trajectory

__all__ = ["gear_share", "motion_loads", "plan_loads", "strike_loads"]

Array = NDArray[np.float64]
STEP = 5e-3  # [s] of motions, whose loads change from one node to the next: a completed millisecond is dear


def motion_loads(robot: Robot, way: Trajectory, hit: PlannedCollision) -> DriveLoads:
    """Loads of a reference before and after contact, and of the collision, at all known instants."""
    phase, base = way.phase, robot.nv - robot.n
    rates, outside = way.v[:, base:], phase != 1
    jump = rates[phase == 2][0] - rates[phase == 0][-1]
    return _loads(robot, (way.torque[outside], rates[outside], way.a[outside, base:]), hit, jump)


def plan_loads(robot: Robot, plan: Plan, hits: Sequence[PlannedCollision]) -> list[DriveLoads]:
    """Loads of a plan's motions every `STEP`, including the one that meets nothing, and of these collisions
    with its targets.
    """
    expected, *others = hits
    ways = [plan.trajectory(step=STEP, hold=STEP)]
    if plan.abort is not None:
        ways.append(plan.trajectory(step=STEP, hold=STEP, missed=True, known=ways[0]))
    out = [motion_loads(robot, way, expected) for way in ways]
    still = np.zeros(robot.nv)
    return out + [strike_loads(robot, still, still, hit) for hit in others]


def strike_loads(robot: Robot, before: Array, after: Array, hit: PlannedCollision) -> DriveLoads:
    """Loads of a collision alone, with the robot's velocities (nv,) before and after it."""
    none = np.zeros((0, robot.n))
    return _loads(robot, (none, none, none), hit, (after - before)[-robot.n :])


def gear_share(problem: ImpactProblem, torque: Array, acceleration: Array) -> Array:
    """(k,) Largest load of a gear over what the problem allows, of torques and accelerations (k, n) of the
    joints; zeros where it bounds none.
    """
    term, robot = problem.extra(GearLoad), problem.robot
    if term is None or not term.active or not acceleration.size:
        return np.zeros(len(torque))
    load = gear_torque(robot, torque, acceleration) / robot.torque_limit / term.most(robot)
    return np.asarray(np.abs(load).max(axis=1, initial=0.0))


def _loads(robot: Robot, way: tuple[Array, ...], hit: PlannedCollision, jump: Array) -> DriveLoads:
    """way, hit : torque, velocity and acceleration of the joints, (k, n) each."""
    parts = [way, (hit.torque, hit.velocity, hit.acceleration)][: 1 + bool(hit.acceleration.size)]
    torque, velocity, acceleration = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    gear = gear_torque(robot, torque, acceleration)
    return DriveLoads.of(robot, gear=gear, torque=torque, velocity=velocity, jump=jump)
