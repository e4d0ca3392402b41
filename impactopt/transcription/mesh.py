"""Mesh of a program: breaks of the splines, collocation points of the contact phases; its refinement.

A program holds torques and the ground's wrench to their limits at its nodes. Between two of them the motion
is a spline, and what it needs is not: right after a blow, where accelerations are largest, the ZMP can leave
the soles on its way from one node to the next.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from impactopt.contact.targets import Target
from impactopt.kinematics.splines import Radau
from impactopt.kinematics.support import contact_wrench_cone
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import ContactWrenchCone, PositionLimit, TorqueLimit
from impactopt.robots.loads import BEARS, cop_margin, fading, least_kept, weight_of
from impactopt.robots.tools import inside
from impactopt.transcription.contact_guess import mass_at_contact, natural_durations
from impactopt.transcription.plan import Piece, Plan, Trajectory, gear_share

Array = NDArray[np.float64]
STEP = 1e-3  # [s] at which a motion is looked at: as the servo's reference is sampled
_SHARE, _TORQUE = 0.5, 0.01  # of the room to all torque, and of the limit: what may be given up between nodes
_FRICTION = 1.1  # of the friction coefficient that a plan may use: what it may use between nodes
_ROUNDING = 1e-6  # of the weight, by which a cone's constraints may be off
GEAR = 0.03  # of what a gear may bear: what it may carry more between nodes, or collocation points


class MoreNodes(NamedTuple):
    """Places on [0, 1] of nodes beside the ends and middles of a spline's intervals: of the swing, of all
    ways to rest, and of each stance phase beside the one with the blow.
    """

    swing: tuple[float, ...] = ()
    follow: tuple[float, ...] = ()
    stands: tuple[tuple[float, ...], ...] = ()

    @property
    def total(self) -> int:
        return len(self.swing) + len(self.follow) + sum(map(len, self.stands))

    def of_stand(self, number: int) -> tuple[float, ...]:
        """Places of a stance phase beside the one with the blow."""
        return self.stands[number] if number < len(self.stands) else ()


NO_MORE = MoreNodes()


def nodes_to_add(plan: Plan, known: MoreNodes) -> MoreNodes:
    """Nodes to add: those known, and the middle between two nodes where the plan leaves its limits.

    It is looked at every millisecond. That is where a sole gives up more than half of a margin that it has at
    the nodes: of its centre of pressure to its own edges, or of its least normal force; or uses a tenth more
    friction than it may; where torques give up half of the room to all that the motors have; where a joint of
    a constrained leg is faster than it may be, or gives up half of its distance to a limit; and where a gear
    carries 3 % more than it may.
    """
    blow, found = plan.problem.blow, dict[tuple[int, int], set[float]]()
    for piece in plan.pieces():
        found[piece.phase, piece.number] = set(_middles_outside(plan, plan.reference, piece))
    if plan.abort is not None:
        for piece in plan.pieces(missed=True)[len(plan.before) + 1 :]:
            middles = _middles_outside(plan, plan.missed_reference, piece)
            found[piece.phase, piece.number] |= set(middles)
    stands = [
        {*known.of_stand(k), *(found[0 if k < blow else 2, k] if k != blow else ())}
        for k in range(len(plan.problem.stances))
    ]
    return MoreNodes(
        tuple(sorted({*known.swing, *found[0, blow]})),
        tuple(sorted({*known.follow, *found[2, blow]})),
        tuple(tuple(sorted(places)) for places in stands),
    )


def _middles_outside(plan: Plan, way: Trajectory, piece: Piece) -> list[float]:
    """Middles between nodes between which a piece of a reference is out of its limits."""
    p, c = plan.problem, plan.problem.stance_coordinates[piece.number]
    own = way.phase == piece.phase
    if way.stance.size:
        own &= way.stance == piece.number
    nodes, duration = piece.nodes, piece.spline.duration
    at = np.flatnonzero(own & (way.time <= piece.start + duration))
    limit, joints = p.term(TorqueLimit).fraction, slice(c.base, None)
    ratio = np.abs(way.torque[at] / p.robot.torque_limit).max(axis=1, initial=0.0)
    outside = ratio > limit + max(_SHARE * (1.0 - limit), _TORQUE)
    # the others' positions and rates are bounded by their splines' control points
    outside |= (np.abs(way.v[at, joints]) > p.robot.velocity_limit)[:, c.dependent].any(axis=1)
    lower, upper = inside(p.robot, _SHARE * p.term(PositionLimit).margin)
    angles = p.robot.ranges.positions(p.robot.joint_positions(way.q[at]))
    legs = c.dependent[~p.robot.hinges[c.dependent]]  # hinges keep a quarter of their range at the nodes
    of_nodes = [*legs, *range(p.robot.n, len(lower))]  # and tendons
    outside |= ((angles < lower) | (angles > upper))[:, of_nodes].any(axis=1)
    outside |= gear_share(p, way.torque[at], way.a[at, joints]) > 1.0 + GEAR
    outside |= _soles_outside(p, piece.number, way.sole_wrench[at])
    time = (way.time[at[outside]] - piece.start) / duration
    between = np.searchsorted(nodes, time, side="right").clip(1, len(nodes) - 1)
    return [float((nodes[k - 1] + nodes[k]) / 2) for k in np.unique(between)]


def _soles_outside(problem: ImpactProblem, number: int, wrenches: Array) -> NDArray[np.bool_]:
    """Instants (k,) at which some sole that stands in a stance phase keeps too little of its limits.

    wrenches (k, 6 a sole) : of all soles. One that may bear nothing has no friction to speak of then.
    """
    robot, cone = problem.robot, problem.term(ContactWrenchCone)
    least, standing = least_kept(cone.margin), problem.standing
    on, fades = np.flatnonzero(standing[number]), fading(standing)[number]
    soles, own = problem.soles, wrenches.reshape(len(wrenches), -1, 6)
    outside = (cop_margin(robot, [soles[k].polygon for k in on], own[:, on]) < least).any(axis=1)
    for k in on:
        bears = own[:, k, 2] >= (BEARS * weight_of(robot) if fades[k] else -np.inf)
        if not fades[k]:
            outside |= own[:, k, 2] < _SHARE * cone.minimum_force
        rows = contact_wrench_cone(soles[k].polygon, _FRICTION * cone.friction, margin=max(least, 0.0))
        outside |= bears & (own[:, k] @ rows.T < -_ROUNDING * weight_of(robot)).any(axis=1)
    return np.asarray(outside)


Elements = tuple[tuple[float, ...], ...]  # lengths of each phase's, as fractions of it
Shares = tuple[
    float, ...
]  # of the contact's time that each phase lasts; where something is frozen on the way
SNAP = 0.1  # of a segment between freezes: an element is not shorter


@dataclass(frozen=True)
class CollocationPoint:
    """One collocation point of the collision."""

    phase: int
    phase_name: str
    place: float  # s in the phase
    weights: Array  # (stages,) of this element's stages in u', d u/ds
    start: float  # weight of the element's start value in u'
    members: tuple[int, ...]  # indices of this element's stages
    previous: int  # index of the stage the element starts from, -1 at contact
    quadrature: Array  # (stages,) weights of the element's u in d
    new_phase: bool  # the element begins a phase, so d starts from zero

    @property
    def name(self) -> str:
        return f"{self.phase_name}, {100 * self.place:.3g} %"  # short elements: several within one per cent


def collision_mesh(
    elements: Sequence[tuple[float, ...]], radau: Radau, names: Sequence[str] = Target.phases
) -> list[CollocationPoint]:
    """Stages of the contact's phases; ``elements``: their lengths, as fractions of a phase."""
    inverse = np.linalg.inv(radau.a)
    stages: list[CollocationPoint] = []
    for phase, name in enumerate(names):
        s = 0.0
        for e, h in enumerate(elements[phase]):
            first = len(stages)
            members = tuple(range(first, first + len(radau.c)))
            for i, c in enumerate(radau.c):
                stages.append(
                    CollocationPoint(
                        phase,
                        name,
                        s + c * h,
                        inverse[i] / h,
                        -float(inverse[i].sum()) / h,
                        members,
                        first - 1,
                        radau.a[i] * h,
                        e == 0,
                    )
                )
            s += h
    return stages


