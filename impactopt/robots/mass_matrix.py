"""Mass matrix of a `pin.Model`, of one with followers too."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

__all__ = ["mass_matrix"]

Array = NDArray[np.float64]


def mass_matrix(model: pin.Model, data: Any, q: Array) -> Array:
    """H (nv, nv), symmetric, at q (nq), armature on its diagonal, by `pin.crba`.

    Pinocchio 4.1 leaves entries out where several branches hang on a follower, so that there H is the forces
    of unit accelerations, column by column.
    """
    if getattr(model, "nvExtended", model.nv) == model.nv:
        return np.array(pin.crba(model, data, q))
    own, still = model.createData(), np.zeros(model.nv)  # so that `data` keeps its velocities
    weight = np.array(pin.computeGeneralizedGravity(model, own, q))
    columns = [pin.rnea(model, own, q, still, unit) - weight for unit in np.eye(model.nv)]
    half = 0.5 * np.array(columns)
    return np.asarray(half + half.T)
