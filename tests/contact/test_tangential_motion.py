"""Targets that friction moves across the normal: closed forms, momentum, engines, derivatives, and plans."""

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
from support.small_robots import WALL_STIFFNESS, arm, biped, table

from impactopt import (
    SDC,
    Board,
    BothSoles,
    ContactFriction,
    Effects,
    FixedBase,
    Free,
    FreeMass,
    FullDynamics,
    GearLoad,
    Impulse,
    Incidence,
    InputError,
    KelvinVoigt,
    MujocoDynamics,
    Nail,
    RigidWall,
    Scenario,
    SpringDamper,
    TargetEnergy,
    VirtualMass,
    holding_torque,
    load_problem,
    solve,
    striking_velocity,
)
from impactopt.files.problem_file import ProblemFile, problem_data
from impactopt.planning.lazy_constraints import slide
from impactopt.simulation import scene_of, simulate_mujoco, simulate_pinocchio
from impactopt.solvers.ipm import solve_ipm
from impactopt.transcription.initial_guess import first_iterate

LAW = SpringDamper(stiffness=WALL_STIFFNESS, damping=20.0)
MOVES = ContactFriction(coefficient=0.6, moves_target=True)
BENDING = dataclasses.replace(MOVES, stiffness=0.8 * LAW.stiffness)
FRICTIONS = pytest.mark.parametrize("friction", [MOVES, BENDING], ids=["regularized", "bristles"])
MASS = 3.0


def on_a_box(across: float, friction: ContactFriction, kind: Any = FullDynamics) -> Any:
    """A mass of 4 kg along x and 2 kg along y that hits a box of 3 kg at 1 m/s along x."""
    options = {} if kind in (FullDynamics, MujocoDynamics) else {"step": 1e-5}
    model = kind(
        robot=table(4.0),
        striker="tip",
        normal=[1.0, 0.0, 0.0],
        law=LAW,
        target=FreeMass(mass=MASS),
        stance=FixedBase(),
        contact_friction=friction,
        **options,
    )
    return model.collide(np.zeros(2), np.array([1.0, across]), np.zeros(2))


KINDS = pytest.mark.parametrize("kind", [FullDynamics, MujocoDynamics, SDC, VirtualMass])


@KINDS
def test_a_box_that_slides_all_along_gets_mu_times_the_impulse(kind: Any) -> None:
    """Against the axis; along it, boxes stick in the next test."""
    across, rough = -6.0, dataclasses.replace(MOVES, slip_speed=1e-3)
    found = on_a_box(across, rough, kind)
    push = -0.6 * found.impulse
    rel = 1e-4 if kind is MujocoDynamics else 1e-6
    assert found.tangential_velocity == pytest.approx([0.0, push / MASS, 0.0], rel=rel)
    assert found.velocity[1] == pytest.approx(across - push / 2.0, rel=rel)
    along = 0.5 * MASS * found.target_result["speed"] ** 2
    assert found.energy == pytest.approx(along + push**2 / (2 * MASS), rel=1e-3)


@KINDS
def test_two_masses_that_stick_have_one_tangential_velocity(kind: Any) -> None:
    """Theirs is that of a plastic impact; the target's mass counts as any other."""
    found = on_a_box(0.5, dataclasses.replace(MOVES, slip_speed=1e-2), kind)
    common = 2.0 * 0.5 / (2.0 + MASS)
    assert found.velocity[1] == pytest.approx(common, rel=1e-5)
    np.testing.assert_allclose(found.tangential_velocity, [0.0, common, 0.0], rtol=1e-5, atol=1e-12)


