"""The objective in parts, rows of what it lifts, and rows of terms that not every problem has."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.problem.objectives import (
    AngularMomentum,
    Impulse,
    Objective,
    PeakForce,
    Penetration,
    TargetEnergy,
)
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import Gaze, HandOrientation, TargetSpeed
from oracle.blow import DEPTH, Blow
from oracle.motions import Way
from oracle.robot_motion import RobotMotion
from oracle.variables import Piece, Variables

Array = NDArray[np.float64]
GONE = "target's way after contact"  # [m], a variable where the target may be slow then
PEAK = 100.0  # [N] of which the peak force is a multiple


def orientation_pieces(
    problem: ImpactProblem, robot: RobotMotion, at_contact: Callable[[Variables], Array]
) -> list[Piece]:
    """How the hand is turned at contact."""
    term = problem.extra(HandOrientation)
    if term is None:
        return []
    direction = np.asarray(problem.normal if term.direction is None else term.direction)
    axis, angle = np.asarray(term.axis), term.angle

    def value(v: Variables) -> Array:
        turn = robot.striking(at_contact(v), np.zeros(robot.ny))[2]
        return np.array([direction @ turn @ axis / np.sin(angle)])

    return [Piece.of(value, [(term.name, "contact", [problem.striker], 1 / np.tan(angle), np.inf)])]


def gaze_pieces(problem: ImpactProblem, swing: Way) -> list[Piece]:
    """Where a frame looks, at the swing's nodes after a part of it."""
    term, robot = problem.extra(Gaze), swing.robot
    if term is None:
        return []
    frame = robot.model.getFrameId(term.frame)

    def piece(k: int, s: float) -> Piece:
        def value(v: Variables) -> Array:
            y, legs = swing.at(s)(v)[0], v.get("swing legs", k)
            pin.forwardKinematics(robot.model, robot.data, robot.posture(y, legs))
            at = pin.updateFramePlacement(robot.model, robot.data, frame)
            way = problem.point - at.translation
            cosine = way @ at.rotation @ np.asarray(term.axis) / np.sqrt(way @ way + 1e-8)
            return np.array([cosine / np.sin(term.angle)])

        return Piece.of(value, [(term.name, swing.place(s), [term.frame], 1 / np.tan(term.angle), np.inf)])

    return [piece(k, float(s)) for k, s in enumerate(swing.nodes) if s >= term.since]


def speed_pieces(problem: ImpactProblem, blow: Blow, follow: Way) -> list[Piece]:
    """How fast the target is after the blow, and how far it gets until the follow-through ends."""
    term, target = problem.extra(TargetSpeed), problem.target
    if term is None:
        return []
    last = len(blow.stages) - 1

    def value(v: Variables) -> Array:
        return np.array([float(target.velocity(blow.get(v, "target state", last), blow.target))])

    def way(v: Variables) -> Array:
        return v.one(follow.T) * value(v) - v.one(GONE)

    found = [Piece.of(value, [(term.name, "separation", ["normal"], term.least, term.most)])]
    if not target.stays:
        found.append(Piece.of(way, [(GONE, follow.place(1.0), [GONE], 0.0, 0.0)]))
    return found


def worth_pieces(
    problem: ImpactProblem, blow: Blow, approach: Callable[[Variables], float]
) -> tuple[list[Piece], list[Piece]]:
    """Rows of what objectives lift, and minus what they are worth.

    approach : speed of the striker along the normal at contact [m/s].
    """
    rows, worth = [], []
    for objective in problem.objectives:
        factor = objective.weight if objective.cost else -objective.weight
        found = _lifted(problem, blow, approach, objective)
        if found is None:
            continue
        quantity, row = found

        def value(v: Variables, quantity: Any = quantity, factor: float = factor) -> Array:
            return np.array([factor * quantity(v)])

        worth.append(Piece(value))
        rows += [] if row is None else [row]
    return rows, worth


