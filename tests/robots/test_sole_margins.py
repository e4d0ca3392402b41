"""Margins of a sole by itself: where forces at known points press, and what a light sole counts for."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from support.small_robots import biped

from impactopt.robots.loads import (
    MIN_LOAD_FRACTION,
    cop_margin,
    least_margins,
    margin_between_nodes,
    shortfalls,
    weight_of,
)

Array = NDArray[np.float64]
CORNERS = np.array([[-0.05, -0.06], [0.15, -0.06], [0.15, 0.06], [-0.05, 0.06]])
MIDDLE = CORNERS.mean(axis=0)
ROBOT = biped()
LIGHT = MIN_LOAD_FRACTION * weight_of(ROBOT)


def pressed(points: Array, forces: Array) -> Array:
    """Wrench (1, 1, 6) of normal forces [N] at points of the sole."""
    at = np.column_stack([points, np.zeros(len(points))])
    f = np.column_stack([np.zeros((len(points), 2)), forces])
    return np.concatenate([f.sum(axis=0), np.cross(at, f).sum(axis=0)])[None, None]


def margin_of(wrench: Array) -> float:
    return float(cop_margin(ROBOT, [CORNERS], wrench)[0, 0])


@pytest.mark.parametrize(
    ("point", "margin"),
    [((0.05, 0.0), 0.06), ((0.14, 0.0), 0.01), ((0.0, -0.06), 0.0), ((0.0, 0.1), -0.04), ((-0.08, 0), -0.03)],
)
def test_one_force_presses_where_it_is(point: tuple[float, float], margin: float) -> None:
    wrench = pressed(np.array([point]), np.array([10 * LIGHT]))
    assert margin_of(wrench) == pytest.approx(margin, abs=1e-12)
    wrench[..., [0, 1, 5]] = 30.0  # friction and torsion move no centre of pressure
    assert margin_of(wrench) == pytest.approx(margin, abs=1e-12)


@given(forces=arrays(float, 4, elements=st.floats(0.0, 1e3)))
def test_what_corners_can_bear_is_inside(forces: Array) -> None:
    assert -1e-9 <= margin_of(pressed(CORNERS, forces)) <= 0.06 + 1e-9


def test_a_light_sole_counts_as_pressed_at_its_middle() -> None:
    """Without load it has its middle's margin, a moment that nothing bears is outside, and nothing jumps."""
    assert margin_of(np.zeros((1, 1, 6))) == pytest.approx(0.06)
    tipping = np.zeros((1, 1, 6))
    tipping[..., 3] = 0.1 * LIGHT
    assert margin_of(tipping) == pytest.approx(0.06 - 0.1)
    near = [
        margin_of(pressed(np.array([[0.14, 0.0]]), np.array([s * LIGHT]))) for s in (0.5, 1 - 1e-9, 1 + 1e-9)
    ]
    assert near[0] == pytest.approx(0.15 - (0.5 * 0.14 + 0.5 * MIDDLE[0]))
    assert near[1] == pytest.approx(near[2], abs=1e-9)


def test_half_of_a_margin_or_all_but_a_millimetre_is_kept() -> None:
    assert [margin_between_nodes(asked) for asked in (0.02, 0.002, 0.001, 0.0)] == pytest.approx(
        [0.01, 0.001, 0.0, -0.001]
    )


def test_what_is_short_is_named_worst_first() -> None:
    cop = np.array([[0.02, 0.018], [0.009, 0.02], [0.02, 0.004]])
    force = np.array([[100.0, 60.0], [90.0, 60.0], [80.0, 20.0]])
    phase = np.array([0, 1, 1])
    numbers: dict[str, Any] = least_margins(
        ("left", "right"), cop, force, {"swing": phase == 0, "follow": phase == 1, "missed": phase == 2}
    )
    assert numbers["sole_cop_margin_mm"]["left"] == pytest.approx({"swing": 20.0, "follow": 9.0})
    assert numbers["sole_force_N"]["right"] == {"swing": 60.0, "follow": 20.0}
    assert shortfalls(numbers) == [], "nothing is asked"
    numbers |= {"sole_cop_margin_asked_mm": {"swing": 20.0, "follow": 20.0}, "sole_force_asked_N": 50.0}
    assert [words.partition(":")[0] for words in shortfalls(numbers)] == [
        "centre of pressure of the sole 'right', follow",
        "normal force on the sole 'right', follow",
        "centre of pressure of the sole 'left', follow",
    ]
