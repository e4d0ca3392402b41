"""Friction of the striking point: closed form, the cone, another engine, derivatives, and a plan."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from support.derivative_checks import check_derivatives
from support.small_plans import BODILESS, arm_problem, biped_problem, transcribed
from support.small_robots import WALL_STIFFNESS, arm, biped, disc, on_a_wall

from impactopt import (
    SDC,
    BothSoles,
    ContactFriction,
    Effects,
    FixedBase,
    Free,
    FreeMass,
    FullDynamics,
    GearLoad,
    Incidence,
    InputError,
    JointFriction,
    MujocoDynamics,
    RigidWall,
    SpringDamper,
    VirtualMass,
    holding_torque,
    load_problem,
    striking_velocity,
)
from impactopt.files.problem_file import ProblemFile, problem_data
from impactopt.kinematics.operational_space import ConstrainedDynamics
from impactopt.simulation import scene_of, simulate_mujoco, simulate_pinocchio
from impactopt.solvers.ipm import solve_ipm
from impactopt.transcription.initial_guess import first_iterate

ROUGH = ContactFriction(coefficient=0.5, slip_speed=1e-3)
LAW = SpringDamper(stiffness=WALL_STIFFNESS, damping=20.0)
GENTLE = ContactFriction(coefficient=0.6)
BENDING = ContactFriction(coefficient=0.6, stiffness=0.8 * LAW.stiffness)


def sliding(across: float, friction: ContactFriction | None, kind: Any = FullDynamics, **options: Any) -> Any:
    """A mass of 4 kg along x and 2 kg along y that hits a wall across x with 1 m/s."""
    model = on_a_wall(kind, friction, LAW.damping, **options)
    return model.collide(np.zeros(2), np.array([1.0, across]), np.zeros(2))


@pytest.mark.slow
@pytest.mark.parametrize("kind", [FullDynamics, SDC, VirtualMass])
def test_a_mass_that_slides_all_along_loses_mu_times_the_impulse(kind: Any) -> None:
    for across in (4.0, -6.0):
        options = {} if kind is FullDynamics else {"method": "rk4", "step": 1e-5}
        found, without = (sliding(across, friction, kind, **options) for friction in (ROUGH, None))
        assert 4.0 * (1.0 - found.velocity[0]) == pytest.approx(found.impulse, rel=1e-9)
        lost = 2.0 * (across - found.velocity[1])
        assert lost == pytest.approx(np.sign(across) * 0.5 * found.impulse, rel=1e-6)
        assert without.velocity[1] == pytest.approx(across, rel=1e-12)
        assert found.impulse == pytest.approx(without.impulse, rel=1e-6)


@pytest.mark.slow
def test_a_mass_that_hardly_slides_sticks() -> None:
    # it has 0.4 N s across, and friction could take half of some 7 N s
    assert abs(sliding(0.2, ROUGH).velocity[1]) < 1e-6
    frozen = [sliding(0.2, GENTLE, kind, step=1e-5).velocity for kind in (SDC, VirtualMass)]
    for velocity in frozen:
        np.testing.assert_allclose(velocity, sliding(0.2, GENTLE).velocity, atol=1e-4)


OBLIQUE = np.array([0.8, 0.0, 0.6])


def oblique(kind: Any = SDC, **options: Any) -> tuple[Any, tuple[Any, Any, Any]]:
    """A biped's blow that slides 0.6 of its speed along a box, and its state at contact."""
    robot = biped()
    q = robot.posture("half_sitting")
    v = striking_velocity(robot, q, "fist", [1.0, 0.0, 0.0], 1.0)
    shared = {"robot": robot, "striker": "fist", "normal": OBLIQUE, "law": LAW, "target": FreeMass(mass=3.0)}
    return kind(**shared, **options), (q, v, holding_torque(robot, q, v))


