"""A live look at one collision: what its sliders do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.small_robots import slider

from impactopt import (
    SDC,
    FixedBase,
    FreeMass,
    ImpactProblem,
    InputError,
    KelvinVoigt,
    SpringDamper,
    holding_torque,
    load_problem,
    striking_velocity,
)
from impactopt.live.collision_page import CollisionPage

FILE = Path(__file__).resolve().parents[2] / "problems" / "arm_planar.toml"
LONG = 60.0  # [s]


@pytest.fixture(scope="module")
def look() -> Iterator[CollisionPage]:
    with CollisionPage(load_problem(FILE)) as made:
        assert made.wait(LONG)
        yield made


def test_at_first_the_hand_is_at_the_target_and_hits(look: CollisionPage) -> None:
    p, hit = look.problem, look.shown.collision
    assert look.shown.q == pytest.approx(p.contact_posture)
    q = p.contact_posture
    v = striking_velocity(p.robot, q, p.striker, p.normal, float(look.speed.value), stance=p.stance)
    names = ("robot", "striker", "normal", "law", "target", "stance")
    model = SDC(**{name: getattr(p, name) for name in names}, freezes=4)
    assert hit is not None
    assert hit.impulse == model.collide(q, v, holding_torque(p.robot, q, v, stance=p.stance)).impulse
    assert f"**{hit.impulse:.3g} N s**" in look.text.content
    # also beyond the limit, where `collide` refuses it
    share = np.abs(v[-p.robot.n :] / p.robot.velocity_limit).max()
    assert f"- joint speed {100 * share:.0f} % of the limit" in look.text.content


def test_a_slider_of_posture_or_speed_makes_another_collision(look: CollisionPage) -> None:
    assert look.shown.collision is not None
    before, q = look.shown.collision.impulse, look.shown.q
    look.speed.value = 2.0
    assert look.wait(LONG)
    faster = look.shown.collision
    assert faster is not None
    assert faster.impulse > before
    name = next(reversed(look.joints))
    look.joints[name].value = look.joints[name].value - 0.2
    assert look.wait(LONG)
    assert look.shown.q is not None
    assert q is not None
    assert np.abs(look.shown.q - q).max() == pytest.approx(0.2)
    assert look.shown.collision is not None
    assert look.shown.collision.impulse != faster.impulse


def test_where_there_is_no_collision_the_page_says_why(
    look: CollisionPage, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stuck(*_: object, **__: object) -> None:
        raise InputError("the hand cannot move along the normal")

    monkeypatch.setattr("impactopt.live.collision_page.striking_velocity", stuck)
    look.speed.value = 3.0
    assert look.wait(LONG)
    assert look.shown.collision is None
    assert look.text.content == "**No collision.** the hand cannot move along the normal"


def test_a_target_that_flees_is_not_hit() -> None:
    fleeing = replace(load_problem(FILE), target=FreeMass(mass=2.0, initial_velocity=20.0))
    with CollisionPage(fleeing) as made:
        assert made.wait(LONG)
        assert made.shown.collision is None and "moves away" in made.text.content


def test_a_slider_has_the_unit_of_its_joint(look: CollisionPage) -> None:
    """A rail's was an angle in radians."""
    assert [joint.label for joint in look.joints.values()] == [f"{name} [rad]" for name in look.joints]
    problem = ImpactProblem(
        robot=slider(5.0, postures={"start": {"rail": 0.0}}),
        striker="tip",
        start="start",
        stance=FixedBase(),
        point=[0.25, 0.0, 0.0],
        normal=[1.0, 0.0, 0.0],
        target=FreeMass(mass=1.0),
        law=SpringDamper(stiffness=2e4, damping=50.0),
    )
    with CollisionPage(problem) as page:
        assert page.joints["rail"].label == "rail [m]"


def test_a_nail_that_jumps_ahead_is_touched_again() -> None:
    stiff = replace(load_problem(FILE), law=KelvinVoigt(stiffness=1e7, damping=0.0))
    with CollisionPage(stiff) as page:
        page.speed.value = 3.0
        assert page.wait(LONG)
        assert "touches the nail again" in page.text.content


@pytest.mark.slow
def test_soles_that_the_ground_would_have_to_pull() -> None:
    """A stiff contact of half a millisecond: the page told the ZMP of its ends."""
    problem = load_problem(FILE.with_name("punch_standin.toml"))
    with CollisionPage(replace(problem, law=SpringDamper(stiffness=1e8, damping=0.0))) as page:
        assert page.wait(LONG)
        assert page.shown.collision is not None and page.shown.collision.sole_wrench is not None
        assert page.shown.collision.sole_wrench[..., 2].sum(axis=1).min() < 0
        assert "no ZMP: the ground would have to pull the soles" in page.text.content
