"""Swing and motions to rest: their splines, and the rows at their nodes."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from impactopt.kinematics.splines import graded_breaks, knots
from impactopt.kinematics.stance import contact_wrench_cone
from impactopt.problem.phases import Phase
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import (
    ContactWrenchCone,
    Grip,
    LegExtension,
    PositionLimit,
    TorqueLimit,
    VelocityLimit,
)
from impactopt.problem.terms.grip import WRENCH
from impactopt.robots.tools import inside
from oracle.robot_motion import RobotMotion
from oracle.variables import Piece, Variables

Array = NDArray[Any]
End = str | Callable[["Variables"], NDArray[np.float64]]  # rest, free, coasting, or at these coordinates
NONE = np.zeros(0)
DIRECTIONS = ("x", "y", "z", "roll", "pitch", "yaw")
BASE_BOX = np.array([0.6, 0.6, 0.6, 0.8, 0.8, 1.2])  # [m, rad] how far the base may go from its start
FREE_BOX = np.array([np.inf, np.inf, np.inf, 3.0, 1.2, 3.0])  # the same of one that nothing holds
REST, FREE, COASTING = "rest", "free", "coasting"  # how a spline may begin or end


class Limits:
    """What bounds a motion, as numbers of the problem's terms."""

    def __init__(self, problem: ImpactProblem, robot: RobotMotion) -> None:
        r = problem.robot
        self.torque, self.velocity = problem.term(TorqueLimit), problem.term(VelocityLimit)
        self.cone, self.extension = problem.term(ContactWrenchCone), problem.term(LegExtension)
        self.grip = problem.extra(Grip)
        lower, upper = inside(r, problem.term(PositionLimit).margin)
        box = (FREE_BOX if robot.drifts else BASE_BOX)[: robot.base]
        self.y = (
            np.concatenate([robot.y0[: robot.base] - box, lower[robot.independent]]),
            np.concatenate([robot.y0[: robot.base] + box, upper[robot.independent]]),
        )
        self.legs = lower[robot.dependent], upper[robot.dependent]
        self.tendons = lower[r.n :], upper[r.n :]

    def cone_rows(
        self,
        robot: RobotMotion,
        place: str,
        margin: float | None,
        least: float,
        fading: Collection[str] = (),
        lifted: Array = NONE,
    ) -> tuple[Callable[[Array], Array], list[Any]]:
        """Of wrenches (6 a sole): how far inside the cone they are, and what hands that hold on bear, over
        what they may; with the rows that say so.  margin : [m]; None: the cone is not asked for.
        fading : soles that may bear nothing.  lifted : numbers of those that do.
        """
        parts, rows = [], list[Any]()
        for k, (leg, *_) in enumerate(robot.soles):
            if k in lifted:
                continue
            if leg.sole is None:
                assert self.grip is not None  # the problem has it
                most = np.repeat([self.grip.force, self.grip.moment], 3)
                parts.append((k, np.diag(1 / most)))
                rows.append((self.grip.name, place, [f"{leg.end} {name}" for name in WRENCH], -1.0, 1.0))
                continue
            if margin is None:
                continue
            facets = contact_wrench_cone(leg.sole.polygon, self.cone.friction, margin=margin) / robot.weight
            normal = np.zeros((1, 6))
            normal[0, 2] = 1 / robot.weight
            name = leg.end
            components = [f"{name}, facet {i}" for i in range(len(facets))]
            rows.append((self.cone.name, place, components, 0.0, np.inf))
            if leg.name in fading:
                parts.append((k, facets))
                continue
            parts.append((k, np.vstack([facets, normal])))
            rows.append(("normal force", place, [name], least / robot.weight, np.inf))

        def inside(w: Array) -> Array:
            found = [matrix @ w[6 * k : 6 * k + 6] for k, matrix in parts]
            return np.concatenate([np.zeros(0), *found])

        return inside, rows


