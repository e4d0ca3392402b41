"""Targets that come to the striker, or go before it: what must not change when everything moves along, and
what the compiled models, full dynamics and differences say.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.frozen_cases import X, slider
from support.implicit_cases import exact, gradient, implicit
from support.native_cases import call, situation

from impactopt import (
    SDC,
    Board,
    FreeMass,
    FullDynamics,
    HuntCrossley,
    Nail,
    RigidWall,
    SpringDamper,
    Target,
    VirtualMass,
)
from impactopt.codegen.compiler import find_compiler
from impactopt.simulation.result import travelled

pytestmark = [
    pytest.mark.skipif(find_compiler() is None, reason="no C compiler"),
    pytest.mark.filterwarnings("ignore::impactopt.errors.NoCompilerWarning"),
]

LAWS = {
    "spring": SpringDamper(stiffness=2e4, damping=30.0),
    "hunt": HuntCrossley(stiffness=1e6, dissipation=0.2),
}
TARGETS = {
    "mass": FreeMass(mass=0.45),
    "board": Board(mass=0.5, stiffness=2e4, breaking_force=400.0, damping=5.0),
}


def blow(law: Any, target: Target, speed: float, kind: Any = SDC) -> Any:
    """A point mass of 1 kg on a rail; no servo."""
    model = kind(robot=slider(1.0), striker="tip", normal=X, law=law, target=target, horizon=0.2)
    return model.collide([0.0], [speed], *([[0.0]] if kind is not VirtualMass else []))


@pytest.mark.slow
@pytest.mark.parametrize("kind", [SDC, VirtualMass, FullDynamics])
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("target", TARGETS)
def test_a_blow_is_the_same_if_everything_moves_along(target: str, law: str, kind: Any) -> None:
    """Galilei: without servo and gravity along the rail only the difference of the speeds matters."""
    still = blow(LAWS[law], TARGETS[target], 6.0, kind)
    for along in (-5.0, 2.0):
        moving = blow(LAWS[law], replace(TARGETS[target], initial_velocity=along), 6.0 + along, kind)
        assert moving.impulse == pytest.approx(still.impulse, rel=1e-8)
        assert moving.duration == pytest.approx(still.duration, rel=1e-8)
        assert moving.target_speed[0] == pytest.approx(along)
        assert moving.target_speed[-1] - along == pytest.approx(still.target_speed[-1], rel=1e-7)


@given(speed=st.floats(-2.0, 3.0), before=st.floats(-8.0, 2.0))
@settings(deadline=None, max_examples=25)
def test_what_the_mass_gains_is_the_impulse_and_the_work_done_on_it(speed: float, before: float) -> None:
    if speed - before < 0.1:
        return
    law, mass = LAWS["spring"], 0.45
    found = blow(law, FreeMass(mass=mass, initial_velocity=before), speed)
    after = found.target_result["speed"]
    assert mass * (after - before) == pytest.approx(found.impulse, rel=1e-7)
    assert found.energy == pytest.approx(0.5 * mass * (after**2 - before**2), rel=1e-6, abs=1e-9)


def test_only_what_may_move_before_contact_has_a_speed_then() -> None:
    nail = Nail(mass=0.2, resistance=300.0)
    assert [float(t.speed_before()) for t in (nail, RigidWall(), *TARGETS.values())] == [0.0] * 4
    assert float(replace(TARGETS["mass"], initial_velocity=-5.0).speed_before()) == -5.0


def coming(name: str, law: Any, before: float, **options: Any) -> Any:
    return implicit(name, law=law, target=FreeMass(mass=0.45, initial_velocity=before), **options)


def impulse_of(model: Any, values: list[Any], **moved: Any) -> float:
    """By the compiled function; q and v in place of those of `values`."""
    q, v = moved.get("q", values[0]), moved.get("v", values[1])
    function = model.function(("impulse",), parameters=tuple(model.settings))
    return float(call(function, [q, v, *values[2:]])["impulse"].item())


@pytest.mark.parametrize("name", ["arm", "biped"])
def test_what_is_frozen_where_hand_and_target_have_met_knows_that_the_target_comes(name: str) -> None:
    """Against exact frozen dynamics: a ball of 5 m/s."""
    model = coming(name, LAWS["spring"], -5.0)
    values = situation(name, model)
    true = exact(model, values)(*values[:2]).impulse
    assert impulse_of(model, values) == pytest.approx(true, rel=1e-9)
    still = coming(name, LAWS["spring"], 0.0)
    assert impulse_of(still, situation(name, still)) < 0.5 * true


@pytest.mark.parametrize("name", ["arm", "biped"])
def test_derivatives_know_that_the_target_comes(name: str) -> None:
    """Gradients against differences, where a still target would be parted from: the hand goes away from it,
    and the target is faster.
    """
    model = coming(name, LAWS["hunt"], -3.0)
    values = situation(name, model, speed=-0.5)
    (q, v), nv = values[:2], model.robot.nv
    impulse, by_q, by_v = gradient(model, "impulse", values)
    assert impulse == pytest.approx(impulse_of(model, values), rel=1e-9)
    rng = np.random.default_rng(3)
    for _ in range(3):
        way = rng.normal(size=2 * nv)
        ends = [
            impulse_of(model, values, q=pin.integrate(model.robot.model, q, h * way[:nv]), v=v + h * way[nv:])
            for h in (1e-4, -1e-4)
        ]
        slope = (ends[0] - ends[1]) / 2e-4
        assert by_q @ way[:nv] + by_v @ way[nv:] == pytest.approx(slope, rel=1e-5, abs=1e-6)


def test_freezes_on_the_way_bring_a_blow_at_a_ball_nearer_to_full_dynamics() -> None:
    errors = []
    for freezes in (0, 4):
        model = coming("arm", SpringDamper(stiffness=3e3, damping=10.0), -3.0, freezes=freezes)
        q, v, torque, *_ = situation("arm", model)
        keys = ("robot", "striker", "normal", "law", "target", "stance")
        full = FullDynamics(**{key: getattr(model, key) for key in keys}).collide(q, v, torque).impulse
        errors.append(abs(model.collide(q, v, torque).impulse / full - 1))
    assert errors[0] < 0.02
    assert errors[1] < 0.3 * errors[0]


def test_a_targets_travel_is_counted_from_where_it_is_hit() -> None:
    time = np.array([0.0, 0.5, 1.0, 1.5])
    assert travelled(time, np.full(4, -5.0), 1.0) == pytest.approx([5.0, 2.5, 0.0, -2.5])
    assert travelled(time, np.zeros(4), np.nan) == pytest.approx(np.zeros(4))
