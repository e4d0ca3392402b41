"""State at contact that all collisions of a program start from, and parameters of contact law and target.

Also the points at which a program knows the state of joints and drives: nodes, contact and its ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from impactopt.contact.laws import ContactLaw
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.scenario import Scenario
from impactopt.transcription.builder import Builder
from impactopt.transcription.contact_guess import natural_durations
from impactopt.transcription.layout import Affine, Array, Group, Place
from impactopt.transcription.mesh import CollocationPoint

# of the shortest compression that each of the two may last which an event makes of it, and the first of them
# where that may come at once: tiny, as nothing has happened until then, but accelerations are over it
SHARE, AT_ONCE = 0.1, 0.05
SEVERAL = 0.01  # the same of each phase where striker and target part and meet again
# of a phase without a shortest time: share of the natural one, [s] at most, and share of the longest time
OF_NATURAL, LEAST, HALF = 0.15, 2e-3, 0.5
ALIKE = 3.0  # factor between numbers that are


class ContactNumbers:
    """Part of a `impactopt.transcription.collision.Collision`, which has its attributes too.

    law, target : numbers by name.  shortest : least durations [s] of the phases.
    mass : of the robot at its striker [kg].  natural : how long the last phase [s] is of a point mass's blow.
    """

    _b: Builder
    scenario: Scenario | None
    stages: Sequence[CollocationPoint]
    end: list[int]
    T: list[Group]
    mass: float
    law: dict[str, float]
    target: dict[str, float]
    _known: Array

    def renew(self, mass: float | None = None, *, anew: bool = True) -> None:
        """Take the numbers of the builder's problem.

        mass : of the robot at its striker [kg], if it is another.  anew : the least durations too; else those
        are kept where numbers are alike, as they are far below what a blow takes.
        """
        p = self._b.problem
        self.mass = self.mass if mass is None else mass
        self.law, self.target = p.law.parameters, p.target.parameters
        if self.scenario is not None:
            self.law, self.target = self.scenario.numbers(p.law, p.target)
        numbers = np.array([*self.law.values(), *self.target.values(), self.mass])
        if not anew and alike(numbers, self._known):
            return
        self._known = numbers
        # how long the last phase [s] is of a point mass's blow: the unit of what is too short
        self.natural = float(natural_durations(*self.alone(), self.mass, p.planned_touches)[-1])
        self.shortest = shortest_phases(p, self.natural)

    def alone(self) -> tuple[Any, Any]:
        """Law and target as one of all strikers has them, which has its share of a mass."""
        p, numbers = self._b.problem, dict(self.target)
        numbers |= {"mass": numbers["mass"] / len(p.strikers)} if "mass" in numbers else {}
        return type(p.law)(**self.law), type(p.target)(**numbers)

    def follow(self) -> None:
        """Bounds of durations follow the problem."""
        longest = self._b.problem.contact_duration[1]
        for T, least in zip(self.T, self.shortest, strict=True):
            self._b.layout.bound(T, least, longest)

    def force_numbers(self) -> list[list[float]]:
        """Parameters of the block ``force``, of each stage."""
        p = self._b.problem
        modes = np.eye(len(p.target.phases))[[phase.mode for phase in p.contact_phases]]
        phases = np.column_stack([modes, self.shortest])
        within = phases if p.target.guards else phases[:, :0]
        numbers = [*self.law.values(), *self.target.values()]
        numbers += [] if p.second is None else [*p.second.point]
        return [
            [*p.point, *p.normal, float(s.phase == len(self.end) - 1), *within[s.phase], *numbers]
            for s in self.stages
        ]


def shortest_phases(problem: ImpactProblem, natural: float) -> list[float]:
    """Least duration [s] of each contact phase; ``natural``: that of a point mass's last phase."""
    target, (shortest, longest) = problem.target, problem.contact_duration
    if not shortest:  # no bound: far below what a blow takes, as constraints are over these times
        shortest = min(OF_NATURAL * natural, LEAST, HALF * longest)
    shares = [SHARE if target.guards else 1.0] * (len(problem.contact_phases) - 1) + [1.0]
    if problem.planned_touches > 1:
        shares = [SEVERAL] * len(shares)
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


GAINS = "logarithms of factors on gains"


class ContactState(NamedTuple):
    """The state at contact, as a swing or a posture hands it over.

    y, y1, y2 : coordinates, y' and y''.  T : the duration [s] of the phase that they are of: ydot = y'/T.
    legs, w : legs and sole wrenches.
    """

    y: Affine
    y1: Affine
    y2: Affine
    T: Affine
    legs: Affine
    w: Affine


class Coasting(NamedTuple):
    """Reference during contact: the feed-forward torques over limit (n), the rate (ny) ydot, and the
    logarithms of the factors on the servo's gains, one for each of the problem's `gains`.
    """

    feedforward: Group
    u0: Group
    gains: Group


def add_coasting(b: Builder, rates: dict[str, Any] | None = None) -> Coasting:
    """Its variables.  rates : bounds of the rates at contact."""
    limit, names = b.limits.torque.fraction, b.robot.joint_names
    return Coasting(
        b.layout.add("feed-forward at contact", 1, b.robot.n, lower=-limit, upper=limit, labels=names),
        b.layout.add("rate at contact", 1, b.ny, labels=b.coordinates.labels, **(rates or {})),
        _add_gains(b),
    )


def _add_gains(b: Builder) -> Group:
    chosen = b.problem.gains
    if not chosen:
        return Group(GAINS, 0, 1, 0, np.zeros(0), ())
    least, largest = np.log([gain.factor for gain in chosen]).T
    labels = [", ".join(gain.joints) for gain in chosen]
    return b.layout.add(GAINS, 1, len(chosen), lower=least, upper=largest, labels=labels)


class Contact(NamedTuple):
    """State at contact and what coasts from there."""

    state: ContactState
    feedforward: Group
    u0: Group
    gains: Group

    def link(
        self,
        start: tuple[Affine, Affine, Affine],
        times: tuple[Affine, Affine],
        travel: tuple[Affine, Affine],
        rate: Affine,
    ) -> list[list[Affine]]:
        """Slots of the block ``link``, coordinate by coordinate: from the state at contact to a later start.

        start : y and d y/ds of what starts, and its duration [s].  times [s], travel : of two phases between,
        whose ways are time x travel.  rate : ydot after them.
        """
        y, y1, *_ = self.state
        out = []
        for k in range(self.u0.size):
            yk, rk, a, b, one, two, u0, u = (
                e[k : k + 1] for e in (*start[:2], y, y1, *travel, self.u0[0], rate)
            )
            out.append([yk, rk, start[2], a, b, self.state.T, *times, one, two, u0, u])
        return out


class DrivePoint(NamedTuple):
    """State of the drives at a node.

    torque (n,) : of the servos, over limit.  slots : z of `impactopt.problem.block.joint_motion`.
    """

    place: Place
    torque: Affine
    slots: list[Affine]


class ContactEnd(NamedTuple):
    """A contact's two ends.

    before, after : z of `impactopt.problem.block.joint_motion`.  change (ny,) : of ydot.
    """

    place: Place
    before: list[Affine]
    after: list[Affine]
    change: Affine


def still(y: Affine, rate: Affine, slope: Affine, T: Affine, legs: Affine) -> list[Affine]:
    """Slots of a motion at y, with ydot = rate/T and yddot = slope/T^2."""
    none = Affine.zeros(y.size)
    return [y, none, Affine.zeros(1), none, T, rate, slope, T, legs]
