"""Text and hashes that are the same in every process for equal things: what cache keys are made of."""

from __future__ import annotations

import dataclasses
import enum
import hashlib
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

__all__ = ["canonical", "model_hash"]


def model_hash(model: pin.Model) -> str:
    """Hexadecimal hash of all in a `pin.Model` that shapes its dynamics, the same in every process.

    Covers joints (name, type, axis, parent, placement), inertias, armature, gravity and frames; not limits.
    """
    digest = hashlib.sha256()

    def add(*items: Any) -> None:
        for item in items:
            if isinstance(item, np.ndarray):
                digest.update(np.ascontiguousarray(item, dtype=np.float64).tobytes())
            digest.update(repr(np.shape(item) if isinstance(item, np.ndarray) else item).encode() + b"\0")

    add(int(model.nq), int(model.nv), np.array(model.gravity.vector))
    neutral = pin.neutral(model)
    for i in range(model.njoints):
        joint, inertia = model.joints[i], model.inertias[i]
        placement = model.jointPlacements[i].homogeneous
        add(str(model.names[i]), joint.shortname(), int(model.parents[i]), joint.idx_q, joint.idx_v)
        add(_motion_subspace(joint, neutral) if i else None)
        add(np.array(placement), float(inertia.mass), np.array(inertia.lever), np.array(inertia.inertia))
    add(np.array(model.armature))
    for frame in model.frames:
        add(str(frame.name), int(frame.parentJoint), str(frame.type), np.array(frame.placement.homogeneous))
    return digest.hexdigest()


def _motion_subspace(joint: Any, q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Axes of a joint, (6, nv): the only way from Python to the axis of an unaligned one."""
    data = joint.createData()
    joint.calc(data, q)
    return np.array(data.S)


def canonical(item: Any) -> str:
    """Text that is the same for equal recipes only, in every process."""
    if item is None or isinstance(item, bool | int | float | str | bytes):
        return repr(item)
    if isinstance(item, np.ndarray | np.generic):
        # repr would leave out the middle of a long array
        array = np.asarray(item)
        return f"array{array.shape}{array.dtype}{np.ascontiguousarray(array).tobytes().hex()}"
    if isinstance(item, tuple | list):
        return "(" + ",".join(map(canonical, item)) + ")"
    if isinstance(item, dict):
        return "{" + ",".join(sorted(f"{canonical(k)}:{canonical(v)}" for k, v in item.items())) + "}"
    if dataclasses.is_dataclass(item) and not isinstance(item, type):
        parts = {f.name: getattr(item, f.name) for f in dataclasses.fields(item)}
        return f"{type(item).__qualname__}{canonical(parts)}"
    if isinstance(item, enum.Enum):
        return f"{type(item).__qualname__}.{item.name}"
    raise TypeError(
        f"recipe: {type(item).__name__} is not supported; use numbers, text, arrays, tuples or dataclasses"
    )
