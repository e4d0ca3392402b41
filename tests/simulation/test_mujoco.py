"""The replay on free soles: closed forms, balances, Pinocchio's second opinion, what each condition does."""

from __future__ import annotations

import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.fake_solution import still_problem, still_solution
from support.small_motions import (
    blow_motion,
    given_until,
    reference,
    scene,
    standing,
    standing_on_left,
    strike,
)
from support.small_robots import arm, biped, slider

from impactopt import FreeMass, InputError, Perturbation, Robot, Solution, load_robot
from impactopt.kinematics.stance import margin
from impactopt.simulation import Scene, Simulation, simulate, simulate_mujoco, simulate_pinocchio
from impactopt.simulation.collision_geometry import Solid, Solids
from impactopt.simulation.mujoco_engine import _Replay
from impactopt.simulation.mujoco_world import MujocoOptions, build_world

Array = NDArray[np.float64]


def weight(robot: Robot) -> float:
    return float(9.81 * sum(inertia.mass for inertia in robot.model.inertias))


def centre_of_mass(robot: Robot, q: Array) -> Array:
    return np.asarray(pin.centerOfMass(robot.model, robot.model.createData(), q))


# ---- two point masses


@pytest.mark.slow
@pytest.mark.parametrize("damping", [0.0, 100.0, 300.0])
@pytest.mark.parametrize("step", [4e-4, 1e-4])
def test_two_point_masses_collide_as_in_the_closed_form(damping: float, step: float) -> None:
    sim, exact = strike(damping, step=step, simulate=simulate_mujoco)
    assert sim.hand_speed[sim.phase() == 0][-1] == pytest.approx(exact["speed"], rel=1e-10)
    # a step that misses the instant of contact misses as much of the damper's force, which jumps there
    missed = damping * exact["speed"] * step / exact["impulse"]
    assert sim.impulse == pytest.approx(exact["impulse"], rel=missed + 1e-4)
    assert sim.contact_start == pytest.approx(exact["start"], abs=1.01 * step)
    assert sim.contact_end - sim.contact_start == pytest.approx(exact["duration"], abs=2.1 * step)
    assert 6.0 * sim.hand_speed[-1] + sim.impulse == pytest.approx(6.0 * exact["speed"], rel=1e-10)


@pytest.mark.slow
def test_the_impulse_of_two_point_masses_does_not_hang_on_the_step() -> None:
    """Within a step the contact is followed with errors of its own."""
    for step in (4e-4, 2e-4, 1e-4, 5e-5):
        sim, exact = strike(0.0, step=step, simulate=simulate_mujoco)
        assert sim.impulse == pytest.approx(exact["impulse"], rel=1e-6)


@pytest.mark.slow
def test_an_arm_hits_as_in_pinocchio() -> None:
    """Fixed base, servo, four joints: both engines tend to the same collision."""
    robot, name = arm(), "striker:hand"
    time = np.linspace(0, 0.4, 41)
    s = np.clip(time / 0.3, 0, 1)
    blend, way = 10 * s**3 - 15 * s**4 + 6 * s**5, np.array([0.3, 0.5, -0.4, 0.2])
    model, data = robot.model, robot.model.createData()
    q = np.array([pin.integrate(model, robot.posture("start"), b * way) for b in blend])
    v = np.gradient(blend, time)[:, None] * way
    torque = np.array([np.array(pin.computeGeneralizedGravity(model, data, x)) for x in q])
    pin.framesForwardKinematics(model, data, q[18])
    hand = model.getFrameId(name)
    point = np.array(data.oMf[hand].translation)
    speed = pin.computeFrameJacobian(model, data, q[18], hand, pin.LOCAL_WORLD_ALIGNED)[:3] @ v[18]
    there = scene(name, point=point, normal=speed / np.linalg.norm(speed), target=FreeMass(mass=2.0))
    motion = reference(time, q, v, torque, nv=4, n=4)
    exact = simulate_pinocchio(robot, motion, there, step=2.5e-5, settle=0.0)
    for step in (4e-4, 1e-4):
        sim = simulate_mujoco(robot, motion, there, step=step, settle=0.0, record=1)
        jump = 100.0 * float(np.linalg.norm(speed))
        assert abs(sim.impulse - exact.impulse) < jump * step
        assert sim.contact_start == pytest.approx(exact.contact_start, abs=1.1 * step)
        assert sim.contact_end == pytest.approx(exact.contact_end, abs=2.1 * step)
        k = int(np.argmin(np.abs(exact.time - sim.time[-1])))
        np.testing.assert_allclose(sim.q[-1], exact.q[k], atol=0.1 * step)
        assert sim.fall == "" and sim.standing


