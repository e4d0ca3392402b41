"""Mesh of an NLP: nodes of the motions, collocation points of the contact phases, and nodes to be added.

Limits on torques and sole wrenches are constraints at the nodes only. Between nodes the motion is a spline,
but the torques and wrenches that it needs are not: right after an impact, where accelerations are largest,
the ZMP can leave the soles between two nodes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate, count
from typing import NamedTuple

import numpy as np

from impactopt.arrays import Array, Mask
from impactopt.contact.targets import Target
from impactopt.kinematics.splines import Radau
from impactopt.kinematics.stance import contact_wrench_cone
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import ContactWrenchCone, PositionLimit, TorqueLimit
from impactopt.robots.loads import MIN_LOAD_FRACTION, cop_margin, fading, margin_between_nodes, weight_of
from impactopt.robots.tools import inside
from impactopt.transcription.contact_guess import mass_at_contact, natural_durations
from impactopt.transcription.plan import Piece, Plan, Trajectory, gear_share

# Tolerances between nodes, wider than the constraints at the nodes.
_MARGIN_LOSS = 0.5  # fraction of a margin that may be lost: of torques, normal forces, and joint ranges
_TORQUE_LOSS = 0.01  # of the torque limit; the least tolerance, if the problem leaves no margin
_FRICTION_EXCESS = 1.1  # times the problem's friction coefficient
_CONE_ROUNDING = 1e-6  # of the weight
GEAR = 0.03  # of a gear's limit; also between collocation points


class MoreNodes(NamedTuple):
    """Nodes in addition to the ends and middles of splines' intervals, as fractions of a phase.

    swing, follow : of the swing, and of all motions to rest.
    stands : of each stance phase; empty of the one with the impact.
    contact : whether the collocation points of the contact are nodes for clearance.
    """

    swing: tuple[float, ...] = ()
    follow: tuple[float, ...] = ()
    stands: tuple[tuple[float, ...], ...] = ()
    contact: bool = False

    @property
    def total(self) -> int:
        return len(self.swing) + len(self.follow) + sum(map(len, self.stands))

    def of_stand(self, number: int) -> tuple[float, ...]:
        """Additional nodes of a stance phase without the impact."""
        return self.stands[number] if number < len(self.stands) else ()


NO_MORE = MoreNodes()


def nodes_to_add(plan: Plan, known: MoreNodes) -> MoreNodes:
    """The ``known`` additional nodes, and the middle between any two nodes where the plan violates limits.

    The plan is checked at the instants of its coarse reference. A violation between nodes is

    * a sole that loses more than half of its margin of the centre of pressure, or of the least normal force,
      or uses 10 % more friction than allowed;
    * torques above the limit by more than half of the rest to the motors' maximum;
    * a joint of a closed leg that is too fast, or loses half of its distance from the ends of its range;
    * a gear with 3 % more than its limit.
    """
    blow, found = plan.problem.blow, dict[tuple[int, int], set[float]]()
    for piece in plan.pieces():
        found[piece.phase, piece.number] = set(_middles_violated(plan, plan.coarse_reference, piece))
    if plan.abort is not None:  # the abort motion has the follow-through's nodes
        for piece in plan.pieces(missed=True)[len(plan.before) + 1 :]:
            middles = _middles_violated(plan, plan.coarse_missed_reference, piece)
            # one mesh for both motions to rest, so nodes that either needs
            found[piece.phase, piece.number] |= set(middles)
    stands = [
        {*known.of_stand(k), *(found[0 if k < blow else 2, k] if k != blow else ())}
        for k in range(len(plan.problem.stances))
    ]
    return MoreNodes(
        tuple(sorted({*known.swing, *found[0, blow]})),
        tuple(sorted({*known.follow, *found[2, blow]})),
        tuple(tuple(sorted(places)) for places in stands),
        known.contact,
    )


def _middles_violated(plan: Plan, reference: Trajectory, piece: Piece) -> list[float]:
    """Middles between those neighbouring nodes of a piece between which the reference violates a limit."""
    p, c = plan.problem, plan.problem.stance_coordinates[piece.number]
    own = reference.phase == piece.phase
    if reference.stance.size:
        own &= reference.stance == piece.number
    nodes, duration = piece.nodes, piece.spline.duration
    # without the instants of rest after the motion, which the reference goes on with
    at = np.flatnonzero(own & (reference.time <= piece.start + duration))
    torque = reference.torque[at]
    limit, joints = p.term(TorqueLimit).fraction, slice(c.base, None)
    ratio = np.abs(torque / p.robot.torque_limit).max(axis=1, initial=0.0)
    # halfway from the problem's fraction to the motor's maximum
    violated = ratio > limit + max(_MARGIN_LOSS * (1.0 - limit), _TORQUE_LOSS)
    # Rates and positions of leg joints only: those of others are bounded everywhere by control points.
    violated |= (np.abs(reference.v[at, joints]) > p.robot.velocity_limit)[:, c.dependent].any(axis=1)
    lower, upper = inside(p.robot, _MARGIN_LOSS * p.term(PositionLimit).margin)
    angles = p.robot.ranges.positions(p.robot.joint_positions(reference.q[at]))
    legs = c.dependent[~p.robot.hinges[c.dependent]]  # hinges keep a quarter of their range at the nodes
    constrained_at_nodes = [*legs, *range(p.robot.n, len(lower))]  # leg joints and tendons
    violated |= ((angles < lower) | (angles > upper))[:, constrained_at_nodes].any(axis=1)
    violated |= gear_share(p, torque, reference.a[at, joints]) > 1.0 + GEAR
    violated |= _soles_violated(p, piece.number, reference.sole_wrench[at])
    time = (reference.time[at[violated]] - piece.start) / duration
    # interval of each violated instant: it gets one node, however many of its instants violate something
    between = np.searchsorted(nodes, time, side="right").clip(1, len(nodes) - 1)
    return [float((nodes[k - 1] + nodes[k]) / 2) for k in np.unique(between)]


def _soles_violated(problem: ImpactProblem, number: int, wrenches: Array) -> Mask:
    """Mask (k,) of instants at which a standing sole of a stance phase exceeds its tolerances.

    wrenches (k, 6 a sole) : of all soles of the problem. Friction of a sole that lifts off or touches down in
    the phase is not checked while it carries almost nothing.
    """
    robot, cone = problem.robot, problem.term(ContactWrenchCone)
    least, standing = margin_between_nodes(cone.margin), problem.standing
    on, fades = np.flatnonzero(standing[number]), fading(standing)[number]
    soles, own = problem.soles, wrenches.reshape(len(wrenches), -1, 6)
    violated = (cop_margin(robot, [soles[k].polygon for k in on], own[:, on]) < least).any(axis=1)
    for k in on:
        loaded = own[:, k, 2] >= (MIN_LOAD_FRACTION * weight_of(robot) if fades[k] else -np.inf)
        if not fades[k]:
            violated |= own[:, k, 2] < _MARGIN_LOSS * cone.minimum_force
        friction = _FRICTION_EXCESS * cone.friction
        facets = contact_wrench_cone(soles[k].polygon, friction, margin=max(least, 0.0))
        violated |= loaded & (own[:, k] @ facets.T < -_CONE_ROUNDING * weight_of(robot)).any(axis=1)
    return np.asarray(violated)


Elements = tuple[tuple[float, ...], ...]  # lengths of each phase's collocation elements, as fractions of it
Shares = tuple[float, ...]  # fraction of the contact's time that each phase lasts
_SHORTEST_ELEMENT = 0.1  # of a segment between two freezes


@dataclass(frozen=True)
class CollocationPoint:
    """One collocation point (stage) of the collision.

    In its element, with u the velocity and ' = d/ds, s in [0, 1] in the phase:
    u' = weights . u_members + start u_previous,  and the displacement d grows by quadrature . u_members.
    """

    phase: int
    name: str
    place: float  # s in the phase
    weights: Array  # (stages,)
    start: float
    members: tuple[int, ...]  # indices of this element's stages
    previous: int  # index of the stage that the element starts from, -1 at contact
    quadrature: Array  # (stages,)
    new_phase: bool  # the element begins a phase, so d starts from zero


def collision_mesh(
    elements: Sequence[tuple[float, ...]], radau: Radau, names: Sequence[str] = Target.phases
) -> list[CollocationPoint]:
    """Collocation points of the contact's phases.  elements : their lengths, as fractions of a phase."""
    # u_i = u_start + h sum_j a_ij u'_j, solved for the u'
    inverse = np.linalg.inv(radau.a)
    stages: list[CollocationPoint] = []
    for phase, name in enumerate(names):
        begins = [0.0, *accumulate(elements[phase])]
        # three digits: a short element has several points within one per cent
        digits = digits_of(
            (s + c * h for s, h in zip(begins, elements[phase], strict=False) for c in radau.c), 3, "g"
        )
        for e, (s, h) in enumerate(zip(begins, elements[phase], strict=False)):
            first = len(stages)
            members = tuple(range(first, first + len(radau.c)))
            for i, c in enumerate(radau.c):
                stages.append(
                    CollocationPoint(
                        phase,
                        f"{name}, {percentage(s + c * h, digits, 'g')}",
                        s + c * h,
                        inverse[i] / h,
                        -float(inverse[i].sum()) / h,
                        members,
                        first - 1,
                        radau.a[i] * h,
                        e == 0,
                    )
                )
    return stages


