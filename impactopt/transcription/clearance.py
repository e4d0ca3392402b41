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
    """Rows at the nodes of the swing, and at those of the follow-through if the target stays."""
    p, before, after, start = b.problem, swing.nodes[:-1], follow.nodes, len(b.rows.lower)
    motions = [swing.at(s)[0] for s in before]
    if p.target.stays:
        motions += [follow.at(s)[0] for s in after]
    first = b.add_block("approach", [[y] for y in motions], p.normal)
    ahead = float(np.mean(p.swing.duration))
    surface, coming = Affine.constant(float(p.normal @ p.point)), float(p.target.speed_before())
    for i, s in enumerate(before):
        plane = surface - swing.T[0] * (coming * (1 - s))
        _add_rows(b, "no touch before contact", [(first + i, swing.place_at(s), (1 - s) * ahead)], plane)
    aparts = [(1 - s) * ahead for s in before]
    b.follow(lambda b: _follow(b, start, aparts))
    if not p.target.stays:
        return
    # the striker has left the target where it is then; a nail that coasts on only makes room
    first, behind, place = first + len(before), float(np.mean(p.follow.duration)), follow.place_at
    there = b.lift("target left", np.array([first]), place=place(0.0), measure=TOO_NEAR)[0]
    spots = [(first + i, place(s), s * behind) for i, s in enumerate(after) if i]
    left = len(b.rows.lower)
    _add_rows(b, "no touch after contact", spots, there)
    b.follow(lambda b: _follow(b, left, [apart for _, _, apart in spots], planes=False))


def _add_rows(b: Builder, term: str, spots: list[tuple[int, Place, float]], plane: Affine) -> None:
    """``spots``: output, place and time from contact [s]; plane [m]: the target's, along the normal."""
    nearest = _nearest(b)
    for output, place, apart in spots:
        b.rows.add(
            term=term,
            place=place,
            components=[b.problem.striker],
            outputs=np.array([output]),
            affine=-plane,
            upper=-min(nearest, HASTE * apart),
            measure=TOO_NEAR,
        )


def _follow(b: Builder, start: int, aparts: list[float], *, planes: bool = True) -> None:
    """Rows from number ``start`` on, of places at these times from contact [s]; planes: that of the target,
    and not one that is a variable.
    """
    nearest, surface = _nearest(b), float(b.problem.normal @ b.problem.point)
    for k, apart in enumerate(aparts, start=start):
        b.rows.bound(k, -np.inf, -min(nearest, HASTE * apart))
        if planes:
            b.rows.affine[k] = replace(b.rows.affine[k], const=np.full(1, -surface))


def _nearest(b: Builder) -> float:
    """How near [m] behind the target's plane the striking point may stay: as near as it starts, at least."""
    p = b.problem
    at = striking_point(p.robot, p.striker, p.start_posture)
    return min(CLEARANCE, max(float(p.normal @ (p.point - at)), 0.0))