# ---- the same robot in both engines


def world_of(robot: Robot, **perturbation: Any) -> _Replay:
    posture = next(iter(robot.postures.values()))
    soles = tuple(sole.frame for sole in robot.soles)
    striker = next(iter(robot.strikers.values())).model_frame
    still = reference([0.0, 1.0], posture, nv=robot.nv, n=robot.n)
    there = scene(striker, soles=soles, corners=tuple(sole.polygon for sole in robot.soles))
    return _Replay(robot, still, there, Perturbation(**perturbation), MujocoOptions())


@pytest.fixture(scope="module")
def worlds() -> dict[str, _Replay]:
    return {"biped": world_of(biped()), "arm": world_of(arm()), "talos": world_of(load_robot("talos"))}


def drawn_state(robot: Robot, seed: int) -> tuple[Array, Array]:
    """Joints anywhere, continuous ones all round; any base pose, any velocity."""
    rng = np.random.default_rng(seed)
    model = robot.model
    q = pin.integrate(model, pin.neutral(model), rng.uniform(-3.0, 3.0, model.nv))
    return np.array(q), rng.normal(size=model.nv)


def base_change(robot: Robot, q: Array) -> Array:
    """(nv, nv): Pinocchio's velocity of MuJoCo's, whose free joint has its linear part in the world."""
    out = np.eye(robot.nv)
    if robot.floating:
        out[:3, :3] = pin.Quaternion(q[3:7]).toRotationMatrix().T
    return out


def set_velocity(replay: _Replay, q: Array, v: Array) -> None:
    qvel = np.linalg.solve(base_change(replay.robot, q), v)
    replay.data.qvel[: 6 if replay.floating else 0] = qvel[: 6 if replay.floating else 0]
    replay.data.qvel[replay.dof] = qvel[-replay.robot.n :]
    replay.mujoco.mj_forward(replay.world, replay.data)


@pytest.mark.parametrize("name", ["biped", "arm"])
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_a_state_goes_to_mujoco_and_back(name: str, worlds: dict[str, _Replay], seed: int) -> None:
    replay = worlds[name]
    robot, model = replay.robot, replay.robot.model
    q, v = drawn_state(robot, seed)
    replay.start(q)
    set_velocity(replay, q, v)
    back, rate = replay.state()
    np.testing.assert_allclose(pin.difference(model, q, back), 0, atol=1e-9)
    np.testing.assert_allclose(rate, v, atol=1e-9)
    data = model.createData()
    pin.forwardKinematics(model, data, q, v)
    pin.updateFramePlacements(model, data)
    hand = model.getFrameId(replay.scene.striker)
    np.testing.assert_allclose(replay.striking_points()[0], data.oMf[hand].translation, atol=1e-9)
    speed = pin.getFrameVelocity(model, data, hand, pin.LOCAL_WORLD_ALIGNED).linear
    assert replay.hand_speeds()[0] == pytest.approx(float(replay.scene.normal @ speed), abs=1e-9)
    corners = [
        data.oMf[model.getFrameId(sole)].act(np.array([*corner, 0.0]))
        for sole, its in zip(replay.scene.soles, replay.scene.corners, strict=True)
        for corner in its
    ]
    np.testing.assert_allclose(replay.corner_places(), np.reshape(corners, (-1, 3)), atol=1e-9)


