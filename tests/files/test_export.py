"""Exports are read back by code that knows nothing of their writers, and replayed."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from support.fake_solution import still_problem, still_solution, strike_record
from support.small_plans import BODILESS, rod_hammer
from support.small_robots import biped
from typer.testing import CliRunner

import impactopt
from impactopt import (
    Board,
    CustomLaw,
    FirstTouch,
    FreeMass,
    HertzDamped,
    HuntCrossley,
    ImpactProblem,
    Impulse,
    InputError,
    JointAcceleration,
    JointJerk,
    KelvinVoigt,
    Perturbation,
    RigidWall,
    Robot,
    SoftGrip,
    Solution,
    SpringDamper,
    Status,
    Tool,
    load_problem,
    solve,
)
from impactopt.cli.app import app
from impactopt.cli.export import Target as Choice
from impactopt.contact.laws import LAWS
from impactopt.files.export import FORMATS, export_planned
from impactopt.files.export import mujoco_scene as formulas
from impactopt.files.named_problems import problem_file
from impactopt.files.output import record_of, save_record
from impactopt.files.record import Record
from impactopt.files.replay import Planned
from impactopt.planning.lazy_constraints import lazy_terms_of, with_lazy_constraints
from impactopt.simulation import Simulation, scene_of, simulate_mujoco
from impactopt.simulation.mujoco_world import MujocoOptions, build_world

Array = np.ndarray
SERVO = Perturbation(period=1e-3)  # a servo at 1 kHz
NEAR = 5e-3  # of an impulse
runner = CliRunner()


@pytest.fixture(scope="module")
def arm() -> Solution:
    problem = rod_hammer(load_problem("arm_planar"))
    return solve(
        dataclasses.replace(problem, style="strongest", terms=(*problem.terms, FirstTouch(enabled=False)))
    )


@pytest.fixture(scope="module")
def planned(arm: Solution) -> Planned:
    return Planned(record=record_of(arm), problem=arm.problem, reference=arm.trajectory)


@pytest.fixture(scope="module")
def filed(planned: Planned) -> Record:
    """The plan's record as if its problem were that of a file, with the same lazy constraints."""
    path = problem_file("arm_planar")
    lazy = lazy_terms_of(planned.problem)
    own = planned.record.summary["problem"] | with_lazy_constraints(load_problem(path), lazy).describe()
    return dataclasses.replace(
        planned.record,
        problem=path.read_text(encoding="utf-8"),
        problem_path=path,
        summary={**planned.record.summary, "problem": own},
    )


@pytest.fixture(scope="module")
def still() -> Solution:
    return still_solution()


def replayed(
    problem: ImpactProblem, reference: Any, *, step: float = 4e-4, settle: float = 0.0
) -> Simulation:
    return simulate_mujoco(
        problem.robot, reference, scene_of(problem), step=step, settle=settle, perturbation=SERVO
    )


def reference_of(
    robot: Robot,
    time: Array,
    joints: list[str],
    position: Array,
    velocity: Array,
    effort: Array,
    base: Array | None = None,
) -> Any:
    """What an engine follows, from columns in any order; base (k, 13): place, w, x, y, z, twist."""
    order = [joints.index(name) for name in robot.joint_names]
    position, velocity, effort = (table[:, order] for table in (position, velocity, effort))
    if base is not None:  # a servo does not see the base, but a replay begins there
        position = np.hstack([base[:, :3], base[:, [4, 5, 6, 3]], position])
        velocity = np.hstack([base[:, 7:], velocity])
    return SimpleNamespace(time=time, q=position, v=velocity, torque=effort, end=float(time[-1]))


