"""Normal force of the ground on the soles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from impactopt.contact.fields import about
from impactopt.problem.terms.base import Term

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class GroundForce(Term):
    """The soles stay loaded, one by one and in all, and the robot does not land hard.

    The shares hold at the nodes of the motion, and in contact with the expected target. They come beside the
    contact wrench cone, which has no scale: near free fall it is satisfied by a sole that a soft floor no
    longer holds.
    """

    name: ClassVar[str] = "ground force"
    unit: ClassVar[str] = "of weight"
    least: float = field(
        default=0.5,
        metadata=about("least normal force of all soles, as a share of the weight", least=0, most=0.9),
    )
    most: float = field(
        default=1.7,
        metadata=about("largest normal force of all soles, as a share of the weight", least=1.1),
    )
    sole: float = field(
        default=0.1,
        metadata=about("least normal force of each sole, as a share of the weight", least=0, most=0.45),
    )

    def bounds(self, legs: Sequence[Any]) -> tuple[list[str], Array, Array, Array]:
        """Names (k,), matrix (k, 6 a leg), lower and upper bounds (k,) of normal forces over the weight.

        legs : `impactopt.kinematics.coordinates.Leg`; wrenches are in the frames of their soles. All soles
        come first, then each one if there are several; none where all legs are hands that hold on.
        """
        soles = [k for k, leg in enumerate(legs) if leg.sole is not None]
        sets = [("all soles", soles)] if soles else []
        sets += [(legs[k].end, [k]) for k in soles] if len(soles) > 1 else []
        matrix = np.zeros((len(sets), 6 * len(legs)))
        for row, (_, chosen) in zip(matrix, sets, strict=True):
            row[6 * np.array(chosen) + 2] = 1.0
        lower, upper = np.full(len(sets), self.sole), np.full(len(sets), np.inf)
        lower[:1], upper[:1] = self.least, self.most
        return [name for name, _ in sets], matrix, lower, upper

    def shortfall(self, loads: Array, share: float) -> Array:
        """Distance (k,) of normal forces over the weight (k, soles) beyond their ranges; <= 0 within them.

        share : of the least ones that has to be kept. The largest may be exceeded by 1 - share of its
        distance to the weight.
        """
        total = loads.sum(axis=1)
        beyond = [share * self.least - total, total - self.most - (1 - share) * (self.most - 1)]
        if loads.shape[1] > 1:
            beyond.append(share * self.sole - loads.min(axis=1))
        return np.asarray(np.max(beyond, axis=0))
