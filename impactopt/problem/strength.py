"""Estimates of how hard a robot on a fixed base hits, in many postures: where it is strong."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.bodies.robot_bodies import striker_face
from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import FreeMass, Target
from impactopt.errors import InputError
from impactopt.kinematics.inverse_kinematics import inverse_kinematics
from impactopt.problem.terms import FirstTouch, TorqueLimit
from impactopt.robots.mass_matrix import mass_matrix
from impactopt.robots.robot import Robot

if TYPE_CHECKING:
    from impactopt.problem.problem import ImpactProblem

__all__ = ["Blow", "Strength", "best_share", "drawn_blows"]

Array = NDArray[np.float64]
SWING = 1.2  # [rad], [m] of a joint's way from rest to contact at most
INSIDE = 0.05  # of a joint's range that a posture at contact keeps off its limits
DRAWN, REFUSED = 600, 6000  # postures in which blows are estimated, and that are drawn for them at most
TRIED = 8  # postures at the point of a problem
NEARBY = 0.4  # [m] from a problem's point
AHEAD = 0.25  # of the reach: a target stands so far ahead of the base at least
DOWN = np.array([0.0, 0.0, -1.0])
NORMALS = (*map(np.array, ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0))), DOWN)
ASLANT = float(np.cos(np.radians(30)))  # least cosine between a single joint's line and a normal
PRESSED = 1e-3  # [m] at which a law's stiffness is read


@dataclass(frozen=True, kw_only=True, eq=False)
class Blow:
    """An estimated blow: configuration q (nq,) and velocity v (nv,) at contact, point (3,) [m], normal (3,),
    and impulse [N s].
    """

    q: Array
    v: Array
    point: Array
    normal: Array
    impulse: float


@dataclass(frozen=True, kw_only=True)
class Strength:
    """A striker of a robot on a fixed base, and what it hits."""

    robot: Robot
    striker: str
    law: ContactLaw
    target: Target

    def at(self, q: Array, normals: Sequence[Array]) -> list[Blow]:
        """Blows in a configuration (nq,), one along each normal (3,) that the striking point can move along.

        The impulse is mu s: mu is the reduced mass of target and effective mass, and s the largest speed,
        without any across the normal, that these leave: joint speeds; torques that accelerate all joints
        evenly over the room behind them; and gears, which bear their rotors' deceleration under the peak
        force.
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
        spread = np.linalg.solve(inertia, jac.T)
        mobility = jac @ spread
        angles = robot.joint_positions(q)
        room = [np.clip(angles - robot.lower, 0.0, SWING), np.clip(robot.upper - angles, 0.0, SWING)]
        fast = jac * robot.velocity_limit**2
        out = []
        for n in normals:
            inverse = float(n @ mobility @ n)
            if inverse <= 1e-9 * np.trace(mobility):  # it cannot move along the normal
                continue
            best = max(
                (self._speed(way, n, jac, inertia, weight, room), k, way)
                for k, way in enumerate((spread @ _solved(mobility, n), fast.T @ _solved(fast @ jac.T, n)))
            )
            speed, way = best[0], best[2]
            mass = 1.0 / (inverse + self._yield())
            speed = min(speed, self._bearable(spread @ n, mass))
            blow = Blow(q=q, v=speed * way, point=point, normal=n, impulse=mass * speed)
            out.append(blow)
        return out

    def _yield(self) -> float:
        """[1/kg] of the target."""
        return 1.0 / self.target.mass if isinstance(self.target, FreeMass) else 0.0

    def _speed(
        self, way: Array, n: Array, jac: Array, inertia: Array, weight: Array, room: list[Array]
    ) -> float:
        """[m/s] that a swing reaches: velocities (nv,) are `way` at 1 m/s."""
        robot = self.robot
        if np.linalg.norm(jac @ way - n) > 1e-6:
            return 0.0
        size = np.maximum(np.abs(way), 1e-9)
        behind = np.where(way > 0, room[0], room[1])
        free = np.maximum(TorqueLimit().fraction * robot.torque_limit - weight, 0.0)
        travel = float((behind / size).min())
        push = float((free / np.maximum(np.abs(inertia @ way), 1e-9)).min())
        return min(float((robot.velocity_limit / size).min()), float(np.sqrt(2.0 * travel * push)))

    def _bearable(self, jump: Array, mass: float) -> float:
        """[m/s] at which gears carry a blow; jump (nv,) : of velocities by an impulse of 1 N s."""
        robot = self.robot
        stiffness = float(self.law.force(PRESSED, 0.0)) / PRESSED
        damping = float(self.law.force(PRESSED, 1.0)) - float(self.law.force(PRESSED, 0.0))
        force = max(np.sqrt(stiffness * mass), damping)  # [N] at 1 m/s
        size = np.maximum(np.abs(jump), 1e-12)
        gears = robot.gear_limit * robot.torque_limit / np.maximum(robot.armature * size, 1e-12)
        return float(gears.min()) / force


