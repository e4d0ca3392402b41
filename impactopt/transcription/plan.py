"""Planned motion or strike as arrays: servo references, predicted contact, loads.

Everything that checks, draws or executes a plan reads it from here, without CasADi.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicHermiteSpline

from impactopt.arrays import Array, Index, Mask
from impactopt.errors import InputError
from impactopt.kinematics.coordinates import StanceCoordinates, base_rates, solved
from impactopt.kinematics.splines import CubicSpline
from impactopt.kinematics.stance import margin, support_polygon, zmp
from impactopt.problem.phases import places_of_soles
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import ContactWrenchCone, GearLoad
from impactopt.robots.loads import (
    MIN_LOAD_FRACTION,
    DriveLoads,
    cop_margin,
    gear_torque,
    least_margins,
    weight_of,
)
from impactopt.robots.model import mass_matrix
from impactopt.robots.robot import Robot

# [s] Steps of the coarse references, with which a plan is checked between its nodes, and of all references in
# contact, at most. Loads change no faster than the nodes are apart, and inverse dynamics of every millisecond
# is slow.
COARSE_STEP, CONTACT_STEP = 5e-3, 1e-3
_BETWEEN_NODES = 3  # steps of a coarse reference between two nodes, if these are 3 ms apart
MOMENT_COST = 10.0  # [1/m] weight of a wrench correction's moments relative to its forces


class Completed(NamedTuple):
    """Full motion at k instants, with the torques and wrenches that it needs.

    q (k, nq), v and a (k, nv), torque (k, n) [N m]; ground (k, 6): ground wrench about the world's origin
    [N, N m]; sole_wrench (k, 6 a sole, 6 a hand), in the frames of soles and hands [N, N m].
    """

    q: Array
    v: Array
    a: Array
    torque: Array
    ground: Array
    sole_wrench: Array


def complete_reference(
    problem: ImpactProblem,
    y: Array,
    yd: Array,
    ydd: Array,
    wrench: Array,
    legs: Array,
    coordinates: StanceCoordinates | None = None,
) -> Completed:
    """Full motion, torques and wrenches of a motion in independent coordinates.

    y, yd, ydd (k, ny) : independent coordinates and their first and second time derivatives.
    wrench (k, 6 a sole) : wrenches, interpolated between nodes. They get the smallest correction that
        balances the unactuated coordinates (base, hinges of soles). It is distributed among soles by
        their loads, so that the centre of pressure of a lightly loaded sole hardly moves.
    legs (nl,) : initial guess of the legs' inverse kinematics.
    coordinates : by default those of the stance phase with the impact.
    """
    c, robot = coordinates or problem.coordinates, problem.robot
    model, data = robot.model, robot.model.createData()
    n = len(y)
    q, v, a = np.zeros((n, model.nq)), np.zeros((n, model.nv)), np.zeros((n, model.nv))
    torque, corrected = np.zeros((n, robot.n)), np.zeros((n, 6 * len(c.legs)))
    cost = _correction_costs(c, wrench, MIN_LOAD_FRACTION * weight_of(robot))
    # a robot at rest repeats its state over many instants: each distinct state is computed once
    state = np.hstack([y, yd, ydd, wrench])
    changes = np.append(True, (state[1:] != state[:-1]).any(axis=1))[:n]
    distinct = np.flatnonzero(changes)
    for k, (configuration, _) in zip(distinct.tolist(), c.leg_closure.follow(y[distinct], legs), strict=True):
        q[k] = configuration
        v[k], a[k], jac = c.leg_closure.rates(configuration, y[k], yd[k], ydd[k])
        tau = robot.inverse_dynamics(data, q[k], v[k], a[k])
        if c.legs:
            # minimize |C dw|^2 subject to B' dw = unbalanced, where B are the columns of the contact Jacobian
            # that belong to unactuated coordinates: dw = C^-2 B (B' C^-2 B)^-1 unbalanced.  base = B' C^-1
            base = jac[:, c.undriven].T / cost[k]
            unbalanced = tau[c.undriven] - jac[:, c.undriven].T @ wrench[k]
            corrected[k] = wrench[k] + base.T @ solved(base @ base.T, unbalanced) / cost[k]
            tau = tau - jac.T @ corrected[k]
        torque[k] = tau[c.base :]
    last = np.maximum.accumulate(np.where(changes, np.arange(n), 0))  # the distinct state that holds at each
    q, v, a, torque, corrected = (part[last] for part in (q, v, a, torque, corrected))
    return Completed(q, v, a, torque, total_ground_wrench(c, corrected), corrected)


def drifting_reference(
    problem: ImpactProblem, sample: Callable[[Array], Sequence[Array]], time: Array, *, backward: bool
) -> Completed:
    """Full motion and torques of a free-floating robot, whose base follows from the motion of its joints.

    sample : function that gives y, yd, ydd (k, ny) at times (k,) [s].
    backward : the base's state is given at the last time instead of the first.

    From the given state on, only gravity changes the momentum. Velocities of the base follow from it
    (centroidal momentum matrix), and its pose by the classical Runge-Kutta method with one step between two
    times.
    """
    c, robot = problem.coordinates, problem.robot
    model, data = robot.model, robot.model.createData()
    # a swing's end is given, not its start: there the striking point has to be at the target
    order = np.arange(len(time))[:: -1 if backward else 1]
    y, yd, ydd = (np.array(part) for part in sample(time)[:3])
    weight = np.append(np.array(model.gravity.linear), np.zeros(3))
    weight *= sum(inertia.mass for inertia in model.inertias)  # (6,) wrench about the centre of mass

    def velocity(q: Array, base: Array, yd: Array, momentum: Array) -> Array:
        """v (nv,) with the joints' rates, and the base's for this momentum (6,) about the centre of mass.

        The base's coordinates (6,) are written to q (nq,), which has the joints'.
        """
        v = np.concatenate([np.zeros(6), yd[6:]])
        q[:3], q[3:7] = base[:3], pin.Quaternion(pin.rpy.rpyToMatrix(base[3:6])).coeffs()
        pin.ccrba(model, data, q, v)  # data.Ag: momentum matrix (6, nv); data.hg: momentum at v
        v[:6] = solved(np.array(data.Ag[:, :6]), momentum - np.array(data.hg.vector))
        return v

    def joined(y: Array) -> Array:
        return c.join(y, np.zeros((len(y), 0)))

    start = order[0]
    q, v = joined(y), np.zeros((len(y), model.nv))
    _, v[start], _ = c.complete_motion(y[start], yd[start], ydd[start], np.zeros(0))
    momentum = np.array(pin.computeCentroidalMomentum(model, data, q[start], v[start]).vector)
    # classical Runge-Kutta method for the base's pose; the joints' motion is known at all its stages
    middles, middle_rates, _ = sample((time[1:] + time[:-1]) / 2)[:3]
    between = joined(np.asarray(middles))
    for one, other in pairwise(order.tolist()):
        h, middle = time[other] - time[one], min(one, other)
        base, elapsed = y[one, :6], time[one] - time[start]
        slopes = [base_rates(base, v[one])]
        for fraction, joints, rates in (
            (0.5, between[middle], middle_rates[middle]),
            (0.5, between[middle], middle_rates[middle]),
            (1.0, q[other], yd[other]),
        ):
            stage = base + fraction * h * slopes[-1]
            found = velocity(joints, stage, rates, momentum + (elapsed + fraction * h) * weight)
            slopes.append(base_rates(stage, found))
        y[other, :6] = base + h / 6 * (slopes[0] + 2 * slopes[1] + 2 * slopes[2] + slopes[3])
        v[other] = velocity(q[other], y[other, :6], yd[other], momentum + (elapsed + h) * weight)
    q = joined(y)
    a, torque = np.zeros_like(v), np.zeros((len(y), robot.n))
    for k in range(len(y)):
        a[k, 6:] = ydd[k, 6:]
        # the equations of motion are linear in the base's acceleration: its six equations have no torque
        force = robot.inverse_dynamics(data, q[k], v[k], a[k])  # while a[k, :6] = 0
        base_columns = mass_matrix(model, data, q[k])[:, :6]
        a[k, :6] = -solved(base_columns[:6], force[:6])
        torque[k] = force[6:] + base_columns[6:] @ a[k, :6]
    return Completed(q, v, a, torque, np.zeros((len(y), 6)), np.zeros((len(y), 0)))


def _correction_costs(c: StanceCoordinates, wrench: Array, least: float) -> Array:
    """(k, 6 a sole, 6 a hand) Weights C of a wrench correction d, which minimizes |C d|^2.

    The minimum of the sum of d_i^2 / load_i distributes d in proportion to the loads. ``least`` [N] bounds
    the load of a sole from below. A hand counts as a sole of mean load.
    """
    standing = np.array([leg.sole is not None for leg in c.legs], dtype=bool)
    load = np.maximum(wrench[:, 2::6], least)
    load[:, ~standing] = load[:, standing].mean(axis=1, keepdims=True) if standing.any() else least
    component_costs = np.array([1.0, 1.0, 1.0, MOMENT_COST, MOMENT_COST, MOMENT_COST])
    return np.asarray((component_costs / np.sqrt(load)[:, :, None]).reshape(len(wrench), -1))


def total_ground_wrench(coordinates: StanceCoordinates, wrenches: Array) -> Array:
    """(k, 6) ground wrenches about the world's origin of (k, 6 a sole) sole wrenches.

    Wrenches of hands are left out: what they hold on to is not the ground.
    """
    placements = [leg.placement for leg in coordinates.legs if leg.sole is not None]
    total = np.zeros((len(wrenches), 6))
    for k, placement in enumerate(placements):
        # the dual action transforms wrenches from the sole's frame to the world's
        total += wrenches[:, 6 * k : 6 * k + 6] @ placement.toDualActionMatrix().T
    return total


def margin_of(polygon: Array, ground: Array) -> Array:
    """Distance (k,) [m] of the ZMP of ground wrenches (k, 6) from a polygon's edges; (0,) without one."""
    return margin(polygon, zmp(ground)) if len(polygon) and len(ground) else np.zeros(0)