def test_balls_about_links_touch_their_hulls_and_leave_nothing_out() -> None:
    """MuJoCo looks for contacts inside them only; its own enclose a long hull's box, and are larger."""
    robot, draw = biped(), np.random.default_rng(0)
    hulls = [draw.standard_normal((20, 3)) * [0.05, 0.05, scale] for scale in (0.05, 0.5)]
    solids = tuple(Solid(name=str(k), joint=k + 2, vertices=hull) for k, hull in enumerate(hulls))
    there = replace(scene("striker:fist"), solids=Solids(solids=solids, pairs=((0, 1),)))
    world = build_world(robot, there, Perturbation(), MujocoOptions(), [(0, 1)])
    for k, hull in enumerate(hulls):
        geom = world.geom(f"solid {k}")
        farthest = np.linalg.norm(hull - geom.pos, axis=1).max()
        assert geom.rbound[0] == pytest.approx(farthest, rel=1e-5)


@pytest.mark.parametrize("name", ["biped", "arm", "talos"])
def test_inertia_and_bias_are_pinocchios(name: str, worlds: dict[str, _Replay]) -> None:
    """Generalized inertia with armature; gravity, Coriolis and centrifugal forces."""
    replay = worlds[name]
    robot, model = replay.robot, replay.robot.model
    for seed in range(5):
        q, v = drawn_state(robot, seed)
        replay.start(q)
        set_velocity(replay, q, v)
        order = np.concatenate([np.arange(6 if replay.floating else 0), replay.dof])
        columns = np.zeros((robot.nv, replay.world.nv))
        for k, unit in enumerate(np.eye(replay.world.nv)[order]):
            replay.mujoco.mj_mulM(replay.world, replay.data, columns[k], unit)
        change = base_change(robot, q)
        upper = np.triu(pin.crba(model, model.createData(), q))
        inertia = upper + np.triu(upper, 1).T
        wanted = change.T @ inertia @ change
        np.testing.assert_allclose(columns[:, order], wanted, atol=1e-8 * np.abs(wanted).max())
        # MuJoCo's bias is for constant qvel: there, Pinocchio's base still turns under a constant linear part
        rest = np.zeros(robot.nv)
        if replay.floating:
            rest[:3] = -np.cross(v[3:6], v[:3])
        bias = change.T @ pin.rnea(model, model.createData(), q, v, rest)
        np.testing.assert_allclose(replay.data.qfrc_bias[order], bias, atol=1e-8 * np.abs(bias).max())


@pytest.mark.parametrize(
    "moments",
    [(0.1, 0.2, 0.3), (0.1, 0.2, 0.30009), (3e-20, 0.2, 0.2)],
    ids=["plate", "rounded plate", "rod"],
)
def test_a_link_without_thickness_has_its_inertia(moments: tuple[float, ...]) -> None:
    """Rounding breaks the triangle inequality, or decimals do, within the tolerance that robots have."""
    robot = arm()
    turn = pin.exp3(np.array([0.3, -0.5, 0.9]))
    own = turn @ np.diag(moments) @ turn.T
    robot.model.inertias[2] = pin.Inertia(2.0, np.array([0.0, 0.0, 0.2]), own)
    world = build_world(robot, scene("striker:hand"), Perturbation(), MujocoOptions())
    there = world.body(f"body {robot.model.names[2]}")
    rotation = pin.Quaternion(np.roll(there.iquat, -1)).toRotationMatrix()
    found = rotation @ np.diag(there.inertia) @ rotation.T
    np.testing.assert_allclose(found, own, atol=5e-4 * max(moments))


# ---- standing


@pytest.mark.parametrize("make", [biped, lambda: load_robot("talos")], ids=["biped", "talos"])
def test_a_robot_at_rest_bears_its_weight_where_statics_says(make: Any) -> None:
    robot = make()
    motion, there, wrench = standing(robot)
    sim = simulate_mujoco(robot, motion, there, settle=0.3)
    assert sim.standing and sim.fall == "" and np.isnan(sim.contact_start)
    load = weight(robot)
    np.testing.assert_allclose(sim.ground[-1, :3], [0, 0, load], atol=1e-4 * load)
    np.testing.assert_allclose(sim.zmp()[-1], centre_of_mass(robot, sim.q[-1])[:2], atol=1e-4)
    np.testing.assert_allclose(sim.sole_normal[-1], wrench[2::6], atol=5e-3 * load)
    assert max(sim.slip.max(), sim.lift.max()) < 1e-5
    # each sole's own margin: its centre of pressure, to edges that are where they were
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, sim.q[-1])
    for k, sole in enumerate(robot.soles):
        place = data.oMf[robot.model.getFrameId(sole.frame)]
        at = place.actInv(np.array([*sim.sole_cop()[-1, k], place.translation[2]]))[:2]
        assert sim.cop_margin[-1, k] == pytest.approx(margin(sole.polygon, at[None])[0], abs=1e-5)


