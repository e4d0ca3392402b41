"""Contact conditions of the striking point as it meets the target, and balance after the impact.

It touches the target in contact only: not before, and not after if the target stays, or may be slow as its
speed after the impact is bounded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from impactopt.kinematics.operational_space import across, striking_point
from impactopt.kinematics.support import inward_edges, support_polygon
from impactopt.problem.objectives import AngularMomentum
from impactopt.problem.terms import HitCone, HitRegion, TargetSpeed
from impactopt.transcription.builder import Builder
from impactopt.transcription.collision import Collision
from impactopt.transcription.contact_state import ContactState
from impactopt.transcription.layout import Affine, Array, Group, Measure, Place, millimetres
from impactopt.transcription.motion_phase import MotionPhase


def add_balance(
    b: Builder, state: ContactState, after: list[Affine], scenarios: Sequence[Collision]
) -> Group | None:
    """Rows of all states; the angular momentum after the expected target, if an objective asks for it.

    state : at contact, which a missing target leaves.  after : y, y', legs and T after the expected target.
    """
    balance = b.limits.balance
    found = [(after, balance.capture_margin, "after contact")]
    for other in scenarios:
        assert other.scenario is not None
        found.append((other.state_after, other.scenario.capture_margin, f"after contact{other.suffix}"))
    for s in b.problem.scenarios:
        if s.missing:
            slots = [state.y, state.y1, state.legs, state.T]
            found.append((slots, s.capture_margin, f"contact, if {s.name}"))
    inward, offset = inward_edges(support_polygon(b.robot, b.coordinates))
    parameters = [np.column_stack([inward, offset + (m or 0.0)]).ravel() for _, m, _ in found]
    at = b.add_block("balance", [slots for slots, _, _ in found], np.array(parameters))
    k = len(inward)
    wanted = any(isinstance(o, AngularMomentum) for o in b.problem.objectives)
    angular_momentum: Group | None = None
    for i, (_, margin, place) in enumerate(found):
        start = at + i * (k + 4)
        if margin is not None:
            b.rows.add(
                term="capture point",
                place=place,
                components=[f"edge {e}" for e in range(k)],
                outputs=start + np.arange(k),
                lower=0,
                measure=millimetres("outside"),
                whole="",
            )
        slow, still = balance.vertical_speed, balance.angular_momentum
        b.rows.add(
            term="vertical speed",
            place=place,
            components=["z"],
            outputs=np.array([start + k]),
            lower=-slow,
            upper=slow,
            measure=Measure("m/s", 1.0, "too fast"),
        )
        outputs, turning = start + k + 1 + np.arange(3), Measure("N m s", 1.0, "too much")
        if wanted and i == 0:
            angular_momentum = b.lift(
                "angular momentum",
                outputs,
                place=place,
                labels=["x", "y", "z"],
                measure=turning,
                lower=-still,
                upper=still,
            )
            continue
        b.rows.add(
            term="angular momentum",
            place=place,
            components=["x", "y", "z"],
            outputs=outputs,
            lower=-still,
            upper=still,
            measure=turning,
        )
    return angular_momentum


# the striking point stays this far behind the target [m], and less only at this speed [m/s] towards it
# or away from it: what hovers at the plane would touch it between the nodes
CLEARANCE, HASTE = 0.02, 0.04
PARTING = 0.12  # [m/s] away, of a tool in a soft grip: it swings back, in a replay some mm farther
TOO_NEAR = millimetres("too near")
GONE = "target's way after contact"


def rotation_rows(normal: Array) -> Array:
    """(3, 3) rows: the normal and two tangents."""
    return np.vstack([normal, across(normal)])


def _slowest(b: Builder) -> float:
    """Approach speed [m/s]."""
    return 0.05 + float(b.problem.target.speed_before())


def add_touch_rows(b: Builder, state: ContactState) -> None:
    """Hit point, approach speed and incidence, but for what a term of the problem takes the place of; of a
    second striker too.
    """
    for k, block in enumerate(["contact", "second_contact"][: len(b.problem.strikers)]):
        _add_rows(b, state, block, k)


def _add_rows(b: Builder, state: ContactState, block: str, number: int) -> None:
    p, incidence = b.problem, b.limits.incidence
    striker, point = p.contacts[number]
    named = f"{striker} " if number else ""
    at = b.add_block(block, [[state.y, state.y1, state.T]], rotation_rows(p.normal).ravel())
    if p.extra(HitRegion) is None:
        b.rows.add(
            term="hit point",
            place=Place("contact", ""),
            components=[f"{named}{axis}" for axis in "xyz"],
            outputs=at + np.arange(3),
            lower=point,
            upper=point,
            measure=millimetres("away"),
        )
        place = len(b.rows.lower) - 1

        def follow(b: Builder) -> None:
            at = b.problem.contacts[number][1]
            b.rows.bound(place, at, at)

        b.follow(follow)
    b.rows.add(
        term="approach speed",
        place="contact",
        components=[f"{named}normal"],
        outputs=np.array([at + 3]),
        lower=_slowest(b),
        measure=Measure("m/s", 1.0, "too slow"),
    )
    approach = len(b.rows.lower) - 1
    b.follow(lambda b: b.rows.bound(approach, _slowest(b), np.inf))
    if p.extra(HitCone) is None:
        b.rows.add(
            term=incidence.name,
            place="contact",
            components=[f"{named}tangent 1", f"{named}tangent 2"],
            outputs=at + np.array([4, 5]),
            lower=-incidence.speed,
            upper=incidence.speed,
            measure=Measure("m/s", 1.0, "too fast across the normal"),
            whole="",
        )


def add_clearance(b: Builder, swing: MotionPhase, follow: MotionPhase, state: Affine) -> None:
    """Rows at the nodes of the swing, and at those of the follow-through if the target stays or may be slow;
    of all strikers.

    state : of the expected target at separation.
    """
    gone = _gone(b, follow, state)
    for k, block in enumerate(["approach", "second_approach"][: len(b.problem.strikers)]):
        _add_clearance(b, swing, follow, block, k, gone)


def _gone(b: Builder, follow: MotionPhase, state: Affine) -> Affine | None:
    """[m] that the target goes along the normal in the follow-through; None: the striker may follow it."""
    if b.problem.target.stays:
        return Affine.zeros(1)
    if b.problem.extra(TargetSpeed) is None:
        return None

    def numbers(b: Builder) -> Array:
        return np.array(list(b.problem.target.parameters.values()))

    at = b.add_block("target_way", [[state, follow.T[0]]], numbers(b))
    b.follow(lambda b: b.block("target_way").take_parameters(numbers(b)))
    return b.lift(GONE, np.array([at]), place=follow.place_at(1.0), measure=millimetres("off"))[0]


def _add_clearance(
    b: Builder, swing: MotionPhase, follow: MotionPhase, block: str, number: int, gone: Affine | None
) -> None:
    p, before, after, start = b.problem, swing.nodes[:-1], follow.nodes, len(b.rows.lower)
    striker, point = b.problem.contacts[number]
    motions = [swing.at(s)[0] for s in before]
    if gone is not None:
        motions += [follow.at(s)[0] for s in after]
    first = b.add_block(block, [[y] for y in motions], p.normal)
    ahead = float(np.mean(p.swing.duration))
    surface, coming = Affine.constant(float(p.normal @ point)), float(p.target.speed_before())
    for i, s in enumerate(before):
        plane = surface - swing.T[0] * (coming * (1 - s))
        spot = first + i, swing.place_at(s), HASTE * (1 - s) * ahead
        _add_row(b, "no touch before contact", number, spot, plane)
    aparts = [HASTE * (1 - s) * ahead for s in before]
    b.follow(lambda b: _follow(b, number, start, aparts))
    if gone is None:
        return
    # the striker has left the target where it is then, from where it goes on; a nail that coasts on only
    # makes room
    first, place = first + len(before), follow.place_at
    behind = _parting(b, striker) * float(np.mean(p.follow.duration))
    name = f"target left by {striker}" if number else "target left"
    there = b.lift(name, np.array([first]), place=place(0.0), measure=TOO_NEAR)[0]
    spots = [(first + i, place(s), s * behind) for i, s in enumerate(after) if i]
    left = len(b.rows.lower)
    for s, spot in zip(after[1:], spots, strict=True):
        _add_row(b, "no touch after contact", number, spot, there + gone * float(s))
    b.follow(lambda b: _follow(b, number, left, [apart for _, _, apart in spots], planes=False))


def _add_row(b: Builder, term: str, number: int, spot: tuple[int, Place, float], plane: Affine) -> None:
    """``spot``: output, place, distance asked near contact [m]; plane [m]: the target's, along the normal."""
    output, place, apart = spot
    b.rows.add(
        term=term,
        place=place,
        components=[b.problem.contacts[number][0]],
        outputs=np.array([output]),
        affine=-plane,
        upper=-min(_nearest(b, number), apart),
        measure=TOO_NEAR,
    )


def _follow(b: Builder, number: int, start: int, aparts: list[float], *, planes: bool = True) -> None:
    """Rows from ``start`` on, of places with these distances asked near contact [m]; planes: that of the
    target, and not one that is a variable.
    """
    nearest, surface = _nearest(b, number), float(b.problem.normal @ b.problem.contacts[number][1])
    for k, apart in enumerate(aparts, start=start):
        b.rows.bound(k, -np.inf, -min(nearest, apart))
        if planes:
            b.rows.affine[k] = replace(b.rows.affine[k], const=np.full(1, -surface))


def _parting(b: Builder, striker: str) -> float:
    """Least mean speed [m/s] at which a striker goes away from a target that stays."""
    soft = any(tool.name == striker and tool.grip is not None for tool in b.problem.robot.tools)
    return PARTING if soft else HASTE


def _nearest(b: Builder, number: int) -> float:
    """Least distance [m] of a striking point behind the target's plane: at most the distance that it starts
    at.
    """
    p, (striker, point) = b.problem, b.problem.contacts[number]
    at = striking_point(p.robot, striker, p.start_posture)
    return min(CLEARANCE, max(float(p.normal @ (point - at)), 0.0))
