"""Implicit steps: their polynomials, and collisions against the exact solution and closed forms."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
import pytest
from support import small_robots
from support.exact import ExactCollision
from support.exact_reference import random_case, robot_named
from support.frozen_cases import two_masses

from impactopt import (
    SDC,
    Board,
    CustomLaw,
    Effects,
    FreeMass,
    HuntCrossley,
    InputError,
    JointFriction,
    KelvinVoigt,
    Nail,
    RigidWall,
    SpringDamper,
    VirtualMass,
)
from impactopt.codegen.compiler import find_compiler
from impactopt.collision.graph import collision_graph
from impactopt.collision.implicit import STAGES, gamma, polynomials
from impactopt.collision.stepped import law_is_linear, target_is_linear

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")

X = np.array([1.0, 0.0, 0.0])
LAW, TARGET = SpringDamper(stiffness=1e4, damping=300.0), FreeMass(mass=2.0)
NAIL = Nail(mass=0.2, resistance=120.0, hardening=1e4, depth=0.01)
BOARD = Board(mass=0.5, stiffness=3e4, breaking_force=150.0, damping=20.0)
FRICTION = JointFriction(viscous=1.0, coulomb=2.0, transition=0.1)
MODELS: dict[str, dict[str, Any]] = {
    "mass": {"law": LAW, "target": TARGET},
    "nail": {"law": LAW, "target": NAIL, "effects": Effects(jdot=False)},
    "board": {"law": KelvinVoigt(stiffness=2e4, damping=100.0), "target": BOARD},
    "wall": {"law": LAW, "target": RigidWall(), "effects": Effects(friction=True), "friction": FRICTION},
}


# ------------------------------------------------------------ polynomials
def approximation(z: Any, theta: float) -> Any:
    """Of exp(theta z)."""
    P, x = polynomials(), z / (1.0 - gamma() * z)
    p = P @ theta ** np.arange(STAGES + 1)
    return sum(p[j] * x**j for j in range(STAGES + 1))


@pytest.mark.parametrize("theta", [0.25, 0.6, 1.0])
def test_at_least_order_eight_at_every_place_of_the_step(theta: float) -> None:
    z = 0.4 * np.exp(1j * np.linspace(0.0, np.pi, 9))
    errors = [np.abs(approximation(z / k, theta) - np.exp(theta * z / k)).max() for k in (1, 2)]
    assert np.log2(errors[0] / errors[1]) > STAGES + 0.5


def test_fast_modes_are_damped_away_and_none_grows() -> None:
    assert abs(approximation(-1e12, 1.0)) < 1e-9
    frequencies = np.concatenate([-np.logspace(-3, 8, 5000), np.logspace(-3, 8, 5000)])
    assert np.abs(approximation(1j * frequencies, 1.0)).max() <= 1.0 + 1e-12
    for theta in np.linspace(0.0, 1.0, 21):  # a step that ends on an event
        assert abs(approximation(-1e12, theta)) <= 1.3


# ------------------------------------------------------------ which laws and targets
def test_what_is_linear_between_events() -> None:
    for target in (FreeMass(mass=2.0), RigidWall(), NAIL, BOARD):
        assert target_is_linear(target)
    assert law_is_linear(LAW) and law_is_linear(KelvinVoigt(stiffness=1e4, damping=10.0))
    assert not law_is_linear(HuntCrossley(stiffness=1e6, dissipation=0.1))
    bent = {"k": 1e4, "analytic": True}
    soft = CustomLaw(compression=lambda x, r, k: k * x + r, restitution=lambda x, r, k: k * x, **bent)
    hard = CustomLaw(compression=lambda x, r, k: k * x + r**3, restitution=lambda x, r, k: k * x, **bent)
    assert law_is_linear(soft) and not law_is_linear(hard)


def test_what_it_cannot_do_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[str, Any] = {"robot": robot_named("arm"), "striker": "hand", "normal": X, "target": TARGET}
    for method in ("events", "exact"):
        with pytest.raises(InputError, match=f"'{method}'.*there are implicit, rk4"):
            SDC(**given, law=LAW, method=method)
    with pytest.raises(InputError, match="freezes=0"):
        SDC(**given, law=LAW, freezes=2).graph()
    for tolerance in (0.0, -1e-6, np.nan, 1.0):
        with pytest.raises(InputError, match="tolerance"):
            SDC(**given, law=LAW, tolerance=tolerance)
    # what a machine has does not choose the method; what needs a compiler says so
    monkeypatch.setenv("IMPACTOPT_NO_COMPILER", "1")
    without = SDC(**given, law=LAW)
    assert without.stepping == "implicit"
    for derivatives in (without.gradient_function, lambda: without.jacobian_function(("impulse",))):
        with pytest.raises(InputError, match=r"need a C compiler that works: install gcc or clang"):
            derivatives()


# ------------------------------------------------------------ collisions
@functools.cache
def model_of(name: str, robot: str = "arm", **options: Any) -> SDC:
    robot_ = robot_named(robot)
    striker = next(iter(robot_.strikers))
    return SDC(robot=robot_, striker=striker, normal=X, horizon=0.2, **{**MODELS[name], **options})


def cases_of(model: SDC, count: int) -> list[tuple[Any, Any, Any, dict[str, Any]]]:
    """Arguments of `collide`: servos that saturate, joints that stick and slide, gains over two decades."""
    made = []
    for seed in range(count):
        case = random_case(seed, "arm")
        rng = np.random.default_rng(seed)
        gains = {"kd": case.gains["kd"], "kp": case.gains["kp"]}
        limits = model.robot.torque_limit * 10 ** rng.uniform(-1.0, 0.0)
        made.append((case.q, case.v, case.torque, {**gains, "torque_limit": limits}))
    return made


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.parametrize("name", MODELS)
@pytest.mark.slow
def test_random_collisions_are_the_exact_ones(name: str) -> None:
    """The impulse to ten times the tolerance, whatever the events on the way; and better with a better one.

    The tolerance is of the hand's speed: joints of their own fast modes may be ten times as far off."""
    rough, model = model_of(name), dataclasses.replace(model_of(name), tolerance=1e-11)
    exact = ExactCollision(rough)
    for q, v, torque, given in cases_of(rough, 10):
        options = {"require_separation": False, **given}
        true = exact.collide(q, v, torque, **options)
        for sdc, allowed in ((rough, 1e-5), (model, 1e-9)):
            loose = 10 * allowed
            found = sdc.collide(q, v, torque, **options)
            assert found.separated == true.separated
            assert found.impulse == pytest.approx(true.impulse, rel=allowed)
            assert found.peak_force == pytest.approx(true.peak_force, rel=allowed)
            np.testing.assert_allclose(found.velocity, true.velocity, atol=loose * np.abs(v).max())
            np.testing.assert_allclose(found.configuration, true.configuration, atol=loose)
            for key, value in true.target_result.items():
                assert found.target_result[key] == pytest.approx(value, rel=allowed, abs=allowed)
        # where the contact is left slowly its end is less sharp than its impulse
        assert found.duration == pytest.approx(true.duration, rel=1e-6)


