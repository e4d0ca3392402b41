"""Sampling of a reference trajectory for exports: joint motion, effort, base, contact force and ZMP."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.interpolate import BPoly, PchipInterpolator
from scipy.spatial.transform import Rotation

from impactopt.arrays import Array, Index, Mask
from impactopt.kinematics.stance import zmp
from impactopt.robots.robot import Robot
from impactopt.transcription.plan import Trajectory

JUMP = 1e-6  # [s] between the two samples at a jump, so that time is strictly ascending
CONTACT = 1  # phase


@dataclass(frozen=True, kw_only=True, eq=False)
class Base:
    """Pose and velocity of the robot's root link at k instants, along the world's axes.

    position (k, 3) [m]; quaternion (k, 4) : w, x, y, z; linear (k, 3) [m/s]; angular (k, 3) [rad/s].
    """

    position: Array
    quaternion: Array
    linear: Array
    angular: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """Reference of the servos, and planned force and ZMP, at k instants; joints in the order of the export.

    time (k,) [s], strictly ascending.  phase (k,) : 0 swing, 1 contact, 2 follow-through.
    position, velocity, acceleration, effort (k, n) : of the joints; effort is the feed-forward. In SI units
    of revolute joints; for a prismatic joint m, m/s, m/s2, N.
    base : None for a robot on a fixed base.
    force (k,) [N] : on the target, along its normal; zero outside of contact.
    zmp (k, 2) [m] : None without soles; nan where it is not defined.
    contact_start, contact_end, end [s].  stance (k,) : index of the stance phase; None for one stance.
    """

    time: Array
    phase: Index
    position: Array
    velocity: Array
    acceleration: Array
    effort: Array
    base: Base | None
    force: Array
    zmp: Array | None
    contact_start: float
    contact_end: float
    end: float
    stance: Index | None = None


def motion_at(
    reference: Trajectory,
    robot: Robot,
    rate: float,
    order: Index,
    arrays: Mapping[str, Any],
    *,
    jumps: bool = True,
) -> Motion:
    """The reference sampled at `rate` [Hz], from its start to its end.

    Positions, velocities and accelerations are those of one curve, the quintic spline through the reference's
    at its own instants (some 1 ms apart), so they are consistent derivatives. Feed-forward is interpolated
    linearly, as in the servo of our replays.

    order (n,) : indices of the robot's joints in the order of the export.
    arrays : of the record, for `collision_*`; empty for a motion that hits nothing.
    jumps : add both sides of the reference's jumps to the samples, `JUMP` apart, and the instant of the
        largest force; else there are samples at multiples of 1 / rate only.
    """
    reference = _with_rest_at_end(reference, robot, 1 / rate)
    # multiples of 1 / rate, to the first one at or after the end, where the robot is at rest
    grid = np.arange(int(np.ceil(reference.end * rate - 1e-9)) + 1) / rate
    grid = grid if not jumps else np.append(grid[grid < reference.end - JUMP], reference.end)
    edges = (reference.contact_start, reference.contact_end)
    curves = _curves(reference, robot)
    parts = []
    for phase in range(3):
        own = np.flatnonzero(reference.phase == phase)
        first, last = reference.time[own[0]], reference.time[own[-1]]
        if last - first < 2 * JUMP:  # an impact without duration
            continue
        gap = 2 * JUMP if jumps else 0.0
        inside = grid[(grid >= first + gap * (phase > 0)) & (grid < last - gap)]
        if phase == CONTACT and jumps and len(arrays.get("collision_time", ())) > 1:
            # The peak of the force, which may be shorter than a period.
            peak = first + arrays["collision_time"][np.argmax(arrays["collision_force"])]
            if first + gap <= peak < last - gap:
                inside = np.union1d(inside[np.abs(inside - peak) > JUMP], peak)
        times = inside if not jumps else np.concatenate([[first] * (phase > 0), inside, [last] * (phase < 2)])
        if phase == 2 and jumps:
            times = np.append(times[times < reference.end], reference.end)
        parts.append(_phase(phase, times, own, reference, curves, arrays))
    time = np.concatenate([part["time"] for part in parts])
    # the second of two samples at the same instant, at a jump
    late = np.flatnonzero(np.diff(time) <= 0) + 1
    time[late] = time[late - 1] + JUMP
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0] if name != "time"}
    joint = slice(-robot.n, None)
    soles = bool(np.any(reference.ground))
    return Motion(
        time=time,
        phase=whole["phase"],
        position=whole["position"][:, joint][:, order],
        velocity=whole["velocity"][:, joint][:, order],
        acceleration=whole["acceleration"][:, joint][:, order],
        effort=whole["effort"][:, order],
        base=_base(whole) if robot.floating else None,
        force=whole["force"],
        zmp=whole["zmp"] if soles else None,
        contact_start=edges[0],
        contact_end=edges[1],
        end=reference.end,
        stance=_stances(reference, time),
    )


def _stances(reference: Trajectory, time: Array) -> Index | None:
    """Index of the stance phase at each instant (k,) [s]; None without stance phases."""
    if not reference.stance.size:
        return None
    samples = np.searchsorted(reference.time, time, side="right") - 1
    return reference.stance[samples.clip(0)]


def with_passive_at_rest(motion: Motion, passive: Mask) -> Motion:
    """The motion with constant references of passive joints (n,): position and effort are those at the start.

    They have no servos.
    """
    if not passive.any():
        return motion
    fixed = {
        name: getattr(motion, name).copy() for name in ("position", "velocity", "acceleration", "effort")
    }
    for name, value in fixed.items():
        value[:, passive] = value[0, passive] if name in ("position", "effort") else 0.0
    return dataclasses.replace(motion, **fixed)


def _with_rest_at_end(reference: Trajectory, robot: Robot, period: float) -> Trajectory:
    """The reference with its last instant, at rest, at `end` exactly, and once more after a `period` [s].

    So the curve ends there. Through instants before and after `end` it would not be at rest. The first
    multiple of the period after `end` is in it. The base of a robot without soles drifts on meanwhile.
    """
    fields = {f.name: getattr(reference, f.name) for f in dataclasses.fields(reference)}
    histories = {name: value for name, value in fields.items() if np.ndim(value)}
    before = int(np.searchsorted(reference.time, reference.end - JUMP))
    if before < len(reference.time):
        histories = {name: np.concatenate([x[:before], x[-1:], x[-1:]]) for name, x in histories.items()}
        histories["time"][-2:] = reference.end, max(reference.time[-1], reference.end + period + JUMP)
        if robot.floating and not np.any(reference.ground):
            for k in (-2, -1):
                here = int(np.searchsorted(reference.time, histories["time"][k], side="right")) - 1
                q, v, a = reference.q[here], reference.v[here], reference.a[here]
                dt = histories["time"][k] - reference.time[here]
                histories["q"][k, :7] = pin.integrate(robot.model, q, dt * (v + dt / 2 * a))[:7]
                histories["v"][k, :6], histories["a"][k, :6] = (v + dt * a)[:6], a[:6]
    return dataclasses.replace(reference, **histories)


def _curves(reference: Trajectory, robot: Robot) -> tuple[Array, Array, Array]:
    """Values, first and second time derivatives (k, d) of continuous coordinates: of the base, then joints.

    The base has seven: position, and quaternion w, x, y, z.
    """
    q, v, a = reference.q, reference.v, reference.a
    continuous = robot.angles.continuous
    angle = robot.joint_positions(q)
    angle[:, continuous] = np.unwrap(angle[:, continuous], axis=0)
    values, firsts, seconds = [angle], [v[:, -robot.n :]], [a[:, -robot.n :]]
    if robot.floating:
        # of the quaternions q and -q of a rotation, the one nearer to the sample before
        quaternion = q[:, [6, 3, 4, 5]].copy()
        flips = np.cumsum(np.einsum("ij,ij->i", quaternion[1:], quaternion[:-1]) < 0) % 2
        quaternion[1:][flips == 1] *= -1.0
        # v and a are along the base's axes: dq/dt = q w / 2, d2q/dt2 = (dq/dt w + q dw/dt) / 2
        spin, spin_rate = v[:, 3:6], a[:, 3:6]
        rate = _product(quaternion, spin) / 2
        second = (_product(rate, spin) + _product(quaternion, spin_rate)) / 2
        linear = _turned(quaternion, v[:, :3])
        acceleration = _turned(quaternion, a[:, :3] + np.cross(spin, v[:, :3]))
        values = [q[:, :3], quaternion, *values]
        firsts, seconds = [linear, rate, *firsts], [acceleration, second, *seconds]
    return np.hstack(values), np.hstack(firsts), np.hstack(seconds)


def _quintics(knots: Array, value: Array, first: Array, second: Array) -> BPoly:
    """Curve (d,) with these values and derivatives (k, d) at its knots (k,), a quintic between each two."""
    h = np.diff(knots)[:, None]
    half = [
        (value[at], sign * h / 5 * first[at], h**2 / 20 * second[at])
        for at, sign in ((slice(None, -1), 1), (slice(1, None), -1))
    ]
    # its Bernstein coefficients, from each end inwards
    start, end = ([y, y + d, y + 2 * d + dd] for y, d, dd in half)
    return BPoly(np.stack([*start, *reversed(end)]), knots)


def _phase(
    phase: int,
    times: Array,
    own: Index,
    reference: Trajectory,
    curves: tuple[Array, Array, Array],
    arrays: Mapping[str, Any],
) -> dict[str, Any]:
    """Fields of `Motion`, with full curves, of one phase at its instants.

    own : indices of the phase's samples in the reference.
    """
    knots = reference.time[own]
    curve = _quintics(knots, *(part[own] for part in curves))
    ground = np.stack([np.interp(times, knots, w) for w in reference.ground[own].T], axis=1)
    force = np.zeros(len(times))
    since = times - reference.contact_start
    if phase == CONTACT and len(arrays.get("collision_time", ())) > 1:
        # force and ground wrench in contact are those of the planned collision, not of the reference
        hit = arrays["collision_time"]
        force = np.clip(PchipInterpolator(hit, arrays["collision_force"])(since.clip(0, hit[-1])), 0.0, None)
        wrench = arrays["collision_ground"]
        if len(wrench) and np.any(wrench):
            at = hit[-len(wrench) :]
            # from the swing's last wrench to the first one of the collision
            at, wrench = np.append(0.0, at), np.vstack([reference.ground[own[0] - 1], wrench])
            ground = np.stack([np.interp(since, at, w) for w in wrench.T], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        place = zmp(ground) if np.any(reference.ground) else np.zeros((len(times), 2))
    return {
        "time": times.copy(),
        "phase": np.full(len(times), phase),
        "position": curve(times),
        "velocity": curve.derivative()(times),
        "acceleration": curve.derivative(2)(times),
        "effort": np.stack([np.interp(times, knots, tau) for tau in reference.torque[own].T], axis=1),
        "force": force,
        "zmp": place,
    }


def _base(whole: Mapping[str, Any]) -> Base:
    """Pose and velocity of the base from its curves, whose quaternions are only nearly of norm 1."""
    position, rate = whole["position"], whole["velocity"]
    quaternion, derivative = position[:, 3:7], rate[:, 3:7]
    size = np.linalg.norm(quaternion, axis=1, keepdims=True)
    # the angular velocity in the link's axes is twice the vector part of conj(quaternion) x derivative
    w, vector = quaternion[:, :1], quaternion[:, 1:]
    spin = w * derivative[:, 1:] - derivative[:, :1] * vector - np.cross(vector, derivative[:, 1:])
    spin = 2 * spin / size**2
    quaternion = quaternion / size
    return Base(
        position=position[:, :3], quaternion=quaternion, linear=rate[:, :3], angular=_turned(quaternion, spin)
    )


def _product(quaternion: Array, vector: Array) -> Array:
    """Products (k, 4) of quaternions (k, 4), w first, and vectors (k, 3)."""
    w, u = quaternion[:, :1], quaternion[:, 1:]
    real = -np.einsum("ij,ij->i", u, vector)[:, None]
    return np.hstack([real, w * vector + np.cross(u, vector)])


def _turned(quaternion: Array, vector: Array) -> Array:
    """Vectors (k, 3) rotated by unit quaternions (k, 4)."""
    return np.asarray(Rotation.from_quat(quaternion[:, [1, 2, 3, 0]]).apply(vector))
