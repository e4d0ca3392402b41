"""Prices of the motion style, and the measures of a motion that they are for."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid, quad, trapezoid
from support.small_plans import Planned, arm_problem, biped_problem, changed, transcribed
from support.small_robots import biped

from impactopt import GroundForce, InputError, talos
from impactopt.kinematics.splines import CubicSpline
from impactopt.planning.solution import ground_force_share, motion_measures
from impactopt.problem.objectives import STYLES, MotionPrices
from impactopt.robots.loads import weight_of
from impactopt.transcription.objective import cost_of_motion
from impactopt.transcription.plan import Trajectory
from impactopt.transcription.transcription import Transcription


def integrals(curve: CubicSpline, order: int) -> np.ndarray:
    """Integrals (ny,) of the squares of a spline's derivative [per s^order], by adaptive quadrature."""
    step = 1e-5

    def value(time: float, k: int) -> float:
        if order == 1:
            return float(curve.sample(time)[1][0][k] ** 2)
        later, sooner = (curve.sample(np.clip(time + d, 0, curve.duration))[2][0][k] for d in (step, -step))
        return float(((later - sooner) / (2 * step)) ** 2)

    inner = curve.breaks * curve.duration
    size = curve.control.shape[1]
    out = np.zeros(size)
    for k in range(size):
        for a, b in pairwise(inner):
            out[k] += quad(value, a + 2 * step, b - 2 * step, args=(k,), epsrel=1e-6)[0]
    return out


def test_the_price_of_jerk_is_the_integral_of_its_square(
    arm_plan: Planned, monkeypatch: pytest.MonkeyPatch
) -> None:
    t = priced(arm_plan.transcription, monkeypatch, jerk=2.0)
    x = arm_plan.result.x.copy()
    for motion in (t.swing, *t.follows):  # prices take a phase's typical duration
        motion.T.write(x, float(np.mean(motion.phase.duration)))
    found = cost_of_motion(t.builder, t.problem.style_prices, [t.swing, *t.follows], t.follows).evaluate(x)
    expected = 2.0 * sum(integrals(motion.spline(x), 3).sum() for motion in (t.swing, *t.follows))
    assert found == pytest.approx(expected, rel=1e-3)


