"""The strike: the state at contact alone. Derivatives, rows that hold, a bound on motions, their start."""

from __future__ import annotations

import dataclasses
import json
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from support.derivative_checks import check_derivatives
from support.fake_solution import PROBLEM_FILE
from support.small_plans import BODILESS, Planned, arm_problem, changed
from typer.testing import CliRunner

from impactopt import (
    AngularMomentum,
    Balance,
    Board,
    Effort,
    FreeMass,
    FullDynamics,
    HitCone,
    HitRegion,
    Impulse,
    Incidence,
    InputError,
    KelvinVoigt,
    Nail,
    Obstacle,
    PeakForce,
    Phase,
    Scenario,
    Solution,
    Status,
    StrikeSolution,
    TorqueLimit,
    TorqueRate,
    VelocityLimit,
    load_record,
    planar_arm,
)
from impactopt.cli.app import app
from impactopt.files.problem_file import ProblemFile
from impactopt.kinematics.stance import support_polygon
from impactopt.planning.solve import solve
from impactopt.planning.strike import optimize_strike
from impactopt.solvers.program import check_program
from impactopt.transcription.initial_guess import first_iterate, iterate_from_strike, strike_iterate
from impactopt.transcription.strike import StrikeTranscription
from impactopt.transcription.transcription import Transcription

Array = NDArray[np.float64]

VARIANTS: dict[str, dict[str, Any]] = {
    "as it is": {},
    "with scenarios": {
        "scenarios": (Scenario(name="heavy", mass=2.0), Scenario(name="missing", missing=True)),
        "objectives": (Impulse(), PeakForce(weight=-1e-3), Effort()),
    },
    "rigid": {"collision": "rigid", "coefficient_of_restitution": 0.3},
    "with terms": {"terms": (HitCone(angle=0.1), HitRegion(radius=0.02), TorqueRate(limit=1e3))},
}


def of_strike(t: Transcription) -> StrikeTranscription:
    return StrikeTranscription(t.problem, t.functions)


@pytest.fixture(
    scope="module", params=[(robot, kind) for kind in VARIANTS for robot in ("biped", "arm")], ids=", ".join
)
def transcription(request: pytest.FixtureRequest) -> StrikeTranscription:
    robot, kind = request.param
    return of_strike(changed(request.getfixturevalue(f"{robot}_transcription"), **VARIANTS[kind]))


def optimized(t: Transcription, monkeypatch: pytest.MonkeyPatch, **options: Any) -> StrikeSolution:
    """The strike of a transcription's problem, on its functions."""
    monkeypatch.setattr("impactopt.planning.strike.block_functions", lambda *_: t.functions)
    return optimize_strike(t.problem, **options)


@pytest.fixture(scope="module", params=["biped", "arm"])
def robot_plan(request: pytest.FixtureRequest) -> Planned:
    return request.getfixturevalue(f"{request.param}_plan")


@pytest.fixture(scope="module")
def solved(robot_plan: Planned) -> StrikeSolution:
    with pytest.MonkeyPatch.context() as patch:
        return optimized(robot_plan.transcription, patch)


# ---- the program


def test_the_first_iterate_is_inside_its_bounds_and_finite_in_all_rows(
    transcription: StrikeTranscription,
) -> None:
    program, x = transcription.program, strike_iterate(transcription)
    check_program(program, x)
    assert (x >= program.x_lower).all() and (x <= program.x_upper).all()
    assert np.isfinite(program.constraints(x)).all()


def test_derivatives_agree_with_differences(transcription: StrikeTranscription) -> None:
    program, x = transcription.program, strike_iterate(transcription)
    check_derivatives(program, x + 0.02 * np.random.default_rng(0).standard_normal(program.n))


def test_rows_and_variables_have_names_of_their_own_and_all_are_used(
    transcription: StrikeTranscription,
) -> None:
    program = transcription.program
    for count, name in ((program.m, program.constraint_name), (program.n, program.variable_name)):
        assert len({name(i) for i in range(count)}) == count
    x = strike_iterate(transcription) + 0.01 * np.random.default_rng(1).standard_normal(program.n)
    used = np.asarray(abs(program.jacobian(x)).sum(axis=0)).ravel() + np.abs(program.gradient(x))
    assert [program.variable_name(int(j)) for j in np.flatnonzero(used == 0)] == []


