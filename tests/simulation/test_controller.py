"""The whole-body controller: its QP, its sensors and state, standing and pushes, and how it is chosen."""

from __future__ import annotations

import itertools
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize
from support.small_motions import blow_motion, scene, standing, standing_on_left
from support.small_robots import arm, biped

from impactopt import InputError, Perturbation, Robot
from impactopt.files.problem_file import read_problem_file
from impactopt.simulation import ControllerSettings, Scene, Simulation, collision_geometry, simulate_mujoco
from impactopt.simulation.collision_geometry import Solid, Solids
from impactopt.simulation.controller import clearance, controller_of
from impactopt.simulation.controller.clearance import Clearance
from impactopt.simulation.controller.sensors import Sensors, StateEstimate
from impactopt.simulation.controller.tracking_reference import Recovery, TrackingReference
from impactopt.simulation.controller.whole_body import TorqueQP, TorqueResponse, wrench_cone
from impactopt.simulation.mujoco_engine import _Replay
from impactopt.simulation.mujoco_world import MujocoOptions

Array = NDArray[np.float64]
QUIET = ControllerSettings(noise=0.0)


def still(robot: Robot) -> tuple[Any, Scene]:
    """A robot that stands, as a reference with all that a trajectory has."""
    given, where, _ = standing(robot)
    rest = {"a": np.zeros_like(given.v), "contact_start": 0.5, "contact_end": 0.6}
    return SimpleNamespace(**(vars(given) | rest)), where


def stand(world: Perturbation | None = None, settings: ControllerSettings | None = None) -> Simulation:
    """For a second, in steps of 1 ms."""
    robot = biped()
    ref, where = still(robot)
    return simulate_mujoco(
        robot, ref, where, step=1e-3, settle=1.0, perturbation=world, controller=settings, record=10
    )


# ---- the QP


def test_the_qp_has_the_answer_of_a_dense_solver() -> None:
    """Several in a row: matrices are updated in place, and each begins where the one before has ended."""
    random, n, m = np.random.default_rng(3), 6, 4
    qp = TorqueQP(n, m, iterations=200)
    for _ in range(5):
        root = random.normal(size=(n, n))
        P, q, C = root @ root.T + 0.1 * np.eye(n), 3 * random.normal(size=n), random.normal(size=(m, n))
        c, low, high = C @ (0.2 * random.normal(size=n)) - 0.1, -np.ones(n), np.ones(n)
        exact = minimize(
            lambda x, P=P, q=q: 0.5 * x @ P @ x + q @ x,
            np.zeros(n),
            jac=lambda x, P=P, q=q: P @ x + q,
            bounds=list(zip(low, high, strict=True)),
            constraints={"type": "ineq", "fun": lambda x, C=C, c=c: C @ x - c, "jac": lambda x, C=C: C},
            method="SLSQP",
            options={"ftol": 1e-12, "maxiter": 200},
        )
        assert exact.success
        np.testing.assert_allclose(qp.solve(P, q, C, c, low, high), exact.x, atol=2e-4)


def test_torques_move_a_held_robot_by_its_equation_of_motion() -> None:
    robot = biped()
    ref, where = still(robot)
    q = np.asarray(ref.q[0])
    held = TorqueResponse(robot, where.soles, where.strikers, where.normal, q)
    held.update(q, np.zeros(robot.nv), forces=40.0)
    torque = 20 * np.sin(np.arange(robot.n))
    a, wrench = held.A @ torque + held.a0, held.B @ torque + held.b0
    model, data = robot.model, robot.model.createData()
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    axes = pin.LOCAL_WORLD_ALIGNED
    push = -40.0 * where.normal @ pin.getFrameJacobian(model, data, model.getFrameId(where.striker), axes)[:3]
    push[6:] += torque
    for name, part in zip(where.soles, wrench.reshape(-1, 6), strict=True):
        J = pin.getFrameJacobian(model, data, model.getFrameId(name), axes)
        push += J.T @ part
        np.testing.assert_allclose(J @ a, 0.0, atol=1e-8)
    np.testing.assert_allclose(pin.rnea(model, data, q, np.zeros(robot.nv), a), push, atol=1e-7)