def test_the_price_of_speed_is_nearly_that_of_its_square(
    arm_plan: Planned, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the nodes' shares of a phase: a quadrature of its own, within a few per cent."""
    t = priced(arm_plan.transcription, monkeypatch, speed=3.0)
    x = arm_plan.result.x.copy()
    for motion in (t.swing, *t.follows):
        motion.T.write(x, float(np.mean(motion.phase.duration)))
    found = cost_of_motion(t.builder, t.problem.style_prices, [t.swing, *t.follows], t.follows).evaluate(x)
    expected = 3.0 * sum(integrals(motion.spline(x), 1).sum() for motion in (t.swing, *t.follows))
    assert found == pytest.approx(expected, rel=0.05)


def priced(t: Transcription, monkeypatch: pytest.MonkeyPatch, **prices: float) -> Transcription:
    """The program, whose problem has a style with these prices alone."""
    monkeypatch.setitem(STYLES, "of this test", MotionPrices(**prices))
    monkeypatch.setattr(t, "problem", replace(t.problem, style="of this test"))
    return t


def test_idle_joints_are_those_of_the_other_arm_and_the_head() -> None:
    from impactopt import FreeMass, ImpactProblem, SpringDamper

    robot = talos()
    problem = ImpactProblem(
        robot=robot,
        striker="right_hand",
        point=[0.6, -0.25, 1.1],
        normal=[1, 0, 0],
        law=SpringDamper(stiffness=1e4, damping=300.0),
        target=FreeMass(mass=5.0),
    )
    idle = {name for name, yes in zip(robot.joint_names, problem.idle_joints, strict=True) if yes}
    assert idle == {n for n in robot.joint_names if n.startswith(("arm_left", "head"))}


def test_an_unknown_style_is_an_input_error(arm_plan: Planned) -> None:
    with pytest.raises(InputError, match=r"unknown style 'naturl' .did you mean 'natural'"):
        replace(arm_plan.problem, style="naturl")


def test_measures_are_those_of_the_reference(biped_plan: Planned) -> None:
    problem, reference = biped_plan.problem, biped_plan.trajectory
    found = motion_measures(problem, reference)
    rate = reference.v[:, -problem.robot.n :]
    idle = problem.idle_joints
    travel = trapezoid(np.abs(rate[:, idle]), reference.time, axis=0).sum() if idle.any() else 0.0
    assert found["idle_travel_rad"] == pytest.approx(travel, rel=1e-2, abs=1e-3)
    q = [problem.robot.joint_positions(reference.q[k]) for k in (0, -1)]
    assert found["end_posture_rad"] == pytest.approx(np.abs(q[1] - q[0]).max())
    low, high = found["ground_force_share"]
    weight = 9.81 * sum(body.mass for body in problem.robot.model.inertias)
    assert low * weight == pytest.approx(reference.ground[:, 2].min())
    assert high * weight == pytest.approx(reference.ground[:, 2].max())


def test_a_continuous_joint_that_passes_half_a_turn_ends_near_its_start() -> None:
    problem, time = arm_problem(), np.array([0.0, 1.0])
    robot, still = problem.robot, np.zeros((2, problem.robot.nv))
    q = robot.angles.put(np.empty((2, robot.nq)), [[3.1, 0.3, 1.2, 0.3], [3.2, 0.3, 1.2, 0.3]])
    reference = Trajectory(
        time=time,
        phase=np.array([0, 2]),
        q=q,
        v=still,
        a=still,
        torque=still,
        ground=np.zeros((2, 6)),
        contact_start=0.5,
        contact_end=0.5,
        end=1.0,
    )
    assert motion_measures(problem, reference)["end_posture_rad"] == pytest.approx(0.1)


@pytest.mark.parametrize("seed", range(10))
def test_reversals_are_peaks_and_valleys_by_their_prominence(biped_plan: Planned, seed: int) -> None:
    from scipy.signal import find_peaks  # here: every worker imports all files, and this takes 0.4 s

    problem, reference = biped_plan.problem, biped_plan.trajectory
    rates = 3.0 * np.random.default_rng(seed).standard_normal(reference.v.shape)
    found = motion_measures(problem, replace(reference, v=rates))["reversals"]
    before = reference.phase == 0
    angle = cumulative_trapezoid(rates[before], reference.time[before], axis=0, initial=0.0)
    counts = [
        sum(len(find_peaks(side, prominence=0.02)[0]) for side in (column, -column))
        for column in angle[:, -problem.robot.n :].T
    ]
    assert found == np.median(counts) > 0


def test_a_robot_at_rest_presses_with_its_weight(biped_plan: Planned) -> None:
    low, high = ground_force_share(biped_plan.problem, biped_plan.trajectory.ground[:1, 2]) or (0.0, 0.0)
    assert low == high == pytest.approx(1.0, abs=1e-6)


@pytest.mark.slow
def test_the_weight_is_that_of_the_robots_gravity() -> None:
    """On Mars a robot at rest presses with all of its weight, too."""
    robot = biped()
    robot.model.gravity.linear = np.array([0.0, 0.0, -3.71])
    t = transcribed(replace(biped_problem(robot), terms=(GroundForce(),)))
    x = np.random.default_rng(0).standard_normal(t.program.n)
    row = next(k for k, origin in enumerate(t.program.origins) if origin.term == "ground force")
    (_, wrench), *_ = t.wrenches()
    normal = wrench.evaluate(x)[2::6].sum()
    assert t.program.constraints(x)[row] == pytest.approx(normal / weight_of(robot), rel=1e-12)


def test_constraints_of_the_ground_force_are_normal_forces_over_the_weight(biped_plan: Planned) -> None:
    """Of all soles and of each, at every place where the soles have wrenches."""
    t = changed(biped_plan.transcription, terms=(GroundForce(least=0.4, most=1.6, sole=0.1),))
    x = np.random.default_rng(0).standard_normal(t.program.n)
    rows = [k for k, origin in enumerate(t.program.origins) if origin.term == "ground force"]
    weight = 9.81 * sum(body.mass for body in t.robot.model.inertias)
    expected = []
    for _, wrench in t.wrenches():
        normal = wrench.evaluate(x)[2::6] / weight
        expected += [normal.sum(), *(normal if len(normal) > 1 else [])]
    np.testing.assert_allclose(t.program.constraints(x)[rows], expected, rtol=1e-12)
    lower, upper = t.program.g_lower[rows], t.program.g_upper[rows]
    assert set(lower) == {0.4, 0.1} and set(upper) == {1.6, np.inf}
