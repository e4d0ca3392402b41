"""Faces of striking links, by their hulls."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from impactopt import Robot, g1, talos
from impactopt.bodies.robot_bodies import striker_face


def moved(robot: Robot, name: str, by: np.ndarray) -> Robot:
    """The robot with that striking point moved [m]."""
    strikers = dict(robot.strikers)
    strikers[name] = dataclasses.replace(strikers[name], point=np.asarray(strikers[name].point) + by)
    return dataclasses.replace(robot, strikers=strikers)


@pytest.mark.parametrize(("make", "name"), [(talos, "right_hand"), (g1, "right_hand")])
def test_presets_strike_with_what_is_outermost(make: object, name: str) -> None:
    face = striker_face(make(), name)  # type: ignore[operator]
    assert face is not None
    assert np.linalg.norm(face.normal) == pytest.approx(1.0)
    assert face.ahead < 2e-3


def test_a_point_inside_its_link_is_as_far_behind_as_it_was_moved() -> None:
    """The fingertips' plane looks along -z of the gripper's base."""
    name = "right_hand"
    face = striker_face(moved(talos(), name, np.array([0.0, 0.0, 0.02])), name)
    assert face is not None
    np.testing.assert_allclose(face.normal, [0.0, 0.0, -1.0], atol=0.02)
    assert face.ahead == pytest.approx(0.02, abs=1e-3)


def test_the_corners_lead_in_every_direction_near_the_normal() -> None:
    """No vertex of the hull lies farther ahead than the corners, but for those that were merged."""
    from impactopt.bodies.robot_bodies import bodies_of

    robot = talos()
    face, hit = striker_face(robot, "right_hand"), robot.striker("right_hand")
    assert face is not None
    frame = robot.model.frames[robot.model.getFrameId(hit.frame)]
    pieces = bodies_of(robot).of_joint[int(frame.parentJoint)]
    back = frame.placement.inverse()
    points = np.concatenate([p.vertices for p in pieces]) @ back.rotation.T + back.translation - hit.point
    rng = np.random.default_rng(0)
    for _ in range(50):
        direction = face.normal + 0.5 * rng.standard_normal(3)
        direction /= np.linalg.norm(direction)
        if direction @ face.normal > 0.6:
            assert (face.corners @ direction).max() > (points @ direction).max() - 4e-3
