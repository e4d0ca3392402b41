"""Gradients by implicit steps taken back: against differences of exact collisions, and closed forms."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from support import small_robots
from support.frozen_cases import two_masses
from support.implicit_cases import exact, gradient, implicit
from support.native_cases import FRICTION, LAW, TARGET, X, call, inputs, situation

from impactopt import SDC, Board, Effects, KelvinVoigt, Nail, RigidWall, VirtualMass
from impactopt.codegen.compiler import find_compiler

pytestmark = [
    pytest.mark.skipif(find_compiler() is None, reason="no C compiler"),
    pytest.mark.filterwarnings("ignore::impactopt.errors.NoCompilerWarning"),
]


def stepped(model: Any, outputs: tuple[str, ...], values: list[Any]) -> Callable[[Any, Any], Any]:
    """The collision at q and v by the steps themselves."""
    function = model._collision(outputs)

    def collision(q: Any, v: Any) -> Any:
        found = call(function, [q, v, *values[2:]])
        return type("Found", (), {name: x.item() for name, x in found.items()})

    return collision


def differences(
    collision: Callable[[Any, Any], Any], outputs: tuple[str, ...], model: Any, values: list[Any], way: Any
) -> dict[str, float]:
    """Central differences along `way` with Richardson's extrapolation: their error is of order four."""
    robot, (q, v) = model.robot, values[:2]

    def difference(h: float) -> Any:
        ends = [
            collision(pin.integrate(robot.model, q, t * way[: robot.nv]), v + t * way[robot.nv :])
            for t in (h, -h)
        ]
        ahead, behind = (np.array([getattr(end, output) for output in outputs]) for end in ends)
        return (ahead - behind) / (2 * h)

    return dict(zip(outputs, (4 * difference(5e-4) - difference(1e-3)) / 3, strict=True))


def assert_slopes(
    collision: Callable[[Any, Any], Any], outputs: tuple[str, ...], model: Any, values: list[Any], rel: float
) -> None:
    way = np.random.default_rng(1).normal(size=2 * model.robot.nv)
    true = differences(collision, outputs, model, values, way)
    for output in outputs:
        _, by_q, by_v = gradient(model, output, values)
        assert np.concatenate([by_q, by_v]) @ way == pytest.approx(true[output], rel=rel), output


def with_values(model: Any, values: list[Any], **others: Any) -> list[Any]:
    names = model._collision(("impulse",)).name_in()
    return [others.get(name, value) for name, value in zip(names, values, strict=True)]


# ------------------------------------------------------------ against exact collisions
# servos that push on would not let go of a wall, nor of a nail
SOFT = {"kp": 10.0, "kd": 1.0, "effects": Effects(feedforward=False)}
WALL = {"target": RigidWall(), "law": KelvinVoigt(stiffness=1e4, damping=50.0), **SOFT}
ARMS = {
    "all terms but friction": (("impulse", "duration", "energy"), {}),
    "nothing but damping": (("peak_force",), {"effects": Effects.none()}),
    "a nail": (("energy",), {"target": Nail(mass=0.2, resistance=80.0, hardening=1e4), **SOFT}),
    "a board that breaks": (
        ("energy",),
        {"target": Board(mass=0.5, stiffness=2e4, breaking_force=60.0), "effects": Effects(bias=False)},
    ),
    "a wall": (("peak_force", "duration"), WALL),
    "a wall, to the horizon": (("impulse", "peak_force"), {**WALL, "horizon": 0.003}),
}


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if "wall" in name else name for name in ARMS]
)
def test_an_arms_gradient_is_that_of_exact_collisions(name):
    outputs, options = ARMS[name]
    model = implicit("arm", **options)
    values = situation("arm", model)
    collision = exact(model, values)
    found = collision(*values[:2])
    assert found.separated == ("horizon" not in options)
    assert found.target_result.get("broken", 1.0) == 1.0 and found.target_result.get("depth", 1.0) > 0.0
    assert_slopes(collision, outputs, model, values, rel=1e-8)


LIMIT = np.array([30.0, 36.0, 8.0, 3.5])


def sliding(**options: Any) -> tuple[Any, list[Any]]:
    """An arm with joints that saturate and slide on the way."""
    friction = dataclasses.replace(FRICTION, transition=0.33)
    model = implicit("arm", effects=Effects(friction=True), friction=friction, **options)
    values = situation("arm", model)
    return model, with_values(model, values, feedforward=np.zeros(4), torque_limit=LIMIT)


