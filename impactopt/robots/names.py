"""Names that a link and a joint share, as URDF and MJCF allow, told apart for Pinocchio."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

__all__ = ["reduced", "tell_apart"]

_MARK = "\x00"  # in no name of a file


def tell_apart(model: pin.Model) -> None:
    """Rename frames of joints that have a link's name: `elbow` is the link, `joint elbow` its joint."""
    count = Counter(str(frame.name) for frame in model.frames)
    for frame in model.frames:
        if count[str(frame.name)] > 1 and frame.type in (pin.FrameType.JOINT, pin.FrameType.FIXED_JOINT):
            frame.name = f"joint {frame.name}"


def reduced(model: pin.Model, locked: Sequence[int], q: NDArray[np.float64], *geometry: Any) -> Any:
    """The model without locked joints, held at q (nq,), as of `pin.buildReducedModel`; and a
    pin.GeometryModel where one is given.

    Pinocchio 4.1 looks frames up by joints' names, and fails where a link has the same.
    """
    model = model.copy()
    joints = set(map(str, model.names))
    for frame in model.frames:
        if frame.type == pin.FrameType.JOINT:
            frame.name = model.names[frame.parentJoint]
        elif frame.type != pin.FrameType.FIXED_JOINT and str(frame.name) in joints:
            frame.name = f"{frame.name}{_MARK}"
    out = pin.buildReducedModel(model, *geometry, list(locked), q)
    found = out[0] if geometry else out
    for frame in found.frames:
        frame.name = str(frame.name).removesuffix(_MARK)
    tell_apart(found)
    return out