@pytest.mark.parametrize("friction", [0.4, 0.9])
def test_the_cone_holds_what_corners_can_bear(friction: float) -> None:
    """Forces at the corners inside their pyramids make wrenches inside; none pulls or turns more."""
    _, where = still(biped())
    settings = replace(QUIET, friction=friction, cop_margin=0.0)
    random, corners = np.random.default_rng(1), where.corners[0]
    cone = wrench_cone(corners, settings)
    at = np.column_stack([corners, np.zeros(len(corners))])
    for _ in range(50):
        force = random.random((len(at), 3))
        force[:, :2] = friction * force[:, 2:] * (2 * force[:, :2] - 1)
        wrench = np.concatenate([force.sum(axis=0), np.cross(at, force).sum(axis=0)])
        assert (cone @ wrench).min() >= -1e-12
    reach = friction * np.ptp(corners, axis=0).sum() / 2  # [m] of the torsion of a unit normal force
    middle = corners.mean(axis=0)
    straight = np.array([0.0, 0.0, 1.0, middle[1], -middle[0], 0.0])
    for wrench in (
        -straight,
        straight + np.array([1.01 * friction, 0, 0, 0, 0, -1.01 * friction * middle[1]]),
        straight + np.array([0, 0, 0, 0, 0, 1.01 * reach]),
        straight + np.array([0, 0, 0, 1.01 * np.ptp(corners[:, 1]) / 2, 0, 0]),
    ):
        assert (cone @ wrench).min() < 0


# ---- what it knows


def test_the_state_is_known_exactly_without_errors_of_sensors() -> None:
    """Joints that move with the soles where they stood."""
    robot = biped()
    ref, where = still(robot)
    q0 = np.asarray(ref.q[0])
    held = TorqueResponse(robot, where.soles, where.strikers, where.normal, q0)
    held.update(q0, np.zeros(robot.nv))
    v = 0.1 * (
        held.A @ np.sin(np.arange(robot.n))
    )  # accelerations of a held robot are velocities of one, too
    rotation = pin.Quaternion(q0[3:7]).toRotationMatrix()
    measured = Sensors(robot, noise=0.0, rate=1000.0, seed=1).read(
        robot.joint_positions(q0), v, rotation, np.array([7.0])
    )
    points = np.array([[0.05, 0.02, 0.0], [-0.03, 0.0, 0.0]])
    q, rates = StateEstimate(robot, where.soles, q0).of(measured, np.array([1.0, 3.0]), points)
    np.testing.assert_allclose(q, q0, atol=1e-12)
    np.testing.assert_allclose(rates, v, atol=1e-12)
    assert measured.forces.tolist() == [7.0]


def test_errors_of_sensors_are_of_their_seed() -> None:
    robot = biped()
    q, v = robot.posture("half_sitting"), np.zeros(robot.nv)

    def read(seed: int) -> Array:
        sensors = Sensors(robot, noise=1.0, rate=1000.0, seed=seed)
        return sensors.read(robot.joint_positions(q), v, np.eye(3), np.zeros(1)).angles

    assert np.array_equal(read(1), read(1))
    assert not np.array_equal(read(1), read(2))


def test_the_motion_before_the_blow_coasts_on_until_the_hand_is_free() -> None:
    robot = arm()
    time = np.array([0.0, 0.5, 0.5, 0.6, 0.6, 1.0])
    q0, v0 = robot.posture("start"), np.full(robot.nv, 0.5)
    q = np.array([pin.integrate(robot.model, q0, min(t, 0.6) * v0) for t in time])
    v = np.vstack([np.tile(v0, (4, 1)), np.zeros((2, robot.nv))])
    ref = SimpleNamespace(
        time=time,
        q=q,
        v=v,
        a=np.zeros_like(v),
        torque=np.zeros((6, robot.n)),
        contact_start=0.5,
        contact_end=0.6,
    )
    target = TrackingReference(robot, ref, ("striker:hand",), spread=True)
    target.update_contact(0.55, True)  # later than planned
    late = target.at(0.64)
    np.testing.assert_allclose(late.v, v0)
    np.testing.assert_allclose(late.q, pin.integrate(robot.model, q0, 0.64 * v0), atol=1e-12)
    target.update_contact(0.66, False)
    np.testing.assert_allclose(target.at(0.66).v, 0.0)
    assert target.clock(0.70)[0] == pytest.approx(0.64)


