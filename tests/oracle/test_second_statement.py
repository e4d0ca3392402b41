"""The program written down a second time has the rows, bounds and objective of the first, at any point."""

from __future__ import annotations

import ast
import dataclasses
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from support.small_plans import Planned, arm_problem, biped_problem, changed, transcribed

from impactopt import (
    Actuator,
    Board,
    ContactFriction,
    ContactWrenchCone,
    Effort,
    FirstTouch,
    FreeMass,
    Gaze,
    GearLoad,
    GroundForce,
    KelvinVoigt,
    Objective,
    PeakForce,
    Phase,
    ReferenceRange,
    Scenario,
    Slide,
    SoftGrip,
    SpringDamper,
    StancePhase,
    TargetSpeed,
    Trajectory,
    load_problem,
    solve,
    space_arm,
)
from impactopt.bodies.clearance import Places
from impactopt.files.output import record_of
from impactopt.planning.clearance_constraints import Margins, Watch
from impactopt.robots.couplings import Tendon
from impactopt.transcription.contact_refinement import contact_error
from impactopt.transcription.initial_guess import first_iterate
from impactopt.transcription.mesh import MoreNodes
from impactopt.transcription.transcription import Transcription, statement_of
from oracle.kkt import lagrangian_gradient
from oracle.program import Program, unknown
from oracle.recorded import off_in_record
from oracle.variables import Variables
from oracle.verdict import claims_of, verify_record

PROBLEMS = Path(__file__).resolve().parents[2] / "problems"
ALLOWED = {"bodies", "contact", "errors", "kinematics", "problem", "robots"}
# those of `kinematics` that are numbers alone
NUMBERS = {"impactopt.kinematics.splines", "impactopt.kinematics.stance"}


def test_it_shares_no_code_with_program_and_solver() -> None:
    own = [f for f in Path(__file__).parent.glob("*.py") if not f.name.startswith(("test_", "__main__"))]
    assert len(own) > 5
    for file in own:
        nodes = [n for n in ast.walk(ast.parse(file.read_text("utf-8"))) if isinstance(n, ast.ImportFrom)]
        used = {str(n.module) for n in nodes if str(n.module).startswith("impactopt")}
        assert {name.split(".")[1] for name in used} <= ALLOWED, file
        assert {name for name in used if name.startswith("impactopt.kinematics")} <= NUMBERS, file


def away_from_start(t: Transcription) -> np.ndarray:
    """A point off the initial guess, but for variables that their bounds fix."""
    x, draw = first_iterate(t), np.random.default_rng(0)
    moved = x + 1e-2 * draw.standard_normal(len(x)) * np.clip(np.abs(x), 1e-3, 1.0)
    return np.where(t.program.x_lower == t.program.x_upper, t.program.x_lower, moved)


def second(t: Transcription, x: np.ndarray) -> tuple[Program, Variables]:
    claims = claims_of({"program_statement": np.array(statement_of(t))})
    program = Program(t.problem, claims)
    return program, Variables(claims.groups, program.scales, x)


def check_rows(t: Transcription) -> None:
    x = away_from_start(t)
    program, v = second(t, x)
    assert program.missing == []
    found: dict[tuple[str, str, str], list[tuple[float, float]]] = {}
    for piece in program.rows:
        for name, g, low, high in zip(piece.names, piece.value(v), piece.lower, piece.upper, strict=True):
            if np.isfinite(low) or np.isfinite(high):
                found.setdefault(name, []).append((g - low, high - g))
    g, lower, upper = t.program.constraints(x), t.program.g_lower, t.program.g_upper
    origins = t.constraints.origins
    own = np.array([found[row.term, row.place.name, row.component].pop(0) for row in origins])
    near = np.isclose(own, np.stack([g - lower, upper - g], axis=1), rtol=5e-10, atol=5e-10).all(axis=1)
    assert near.all(), str(origins[int(np.argmin(near))])
    assert not any(found.values())
    worth = sum(float(part.value(v)[0]) for part in program.worth)
    assert worth == pytest.approx(t.program.objective(x), rel=1e-10)
    for name, (low, high) in program.bounds.items():
        if name in v and v.count(name):
            assert v.scaled(name, low) == pytest.approx(t.program.x_lower[v.span(name)])
            assert v.scaled(name, high) == pytest.approx(t.program.x_upper[v.span(name)])
    bounded = np.isfinite(t.program.x_lower) | np.isfinite(t.program.x_upper)
    for name in v.names:
        assert name in program.bounds or not bounded[v.span(name)].any(), name


