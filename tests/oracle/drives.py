"""What joints and their drives bear: torques as variables, loads of gears, springs, effort."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from impactopt.problem.objectives import Effort
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import GearLoad
from oracle.blow import FORCE, Blow
from oracle.motions import DIRECTIONS, Way
from oracle.robot_motion import RobotMotion
from oracle.variables import Piece, Variables

Array = NDArray[np.float64]
COASTED = "end of coasting, if nothing is hit"  # a node's place
FEEDFORWARD = "feed-forward at contact"
JUMP = 100.0  # [rad/s2] of which the first instant's change of acceleration is a multiple
_SIMPSON = np.array([1.0, 4.0, 1.0]) / 6


class Point(NamedTuple):
    """Torques of the servos over limit (n,), and q, v, a, at a place."""

    place: str
    torque: Callable[[Variables], Array]
    motion: Callable[[Variables], tuple[Array, Array, Array]]


class Moves(Protocol):
    """What a program knows of its motions."""

    problem: ImpactProblem
    robot: RobotMotion
    ways: list[Way]
    blows: list[Blow]

    def node(self, way: Way, k: int) -> Callable[[Variables], Any]:
        """y, y', y'', legs, sole wrenches and T at a node."""
        ...

    def state_at_contact(self, v: Variables) -> tuple[Array, Array]:
        """Coordinates and rates."""
        ...


class Drives:
    """Gears, springs and effort, of a program whose torques are variables.

    names : of all groups of variables.  coasting : of the node where coasting ends, if there is one.

    Attributes
    ----------
    rows, worth, scales, missing : as of `oracle.program.Program`.
    """

    def __init__(
        self, moves: Moves, names: Collection[str], coasting: Callable[[Variables], Any] | None
    ) -> None:
        p = moves.problem
        self._moves, self._coasting = moves, coasting
        self.rows, self.worth = list[Piece](), list[Piece]()
        self.scales: dict[str, Array] = {}
        self.missing: list[str] = []
        gears, effort = p.extra(GearLoad) is not None, any(isinstance(o, Effort) for o in p.objectives)
        if not (gears or effort or p.robot.passive.any()):
            return
        nodes = [(way, float(s)) for way in moves.ways for s in way.nodes[: -1 if way.swings else None]]
        wanted = {node_torque(way.place(s)) for way, s in nodes}
        if gears:
            wanted |= {blow.torque(i) for blow in moves.blows for i in range(len(blow.stages))}
        if not wanted <= set(names):
            self.missing.append("drives whose torques are no variables")
            return
        self.rows += spring_pieces(moves.robot, moves.ways, self._torque)
        self.rows += hinge_pieces(moves.robot, moves.ways, self._torque)
        rows, self.worth = effort_pieces(p, moves.robot, moves.ways, self._torque)
        self.rows += rows
        if gears:
            self.rows += gear_pieces(p, moves.robot, [*self._at_nodes(), *self._in_contact()])

    def _torque(self, way: Way, k: int) -> Callable[[Variables], Array]:
        """Over limit, at a node; -1: the start."""
        if k < 0:
            start = self._moves.robot.resting() / self._moves.problem.robot.torque_limit
            return lambda v: start
        last = way.swings and k == len(way.nodes) - 1
        name = FEEDFORWARD if last else node_torque(way.place(float(way.nodes[k])))
        return lambda v: v.get(name)

    def _at_nodes(self) -> list[Point]:
        robot = self._moves.robot

        def moving(state: Callable[[Variables], Any]) -> Callable[[Variables], Any]:
            def motion(v: Variables) -> tuple[Array, Array, Array]:
                y, y1, y2, legs, _, T = state(v)
                return robot.motion(y, legs, y1 / T, y2 / T**2)

            return motion

        out = [
            Point(way.place(float(s)), self._torque(way, k), moving(self._moves.node(way, k)))
            for way in self._moves.ways
            for k, s in enumerate(way.nodes)
        ]
        if self._coasting is not None:
            out.append(Point(COASTED, partial(_variable, node_torque(COASTED)), moving(self._coasting)))
        return out

    def _in_contact(self) -> list[Point]:
        moves, p = self._moves, self._moves.problem
        out = [
            Point(blow.place(i), partial(_variable, blow.torque(i)), partial(_at_stage, blow, i))
            for blow in moves.blows
            for i in range(len(blow.stages))
        ]
        if float(p.law.branch(0.0, 1.0, True)) == 0.0:
            return out
        last = len(moves.ways[0].nodes) - 1

        def contact(v: Variables) -> tuple[Array, Array, Array]:
            return moves.state_at_contact(v)[0], v.get("swing legs", last), v.get("rate at contact")

        for blow in moves.blows:
            first = FirstInstant(p, moves.robot, blow, contact)
            self.scales |= first.scales()
            self.rows.append(first.piece())
            out.append(Point(first.place, partial(_variable, FEEDFORWARD), first.motion))
        return out


