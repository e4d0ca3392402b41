"""The exact solution of the frozen collision against closed forms and an independent integration; and the
orders of the methods that make steps, against it."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from support.exact import ExactCollision
from support.exact.bernstein import first_negative, largest
from support.exact_reference import Case, random_case, robot_named
from support.small_robots import slider

from impactopt import (
    SDC,
    Effects,
    FreeMass,
    HuntCrossley,
    InputError,
    JointFriction,
    KelvinVoigt,
    SpringDamper,
    VirtualMass,
)
from impactopt.collision.implicit import bernstein_matrix

X = np.array([1.0, 0.0, 0.0])
LAW, TARGET = SpringDamper(stiffness=1e4, damping=300.0), FreeMass(mass=2.0)


@pytest.fixture(autouse=True)
def _virtual_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("IMPACTOPT_NO_COMPILER", "1")


pytestmark = pytest.mark.filterwarnings("ignore::impactopt.errors.NoCompilerWarning")


# ------------------------------------------------------------ polynomials
def bernstein(*roots: complex, degree: int = 20) -> Any:
    powers = np.zeros(degree + 1)
    powers[: len(roots) + 1] = np.polynomial.polynomial.polyfromroots(roots).real
    return bernstein_matrix(degree) @ powers


@pytest.mark.parametrize("dip", [1e-3, 1e-6])
def test_a_dip_between_two_samples_is_not_missed(dip: float) -> None:
    """(s - 0.3)(s - 0.3 - dip): above zero at both ends and nearly everywhere between."""
    assert first_negative(bernstein(0.3, 0.3 + dip)) == pytest.approx(0.3, abs=1e-9)
    assert first_negative(bernstein(0.3 + 1e-3j, 0.3 - 1e-3j)) is None


def test_first_of_several_roots_and_the_largest_value() -> None:
    b = bernstein(0.2, 0.5, 0.9)
    assert first_negative(-b) == pytest.approx(0.2, abs=1e-14)
    s = np.linspace(0.0, 1.0, 200001)
    values = (s - 0.2) * (s - 0.5) * (s - 0.9)
    assert largest(b, 1.0, -1.0) == pytest.approx(values.max(), rel=1e-9)
    assert largest(-b, 1.0, -1.0) == pytest.approx((-values).max(), rel=1e-9)
    assert largest(-b, 0.1, -1.0) == pytest.approx((-values[s <= 0.1]).max(), rel=1e-9)
    assert largest(b, 1.0, 7.0) == 7.0


def test_the_largest_value_where_rounding_is_all_that_tells_neighbours_apart() -> None:
    for top in np.linspace(0.05, 0.95, 19):
        powers = np.zeros(21)
        powers[:3] = 400.0 - 1e-2 * top**2, 2e-2 * top, -1e-2
        assert largest(bernstein_matrix(20) @ powers, 1.0, 0.0) == pytest.approx(400.0, rel=1e-13)


# ------------------------------------------------------------ closed forms
@pytest.mark.parametrize("mass, target, ratio", [(4.0, 5.0, 0.2), (1.0, 50.0, 0.7), (6.0, 0.5, 0.0)])
def test_two_masses_in_closed_form(mass: float, target: float, ratio: float) -> None:
    """A Kelvin-Voigt element until its force v sqrt(k mu) / r exp(-zeta w t) sin(2 phi - r w t) has fallen to
    zero; cos(phi) = zeta, sin(phi) = r."""
    mu, k, speed = mass * target / (mass + target), 2e4, 1.3
    w, phi = np.sqrt(k / mu), np.arccos(ratio)
    law = KelvinVoigt(stiffness=k, damping=2.0 * ratio * w * mu)
    given: dict[str, Any] = {"striker": "tip", "normal": X, "law": law, "target": FreeMass(mass=target)}
    sdc = SDC(robot=slider(mass), **given, horizon=0.5)
    duration = 2.0 * phi / (w * np.sin(phi))
    restitution = np.exp(-ratio * w * duration)
    highest = max(0.0, 3.0 * phi - np.pi)  # r w t there
    decay = np.exp(-highest / np.tan(phi))
    peak = speed * np.sqrt(k * mu) / np.sin(phi) * decay * np.sin(2.0 * phi - highest)
    for model in (sdc, VirtualMass(robot=slider(mass), **given, horizon=0.5)):
        result = ExactCollision(model).collide([0.0], [speed], [0.0])
        assert result.separated and result.force[-1] == 0.0
        assert result.duration == pytest.approx(duration, rel=1e-12)
        assert result.impulse == pytest.approx(mu * speed * (1.0 + restitution), rel=1e-12)
        assert result.peak_force == pytest.approx(peak, rel=1e-12)


# ------------------------------------------------------------ an independent integration
@pytest.mark.slow
@pytest.mark.parametrize(
    "name, seeds",
    [("slider", (5,)), ("arm", (21, 1001)), ("biped", (7,)), ("talos", (23,)), ("standin", (1114,))],
)
def test_random_collisions_against_an_independent_integration(name: str, seeds: tuple[int, ...]) -> None:
    for seed in seeds:
        case = random_case(seed, name)
        case = dataclasses.replace(case, sdc=dataclasses.replace(case.sdc, horizon=0.06))
        expected, result = case.reference(), case.collide()
        assert result.separated == expected["separated"], seed
        for key in ("impulse", "duration", "peak_force"):
            assert getattr(result, key) == pytest.approx(expected[key], rel=1e-9), (seed, key)
        np.testing.assert_allclose(result.velocity, expected["velocity"], atol=1e-9)
        after = pin.integrate(case.sdc.robot.model, case.q, expected["displacement"])
        np.testing.assert_allclose(result.configuration, after, atol=1e-10)


def test_histories_are_at_phases_ends_and_on_a_grid() -> None:
    case = smooth_case("arm", Effects(friction=True))
    coarse, fine = case.collide(spacing=1e-3), case.collide(spacing=2.5e-4)
    assert coarse.impulse == fine.impulse and coarse.peak_force == fine.peak_force
    grid = np.arange(0.0, fine.duration, 2.5e-4)
    near = np.abs(fine.time[:, None] - grid).min(axis=0)
    assert near.max() < 1e-15 and (np.diff(fine.time) > 0).all()
    assert len(fine.time) > len(grid) + 1, "there are phases' ends between"
    assert fine.force.max() <= fine.peak_force * (1 + 1e-12)
    np.testing.assert_allclose(fine.joint_velocity[-1], fine.velocity[-case.sdc.robot.n :], atol=1e-13)


# ------------------------------------------------------------ orders
def smooth_case(name: str, effects: Effects) -> Case:
    case, robot = random_case(8, name), robot_named(name)
    friction = JointFriction(viscous=1.0, coulomb=1.0, transition=0.1) if effects.friction else None
    sdc = SDC(
        robot=robot,
        striker=case.sdc.striker,
        normal=case.sdc.normal,
        law=LAW,
        target=TARGET,
        effects=effects,
        friction=friction,
    )
    return dataclasses.replace(case, sdc=sdc, gains={"kd": robot.kd, "kp": robot.kp})


def deepening(case: Case, time: float, **options: Any) -> float:
    """Penetration [m] at a time that is a step's end."""
    result = case.collide(**options)
    at = int(np.abs(result.time - time).argmin())
    assert result.time[at] == pytest.approx(time, rel=1e-9)
    return float(result.penetration[at])


