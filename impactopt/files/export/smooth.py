"""A plan's reference without jumps, for arms whose controllers refuse them: within limits of acceleration and
jerk.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.optimize import linprog

from impactopt.errors import InputError, check_number
from impactopt.problem.problem import ImpactProblem
from impactopt.transcription.plan import Trajectory, complete_reference

__all__ = ["Smoothness", "smoothed"]

Array = NDArray[np.float64]
STEP, PIECES = 2e-3, 3000  # [s] of constant jerk at least, and how many of them there are at most
REST = 0.1  # [s] longer than the plan
NEARBY, WEIGHT = 0.05, 1e3  # [s] before contact in which, and up to its end, a deviation counts so much more
LAG = 0.02  # [s] a position that is off by as much as a speed, times this, costs as much
INSTANTS = 2  # a piece


@dataclass(frozen=True, kw_only=True)
class Smoothness:
    """Limits of every joint: acceleration [rad/s^2] and jerk [rad/s^3]; of slides [m/s^2], [m/s^3].

    Raises
    ------
    InputError : one is no number above 0.
    """

    acceleration: float
    jerk: float

    def __post_init__(self) -> None:
        for name in ("acceleration", "jerk"):
            if not check_number(f"smooth: {name}", getattr(self, name)) > 0:
                raise InputError(f"smooth: {name} has to be above 0")


def smoothed(reference: Trajectory, problem: ImpactProblem, limits: Smoothness) -> Trajectory:
    """The trajectory nearest to a reference whose acceleration is continuous, within limits.

    Joint by joint a linear program: jerks, constant for 2 ms each, that minimize the sum of deviations of
    position and velocity. Deviations before contact and in it cost more, as they cost impulse. It ends 0.1 s
    later. Joints keep their ranges and their speeds. Feed-forward is that of the smoothed motion.

    Raises
    ------
    InputError : the robot stands on soles, which other joints' motions would move; no motion within the
        limits is at rest where the plan is.
    """
    robot, c = problem.robot, problem.coordinates
    if robot.floating:
        raise InputError("smooth: joints of legs cannot be smoothed one by one; it is for bolted robots")
    position = np.unwrap([c.split(q)[0] for q in reference.q], axis=0)
    end = reference.end + REST
    step = max(STEP, end / PIECES)
    pieces = int(np.ceil(end / step))
    nodes = np.linspace(0.0, pieces * step, pieces + 1)
    near = (nodes > reference.contact_start - NEARBY) & (nodes < reference.contact_end)
    parts = [
        _joint(
            name,
            step,
            np.interp(nodes, reference.time, position[:, k]),
            np.interp(nodes, reference.time, reference.v[:, k]),
            np.where(near, WEIGHT, 1.0),
            limits,
            (float(robot.lower[k]), float(robot.upper[k]), float(robot.velocity_limit[k])),
        )
        for k, name in enumerate(robot.joint_names)
    ]
    edges = [reference.contact_start, reference.contact_end]
    fine = np.linspace(0.0, nodes[-1], INSTANTS * (len(nodes) - 1) + 1)
    before, hit, after = (
        np.unique(np.concatenate([fine[(fine > low) & (fine < high)], np.clip([low, high], 0.0, fine[-1])]))
        for low, high in ((0.0, edges[0]), edges, (edges[1], fine[-1]))
    )
    time = np.concatenate([before, hit, after])
    y, yd, ydd = np.stack([_at(time, nodes, *part) for part in parts], axis=-1)
    rows = complete_reference(problem, y, yd, ydd, np.zeros((len(time), 0)), np.zeros(0))
    return Trajectory(
        time=time,
        phase=np.repeat(np.arange(3), [len(before), len(hit), len(after)]),
        **rows._asdict(),
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
    limits: Smoothness,
    own: tuple[float, float, float],
) -> tuple[Array, Array, Array]:
    """Position, velocity and acceleration (k,) of one joint at nodes `step` [s] apart.

    position, velocity (k,) : of the reference there.  weight (k,) : of deviations.  own : the joint's lowest
    and highest position, and its largest speed.
    """
    k, h = len(position), step
    one = sp.identity(k, format="csr")
    here, on = one[:-1], one[1:] - one[:-1]
    # unknowns: position, velocity, acceleration, jerk, and what the first two are off by at most
    kept = sp.bmat(
        [
            [on, -h * here, -(h**2 / 2) * here, -(h**3 / 6) * here, 0 * here, 0 * here],
            [None, on, -h * here, -(h**2 / 2) * here, None, None],
            [None, None, on, -h * here, None, None],
        ]
    )
    off = sp.bmat(
        [
            [one, None, None, None, -one, None],
            [-one, None, 0 * one, 0 * one, -one, None],
            [None, one, None, None, None, -one],
            [None, -one, None, None, None, -one],
        ]
    )
    lowest, highest, fastest = own
    ends = np.zeros(k, dtype=bool)
    ends[[0, -1]] = True
    still = [np.where(ends, 0.0, most) for most in (fastest, limits.acceleration)]
    most = [np.where(ends, position, highest), *still, np.full(k, limits.jerk)]
    least = [np.where(ends, position, lowest), *(-x for x in most[1:])]
    found = linprog(
        np.concatenate([np.zeros(4 * k), weight / LAG, weight]),
        A_ub=off,
        b_ub=np.concatenate([position, -position, velocity, -velocity]),
        A_eq=kept,
        b_eq=np.zeros(3 * (k - 1)),
        bounds=np.column_stack(
            [np.concatenate([*least, np.zeros(2 * k)]), np.concatenate([*most, np.full(2 * k, np.inf)])]
        ),
        method="highs-ds",
    )
    if found.status != 0:
        raise InputError(
            f"smooth: no motion of {name} with at most {limits.acceleration:g} rad/s^2 and {limits.jerk:g} "
            "rad/s^3 ends where the plan does; give larger limits, or plan a longer follow-through"
        )
    q, v, a = found.x[: 3 * k].reshape(3, k)
    return q, v, a


def _at(time: Array, nodes: Array, q: Array, v: Array, a: Array) -> Array:
    """(3, m) Position, velocity, acceleration of a joint at m instants, from those at the nodes."""
    k = np.clip(np.searchsorted(nodes, time, side="right") - 1, 0, len(nodes) - 2)
    t, jerk = time - nodes[k], np.diff(a)[k] / (nodes[1] - nodes[0])
    return np.array(
        [
            q[k] + t * (v[k] + t * (a[k] / 2 + t * jerk / 6)),
            v[k] + t * (a[k] + t * jerk / 2),
            a[k] + t * jerk,
        ]
    )