def bowed(robot: Robot, where: Scene, ref: Any) -> Any:
    """A reference that ends with its centre of mass 6 cm ahead."""
    q0 = np.asarray(ref.q[0])
    ahead = replace(where, polygon=where.polygon + np.array([0.06, 0.0]))
    recovery = Recovery(robot, ref, ahead, replace(QUIET, recovery_margin=1.0))
    q = np.array([pin.integrate(robot.model, q0, part * recovery.shift) for part in (0.0, 0.5, 1.0)])
    v = np.zeros((3, robot.nv))
    torque = np.zeros((3, robot.n))
    return SimpleNamespace(
        time=np.array([0.0, 0.5, 1.0]), q=q, v=v, a=v, torque=torque, contact_start=0.2, contact_end=0.3
    )


@pytest.mark.parametrize("margin", [0.0, 1.0])
def test_a_recovery_ends_inside_the_soles_which_stay(margin: float) -> None:
    robot = biped()
    still_ref, where = still(robot)
    ref = bowed(robot, where, still_ref)
    recovery = Recovery(robot, ref, where, replace(QUIET, recovery_margin=margin))
    q = pin.integrate(robot.model, ref.q[-1], recovery.shift)
    model, data = robot.model, robot.model.createData()
    before, com = model.createData(), pin.centerOfMass(model, data, q)
    middle = (where.polygon.min(axis=0) + where.polygon.max(axis=0)) / 2
    ended = pin.centerOfMass(model, before, ref.q[-1])[:2]
    np.testing.assert_allclose(com[:2], middle if margin else ended, atol=1e-6)
    pin.framesForwardKinematics(model, data, q)
    pin.framesForwardKinematics(model, before, ref.q[0])
    for name in where.soles:
        i = model.getFrameId(name)
        np.testing.assert_allclose(data.oMf[i].homogeneous, before.oMf[i].homogeneous, atol=1e-6)


def test_a_recovery_on_one_foot_leaves_the_leg_in_the_air_as_it_is() -> None:
    robot, ref, where = standing_on_left()
    ref.contact_start, ref.contact_end = 0.5, 0.6
    # its own support, not that of the stance at the impact
    aside = where.polygon + np.array([0.02, 0.01])
    world = replace(where, polygon=where.polygon - np.array([0.0, 0.2]), polygons=(aside,))
    recovery = Recovery(robot, ref, world, replace(QUIET, recovery_margin=1.0))
    np.testing.assert_allclose(recovery.com_goal, (aside.min(axis=0) + aside.max(axis=0)) / 2, atol=1e-6)
    model, before, data = robot.model, robot.model.createData(), robot.model.createData()
    assert np.abs(recovery.shift).max() > 0.01
    lifted = [6 + k for k, name in enumerate(robot.joint_names) if name.startswith("right")]
    np.testing.assert_array_equal(recovery.shift[lifted], 0.0)
    pin.framesForwardKinematics(model, before, ref.q[-1])
    pin.framesForwardKinematics(model, data, pin.integrate(model, ref.q[-1], recovery.shift))
    foot = model.getFrameId(where.soles[0])
    np.testing.assert_allclose(data.oMf[foot].homogeneous, before.oMf[foot].homogeneous, atol=1e-6)


