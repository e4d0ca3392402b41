"""The full-dynamics check: closed forms, balances, convergence, and what it does with bad motions."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from support.small_motions import blow_motion, given_until, reference, scene, standing, strike
from support.small_robots import arm, biped, slider

from impactopt import InputError, Robot, load_problem, load_robot, solve
from impactopt.kinematics.stance import margin
from impactopt.simulation import Scene, Simulation, simulate_pinocchio

Array = NDArray[np.float64]


# ---- two point masses


@pytest.mark.parametrize("damping", [0.0, 300.0])
def test_two_point_masses_collide_as_in_the_closed_form(damping: float) -> None:
    sim, exact = strike(damping)
    after = sim.hand_speed[-1]
    assert sim.hand_speed[sim.phase() == 0][-1] == pytest.approx(exact["speed"], rel=1e-10)
    # where the damper makes the force jump, the step that contact begins in is of first order
    assert sim.impulse == pytest.approx(exact["impulse"], rel=1e-5 if damping == 0 else 2e-3)
    assert 5.0 * sim.target_speed[-1] == pytest.approx(sim.impulse, rel=1e-12)
    assert sim.outcome == {"speed_m_s": pytest.approx(sim.target_speed[-1], rel=1e-12)}
    assert sim.peak_force == pytest.approx(exact["peak"], rel=1e-4)
    assert sim.contact_start == pytest.approx(exact["start"], abs=1e-6)
    assert sim.contact_end - sim.contact_start == pytest.approx(exact["duration"], rel=1e-4)
    assert after == pytest.approx(exact["own_after"], abs=5e-3 * exact["speed"])
    # between the bodies nothing is lost, whatever the step
    assert 6.0 * after + 5.0 * sim.target_speed[-1] == pytest.approx(6.0 * exact["speed"], rel=1e-12)


@pytest.mark.slow
def test_an_undamped_collision_keeps_the_energy() -> None:
    sim, exact = strike(0.0)
    before = 0.5 * 6.0 * exact["speed"] ** 2
    after = 0.5 * 6.0 * sim.hand_speed[-1] ** 2 + 0.5 * 5.0 * sim.target_speed[-1] ** 2
    assert after == pytest.approx(before, rel=1e-5)


@pytest.mark.slow
def test_the_damper_works_in_compression_only_and_contact_never_pulls() -> None:
    sim, _ = strike(300.0)
    contact = sim.phase() == 1
    assert (sim.force >= 0).all()
    approach = sim.hand_speed - sim.target_speed
    assert (approach[contact] < -1e-3).any()
    # in restitution the force is the spring's alone, so its rate is k times the approach speed
    part = np.flatnonzero(contact & (approach < -1e-3))[1:-1]
    rate = np.diff(sim.force[part]) / np.diff(sim.time[part])
    middle = (approach[part][1:] + approach[part][:-1]) / 2
    np.testing.assert_allclose(rate, 1e4 * middle, rtol=1e-3)


@pytest.mark.slow
def test_contact_is_finer_recorded_and_the_impulse_is_the_forces_integral() -> None:
    sim, exact = strike(100.0)
    contact = sim.phase() == 1
    np.testing.assert_allclose(np.diff(sim.time[contact]), 1e-4, rtol=1e-6)
    impulse = float(given_until(sim, sim.time[-1]))
    assert impulse == pytest.approx(exact["impulse"], rel=5e-3)
    assert impulse == pytest.approx(sim.impulse, rel=1e-4)


@pytest.mark.slow
def test_a_smaller_step_is_nearer_to_the_closed_form() -> None:
    errors = []
    for step in (4e-4, 1e-4):
        sim, exact = strike(100.0, step=step)
        errors.append(abs(sim.impulse / exact["impulse"] - 1))
    assert errors[1] < 0.5 * errors[0]


# ---- the integrator and the servo


def swing_arm(step: float, robot: Robot) -> Simulation:
    n = robot.n
    q = robot.posture("start")
    time = np.linspace(0, 0.2, 2)
    torque = np.array([[3.0, -20.0, -8.0, 1.0]])
    ref = reference(time, q, torque=torque, nv=n, n=n, end=0.2)
    return simulate_pinocchio(robot, ref, scene("striker:hand"), step=step, settle=step, record=1)


def test_the_midpoint_rule_is_of_second_order_in_the_step() -> None:
    """A smooth motion of four coupled joints, with the servo on."""
    robot = arm(kp=40.0, kd=5.0)
    exact = swing_arm(1.25e-4, robot)

    def error(step: float) -> float:
        sim = swing_arm(step, robot)
        assert sim.time[-1] == pytest.approx(exact.time[-1])
        return float(np.abs(pin.difference(robot.model, sim.q[-1], exact.q[-1])).max())

    errors = [error(h) for h in (4e-3, 2e-3, 1e-3)]
    ratios = np.array(errors[:-1]) / errors[1:]
    assert errors[0] > 1e-6  # or there is nothing to see
    assert (ratios > 3.4).all()
    assert (ratios < 4.8).all()


def test_the_servo_is_the_robots_and_saturates() -> None:
    robot = arm(torque_limit=np.array([60.0, 80.0, 10.0, 40.0]))
    q = robot.posture("start")
    ahead = pin.integrate(robot.model, q, np.array([0.0, 0.0, 0.4, 0.0]))
    forward = np.array([1.0, 2.0, 3.0, 4.0])
    rate = np.array([0.0, 0.2, 0.0, 0.0])
    ref = reference([0.0, 1e-4], [q, ahead], [rate, rate], forward, nv=4, n=4, end=1e-3)
    sim = simulate_pinocchio(robot, ref, scene("striker:hand"), settle=0.0, record=1)
    # where it stands, its reference is only faster
    np.testing.assert_allclose(sim.demand[0], forward + robot.kd * rate, rtol=1e-12)
    assert sim.demand[1, 2] == pytest.approx(3.0 + 0.4 * robot.kp[2], rel=1e-2)
    np.testing.assert_array_equal(sim.torque, np.clip(sim.demand, -robot.torque_limit, robot.torque_limit))
    assert (np.abs(sim.demand[1:, 2]) > 10.0).all()
    assert (sim.torque[1:, 2] == 10.0).all()


@pytest.mark.slow
def test_a_continuous_joint_is_held_past_half_a_turn_the_short_way() -> None:
    """In q it is a cosine and a sine; the servo is on its angle."""
    robot = arm(postures={"start": {"turn": 3.1, "shoulder": 0.3, "elbow": 1.2, "wrist": 0.3}})
    q0 = robot.posture("start")
    time = np.linspace(0, 0.5, 51)
    rate = np.zeros((51, 4))
    rate[:, 0] = 0.5 * np.sin(2 * np.pi * time) ** 2
    travel = np.concatenate([[0], np.cumsum((rate[1:, 0] + rate[:-1, 0]) / 2 * 0.01)])
    q = np.array([pin.integrate(robot.model, q0, np.array([t, 0, 0, 0])) for t in travel])
    assert robot.joint_positions(q[-1])[0] < -3.0  # it has gone past pi
    gravity = np.array(pin.computeGeneralizedGravity(robot.model, robot.model.createData(), q0))
    sim = simulate_pinocchio(
        robot, reference(time, q, rate, gravity, nv=4, n=4), scene("striker:hand"), settle=0.3
    )
    np.testing.assert_allclose(pin.difference(robot.model, sim.q[-1], q[-1]), 0, atol=5e-3)
    assert np.abs(sim.demand[:, 0]).max() < 10.0


# ---- standing


@pytest.mark.parametrize("make", [biped, lambda: load_robot("talos")], ids=["biped", "talos"])
def test_a_robot_that_stands_still_goes_on_standing(make: Any) -> None:
    robot = make()
    ref, where, _ = standing(robot)
    sim = simulate_pinocchio(robot, ref, where, step=2.5e-4, settle=0.0)
    model, data = robot.model, robot.model.createData()
    weight = 9.81 * sum(i.mass for i in model.inertias)
    com = pin.centerOfMass(model, data, ref.q[0])
    assert np.abs([pin.difference(model, ref.q[0], q) for q in sim.q]).max() < 1e-7
    np.testing.assert_allclose(sim.demand, np.tile(ref.torque[0], (len(sim.time), 1)), atol=1e-4)
    np.testing.assert_allclose(
        sim.ground[:, :3], np.tile([0, 0, weight], (len(sim.time), 1)), atol=1e-4 * weight
    )
    zmp = np.stack([-sim.ground[:, 4], sim.ground[:, 3]], axis=1) / sim.ground[:, 2:3]
    np.testing.assert_allclose(zmp, np.tile(com[:2], (len(zmp), 1)), atol=1e-5)
    assert max(sim.slip.max(), sim.lift.max()) < 1e-8
    assert sim.standing is None
    assert np.isnan(sim.contact_start)
    assert (sim.phase() == 0).all()
    given = {"torque_limit": robot.torque_limit, "polygon": where.polygon, "planned_impulse": 1.0}
    with pytest.raises(InputError, match="never touched"):
        sim.summary(**given)
    report = sim.report(**given)  # of `impactopt validate`: a miss is a result, as in MuJoCo
    assert report["impulse_Ns"] == 0.0 and report["impulse_error_pct"] is None and report["target"] == {}


@pytest.fixture(scope="module")
def blow() -> tuple[Robot, Scene, Simulation]:
    """The biped's arm swings against a mass in front of it; every step is recorded."""
    robot, motion, there = blow_motion()
    return robot, there, simulate_pinocchio(robot, motion, there, step=1e-4, settle=0.0, record=1)


