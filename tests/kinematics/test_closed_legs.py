"""Legs of many instants at once: as those of one after the other."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from support.small_robots import arm, biped

from impactopt.errors import InputError
from impactopt.kinematics import closed_legs
from impactopt.kinematics.closed_legs import close_legs
from impactopt.kinematics.coordinates import StanceCoordinates

Array = NDArray[np.float64]


Motion = tuple[StanceCoordinates, Array, Array]


@pytest.fixture(params=[6, 7], ids=["legs of six", "legs of seven"])
def moving(request: pytest.FixtureRequest) -> Motion:
    """Coordinates, those of a base that shifts, squats and turns (k, ny), and the legs to start from."""
    robot = biped(request.param)
    posture = robot.posture("half_sitting")
    c = StanceCoordinates(robot, robot.soles, posture)
    y, legs = c.split(posture)
    at = np.linspace(0.0, 1.0, 12)[:, None]
    rng = np.random.default_rng(3)
    way = 0.2 * rng.standard_normal(c.ny)
    way[:6] = 0.03, -0.02, -0.05, 0.05, 0.08, -0.1
    return c, y + at * way, legs


def test_they_are_those_of_one_instant_after_the_other(moving: Motion) -> None:
    c, y, legs = moving
    found, before = close_legs(c, y, legs), legs
    for k, row in enumerate(y):
        before = c.solve_legs(row, before)
        np.testing.assert_allclose(found[k], before, atol=1e-11)


def test_an_instant_that_newtons_method_misses_is_closed_from_the_one_before(
    moving: Motion, monkeypatch: pytest.MonkeyPatch
) -> None:
    c, y, legs = moving
    right = close_legs(c, y, legs)
    monkeypatch.setattr(closed_legs, "ITERATIONS", 2)  # too few for all but the first
    np.testing.assert_allclose(close_legs(c, y, legs), right, atol=1e-11)
    monkeypatch.undo()
    monkeypatch.setattr(closed_legs, "NEAR", 0.0)  # as though each had found another way to bend its knees
    np.testing.assert_allclose(close_legs(c, y, legs), right, atol=1e-11)


def test_a_base_out_of_reach_is_told(moving: Motion) -> None:
    c, y, legs = moving
    y = y.copy()
    y[-1, 2] += 1.0
    with pytest.raises(InputError, match="out of the legs' reach"):
        close_legs(c, y, legs)


def test_turns_and_shifts_are_pinocchios() -> None:
    rng = np.random.default_rng(0)
    rotations = np.array([pin.exp3(s * rng.standard_normal(3)) for s in (0.0, 1e-9, 1e-3, 0.1, 1.0)])
    shifts = rng.standard_normal((5, 3))
    expected = [pin.log6(pin.SE3(r, p)).vector for r, p in zip(rotations, shifts, strict=True)]
    np.testing.assert_allclose(closed_legs._logarithm(rotations, shifts), expected, atol=1e-12)


def test_an_arm_has_none() -> None:
    robot = arm()
    posture = robot.posture(next(iter(robot.postures)))
    c = StanceCoordinates(robot, (), posture)
    assert close_legs(c, np.zeros((3, c.ny)), np.zeros(0)).shape == (3, 0)
