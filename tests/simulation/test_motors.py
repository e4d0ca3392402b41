"""Motors in replays: line, lag and delay, in both engines, against closed forms and MuJoCo's dcmotor."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from impactopt import Actuator, FreeMass, InputError, Robot, SoftGrip, SpringDamper, Striker, load_problem
from impactopt.report.result_rows import result_rows
from impactopt.simulation.motors import Delay, Motors, Servo
from impactopt.simulation.mujoco_engine import simulate_mujoco
from impactopt.simulation.mujoco_world import MujocoOptions, robot_bodies, spec_of
from impactopt.simulation.pinocchio_engine import simulate_pinocchio
from impactopt.simulation.result import Scene, Simulation

ENGINES: dict[str, Callable[..., Simulation]] = {"pinocchio": simulate_pinocchio, "mujoco": simulate_mujoco}
INERTIA, END = 0.5, 0.3  # [kg m2] about the joint, with its armature; [s]
STALL, IDLE = 60.0, 10.0  # [N m], [rad/s]


def lever(kp: float = 0.0, kd: float = 0.0, **actuator: Any) -> Robot:
    """One joint without gravity; its hand is half a metre away from the axis."""
    model = pin.Model()
    model.gravity = pin.Motion.Zero()
    joint = model.addJoint(0, pin.JointModelRZ(), pin.SE3.Identity(), "joint")
    model.addJointFrame(joint, 0)
    body = pin.Inertia(1.0, np.zeros(3), np.diag([0.3, 0.3, INERTIA - 0.1]))
    model.appendBodyToJoint(joint, body, pin.SE3.Identity())
    return Robot.from_model(
        model,
        name="lever",
        armature=0.1,
        kp=kp,
        kd=kd,
        torque_limit=80.0,
        velocity_limit=50.0,
        position_limit={"joint": (-50.0, 50.0)},
        strikers=(Striker(name="hand", frame="joint", point=np.array([0.5, 0.0, 0.0])),),
        actuators={"*": Actuator(**actuator)},
    )


def course(q: Any, v: Any, torque: Any) -> Any:
    """A reference from functions of time."""
    time = np.linspace(0.0, END, 601)
    rows = [np.array([np.broadcast_to(f(t), (1,)) for t in time], dtype=float) for f in (q, v, torque)]
    return SimpleNamespace(time=time, q=rows[0], v=rows[1], torque=rows[2], end=END, contact_end=END)


def pushed(torque: Any) -> Any:
    """A reference that is feed-forward torque alone."""
    return course(lambda t: 0.0, lambda t: 0.0, torque)


def replay(
    engine: str, robot: Robot, reference: Any, *, away: float = 100.0, step: float = 1e-4
) -> Simulation:
    """Of a lever whose target is so far [m] ahead of its hand."""
    scene = Scene(
        point=np.array([0.5, away, 0.0]),
        normal=np.array([0.0, 1.0, 0.0]),
        law=SpringDamper(stiffness=1e4, damping=10.0),
        target=FreeMass(mass=0.5),
        striker="striker:hand",
        soles=(),
        corners=(),
        polygon=np.zeros((0, 2)),
    )
    return ENGINES[engine](robot, reference, scene, step=step, record=1, settle=0.0)


# ---------------------------------------------------------------- by themselves
def test_a_line_drives_less_and_brakes_more_at_speed() -> None:
    motors = Motors(lever(stall_torque=STALL, no_load_speed=IDLE, coulomb_friction=2.0, viscous_friction=0.5))
    much = np.array([1e3])
    for rate in (-15.0, -4.0, 0.0, 4.0, 15.0):
        most, least = (float(motors.cut(sign * much, np.array([rate]))[0]) for sign in (1, -1))
        friction = 2.0 * np.sign(rate) + 0.5 * rate
        assert most == pytest.approx(STALL * (1 - rate / IDLE) - friction)
        assert least == pytest.approx(-STALL * (1 + rate / IDLE) - friction)
    np.testing.assert_array_equal(motors.cut(np.array([3.0]), np.array([4.0])), 3.0)


def test_without_data_nothing_is_between_servo_and_joint() -> None:
    robot = lever()
    motors, torque = Motors(robot), np.array([1e3])
    assert not motors.lines and motors.cut(torque, torque) is torque
    assert motors.after(0 * torque, torque, 1e-4) is torque and Delay(robot).at(1.0, torque) is torque


def test_a_servo_with_other_gains_leaves_the_springs_of_a_grip_as_they_are() -> None:
    grip = SoftGrip(axis=[0, 1, 0], stiffness=20.0, damping=0.5, point=[0.0, 0.0, 0.08])
    robot = load_problem("arm_planar").robot.with_grip("hammer", grip)
    (joint,) = np.flatnonzero(robot.passive)
    q, none = np.zeros((2, robot.n)), np.zeros((2, robot.n))
    ref = SimpleNamespace(time=np.array([0.0, 1.0]), q=q, v=none, torque=none)
    servo = Servo(robot, ref, kp=0.5, kd=0.5)
    torque = servo.springs(np.full(robot.n, 0.1), np.full(robot.n, 0.2))[joint]
    assert torque == pytest.approx(-20.0 * 0.1 - 0.5 * 0.2)


@pytest.mark.parametrize(
    "numbers", [{"bandwidth": 0.0}, {"delay": -1e-3}, {"delay": 5.0}, {"bandwidth": 1e9}]
)
def test_lags_that_are_none_are_refused(numbers: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(numbers))):
        Actuator(**numbers)


# ---------------------------------------------------------------- closed forms, in both engines
@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
def test_a_push_beyond_the_line_ends_at_the_no_load_speed(engine: str) -> None:
    """Constant until the line is met; then the speed goes to no load's with the line's own rate."""
    wanted = 50.0
    robot = lever(stall_torque=STALL, no_load_speed=IDLE)
    found = replay(engine, robot, pushed(lambda t: wanted), step=5e-5)
    meets = IDLE * (1 - wanted / STALL)  # [rad/s]
    since = meets * INERTIA / wanted
    late = np.maximum(found.time - since, 0.0)
    rest = (IDLE - meets) * np.exp(-STALL / IDLE / INERTIA * late)
    speed = np.where(found.time < since, wanted / INERTIA * found.time, IDLE - rest)
    np.testing.assert_allclose(found.v[:, 0], speed, atol=2e-3)
    assert found.cuts is not None
    (cut,) = found.cuts
    assert cut.joint == "joint" and cut.since == pytest.approx(since, abs=1e-4)
    assert cut.duration == pytest.approx(END - since, abs=2e-4)
    assert cut.most == pytest.approx(wanted - STALL * (1 - speed[-1] / IDLE), rel=1e-3)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_lag_is_of_first_order(engine: str) -> None:
    hertz, jump = 20.0, 0.1
    found = replay(engine, lever(bandwidth=hertz), pushed(lambda t: 10.0 * (t >= jump)))
    reached = 10.0 * -np.expm1(-2 * np.pi * hertz * np.maximum(found.time - jump, 0.0))
    # the reference rises within half a millisecond
    np.testing.assert_allclose(found.torque[:, 0], reached, atol=10.0 * 2 * np.pi * hertz * 5e-4)
    speed = np.cumsum(reached) * 1e-4 / INERTIA
    assert found.v[-1, 0] == pytest.approx(speed[-1], rel=3e-3)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_spring_swings_about_its_rest(engine: str) -> None:
    """It is no motor: it has no torque limit, and no part in the torque that is recorded."""
    stiffness, rest = 400.0, 0.7
    found = replay(engine, lever(spring_stiffness=stiffness, spring_rest=rest), pushed(lambda t: 0.0))
    wanted = rest * (1 - np.cos(np.sqrt(stiffness / INERTIA) * found.time))
    np.testing.assert_allclose(found.q[:, 0], wanted, atol=2e-3)
    assert not found.torque.any()


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
def test_a_delay_shifts_what_is_asked_for(engine: str) -> None:
    """Half of it a ramp, so that instants between steps count."""
    late = 4.23e-3
    plain, delayed = (
        replay(engine, lever(**numbers), pushed(lambda t: 40.0 * t + 5.0 * (t > 0.15)))
        for numbers in ({}, {"delay": late})
    )
    np.testing.assert_allclose(
        delayed.torque[:, 0], np.interp(plain.time - late, plain.time, plain.torque[:, 0]), atol=1e-9
    )
    np.testing.assert_array_equal(delayed.torque, delayed.demand)
    assert plain.cuts is None


# ---------------------------------------------------------------- MuJoCo's own motor
CONSTANT, RESISTANCE = 1.2, 0.3  # [N m/A], [Ohm] at the joint


def mujocos_motor(robot: Robot, reference: Any, *, lag: float, step: float) -> tuple[Any, Any, Any]:
    """Time, angle and torque of the lever with a `dcmotor`, whose voltage a servo sets that makes up for the
    back-EMF and has STALL at rest under all of it."""
    constant, resistance, voltage = CONSTANT, RESISTANCE, STALL * RESISTANCE / CONSTANT
    spec = spec_of(robot, MujocoOptions(step=step))
    robot_bodies(mujoco, spec, robot)
    motor = spec.add_actuator(name="motor", target="joint", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    motor.set_to_dcmotor([constant, constant], resistance, inductance=[resistance * lag, 0.0])
    motor.ctrllimited, motor.ctrlrange = True, [-voltage, voltage]
    model = spec.compile()
    data = mujoco.MjData(model)
    rows = []
    for k in range(round(END / step)):
        t, (angle,), (rate,) = k * step, data.qpos, data.qvel
        q, v, torque = (
            float(np.interp(t, reference.time, x[:, 0])) for x in (reference.q, reference.v, reference.torque)
        )
        asked = np.clip(torque + robot.kp[0] * (q - angle) + robot.kd[0] * (v - rate), -80.0, 80.0)
        if k == 0:  # as in a replay, the motor begins with what it is asked for
            data.act[0] = np.clip(asked, -STALL, STALL) / constant
        data.ctrl[0] = resistance / constant * asked + constant * rate
        mujoco.mj_step(model, data)
        rows.append((t, angle, data.actuator_force[0]))
    time, angles, torques = np.array(rows).T
    return time, angles, torques


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
def test_a_motor_is_mujocos_own(engine: str) -> None:
    """A swing there and back that is too fast for the motor: it brakes harder than it drives."""
    lag, idle = 3e-3, STALL * RESISTANCE / CONSTANT**2
    wave = 2 * np.pi / 0.2
    reference = course(
        lambda t: 0.2 * (1 - np.cos(wave * t)),
        lambda t: 0.2 * wave * np.sin(wave * t),
        lambda t: INERTIA * 0.2 * wave**2 * np.cos(wave * t),
    )
    known = {"stall_torque": STALL, "no_load_speed": idle, "bandwidth": 1 / (2 * np.pi * lag)}
    servo = {"kp": 300.0, "kd": 10.0}
    robot = lever(**servo, **known)
    time, angle, torque = mujocos_motor(robot, reference, lag=lag, step=2e-5)
    found = replay(engine, robot, reference)
    ideal = replay(engine, lever(**servo), reference)

    def off(one: Simulation) -> tuple[float, float]:
        """[rad], and of the stall torque, at most."""
        angles, torques = (np.interp(one.time, time, x) for x in (angle, torque))
        return (
            float(np.abs(one.q[:, 0] - angles).max()),
            float(np.abs(one.torque[:, 0] - torques).max() / STALL),
        )

    assert found.cuts is not None and found.cuts[0].duration > 0.02
    (angle_off, torque_off), (without, torque_without) = off(found), off(ideal)
    assert torque_off < 5e-3 and torque_without > 0.5
    assert angle_off < 1e-3 and without > 0.05


# ---------------------------------------------------------------- what is told
@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
def test_a_replay_says_where_a_line_has_cut(engine: str) -> None:
    robot = lever(stall_torque=STALL, no_load_speed=3.0)
    found = replay(engine, robot, pushed(lambda t: 55.0), away=0.02)
    limits = {"torque_limit": robot.torque_limit, "polygon": np.zeros((0, 2)), "planned_impulse": 1.0}
    told = found.report(**limits)
    assert told["motor_cut_joint"] == "joint" and told["motor_cut_ms"] > 10
    assert told["motor_cuts"][0]["ms"] == told["motor_cut_ms"]
    rows = {
        row.label: row.cells for row in result_rows({"planned": {}, "simulated": found.summary(**limits)})
    }
    assert not rows["cut by the motor's line [ms]"][1].good
    free = replay(engine, lever(), pushed(lambda t: 55.0), away=0.02).report(**limits)
    assert free["motor_cut_ms"] is None and free["motor_cuts"] == []