def _solved(matrix: Array, n: Array) -> Array:
    return np.asarray(np.linalg.lstsq(matrix, n, rcond=1e-9)[0])


def drawn_blows(
    strength: Strength, q: Array, normals: Sequence[Array] = NORMALS, *, with_face: bool = True
) -> list[Blow]:
    """Estimated blows ahead of the base, the hardest first: in `DRAWN` postures, along each normal.

    The joints that move the striker are anywhere inside their limits, and the others as in q (nq,). A single
    joint strikes along its circle or line, within `ASLANT` of a normal. A striker
    whose face is known meets the target with it, as `FirstTouch` asks by default; not if not `with_face`.
    """
    robot = strength.robot
    model, data = robot.model, robot.model.createData()
    frame = model.getFrameId(robot.striker(strength.striker).model_frame)
    face = striker_face(robot, strength.striker) if with_face else None
    square = float(np.cos(FirstTouch().angle))
    rng, limb = np.random.default_rng(0), np.array(robot.limb(robot.striker(strength.striker).model_frame))
    low, high = np.maximum(robot.lower, -np.pi)[limb], np.minimum(robot.upper, np.pi)[limb]
    low, high = low + INSIDE * (high - low), high - INSIDE * (high - low)
    own, blows = robot.joint_positions(q)[limb], list[Blow]()
    met = 0
    for _ in range(REFUSED):
        step = np.zeros(robot.nv)
        step[robot.nv - robot.n + limb] = rng.uniform(low, high) - own
        posture, ways = np.array(pin.integrate(model, q, step)), normals
        if len(limb) == 1:
            jac = pin.computeFrameJacobian(model, data, posture, frame, pin.LOCAL_WORLD_ALIGNED)
            way = np.reshape(jac, (6, robot.nv))[:3, robot.nv - robot.n + limb[0]]
            both = np.outer([1.0, -1.0], way / max(float(np.linalg.norm(way)), 1e-9))
            ways = [line for line in both if max(n @ line for n in normals) > ASLANT]
        if face is not None:
            pin.framesForwardKinematics(model, data, posture)
            ahead = data.oMf[frame].rotation @ face.normal
            ways = [n for n in ways if n @ ahead >= square]
        if ways:
            blows += strength.at(posture, ways)
            met += 1
        if met == DRAWN:
            break
    reach = max((float(np.linalg.norm(blow.point[:2])) for blow in blows), default=0.0)
    front = [b for b in blows if b.point[0] > AHEAD * reach and b.impulse > 0]
    return sorted(front, key=lambda blow: -blow.impulse)


def best_share(problem: ImpactProblem) -> tuple[float, Blow] | None:
    """Impulse of a problem's blow over that of the hardest one nearby, by estimates of both, and that one.

    Nearby are points within `NEARBY`, hit along the problem's normal, to the front, to a side or down. A
    rough number: postures are drawn, and estimates know nothing of bodies. None: of a robot on soles, whose
    balance decides, and of targets that are no free mass.
    """
    p = problem
    if p.robot.floating or p.second is not None or not isinstance(p.target, FreeMass):
        return None
    strength = Strength(robot=p.robot, striker=p.striker, law=p.law, target=p.target)
    rng, postures = np.random.default_rng(0), [p.contact_posture]
    for _ in range(TRIED):
        guess = pin.integrate(p.robot.model, p.contact_posture, rng.standard_normal(p.robot.nv))
        with suppress(InputError):
            postures.append(inverse_kinematics(p.coordinates, p.striker, p.point, guess, starts=1))
    own = [blow.impulse for q in postures for blow in strength.at(q, [p.normal])]
    drawn = drawn_blows(strength, p.start_posture, (*NORMALS, p.normal), with_face=p.term(FirstTouch).enabled)
    near = [blow for blow in drawn if np.linalg.norm(blow.point - p.point) < NEARBY]
    if not near or not own or not near[0].impulse > 0:
        return None
    return min(max(own) / near[0].impulse, 1.0), near[0]
