"""Minimum-jerk reach to the target: a baseline without optimization, at the highest speed that the limits
allow.

The robot moves from rest to a posture at the hit point (by inverse kinematics), where the striking point
moves along the normal, and back. Both motions are minimum-jerk polynomials (Flash and Hogan 1985) in the
independent coordinates. The duration of the first is the best of several, that of the second the mean of the
problem's follow-through. The speed is the largest for which both motions keep the limits of position,
velocity and torque and the contact wrench cones, and a replay in full dynamics with the same servo keeps ZMP
and torque inside their limits during and after the impact.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import linprog

from impactopt.arrays import Array
from impactopt.errors import InputError
from impactopt.kinematics.operational_space import static_wrenches
from impactopt.kinematics.splines import quintic
from impactopt.kinematics.stance import contact_wrench_cone
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import ContactWrenchCone, Grip, PositionLimit, TorqueLimit, VelocityLimit
from impactopt.robots.tools import inside
from impactopt.simulation import Simulation, scene_of, simulate_pinocchio
from impactopt.simulation.engines import longest_stable_step
from impactopt.transcription.initial_guess import strike_rates
from impactopt.transcription.plan import Completed, Trajectory, complete_reference


@dataclass(frozen=True, kw_only=True)
class Baseline:
    """Minimum-jerk reach and its replay.

    duration [s] : of the swing.  speed [m/s] : of the striking point at contact, as planned.  reference : of
    the servo.
    """

    duration: float
    speed: float
    reference: Trajectory
    simulation: Simulation
    summary: dict[str, Any]

    @property
    def impulse(self) -> float:
        """Simulated impulse [N s]."""
        return float(self.summary["impulse_Ns"])

    def describe(self) -> dict[str, Any]:
        """Entries of ``summary.json``, all of them simulated except for the swing's duration."""
        return {"method": "minimum jerk", "swing_s": self.duration, **self.summary}


SWING_DURATIONS = (0.6, 0.8, 1.0, 1.3, 1.7)  # [s] that are tried
MIN_SPEED = 0.01  # [m/s] that is tried
SPEED_FACTOR = 0.93  # from a speed whose replay violates the limits to the next one


def minimum_jerk_baseline(
    problem: ImpactProblem, *, fastest: float = 5.0, tolerance: float = 0.02
) -> Baseline:
    """The minimum-jerk reach with the largest impulse.

    fastest [m/s] : largest speed that is tried.  tolerance : of the speed, relative.

    The reach may use the soles up to their edges: with the margins that plans keep it could hardly move.
    All reaches strike in one posture and direction, so the impulse grows with the speed. They are tried by
    falling speed, and the first one whose replay keeps the limits is the result.

    Raises
    ------
    InputError : not even a touch at 1 cm/s keeps the limits; the base floats, or the problem has stance
        phases.
    """
    if problem.floats:
        raise InputError("a minimum-jerk reach gives the base a motion: it has none where nothing holds it")
    if problem.stances:
        raise InputError("a minimum-jerk reach keeps one stance: there is none for stance phases")
    # Queue of (-speed, is_bound, duration), the fastest first. A speed is that of a reach that keeps the
    # limits without contact; or, with is_bound = 1, an upper bound of it.
    # A best-first search: a duration is bisected only while its upper bound is the
    # largest value in the queue.
    reaches = [(-fastest, 1, duration) for duration in SWING_DURATIONS]
    heapq.heapify(reaches)
    while reaches:
        negative, is_bound, duration = heapq.heappop(reaches)
        speed = -negative
        if is_bound:
            # a duration matters only if it permits more than the fastest reach that is known
            best = max((-other for other, unknown, _ in reaches if not unknown), default=0.0)
            slow = max(best, MIN_SPEED)
            if _keeps_limits(problem, duration, slow):
                heapq.heappush(reaches, (-_fastest(problem, duration, slow, speed, tolerance), 0, duration))
            elif best:
                # It permits less than the fastest known one, whose speed bounds it now: it returns if that
                # one fails.
                heapq.heappush(reaches, (-slow, 1, duration))
        elif (found := _replayed(problem, duration, speed)) is not None:
            return found
        elif SPEED_FACTOR * speed >= MIN_SPEED:
            heapq.heappush(reaches, (-SPEED_FACTOR * speed, 0, duration))
    raise InputError(f"not even a minimum-jerk reach that hits at {MIN_SPEED} m/s keeps the limits")


