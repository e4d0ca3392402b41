"""Blows with a tool that is held softly: planned, and replayed in both engines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from impactopt import GearLoad, ImpactProblem, Perturbation, SoftGrip, Solution, load_problem, solve
from impactopt.simulation import ControllerSettings, Simulation

GRIP = SoftGrip(axis=[0, 1, 0], stiffness=20.0, damping=0.5, point=[0.0, 0.0, 0.08])


def _problem(intervals: int = 24) -> ImpactProblem:
    firm = load_problem("arm_planar")
    return replace(
        firm,
        robot=firm.robot.with_grip("hammer", GRIP),
        swing=replace(firm.swing, intervals=intervals),
        follow=replace(firm.follow, intervals=16),
    )


@pytest.fixture(scope="module")
def soft() -> Solution:
    solution = solve(_problem())
    assert solution.status.usable
    return solution


def _off_at_contact(solution: Solution) -> float:
    """[rad/s] how much faster or slower a joint is in a replay, just before contact, than it is planned."""
    way, replay = solution.plan.trajectory(), solution.validate(engine="pinocchio", step=1e-4)
    last = np.flatnonzero(replay.time < solution.plan.contact_start - 1e-4)[-1]
    swing = way.phase == 0
    planned = [np.interp(replay.time[last], way.time[swing], v) for v in way.v[swing].T]
    return float(np.abs(replay.v[last] - planned).max())


@pytest.mark.slow
def test_its_swing_converges() -> None:
    """With the third power of the intervals' length at least: accelerations are right in the mean."""
    problem = _problem()
    fine, coarse = (
        _off_at_contact(solve(replace(problem, swing=replace(problem.swing, duration=0.6, intervals=n))))
        for n in (24, 12)
    )
    assert coarse > 6 * fine
    assert fine < 0.01


@pytest.mark.slow
def test_a_blow_through_it_keeps_the_momentum_of_arm_and_hammer(soft: Solution) -> None:
    """M dv = the torques' impulse less that of the contact, joint by joint; gravity is small in 8 ms."""
    plan, robot = soft.plan, soft.problem.robot
    hit, model = plan.collision, robot.model
    way = plan.trajectory()
    q = way.q[np.flatnonzero(way.phase == 0)[-1]] / 2 + way.q[np.flatnonzero(way.phase == 2)[0]] / 2
    data = model.createData()
    upper = pin.crba(model, data, q, pin.Convention.WORLD)
    inertia = np.triu(upper) + np.triu(upper, 1).T
    hand = model.getFrameId("striker:hammer")
    row = soft.problem.normal @ pin.computeFrameJacobian(model, data, q, hand, pin.LOCAL_WORLD_ALIGNED)[:3]
    pushed = np.trapezoid(hit.torque, hit.time, axis=0) - np.trapezoid(hit.force, hit.time) * row
    bias = pin.rnea(model, data, q, hit.velocity.mean(axis=0), np.zeros(robot.nv)) * hit.time[-1]
    change = inertia @ (hit.velocity[-1] - hit.velocity[0])
    np.testing.assert_allclose(change, pushed - bias, atol=0.03 * np.abs(soft.impulse * row).max())


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["pinocchio", "mujoco"])
def test_what_is_planned_happens(soft: Solution, engine: str) -> None:
    replay = soft.validate(engine=engine)
    assert replay.impulse == pytest.approx(soft.impulse, rel=0.01)
    assert replay.outcome["depth_m"] == pytest.approx(soft.plan.collision.outcome["depth_m"], rel=0.02)
    assert soft.loads is not None
    planned, found = soft.loads.gear, replay.loads.gear
    assert np.nanmax(found) == pytest.approx(np.nanmax(planned), rel=0.05)
    assert np.isnan(planned[-1])
    assert np.isnan(found[-1]), "a spring has no gear"
    assert replay.saturated == 0.0


def test_the_hammer_goes_away_from_the_nail(soft: Solution) -> None:
    """On its spring it swings back: a replay that went a little farther would hit again."""
    problem, way = soft.problem, soft.plan.trajectory()
    model, after = problem.robot.model, np.flatnonzero(way.phase == 2)
    data, hand, along = model.createData(), model.getFrameId("striker:hammer"), []
    for q in way.q[after]:
        pin.framesForwardKinematics(model, data, q)
        along.append(float(problem.normal @ data.oMf[hand].translation))
    since = way.time[after] - way.time[after[0]]
    assert (along[0] - np.array(along) >= np.minimum(0.02, 0.12 * since) - 1e-3).all()


def test_it_spares_the_gears_and_drives_the_nail_deeper(soft: Solution, hammered: Solution) -> None:
    firm = hammered
    assert soft.loads is not None
    assert firm.loads is not None
    assert np.nanmax(soft.loads.gear) < 0.5 * np.nanmax(firm.loads.gear)
    assert soft.plan.collision.outcome["depth_m"] > firm.plan.collision.outcome["depth_m"]


def test_a_bound_of_the_gears_leaves_the_grip_out(soft: Solution) -> None:
    problem = soft.problem
    kept = solve(replace(problem, terms=(*problem.terms, GearLoad(limit=0.6))))
    assert kept.status.usable
    assert kept.loads is not None
    assert np.nanmax(kept.loads.gear) < 1.03 * 0.6


def _spring(replay: Simulation) -> np.ndarray:
    """[N m] by which the torque in a grip is off what its spring and damper make, since the start."""
    made = replay.torque[:, -1] + 20.0 * replay.q[:, -1] + 0.5 * replay.v[:, -1]
    return np.asarray(made - made[0])


@pytest.mark.slow
def test_a_controller_steers_the_arm_and_leaves_the_spring_alone(soft: Solution) -> None:
    exact = ControllerSettings(noise=0.0, delay=0.0)
    replay = soft.validate(engine="mujoco", controller=exact)
    assert replay.impulse == pytest.approx(soft.impulse, rel=0.1)
    assert replay.outcome["depth_m"] == pytest.approx(soft.plan.collision.outcome["depth_m"], rel=0.05)
    np.testing.assert_allclose(_spring(replay), 0.0, atol=1e-9)


def test_a_slow_servo_does_not_slow_the_spring(soft: Solution) -> None:
    replay = soft.validate(engine="mujoco", perturbation=Perturbation(period=5e-3, delay=5e-3))
    np.testing.assert_allclose(_spring(replay), 0.0, atol=1e-9)
