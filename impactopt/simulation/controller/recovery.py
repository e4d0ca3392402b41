"""Recovery after an impact: the plan's follow-through, slower and farther from the soles' edges.

On its way to rest a plan may bring the capture point to the soles' edges, and joints to their torque limits.
At a slower pace the same postures need less, and legs that shift the body keep the capture point away from
edges.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.robots.robot import Robot
from impactopt.simulation.controller.setpoint import Aim
from impactopt.simulation.controller.settings import ControllerSettings
from impactopt.simulation.result import Scene, distance_inside

__all__ = ["Recovery"]

Array = NDArray[np.float64]
STEPS = 30  # of Gauss-Newton, from the plan's last posture
LARGEST = 0.2  # [rad] of one
SMALLEST = 1e-3  # singular value that counts, of the largest
PARTS = (1.0, 0.75, 0.5, 0.25)  # of the shift, the most that keeps links apart
CLEAR = 3e-3  # [m] between links
SAFE = 0.015  # [m] of the capture point to the soles' edges
LOOK = 0.05  # [s] at which that is looked at
BRAKING = 0.15  # [s] from the plan's pace to the slower one
_AXES = pin.LOCAL_WORLD_ALIGNED


class Recovery:
    """place (2,) [m] : where the centre of mass goes.  shift (nv,) : of the postures, by legs and base.

    It begins `start` [s] after the blow.
    """

    def __init__(self, robot: Robot, reference: Any, scene: Scene, settings: ControllerSettings) -> None:
        self.model, self.start, self.pace = robot.model, settings.recovery_start, settings.recovery_pace
        last = np.asarray(reference.q[-1])
        shift = np.zeros(robot.nv)
        if not scene.hands:  # they would be torn off
            q = _moved(robot, last, np.asarray(reference.q[0]), scene, settings.recovery_margin)
            shift = np.array(pin.difference(self.model, last, q))
        self.shift = shift * _clear_part(self.model, reference, scene, shift)
        q = pin.integrate(self.model, last, self.shift)
        self.place = np.array(pin.centerOfMass(self.model, self.model.createData(), q)[:2])

    def clock(self, since: float) -> tuple[float, float, float]:
        """Progress in the plan [s] at a time since the recovery began, with its first and second rate."""
        slower, braked = 1.0 - self.pace, min(since, BRAKING)
        gone = since - slower * (braked**2 / (2 * BRAKING) + since - braked)
        brakes = since < BRAKING
        return gone, 1.0 - slower * braked / BRAKING, -slower / BRAKING if brakes else 0.0

    def of(self, aim: Aim, rate: float, gain: float) -> Aim:
        """The plan's at this rate and second rate, shifted, with the centre of mass at its place."""
        com, momentum = aim.com, aim.momentum
        com_aim = np.zeros((3, 3))
        com_aim[0, :2] = self.place
        com_aim[:, 2] = com[0, 2], rate * com[1, 2], rate**2 * com[2, 2] + gain * com[1, 2]
        return Aim(
            q=np.array(pin.integrate(self.model, aim.q, self.shift)),
            v=rate * aim.v,
            a=rate**2 * aim.a + gain * aim.v,
            torque=np.zeros_like(aim.torque),
            com=com_aim,
            momentum=np.array([rate * momentum[0], rate**2 * momentum[1] + gain * momentum[0]]),
            hands=aim.hands,
        )


def _clear_part(model: Any, reference: Any, scene: Scene, shift: Array) -> float:
    """Fraction of a shift (nv,) of the postures after the blow that leaves links as far apart as planned, or
    by `CLEAR`: legs that shift the body may bring thighs together. All of it, if the plan's capture point
    comes nearer to the soles' edges than `SAFE`: a robot that touches itself still stands.
    """
    time, postures = np.asarray(reference.time), np.asarray(reference.q)
    looked = np.arange(float(reference.contact_end), float(time[-1]) + LOOK, LOOK)
    rows = np.searchsorted(time, looked).clip(0, len(time) - 1)
    q = postures[rows]
    v, data = np.asarray(reference.v)[rows], model.createData()
    capture = [_capture_point(model, data, *state) for state in zip(q, v, strict=True)]
    if distance_inside(scene.polygon, np.array(capture)).min() < SAFE:
        return 1.0
    links = scene.solids.links_between(model, shift)
    least = np.minimum(links.apart(model, q), CLEAR)
    for part in PARTS:
        moved = np.array([pin.integrate(model, row, part * shift) for row in q])
        if np.all(links.apart(model, moved) >= least):
            return part
    return 0.0


def _capture_point(model: Any, data: Any, q: Array, v: Array) -> Array:
    """(2,) [m] on the ground."""
    com = pin.centerOfMass(model, data, q, v)
    return np.asarray(com[:2] + data.vcom[0][:2] * np.sqrt(com[2] / np.linalg.norm(model.gravity.linear)))


def _inside(scene: Scene, com: Array, margin: float) -> Array:
    """The place (2,) [m] next to com (2,), on the way to the soles' middle, with a margin [m] to their edges;
    else the middle.
    """
    middle = (scene.polygon.min(axis=0) + scene.polygon.max(axis=0)) / 2
    has, most = distance_inside(scene.polygon, np.stack([com, middle]))
    way = 1.0 if most <= margin else np.clip((margin - has) / (most - has), 0.0, 1.0)
    return np.asarray(com + way * (middle - com))


def _moved(robot: Robot, q: Array, q0: Array, scene: Scene, margin: float) -> Array:
    """q (nq,), moved by base and legs until the centre of mass is inside the soles by a margin [m]; these are
    where q0 has them, and the base keeps its orientation.
    """
    model, data = robot.model, robot.model.createData()
    soles = [model.getFrameId(name) for name in scene.soles]
    pin.framesForwardKinematics(model, data, q0)
    stood = [data.oMf[i].copy() for i in soles]
    upright = pin.Quaternion(q[3:7]).toRotationMatrix()
    place = _inside(scene, np.array(pin.centerOfMass(model, data, q)[:2]), margin)
    moves = np.zeros(robot.nv)
    moves[:6] = 1.0
    for joint in {j for i in soles for j in model.supports[model.frames[i].parentJoint] if j}:
        moves[model.joints[joint].idx_v : model.joints[joint].idx_v + model.joints[joint].nv] = 1.0
    turns = np.zeros((3, robot.nv))
    for _ in range(STEPS):
        now = pin.Quaternion(q[3:7]).toRotationMatrix()
        turns[:, 3:6] = now
        com = pin.centerOfMass(model, data, q)
        rows, off = [pin.jacobianCenterOfMass(model, data, q)[:2], turns], [place - com[:2]]
        off.append(pin.log3(upright @ now.T))
        pin.computeJointJacobians(model, data, q)
        for i, sole in zip(soles, stood, strict=True):
            at = pin.updateFramePlacement(model, data, i)
            rows.append(np.array(pin.getFrameJacobian(model, data, i, _AXES)))
            off += [sole.translation - at.translation, pin.log3(sole.rotation @ at.rotation.T)]
        step = np.linalg.lstsq(np.vstack(rows) * moves, np.concatenate(off), rcond=SMALLEST)[0]
        q = pin.integrate(model, q, step * min(1.0, LARGEST / max(float(np.abs(step).max()), LARGEST)))
    return np.asarray(q)
