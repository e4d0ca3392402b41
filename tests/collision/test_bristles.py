"""Friction with bristles: closed forms, energy, limits, another engine, compiled code and derivatives."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.small_plans import arm_problem
from support.small_robots import WALL_STIFFNESS, arm, biped, disc, on_a_wall

from impactopt import (
    SDC,
    ContactFriction,
    FreeMass,
    FullDynamics,
    KelvinVoigt,
    MujocoDynamics,
    RigidWall,
    SpringDamper,
    VirtualMass,
)
from impactopt.errors import InputError
from impactopt.files.problem_file import ProblemFile, load_problem, problem_data
from impactopt.kinematics.operational_space import holding_torque, striking_velocity
from impactopt.kinematics.stance import FixedBase, Free

BENDING = ContactFriction(coefficient=0.6, stiffness=0.8 * WALL_STIFFNESS)
NO_CREEP = 1e-7  # [m/s]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "options"),
    [(FullDynamics, {}), (MujocoDynamics, {}), (SDC, {"step": 1e-5}), (VirtualMass, {"step": 1e-5})],
)
@pytest.mark.parametrize("ratio", [0.2, 1.0])
def test_a_mass_that_sticks_swings_with_the_frequency_of_its_bristles(
    kind: Any, options: Any, ratio: float
) -> None:
    friction = ContactFriction(coefficient=10.0, slip_speed=NO_CREEP, stiffness=ratio * WALL_STIFFNESS)
    across = 1e-3  # [m/s], so that friction is far from its limit
    found = on_a_wall(kind, friction, **options).collide(np.zeros(2), np.array([1.0, across]), np.zeros(2))
    duration = np.pi * np.sqrt(4.0 / WALL_STIFFNESS)
    assert found.duration == pytest.approx(duration, abs=2e-5)
    swing = np.cos(np.sqrt(ratio * WALL_STIFFNESS / 2.0) * duration)
    assert found.velocity[1] / across == pytest.approx(swing, abs=2e-3)


@pytest.mark.slow
def test_a_ball_that_sticks_gives_its_spin_back() -> None:
    """Its rim turns around with all energy (Garwin, Am. J. Phys. 37, 1969); without bristles it stops."""
    mass, radius, stiffness, spin = 4.0, 0.1, 1e10, 0.1
    inertia = 0.4 * mass * radius**2
    at_rim = 1 / (1 / mass + radius**2 / inertia)  # effective mass, 2/7 of the ball's
    # half a swing across takes as long as one along the normal
    bristles = ContactFriction(coefficient=10.0, slip_speed=1e-6, stiffness=stiffness * at_rim / mass)
    for friction, swings in ((bristles, 2), (ContactFriction(coefficient=0.5, slip_speed=1e-3), 1)):
        model = FullDynamics(
            robot=disc(mass, radius),
            striker="rim",
            normal=[1.0, 0.0, 0.0],
            law=SpringDamper(stiffness=stiffness, damping=0.0),
            target=RigidWall(),
            stance=FixedBase(),
            contact_friction=friction,
        )
        found = model.collide(np.zeros(3), np.array([1.0, 0.0, spin]), np.zeros(3)).velocity
        push = swings * at_rim * radius * spin
        expected = np.array([-1.0, -push / mass, spin - radius * push / inertia])
        np.testing.assert_allclose(found, expected, atol=2e-3 * spin)


@cache
def stepped() -> Any:
    return on_a_wall(SDC, BENDING, 100.0, step=2e-5, accuracy=None)


@settings(max_examples=60, deadline=None)
@given(
    speed=st.floats(0.1, 2.0),
    across=st.floats(-4.0, 4.0),
    coefficient=st.floats(0.01, 3.0),
    ratio=st.floats(0.01, 3.0),
    slip_speed=st.floats(1e-4, 0.3),
    damping=st.floats(0.1, 300.0),
)
def test_energy_never_grows_and_the_push_is_in_the_cone(
    speed: float, across: float, coefficient: float, ratio: float, slip_speed: float, damping: float
) -> None:
    found = stepped().collide(
        np.zeros(2),
        np.array([speed, across]),
        np.zeros(2),
        contact_damping=damping,
        friction_coefficient=coefficient,
        friction_stiffness=ratio * WALL_STIFFNESS,
        friction_slip_speed=slip_speed,
    )
    along, side = found.velocity
    # the normal's motion knows nothing of the friction: each has its own energy
    assert abs(side) <= abs(across) * (1 + 1e-6) + 1e-6
    assert 2.0 * abs(across - side) <= coefficient * found.impulse * (1 + 1e-6)
    assert 4.0 * (speed - along) == pytest.approx(found.impulse, rel=1e-9)


def test_stiff_bristles_are_friction_without_them() -> None:
    """With an error of one over the stiffness."""
    rough, at = ContactFriction(coefficient=0.3), (np.zeros(2), np.array([1.0, 1.5]), np.zeros(2))
    options = {"step": 1e-6, "horizon": 0.049, "accuracy": None}
    limit = on_a_wall(SDC, rough, **options).collide(*at).velocity[1]
    bent = on_a_wall(SDC, dataclasses.replace(rough, stiffness=1e6), **options)
    off = [abs(bent.collide(*at, friction_stiffness=k).velocity[1] - limit) for k in (1e6, 1e7, 1e8)]
    assert off[2] < 3e-5
    assert off[1] == pytest.approx(off[0] / 10, rel=0.1) and off[2] == pytest.approx(off[1] / 10, rel=0.1)


def test_friction_pushes_against_the_slide_in_the_tangent_plane() -> None:
    robot, n = biped(), np.array([0.8, 0.0, 0.6])
    q = robot.posture("half_sitting")
    v = striking_velocity(robot, q, "fist", [0.96, 0.28, 0.0], 1.0)
    model, data = robot.model, robot.model.createData()
    model.gravity = pin.Motion.Zero()
    shared = {"robot": robot, "striker": "fist", "normal": n, "target": FreeMass(mass=3.0)}
    shared |= {"law": SpringDamper(stiffness=WALL_STIFFNESS, damping=20.0), "stance": Free()}
    found = FullDynamics(**shared, contact_friction=BENDING).collide(q, v, np.zeros(robot.n))
    begin = pin.computeCentroidalMomentum(model, data, q, v).linear.copy()
    end = pin.computeCentroidalMomentum(model, data, found.configuration, found.velocity).linear
    lost = begin - end
    across = lost - n * (n @ lost)
    assert n @ lost == pytest.approx(found.impulse, rel=1e-6)
    assert 0.05 * found.impulse < np.linalg.norm(across) < 0.6 * found.impulse
    rigid = FullDynamics(**shared, contact_friction=ContactFriction(coefficient=0.6))
    without = rigid.collide(q, v, np.zeros(robot.n)).velocity
    assert np.abs(found.velocity - without).max() > 0.03  # and bristles matter


@pytest.mark.slow
def test_mujoco_agrees() -> None:
    robot, n = arm(), np.array([0.0, 0.8, 0.6])
    q = robot.posture("start")
    v = striking_velocity(robot, q, "hand", [0.0, 1.0, 0.0], 1.0, stance=FixedBase())
    shared = {"robot": robot, "striker": "hand", "normal": n, "target": FreeMass(mass=3.0)}
    shared |= {"law": KelvinVoigt(stiffness=WALL_STIFFNESS, damping=20.0), "stance": FixedBase()}
    found = [
        kind(**shared, contact_friction=BENDING).collide(q, v, np.zeros(robot.n))
        for kind in (FullDynamics, MujocoDynamics)
    ]
    assert found[1].impulse == pytest.approx(found[0].impulse, rel=1e-4)
    np.testing.assert_allclose(found[1].velocity, found[0].velocity, atol=1e-3 * np.abs(v).max())


def oblique(kind: Any = SDC, **options: Any) -> tuple[Any, tuple[Any, Any, Any]]:
    """A biped's blow that slides 0.6 of its speed along a box, and its state at contact."""
    robot = biped()
    q = robot.posture("half_sitting")
    v = striking_velocity(robot, q, "fist", [1.0, 0.0, 0.0], 1.0)
    model = kind(
        robot=robot,
        striker="fist",
        normal=[0.8, 0.0, 0.6],
        law=SpringDamper(stiffness=WALL_STIFFNESS, damping=20.0),
        target=FreeMass(mass=3.0),
        contact_friction=BENDING,
        **options,
    )
    return model, (q, v, holding_torque(robot, q, v))


