"""Minimum-jerk reach to the target: a baseline without optimization, at the highest speed that the limits
allow.

From rest to a posture at the hit point (by inverse kinematics) with the striking point moving along the
normal, and back, each on the minimum-jerk polynomial (Flash and Hogan 1985) in the independent coordinates;
the swing's duration is the best of several, the way back has the problem's own.  The speed is the greatest
for which position, velocity and torque limits and the contact wrench cones hold on the way and, re-simulated
in full dynamics with the same servo, ZMP and torque stay inside while and after it hits.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from impactopt.errors import InputError
from impactopt.kinematics.operational_space import static_wrenches
from impactopt.kinematics.splines import quintic
from impactopt.kinematics.support import contact_wrench_cone
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import ContactWrenchCone, Grip, PositionLimit, TorqueLimit, VelocityLimit
from impactopt.robots.tools import inside
from impactopt.simulation import Simulation, scene_of, simulate_pinocchio
from impactopt.transcription.initial_guess import strike_rates
from impactopt.transcription.plan import Completed, Trajectory, complete_reference

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Baseline:
    """The reach: duration [s] of the swing, speed [m/s] of the striking point that it was planned with, the
    servo's reference, and what came of it.
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
        """The numbers for ``summary.json``, all simulated but the swing's duration."""
        return {"method": "minimum jerk", "swing_s": self.duration, **self.summary}


DURATIONS = (0.6, 0.8, 1.0, 1.3, 1.7)  # [s] of the swing that are tried
SLOWEST = 0.01  # [m/s] that is tried
SLOWER = 0.93  # factor from a speed whose replay does not keep the limits to the next


def minimum_jerk_baseline(
    problem: ImpactProblem, *, fastest: float = 5.0, tolerance: float = 0.02
) -> Baseline:
    """The hardest minimum-jerk reach; ``tolerance``: of its speed, relative; ``fastest`` [m/s] that is tried.

    It may use the soles up to their edges: with the margins that plans keep it could hardly move.
    All reaches strike in one posture and direction, so that the impulse grows with the speed: they are taken
    by descending speed, and the first whose replay keeps the limits is the hardest.

    Raises
    ------
    InputError : not even a touch at 1 cm/s keeps the limits; a problem with stance phases.
    """
    if problem.floats:
        raise InputError("a minimum-jerk reach gives the base a motion: it has none where nothing holds it")
    if problem.stances:
        raise InputError("a minimum-jerk reach keeps one stance: there is none for stance phases")
    # (-speed, bound, duration): the fastest reach without contact, or where `bound` is 1 no more than a bound
    reaches = [(-fastest, 1, duration) for duration in DURATIONS]
    heapq.heapify(reaches)
    while reaches:
        negative, bound, duration = heapq.heappop(reaches)
        speed = -negative
        if bound:
            best = max((-other for other, unknown, _ in reaches if not unknown), default=0.0)
            slow = max(best, SLOWEST)
            if _holds(problem, duration, slow):
                heapq.heappush(reaches, (-_fastest(problem, duration, slow, speed, tolerance), 0, duration))
            elif best:
                heapq.heappush(reaches, (-slow, 1, duration))
        elif (found := _replayed(problem, duration, speed)) is not None:
            return found
        elif SLOWER * speed >= SLOWEST:
            heapq.heappush(reaches, (-SLOWER * speed, 0, duration))
    raise InputError(f"not even a minimum-jerk reach that hits at {SLOWEST} m/s keeps the limits")


def _fastest(problem: ImpactProblem, duration: float, slow: float, fast: float, tolerance: float) -> float:
    """Speed [m/s] of the fastest reach without contact between one that keeps the limits and a bound."""
    # limits without contact are cheap, and monotonic in speed
    while fast > (1 + tolerance) * slow:
        middle = float(np.sqrt(fast * slow))
        slow, fast = (middle, fast) if _holds(problem, duration, middle) else (slow, middle)
    return slow


def _replayed(problem: ImpactProblem, duration: float, speed: float) -> Baseline | None:
    """The reach in full dynamics; None if it does not keep the limits there."""
    scene, reference = scene_of(problem), _reference(problem, duration, speed)
    simulation = simulate_pinocchio(problem.robot, reference, scene, step=2e-4)
    summary = simulation.summary(
        torque_limit=problem.robot.torque_limit, polygon=scene.polygon, planned_impulse=np.nan
    )
    del summary["impulse_error_pct"]  # nothing was planned
    margins, ratios = summary.get("zmp_margin_m", {"": 0.0}), summary["torque_ratio"]
    if min(margins.values()) < 0 or max(ratios.values()) > 1.0:
        return None
    return Baseline(
        duration=duration, speed=speed, reference=reference, simulation=simulation, summary=summary
    )


def _phases(
    problem: ImpactProblem, there: float, speed: float
) -> list[tuple[float, tuple[Array, Array, Array, Array]]]:
    """(duration, (start, start rate, end, end rate)) of the way there and of the way back."""
    c = problem.coordinates
    y0 = c.start
    hit, legs = c.split(problem.contact_posture)
    rates = strike_rates(c, problem.strikers, hit, legs, speed * problem.normal, base=0.02)  # by the arm
    zero = np.zeros(c.ny)
    back = float(np.mean(problem.follow.duration))
    return [(there, (y0, zero, hit, rates)), (back, (hit, rates, y0, zero))]


