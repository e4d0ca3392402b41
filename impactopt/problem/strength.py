"""Estimates of the impulse with which a robot on a fixed base hits a target, in many postures."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.bodies.clearance import Places
from impactopt.bodies.robot_bodies import striker_face
from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import FreeMass, Target
from impactopt.errors import InputError
from impactopt.kinematics.inverse_kinematics import inverse_kinematics
from impactopt.problem.terms import FirstTouch, HandOrientation, TorqueLimit
from impactopt.robots.mass_matrix import mass_matrix
from impactopt.robots.robot import Robot

if TYPE_CHECKING:
    from impactopt.problem.problem import ImpactProblem

Array = NDArray[np.float64]
MAX_SWING = 1.2  # [rad], [m] travel of a joint from rest to contact
LIMIT_MARGIN = 0.05  # of a joint's range, between a posture at contact and the joint's limits
# postures with estimated impacts, and postures that are drawn for them at most, as most may not face a normal
POSTURES, MAX_DRAWN = 1000, 20000
MIN_POSTURES = 100  # with the link behind the target's plane; where there are fewer, others count, too
POINT_POSTURES = 8  # postures at the hit point of a problem
NEARBY = 0.4  # [m] from a problem's point
# Attempts of `strongest_posture`. Measured on 17 targets of five arms: the best of 10 leads to a motion for
# 16 of them, that of 6 for 14.
ATTEMPTS = 12
# Decay of an estimate with the time that joints need to a posture, over the longest swing. 2 to 5 choose
# alike; with 1 or less, postures are chosen that no swing reaches.
DECAY = 2.0
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

    def at(self, q: Array, normals: Sequence[Array]) -> list[EstimatedImpact]:
        """Impacts in a configuration (nq,), one along each normal (3,) along which the striking point can
        move.

        The impulse is mu s. mu is the reduced mass of target and effective mass. s is the largest speed along
        the normal, without speed across it, within three limits: of the joints' velocities; of the torques,
        which accelerate all joints evenly, each over its travel from a limit of position, at most
        `MAX_SWING`; and of the gear loads, from the rotors' deceleration under the peak force.
        """
        robot = self.robot
        model, data = robot.model, robot.model.createData()
        frame = model.getFrameId(robot.striker(self.striker).model_frame)
        inertia = mass_matrix(model, data, q)
        jac = np.reshape(
            pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED), (6, model.nv)
        )[:3]
        weight = np.abs(robot.generalized_gravity(data, q))
        point = np.array(data.oMf[frame].translation)
        response = np.linalg.solve(inertia, jac.T)  # (nv, 3) velocities by unit impulses at the point
        mobility = jac @ response
        angles = robot.joint_positions(q)
        # largest travel of each joint before contact, in positive and in negative direction
        travel = [
            np.clip(angles - robot.lower, 0.0, MAX_SWING),
            np.clip(robot.upper - angles, 0.0, MAX_SWING),
        ]
        weighted = jac * robot.velocity_limit**2
        out = []
        for n in normals:
            inverse_mass = float(n @ mobility @ n)
            if inverse_mass <= 1e-9 * np.trace(mobility):  # it cannot move along the normal
                continue
            # velocities (nv,) for 1 m/s along n: of least kinetic energy, and of least squares over the
            # limits
            candidates = (
                response @ _least_squares(mobility, n),
                weighted.T @ _least_squares(weighted @ jac.T, n),
            )
            best = max(
                (self._swing_speed(v, n, jac, inertia, weight, travel), k, v)
                for k, v in enumerate(candidates)
            )
            speed, direction = best[0], best[2]
            mass = 1.0 / (inverse_mass + self._target_inverse_mass())
            speed = min(speed, self._gear_speed(response @ n, mass))
            out.append(EstimatedImpact(q=q, v=speed * direction, point=point, normal=n, impulse=mass * speed))
        return out

    def _target_inverse_mass(self) -> float:
        """Inverse mass [1/kg] of the target."""
        return 1.0 / self.target.mass if isinstance(self.target, FreeMass) else 0.0

    def _swing_speed(
        self, direction: Array, n: Array, jac: Array, inertia: Array, weight: Array, travel: list[Array]
    ) -> float:
        """Largest speed [m/s] of a swing whose velocities (nv,) at 1 m/s are ``direction``; 0 if these do not
        move the point along n.
        """
        robot = self.robot
        if np.linalg.norm(jac @ direction - n) > 1e-6:
            return 0.0
        size = np.maximum(np.abs(direction), 1e-9)
        joint_travel = np.where(direction > 0, travel[0], travel[1])
        torque = np.maximum(TorqueLimit().fraction * robot.torque_limit - weight, 0.0)
        # distance and constant acceleration of the point, by the joint that limits each: v^2 = 2 a s
        distance = float((joint_travel / size).min())
        acceleration = float((torque / np.maximum(np.abs(inertia @ direction), 1e-9)).min())
        return min(float((robot.velocity_limit / size).min()), float(np.sqrt(2.0 * distance * acceleration)))

    def _gear_speed(self, jump: Array, mass: float) -> float:
        """Largest speed [m/s] at which the gears carry the impact; jump (nv,) : velocities by 1 N s."""
        robot = self.robot
        stiffness = float(self.law.force(STIFFNESS_DEPTH, 0.0)) / STIFFNESS_DEPTH
        damping = float(self.law.force(STIFFNESS_DEPTH, 1.0)) - float(self.law.force(STIFFNESS_DEPTH, 0.0))
        # [N] peak at 1 m/s, of the spring or the damper alone
        force = max(np.sqrt(stiffness * mass), damping)
        size = np.maximum(np.abs(jump), 1e-12)
        gears = robot.gear_limit * robot.torque_limit / np.maximum(robot.armature * size, 1e-12)
        return float(gears.min()) / force


def _least_squares(matrix: Array, n: Array) -> Array:
    return np.asarray(np.linalg.lstsq(matrix, n, rcond=1e-9)[0])


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
    frame = model.getFrameId(robot.striker(strength.striker).model_frame)
    face = striker_face(robot, strength.striker) if with_face else None
    min_face_cosine, most = float(np.cos(FirstTouch().angle)), FirstTouch().depth + MAX_BEYOND
    rng, limb = np.random.default_rng(0), np.array(robot.limb(robot.striker(strength.striker).model_frame))
    low, high = np.maximum(robot.lower, -np.pi)[limb], np.minimum(robot.upper, np.pi)[limb]
    low, high = low + LIMIT_MARGIN * (high - low), high - LIMIT_MARGIN * (high - low)
    own = robot.joint_positions(q)[limb]
    # postures with directions: with the link behind the target's plane, and others that meet it face on
    behind, others = list[tuple[Array, Sequence[Array]]](), list[tuple[Array, Sequence[Array]]]()
    for _ in range(MAX_DRAWN):
        step = np.zeros(robot.nv)
        step[robot.nv - robot.n + limb] = rng.uniform(low, high) - own
        posture, directions = np.array(pin.integrate(model, q, step)), normals
        if len(limb) == 1:
            jac = pin.computeFrameJacobian(model, data, posture, frame, pin.LOCAL_WORLD_ALIGNED)
            tangent = np.reshape(jac, (6, robot.nv))[:3, robot.nv - robot.n + limb[0]]
            both = np.outer([1.0, -1.0], tangent / max(float(np.linalg.norm(tangent)), 1e-9))
            directions = [line for line in both if max(n @ line for n in normals) > MIN_COSINE]
        near = directions
        if face is not None:
            pin.framesForwardKinematics(model, data, posture)
            own_frame = data.oMf[frame].rotation.T
            directions = [n for n in directions if face.normal @ (own_frame @ n) >= min_face_cosine]
            near = [n for n in directions if (face.corners @ (own_frame @ n)).max() <= face.ahead + most]
        if len(near):
            behind.append((posture, near))
        elif len(directions) and len(others) < POSTURES:
            others.append((posture, directions))
        if len(behind) == POSTURES:
            break
    chosen = behind if len(behind) >= MIN_POSTURES else [*behind, *others]
    impacts = [impact for posture, directions in chosen for impact in strength.at(posture, directions)]
    reach = max((float(np.linalg.norm(impact.point[:2])) for impact in impacts), default=0.0)
    away = [b for b in impacts if np.linalg.norm(b.point[:2]) > MIN_AHEAD * reach and b.impulse > 0]
    # an arm may only reach to a side of its base, as Stretch's does
    front = [b for b in away if b.point[0] > MIN_AHEAD * reach] or away
    return sorted(front, key=lambda impact: -impact.impulse)


def strongest_posture(problem: ImpactProblem, seed: int = 0) -> Array:
    """Posture at contact (nq,) for the initial guess of a motion.

    It is the problem's `contact_posture`, unless the robot has a fixed base and that posture violates
    `HandOrientation`. Then inverse kinematics starts from `ATTEMPTS` random postures. Of the results that
    have the orientation without penetration, the posture with the largest estimated impulse is taken,
    decreased with the time that the joints need from the start posture.

    seed : of the random postures.
    """
    p, robot, hand = problem, problem.robot, problem.extra(HandOrientation)
    if hand is None or robot.floating or p.second is not None:
        return p.contact_posture
    model, data = robot.model, robot.model.createData()
    frame, first = model.getFrameId(robot.striker(p.striker).model_frame), robot.nv - robot.n
    facing = np.array(hand.axis), p.normal if hand.direction is None else np.array(hand.direction)
    min_cosine = float(np.cos(hand.angle))

    def faces(q: Array) -> bool:
        pin.framesForwardKinematics(model, data, q)
        return bool((data.oMf[frame].rotation @ facing[0]) @ facing[1] >= min_cosine)

    if faces(p.contact_posture):
        return p.contact_posture
    strength = Strength(robot=robot, striker=p.striker, law=p.law, target=p.target)
    limb = np.array(robot.limb(robot.striker(p.striker).model_frame))
    rng, start = np.random.default_rng(seed), robot.joint_positions(p.start_posture)
    low, high = np.maximum(robot.lower, -np.pi)[limb], np.minimum(robot.upper, np.pi)[limb]
    best, chosen = 0.0, p.contact_posture
    for _ in range(ATTEMPTS):
        step = np.zeros(robot.nv)
        step[first + limb] = rng.uniform(low, high) - start[limb]
        guess = pin.integrate(model, p.start_posture, step)
        with suppress(InputError):
            q = inverse_kinematics(p.coordinates, p.striker, p.point, guess, facing=facing, starts=1)
            if not faces(q) or (p.keeps_apart and touches(p, q)):
                continue
            needed = float(np.max(np.abs(robot.joint_positions(q) - start) / robot.velocity_limit))
            decay = np.exp(-DECAY * needed / p.swing.duration[1])
            estimate = decay * max((impact.impulse for impact in strength.at(q, [p.normal])), default=0.0)
            if estimate > best:
                best, chosen = estimate, q
    return chosen


def touches(problem: ImpactProblem, *postures: Array) -> bool:
    """True if bodies touch in one of these configurations (nq,), with the target as before contact."""
    none: Array = np.zeros(len(postures))
    at = Places.of(problem.robot, np.array(postures), none, none.astype(np.intp))
    return bool(problem.bodies.survey(none + np.arange(len(postures)), at).touches)


def best_share(problem: ImpactProblem) -> tuple[float, EstimatedImpact] | None:
    """Estimated impulse of a problem over that of the hardest impact nearby, and that impact.

    Nearby are points within 0.4 m, hit along the problem's normal, or one of `NORMALS`. The result is
    rough: postures are drawn, and clearance is ignored. None for a robot on soles, whose balance limits the
    impulse, and for targets other than a free mass.
    """
    p = problem
    if p.robot.floating or p.second is not None or not isinstance(p.target, FreeMass):
        return None
    strength = Strength(robot=p.robot, striker=p.striker, law=p.law, target=p.target)
    rng, postures = np.random.default_rng(0), [p.contact_posture]
    for _ in range(POINT_POSTURES):
        guess = pin.integrate(p.robot.model, p.contact_posture, rng.standard_normal(p.robot.nv))
        with suppress(InputError):
            postures.append(inverse_kinematics(p.coordinates, p.striker, p.point, guess, starts=1))
    own = [impact.impulse for q in postures for impact in strength.at(q, [p.normal])]
    drawn = drawn_impacts(
        strength, p.start_posture, (*NORMALS, p.normal), with_face=p.term(FirstTouch).enabled
    )
    near = [impact for impact in drawn if np.linalg.norm(impact.point - p.point) < NEARBY]
    if not near or not own or not near[0].impulse > 0:
        return None
    return min(max(own) / near[0].impulse, 1.0), near[0]
