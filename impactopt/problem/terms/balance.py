"""Balance after the impact."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from impactopt.contact.fields import about
from impactopt.errors import InputError
from impactopt.problem.terms.base import Term


@dataclass(frozen=True, kw_only=True)
class Balance(Term):
    """Bounds on the state after the impact, so that the robot does not fall; inf: no bound."""

    name: ClassVar[str] = "balance after impact"
    unit: ClassVar[str] = "m, m/s, N m s"
    capture_margin: float | None = field(
        default=0.02,
        metadata=about(
            'margin of the capture point in the support polygon; "anywhere": no constraint',
            unit="m",
            least=0,
            none="anywhere",
        ),
    )
    vertical_speed: float = field(
        default=0.2,
        metadata=about("largest vertical speed of the centre of mass", unit="m/s", least=0, endless=True),
    )
    angular_momentum: float = field(
        default=10.0,
        metadata=about(
            "largest angular momentum about each axis; inf: any",
            unit="N m s",
            least=0,
            endless=True,
        ),
    )

    def __post_init__(self) -> None:
        if isinstance(self.capture_margin, float) and self.capture_margin == np.inf:
            raise InputError("Balance.capture_margin is inf, which nothing can keep; give None for anywhere")
        super().__post_init__()
