"""Gravity compensation of an MJCF's bodies (`gravcomp`), as one fraction of gravity for the whole robot.

The equations of motion have one gravity vector. Bodies may differ from it whose weight no joint carries, as
above a turntable, or that are so light that their weight hardly matters, as fingers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin

from impactopt.arrays import Array
from impactopt.robots.build import is_floating

# Part of a joint's torque limit that the weight of bodies with another fraction may load it with.
NEGLIGIBLE = 0.05
_ROUNDING = 1e-9  # of the cosine between an axis and gravity


@dataclass(frozen=True, kw_only=True)
class CompensatedBody:
    """A body with a compensated fraction of its weight; centre (3,) [m] : of mass, in its joint's frame."""

    name: str
    joint: int
    mass: float
    centre: Array
    fraction: float


@dataclass(frozen=True, kw_only=True)
class Compensation:
    """Compensated fraction of a robot's weight, and the bodies that have another one.

    loads [N m], [N] : upper bounds, by joint, of the torque by which the weight of these bodies is wrong.
    """

    fraction: float = 0.0
    others: tuple[str, ...] = ()
    loads: Mapping[str, float] = field(default_factory=dict)

    def negligible(self, torque: Mapping[str, float]) -> dict[str, float]:
        """Loads over the torque limits [N m] of the joints, of those that are negligible."""
        shares = {joint: load / torque[joint] for joint, load in self.loads.items() if joint in torque}
        return {joint: share for joint, share in shares.items() if share <= NEGLIGIBLE}


def compensation(model: pin.Model, gravity: Array, bodies: Sequence[CompensatedBody]) -> Compensation:
    """Compensation of a robot with these bodies; gravity (3,) [m/s2], not zero.

    The fraction is that of most of the mass that joints carry; for a robot that floats, of its root.
    """
    lifts, carried = _lifting(model, gravity), dict[float, float]()
    loaded = [body for body in bodies if any(lifts[j] for j in model.supports[body.joint])]
    for body in [body for body in loaded if body.joint == 1] if is_floating(model) else loaded:
        carried[body.fraction] = carried.get(body.fraction, 0.0) + body.mass
    fraction = max(carried, key=lambda one: carried[one], default=0.0)
    others = [body for body in loaded if body.fraction != fraction]
    loads = dict[str, float]()
    for body in others:
        weight = abs(body.fraction - fraction) * body.mass * float(np.linalg.norm(gravity))
        lever, below = float(np.linalg.norm(body.centre)), body.joint
        while below:  # from the body to the root, with the links stretched out
            joint, name = model.joints[below], str(model.names[below])
            slides = "JointModelP" in joint.shortname()
            if lifts[below]:
                loads[name] = loads.get(name, 0.0) + weight * (1.0 if slides else lever)
            if slides:
                low, high = model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q]
                lever += float(max(abs(low), abs(high)))
            lever += float(np.linalg.norm(model.jointPlacements[below].translation))
            below = int(model.parents[below])
    return Compensation(fraction=fraction, others=tuple(body.name for body in others), loads=loads)


def _lifting(model: pin.Model, gravity: Array) -> list[bool]:
    """Mask of the joints that can lift what they move: all but turntables and level slides near the root."""
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    # joints up to which nothing tilts, whatever the posture
    upright, lifts = [True], [False]
    down = gravity / np.linalg.norm(gravity)
    for j in range(1, model.njoints):
        at, above = model.joints[j], upright[int(model.parents[j])]
        axis = np.reshape(data.J, (6, -1))[:, at.idx_v] if at.nv == 1 else np.ones(6)
        slides = at.nv == 1 and not axis[3:].any()
        level = abs(axis[:3] @ down) < _ROUNDING if slides else abs(axis[3:] @ down) > 1 - _ROUNDING
        lifts.append(not (above and at.nv == 1 and level))
        upright.append(above and at.nv == 1 and (slides or level))
    return lifts