def test_of_a_robot_on_two_soles(biped_transcription: Transcription) -> None:
    check_rows(biped_transcription)


def test_of_bodies_that_are_kept_apart(biped_transcription: Transcription) -> None:
    t = changed(biped_transcription)
    rows = Watch(t, Margins(dataclasses.replace(t.problem, terms=())), first_iterate(t)).constraints(0.15)
    assert len(rows) > 100
    check_rows(t.with_clearance(rows))


@pytest.mark.parametrize("model", ["full", "sdc"])
@pytest.mark.parametrize("build", [arm_problem, biped_problem])
def test_of_bodies_that_are_kept_apart_in_contact(build: Callable[[], Any], model: str) -> None:
    problem = dataclasses.replace(build(), collision=model)
    t = transcribed(problem, MoreNodes(contact=True))
    rows = Watch(t, Margins(dataclasses.replace(problem, terms=())), first_iterate(t)).constraints(0.5)
    assert any("compression" in row.place for row in rows)
    if model == "full":
        check_rows(t.with_clearance(rows))
    else:  # the oracle does not know frozen models, and says so
        program, _ = second(t.with_clearance(rows), first_iterate(t))
        assert "the model 'sdc' of the collision" in program.missing
        assert any("compression" in what for what in program.missing)
    x = first_iterate(t)
    off = [k for k, o in enumerate(t.constraints.origins) if o.term == "position in contact"]
    assert np.abs(t.program.constraints(x)[off]).max() < 1e-12
    states, plan = [s for s in t.body_states(x) if s.phase == 1], t.decode(x)
    share = (np.array([s.time for s in states]) - plan.contact_start) / plan.collision.time[-1]
    np.testing.assert_allclose(
        [t.coordinates.split(s.q)[0] for s in states], plan.through_contact(share), atol=1e-12
    )


def test_of_bodies_that_are_kept_apart_from_a_target_that_friction_pushes_aside() -> None:
    rough = ContactFriction(coefficient=0.6, moves_target=True)
    t = transcribed(dataclasses.replace(arm_problem(), friction=rough))
    margins = Margins(dataclasses.replace(t.problem, terms=()))
    rows = Watch(t, margins, away_from_start(t)).constraints(0.5)
    assert any(key.other < 0 and t.problem.bodies.world[-1 - key.other].moves for key in rows)
    check_rows(t.with_clearance(rows))


@pytest.mark.parametrize("make", [arm_problem, biped_problem])
def test_of_tendons(make: Any) -> None:
    p = make()
    two = dict(zip(p.robot.joint_names, (0.5, -0.25), strict=False))
    tendon = Tendon(name="t", coefficients=two, lower=-2.0, upper=0.7)
    check_rows(transcribed(dataclasses.replace(p, robot=dataclasses.replace(p.robot, tendons=(tendon,)))))


def test_with_scenarios() -> None:
    others = (Scenario(name="soft", stiffness=0.5, torque=0.9), Scenario(name="heavy", mass=2.0))
    check_rows(transcribed(dataclasses.replace(arm_problem(), scenarios=others)))


def test_of_joints_with_springs() -> None:
    p = arm_problem()
    springs = {"elbow": Actuator(spring_stiffness=40.0, spring_rest=0.8)}
    check_rows(transcribed(dataclasses.replace(p, robot=p.robot.with_actuators(springs))))


def test_of_a_ball_that_comes_and_is_caught() -> None:
    p = arm_problem()
    still = TargetSpeed(least=-0.1, most=0.2)
    ball = FreeMass(mass=0.5, initial_velocity=-3.0)
    check_rows(transcribed(dataclasses.replace(p, target=ball, terms=(*p.terms, still))))