@pytest.mark.slow
def test_frozen_dynamics_come_to_full_dynamics_with_friction_too() -> None:
    model, at = oblique(FullDynamics, contact_friction=GENTLE)
    full = model.collide(*at)
    off = []
    for freezes in (0, 2, 8):
        model, at = oblique(contact_friction=GENTLE, freezes=freezes, accuracy=None, step=2e-5)
        found = model.collide(*at)
        off.append(abs(found.impulse / full.impulse - 1))
    assert off[2] < off[1] < off[0] and off[2] < 3e-4
    np.testing.assert_allclose(found.velocity, full.velocity, atol=2e-3)
    # the last instant is separation's, which is not quite at the same time
    whole = np.linspace(0.0, 0.9 * full.duration, 20)
    for name in ("sole_wrench", "torque"):
        ours, theirs = (
            np.array([np.interp(whole, x.time, y) for y in getattr(x, name).reshape(len(x.time), -1).T])
            for x in (found, full)
        )
        np.testing.assert_allclose(ours, theirs, atol=0.02 * np.abs(theirs).max())
    model, at = oblique(accuracy=None)
    assert abs(model.collide(*at).impulse / full.impulse - 1) > 1e-2  # and friction matters


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        (SDC, {}),
        (SDC, {"effects": Effects(bias=False, jdot=False, feedforward=False)}),
        (SDC, {"effects": Effects(jdot=False), "stance": BothSoles(base_mass=1e5, base_inertia=1e5)}),
        (SDC, {"effects": Effects(friction=True), "friction": JointFriction(viscous=1.0, coulomb=0.5)}),
        (VirtualMass, {}),
    ],
)
def test_compiled_code_is_its_graph_with_friction_too(kind: Any, options: Any) -> None:
    wanted = ("impulse", "velocity", "configuration", "sole_wrench", "zmp", "hand_speed")
    model, at = oblique(kind, contact_friction=GENTLE, **options)
    outputs = tuple(name for name in wanted if name in model.available)
    numbers = [*(at if model.effects.feedforward else at[:2]), *model.settings.values()]
    graph = model.graph(outputs, every=50)
    compiled = model.function(outputs, parameters=tuple(model.settings), every=50)
    for one, two in zip(compiled.call(numbers), graph.call(numbers), strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_frozen_models_have_derivatives_with_friction() -> None:
    model, (q, v, torque) = oblique(contact_friction=GENTLE)
    value, _, by_v = model.gradient_function("impulse")(q, v, torque)
    named = ("friction_coefficient", "friction_slip_speed")
    function = model.function(parameters=named)
    numbers = [q, v, torque, *(model.settings[name] for name in named)]
    jacobian = dict(zip(function.jacobian().name_out(), function.jacobian()(*numbers, value), strict=True))
    np.testing.assert_allclose(jacobian["jac_impulse_v"], ca.DM(by_v).T, rtol=1e-5, atol=1e-8)
    for name in named:
        h = 1e-5 * float(model.settings[name])
        ends = [
            model.collide(q, v, torque, **{name: model.settings[name] + side * h}).impulse for side in (1, -1)
        ]
        slope = (ends[0] - ends[1]) / (2 * h)
        assert float(jacobian[f"jac_impulse_{name}"]) == pytest.approx(slope, rel=1e-4)


@pytest.mark.slow
def test_gradients_with_freezes_are_those_of_differences_too() -> None:
    model, (q, v, torque) = oblique(contact_friction=GENTLE, freezes=1, accuracy=None)
    value, by_q, by_v = (np.array(x) for x in model.gradient_function()(q, v, torque))
    jacobian = model.function(("impulse",)).jacobian()(q, v, torque, value)
    np.testing.assert_allclose(by_v.T, jacobian[1], rtol=1e-6, atol=1e-7)
    way = np.random.default_rng(1).normal(size=model.robot.nv)
    ends = [model.collide(pin.integrate(model.robot.model, q, h * way), v, torque) for h in (1e-6, -1e-6)]
    slope = (ends[0].impulse - ends[1].impulse) / 2e-6
    assert by_q[:, 0] @ way == pytest.approx(slope, rel=1e-4)


def test_steps_too_long_for_a_point_that_sticks_are_refused() -> None:
    """They are stable at a small force, not at that of the blow: friction swings from stage to stage."""
    sticky = ContactFriction(coefficient=0.6, slip_speed=1e-3)
    model, (q, _, torque) = oblique(contact_friction=sticky, accuracy=None, step=6e-5)
    v = striking_velocity(model.robot, q, "fist", OBLIQUE, 1.0)
    assert model.step_length < model.stable_step(q)
    with pytest.raises(InputError, match=r"step \[s\]: 6e-05 is too long to follow this contact"):
        model.collide(q, v, torque)
    assert np.isnan(model.batch([q], [v], torque)["impulse"]).all()
    shorter = dataclasses.replace(model, step=1e-5)
    assert shorter.batch([q], [v], torque)["step_error"][0] < 1e-4


def test_many_frozen_collisions_have_friction_of_their_own() -> None:
    model, (q, v, torque) = oblique(contact_friction=GENTLE, freezes=1)
    coefficients = np.array([0.1, 0.6, 1.2])
    many = model.batch(np.tile(q, (3, 1)), np.tile(v, (3, 1)), torque, friction_coefficient=coefficients)
    alone = [model.collide(q, v, torque, friction_coefficient=mu).impulse for mu in coefficients]
    np.testing.assert_allclose(many["impulse"], alone, rtol=1e-12)
    assert np.ptp(alone) > 1e-2 * np.mean(alone)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("across", "spin", "sticks"), [(0.0, 30.0, False), (3.0, -5.0, False), (0.2, 0.5, True)]
)
def test_a_ball_with_spin_leaves_a_wall_as_in_closed_form(across: float, spin: float, sticks: bool) -> None:
    """Routh's: it slides all along, or until it sticks; and the duration makes all the difference."""
    mass, radius, mu = 4.0, 0.1, 0.3
    inertia = 0.4 * mass * radius**2
    to_stick = (across + radius * spin) / (1 / mass + radius**2 / inertia)
    most = mu * 2 * mass
    assert (abs(to_stick) < most) == sticks
    push = np.clip(to_stick, -most, most)
    expected = np.array([-1.0, across - push / mass, spin - radius * push / inertia])
    off = []
    for stiffness in (1e10, 1e12):
        found = FullDynamics(
            robot=disc(mass, radius),
            striker="rim",
            normal=[1.0, 0.0, 0.0],
            law=SpringDamper(stiffness=stiffness, damping=0.0),
            target=RigidWall(),
            stance=FixedBase(),
            contact_friction=ContactFriction(coefficient=mu, slip_speed=1e-3),
        ).collide(np.zeros(3), np.array([1.0, across, spin]), np.zeros(3))
        off.append(np.abs(found.velocity - expected).max())
    assert off[0] < 0.1 and off[1] == pytest.approx(0.1 * off[0], rel=0.1)