@pytest.mark.slow
def test_momentum_is_balanced_by_ground_gravity_and_target(blow: tuple[Robot, Scene, Simulation]) -> None:
    """Linear: robot + target; angular, about the world's origin: with the contact force's moment."""
    robot, there, sim = blow
    model, data = robot.model, robot.model.createData()
    v = np.array([pin.difference(model, a, b) for a, b in zip(sim.q[:-1], sim.q[1:], strict=True)]) / 1e-4
    middle = [pin.interpolate(model, a, b, 0.5) for a, b in zip(sim.q[:-1], sim.q[1:], strict=True)]
    linear, angular = [], []
    for q, vk in zip(middle, v, strict=True):
        h = pin.computeCentroidalMomentum(model, data, q, vk)
        linear.append(np.array(h.linear))
        angular.append(np.array(h.angular) + np.cross(data.com[0], h.linear))
    fid = model.getFrameId(there.striker)
    push, weight = -sim.force[:, None] * there.normal, []
    for k, q in enumerate(sim.q):
        pin.framesForwardKinematics(model, data, q)
        com = pin.centerOfMass(model, data, q)
        gravity = np.array([0, 0, -9.81 * data.mass[0]])
        force = sim.ground[k, :3] + gravity + push[k]
        arm_ = np.array(data.oMf[fid].translation)
        moment = sim.ground[k, 3:] + np.cross(com, gravity) + np.cross(arm_, push[k])
        weight.append(np.concatenate([force, moment]))
    impulse = np.cumsum(np.array(weight)[1:-1], axis=0) * 1e-4
    change = np.hstack([np.array(linear), np.array(angular)])
    change = change[1:] - change[0]
    size = np.abs(change).max(axis=0).max()
    np.testing.assert_allclose(impulse, change, atol=5e-3 * size)
    # and what the target got is what the contact gave
    given = float(given_until(sim, sim.time[-1]))
    assert 3.0 * sim.target_speed[-1] == pytest.approx(given, rel=5e-3)
    assert sim.impulse == pytest.approx(3.0 * sim.target_speed[-1], rel=1e-12)
    assert given > 0.5