def test_order_of_runge_kutta_without_events() -> None:
    method, order, steps = "rk4", 4, (2.5e-4, 6.25e-5)
    case, time = smooth_case("arm", Effects(saturation=False)), 2e-3
    exact = deepening(case, time, spacing=time)
    errors = [abs(deepening(case, time, step=step, method=method) - exact) for step in steps]
    measured = np.log(errors[0] / errors[1]) / np.log(steps[0] / steps[1])
    assert errors[1] > 1e-13 * exact, "rounding is not what is measured"
    assert measured == pytest.approx(order, abs=0.5)


@pytest.mark.slow
def test_order_of_runge_kutta_with_events() -> None:
    """Of the impulse, over several speeds, as where in its step an event falls is chance."""
    method, order, steps = "rk4", 2, (2.5e-4, 3.125e-5)
    case = smooth_case("arm", Effects(friction=True))
    cases = [dataclasses.replace(case, v=scale * case.v) for scale in np.linspace(0.8, 1.2, 8)]
    exact = [each.collide() for each in cases]
    assert all(found.separated for found in exact)
    errors = []
    for step in steps:
        sdc = dataclasses.replace(case.sdc, method=method, step=step)
        found = [sdc.collide(c.q, c.v, c.torque, **c.gains).impulse for c in cases]
        errors.append(
            np.sqrt(np.mean([(a / b.impulse - 1.0) ** 2 for a, b in zip(found, exact, strict=True)]))
        )
    assert errors[1] > 1e-14, "rounding is not what is measured"
    measured = np.log(errors[0] / errors[1]) / np.log(steps[0] / steps[1])
    assert measured == pytest.approx(order, abs=0.6)


# ------------------------------------------------------------ what it is not for
def test_what_is_not_linear_or_frozen_again_is_refused() -> None:
    given: dict[str, Any] = {"robot": slider(4.0), "striker": "tip", "normal": X, "target": TARGET}
    with pytest.raises(InputError, match="HuntCrossley is not linear"):
        ExactCollision(SDC(**given, law=HuntCrossley(stiffness=1e6, dissipation=0.1)))
    with pytest.raises(InputError, match="freezes=0"):
        ExactCollision(SDC(**given, law=LAW, freezes=2))
    sdc = ExactCollision(SDC(**given, law=LAW, horizon=0.01))
    with pytest.raises(InputError, match="horizon"):
        sdc.collide([0.0], [1.0], [0.0])
    away = sdc.collide([0.0], [-1.0], [0.0])
    assert away.separated and away.impulse == 0.0 and away.duration == 0.0 and away.peak_force == 0.0


def test_a_drag_that_grows_with_the_square_of_the_speed_is_refused() -> None:
    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Dragged(FreeMass):
        def derivative(self, state: Any, force: Any, parameters: Any = None) -> list[Any]:
            mass = (parameters or self.parameters)["mass"]
            return [force / mass - 3.0 * state[0] * state[0]]

    with pytest.raises(InputError, match="Dragged is not linear"):
        ExactCollision(SDC(robot=slider(4.0), striker="tip", normal=X, law=LAW, target=Dragged(mass=1.0)))