def sampled(start: float, end: float, step: float) -> Array:
    """Instants (k,) [s] about every ``step`` [s], both ends included."""
    return np.linspace(start, end, max(2, round((end - start) / step) + 1))


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """Reference trajectory of the servo, the only part of a plan that reaches a simulation.

    time (k,) [s] : ascending; an instant stands twice where the reference jumps.
    phase (k,) : 0 swing, 1 collision, 2 follow-through.
    q (k, nq), v (k, nv), a (k, nv) : Pinocchio's configurations, velocities, accelerations.
    torque (k, n) : feed-forward [N m].
    ground (k, 6) : total ground wrench about the world's origin that the feed-forward assumes [N, N m].
    sole_wrench (k, 6 a sole, 6 a supporting hand) : its parts, in their own frames; (0, 0): unknown.
    contact_start, contact_end, end : [s] planned begin and end of contact, and end of the motion.
    stance (k,) : number of the stance phase; (0,): there is one stance.
    """

    time: Array = field(repr=False)
    phase: Index = field(repr=False)
    q: Array = field(repr=False)
    v: Array = field(repr=False)
    a: Array = field(repr=False)
    torque: Array = field(repr=False)
    ground: Array = field(repr=False)
    sole_wrench: Array = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    contact_start: float
    contact_end: float
    end: float
    stance: Index = field(default_factory=lambda: np.zeros(0, dtype=np.intp), repr=False)


