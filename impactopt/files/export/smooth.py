"""Smoothing of a reference within limits of acceleration and jerk, for controllers that refuse jumps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.sparse as sp
from scipy.optimize import linprog

from impactopt.arrays import Array
from impactopt.errors import InputError, check_array
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import JointAcceleration, JointJerk
from impactopt.problem.terms.base import of_joints
from impactopt.transcription.plan import Trajectory, complete_reference

MIN_STEP, MAX_STEPS = 2e-3, 3000  # [s] of constant jerk, and their number
EXTRA_TIME = 0.1  # [s] that the smoothed motion is longer
# weight of deviations from so long [s] before contact to its end, where they cost impulse; 1 elsewhere
BEFORE_CONTACT, CONTACT_WEIGHT = 0.05, 1e3
POSITION_TIME = 0.02  # [s]: a position error is weighted as the velocity error position / POSITION_TIME
SAMPLES_PER_STEP = 2


@dataclass(frozen=True, kw_only=True)
class Smoothness:
    """Limits by joint, (n,) each: acceleration [rad/s^2] and jerk [rad/s^3]; of prismatic ones [m/s^2],
    [m/s^3].
    """

    acceleration: Array
    jerk: Array

    @classmethod
    def of(cls, problem: ImpactProblem, given: Literal["terms"] | tuple[float, float]) -> Smoothness:
        """Limits of all joints, or those of the problem's terms.

        Raises
        ------
        InputError : neither two positive numbers nor "terms"; a problem without limits of all joints.
        """
        names = problem.robot.joint_names
        if isinstance(given, str) and given == "terms":  # an array's == is an array
            found = problem.extra(JointAcceleration), problem.extra(JointJerk)
            limits = [of_joints(term.limit, names) for term in found if term is not None]
            if len(limits) < 2 or not np.isfinite(limits).all():
                raise InputError(
                    "smooth: the problem lacks limits of all joints in [terms.joint_acceleration] and "
                    "[terms.joint_jerk]; give them, or two numbers"
                )
            return cls(acceleration=limits[0], jerk=limits[1])
        numbers = check_array("smooth: acceleration and jerk", given, (2,))
        for name, number in zip(("acceleration", "jerk"), numbers, strict=True):
            if not number > 0:
                raise InputError(f"smooth: {name} has to be above 0")
        return cls(acceleration=np.full(len(names), numbers[0]), jerk=np.full(len(names), numbers[1]))

    def __str__(self) -> str:
        acceleration, jerk = (", ".join(f"{x:g}" for x in dict.fromkeys(v)) for v in self.limits)
        return f"at most {acceleration} rad/s^2 and {jerk} rad/s^3"

    @property
    def limits(self) -> tuple[list[float], list[float]]:
        """Accelerations and jerks as lists of the joints."""
        return self.acceleration.tolist(), self.jerk.tolist()


def smoothed(reference: Trajectory, problem: ImpactProblem, limits: Smoothness) -> Trajectory:
    """The trajectory with continuous acceleration nearest to a reference, within limits.

    A linear program for each joint: piecewise constant jerks, for 2 ms each, minimize the weighted sum of
    absolute deviations of position and velocity. Position and velocity limits hold, too. The motion ends
    0.1 s later than the plan; its feed-forward is computed anew.

    Raises
    ------
    InputError : the robot's base is not bolted, which joints smoothed one by one would move; no motion within
        the limits ends at rest where the plan does.
    """
    robot, c = problem.robot, problem.coordinates
    if robot.floating:
        raise InputError(
            "smooth: it is for bolted robots; smoothing the joints one by one would move the base of others"
        )
    position = np.unwrap([c.split(q)[0] for q in reference.q], axis=0)
    end = reference.end + EXTRA_TIME
    step = max(MIN_STEP, end / MAX_STEPS)
    steps = int(np.ceil(end / step))
    nodes = np.linspace(0.0, steps * step, steps + 1)
    near = (nodes > reference.contact_start - BEFORE_CONTACT) & (nodes < reference.contact_end)
    parts = [
        _joint(
            name,
            step,
            np.interp(nodes, reference.time, position[:, k]),
            np.interp(nodes, reference.time, reference.v[:, k]),
            np.where(near, CONTACT_WEIGHT, 1.0),
            (float(limits.acceleration[k]), float(limits.jerk[k])),
            (float(robot.lower[k]), float(robot.upper[k]), float(robot.velocity_limit[k])),
        )
        for k, name in enumerate(robot.joint_names)
    ]
    edges = [reference.contact_start, reference.contact_end]
    fine = np.linspace(0.0, nodes[-1], SAMPLES_PER_STEP * (len(nodes) - 1) + 1)
    # samples of the three phases, with both edges of each: an edge is in two phases
    before, contact, after = (
        np.unique(np.concatenate([fine[(fine > low) & (fine < high)], np.clip([low, high], 0.0, fine[-1])]))
        for low, high in ((0.0, edges[0]), edges, (edges[1], fine[-1]))
    )
    time = np.concatenate([before, contact, after])
    y, yd, ydd = np.stack([_at(time, nodes, *part) for part in parts], axis=-1)
    samples = complete_reference(problem, y, yd, ydd, np.zeros((len(time), 0)), np.zeros(0))
    return Trajectory(
        time=time,
        phase=np.repeat(np.arange(3), [len(before), len(contact), len(after)]),
        **samples._asdict(),
        contact_start=reference.contact_start,
        contact_end=reference.contact_end,
        end=float(nodes[-1]),
    )


def _joint(
    name: str,
    step: float,
    position: Array,
    velocity: Array,
    weight: Array,
    limits: tuple[float, float],
    own: tuple[float, float, float],
) -> tuple[Array, Array, Array]:
    """Smoothed position, velocity and acceleration (k,) of one joint at nodes `step` [s] apart.

    position, velocity (k,) : of the reference there.  weight (k,) : of deviations.  limits : of acceleration
    and jerk.  own : lower and upper position limit, and velocity limit.
    """
    k, h, (acceleration, jerk) = len(position), step, limits
    one = sp.identity(k, format="csr")
    here, increment = one[:-1], one[1:] - one[:-1]
    # Unknowns, (k,) each: position, velocity, acceleration, jerk, bounds of the deviations of position and
    # velocity. Equations: integration over a step of constant jerk.
    integration = sp.bmat(
        [
            [increment, -h * here, -(h**2 / 2) * here, -(h**3 / 6) * here, 0 * here, 0 * here],
            [None, increment, -h * here, -(h**2 / 2) * here, None, None],
            [None, None, increment, -h * here, None, None],
        ]
    )
    # Inequalities: |position - reference| <= bound, and the same of velocity; the velocity's middle Bernstein
    # coefficient within its limit, so that a step's velocity is between its ends too.
    inequalities = sp.bmat(
        [
            [one, None, None, None, -one, None],
            [-one, None, 0 * one, 0 * one, -one, None],
            [None, one, None, None, None, -one],
            [None, -one, None, None, None, -one],
            [None, one, h / 2 * one, None, None, None],
            [None, -one, -h / 2 * one, None, None, None],
        ]
    )
    lowest, highest, fastest = own
    largest = np.concatenate([position, -position, velocity, -velocity, np.full(2 * k, fastest)])
    # at both ends the joint is at rest, at the reference's position
    ends = np.zeros(k, dtype=bool)
    ends[[0, -1]] = True
    at_rest = [np.where(ends, 0.0, most) for most in (fastest, acceleration)]
    upper = [np.where(ends, position, highest), *at_rest, np.full(k, jerk)]
    lower = [np.where(ends, position, lowest), *(-x for x in upper[1:])]
    # In units that make all numbers of order one, and not by the simplex method, which failed on some
    # programs in any units.
    sizes = np.array([POSITION_TIME, 1.0, acceleration, jerk])
    column = np.repeat([*sizes, *sizes[:2]], k)
    equation, inequality = np.repeat(sizes[:3], k - 1), np.repeat(sizes[[0, 1, 1]], 2 * k)
    bounds = np.stack([[*lower, *np.zeros((2, k))], [*upper, *np.full((2, k), np.inf)]])
    found = linprog(
        np.concatenate([np.zeros(4 * k), weight, weight]),
        A_ub=sp.diags(1 / inequality) @ inequalities @ sp.diags(column),
        b_ub=largest / inequality,
        A_eq=sp.diags(1 / equation) @ integration @ sp.diags(column),
        b_eq=np.zeros(3 * (k - 1)),
        bounds=(bounds.reshape(2, -1) / column).T,
        method="highs-ipm",
    )
    if found.status != 0:
        raise InputError(
            f"smooth: no motion of {name} with at most {acceleration:g} rad/s^2 and {jerk:g} "
            "rad/s^3 ends where the plan does; give larger limits, or plan a longer follow-through"
        )
    q, v, a = (column * found.x)[: 3 * k].reshape(3, k)
    return q, v, a


def _at(time: Array, nodes: Array, q: Array, v: Array, a: Array) -> Array:
    """Position, velocity and acceleration (3, m) of a joint at m instants, from those at the nodes."""
    k = np.clip(np.searchsorted(nodes, time, side="right") - 1, 0, len(nodes) - 2)
    t, jerk = time - nodes[k], np.diff(a)[k] / (nodes[1] - nodes[0])
    return np.array(
        [q[k] + t * (v[k] + t * (a[k] / 2 + t * jerk / 6)), v[k] + t * (a[k] + t * jerk / 2), a[k] + t * jerk]
    )