def test_it_is_smaller_than_the_motion_and_has_no_swing(biped_transcription: Transcription) -> None:
    strike = of_strike(biped_transcription)
    assert strike.program.n < 0.7 * biped_transcription.program.n
    names = [strike.program.constraint_name(i) for i in range(strike.program.m)]
    assert not [name for name in names if "swing" in name or "follow-through" in name]
    for term in ("hit point", "incidence", "capture point", "contact law", "closed legs, contact"):
        assert any(name.startswith(term) for name in names), term


def test_accelerations_are_priced_as_the_cubic_that_leads_there(arm_transcription: Transcription) -> None:
    t = of_strike(changed(arm_transcription, wrench_price=0.0))
    y, u, duration = t.y0 + np.array([0.3, -0.2, 0.1, 0.5]), np.array([1.0, 2.0, -1.0, 0.5]), 0.5
    x = np.zeros(t.program.n)
    t.y.write(x, y)
    t.u0.write(x, u)
    time = np.linspace(0, duration, 20001)[:, None]
    # y'' = a + b t from rest, with its way and its rate at the end
    way = np.array([[duration**2 / 2, duration**3 / 6], [duration, duration**2 / 2]])
    a, b = np.linalg.solve(way, np.array([y - t.y0, u]))
    squared = np.trapezoid((a + b * time) ** 2, time[:, 0], axis=0).sum()
    assert t.program.objective(x) == pytest.approx(t.problem.smoothness * squared, rel=1e-6)


# ---- the strike


def test_it_solves(solved: StrikeSolution) -> None:
    assert solved.status is Status.SOLVED
    assert solved.violations == ()
    assert solved.impulse > 1.0


def test_the_hand_meets_the_point_along_the_normal_inside_the_limits(solved: StrikeSolution) -> None:
    """By Pinocchio."""
    problem, hit = solved.problem, solved.strike
    model = problem.robot.model
    data = model.createData()
    pin.forwardKinematics(model, data, hit.posture, hit.velocity)
    pin.updateFramePlacements(model, data)
    frame = model.getFrameId(f"striker:{problem.striker}")
    np.testing.assert_allclose(data.oMf[frame].translation, problem.point, atol=1e-5)
    speed = pin.getFrameVelocity(model, data, frame, pin.LOCAL_WORLD_ALIGNED).linear
    assert problem.normal @ speed == pytest.approx(hit.hand_speed, rel=1e-5)
    across = speed - problem.normal * hit.hand_speed
    assert np.linalg.norm(across) <= np.sqrt(2) * problem.term(Incidence).speed + 1e-5
    problem.robot.check_limits(hit.posture, name="the strike")
    fast = np.abs(hit.velocity[-problem.robot.n :]) / problem.robot.velocity_limit
    assert fast.max() <= problem.term(VelocityLimit).fraction + 1e-5
    for leg in problem.coordinates.legs:
        sole = model.getFrameId(leg.sole.frame)
        np.testing.assert_allclose(data.oMf[sole].homogeneous, leg.placement.homogeneous, atol=1e-4)
        assert np.abs(pin.getFrameVelocity(model, data, sole, pin.LOCAL).vector).max() < 1e-3


def test_torque_and_ground_wrench_make_it_coast(solved: StrikeSolution) -> None:
    """Inverse dynamics without acceleration of the independent coordinates."""
    hit, c = solved.strike, solved.problem.coordinates
    model, data = solved.problem.robot.model, solved.problem.robot.model.createData()
    y, legs = c.split(hit.posture)
    rates = _rates(c, hit.posture, hit.velocity)
    q, v, a = c.complete_motion(y, rates, np.zeros(c.ny), legs)
    np.testing.assert_allclose(v, hit.velocity, atol=1e-9)
    tau = pin.rnea(model, data, q, v, a)
    if not c.legs:
        np.testing.assert_allclose(tau, hit.torque, atol=1e-3)
        return
    pin.forwardKinematics(model, data, q, v, a)
    wrench = data.oMi[1].act(pin.Force(tau[:6])).vector
    np.testing.assert_allclose(hit.ground, wrench, atol=0.1)
    assert np.abs(hit.torque / solved.problem.robot.torque_limit).max() <= 0.85 + 1e-4