def test_a_recovery_slows_the_plan_down_without_a_jump() -> None:
    robot = biped()
    ref, where = still(robot)
    recovery = Recovery(robot, ref, where, replace(QUIET, recovery_pace=0.4))
    small = 1e-6
    for since in (0.01, 0.1, 0.3, 1.0):
        gone, rate, gain = recovery.progress(since)
        later = recovery.progress(since + small)
        assert (later[0] - gone) / small == pytest.approx(rate, rel=1e-4)
        assert (later[1] - rate) / small == pytest.approx(gain, abs=1e-6)
    assert recovery.progress(0.0)[:2] == (0.0, 1.0)
    assert recovery.progress(1.0)[1] == pytest.approx(0.4)


def test_the_recovery_begins_after_the_blow_and_goes_on_from_where_the_plan_is() -> None:
    robot = biped()
    still_ref, where = still(robot)
    ref = bowed(robot, where, still_ref)
    settings = replace(QUIET, recovery_start=0.1, recovery_margin=0.0)
    recovery = Recovery(robot, ref, where, settings)
    target = TrackingReference(robot, ref, where.strikers, spread=True, recovery=recovery)
    assert not target.recovers(5.0)  # nothing was hit
    target.update_contact(0.2, True)
    target.update_contact(0.4, False)  # 0.1 s later than planned
    assert not target.recovers(0.49)
    assert target.recovers(0.51)
    np.testing.assert_allclose(target.at(0.5 - 1e-9).q, target.at(0.5 + 1e-9).q, atol=1e-6)


# ---- what it does


@pytest.mark.slow
def test_it_stands_still_with_noise_and_delay() -> None:
    done = stand(settings=ControllerSettings())
    assert done.standing, done.fall
    assert float(done.slip.max()) < 1e-3
    assert float(done.lift.max()) < 1e-3
    assert done.posture_error < 0.02


def test_a_robot_of_a_kilogram_stands_as_a_heavy_one_does() -> None:
    """Its soles cannot bear the least force of a heavy robot's; all motions scale with the mass."""
    heavy, part = biped(), 0.02
    model = heavy.model.copy()
    for j, inertia in enumerate(heavy.model.inertias):
        model.inertias[j] = pin.Inertia(part * inertia.mass, inertia.lever, part * inertia.inertia)
    model.armature = part * np.array(heavy.model.armature)
    gains = {name: part * getattr(heavy, name) for name in ("kp", "kd", "torque_limit")}
    moved = []
    for robot in (heavy, replace(heavy, model=model, **gains)):
        done = simulate_mujoco(robot, *still(robot), step=1e-3, settle=0.0, until=0.3, controller=QUIET)
        moved.append(done.q[-1] - done.q[0])
    np.testing.assert_allclose(moved[1], moved[0], atol=1e-8)


def test_it_stands_without_a_weight_of_torques_posture_and_wrenches() -> None:
    """Torques that no task determines are the plan's."""
    done = stand(settings=replace(QUIET, torque=0.0, posture=0.0, wrench=0.0))
    assert done.standing, done.fall


@pytest.mark.slow
def test_it_stands_after_a_push_that_the_servo_does_not_survive() -> None:
    pushed = Perturbation(push=90.0, push_start=0.1, push_time=0.1, period=1e-3)
    assert not stand(pushed).standing
    done = stand(pushed, ControllerSettings())
    assert done.standing, done.fall


def test_noise_of_the_force_sensor_is_no_contact() -> None:
    """With five times the noise a hand hits about as hard; the reference after the impact would stop it."""
    robot, motion, where = blow_motion()
    slope = np.gradient(motion.v, motion.time, axis=0)
    ref = SimpleNamespace(**(vars(motion) | {"a": slope, "contact_start": 0.2, "contact_end": 0.25}))
    impulses = []
    for noise in (0.0, 5.0):
        settings = ControllerSettings(noise=noise, follow="plan")
        done = simulate_mujoco(robot, ref, where, step=1e-3, until=0.35, controller=settings)
        impulses.append(done.impulse)
    assert impulses[1] == pytest.approx(impulses[0], rel=0.2)