ENDS = {"C": "end of compression", "S": "separation", "T": "touch", "B": "break"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "touches"),
    [
        *((KelvinVoigt, each) for each in (2, 3, "SB", "BS", "STSB", "SBTS")),
        *((SpringDamper, each) for each in (2, "CSB", "BCS", "CBCCSTCS")),
    ],
)
def test_of_a_board_whose_events_have_an_order(
    law: Any, touches: int | str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # any point will do: no speed is sought with which a point mass has this order
    monkeypatch.setattr("impactopt.transcription.contact_guess.SPEED_STEPS", 0)
    board = Board(mass=0.1, stiffness=1e5, breaking_force=700.0, damping=20.0)
    order = touches if isinstance(touches, int) else tuple(ENDS[letter] for letter in touches)
    stiff, rough = law(stiffness=1e6, damping=50.0), ContactFriction(coefficient=0.6, stiffness=8e5)
    problem = dataclasses.replace(arm_problem(), target=board, law=stiff, touches=order)
    for friction in (None, rough):
        check_rows(transcribed(dataclasses.replace(problem, friction=friction)))


def test_of_a_slide_that_is_bounded() -> None:
    p = arm_problem()
    check_rows(transcribed(dataclasses.replace(p, terms=(*p.terms, Slide(most=0.02)))))


@pytest.mark.parametrize("model", ["rigid", "sdc"])
def test_of_a_collision_model_that_is_not_known(model: str) -> None:
    """The verdict says so, and finds nothing wrong in what it knows."""
    p = arm_problem()
    terms = (*p.terms, Slide(most=0.02), ReferenceRange(margin=0.1))
    solution = solve(dataclasses.replace(p, collision=model, terms=terms))
    record = record_of(solution, problem="")
    verdict = verify_record(solution.problem, record.arrays, record.summary)
    assert not verdict.ok and verdict.max_violation < 1e-6
    reasons = verdict.reason.split("; ")
    assert f"not known to verify: the model {model!r} of the collision" in reasons
    assert all(reason.startswith("not known to verify: ") for reason in reasons)


@pytest.mark.parametrize("make", [arm_problem, biped_problem])
def test_of_the_reference_s_range(make: Any) -> None:
    p = make()
    check_rows(transcribed(dataclasses.replace(p, terms=(*p.terms, ReferenceRange(margin=0.1)))))


def test_of_the_ground_s_force_and_the_first_touch(biped_transcription: Transcription) -> None:
    p = biped_transcription.problem
    others = (
        Scenario(name="soft", stiffness=0.5),
        Scenario(name="nothing", missing=True, abort_after=0.02),
    )
    kept = tuple(term for term in p.terms if not isinstance(term, GroundForce | FirstTouch))
    terms = (*kept, GroundForce(least=0.4, sole=0.2), FirstTouch(depth=2e-3, angle=0.5))
    check_rows(transcribed(dataclasses.replace(p, terms=terms, scenarios=others)))


def test_of_a_striking_link_with_corners() -> None:
    p = load_problem(PROBLEMS / "arm7.toml")
    kept = tuple(term for term in p.terms if not isinstance(term, FirstTouch))
    t = transcribed(dataclasses.replace(p, terms=(*kept, FirstTouch())))
    assert any(row.term == FirstTouch.name for row in t.constraints.origins)
    check_rows(t)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["strike_holding_on", "push_two_hands"])
def test_of_two_hands(name: str) -> None:
    problem = load_problem(PROBLEMS / f"{name}.toml")
    check_rows(transcribed(problem))


@pytest.mark.parametrize("name", sorted(path.stem for path in PROBLEMS.glob("*.toml")))
def test_all_that_a_problem_states_is_known(name: str) -> None:
    assert unknown(load_problem(PROBLEMS / f"{name}.toml")) == []


def test_of_a_frame_that_looks_at_the_hit_point() -> None:
    p = biped_problem()
    t = transcribed(dataclasses.replace(p, terms=(*p.terms, Gaze(frame="elbow", axis=[1, 0, 0], since=0.0))))
    assert any(row.term == Gaze.name for row in t.constraints.origins)
    check_rows(t)


@pytest.mark.parametrize("gravity", [0.0, -2.0])
def test_of_a_robot_that_nothing_holds(gravity: float) -> None:
    problem = load_problem(PROBLEMS / "space_arm.toml")
    robot = space_arm(gravity=[0.0, 0.0, gravity])
    check_rows(transcribed(dataclasses.replace(problem, robot=robot)))


