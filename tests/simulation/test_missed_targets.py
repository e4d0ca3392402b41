"""Missed blows: what the robot follows until it notices is what its abort motion starts from."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from impactopt import (
    FixedBase,
    FreeMass,
    ImpactProblem,
    Robot,
    Scenario,
    Solution,
    SpringDamper,
    Trajectory,
    planar_arm,
    solve,
)
from impactopt.simulation.result import FollowedReference

LATE = 0.06  # [s] after the planned contact that the robot notices
MOST = 0.05  # [rad/s] that the reference may jump by
EVERY = 1e-4  # [s] at which it is looked at


@pytest.fixture(scope="module")
def short() -> Solution:
    """A contact of a few milliseconds, over long before a miss is noticed."""
    problem = ImpactProblem(
        robot=planar_arm(),
        striker="hammer",
        start="ready",
        stance=FixedBase(),
        point=[0.7, 0.0, 0.75],
        normal=[0.0, 0.0, -1.0],
        target=FreeMass(mass=1.0),
        law=SpringDamper(stiffness=1e5, damping=50.0),
        scenarios=(Scenario(name="nothing", missing=True, abort_after=LATE),),
    )
    solution = solve(problem)
    assert solution.result.status.usable
    assert solution.plan.contact_end - solution.plan.contact_start < LATE / 4
    return solution


def rates(reference: Trajectory, robot: Robot, t: float) -> np.ndarray:
    """Joint velocities at an instant; at a jump those after it."""
    k = int(np.searchsorted(reference.time, t, side="right")) - 1
    s = (t - reference.time[k]) / (reference.time[k + 1] - reference.time[k])
    return np.asarray((1 - s) * reference.v[k] + s * reference.v[k + 1])[-robot.n :]


@pytest.mark.slow
def test_the_reference_of_a_robot_that_feels_nothing_is_continuous(short: Solution) -> None:
    reference, missed, robot = short.trajectory, short.missed_trajectory, short.problem.robot
    followed = FollowedReference(reference, missed)
    times = np.arange(reference.contact_start - 0.01, missed.contact_end + 0.02, EVERY)
    told = np.array([rates(followed.at(t, False), robot, t) for t in times])
    jumps = np.abs(np.diff(told, axis=0)).max(axis=1)
    # an acceleration is no jump
    allowed = MOST + EVERY * max(np.abs(reference.a).max(), np.abs(missed.a).max())
    assert jumps.max() < allowed
    # going on with the blow's own would jump by rad/s, at its end and where the robot notices
    k = int(np.searchsorted(reference.time, missed.contact_end))
    apart = rates(missed, robot, missed.contact_end) - reference.v[k, -robot.n :]
    assert np.abs(apart).max() > 10 * MOST


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["pinocchio", "mujoco"])
def test_a_missed_blow_asks_for_no_more_torque_than_planned(short: Solution, engine: str) -> None:
    options: dict[str, Any] = {"missing": True}
    if engine == "mujoco":
        from impactopt import Perturbation

        options = {"perturbation": Perturbation(missing=True)}
    sim = short.validate(engine=engine, **options)
    told = short.summary(sim)
    assert sim.impulse == 0.0 and np.isnan(sim.contact_start)
    held = told["simulated"]["torque_ratio"]
    assert held.keys() == {"swing", "missed"}
    assert held["missed"] == pytest.approx(told["torque_ratio"]["missed"], abs=0.01)
    assert told["simulated"]["gear_ratio"] < told["gear_ratio"] + 0.01
    # where the abort motion begins the robot is where its reference is
    k = int(np.searchsorted(sim.time, short.missed_trajectory.contact_end))
    late = float(sim.time[k] - short.missed_trajectory.contact_end)
    begin = np.flatnonzero(short.missed_trajectory.phase == 2)[0]
    q, v = short.missed_trajectory.q[begin], short.missed_trajectory.v[begin]
    np.testing.assert_allclose(sim.q[k], q + late * v, atol=1e-3)
    np.testing.assert_allclose(sim.v[k], v, atol=MOST)


def test_it_goes_over_to_the_blow_where_it_feels_one_late(short: Solution) -> None:
    reference, missed = short.trajectory, short.missed_trajectory
    between = (reference.contact_end + missed.contact_end) / 2
    followed = FollowedReference(reference, missed)
    assert followed.at(reference.contact_start, False) is reference
    assert followed.at(between, False) is missed
    assert followed.at(between + EVERY, True) is reference
    assert followed.at(missed.contact_end + EVERY, True) is reference
    # once it aborts, it does not come back: what it touches then is in the way of its stop
    aborts = FollowedReference(reference, missed)
    assert aborts.at(missed.contact_end, False) is missed
    assert aborts.at(missed.contact_end + EVERY, True) is missed
    assert FollowedReference(reference).at(missed.contact_end, False) is reference


def test_a_contact_longer_than_that_ends_with_the_abort_motion(short: Solution) -> None:
    reference, missed = short.trajectory, short.missed_trajectory
    long = dataclasses.replace(reference, contact_end=missed.contact_end + 0.01)
    followed = FollowedReference(long, missed)
    assert followed.at(missed.contact_end - EVERY, False) is long
    assert followed.at(missed.contact_end, False) is missed
    assert FollowedReference(long, missed).at(missed.contact_end, True) is long