def test_joints_that_saturate_and_slide_on_the_way_are_in_the_gradient():
    model, values = sliding()
    collision = exact(model, values)
    found = collision(*values[:2])
    saturated = np.abs(found.torque) >= LIMIT * (1 - 1e-12)
    beyond = np.abs(found.joint_velocity) > model.joint_friction.transition
    assert (saturated[:-1] != saturated[1:]).sum() > 2
    assert (beyond[:-1] != beyond[1:]).sum() > 2
    assert_slopes(collision, ("impulse", "duration"), model, values, rel=1e-8)


def test_a_force_that_grows_until_the_horizon_has_its_peak_there():
    # the last step begins on an event, so that its length is no constant
    model, values = sliding(law=KelvinVoigt(stiffness=1e4, damping=5.0), horizon=0.0132)
    collision = exact(model, values)
    found = collision(*values[:2])
    assert np.argmax(found.force) == found.force.size - 1
    assert (np.abs(found.torque[-1]) >= LIMIT * (1 - 1e-12)).any()
    assert (np.abs(found.torque[0]) < LIMIT).all()
    assert_slopes(collision, ("peak_force",), model, values, rel=1e-8)


@pytest.mark.slow
def test_a_bipeds_gradient_is_that_of_exact_collisions():
    model = implicit("biped")
    values = situation("biped", model)
    assert_slopes(exact(model, values), ("impulse", "duration"), model, values, rel=1e-8)


# ------------------------------------------------------------ against differences of the same steps
@pytest.mark.slow
def test_a_standins_gradient_is_that_of_differences():
    model = implicit("standin")
    values = situation("standin", model)
    so_far = stepped(model, ("impulse", "separated"), values)  # its servo pushes on to the horizon
    assert_slopes(so_far, ("impulse",), model, values, rel=1e-8)


def test_a_stiff_servos_gradient_is_that_of_differences():
    model = implicit("arm", kp=1e5, kd=2e3, effects=Effects(saturation=False))
    values = situation("arm", model)
    outputs = ("impulse", "peak_force")
    assert_slopes(stepped(model, outputs, values), outputs, model, values, rel=1e-8)


def test_the_default_tolerance_is_enough_for_a_gradient():
    tight, usual = implicit("biped"), implicit("biped", tolerance=1e-6)
    values = situation("biped", tight)
    true, found = (np.concatenate(gradient(model, "impulse", values)[1:]) for model in (tight, usual))
    assert np.linalg.norm(found - true) <= 1e-6 * np.linalg.norm(true)


# ------------------------------------------------------------ against closed forms
def test_a_sliders_gradient_is_that_of_two_masses():
    robot = small_robots.slider(3.0)
    model = SDC(robot=robot, striker="tip", normal=X, law=LAW, target=TARGET, effects=Effects.none())
    assert model.stepping == "implicit"
    values = inputs(model, [0.1], [1.2], [0.0])
    impulse, _ = two_masses(3.0, TARGET.mass, LAW.stiffness, LAW.damping, 1.2)
    # all is in proportion to the speed, but for the time that it takes
    found, by_q, by_v = gradient(model, "impulse", values)
    assert found == pytest.approx(impulse, rel=1e-6)
    assert by_v == pytest.approx(impulse / 1.2, rel=1e-6) and abs(by_q) < 1e-9
    duration, _, by_v = gradient(model, "duration", values)
    assert abs(by_v) < 1e-9 * duration


def test_a_point_masses_gradient_is_in_proportion_to_its_speed():
    model = implicit("arm", VirtualMass)
    values = situation("arm", model)
    impulse, _, by_v = gradient(model, "impulse", values)
    assert by_v @ values[1] == pytest.approx(impulse, rel=1e-10)
    collision = exact(model, values)
    assert_slopes(collision, ("impulse",), model, values, rel=1e-8)


# ------------------------------------------------------------ where there is nothing to differentiate
def test_what_the_horizon_ends_lasts_as_long_whatever_hits():
    model = implicit("arm", **WALL, horizon=0.003)
    values = situation("arm", model)
    for output, true in (("duration", 0.003), ("separated", 0.0)):
        found, by_q, by_v = gradient(model, output, values)
        assert found == pytest.approx(true, rel=1e-12)
        assert np.abs(by_q).max() < 1e-15 and np.abs(by_v).max() < 1e-15


def test_hands_that_part_have_no_gradient():
    model = implicit("arm")
    found = gradient(model, "impulse", situation("arm", model, speed=-1.0))
    assert all((x == 0.0).all() for x in map(np.asarray, found))


@pytest.mark.parametrize("place", [0, 1])
def test_a_gradient_says_where_it_has_no_numbers(place):
    model = implicit("arm")
    values = situation("arm", model)
    values[place] = np.array(values[place], dtype=float)
    values[place][-1] = np.nan
    found = gradient(model, "impulse", values)
    assert all(np.isnan(x).all() for x in map(np.asarray, found))