def test_an_arm_on_a_fixed_base_follows_too() -> None:
    robot = arm()
    q = robot.posture("start")
    torque = np.array(pin.computeGeneralizedGravity(robot.model, robot.model.createData(), q))
    k = 3
    ref = SimpleNamespace(
        time=np.linspace(0, 0.2, k),
        q=np.tile(q, (k, 1)),
        v=np.zeros((k, robot.nv)),
        a=np.zeros((k, robot.nv)),
        torque=np.tile(torque, (k, 1)),
        end=0.2,
        contact_start=0.1,
        contact_end=0.15,
    )
    done = simulate_mujoco(robot, ref, scene("striker:hand"), step=1e-3, settle=0.2, controller=QUIET)
    assert done.posture_error < 1e-4


# ---- how it is chosen


def test_settings_are_refused_by_name() -> None:
    for wrong in ({"rate": 10.0}, {"noise": -1.0}, {"impact": "never"}, {"iterations": 0}, {"com": np.nan}):
        with pytest.raises(InputError, match=f"controller: {next(iter(wrong))}"):
            ControllerSettings(**wrong)  # type: ignore[arg-type]


def test_controllers_have_names() -> None:
    assert controller_of("servo", QUIET) is None
    assert controller_of("wbc", QUIET) is QUIET
    with pytest.raises(InputError, match="wbc"):
        controller_of("wbk")


def test_a_problem_file_has_its_settings() -> None:
    usual = read_problem_file("arm_planar").controller
    assert usual == ControllerSettings()
    changed = read_problem_file("arm_planar", {"controller.rate": 500.0, "controller.impact": "spread"})
    assert changed.controller == replace(usual, rate=500.0, impact="spread")
    with pytest.raises(InputError, match="capture_gain"):
        read_problem_file("arm_planar", {"controller.capture_gain": -1.0})


def test_who_recovers_comes_late_through_what_is_planned_and_has_not_fallen() -> None:
    """A plan that bows by 1 rad after the blow is up again when a slower robot still bows."""
    robot = biped()
    ref, where = still(robot)
    q0 = np.asarray(ref.q[0])
    bow, back = q0.copy(), q0.copy()
    for q, angle in ((bow, 1.0), (back, -1.0)):
        q[3:7] = pin.Quaternion(pin.rpy.rpyToMatrix(0.0, angle, 0.0)).coeffs()
    ref.time = np.array([0.0, 0.6, 1.0, 1.5, 3.0])
    ref.q = np.array([q0, q0, bow, q0, q0])
    ref.v = ref.a = np.zeros((5, robot.nv))
    ref.torque = np.zeros((5, robot.n))
    replay = _Replay(robot, ref, where, Perturbation(), MujocoOptions(1e-3, 100, 1e-10), QUIET)
    assert replay.wbc is not None
    replay.start(bow)
    assert replay.fallen(2.0).startswith("fell"), "nothing was hit: it is due upright"
    replay.wbc.tracking.update_contact(0.55, True)
    replay.wbc.tracking.update_contact(0.6, False)
    assert replay.fallen(2.0) == ""
    replay.start(back)
    assert replay.fallen(2.0).startswith("fell"), "nobody planned that"


# ---- a recovery leaves room between links