@dataclass(frozen=True, kw_only=True, eq=False)
class PlannedStand:
    """Stance phase other than the one with the impact.

    number : index of the phase.  spline : in the coordinates of its stance.  nodes (k,) : nodes of the
    nonlinear program, fractions of the phase; wrench (k, 6 a sole) : at the nodes, in each sole's frame
    [N, N m].
    """

    number: int
    spline: CubicSpline
    nodes: Array
    wrench: Array


class Piece(NamedTuple):
    """Spline of a plan, with sole wrenches.

    phase : 0 before, 2 after contact.  number : index of the stance phase.  start : [s] since the motion's.
    nodes (k,) : fractions of the spline.  wrench (k, 6 a sole) : at the nodes.
    """

    phase: int
    number: int
    spline: CubicSpline
    start: float
    nodes: Array
    wrench: Array

    def sample(self, time: Array) -> tuple[Array, Array, Array, Array]:
        """y, ydot, yddot (k, ny) and sole wrenches (k, 6 a sole) at times (k,) [s] since the motion's start.

        Wrenches are linear between nodes. Before and after the piece, values at its ends hold.
        """
        ts, nw = np.asarray(time, dtype=float), self.wrench.shape[1]
        local = np.clip(ts - self.start, 0.0, self.spline.duration)
        node_times = self.nodes * self.spline.duration
        w = [np.interp(local, node_times, component) for component in self.wrench.T]
        return *self.spline.sample(local), np.stack(w, axis=1) if nw else np.zeros((len(ts), 0))


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """Motion of the bodies at k instants.

    time (k,) [s].  phase (k,) : 0 before, 1 during, 2 after contact.  q (k, nq) : Pinocchio's configurations.
    displacement (k, 3) : of the target [m].
    """

    time: Array = field(repr=False)
    phase: Index = field(repr=False)
    q: Array = field(repr=False)
    displacement: Array = field(repr=False)


def pushed_aside(time: Array, velocity: Array, since: Array) -> Array:
    """Displacement (k, 3) [m] at times (k,) [s], from velocities (m, 3) [m/s] at times (m,) since contact.

    After these the target keeps its last velocity.
    """
    moved = cumulative_trapezoid(velocity, time, axis=0, initial=0.0)
    within = np.column_stack([np.interp(since, time, x) for x in moved.T])
    return np.asarray(within + np.maximum(since - time[-1], 0.0)[:, None] * velocity[-1])


@dataclass(frozen=True, kw_only=True, eq=False)
class PlannedCollision:
    """Predicted collision of a plan, at contact and at the m collocation points.

    time (m + 1,) : [s] since contact. The force of a later touch that begins with a jump is that of its first
        collocation point.
    force (m + 1,), forces (m + 1, strikers) : [N] total contact force, and that on each striker.
    target_speed (m + 1,) : of the target's surface [m/s].
    target_state (n_states,) : of the target at the end; (0,) for an impact without duration.
    tangential_velocity (m + 1, 3) : [m/s] across the normal, of a target that friction moves; else None.
    outcome : effect on the target, by name and unit (``speed_m_s`` of a free mass, ``depth_m`` of a nail,
        ``broken`` of a board, ``tangential_speed_m_s`` if friction moves it across the normal).
    torque (m + 1, n) : servo and feed-forward [N m].
    ground (m, 6) : ground wrench about the world's origin [N, N m].
    sole_wrench (m, 6 a sole, 6 a supporting hand) : in their own frames [N, N m].
    motion (m + 1, 2, ny) : independent coordinates and their rates.
    velocity, acceleration (m + 1, n) : of the joints. The first is the limit from the right: the force of a
        damped contact jumps at contact.
    Of an impact without duration the last three are empty.
    """

    time: Array = field(repr=False)
    force: Array = field(repr=False)
    target_speed: Array = field(repr=False)
    outcome: dict[str, float]
    torque: Array = field(repr=False)
    ground: Array = field(repr=False)
    sole_wrench: Array = field(repr=False)
    motion: Array = field(default_factory=lambda: np.zeros((0, 2, 0)), repr=False)
    velocity: Array = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    acceleration: Array = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    forces: Array = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    tangential_velocity: Array | None = field(default=None, repr=False)
    target_state: Array = field(default_factory=lambda: np.zeros(0), repr=False)

    def aside(self, since: Array) -> Array:
        """Displacement (k, 3) [m] of the target across the normal at times (k,) [s] since contact.

        After the contact the target keeps its last velocity.
        """
        v = self.tangential_velocity
        return np.zeros((len(since), 3)) if v is None else pushed_aside(self.time, v, since)

    @property
    def peak_force(self) -> float:
        """Largest contact force [N]; infinite for an impact without duration."""
        return float(self.force.max()) if self.time[-1] > 0 else np.inf

    @property
    def last_touch(self) -> float:
        """End of the last touch [s]; a board may swing on after it, and break."""
        touching = np.flatnonzero(self.force > _NO_FORCE * self.force.max())
        return float(self.time[min(touching[-1] + 1, len(self.time) - 1)]) if touching.size else 0.0


_NO_FORCE = 1e-9  # of the largest force: rounding


