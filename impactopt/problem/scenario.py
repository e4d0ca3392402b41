"""Phases of a motion, scenarios of other targets, and a second striker."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from impactopt.arrays import Array
from impactopt.contact.fields import Described, about, abouts, described, snake_case
from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import FreeMass, RigidWall, Target
from impactopt.contact.targets.base import scaled_numbers
from impactopt.errors import (
    FARTHEST,
    InputError,
    check_array,
    check_kind,
    check_name,
    check_number,
    raw_array,
    shortened,
)
from impactopt.problem.objectives import PeakForce, Penetration
from impactopt.problem.terms import HitCone, HitRegion, Slide


@dataclass(frozen=True, kw_only=True, eq=False)
class SecondStriker:
    """Another striker that hits the target at its own point.

    Both strikers touch, reach their deepest penetration, and separate at the same instants. Each has its own
    contact with the problem's law. The sum of both forces acts on the target, which moves along the normal
    and does not turn: a door on rails, a guided box, or one that the two forces do not turn.

    Attributes
    ----------
    striker : name of the robot's striker.
    point (3,) [m] : hit point in the world frame.

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
    """InputError for a second striker that does not fit the rest of a problem."""
    p, robot, second = problem, problem.robot, problem.second
    if second is None:
        return
    if not isinstance(second, SecondStriker):
        raise InputError(f"second must be a SecondStriker, not {second!r}")
    # each needs a joint that does not move the other
    one, other = (set(robot.limb(robot.striker(s).model_frame)) for s in (p.striker, second.striker))
    if not (one - other and other - one):
        raise InputError(
            f"the second striker {second.striker!r} moves with {p.striker!r}: give one on a limb of its own"
        )
    if p.collision != "full":
        raise InputError(f'two strikers need collision="full", not {p.collision!r}')
    if not isinstance(p.target, (FreeMass, RigidWall)):
        raise InputError(
            f"two strikers hit a FreeMass or a RigidWall, not a {type(p.target).__name__}, which takes one"
        )
    for thing in (*(term for term in p.terms if term.active), *p.objectives):
        if isinstance(thing, (HitCone, HitRegion, Slide, PeakForce, Penetration)) or (
            getattr(thing, "first_instant", False)
        ):
            name, section = type(thing).__name__, "objectives" if thing in p.objectives else "terms"
            raise InputError(
                f"{name}, in a file [{section}.{snake_case(name)}], is for one striker: leave it out, or the "
                "second one"
            )


# [s] of a phase: no servo is faster; an impact's motion takes about a second, and more is milliseconds
SHORTEST, LONGEST = 1e-3, 60.0
LONGEST_WAIT = 10.0  # [s] until an abort motion
# intervals of a phase: with the middles of the intervals, a swing of 1 s has nodes at 4 kHz, as a fast servo
FINEST = 2000
STEEPEST = 1e3  # grading


@dataclass(frozen=True, kw_only=True)
class Phase:
    """Phase of the motion: duration and spline.

    ``duration`` [s] : (shortest, longest), or one number.  ``intervals`` : number of the spline's intervals.
    ``grading`` : longest interval over the shortest one; the short ones are at the contact. The program's
    nodes are the ends and the middles of the intervals.
    """

    duration: tuple[float, float]
    intervals: int = 12
    grading: float = 3.0

    def __post_init__(self) -> None:
        one = raw_array("a phase's duration [s]", self.duration).ndim == 0
        given: Any = (self.duration,) * 2 if one else self.duration
        duration = check_array("a phase's duration [s]", given, (None,)).tolist()
        if len(duration) != 2 or not SHORTEST <= duration[0] <= duration[1] <= LONGEST:
            doubt = "; is it in milliseconds?" if max(duration, default=0.0) > LONGEST else ""
            raise InputError(
                f"a phase's duration [s] is a number of {SHORTEST:g} to {LONGEST:g} or (shortest, longest), "
                f"not {shortened(str(self.duration))}{doubt}"
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

    The objectives are those of the expected target. In a scenario the constraints on the collision (torque,
    wrench cones) and on the balance after it hold too, with their own margins, under the same reference and
    servo. If the target is missing, no impulse slows the robot down, and balance is required at contact. With
    `abort_after` an abort motion follows, which brings the robot to rest and is planned with the swing;
    without it, the follow-through. A plan has one abort motion, so all scenarios that give `abort_after` have
    the same.
    """

    name: str = field(metadata=about("what reports call it"))
    mass: float = described(1.0, "target's mass over the expected mass", above=0)
    stiffness: float = described(1.0, "contact stiffness over the expected one", above=0)
    damping: float = described(1.0, "contact damping over the expected one", least=0)
    missing: bool = described(False, "true: there is nothing to hit")
    abort_after: float | None = described(
        None, "time from the planned contact to the abort motion", unit="s", above=0, most=LONGEST_WAIT
    )
    torque: float = described(1.0, "share of each torque limit in the collision", above=0)
    cone_margin: float = described(
        0.005, "margin of each sole's centre of pressure in the collision", unit="m", least=0
    )
    capture_margin: float = described(0.0, "margin of the capture point after contact", unit="m", least=0)

    def __post_init__(self) -> None:
        check_name("a scenario", self.name)
        where = f"scenario {self.name!r}"
        for f, description in list(abouts(type(self)))[1:]:
            value = getattr(self, f.name)
            if value is None and f.default is None:
                continue
            if isinstance(f.default, bool):
                check_kind(f"{where}: {f.name}", value, bool)
            else:
                unit = f" [{description.unit}]" if description.unit else ""
                description.checked(f"{where}: {f.name}{unit}", value)
        changed = [f.name for f in fields(self)[1:] if getattr(self, f.name) != f.default]
        unused = [name for name in changed if name not in ("missing", "abort_after", "capture_margin")]
        if self.missing and unused:
            raise InputError(
                f"{where}: with a target that is missing there is no collision; drop {unused[0]}"
            )
        if self.abort_after is not None and not self.missing:
            raise InputError(f"{where}: abort_after is for a missing target; drop it, or give missing=True")

    def numbers(self, law: ContactLaw, target: Target) -> tuple[dict[str, float], dict[str, float]]:
        """Parameters of the contact law and the target by name, with the scenario's factors.

        Raises
        ------
        InputError : a factor of a parameter that they do not have.
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