def test_the_masses_swing_on_the_bristles_as_their_reduced_mass_does() -> None:
    """Stuck all along: bristles are a spring between two masses, so that z is a sine for a constant force."""
    stiffness, across = 8e4, 0.02
    friction = ContactFriction(coefficient=10.0, slip_speed=1e-6, stiffness=stiffness, moves_target=True)
    found = on_a_box(across, friction)
    reduced = 1 / (1 / 2.0 + 1 / MASS)
    rate = np.sqrt(stiffness / reduced)
    slipping = across * np.cos(rate * found.duration)  # of the relative velocity, from across at z = 0
    assert found.velocity[1] - found.tangential_velocity[1] == pytest.approx(slipping, abs=0.03 * across)


OBLIQUE = np.array([0.8, 0.0, 0.6])


def oblique(kind: Any = SDC, **options: Any) -> tuple[Any, tuple[Any, Any, Any]]:
    """A biped's blow that slides 0.6 of its speed along a box, and its state at contact."""
    robot = biped()
    q = robot.posture("half_sitting")
    v = striking_velocity(robot, q, "fist", [1.0, 0.0, 0.0], 1.0)
    shared = {"robot": robot, "striker": "fist", "normal": OBLIQUE, "law": LAW, "target": FreeMass(mass=MASS)}
    return kind(**{"contact_friction": MOVES, **shared, **options}), (q, v, holding_torque(robot, q, v))


@FRICTIONS
@pytest.mark.parametrize("kind", [FullDynamics, SDC])
def test_momentum_of_robot_and_target_is_kept_in_three_directions(
    kind: Any, friction: ContactFriction
) -> None:
    options = {"freezes": 8, "accuracy": None, "step": 2e-5} if kind is SDC else {}
    model, (q, v, _) = oblique(kind, contact_friction=friction, stance=Free(), **options)
    model.robot.model.gravity = pin.Motion.Zero()
    found = model.collide(q, v, np.zeros(model.robot.n))
    pin_model, data = model.robot.model, model.robot.model.createData()
    begin = pin.computeCentroidalMomentum(pin_model, data, q, v).linear.copy()
    end = pin.computeCentroidalMomentum(pin_model, data, found.configuration, found.velocity).linear
    target = MASS * (OBLIQUE * found.target_result["speed"] + found.tangential_velocity)
    assert abs(OBLIQUE @ found.tangential_velocity) < 1e-12 < np.abs(found.tangential_velocity).max()
    np.testing.assert_allclose(
        begin - end, target, atol=(1e-6 if kind is FullDynamics else 2e-3) * found.impulse
    )


@pytest.mark.slow
@FRICTIONS
def test_frozen_dynamics_come_to_full_dynamics(friction: ContactFriction) -> None:
    model, at = oblique(FullDynamics, contact_friction=friction)
    full, off = model.collide(*at), []
    for freezes in (0, 2, 8):
        model, at = oblique(contact_friction=friction, freezes=freezes, accuracy=None, step=2e-5)
        found = model.collide(*at)
        off.append(abs(found.impulse / full.impulse - 1))
    assert off[2] < off[1] < off[0] and off[2] < 3e-4
    np.testing.assert_allclose(found.velocity, full.velocity, atol=2e-3)
    np.testing.assert_allclose(found.tangential_velocity, full.tangential_velocity, atol=1e-3)
    held, at = oblique(FullDynamics, contact_friction=dataclasses.replace(friction, moves_target=False))
    assert abs(held.collide(*at).impulse / full.impulse - 1) > 1e-3  # and it matters


@pytest.mark.slow
@FRICTIONS
def test_mujoco_agrees(friction: ContactFriction) -> None:
    robot = arm()
    q = robot.posture("start")
    v = striking_velocity(robot, q, "hand", [0.0, 1.0, 0.0], 1.0, stance=FixedBase())
    shared = {"robot": robot, "striker": "hand", "normal": [0.0, 0.8, 0.6], "law": LAW}
    shared |= {"target": FreeMass(mass=MASS), "stance": FixedBase(), "contact_friction": friction}
    ours, theirs = (
        kind(**shared).collide(q, v, np.zeros(robot.n)) for kind in (FullDynamics, MujocoDynamics)
    )
    assert theirs.impulse == pytest.approx(ours.impulse, rel=1e-4)
    np.testing.assert_allclose(theirs.velocity, ours.velocity, atol=1e-3 * np.abs(v).max())
    np.testing.assert_allclose(theirs.tangential_velocity, ours.tangential_velocity, atol=1e-3)