def _profile(
    duration: float, ends: tuple[Array, Array, Array, Array], time: Array
) -> tuple[Array, Array, Array]:
    """y, ydot, yddot (k, ny) of the quintic at times [s]; it rests after ``duration``."""
    nodes = np.linspace(0, 1, 6)
    fit = np.polynomial.polynomial.polyfit(nodes, quintic(*ends[:2], *ends[2:], duration, nodes), 5)
    s = np.clip(time / duration, 0.0, 1.0)
    out = []
    for order in range(3):
        coefficients = np.polynomial.polynomial.polyder(fit, order) / duration**order
        values = np.polynomial.polynomial.polyval(s, coefficients).T
        out.append(values if order == 0 else np.where((time <= duration)[:, None], values, 0.0))
    return out[0], out[1], out[2]


def _holds(problem: ImpactProblem, there: float, speed: float, nodes: int = 25) -> bool:
    """True if the reach without contact keeps the limits at ``nodes`` instants of each of its two motions."""
    c, r = problem.coordinates, problem.robot
    lower, upper = inside(r, problem.term(PositionLimit).margin)
    legs0 = c.start_legs
    for duration, ends in _phases(problem, there, speed):
        y, yd, ydd = _profile(duration, ends, np.linspace(0, duration, nodes)[1:])
        wrench = np.tile(static_wrenches(c, ends[0], legs0), (len(y), 1))
        try:
            q, v, a, *_ = complete_reference(problem, y, yd, ydd, wrench, legs0)
        except InputError:  # a leg too short for the base's way
            return False
        joints, rates = r.ranges.positions(q[:, -r.n :]), v[:, -r.n :]
        if (joints < lower).any() or (joints > upper).any():
            return False
        if (np.abs(rates) > problem.term(VelocityLimit).most(r)).any():
            return False
        if not all(_wrenches_exist(problem, q[k], v[k], a[k]) for k in range(len(y))):
            return False
    return True


def _wrenches_exist(problem: ImpactProblem, q: Array, v: Array, a: Array) -> bool:
    """True if wrenches that soles can transmit balance the motion with torques inside the limits (a linear
    program).
    """
    c, r = problem.coordinates, problem.robot
    tau = r.inverse_dynamics(c.data, q, v, a)
    limit = problem.term(TorqueLimit).fraction * np.where(r.hinges, 0.0, r.torque_limit)
    if not c.legs:
        return bool(np.all(np.abs(tau) <= limit))
    cone = problem.term(ContactWrenchCone)
    jac, _ = c.sole_jacobians(q)
    n = 6 * len(c.legs)
    rows, bounds = [], []
    for k, leg in enumerate(c.legs):
        if leg.sole is None:
            grip = problem.extra(Grip)
            assert grip is not None  # the problem has it
            block = np.zeros((12, n))
            block[:6, 6 * k : 6 * k + 6], block[6:, 6 * k : 6 * k + 6] = np.eye(6), -np.eye(6)
            rows.append(block)
            bounds.append(np.tile(np.repeat([grip.force, grip.moment], 3), 2))
            continue
        facets = contact_wrench_cone(leg.sole.polygon, cone.friction, margin=0.0)
        block = np.zeros((len(facets), n))
        block[:, 6 * k : 6 * k + 6] = -facets
        rows.append(block)
        bounds.append(np.zeros(len(facets)))
    legs = jac[:, c.base :].T
    rows += [-legs, legs]
    bounds += [limit - tau[c.base :], limit + tau[c.base :]]
    found = linprog(
        np.zeros(n),
        A_ub=np.vstack(rows),
        b_ub=np.concatenate(bounds),
        A_eq=jac[:, :6].T,
        b_eq=tau[:6],
        bounds=(None, None),
        method="highs",
    )
    return bool(found.status == 0)


def _reference(problem: ImpactProblem, there: float, speed: float) -> Trajectory:
    """The servo's reference: there and back, as if there were no target."""
    c = problem.coordinates
    legs = c.start_legs
    parts, start = [], 0.0
    for phase, (duration, ends) in zip((0, 2), _phases(problem, there, speed), strict=True):
        length = duration + (0.5 if phase else 0.0)
        time = np.linspace(0.0, length, round(length / 1e-3) + 1)
        y, yd, ydd = _profile(duration, ends, time)
        wrench = np.tile(static_wrenches(c, ends[0], legs), (len(time), 1))
        parts.append(
            (start + time, np.full(len(time), phase), *complete_reference(problem, y, yd, ydd, wrench, legs))
        )
        legs = c.split(parts[-1][2][-1])[1]
        start += duration
    columns = (np.concatenate(rows) for rows in zip(*parts, strict=True))
    time, phases, *rows = columns
    hit = float(parts[0][0][-1])
    return Trajectory(
        time=time,
        phase=phases,
        **Completed(*rows)._asdict(),
        contact_start=hit,
        contact_end=hit,
        end=start,
    )
