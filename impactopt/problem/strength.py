"""Estimates of the impulse with which a robot on a fixed base hits a target, in many postures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import pinocchio as pin

from impactopt.arrays import Array
from impactopt.bodies.clearance import Places
from impactopt.bodies.robot_bodies import striker_face
from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import FreeMass, Target
from impactopt.errors import InputError
from impactopt.kinematics.inverse_kinematics import inverse_kinematics
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import FirstTouch, HandOrientation, TorqueLimit
from impactopt.problem.terms.first_touch import face_of
from impactopt.robots.model import mass_matrix
from impactopt.robots.robot import Robot

MAX_SWING = 1.2  # [rad], [m] travel of a joint from rest to contact
LIMIT_MARGIN = 0.05  # of a joint's range, between a posture at contact and the joint's limits
# postures with estimated impacts, and postures that are drawn for them at most, as most may not face a normal
POSTURES, MAX_DRAWN = 1000, 20000
MIN_POSTURES = 100  # with the link behind the target's plane; where there are fewer, others count, too
POINT_POSTURES = 8  # postures at the hit point of a problem: random ones, and near the hardest impacts
NEARBY = 0.4  # [m] from a problem's point
# Attempts of `drawn_posture`. Measured on 17 targets of five arms: the best of 10 leads to a motion for
# 16 of them, that of 6 for 14.
ATTEMPTS = 12
# Decay of an estimate with the time that joints need to a posture, over the longest swing. 2 to 5 choose
# alike; with 1 or less, postures are chosen that no swing reaches.
DECAY = 2.0
# Of that share, from which on a swing hardly reaches a posture. Of 114 targets of 14 arms that the drawn or
# the nearest posture solves, the chosen one misses 4; 17 if the nearest one always goes first.
MAX_SHARE = 0.9
# Factor by which the estimate of the nearest posture is larger, if it goes first. Of 34 targets of ten arms
# for which that changes the posture, two more are solved, two nails are driven 2.5 and 4 times as far, and
# two impulses are 7 and 9 % smaller; with 1, four of seven motions of another arm are 1 to 2 % weaker.
LARGER = 1.2
MIN_AHEAD = 0.25  # of the reach: a target is at least so far ahead of the base
DOWN = np.array([0.0, 0.0, -1.0])
AXES = (*map(np.array, ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0))), DOWN)
# ahead, to a side, down, and halfway between two of these
NORMALS = (*AXES, *(np.round(np.sqrt(0.5) * (a + b), 9) for a, b in combinations(AXES, 2) if not a @ b))
MIN_COSINE = float(np.cos(np.radians(30)))  # between a normal and the line along which a single joint strikes
# [m] farthest that a corner of the striking link may be beyond the target's plane, other than `FirstTouch`
# allows, in a posture that is drawn: strikes that have to turn the link more are often not solved.
MAX_BEYOND = 1.5e-3
STIFFNESS_DEPTH = 1e-3  # [m] penetration at which the secant stiffness of a law is taken


@dataclass(frozen=True, kw_only=True, eq=False)
class EstimatedImpact:
    """Estimated impact: configuration q (nq,) and velocity v (nv,) at contact, point (3,) [m], normal (3,),
    and impulse [N s].
    """

    q: Array
    v: Array
    point: Array
    normal: Array
    impulse: float


@dataclass(frozen=True, kw_only=True)
class Strength:
    """Estimator of impacts of a striker, on a robot with a fixed base, with a law and a target."""

    robot: Robot
    striker: str
    law: ContactLaw
    target: Target

    def at(self, q: Array, normals: Array) -> list[EstimatedImpact]:
        """Impacts of configurations (k, nq), each along its normal of (k, 3), if the striking point can move
        along it.

        The impulse is mu s. mu is the reduced mass of target and effective mass. s is the largest speed along
        the normal, without speed across it, within three limits: of the joints' velocities; of the torques,
        which accelerate all joints evenly, each over its travel from a limit of position, at most
        `MAX_SWING`; and of the gear loads, from the rotors' deceleration under the peak force.
        """
        robot, model, data = self.robot, self.robot.model, self.robot.model.createData()
        frame = model.getFrameId(robot.striker(self.striker).model_frame)
        inertia, jac = np.zeros((len(q), model.nv, model.nv)), np.zeros((len(q), 3, model.nv))
        weight, point = np.zeros((len(q), model.nv)), np.zeros((len(q), 3))
        for k, posture in enumerate(q):
            inertia[k] = mass_matrix(model, data, posture)
            jac[k] = np.reshape(
                pin.computeFrameJacobian(model, data, posture, frame, pin.LOCAL_WORLD_ALIGNED), (6, model.nv)
            )[:3]
            weight[k] = np.abs(robot.generalized_gravity(data, posture))
            point[k] = data.oMf[frame].translation
        back = jac.swapaxes(1, 2)
        response = np.linalg.solve(inertia, back)  # (k, nv, 3) velocities by unit impulses at the point
        mobility = jac @ response
        inverse_mass = np.einsum("ki,kij,kj->k", normals, mobility, normals)
        weighted = robot.velocity_limit[:, None] ** 2 * back
        # velocities (2, k, nv) for 1 m/s along the normal: of least kinetic energy, and of least squares over
        # the limits
        ways = np.stack(
            [_least_squares(response, mobility, normals), _least_squares(weighted, jac @ weighted, normals)]
        )
        speeds = self._swing_speeds(ways, normals, jac, inertia, weight, robot.joint_positions(q))
        best, each = speeds.argmax(axis=0), np.arange(len(q))
        mass = 1.0 / (np.maximum(inverse_mass, 1e-300) + self._target_inverse_mass())
        speed = np.minimum(
            speeds[best, each], self._gear_speeds((response @ normals[:, :, None])[..., 0], mass)
        )
        return [
            EstimatedImpact(
                q=q[k],
                v=speed[k] * ways[best[k], k],
                point=point[k],
                normal=normals[k],
                impulse=float(mass[k] * speed[k]),
            )
            for k in np.flatnonzero(inverse_mass > 1e-9 * np.trace(mobility, axis1=1, axis2=2))
        ]

    def _target_inverse_mass(self) -> float:
        """Inverse mass [1/kg] of the target."""
        return 1.0 / self.target.mass if isinstance(self.target, FreeMass) else 0.0

    def _swing_speeds(
        self, ways: Array, normals: Array, jac: Array, inertia: Array, weight: Array, angles: Array
    ) -> Array:
        """Largest speeds (2, k) [m/s] of swings whose velocities (2, k, nv) at 1 m/s are ``ways``; 0 if these
        do not move the point along its normal.
        """
        robot = self.robot
        size = np.maximum(np.abs(ways), 1e-9)
        # largest travel of each joint before contact: in positive direction from its lower limit
        room = np.where(ways > 0, angles - robot.lower, robot.upper - angles)
        torque = np.maximum(TorqueLimit().fraction * robot.torque_limit - weight, 0.0)
        # distance and constant acceleration of the point, by the joint that limits each: v^2 = 2 a s
        distance = (np.clip(room, 0.0, MAX_SWING) / size).min(axis=-1)
        pushed = np.abs((inertia @ ways[..., None])[..., 0])
        acceleration = (torque / np.maximum(pushed, 1e-9)).min(axis=-1)
        speeds = np.minimum(
            (robot.velocity_limit / size).min(axis=-1), np.sqrt(2.0 * distance * acceleration)
        )
        along = np.linalg.norm((jac @ ways[..., None])[..., 0] - normals, axis=-1) <= 1e-6
        return np.where(along, speeds, 0.0)

    def _gear_speeds(self, jumps: Array, mass: Array) -> Array:
        """Largest speeds (k,) [m/s] at which the gears carry the impact; jumps (k, nv) : velocities by
        1 N s.
        """
        robot = self.robot
        stiffness = float(self.law.force(STIFFNESS_DEPTH, 0.0)) / STIFFNESS_DEPTH
        damping = float(self.law.force(STIFFNESS_DEPTH, 1.0)) - float(self.law.force(STIFFNESS_DEPTH, 0.0))
        # [N] peak at 1 m/s, of the spring or the damper alone
        force = np.maximum(np.sqrt(stiffness * mass), max(damping, 1e-12))  # a law may begin deeper
        size = np.maximum(np.abs(jumps), 1e-12)
        gears = robot.gear_limit * robot.torque_limit / np.maximum(robot.armature * size, 1e-12)
        return np.asarray(gears.min(axis=-1) / force)


def _least_squares(ways: Array, moves: Array, normals: Array) -> Array:
    """Combinations (k, nv) of the columns of ways (k, nv, 3), which move the point by moves (k, 3, 3), that
    move it along the normals (k, 3).
    """
    solved = np.linalg.pinv(moves, rcond=1e-9) @ normals[:, :, None]
    return np.asarray((ways @ solved)[..., 0])


def drawn_impacts(
    strength: Strength, q: Array, normals: Sequence[Array] = NORMALS, *, with_face: bool = True
) -> list[EstimatedImpact]:
    """Estimated impacts in `POSTURES` postures along each normal, the hardest first.

    They are ahead of the base, or elsewhere if the arm does not reach there. The joints that move the striker
    are drawn within their limits; the others are as in q (nq,). A single joint strikes along its circle or
    line, if that is within 30 degrees of a normal.
    with_face : a striker meets the target with its face if that is known, as `FirstTouch` requires by
    default.
    """
    robot = strength.robot
    model, data = robot.model, robot.model.createData()
    hit = robot.striker(strength.striker)
    frame = model.getFrameId(hit.model_frame)
    face = striker_face(robot, strength.striker) if with_face else None
    min_face_cosine, most = float(np.cos(FirstTouch().angle)), FirstTouch().depth + MAX_BEYOND
    rng, limb, first = np.random.default_rng(0), np.array(robot.limb(hit.model_frame)), robot.nv - robot.n
    low, high = (limits[limb] for limits in drawn_ranges(robot))
    low, high = low + LIMIT_MARGIN * (high - low), high - LIMIT_MARGIN * (high - low)
    own = robot.joint_positions(q)[limb]
    # postures with their lines: with the link behind the target's plane, and others that meet it face on
    behind, others = list[tuple[Array, Array]](), list[tuple[Array, Array]]()
    for _ in range(MAX_DRAWN // POSTURES):
        steps = np.zeros((POSTURES, robot.nv))
        steps[:, first + limb] = rng.uniform(low, high, (POSTURES, len(limb))) - own
        postures = np.array([pin.integrate(model, q, step) for step in steps])
        lines = np.tile(normals, (POSTURES, 1, 1))
        facing = np.ones(lines.shape[:2], dtype=bool)
        if len(limb) == 1:
            jacs = [
                pin.computeFrameJacobian(model, data, posture, frame, pin.LOCAL_WORLD_ALIGNED)
                for posture in postures
            ]
            tangents = np.reshape(jacs, (POSTURES, 6, robot.nv))[:, :3, first + limb[0]]
            tangents = tangents / np.maximum(np.linalg.norm(tangents, axis=1), 1e-9)[:, None]
            lines = np.stack([tangents, -tangents], axis=1)
            facing = (lines @ np.transpose(normals)).max(axis=-1) > MIN_COSINE
        near = facing
        if face is not None:
            place = model.frames[frame]
            turns = robot.forward_kinematics(postures)[0][:, place.parentJoint] @ place.placement.rotation
            local = lines @ turns
            facing = facing & (local @ face.normal >= min_face_cosine)
            near = facing.copy()
            near[facing] = (local[facing] @ face.corners.T).max(axis=-1) <= face.ahead + most
        for chosen, drawn in ((near, behind), (facing & ~near.any(axis=1, keepdims=True), others)):
            some = np.flatnonzero(chosen.any(axis=1))[: POSTURES - len(drawn)]
            drawn += [(postures[k], lines[k, chosen[k]]) for k in some]
        if len(behind) == POSTURES:
            break
    pairs = behind if len(behind) >= MIN_POSTURES else [*behind, *others]
    if not pairs:
        return []
    each = np.repeat([posture for posture, _ in pairs], [len(along) for _, along in pairs], axis=0)
    impacts = strength.at(each, np.concatenate([along for _, along in pairs]))
    reach = max((float(np.linalg.norm(impact.point[:2])) for impact in impacts), default=0.0)
    away = [b for b in impacts if np.linalg.norm(b.point[:2]) > MIN_AHEAD * reach and b.impulse > 0]
    # an arm may only reach to a side of its base, as Stretch's does
    front = [b for b in away if b.point[0] > MIN_AHEAD * reach] or away
    return sorted(front, key=lambda impact: -impact.impulse)


def strongest_posture(problem: ImpactProblem, seed: int = 0) -> Array:
    """Posture at contact (nq,) for the initial guess of a motion.

    seed : that of `drawn_posture`. With 0, of the first start, it is the problem's `contact_posture` if
        `near_contact` is given; else if a swing reaches it and its estimate is clearly larger than that of
        the drawn one, or a swing hardly reaches the latter.
    """
    if problem.near_contact is not None and not seed:
        return problem.contact_posture
    near, drawn = problem.contact_posture, drawn_posture(problem, seed)
    if seed or np.array_equal(near, drawn) or _share_of_swing(problem, near) > MAX_SHARE:
        return drawn
    if _share_of_swing(problem, drawn) > MAX_SHARE:
        return near if _faces(problem, near, _hand_facing(problem)) else drawn
    own, other = (_estimate(problem, _strength(problem), q) for q in (near, drawn))
    return near if own > LARGER * other and _meets(problem, near, _facing(problem)) else drawn


def drawn_posture(problem: ImpactProblem, seed: int = 0) -> Array:
    """Strongest posture at contact (nq,) that inverse kinematics finds from `ATTEMPTS` random postures.

    Of the results that have the hand's orientation, or else its face to the target, without penetration, the
    posture with the largest estimated impulse is taken, decreased with the time that the joints need from the
    start posture. It is the `contact_posture` if there is none, and of robots on soles or with two striking
    points.
    """
    p, robot = problem, problem.robot
    best, chosen = 0.0, p.contact_posture
    if robot.floating or p.second is not None:
        return chosen
    facing, strength = _facing(p), _strength(p)
    for guess in random_postures(robot, p.striker, p.start_posture, ATTEMPTS, seed):
        with suppress(InputError):
            lines = None if facing is None else facing[:2]
            q = inverse_kinematics(p.coordinates, p.striker, p.point, guess, facing=lines, starts=1)
            if _meets(p, q, facing) and (estimate := _estimate(p, strength, q)) > best:
                best, chosen = estimate, q
    return chosen


def _strength(problem: ImpactProblem) -> Strength:
    p = problem
    return Strength(robot=p.robot, striker=p.striker, law=p.law, target=p.target)


def _estimate(problem: ImpactProblem, strength: Strength, q: Array) -> float:
    """Estimated impulse [N s] of a posture (nq,), decreased with the time that the joints need to it."""
    impacts = strength.at(q[None], problem.normal[None])
    decay = float(np.exp(-DECAY * _share_of_swing(problem, q)))
    return decay * max((impact.impulse for impact in impacts), default=0.0)


def _share_of_swing(problem: ImpactProblem, q: Array) -> float:
    """Time that the joints need to a posture (nq,) at their largest velocities, over the longest swing."""
    robot = problem.robot
    way = robot.joint_positions(q) - robot.joint_positions(problem.start_posture)
    return float(np.max(np.abs(way) / robot.velocity_limit)) / problem.swing.duration[1]


# axis of the striker's frame (3,), direction in the world (3,), and the largest angle between them [rad]
_Facing = tuple[Array, Array, float]


def _hand_facing(problem: ImpactProblem) -> _Facing | None:
    """Orientation that `HandOrientation` requires."""
    hand = problem.extra(HandOrientation)
    if hand is None:
        return None
    return (
        np.array(hand.axis),
        np.array(problem.normal if hand.direction is None else hand.direction),
        hand.angle,
    )


def _face_facing(problem: ImpactProblem) -> _Facing | None:
    """Orientation that `FirstTouch` requires of a striker with a known shape."""
    touch = problem.term(FirstTouch)
    face = face_of(problem, problem.striker) if touch.enabled else None
    return None if face is None else (face.normal, problem.normal, touch.angle)


def _facing(problem: ImpactProblem) -> _Facing | None:
    """Orientation of the hand, or else of its face to the target."""
    return _hand_facing(problem) or _face_facing(problem)


def _meets(problem: ImpactProblem, q: Array, facing: _Facing | None) -> bool:
    """True if the striker has an orientation in a configuration (nq,), and no bodies touch."""
    return _faces(problem, q, facing) and not (problem.keeps_apart and touches(problem, q))


def _faces(problem: ImpactProblem, q: Array, facing: _Facing | None) -> bool:
    """True if the striker has an orientation in a configuration (nq,), or needs none."""
    if facing is None:
        return True
    (axis, direction, angle), robot = facing, problem.robot
    model, data = robot.model, robot.model.createData()
    pin.framesForwardKinematics(model, data, q)
    at = data.oMf[model.getFrameId(robot.striker(problem.striker).model_frame)]
    return bool((at.rotation @ axis) @ direction >= np.cos(angle))


def drawn_ranges(robot: Robot) -> tuple[Array, Array]:
    """Position limits (n,) [rad], [m] of a turn at most: the middle one of a range, or from -pi to pi without
    limits.
    """
    turn = 2 * np.pi
    low = np.where(np.isfinite(robot.lower), robot.lower, np.minimum(robot.upper, np.pi) - turn)
    high = np.where(np.isfinite(robot.upper), robot.upper, low + turn)
    middle = (low + high) / 2
    return np.maximum(low, middle - turn / 2), np.minimum(high, middle + turn / 2)


def random_postures(robot: Robot, striker: str, q: Array, count: int, seed: int = 0) -> Iterator[Array]:
    """A configuration q (nq,) with the joints that move a striker drawn within their limits, several times.

    Joints without limits are drawn between -pi and pi, those with more than a turn in the middle turn of
    their range.
    """
    limb = np.array(robot.limb(robot.striker(striker).model_frame))
    rng, own = np.random.default_rng(seed), robot.joint_positions(q)[limb]
    low, high = (limits[limb] for limits in drawn_ranges(robot))
    for _ in range(count):
        step = np.zeros(robot.nv)
        step[robot.nv - robot.n + limb] = rng.uniform(low, high) - own
        yield np.asarray(pin.integrate(robot.model, q, step))


def touches(problem: ImpactProblem, *postures: Array) -> bool:
    """True if bodies touch in one of these configurations (nq,), with the target as before contact."""
    at = Places.of(problem.robot, np.array(postures), np.zeros(len(postures), dtype=np.intp))
    return bool(problem.bodies.touches(np.arange(float(len(postures))), at))


def best_share(problem: ImpactProblem) -> tuple[float, EstimatedImpact] | None:
    """Estimated impulse of a problem over that of the hardest impact nearby, and that impact.

    Nearby are points within 0.4 m, hit along the problem's normal, or one of `NORMALS`. The result is
    rough: postures are drawn, and clearance is ignored. None for a robot on soles, whose balance limits the
    impulse, and for targets other than a free mass.
    """
    p = problem
    if p.robot.floating or p.second is not None or not isinstance(p.target, FreeMass):
        return None
    strength = _strength(p)
    drawn = drawn_impacts(
        strength, p.start_posture, (*NORMALS, p.normal), with_face=p.term(FirstTouch).enabled
    )
    near = [impact for impact in drawn if np.linalg.norm(impact.point - p.point) < NEARBY]
    rng, postures = np.random.default_rng(0), [p.contact_posture]
    guesses = [
        pin.integrate(p.robot.model, p.contact_posture, rng.standard_normal(p.robot.nv))
        for _ in range(POINT_POSTURES)
    ]
    # random postures miss the one for which a draft has its target there
    guesses += [impact.q for impact in near if np.allclose(impact.normal, p.normal)][:POINT_POSTURES]
    for guess in guesses:
        with suppress(InputError):
            postures.append(inverse_kinematics(p.coordinates, p.striker, p.point, guess, starts=1))
    own = [b.impulse for b in strength.at(np.array(postures), np.tile(p.normal, (len(postures), 1)))]
    if not near or not own or not near[0].impulse > 0:
        return None
    return min(max(own) / near[0].impulse, 1.0), near[0]
