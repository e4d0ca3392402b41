"""Mass matrix of a `pin.Model` with or without followers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

Array = NDArray[np.float64]


def mass_matrix(model: pin.Model, data: Any, q: Array) -> Array:
    """H (nv, nv), symmetric, at q (nq), with armature on its diagonal, by `pin.crba`.

    For a model with followers the columns are the forces of unit accelerations, by `pin.rnea`: `pin.crba` of
    Pinocchio 4.1 leaves entries out if several branches hang on a follower.
    """
    if getattr(model, "nvExtended", model.nv) == model.nv:
        return np.array(pin.crba(model, data, q))
    own, zero = model.createData(), np.zeros(model.nv)  # its own data, so that `data` keeps its velocities
    weight = np.array(pin.computeGeneralizedGravity(model, own, q))
    columns = [pin.rnea(model, own, q, zero, unit) - weight for unit in np.eye(model.nv)]
    half = 0.5 * np.array(columns)
    return np.asarray(half + half.T)