def _rates(c: Any, q: Array, v: Array) -> Array:
    """ydot of pin's velocity."""
    if not c.base:
        return np.asarray(v[c.independent])
    rpy = c.split(q)[0][3:6]
    rotation, jacobian = pin.rpy.rpyToMatrix(rpy), pin.rpy.computeRpyJacobian(rpy, pin.LOCAL)
    turning = np.linalg.solve(jacobian, v[3:6])
    return np.concatenate([rotation @ v[:3], turning, v[6 + c.independent]])


def test_the_blow_is_that_of_the_full_dynamics(solved: StrikeSolution) -> None:
    """Another integration of other equations, from the same state under the same torque.

    Legs coast joint by joint there, and with the soles in place here.
    """
    p, hit = solved.problem, solved.strike
    given = {name: getattr(p, name) for name in ("robot", "striker", "normal", "law", "target", "stance")}
    model = FullDynamics(**given, step=2e-4)
    result = model.collide(hit.posture, hit.velocity, hit.torque)
    exact = 1e-3 if not p.robot.floating else 1e-2
    assert result.impulse == pytest.approx(hit.impulse, rel=exact)
    assert result.duration == pytest.approx(hit.compression + hit.restitution, rel=2e-2)
    if p.robot.floating:  # the legs end elsewhere, as they follow another reference
        return
    moved = pin.difference(p.robot.model, hit.posture, hit.posture_after)
    apart = pin.difference(p.robot.model, hit.posture_after, np.asarray(result.configuration))
    assert np.abs(apart).max() < 1e-2 * np.abs(moved).max()
    assert np.abs(hit.velocity_after - result.velocity).max() < 1e-2 * np.abs(hit.velocity).max()


def test_what_is_left_after_contact_can_be_balanced(biped_plan: Planned, solved: StrikeSolution) -> None:
    if not solved.problem.robot.floating:
        assert "capture_margin_m" not in solved.strike.margins()
        return
    margins, balance = solved.strike.margins(), solved.problem.term(Balance)
    assert margins["capture_margin_m"] >= (balance.capture_margin or 0.0) - 1e-4
    assert min(margins["zmp_margin_m"].values()) >= 0.02 - 1e-4
    limit = solved.problem.term(TorqueLimit)
    assert margins["torque_ratio"]["collision"] <= limit.collision + 1e-4
    model = solved.problem.robot.model
    data = model.createData()
    h = pin.computeCentroidalMomentum(model, data, solved.strike.posture_after, solved.strike.velocity_after)
    assert np.abs(h.angular).max() <= balance.angular_momentum + 1e-2
    assert np.abs(data.vcom[0][2]) <= balance.vertical_speed + 1e-3
    assert len(support_polygon(solved.problem.robot, solved.problem.coordinates))


def embedded(plan: Planned) -> tuple[StrikeTranscription, Array]:
    """A motion's state at contact, and its collision, as a strike's variables."""
    t, x = plan.transcription, plan.result.x
    # that motion has no constraints between bodies
    strike = of_strike(changed(t, terms=BODILESS))
    out = np.zeros(strike.program.n)
    for name, group in strike.layout.groups.items():
        if (mine := t.layout.groups.get(name)) is not None and mine.count == group.count:
            group.write(out, mine.read(x))
    for group, value in (
        (strike.y, t.contact_state[0]),
        (strike.legs, t.contact_legs),
        (strike.w, t.contact_w),
        (strike.expected.after, t.follow.start[0]),  # type: ignore[union-attr]
    ):
        group.write(out, value.evaluate(x))
    return strike, out


