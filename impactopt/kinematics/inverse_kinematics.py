"""Inverse kinematics on fixed soles, and postures that reach a point at rest."""

from __future__ import annotations

import pickle
import weakref
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.optimize import least_squares

from impactopt.arrays import Array
from impactopt.errors import InputError
from impactopt.kinematics.coordinates import StanceCoordinates, solved
from impactopt.kinematics.operational_space import across
from impactopt.kinematics.stance import inward_edges, margin
from impactopt.robots.robot import Robot
from impactopt.robots.tools import inside

UNBOUNDED = 50.0  # [rad, m] stands for an infinite bound


class Reach(NamedTuple):
    """Result of `reach`.

    q (nq,) : the posture.  off : largest error of striking point and soles [m, rad].
    outside : distance of the centre of mass from the support polygon, negative inside [m].
    """

    q: Array
    off: float
    outside: float


def reach(
    robot: Robot,
    held: Sequence[tuple[str, object]],
    polygon: Array,
    striker: str,
    point: Array,
    guess: Array,
    *,
    lean: float = 0.0,
    joint_margin: float = 0.02,
) -> Reach:
    """Least-squares posture near a guess (nq,) with the striking point at `point` (3,) [m].

    held : fixed soles, each a frame and its pin.SE3 in the world.
    polygon (k, 2) : that the centre of mass should be above; (0, 2): none.  lean : by which it may be outside
        [m].
    joint_margin : distance from joint limits [rad].
    """
    model, data = robot.model, robot.model.createData()
    fid = model.getFrameId(f"striker:{striker}")
    frames = [(model.getFrameId(frame), placement) for frame, placement in held]
    base = robot.nv - robot.n
    inward, offset = inward_edges(polygon) if len(polygon) else (np.zeros((0, 2)), np.zeros(0))

    def errors(step: Array) -> Array:
        # step (nv,) is a tangent vector at the guess: quaternions need no constraint.
        q = pin.integrate(model, guess, step)
        pin.forwardKinematics(model, data, q)
        pin.updateFramePlacements(model, data)
        residuals = [pin.log6(data.oMf[f].actInv(placement)).vector for f, placement in frames]
        centre = np.array(pin.centerOfMass(model, data, q))[:2]
        residuals += [point - data.oMf[fid].translation, np.maximum(offset - lean - inward @ centre, 0.0)]
        return np.concatenate([*residuals, 1e-4 * step])  # the last makes the solution unique

    angles = robot.joint_positions(guess)
    # A narrow range keeps its middle half.
    slack = np.minimum(joint_margin, (robot.upper - robot.lower) / 4)
    lower, upper = np.full(robot.nv, -UNBOUNDED), np.full(robot.nv, UNBOUNDED)
    upper[base:] = np.minimum(robot.upper - slack - angles, UNBOUNDED)
    # least_squares requires lower < upper, also of a guess that is outside its limits.
    lower[base:] = np.minimum(np.maximum(robot.lower + slack - angles, -UNBOUNDED), upper[base:] - 1e-9)
    start = np.clip(np.zeros(robot.nv), lower, upper)
    found = least_squares(errors, start, bounds=(lower, upper), xtol=1e-10, ftol=1e-12, max_nfev=80)
    q, off = pin.integrate(model, guess, found.x), np.abs(errors(found.x)[: 6 * len(frames) + 3]).max()
    outside = -np.inf
    if len(polygon):
        centre = np.array(pin.centerOfMass(model, data, q))
        outside = -float(margin(polygon, centre[None, :2])[0])
    return Reach(q, float(off), outside)


FACING_STEPS = 100  # first steps of each attempt, in which the striker's orientation is an aim too
FACING_STEP = 1e-10  # [rad], [m] least step that still turns the striker
FACING_DAMPING = 0.1  # of orientation; position and soles have 1e-8, so that these come first
# [rad] standard deviation of random joint offsets from the guess: in the first attempt, if it has an
# orientation to reach, and in later attempts
FIRST_SPREAD, SPREAD = 0.1, 0.3
# Postures of a robot, or why there is none: copies of a problem with another law or price ask for the same.
_KNOWN: weakref.WeakKeyDictionary[Robot, dict[bytes, Array | str]] = weakref.WeakKeyDictionary()
_MOST_KNOWN = 1000


