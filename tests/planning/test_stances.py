"""A motion whose soles lift off and touch down, against Pinocchio, momentum balance and differences."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from support.causes import searched
from support.derivative_checks import check_derivatives
from support.small_plans import BODILESS, biped_problem, transcribed
from support.small_robots import arm, biped

from impactopt import (
    Effort,
    FixedBase,
    ImpactProblem,
    InputError,
    Perturbation,
    Phase,
    Plan,
    Scenario,
    StancePhase,
    TargetBody,
    Trajectory,
    load_problem,
)
from impactopt.files.export.motion import motion_at
from impactopt.files.problem_file import ProblemFile, problem_data
from impactopt.files.record import Record
from impactopt.files.verify import motion_of_record
from impactopt.planning.bounds import bounds_of
from impactopt.planning.diagnosis import with_reason
from impactopt.report.histories import soles_standing, zmp_margins
from impactopt.simulation import ControllerSettings, Simulation, scene_of, simulate_mujoco, simulate_pinocchio
from impactopt.solvers.ipm import solve_ipm
from impactopt.transcription.initial_guess import first_iterate, reached, warm_start
from impactopt.transcription.mesh import NO_MORE, MoreNodes, nodes_to_add
from impactopt.transcription.transcription import Transcription

BOTH = StancePhase(soles=("left", "right"), phase=Phase(duration=(0.4, 0.9), intervals=6, grading=1.0))
AHEAD = {"right": (0.06, -0.02)}  # [m]
STEPS = (BOTH, StancePhase(soles=("left",)), dataclasses.replace(BOTH, steps=AHEAD))


def changed_nodes(program: Transcription, nodes: MoreNodes) -> Transcription:
    return Transcription(program.problem, program.functions, nodes)


def no_multipliers(program: Transcription) -> tuple[np.ndarray, np.ndarray]:
    return np.zeros(program.program.m), np.zeros(program.program.n)


def stepping(**changes: object) -> ImpactProblem:
    missing = Scenario(name="gone", missing=True, abort_after=0.02)
    usual: dict[str, object] = {"stances": STEPS, "terms": BODILESS, "scenarios": (missing,)}
    return dataclasses.replace(biped_problem(), **{**usual, **changes})


@pytest.fixture(scope="module")
def program() -> Transcription:
    return transcribed(stepping())


@pytest.fixture(scope="module")
def plan(program: Transcription) -> Plan:
    result = solve_ipm(program.program, first_iterate(program))
    assert result.status.usable, result.message
    return program.decode(result.x)


@pytest.fixture(scope="module")
def ways(plan: Plan) -> tuple[Trajectory, Trajectory]:
    hit = plan.trajectory()
    return hit, plan.trajectory(missed=True, known=hit)


@pytest.fixture(scope="module")
def held(plan: Plan, ways: tuple[Trajectory, Trajectory]) -> Simulation:
    return simulate_pinocchio(plan.problem.robot, ways[0], scene_of(plan.problem), settle=0.1)


@pytest.mark.slow
def test_a_duration_that_would_have_to_be_longer_is_that_of_its_phase(program: Transcription) -> None:
    (bound,) = (b for b in bounds_of(program) if b.name == "stance0")
    x = first_iterate(program)
    x[bound.variables] = 1.5 / 0.1  # durations of motions are in tenths of a second
    (cause,) = bound.causes(x)
    assert (
        cause.text.startswith("stance phase 1: 1.5")
        and "s instead of 0.9 s ([[stances]] number 1" in cause.text
    )
    assert cause.problem is not None and cause.problem.stances[0].phase is not None
    assert cause.problem.stances[0].phase.duration[1] == pytest.approx(1.5, rel=0.05)
    assert cause.problem.stances[1:] == program.problem.stances[1:]


@pytest.mark.slow
def test_a_step_without_the_time_for_it_names_its_phase() -> None:
    """The search has to lengthen stance phases, too: with 0.2 s the foot does not come 6 cm ahead."""
    step = StancePhase(soles=("left",), phase=Phase(duration=0.2, intervals=6, grading=1.0))
    landed = StancePhase(soles=("left", "right"), steps=AHEAD)
    swing = Phase(duration=(0.4, 0.8), intervals=6)  # no bound that a cause would have to move
    t, result, found = searched(stepping(stances=(BOTH, step, landed), scenarios=(), swing=swing))
    message = with_reason(t, result, found.causes).message
    assert message.startswith("Infeasible: time. stance phase 2: ")
    longer = found.causes[0].problem
    assert longer is not None and longer.stances[0] == BOTH and longer.stances[2] == landed
    assert longer.stances[1].phase is not None and longer.stances[1].phase.duration[0] > 0.2


@pytest.mark.slow
def test_an_initial_guess_has_no_straight_leg_at_contact() -> None:
    """Near a straight knee, where this contact posture is, the legs' rates grow without bound."""
    problem = load_problem("punch_step")
    steps = dataclasses.replace(problem.stances[-1], steps={"left": (0.28, 0.0)})
    problem = dataclasses.replace(problem, stances=(*problem.stances[:-1], steps))
    c = problem.coordinates
    assert c.leg_extension(c.split(problem.contact_posture)[1]).min() < 0.05
    t = transcribed(problem)
    values = t.program.constraints(first_iterate(t))
    worst = np.maximum(t.program.g_lower - values, values - t.program.g_upper).max()
    assert worst < 10  # 5800 with the straight leg


