"""Legs along a motion, whose guesses are extrapolated, against legs solved one by one."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from support.small_robots import arm, biped

from impactopt import InputError
from impactopt.kinematics.coordinates import StanceCoordinates

Array = NDArray[np.float64]


Motion = tuple[StanceCoordinates, Array, Array]


@pytest.fixture(params=[6, 7], ids=["legs of six", "legs of seven"])
def moving(request: pytest.FixtureRequest) -> Motion:
    """Stance coordinates, a motion y (k, ny) of a base that shifts, squats and turns, and first legs."""
    robot = biped(request.param)
    posture = robot.posture("half_sitting")
    c = StanceCoordinates(robot, robot.soles, posture)
    y, legs = c.split(posture)
    at = np.linspace(0.0, 1.0, 12)[:, None]
    rng = np.random.default_rng(3)
    way = 0.2 * rng.standard_normal(c.ny)
    way[:6] = 0.03, -0.02, -0.05, 0.05, 0.08, -0.1
    return c, y + at * way, legs


def test_legs_along_a_motion_are_those_solved_one_by_one(moving: Motion) -> None:
    c, y, legs = moving
    found, before = np.array([leg for _, leg in c.leg_closure.follow(y, legs)]), legs
    for k, coordinates in enumerate(y):
        before = c.solve_legs(coordinates, before)
        np.testing.assert_allclose(found[k], before, atol=1e-11)


def test_a_base_out_of_reach_is_an_input_error(moving: Motion) -> None:
    c, y, legs = moving
    y = y.copy()
    y[-1, 2] += 1.0
    with pytest.raises(InputError, match="out of the legs' reach"):
        np.array(list(c.leg_closure.follow(y, legs)))


def test_an_arm_has_no_legs() -> None:
    robot = arm()
    posture = robot.posture(next(iter(robot.postures)))
    c = StanceCoordinates(robot, (), posture)
    found = [leg for _, leg in c.leg_closure.follow(np.zeros((3, c.ny)), np.zeros(0))]
    assert np.array(found).shape == (3, 0)