def test_a_motions_state_at_contact_is_a_strike_and_the_strike_brings_more(
    robot_plan: Planned, monkeypatch: pytest.MonkeyPatch
) -> None:
    strike, x = embedded(robot_plan)
    program = strike.program
    g = program.constraints(x)
    off = np.maximum(program.g_lower - g, g - program.g_upper).max()
    assert off <= 10 * robot_plan.result.max_violation + 1e-5
    assert strike.impulse(x) == pytest.approx(robot_plan.plan.impulse)
    assert program.objective(x) <= robot_plan.result.objective + 1e-4, "its prices are no higher"
    found = optimized(changed(robot_plan.transcription, terms=BODILESS), monkeypatch, start=x)
    assert found.impulse >= robot_plan.plan.impulse - 1e-3
    assert found.result.objective <= robot_plan.result.objective + 1e-3
    assert [attempt.start for attempt in found.attempts] == ["given"]


def test_a_missing_target_asks_for_balance_at_contact(
    biped_transcription: Transcription, monkeypatch: pytest.MonkeyPatch
) -> None:
    missing = Scenario(name="missing", missing=True, capture_margin=0.03)
    t = changed(biped_transcription, scenarios=(missing,))
    found = optimized(t, monkeypatch)
    assert found.status is Status.SOLVED
    hit = found.strike
    at_contact = dataclasses.replace(hit, posture_after=hit.posture, velocity_after=hit.velocity)
    assert at_contact.margins()["capture_margin_m"] >= 0.03 - 1e-4


def test_a_heavier_target_is_predicted_too(
    arm_transcription: Transcription, monkeypatch: pytest.MonkeyPatch
) -> None:
    t = changed(arm_transcription, scenarios=(Scenario(name="heavy", mass=2.0),))
    hit = optimized(t, monkeypatch).strike
    (heavy,) = hit.scenarios
    assert heavy.name == "heavy"
    assert heavy.impulse > hit.impulse
    assert np.abs(heavy.collision.torque / t.robot.torque_limit).max() <= 1 + 1e-4


