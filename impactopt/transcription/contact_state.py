"""State at contact, which all collisions of a program share, and parameters of contact law and target.

Also the points at which a program has the states of joints and drives: nodes, collocation points, and the
ends of a contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from impactopt.arrays import Array
from impactopt.contact.laws import ContactLaw
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.scenario import Scenario
from impactopt.problem.violation import Place, percent
from impactopt.transcription.builder import Builder
from impactopt.transcription.contact_guess import natural_durations
from impactopt.transcription.layout import Affine, Group
from impactopt.transcription.mesh import CollocationPoint

# Least durations of contact phases, as fractions of that of compression or restitution (`contact_duration`).
# Phases into which events split compression may last the first fraction. A first phase whose event may come
# at first touch may last the second: short, as hardly anything happens in it, but not zero, as accelerations
# are divided by its duration.
EVENT_PHASE_FRACTION, IMMEDIATE_PHASE_FRACTION = 0.1, 0.05
ORDER_PHASE_FRACTION = 0.01  # of each phase where events have an order of their own
# Where no least duration is given, it is the least of a fraction of a point mass's restitution, a time [s],
# and a fraction of the longest duration.
# Measured: with fractions of 0.05 to 0.6 arm_planar and punch have the same optimum (33 to 76 and 57
# iterations).
NATURAL_FRACTION, MAX_LEAST_DURATION, LONGEST_FRACTION = 0.15, 2e-3, 0.5
SIMILAR_FACTOR = 3.0  # parameters within this factor share least durations


class ContactParameters:
    """Parameters of one collision's contact law and target, and the least durations of its phases.

    Base of `impactopt.transcription.collision.Collision`, which has more attributes.

    law, target : parameters by name.
    shortest : least durations of the phases [s].
    mass : effective mass of the robot at its striker [kg].
    natural : duration of the last phase of a point mass's contact [s].
    """

    _b: Builder
    scenario: Scenario | None
    stages: Sequence[CollocationPoint]
    end: list[int]
    T: list[Group]
    mass: float
    law: dict[str, float]
    target: dict[str, float]
    _parameters: Array  # for which `natural` and `shortest` were found

    def update_parameters(self, mass: float | None = None, *, anew: bool = True) -> None:
        """Take the parameters of the builder's problem.

        mass : effective mass of the robot at its striker [kg]; None: as before.
        anew : compute the least durations, too. Otherwise they are kept if the parameters are similar, as
            they are far below the duration of an impact.
        """
        p = self._b.problem
        self.mass = self.mass if mass is None else mass
        self.law, self.target = p.law.parameters, p.target.parameters
        if self.scenario is not None:
            self.law, self.target = self.scenario.numbers(p.law, p.target)
        # the natural duration depends on these, beside the number of touches
        parameters = np.array([*self.law.values(), *self.target.values(), self.mass])
        if not anew and similar(parameters, self._parameters):
            return
        self._parameters = parameters
        self.natural = float(natural_durations(*self.per_striker(), self.mass, p.order)[-1])
        self.shortest = shortest_phases(p, self.natural)

    def per_striker(self) -> tuple[Any, Any]:
        """Law and target that one striker meets: two strikers share the target's mass."""
        p, parameters = self._b.problem, dict(self.target)
        if "mass" in parameters:
            parameters["mass"] /= len(p.strikers)
        return type(p.law)(**self.law), type(p.target)(**parameters)

    def update_bounds(self) -> None:
        """Set the bounds of the phases' durations to those of the builder's problem."""
        longest = self._b.problem.contact_duration[1]
        for T, least in zip(self.T, self.shortest, strict=True):
            self._b.layout.bound(T, least, longest)

    def force_parameters(self) -> list[list[float]]:
        """Parameters of the block ``force`` at each stage."""
        p = self._b.problem
        # one-hot mode of each phase of the contact, by which the block selects the target's smooth motion
        modes = np.eye(len(p.target.phases))[[phase.mode for phase in p.contact_phases]]
        phases = np.column_stack([modes, self.shortest])
        within = phases if p.target.guards else phases[:, :0]
        common = [*self.law.values(), *self.target.values()]
        common += [] if p.second is None else [*p.second.point]
        return [
            [*p.point, *p.normal, float(p.contact_phases[s.phase].restituting), *within[s.phase], *common]
            for s in self.stages
        ]