def inverse_kinematics(
    coordinates: StanceCoordinates,
    striker: str,
    point: Array,
    guess: Array,
    *,
    also: Sequence[tuple[str, Array]] = (),
    facing: tuple[Array, Array] | None = None,
    margin: float = 0.02,
    starts: int = 8,
    tolerance: float = 1e-8,
) -> Array:
    """Pinocchio configuration (nq,) with the striking point at ``point`` (3,) [m] and the soles in place.

    Damped least squares on soles and striking point, from ``guess`` (nq,) and then from random postures about
    it.

    also : other strikers, each with its point.
    facing : axis of the striker's frame, and its desired direction in the world; unit vectors (3,). It is
        approximated, not reached.
    margin : distance of joints from their limits [rad].
    starts : number of attempts.  tolerance : largest error of point and soles [m, rad].

    Raises
    ------
    InputError : no posture found; the message has the smallest error, and the striking points of that posture
        and of the guess.
    """
    given = (striker, also, point, guess, facing, margin, starts, tolerance)
    legs = [(leg.frame, leg.placement.homogeneous.tobytes()) for leg in coordinates.legs]
    key = pickle.dumps((legs, given))
    known = _KNOWN.setdefault(coordinates.robot, {})
    found = known.get(key)
    if found is None:
        try:
            found = _searched(coordinates, *given)
        except InputError as error:
            found = str(error)
        if len(known) >= _MOST_KNOWN:
            known.clear()
        known[key] = found
    if isinstance(found, str):
        raise InputError(found)
    return found.copy()


