"""Phases of a motion: durations and splines; stance phases, with the soles that stand and their steps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations, pairwise
from typing import Any

import numpy as np
import pinocchio as pin

from impactopt.arrays import Array
from impactopt.errors import InputError, check_array, check_number, raw_array, shortened
from impactopt.kinematics.coordinates import LegClosure, StanceCoordinates
from impactopt.kinematics.stance import BothSoles, OneSole, Stance, corners_at, overlap
from impactopt.problem.checks import check_parts
from impactopt.robots.robot import Robot

_DESCENTS = np.arange(0.0, 0.21, 0.02)  # [m] of the base that are tried, in turn, for legs that do not reach
_MAX_STEP = 2.0  # [m]: a longer step is a mistake of units

# [s] of a phase: no servo is faster; an impact's motion takes about a second, and more is milliseconds
SHORTEST, LONGEST = 1e-3, 60.0
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
class StancePhase:
    """Phase of the motion in which the same soles stand.

    Between two phases soles lift off or touch down, where they stood before or a step away.

    soles : names of the soles that stand.
    phase : duration and spline. None: the impact is in this phase, whose durations are those of the problem's
        swing and follow-through.
    steps : by name of a sole that touches down at the phase's beginning: displacement [m] along the world's x
        and y from where it stood before.
    """

    soles: tuple[str, ...]
    phase: Phase | None = None
    steps: Mapping[str, Sequence[float]] = field(default_factory=dict)

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
        if not isinstance(self.steps, Mapping):
            raise InputError(f"a stance phase's steps are a table by sole's name, not {self.steps!r}")
        steps = {
            name: check_array(f"the step of sole {name!r} [m]", step, (2,), most=_MAX_STEP)
            for name, step in self.steps.items()
        }
        object.__setattr__(self, "steps", {name: tuple(step.tolist()) for name, step in steps.items()})


def names_of(stances: Sequence[StancePhase]) -> str:
    """Text with the soles and steps of each phase."""
    return ", then ".join(
        " and ".join(stance.soles)
        + "".join(f" ({name} steps {x:g} m ahead, {y:g} m left)" for name, (x, y) in stance.steps.items())
        for stance in stances
    )


def check_stances(problem: Any) -> None:
    """Checks the sequence of stance phases, and sets the problem's stance to that of the impact.

    Raises
    ------
    InputError : phases that are not a possible sequence, or that the problem's other parts exclude.
    """
    check_parts(problem, "stances", StancePhase)
    stances, robot = problem.stances, problem.robot
    if not stances:
        return
    stance = stance_at_impact(robot, stances)
    if problem.stance.hand_frames(robot):
        raise InputError("stances: a supporting hand goes with one stance: leave one of them out")
    object.__setattr__(problem, "stance", stance)


def impact_phase(stances: Sequence[StancePhase]) -> int:
    """Index of the stance phase with the impact, the one without a duration; 0 without phases."""
    return next((k for k, stance in enumerate(stances) if stance.phase is None), 0)


def stance_at_impact(robot: Robot, stances: Sequence[StancePhase]) -> Stance:
    """Stance of the phase with the impact.

    Raises
    ------
    InputError : phases that are not a possible sequence for this robot.
    """
    if not robot.floating:
        raise InputError(f"robot {robot.name!r} has a fixed base, and no soles to lift: leave `stances` out")
    for stance in stances:
        for name in stance.soles:
            robot.sole(name)
    of_impact = sum(stance.phase is None for stance in stances)
    if of_impact != 1:
        raise InputError(
            f"stances: the impact is in one phase, the only one without a duration, but {of_impact} of "
            f"{names_of(stances)} have none: leave out the duration of this phase, and give one to all others"
        )
    if len(stances) == 1:
        raise InputError("stances: a single phase is no sequence: give `stance` in its place")
    # soles either lift off or touch down between two phases, so that some soles stand in both
    for one, other in pairwise(stances):
        a, b = set(one.soles), set(other.soles)
        if not (a < b or b < a):
            raise InputError(
                f"stances: between {' and '.join(one.soles)} and {' and '.join(other.soles)} soles have to "
                "lift off or to touch down, not both: put a phase between in which all of these stand"
            )
    _check_steps(stances)
    if robot.sprung.any():
        raise InputError(f"stances: robot {robot.name!r} has soft grips, which go with one stance")
    return _stance(robot, stances[impact_phase(stances)].soles)


def _check_steps(stances: Sequence[StancePhase]) -> None:
    """InputError for a step of a sole that does not touch down."""
    for k, stance in enumerate(stances):
        landing = set(stance.soles) - set(stances[k - 1].soles if k else stance.soles)
        for name in stance.steps:
            if name not in landing:
                names = " or ".join(sorted(landing)) or "no sole"
                raise InputError(
                    f"stances: sole {name!r} has a step in phase {k + 1}, on {' and '.join(stance.soles)}, "
                    f"where {names} touches down: give the step to the phase in which it lands"
                )


def places_of_soles(stances: Sequence[StancePhase], names: Sequence[str]) -> Iterator[dict[str, Array]]:
    """Displacements (2,) [m] of each phase's soles from where they stood at the start, by name.

    names : of all soles, in the order of the result.
    """
    moved: dict[str, Array] = {}
    for stance in stances:
        moved |= {name: moved.get(name, np.zeros(2)) + step for name, step in stance.steps.items()}
        yield {name: moved.get(name, np.zeros(2)) for name in names if name in stance.soles}


def phase_coordinates(
    robot: Robot, stances: Sequence[StancePhase], start: Array
) -> tuple[StanceCoordinates, ...]:
    """Independent coordinates of each stance phase.

    start (nq,) : start posture; a phase after steps has the posture of `_stepped_posture`.

    Raises
    ------
    InputError : legs that cannot be closed; steps beyond their reach; soles that overlap.
    """
    # by the names of the soles: where they stand at the start; by names and steps: after these
    known: dict[Any, StanceCoordinates] = {}
    out = []
    for steps in places_of_soles(stances, [sole.name for sole in robot.soles]):
        soles = tuple(robot.sole(name) for name in steps)
        names, key = tuple(steps), tuple((name, *step) for name, step in steps.items())
        if names not in known:
            known[names] = StanceCoordinates(robot, soles, start)
        if key not in known:
            c = known[names]
            if any(step.any() for step in steps.values()):
                c = StanceCoordinates(robot, soles, _stepped_posture(c, steps))
            known[key] = c
        out.append(known[key])
    return tuple(out)


def _stepped_posture(c: StanceCoordinates, moved: Mapping[str, Array]) -> Array:
    """Posture (nq,) of a stance with its soles displaced by ``moved`` (2,) [m].

    The base is displaced by the mean of the soles, and lowered if the legs do not reach.

    Raises
    ------
    InputError : the legs do not reach within their joints' limits; soles overlap.
    """
    placements, corners = [], {}
    for leg in c.legs:
        step = np.append(moved.get(leg.name, np.zeros(2)), 0.0)
        placements.append(pin.SE3(leg.placement.rotation, leg.placement.translation + step))
        if leg.sole is not None:
            corners[leg.name] = corners_at(leg.sole.polygon, placements[-1])[:, :2]
    steps = ", ".join(f"{name} by {np.round(step, 3).tolist()} m" for name, step in moved.items())
    for (one, a), (other, b) in combinations(corners.items(), 2):
        if overlap(a, b):
            raise InputError(f"stances: soles {one} and {other} overlap after steps of {steps}")
    closure = LegClosure(c, placements)
    mean = np.mean([moved.get(leg.name, np.zeros(2)) for leg in c.legs], axis=0)
    lower, upper = c.robot.lower[c.dependent], c.robot.upper[c.dependent]
    for descent in _DESCENTS:
        y = c.start + np.concatenate([mean, [-descent], np.zeros(c.ny - 3)])
        try:
            legs = closure.legs(y, c.start_legs)
        except InputError:
            continue
        if ((lower <= legs) & (legs <= upper)).all():
            return c.join(y, legs)
    raise InputError(f"stances: the legs do not reach soles displaced by steps ({steps}): make them shorter")


def _stance(robot: Robot, soles: tuple[str, ...]) -> Stance:
    if set(soles) == {sole.name for sole in robot.soles}:
        return BothSoles()
    if len(soles) == 1:
        return OneSole(soles[0])
    raise InputError(f"stances: robot {robot.name!r} stands on one sole or on all, not on {', '.join(soles)}")
