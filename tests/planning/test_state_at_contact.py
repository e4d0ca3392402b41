"""One state at contact, one answer: plans, replays and collision models of what a servo follows there."""

from __future__ import annotations

import dataclasses
import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from support.exact import ExactCollision
from support.frozen_cases import slider
from support.native_cases import LAW, X, call, native, robot_named, situation
from support.small_plans import Planned, solution_of
from typer.testing import CliRunner

from impactopt import (
    SDC,
    Effects,
    FreeMass,
    FullDynamics,
    ImpactProblem,
    InputError,
    MujocoDynamics,
    Solution,
    StrikeSolution,
    coasting_reference,
    load_problem,
    load_record,
    optimize_strike,
    solve,
)
from impactopt.cli.app import app
from impactopt.codegen.compiler import find_compiler
from impactopt.collide.contact_states import ContactStates, Posture
from impactopt.collide.single_collision import collide_once, problem_of_result
from impactopt.collision.settings import REFERENCE_ORDER, constant_reference
from impactopt.files.output import record_of, record_of_strike, save_record
from impactopt.files.problem_file import read_problem_file
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.simulation import scene_of, simulate_pinocchio
from impactopt.simulation.cases import errors_against
from impactopt.transcription.plan import PlannedCollision

pytestmark = pytest.mark.filterwarnings("ignore::impactopt.errors.NoCompilerWarning")

Array = NDArray[np.float64]
BEND = np.zeros(REFERENCE_ORDER)
BEND[:3] = -30.0, 400.0, -5e3