def _searched(
    coordinates: StanceCoordinates,
    striker: str,
    also: Sequence[tuple[str, Array]],
    point: Array,
    guess: Array,
    facing: tuple[Array, Array] | None,
    margin: float,
    starts: int,
    tolerance: float,
) -> Array:
    """Posture of `inverse_kinematics`."""
    robot, model = coordinates.robot, coordinates.model
    data = model.createData()
    aims = [(striker, point), *also]
    hands = [(model.getFrameId(f"striker:{name}"), point) for name, point in aims]
    soles = [(model.getFrameId(leg.frame), leg.placement) for leg in coordinates.legs]
    lower, upper = inside(robot, margin)
    # a continuous joint has (cos, sin) of its angle in q, and no limits
    joints = robot.joint_models
    limited = np.array([k for k, j in enumerate(joints) if j.nq == 1], dtype=np.intp)
    place = np.array([joints[k].idx_q for k in limited], dtype=np.intp)
    lower, upper = lower[limited], upper[limited]
    # A fixed seed: the same problem has the same posture.
    rng = np.random.default_rng(0)
    base = coordinates.base
    # weights of a step (larger: cheaper). The base is expensive, as a reach with the arm keeps the centre of
    # mass over the feet.
    ease = np.ones(model.nv)
    ease[:base] = 0.02
    best_gap, nearest = np.inf, list[Array]()  # striking points of the best posture
    for k in range(starts):
        q = guess.copy()
        # off the guess: an arm in its plane of symmetry would stay there, whatever the orientation
        if k or facing is not None:
            offsets = (SPREAD if k else FIRST_SPREAD) * rng.standard_normal(robot.n)
            q = pin.integrate(model, q, np.concatenate([np.zeros(base), offsets]))
        step = np.full(model.nv, np.inf)
        for iteration in range(200):
            q[place] = np.minimum(np.maximum(q[place], lower), upper)
            pin.computeJointJacobians(model, data, q)
            pin.updateFramePlacements(model, data)
            errors, jacs = [], []
            for f, placement in soles:
                errors.append(pin.log6(data.oMf[f].actInv(placement)).vector)
                jacs.append(pin.getFrameJacobian(model, data, f, pin.LOCAL))
            for fid, point in reversed(hands):
                errors.append(point - data.oMf[fid].translation)
                hand = pin.getFrameJacobian(model, data, fid, pin.LOCAL_WORLD_ALIGNED)
                hand = np.reshape(hand, (6, model.nv))  # Pinocchio drops an axis if nv is 1
                jacs.append(hand[:3])
            off = float(np.abs(np.concatenate(errors)).max())
            gap = max(float(error @ error) for error in errors) ** 0.5
            if gap < best_gap:
                best_gap, nearest = gap, [data.oMf[fid].translation.copy() for fid, _ in hands]
            orienting = facing is not None and iteration < FACING_STEPS
            if off < tolerance and (not orienting or np.abs(step).max() < FACING_STEP):
                return q
            damping = np.full(6 * len(soles) + 3 * len(hands), 1e-8)
            if facing is not None and orienting:  # fid, hand: of the striker, the last in the loop above
                axis = data.oMf[fid].rotation @ facing[0]
                sides = across(axis)  # two components: a rotation about the axis changes nothing
                errors.append(sides @ _least_rotation(axis, facing[1], sides[0]))
                jacs.append(sides @ hand[3:])
                damping = np.concatenate([damping, [FACING_DAMPING, FACING_DAMPING]])
            e, jac = np.concatenate(errors), np.vstack(jacs)
            # Active set: joints at a limit that the step would violate are fixed, and the step is computed
            # again.
            step = np.zeros(model.nv)
            free = np.ones(model.nv, dtype=bool)
            high, low = q[place] >= upper - 1e-9, q[place] <= lower + 1e-9
            for _ in range(3):
                j = jac[:, free]
                step[:] = 0.0
                # Weighted damped least squares in the small space, W J' (J W J' + D)^-1 e: a system of
                # as many unknowns as errors.
                jw = j * ease[free]
                square = jw @ j.T
                square.flat[:: len(e) + 1] += damping
                step[free] = jw.T @ solved(square, e)
                joint = step[base:][limited]
                violates = np.zeros(robot.n, dtype=bool)
                violates[limited] = (high & (joint > 0)) | (low & (joint < 0))
                if not (violates & free[base:]).any():
                    break
                free[base:] &= ~violates
            # Linearization is good for some tenths of a radian.
            q = pin.integrate(model, q, np.minimum(np.maximum(step, -0.15), 0.15))
    pin.framesForwardKinematics(model, data, guess)
    start = [data.oMf[fid].translation for fid, _ in hands]
    names = " and ".join(f"'{name}'" for name, _ in aims)
    fixed = " with the soles in place" if coordinates.legs else ""
    s, verb, they = ("", "is", "it starts") if len(hands) == 1 else ("s", "are", "they start")
    raise InputError(
        f"the point{s} {_written([aim for _, aim in hands], 4)} {verb} out of reach of {names}{fixed}: the "
        f"nearest posture found is off by {best_gap:.3g} m, with the striking point{s} at "
        f"{_written(nearest, 3)} ({they} at {_written(start, 3)}); move the point{s} nearer to that"
    ) from None


def _written(points: Sequence[Array], digits: int) -> str:
    """Points (3,) [m] in a message."""
    return " and ".join(f"{np.round(point, digits).tolist()} m" for point in points)


def _least_rotation(axis: Array, direction: Array, across: Array) -> Array:
    """Rotation vector (3,) [rad] from ``axis`` to ``direction``; ``across``: at right angles to ``axis``.

    Unit vectors (3,). Opposite ones have no unique rotation; then it is half a turn about ``across``.
    """
    cross, cosine = pin.skew(axis) @ direction, float(axis @ direction)
    sine = float(np.linalg.norm(cross))
    if sine < 1e-9:
        return np.zeros(3) if cosine > 0 else np.pi * across
    return np.asarray(cross * (np.arctan2(sine, cosine) / sine))
