"""The striking point touches the target in contact only: not before, and not after if the target stays."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from impactopt.transcription.layout import Affine, Array
from impactopt.transcription.rows import Place, millimetres

if TYPE_CHECKING:
    from impactopt.transcription.transcription import Transcription

# the striking point stays this far behind the target [m], and less only at this speed [m/s] towards it
# or away from it: what hovers at the plane would touch it between the nodes
CLEARANCE, HASTE = 0.02, 0.04
TOO_NEAR = millimetres("too near")


def add_clearance(t: Transcription) -> None:
    """Rows at the nodes of the swing, and at those of the follow-through if the target stays."""
    p, swing, after = t.problem, t.swing_nodes[:-1], t.follow_nodes
    ways = [t.at(t.swing_control, t.swing_breaks, s)[0] for s in swing]
    if p.target.stays:
        ways += [t.at(t.follow.control, t.follow_breaks, s)[0] for s in after]
    first = t.add_block("approach", [[y] for y in ways], p.normal)
    ahead = float(np.mean(p.swing.duration))
    plane = Affine.constant(float(p.normal @ p.point))
    spots = [(first + i, t.swing_place(s), (1 - s) * ahead) for i, s in enumerate(swing)]
    _rows(t, "no touch before contact", spots, plane)
    if not p.target.stays:
        return
    # the striker has left the target where it is then; a nail that coasts on only makes room
    first, behind, place = first + len(swing), float(np.mean(p.follow.duration)), t.follow.place_at
    there = t.lift("target left", np.array([first]), place=place(0.0), measure=TOO_NEAR)[0]
    spots = [(first + i, place(s), s * behind) for i, s in enumerate(after) if i]
    _rows(t, "no touch after contact", spots, there)


def _rows(t: Transcription, term: str, spots: list[tuple[int, Place, float]], plane: Affine) -> None:
    """``spots``: output, place and time from contact [s]; plane [m]: the target's, along the normal."""
    nearest = min(CLEARANCE, _start_gap(t))
    for output, place, apart in spots:
        t.rows.add(
            term=term,
            place=place,
            components=[t.problem.striker],
            outputs=np.array([output]),
            affine=-plane,
            upper=-min(nearest, HASTE * apart),
            measure=TOO_NEAR,
        )


def _start_gap(t: Transcription) -> float:
    """How far [m] behind the target's plane the striking point starts: it may stay as near as that."""
    p, c = t.problem, t.coordinates
    pin.framesForwardKinematics(c.model, c.data, p.start_posture)
    at: Array = c.data.oMf[c.model.getFrameId(f"striker:{p.striker}")].translation
    return max(float(p.normal @ (p.point - at)), 0.0)