@pytest.mark.slow
def test_a_leg_of_an_initial_guess_bends_as_at_the_start() -> None:
    """The contact posture has the knee of the standing leg just behind the straight leg."""
    problem = load_problem("kick_g1")
    # without a target's body, which would be in the leg at the start
    point, body = problem.point + np.array([-0.1, 0.0, 0.44]), TargetBody(shape="none")
    problem = dataclasses.replace(problem, point=point, body=body)
    c = problem.coordinates
    assert c.leg_extension(c.split(problem.contact_posture)[1]).min() < 0
    assert c.leg_extension(reached(transcribed(problem)).legs).min() > 0


@pytest.mark.slow
def test_effort_after_a_stance_phase_has_the_first_node_of_the_swing() -> None:
    """The objective's value is the trapezoidal sum of all nodes of swing and follow-through."""
    t = transcribed(stepping(objectives=(Effort(weight=1.0),)))
    x = t.with_lifted(first_iterate(t))
    expected = 0.0
    for profile in t.torque_profiles()[:2]:
        of_node = [np.sum(tau.evaluate(x) ** 2) for tau in profile.torques]
        expected += float(profile.T.evaluate(x)[0] * np.trapezoid(of_node, profile.nodes))
    assert t.achieved(x)["effort"] == pytest.approx(expected)


@pytest.mark.slow
def test_derivatives_are_those_of_differences(program: Transcription) -> None:
    # and of a blow on two feet, after a step on the left one and before one on the right one
    left, right = (dataclasses.replace(BOTH, soles=(name,)) for name in ("left", "right"))
    steps = (BOTH, left, StancePhase(soles=("left", "right"), steps=AHEAD), right, BOTH)
    for t in (program, transcribed(stepping(stances=steps))):
        x = first_iterate(t)
        check_derivatives(t.program, x + 0.01 * np.random.default_rng(1).standard_normal(len(x)))


