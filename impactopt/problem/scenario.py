"""What else may happen at the impact, and has to be survived."""

from __future__ import annotations

from dataclasses import dataclass, fields

from impactopt.contact.factors import scaled_numbers
from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import Target
from impactopt.errors import MOST, InputError, check_array, check_name


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """A target that differs from the expected one: the same swing has to be safe with it too.

    The impulse to the expected target is what is maximized; in a scenario the collision's rows (torque,
    wrench cones) and the balance after it hold, with margins of their own, under the same reference and
    servo.

    Attributes
    ----------
    name : for reports.
    mass, stiffness, damping : factors of the target's mass and the contact's numbers.
    missing : there is nothing to hit; what the robot has at contact it has to stop by itself.
    brake_after [s] : with ``missing``: a robot that has felt nothing by then after the planned contact goes
        on to a motion to rest that is planned with the swing, not to the follow-through of a blow that was
        none; None: it feels nothing.
    torque : fraction of each joint's limit in the collision.
    cone_margin [m] : of each sole's CoP in the collision.
    capture_margin [m] : of the capture point after it; with ``missing``, of that at contact.

    Raises
    ------
    InputError : no name; a factor that is not positive (damping: negative), a negative margin; ``missing``
        with numbers of a collision.
    """

    name: str
    mass: float = 1.0
    stiffness: float = 1.0
    damping: float = 1.0
    missing: bool = False
    brake_after: float | None = None
    torque: float = 1.0
    cone_margin: float = 0.005
    capture_margin: float = 0.0

    def __post_init__(self) -> None:
        check_name("a scenario", self.name)
        where = f"scenario {self.name!r}"
        for f in fields(self)[1:]:
            value = getattr(self, f.name)
            if value is None and f.default is None:
                continue
            if not check_array(f"{where}: {f.name}", value, (), most=MOST) >= 0:
                raise InputError(f"{where}: {f.name} is {value:g}; give a number >= 0")
        for name in ("mass", "stiffness", "torque"):
            if not getattr(self, name) > 0:
                raise InputError(f"{where}: {name} is {getattr(self, name):g}; give a number > 0")
        changed = [f.name for f in fields(self)[1:] if getattr(self, f.name) != f.default]
        unused = [name for name in changed if name not in ("missing", "brake_after", "capture_margin")]
        if self.missing and unused:
            raise InputError(
                f"{where}: with a target that is missing there is no collision; drop {unused[0]}"
            )
        if self.brake_after is not None and not (self.missing and self.brake_after > 0):
            raise InputError(
                f"{where}: brake_after is a time > 0 s, for a missing target; drop it, or give missing=True"
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
