"""Sole wrenches that carry the robot at rest."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.kinematics.coordinates import StanceCoordinates

Array = NDArray[np.float64]


def static_wrenches(c: StanceCoordinates, y: Array, legs: Array) -> Array:
    """Sole wrenches (6 a sole) of least norm that carry the robot at rest. Hands and hinges bear nothing."""
    if not c.legs:
        return np.zeros(0)
    model, data = c.model, c.model.createData()
    q = c.join(y, legs)
    tau = np.array(pin.computeGeneralizedGravity(model, data, q))
    jac = c.sole_jacobians(q)[0][: 6 * len(c.soles), c.undriven]
    lever = np.array([1, 1, 1, 10, 10, 10] * len(c.soles))  # moments cost more: keep the CoP in the sole
    found = np.linalg.lstsq(jac.T / lever, tau[c.undriven], rcond=None)[0] / lever
    return np.concatenate([found, np.zeros(6 * len(c.hands))])