def test_a_blow_has_three_phases_and_a_summary(blow: tuple[Robot, Scene, Simulation]) -> None:
    robot, there, sim = blow
    assert np.isfinite([sim.contact_start, sim.contact_end]).all()
    phase = sim.phase()
    assert (np.diff(phase) >= 0).all()
    assert set(phase.tolist()) == {0, 1, 2}
    assert (sim.force[phase != 1] == 0).all()
    impulse = 3.0 * sim.target_speed[-1]
    out = sim.summary(torque_limit=robot.torque_limit, polygon=there.polygon, planned_impulse=impulse / 1.1)
    assert out["impulse_Ns"] == pytest.approx(impulse)
    assert out["impulse_error_pct"] == pytest.approx(10.0)
    # which may lie between two steps
    assert sim.force.max() <= out["peak_force_N"] == sim.contact_force.max() < 1.01 * sim.force.max()
    assert out["contact_ms"] == pytest.approx(1e3 * (sim.contact_end - sim.contact_start))
    names = ("swing", "collision", "follow")
    zmp = np.stack([-sim.ground[:, 4], sim.ground[:, 3]], axis=1) / sim.ground[:, 2:3]
    inside = margin(there.polygon, zmp)
    for k, name in enumerate(names):
        assert out["zmp_margin_m"][name] == pytest.approx(inside[phase == k].min(), abs=1e-12)
        ratio = np.abs(sim.demand[phase == k]) / robot.torque_limit
        assert out["torque_ratio"][name] == pytest.approx(ratio.max())
    for k, sole in enumerate(sim.soles):
        for i, name in enumerate(names):
            assert out["sole_force_N"][sole][name] == pytest.approx(sim.sole_normal[phase == i, k].min())
    np.testing.assert_allclose(sim.sole_normal.sum(axis=1), sim.ground[:, 2], rtol=1e-9)  # level soles
    assert out["sole_slip_mm"] == pytest.approx(1e3 * sim.slip.max())
    assert out["sole_lift_mm"] == pytest.approx(1e3 * sim.lift.max())
    assert max(out["sole_slip_mm"], out["sole_lift_mm"]) < 0.05
    assert out["hand_speed_m_s"] > 0.5