def test_the_change_of_momentum_is_in_the_cone() -> None:
    robot = biped()
    q = robot.posture("half_sitting")
    n = np.array([0.8, 0.0, 0.6])
    v = striking_velocity(robot, q, "fist", [1.0, 0.0, 0.0], 1.0)
    model, data = robot.model, robot.model.createData()
    model.gravity = pin.Motion.Zero()
    shared = {"robot": robot, "striker": "fist", "normal": n, "law": LAW, "target": FreeMass(mass=3.0)}
    found = FullDynamics(**shared, stance=Free(), contact_friction=GENTLE).collide(q, v, np.zeros(robot.n))
    begin = pin.computeCentroidalMomentum(model, data, q, v).linear.copy()
    end = pin.computeCentroidalMomentum(model, data, found.configuration, found.velocity).linear
    lost = begin - end
    across = lost - n * (n @ lost)
    assert n @ lost == pytest.approx(found.impulse, rel=1e-6)
    assert 0.3 * found.impulse < np.linalg.norm(across) < 0.6 * found.impulse
    hand = ConstrainedDynamics.at(model, q, (), robot.striker("fist").model_frame).hand @ v
    assert across @ (hand - n * (n @ hand)) > 0  # against the slide


@pytest.mark.slow
def test_mujoco_agrees() -> None:
    robot = arm()
    q = robot.posture("start")
    n = np.array([0.0, 0.8, 0.6])
    v = striking_velocity(robot, q, "hand", [0.0, 1.0, 0.0], 1.0, stance=FixedBase())
    shared = {"robot": robot, "striker": "hand", "normal": n, "law": LAW, "target": FreeMass(mass=3.0)}
    shared |= {"stance": FixedBase(), "contact_friction": GENTLE}
    ours, theirs = (
        kind(**shared).collide(q, v, np.zeros(robot.n)) for kind in (FullDynamics, MujocoDynamics)
    )
    assert theirs.impulse == pytest.approx(ours.impulse, rel=1e-4)
    np.testing.assert_allclose(theirs.velocity, ours.velocity, atol=1e-3 * np.abs(v).max())
    none = FullDynamics(**{**shared, "contact_friction": None}).collide(q, v, np.zeros(robot.n))
    assert abs(none.impulse / ours.impulse - 1) > 1e-2  # and it matters