# ---------------------------------------------------------------- a reference that bends
@pytest.mark.slow
def test_a_servo_on_a_slide_against_scipy() -> None:
    """One mass, whose servo wants to be elsewhere all the time: m a = kp e + kd de/dt - f."""
    mass, hit, kp, kd, speed = 3.0, 2.0, 4000.0, 60.0, 1.2
    robot = dataclasses.replace(
        slider(mass), kp=np.array([kp]), kd=np.array([kd]), torque_limit=np.array([1e6])
    )
    scene: dict[str, Any] = {"robot": robot, "striker": "tip", "normal": X, "law": LAW}
    scene |= {"target": FreeMass(mass=hit)}
    orders = np.arange(1, REFERENCE_ORDER + 1)

    def motion(t: float, y: Any) -> list[float]:
        x, rate, at, moves = y
        gained, further = (BEND * t**orders).sum(), (BEND * t ** (orders + 1) / (orders + 1)).sum()
        into = rate - moves
        force = LAW.stiffness * (x - at) + LAW.damping * max(into, 0.0)
        servo = kp * (speed * t + further - x) + kd * (speed + gained - rate)
        return [rate, (servo - force) / mass, moves, force / hit]

    def no_force(t: float, y: Any) -> float:
        return y[0] - y[2] if t > 1e-4 else 1.0

    no_force.terminal = True  # type: ignore[attr-defined]
    true = solve_ivp(motion, (0.0, 0.2), [0.0, speed, 0.0, 0.0], events=no_force, rtol=1e-10, atol=1e-13)
    state = ([0.0], [speed], [0.0])
    bend = BEND[None]
    full = FullDynamics(**scene, step=2e-5).collide(*state, reference=bend)
    assert full.impulse == pytest.approx(hit * true.y[3, -1], rel=1e-6)
    assert full.duration == pytest.approx(true.t[-1], rel=1e-5)
    assert full.joint_velocity[-1, 0] == pytest.approx(true.y[1, -1], rel=1e-5)
    straight = FullDynamics(**scene, step=2e-5).collide(*state)
    assert abs(straight.impulse - full.impulse) > 0.02 * full.impulse
    # an acceleration that does not change is all that one freeze takes to be exact
    even = np.zeros_like(bend)
    even[0, 0] = BEND[0]
    exact = FullDynamics(**scene, step=2e-5).collide(*state, reference=even)
    frozen = SDC(**scene, tolerance=1e-9)
    for model in (frozen, ExactCollision(frozen)):
        once = model.collide(*state, reference=even)
        assert once.impulse == pytest.approx(exact.impulse, rel=1e-6), model
        assert once.joint_velocity[-1, 0] == pytest.approx(exact.joint_velocity[-1, 0], rel=1e-5), model
    # what it has gained by then it keeps
    held = {"reference": bend, "reference_until": 0.01}
    stops = FullDynamics(**scene, step=2e-5)
    forces, _ = stops._forces(np.array([speed]), [0.0], held)
    for t in (0.005, 0.03):
        part = min(t, 0.01)
        gain, way = (BEND * part**orders).sum(), (BEND * part ** (orders + 1) / (orders + 1)).sum()
        wanted = kp * (speed * t + way + gain * (t - part)) + kd * (speed + gain)
        assert forces.demand(t, np.zeros(1), np.zeros(1)) == pytest.approx([wanted])
    stopped = stops.collide(*state, **held).impulse
    assert abs(stopped - full.impulse) > 1e-3 * full.impulse
    assert SDC(**scene, freezes=64).collide(*state, **held).impulse == pytest.approx(stopped, rel=1e-3)
    errors = [
        abs(SDC(**scene, freezes=n).collide(*state, reference=bend).impulse / full.impulse - 1)
        for n in (2, 4, 8)
    ]
    assert errors[1] < errors[0] / 2.5 and errors[2] < errors[1] / 2.5 and errors[2] < 1e-3


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
def test_engines_and_batches_agree() -> None:
    """On the small biped, whose reference bends in all joints at random."""
    robot = robot_named("biped")
    scene: dict[str, Any] = {"robot": robot, "striker": "fist", "normal": X, "law": LAW}
    scene |= {"target": FreeMass(mass=1.0)}
    model = SDC(**scene, freezes=32)
    values = situation("biped", model)
    # a servo that does not saturate: MuJoCo's steps meet events late
    q, v, torque = values[0], values[1], 0.2 * values[2]
    bend = values[3 + list(model.settings).index("reference")]
    held = {"reference": bend, "reference_until": 0.02}
    full = FullDynamics(**scene).collide(q, v, torque, **held)
    tree = FullDynamics(**scene, form="pinocchio").collide(q, v, torque, **held)
    assert tree.impulse == pytest.approx(full.impulse, rel=1e-9)
    other, change = MujocoDynamics(**scene).converged(q, v, torque, **held, tolerance=1e-3)
    assert other.impulse == pytest.approx(full.impulse, abs=4 * change)
    once = model.collide(q, v, torque, **held)
    assert once.impulse == pytest.approx(full.impulse, rel=2e-3)
    straight = model.collide(q, v, torque)
    assert abs(straight.impulse - once.impulse) > 10 * abs(once.impulse - full.impulse)
    outputs = ("impulse", "joint_velocity")
    three = {"reference": np.stack([bend, 0 * bend, bend]), "reference_until": np.array([0.02, 0.1, 0.02])}
    rows = model.batch([q] * 3, [v] * 3, torque, outputs=outputs, **three)
    assert rows["impulse"] == pytest.approx([once.impulse, straight.impulse, once.impulse], rel=1e-9)
    last = rows["joint_velocity"][0, -1]
    np.testing.assert_allclose(last, once.joint_velocity[-1], rtol=1e-9, atol=1e-9)
    function = native(model, ("velocity",))
    found = call(function, [q, v, torque, *{**model.settings, **held}.values()])
    # histories of joint velocities are not relative to the reference, as the state is
    np.testing.assert_allclose(once.joint_velocity[-1], found["velocity"].ravel()[-robot.n :], atol=2e-2)


def test_who_has_no_reference_says_so() -> None:
    scene: dict[str, Any] = {"robot": robot_named("arm"), "striker": "hand", "normal": X, "law": LAW}
    scene |= {"target": FreeMass(mass=1.0)}
    assert "reference" not in SDC(**scene, effects=Effects.paper()).settings
    assert "reference" in SDC(**scene).settings
    with pytest.raises(InputError, match="reference"):
        SDC(**scene).settings.override({"reference": np.zeros((4, 2))})


# ---------------------------------------------------------------- that of a plan
def turning(c: StanceCoordinates, q: Any, seed: int) -> Any:
    """A velocity with the soles at rest."""
    rng = np.random.default_rng(seed)
    y, legs = c.split(q)
    return c.complete_motion(y, rng.normal(scale=0.25, size=c.ny), np.zeros(c.ny), legs)[1]


