"""Implicit steps where law or target bend, and with matrices of gains: against SciPy and differences."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from support.frozen_by_scipy import FrozenCollision
from support.native_cases import FRICTION, HARDENING, ROBOTS, X, robot_named, situation

from impactopt import (
    SDC,
    Effects,
    FreeMass,
    HertzDamped,
    HuntCrossley,
    Nail,
    SpringDamper,
    VirtualMass,
    effective_mass,
    load_robot,
    striking_velocity,
)
from impactopt.codegen.compiler import find_compiler
from impactopt.collision.graph import collision_graph
from impactopt.collision.implicit import NODES, STAGES, gamma, node_tables
from impactopt.collision.stepped import law_is_linear, target_is_linear

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Dragged(FreeMass):
    """A mass in water."""

    drag: float = 3.0

    def derivative(self, state: Any, force: Any, parameters: Any = None) -> list[Any]:
        p = self.parameters if parameters is None else parameters
        return [(force - p["drag"] * state[0] * (state[0] ** 2 + 0.01) ** 0.5) / p["mass"]]


GAINS = 0.5 * np.ones((4, 4)) + np.diag([20.0, 30.0, 20.0, 10.0])
GAINS[0, 1] += 0.3  # not symmetric
MASS, SPRING = FreeMass(mass=1.0), SpringDamper(stiffness=1e4, damping=300.0)
HUNT = HuntCrossley(stiffness=1e6, dissipation=0.3)
MODELS: dict[str, dict[str, Any]] = {
    "Hunt-Crossley": {"law": HUNT},
    "Hertz": {"law": HertzDamped(stiffness=1e6, damping=200.0)},
    "Hertz without a damper": {"law": HertzDamped(stiffness=1e6, damping=0.0)},
    "a law of one's own": {"law": HARDENING},
    "matrices of gains": {"kp": 10 * GAINS, "kd": GAINS},
    "drag": {"target": Dragged(mass=1.0)},
    "all of them": {"law": HARDENING, "target": Dragged(mass=1.0), "kp": 10 * GAINS, "kd": GAINS},
    "joints that slide": {"law": HUNT, "effects": Effects(friction=True), "friction": FRICTION},
    "a nail": {
        "law": HUNT,
        "target": Nail(mass=0.2, resistance=80.0, hardening=1e4),
        "effects": Effects(feedforward=False),
        "kp": 10.0,
        "kd": 1.0,
    },
}
OUTPUTS = ("impulse", "duration", "peak_force", "energy")


@functools.cache
def case(name: str, tolerance: float = 1e-7) -> tuple[SDC, list[Any]]:
    given = {"robot": robot_named("arm"), "striker": ROBOTS["arm"][1], "normal": X, "law": SPRING}
    model = SDC(**{**given, "target": MASS, "tolerance": tolerance, "accuracy": None, **MODELS[name]})
    values = situation("arm", model)
    first = 3 if model.effects.feedforward else 2
    names = [*model.settings]
    if "reference" in names:
        values[first + names.index("reference")] = 0.0 * model.settings["reference"]
    return model, values


def settings_of(model: SDC, values: list[Any]) -> tuple[Any, dict[str, Any]]:
    first = 3 if model.effects.feedforward else 2
    return (values[2] if first == 3 else None), dict(zip(model.settings, values[first:], strict=True))


# ------------------------------------------------------------ numbers of the method
def test_polynomials_through_the_nodes_are_what_they_go_through() -> None:
    at, back = node_tables()
    rng = np.random.default_rng(0)
    values = rng.normal(size=NODES)
    np.testing.assert_allclose(at @ (back @ values), values, atol=1e-9)
    assert back.shape == (STAGES + 1, NODES) and not back[0].any() and not back[STAGES].any()
    assert at[-1] @ back @ np.ones(NODES) == pytest.approx(1.0) and gamma() > 0


def test_nonlinear_laws_and_targets_are_recognized() -> None:
    assert not law_is_linear(HUNT) and target_is_linear(MASS)
    # for any parameters, also those for which the force is linear but for a kink
    assert not law_is_linear(HuntCrossley(stiffness=1e6, dissipation=0.0, exponent=1.0))
    assert not target_is_linear(Dragged(mass=1.0)) and law_is_linear(SPRING)


# ------------------------------------------------------------ values
@pytest.mark.parametrize("name", MODELS)
def test_collisions_are_scipys(name: str) -> None:
    model, values = case(name)
    torque, settings = settings_of(model, values)
    impulse, duration = FrozenCollision(model, values[0], values[1], torque, settings).run()
    found = [float(x) for x in model._collision(OUTPUTS)(*values)]
    assert found[0] == pytest.approx(impulse, rel=1e-6)
    assert found[1] == pytest.approx(duration, rel=1e-6)


@pytest.mark.parametrize(("deep", "most"), [(1e-4, 3e-4), (1e-5, 3e-3), (1e-6, 0.08)])
def test_shallow_contacts_of_hertz_are_damped_less(deep: float, most: float) -> None:
    """Impulse over Tsuji's, by how deep [m] two point masses would be without damping."""
    robot, normal, hit, speed, ratio = load_robot("planar_arm"), [0.0, 0.0, -1.0], 0.01, 0.5, 1.5
    q = robot.posture("ready")
    v = striking_velocity(robot, q, "hammer", normal, speed)
    own = float(effective_mass(robot, striker="hammer", normal=normal)(q))
    both = 1 / (1 / own + 1 / hit)
    stiffness = 1.25 * both * speed**2 / deep**2.5  # both speed^2 / 2 = 2/5 stiffness deep^2.5
    law = HertzDamped(stiffness=stiffness, damping=ratio * np.sqrt(stiffness * both))
    scene: dict[str, Any] = {"robot": robot, "striker": "hammer", "normal": normal, "law": law}
    found = VirtualMass(**scene, target=FreeMass(mass=hit)).collide(q, v)
    zeta = ratio / np.sqrt(5)
    restitution = np.exp(-2 * zeta * np.arccos(zeta) / np.sqrt(1 - zeta**2))
    assert 0 < found.impulse / ((1 + restitution) * both * speed) - 1 < most


