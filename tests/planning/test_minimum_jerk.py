"""The minimum-jerk baseline: inside the limits, true to its profile, as fast as it can be."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from support.small_robots import arm, biped, striking_point

from impactopt import (
    ContactWrenchCone,
    FixedBase,
    FreeMass,
    ImpactProblem,
    InputError,
    Phase,
    Robot,
    SpringDamper,
    Striker,
    TorqueLimit,
)
from impactopt.planning.minimum_jerk import _keeps_limits, _profile, _wrenches_exist, minimum_jerk_baseline

LAW = SpringDamper(stiffness=1e4, damping=300.0)


def reach_of(
    robot: Any,
    posture: str,
    striker: str,
    shift: tuple[float, float, float] = (0.05, 0.03, 0.03),
    **options: Any,
) -> ImpactProblem:
    return ImpactProblem(
        robot=robot,
        striker=striker,
        start=posture,
        point=striking_point(robot, posture, striker) + np.array(shift),
        normal=[1.0, 0.0, 0.0],
        law=LAW,
        target=FreeMass(mass=3.0),
        swing=Phase(duration=0.6, intervals=6),
        follow=Phase(duration=0.8, intervals=6),
        **options,
    )


def test_the_profile_is_the_quintic_with_its_ends_and_derivatives() -> None:
    rng = np.random.default_rng(0)
    ends = tuple(rng.standard_normal((4, 3)))
    duration, h = 0.7, 1e-5
    time = np.linspace(h, duration - h, 50)
    y, yd, ydd = _profile(duration, ends, time)  # type: ignore[arg-type]
    before, after = (_profile(duration, ends, time + s)[0] for s in (-h, h))  # type: ignore[arg-type]
    np.testing.assert_allclose(yd, (after - before) / (2 * h), atol=1e-7)
    np.testing.assert_allclose(ydd, (after - 2 * y + before) / h**2, atol=1e-3)
    first, last = (_profile(duration, ends, np.array([t])) for t in (0.0, duration))  # type: ignore[arg-type]
    for (got, rate, acc), (place, speed) in zip((first, last), (ends[:2], ends[2:]), strict=True):
        np.testing.assert_allclose(got[0], place, atol=1e-12)
        np.testing.assert_allclose(rate[0], speed, atol=1e-11)
        np.testing.assert_allclose(acc[0], 0.0, atol=1e-9)


@pytest.mark.slow
def test_it_is_inside_the_limits_and_a_little_faster_is_not() -> None:
    problem = reach_of(arm(), "start", "hand", stance=FixedBase())
    found = minimum_jerk_baseline(problem, tolerance=0.05)
    assert found.impulse == pytest.approx(3.0 * found.simulation.target_speed[-1])
    assert found.impulse > 0
    assert found.summary["hand_speed_m_s"] == pytest.approx(found.speed, rel=0.03)
    assert max(found.summary["torque_ratio"].values()) <= 1.0
    assert _keeps_limits(problem, found.duration, found.speed)
    assert not _keeps_limits(problem, found.duration, 20 * found.speed)
    assert found.describe()["impulse_Ns"] == found.impulse


def test_a_slow_reach_keeps_the_limits_beside_a_continuous_joint() -> None:
    """Its (cos, sin) come last in a configuration, and are no angles of the joints before it."""
    model, parent = pin.Model(), 0
    kinds = {"shoulder": pin.JointModelRY, "elbow": pin.JointModelRY, "roll": pin.JointModelRUBX}
    for name, kind in kinds.items():
        place = pin.SE3(np.eye(3), np.array([0.4 if parent else 0.0, 0.0, 0.0]))
        parent = model.addJoint(parent, kind(), place, name)
        body = pin.Inertia(2.0, np.array([0.1, 0.0, 0.0]), 0.02 * np.eye(3))
        model.appendBodyToJoint(parent, body, pin.SE3.Identity())
        model.addFrame(pin.Frame(f"{name} link", parent, 0, pin.SE3.Identity(), pin.FrameType.BODY))
    robot = Robot.from_model(
        model,
        name="rolling",
        armature=0.1,
        torque_limit=200.0,
        velocity_limit=6.0,
        position_limit={"shoulder": (-2.5, 0.5), "elbow": (0.7, 2.8)},
        strikers=[Striker(name="tip", frame="roll link", point=np.array([0.2, 0.0, 0.0]))],
        postures={"ready": {"shoulder": -1.2, "elbow": 1.8}},
    )
    problem = reach_of(robot, "ready", "tip", (0.05, 0.0, 0.0), stance=FixedBase())
    assert _keeps_limits(problem, 1.0, 0.1)


def test_wrenches_exist_only_for_what_soles_can_push() -> None:
    robot = biped()
    problem = reach_of(robot, "half_sitting", "fist")
    q, zero = problem.start_posture, np.zeros(robot.nv)
    assert _wrenches_exist(problem, q, zero, zero)
    for axis, acceleration in (
        (2, -20.0),
        (1, 10.0),
        (0, -10.0),
    ):  # down: they would pull; aside: they would slip
        moving = zero.copy()
        moving[axis] = acceleration
        assert not _wrenches_exist(problem, q, zero, moving)


def test_limits_that_do_not_let_it_stand_are_said() -> None:
    problem = reach_of(arm(), "start", "hand", stance=FixedBase(), terms=(TorqueLimit(fraction=1e-3),))
    with pytest.raises(InputError, match=r"minimum-jerk reach that hits at 0\.01 m/s"):
        minimum_jerk_baseline(problem)


@pytest.mark.slow
def test_a_reach_may_use_the_soles_up_to_their_edges() -> None:
    """A margin that leaves a plan no room leaves a reach as it is."""
    narrow = ContactWrenchCone(margin=0.045, minimum_force=100.0)
    plain, wary = (reach_of(biped(), "half_sitting", "fist", terms=t) for t in ((), (narrow,)))
    found = minimum_jerk_baseline(wary, tolerance=0.1)
    assert found.speed == minimum_jerk_baseline(plain, tolerance=0.1).speed
    assert min(found.summary["zmp_margin_m"].values()) >= 0
