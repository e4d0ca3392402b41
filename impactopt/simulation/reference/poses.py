"""Poses of a motion's links at some instants, and effective mass at contact, for pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from impactopt.arrays import Array, Mask
from impactopt.bodies.world import WorldBody
from impactopt.kinematics.operational_space import ConstrainedDynamics, striking_point
from impactopt.problem.problem import ImpactProblem
from impactopt.robots.robot import Robot
from impactopt.transcription.plan import Trajectory

POSES_BEFORE, POSES_AFTER = 4, 2  # up to contact, and after the end of contact


@dataclass(frozen=True, kw_only=True, eq=False)
class Poses:
    """A motion in a few poses, in the world frame.

    time (m,) [s]
    links (m, l, 2, 3) [m] : ends of each link
    strikes (l,) : whether a link belongs to the striking limb
    contact : index of the first pose in contact
    path (k, 3) [m] : of the striking point, at the k instants of the reference
    target, obstacles (b, c, 3) [m] : corners of each body of the target at contact, and of the obstacles
    ground (1,) [m] : height; (0,) without ground
    normal (3,) : of the impact
    inverse_mass (3, 3) [1/kg] : of the striking point at contact
    """

    time: Array
    links: Array
    strikes: Mask
    contact: int
    path: Array
    target: Array
    obstacles: Array
    ground: Array
    normal: Array
    inverse_mass: Array


def poses_of(problem: ImpactProblem, reference: Trajectory) -> Poses:
    """Poses from the start over contact to rest, and the striking point's path."""
    robot = problem.robot
    begin, end = reference.contact_start, reference.contact_end
    after = np.linspace(end, reference.end, POSES_AFTER + 1)[1:]
    times = np.concatenate([np.linspace(0.0, begin, POSES_BEFORE), [end] * (end > begin), after])
    # of two instants at the same time take the first, before the jump
    chosen = np.searchsorted(reference.time, times - 1e-9).clip(0, len(reference.time) - 1)
    at_contact = reference.q[chosen[POSES_BEFORE - 1]]
    names, visible = problem.strikers, [b for b in problem.world if not (b.core or b.ground)]
    links = [_links(robot, names, reference.q[k]) for k in chosen]
    strikes = {j for name in names for j in robot.model.supports[_striker(robot, name).parentJoint]}
    of_limb = [j in strikes for _, j in bones(robot)]
    return Poses(
        time=reference.time[chosen],
        links=np.array(links),
        strikes=np.array([True] * len(names) + [*of_limb, *[False] * (2 * len(robot.soles))]),
        contact=POSES_BEFORE - 1,
        path=striking_point(robot, problem.striker, reference.q),
        target=_corners([b for b in visible if b.of_target]),
        obstacles=_corners([b for b in visible if not b.of_target]),
        ground=np.array([z for z in [problem.ground_height] if z is not None]),
        normal=problem.normal,
        inverse_mass=inverse_mass(problem, at_contact),
    )


def inverse_mass(problem: ImpactProblem, q: Array) -> Array:
    """J P J' (3, 3) [1/kg] of the striking point, as `ConstrainedDynamics.inverse_mass`."""
    robot = problem.robot
    frames = problem.stance.constraint_frames(robot)
    return ConstrainedDynamics.at(
        robot.model, q, frames, robot.striker(problem.striker).model_frame
    ).inverse_mass()


def bones(robot: Robot) -> list[tuple[int, int]]:
    """Pairs of joints with a link between them; a free-flyer is no link."""
    first = 2 if robot.floating else 1
    return [(int(robot.model.parents[j]), j) for j in range(first, robot.model.njoints)]


def _striker(robot: Robot, name: str) -> pin.Frame:
    return robot.model.frames[robot.model.getFrameId(robot.striker(name).model_frame)]


def _links(robot: Robot, strikers: Sequence[str], q: Array) -> list[Array]:
    """Ends (2, 3) [m] of each link: to the striking points, between joints, then two of each sole."""
    model, data = robot.model, robot.model.createData()
    pin.framesForwardKinematics(model, data, q)
    hands = [_striker(robot, name) for name in strikers]
    ends = [(data.oMi[hand.parentJoint].translation, _point(data, model, hand)) for hand in hands]
    ends += [(data.oMi[a].translation, data.oMi[b].translation) for a, b in bones(robot)]
    for sole in robot.soles:
        frame = model.getFrameId(sole.frame)
        place, ankle = data.oMf[frame], data.oMi[model.frames[frame].parentJoint].translation
        heel, toe = (np.array([f(sole.polygon[:, 0]), 0.0, 0.0]) for f in (np.min, np.max))
        ends += [(ankle, place.translation), (place.act(heel), place.act(toe))]
    return [np.array(pair) for pair in ends]


def _point(data: pin.Data, model: pin.Model, frame: pin.Frame) -> Array:
    return np.array(data.oMf[model.getFrameId(frame.name)].translation)


def _corners(bodies: Sequence[WorldBody]) -> Array:
    """Corners of each body's surface, padded to the largest number (b, c, 3) [m]."""
    found = [body.solid.vertices for body in bodies]
    most = max(map(len, found), default=0)
    padded = [np.pad(v, ((0, most - len(v)), (0, 0)), mode="edge") for v in found]
    return np.array(padded).reshape(len(found), most, 3)
