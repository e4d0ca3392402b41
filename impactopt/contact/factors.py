"""Laws and targets that differ from the expected ones by a factor."""

from __future__ import annotations

from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import Target
from impactopt.errors import InputError

__all__ = ["scaled_numbers"]


def scaled_numbers(
    where: str,
    law: ContactLaw,
    target: Target,
    *,
    mass: float = 1.0,
    stiffness: float = 1.0,
    damping: float = 1.0,
) -> tuple[dict[str, float], dict[str, float]]:
    """The contact law's and the target's numbers by name, with factors of some.

    where : what asks for it, for messages.  mass : factor of the target's.  stiffness, damping : of the
        law's.

    Raises
    ------
    InputError : a factor of a number that they do not have.
    """
    of_law, of_target = dict(law.parameters), dict(target.parameters)
    for name, factor, of, numbers in (
        ("stiffness", stiffness, law, of_law),
        ("damping", damping, law, of_law),
        ("mass", mass, target, of_target),
    ):
        if name in numbers:
            numbers[name] *= factor
        elif factor != 1:
            what = "law" if of is law else "target"
            raise InputError(f"{where}: the {what} {type(of).__name__} has no {name}; leave it out")
    return of_law, of_target