# ---------------------------------------------------------------- readers
def read_csv(path: Path) -> dict[str, Array]:
    with open(path, newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    return dict(zip(header, np.array(rows, dtype=float).T, strict=True))


def table(columns: dict[str, Array], what: str) -> tuple[list[str], Array]:
    """Names and values (k, n) of the columns `what NAME [unit]`."""
    named = {
        m[1]: values
        for key, values in columns.items()
        if (m := re.fullmatch(rf"{what} (\S+)(?: \[.+\])?", key))
    }
    return list(named), np.stack(list(named.values()), axis=1)


def from_csv(path: Path, robot: Robot) -> Any:
    columns = read_csv(path)
    joints, position = table(columns, "position")
    base = None
    if robot.floating:
        whats = ("base position", "base quaternion", "base linear velocity", "base angular velocity")
        base = np.hstack([table(columns, what)[1] for what in whats])
    velocity, effort = (table(columns, what)[1] for what in ("velocity", "effort"))
    return reference_of(robot, columns["time [s]"], joints, position, velocity, effort, base)


def from_points(robot: Robot, joints: list[str], points: list[Any]) -> Any:
    """Of a JointTrajectory, as dictionaries or messages."""

    def of(thing: Any, name: str) -> Any:
        return thing[name] if isinstance(thing, dict) else getattr(thing, name)

    stamps = [of(point, "time_from_start") for point in points]
    nanoseconds = [1_000_000_000 * of(stamp, "sec") + of(stamp, "nanosec") for stamp in stamps]
    assert all(0 <= of(stamp, "nanosec") < 1_000_000_000 for stamp in stamps)
    assert (np.diff(nanoseconds) > 0).all(), "ROS refuses times that do not ascend"
    names = ("positions", "velocities", "effort")
    tables = [np.array([of(point, name) for point in points], dtype=float) for name in names]
    return reference_of(robot, 1e-9 * np.array(nanoseconds), joints, *tables)


def play(directory: Path, *options: str) -> list[float]:
    """The numbers that play.py prints, run by Python alone, elsewhere."""
    done = subprocess.run(
        [sys.executable, "-I", str(directory / "play.py"), *options],
        capture_output=True,
        text=True,
        cwd=directory.parent,
        check=False,
    )
    assert done.returncode == 0 and not done.stderr, done.stderr
    return [float(number) for number in re.findall(r"-?\d+\.\d+", done.stdout)]


# ---------------------------------------------------------------- an arm
@pytest.mark.slow
def test_csv_replays_as_the_plan_does(arm: Solution, tmp_path: Path) -> None:
    files = arm.export("csv", tmp_path / "new" / "csv", joints=["wrist", "shoulder", "elbow"])
    assert [path.name for path in files] == ["meta.json", "motion.csv"] and all(p.is_file() for p in files)
    read = from_csv(files[1], arm.problem.robot)
    memory = replayed(arm.problem, arm.trajectory)
    assert replayed(arm.problem, read).impulse == pytest.approx(memory.impulse, rel=NEAR)
    columns = read_csv(files[1])
    assert table(columns, "effort")[0] == ["wrist", "shoulder", "elbow"]
    assert np.trapezoid(columns["force [N]"], columns["time [s]"]) == pytest.approx(arm.impulse, rel=0.02)
    meta = json.loads(files[0].read_text(encoding="utf-8"))
    robot = arm.problem.robot
    for joint in meta["joints"]:
        k = robot.joint_index(joint["name"])
        told = [joint["kp"], joint["kd"], joint["effort_limit"]]
        assert told == [robot.kp[k], robot.kd[k], robot.torque_limit[k]]
    assert meta["contact_s"] == [arm.plan.contact_start, arm.plan.contact_end] and meta["missed"] is None
    assert meta["target"]["resistance_N"] == 600.0 and meta["contact_law"]["stiffness_N_m"] == 5e5
    assert meta["expected"]["impulse_Ns"] == pytest.approx(arm.impulse)


@pytest.mark.parametrize("rate", [50.0, 1000.0])
def test_the_force_has_its_peak_at_any_rate(arm: Solution, tmp_path: Path, rate: float) -> None:
    """The contact lasts less than a period of 50 Hz."""
    force = read_csv(arm.export("csv", tmp_path / "csv", rate=rate)[1])["force [N]"]
    assert force.max() == pytest.approx(arm.collision.peak_force)


def test_rows_are_at_the_rate_and_at_both_sides_of_a_jump(arm: Solution, tmp_path: Path) -> None:
    start, end = arm.plan.contact_start, arm.plan.contact_end
    columns = read_csv(arm.export("csv", tmp_path / "csv", rate=500.0)[1])
    time, inside = columns["time [s]"], columns["contact"]
    assert (np.diff(time) > 0).all() and time[0] == 0 and time[-1] == pytest.approx(arm.plan.duration)
    for instant, step in ((start, 1), (end, -1)):
        before, after = np.flatnonzero(np.abs(time - instant) < 1.5e-6)
        assert after == before + 1 and inside[after] - inside[before] == step
        assert time[after] - time[before] == pytest.approx(1e-6, abs=1e-9)
    others = np.abs(np.round(500 * time) / 500 - time) < 1e-9
    assert others.sum() >= len(time) - 6 and np.diff(time[others]).max() == pytest.approx(0.002)
    # the reference coasts in contact, and goes on from the predicted state after it
    after = np.flatnonzero(inside == 1)[-1] + 1
    jump = [table(columns, "velocity")[1][k] for k in (after - 1, after)]
    assert np.abs(jump[1] - jump[0]).max() > 0.1


@pytest.mark.parametrize("which", ["position", "velocity"])
def test_rates_are_those_of_the_curve(arm: Solution, tmp_path: Path, which: str) -> None:
    """Central differences of dense rows, where the curve has no break."""
    columns = read_csv(arm.export("csv", tmp_path / "csv", rate=1e4)[1])
    time = columns["time [s]"]
    rate = table(columns, {"position": "velocity", "velocity": "acceleration"}[which])[1]
    values = table(columns, which)[1]
    steps = np.diff(time)
    even = np.flatnonzero((np.abs(steps[1:] - 1e-4) < 1e-9) & (np.abs(steps[:-1] - 1e-4) < 1e-9)) + 1
    even = even[(columns["phase"][even - 1] == columns["phase"][even + 1])]
    found = (values[even + 1] - values[even - 1]) / 2e-4
    # differences err by the third rate, and twelve digits by 1e-12 / 1e-4
    np.testing.assert_allclose(found, rate[even], atol={"position": 1e-5, "velocity": 0.05}[which])


def test_ros2_is_a_goal_that_replays_as_the_plan_does(arm: Solution, tmp_path: Path) -> None:
    _, path = arm.export("ros2", tmp_path / "goal")
    goal = yaml.load(path.read_text(encoding="utf-8"), yaml.CSafeLoader)
    trajectory = goal["trajectory"]
    assert set(goal) == {"trajectory"} and set(trajectory) == {"joint_names", "points"}
    fields = {"positions", "velocities", "accelerations", "effort", "time_from_start"}
    for point in trajectory["points"]:
        assert set(point) == fields
        assert all(isinstance(x, float) for name in fields - {"time_from_start"} for x in point[name])
    read = from_points(arm.problem.robot, trajectory["joint_names"], trajectory["points"])
    memory = replayed(arm.problem, arm.trajectory)
    assert replayed(arm.problem, read).impulse == pytest.approx(memory.impulse, rel=NEAR)
    # controllers refuse goals that do not end at rest
    np.testing.assert_allclose(trajectory["points"][-1]["velocities"], 0.0, atol=1e-9)


def test_ros2_reads_small_round_numbers_as_numbers(planned: Planned, tmp_path: Path) -> None:
    """YAML takes 1e-05 for text, and 1.0e-05 for a number."""
    small = dataclasses.replace(planned.reference, torque=np.full_like(planned.reference.torque, 1e-5))
    _, path = export_planned(dataclasses.replace(planned, reference=small), "ros2", tmp_path / "goal")
    points = yaml.load(path.read_text(encoding="utf-8"), yaml.CSafeLoader)["trajectory"]["points"]
    assert {x for point in points for x in point["effort"]} == {1e-5}


def test_effort_without_gravity_is_for_arms_that_hold_themselves(
    arm: Solution, still: Solution, tmp_path: Path
) -> None:
    """At rest at the start nothing is left of it; at speed, what inertia and velocity ask for."""
    robot, motions = arm.problem.robot, {}
    for gravity in (True, False):
        meta, path = arm.export("csv", tmp_path / str(gravity), gravity=gravity)
        assert json.loads(meta.read_text())["effort_holds_gravity"] is gravity
        motions[gravity] = np.genfromtxt(path, delimiter=",", names=True, deletechars="")
    less = [motions[True][n] - motions[False][n] for n in motions[True].dtype.names if n.startswith("effort")]
    where = [motions[True][n] for n in motions[True].dtype.names if n.startswith("position")]
    data = robot.model.createData()
    for k in (0, len(less[0]) // 2, -1):
        q = np.array([column[k] for column in where])
        held = pin.computeGeneralizedGravity(robot.model, data, q)
        np.testing.assert_allclose([column[k] for column in less], held, atol=2e-3 * np.abs(held).max())
    with pytest.raises(InputError, match="gravity must be a bool, not 'no'"):
        arm.export("csv", tmp_path / "text", gravity="no")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="depend on the contact forces"):
        still.export("csv", tmp_path / "legs", gravity=False)
    with pytest.raises(InputError, match="needs the whole effort"):
        arm.export("mujoco", tmp_path / "scene", gravity=False)


@pytest.mark.slow
def test_a_smoothed_motion_keeps_limits_of_acceleration_and_jerk(
    arm: Solution, planned: Planned, still: Solution, tmp_path: Path
) -> None:
    """By differences of the rows alone; and the blow is nearly the planned one."""
    robot, limits = arm.problem.robot, (60.0, 5000.0)
    meta, path = arm.export("csv", tmp_path / "csv", smooth=np.array(limits))  # type: ignore[arg-type]
    read = from_csv(path, robot)
    gap = np.diff(read.time)[:, None]
    acceleration = np.diff(read.v, axis=0) / gap
    assert gap.min() > 0.9e-3  # no instant twice
    assert np.abs(acceleration).max() < limits[0] * (1 + 1e-6)
    # of constant jerk in each piece: the second difference of velocities is its mean over two rows
    assert np.abs(np.diff(acceleration, axis=0) / gap[1:]).max() < limits[1] * (1 + 1e-6)
    np.testing.assert_allclose(
        np.diff(read.q, axis=0) / gap, (read.v[1:] + read.v[:-1]) / 2, atol=limits[1] * 1e-3**2 / 6
    )
    for row in (0, -1):
        np.testing.assert_allclose(read.v[row], 0.0, atol=1e-9)
    np.testing.assert_allclose(read.q[[0, -1]], arm.trajectory.q[[0, -1]], atol=1e-6)
    told = json.loads(meta.read_text())["smooth"]
    assert told["impulse_Ns"] == pytest.approx(replayed(arm.problem, read).impulse, rel=2 * NEAR)
    assert told["impulse_Ns"] == pytest.approx(arm.impulse, rel=0.05)
    assert told["pressing_Ns"] == told["pressing_ms"] == 0
    ratio = (np.abs(read.torque) / robot.torque_limit).max()
    assert told["feed_forward_ratio"] == pytest.approx(ratio, rel=0.02) and ratio < 1
    with pytest.raises(InputError, match="bolted robots"):
        still.export("csv", tmp_path / "legs", smooth=limits)
    with pytest.raises(InputError, match="does not hit the target; the plan's swing has up to") as slow:
        arm.export("csv", tmp_path / "slow", smooth=(0.1, 1.0))  # it hardly moves
    assert not (tmp_path / "slow").exists()
    swing = np.abs(arm.trajectory.a[arm.trajectory.phase == 0])
    assert f"{float(f'{swing.max():.2g}'):g} rad/s^2 and" in str(slow.value)
    way = np.linspace(0.0, 1.0, len(planned.reference.time))[:, None]
    farther = dataclasses.replace(planned.reference, q=planned.reference.q + way)
    with pytest.raises(InputError, match="larger limits"):
        export_planned(
            dataclasses.replace(planned, reference=farther), "csv", tmp_path / "far", smooth=(0.1, 1.0)
        )
    with pytest.raises(InputError, match="lacks limits of all joints"):
        arm.export("csv", tmp_path / "none", smooth="terms")
    with pytest.raises(InputError, match="above 0"):
        arm.export("csv", tmp_path / "none", smooth=(0.0, 1.0))
    with pytest.raises(InputError, match=r"smooth: acceleration and jerk: expected shape \(2\)"):
        arm.export("csv", tmp_path / "none", smooth=60.0)  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_smoothed_motion_keeps_velocity_limits_between_its_steps(arm: Solution, tmp_path: Path) -> None:
    _, path = arm.export("csv", tmp_path / "csv", smooth=(40.0, 2000.0), rate=5000.0)
    ratio = np.abs(from_csv(path, arm.problem.robot).v) / arm.problem.robot.velocity_limit
    assert 0.99 < ratio.max() <= 1 + 1e-9  # it is at a limit


@pytest.mark.slow
def test_a_smoothed_motion_that_presses_on_is_told(arm: Solution, tmp_path: Path) -> None:
    """Low accelerations brake behind the target's surface: what the arm presses there is no impact."""
    meta, path = arm.export("csv", tmp_path / "csv", smooth=(15.0, 2000.0))
    told = json.loads(meta.read_text())["smooth"]
    whole = replayed(arm.problem, from_csv(path, arm.problem.robot)).impulse
    assert told["pressing_Ns"] > 0.1 * whole and told["pressing_ms"] > 50
    assert told["impulse_Ns"] + told["pressing_Ns"] == pytest.approx(whole, rel=2 * NEAR)
    # what is expected is this motion's, not the plan's, whose impulse is larger
    _, fine = arm.export("csv", tmp_path / "fine", smooth=(15.0, 2000.0), rate=20_000.0)
    columns = read_csv(fine)
    force = np.trapezoid(columns["force [N]"], columns["time [s]"])
    expected = json.loads(meta.read_text())["expected"]
    assert force == pytest.approx(whole, rel=2 * NEAR) == expected["impulse_Ns"] != arm.impulse
    with pytest.raises(InputError, match=r"brakes too late: .* then presses on it"):
        arm.export("csv", tmp_path / "late", smooth=(30.0, 500.0))


@pytest.mark.slow
def test_a_smoothed_motion_that_leaves_the_board_whole_is_refused(tmp_path: Path) -> None:
    """Its impulse is larger than the plan's, as a board that does not break pushes back."""
    chop = solve(load_problem("chop_arm"))
    assert chop.collision.outcome["broken"]
    with pytest.raises(InputError, match="does not break the board: it presses with"):
        chop.export("csv", tmp_path / "whole", smooth=(20.0, 2000.0))
    assert not (tmp_path / "whole").exists()
    meta, _ = chop.export("csv", tmp_path / "broken", smooth=(60.0, 5000.0))
    assert json.loads(meta.read_text())["expected"]["target"] == {"broken": 1.0}


@pytest.mark.slow
def test_a_smoothed_motion_may_be_for_a_target_that_does_not_break(tmp_path: Path) -> None:
    """Of another file than the plan's: the replay of the smoothed motion, and what is expected, are of it."""
    solve(load_problem("chop_arm")).save(tmp_path / "chop")
    text = problem_file("chop_arm").read_text(encoding="utf-8")
    board, light = text[text.index("[target]") : text.index("[contact]")], "[target]\nmass_kg = 0.5\n\n"
    (tmp_path / "other.toml").write_text(text.replace(board, light), encoding="utf-8")
    given = ["--to", "csv", "--out", str(tmp_path / "csv"), "--problem", str(tmp_path / "other.toml")]
    done = runner.invoke(app, ["export", str(tmp_path / "chop"), *given, "--smooth", "60,5000", "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["caution"].endswith("in the files are of it, the motion is the plan's")


@pytest.mark.slow
def test_feed_forward_beyond_the_torque_limit_is_told(
    filed: Record, planned: Planned, tmp_path: Path
) -> None:
    """A smoothed motion that is near the plan's jumps accelerates beyond what its motors can."""
    out, robot = tmp_path / "csv", planned.problem.robot
    save_record(filed, tmp_path / "arm")
    given = ["export", str(tmp_path / "arm"), "--to", "csv", "--out", str(out), "--smooth", "200,50000"]
    done = runner.invoke(app, [*given, "--no-gravity"])
    assert "caution: its feed-forward" in done.stdout
    read = from_csv(out / "motion.csv", robot)
    data = robot.model.createData()  # the motors produce what the controller adds, too
    torque = read.torque + [pin.computeGeneralizedGravity(robot.model, data, q) for q in read.q]
    told = json.loads((out / "meta.json").read_text())["smooth"]["feed_forward_ratio"]
    assert told == pytest.approx((np.abs(torque) / robot.torque_limit).max(), rel=0.02) and told > 1


@pytest.mark.slow
@pytest.mark.parametrize("rate", [200.0, 50.0])
def test_a_smoothed_motion_ends_at_rest_at_any_rate(arm: Solution, tmp_path: Path, rate: float) -> None:
    """At the first sample at or after its end, which is 0.1 s after the plan's."""
    columns = read_csv(arm.export("csv", tmp_path / "csv", rate=rate, smooth=(60.0, 5000.0))[1])
    time, end = columns["time [s]"], arm.trajectory.end + 0.1
    assert end - 1e-9 <= time[-1] < end + 1 / rate
    np.testing.assert_allclose(np.diff(time), 1 / rate, atol=1e-9)
    for what in ("velocity", "acceleration"):
        np.testing.assert_allclose(table(columns, what)[1][-1], 0.0, atol=1e-9)


@pytest.mark.slow
def test_a_smoothed_motion_keeps_the_limits_of_the_problem_s_terms_by_joint(
    planned: Planned, tmp_path: Path
) -> None:
    robot = planned.problem.robot
    most = {joint: 40.0 + 20.0 * k for k, joint in enumerate(robot.joint_names)}
    terms = (*planned.problem.terms, JointAcceleration(limit=most), JointJerk(limit=5000.0))
    limited = dataclasses.replace(planned, problem=dataclasses.replace(planned.problem, terms=terms))
    order = robot.joint_names[::-1]
    meta, path = export_planned(limited, "csv", tmp_path / "csv", smooth="terms", joints=order)[:2]
    told = json.loads(meta.read_text())["smooth"]
    assert told["acceleration_rad_s2"] == most and told["jerk_rad_s3"] == dict.fromkeys(order, 5000.0)
    read = from_csv(path, robot)
    used = np.abs(np.diff(read.v, axis=0) / np.diff(read.time)[:, None]).max(axis=0) / [*most.values()]
    assert used.max() < 1 + 1e-6 and used.min() > 0.5  # each joint has its own limit


@pytest.mark.slow
def test_mcap_is_what_ros_reads(arm: Solution, tmp_path: Path) -> None:
    _, path = arm.export("mcap", tmp_path / "bag")
    messages = read_mcap(path)
    ((_, trajectory),) = messages["/motion"]
    read = from_points(arm.problem.robot, list(trajectory.joint_names), trajectory.points)
    memory = replayed(arm.problem, arm.trajectory)
    assert replayed(arm.problem, read).impulse == pytest.approx(memory.impulse, rel=NEAR)
    time = np.array([t for t, _ in messages["/expected_force"]])
    force = np.array(
        [[m.wrench.force.x, m.wrench.force.y, m.wrench.force.z] for _, m in messages["/expected_force"]]
    )
    impulse = np.trapezoid(force, 1e-9 * time, axis=0)
    np.testing.assert_allclose(impulse, arm.impulse * arm.problem.normal, atol=0.02 * arm.impulse)
    assert {m.data for _, m in messages["/phase"]} == {0, 1, 2} and "/zmp" not in messages
    states = messages["/joint_states"]
    assert [t for t, _ in states] == [t for t, _ in messages["/phase"]]
    for (_, state), point in zip(states, trajectory.points, strict=True):
        assert state.name == trajectory.joint_names
        for told, goal in ((state.position, point.positions), (state.effort, point.effort)):
            np.testing.assert_array_equal(told, goal)
    with open(path, "rb") as file:
        (attached,) = make_reader(file).iter_attachments()
    assert attached.name == "meta.json"
    assert json.loads(attached.data)["contact_s"] == [arm.plan.contact_start, arm.plan.contact_end]


def read_mcap(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Times [ns] and messages by topic, with the definitions that rosbags has of ROS 2's messages."""
    store, found = get_typestore(Stores.ROS2_JAZZY), dict[str, list[tuple[int, Any]]]()
    with AnyReader([path], default_typestore=store) as bag:
        for connection, time, raw in bag.messages():
            found.setdefault(connection.topic, []).append(
                (time, store.deserialize_cdr(raw, connection.msgtype))
            )
    return found


def test_a_humanoids_base_and_zmp_are_told(still: Solution, tmp_path: Path) -> None:
    """It stands: nothing moves, and the ZMP is below the centre of mass until the made-up collision."""
    messages = read_mcap(still.export("mcap", tmp_path / "bag", rate=200.0)[1])
    columns = read_csv(still.export("csv", tmp_path / "csv", rate=200.0)[1])
    q = still.problem.start_posture
    for k in (0, -1):
        pose, zmp = messages["/base_pose"][k][1].pose, messages["/zmp"][k][1].point
        told = [pose.position.x, pose.position.y, pose.position.z]
        np.testing.assert_allclose(told, q[:3], atol=1e-12)
        told = [pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w]
        np.testing.assert_allclose(told, q[3:7], atol=1e-12)
        assert [zmp.x, zmp.y] == pytest.approx(table(columns, "zmp")[1][k])
    inside = columns["contact"] == 1
    np.testing.assert_allclose(table(columns, "zmp")[1][inside][-1], [8 / 400, 0.0], atol=1e-9)
    assert columns["force [N]"][inside].max() == pytest.approx(700.0)
    assert not columns["force [N]"][~inside].any()


def test_an_impact_without_duration_is_one_jump(still: Solution, tmp_path: Path) -> None:
    hit = still.plan.collision
    short = dataclasses.replace(
        hit, **{name: getattr(hit, name)[:1] for name in ("time", "force", "target_speed", "torque")}
    )
    short = dataclasses.replace(short, ground=hit.ground[:0], sole_wrench=hit.sole_wrench[:0])
    plan = dataclasses.replace(still.plan, compression=0.0, restitution=0.0, collision=short)
    columns = read_csv(dataclasses.replace(still, plan=plan).export("csv", tmp_path / "csv")[1])
    assert set(columns["phase"]) == {0.0, 2.0} and not columns["force [N]"].any()
    steps = np.diff(columns["time [s]"])
    assert (steps > 0).all() and (steps < 1.5e-6).sum() == 1
    assert np.isfinite(table(columns, "zmp")[1]).all()


@pytest.mark.slow
def test_mujoco_plays_the_scene(arm: Solution, tmp_path: Path) -> None:
    directory = tmp_path / "scene"
    arm.export("mujoco", directory, joints=["elbow", "wrist", "shoulder"])
    impulse, told = play(directory)
    memory = simulate_mujoco(arm.problem.robot, arm.trajectory, scene_of(arm.problem), settle=0.0)
    assert impulse == pytest.approx(memory.impulse, rel=NEAR)
    assert told == pytest.approx(arm.impulse, abs=1e-3)
    model = mujoco.MjModel.from_xml_path(str(directory / "scene.xml"))
    limits = dict(zip(arm.problem.robot.joint_names, arm.problem.robot.torque_limit, strict=True))
    for k, name in enumerate(("elbow", "wrist", "shoulder")):
        assert model.actuator(k).name == name
        np.testing.assert_allclose(model.actuator(k).forcerange, [-limits[name], limits[name]])
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("contact").id)
    mujoco.mj_forward(model, data)
    depth, rate = data.actuator("contact").length[0], data.actuator("contact").velocity[0]
    assert depth == pytest.approx(0.0, abs=1e-5) and rate == pytest.approx(arm.plan.hand_speed, rel=1e-3)
    assert play(directory, "missing")[0] == 0.0


@pytest.mark.slow
def test_a_soft_grip_is_a_spring_in_the_scene_and_the_tables(tmp_path: Path) -> None:
    """What nothing drives is not asked to follow the plan; so the scene's blow is the replay's."""
    firm = load_problem("arm_planar")
    grip = SoftGrip(axis=[0, 1, 0], stiffness=20.0, damping=0.5, point=[0.0, 0.0, 0.08])
    soft = solve(dataclasses.replace(firm, robot=firm.robot.with_grip("hammer", grip)))
    soft.export("mujoco", tmp_path / "scene")
    memory = simulate_mujoco(soft.problem.robot, soft.trajectory, scene_of(soft.problem), settle=0.0)
    assert play(tmp_path / "scene")[0] == pytest.approx(memory.impulse, rel=NEAR)
    table = np.genfromtxt(soft.export("csv", tmp_path / "csv")[1], delimiter=",", names=True, comments="#")
    moves = [name for name in table.dtype.names if "hammer_grip" in name and "kp" not in name]
    assert moves and all(np.ptp(table[name]) == 0.0 for name in moves)
    joints = json.loads((tmp_path / "csv" / "meta.json").read_text())["joints"]
    assert [joint["name"] for joint in joints if joint.get("passive")] == ["hammer_grip"]
    less = soft.export("csv", tmp_path / "less", gravity=False)[1]  # no controller bears a spring's weight
    less = np.genfromtxt(less, delimiter=",", names=True, comments="#")
    (effort,) = (name for name in moves if name.startswith("effort"))
    np.testing.assert_array_equal(less[effort], table[effort])
    assert np.any(less["effort_shoulder_N_m"] != table["effort_shoulder_N_m"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "target"),
    [
        (SpringDamper(stiffness=1e4, damping=100.0), FreeMass(mass=1.0)),
        (SpringDamper(stiffness=1e4, damping=100.0), FreeMass(mass=1.0, initial_velocity=-2.0)),
        (HuntCrossley(stiffness=2e6, dissipation=0.1), RigidWall()),
        (
            HertzDamped(stiffness=2e6, damping=500.0),
            Board(mass=0.5, stiffness=4e4, breaking_force=150.0, damping=5.0),
        ),
        (KelvinVoigt(stiffness=1e4, damping=50.0), Board(mass=0.5, stiffness=2e5, breaking_force=1e6)),
    ],
    ids=["mass", "ball", "wall", "board", "strong board"],
)
def test_every_law_and_target_plays(planned: Planned, law: Any, target: Any, tmp_path: Path) -> None:
    """The arm's motion against other things than it was planned for."""
    problem = dataclasses.replace(
        planned.problem, law=law, target=target, terms=BODILESS, objectives=(Impulse(),)
    )
    export_planned(dataclasses.replace(planned, problem=problem), "mujoco", tmp_path / "scene")
    fine = simulate_mujoco(
        problem.robot,
        planned.reference,
        scene_of(problem),
        step=5e-5,
        settle=0.0,
        until=planned.reference.contact_end + 0.2,
    )
    assert play(tmp_path / "scene")[0] == pytest.approx(fine.impulse, rel=NEAR)


def test_formulas_are_the_laws() -> None:
    assert set(formulas.LAWS) == set(LAWS)
    numbers = {"stiffness": 3e4, "damping": 70.0, "dissipation": 0.3, "exponent": 1.7}
    for law, formula in formulas.LAWS.items():
        made = law(**{f.name: numbers[f.name] for f in dataclasses.fields(law)})
        for x in (1e-4, 0.003, 0.02):
            for rate in (-1.0, -0.1, 0.0, 0.2, 2.0):
                told = max(0.0, eval(formula, {}, {**numbers, "x": x, "rate": rate}))
                assert told == pytest.approx(float(made.force(x, rate)), rel=1e-9, abs=1e-9), formula


def test_a_law_of_ones_own_has_no_scene(planned: Planned, tmp_path: Path) -> None:
    law = CustomLaw(compression=lambda x, rate, k: k * x, k=1e4)
    problem = dataclasses.replace(planned.problem, law=law)
    own = dataclasses.replace(planned, problem=problem)
    with pytest.raises(InputError, match="no formula for CustomLaw"):
        export_planned(own, "mujoco", tmp_path / "scene")
    export_planned(own, "csv", tmp_path / "csv")
    assert json.loads((tmp_path / "csv" / "meta.json").read_text())["contact_law"]["k"] == 1e4
    assert [p.name for p in tmp_path.iterdir()] == ["csv"]


def test_a_scene_that_mujoco_refuses_is_said(planned: Planned, tmp_path: Path) -> None:
    robot = planned.problem.robot
    model = robot.model.copy()
    model.names[1] = "target"  # as the scene's own joint
    other = dataclasses.replace(robot, model=model)
    problem = dataclasses.replace(planned.problem, robot=other)
    with pytest.raises(InputError, match="MuJoCo refuses the scene"):
        export_planned(dataclasses.replace(planned, problem=problem), "mujoco", tmp_path / "scene")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("shape", ['<box size="0 0 0"/>', '<sphere radius="0"/>'])
def test_a_shape_without_size_is_not_drawn_in_the_scene(planned: Planned, tmp_path: Path, shape: str) -> None:
    """As many files have for links that are only frames."""
    red = '<material name="red"><color rgba="1 0 0 1"/></material>'
    drawn = "".join(
        f"<visual><geometry>{one}</geometry>{colour}</visual>"
        for one, colour in ((shape, ""), ('<box size=".1 .1 .1"/>', red))
    )
    (tmp_path / "arm.urdf").write_text(f'<robot name="arm"><link name="plate">{drawn}</link></robot>')
    robot = planned.problem.robot
    model = robot.model.copy()
    model.addFrame(pin.Frame("plate", 1, 0, pin.SE3.Identity(), pin.FrameType.BODY))
    robot = dataclasses.replace(robot, model=model, urdf=str(tmp_path / "arm.urdf"))
    problem = dataclasses.replace(planned.problem, robot=robot)
    export_planned(dataclasses.replace(planned, problem=problem), "mujoco", tmp_path / "scene")
    scene = mujoco.MjModel.from_xml_path(str(tmp_path / "scene" / "scene.xml"))
    assert scene.nmesh == 2  # the box and the hammer


def frames_in_mujoco(robot: Robot, problem: ImpactProblem, motion: Any) -> list[dict[str, Array]]:
    """Places and velocities of the file's bodies at some frames, by MuJoCo's kinematics of its joints."""
    model = build_world(robot, scene_of(problem), Perturbation(), MujocoOptions())
    data, found = mujoco.MjData(model), []
    names = [str(name) for name in motion["joint_names"]]
    root = [model.joint(str(robot.model.names[1])).bodyid[0]] if robot.floating else [0]
    bodies = [*root, *(model.joint(name).bodyid[0] for name in names)]
    for k in range(0, len(motion["joint_pos"]), 7):
        for column, name in enumerate(names):
            data.qpos[model.joint(name).qposadr[0]] = motion["joint_pos"][k, column]
            data.qvel[model.joint(name).dofadr[0]] = motion["joint_vel"][k, column]
        if robot.floating:
            data.qpos[:3], data.qpos[3:7] = motion["body_pos_w"][k, 0], motion["body_quat_w"][k, 0]
            turn = np.zeros(9)
            mujoco.mju_quat2Mat(turn, data.qpos[3:7])
            data.qvel[:3] = motion["body_lin_vel_w"][k, 0]
            data.qvel[3:6] = turn.reshape(3, 3).T @ motion["body_ang_vel_w"][k, 0]
        mujoco.mj_forward(model, data)
        velocity = np.zeros((len(bodies), 6))
        for row, body in zip(velocity, bodies, strict=True):
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, row, 0)
        found.append({"k": k, "place": data.xpos[bodies], "turn": data.xquat[bodies], "velocity": velocity})
        found[-1] = {key: np.array(value) for key, value in found[-1].items()}
    return found


def check_mjlab(solution: Solution, path: Path) -> Any:
    motion = np.load(path)
    for frame in frames_in_mujoco(solution.problem.robot, solution.problem, motion):
        k = int(frame["k"])
        np.testing.assert_allclose(motion["body_pos_w"][k], frame["place"], atol=1e-6)
        same = np.abs((motion["body_quat_w"][k] * frame["turn"]).sum(axis=1))
        np.testing.assert_allclose(same, 1.0, atol=1e-9)
        np.testing.assert_allclose(motion["body_ang_vel_w"][k], frame["velocity"][:, :3], atol=1e-6)
        np.testing.assert_allclose(motion["body_lin_vel_w"][k], frame["velocity"][:, 3:], atol=1e-6)
    return motion


def test_mjlab_has_the_kinematics_of_mujoco(arm: Solution, tmp_path: Path) -> None:
    arm.export("mjlab", tmp_path / "m", joints=["elbow", "shoulder", "wrist"])
    motion = check_mjlab(arm, tmp_path / "m" / "motion.npz")
    assert motion["fps"].tolist() == [50.0] and list(motion["joint_names"]) == ["elbow", "shoulder", "wrist"]
    frames = int(np.ceil(arm.plan.duration * 50)) + 1
    assert motion["joint_pos"].shape == (frames, 3) and motion["body_quat_w"].shape == (frames, 4, 4)
    k = 5  # in the swing: the plan's own curve, to the last digit that a step of 1 ms leaves
    swing = arm.plan.coordinates
    y, rate, _ = arm.plan.swing.sample(np.array([k / 50]))
    assert swing is not None
    order = [1, 0, 2]
    np.testing.assert_allclose(motion["joint_pos"][k], y[0][order], atol=1e-9)
    np.testing.assert_allclose(motion["joint_vel"][k], rate[0][order], atol=1e-6)


def test_mjlab_has_only_the_joints_of_the_robots_file(tmp_path: Path) -> None:
    """Policies read columns by position, and no file has the joints of soft grips and soles' hinges."""
    own = biped(5)
    grip = SoftGrip(axis=[0, 1, 0], stiffness=20.0, damping=0.5)
    zero, inertia, head = np.zeros(3), np.full(3, 1e-3), np.array([0.1, 0.0, 0.0])
    hammer = Tool(name="hammer", frame="fist", mass=0.5, center=zero, inertia=inertia, head=head, grip=grip)
    robot = own.with_tool(hammer)
    joints = [name for k, name in enumerate(robot.joint_names) if not robot.passive[k]]
    assert len(joints) == robot.n - 3
    solution = still_solution(problem=still_problem(robot=robot, terms=BODILESS))
    solution.export("mjlab", tmp_path / "m")
    motion = check_mjlab(solution, tmp_path / "m" / "motion.npz")
    assert list(motion["joint_names"]) == joints
    assert motion["joint_pos"].shape[1] == motion["joint_vel"].shape[1] == len(joints)
    assert motion["body_pos_w"].shape[1] == len(motion["body_names"]) == len(joints) + 1


# ---------------------------------------------------------------- a humanoid
@pytest.mark.slow
def test_a_punch_replays_from_csv_and_stands(punch: Solution, tmp_path: Path) -> None:
    files = punch.export("csv", tmp_path / "csv")
    assert [path.name for path in files] == ["meta.json", "missed.csv", "motion.csv"]
    read = from_csv(files[2], punch.problem.robot)
    memory = replayed(punch.problem, punch.trajectory, step=5e-4, settle=1.0)
    found = replayed(punch.problem, read, step=5e-4, settle=1.0)
    assert (
        found.impulse == pytest.approx(memory.impulse, rel=NEAR) and found.standing is memory.standing is True
    )
    # the motion of a missed blow is the planned one up to contact, then coasts until that is noticed
    whole, missed = (read_csv(path) for path in (files[2], files[1]))
    told, start = json.loads(files[0].read_text())["missed"], punch.plan.contact_start
    assert told["abort_s"] == pytest.approx(start + punch.problem.abort_after)
    assert told["from_s"] == pytest.approx(min(told["abort_s"], punch.plan.contact_end))
    time, speed = missed["time [s]"], table(missed, "velocity")[1]
    before, after = (np.searchsorted(time, told["abort_s"] + shift) for shift in (-2e-6, 2e-6))
    assert np.abs(speed[after] - speed[before]).max() < 0.05, "rad/s: the abort motion goes on from there"
    early = whole["time [s]"] < start
    np.testing.assert_array_equal(
        table(whole, "position")[1][early], table(missed, "position")[1][missed["time [s]"] < start]
    )
    assert not missed["force [N]"].any() and missed["time [s]"][-1] == pytest.approx(
        punch.missed_trajectory.end
    )
    polygon = punch.plan.polygon
    zmp = table(whole, "zmp")[1]
    low, high = polygon.min(axis=0), polygon.max(axis=0)
    assert ((zmp > low) & (zmp < high)).all()


@pytest.mark.slow
def test_a_punch_plays_in_plain_mujoco(punch: Solution, tmp_path: Path) -> None:
    punch.export("mujoco", tmp_path / "scene")
    impulse, _, height, planned = play(tmp_path / "scene")
    memory = simulate_mujoco(punch.problem.robot, punch.trajectory, scene_of(punch.problem), settle=0.0)
    assert impulse == pytest.approx(memory.impulse, rel=NEAR) and height == pytest.approx(planned, abs=0.01)
    impulse, _, height, planned = play(tmp_path / "scene", "missing")
    assert impulse == 0.0 and height == pytest.approx(planned, abs=0.01)


@pytest.mark.slow
def test_a_punch_for_mjlab_has_the_kinematics_of_mujoco(punch: Solution, tmp_path: Path) -> None:
    punch.export("mjlab", tmp_path / "m", joints=punch.problem.robot.joint_names[::-1])
    motion = check_mjlab(punch, tmp_path / "m" / "motion.npz")
    assert motion["body_names"][0] == "base_link"
    check_mjlab(punch, tmp_path / "m" / "missed.npz")


# ---------------------------------------------------------------- what is refused
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"to": "cvs"}, "did you mean 'csv'"),
        ({"joints": ["shoulder", "elbo", "wrist"]}, "did you mean 'elbow'"),
        ({"joints": ["shoulder", "elbow", "elbow", "wrist"]}, "elbow named twice"),
        ({"joints": ["shoulder", "elbow"]}, "wrist left out"),
        ({"rate": 0.0}, "rate"),
        ({"rate": np.nan}, "rate"),
        ({"rate": 1e9}, "rate"),
    ],
)
def test_bad_input_is_refused_and_nothing_is_made(
    planned: Planned, options: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=message):
        export_planned(planned, **{"to": "csv", **options}, directory=tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("to", FORMATS)
def test_a_plan_that_is_not_finished_is_not_exported(to: str, still: Solution, tmp_path: Path) -> None:
    result = dataclasses.replace(still.result, status=Status.ITERATION_LIMIT)
    with pytest.raises(InputError, match="not solved"):
        dataclasses.replace(still, result=result).export(to, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_a_strike_has_no_motion(arm: Solution, tmp_path: Path) -> None:
    robot = arm.problem.robot
    made = strike_record(robot, robot.posture("ready"), np.zeros(robot.nv), np.zeros(robot.n))
    save_record(made, tmp_path / "strike")
    done = runner.invoke(app, ["export", str(tmp_path / "strike"), "--to", "csv"])
    assert (
        done.exit_code == 2 and "strike, the impact alone" in done.stderr and done.stderr.count("error:") == 1
    )


def test_only_an_export_of_the_same_kind_is_replaced(planned: Planned, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    export_planned(planned, "csv", out)  # an empty one is taken
    export_planned(planned, "csv", out, rate=100.0)
    assert json.loads((out / "meta.json").read_text())["rate_Hz"] == 100.0
    with pytest.raises(InputError, match="holds an export to csv"):
        export_planned(planned, "ros2", out)
    (out / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"notes\.txt"):
        export_planned(planned, "csv", out)
    (out / "meta.json").write_text("{}")
    with pytest.raises(InputError, match="something else"):
        export_planned(planned, "csv", out)
    (tmp_path / "file").write_text("mine")
    for place in ("file", "file/below"):
        with pytest.raises(InputError):
            export_planned(planned, "csv", tmp_path / place)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "out"]
    assert sorted(p.name for p in out.iterdir()) == ["meta.json", "motion.csv", "notes.txt"]


def test_a_read_only_export_is_not_replaced(
    planned: Planned, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It could be renamed, but not removed."""
    out = tmp_path / "out"
    export_planned(planned, "csv", out)
    # root, as in many containers, may write everywhere
    monkeypatch.setattr(os, "access", lambda path, mode: path != out)
    with pytest.raises(InputError, match="it is read-only"):
        export_planned(planned, "csv", out, rate=100.0)
    assert list(tmp_path.iterdir()) == [out]


def test_what_fails_midway_leaves_the_old_files(
    planned: Planned, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    export_planned(planned, "csv", out)
    before = (out / "motion.csv").read_bytes()

    def fail(_export: Any, directory: Path) -> None:
        (directory / "half").write_text("half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("impactopt.files.export.csv_files.write", fail)
    with pytest.raises(InputError, match="No space left"):
        export_planned(planned, "csv", out, rate=10.0)
    assert [p.name for p in tmp_path.iterdir()] == ["out"] and (out / "motion.csv").read_bytes() == before


def test_a_missing_package_says_how_to_get_it(
    planned: Planned, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "mcap_ros2.writer", None)
    with pytest.raises(InputError, match=r"pip install -e '\.\[mcap\]'"):
        export_planned(planned, "mcap", tmp_path / "some" / "where" / "out")
    assert list(tmp_path.iterdir()) == []


# ---------------------------------------------------------------- the command
def test_the_command_writes_and_lists_files(
    filed: Record, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_record(filed, tmp_path / "arm")
    done = runner.invoke(app, ["export", str(tmp_path / "arm"), "--to", "csv", "--rate", "100", "--json"])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert told["to"] == "csv" and told["directory"] == str(tmp_path / "arm_csv")
    assert [Path(p).name for p in told["files"]] == ["meta.json", "motion.csv"]
    assert all(Path(p).is_file() for p in told["files"])
    out = tmp_path / "a scene"
    done = runner.invoke(app, ["export", str(tmp_path / "arm"), "--to", "mujoco", "--out", str(out)])
    *_, scene, command = done.stdout.splitlines()
    assert scene == f"{out}/scene.xml" and shlex.split(command) == ["python", f"{out}/play.py"]
    monkeypatch.chdir(tmp_path / "arm")
    done = runner.invoke(app, ["export", ".", "--to", "mjlab", "--json"])
    assert json.loads(done.stdout)["directory"] == str(tmp_path / "arm_mjlab")
    done = runner.invoke(app, ["export", str(tmp_path / "arm"), "--to", "csv", "--joints", "a,b"])
    assert done.exit_code == 2 and done.stderr.count("error:") == 1 and "'a'" in done.stderr


@pytest.fixture
def own_and_other(filed: Record, tmp_path: Path) -> tuple[Path, list[tuple[Path, bool]]]:
    """A saved plan; its problem's file and another one, and whether that is told."""
    save_record(filed, tmp_path / "arm")
    other, changed = (
        tmp_path / "other.toml",
        filed.problem.replace("resistance_N = 600", "resistance_N = 500"),
    )
    other.write_text(changed, encoding="utf-8")
    return tmp_path / "arm", [(problem_file("arm_planar"), False), (other, True)]


def test_a_problem_file_that_is_not_the_plans_is_told(
    own_and_other: tuple[Path, list[tuple[Path, bool]]], tmp_path: Path
) -> None:
    """The target and the law in the files are then of another problem than the motion."""
    plan, files = own_and_other
    for file, told in files:
        out = ["--to", "csv", "--out", str(tmp_path / "csv"), "--problem", str(file)]
        done = runner.invoke(app, ["export", str(plan), *out])
        assert done.exit_code == 0, done.output
        assert ("is not the problem of this plan" in done.stdout) == told
        done = runner.invoke(app, ["export", str(plan), *out, "--json"])
        assert ("caution" in json.loads(done.stdout)) == told


@pytest.mark.slow
def test_pictures_and_replays_under_another_problem_tell_it(
    own_and_other: tuple[Path, list[tuple[Path, bool]]], tmp_path: Path
) -> None:
    plan, files = own_and_other
    page = tmp_path / "page.html"
    for file, told in files:
        for command in (
            ["show", "--out", str(page)],
            ["show", "--sheet", str(tmp_path / "sheet.png")],
            ["validate", "-q"],
        ):
            given = [*command, str(plan), "--problem", str(file)]
            done = runner.invoke(app, given, env={"COLUMNS": "200"})
            assert done.exit_code == 0, done.output
            assert ("is not the problem of this plan" in done.stdout) == told
        assert ("is not the problem of this plan" in page.read_text(encoding="utf-8")) == told
        done = runner.invoke(app, ["validate", str(plan), "--problem", str(file), "--json"])
        assert ("caution" in json.loads(done.stdout)) == told
    # the plan's file with another value
    given = ["--problem", str(files[0][0]), "--set", "target.mass_kg=0.06"]
    done = runner.invoke(app, ["validate", "-q", str(plan), *given], env={"COLUMNS": "200"})
    assert "arm_planar.toml with --set is not the problem of this plan" in " ".join(done.stdout.split())


def test_the_command_knows_all_formats() -> None:
    assert list(get_args(Choice)) == list(FORMATS)
    assert callable(impactopt.export)