@pytest.mark.parametrize("until", [0.02, 0.1])
def test_soles_stay_where_they_are(until: float) -> None:
    """The legs' angles by the fit, the base by its own constant rates: the soles' frames do not move."""
    robot = robot_named("biped")
    q = robot.posture("half_sitting")
    c = StanceCoordinates(robot, robot.soles, q)
    v = turning(c, q, 3)
    given = coasting_reference(c, q, v, until=until)
    bend, until = given["reference"], float(given["reference_until"])
    assert bend.shape == (robot.n, REFERENCE_ORDER)
    assert np.abs(bend[c.independent]).max() == 0 and np.abs(bend[c.dependent]).max() > 1
    model, data = robot.model, robot.model.createData()
    orders = np.arange(1, REFERENCE_ORDER + 1)
    y, _ = c.split(q)
    # rates of the base's coordinates, by differences
    step = 1e-6
    ahead, behind = (c.split(pin.integrate(model, q, s * step * v))[0] for s in (1, -1))
    rates = (ahead - behind) / (2 * step)
    for t in np.linspace(0.0, until, 7):
        joints = (
            robot.joint_positions(q) + v[-robot.n :] * t + (bend * t ** (orders + 1) / (orders + 1)).sum(1)
        )
        pin.framesForwardKinematics(model, data, c.join(y + rates * t, joints[c.dependent]))
        for leg in c.legs:
            off = pin.log6(leg.placement.actInv(data.oMf[model.getFrameId(leg.sole.frame)])).vector
            assert np.abs(off).max() < 1e-5, t
        straight = robot.joint_positions(q) + v[-robot.n :] * t
        pin.framesForwardKinematics(model, data, c.join(y + rates * t, straight[c.dependent]))
    off = [
        pin.log6(leg.placement.actInv(data.oMf[model.getFrameId(leg.sole.frame)])).vector for leg in c.legs
    ]
    assert np.abs(off).max() > 1e-4  # with constant joint velocities they do


def test_it_is_what_a_plans_servo_is_given(biped_plan: Planned) -> None:
    ref, robot = biped_plan.trajectory, biped_plan.problem.robot
    last = int(np.flatnonzero(ref.phase == 0)[-1])
    there = ref.phase == 1
    time = ref.time[there] - ref.contact_start
    found = coasting_reference(biped_plan.problem.coordinates, ref.q[last], ref.v[last], until=2 * time[-1])
    bend = found["reference"]
    assert found["reference_until"] >= time[-1]
    orders = np.arange(1, REFERENCE_ORDER + 1)
    gained = (bend * time[:, None, None] ** orders).sum(axis=2)
    given = ref.v[there][:, -robot.n :] - ref.v[last, -robot.n :]
    assert np.abs(given).max() > 0.01
    np.testing.assert_allclose(gained, given, atol=1e-4 * np.abs(given).max() + 1e-9)
    np.testing.assert_allclose(ref.a[there][0, -robot.n :], bend[:, 0], atol=1e-6)


def test_references_that_cannot_be() -> None:
    robot = robot_named("biped")
    q = robot.posture("half_sitting")
    c = StanceCoordinates(robot, robot.soles, q)
    with pytest.raises(InputError, match="until"):
        coasting_reference(c, q, np.zeros(robot.nv), until=0.0)
    with pytest.raises(InputError):
        coasting_reference(c, q[:-1], np.zeros(robot.nv))
    # legs that are soon too short bend as long as they reach
    v = turning(c, q, 0)
    v = c.complete_motion(c.split(q)[0], np.r_[0, 0, 5.0, np.zeros(c.ny - 3)], np.zeros(c.ny), c.split(q)[1])[
        1
    ]
    found = coasting_reference(c, q, v, until=1.0)
    assert np.isfinite(found["reference"]).all() and 0 < found["reference_until"] < 0.5
    arm = robot_named("arm")
    on_base = StanceCoordinates(arm, (), arm.posture("start"))
    none = coasting_reference(on_base, arm.posture("start"), np.ones(arm.nv))
    assert not none["reference"].any() and none.keys() == constant_reference(arm.n).keys()


# ---------------------------------------------------------------- results of the problems that come with us
# What plan and full dynamics may differ by is what the plan has between its collocation points, of which
# docs/benchmarks.md (truth) has the largest. A motion's ZMP and torque are told on
# elements half as long. A strike's are told at its points alone: torques may be largest between two of them,
# and are compared there.
OF_PLAN = {"impulse_Ns": 5e-3, "zmp_margin_m": 2e-3, "sole_force_N": 0.02}
OF_MOTION = {**OF_PLAN, "torque_ratio": 0.01}
AT_POINTS = 0.02  # of a torque's limit
# The replay gets to contact by its servo, the models are put there.
OF_REPLAY = {"impulse_Ns": 2e-3, "zmp_margin_m": 1e-3, "torque_ratio": 0.01}
PROBLEMS = ("arm_planar", "chop_arm", "punch")


@cache
def solved(name: str) -> Solution:
    return solve(load_problem(name))


@cache
def struck(name: str) -> StrikeSolution:
    return optimize_strike(load_problem(name))


