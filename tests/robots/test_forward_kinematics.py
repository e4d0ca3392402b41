"""Forward kinematics in whole arrays: Pinocchio's, configuration by configuration."""

import numpy as np
import pinocchio as pin
import pytest
from support.rigid_body_cases import NAMES, case, configurations

from impactopt import RigidBody
from impactopt.robots.model import ForwardKinematics


@pytest.mark.parametrize("name", NAMES)
def test_placements_are_pinocchios(name: str) -> None:
    model = case(name).model
    data, q = model.createData(), configurations(model, 20)[0]
    rotation, translation = ForwardKinematics(model)(q)
    for k, posture in enumerate(q):
        pin.forwardKinematics(model, data, posture)
        np.testing.assert_allclose(rotation[k], [place.rotation for place in data.oMi], atol=1e-13)
        np.testing.assert_allclose(translation[k], [place.translation for place in data.oMi], atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_rows_of_coordinates_are_configurations(name: str) -> None:
    model = case(name).model
    body, q = RigidBody(model, base="rpy"), configurations(model, 20)[0]
    rows = np.array([body.from_pin(posture) for posture in q])
    for back, posture, row in zip(body.to_pin(rows), q, rows, strict=True):
        np.testing.assert_allclose(pin.difference(model, posture, back), 0.0, atol=1e-10)
        np.testing.assert_array_equal(body.to_pin(row), back)