@pytest.mark.parametrize("name", ["arm_planar", "chop_arm"])
def test_of_targets_with_events(name: str) -> None:
    problem = load_problem(PROBLEMS / f"{name}.toml")
    check_rows(transcribed(problem))


def test_slopes_are_those_of_the_program(arm_transcription: Transcription) -> None:
    t = arm_transcription
    x = away_from_start(t)
    program, v = second(t, x)
    y = np.random.default_rng(1).standard_normal(t.program.m)
    left: dict[tuple[str, str, str], list[float]] = {}
    for row, weight in zip(t.constraints.origins, y, strict=True):
        left.setdefault((row.term, row.place.name, row.component), []).append(weight)
    weights = [np.array([left[n].pop(0) if n in left else 0.0 for n in p.names]) for p in program.rows]
    pieces = [*program.rows, *program.worth]
    found, doubt = lagrangian_gradient(pieces, [*weights, *[np.ones(1)] * len(program.worth)], v)
    wanted = t.program.gradient(x) + t.program.jacobian(x).T @ y
    assert found == pytest.approx(wanted, rel=1e-7, abs=1e-6)
    assert np.abs(found - wanted).max() <= 10 * doubt.max() + 1e-7 * np.abs(wanted).max()


@pytest.mark.parametrize("limit", [None, 1.5, {"elbow": 2.0}], ids=["default", "one", "by joint"])
def test_of_gears_in_a_damped_contact(limit: Any) -> None:
    """With the first instant, at which a damper has its force already, and in scenarios too."""
    p = load_problem(PROBLEMS / "arm_planar.toml")
    others = (
        Scenario(name="heavy", mass=2.0, torque=0.9),
        Scenario(name="nothing", missing=True, abort_after=0.02),
    )
    terms = (*(t for t in p.terms if not isinstance(t, GearLoad)), GearLoad(limit=limit))
    check_rows(transcribed(dataclasses.replace(p, terms=terms, scenarios=others)))


def test_of_a_tool_in_a_soft_grip() -> None:
    """Its joint bears what spring and damper do, and no more; with gears beside it."""
    p = load_problem(PROBLEMS / "arm_planar.toml")
    grip = SoftGrip(axis=[0, 1, 0], stiffness=20.0, damping=0.5, point=[0.0, 0.0, 0.05])
    robot = p.robot.with_grip(p.robot.tools[-1].name, grip)
    check_rows(transcribed(dataclasses.replace(p, robot=robot, terms=(*p.terms, GearLoad()))))


@pytest.mark.parametrize("objective", [Effort(weight=0.02), PeakForce(weight=0.001)], ids=lambda o: o.name)
def test_of_an_objective_that_is_not_linear(objective: Objective) -> None:
    """The peak force has the force at first touch of the damped law."""
    p = load_problem(PROBLEMS / "arm_planar.toml")
    check_rows(transcribed(dataclasses.replace(p, objectives=(*p.objectives, objective))))


def test_a_ball_that_comes_is_not_yet_at_its_place_in_the_record() -> None:
    """A posture that would penetrate it at contact is right long before."""
    t = transcribed(dataclasses.replace(arm_problem(), target=FreeMass(mass=0.5, initial_velocity=-3.0)))
    problem, x = t.problem, first_iterate(t)
    program, v = second(t, x)
    trajectory, rng = t.decode(x).trajectory(step=5e-3), np.random.default_rng(0)
    depth = 0.0
    while not depth > 0.01:  # in the ball, and in nothing else
        turn = rng.uniform(-0.5, 0.5, problem.robot.n)
        q = pin.integrate(problem.robot.model, problem.contact_posture, turn)
        touches = problem.bodies.survey(
            np.zeros(1), Places.of(problem.robot, q[None], np.zeros(1, dtype=np.intp))
        ).touches
        depth = (
            touches[0].depth if len(touches) == 1 and "target" in (touches[0].one, touches[0].other) else 0.0
        )
    arrays = {f"reference_{f.name}": getattr(trajectory, f.name) for f in fields(Trajectory)}
    swing = np.flatnonzero(trajectory.phase == 0)
    for k, off in ((swing[-1], depth), (swing[0], 0.0)):
        arrays["reference_q"] = np.tile(problem.start_posture, (len(trajectory.q), 1))
        arrays["reference_q"][k] = q
        found = [each.amount for each in off_in_record(program, v, arrays, {}) if "distance" in each.name]
        assert max(found) == pytest.approx(off, abs=5e-3)