def lagrange(places: Sequence[float], at: float) -> Array:
    """Weights (k,) of values at k places in the polynomial through them, at one place."""
    x = np.asarray(places)
    gaps, ahead = x[:, None] - x + np.eye(len(x)), at - x + np.zeros((len(x), 1))
    np.fill_diagonal(ahead, 1.0)
    return np.asarray(np.prod(ahead / gaps, axis=1))


APART = (0.5, 0.5)  # elements of a phase without force


def contact_elements(problem: ImpactProblem, shares: Shares = ()) -> Elements:
    """Elements of each phase of a problem's contact; halved if its target has events, and once more where it
    is met several times, as force rises and falls in one phase then.

    Where an event may come at once, the phase before it is one element. Where something is frozen on the
    way, segments begin with elements; ``shares`` : if the phases' are not those of a point mass.
    """
    target, (first, last) = problem.target, problem.collision_elements
    if target.guards:
        first, last = halved((first, last))
    if problem.planned_touches > 1:
        first, last = halved((first, last))
    before = [APART if phase.apart else first for phase in problem.contact_phases[:-1]]
    if target.at_once:
        before[0] = (1.0,)
    own = (*before, last)
    if problem.freezes < 2:
        return own
    shares = shares or guessed_shares(problem)
    begins = [place_of(k / problem.freezes, shares) for k in range(1, problem.freezes)]
    return tuple(
        _cut(lengths, [s for at, s in begins if at == phase], SNAP / (problem.freezes * share))
        for phase, (lengths, share) in enumerate(zip(own, shares, strict=True))
    )