@dataclass(frozen=True, kw_only=True)
class PlannedScenario:
    """Predicted collision with the target of the :class:`impactopt.Scenario` of this name.

    impulse : to that target [N s].
    """

    name: str
    impulse: float
    collision: PlannedCollision

    def summary(self, *, torque_limit: Array, polygon: Array) -> dict[str, Any]:
        """Entries of ``summary.json``.  torque_limit (n,) [N m]; polygon (k, 2) [m]: support polygon."""
        hit = self.collision
        out = {
            "name": self.name,
            "impulse_Ns": self.impulse,
            "target": hit.outcome,
            "peak_force_N": float(hit.force.max()),
            "contact_ms": 1e3 * hit.last_touch,
            "torque_ratio": float(np.abs(hit.torque / torque_limit).max()),
        }
        return out | ({"zmp_margin_m": float(margin(polygon, zmp(hit.ground)).min())} if len(polygon) else {})


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Plan:
    """A planned impact motion.

    Attributes
    ----------
    problem : the problem that it solves.
    swing, follow : splines in the independent coordinates, from start to contact and from there to rest.
    compression, restitution : [s] durations of the contact's phases.
    swing_nodes, follow_nodes : (k,) nodes of the nonlinear program, fractions of each spline from 0 to 1.
    swing_wrench, follow_wrench : (k, 6 a sole) wrenches at these nodes, in each sole's frame [N, N m]. In
        contact the reference keeps the last one of the swing.
    collision : prediction of the contact.
    hand_speed : [m/s] along the normal, at contact.
    impulse : [N s] to the target.
    scenarios : predictions for other targets, in the problem's order, without missing ones.
    coast_wrench : (6 a sole) at the end of coasting, if nothing is hit; None without an abort motion.
    abort, abort_wrench : the abort motion, as `follow` and `follow_wrench`; None if the problem has none.
    before, after, after_abort : stance phases before the swing, after the follow-through and after the abort
        motion.
    """

    problem: ImpactProblem
    swing: CubicSpline
    follow: CubicSpline
    compression: float
    restitution: float
    swing_nodes: Array
    swing_wrench: Array
    follow_nodes: Array
    follow_wrench: Array
    collision: PlannedCollision
    hand_speed: float
    impulse: float
    scenarios: tuple[PlannedScenario, ...] = ()
    abort: CubicSpline | None = None
    abort_wrench: Array | None = None
    coast_wrench: Array | None = None
    before: tuple[PlannedStand, ...] = ()
    after: tuple[PlannedStand, ...] = ()
    after_abort: tuple[PlannedStand, ...] = ()

    def __repr__(self) -> str:
        """One line without the arrays."""
        return (
            f"<Plan of {self.problem.name!r}: {self.impulse:.2f} N s, contact at {self.contact_start:.3g} s>"
        )

    @property
    def coordinates(self) -> StanceCoordinates:
        return self.problem.coordinates

    @cached_property
    def reference(self) -> Trajectory:
        """The servo's reference every millisecond; InputError if legs do not reach their soles."""
        return self.trajectory()

    @cached_property
    def coarse_reference(self) -> Trajectory:
        """The servo's reference every `COARSE_STEP`, or more often if any two nodes are near each other, in
        contact every millisecond; InputError as of `reference`.
        """
        return self.trajectory(step=self._coarse_step, hold=self._coarse_step)

    @cached_property
    def coarse_missed_reference(self) -> Trajectory:
        """`missed_reference` with the steps of `coarse_reference`."""
        step = self._coarse_step
        return self.trajectory(step=step, hold=step, missed=True, known=self.coarse_reference)

    @property
    def _coarse_step(self) -> float:
        pieces = self.pieces() + (self.pieces(missed=True) if self.abort is not None else [])
        least = min(piece.spline.duration * float(np.diff(piece.nodes).min()) for piece in pieces)
        return max(CONTACT_STEP, min(COARSE_STEP, least / _BETWEEN_NODES))

    @cached_property
    def missed_reference(self) -> Trajectory:
        """The servo's reference if nothing is hit; InputError if the plan has no abort motion."""
        return self.trajectory(missed=True, known=self.reference if self.abort is not None else None)

    @property
    def swing_start(self) -> float:
        """End of the stance phases before the one with the impact [s]."""
        return float(sum(stand.spline.duration for stand in self.before))

    @property
    def contact_start(self) -> float:
        return self.swing_start + self.swing.duration

    @property
    def contact_end(self) -> float:
        return self.contact_start + self.compression + self.restitution

    @property
    def duration(self) -> float:
        """Start to rest [s]."""
        return self.end()

    def end(self, *, missed: bool = False) -> float:
        """End of the motion [s]; ``missed``: of the motion if nothing is hit."""
        last = self.pieces(missed=missed)[-1]
        return last.start + last.spline.duration

    def pieces(self, *, missed: bool = False) -> list[Piece]:
        """All splines in the order of time; ``missed``: those of the motion if nothing is hit."""
        out, start = [], 0.0
        for stand in self.before:
            out.append(Piece(0, stand.number, stand.spline, start, stand.nodes, stand.wrench))
            start += stand.spline.duration
        for phase in (0, 2):
            out.append(Piece(phase, self.problem.blow, *self.segment(phase, missed=missed)))
        start = out[-1].start + out[-1].spline.duration
        for stand in self.after_abort if missed else self.after:
            out.append(Piece(2, stand.number, stand.spline, start, stand.nodes, stand.wrench))
            start += stand.spline.duration
        return out

    @cached_property
    def polygon(self) -> Array:
        """Support polygon (k, 2) [m]."""
        return support_polygon(self.problem.robot, self.coordinates)

    def independent(
        self, phase: int, time: Array, *, missed: bool = False
    ) -> tuple[Array, Array, Array, Array]:
        """Reference y, ydot, yddot (k, ny) and sole wrenches (k, 6 a sole) of a phase.

        time (k,) : [s] since the motion's start.
        phase : 0 swing; 1 contact, in which the reference coasts at its velocity at contact; 2 follow-through
            and rest.
        missed : nothing is hit. The reference coasts until the robot detects that, then follows the abort
            motion.
        """
        if phase == 1:
            ts = np.asarray(time, dtype=float)
            end, rate, _ = self.swing.sample(self.swing.duration)
            y = end + rate * (ts[:, None] - self.contact_start)
            wrenches = np.tile(self.swing_wrench[-1], (len(ts), 1))
            if missed and self.coast_wrench is not None:
                coasting = self.segment(2, missed=True)[1] - self.contact_start
                fraction = (ts - self.contact_start) / coasting
                wrenches += fraction[:, None] * (self.coast_wrench - self.swing_wrench[-1])
            return y, np.repeat(rate, len(ts), axis=0), np.zeros_like(y), wrenches
        return Piece(phase, self.problem.blow, *self.segment(phase, missed=missed)).sample(time)

    def segment(self, phase: int, *, missed: bool = False) -> tuple[CubicSpline, float, Array, Array]:
        """Spline, start [s], nodes and sole wrenches at them: swing (phase 0) or follow-through (2).

        missed : the abort motion instead of the follow-through; InputError if the plan has none.
        """
        if phase == 0:
            return self.swing, self.swing_start, self.swing_nodes, self.swing_wrench
        if not missed:
            return self.follow, self.contact_end, self.follow_nodes, self.follow_wrench
        after = self.problem.abort_after
        if self.abort is None or self.abort_wrench is None or after is None:
            raise InputError(
                "this plan has no abort motion for a missed target: solve the problem with a scenario "
                "Scenario(name=..., missing=True, abort_after=0.025)"
            )
        return self.abort, self.contact_start + after, self.follow_nodes, self.abort_wrench

    def trajectory(
        self,
        *,
        step: float = 1e-3,
        hold: float = 0.5,
        missed: bool = False,
        known: Trajectory | None = None,
    ) -> Trajectory:
        """The servo's reference about every ``step`` [s], until ``hold`` [s] after the motion's end.

        In contact, which is short, it is sampled every millisecond at least.

        missed : nothing is hit: the same reference until the robot detects that, then the abort motion.
        known : the reference of this plan with this step and the other ``missed``, if already computed. Both
            have the same swing.

        Legs follow by inverse kinematics, so that soles stay in place. The feed-forward is inverse dynamics
        under the planned sole wrenches, which are corrected between nodes to balance the base. A
        free-floating base is integrated from contact: backward through the swing, forward after it.
        The begin and the end of contact stand twice, because the reference jumps from the coasting one to
        the predicted state.
        """
        problem, pieces = self.problem, self.pieces(missed=missed)
        t0, t1, rest = self.contact_start, self.segment(2, missed=missed)[1], self.end(missed=missed)
        q = problem.start_posture
        parts: list[tuple[Any, ...]] = []  # of each piece: phase, times, and the fields of Completed
        stance = np.zeros(0, dtype=np.intp)
        for piece in pieces[: len(self.before) + 1] if known is None else ():
            times = sampled(piece.start, piece.start + piece.spline.duration, step)
            # pieces share their ends: the instant is kept in the later one
            times = times if piece.number == problem.blow else times[:-1]
            parts.append((0, times, *self._completed(piece, times, q)))
            stance = np.append(stance, np.full(len(times), piece.number))
            q = parts[-1][2][-1]
        if known is not None:
            own = known.phase == 0
            parts.append((0, *(getattr(known, name)[own] for name in ("time", *Completed._fields))))
            stance = known.stance[own] if known.stance.size else np.zeros(own.sum(), dtype=np.intp)
            q = parts[-1][2][-1]
        contact = sampled(t0, t1, min(step, CONTACT_STEP))
        legs = self.coordinates.split(q)[1]
        if self.coordinates.drifts:
            coasting = drifting_reference(problem, partial(self.independent, 1), contact, backward=False)
        else:
            coasting = complete_reference(problem, *self.independent(1, contact, missed=missed), legs)
        parts.append((1, contact, *self._of_all_soles(problem.blow, coasting)))
        stance = np.append(stance, np.full(len(contact), problem.blow))
        for piece in pieces[len(self.before) + 1 :]:
            end = piece.start + piece.spline.duration + (hold if piece is pieces[-1] else 0.0)
            times = sampled(piece.start, end, step)
            times = times if piece is pieces[-1] else times[:-1]
            parts.append((2, times, *self._completed(piece, times, q)))
            stance = np.append(stance, np.full(len(times), piece.number))
            q = parts[-1][2][-1] if self.after else q
        phases = np.concatenate([np.full(len(p[1]), p[0]) for p in parts])
        time, q, v, a_, torque, ground, wrench = (np.concatenate([p[k] for p in parts]) for k in range(1, 8))
        # In contact the feed-forward is constant, as the collision model assumes: the torque that makes the
        # robot coast at contact. If nothing is hit, coasting goes on after the planned contact; there the
        # feed-forward is what each posture needs.
        torque[(phases == 1) & (time <= self.contact_end)] = self.collision.torque[0]
        return Trajectory(
            time=time,
            phase=phases,
            q=q,
            v=v,
            a=a_,
            torque=torque,
            ground=ground,
            sole_wrench=wrench,
            contact_start=t0,
            contact_end=t1,
            end=rest,
            stance=stance if problem.stances else stance[:0],
        )

    def _completed(self, piece: Piece, times: Array, near: Array) -> Completed:
        """Full motion of a piece at times (k,) [s].  near (nq,): initial guess of the legs' kinematics."""
        c = self.problem.stance_coordinates[piece.number]
        if c.drifts:
            return drifting_reference(self.problem, piece.sample, times, backward=piece.phase == 0)
        completed = complete_reference(self.problem, *piece.sample(times), c.split(near)[1], c)
        return self._of_all_soles(piece.number, completed)

    def _of_all_soles(self, number: int, completed: Completed) -> Completed:
        """Same motion with sole wrenches as of `_wrench_of_all`."""
        if not self.problem.stances:
            return completed
        return completed._replace(sole_wrench=self._wrench_of_all(number, completed.sole_wrench))

    def _wrench_of_all(self, number: int, wrench: Array) -> Array:
        """Wrenches (k, 6 a sole of the problem), zero of soles that do not stand in this stance phase."""
        own = [sole.name for sole in self.problem.stance_coordinates[number].soles]
        out = np.zeros((len(wrench), len(self.problem.soles), 6))
        for k, sole in enumerate(self.problem.soles):
            if sole.name in own:
                out[:, k] = wrench.reshape(len(wrench), -1, 6)[:, own.index(sole.name)]
        return out.reshape(len(wrench), -1)

    def motion(
        self, reference: Trajectory | None = None, *, step: float = CONTACT_STEP, missed: bool = False
    ) -> Motion:
        """Expected motion of the robot's bodies, at the reference's instants from start to rest.

        In contact the contact force slows the robot below the servo's reference, so there the motion is that
        of the collision (`through_contact`), about every ``step`` [s].

        reference : result of :meth:`trajectory`; default: every millisecond.
        missed : nothing is hit, as in the reference; the motion from the planned contact on (before, it is as
            planned).

        Raises
        ------
        InputError : the legs do not reach their soles.
        """
        reference = reference or (self.missed_reference if missed else self.reference)
        t0, t1 = self.contact_start, self.segment(2, missed=missed)[1]
        within = sampled(t0, t1, step)
        # an impact without duration has t1 = t0
        during = self.closed(self.through_contact((within - t0) / max(t1 - t0, 1e-12), missed=missed))
        before, after = (reference.phase == 0) & (not missed), reference.phase == 2
        time = np.concatenate([reference.time[before], within, reference.time[after]])
        return Motion(
            time=time,
            phase=np.repeat([0, 1, 2], [before.sum(), len(within), after.sum()]),
            q=np.concatenate([reference.q[before], during, reference.q[after]]),
            displacement=np.zeros((len(time), 3)) if missed else self.displacement(time),
        )

    def in_contact(self, reference: Trajectory) -> Array:
        """Expected configurations (k, nq) at the instants of a reference in contact, as of :meth:`motion`."""
        expected = self.motion(reference)
        return expected.q[expected.phase == 1]

    def through_contact(self, s: Array, *, missed: bool = False) -> Array:
        """Independent coordinates (k, ny) at fractions s (k,) of the contact.

        missed : those of the reference, which coasts.
        """
        t0, t1 = self.contact_start, self.segment(2, missed=missed)[1]
        if missed or not len(self.collision.motion):
            return self.independent(1, t0 + (t1 - t0) * s, missed=missed)[0]
        # Between all states of the collision: between its first and its last one alone, a link would be up to
        # 10 mm off (preset punch_g1), as a light hand loses its speed at once.
        y, rates = self.collision.motion.swapaxes(0, 1)
        return np.asarray(CubicHermiteSpline(self.collision.time, y, rates)((t1 - t0) * s))

    def travel(self, time: Array) -> Array:
        """Displacement (k,) [m] of the target along the normal at times (k,) [s] since the motion's start.

        Before contact its speed is that at contact; after the contact a free target keeps its last speed.
        """
        hit, since = self.collision, np.asarray(time) - self.contact_start
        if len(hit.time) < 2:
            return np.zeros(len(since))
        # the speed, integrated by the trapezoidal rule
        displacement = np.concatenate(
            [[0.0], np.cumsum(np.diff(hit.time) * (hit.target_speed[1:] + hit.target_speed[:-1]) / 2)]
        )
        # the speed of a target that stays is zero after contact, up to rounding
        last = 0.0 if self.problem.target.stays else float(hit.target_speed[-1])
        before = float(self.problem.target.speed_before()) * np.minimum(since, 0.0)
        within = np.interp(since, hit.time, displacement, left=0.0)
        return before + within + last * np.maximum(since - hit.time[-1], 0.0)

    def aside(self, time: Array) -> Array:
        """Displacement (k, 3) [m] of the target across the normal at times (k,) [s], as of `travel`."""
        return self.collision.aside(np.asarray(time) - self.contact_start)

    def displacement(self, time: Array) -> Array:
        """Displacement (k, 3) [m] of the target at times (k,) [s], as of `travel`."""
        return np.outer(self.travel(time), self.problem.normal) + self.aside(time)

    def stances(self) -> list[dict[str, Any]]:
        """Stance phases as in ``summary.json``; none if the problem has one stance.

        Standing soles, begin and end [s], and displacements [m] of soles from their places at the start.
        """
        out = []
        displacements = places_of_soles(self.problem.stances, [sole.name for sole in self.problem.soles])
        for k, (stance, places) in enumerate(zip(self.problem.stances, displacements, strict=True)):
            own = [piece for piece in self.pieces() if piece.number == k]
            end = own[-1].start + own[-1].spline.duration
            moved = {name: at.tolist() for name, at in places.items() if at.any()}
            phase = {"soles": list(stance.soles), "from_s": own[0].start, "to_s": end}
            out.append(phase | ({"moved_m": moved} if moved else {}))
        return out

    def landing_speeds(self) -> dict[str, float]:
        """Planned speed [m/s] of the fastest corner of each sole that touches down, by the sole's name."""
        p, out = self.problem, dict[str, float]()
        robot, data = p.robot, p.robot.model.createData()
        for one, other in pairwise(self.pieces()):
            landed = p.standing[other.number] & ~p.standing[one.number]
            for sole in (sole for sole, down in zip(p.soles, landed, strict=True) if down):
                c, end = p.stance_coordinates[one.number], one.start + one.spline.duration
                (y,), (yd,), (ydd,), _ = one.sample(np.array([end]))
                q, v, _ = c.complete_motion(y, yd, ydd, c.solve_legs(y, c.start_legs))
                pin.forwardKinematics(robot.model, data, q, v)
                frame = robot.model.getFrameId(sole.frame)
                # LOCAL: the corners are known in the sole's own axes, and the length of a velocity is the
                # same in all
                twist = pin.getFrameVelocity(robot.model, data, frame, pin.LOCAL)
                corners = np.column_stack([sole.polygon, np.zeros(len(sole.polygon))])
                speeds = twist.linear + np.cross(twist.angular, corners)
                out[sole.name] = max(out.get(sole.name, 0.0), float(np.linalg.norm(speeds, axis=1).max()))
        return out

    def closed(self, y: Array) -> Array:
        """Configurations (k, nq) of independent coordinates (k, ny) along a continuous motion, in the stance
        phase with the impact.
        """
        c = self.coordinates
        return np.array([q for q, _ in c.leg_closure.follow(y, c.start_legs)]).reshape(len(y), c.model.nq)

    def margins(
        self,
        collision: PlannedCollision | None = None,
        reference: Trajectory | None = None,
    ) -> dict[str, dict[str, float]]:
        """Planned ZMP margin [m] and torque demand over limit, by phase.

        Phases are ``swing``, ``collision`` (not of an impact without duration), ``follow``, and ``missed``:
        from the planned contact on, if nothing is hit.

        collision : the planned one at more instants than the program has, such as `ContactError.finer`.
        reference : a coarser one, used in place of the plan's; then ``missed`` is left out.
        """
        ref = self.reference if reference is None else reference
        limit = self.problem.robot.torque_limit
        phase = ref.phase
        hit = self.collision if collision is None else collision
        zmp_margins = [
            self._zmp_margin(ref, phase == 0),
            margin_of(self.polygon, hit.ground),
            self._zmp_margin(ref, phase == 2),
        ]
        during = hit.torque if len(hit.ground) else hit.torque[:0]
        torques = [ref.torque[phase == 0], during, ref.torque[phase == 2]]
        if self.abort is not None and reference is None:
            missed = self.missed_reference
            zmp_margins.append(self._zmp_margin(missed, missed.phase > 0))
            torques.append(missed.torque[missed.phase > 0])
        names = ("swing", "collision", "follow", "missed")[: len(torques)]
        ratio = {n: float(np.abs(t / limit).max()) for n, t in zip(names, torques, strict=True) if len(t)}
        out = {"torque_ratio": ratio}
        if len(self.polygon):
            out["zmp_margin_m"] = {
                n: float(found.min()) for n, found in zip(names, zmp_margins, strict=True) if len(found)
            }
        return out

    def _zmp_margin(self, reference: Trajectory, chosen: Mask) -> Array:
        """ZMP margins (k,) [m] in the support polygon of each instant's stance phase, at chosen instants."""
        if not reference.stance.size:
            return margin_of(self.polygon, reference.ground[chosen])
        out = np.zeros(len(reference.time))
        for k, c in enumerate(self.problem.stance_coordinates):
            own = reference.stance == k
            out[own] = margin_of(support_polygon(self.problem.robot, c), reference.ground[own])
        return out[chosen]

    def sole_margins(
        self, collision: PlannedCollision | None = None, *, coarse: bool = False
    ) -> dict[str, Any]:
        """Planned margins of each sole and the required ones, as in ``summary.json``; empty without soles.

        ``sole_cop_margin_mm`` and ``sole_force_N``, by sole and phase: the smallest distance of its centre of
        pressure from its own edges (:func:`impactopt.robots.loads.cop_margin`) and its smallest normal force.
        They are taken every millisecond of swing and follow-through (``coarse``: at the coarse references'
        instants), at the known instants of the collision, and after a missed target.
        ``sole_cop_margin_asked_mm``, by phase, and ``sole_force_asked_N`` are the problem's requirements.

        collision : as of :meth:`margins`.
        """
        p, cone = self.problem, self.problem.term(ContactWrenchCone)
        if not p.soles:
            return {}
        ref = self.coarse_reference if coarse else self.reference
        hit = self.collision if collision is None else collision
        of_hit = self._wrench_of_all(p.blow, hit.sole_wrench) if p.stances else hit.sole_wrench
        # of each phase: wrenches (k, 6 a sole), and indices of stance phases (k,), or (0,) if there is one
        # stance
        parts = {
            "swing": (ref.sole_wrench[ref.phase == 0], ref.stance[ref.phase[: len(ref.stance)] == 0]),
            "collision": (of_hit, np.full(len(of_hit), p.blow)),
            "follow": (ref.sole_wrench[ref.phase == 2], ref.stance[ref.phase[: len(ref.stance)] == 2]),
        }
        if self.abort is not None:
            missed = self.coarse_missed_reference if coarse else self.missed_reference
            after = missed.phase > 0
            parts["missed"] = missed.sole_wrench[after], missed.stance[after[: len(missed.stance)]]
        labels = np.repeat(list(parts), [len(part) for part, _ in parts.values()])
        wrench = np.concatenate([part for part, _ in parts.values()])
        wrench = wrench.reshape(len(labels), -1, 6)[:, : len(p.soles)]
        stance = np.concatenate([numbers for _, numbers in parts.values()])
        margins = cop_margin(p.robot, [sole.polygon for sole in p.soles], wrench)
        required = {name: cone.collision_margin if name == "collision" else cone.margin for name in parts}
        return {
            **least_margins(
                [sole.name for sole in p.soles],
                margins,
                wrench[:, :, 2],
                {name: labels == name for name in parts},
                *((p.standing, stance) if p.stances else ()),
            ),
            "sole_cop_margin_asked_mm": {n: 1e3 * m for n, m in required.items() if m is not None},
            "sole_force_asked_N": cone.minimum_force,
        }