def lagrange(places: Sequence[float], at: float) -> Array:
    """Lagrange polynomials (k,) of k places, evaluated at one place."""
    x = np.asarray(places)
    # prod over j != i of (at - x_j) / (x_i - x_j): ones on both diagonals leave j = i out
    denominators, numerators = x[:, None] - x + np.eye(len(x)), at - x + np.zeros((len(x), 1))
    np.fill_diagonal(numerators, 1.0)
    return np.asarray(np.prod(numerators / denominators, axis=1))


_GAP_ELEMENTS = (0.5, 0.5)  # of a phase in which striker and target are apart, which has no force


def contact_elements(problem: ImpactProblem, shares: Shares = ()) -> Elements:
    """Collocation elements of each phase of a problem's contact.

    They are halved if the target has events, and once more if these have an order of their own, as the force
    then rises and falls in one phase. If an event may come at once, the phase before it is one element. If
    the model is frozen again during contact, each segment between freezes begins with an element.

    shares : of the phases; by default those of a point mass.
    """
    target, (first, last) = problem.target, problem.collision_elements
    if target.guards:
        first, last = halved((first, last))
    if problem.order:
        first, last = halved((first, last))
    phases = problem.contact_phases
    before = [_GAP_ELEMENTS if phase.apart else first for phase in phases[:-1]]
    if target.at_once:
        before[0] = (1.0,)
    own = (*before, _GAP_ELEMENTS if phases[-1].apart else last)
    if problem.freezes < 2:
        return own
    shares = shares or guessed_shares(problem)
    # One freeze lasts for the whole contact, so only two or more have a boundary between them.
    begins = [place_of(k / problem.freezes, shares) for k in range(1, problem.freezes)]
    return tuple(
        _cut(lengths, [s for at, s in begins if at == phase], _SHORTEST_ELEMENT / (problem.freezes * share))
        for phase, (lengths, share) in enumerate(zip(own, shares, strict=True))
    )