def contact_of(
    kind: str, name: str, request: pytest.FixtureRequest
) -> tuple[ImpactProblem, Any, Any, Any, PlannedCollision]:
    """Problem, q, v and torque at contact, and what the plan says of it."""
    if kind == "strike":
        strike = struck(name).strike
        return struck(name).problem, strike.posture, strike.velocity, strike.torque, strike.collision
    shared = {"punch": "punch", "arm_planar": "hammered"}
    solution = request.getfixturevalue(shared[name]) if name in shared else solved(name)
    ref = solution.trajectory
    last = int(np.flatnonzero(ref.phase == 0)[-1])
    return solution.problem, ref.q[last], ref.v[last], ref.torque[last], solution.plan.collision


def scene_at(problem: ImpactProblem) -> dict[str, Any]:
    names = ("robot", "striker", "normal", "law", "target", "stance")
    return {name: getattr(problem, name) for name in names}


def saved(kind: str, name: str, folder: Path, punch: Solution | None = None) -> Path:
    file = read_problem_file(name)
    given = {"problem": file.text, "problem_path": file.path}
    if kind == "strike":
        save_record(record_of_strike(struck(name), **given), folder)
        return folder
    solution = punch if name == "punch" and punch else solved(name)
    held = simulate_pinocchio(solution.problem.robot, solution.trajectory, scene_of(solution.problem))
    save_record(record_of(solution, simulation=held, **given), folder)
    return folder


def within(model: dict[str, Any], other: dict[str, Any], bounds: dict[str, float], weight: float) -> None:
    for key, bound in bounds.items():
        if key not in other:
            assert key.startswith(("zmp", "sole")) and "zmp_margin_m" not in model, key
            continue
        size = {"impulse_Ns": other[key], "sole_force_N": weight}.get(key, 1.0)
        assert abs(model[key] - other[key]) <= bound * size, (key, model[key], other[key])


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("kind", ["solve", "strike"])
@pytest.mark.parametrize("name", PROBLEMS)
def test_a_result_has_one_answer(name: str, kind: str, tmp_path: Path, punch: Solution) -> None:
    result = saved(kind, name, tmp_path / "result", punch)
    file = problem_of_result(result)
    robot = load_problem(name).robot
    weight = 9.81 * sum(body.mass for body in robot.model.inertias)

    def answer(model: str, **more: Any) -> dict[str, Any]:
        return collide_once(file, {"result": str(result), "model": model, **more})

    full = answer("full")
    assert set(full["saved"]) == ({"planned", "simulated"} if kind == "solve" else {"planned"})
    within(full, full["saved"]["planned"], OF_MOTION if kind == "solve" else OF_PLAN, weight)
    if kind == "solve":
        within(full, full["saved"]["simulated"], OF_REPLAY, weight)
    often = answer("sdc", freezes=8)
    assert often["saved"] == full["saved"] and "frozen at contact and 8 times" in often["believe"]
    # its own error is less than what four more freezes change, and is tested as histories below
    within(
        often,
        full,
        {"impulse_Ns": 2e-3, "zmp_margin_m": 2e-3, "sole_force_N": 0.02, "torque_ratio": 0.02},
        weight,
    )
    # models that leave out the servo's stiffness, feed-forward and more say that it is theirs
    # (the paper's steps are too long for the arms' contacts, and refused)
    for model in ("virtual-mass", *(["sdc-paper"] if robot.floating else [])):
        assert "trust the plan" in answer(model)["believe"]


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("arm_planar", "solve"),
        ("chop_arm", "strike"),
        *(pytest.param("punch", kind, marks=pytest.mark.slow) for kind in ("solve", "strike")),
    ],
)
def test_torques_of_a_plan_are_those_of_full_dynamics(
    name: str, kind: str, request: pytest.FixtureRequest
) -> None:
    """Of each joint, at the plan's collocation points."""
    problem, q, v, torque, hit = contact_of(kind, name, request)
    bend = coasting_reference(problem.coordinates, q, v, until=2 * hit.time[-1])
    full = FullDynamics(**scene_at(problem), step=1e-4).collide(q, v, torque, **bend)
    at = hit.time < full.time[-1]
    assert at.sum() >= len(at) - 1
    there = np.stack([np.interp(hit.time[at], full.time, joint) for joint in full.demand.T], axis=1)
    assert np.abs((hit.torque[at] - there) / problem.robot.torque_limit).max() < AT_POINTS


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("kind", ["solve", "strike"])
def test_what_is_left_is_the_models_own(kind: str, request: pytest.FixtureRequest) -> None:
    """Of the demo's punch: force, ZMP and torque at all times; errors fall with the number of freezes."""
    problem, q, v, torque, hit = contact_of(kind, "punch", request)
    scene = scene_at(problem)
    bend = coasting_reference(problem.coordinates, q, v, until=2 * hit.time[-1])
    full = FullDynamics(**scene, step=1e-4).collide(q, v, torque, **bend)

    def errors(freezes: int, **settings: Any) -> Any:
        found = SDC(**scene, freezes=freezes).collide(q, v, torque, **settings)
        told = errors_against(found, full, torque_limit=problem.robot.torque_limit)
        return np.abs([told[name] for name in ("impulse_error_pct", "zmp_error_mm", "torque_error_pct")])

    few, more = errors(4, **bend), errors(16, **bend)
    # of second order: a sixteenth; between instants that are told, and at events, less is gained
    assert (more < few / 4).all(), (few, more)
    # a servo that follows constant joint velocities is no error that freezes reduce
    assert (errors(16)[1:] > 20 * more[1:]).all()
    # the plan's own numbers at its collocation points
    at = np.flatnonzero(hit.time[1:] < full.time[-1])
    wrench = np.stack([np.interp(hit.time[1:][at], full.time, w) for w in full.ground_wrench.T], axis=1)
    own = hit.ground[at]
    moved = (
        np.stack([-own[:, 4], own[:, 3]], 1) / own[:, 2:3]
        - np.stack([-wrench[:, 4], wrench[:, 3]], 1) / wrench[:, 2:3]
    )
    assert np.abs(moved).max() < 2e-3
    force = np.interp(hit.time[1:][at], full.time, full.force)
    assert np.abs(hit.force[1:][at] - force).max() < 5e-3 * full.peak_force