def test_soles_bear_the_robot_from_the_first_instant_where_rounding_has_them_above_the_floor() -> None:
    robot = biped()
    motion, there, wrench = standing(robot)
    higher = motion.q[0] + np.where(np.arange(robot.model.nq) == 2, 1e-12, 0.0)
    motion = reference([0.0, 1.0], higher, torque=motion.torque[0], nv=robot.nv, n=robot.n, end=0.05)
    sim = simulate_mujoco(robot, motion, there, until=1e-3)
    assert (sim.sole_normal[0] > 0.2 * wrench[2::6]).all()


def test_a_robot_falls_when_its_centre_of_mass_is_not_over_its_soles() -> None:
    """A load in the hand moves the centre of mass: inside the soles it stands, outside it falls."""
    robot = biped()
    motion, there, _ = standing(robot)
    q = motion.q[0]
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    hand = np.array(data.oMf[robot.model.getFrameId(there.striker)].translation)
    mass, centre = weight(robot) / 9.81, centre_of_mass(robot, q)
    for load, inside in ((2.0, True), (60.0, False)):
        together = (mass * centre + load * hand) / (mass + load)
        assert (margin(there.polygon, together[None, :2])[0] > 0) == inside
        sim = simulate_mujoco(
            robot, motion, there, step=5e-4, settle=2.0, perturbation=Perturbation(payload=load)
        )
        assert sim.standing == inside
        if inside:
            assert sim.ground[-1, 2] == pytest.approx(weight(robot) + 9.81 * load, rel=1e-3)
        else:
            assert sim.fall is not None and sim.fall.startswith("fell: ")
            assert sim.fall.endswith(f"at t = {sim.time[-1]:.2f} s")
            assert sim.time[-1] < 2.0, "the simulation ends with the fall"


def test_a_robot_whose_base_has_its_origin_in_the_ground_stands_and_falls_as_another() -> None:
    """A root link's origin may be anywhere: the base is at no height where the feet are."""
    robot = biped()
    motion, there, _ = standing(robot)
    up = pin.SE3(np.eye(3), np.array([0.0, 0.0, motion.q[0, 2] + 0.07]))  # from the new origin to the old
    model = robot.model.copy()
    model.inertias[1] = model.inertias[1].se3Action(up)
    for joint in range(2, model.njoints):
        if model.parents[joint] == 1:
            model.jointPlacements[joint] = up * model.jointPlacements[joint]
    for frame in model.frames:
        if frame.parentJoint == 1:
            frame.placement = up * frame.placement
    low = np.where(np.arange(model.nq) == 2, motion.q - up.translation[2], motion.q)
    assert low[0, 2] < 0, "under the ground"
    robot = replace(robot, model=model)
    motion = reference([0.0, 1.0], low[0], torque=motion.torque[0], nv=robot.nv, n=robot.n, end=0.05)
    for load, stands in ((2.0, True), (60.0, False)):
        sim = simulate_mujoco(
            robot, motion, there, step=5e-4, settle=2.0, perturbation=Perturbation(payload=load)
        )
        assert sim.standing == stands, sim.fall


def test_a_summary_of_a_fall_and_a_report() -> None:
    robot = biped()
    motion, there, _ = standing(robot)
    sim = simulate_mujoco(robot, motion, there, step=1e-3, perturbation=Perturbation(payload=60.0))
    known = {"torque_limit": robot.torque_limit, "polygon": there.polygon, "planned_impulse": 1.0}
    summary, report = sim.summary(**known), sim.report(**known)
    assert summary["standing"] is False and summary["reason"] == sim.fall
    assert summary["impulse_Ns"] == summary["contact_ms"] == 0.0
    assert summary["impulse_error_pct"] is summary["hand_speed_m_s"] is None, "nothing was hit"
    assert report["zmp_margin_m"] == summary["zmp_margin_m"]["swing"]
    assert report["torque_ratio_by_phase"] == summary["torque_ratio"]
    for key, least in (("sole_cop_margin_mm", 1e3 * sim.cop_margin), ("sole_force_N", sim.sole_normal)):
        for k, name in enumerate(("left", "right")):
            assert report[key][name] == {"swing": least[:, k].min()}