@pytest.mark.slow
def test_a_fixed_base_has_no_zmp() -> None:
    sim, exact = strike(100.0)
    out = sim.summary(
        torque_limit=np.array([1e4]), polygon=np.zeros((0, 2)), planned_impulse=exact["impulse"]
    )
    assert "zmp_margin_m" not in out and "grip_force_N" not in out
    assert abs(out["impulse_error_pct"]) < 0.2
    held = dataclasses.replace(sim, grip_force=np.array([[3.0, 1.0], [2.0, 7.0]]))
    out = held.summary(
        torque_limit=np.array([1e4]), polygon=np.zeros((0, 2)), planned_impulse=exact["impulse"]
    )
    assert out["grip_force_N"] == 7.0, "of a robot that hangs on its hands too"


# ---- what cannot be simulated


def test_a_diverging_simulation_says_when_and_what_to_do() -> None:
    """A servo of 2.5e4 1/s is beyond the explicit rule's limit of 2/h."""
    robot = slider(1.0, kd=2.5e4, torque_limit=1e12)
    ref = reference([0.0, 1.0], np.zeros(1), [[0.1], [0.1]], nv=1, n=1, end=1.0)
    with pytest.raises(InputError, match=r"diverged at t = 0\.0\d+ s.*smaller step than 0.0002 s"):
        simulate_pinocchio(robot, ref, scene())
    sim = simulate_pinocchio(
        robot,
        reference([0.0, 1.0], np.zeros(1), [[0.1], [0.1]], nv=1, n=1, end=0.01),
        scene(),
        step=2e-5,
        settle=0.0,
    )
    assert sim.hand_speed[-1] == pytest.approx(0.1, rel=1e-6)


@pytest.mark.slow
def test_the_plan_knows_the_motion_in_contact() -> None:
    """Full dynamics move the joints as planned between the states before and after contact, too."""
    solution = solve(load_problem("arm7"))
    plan, replayed = solution.plan, solution.validate()
    span = plan.contact_end - plan.contact_start
    s = (replayed.time - plan.contact_start) / span
    within = (s >= 0.0) & (s <= 1.0)
    planned = plan.closed(plan.through_contact(s[within]))
    assert np.abs(replayed.q[within] - planned).max() < 1e-4