def test_links_are_as_far_apart_as_their_hulls(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tetrahedra so small that they are points."""
    robot = biped()
    q = np.asarray(still(robot)[0].q[0])
    model, data = robot.model, robot.model.createData()
    small = 1e-5 * np.vstack([np.zeros(3), np.eye(3)])
    joints = [int(model.frames[model.getFrameId(name)].parentJoint) for name in still(robot)[1].soles]
    near = tuple(Solid(name=f"foot {k}", joint=j, vertices=small) for k, j in enumerate(joints))
    feet = Solids(solids=near, pairs=((0, 1),))
    turned = pin.integrate(model, q, 1e-2 * np.ones(robot.nv))
    expected = []
    for posture in (q, turned):
        pin.forwardKinematics(model, data, posture)
        expected.append(np.linalg.norm(data.oMi[joints[0]].translation - data.oMi[joints[1]].translation))
    monkeypatch.setattr(collision_geometry, "NEAR", 10.0)  # [m]: feet are near each other
    np.testing.assert_allclose(feet.least_distance(model, np.array([q, turned])), expected, atol=5e-5)


def test_only_links_that_a_shift_brings_nearer_are_looked_at() -> None:
    """Two of a foot keep their distance; a foot and the trunk do not, if a leg's joint moves."""
    robot = biped()
    model = robot.model
    foot = int(model.frames[model.getFrameId(still(robot)[1].soles[0])].parentJoint)
    corners = np.vstack([np.zeros(3), np.eye(3)])
    three = tuple(Solid(name=str(k), joint=j, vertices=corners) for k, j in enumerate((foot, foot, 1)))
    all_pairs = Solids(solids=three, pairs=((0, 1), (0, 2), (1, 2)))
    moves = np.zeros(robot.nv)
    moves[model.joints[foot].idx_v] = 0.1
    assert all_pairs.links_between(model, moves).pairs == ((0, 2), (1, 2))
    assert all_pairs.links_between(model, np.r_[np.ones(6), np.zeros(robot.nv - 6)]).pairs == ()


# ---- clearance


def test_near_links_brake_by_how_their_distance_changes() -> None:
    """Two cubes on sliders: what keeps them apart is known in closed form."""
    model = pin.Model()
    slider = pin.JointModelPX()
    for k in range(2):
        model.addJoint(0, slider, pin.SE3.Identity(), f"slider {k}")
    cube = 0.05 * np.array(list(itertools.product((-1, 1), repeat=3)), dtype=float)
    apart = Solids(
        solids=tuple(Solid(name=f"cube {k}", joint=k + 1, vertices=cube) for k in range(2)), pairs=((0, 1),)
    )

    def constraints(of: Clearance, gap: float, speed: float) -> tuple[Array, Array]:
        data, q, v = model.createData(), np.array([0.0, 0.1 + gap]), np.array([speed, 0.0])
        pin.forwardKinematics(model, data, q, v, np.zeros(2))
        pin.computeJointJacobians(model, data)
        return of.constraints(data)

    rows, least = constraints(Clearance(model, apart, period=1e-3), 0.01, 0.0)
    np.testing.assert_allclose(rows, [[-1.0, 1.0]], atol=1e-9)
    assert least[0] == pytest.approx(-(40.0**2) * (0.01 - 0.002))
    # far apart at rest there is none; faster than they can be stopped in there is one that asks them to brake
    near = Clearance(model, apart, period=1e-3)
    assert len(constraints(near, 0.2, 0.0)[1]) == 0
    constraints(near, 0.052, 2.0)
    _, least = constraints(near, 0.05, 2.0)
    assert least[0] == pytest.approx(2 * 40.0 * 2.0 - 40.0**2 * 0.048)
    # who is held to it comes to rest before the distance is used up
    near, gap, rate = Clearance(model, apart, period=1e-3), 0.1, -1.5
    for _ in range(200):
        _, least = constraints(near, gap, -rate)
        rate += 1e-3 * (float(least[0]) if len(least) else 0.0)
        gap += 1e-3 * rate
    assert 0.002 < gap < 0.02 and abs(rate) < 0.1


def test_a_link_that_turns_and_an_obstacle_brake_by_their_distances_second_rate() -> None:
    """A cube's corner above a floor of its own: the least rate, against differences of the distance."""
    model = pin.Model()
    places = pin.SE3.Identity(), pin.SE3(np.eye(3), np.array([0.3, 0.0, 0.1]))
    for k, (joint, place) in enumerate(zip((pin.JointModelRY(), pin.JointModelRX()), places, strict=True)):
        model.addJoint(k, joint, place, f"joint {k}")
    cube = 0.05 * np.array(list(itertools.product((-1, 1), repeat=3)), dtype=float)
    plate = Solid(
        name="plate", half=np.array([1.0, 1.0, 0.05]), place=np.array([0.0, 0.0, -0.3]), rotation=np.eye(3)
    )
    apart = Solids(solids=(Solid(name="cube", joint=2, vertices=cube), plate), pairs=((0, 1),))
    q, v, a, h = np.array([0.9, 0.4]), np.array([1.3, -0.8]), np.array([0.7, 2.0]), 1e-4

    def height(t: float) -> float:
        """Of the lowest corner above the plate, by kinematics."""
        data = model.createData()
        pin.forwardKinematics(model, data, q + t * v + t**2 / 2 * a)
        return float(min(data.oMi[2].act(corner)[2] for corner in cube) + 0.25)

    data = model.createData()
    pin.forwardKinematics(model, data, q, v, np.zeros(2))
    pin.computeJointJacobians(model, data)
    rows, least = Clearance(model, apart, period=1e-3).constraints(data)
    before, now, after = (height(t) for t in (-h, 0.0, h))
    rate, second = (after - before) / (2 * h), (after - 2 * now + before) / h**2
    # what the accelerations have beyond what is asked for, is what the second rate has
    beyond = second + 2 * 40.0 * rate + 40.0**2 * (now - 0.002)
    assert float(rows[0] @ a - least[0]) == pytest.approx(beyond, abs=1e-4)


def cubes_on_joints(robot: Robot) -> Solids:
    """A cube of 6 cm on each joint of a robot, and all pairs of those that no joint connects."""
    model, joints = robot.model, range(1, robot.model.njoints)
    cube = 0.03 * np.array(list(itertools.product((-1, 1), repeat=3)), dtype=float)
    pairs = [(a - 1, b - 1) for a, b in itertools.combinations(joints, 2) if model.parents[b] != a]
    return Solids(
        solids=tuple(Solid(name=str(j), joint=j, vertices=cube) for j in joints), pairs=tuple(pairs)
    )


def moved_data(robot: Robot, q: Array, v: Array) -> Any:
    """Pinocchio's data in a state, as `Clearance.constraints` needs them."""
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, q, v, np.zeros(robot.nv))
    pin.computeJointJacobians(robot.model, data)
    return data


