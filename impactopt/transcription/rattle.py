"""Whether striker and nail rattle: part, and meet again, within a blow that is planned as one contact.

Where contact is much stiffer than what holds a nail, the nail jumps ahead of the hammer, is caught up with
and jumps again. What the wood gets hardly depends on that: momentum and the wood decide it. So a plan holds
the two together while the nail is driven, by the same law, which then may pull for an instant. Here is what
that leaves out, by point masses of the same speed: the law with its gaps, and the law that holds.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp

from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import Target
from impactopt.transcription.at_contact import ContactProgram
from impactopt.transcription.collision import Collision
from impactopt.transcription.guess import effective_mass
from impactopt.transcription.layout import Array

_STEPS = 400  # of the planned contact's duration, at least
_LONGER = 1.5  # than the planned contact, so that all contacts with gaps between them are in it
_WORTH = 1e-3  # of the planned contact's duration: a gap that is told


@dataclass(frozen=True, kw_only=True)
class Rattle:
    """What a plan that holds striker and target together leaves out.

    partings : how often they part and meet again.  peak : largest force [N].  impulse_pct : what the impulse
        of the contact that holds is more by than that of the one with gaps [%].
    """

    partings: int
    peak: float
    impulse_pct: float

    def __str__(self) -> str:
        times = "once" if self.partings == 1 else f"{self.partings} times"
        return (
            f"striker and target part and meet again {times} within the blow, which is planned as one "
            f"contact: by point masses its impulse is {self.impulse_pct:+.2f} % off, and the largest force "
            f"is {self.peak:.0f} N, whatever is planned"
        )


@dataclass(frozen=True, kw_only=True)
class HeldBlow:
    """A planned blow in which striker and target stay together: masses [kg], speed [m/s], duration [s]."""

    law: ContactLaw
    target: Target
    mass: float
    speed: float
    duration: float

    @cached_property
    def rattle(self) -> Rattle | None:
        """What its plan leaves out; None where nothing parts."""
        return rattle_of(self.law, self.target, self.mass, self.speed, self.duration)


def held_blow(t: ContactProgram, x: Array) -> HeldBlow | None:
    """With the expected target of solver variables (n,); None where nothing is held together."""
    hit, c, p = t.hit.expected, t.coordinates, t.problem
    if not isinstance(hit, Collision) or not hit.holds:
        return None
    y, legs, rates = t.contact_state[0].evaluate(x), t.contact_legs.evaluate(x), t.u0.read(x)[0]
    mass, speed = effective_mass(c, p.strikers, p.normal, y, legs, rates)
    return HeldBlow(law=p.law, target=p.target, mass=mass, speed=speed, duration=sum(hit.durations(x)))


def rattle_of(law: ContactLaw, target: Target, mass: float, speed: float, duration: float) -> Rattle | None:
    """Of a point mass [kg] that hits at a speed [m/s], in a contact of about a duration [s]."""
    time, force, impulse = _blow(law, target, mass, speed, duration, holds=False)
    on = np.flatnonzero(force > 0)
    gaps = [time[b] - time[a] for a, b in pairwise(on) if b > a + 1]
    partings = sum(gap > _WORTH * duration for gap in gaps)
    if not partings:
        return None
    held = _blow(law, target, mass, speed, duration, holds=True)[2]
    return Rattle(partings=partings, peak=float(force.max()), impulse_pct=100 * (held / impulse - 1))


def _blow(
    law: ContactLaw, target: Target, mass: float, speed: float, duration: float, *, holds: bool
) -> tuple[Array, Array, float]:
    """Instants (k,) [s], force (k,) [N] and impulse [N s] of all contacts; of one that ``holds`` until the
    target stands.
    """

    def force(y: Array) -> float:
        depth, rate = float(y[1] - y[2]), float(y[0] - target.velocity(y[3:]))
        moves = float(target.velocity(y[3:])) > 0
        return float(law.branch(depth, rate, rate > 0) if holds and moves else law.force(depth, rate))

    def flow(_: float, y: Array) -> list[float]:
        f = force(y)
        return [-f / mass, y[0], float(target.velocity(y[3:])), *map(float, target.derivative(y[3:], f))]

    span = (0.0, _LONGER * duration)
    start = [speed, 0.0, 0.0, *np.zeros(target.n_states)]
    options = {"method": "RK23", "rtol": 1e-5, "atol": 1e-9}  # explicit, as in `guess`
    found = solve_ivp(flow, span, start, max_step=duration / _STEPS, **options)
    forces = np.array([force(y) for y in found.y.T])
    return found.t, forces, mass * (speed - float(found.y[0, -1]))