def _variable(name: str, v: Variables) -> Array:
    return v.get(name)


def _at_stage(blow: Blow, i: int, v: Variables) -> tuple[Array, Array, Array]:
    return blow.motion(v, i)


def node_torque(place: str) -> str:
    """Name of the torque at a node, where that is a variable."""
    return f"torque, {place}"


class FirstInstant:
    """The first instant of a contact that has a force at once, by which accelerations jump.

    state : coordinates and legs at contact, and the coordinates' rates.
    """

    def __init__(
        self,
        problem: ImpactProblem,
        robot: RobotMotion,
        blow: Blow,
        state: Callable[[Variables], tuple[Array, Array, Array]],
    ) -> None:
        self._problem, self._robot, self._blow, self._state = problem, robot, blow, state
        self.place = f"first instant of contact{blow.suffix}"
        names = ("jump of acceleration", "jump of sole wrench", "first force")
        self._change, self._wrench, self._force = (name + blow.suffix for name in names)

    def scales(self) -> dict[str, Array]:
        return {
            self._change: np.array([JUMP]),
            self._wrench: self._robot.wrench_scale,
            self._force: np.array([FORCE]),
        }

    def motion(self, v: Variables) -> tuple[Array, Array, Array]:
        """q, v and a: that of coasting, and the jump."""
        y, legs, u = self._state(v)
        return self._robot.motion(y, legs, u, v.get(self._change))

    def piece(self) -> Piece:
        """What changes is balanced: inertia x jump = sole wrenches - force; and the law."""
        robot, names = self._robot, self._robot.robot.joint_names
        law, before = self._problem.law, float(self._problem.target.speed_before())

        def value(v: Variables) -> Array:
            y, legs, u = self._state(v)
            none, force = np.zeros(robot.ny), v.one(self._force)
            _, rates, _ = robot.motion(y, legs, u, none)
            q, jump, _ = robot.motion(y, legs, v.get(self._change), none)
            fast = float(robot.normal @ robot.striking(y, u)[1])
            still = np.zeros(robot.model.nv)
            bare = robot.torque(q, still, still, 0 * v.get(self._wrench))
            left = robot.torque(q, still, jump, v.get(self._wrench)) - bare
            left += robot.pushed(q, rates, [force])
            wanted = float(law.branch(0.0, fast - before, True, self._blow.law))
            return np.concatenate(
                [
                    left[: robot.base] / robot.base_scale,
                    left[robot.base :] / robot.robot.torque_limit,
                    [(force - wanted) / FORCE],
                ]
            )

        rows: list[Any] = [
            ("jump of acceleration", self.place, [*DIRECTIONS[: robot.base], *names], 0.0, 0.0),
            ("contact law", self.place, ["force"], 0.0, 0.0),
        ]
        return Piece.of(value, rows)


def gear_pieces(problem: ImpactProblem, robot: RobotMotion, points: Sequence[Point]) -> list[Piece]:
    """Torque through gears: the servo's, less armature x acceleration."""
    term, r = problem.extra(GearLoad), robot.robot
    if term is None:
        return []
    most, share = term.most(r), r.armature / r.torque_limit

    def piece(point: Point) -> Piece:
        def value(v: Variables) -> Array:
            return point.torque(v) - share * point.motion(v)[2][robot.base :]

        return Piece.of(value, [(term.name, point.place, r.joint_names, -most, most)])

    return [piece(point) for point in points]


