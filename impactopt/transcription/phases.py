"""Phases of a contact: how short they may be, and what of a law needs constraints of its own."""

from __future__ import annotations

import numpy as np

from impactopt.contact.laws import ContactLaw
from impactopt.problem.problem import ImpactProblem
from impactopt.transcription.layout import Array

# of the shortest compression that each of the two may last which an event makes of it, and the first of them
# where that may come at once: tiny, as nothing has happened until then, but accelerations are over it
SHARE, AT_ONCE = 0.1, 0.05
# of a phase without a shortest time: share of the natural one, [s] at most, and share of the longest time
OF_NATURAL, LEAST, HALF = 0.15, 2e-3, 0.5
ALIKE = 3.0  # factor between numbers that are


def shortest_phases(problem: ImpactProblem, natural: float) -> list[float]:
    """Least duration [s] of each contact phase; ``natural``: that of a point mass's last phase."""
    target, (shortest, longest) = problem.target, problem.contact_duration
    if not shortest:  # no bound: far below what a blow takes, as constraints are over these times
        shortest = min(OF_NATURAL * natural, LEAST, HALF * longest)
    shares = [SHARE if target.guards else 1.0] * (len(target.phases) - 1) + [1.0]
    if target.at_once:
        shares[0] = AT_ONCE
    return [share * shortest for share in shares]


def alike(numbers: Array, others: Array) -> bool:
    """True if problems with these parameters (k,) can share least durations, as their blows take about as
    long.
    """
    sizes = np.sort(np.abs([numbers, others]), axis=0)
    return bool(np.all(sizes[1] <= ALIKE * sizes[0]))


def switches(law: ContactLaw) -> bool:
    """True if compression and restitution are different branches of the law."""
    compression, restitution, _ = law.formula()
    return bool(compression != restitution)


def pulls_apart(law: ContactLaw) -> bool:
    """True if the law would pull at bodies that separate fast."""
    # hardly any penetration [m], and separation at 10 m/s: a damper without a spring behind it would pull
    return float(law.branch(1e-6, -10.0, False)) < 0
