"""Plans of robots that nothing holds: momentum, closed forms of two bodies, both engines, what is refused."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from oracle.verdict import verify_record

from impactopt import (
    Free,
    FreeMass,
    ImpactProblem,
    Incidence,
    InputError,
    KeepOut,
    Phase,
    Robot,
    Scenario,
    SelfCollision,
    Slide,
    Solution,
    SpringDamper,
    Status,
    Striker,
    VelocityLimit,
    load_problem,
    optimize_strike,
    solve,
    space_arm,
)
from impactopt.files.named_problems import problem_file
from impactopt.files.output import record_of, save_record
from impactopt.files.verify import verify
from impactopt.planning.minimum_jerk import minimum_jerk_baseline

BASE, ARM, ROTOR, BALL = 6.0, 2.0, 0.5, 1.0  # [kg]
FASTEST = 1.0  # [m/s]
GRAVITY = 9.81
TERMS = SelfCollision(enabled=False), KeepOut(enabled=False), VelocityLimit(fraction=1.0)


def two_bodies(gravity: list[float]) -> Robot:
    """A base and a slider along x, both of whose centres are on the line on which it strikes."""
    model, still = pin.Model(), pin.SE3.Identity()
    root = model.addJoint(0, pin.JointModelFreeFlyer(), still, "root_joint")
    model.appendBodyToJoint(root, pin.Inertia.FromBox(BASE, 0.2, 0.2, 0.2), still)
    bounds = [np.array([x]) for x in (200.0, FASTEST, -0.3, 0.3)]
    slide = model.addJoint(root, pin.JointModelPX(), still, "slide", *bounds)
    model.appendBodyToJoint(slide, pin.Inertia.FromBox(ARM, 0.1, 0.1, 0.1), still)
    model.addJointFrame(slide)
    return Robot.from_model(
        model,
        name="two bodies",
        armature=ROTOR,
        # so soft that the contact does not feel the servo
        kp=0.02,
        kd=0.02,
        gravity=gravity,
        strikers=[Striker(name="fist", frame="slide", point=np.array([0.3, 0.0, 0.0]))],
        postures={"ready": {"slide": 0.0}},
    )


def pushing(robot: Robot, **changes: Any) -> ImpactProblem:
    shared: dict[str, Any] = {
        "robot": robot,
        "striker": "fist",
        "point": np.array([0.45, 0.0, 0.0]),
        "normal": np.array([1.0, 0.0, 0.0]),
        "law": SpringDamper(stiffness=1e4, damping=0.0),
        "target": FreeMass(mass=BALL),
        "stance": Free(),
        "start": "ready",
        "style": "strongest",
        "terms": TERMS,
        "swing": Phase(duration=(0.5, 1.5)),
        "follow": Phase(duration=(0.5, 1.5)),
    }
    return ImpactProblem(**{**shared, **changes})


def momentum(robot: Robot, q: Any, v: Any) -> np.ndarray:
    """(k, 6) about the centre of mass, by Pinocchio."""
    data = robot.model.createData()
    found = [pin.computeCentroidalMomentum(robot.model, data, *row).vector for row in zip(q, v, strict=True)]
    return np.array([np.array(each) for each in found])


def hardest() -> float:
    """[N s]: the slider at its fastest against a base that goes back, and then an elastic blow.

    Coordinates are the base's place and the slide's: H = [[M, m], [m, m + rotor]], and the tip moves by both.
    """
    whole = BASE + ARM
    speed = FASTEST * (1 - ARM / whole)
    inertia = np.array([[whole, ARM], [ARM, ARM + ROTOR]])
    mass = 1 / (np.ones(2) @ np.linalg.solve(inertia, np.ones(2)))
    return float(2 * speed * mass * BALL / (mass + BALL))


@pytest.fixture(scope="module")
def thrown() -> Solution:
    return solve(load_problem("space_arm"))


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["pinocchio", "mujoco"])
def test_replays_agree_with_the_plan(thrown: Solution, engine: str) -> None:
    assert thrown.status is Status.SOLVED, thrown.result.message
    replay = thrown.validate(engine=engine)
    assert replay.impulse == pytest.approx(thrown.impulse, rel=1e-2)


def test_momentum_is_conserved_up_to_contact(thrown: Solution) -> None:
    plan, robot = thrown.plan, thrown.problem.robot
    c, reference = plan.coordinates, plan.reference
    # where the program has constraints for it, and in contact
    breaks = plan.swing.breaks
    spots = plan.swing.duration * np.append((breaks[1:] + breaks[:-1]) / 2, 1.0)
    rows = zip(*plan.independent(0, spots)[:3], strict=True)
    q, v, _ = zip(*(c.complete_motion(*row, np.zeros(0)) for row in rows), strict=True)
    assert np.abs(momentum(robot, q, v)).max() < 1e-5
    # and every millisecond of the reference, whose base has no force on it; so its centre of mass stays
    swing = reference.phase == 0
    assert np.abs(momentum(robot, reference.q[swing], reference.v[swing])).max() < 1e-5
    data = robot.model.createData()
    centres = np.array([pin.centerOfMass(robot.model, data, q).copy() for q in reference.q[swing]])
    assert np.ptp(centres, axis=0).max() < 1e-8
    forces = [
        pin.rnea(robot.model, data, *row) for row in zip(reference.q, reference.v, reference.a, strict=True)
    ]
    assert np.abs(np.array(forces)[:, :6]).max() < 1e-6


def test_the_blow_takes_the_momentum_that_the_target_gets(thrown: Solution) -> None:
    plan, robot, p = thrown.plan, thrown.problem.robot, thrown.problem
    reference, data = plan.reference, thrown.problem.robot.model.createData()
    after = np.flatnonzero(reference.phase == 2)
    found = momentum(robot, reference.q[after], reference.v[after])
    np.testing.assert_allclose(found[0, :3], -plan.impulse * p.normal, atol=1e-5)
    # the force goes through the striking point, which moves by some mm meanwhile
    arm = p.point - np.array(pin.centerOfMass(robot.model, data, reference.q[after[0]]))
    np.testing.assert_allclose(
        found[0, 3:], np.cross(arm, -plan.impulse * p.normal), atol=0.03 * plan.impulse
    )
    assert np.ptp(found, axis=0).max() < 1e-10
    # the joints come to rest; the base drifts on
    assert np.abs(reference.v[-1, 6:]).max() < 1e-9
    assert np.linalg.norm(reference.v[-1, :6]) > 0.01


def test_an_exported_base_drifts_on_to_the_end(thrown: Solution, tmp_path: Path) -> None:
    """Velocities are those of the positions up to the last row, also of the row after the joints' rest."""
    for to, rate in (("csv", 1000.0), ("mjlab", 50.0)):
        thrown.export(to, tmp_path / to, rate=rate)
    with open(tmp_path / "csv" / "motion.csv", newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    last = dict(zip(header, np.array(rows[-40:], dtype=float).T, strict=True))
    places = np.column_stack([last[f"base position {axis} [m]"] for axis in "xyz"])
    speeds = np.column_stack([last[f"base linear velocity {axis} [m/s]"] for axis in "xyz"])
    steps = np.diff(last["time [s]"])[:, None]
    np.testing.assert_allclose(np.diff(places, axis=0), steps * (speeds[1:] + speeds[:-1]) / 2, atol=1e-7)
    frames = np.load(tmp_path / "mjlab" / "motion.npz")
    places, speeds = frames["body_pos_w"][-3:, 0], frames["body_lin_vel_w"][-3:, 0]
    np.testing.assert_allclose(np.diff(places, axis=0), 0.02 * (speeds[1:] + speeds[:-1]) / 2, atol=1e-5)
    thrown.export("mujoco", tmp_path / "scene")
    assert "m high" not in (tmp_path / "scene" / "play.py").read_text("utf-8")  # it does not stand


def test_its_record_is_verified(thrown: Solution, tmp_path: Path) -> None:
    text = problem_file("space_arm").read_text("utf-8")
    save_record(record_of(thrown, problem=text), tmp_path)
    verdict = verify(tmp_path)
    assert verdict.ok, verdict.reason


@pytest.mark.slow
def test_its_program_written_down_a_second_time_agrees(thrown: Solution) -> None:
    record = record_of(thrown)
    verdict = verify_record(thrown.problem, record.arrays, record.summary)
    assert verdict.ok, verdict.reason
    q = record.arrays["reference_q"].copy()
    q[len(q) // 4, 0] += 1e-3  # the base of one instant
    wrong = verify_record(thrown.problem, {**record.arrays, "reference_q": q}, record.summary)
    assert not wrong.ok and "reference posture" in wrong.reason


@pytest.mark.slow
def test_two_bodies_strike_as_hard_as_the_closed_form_says() -> None:
    solution = solve(pushing(two_bodies([0.0, 0.0, 0.0])))
    assert solution.status is Status.SOLVED, solution.result.message
    assert solution.plan.hand_speed == pytest.approx(FASTEST * BASE / (BASE + ARM), rel=1e-6)
    assert solution.impulse == pytest.approx(hardest(), rel=2e-3)
    for engine in ("pinocchio", "mujoco"):
        assert solution.validate(engine=engine).impulse == pytest.approx(solution.impulse, rel=1e-2)


@pytest.mark.slow
def test_a_robot_in_flight_falls_to_the_target() -> None:
    """The time of the blow is that of a fall, whatever the slider does, and it strikes as hard as without."""
    drop = 0.2
    problem = pushing(
        two_bodies([0.0, 0.0, -GRAVITY]),
        point=np.array([0.36, 0.0, -drop]),
        swing=Phase(duration=(0.1, 0.5)),
        follow=Phase(duration=(0.2, 0.5)),
        terms=(*TERMS, Incidence(speed=5.0)),
    )
    solution = solve(problem)
    assert solution.status is Status.SOLVED, solution.result.message
    plan, robot = solution.plan, problem.robot
    assert plan.contact_start == pytest.approx(np.sqrt(2 * drop / GRAVITY), rel=1e-4)
    reference = plan.reference
    swing = reference.phase == 0
    falling = np.zeros((swing.sum(), 6))
    falling[:, 2] = -(BASE + ARM) * GRAVITY * reference.time[swing]
    found = momentum(robot, reference.q[swing], reference.v[swing])
    np.testing.assert_allclose(found, falling, atol=1e-5)
    assert solution.impulse == pytest.approx(hardest(), rel=2e-3)
    for engine in ("pinocchio", "mujoco"):
        assert solution.validate(engine=engine).impulse == pytest.approx(solution.impulse, rel=1e-2)


def test_a_long_fall_is_planned() -> None:
    """In the default time of swing and follow-through it is 16 m long, and changes nothing in the impact."""
    swing, follow = 0.8, 1.0
    problem = pushing(
        two_bodies([0.0, 0.0, -GRAVITY]),
        point=np.array([0.45, 0.0, -GRAVITY * swing**2 / 2]),
        swing=Phase(duration=swing),
        follow=Phase(duration=follow),
        # the striker falls past the target at 8 m/s
        terms=(*TERMS, Incidence(speed=np.inf), Slide(enabled=False)),
    )
    solution = solve(problem, refine=False)
    assert solution.status is Status.SOLVED, solution.result.message
    assert solution.impulse == pytest.approx(hardest(), rel=2e-3)
    reference = solution.plan.reference
    assert reference.q[:, 2] == pytest.approx(-GRAVITY * reference.time**2 / 2, abs=1e-3)
    assert reference.q[reference.phase == 2, 2].min() < -15


def test_what_it_is_not_for(thrown: Solution) -> None:
    problem = thrown.problem
    with pytest.raises(InputError, match=r"floats freely: .* no strike by itself"):
        optimize_strike(problem)
    with pytest.raises(InputError, match="floats freely, and has no strike"):
        solve(problem, start="strike")
    with pytest.raises(InputError, match="it has none where nothing holds it"):
        minimum_jerk_baseline(problem)
    late = Scenario(name="late", missing=True, abort_after=0.02)
    with pytest.raises(InputError, match="floats freely, and has no abort motion"):
        replace(problem, scenarios=(late,))
    with pytest.raises(InputError, match="floats freely, and the whole-body controller"):
        thrown.validate(engine="mujoco", controller="wbc")
    start = problem.start_posture.copy()
    start[3:7] = pin.Quaternion(pin.rpy.rpyToMatrix(0.0, np.pi / 2, 0.0)).coeffs()
    with pytest.raises(InputError, match=r"base is pitched by 1\.57 rad"):
        replace(problem, start=start)
    with pytest.raises(InputError, match=r"gravity \[m/s2\]"):
        space_arm(gravity=[0.0, 0.0])