def guessed_shares(problem: ImpactProblem) -> Shares:
    """Fraction of the contact's time that each phase lasts, as a point mass meets the target."""
    durations = natural_durations(problem.law, problem.target, mass_at_contact(problem), 1)
    return tuple(float(share) for share in durations / durations.sum())


def place_of(fraction: float, shares: Shares) -> tuple[int, float]:
    """Phase, and place in it, of a fraction of the contact's time."""
    ends = np.cumsum(shares)
    phase = min(int(np.searchsorted(ends, fraction)), len(ends) - 1)
    return phase, float((fraction - ends[phase]) / shares[phase] + 1)


def segment_of(phase: int, begin: float, end: float, shares: Shares, freezes: int) -> int:
    """Index of the segment between freezes that an element with these ends belongs to."""
    before = float(np.cumsum([0.0, *shares])[phase])
    middle = before + shares[phase] * (begin + end) / 2
    return min(int(middle * freezes), freezes - 1)


def _cut(lengths: tuple[float, ...], places: Sequence[float], near: float) -> tuple[float, ...]:
    """Elements of a phase, cut at places but where an end is near; ends of its own that are near give way."""
    kept = [s for s in places if near < s < 1 - near]
    own = [s for s in np.cumsum(lengths)[:-1] if min((abs(s - k) for k in kept), default=1.0) > near]
    return tuple(float(h) for h in np.diff([0.0, *sorted([*own, *kept]), 1.0]))


def halved(elements: Elements) -> Elements:
    """Each of them in two."""
    return tuple(tuple(h / 2 for h in lengths for _ in range(2)) for lengths in elements)


def contact_mesh(problem: ImpactProblem, elements: Elements | None = None) -> list[CollocationPoint]:
    """Stages of the contact of a problem; ``elements``: if not those that it asks for."""
    radau = Radau.of_stages(problem.collision_stages)
    names = [phase.name for phase in problem.contact_phases]
    return collision_mesh(elements or contact_elements(problem), radau, names)


def percentage(s: float, more: Collection[float]) -> str:
    """Name of a place on [0, 1]; one of ``more`` has more digits, as others are near it."""
    return f"{100 * s:.2f} %" if s in more else f"{100 * s:.0f} %"


def with_middles(breaks: Array) -> Array:
    """Breaks and the middles between them, in order."""
    return np.sort(np.concatenate([breaks, (breaks[1:] + breaks[:-1]) / 2]))
