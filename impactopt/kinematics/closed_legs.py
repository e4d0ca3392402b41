"""Inverse kinematics of held legs for many instants of a motion at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.kinematics.coordinates import Leg, StanceCoordinates

__all__ = ["close_legs"]

Array = NDArray[np.float64]
TOLERANCE = 1e-12  # [m], [rad], as of `StanceCoordinates.solve_legs`
ITERATIONS = 20
LONGEST = 0.3  # [rad] of a Newton step
NEAR = 0.3  # [rad] from one instant to the next: what is farther may be another way to bend a knee


def close_legs(c: StanceCoordinates, y: Array, guess: Array) -> Array:
    """Leg joints (k, nl) that put every held sole in its place at coordinates y (k, ny), one near the next.

    As `StanceCoordinates.solve_legs` from the instant before, of the first from ``guess`` (nl,); but Newton's
    method runs for all instants at once, and again by itself where that led elsewhere.

    Raises
    ------
    InputError : a sole cannot be reached.
    """
    out = np.tile(np.asarray(guess, dtype=float), (len(y), 1))
    if not c.legs or not len(y):
        return out
    root, joints = _roots(c, y), np.zeros((len(y), c.robot.n))
    joints[:, c.independent] = y[:, c.base :]
    found = np.ones(len(y), dtype=bool)
    for k, leg in enumerate(c.legs):
        own = slice(6 * k, 6 * k + 6)
        found &= _LegChain(c, leg).close(*root, joints, out[:, own])
    before = np.asarray(guess, dtype=float)
    for k, row in enumerate(y):
        if not found[k] or (k and np.abs(out[k] - before).max() > NEAR):
            out[k] = c.solve_legs(row, before)
        before = out[k]
    return out


def _roots(c: StanceCoordinates, y: Array) -> tuple[Array, Array]:
    """Rotation (k, 3, 3) and position (k, 3) [m] of the base; of a fixed one those of the world."""
    if not c.base:
        return np.tile(np.eye(3), (len(y), 1, 1)), np.zeros((len(y), 3))
    rotation = np.array([pin.rpy.rpyToMatrix(angles) for angles in y[:, 3:6]])
    return rotation, y[:, :3]


@dataclass(frozen=True)
class _Joint:
    """place : of its frame in that of the joint before (pin.SE3).  axis (3,) in its own frame.  turns :
    whether it turns or slides.  number : among the robot's.  moved : its place among the leg's six, or None.
    """

    place: Any
    axis: Array
    turns: bool
    number: int
    moved: int | None


class _LegChain:
    """The joints from the base to a held sole."""

    def __init__(self, c: StanceCoordinates, leg: Leg) -> None:
        model = c.model
        frame = model.frames[model.getFrameId(leg.frame)]
        self._end, self._target = frame.placement, leg.placement
        self._joints = list[_Joint]()
        own = {int(j): k for k, j in enumerate(leg.joints)}
        place = pin.SE3.Identity()
        for j in model.supports[frame.parentJoint]:
            joint = model.joints[j]
            if j == 0 or joint.nv == 6:
                place = place if j == 0 or c.base else place * model.jointPlacements[j]
                continue
            data = joint.createData()
            joint.calc(data, pin.neutral(model))
            subspace, number = np.asarray(data.S).reshape(6), joint.idx_v - c.base
            turns = bool(np.any(subspace[3:]))
            axis = subspace[3:] if turns else subspace[:3]
            self._joints.append(
                _Joint(place * model.jointPlacements[j], axis, turns, number, own.get(number))
            )
            place = pin.SE3.Identity()

    def close(self, rotation: Array, position: Array, joints: Array, legs: Array) -> NDArray[np.bool_]:
        """Newton's method on the legs (k, 6), in place; where (k,) it has converged.

        rotation (k, 3, 3), position (k, 3) : of the base.  joints (k, n) : all others.
        """
        left = np.arange(len(legs))
        for _ in range(ITERATIONS):
            error, jacobian = self._off(rotation[left], position[left], joints[left], legs[left])
            transposed = jacobian.transpose(0, 2, 1)
            normal = transposed @ jacobian + 1e-12 * np.eye(6)
            step = np.linalg.solve(normal, transposed @ error[:, :, None])[:, :, 0]
            legs[left] += np.clip(step, -LONGEST, LONGEST)
            left = left[np.abs(error).max(axis=1) >= TOLERANCE]
            if not left.size:
                break
        found = np.ones(len(legs), dtype=bool)
        found[left] = False
        return found

    def _off(self, rotation: Array, position: Array, joints: Array, legs: Array) -> tuple[Array, Array]:
        """Twists (k, 6) that would lead the sole to its place, in its own frame, and the Jacobian (k, 6, 6)
        of the leg's joints in it.
        """
        axes, points = np.zeros((6, len(legs), 3)), np.zeros((6, len(legs), 3))
        slides = np.zeros(6, dtype=bool)
        for joint in self._joints:
            position = position + rotation @ joint.place.translation
            rotation = rotation @ joint.place.rotation
            angle = joints[:, joint.number] if joint.moved is None else legs[:, joint.moved]
            if joint.moved is not None:
                axes[joint.moved], points[joint.moved] = rotation @ joint.axis, position
                slides[joint.moved] = not joint.turns
            if joint.turns:
                rotation = rotation @ _turned(joint.axis, angle)
            else:
                position = position + (rotation @ joint.axis) * angle[:, None]
        position = position + rotation @ self._end.translation
        rotation = rotation @ self._end.rotation
        moved = np.where(slides[:, None, None], axes, np.cross(axes, position - points))
        turned = np.where(slides[:, None, None], 0.0, axes)
        jacobian = np.concatenate([_into(rotation, moved), _into(rotation, turned)], axis=1)
        away = _into(rotation, (self._target.translation - position)[None])[:, :, 0]
        return _logarithm(rotation.transpose(0, 2, 1) @ self._target.rotation, away), jacobian


def _into(rotation: Array, vectors: Array) -> Array:
    """Vectors (m, k, 3) in the axes of rotations (k, 3, 3), as columns (k, 3, m)."""
    return rotation.transpose(0, 2, 1) @ vectors.transpose(1, 2, 0)


def _turned(axis: Array, angle: Array) -> Array:
    """Rotations (k, 3, 3) about an axis (3,) by angles (k,)."""
    cross = pin.skew(axis)
    sine, less = np.sin(angle)[:, None, None], (1.0 - np.cos(angle))[:, None, None]
    return np.asarray(np.eye(3) + sine * cross + less * (cross @ cross))


def _logarithm(rotation: Array, shift: Array) -> Array:
    """Twists (k, 6) that lead to the placements of rotations (k, 3, 3) and shifts (k, 3) in a unit of time,
    for turns by less than half of a circle.
    """
    half = 0.5 * (rotation - rotation.transpose(0, 2, 1))
    sine_axis = np.stack([half[:, 2, 1], half[:, 0, 2], half[:, 1, 0]], axis=1)
    sine = np.linalg.norm(sine_axis, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(rotation, axis1=1, axis2=2) - 1.0))
    small = angle < 1e-4
    safe, safe_sine = np.where(small, 1.0, angle), np.where(small, 1.0, sine)
    turn = sine_axis * np.where(small, 1.0, safe / np.maximum(safe_sine, 1e-12))[:, None]
    bend = np.where(small, 1.0 / 12.0, (1.0 - safe / (2.0 * np.tan(0.5 * safe))) / safe**2)
    twisted = np.cross(turn, shift)
    moved = shift - 0.5 * twisted + bend[:, None] * np.cross(turn, twisted)
    return np.concatenate([moved, turn], axis=1)