@FRICTIONS
@pytest.mark.parametrize(
    ("kind", "options"),
    [
        (SDC, {}),
        (SDC, {"effects": Effects(jdot=False), "stance": BothSoles(base_mass=1e5, base_inertia=1e5)}),
        (VirtualMass, {}),
    ],
)
def test_compiled_code_is_its_graph(kind: Any, options: Any, friction: ContactFriction) -> None:
    wanted = ("impulse", "energy", "tangential_velocity", "velocity", "configuration", "zmp", "hand_speed")
    model, at = oblique(kind, contact_friction=friction, **options)
    outputs = tuple(name for name in wanted if name in model.available)
    assert "tangential_velocity" in outputs
    numbers = [*(at if model.effects.feedforward else at[:2]), *model.settings.values()]
    graph = model.graph(outputs, every=50)
    compiled = model.function(outputs, parameters=tuple(model.settings), every=50)
    for one, two in zip(compiled.call(numbers), graph.call(numbers), strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-9, atol=1e-9)


@pytest.mark.filterwarnings("ignore::impactopt.errors.NoCompilerWarning")
@FRICTIONS
def test_freezes_in_numpy_are_those_in_c(friction: ContactFriction, monkeypatch: pytest.MonkeyPatch) -> None:
    model, at = oblique(contact_friction=friction, freezes=2, accuracy=None)
    compiled = model.collide(*at)
    monkeypatch.setenv("IMPACTOPT_NO_COMPILER", "1")
    model, at = oblique(contact_friction=friction, freezes=2, accuracy=None)
    found = model.collide(*at)
    for name in ("impulse", "energy", "velocity", "tangential_velocity", "force"):
        one, two = getattr(found, name), getattr(compiled, name)
        np.testing.assert_allclose(one, two, rtol=1e-9, atol=1e-9 * np.abs(two).max())


@FRICTIONS
def test_graphs_have_the_derivatives_of_differences(friction: ContactFriction) -> None:
    model, at = oblique(contact_friction=friction)
    graph = model.graph(("tangential_velocity",))
    numbers = [ca.DM(x) for x in (*at, *model.settings.values())]
    names, rng = graph.name_in(), np.random.default_rng(3)
    slopes = dict(zip(names, graph.jacobian().call([*numbers, graph.call(numbers)[0]]), strict=True))
    for name in ("v", "target_mass", "friction_coefficient"):
        k = names.index(name)
        way = ca.DM(rng.normal(size=numbers[k].shape))
        h = 1e-5 * float(ca.norm_2(numbers[k]))
        ends = [
            graph.call([*numbers[:k], numbers[k] + sign * h * way, *numbers[k + 1 :]])[0] for sign in (1, -1)
        ]
        slope = np.array((ends[0] - ends[1]) / (2 * h))
        np.testing.assert_allclose(slopes[name] @ way, slope, rtol=0, atol=1e-6 * np.abs(slope).max())


@pytest.mark.parametrize("freezes", [0, 1])
def test_compiled_functions_have_derivatives_by_the_targets_mass(freezes: int) -> None:
    model, at = oblique(accuracy=None, freezes=freezes)
    function = model.function(("tangential_velocity",), parameters=("target_mass",))
    value = function(*at, MASS)
    jacobian = dict(zip(function.jacobian().name_out(), function.jacobian()(*at, MASS, value), strict=True))
    ends = [model.collide(*at, target_mass=MASS + h).tangential_velocity for h in (1e-4, -1e-4)]
    slope = (ends[0] - ends[1]) / 2e-4
    np.testing.assert_allclose(
        jacobian["jac_tangential_velocity_target_mass"][:, 0], slope[:, None], rtol=1e-5
    )


