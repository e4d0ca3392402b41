"""Histories that both engines record, and the displacements of soles and posture."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.errors import InputError
from impactopt.robots.loads import DriveLoads, cop_margin
from impactopt.robots.robot import Robot
from impactopt.simulation.result import Scene, Simulation


def parts_from(reference: Any, missed: Any) -> float:
    """Time [s] from which a robot that has felt no contact follows ``missed``, and not ``reference``.

    Both coast from the planned contact on. The one goes on to the follow-through at its ``contact_end``; the
    other goes on coasting, until the robot notices at its own ``contact_end``, and is the abort motion then.
    """
    return min(float(reference.contact_end), float(missed.contact_end))


class FollowedReference:
    """Choice of the servo's reference, by whether the robot has felt a contact.

    A robot knows that it has hit something when it feels it, but that it has hit nothing only at
    ``missed.contact_end``: until then it goes over to ``reference`` when it is late.

    reference, missed : as of :class:`impactopt.transcription.plan.Trajectory`.  missed None: it does not
        notice, and ``reference`` is all that it has.
    """

    def __init__(self, reference: Any, missed: Any = None) -> None:
        self._reference, self._missed = reference, missed
        self._parts = np.inf if missed is None else parts_from(reference, missed)
        self._aborts = False

    def at(self, t: float, felt: bool) -> Any:
        """The reference from a time [s] on; felt : whether there has been a contact yet."""
        if t < self._parts:
            return self._reference
        self._aborts = self._aborts or (not felt and t >= self._missed.contact_end)
        return self._reference if felt and not self._aborts else self._missed


class Touches:
    """Intervals of contact, told step by step. A graze before or after the blow is an interval of its own."""

    def __init__(self) -> None:
        self.intervals: list[list[float]] = []  # start [s], end [s], impulse [N s]
        self.touching = False

    def add(self, t: float, force: float, step: float, since: float = 0.0) -> None:
        """The contact's mean force [N] in the step that begins at time t [s]; since [s]: when in it there was
        one first."""
        if force > 0:
            if not self.touching:
                self.intervals.append([t + since, t + since, 0.0])
            self.intervals[-1][2] += force * step
        if self.touching or force > 0:
            self.intervals[-1][1] = max(t, self.intervals[-1][0])
        self.touching = force > 0

    def blow(self) -> tuple[float, float]:
        """Start and end [s] of the contact with the largest impulse; nan if there was none."""
        if not self.intervals:
            return np.nan, np.nan
        start, end, _ = max(self.intervals, key=lambda interval: interval[2])
        return start, end


Array = NDArray[np.float64]


def sole_names(robot: Robot, scene: Scene) -> tuple[str, ...]:
    """The robot's names of the scene's soles, in the scene's order."""
    names = {sole.frame: sole.name for sole in robot.soles}
    return tuple(names.get(frame, frame) for frame in scene.soles)


def cop_margins(robot: Robot, scene: Scene, q: Array, sole_ground: Array) -> Array:
    """Distance (k, soles) [m] of each sole's centre of pressure from its own edges, as of `cop_margin`.

    q (k, nq); sole_ground (k, soles, 6) about the world's origin [N, N m].
    """
    model, data = robot.model, robot.model.createData()
    frames = [model.getFrameId(name) for name in scene.soles]
    wrenches = np.empty_like(sole_ground)
    for k, posture in enumerate(q if frames else ()):
        pin.forwardKinematics(model, data, posture)
        for i, frame in enumerate(frames):
            place = pin.updateFramePlacement(model, data, frame)
            # in the sole's own frame, so that a tilted sole's edges are its edges
            wrenches[k, i] = place.actInv(pin.Force(sole_ground[k, i])).vector
    return cop_margin(robot, scene.corners, wrenches)


def slip_and_lift(scene: Scene, corners: Array) -> tuple[Array, Array]:
    """(k, soles) [m] of each sole, of the corner that moved most since the first instant, from the places
    (k, corners, 3) of all soles' corners, in the scene's order.
    """
    moves = corners - corners[0]
    level, up = np.linalg.norm(moves[..., :2], axis=2), np.maximum(moves[..., 2], 0.0)
    first = np.cumsum([0, *(len(c) for c in scene.corners)])
    soles = [slice(a, b) for a, b in itertools.pairwise(first)]
    slip, lift = np.zeros((2, len(corners), len(soles)))
    for i, its in enumerate(soles):
        slip[:, i], lift[:, i] = level[:, its].max(axis=1), up[:, its].max(axis=1)
    return slip, lift


def check_not_diverged(rates: Array, t: float, step: float) -> None:
    """InputError with the time [s] if the rates [rad/s, m/s] are of no robot."""
    if not np.abs(rates).max() <= 1e4:  # nan is not, either
        raise InputError(
            f"the simulation diverged at t = {t:.4f} s: take a smaller step than {step:g} s, or softer gains"
        )


def posture_error(model: Any, q: Array, planned: Array) -> float:
    """[rad] of the joint, or of the base's orientation, that is farthest from where it should be."""
    error = np.abs(pin.difference(model, planned, q))
    if model.joints[1].nv == 6:
        return float(max(np.linalg.norm(error[3:6]), error[6:].max(initial=0.0)))
    return float(error.max())


def simulation_of(
    robot: Robot, scene: Scene, rows: list[tuple[Any, ...]], touches: Touches, **rest: Any
) -> Simulation:
    """Histories of recorded instants: rows of time, q, v, force, target speed, hand speed, demand, torque,
    wrench of each sole and each hand that holds on, places of the soles' corners, torque through the gears
    since the row before; ``rest``: the other fields.
    """
    if not rows:
        raise InputError("the step of the simulation is longer than its motion: give a shorter one (--step)")
    columns = [np.array(c) for c in zip(*rows, strict=True)]
    time, q, v, force, target_speed, hand_speed, demand, torque, sole_ground, corners, gear = columns
    slip, lift = slip_and_lift(scene, corners)
    contact_start, contact_end = touches.blow()
    joints, soles = v[:, -robot.n :], len(scene.soles)
    sole_ground, grips = sole_ground[:, :soles], sole_ground[:, soles:]
    return Simulation(
        time=time,
        q=q,
        v=v,
        force=force,
        target_speed=target_speed,
        hand_speed=hand_speed,
        demand=demand,
        torque=torque,
        sole_ground=sole_ground,
        soles=sole_names(robot, scene),
        cop_margin=cop_margins(robot, scene, q, sole_ground),
        slip=slip,
        lift=lift,
        grip_force=np.linalg.norm(grips[:, :, :3], axis=2),
        gear=gear,
        loads=DriveLoads.of(
            robot,
            gear=gear,
            torque=torque,
            velocity=joints,
            jump=_jump(time, joints, contact_start, contact_end),
        ),
        contact_start=contact_start,
        contact_end=contact_end,
        touches=tuple((start, end, impulse) for start, end, impulse in touches.intervals),
        **rest,
    )


def _jump(time: Array, rates: Array, start: float, end: float) -> Array:
    """(n,) Change of the joints' rates (k, n) from before the contact to after it; nan: there was none."""
    if not (np.isfinite(start) and end <= time[-1]):
        return np.full(rates.shape[1], np.nan)
    before = max(int(np.searchsorted(time, start, side="right")) - 1, 0)
    return np.asarray(rates[int(np.searchsorted(time, end))] - rates[before])
