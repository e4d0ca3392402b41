"""Stance phases of a motion: which soles stand when."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from impactopt.errors import InputError, shortened
from impactopt.kinematics.stance import BothSoles, OneSole, Stance
from impactopt.problem.scenario import Phase
from impactopt.robots.robot import Robot

__all__ = ["StancePhase", "check_stances", "names_of"]


@dataclass(frozen=True, kw_only=True)
class StancePhase:
    """A phase of the motion in which the same soles stand.

    Between two phases soles lift off, or touch down where they stood at the start.

    soles : names of those that stand.
    phase : its duration and its spline. None: the blow falls in it, and its times are those of the problem's
        swing and follow-through.
    """

    soles: tuple[str, ...]
    phase: Phase | None = None

    def __post_init__(self) -> None:
        if (
            not isinstance(self.soles, (tuple, list))
            or not all(isinstance(name, str) for name in self.soles)
            or len(set(self.soles)) != len(self.soles)
        ):
            raise InputError(
                f"a stance phase's soles are a tuple of names, each once, not {shortened(str(self.soles))}"
            )
        object.__setattr__(self, "soles", tuple(self.soles))
        if not self.soles:
            raise InputError("a stance phase has no soles: name those that stand; plans do not jump")
        if self.phase is not None and not isinstance(self.phase, Phase):
            raise InputError(f"a stance phase's phase must be a Phase, not {self.phase!r}")


def names_of(stances: Sequence[StancePhase]) -> str:
    """Soles of each phase in words."""
    return ", then ".join(" and ".join(stance.soles) for stance in stances)


def check_stances(problem: Any) -> None:
    """InputError for stance phases that are no schedule; takes the stance of the one with the blow."""
    given: Any = problem.stances
    if not isinstance(given, (list, tuple)) or not all(isinstance(s, StancePhase) for s in given):
        raise InputError(f"stances must be a tuple of StancePhase, not {given!r}")
    object.__setattr__(problem, "stances", tuple(given))
    stances, robot = problem.stances, problem.robot
    if not stances:
        return
    if not robot.floating:
        raise InputError(f"robot {robot.name!r} has a fixed base, and no soles to lift: leave `stances` out")
    for stance in stances:
        for name in stance.soles:
            robot.sole(name)
    of_blow = [stance for stance in stances if stance.phase is None]
    if len(of_blow) != 1:
        found = "none" if not of_blow else str(len(of_blow))
        raise InputError(
            f"stances: the blow falls in one phase, which has no duration of its own, and {found} of "
            f"{names_of(stances)} is like that: give all others a duration"
        )
    if len(stances) == 1:
        raise InputError("stances: one phase is no schedule: give `stance` in its place")
    for one, other in pairwise(stances):
        a, b = set(one.soles), set(other.soles)
        if not (a < b or b < a):
            raise InputError(
                f"stances: between {' and '.join(one.soles)} and {' and '.join(other.soles)} soles have to "
                "lift off or to touch down, not both: put a phase between in which all of these stand"
            )
    if problem.stance.hand_frames(robot):
        raise InputError("stances: a hand that holds on goes with one stance: leave one of them out")
    if robot.sprung.any():
        raise InputError(f"stances: robot {robot.name!r} has springs, which go with one stance")
    object.__setattr__(problem, "stance", _stance(robot, of_blow[0].soles))


def _stance(robot: Robot, soles: tuple[str, ...]) -> Stance:
    if set(soles) == {sole.name for sole in robot.soles}:
        return BothSoles()
    if len(soles) == 1:
        return OneSole(soles[0])
    raise InputError(f"stances: robot {robot.name!r} stands on one sole or on all, not on {', '.join(soles)}")
