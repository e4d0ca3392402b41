"""Limit on the rate of torques."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np

from impactopt.contact.fields import about
from impactopt.problem.terms.base import Term, of_joints
from impactopt.problem.violation import Measure


@dataclass(frozen=True, kw_only=True)
class TorqueRate(Term):
    """The mean rate of each torque from one node to the next is bounded, in swing and follow-through.

    Within an interval a torque may change faster. If the limit is by joint, other joints have no bound.
    """

    name: ClassVar[str] = "torque rate"
    unit: ClassVar[str] = "of limit"
    whole_motion: ClassVar[bool] = True
    needs_torques: ClassVar[bool] = True
    limit: float | Mapping[str, float] = field(
        metadata=about("largest rate, of all or by joint", unit="N m/s", above=0, by_joint=True)
    )

    def add_constraints(self, program: Any) -> None:
        """Add the constraints, which are linear in torques and duration, both variables."""
        names = program.robot.joint_names
        limit = of_joints(self.limit, names)
        joints = np.flatnonzero(np.isfinite(limit))
        rate = limit[joints] / program.robot.torque_limit[joints]
        labels = [names[j] for j in joints]
        for profile in program.torque_profiles():
            steps = zip(pairwise(profile.nodes), pairwise(profile.torques), strict=True)
            for (a, b), (one, two) in steps:
                step, most = (
                    (two - one)[joints],
                    profile.T.apply(np.ones((len(joints), 1))) * (rate * (b - a)),
                )
                place = profile.place_at((a + b) / 2)
                place = replace(place, name=f"{place.name}, from {100 * a:.1f} %")
                for word, sign in (("rising", 1.0), ("falling", -1.0)):
                    program.constraints.add(
                        term=self.name,
                        place=place,
                        components=[f"{label} {word}" for label in labels],
                        affine=step * sign - most,
                        upper=0,
                        measure=[Measure("%", 100 / r, "over its limit", profile.T * (b - a)) for r in rate],
                    )