def spring_pieces(
    robot: RobotMotion, ways: Sequence[Way], torque: Callable[[Way, int], Callable[[Variables], Array]]
) -> list[Piece]:
    """Joints that a spring and a damper move bear  torque at rest - stiffness x turn - damping x rate.

    As means over the intervals of a motion to contact, and at its end; at the ends of the others' intervals.
    torque : of a node, by its number; -1: the start.
    """
    r = robot.robot
    passive = np.flatnonzero(r.sprung)
    if not passive.size:
        return []
    names = [r.joint_names[k] for k in passive]
    at = robot.base + np.array([int(np.flatnonzero(robot.independent == k)[0]) for k in passive])
    rest = robot.resting()[passive] / r.torque_limit[passive]
    stiffness, damping = (gain[passive] / r.torque_limit[passive] for gain in (r.kp, r.kd))

    def piece(way: Way, place: str, parts: Sequence[tuple[float, float, int]]) -> Piece:
        """parts : weight, fraction of the motion, and its node."""
        curves = [(weight, way.at(s), torque(way, node)) for weight, s, node in parts]

        def value(v: Variables) -> Array:
            out = np.zeros(len(at))
            for weight, curve, borne in curves:
                y, y1, _ = curve(v)
                turn, rate = y[at] - robot.y0[at], y1[at] / v.one(way.T)
                out -= weight * (stiffness * turn + damping * rate + borne(v)[passive])
            return out

        return Piece.of(value, [("spring of a joint", place, names, -rest, -rest)])

    def node_at(way: Way, s: float) -> int:
        near = np.flatnonzero(np.isclose(way.nodes, s))
        return int(near[0]) if near.size else -1

    out = []
    for way in ways:
        if way.swings:
            for one, other in pairwise(way.breaks):
                middle = (one + other) / 2
                three = [
                    (w, float(s), node_at(way, s))
                    for w, s in zip(_SIMPSON, (one, middle, other), strict=True)
                ]
                out.append(piece(way, way.place(float(middle)), three))
        for k, s in enumerate(way.nodes):
            ends = bool(np.isclose(s, way.breaks).any())
            if ends and (not way.swings or k == len(way.nodes) - 1):
                out.append(piece(way, way.place(float(s)), [(1.0, float(s), k)]))
    return out


def hinge_pieces(
    robot: RobotMotion, ways: Sequence[Way], torque: Callable[[Way, int], Callable[[Variables], Array]]
) -> list[Piece]:
    """Hinges of soles bear no torque, at all nodes."""
    free = np.flatnonzero(robot.robot.hinges)
    if not free.size:
        return []
    names = [robot.robot.joint_names[k] for k in free]

    def piece(way: Way, k: int, s: float) -> Piece:
        borne = torque(way, k)
        return Piece.of(lambda v: borne(v)[free], [("hinge of a sole", way.place(s), names, 0.0, 0.0)])

    return [piece(way, k, float(s)) for way in ways for k, s in enumerate(way.nodes)]


def _timed(name: str, price: float, v: Variables) -> Array:
    return np.array([price * v.one(name)])


def effort_pieces(
    problem: ImpactProblem,
    robot: RobotMotion,
    ways: Sequence[Way],
    torque: Callable[[Way, int], Callable[[Variables], Array]],
) -> tuple[list[Piece], list[Piece]]:
    """Rows of the effort at nodes of swing and follow-through, and its price, by the trapezoidal rule."""
    weight = sum(o.weight for o in problem.objectives if isinstance(o, Effort))
    if not any(isinstance(o, Effort) for o in problem.objectives):
        return [], []
    name, rows, worth = "effort of a node", list[Piece](), list[Piece]()
    start = float(np.sum((robot.resting() / robot.robot.torque_limit) ** 2))
    number = 0
    for way in ways[:2]:
        nodes = np.concatenate([[0.0], way.nodes]) if way.swings else way.nodes
        half = np.diff(nodes) / 2
        of_node = np.concatenate([half, [0.0]]) + np.concatenate([[0.0], half])
        if way.swings:
            first, *rest = of_node
            of_node = np.array(rest)
            worth.append(Piece(partial(_timed, way.T, weight * float(first) * start)))
        for k, s in enumerate(map(float, way.nodes)):
            load = torque(way, k)

            def value(v: Variables, way: Way = way, load: Any = load, number: int = number) -> Array:
                return np.array([v.one(way.T) * np.sum(load(v) ** 2) - v.get(name)[number]])

            def price(v: Variables, number: int = number, share: float = of_node[k]) -> Array:
                return np.array([weight * share * v.get(name)[number]])

            rows.append(Piece.of(value, [(name, "", [way.place(s)], 0.0, 0.0)]))
            worth.append(Piece(price))
            number += 1
    return rows, worth
