"""Measures of a planned motion, as a film of it shows: detours, jerk, work, ground load, first touch."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid, trapezoid

from impactopt.bodies.clearance import Places
from impactopt.problem.problem import ImpactProblem
from impactopt.robots.loads import weight_of
from impactopt.transcription.plan import Plan, Trajectory

__all__ = ["first_touch", "ground_force_share", "motion_measures"]

Array = NDArray[np.float64]
TURN = 0.02  # [rad] by which a joint has to come back for a reversal
LOOK, STEP = 0.05, 2.5e-4  # [s] before contact, and how finely, the striking link is looked at


def motion_measures(problem: ImpactProblem, reference: Trajectory) -> dict[str, Any]:
    """Measures of a reference, by the keys of ``summary.json``.

    idle_travel_rad : sum of what idle joints turn, over the whole motion [rad].
    reversals : median over the joints of how often one turns back by 0.02 rad or more before contact.
    peak_jerk_rad_s3 : largest jerk of a joint in swing and follow-through [rad/s^3].
    work_J : positive mechanical work of all joints before contact [J].
    end_posture_rad : largest distance of a joint from the start posture at the end [rad].
    ground_force_share : least and largest normal force of the ground, over the weight; None without soles.
    """
    robot, n = problem.robot, problem.robot.n
    rate, bend = reference.v[:, -n:], reference.a[:, -n:]
    angle = cumulative_trapezoid(rate, reference.time, axis=0, initial=0.0)
    ends = [robot.joint_positions(reference.q[k]) for k in (0, -1)]
    before = reference.phase == 0
    power = np.maximum(reference.torque * rate, 0.0).sum(axis=1)[before]
    idle = problem.idle_joints
    jerk = [_slope(reference.time[k], bend[k]) for k in (before, reference.phase == 2) if k.sum() > 1]
    turns = [_turns(column) for column in angle[before].T]
    return {
        "idle_travel_rad": float(np.abs(np.diff(angle[:, idle], axis=0)).sum()),
        "reversals": float(np.median(turns)),
        "peak_jerk_rad_s3": float(max((np.abs(j).max() for j in jerk if j.size), default=0.0)),
        "work_J": float(trapezoid(power, reference.time[before])),
        "end_posture_rad": float(np.abs(ends[1] - ends[0]).max()),
        "ground_force_share": ground_force_share(problem, reference.ground[:, 2]),
    }


def first_touch(plan: Plan) -> dict[str, float | None]:
    """First touch of the striking links and the target, by their exact hulls.

    first_touch_mm : how deep a link is in the target when the plan says that contact begins [mm]; < 0: apart.
    first_touch_ms : how much earlier than that they touch [ms].  None: one of them has no body.
    """
    p = plan.problem
    struck = [w for w, body in enumerate(p.world) if body.strikable]
    bodies = p.bodies if struck and p.keeps_apart else None
    pairs = [] if bodies is None else [(j, -1 - w) for j in bodies.striking for w in struck]
    pairs = [pair for pair in pairs if bodies is not None and pair[0] in bodies.links.of_joint]
    if bodies is None or not pairs:
        return {"first_touch_mm": None, "first_touch_ms": None}
    end = plan.contact_start
    time = end - np.arange(0.0, min(LOOK, end), STEP)
    q = plan.closed(plan.independent(0, time)[0][::-1])[::-1]
    at = Places.of(p.robot, q, plan.travel(time), np.zeros(len(time), dtype=np.intp))
    apart = np.array([min(bodies.exact(at, k, pair) for pair in pairs) for k in range(len(time))])
    clear = np.flatnonzero(apart > 0)
    early = time[0] - time[clear[0] - 1] if clear.size and clear[0] else 0.0
    if not clear.size:
        early = time[0] - time[-1]
    return {"first_touch_mm": float(-1e3 * apart[0]), "first_touch_ms": float(1e3 * early)}


def ground_force_share(problem: ImpactProblem, normal: Array) -> list[float] | None:
    """Least and largest of normal forces (k,) [N] of the ground, over the weight; None without soles."""
    if not problem.soles or not len(normal):
        return None
    weight = weight_of(problem.robot)
    return [float(normal.min() / weight), float(normal.max() / weight)]


def _slope(time: Array, values: Array) -> Array:
    """Differences (k - 1, n) over times (k,), without instants that are there twice."""
    step = np.diff(time)
    keep = step > 1e-9
    return np.diff(values, axis=0)[keep] / step[keep, None]


def _turns(angle: Array) -> int:
    """Number of times that an angle (k,) [rad] turns back by `TURN` or more.

    SciPy's `find_peaks` by prominence finds as many, and takes half a second to import.
    """
    turns, way, low, high = 0, 0, angle[0], angle[0]
    for value in angle.tolist():
        low, high = min(low, value), max(high, value)
        now = 1 if value - low >= TURN and way <= 0 else -1 if high - value >= TURN and way >= 0 else 0
        if now:
            turns += way != 0
            way, low, high = now, value, value
    return turns