def motion_loads(robot: Robot, reference: Trajectory, hit: PlannedCollision) -> DriveLoads:
    """Loads of a reference before and after contact, and of the collision, at all known instants."""
    phase, base = reference.phase, robot.nv - robot.n
    rates, outside = reference.v[:, base:], phase != 1
    # the reference's phase 1 coasts, so the jump by the impact is between the phases beside it
    jump = rates[phase == 2][0] - rates[phase == 0][-1]
    motion = reference.torque[outside], rates[outside], reference.a[outside, base:]
    return _loads(robot, motion, hit, jump)


def plan_loads(robot: Robot, plan: Plan, hits: Sequence[PlannedCollision]) -> list[DriveLoads]:
    """Loads of a plan's motions every `COARSE_STEP`, including the abort motion, and of its collisions.

    hits : with the expected target, then with those of scenarios.
    """
    expected, *others = hits
    references = [plan.coarse_reference]
    if plan.abort is not None:
        references.append(plan.coarse_missed_reference)
    out = [motion_loads(robot, reference, expected) for reference in references]
    still = np.zeros(robot.nv)
    return out + [strike_loads(robot, still, still, hit) for hit in others]


def strike_loads(robot: Robot, before: Array, after: Array, hit: PlannedCollision) -> DriveLoads:
    """Loads of a collision alone.  before, after (nv,): the robot's velocities."""
    none = np.zeros((0, robot.n))
    return _loads(robot, (none, none, none), hit, (after - before)[-robot.n :])