def _fastest(problem: ImpactProblem, duration: float, slow: float, fast: float, tolerance: float) -> float:
    """Speed [m/s] of the fastest reach without contact, by bisection between a speed that keeps the limits
    and an upper bound.
    """
    while fast > (1 + tolerance) * slow:
        # The geometric mean, as the tolerance is relative and MIN_SPEED is far below usual speeds.
        middle = float(np.sqrt(fast * slow))
        slow, fast = (middle, fast) if _keeps_limits(problem, duration, middle) else (slow, middle)
    return slow


def _replayed(problem: ImpactProblem, duration: float, speed: float) -> Baseline | None:
    """The reach replayed in full dynamics; None if it violates limits there."""
    scene, reference = scene_of(problem), _reference(problem, duration, speed)
    step = min(2e-4, longest_stable_step(problem.robot, reference, scene))
    simulation = simulate_pinocchio(problem.robot, reference, scene, step=step)
    summary = simulation.summary(
        torque_limit=problem.robot.torque_limit, polygon=scene.polygon, planned_impulse=np.nan
    )
    del summary["impulse_error_pct"]  # nothing was planned
    margins, ratios = summary.get("zmp_margin_m", {"": 0.0}), summary["torque_ratio"]
    # ZMP outside the support polygon, or more torque demanded than the servo has.
    if min(margins.values()) < 0 or max(ratios.values()) > 1.0:
        return None
    return Baseline(
        duration=duration, speed=speed, reference=reference, simulation=simulation, summary=summary
    )


def _phases(
    problem: ImpactProblem, swing_duration: float, speed: float
) -> list[tuple[float, tuple[Array, Array, Array, Array]]]:
    """(duration, (start, start rate, end, end rate)) of the reach and of the return."""
    c = problem.coordinates
    y0 = c.start
    hit, legs = c.split(problem.contact_posture)
    # with so small a weight on the base the arm moves, and the base hardly
    rates = strike_rates(c, problem.strikers, hit, legs, speed * problem.normal, base=0.02)
    zero = np.zeros(c.ny)
    return_duration = float(np.mean(problem.follow.duration))
    return [(swing_duration, (y0, zero, hit, rates)), (return_duration, (hit, rates, y0, zero))]


def _profile(
    duration: float, ends: tuple[Array, Array, Array, Array], time: Array
) -> tuple[Array, Array, Array]:
    """y, ydot, yddot (k, ny) of the quintic at times [s]; it rests after ``duration``."""
    nodes = np.linspace(0, 1, 6)  # six points determine the polynomial, whose derivatives follow
    fit = np.polynomial.polynomial.polyfit(nodes, quintic(*ends[:2], *ends[2:], duration, nodes), 5)
    s = np.clip(time / duration, 0.0, 1.0)
    out = []
    for order in range(3):
        coefficients = np.polynomial.polynomial.polyder(fit, order) / duration**order
        values = np.polynomial.polynomial.polyval(s, coefficients).T
        out.append(values if order == 0 else np.where((time <= duration)[:, None], values, 0.0))
    return out[0], out[1], out[2]


