"""A motion on soles that change: its phases, and rows where a sole lifts off, touches down or is in the air.

Of two neighbours the one on fewer soles begins, or ends, at the posture of the other. Its rates and torques
are the other's there, and the sole that changes bears nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.problem.problem import ImpactProblem
from impactopt.robots.loads import fading
from oracle.motions import COASTING, FREE, REST, End, Way
from oracle.robot_motion import RobotMotion
from oracle.variables import Piece, Variables

Array = NDArray[np.float64]
Course = Mapping[int, Way]  # phases one after the other, by their numbers
# [m] that a sole in the air is above the ground, and beside its foothold at most, within so long [s]
HEIGHT, ASIDE, WITHIN = 0.01, 0.02, 0.2


def course(
    problem: ImpactProblem,
    robots: Sequence[RobotMotion],
    numbers: range,
    main: tuple[str, str],
    more: Sequence[tuple[float, ...]],
) -> Course:
    """Phases up to contact, or from it to rest.

    main : first word of the variables' names, and name of places, of the phase with the blow.
    more : nodes beside the mesh's, of the phase with the blow and of each stance phase.
    """
    p, blow, out = problem, problem.blow, dict[int, Way]()

    def meets(k: int, other: int) -> End:
        if other not in numbers:
            return REST
        if len(robots[k].soles) > len(robots[other].soles):
            return FREE

        def posture(v: Variables) -> Array:
            y, legs = out[other].end(v, 1.0 if other < k else 0.0)
            joints = robots[other].joints(y, legs)
            return np.concatenate([y[:6], joints[robots[k].independent]])

        return posture

    for k in numbers:
        begins, ends = meets(k, k - 1), meets(k, k + 1)
        if k == blow:
            swings = main[0] == "swing"
            begins, ends = (begins, COASTING) if swings else (FREE, ends)
            phase = p.swing if swings else p.follow
            out[k] = Way(robots[k], k, main, phase, more[0], begins, ends, fine_end=swings)
            continue
        stance, missed = p.stances[k], main[0] == "abort"
        assert stance.phase is not None
        names = (
            f"stance{k}" + "-abort" * missed,
            f"on {' and '.join(stance.soles)}, phase {k + 1}" + ", if nothing is hit" * missed,
        )
        own = more[k + 1] if k + 1 < len(more) else ()
        out[k] = Way(robots[k], k, names, stance.phase, own, begins, ends, fine_end=k < blow)
    for one, other in pairwise(numbers):
        heavy = max(one, other, key=lambda k: len(robots[k].soles))
        stay = {leg.name for leg, *_ in robots[one + other - heavy].soles}
        gone = [k for k, (leg, *_) in enumerate(robots[heavy].soles) if leg.name not in stay]
        out[heavy].lifted[len(out[heavy].nodes) - 1 if heavy == one else 0] = np.array(gone)
    return out


def fading_soles(problem: ImpactProblem, number: int) -> set[str]:
    """Soles of a phase that do not stand in the one before or after it."""
    fades = fading(problem.standing)[number]
    return {sole.name for sole, fading in zip(problem.soles, fades, strict=True) if fading}


def change_pieces(ways: Course, node: Callable[[Way, int], Callable[[Variables], Any]]) -> Iterator[Piece]:
    """Where soles change: rates and torques of both phases are the same.

    node : y, y', y'', legs, sole wrenches and T of a phase at a node.
    """
    for one, other in pairwise(ways):
        light, heavy = sorted((ways[one], ways[other]), key=lambda way: len(way.robot.soles))
        term, place = "change of stance", f"between {ways[one].name} and {ways[other].name}"
        states = [node(way, len(way.nodes) - 1 if way is ways[one] else 0) for way in (light, heavy)]
        yield from _joined(light, heavy, states, term, place)


def _joined(
    light: Way, heavy: Way, states: Sequence[Callable[[Variables], Any]], term: str, place: str
) -> Iterator[Piece]:
    mine, its = light.robot, heavy.robot
    freed = np.flatnonzero(~np.isin(its.dependent, mine.dependent))
    rate, torque = f"rate {place}", f"torque {place}"
    fast = mine.robot.velocity_limit[its.dependent[freed]]

    def motion(way: Way, state: Callable[[Variables], Any], v: Variables) -> tuple[Array, Array]:
        """Rates of the joints, and torques over limit (n,)."""
        y, y1, y2, legs, w, T = state(v)
        q, qd, qdd = way.robot.motion(y, legs, y1 / T, y2 / T**2)
        tau = way.robot.torque(q, qd, qdd, w)[way.robot.base :]
        return qd[way.robot.base :], tau / way.robot.robot.torque_limit

    def rates(v: Variables) -> Array:
        _, y1, _, _, _, T = states[0](v)
        return np.asarray(y1 / T - v.get(rate))

    def others(v: Variables) -> Array:
        _, y1, _, _, _, T = states[1](v)
        shared, joints = v.get(rate), mine.joints(v.get(rate), np.zeros(mine.nl))
        own = np.concatenate([shared[:6], joints[its.independent]])
        legs = motion(heavy, states[1], v)[0][its.dependent[freed]] - joints[its.dependent[freed]]
        return np.concatenate([y1 / T - own, legs / fast])

    names = [f"torque of {name}" for name in mine.robot.joint_names]
    yield Piece.of(rates, [(term, place, mine.labels, 0.0, 0.0)])
    legs = [its.leg_labels[k] for k in freed]
    yield Piece.of(others, [(term, place, [*its.labels, *legs], 0.0, 0.0)])
    for way, state in ((heavy, states[1]), (light, states[0])):

        def borne(way: Way, state: Callable[[Variables], Any], v: Variables) -> Array:
            return motion(way, state, v)[1] - v.get(torque)

        yield Piece.of(partial(borne, way, state), [(term, place, names, 0.0, 0.0)])


def height_pieces(problem: ImpactProblem, ways: Course) -> Iterator[Piece]:
    """Soles in the air are above the ground, and come down from above their footholds."""
    for k, way in ways.items():
        robot, T = way.robot, float(np.mean(way.phase.duration))
        stand = {i: {leg.name: leg for leg, *_ in w.robot.soles} for i, w in ways.items()}
        for sole in problem.soles:
            if sole.name in stand[k]:
                continue
            foothold = stand.get(k + 1, {}).get(sole.name)
            left = sole.name in stand.get(k - 1, {}) or (k == 0 and way.nodes[0] > 0)  # from rest
            frame = robot.model.getFrameId(sole.frame)
            corners = np.column_stack([sole.polygon, np.zeros(len(sole.polygon))])
            for s in map(float, way.nodes):
                until = (1 - s) * T if foothold else np.inf
                up = min(s * T if left else np.inf, until, WITHIN) / WITHIN
                if up <= 0:
                    continue

                def value(
                    v: Variables, way: Way = way, s: float = s, frame: int = frame, corners: Array = corners
                ) -> Array:
                    y = way.at(s)(v)[0]
                    q = way.robot.posture(y, np.zeros(way.robot.nl))
                    pin.forwardKinematics(way.robot.model, way.robot.data, q)
                    at = pin.updateFramePlacement(way.robot.model, way.robot.data, frame)
                    heights = (corners @ at.rotation.T + at.translation)[:, 2]
                    return np.concatenate([heights, at.translation[:2]])

                names = [f"{sole.name}, corner {i}" for i in range(len(corners))]
                lowest = HEIGHT * up**3
                rows: list[Any] = [("swing foot off the ground", way.place(s), names, lowest, np.inf)]
                near, most = np.zeros(2), np.inf
                if foothold and until < WITHIN:
                    near, most = foothold.placement.translation[:2], ASIDE * (until / WITHIN) ** 3
                axes = [f"{sole.name}, {axis}" for axis in "xy"]
                term = "swing foot above its foothold"
                rows.append((term, way.place(s), axes, near - most, near + most))
                yield Piece.of(value, rows)
