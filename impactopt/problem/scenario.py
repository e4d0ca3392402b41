"""Scenarios: other outcomes of the impact, which the robot has to survive."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

from impactopt.contact.fields import Described, about, abouts
from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import Target
from impactopt.contact.targets.base import scaled_numbers
from impactopt.errors import MOST, InputError, check_array, check_name


@dataclass(frozen=True, kw_only=True)
class Scenario(Described):
    """Another target than the expected one, or none, that the robot has to survive with the same swing.

    Objectives are those of the blow on the expected target. In a scenario the collision's rows (torque,
    wrench cones) and the balance after it hold too, with margins of their own, under the same reference and
    servo. If there is nothing to hit, no impulse slows the robot down: the margin of balance is then taken at
    contact. With `abort_after` the robot goes on to an abort motion, which brings it to rest and is planned
    with the swing; without, it follows the follow-through of the blow.
    """

    name: str = field(metadata=about("what reports call it"))
    mass: float = field(default=1.0, metadata=about("target's mass over the expected mass", above=0))
    stiffness: float = field(default=1.0, metadata=about("contact stiffness over the expected one", above=0))
    damping: float = field(default=1.0, metadata=about("contact damping over the expected one", least=0))
    missing: bool = field(default=False, metadata=about("true: there is nothing to hit"))
    abort_after: float | None = field(
        default=None,
        metadata=about(
            "time after the planned contact at which the motion is aborted, to a planned stop",
            unit="s",
            above=0,
        ),
    )
    torque: float = field(
        default=1.0,
        metadata=about("share of each joint's torque limit that may be used in the collision", above=0),
    )
    cone_margin: float = field(
        default=0.005,
        metadata=about(
            "least distance from each sole's centre of pressure to its edges in the collision",
            unit="m",
            least=0,
        ),
    )
    capture_margin: float = field(
        default=0.0,
        metadata=about(
            "least distance from the capture point to the support polygon's edges, after contact",
            unit="m",
            least=0,
        ),
    )

    def __post_init__(self) -> None:
        check_name("a scenario", self.name)
        where = f"scenario {self.name!r}"
        for f, told in list(abouts(type(self)))[1:]:
            value = getattr(self, f.name)
            if value is None and f.default is None:
                continue
            number = check_array(f"{where}: {f.name}", value, (), most=MOST)
            if f.name != "abort_after" and not told.allows(float(number)):
                raise InputError(f"{where}: {f.name} is {value:g}; give a number {told.range}")
        changed = [f.name for f in fields(self)[1:] if getattr(self, f.name) != f.default]
        unused = [name for name in changed if name not in ("missing", "abort_after", "capture_margin")]
        if self.missing and unused:
            raise InputError(
                f"{where}: with a target that is missing there is no collision; drop {unused[0]}"
            )
        if self.abort_after is not None and not (self.missing and self.abort_after > 0):
            raise InputError(
                f"{where}: abort_after is a time > 0 s, for a missing target; drop it, or give missing=True"
            )

    def numbers(self, law: ContactLaw, target: Target) -> tuple[dict[str, float], dict[str, float]]:
        """The contact law's and the target's numbers by name, with the scenario's factors.

        Raises
        ------
        InputError : a factor of a number that they do not have.
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