def test_a_robot_that_is_to_end_on_one_foot_stands_on_it() -> None:
    robot, motion, there = standing_on_left()
    sim = simulate_mujoco(robot, motion, there, step=5e-4, settle=0.3)
    assert sim.standing, sim.fall
    np.testing.assert_allclose(sim.sole_normal[-1], [weight(robot), 0.0], atol=1e-3 * weight(robot))


@pytest.mark.slow
def test_what_slides_away_stands_no_more() -> None:
    """On ice, pushed: it is upright and at rest in the end, but not where it stood."""
    robot = biped()
    motion, there, _ = standing(robot)
    for part, slides in ((1.2, True), (0.2, False)):  # of what friction bears
        world = Perturbation(friction=0.05, push=part * 0.05 * weight(robot), push_time=0.6)
        sim = simulate_mujoco(robot, motion, there, step=1e-3, settle=4.0, perturbation=world)
        assert (sim.slip.max() > 0.05) == slides
        assert (sim.fall == "") != slides
        if slides:
            assert "slid" in str(sim.fall) and f"{1e3 * sim.slip[:, 0].max():.0f} mm" in str(sim.fall)


# ---- a blow on free soles


@pytest.fixture(scope="module")
def blow() -> tuple[Robot, Any, Scene]:
    return blow_motion()


@pytest.mark.slow
def test_momentum_is_balanced_by_ground_gravity_and_target(blow: tuple[Robot, Any, Scene]) -> None:
    """Linear, and angular about the world's origin, over the whole motion, to the order of the step."""
    robot, motion, there = blow
    model, data = robot.model, robot.model.createData()
    hand = model.getFrameId(there.striker)
    worst = []
    for step in (4e-4, 2e-4):
        sim = simulate_mujoco(robot, motion, there, step=step, settle=0.0, record=1)
        momentum, force = [], []
        means = np.diff(given_until(sim, step * np.arange(len(sim.time) + 1))) / step
        for q, v, ground, push in zip(sim.q, sim.v, sim.ground, means, strict=True):
            h = pin.computeCentroidalMomentum(model, data, q, v)
            centre = np.array(data.com[0])
            momentum.append(np.concatenate([h.linear, h.angular + np.cross(centre, h.linear)]))
            pin.framesForwardKinematics(model, data, q)
            place, reaction = np.array(data.oMf[hand].translation), -push * there.normal
            pull = np.array([0.0, 0.0, -weight(robot)])
            moment = np.cross(place, reaction) + np.cross(centre, pull)
            force.append(ground + np.concatenate([reaction + pull, moment]))
        change = np.array(momentum) - momentum[0]
        missing = step * np.cumsum(force, axis=0)[:-1] - change[1:]
        worst.append(np.abs(missing).max() / np.abs(change).max())
        assert sim.impulse > 0.5
    assert worst[1] < 0.6 * worst[0] < 2e-3


@pytest.mark.slow
def test_soles_that_stay_down_hit_as_held_ones_do(blow: tuple[Robot, Any, Scene]) -> None:
    robot, motion, there = blow
    held = simulate_pinocchio(robot, motion, there, settle=0.0)
    free = simulate_mujoco(robot, motion, there, settle=0.5)
    assert free.standing
    assert max(free.slip.max(), free.lift.max()) < 5e-4
    assert free.impulse == pytest.approx(held.impulse, rel=0.01)
    known = {"torque_limit": robot.torque_limit, "polygon": there.polygon, "planned_impulse": held.impulse}
    assert held.report(**known)["standing"] is None
    assert held.report(**known).keys() == free.report(**known).keys()


def test_soles_slide_with_as_much_force_as_friction_gives(blow: tuple[Robot, Any, Scene]) -> None:
    robot, motion, there = blow
    slips = []
    for friction in (0.9, 0.02):
        sim = simulate_mujoco(
            robot, motion, there, step=5e-4, settle=0.0, perturbation=Perturbation(friction=friction)
        )
        across = np.linalg.norm(sim.sole_ground[:, :, :2], axis=2)
        assert (across <= friction * sim.sole_normal * (1 + 1e-6) + 1e-6).all()
        slips.append(float(sim.slip.max()))
    assert slips[0] < 1e-4 < 1e-3 < slips[1]