def _keeps_limits(problem: ImpactProblem, swing_duration: float, speed: float) -> bool:
    """True if the reach without contact keeps the limits at 25 instants of each of its two motions."""
    c, r = problem.coordinates, problem.robot
    lower, upper = inside(r, problem.term(PositionLimit).margin)
    legs0 = c.start_legs
    for duration, ends in _phases(problem, swing_duration, speed):
        # Without the first instant: the start posture at rest.
        y, yd, ydd = _profile(duration, ends, np.linspace(0, duration, 25)[1:])
        wrench = np.tile(static_wrenches(c, ends[0], legs0), (len(y), 1))
        try:
            q, v, a, *_ = complete_reference(problem, y, yd, ydd, wrench, legs0)
        except InputError:  # a leg is too short for the base's motion
            return False
        joints, rates = r.ranges.positions(r.joint_positions(q)), v[:, -r.n :]
        if (joints < lower).any() or (joints > upper).any():
            return False
        if (np.abs(rates) > problem.term(VelocityLimit).most(r)).any():
            return False
        if not all(_wrenches_exist(problem, q[k], v[k], a[k]) for k in range(len(y))):
            return False
    return True


def _wrenches_exist(problem: ImpactProblem, q: Array, v: Array, a: Array) -> bool:
    """True if some wrenches of the soles within their cones balance the motion, with torques inside the
    limits: feasibility of a linear program in the wrenches (6 a leg).
    """
    c, r = problem.coordinates, problem.robot
    tau = r.inverse_dynamics(c.data, q, v, a)
    # Nothing drives a sole's hinge.
    limit = problem.term(TorqueLimit).fraction * np.where(r.hinges, 0.0, r.torque_limit)
    if not c.legs:
        return bool(np.all(np.abs(tau) <= limit))
    cone = problem.term(ContactWrenchCone)
    jac, _ = c.sole_jacobians(q)
    n = 6 * len(c.legs)
    rows, bounds = [], []  # rows @ wrenches <= bounds
    for k, leg in enumerate(c.legs):
        if leg.sole is None:
            grip = problem.extra(Grip)
            assert grip is not None  # the problem has it
            block = np.zeros((12, n))
            # A hand's wrench in a box, by Grip's force and moment.
            block[:6, 6 * k : 6 * k + 6], block[6:, 6 * k : 6 * k + 6] = np.eye(6), -np.eye(6)
            rows.append(block)
            bounds.append(np.tile(np.repeat([grip.force, grip.moment], 3), 2))
            continue
        facets = contact_wrench_cone(leg.sole.polygon, cone.friction, margin=0.0)
        block = np.zeros((len(facets), n))
        block[:, 6 * k : 6 * k + 6] = -facets
        rows.append(block)
        bounds.append(np.zeros(len(facets)))
    # the joints' torques, tau - J'w, stay inside the limits, and the wrenches replace the torque on the base
    legs = jac[:, c.base :].T
    rows += [-legs, legs]
    bounds += [limit - tau[c.base :], limit + tau[c.base :]]
    found = linprog(
        # No objective: only feasibility counts.
        np.zeros(n),
        A_ub=np.vstack(rows),
        b_ub=np.concatenate(bounds),
        A_eq=jac[:, :6].T,
        b_eq=tau[:6],
        bounds=(None, None),
        method="highs",
    )
    return bool(found.status == 0)


def _reference(problem: ImpactProblem, swing_duration: float, speed: float) -> Trajectory:
    """Reference of the servo: reach and return, as if there were no target."""
    c = problem.coordinates
    legs = c.start_legs
    parts, start = [], 0.0
    for phase, (duration, ends) in zip((0, 2), _phases(problem, swing_duration, speed), strict=True):
        length = duration + (0.5 if phase else 0.0)  # half a second of rest at the end
        time = np.linspace(0.0, length, round(length / 1e-3) + 1)
        y, yd, ydd = _profile(duration, ends, time)
        wrench = np.tile(static_wrenches(c, ends[0], legs), (len(time), 1))
        parts.append(
            (start + time, np.full(len(time), phase), *complete_reference(problem, y, yd, ydd, wrench, legs))
        )
        legs = c.split(parts[-1][2][-1])[1]
        start += duration
    time, phases, *columns = (np.concatenate(both) for both in zip(*parts, strict=True))
    hit = float(parts[0][0][-1])
    return Trajectory(
        time=time,
        phase=phases,
        **Completed(*columns)._asdict(),
        contact_start=hit,
        contact_end=hit,
        end=start,
    )