@pytest.mark.slow
def test_half_of_each_soles_margin_is_kept_in_the_reference(biped_plan: Planned) -> None:
    """By the wrenches that the legs' torques leave to the soles, as the plan says."""
    plan, t = biped_plan.plan, biped_plan.transcription
    arrays = {f"reference_{f.name}": getattr(biped_plan.trajectory, f.name) for f in fields(Trajectory)}
    margins = plan.sole_margins()["sole_cop_margin_mm"].values()
    kept = 1e-3 * min(phases[name] for phases in margins for name in ("swing", "follow"))
    for half, short in ((kept + 3e-3, 3e-3), (kept - 1e-3, 0.0)):
        cone = ContactWrenchCone(margin=2 * half, minimum_force=0.0)
        program, v = second(changed(t, terms=(cone,)), biped_plan.result.x)
        off = {found.name: found.amount for found in off_in_record(program, v, arrays, {})}
        assert max(off["reference margin of a sole's centre of pressure"], 0.0) == pytest.approx(
            short, abs=1e-6
        )
        assert off["reference normal force of a sole"] < 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("blow", "count"), [(1, 3), (2, 3), (1, 2)], ids=["on one foot", "after a step", "ends on one foot"]
)
def test_of_soles_that_change(blow: int, count: int) -> None:
    """Before and after the blow, and where nothing is hit; with a tendon of an arm and a leg."""
    p, phase = biped_problem(), Phase(duration=(0.4, 0.9), intervals=6, grading=1.0)
    both = StancePhase(soles=("left", "right"), phase=phase)
    ahead = dataclasses.replace(both, steps={"right": (0.06, -0.02)})
    stances = [both, StancePhase(soles=("left",), phase=phase), ahead]
    stances[blow] = dataclasses.replace(stances[blow], phase=None)
    pull = {"left knee": 0.5, "elbow": 1.0}
    tendon = Tendon(name="t", coefficients=pull, lower=-3, upper=2)
    problem = dataclasses.replace(
        p,
        robot=dataclasses.replace(p.robot, tendons=(tendon,)),
        stances=tuple(stances[:count]),
        scenarios=(Scenario(name="nothing", missing=True, abort_after=0.02),),
    )
    t = transcribed(problem)
    rows = Watch(t, Margins(dataclasses.replace(problem, terms=())), first_iterate(t)).constraints(0.15)
    assert any(row.place.startswith("on ") for row in rows)
    assert any(o.place.name.startswith("on ") for o in t.program.origins if "tendon t" in str(o))
    check_rows(t.with_clearance(rows))


@pytest.mark.slow
@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("stiffness", [0.0, 8e3])
@pytest.mark.parametrize("robot", ["arm", "biped"])
def test_of_friction_at_the_hit(robot: str, stiffness: float, moves: bool) -> None:
    """In the contact and at its first instant, where the servo's torques are variables."""
    rough = ContactFriction(coefficient=0.6, stiffness=stiffness, moves_target=moves)
    p = {"arm": arm_problem, "biped": biped_problem}[robot]()
    t = transcribed(dataclasses.replace(p, friction=rough, terms=(*p.terms, GearLoad())))
    check_rows(t)


def test_forces_of_a_finer_contact_integrate_to_its_impulse(biped_plan: Planned) -> None:
    """By the weights of their collocation points, also where a trapezoidal rule would miss by per cents."""
    t, x = biped_plan.transcription, biped_plan.result.x
    error = contact_error(t, x)
    assert error is not None
    hit = error.finer[0]
    program, v = second(t, x)
    for factor, off in ((1.0, 0.0), (1.03, 0.03)):
        arrays = {f"collision_{name}": getattr(hit, name) for name in ("time", "torque")}
        arrays["collision_force"] = factor * hit.force
        found = max(each.amount for each in off_in_record(program, v, arrays, {}) if each.name == "blow")
        wanted = off and off - 0.005 + factor * error.coarse / 100
        assert found == pytest.approx(wanted, abs=1e-6 if not off else 2e-3)