@pytest.mark.slow
def test_soles_stand_in_their_places_in_their_phases_and_are_in_the_air_between(
    plan: Plan, ways: tuple[Trajectory, Trajectory]
) -> None:
    robot, data = plan.problem.robot, plan.problem.robot.model.createData()
    frames = [robot.model.getFrameId(sole.frame) for sole in plan.problem.soles]
    pin.framesForwardKinematics(robot.model, data, plan.problem.start_posture)
    start = [data.oMf[frame].copy() for frame in frames]
    ahead = pin.SE3(start[1].rotation, start[1].translation + np.append(AHEAD["right"], 0.0))
    for way in ways:
        heights, beside = np.zeros(len(way.time)), np.zeros(len(way.time))
        for i, q in enumerate(way.q):
            pin.framesForwardKinematics(robot.model, data, q)
            on = plan.problem.standing[way.stance[i]]
            places = [start[0], ahead if way.stance[i] == 2 else start[1]]
            for k in np.flatnonzero(on):
                assert np.abs(pin.log6(places[k].actInv(data.oMf[frames[k]])).vector).max() < 1e-6
            heights[i] = data.oMf[frames[1]].translation[2]
            beside[i] = np.abs(data.oMf[frames[1]].translation - ahead.translation)[:2].max()
        stands = way.stance != 1
        change = np.flatnonzero(np.diff(way.stance))
        assert way.stance[0] == 0 and way.stance[-1] == 2 and len(change) == 2
        late = ~stands & (way.time > way.time[change[0]] + 0.2) & (way.time < way.time[change[1]] - 0.2)
        assert heights[late].min() > 0.009  # a node's least height is 10 mm
        assert heights[~stands].min() > -1e-4
        landing = ~stands & (way.time > way.time[change[1]] - 0.1)
        assert beside[landing].max() < 4e-3  # it comes down from above: 20 mm x (0.1 / 0.2)^3 at most


def test_posture_rates_and_torques_go_on_where_soles_change(ways: tuple[Trajectory, Trajectory]) -> None:
    for way in ways:
        for k in np.flatnonzero(np.diff(way.stance)):
            h = way.time[k + 1] - way.time[k]
            rates = (way.v[k + 1] - way.v[k]) / h
            # as everywhere: what they change by is what accelerations say
            assert np.abs(rates - (way.a[k] + way.a[k + 1]) / 2).max() < 0.5
            assert np.abs(way.a[k + 1] - way.a[k]).max() < 3.0
            assert np.abs(way.torque[k + 1] - way.torque[k]).max() < 3.0


def test_the_sole_that_changes_bears_nothing_there_and_stays_in_its_cone(
    plan: Plan, ways: tuple[Trajectory, Trajectory]
) -> None:
    cone = plan.problem.robot.sole("right").polygon
    for way in ways:
        wrench = way.sole_wrench.reshape(len(way.time), 2, 6)[:, 1]
        assert not wrench[way.stance == 1].any()
        lifted, landed = np.flatnonzero(np.diff(way.stance))
        assert np.abs(wrench[[lifted, landed + 1]]).max() < 10.0
        assert wrench[:, 2].min() > -1e-6
        loaded = wrench[wrench[:, 2] > 20.0]
        cop = np.stack([-loaded[:, 4], loaded[:, 3]], axis=1) / loaded[:, 2:3]
        assert (cop > cone.min(axis=0)).all() and (cop < cone.max(axis=0)).all()
        assert wrench[0, 2] > 50.0 and wrench[-1, 2] > 50.0


def test_momentum_is_that_of_gravity_and_the_soles_in_every_phase(
    plan: Plan, ways: tuple[Trajectory, Trajectory]
) -> None:
    robot, data = plan.problem.robot, plan.problem.robot.model.createData()
    mass = sum(inertia.mass for inertia in robot.model.inertias)
    for way in ways:
        for i in np.flatnonzero(way.phase != 1)[::7]:
            pin.computeCentroidalMomentumTimeVariation(robot.model, data, way.q[i], way.v[i], way.a[i])
            pin.framesForwardKinematics(robot.model, data, way.q[i])
            force = pin.Force(mass * np.array([0.0, 0.0, -9.81]), np.zeros(3))
            about = pin.SE3(np.eye(3), data.com[0])
            for k, sole in enumerate(plan.problem.soles):
                place = data.oMf[robot.model.getFrameId(sole.frame)]
                own = pin.Force(way.sole_wrench[i, 6 * k : 6 * k + 6])
                force += about.actInv(place.act(own))
            np.testing.assert_allclose(data.dhg.vector, force.vector, atol=1e-9 * mass * 9.81 * 10)


