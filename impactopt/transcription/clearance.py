"""The striking point touches the target in contact only: not before, and not after if the target stays."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from impactopt.transcription.builder import Builder
from impactopt.transcription.layout import Affine, Array
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
    _add_clearance(b, swing, follow, "approach", b.problem.striker, b.problem.point)
    if (second := b.problem.second) is not None:
        _add_clearance(b, swing, follow, "second_approach", second.striker, second.point)


def _add_clearance(
    b: Builder, swing: MotionPhase, follow: MotionPhase, block: str, striker: str, point: Array
) -> None:
    p, before, after = b.problem, swing.nodes[:-1], follow.nodes
    motions = [swing.at(s)[0] for s in before]
    if p.target.stays:
        motions += [follow.at(s)[0] for s in after]
    first = b.add_block(block, [[y] for y in motions], p.normal)
    ahead = float(np.mean(p.swing.duration))
    surface, coming = Affine.constant(float(p.normal @ point)), float(p.target.speed_before())
    nearest = min(CLEARANCE, _start_gap(b, striker, point))
    for i, s in enumerate(before):
        plane = surface - swing.T[0] * (coming * (1 - s))
        spots = [(first + i, swing.place_at(s), (1 - s) * ahead)]
        _add_rows(b, "no touch before contact", striker, nearest, spots, plane)
    if not p.target.stays:
        return
    # the striker has left the target where it is then; a nail that coasts on only makes room
    first, behind, place = first + len(before), float(np.mean(p.follow.duration)), follow.place_at
    left = "target left" if striker == p.striker else f"target left by {striker}"
    there = b.lift(left, np.array([first]), place=place(0.0), measure=TOO_NEAR)[0]
    spots = [(first + i, place(s), s * behind) for i, s in enumerate(after) if i]
    _add_rows(b, "no touch after contact", striker, nearest, spots, there)


def _add_rows(
    b: Builder, term: str, striker: str, nearest: float, spots: list[tuple[int, Place, float]], plane: Affine
) -> None:
    """``spots``: output, place and time from contact [s]; plane [m]: the target's, along the normal; nearest
    [m]: the striker has not to keep farther off than that.
    """
    for output, place, apart in spots:
        b.rows.add(
            term=term,
            place=place,
            components=[striker],
            outputs=np.array([output]),
            affine=-plane,
            upper=-min(nearest, HASTE * apart),
            measure=TOO_NEAR,
        )


def _start_gap(b: Builder, striker: str, point: Array) -> float:
    """How far [m] behind the target's plane a striking point starts: it may stay as near as that."""
    p, c = b.problem, b.coordinates
    pin.framesForwardKinematics(c.model, c.data, p.start_posture)
    at: Array = c.data.oMf[c.model.getFrameId(f"striker:{striker}")].translation
    return max(float(p.normal @ (point - at)), 0.0)
