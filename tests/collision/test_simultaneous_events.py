"""Events that fall on an instant exactly: the next derivative decides, so that numbers do not jump there.

On a slider, whose speed and force are exact in floating point: what is equal is equal to the last bit.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from support import small_robots

from impactopt import (
    SDC,
    Effects,
    FreeMass,
    FullDynamics,
    JointFriction,
    MujocoDynamics,
    Nail,
    SpringDamper,
    Target,
    VirtualMass,
)
from impactopt.contact.fields import about, choose

pytestmark = pytest.mark.filterwarnings("ignore::impactopt.errors.NoCompilerWarning")

LAW = SpringDamper(stiffness=1e6, damping=512.0)
MODELS = (SDC, VirtualMass, FullDynamics)
# relative: what the numbers beside the tie are off it, and what the models' steps leave out
NEXT_TO, SAME = 1e-7, 2e-5


@pytest.fixture(params=[False, True], ids=["compiled", "in Python"])
def in_python(request, monkeypatch):
    """Implicit steps have a second form, for machines without a compiler."""
    if request.param:
        monkeypatch.setenv("IMPACTOPT_NO_COMPILER", "1")


def model_of(kind, target, *, law=LAW, friction=None, **limits):
    options = {"robot": small_robots.slider(2.0, **limits), "striker": "tip", "normal": [1.0, 0.0, 0.0]}
    options |= {"accuracy": None} if kind is SDC else {}  # no second model for the error of freezing
    options |= {"friction": friction} if friction else {}
    options |= {"effects": Effects(friction=True)} if friction and kind is SDC else {}
    return kind(**options, law=law, target=target, horizon=0.05)


def outcome(model, *, speed=1.0, push=0.0, **settings):
    found = model.collide([0.0], [speed], [push], require_separation=False, **settings)
    return np.array([found.impulse, found.peak_force, found.duration])


@dataclass(frozen=True, kw_only=True)
class Ledge(Target):
    """A mass that is held with a force up to the end of a way, which may be none: it is there at contact."""

    mass: float = field(metadata=about("of it", unit="kg", above=0))
    hold: float = field(metadata=about("force of the spring", unit="N", least=0))
    way: float = field(metadata=about("way to its end", unit="nm", least=0))

    n_states = 2
    typical = (1.0, 0.01)

    def velocity(self, state, parameters=None):
        return state[0]

    def derivative(self, state, force, parameters=None):
        p = self.parameters if parameters is None else parameters
        held = choose(state[1] > 1e-9 * p["way"], 0.0 * force, p["hold"] + 0.0 * force)
        return [(force - held) / p["mass"], state[0]]

    def switches(self, state, force, parameters=None):
        p = self.parameters if parameters is None else parameters
        return [state[1] - 1e-9 * p["way"]]

    def energy(self, state, parameters=None):
        p = self.parameters if parameters is None else parameters
        return 0.5 * p["mass"] * state[0] ** 2


@pytest.mark.slow
@pytest.mark.usefixtures("in_python")
@pytest.mark.parametrize("kind", MODELS)
@pytest.mark.parametrize("speed", [0.5, 2.0])
def test_a_nail_whose_wood_resists_with_the_first_force(kind, speed):
    """d v = R at first touch; the force rises beyond it."""
    tied = Nail(mass=0.05, resistance=LAW.damping * speed)
    beside = Nail(mass=0.05, resistance=LAW.damping * speed * (1 + NEXT_TO))
    found = outcome(model_of(kind, tied), speed=speed)
    np.testing.assert_allclose(found, outcome(model_of(kind, beside), speed=speed), rtol=SAME)
    assert found[1] < 1.6 * tied.resistance  # 2.3 times where the nail is believed to stand


@pytest.mark.parametrize("kind", MODELS)
def test_a_nail_whose_wood_resists_with_the_first_force_which_falls(kind):
    """It stands until the end."""
    law = SpringDamper(stiffness=1e4, damping=512.0)
    model = model_of(kind, Nail(mass=0.05, resistance=512.0), law=law)
    found = model.collide([0.0], [1.0], [0.0])
    assert found.target_result["depth"] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.usefixtures("in_python")
@pytest.mark.parametrize("kind", MODELS)
@pytest.mark.parametrize("hold", [200.0, 512.0])
def test_a_target_that_is_at_its_end_from_the_start(kind, hold):
    """Its velocity, the first derivative, is zero too; with 512 N the second as well."""
    found = outcome(model_of(kind, Ledge(mass=0.5, hold=hold, way=0.0)))
    beside = outcome(model_of(kind, Ledge(mass=0.5, hold=hold, way=1e-12)))
    np.testing.assert_allclose(found, beside, rtol=SAME)


@pytest.mark.usefixtures("in_python")
@pytest.mark.parametrize("kind", [SDC, FullDynamics])
@pytest.mark.parametrize("push", [64.0, -64.0])
def test_a_servo_at_its_limit(kind, push):
    """Its damper takes it beyond, or back, as the blow slows the hand down."""

    def at(limit):
        model = model_of(kind, FreeMass(mass=1.0), kd=50.0, torque_limit=limit)
        return outcome(model, push=push)

    np.testing.assert_allclose(at(64.0), at(64.0 * (1 + NEXT_TO)), rtol=SAME)


@pytest.mark.usefixtures("in_python")
@pytest.mark.parametrize("kind", [SDC, FullDynamics])
@pytest.mark.parametrize("push", [64.0, -64.0])
def test_a_joint_at_the_edge_of_its_frictions_band(kind, push):
    def at(transition):
        friction = JointFriction(coulomb=8.0, transition=transition)
        return outcome(model_of(kind, FreeMass(mass=1.0), friction=friction), push=push)

    np.testing.assert_allclose(at(1.0), at(1.0 + NEXT_TO), rtol=SAME)


@pytest.mark.slow
@pytest.mark.usefixtures("in_python")
@pytest.mark.parametrize("kind", [SDC, FullDynamics])
def test_a_hand_that_rests_against_the_target(kind):
    """It neither approaches nor parts: what pushes it decides, and nothing where nothing does."""
    model = model_of(kind, FreeMass(mass=1.0))
    pushed = outcome(model, speed=0.0, push=64.0)
    beside = outcome(model, speed=1e-9, push=64.0)
    assert pushed[0] > 0.5  # two masses that are pushed for 50 ms: a third of 64 N x 50 ms
    np.testing.assert_allclose(pushed, beside, rtol=SAME)
    for push in (0.0, -64.0):
        assert outcome(model, speed=0.0, push=push)[0] == 0.0


@pytest.mark.slow
@pytest.mark.usefixtures("in_python")
@pytest.mark.parametrize("friction", [None, JointFriction(coulomb=8.0, transition=1.0)])
@pytest.mark.parametrize("target", [FreeMass(mass=1.0), Nail(mass=0.05, resistance=40.0)])
@pytest.mark.parametrize("push", [64.0, 0.0, -64.0])
def test_a_hand_that_rests_in_steps_of_one_length(target, friction, push):
    """Those of C, those of the graph, which takes their place without a compiler, and implicit ones."""
    model = model_of(SDC, target, friction=friction)
    fixed = replace(model, method="rk4", step=2.5e-5)
    at, settings = ([0.0], [0.0], [push]), fixed.settings.values()
    graph = float(fixed.graph(("impulse",))(*at, *settings))
    assert outcome(fixed, speed=0.0, push=push)[0] == pytest.approx(graph, rel=1e-9)
    assert graph == pytest.approx(outcome(model, speed=0.0, push=push)[0], rel=1e-4)
    assert (graph > 0.1) == (push > 0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [SDC, FullDynamics, MujocoDynamics])
def test_a_hand_as_fast_as_what_it_meets(kind):
    model = model_of(kind, FreeMass(mass=1.0, initial_velocity=1.0))
    assert outcome(model, push=64.0)[0] > 0.5
    assert outcome(model)[0] == 0.0


def test_no_line_of_a_batch_jumps_where_many_events_are_tied():
    """d v = 600 N all along; peaks were up to twice as high where the product is exact."""
    model = model_of(SDC, Nail(mass=0.05, resistance=600.0), law=SpringDamper(stiffness=4e6, damping=600.0))
    speed = np.linspace(0.5, 2.0, 601)
    q, v = np.zeros((601, 1)), speed[:, None]
    given = {"outputs": ("impulse", "peak_force"), "contact_damping": 600.0 / speed}
    assert (given["contact_damping"] * speed == 600.0).sum() > 100
    found = model.batch(q, v, np.zeros(1), **given)
    for numbers in (found["impulse"], found["peak_force"]):
        bend = np.abs(np.diff(numbers, 2)).max() / numbers.mean()
        assert bend < 1e-4
