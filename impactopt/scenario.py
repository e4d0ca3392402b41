"""What else may happen at the impact, and has to be survived."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from impactopt.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """A target that differs from the expected one: the same swing has to be safe with it too.

    The impulse to the expected target is what is maximized; in a scenario the collision's rows (torque,
    wrench cones) and the balance after it hold, with margins of their own, under the same reference and servo.

    Attributes
    ----------
    name : for reports.
    mass, stiffness, damping : factors of the target's mass and the contact's numbers.
    missing : there is nothing to hit; what the robot has at contact it has to stop by itself.
    torque : fraction of each joint's limit in the collision.
    cone_margin [m] : of each sole's CoP in the collision.
    capture_margin [m] : of the capture point after it; with ``missing``, of that at contact.

    Raises
    ------
    InputError : a factor that is not positive, a negative margin, ``missing`` with factors.
    """

    name: str
    mass: float = 1.0
    stiffness: float = 1.0
    damping: float = 1.0
    missing: bool = False
    torque: float = 1.0
    cone_margin: float = 0.005
    capture_margin: float = 0.0

    def __post_init__(self) -> None:
        where = f"scenario {self.name!r}"
        for f in fields(self)[1:]:
            value = getattr(self, f.name)
            if not (np.isfinite(value) and value >= 0):
                raise InputError(f"{where}: {f.name} is {value}; give a finite number >= 0")
        for name in ("mass", "stiffness", "torque"):
            if not getattr(self, name) > 0:
                raise InputError(f"{where}: {name} is {getattr(self, name):g}; give a number > 0")
        if self.missing and (self.mass, self.stiffness, self.damping) != (1.0, 1.0, 1.0):
            raise InputError(
                f"{where}: a target that is missing has no mass, stiffness or damping; drop them"
            )
