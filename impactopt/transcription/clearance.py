"""The striking point touches the target in contact only: not before, and not after if the target stays."""

from __future__ import annotations

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
    p, before, after = b.problem, swing.nodes[:-1], follow.nodes
    motions = [swing.at(s)[0] for s in before]
    if p.target.stays:
        motions += [follow.at(s)[0] for s in after]
    first = b.add_block("approach", [[y] for y in motions], p.normal)
    ahead = float(np.mean(p.swing.duration))
    surface, coming = Affine.constant(float(p.normal @ p.point)), float(p.target.speed_before())
    for i, s in enumerate(before):
        plane = surface - swing.T[0] * (coming * (1 - s))
        _add_rows(b, "no touch before contact", [(first + i, swing.place_at(s), (1 - s) * ahead)], plane)
    if not p.target.stays:
        return
    # the striker has left the target where it is then; a nail that coasts on only makes room
    first, behind, place = first + len(before), float(np.mean(p.follow.duration)), follow.place_at
    there = b.lift("target left", np.array([first]), place=place(0.0), measure=TOO_NEAR)[0]
    spots = [(first + i, place(s), s * behind) for i, s in enumerate(after) if i]
    _add_rows(b, "no touch after contact", spots, there)


def _add_rows(b: Builder, term: str, spots: list[tuple[int, Place, float]], plane: Affine) -> None:
    """``spots``: output, place and time from contact [s]; plane [m]: the target's, along the normal."""
    nearest = min(CLEARANCE, _start_gap(b))
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


def _start_gap(b: Builder) -> float:
    """How far [m] behind the target's plane the striking point starts: it may stay as near as that."""
    p = b.problem
    at = striking_point(p.robot, p.striker, p.start_posture)
    return max(float(p.normal @ (p.point - at)), 0.0)
