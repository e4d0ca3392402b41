"""Phases of a motion, scenarios that the robot has to survive, and a second striker."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.contact.fields import Described, about, abouts
from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import FreeMass, RigidWall, Target
from impactopt.contact.targets.base import scaled_numbers
from impactopt.errors import (
    FARTHEST,
    InputError,
    check_array,
    check_name,
    check_number,
    raw_array,
    shortened,
)
from impactopt.problem.objectives import PeakForce, Penetration
from impactopt.problem.terms import HitCone, HitRegion, Slide

__all__ = ["FINEST", "LONGEST", "SHORTEST", "STEEPEST", "Phase", "Scenario", "SecondStriker", "check_second"]

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


SHORTEST, LONGEST = 1e-3, 1e3  # [s] of a phase: no servo is faster, and no blow is prepared for longer
FINEST = 2000  # intervals of a phase: nodes of a swing of 1 s come as often as a servo of 4 kHz samples
STEEPEST = 1e3  # grading


@dataclass(frozen=True, kw_only=True)
class Phase:
    """A phase of the motion: its duration and its spline.

    ``duration`` [s] : (shortest, longest), or one number.  ``intervals`` : how many the spline has.
    ``grading`` : longest over shortest interval; the short ones are at the contact. The program's nodes are
    the ends and the middles of the intervals.
    """

    duration: tuple[float, float]
    intervals: int = 12
    grading: float = 3.0

    def __post_init__(self) -> None:
        one = raw_array("a phase's duration [s]", self.duration).ndim == 0
        given: Any = (self.duration,) * 2 if one else self.duration
        duration = check_array("a phase's duration [s]", given, (None,)).tolist()
        if len(duration) != 2 or not SHORTEST <= duration[0] <= duration[1] <= LONGEST:
            raise InputError(
                f"a phase's duration [s] is a number of {SHORTEST:g} to {LONGEST:g} or (shortest, longest), "
                f"not {shortened(str(self.duration))}"
            )
        object.__setattr__(self, "duration", tuple(duration))
        object.__setattr__(self, "grading", check_number("a phase's grading", self.grading))
        if not 1 <= self.grading <= STEEPEST:
            raise InputError(f"a phase's grading must be 1 to {STEEPEST:g}, not {self.grading:g}")
        intervals = check_number("a phase's intervals", self.intervals)
        if not 6 <= intervals <= FINEST or intervals != round(intervals):
            raise InputError(
                f"a phase needs 6 to {FINEST} spline intervals, a whole number, not "
                f"{shortened(str(self.intervals))}"
            )
        object.__setattr__(self, "intervals", round(intervals))


@dataclass(frozen=True, kw_only=True)
class Scenario(Described):
    """Another target than the expected one, or none, that the robot has to survive with the same swing.

    Objectives are those of the blow on the expected target. In a scenario the collision's rows (torque,
    wrench cones) and the balance after it hold too, with margins of their own, under the same reference and
    servo. If there is nothing to hit, no impulse slows the robot down: the margin of balance is then taken at
    contact. With `abort_after` the robot goes on to an abort motion, which brings it to rest and is planned
    with the swing; without, it follows the follow-through of the blow.
    """

    name: str = field(metadata=about("what reports call it"))
    mass: float = field(default=1.0, metadata=about("target's mass over the expected mass", above=0))
    stiffness: float = field(default=1.0, metadata=about("contact stiffness over the expected one", above=0))
    damping: float = field(default=1.0, metadata=about("contact damping over the expected one", least=0))
    missing: bool = field(default=False, metadata=about("true: there is nothing to hit"))
    abort_after: float | None = field(
        default=None,
        metadata=about(
            "time from the planned contact to the abort motion",
            unit="s",
            above=0,
        ),
    )
    torque: float = field(
        default=1.0,
        metadata=about("share of each torque limit in the collision", above=0),
    )
    cone_margin: float = field(
        default=0.005,
        metadata=about(
            "margin of each sole's centre of pressure in the collision",
            unit="m",
            least=0,
        ),
    )
    capture_margin: float = field(
        default=0.0,
        metadata=about(
            "margin of the capture point after contact",
            unit="m",
            least=0,
        ),
    )

    def __post_init__(self) -> None:
        check_name("a scenario", self.name)
        where = f"scenario {self.name!r}"
        for f, told in list(abouts(type(self)))[1:]:
            value = getattr(self, f.name)
            if value is None and f.default is None:
                continue
            told.checked(f"{where}: {f.name}", value)
        changed = [f.name for f in fields(self)[1:] if getattr(self, f.name) != f.default]
        unused = [name for name in changed if name not in ("missing", "abort_after", "capture_margin")]
        if self.missing and unused:
            raise InputError(
                f"{where}: with a target that is missing there is no collision; drop {unused[0]}"
            )
        if self.abort_after is not None and not self.missing:
            raise InputError(f"{where}: abort_after is for a missing target; drop it, or give missing=True")

    def numbers(self, law: ContactLaw, target: Target) -> tuple[dict[str, float], dict[str, float]]:
        """The contact law's and the target's numbers by name, with the scenario's factors.

        Raises
        ------
        InputError : a factor of a number that they do not have.
        """
        return scaled_numbers(
            f"scenario {self.name!r}",
            law,
            target,
            mass=self.mass,
            stiffness=self.stiffness,
            damping=self.damping,
        )

    def __str__(self) -> str:
        factors = [f"{getattr(self, name):g} x {name}" for name in ("mass", "stiffness", "damping")]
        changed = [text for text in factors if not text.startswith("1 x ")]
        return f"{self.name}: {'no target' if self.missing else ', '.join(changed) or 'as expected'}"