def guessed_shares(problem: ImpactProblem) -> Shares:
    """Fraction of the contact's time that each phase lasts when a point mass hits the target."""
    durations = natural_durations(problem.law, problem.target, mass_at_contact(problem))
    return tuple(float(share) for share in durations / durations.sum())


def place_of(fraction: float, shares: Shares) -> tuple[int, float]:
    """Phase index and fraction of that phase, of a fraction of the contact's time."""
    ends = np.cumsum(shares)
    # rounding may put the last end below 1
    phase = min(int(np.searchsorted(ends, fraction)), len(ends) - 1)
    return phase, float((fraction - ends[phase]) / shares[phase] + 1)


def segment_of(phase: int, begin: float, end: float, shares: Shares, freezes: int) -> int:
    """Index of the segment between freezes that contains the middle of an element.

    begin, end : of the element, fractions of its phase.
    """
    before = float(np.cumsum([0.0, *shares])[phase])
    middle = before + shares[phase] * (begin + end) / 2
    return min(int(middle * freezes), freezes - 1)


def _cut(lengths: tuple[float, ...], places: Sequence[float], shortest: float) -> tuple[float, ...]:
    """Element lengths of a phase with additional breaks at these places.

    No break is nearer than ``shortest`` to the phase's ends, and the phase's own breaks nearer than that to
    an additional one are removed.
    """
    added = [s for s in places if shortest < s < 1 - shortest]
    own = [s for s in np.cumsum(lengths)[:-1] if min((abs(s - k) for k in added), default=1.0) > shortest]
    return tuple(float(h) for h in np.diff([0.0, *sorted([*own, *added]), 1.0]))


def halved(elements: Elements) -> Elements:
    """Elements that are each cut into two equal ones."""
    return tuple(tuple(h / 2 for h in lengths for _ in range(2)) for lengths in elements)


def contact_mesh(problem: ImpactProblem, elements: Elements | None = None) -> list[CollocationPoint]:
    """Collocation points of a problem's contact.  elements : by default those of `contact_elements`."""
    radau = Radau.of_stages(problem.collision_stages)
    names = [phase.name for phase in problem.contact_phases]
    return collision_mesh(elements or contact_elements(problem), radau, names)


def percentage(s: float, digits: int, kind: str = "f") -> str:
    """Name of a place on [0, 1].  digits : decimals, or with the kind "g" significant digits."""
    return f"{100 * s:.{digits}{kind}} %"


def digits_of(places: Iterable[float], least: int = 0, kind: str = "f") -> int:
    """Number of digits, at least ``least``, with which the names of different places differ."""
    different = {float(s) for s in places}
    return next(d for d in count(least) if len({percentage(s, d, kind) for s in different}) == len(different))


def with_middles(breaks: Array) -> Array:
    """Breaks and the middles between them, in order."""
    return np.sort(np.concatenate([breaks, (breaks[1:] + breaks[:-1]) / 2]))