def test_the_error_falls_with_the_tolerance() -> None:
    """Of several speeds together; its order in the step's length is that of the tolerance's ninth root."""
    model, values = case("Hunt-Crossley")
    speeds, tolerances, errors = np.linspace(0.5, 1.5, 6), np.logspace(-3, -8, 4), []

    def impulses(tolerance: float) -> Any:
        function = dataclasses.replace(model, tolerance=tolerance)._collision(("impulse",))
        return np.array([float(function(values[0], s * values[1], *values[2:])) for s in speeds])

    true = impulses(1e-11)
    for tolerance in tolerances:
        errors.append(np.sqrt(np.mean((impulses(tolerance) / true - 1.0) ** 2)))
    slope = np.polyfit(np.log(tolerances), np.log(errors), 1)[0]
    assert slope == pytest.approx(1.0, abs=0.25)
    assert (np.array(errors) < 3 * tolerances).all()


@pytest.mark.parametrize("name", MODELS)
def test_steps_without_a_compiler_give_the_same_numbers(name: str) -> None:
    model, values = case(name)
    outputs = (*OUTPUTS, "force", "torque", "configuration")
    made, graph = model._collision(outputs), collision_graph(model, outputs, as_compiled=True)
    for output, a, b in zip(outputs, made.call(values), graph.call(values), strict=True):
        a, b = np.array(a), np.array(b)
        np.testing.assert_allclose(b, a, atol=1e-6 * np.abs(a).max(), err_msg=output)