def test_many_collisions_are_each_alone() -> None:
    model, (q, v, torque) = oblique(freezes=1)
    masses = np.array([1.0, 3.0, 30.0])
    outputs = ("impulse", "tangential_velocity")
    many = model.batch(np.tile(q, (3, 1)), np.tile(v, (3, 1)), torque, outputs=outputs, target_mass=masses)
    for k, mass in enumerate(masses):
        alone = model.collide(q, v, torque, target_mass=mass)
        np.testing.assert_allclose(many["tangential_velocity"][k], alone.tangential_velocity, rtol=1e-12)


def test_a_target_of_a_large_mass_is_one_that_is_held() -> None:
    target = FreeMass(mass=1e9)
    still, held = (
        model.collide(*at, require_separation=False)
        for model, at in (
            oblique(target=target, contact_friction=friction)
            for friction in (MOVES, dataclasses.replace(MOVES, moves_target=False))
        )
    )
    np.testing.assert_allclose(still.velocity, held.velocity, rtol=1e-7, atol=1e-9)
    assert held.tangential_velocity is None


@FRICTIONS
def test_programs_have_the_derivatives_of_differences(friction: ContactFriction) -> None:
    t = transcribed(dataclasses.replace(biped_problem(), friction=friction, terms=(*BODILESS, GearLoad())))
    x = first_iterate(t)
    check_derivatives(t.program, x + 0.01 * np.random.default_rng(1).standard_normal(len(x)))


@pytest.mark.slow
@pytest.mark.parametrize(
    "friction", [MOVES, ContactFriction(coefficient=0.4, stiffness=8e3, moves_target=True)]
)
def test_a_plan_is_what_both_engines_replay(friction: ContactFriction) -> None:
    lighter = Scenario(name="lighter", mass=0.5)
    problem = dataclasses.replace(
        arm_problem(), friction=friction, terms=(*BODILESS, Incidence(speed=0.5)), scenarios=(lighter,)
    )
    # elements and steps that resolve the friction, which is stiffer than the law
    problem = dataclasses.replace(problem, collision_elements=((0.1, 0.1, 0.4, 0.4), (0.5, 0.5)))
    t = transcribed(problem)
    result = solve_ipm(t.program, first_iterate(t))
    assert result.status.usable, result.message
    plan = t.decode(result.x)
    way, outcome = plan.trajectory(), plan.collision.outcome
    until = float(way.contact_end) + 0.02
    for engine in (simulate_pinocchio, simulate_mujoco):
        done = engine(problem.robot, way, scene_of(problem), until=until, step=1e-4)
        assert done.impulse == pytest.approx(plan.impulse, rel=2e-3)
        assert done.outcome["tangential_speed_m_s"] == pytest.approx(
            outcome["tangential_speed_m_s"], rel=5e-3
        )
        aside = plan.aside(done.time[-1:])[0]
        assert np.linalg.norm(aside) > 1e-3
        np.testing.assert_allclose(done.target_aside[-1], aside, atol=0.02 * np.linalg.norm(aside))
    light = dataclasses.replace(problem, target=FreeMass(mass=0.5 * problem.target.parameters["mass"]))
    done, planned = (
        simulate_pinocchio(problem.robot, way, scene_of(light), until=until, step=1e-4),
        plan.scenarios[0],
    )
    assert done.impulse == pytest.approx(planned.impulse, rel=2e-3)
    assert done.outcome == pytest.approx(planned.collision.outcome, rel=5e-3)
    fixed = dataclasses.replace(plan.collision, tangential_velocity=None)
    assert slide(problem, plan) < slide(problem, dataclasses.replace(plan, collision=fixed))
    held = dataclasses.replace(problem, friction=dataclasses.replace(friction, moves_target=False))
    done = simulate_pinocchio(problem.robot, way, scene_of(held), until=until)
    assert "tangential_speed_m_s" not in done.outcome and not done.target_aside.size


