"""Phases of a planned contact: what is smooth in each, and what ends it."""

from __future__ import annotations

from dataclasses import dataclass

from impactopt.contact.targets import Target

__all__ = ["SEPARATION", "TOUCH", "TURN", "ContactPhase", "contact_phases"]

TURN, SEPARATION, TOUCH = "end of compression", "separation", "touch"  # ends of phases that no target has


@dataclass(frozen=True)
class ContactPhase:
    """One phase of a contact.

    mode : the target's phase whose motion it has (`impactopt.contact.targets.Target.smooth`).
    end : one of the target's guards, `TURN`, `SEPARATION` or `TOUCH`.
    apart : whether striker and target are apart in it.
    """

    name: str
    mode: int
    end: str
    apart: bool = False


def contact_phases(target: Target, touches: int = 1) -> tuple[ContactPhase, ...]:
    """Phases of a contact in which the striker meets the target so many times.

    With one touch they are the target's. With more, the target's events come in the last touch, and
    compression and restitution are not told apart.
    """
    if touches == 1:
        last = len(target.phases) - 1
        ends = [*target.guards, *[TURN] * (last - len(target.guards)), SEPARATION]
        return tuple(ContactPhase(*each) for each in zip(target.phases, range(last + 1), ends, strict=True))
    out = []
    for k in range(1, touches):
        out.append(ContactPhase(f"touch {k}", 0, SEPARATION))
        out.append(ContactPhase(f"apart after touch {k}", 0, TOUCH, apart=True))
    names = [f"touch {touches}", *(f"touch {touches}, after the {guard}" for guard in target.guards)]
    ends = [*target.guards, SEPARATION]
    return (*out, *(ContactPhase(*each) for each in zip(names, range(len(names)), ends, strict=True)))
