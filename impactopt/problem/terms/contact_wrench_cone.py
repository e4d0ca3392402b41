"""Contact wrench cone of a sole."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from impactopt.contact.fields import about
from impactopt.problem.terms.base import Term


@dataclass(frozen=True, kw_only=True)
class ContactWrenchCone(Term):
    """Each sole's wrench lies in the cone of its corners: centre of pressure, friction and torsion.

    Source: Caron et al. 2015, see :mod:`impactopt.kinematics.stance`. The cone bounds friction, centre
    of pressure and yaw torsion of each sole together: where friction or pressure use it up, less torsion is
    left. So there are no terms for one of them alone.
    """

    name: ClassVar[str] = "contact wrench cone"
    unit: ClassVar[str] = "of weight"
    friction: float = field(
        default=0.6,
        metadata=about("friction coefficient that the plan may use along each axis of the sole", above=0),
    )
    margin: float = field(
        default=0.02,
        metadata=about("least distance from the centre of pressure to the sole's edges", unit="m", least=0),
    )
    collision_margin: float | None = field(
        default=0.02,
        metadata=about(
            'the same in contact; "anywhere": no constraint',
            unit="m",
            least=0,
            none="anywhere",
        ),
    )
    minimum_force: float = field(
        default=50.0, metadata=about("least normal force of each sole", unit="N", least=0)
    )