@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
def test_a_slower_result_bends_the_same_way(tmp_path: Path, biped_plan: Planned) -> None:
    problem, ref = biped_plan.problem, biped_plan.trajectory
    save_record(record_of(solution_of(biped_plan)), tmp_path)
    states = ContactStates(
        robot=problem.robot,
        striker=problem.striker,
        stance=problem.stance,
        start=problem.start_posture,
        folder=tmp_path,
    )
    posture = states.posture("reach", str(tmp_path), tuple(problem.point))
    assert isinstance(posture, Posture) and posture.v is not None
    whole = states.compute(posture, {}, None, problem.normal, 1)
    scaled = states.compute(posture, {}, 0.8 * whole.speed, problem.normal, 1)
    c, last = problem.coordinates, int(np.flatnonzero(ref.phase == 0)[-1])
    anew = coasting_reference(c, ref.q[last], 0.8 * ref.v[last], until=2 * biped_plan.plan.collision.time[-1])
    time = np.linspace(0, 0.05, 6)[:, None, None]
    orders = np.arange(1, REFERENCE_ORDER + 1)
    gained, again = (
        (x * time**orders).sum(axis=2) for x in (scaled.reference_settings["reference"][0], anew["reference"])
    )
    np.testing.assert_allclose(gained, again, atol=2e-4)  # of two fits
    assert np.abs(again).max() > 0.1 and scaled.reference_settings["reference_until"][0] > 0.05
    assert states.posture("half_sitting", None, tuple(problem.point)).reference is None  # type: ignore[union-attr]


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
def test_the_command_shows_both(tmp_path: Path) -> None:
    result = saved("solve", "arm_planar", tmp_path / "arm")
    runner = CliRunner()

    def run(*options: str) -> str:
        done = runner.invoke(app, ["collide", str(result), "-q", *options])
        assert done.exit_code == 0, done.output
        return done.stdout

    shown = run()
    for text in ("freezes = 16", "planned", "simulated", "errors of this model"):
        assert text in " ".join(shown.split()), text
    assert "trust the plan" in " ".join(run("--model", "virtual-mass").split())
    found = json.loads(run("--json"))
    assert found["freezes"] == 16 and json.loads(run("--json", "--freezes", "2"))["freezes"] == 2
    # of another blow, the plan's numbers would mislead
    for changed in (["--speed", "2"], ["--set", "target.mass_kg=0.5"]):
        other = json.loads(run("--json", *changed))
        assert "saved" not in other and "believe" not in other
    record = load_record(result)
    assert record.summary["impulse_Ns"] == found["saved"]["planned"]["impulse_Ns"]
    save_record(dataclasses.replace(record, summary={**record.summary, "status": "infeasible"}), result)
    shown = " ".join(run().split())
    assert "the plan is not solved (infeasible)" in shown and "errors of this model" not in shown