@pytest.mark.slow
def test_the_error_falls_with_the_tolerance() -> None:
    model = dataclasses.replace(model_of("mass"), horizon=0.5)
    tolerances, errors = np.logspace(-3, -9, 4), []
    cases, exact = cases_of(model, 8), ExactCollision(model)
    true = np.array([exact.collide(q, v, torque, **given).impulse for q, v, torque, given in cases])
    for tolerance in tolerances:
        sdc = dataclasses.replace(model, tolerance=tolerance)
        found = np.array([sdc.collide(q, v, torque, **given).impulse for q, v, torque, given in cases])
        errors.append(np.sqrt(np.mean((found / true - 1.0) ** 2)))
    slope = np.polyfit(np.log(tolerances), np.log(errors), 1)[0]
    assert slope == pytest.approx(1.0, abs=0.25)
    assert (np.array(errors) < tolerances).all()


def test_histories_lie_on_a_grid_and_are_those_of_the_exact_solution() -> None:
    model = model_of("wall", step=5e-4, tolerance=1e-10)
    exact = ExactCollision(model)
    for q, v, torque, given in cases_of(model, 4):
        found, true = (m.collide(q, v, torque, require_separation=False, **given) for m in (model, exact))
        grid = np.arange(0.0, true.duration, 5e-4)
        np.testing.assert_allclose(found.time[:-1], grid, atol=1e-15)
        assert found.time[-1] == pytest.approx(true.duration, rel=1e-6)
        at = np.array([np.abs(true.time - t).argmin() for t in grid])
        for key in ("force", "penetration", "hand_speed", "torque", "demand", "joint_velocity"):
            mine, other = getattr(found, key)[:-1], getattr(true, key)[at]
            np.testing.assert_allclose(mine, other, atol=1e-6 * np.abs(other).max(), err_msg=key)