# ---- the servo's clock


def test_the_servo_samples_and_holds_and_comes_late() -> None:
    """Feed-forward only, a ramp: what is set is the ramp at the last reading that has arrived."""
    robot = slider(6.0)
    ramp = reference([0.0, 0.02], np.zeros(1), torque=[[0.0], [20.0]], nv=1, n=1)
    step = 1e-3
    for period, delay in ((0.0, 0.0), (4e-3, 0.0), (0.0, 3e-3), (4e-3, 6e-3), (4e-3, 1e-3)):
        sim = simulate_mujoco(
            robot,
            ramp,
            scene(),
            step=step,
            settle=0.0,
            record=1,
            perturbation=Perturbation(period=period, delay=delay),
        )
        hold, lag = max(1, round(period / step)), round(delay / step)
        read = np.maximum((np.arange(20) - lag) // hold * hold, 0)  # steps
        np.testing.assert_allclose(sim.demand[:, 0], 1e3 * step * read, atol=1e-9)


# ---- perturbations


@pytest.mark.slow
def test_conditions_change_the_target() -> None:
    """Mass, stiffness and damping are factors: the closed form of the changed collision holds."""
    changed = Perturbation(mass=2.0, stiffness=1.0, damping=0.5)

    def run(*args: Any, **options: Any) -> Simulation:
        return simulate_mujoco(*args, **options, perturbation=changed)

    sim, _ = strike(200.0, simulate=run)
    _, exact = strike(100.0, mass=10.0, simulate=simulate_mujoco)
    assert sim.outcome == {"speed_m_s": pytest.approx(sim.impulse / 10.0, rel=1e-9)}
    assert sim.impulse == pytest.approx(exact["impulse"], rel=2e-3)
    stiff, _ = strike(
        0.0, simulate=lambda *a, **o: simulate_mujoco(*a, **o, perturbation=Perturbation(stiffness=4.0))
    )
    soft, exact = strike(0.0, simulate=simulate_mujoco)
    assert stiff.contact_end - stiff.contact_start == pytest.approx(exact["duration"] / 2, abs=2.1e-4)
    assert soft.impulse == pytest.approx(stiff.impulse, rel=1e-3)  # without loss the masses alone decide


@pytest.mark.slow
def test_a_target_that_waits_elsewhere_or_not_at_all() -> None:
    def start(**perturbation: Any) -> Simulation:
        world = Perturbation(**perturbation)
        return strike(0.0, simulate=lambda *a, **o: simulate_mujoco(*a, **o, perturbation=world))[0]

    for distance in (0.012, -0.012):
        late = start(distance=distance).contact_start - start().contact_start
        assert late == pytest.approx(distance / 1.2, abs=1.1e-4)
    missed = start(missing=True)
    assert missed.impulse == 0 and np.isnan(missed.contact_start)
    assert (missed.force == 0).all() and (missed.target_speed == 0).all()


def test_the_target_has_no_weight() -> None:
    robot = slider(6.0)
    still = reference([0.0, 0.1], np.zeros(1), nv=1, n=1)
    sim = simulate_mujoco(robot, still, scene(normal=np.array([0.0, 0.0, -1.0])), settle=0.0)
    assert np.abs(sim.target_speed).max() < 1e-12


def test_gains_limits_and_loads_are_factors_of_the_robots() -> None:
    robot = arm(torque_limit=np.array([60.0, 80.0, 10.0, 40.0]))
    q = robot.posture("start")
    ahead = pin.integrate(robot.model, q, np.array([0.0, 0.0, 0.1, 0.0]))
    rate = np.array([0.0, 0.2, 0.0, 0.0])
    motion = reference([0.0, 1e-4], [q, ahead], [rate, rate], np.zeros(4), nv=4, n=4, end=2e-3)

    def run(**perturbation: Any) -> Simulation:
        return simulate_mujoco(
            robot,
            motion,
            scene("striker:hand"),
            settle=0.0,
            record=1,
            perturbation=Perturbation(**perturbation),
        )

    plain, stiff, damped = run(), run(kp=2.0), run(kd=3.0)
    assert stiff.demand[1, 2] == pytest.approx(2.0 * plain.demand[1, 2], rel=1e-2)
    assert damped.demand[0, 1] == pytest.approx(3.0 * plain.demand[0, 1])
    weak = run(torque_limit=0.5)
    np.testing.assert_array_equal(
        weak.torque, np.clip(weak.demand, -0.5 * robot.torque_limit, 0.5 * robot.torque_limit)
    )
    assert np.abs(weak.torque[1:, 2]).max() == 5.0
    assert weak.saturated == pytest.approx(2e-4 * np.sum((np.abs(weak.demand) > [30, 40, 5, 20]).any(axis=1)))


def test_a_softer_floor_is_sunk_into_deeper() -> None:
    robot = biped()
    motion, there, _ = standing(robot)
    depth = []
    for floor_time in (4e-3, 8e-3):
        sim = simulate_mujoco(
            robot, motion, there, step=5e-4, settle=0.3, perturbation=Perturbation(floor_time=floor_time)
        )
        depth.append(motion.q[0, 2] - sim.q[-1, 2])
    assert depth[1] == pytest.approx(4 * depth[0], rel=0.1)  # as the square of the time constant


def test_every_condition_has_its_range_and_the_defaults_are_the_plan() -> None:
    there = scene()
    same = Perturbation().scene(there)
    for f in fields(Scene):
        assert np.array_equal(getattr(same, f.name), getattr(there, f.name)), f.name
    for f in fields(Perturbation):
        with pytest.raises(InputError, match=f"perturbation: {f.name}.*nan"):
            Perturbation(**{f.name: float("nan")})
        if f.name not in ("distance", "missing", "push_way"):
            with pytest.raises(InputError, match=f"perturbation: {f.name} is -1"):
                Perturbation(**{f.name: -1.0})


# ---- what cannot be replayed


def test_a_bolted_robot_cannot_be_pushed() -> None:
    """The push acted on nothing, without a word."""
    still = reference([0.0, 1.0], np.zeros(1), nv=1, n=1)
    with pytest.raises(InputError, match=r"push acts on the base, .* is bolted: leave it out"):
        simulate_mujoco(slider(6.0), still, scene(), perturbation=Perturbation(push=10.0))


def test_without_mujoco_there_is_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    still = reference([0.0, 1.0], np.zeros(1), nv=1, n=1)
    with pytest.raises(InputError, match=r"pip install -e '\.\[validate\]'"):
        simulate_mujoco(slider(6.0), still, scene())


def test_a_diverging_replay_says_so_and_leaves_no_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    robot = slider(1.0, kd=2.5e4, torque_limit=1e12)
    still = reference([0.0, 1.0], np.zeros(1), [[0.1], [0.1]], nv=1, n=1)
    with pytest.raises(InputError, match=r"diverged at t = 0\.\d+ s: take a smaller step than 0\.0002 s"):
        simulate_mujoco(robot, still, scene())
    with pytest.raises(InputError, match=r"step \[s\]: 0; give a number > 0"):
        simulate_mujoco(robot, still, scene(), step=0)
    assert list(tmp_path.iterdir()) == []


# ---- the demo's punch


@pytest.mark.slow
def test_the_demos_punch_stands_on_its_own_feet(punch: Solution) -> None:
    assert punch.status.usable
    sim = punch.validate(engine="mujoco")
    assert sim.standing, sim.fall
    assert sim.impulse == pytest.approx(punch.impulse, rel=0.03)
    assert sim.slip.max() < 5e-3
    assert sim.lift[sim.phase() == 1].max() < 2e-3
    assert sim.posture_error < 0.05


def test_engines_by_name_refuse_what_they_do_not_have() -> None:
    problem, motion = still_problem(), still_solution().trajectory
    with pytest.raises(InputError, match=r"unknown engine 'mujco' \(did you mean 'mujoco'"):
        simulate(problem, motion, engine="mujco")
    with pytest.raises(InputError, match="no perturbation; take engine 'mujoco'"):
        simulate(problem, motion, engine="pinocchio", perturbation=Perturbation(mass=2.0))
    with pytest.raises(InputError, match="has no option 'stp'"):
        simulate(problem, motion, engine="mujoco", stp=1e-4)


@pytest.mark.parametrize(
    ("engine", "options", "text"),
    [
        ("pinocchio", {"record": 0}, "record: 0; give a whole number from 1"),
        ("pinocchio", {"missing": "yes"}, "missing must be a bool, not 'yes'"),
        ("pinocchio", {"settle": None}, r"settle \[s\]"),
        ("mujoco", {"iterations": -3}, "iterations: -3; give a whole number from 1"),
        ("mujoco", {"tolerance": -1.0}, "tolerance: -1; give a number >= 0"),
        ("mujoco", {"perturbation": 3}, "perturbation must be a Perturbation, not 3"),
        ("pinocchio", {"missed": 3}, "missed must be a Trajectory, not 3"),
        ("mujoco", {"missed": True}, "missed must be a Trajectory, not True"),
    ],
)
def test_options_of_engines_are_checked(engine: str, options: dict[str, Any], text: str) -> None:
    with pytest.raises(InputError, match=text):
        simulate(still_problem(), still_solution().trajectory, engine=engine, **options)


@pytest.mark.parametrize("engine", ["pinocchio", "mujoco"])
def test_a_replay_ends_where_it_is_told_to(hammered: Solution, engine: str) -> None:
    end = 0.5 * hammered.trajectory.contact_start
    sim = hammered.validate(engine=engine, until=end, step=1e-3)
    assert end - 0.01 < sim.time[-1] < end + 1e-9 and sim.impulse == 0
    for bad in (0.0, -1.0, np.nan):
        with pytest.raises(InputError, match=r"until \[s\]"):
            hammered.validate(engine=engine, until=bad)


@pytest.mark.slow
def test_a_replay_far_from_the_plan_does_not_pass_for_one_that_stands(punch: Solution) -> None:
    sim = punch.validate(engine="mujoco", step=1e-3, perturbation=Perturbation(torque_limit=0.3))
    assert sim.standing is False
    assert sim.saturated > 0.1


# ---- the striking link in place of its point


CUBE = np.array([[x, y, z] for x in (-0.02, 0.02) for y in (-0.02, 0.02) for z in (-0.02, 0.02)])


def hulls(ahead: float, at: Array) -> Solids:
    """A cube on the slider, whose front is so far ahead [m] of its striking point, and a cube that is hit."""
    hand = Solid(name="hand", joint=1, vertices=CUBE + np.array([ahead - 0.02, 0.0, 0.0]))
    place = at + np.array([0.05, 0.0, 0.0])
    box = Solid(
        name="box", half=np.full(3, 0.05), place=place, rotation=np.eye(3), of_target=True, moves=True
    )
    return Solids(solids=(hand, replace(box, strikable=True)))


@pytest.mark.slow
@pytest.mark.parametrize("ahead", [0.0, 0.006])
def test_a_link_hits_when_its_hull_meets_the_targets_body(ahead: float) -> None:
    """As early as its front is ahead, and as hard as the point that it stands for."""

    def with_hulls(robot: Robot, way: Any, there: Scene, **options: Any) -> Simulation:
        there = replace(there, solids=hulls(ahead, there.point))
        return simulate_mujoco(robot, way, there, contact="link", **options)

    sim, exact = strike(100.0, simulate=with_hulls)
    assert sim.impulse == pytest.approx(exact["impulse"], rel=1e-3)
    assert sim.contact_start == pytest.approx(exact["start"] - ahead / exact["speed"], abs=2e-4)
    assert sim.contact_end - sim.contact_start == pytest.approx(exact["duration"], abs=4e-4)


def test_a_link_or_a_target_without_a_body_is_refused() -> None:
    def bare(robot: Robot, way: Any, there: Scene, **options: Any) -> Simulation:
        return simulate_mujoco(robot, way, there, contact="link", **options)

    with pytest.raises(InputError, match=r"'link' needs bodies, and the target has none: .*keep_out"):
        strike(100.0, simulate=bare)
    with pytest.raises(InputError, match=r"contact 'lnk' .did you mean 'link'"):
        strike(100.0, simulate=lambda *given, **o: simulate_mujoco(*given, contact="lnk", **o))