def test_an_impact_without_duration_has_no_force(
    biped_transcription: Transcription, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = optimized(changed(biped_transcription, collision="rigid"), monkeypatch)
    assert found.status is Status.SOLVED
    summary = found.summary()
    assert (summary["peak_force_N"], summary["contact_ms"]) == (None, 0.0)
    assert set(summary["torque_ratio"]) == set(summary["zmp_margin_m"]) == {"contact"}
    np.testing.assert_allclose(found.strike.posture_after, found.strike.posture)


def test_nor_has_a_fixed_arm_a_torque_in_it(
    arm_transcription: Transcription, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = optimized(changed(arm_transcription, terms=BODILESS, collision="rigid"), monkeypatch)
    assert set(found.strike.margins()["torque_ratio"]) == {"contact"}


def test_a_strike_starts_another_without_its_obstacle(arm_transcription: Transcription) -> None:
    """Whose clearance constraints name bodies that there are not."""
    p = arm_transcription.problem
    low, high = (tuple(p.point + np.array([0.12, -0.1, z])) for z in (-0.2, 0.2))
    rod = Obstacle(name="rod", start=low, end=high, radius=0.02)
    first = optimize_strike(dataclasses.replace(p, obstacles=(rod,), collision="sdc"))
    assert first.clearance_constraints
    assert optimize_strike(p, start=first).status is Status.SOLVED


def test_a_strike_that_does_not_drive_its_nail_is_told(arm_transcription: Transcription) -> None:
    nail, law = Nail(mass=0.05, resistance=1e5, hardening=1e4), KelvinVoigt(stiffness=1e5, damping=100.0)
    problem = dataclasses.replace(arm_transcription.problem, target=nail, law=law)
    found = optimize_strike(problem, options={"max_iterations": 3})
    assert "nail is not driven" in found.summary()["caution"]


# ---- several starts


@pytest.mark.slow
def test_the_best_of_several_starts_is_kept_and_all_are_told(
    arm_transcription: Transcription, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = optimized(arm_transcription, monkeypatch, starts=3, seed=4)
    assert [attempt.start for attempt in found.attempts] == ["reach 1", "reach 2", "reach 3"]
    (kept,) = [attempt for attempt in found.attempts if attempt.kept]
    assert kept.objective == found.result.objective == min(a.objective for a in found.attempts)
    assert kept.impulse == found.impulse
    assert len({attempt.iterations for attempt in found.attempts}) > 1, "the starts are different ones"
    again = optimized(arm_transcription, monkeypatch, starts=3, seed=4)
    assert [a.objective for a in again.attempts] == [a.objective for a in found.attempts]


def test_a_start_that_meets_its_rows_goes_before_one_that_does_not(
    arm_transcription: Transcription, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first start is solved, the second is stopped in its first iterations: the first one is kept."""
    alone: list[int] = []  # iterations of the first start, which may take several runs

    def watch(record: Any) -> bool:
        alone.append(record.iteration)
        return False

    optimized(arm_transcription, monkeypatch, callback=watch)
    seen: list[int] = []

    def stop(record: Any) -> bool:
        seen.append(record.iteration)
        return seen.count(0) == alone.count(0) + 1 and record.iteration == 2

    found = optimized(arm_transcription, monkeypatch, starts=3, callback=stop)
    assert [attempt.status for attempt in found.attempts] == [Status.SOLVED, Status.INTERRUPTED]
    assert [attempt.kept for attempt in found.attempts] == [True, False]


def test_time_is_for_all_starts_together(
    arm_transcription: Transcription, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = optimized(arm_transcription, monkeypatch, starts=100, time_limit=0.05)
    assert len(found.attempts) < 100
    assert found.solve_seconds < 2


def test_bad_input_is_refused(arm_transcription: Transcription, monkeypatch: pytest.MonkeyPatch) -> None:
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"solver": "ipotp"}, "did you mean 'ipopt'"),
        ({"starts": 0}, "starts is 0"),
        ({"starts": 2.0}, "whole number"),
        ({"seed": -1}, "seed is -1"),
        ({"start": np.zeros(3)}, "expected shape"),
        ({"start": np.zeros(3), "starts": 2}, "leave one of the two out"),
    ]
    for options, message in wrong:
        with pytest.raises(InputError, match=message):
            optimized(arm_transcription, monkeypatch, **options)
    with pytest.raises(InputError, match="Impulse"):
        optimized(changed(arm_transcription, objectives=(Effort(),)), monkeypatch)


# ---- the motion's start


def test_a_motion_starts_from_the_strikes_state_at_contact(robot_plan: Planned) -> None:
    t = robot_plan.transcription
    strike, x = embedded(robot_plan)
    start = iterate_from_strike(t, strike, x)
    assert (start >= t.program.x_lower).all() and (start <= t.program.x_upper).all()
    y, y1, _ = (e.evaluate(start) for e in t.contact_state)
    np.testing.assert_allclose(y, strike.y.read(x)[0], atol=1e-6)
    rates, mine = strike.u0.read(x)[0], y1 / t.contact_T.evaluate(start)
    # the motion is a little longer than the start's swing: so fast the arm cannot be in that time
    slower = mine / rates
    assert ((slower >= 0.2 - 1e-6) & (slower <= 1 + 1e-6)).all()
    if t.robot.floating:
        np.testing.assert_allclose(mine, rates, atol=1e-6)
    # the collision is the strike's own: its rows hold at once
    g, names = t.program.constraints(start), [t.program.constraint_name(i) for i in range(t.program.m)]
    hit = [i for i, name in enumerate(names) if name.startswith(("contact law", "collision dynamics"))]
    off = np.maximum(t.program.g_lower - g, g - t.program.g_upper)[hit]
    assert off.max() <= 1e-4
    plain = first_iterate(t)
    assert np.abs(t.u0.read(plain) - t.u0.read(start)).max() > 0.1


def test_a_motion_is_solved_from_several_starts(
    arm_transcription: Transcription, monkeypatch: pytest.MonkeyPatch
) -> None:
    t = arm_transcription
    monkeypatch.setattr("impactopt.planning.solution.block_functions", lambda *_: t.functions)
    found = solve(t.problem, start="strike", starts=2)
    assert found.status is Status.SOLVED
    assert [attempt.start for attempt in found.attempts] == ["strike 1", "strike 2"]
    assert found.result.objective == min(a.objective for a in found.attempts if a.status.usable)
    assert found.clearance()["contacts_besides"] == []
    told = found.summary()["starts"]
    assert [a["kept"] for a in told].count(True) == 1
    json.dumps(told)


def test_no_start_ends_with_bodies_in_each_other(
    arm_transcription: Transcription, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where one of these three would hit harder with the elbow in the target."""
    t = arm_transcription
    monkeypatch.setattr("impactopt.planning.solution.block_functions", lambda *_: t.functions)
    problem = dataclasses.replace(t.problem, point=t.problem.point + np.array([0.0, 0.0, 0.01]))
    found = solve(problem, starts=3)
    assert found.status is Status.SOLVED and found.clearance()["contacts_besides"] == []
    assert all(a.status.usable for a in found.attempts)


@pytest.mark.slow
def test_a_solution_starts_its_neighbour(
    arm_transcription: Transcription, monkeypatch: pytest.MonkeyPatch
) -> None:
    t = changed(arm_transcription, terms=BODILESS)  # whose rows know them as they were at the first one's
    monkeypatch.setattr("impactopt.planning.solution.block_functions", lambda *_: t.functions)
    first = solve(t.problem)
    assert solve(t.problem, start=first).result.iterations == 0
    moved = dataclasses.replace(t.problem, point=t.problem.point + np.array([0.0, 0.0, 0.01]))
    found, plain = solve(moved, start=first), solve(moved, solver="ipopt")
    assert found.status is Status.SOLVED
    assert found.result.objective <= plain.result.objective + 1e-4 * abs(plain.result.objective)


def test_a_start_that_is_none_is_refused(
    arm_transcription: Transcription, hammered: Solution, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(
        InputError, match="a solution of the robot 'planar_arm', and the problem's is 'small arm'"
    ):
        solve(arm_transcription.problem, start=hammered)
    with pytest.raises(InputError, match="did you mean 'strike'"):
        solve(arm_transcription.problem, start="strik")
    with pytest.raises(InputError, match="leave one of the two out"):
        solve(arm_transcription.problem, start=np.zeros(3), starts=2)
    monkeypatch.setattr("impactopt.planning.solution.block_functions", lambda *_: arm_transcription.functions)
    with pytest.raises(InputError, match="start: expected shape"):
        solve(arm_transcription.problem, start=np.zeros(3))


@pytest.mark.parametrize("plan", [solve, optimize_strike])
def test_a_start_with_other_scenarios_is_refused(plan: Any, arm_plan: Planned) -> None:
    """Their collisions have variables, which a solution without them lacks; of a strike, a missed target has
    none.
    """
    solved: dict[str, Any] = {"problem": arm_plan.problem, "result": arm_plan.result, "solver": "ipm"}
    solved |= {"build_seconds": 0.0, "solve_seconds": 0.0, "violations": ()}
    start: Any = Solution(plan=arm_plan.plan, **solved)
    if plan is optimize_strike:
        start = StrikeSolution(strike=arm_plan.plan, **solved)
    others = [(Scenario(name="heavy", mass=2.0),), (Scenario(name="gone", missing=True, abort_after=0.02),)]
    for scenarios in others if plan is solve else others[:1]:
        problem = dataclasses.replace(arm_plan.problem, scenarios=scenarios)
        told = f"solution are none, those of the problem {scenarios[0].name}, .*leave start out"
        with pytest.raises(InputError, match=told):
            plan(problem, start=start)


def test_a_start_with_other_joints_locked_names_them(hammered: Solution) -> None:
    robot = planar_arm(locked={"wrist": 0.47})
    with pytest.raises(InputError, match=r"'planar_arm', with other joints \(wrist\); give one of"):
        solve(dataclasses.replace(hammered.problem, robot=robot), start=hammered)


def test_a_solution_starts_a_problem_with_another_objective(hammered: Solution) -> None:
    """Which has a variable of its own."""
    problem = dataclasses.replace(hammered.problem, objectives=(Impulse(), PeakForce()))
    found = solve(problem, start=hammered, refine=False)
    assert found.status is Status.SOLVED and len(found.objectives) == 2


@pytest.mark.slow
def test_a_solution_starts_problems_with_fewer_and_more_phases_of_contact(hammered: Solution) -> None:
    found = hammered
    for target in (FreeMass(mass=1.0), Board(mass=0.05, stiffness=1e5, breaking_force=50.0)):
        problem = dataclasses.replace(hammered.problem, target=target, objectives=(Impulse(),))
        found = solve(problem, start=found, refine=False)
        assert found.status is Status.SOLVED
        assert found.impulse == pytest.approx(found.validate().impulse, rel=0.01)


def test_a_start_with_another_mesh_or_stance_is_refused(hammered: Solution) -> None:
    finer = dataclasses.replace(hammered.problem, swing=Phase(duration=0.8, intervals=14))
    for problem in (finer, dataclasses.replace(finer, collision="sdc")):
        with pytest.raises(InputError, match=r"intervals of swing.*: 12, 10, of the problem: 14, 10; give"):
            solve(problem, start=hammered)


# ---- the command


def test_the_command_prints_and_writes(
    arm_transcription: Transcription, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    t = arm_transcription
    monkeypatch.setattr("impactopt.planning.strike.block_functions", lambda *_: t.functions)
    monkeypatch.setattr(ProblemFile, "build", lambda self: t.problem)
    (tmp_path / "a.toml").write_text(PROBLEM_FILE, encoding="utf-8")
    runner, command = CliRunner(), ["strike", str(tmp_path / "a.toml"), "--starts", "2"]
    shown = runner.invoke(app, [*command, "--json", "--quiet", "--out", str(tmp_path / "out")])
    assert shown.exit_code == 0, shown.output
    summary = json.loads(shown.stdout)
    assert summary == json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    assert len(summary["starts"]) == 2
    assert set(summary["posture_rad"]) == set(t.robot.joint_names)
    record = load_record(tmp_path / "out")
    assert not record.completed
    assert record.arrays["strike_posture"].shape == (t.robot.model.nq,)
    assert record.arrays["collision_force"].max() == pytest.approx(summary["peak_force_N"])
    table = runner.invoke(app, [*command[:2], "--starts", "1"])
    assert table.exit_code == 0
    assert f"{summary['starts'][0]['impulse_Ns']:.2f}" in table.stdout
    assert f"solved after {summary['starts'][0]['iterations']} iterations" in table.stdout
    assert runner.invoke(app, [*command[:2], "--starts", "0"]).exit_code == 2
    assert runner.invoke(app, [*command[:2], "--time-limit", "1e-6", "--quiet"]).exit_code == 1


def test_objectives_of_the_blow_are_reported(
    biped_transcription: Transcription, monkeypatch: pytest.MonkeyPatch
) -> None:
    t = changed(biped_transcription, objectives=(Impulse(), AngularMomentum(weight=0.1)))
    found = optimized(t, monkeypatch)
    model = t.robot.model
    data = model.createData()
    h = pin.computeCentroidalMomentum(
        model, data, found.strike.posture_after, found.strike.velocity_after
    ).angular
    assert found.objectives["angular momentum after contact, squared"] == pytest.approx(h @ h, abs=1e-3)
    assert found.objectives["impulse"] == found.impulse


def test_a_method_that_is_gone_names_its_replacement() -> None:
    for method in ("shooting", "shoting"):
        with pytest.raises(InputError, match='give "collocation", or leave it out'):
            optimize_strike(arm_problem(), method=method)


def test_ctrl_c_between_iterates_keeps_the_best_one() -> None:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it

    def report(text: str) -> None:
        if text.startswith("program of"):
            signal.raise_signal(signal.SIGINT)

    try:
        found = optimize_strike(arm_problem(), report=report)
    finally:
        signal.signal(signal.SIGINT, before)
    assert found.status is Status.INTERRUPTED and np.isfinite(found.result.x).all()