def _lifted(
    problem: ImpactProblem, blow: Blow, approach: Callable[[Variables], float], objective: Objective
) -> tuple[Callable[[Variables], float], Piece | None] | None:
    """What an objective weighs, and the row that makes a variable of it if there is one."""
    last, target = blow.end[-1], problem.target
    if isinstance(objective, Impulse):
        return (lambda v: float(blow.get(v, "impulse so far", last)[0])), None
    if isinstance(objective, AngularMomentum):
        return (lambda v: float(np.sum(v.get("angular momentum") ** 2))), None
    if isinstance(objective, TargetEnergy):
        name, unit = "target energy", 1.0

        def source(v: Variables) -> float:
            return float(target.energy(blow.get(v, "target state", last), blow.target))

    elif isinstance(objective, PeakForce):
        name, unit = "peak force", PEAK

        def source(v: Variables) -> float:
            rate = approach(v) - float(target.speed_before())
            first = float(problem.law.branch(0.0, rate, True, blow.law))  # of a damper, at once
            forces = [first, *(blow.get(v, "contact force", i)[0] for i in range(len(blow.stages)))]
            g = np.array(forces) / PEAK
            return float(np.sum(g**9) / (np.sum(g**8) + 1e-12))

    elif isinstance(objective, Penetration):
        name, unit = "deepest penetration", DEPTH

        def source(v: Variables) -> float:
            return blow.contact(v, blow.end[-2])[0] / DEPTH

    else:
        return None

    def row(v: Variables) -> Array:
        return np.array([source(v) - v.one(name)])

    return (lambda v: unit * v.one(name)), Piece.of(row, [(name, "", [name], 0.0, 0.0)])


def price_pieces(problem: ImpactProblem, ways: Sequence[Way], blows: Sequence[Blow]) -> list[Piece]:
    """Prices of the motion style, and small ones of accelerations, wrenches and ends away from the start."""
    p, style, out = problem, problem.style_prices, list[Piece]()
    for way in ways:
        robot = way.robot
        moving = np.full(robot.ny, style.speed)
        moving[: robot.base] *= not robot.drifts
        moving[robot.base :] += style.idle_speed * p.idle_joints[robot.independent]
        typical = float(np.mean(way.phase.duration))
        for s, length in zip(way.nodes, np.gradient(way.nodes), strict=True):
            weight, at = p.smoothness * length / typical**3, way.at(float(s))
            speeds = moving * length / typical

            def bending(v: Variables, at: Any = at, weight: float = weight, speeds: Array = speeds) -> Array:
                _, rate, bend = at(v)
                return np.array([weight * np.sum(bend**2) + speeds @ rate**2])

            out.append(Piece(bending))
        for s, end in pairwise(way.breaks) if style.jerk else ():
            weight, third = style.jerk * (end - s) / typical**5, way.third((s + end) / 2)

            def jerking(v: Variables, third: Any = third, weight: float = weight) -> Array:
                return np.array([weight * np.sum(third(v) ** 2)])

            out.append(Piece(jerking))
        if way.rests:

            def away(v: Variables, way: Way = way) -> Array:
                gap = (way.control(v, way.last) - way.robot.y0)[6 * way.drifts :]
                return np.array([(p.return_price + style.end) * np.sum(gap**2)])

            out.append(Piece(away))
    groups = [(f"{way.kind} sole wrench", len(way.nodes), way.robot) for way in ways]
    groups += [(f"{blow.prefix}collision sole wrench", len(blow.stages), blow.robot) for blow in blows]
    groups += [("coasting sole wrench", 1, ways[0].robot)] if p.abort_after is not None else []
    for name, count, robot in groups:
        price = 0.5 * p.wrench_price / count / robot.wrench_scale**2
        for k in range(count if robot.soles else 0):

            def pushing(v: Variables, name: str = name, k: int = k, price: Array = price) -> Array:
                return np.array([np.sum(price * v.get(name, k) ** 2)])

            out.append(Piece(pushing))
    return out