@pytest.mark.slow
def test_frozen_dynamics_come_to_full_dynamics() -> None:
    model, at = oblique(FullDynamics)
    full = model.collide(*at)
    off = []
    for freezes in (0, 2, 8):
        model, at = oblique(freezes=freezes, accuracy=None, step=2e-5)
        found = model.collide(*at)
        off.append(abs(found.impulse / full.impulse - 1))
    assert off[2] < off[1] < off[0] and off[2] < 3e-4
    np.testing.assert_allclose(found.velocity, full.velocity, atol=2e-3)


def test_steps_converge_with_order_two() -> None:
    """As steps across an event do: bristles reach the cone's edge within one."""
    at = np.zeros(2), np.array([1.0, 4.0]), np.zeros(2)
    exact, *found = (
        on_a_wall(SDC, BENDING, step=step, horizon=0.049, accuracy=None).collide(*at).velocity[1]
        for step in (1e-6, 8e-5, 4e-5, 2e-5)
    )
    off = np.abs(np.array(found) - exact)
    np.testing.assert_allclose(off[:-1] / off[1:], 4.0, rtol=0.15)
    assert off[2] < 3e-6


@pytest.mark.parametrize("kind", [SDC, VirtualMass])
def test_compiled_code_is_its_graph(kind: Any) -> None:
    model, at = oblique(kind)
    wanted = ("impulse", "velocity", "configuration", "sole_wrench", "zmp", "hand_speed")
    outputs = tuple(name for name in wanted if name in model.available)
    numbers = [*at, *model.settings.values()] if kind is SDC else [*at[:2], *model.settings.values()]
    graph = model.graph(outputs, every=50)
    compiled = model.function(outputs, parameters=tuple(model.settings), every=50)
    for one, two in zip(compiled.call(numbers), graph.call(numbers), strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-9, atol=1e-9)