def test_distances_known_from_before_leave_no_constraint_out() -> None:
    """All distances are computed for who begins, and those that matter for who has followed the motion."""
    robot = biped()
    solids, rng = cubes_on_joints(robot), np.random.default_rng(0)
    q, v, followed = np.asarray(still(robot)[0].q[0]), np.zeros(robot.nv), 0
    follows = Clearance(robot.model, solids, period=1e-3)
    for k in range(150):
        v = v + 0.05 * rng.standard_normal(robot.nv)
        q = pin.integrate(robot.model, q, 1e-3 * v)
        data = moved_data(robot, q, v)
        found = follows.constraints(data)
        if k % 10 == 9:
            expected = Clearance(robot.model, solids, period=1e-3).constraints(data)
            followed += len(expected[1])
            for a, b in zip(found, expected, strict=True):
                np.testing.assert_array_equal(a, b)
    assert followed > 0


def test_bodies_that_move_together_keep_their_distances(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = biped()
    solids, q = cubes_on_joints(robot), np.asarray(still(robot)[0].q[0])
    of, computed = Clearance(robot.model, solids, period=1e-3), list[int]()
    of.constraints(moved_data(robot, q, np.zeros(robot.nv)))
    distance = clearance.coal.distance

    def counted(*given: Any) -> float:
        computed[-1] += 1
        return float(distance(*given))

    monkeypatch.setattr(clearance.coal, "distance", counted)
    for speed in (0.0, 5.0):  # [m/s, rad/s] of the base
        computed.append(0)
        v = np.r_[np.full(6, speed), np.zeros(robot.nv - 6)]
        of.constraints(moved_data(robot, pin.integrate(robot.model, q, 1e-3 * v), v))
    assert computed[1] == computed[0] < len(solids.pairs) / 4