def shortest_phases(problem: ImpactProblem, natural: float) -> list[float]:
    """Least duration of each contact phase [s].

    natural : duration of the last phase of a point mass's contact [s].
    """
    target, (shortest, longest) = problem.target, problem.contact_duration
    if not shortest:  # none is given: far below the duration of an impact, as constraints are divided by it
        shortest = min(NATURAL_FRACTION * natural, MAX_LEAST_DURATION, LONGEST_FRACTION * longest)
    before = EVENT_PHASE_FRACTION if target.guards else 1.0
    fractions = [before] * (len(problem.contact_phases) - 1) + [1.0]
    if problem.order:
        fractions = [ORDER_PHASE_FRACTION] * len(fractions)
    if target.at_once:
        fractions[0] = IMMEDIATE_PHASE_FRACTION
    return [fraction * shortest for fraction in fractions]


def similar(parameters: Array, others: Array) -> bool:
    """True if contacts with these parameters (k,) last about as long, and can share least durations."""
    # in this form, a parameter that is zero is similar to zero only
    sizes = np.sort(np.abs([parameters, others]), axis=0)
    return bool(np.all(sizes[1] <= SIMILAR_FACTOR * sizes[0]))


def pulls_apart(law: ContactLaw) -> bool:
    """True if the law would pull at bodies that separate fast."""
    # penetration of 1e-6 m and separation at 10 m/s: the spring's force is negligible, a damper pulls
    return float(law.branch(1e-6, -10.0, False)) < 0


GAINS = "logarithms of factors on gains"


class ContactState(NamedTuple):
    """State at contact, at the end of a swing or in a strike's posture.

    y, y1, y2 : coordinates, y' and y'', all (ny,).
    T : duration [s] of the phase whose derivatives y1 and y2 are: ydot = y'/T.
    legs, w : joint angles of the constrained legs (nl,), and sole wrenches (6 a sole).
    """

    y: Affine
    y1: Affine
    y2: Affine
    T: Affine
    legs: Affine
    w: Affine


class Coasting(NamedTuple):
    """Reference of the servo during contact, which coasts from the state at contact.

    feedforward : torques over limit (n,).
    u0 : rate ydot (ny,).
    gains : logarithms of the factors on the servo's gains, one for each of the problem's `gains`.
    """

    feedforward: Group
    u0: Group
    gains: Group


def add_coasting(b: Builder, rates: dict[str, Any] | None = None) -> Coasting:
    """Add the variables of the reference.  rates : bounds of the rate at contact."""
    limit, names = b.limits.torque.fraction, b.robot.joint_names
    torque: dict[str, Any] = {"lower": -limit, "upper": limit, "measure": percent("over its limit")}
    return Coasting(
        b.layout.add("feed-forward at contact", 1, b.robot.n, labels=names, **torque),
        b.layout.add("rate at contact", 1, b.ny, labels=b.coordinates.labels, **(rates or {})),
        _add_gains(b),
    )


def _add_gains(b: Builder) -> Group:
    chosen = b.problem.gains
    if not chosen:
        return Group(GAINS, 0, 1, 0, np.zeros(0), ())
    # as a logarithm a factor stays positive, and halving is as far as doubling
    least, largest = np.log([gain.factor for gain in chosen]).T
    labels = [", ".join(gain.joints) for gain in chosen]
    bounds: dict[str, Any] = {"lower": least, "upper": largest, "measure": percent("off")}
    return b.layout.add(GAINS, 1, len(chosen), labels=labels, **bounds)


class Contact(NamedTuple):
    """State at contact and the reference that coasts from there (`Coasting`)."""

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
        """Slots of the block ``link``, coordinate by coordinate, from contact to the start of a later phase.

        start : y, y' and duration [s] of the later phase.
        times, travel : durations [s] of the two phases between, and mean rates (ny,) in them.
        rate : ydot (ny,) after them.
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
    """State of the drives at a node or collocation point.

    torque : of the servos, over limit (n,).
    slots : z of `impactopt.problem.block.joint_motion`.
    """

    place: Place
    torque: Affine
    slots: list[Affine]


class ContactEnd(NamedTuple):
    """Joint motions just before and just after a contact.

    before, after : z of `impactopt.problem.block.joint_motion`.
    change : of ydot (ny,).
    """

    place: Place
    before: list[Affine]
    after: list[Affine]
    change: Affine


def joint_motion_slots(y: Affine, rate: Affine, slope: Affine, T: Affine, legs: Affine) -> list[Affine]:
    """z of `impactopt.problem.block.joint_motion` at y, with ydot = rate/T and yddot = slope/T^2."""
    zero = Affine.zeros(y.size)
    return [y, zero, Affine.zeros(1), zero, T, rate, slope, T, legs]
