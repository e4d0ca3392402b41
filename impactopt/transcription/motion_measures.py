"""Measures of a planned motion: detours, jerk, work, ground load, first touch of the target."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid, trapezoid

from impactopt.bodies.clearance import Places
from impactopt.problem.problem import ImpactProblem
from impactopt.robots.loads import weight_of
from impactopt.transcription.plan import Plan, Trajectory

Array = NDArray[np.float64]
REVERSAL = 0.02  # [rad] by which a joint has to move back to count as a reversal
TOUCH_WINDOW, TOUCH_STEP = 0.05, 2.5e-4  # [s] time before contact that is searched for a touch, and step


def motion_measures(problem: ImpactProblem, reference: Trajectory) -> dict[str, Any]:
    """Measures of a reference, by the keys of ``summary.json``.

    idle_travel_rad : total travel of idle joints over the whole motion [rad].
    reversals : median over the joints of their numbers of reversals by 0.02 rad or more before contact.
    peak_jerk_rad_s3 : largest jerk of a joint in swing and follow-through [rad/s^3].
    work_J : positive mechanical work of all joints before contact [J].
    end_posture_rad : largest distance of a joint at the end from the start posture [rad].
    ground_force_share : least and largest normal force of the ground, over the weight; None without soles.
    """
    robot, n = problem.robot, problem.robot.n
    rate, acceleration = reference.v[:, -n:], reference.a[:, -n:]
    angle = cumulative_trapezoid(rate, reference.time, axis=0, initial=0.0)
    # continuous joints have no angle of their own, but a difference of at most pi
    apart = pin.difference(robot.model, reference.q[0], reference.q[-1])[-n:]
    before = reference.phase == 0
    power = np.maximum(reference.torque * rate, 0.0).sum(axis=1)[before]
    idle = problem.idle_joints
    phases = [k for k in (before, reference.phase == 2) if k.sum() > 1]
    jerk = [_slope(reference.time[k], acceleration[k]) for k in phases]
    reversals = [_reversals(column) for column in angle[before].T]
    return {
        "idle_travel_rad": float(np.abs(np.diff(angle[:, idle], axis=0)).sum()),
        "reversals": float(np.median(reversals)),
        "peak_jerk_rad_s3": float(max((np.abs(j).max() for j in jerk if j.size), default=0.0)),
        "work_J": float(trapezoid(power, reference.time[before])),
        "end_posture_rad": float(np.abs(apart).max()),
        "ground_force_share": ground_force_share(problem, reference.ground[:, 2]),
    }


def first_touch(plan: Plan) -> dict[str, float | None]:
    """First touch of the striking links and the target, by exact distances of their hulls.

    first_touch_mm : penetration of a link into the target at the planned contact [mm]; < 0: a gap.
    first_touch_ms : time from the first touch to the planned contact [ms].
    Both are None if link or target has no body.
    """
    p = plan.problem
    targets = [w for w, body in enumerate(p.world) if body.strikable]
    bodies = p.bodies if targets and p.keeps_apart else None
    pairs = [] if bodies is None else [(j, -1 - w) for j in bodies.striking for w in targets]
    pairs = [pair for pair in pairs if bodies is not None and pair[0] in bodies.links.of_joint]
    if bodies is None or not pairs:
        return {"first_touch_mm": None, "first_touch_ms": None}
    end = plan.contact_start
    time = end - np.arange(0.0, min(TOUCH_WINDOW, end), TOUCH_STEP)  # backward from contact
    q = plan.closed(plan.independent(0, time)[0][::-1])[::-1]  # legs follow continuously forward in time
    at = Places.of(p.robot, q, plan.travel(time), np.zeros(len(time), dtype=np.intp))
    distance = np.array([min(bodies.exact(at, k, pair) for pair in pairs) for k in range(len(time))])
    clear = np.flatnonzero(distance > 0)
    # the last instant that still touches, going back from contact; 0 if bodies are clear there
    early = time[0] - time[clear[0] - 1] if clear.size and clear[0] else 0.0
    if not clear.size:
        early = time[0] - time[-1]
    return {"first_touch_mm": float(-1e3 * distance[0]), "first_touch_ms": float(1e3 * early)}


def ground_force_share(problem: ImpactProblem, normal: Array) -> list[float] | None:
    """Smallest and largest of normal forces (k,) [N], over the weight; None without soles."""
    if not problem.soles or not len(normal):
        return None
    weight = weight_of(problem.robot)
    return [float(normal.min() / weight), float(normal.max() / weight)]


def _slope(time: Array, values: Array) -> Array:
    """Difference quotients (< k, n) of values (k, n) at times (k,), without steps between equal times."""
    # an instant stands twice where the reference jumps, which is no jerk
    step = np.diff(time)
    keep = step > 1e-9
    return np.diff(values, axis=0)[keep] / step[keep, None]


def _reversals(angle: Array) -> int:
    """Number of reversals of an angle (k,) [rad] by `REVERSAL` or more.

    SciPy's `find_peaks` by prominence finds as many, and takes half a second to import.
    """
    count, direction, low, high = 0, 0, angle[0], angle[0]  # direction 0: none yet
    for value in angle.tolist():
        # extremes since the last reversal
        low, high = min(low, value), max(high, value)
        up, down = value - low >= REVERSAL and direction <= 0, high - value >= REVERSAL and direction >= 0
        if up or down:
            count += direction != 0
            direction, low, high = 1 if up else -1, value, value
    return count