class Way:
    """A motion before or after contact: a cubic spline whose control points are variables.

    kind : first word of its variables' names; name : of its places.  more : nodes beside the ends and middles
    of its intervals.  fine_end : whether its intervals are finer where it ends.

    Attributes
    ----------
    number : of its stance phase.  lifted : soles that bear nothing, by the node where they begin or cease to.
    """

    def __init__(
        self,
        robot: RobotMotion,
        number: int,
        names: tuple[str, str],
        phase: Phase,
        more: tuple[float, ...],
        begins: End,
        ends: End,
        *,
        fine_end: bool,
    ) -> None:
        self.robot, self.number, self.phase, (self.kind, self.name) = robot, number, phase, names
        self.swings, self.rests = ends == COASTING, ends == REST
        self._begins, self._ends, self.lifted = begins, ends, dict[int, Array]()
        self.breaks = graded_breaks(phase.intervals, phase.grading, fine_end=fine_end)
        middles = (self.breaks[1:] + self.breaks[:-1]) / 2
        inside = np.sort(np.concatenate([self.breaks, middles]))
        self.nodes = np.union1d(inside[1:] if begins == REST else inside, more)
        self.more, self._y0 = more, robot.y0
        self.drifts, self.last = robot.drifts, phase.intervals + 2
        # how many control points at its ends are no variables
        self.lead = {REST: 3, FREE: 0}[begins] if isinstance(begins, str) else 1
        tail = {REST: 2, FREE: 0, COASTING: 1}[ends] if isinstance(ends, str) else 1
        self._points = self.last + 1 - self.lead - tail
        # control points whose base is a variable of its own, as an end at rest is one of joints alone
        ends_drift = (2, self.last) if self.swings else (self.last - 1, self.last)
        self._drifting = ends_drift if robot.drifts else ()
        t = knots(self.breaks)
        # the velocity's control points are these times differences of the curve's
        self.factors = 3.0 / (t[4:-1] - t[1:-4])
        self._curve = BSpline(t, np.eye(len(self.breaks) + 2), 3)
        self.control_group, self.T = f"{self.kind} control point", f"{self.kind} duration"

    def place(self, s: float) -> str:
        percent = f"{100 * s:.2f} %" if s in self.more else f"{100 * s:.0f} %"
        return f"{self.name}, {percent}"

    def control(self, v: Variables, j: int) -> Array:
        """Control point j = 0 .. intervals + 2: three that are the same make a start or an end at rest, and
        a last one on the line of those before it an end without acceleration.
        """
        point = self._control(v, j)
        if j not in self._drifting:
            return point
        base = v.get(f"{self.kind} base control point", self._drifting.index(j))
        return np.concatenate([base, point[6:]])

    def _control(self, v: Variables, j: int) -> Array:
        if j < self.lead:
            return self._y0 if isinstance(self._begins, str) else self._begins(v)
        if j < self.lead + self._points or self.rests:
            return v.get(self.control_group, min(j - self.lead, self._points - 1))
        if not isinstance(self._ends, str):
            return self._ends(v)
        one, two = self.control(v, j - 2), self.control(v, j - 1)
        return two + (two - one) * (self.factors[-2] / self.factors[-1])

    def curve(self, v: Variables) -> tuple[BSpline, BSpline, BSpline]:
        """y, y' and y'' as functions of s."""
        points = np.array([self.control(v, j) for j in range(len(self.breaks) + 2)])
        curve = BSpline(knots(self.breaks), points, 3)
        return curve, curve.derivative(), curve.derivative(2)

    def at(self, s: float) -> Callable[[Variables], tuple[Array, Array, Array]]:
        """y, y', y'' at a fraction s, as a function of the variables."""
        derivatives = self._derivatives(s, range(3))

        def values(v: Variables) -> tuple[Array, Array, Array]:
            y, y1, y2 = derivatives(v)
            return y, y1, y2

        return values

    def third(self, s: float) -> Callable[[Variables], Array]:
        """y''' at a fraction s, as a function of the variables."""
        derivatives = self._derivatives(s, [3])
        return lambda v: derivatives(v)[0]

    def _derivatives(self, s: float, orders: Sequence[int]) -> Callable[[Variables], list[Array]]:
        """Derivatives of y by s, of few control points each."""
        weights = np.array([self._curve(s, order) for order in orders])
        used = np.flatnonzero(np.abs(weights).max(axis=0))
        return lambda v: list(weights[:, used] @ np.array([self.control(v, int(j)) for j in used]))

    def wrench(self, v: Variables, k: int) -> Array:
        """Sole wrenches (6 a sole) at node k."""
        w = v.get(f"{self.kind} sole wrench", k)
        for sole in self.lifted.get(k, ()):
            w = np.where(np.arange(len(w)) // 6 == sole, 0.0, w)
        return w

    def end(self, v: Variables, s: float) -> tuple[Array, Array]:
        """Coordinates and legs where it begins (s = 0) or ends (1)."""
        return self.at(s)(v)[0], v.get(f"{self.kind} legs", -1 if s else 0)

    def at_node(self, s: float, k: int) -> Callable[[Variables], tuple[Array, Array, Array]]:
        """The same at node k, where the acceleration of a base that nothing holds is a variable."""
        at = self.at(s)

        def values(v: Variables) -> tuple[Array, Array, Array]:
            y, y1, y2 = at(v)
            return y, y1, np.concatenate([v.get(f"{self.kind} base acceleration", k), y2[6:]])

        return values if self.drifts else at


def node_piece(
    robot: RobotMotion,
    limits: Limits,
    place: str,
    state: Callable[[Variables], tuple[Array, Array, Array, Array, Array, float]],
    *,
    closed: bool = True,
    feedforward: bool = False,
    lifted: str | None = None,
    soles: tuple[Collection[str], Array] = ((), NONE),
) -> Piece:
    """Rows of a node.  state : y, y', y'', legs, sole wrenches, T.  soles : fading and lifted ones.

    closed : whether its legs have rows of their own.  feedforward : whether its torque is that variable.
    lifted : variables that are its torque over limit; None: there are none.
    """
    problem_limits, n = robot.robot, robot.n
    names, fraction = problem_limits.joint_names, limits.torque.fraction
    rates, fast = problem_limits.velocity_limit[robot.dependent], limits.velocity.fraction
    inside, cone = limits.cone_rows(robot, place, limits.cone.margin, limits.cone.minimum_force, *soles)
    closure = [f"{leg.end} {d}" for leg, *_ in robot.soles for d in DIRECTIONS]

    def value(v: Variables) -> Array:
        y, y1, y2, legs, w, T = state(v)
        q, qd, qdd = robot.motion(y, legs, y1 / T, y2 / T**2)
        tau = robot.torque(q, qd, qdd, w)
        demand = tau[robot.base :] / problem_limits.torque_limit
        if feedforward:
            demand = demand - v.get("feed-forward at contact")
        elif lifted is not None:
            demand = demand - v.get(lifted)
        parts = [robot.closure(q)] if closed else []
        parts += [qd[robot.base + robot.dependent] / rates, tau[: robot.base] / robot.base_scale]
        return np.concatenate([*parts, robot.extension(q), inside(w), demand])

    rows: list[Any] = [("closed legs", place, closure, 0.0, 0.0)] if closed else []
    rows += [
        (limits.velocity.name, place, robot.leg_labels, -fast, fast),
        ("equation of motion of the base", place, DIRECTIONS[: robot.base], 0.0, 0.0),
        (
            limits.extension.name,
            place,
            [leg.limb for leg, *_ in robot.soles],
            limits.extension.minimum,
            np.inf,
        ),
        *cone,
    ]
    if feedforward:
        rows.append(("feed-forward that makes the robot coast", "contact", names, 0.0, 0.0))
    else:
        most = np.full(n, 0.0 if lifted is not None else fraction)
        rows.append((limits.torque.name, place, names, -most, most))
    return Piece.of(value, rows)


def rate_pieces(robot: RobotMotion, limits: Limits, way: Way) -> list[Piece]:
    """Velocity control points within the limit, multiplied by the duration."""
    joints = np.arange(robot.base, robot.ny)
    bound = (limits.velocity.fraction * robot.robot.velocity_limit)[robot.independent]
    names = robot.labels[robot.base :]
    shortest, longest = way.phase.duration
    steps = range(max(way.lead - 1, 0), way.last - 2 * way.rests)
    out = []
    for j in steps:

        def step(v: Variables, j: int = j) -> Array:
            found = (way.control(v, j + 1) - way.control(v, j))[joints]
            return np.asarray(found * way.factors[j] / bound)

        name = f"{way.name}, control point {j}"
        if shortest == longest:
            out.append(Piece.of(step, [(limits.velocity.name, name, names, -longest, longest)]))
            continue

        def both(v: Variables, step: Callable[[Variables], Array] = step) -> Array:
            found, T = step(v), v.one(way.T)
            return np.concatenate([found - T, -found - T])

        rows: list[Any] = [
            (limits.velocity.name, f"{name}, {direction}", names, -np.inf, 0.0)
            for direction in ("forward", "backward")
        ]
        out.append(Piece.of(both, rows))
    return out


def momentum_pieces(robot: RobotMotion, way: Way) -> list[Piece]:
    """Momentum of a robot that nothing holds, in the middles of a motion's intervals and at its end: as at
    its beginning, and what gravity adds. A swing begins without any, a follow-through with what the blow has
    left.
    """
    middles, out, lifted = (way.breaks[1:] + way.breaks[:-1]) / 2, [], f"{way.kind} momentum"
    for s in map(float, [*([] if way.swings else [0.0]), *middles, 1.0]):

        def value(v: Variables, s: float = s) -> Array:
            y, y1, _ = way.at(s)(v)
            T = v.one(way.T)
            q, qd, _ = robot.motion(y, np.zeros(0), y1 / T, 0 * y)
            before = 0.0 if way.swings else v.get(lifted)
            return np.asarray(robot.weighed_momentum(q, qd) - before - s * T * robot.pull)

        out.append(Piece.of(value, [("momentum", way.place(s), DIRECTIONS, 0.0, 0.0)]))
    return out