def gear_share(problem: ImpactProblem, torque: Array, acceleration: Array) -> Array:
    """(k,) Largest ratio of a gear's load to the problem's limit; zeros if it has none.

    torque, acceleration (k, n) : of the joints.
    """
    term, robot = problem.extra(GearLoad), problem.robot
    if term is None or not term.active or not acceleration.size:
        return np.zeros(len(torque))
    load = gear_torque(robot, torque, acceleration) / robot.torque_limit / term.most(robot)
    return np.asarray(np.abs(load).max(axis=1, initial=0.0))


def _loads(robot: Robot, motion: tuple[Array, ...], hit: PlannedCollision, jump: Array) -> DriveLoads:
    """motion : torque, velocity, acceleration (k, n) of the joints.  jump (n,) : of velocities, at impact."""
    # an impact without duration has no accelerations, and no torques of its own
    parts = [motion, (hit.torque, hit.velocity, hit.acceleration)][: 1 + bool(hit.acceleration.size)]
    torque, velocity, acceleration = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    gear = gear_torque(robot, torque, acceleration)
    return DriveLoads.of(robot, gear=gear, torque=torque, velocity=velocity, jump=jump)


@dataclass(frozen=True, kw_only=True, eq=False)
class PlannedStrike:
    """Planned impact alone: the robot's state at contact, and the prediction of the collision.

    posture (nq,), velocity (nv,) : Pinocchio's, at contact; posture_after, velocity_after : at separation.
    torque (n,) : feed-forward that makes the robot coast at contact [N m]; ground (6,) : the total ground
        wrench about the world's origin then [N, N m].
    compression, restitution : [s].  hand_speed : along the normal at contact [m/s].  impulse : to the target
        [N s].  collision, scenarios : as of :class:`impactopt.Plan`.
    """

    problem: ImpactProblem
    posture: Array
    velocity: Array
    posture_after: Array
    velocity_after: Array
    torque: Array
    ground: Array
    compression: float
    restitution: float
    collision: PlannedCollision
    hand_speed: float
    impulse: float
    scenarios: tuple[PlannedScenario, ...] = ()

    def margins(self) -> dict[str, Any]:
        """Torque demand over limit and ZMP margin [m] at contact and in the collision; capture margin [m].

        The capture point is that after contact. An impact without duration has no torque and no ZMP.
        """
        limit, hit = self.problem.robot.torque_limit, self.collision
        torques = {"contact": self.torque, "collision": hit.torque if self.problem.lasts else hit.torque[:0]}
        out: dict[str, Any] = {
            "torque_ratio": {name: float(np.abs(t / limit).max()) for name, t in torques.items() if len(t)}
        }
        polygon = support_polygon(self.problem.robot, self.problem.coordinates)
        if not len(polygon):
            return out
        grounds = {"contact": self.ground[None], "collision": hit.ground}
        out["zmp_margin_m"] = {
            name: float(margin(polygon, zmp(wrench)).min()) for name, wrench in grounds.items() if len(wrench)
        }
        robot = self.problem.robot
        data = robot.model.createData()
        capture = robot.capture_point(data, self.posture_after, self.velocity_after)
        out["capture_margin_m"] = float(margin(polygon, capture[None])[0])
        return out

    def loads(self) -> DriveLoads:
        """Peak loads of gears and motors in the impact."""
        before, after = self.velocity, self.velocity_after
        return strike_loads(self.problem.robot, before, after, self.collision)