def test_rows_of_a_batch_are_single_collisions() -> None:
    """Of laws over decades of stiffness: each finds its own steps."""
    model, values = case("Hunt-Crossley")
    torque, settings = settings_of(model, values)
    stiffness = np.logspace(4.5, 10, 12)
    options = {"reference": settings["reference"]} if "reference" in settings else {}
    rows = model.batch(
        np.tile(values[0], (12, 1)),
        np.tile(values[1], (12, 1)),
        torque,
        contact_stiffness=stiffness,
        **options,
    )
    assert rows["separated"].all()
    for k, impulse in zip(stiffness, rows["impulse"], strict=True):
        settings["contact_stiffness"] = np.array(k)
        single = model._collision(("impulse",))(values[0], values[1], torque, *settings.values())
        assert impulse == pytest.approx(float(single), rel=1e-12)


def test_a_hand_that_begins_inside_its_laws_singularity_ends_on_separation() -> None:
    """x^1.5 has no curvature where contact begins and ends; penetration is zero at both."""
    model, values = case("Hunt-Crossley", 1e-9)
    function = model.function(("penetration", "force", "time", "separated"), every=1)
    torque, _ = settings_of(model, values)
    depth, force, time, separated = (np.array(x).ravel() for x in function(values[0], values[1], torque))
    assert separated == 1.0 and depth[0] == 0.0 and (depth[1:-1][np.diff(time)[1:] > 0] >= -1e-9).all()
    assert abs(depth[-1]) < 1e-9 * depth.max() and force[-1] < 1e-9 * force.max()


# ------------------------------------------------------------ derivatives
def way_and_slopes(model: SDC, values: list[Any], function: Any) -> tuple[Any, Any]:
    """A direction, and the outputs' slopes along it by differences of order four."""
    robot, (q, v) = model.robot, values[:2]
    way = np.random.default_rng(1).normal(size=2 * robot.nv)

    def difference(h: float) -> Any:
        ends = []
        for t in (h, -h):
            there = pin.integrate(robot.model, q, t * way[: robot.nv]), v + t * way[robot.nv :]
            ends.append([np.array(x).ravel(order="F") for x in function.call([*there, *values[2:]])])
        return [(a - b) / (2 * h) for a, b in zip(*ends, strict=True)]

    pairs = zip(difference(2.5e-4), difference(5e-4), strict=True)
    return way, [(4 * fine - coarse) / 3 for fine, coarse in pairs]


@pytest.mark.parametrize("name", [x for x in MODELS if x != "Hertz without a damper"])
def test_gradients_and_jacobians_are_those_of_differences(name: str) -> None:
    model, values = case(name, 1e-11)
    outputs = (*OUTPUTS, "force")
    way, slopes = way_and_slopes(model, values, model._collision(OUTPUTS))
    found = model._jacobian(outputs, 2)
    jacobian = dict(zip(found.name_out(), found.call(values), strict=True))
    for output, slope in zip(OUTPUTS, slopes, strict=True):
        by_q, by_v = (np.array(jacobian[f"{output}_by_{x}"]).ravel() for x in "qv")
        assert np.append(by_q, by_v) @ way == pytest.approx(slope.item(), rel=1e-7), output
    _, *gradient = (np.array(x).ravel() for x in model._gradient("impulse").call(values))
    np.testing.assert_allclose(gradient[0], np.array(jacobian["impulse_by_q"]).ravel(), rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(gradient[1], np.array(jacobian["impulse_by_v"]).ravel(), rtol=1e-9, atol=1e-10)


def test_gradients_with_freezes_are_those_of_differences() -> None:
    model = dataclasses.replace(case("Hunt-Crossley")[0], freezes=2)
    values = case("Hunt-Crossley")[1]
    tight = dataclasses.replace(model, tolerance=1e-11)
    way, (slope,) = way_and_slopes(model, values, tight._collision(("impulse",)))
    _, *gradient = (np.array(x).ravel() for x in model._gradient("impulse").call(values))
    assert np.concatenate(gradient) @ way == pytest.approx(slope.item(), rel=1e-6)