@pytest.mark.slow
def test_plans_follow_the_targets_mass() -> None:
    """Which is in the equations of motion, by its velocity across the normal."""
    problem = dataclasses.replace(arm_problem(), friction=MOVES, terms=(*BODILESS, Incidence(speed=0.5)))
    mass = problem.target.parameters["mass"]

    def solved(mass: float) -> Any:
        return solve(dataclasses.replace(problem, target=FreeMass(mass=mass)))

    plan, heavy = solved(mass), solved(1.3 * mass)
    moved = plan.moved(mass=1.3 * mass)
    assert moved.plan.impulse == pytest.approx(heavy.plan.impulse, rel=1e-4)
    assert moved.collision.outcome == pytest.approx(heavy.collision.outcome, rel=1e-3)
    slope = (solved(1.01 * mass).plan.impulse - solved(0.99 * mass).plan.impulse) / (0.02 * mass)
    assert plan.sensitivity("target.mass").impulse == pytest.approx(slope, rel=1e-4)


@pytest.mark.parametrize(
    "target",
    [
        RigidWall(),
        Nail(mass=0.2, resistance=500.0),
        Board(mass=0.5, stiffness=1e4, breaking_force=500.0),
    ],
)
def test_targets_that_are_held_across_are_refused_by_name(target: Any) -> None:
    named = rf"moves_target is for a FreeMass; a {type(target).__name__} is held across the normal"
    law = KelvinVoigt(stiffness=1e5, damping=50.0)
    for kind in (SDC, FullDynamics, MujocoDynamics, VirtualMass):
        with pytest.raises(InputError, match=f"contact_friction: {named}"):
            oblique(kind, target=target, law=law)
    with pytest.raises(InputError, match=f"friction: {named}"):
        dataclasses.replace(arm_problem(), friction=MOVES, target=target, law=law)


def test_other_bad_input_is_refused() -> None:
    with pytest.raises(InputError, match=r"ContactFriction: moves_target is 1; give True or False"):
        ContactFriction(coefficient=0.5, moves_target=1)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"TargetEnergy is of motion along the normal"):
        dataclasses.replace(arm_problem(), friction=MOVES, objectives=(TargetEnergy(),))
    model, _ = oblique(contact_friction=dataclasses.replace(MOVES, moves_target=False))
    with pytest.raises(InputError, match=r"output 'tangential_velocity': no friction moves the target"):
        model.function(("tangential_velocity",))


def test_a_file_has_it_and_a_target_that_is_held_keeps_its_hash() -> None:
    problem = load_problem("punch")
    moves, held = (
        dataclasses.replace(problem, friction=ContactFriction(coefficient=0.6, moves_target=moves))
        for moves in (True, False)
    )
    data = problem_data(moves)
    assert data["friction"] == {"coefficient": 0.6, "moves_target": True}
    assert "moves_target" not in problem_data(held)["friction"]
    again = ProblemFile.from_data(data, Path("again.toml")).build()
    assert again.friction == moves.friction and again.hash == moves.hash != held.hash


@pytest.mark.slow
def test_a_plans_mesh_has_the_momentum_that_friction_gives_the_target() -> None:
    """Bristles swing within the contact: on the mesh that the impulse needs the speed was off by 6 %."""
    normal = np.array([0.15, 0.0, -np.sqrt(1 - 0.15**2)])
    rough = ContactFriction(coefficient=0.8, slip_speed=0.02, stiffness=2e4, moves_target=True)
    solution = solve(
        dataclasses.replace(
            load_problem("arm_planar"),
            normal=normal,
            target=FreeMass(mass=2.0),
            law=SpringDamper(stiffness=2e4, damping=100.0),
            friction=rough,
            terms=(),
            objectives=(Impulse(),),
        )
    )
    replayed = solution.validate(step=2e-5).outcome["tangential_speed_m_s"]
    assert solution.collision.outcome["tangential_speed_m_s"] == pytest.approx(replayed, rel=0.02)
