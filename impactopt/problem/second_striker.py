"""A second striker that hits the same target at the same time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.contact.targets import FreeMass, RigidWall
from impactopt.errors import FARTHEST, InputError, check_array, check_name
from impactopt.problem.objectives import PeakForce, Penetration
from impactopt.problem.terms import HitCone, HitRegion, Slide

__all__ = ["SecondStriker", "check_second"]

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class SecondStriker:
    """Another hand that meets the target, at a point of its own.

    Both hands touch at the same instant, are deepest in at the same instant, and leave at the same instant.
    Each has the contact law to itself. The target feels the sum of both forces. It moves along the normal and
    does not turn: a door on rails, a box that is guided, or one that the two forces leave straight.

    Attributes
    ----------
    striker : name of the robot's striker.
    point (3,) [m] : where it meets the target, in the world frame.

    Raises
    ------
    InputError : a NaN or a wrong shape.
    """

    striker: str
    point: Array

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, SecondStriker)
            and self.striker == other.striker
            and np.array_equal(self.point, other.point)
        )

    def __hash__(self) -> int:
        return hash((self.striker, self.point.tobytes()))

    def __post_init__(self) -> None:
        check_name("the second striker", self.striker)
        object.__setattr__(
            self, "point", check_array("second striker: point [m]", self.point, (3,), most=FARTHEST)
        )


def check_second(problem: Any) -> None:
    """InputError for a second striker that does not go with the rest of a problem."""
    p, robot, second = problem, problem.robot, problem.second
    if second is None:
        return
    if not isinstance(second, SecondStriker):
        raise InputError(f"second must be a SecondStriker, not {second!r}")
    mine, its = (set(robot.limb(robot.striker(s).model_frame)) for s in (p.striker, second.striker))
    if not (mine - its and its - mine):
        raise InputError(
            f"the second striker {second.striker!r} moves with {p.striker!r}: give one on a limb of its own"
        )
    if p.collision != "full":
        raise InputError(f'two strikers need collision="full", not {p.collision!r}')
    if not isinstance(p.target, (FreeMass, RigidWall)):
        raise InputError(
            f"two strikers hit a FreeMass or a RigidWall, not a {type(p.target).__name__}, which takes one"
        )
    for thing in (*p.terms, *p.objectives):
        if isinstance(thing, (HitCone, HitRegion, Slide, PeakForce, Penetration)) or (
            getattr(thing, "first_instant", False)
        ):
            raise InputError(f"{type(thing).__name__} is about one striker: leave it out, or the second one")