@pytest.mark.slow
def test_a_replay_that_holds_the_soles_by_the_schedule_does_what_is_planned(
    plan: Plan, ways: tuple[Trajectory, Trajectory], held: Simulation
) -> None:
    assert held.impulse == pytest.approx(plan.impulse, rel=0.01)
    assert max(plan.landing_speeds().values()) < 1e-6
    assert held.landing_speed[1] < 0.01 and np.isnan(held.landing_speed[0])
    assert held.posture_error < 2e-3 and held.slip.max() < 1e-4 and held.lift.max() < 1e-4
    assert not held.sole_ground[held.stance == 1, 1].any()
    numbers = held.summary(
        torque_limit=plan.problem.robot.torque_limit, polygon=plan.polygon, planned_impulse=plan.impulse
    )
    assert numbers["landing_speed_m_s"].keys() == {"right"}
    planned, found = plan.margins()["zmp_margin_m"], numbers["zmp_margin_m"]
    assert found["swing"] == pytest.approx(planned["swing"], abs=1e-3)
    assert found["follow"] > planned["follow"] - 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("missing", [False, True])
def test_the_whole_body_controller_follows_the_schedule_on_free_soles(
    plan: Plan, ways: tuple[Trajectory, Trajectory], missing: bool
) -> None:
    robot, world = plan.problem.robot, Perturbation(missing=missing)
    done = simulate_mujoco(
        robot,
        ways[0],
        scene_of(plan.problem),
        step=5e-4,
        settle=0.5,
        missed=ways[1],
        perturbation=world,
        controller=ControllerSettings(),
    )
    assert done.standing, done.reason
    assert done.landing_speed[1] < 0.05 and done.slip.max() < 5e-3
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, done.q[-1])
    for leg in plan.problem.stance_coordinates[-1].legs:  # it stands where it was to step
        place = data.oMf[robot.model.getFrameId(leg.frame)]
        np.testing.assert_allclose(place.translation, leg.placement.translation, atol=5e-3)


def test_nodes_are_added_in_phases_beside_the_one_with_the_blow(plan: Plan, program: Transcription) -> None:
    more = nodes_to_add(plan, NO_MORE)  # of six intervals, some margin is gone between two nodes
    assert len(more.stands) == 3 and not more.stands[1] and any(more.stands)
    finer = changed_nodes(program, more)
    names = set(finer.layout.groups)
    assert finer.program.n > program.program.n and names == set(program.layout.groups)
    x = warm_start(finer, program, first_iterate(program), *no_multipliers(program))[0]
    assert np.abs(finer.decode(x).before[0].spline.control).max() > 0.1


def test_what_is_said_of_each_phase(plan: Plan) -> None:
    stances = plan.stances()
    assert [each["soles"] for each in stances] == [["left", "right"], ["left"], ["left", "right"]]
    assert stances[0]["from_s"] == 0.0 and stances[-1]["to_s"] == pytest.approx(plan.duration)
    assert stances[0]["to_s"] == stances[1]["from_s"] < plan.contact_start < stances[1]["to_s"]
    margins = plan.sole_margins()
    # next to no force on a sole that is about to lift is no shortfall
    assert margins["sole_force_N"]["right"] == {}
    assert margins["sole_cop_margin_mm"]["left"].keys() == {"swing", "collision", "follow", "missed"}


