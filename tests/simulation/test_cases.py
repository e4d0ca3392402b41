"""Postures of a given effective mass, striking velocities, and errors against a reference."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from benchmarks.cases import Case, paper_motions
from support.small_robots import arm, biped, slider

from impactopt import (
    SDC,
    FreeMass,
    InputError,
    Robot,
    SpringDamper,
    VirtualMass,
    posture_of_effective_mass,
    standin,
    striking_velocity,
)
from impactopt.collision import Collision
from impactopt.kinematics.stance import margin
from impactopt.simulation.cases import errors_against

LAW, TARGET = SpringDamper(stiffness=1e4, damping=300.0), FreeMass(mass=5.0)


@pytest.fixture(scope="module")
def robot() -> Robot:
    return standin()


def held_jacobian(robot: Robot, q: np.ndarray, striker: str) -> tuple[np.ndarray, np.ndarray]:
    """Jacobians (of the soles, of the striking point's velocity), anew in Pinocchio."""
    model, data = robot.model, robot.model.createData()
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    J = [
        pin.getFrameJacobian(model, data, model.getFrameId(frame), pin.LOCAL_WORLD_ALIGNED)
        for frame in (*[sole.frame for sole in robot.soles], f"striker:{striker}")
    ]
    return np.vstack(J[:-1]), J[-1][:3]


# ---------------------------------------------------------------- posture
@pytest.mark.parametrize("mass", [4.0, 6.0, 8.0])
def test_a_posture_has_its_mass_its_soles_and_its_limits(robot: Robot, mass: float) -> None:
    q = posture_of_effective_mass(robot, mass, "right_hand", (1.0, 0.0, 0.0))
    robot.check_limits(q)
    robot.check_stance(q, height=1e-7, tilt=1e-7)
    # soles stand where they stood, and the centre of mass is over them
    model, data, before = robot.model, robot.model.createData(), robot.model.createData()
    pin.framesForwardKinematics(model, data, q)
    pin.framesForwardKinematics(model, before, robot.posture("half_sitting"))
    corners = []
    for sole in robot.soles:
        frame = model.getFrameId(sole.frame)
        assert np.allclose(data.oMf[frame].homogeneous, before.oMf[frame].homogeneous, atol=1e-7)
        corners += [data.oMf[frame].act(np.array([*corner, 0.0]))[:2] for corner in sole.polygon]
    x, y = np.array(corners).T
    hull = np.array([[x.min(), y.min()], [x.max(), y.min()], [x.max(), y.max()], [x.min(), y.max()]])
    com = pin.centerOfMass(model, data, q)[None, :2]
    assert margin(hull, com)[0] > 0.06 - 1e-7
    # the effective mass, from dense matrices
    H = pin.crba(model, data, q)
    H = np.triu(H) + np.triu(H, 1).T
    Jc, Jh = held_jacobian(robot, q, "right_hand")
    Hi = np.linalg.inv(H)
    P = Hi - Hi @ Jc.T @ np.linalg.solve(Jc @ Hi @ Jc.T, Jc @ Hi)
    assert 1 / (Jh[0] @ P @ Jh[0]) == pytest.approx(mass, abs=2e-6)


def test_the_same_posture_every_time(robot: Robot) -> None:
    one, other = (posture_of_effective_mass(robot, 6.0, "left_hand", (1.0, 0.0, 0.0)) for _ in range(2))
    assert np.array_equal(one, other)


def test_a_fixed_arm_has_postures_too() -> None:
    robot = arm()
    q = posture_of_effective_mass(robot, 1.5, "hand", (1.0, 0.0, 0.0), start=robot.posture("start"))
    robot.check_limits(q)
    assert not np.allclose(q, robot.posture("start"))


def test_a_mass_out_of_reach_is_refused() -> None:
    with pytest.raises(
        InputError, match=r"no posture near the start has an effective mass of 1000 kg .*nearest: 4 kg"
    ):
        posture_of_effective_mass(slider(4.0), 1e3, "tip", (1.0, 0.0, 0.0), start=np.zeros(1))


def test_bad_input_is_refused_before_the_search() -> None:
    robot = slider(4.0)
    with pytest.raises(InputError, match=r"mass \[kg\]: -1; give a number > 0"):
        posture_of_effective_mass(robot, -1.0, "tip", (1.0, 0.0, 0.0))
    with pytest.raises(InputError, match="no posture half_sitting; give start="):
        posture_of_effective_mass(robot, 4.0, "tip", (1.0, 0.0, 0.0))
    with pytest.raises(InputError, match="striker"):
        posture_of_effective_mass(robot, 4.0, "fist", (1.0, 0.0, 0.0), start=np.zeros(1))


# ---------------------------------------------------------------- velocity
def test_a_striking_velocity_holds_the_soles_and_has_least_energy(robot: Robot) -> None:
    q = robot.posture("half_sitting")
    normal = np.array([0.6, 0.0, 0.8])
    v = striking_velocity(robot, q, "right_hand", normal, 0.7)
    Jc, Jh = held_jacobian(robot, q, "right_hand")
    assert np.abs(Jc @ v).max() < 1e-9
    assert Jh @ v == pytest.approx(0.7 * normal, abs=1e-9)
    # any other such motion has more energy: the gradient of the energy vanishes along all of them
    H = pin.crba(robot.model, robot.model.createData(), q)
    H = np.triu(H) + np.triu(H, 1).T
    _, sizes, rows = np.linalg.svd(np.vstack([Jc, Jh]))
    others = rows[int((sizes > 1e-9).sum()) :]
    assert len(others) == robot.nv - 15
    assert np.abs(others @ H @ v).max() < 1e-9


def test_a_point_that_cannot_move_so_is_refused() -> None:
    with pytest.raises(InputError, match="cannot move along"):
        striking_velocity(slider(4.0), np.zeros(1), "tip", (0.0, 0.0, 1.0), 1.0)


# ---------------------------------------------------------------- the paper's motions
def test_the_papers_motions_have_its_names_masses_and_speeds(robot: Robot) -> None:
    cases = paper_motions(robot, masses={"A": 4.0, "C": 8.0}, speeds=(0.4, 1.0))
    assert [case.name for case in cases] == ["A-1", "A-2", "C-1", "C-2"]
    for case, mass, speed in zip(cases, (4.0, 4.0, 8.0, 8.0), 2 * (0.4, 1.0), strict=True):
        assert case.effective_mass == pytest.approx(mass, abs=1e-6)
        _, Jh = held_jacobian(robot, case.q, case.striker)
        assert case.speed == speed and Jh @ case.v == pytest.approx([speed, 0.0, 0.0], abs=1e-9)
        assert np.all(np.abs(case.v[-robot.n :]) < robot.velocity_limit)
        assert np.all(np.abs(case.torque) < robot.torque_limit)


def test_a_model_gets_the_overrides_that_it_has() -> None:
    robot = slider(4.0, kp=0.0, kd=0.0)
    given: dict[str, Any] = {
        "robot": robot,
        "striker": "tip",
        "normal": np.array([1.0, 0.0, 0.0]),
    }
    case = Case(
        **given,
        name="stiff",
        q=np.zeros(1),
        v=np.ones(1),
        torque=np.zeros(1),
        effective_mass=4.0,
        speed=1.0,
        overrides={"kd": 50.0, "target_mass": 1.0},
    )
    point, sdc = (kind(**given, law=LAW, target=TARGET) for kind in (VirtualMass, SDC))
    alone = point.collide(case.q, case.v, target_mass=1.0)
    assert case.collide(point).impulse == alone.impulse
    assert case.collide(sdc).impulse > alone.impulse  # its servo pushes on


# ---------------------------------------------------------------- errors
def made_up(time: Any, *, impulse: float = 2.0, weight: float = 500.0, **change: Any) -> Collision:
    """A collision whose ZMP is at (0.1, 0) m + 0.01 m/s t, and whose torques are t [N m] and 2 t."""
    t = np.asarray(time, dtype=float)
    ground = np.zeros((t.size, 6))
    ground[:, 2] = weight
    ground[:, 4] = -weight * (0.1 + 0.01 * t)
    values: dict[str, Any] = {
        "impulse": impulse,
        "peak_force": 100.0,
        "duration": float(t[-1]),
        "energy": 1.0,
        "separated": True,
        "velocity": np.zeros(2),
        "configuration": np.zeros(2),
        "target_result": {},
        "time": t,
        "force": np.zeros(t.size),
        "penetration": np.zeros(t.size),
        "hand_speed": np.zeros(t.size),
        "target_speed": np.zeros(t.size),
        "joint_velocity": np.zeros((t.size, 2)),
        "torque": np.stack([t, 2 * t], axis=1),
        "demand": np.zeros((t.size, 2)),
        "sole_wrench": None,
        "hand_wrench": None,
        "ground_wrench": ground,
        "zmp": None,
    }
    return Collision(**{**values, **change})


def test_errors_are_signed_and_in_per_cent() -> None:
    errors = errors_against(
        made_up([0.0, 1.0], impulse=1.9, peak_force=105.0), made_up([0.0, 1.0]), torque_limit=[10.0, 10.0]
    )
    assert errors["impulse_error_pct"] == pytest.approx(-5.0)
    assert errors["f_max_error_pct"] == pytest.approx(5.0)
    assert errors["zmp_error_mm"] == pytest.approx(0.0, abs=1e-9)
    assert errors["torque_error_pct"] == pytest.approx(0.0, abs=1e-12)


def test_histories_are_compared_at_equal_times_while_both_are_in_contact() -> None:
    # the reference's instants lie elsewhere, and the model goes on for longer than it
    model, reference = made_up(np.linspace(0.0, 2.0, 21)), made_up(np.linspace(0.0, 1.0, 7))
    same = errors_against(model, reference, torque_limit=[10.0, 5.0])
    assert same["zmp_error_mm"] == pytest.approx(0.0, abs=1e-9)
    assert same["torque_error_pct"] == pytest.approx(0.0, abs=1e-9)
    late = dataclasses.replace(model, time=model.time + 0.05)
    off = errors_against(late, reference, torque_limit=[10.0, 5.0])
    assert off["zmp_error_mm"] == pytest.approx(1e3 * 0.01 * 0.05)
    assert off["torque_error_pct"] == pytest.approx(100 * 2 * 0.05 / 5.0)  # the second joint's


def test_without_weight_on_the_ground_there_is_no_zmp() -> None:
    time = [0.0, 1.0]
    for model, reference in ((40.0, 500.0), (500.0, 40.0)):
        errors = errors_against(made_up(time, weight=model), made_up(time, weight=reference))
        assert errors["zmp_error_mm"] is None
        assert errors["torque_error_pct"] is None  # no limits were given


def test_a_point_mass_has_errors_of_impulse_and_force_only() -> None:
    robot = biped()
    point = VirtualMass(robot=robot, striker="fist", normal=(1.0, 0.0, 0.0), law=LAW, target=TARGET)
    q = robot.posture("half_sitting")
    found = point.collide(q, striking_velocity(robot, q, "fist", (1.0, 0.0, 0.0), 1.0))
    errors = errors_against(found, made_up([0.0, 1.0]), torque_limit=np.ones(2))
    assert errors["zmp_error_mm"] is None and errors["torque_error_pct"] is None
    assert errors["impulse_error_pct"] == pytest.approx(100 * (found.impulse - 2.0) / 2.0)