def test_a_joint_that_saturates_for_a_part_of_one_step_is_seen() -> None:
    """Limits just below the largest demand, which lasts some tenths of a millisecond, and steps of many."""
    model = model_of("mass", tolerance=1e-4)
    q, v, torque, given = cases_of(model, 1)[0]
    free = {**given, "torque_limit": np.full(model.robot.n, 1e6)}
    demand = np.abs(model.collide(q, v, torque, **free).demand)
    joint = int(np.argmax(demand.max(axis=0) - np.maximum(demand[0], demand[-1])))
    for share in (0.9, 0.99, 0.999):
        limits = np.full(model.robot.n, 1e6)
        limits[joint] = share * demand[:, joint].max()
        fine = dataclasses.replace(model, step=1e-5).collide(
            q, v, torque, **{**given, "torque_limit": limits}
        )
        beyond = np.abs(fine.demand[:, joint]) > limits[joint] * (1 + 1e-9)
        assert beyond.any() and not beyond.all()
        assert np.abs(fine.torque[:, joint]).max() <= limits[joint]
        exact = ExactCollision(model).collide(q, v, torque, **{**given, "torque_limit": limits})
        assert fine.impulse == pytest.approx(exact.impulse, rel=1e-4)


@pytest.mark.parametrize("factor", [1e2, 1e4, 1e6])
def test_servos_however_stiff_are_followed_in_the_same_time(factor: float) -> None:
    """The explicit methods would need steps of 1e-7 s and less."""
    model = model_of("mass")
    q, v, torque, given = cases_of(model, 1)[0]
    stiff = {**given, "kd": factor * given["kd"], "torque_limit": np.full(model.robot.n, 1e6)}
    with pytest.raises(InputError, match="unstable"):
        dataclasses.replace(model, method="rk4", step=2e-4).collide(q, v, torque, **stiff)
    impulse = model.collide(q, v, torque, require_separation=False, **stiff).impulse
    finer = dataclasses.replace(model, tolerance=1e-12).collide(
        q, v, torque, require_separation=False, **stiff
    )
    assert impulse == pytest.approx(finer.impulse, rel=1e-5)


def test_two_masses_in_closed_form() -> None:
    mass, speed = 3.0, 1.2
    impulse, duration = two_masses(mass, TARGET.mass, LAW.stiffness, LAW.damping, speed)
    options: dict[str, Any] = {"striker": "tip", "normal": X, "law": LAW, "target": TARGET}
    robot = small_robots.slider(mass)
    for model in (
        SDC(robot=robot, **options, effects=Effects.none(), kd=0.0, tolerance=1e-12),
        VirtualMass(robot=robot, **options, tolerance=1e-12),
    ):
        found = model.collide([0.1], [speed], [0.0])
        assert model.stepping == "implicit"
        assert found.impulse == pytest.approx(impulse, rel=1e-12)
        assert found.duration == pytest.approx(duration, rel=1e-7)


def test_no_number_gives_none_and_hands_that_part_have_no_collision() -> None:
    model = model_of("mass")
    q, v, torque, _ = cases_of(model, 1)[0]
    function = model.function(("impulse", "duration", "velocity", "separated", "torque"))
    broken = np.array(v)
    broken[-1] = np.nan
    assert all(np.isnan(np.array(x)).all() for x in function(q, broken, torque))
    away = model.collide(q, -np.array(v), torque)
    assert away.separated and away.impulse == 0.0 and away.duration == 0.0


def test_several_freezes_take_implicit_steps_too() -> None:
    model = model_of("mass", freezes=3)
    assert model.stepping == "implicit"
    q, v, torque, given = cases_of(model, 1)[0]
    found = model.collide(q, v, torque, **given)
    # the steps without a compiler, in the graph's own course
    outputs = ("impulse", "peak_force", "configuration")
    values = model.settings.override(given).values()
    graph = collision_graph(model, outputs, as_compiled=True)
    impulse, peak, configuration = (np.array(x).ravel() for x in graph.call([q, v, torque, *values]))
    assert found.impulse == pytest.approx(impulse, rel=1e-6)
    assert found.peak_force == pytest.approx(peak, rel=1e-6)
    np.testing.assert_allclose(found.configuration, configuration, atol=1e-7)
    assert (np.diff(found.time) > 0).all() and found.time[-1] == pytest.approx(found.duration)