@pytest.mark.parametrize(
    ("stances", "message"),
    [
        ((BOTH, StancePhase(soles=("left",), phase=Phase(duration=0.5))), "the impact is in one phase"),
        ((BOTH, StancePhase(soles=("left",)), StancePhase(soles=("left", "right"))), "but 2 of"),
        ((StancePhase(soles=("left",)),), "no sequence"),
        ((BOTH, StancePhase(soles=("left", "right"))), "lift off or to touch down"),
        (
            (StancePhase(soles=("left",), phase=Phase(duration=0.5)), StancePhase(soles=("right",))),
            "not both",
        ),
        ((BOTH, StancePhase(soles=("middle",))), "no sole 'middle'"),
        ((BOTH, "left"), "tuple of StancePhase"),
        ((*STEPS[:2], dataclasses.replace(BOTH, steps={"left": (0.1, 0.0)})), "right touches down"),
        ((dataclasses.replace(BOTH, steps=AHEAD), *STEPS[1:]), "no sole touches down"),
        ((*STEPS[:2], dataclasses.replace(BOTH, steps={"right": (1.5, 0.0)})), "do not reach"),
        ((*STEPS[:2], dataclasses.replace(BOTH, steps={"right": (0.0, 0.19)})), "left and right overlap"),
    ],
)
def test_what_is_no_schedule_is_refused(stances: tuple[StancePhase, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        stepping(stances=stances)


def test_what_is_no_phase_is_refused() -> None:
    with pytest.raises(InputError, match="has no soles"):
        StancePhase(soles=())
    with pytest.raises(InputError, match="each once"):
        StancePhase(soles=("left", "left"))
    with pytest.raises(InputError, match="must be a Phase"):
        StancePhase(soles=("left",), phase=0.5)  # type: ignore[arg-type]
    for step, message in (((0.1,), "shape"), ((np.nan, 0.0), "nan"), ((300.0, 0.0), "at most 2")):
        with pytest.raises(InputError, match=rf"the step of sole 'left'.*{message}"):
            StancePhase(soles=("left",), steps={"left": step})
    with pytest.raises(InputError, match="a table by sole's name"):
        StancePhase(soles=("left",), steps=(0.1, 0.0))  # type: ignore[arg-type]


def test_steps_add_up() -> None:
    # right, left, right: each from where it stood before
    right, left = (dataclasses.replace(BOTH, soles=(name,)) for name in ("right", "left"))
    steps = (BOTH, left, dataclasses.replace(BOTH, steps=AHEAD), right, StancePhase(soles=("left", "right")))
    steps = (*steps, left, dataclasses.replace(BOTH, steps=AHEAD))
    c = stepping(stances=steps).stance_coordinates
    at = np.array([[leg.placement.translation for leg in c[k].legs] for k in (0, 2, 4, 6)])
    moved = np.array([0.0, 1.0, 1.0, 2.0])[:, None] * [*AHEAD["right"], 0.0]
    np.testing.assert_allclose(at[:, 1] - at[0, 1], moved, atol=1e-12)
    np.testing.assert_allclose(at[:, 0], at[[0] * 4, 0], atol=1e-12)
    np.testing.assert_allclose(c[3].legs[0].placement.translation - at[0, 1], moved[1], atol=1e-12)


def test_a_robot_without_soles_to_lift_is_refused() -> None:
    with pytest.raises(InputError, match="leave `stances` out"):
        ImpactProblem(
            robot=arm(),
            striker="hand",
            start="start",
            stance=FixedBase(),
            stances=STEPS,
            point=np.zeros(3),
            normal=[0.0, 1.0, 0.0],
            law=biped_problem().law,
            target=biped_problem().target,
        )


def test_the_first_phase_has_to_carry_the_start_posture() -> None:
    one = StancePhase(soles=("right",), phase=Phase(duration=0.5))
    with pytest.raises(InputError, match="support polygon of right"):
        stepping(stances=(one, StancePhase(soles=("left", "right"))))


def test_the_stance_of_a_problem_is_that_of_the_blow() -> None:
    problem = stepping()
    assert problem.stance.sole_names(problem.robot) == ("left",)
    assert [sole.name for sole in problem.soles] == ["left", "right"]
    assert problem.hash != stepping(stances=STEPS[:2]).hash
    assert biped_problem(biped()).hash == dataclasses.replace(biped_problem(biped()), stances=()).hash


@pytest.mark.slow
@pytest.mark.parametrize("first", [False, True], ids=["ends", "begins"])
def test_a_foot_that_is_lifted_for_the_blow_at_the_end_or_the_start_stays_off_the_ground(first: bool) -> None:
    """In a sequence of one phase, the follow-through or the swing, too."""
    stances, start = STEPS[:2], biped_problem().start
    if first:
        stances, start = (StancePhase(soles=("left",)), BOTH), stepping().change_posture(0)
    problem = stepping(stances=stances, start=start)
    program = transcribed(problem)
    result = solve_ipm(program.program, first_iterate(program))
    assert result.status.usable, result.message
    way = program.decode(result.x).trajectory()
    model, sole = problem.robot.model, problem.robot.sole("right")
    data, lowest = model.createData(), []
    for q in way.q:
        pin.framesForwardKinematics(model, data, q)
        place = data.oMf[model.getFrameId(sole.frame)]
        lowest.append(min(place.act(np.array([*corner, 0.0]))[2] for corner in sole.polygon))
    height, lifted = np.array(lowest), ~problem.standing[way.stance, 1]
    change = way.time[np.argmax(way.stance == 1)]
    # 10 mm at nodes, from 0.2 s after lift-off until 0.2 s before touch-down
    since, until = (0.0, change) if first else (change, np.inf)
    late = lifted & (way.time > since + 0.2) & (way.time < until - 0.2)
    assert height[late].min() > 0.009
    assert height[lifted].min() > -1e-4


# ---- what is made of such a plan


def test_a_verdict_holds_the_soles_of_each_phase_to_their_places(
    plan: Plan, ways: tuple[Trajectory, Trajectory]
) -> None:
    arrays = {f"reference_{f.name}": getattr(ways[0], f.name) for f in dataclasses.fields(ways[0])}
    found = list(motion_of_record(plan.problem, arrays))
    worst = max(found, key=lambda off: off[1])
    assert worst[1] < 2e-2, worst  # [1] of its size: what a program's tolerance leaves
    assert max(off for name, off, _ in found if name.endswith("fixed soles")) < 1e-6
    moved = {**arrays, "reference_stance": np.zeros_like(ways[0].stance)}
    assert max(off for name, off, _ in motion_of_record(plan.problem, moved) if "fixed soles" in name) > 0.01


def test_an_export_says_which_sole_stands(plan: Plan, ways: tuple[Trajectory, Trajectory]) -> None:
    robot = plan.problem.robot
    for jumps in (True, False):
        motion = motion_at(ways[0], robot, 500.0, np.arange(robot.n), {}, jumps=jumps)
        assert motion.stance is not None
        changes = motion.time[np.flatnonzero(np.diff(motion.stance)) + 1]
        planned = [each["from_s"] for each in plan.stances()[1:]]
        np.testing.assert_allclose(changes, planned, atol=2e-3)


def test_a_problem_file_has_the_phases() -> None:
    for name in ("punch_step", "kick_talos"):
        problem = load_problem(name)
        again = ProblemFile.from_data(problem_data(problem), Path("again.toml")).build()
        assert again.hash == problem.hash and again.stances == problem.stances
    data = problem_data(problem)
    for stances, message in (
        ([{"soles": ["left"], "duration_s": 1.0}], "the impact is in one phase"),
        ([{"soles": []}, *data["stances"]], "no soles"),
        ([{"soles": ["left"], "intervals": 8}, *data["stances"]], "no duration_s"),
        ([*data["stances"], {"soles": ["up"], "duration_s": 1.0}], "no sole 'up'"),
    ):
        with pytest.raises(InputError, match=message):
            ProblemFile.from_data({**data, "stances": stances}, Path("wrong.toml")).build()
    with pytest.raises(InputError, match=r"\[stance\] is one stance"):
        ProblemFile.from_data({**data, "stance": {"soles": "left"}}, Path("both.toml")).build()


def test_a_page_draws_the_margin_to_what_stands(plan: Plan, ways: tuple[Trajectory, Trajectory]) -> None:
    arrays = {"polygon": plan.polygon}
    for leg in plan.problem.stance_coordinates[0].legs:
        corners = np.column_stack([leg.sole.polygon, np.zeros(4)])
        arrays[f"sole_{leg.name}"] = (corners @ leg.placement.rotation.T + leg.placement.translation)[:, :2]
    record = Record(summary={"stances": plan.stances()}, arrays=arrays)
    away = ways[0].phase != 1
    time, ground = ways[0].time[away], ways[0].ground[away]
    standing = soles_standing(record, time)
    np.testing.assert_array_equal(standing["left"], np.ones(len(time), dtype=bool))
    np.testing.assert_array_equal(standing["right"], ways[0].stance[away] != 1)
    drawn, phase = zmp_margins(record, time, ground), ways[0].phase[away]
    for name, number in (("swing", 0), ("follow", 2)):
        assert drawn[phase == number].min() == pytest.approx(plan.margins()["zmp_margin_m"][name], abs=1e-9)
