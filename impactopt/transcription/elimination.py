"""Elimination order of the variables that constraints determine, and the constraints that determine them.

Each part of a program says which of its variables constraints determine, and whose `Turn` they are. Two
orders hang on that: which variables go first, as others follow from them; and who takes constraints first,
where a constraint would do for several.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum

from impactopt.solvers.program import Determined
from impactopt.transcription.constraints import Index


class Turn(IntEnum):
    """Order of elimination of determined variables; lower ones are eliminated first."""

    NODE = 0  # legs at a node, and the first sole's wrench
    LIFTED = 1  # what equals outputs of blocks
    RATE = 2  # the rate at contact
    FEEDFORWARD = 3  # the torque that makes the robot coast
    STAGE_LEGS = 4  # legs and reference's legs at a collocation point
    ELEMENT = 5  # motion, force, target and wrenches of an element, one element after the other
    AFTER = 6  # what a collision leaves behind: where a follow-through starts, or a position


_FIRST_CHOICE = (
    Turn.NODE,
    Turn.LIFTED,
    Turn.STAGE_LEGS,
    Turn.ELEMENT,
    Turn.FEEDFORWARD,
    Turn.AFTER,
    Turn.RATE,  # of constraints that a collision's legs and motion have left
)


def determined(turn: Turn, variables: Index, step: int = 0) -> Determined:
    """Variables of one system of constraints.  step : within a turn, those of a lower one go first."""
    return Determined((turn, step), variables)


def by_choice(found: Iterable[Determined]) -> list[Determined]:
    """Determined variables in the order in which they take constraints: by turn, then part by part."""
    return sorted(found, key=lambda each: _FIRST_CHOICE.index(Turn(each.rank[0])))