def test_derivatives_are_those_of_differences() -> None:
    model, at = oblique()
    graph = model.graph(("impulse",))
    numbers = [ca.DM(x) for x in (*at, *model.settings.values())]
    names = graph.name_in()
    slopes = dict(zip(names, graph.jacobian().call([*numbers, graph.call(numbers)[0]]), strict=True))
    for name in ("v", "friction_stiffness", "friction_coefficient"):
        k = names.index(name)
        way = ca.DM(np.random.default_rng(3).normal(size=numbers[k].shape))
        h = 1e-5 * float(ca.norm_2(numbers[k]))
        ends = [
            graph.call([*numbers[:k], numbers[k] + sign * h * way, *numbers[k + 1 :]])[0] for sign in (1, -1)
        ]
        slope = float(ends[0] - ends[1]) / (2 * h)
        assert float(slopes[name] @ way) == pytest.approx(slope, rel=1e-6)


def test_a_file_has_bristles() -> None:
    rough = dataclasses.replace(load_problem("arm_planar"), friction=BENDING)
    again = ProblemFile.from_data(problem_data(rough), Path("again.toml")).build()
    assert again.friction == BENDING and again.hash == rough.hash
    assert rough.hash != dataclasses.replace(rough, friction=ContactFriction(coefficient=0.6)).hash


def test_bad_input_is_refused() -> None:
    with pytest.raises(InputError, match=r"ContactFriction: stiffness \[N/m\]: -1"):
        ContactFriction(coefficient=0.5, stiffness=-1.0)
    model, at = oblique()
    with pytest.raises(InputError, match=r"friction_stiffness: has 0; all must be > 0"):
        model.collide(*at, friction_stiffness=0.0)
    rigid = dataclasses.replace(model, contact_friction=ContactFriction(coefficient=0.6))
    with pytest.raises(InputError, match=r"the model 'sdc' of the collision has none"):
        dataclasses.replace(arm_problem(), friction=BENDING, collision="sdc")
    with pytest.raises(InputError, match=r"no setting 'friction_stiffness'"):
        rigid.collide(*at, friction_stiffness=1e4)
