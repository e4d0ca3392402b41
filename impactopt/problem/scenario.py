"""Scenarios of other targets, and a second striker."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np

from impactopt.arrays import Array
from impactopt.contact.fields import Described, about, abouts, described
from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import Target
from impactopt.contact.targets.base import scaled_numbers
from impactopt.errors import (
    FARTHEST,
    InputError,
    check_array,
    check_kind,
    check_name,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class SecondStriker:
    """Another striker that hits the target at its own point.

    Both strikers touch, reach their deepest penetration, and separate at the same instants. Each has its own
    contact with the problem's law. The sum of both forces acts on the target, which moves along the normal
    and does not turn: a door on rails, a guided box, or one that the two forces do not turn.

    Attributes
    ----------
    striker : name of the robot's striker.
    point (3,) [m] : hit point in the world frame.

    Raises
    ------
    InputError : a NaN or a wrong shape.
    """

    striker: str
    point: Array

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, SecondStriker)
            and self.striker == other.striker
            and np.array_equal(self.point, other.point)
        )

    def __hash__(self) -> int:
        return hash((self.striker, self.point.tobytes()))

    def __post_init__(self) -> None:
        check_name("the second striker", self.striker)
        object.__setattr__(
            self, "point", check_array("second striker: point [m]", self.point, (3,), most=FARTHEST)
        )


LONGEST_WAIT = 10.0  # [s] until an abort motion


@dataclass(frozen=True, kw_only=True)
class Scenario(Described):
    """Another target than the expected one, or none, that the robot has to survive with the same swing.

    The objectives are those of the expected target. In a scenario the constraints on the collision (torque,
    wrench cones) and on the balance after it hold too, with their own margins, under the same reference and
    servo. If the target is missing, no impulse slows the robot down, and balance is required at contact. With
    `abort_after` an abort motion follows, which brings the robot to rest and is planned with the swing;
    without it, the follow-through. A plan has one abort motion, so all scenarios that give `abort_after` have
    the same.
    """

    name: str = field(metadata=about("what reports call it"))
    mass: float = described(1.0, "target's mass over the expected mass", above=0)
    stiffness: float = described(1.0, "contact stiffness over the expected one", above=0)
    damping: float = described(1.0, "contact damping over the expected one", least=0)
    missing: bool = described(False, "true: there is nothing to hit")
    abort_after: float | None = described(
        None, "time from the planned contact to the abort motion", unit="s", above=0, most=LONGEST_WAIT
    )
    torque: float = described(1.0, "share of each torque limit in the collision", above=0)
    cone_margin: float = described(
        0.005, "margin of each sole's centre of pressure in the collision", unit="m", least=0
    )
    capture_margin: float = described(0.0, "margin of the capture point after contact", unit="m", least=0)

    def __post_init__(self) -> None:
        check_name("a scenario", self.name)
        where = f"scenario {self.name!r}"
        for f, description in list(abouts(type(self)))[1:]:
            value = getattr(self, f.name)
            if value is None and f.default is None:
                continue
            if isinstance(f.default, bool):
                check_kind(f"{where}: {f.name}", value, bool)
            else:
                unit = f" [{description.unit}]" if description.unit else ""
                description.checked(f"{where}: {f.name}{unit}", value)
        changed = [f.name for f in fields(self)[1:] if getattr(self, f.name) != f.default]
        unused = [name for name in changed if name not in ("missing", "abort_after", "capture_margin")]
        if self.missing and unused:
            raise InputError(
                f"{where}: with a target that is missing there is no collision; drop {unused[0]}"
            )
        if self.abort_after is not None and not self.missing:
            raise InputError(f"{where}: abort_after is for a missing target; drop it, or give missing=True")

    def numbers(self, law: ContactLaw, target: Target) -> tuple[dict[str, float], dict[str, float]]:
        """Parameters of the contact law and the target by name, with the scenario's factors.

        Raises
        ------
        InputError : a factor of a parameter that they do not have.
        """
        return scaled_numbers(
            f"scenario {self.name!r}",
            law,
            target,
            mass=self.mass,
            stiffness=self.stiffness,
            damping=self.damping,
        )

    def __str__(self) -> str:
        factors = [f"{getattr(self, name):g} x {name}" for name in ("mass", "stiffness", "damping")]
        changed = [text for text in factors if not text.startswith("1 x ")]
        return f"{self.name}: {'no target' if self.missing else ', '.join(changed) or 'as expected'}"