@pytest.mark.parametrize("friction", [GENTLE, BENDING])
def test_derivatives_are_those_of_differences(friction: ContactFriction) -> None:
    # gears are there from the start: with the first instant of a damped contact
    terms = (*BODILESS, GearLoad())
    t = transcribed(dataclasses.replace(biped_problem(), friction=friction, terms=terms))
    x = first_iterate(t)
    check_derivatives(t.program, x + 0.01 * np.random.default_rng(1).standard_normal(len(x)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("friction", "within", "apart"),
    [(GENTLE, 5e-3, 5e-3), (ContactFriction(coefficient=0.4, stiffness=8e3), 2e-3, 4e-3)],
)
def test_a_plan_with_friction_is_what_both_engines_replay(
    friction: ContactFriction, within: float, apart: float
) -> None:
    oblique = (*BODILESS, Incidence(speed=0.5))
    problem = dataclasses.replace(arm_problem(), friction=friction, terms=oblique)
    t = transcribed(problem)
    result = solve_ipm(t.program, first_iterate(t))
    assert result.status.usable, result.message
    plan = t.decode(result.x)
    way = plan.trajectory()
    until = float(way.contact_end) + 0.02
    for engine in (simulate_pinocchio, simulate_mujoco):
        done = engine(problem.robot, way, scene_of(problem), until=until)
        assert done.impulse == pytest.approx(plan.impulse, rel=within)
    smooth = scene_of(dataclasses.replace(problem, friction=None))
    done = simulate_pinocchio(problem.robot, way, smooth, until=until)
    assert abs(done.impulse / plan.impulse - 1) > apart


def test_bad_input_and_models_without_friction_are_refused() -> None:
    with pytest.raises(InputError, match=r"ContactFriction: coefficient: -1"):
        ContactFriction(coefficient=-1.0)
    with pytest.raises(InputError, match=r"the model 'sdc' of the collision has none"):
        dataclasses.replace(arm_problem(), friction=GENTLE, collision="sdc")
    with pytest.raises(InputError, match=r"method 'implicit': its steps have no contact_friction"):
        oblique(contact_friction=GENTLE, method="implicit")
    model, at = oblique(contact_friction=GENTLE)
    for coefficient in (-1.0, 11.0):
        with pytest.raises(InputError, match=rf"coefficient: {coefficient:g}; give a number > 0 and <= 10"):
            model.collide(*at, friction_coefficient=coefficient)
    with pytest.raises(InputError, match=r"unstable here, .* or the friction at the hit more slip_speed"):
        model.collide(*at, friction_slip_speed=1e-6)
    with pytest.raises(InputError, match=r"must be a ContactFriction, not 0\.6"):
        dataclasses.replace(arm_problem(), friction=0.6)
    for kind in (SDC, FullDynamics):
        with pytest.raises(InputError, match=r"contact_friction must be a ContactFriction, not 0\.6"):
            oblique(kind, contact_friction=0.6)


def test_a_file_has_it_and_other_problems_keep_their_hash() -> None:
    problem = load_problem("arm_planar")
    rough = dataclasses.replace(problem, friction=GENTLE)
    again = ProblemFile.from_data(problem_data(rough), Path("again.toml")).build()
    assert again.friction == GENTLE and again.hash == rough.hash != problem.hash
    data = {**problem_data(problem), "friction": {"coefficient": 0.4, "slip_speed_m_s": 0.02}}
    read = ProblemFile.from_data(data, Path("read.toml")).build()
    assert read.friction == ContactFriction(coefficient=0.4, slip_speed=0.02)
