"""The striking point touches the target in contact only: not before, and not after if the target stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from impactopt.kinematics.striking_point import striking_point
from impactopt.transcription.builder import Builder
from impactopt.transcription.layout import Affine
from impactopt.transcription.motion_phase import MotionPhase
from impactopt.transcription.rows import Place, millimetres

# the striking point stays this far behind the target [m], and less only at this speed [m/s] towards it
# or away from it: what hovers at the plane would touch it between the nodes
CLEARANCE, HASTE = 0.02, 0.04
TOO_NEAR = millimetres("too near")


def add_clearance(b: Builder, swing: MotionPhase, follow: MotionPhase) -> None:
    """Rows at the nodes of the swing, and at those of the follow-through if the target stays; of all
    strikers.
    """
    for k, block in enumerate(["approach", "second_approach"][: len(b.problem.strikers)]):
        _add_clearance(b, swing, follow, block, k)


def _add_clearance(b: Builder, swing: MotionPhase, follow: MotionPhase, block: str, number: int) -> None:
    p, before, after, start = b.problem, swing.nodes[:-1], follow.nodes, len(b.rows.lower)
    striker, point = b.problem.contacts[number]
    motions = [swing.at(s)[0] for s in before]
    if p.target.stays:
        motions += [follow.at(s)[0] for s in after]
    first = b.add_block(block, [[y] for y in motions], p.normal)
    ahead = float(np.mean(p.swing.duration))
    surface, coming = Affine.constant(float(p.normal @ point)), float(p.target.speed_before())
    for i, s in enumerate(before):
        plane = surface - swing.T[0] * (coming * (1 - s))
        spots = [(first + i, swing.place_at(s), (1 - s) * ahead)]
        _add_rows(b, "no touch before contact", number, spots, plane)
    aparts = [(1 - s) * ahead for s in before]
    b.follow(lambda b: _follow(b, number, start, aparts))
    if not p.target.stays:
        return
    # the striker has left the target where it is then; a nail that coasts on only makes room
    first, behind, place = first + len(before), float(np.mean(p.follow.duration)), follow.place_at
    name = f"target left by {striker}" if number else "target left"
    there = b.lift(name, np.array([first]), place=place(0.0), measure=TOO_NEAR)[0]
    spots = [(first + i, place(s), s * behind) for i, s in enumerate(after) if i]
    left = len(b.rows.lower)
    _add_rows(b, "no touch after contact", number, spots, there)
    b.follow(lambda b: _follow(b, number, left, [apart for _, _, apart in spots], planes=False))


def _add_rows(
    b: Builder, term: str, number: int, spots: list[tuple[int, Place, float]], plane: Affine
) -> None:
    """``spots``: output, place and time from contact [s]; plane [m]: the target's, along the normal."""
    nearest = _nearest(b, number)
    for output, place, apart in spots:
        b.rows.add(
            term=term,
            place=place,
            components=[b.problem.contacts[number][0]],
            outputs=np.array([output]),
            affine=-plane,
            upper=-min(nearest, HASTE * apart),
            measure=TOO_NEAR,
        )


def _follow(b: Builder, number: int, start: int, aparts: list[float], *, planes: bool = True) -> None:
    """Rows from ``start`` on, of places at these times from contact [s]; planes: that of the target, and not
    one that is a variable.
    """
    nearest, surface = _nearest(b, number), float(b.problem.normal @ b.problem.contacts[number][1])
    for k, apart in enumerate(aparts, start=start):
        b.rows.bound(k, -np.inf, -min(nearest, HASTE * apart))
        if planes:
            b.rows.affine[k] = replace(b.rows.affine[k], const=np.full(1, -surface))


def _nearest(b: Builder, number: int) -> float:
    """How near [m] behind the target's plane a striking point may stay: as near as it starts, at least."""
    p, (striker, point) = b.problem, b.problem.contacts[number]
    at = striking_point(p.robot, striker, p.start_posture)
    return min(CLEARANCE, max(float(p.normal @ (point - at)), 0.0))
