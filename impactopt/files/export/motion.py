"""A reference at chosen instants: what every writer of an export gets of a motion."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BPoly, PchipInterpolator

from impactopt.kinematics.support import zmp
from impactopt.robots.robot import Robot
from impactopt.transcription.plan import Trajectory

__all__ = ["JUMP", "Base", "Motion", "motion_at", "springs_at_rest"]

Array = NDArray[np.float64]
JUMP = 1e-6  # [s] by which the later one of two rows at a jump is reported later
CONTACT = 1  # phase


@dataclass(frozen=True, kw_only=True, eq=False)
class Base:
    """The robot's root link at k instants, its origin and axes, in the world's axes.

    position (k, 3) [m]; quaternion (k, 4) : w, x, y, z; linear (k, 3) [m/s]; angular (k, 3) [rad/s].
    """

    position: Array
    quaternion: Array
    linear: Array
    angular: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """The servo's reference and what the plan expects, at k instants; joints in the order of the export.

    time (k,) [s], strictly ascending.  phase (k,) : 0 swing, 1 contact, 2 follow-through.
    position, velocity, acceleration, effort (k, n) : of the joints; effort is the feed-forward. In SI units
    of revolute joints; of a prismatic joint m, m/s, m/s2, N.
    base : None of a robot on a fixed base.
    force (k,) [N] on the target, along its normal; zero outside of contact.  zmp (k, 2) [m], or None
    without soles; nan where nothing is known of it.
    contact_start, contact_end, end [s].  stance (k,) : number of the stance phase; None: there is one stance.
    """

    time: Array
    phase: NDArray[np.intp]
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
    stance: NDArray[np.intp] | None = None


def _frames(end: float, rate: float) -> Array:
    """Instants 1 / rate [Hz] apart from 0 to the last one before `end` [s], and one more that is at rest."""
    return np.arange(int(np.ceil(end * rate - 1e-9)) + 1) / rate


def motion_at(
    reference: Trajectory,
    robot: Robot,
    rate: float,
    order: NDArray[np.intp],
    arrays: Mapping[str, Any],
    *,
    jumps: bool = True,
) -> Motion:
    """The reference at `rate` [Hz], from its start to its end.

    Positions, velocities and accelerations are those of one curve, the quintic that has the reference's at
    its own instants (some 1 ms apart), so velocities are no differences. Feed-forward goes straight between
    them, as in the servo of our replays.

    order (n,) : the robot's joints in the order of the export.
    arrays : of the record, for `collision_*`; empty for a motion that hits nothing.
    jumps : the reference's jumps are among the instants, from both sides, the later ones `JUMP` later;
        else there is a frame at every multiple of 1 / rate, and none elsewhere.
    """
    reference = _ending(reference)
    grid = _frames(reference.end, rate)
    grid = grid if not jumps else np.append(grid[grid < reference.end - JUMP], reference.end)
    edges = (reference.contact_start, reference.contact_end)
    curves = _curves(reference, robot)
    parts = []
    for phase in range(3):
        rows = np.flatnonzero(reference.phase == phase)
        first, last = reference.time[rows[0]], reference.time[rows[-1]]
        if last - first < 2 * JUMP:  # an impact without duration
            continue
        gap = 2 * JUMP if jumps else 0.0
        inside = grid[(grid >= first + gap * (phase > 0)) & (grid < last - gap)]
        times = inside if not jumps else np.concatenate([[first] * (phase > 0), inside, [last] * (phase < 2)])
        if phase == 2 and jumps:
            times = np.append(times[times < reference.end], reference.end)
        parts.append(_phase(phase, times, rows, reference, curves, arrays))
    told = np.concatenate([part["time"] for part in parts])
    late = np.flatnonzero(np.diff(told) <= 0) + 1
    told[late] = told[late - 1] + JUMP
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0] if name != "time"}
    joint = slice(-robot.n, None)
    soles = bool(np.any(reference.ground))
    return Motion(
        time=told,
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
        stance=_stances(reference, told),
    )


def _stances(reference: Trajectory, time: Array) -> NDArray[np.intp] | None:
    """Number of the stance phase at each instant (k,) [s]."""
    if not reference.stance.size:
        return None
    rows = np.searchsorted(reference.time, time, side="right") - 1
    return reference.stance[rows.clip(0)]


def springs_at_rest(motion: Motion, springs: NDArray[np.bool_]) -> Motion:
    """The motion as servos get it, where some joints (n,) are springs: these are asked to stay, and to bear
    what they bear at the start.
    """
    if not springs.any():
        return motion
    held = {name: getattr(motion, name).copy() for name in ("position", "velocity", "acceleration", "effort")}
    for name, value in held.items():
        value[:, springs] = value[0, springs] if name in ("position", "effort") else 0.0
    return dataclasses.replace(motion, **held)


def _ending(reference: Trajectory) -> Trajectory:
    """Reference with a last instant at rest: a curve through the instants about it would not be."""
    fields = {f.name: getattr(reference, f.name) for f in dataclasses.fields(reference)}
    histories = {name: value for name, value in fields.items() if np.ndim(value)}
    before = int(np.searchsorted(reference.time, reference.end - JUMP))
    if before < len(reference.time):
        kept = {name: np.concatenate([x[:before], x[-1:], x[-1:]]) for name, x in histories.items()}
        kept["time"][-2:] = reference.end, max(reference.time[-1], reference.end + JUMP)
        histories = kept
    return dataclasses.replace(reference, **histories)


def _curves(reference: Trajectory, robot: Robot) -> tuple[Array, Array, Array]:
    """Values, rates and second rates (k, d) of numbers that a polynomial may go through: base, then joints.

    The base has seven: position, and quaternion w, x, y, z.
    """
    q, v, a = reference.q, reference.v, reference.a
    joints = robot.joint_models
    turning = [k for k, joint in enumerate(joints) if joint.nq == 2]
    angle = robot.joint_positions(q)
    angle[:, turning] = np.unwrap(angle[:, turning], axis=0)
    values, rates, bends = [angle], [v[:, -robot.n :]], [a[:, -robot.n :]]
    if robot.floating:
        quaternion = q[:, [6, 3, 4, 5]].copy()
        turns = np.cumsum(np.einsum("ij,ij->i", quaternion[1:], quaternion[:-1]) < 0) % 2
        quaternion[1:][turns == 1] *= -1.0
        spin, more = v[:, 3:6], a[:, 3:6]
        rate = _product(quaternion, spin) / 2
        bend = (_product(rate, spin) + _product(quaternion, more)) / 2
        linear = _turned(quaternion, v[:, :3])
        gain = _turned(quaternion, a[:, :3] + np.cross(spin, v[:, :3]))
        values = [q[:, :3], quaternion, *values]
        rates, bends = [linear, rate, *rates], [gain, bend, *bends]
    return np.hstack(values), np.hstack(rates), np.hstack(bends)


def _phase(
    phase: int,
    times: Array,
    rows: NDArray[np.intp],
    reference: Trajectory,
    curves: tuple[Array, Array, Array],
    arrays: Mapping[str, Any],
) -> dict[str, Any]:
    """All that there is of one phase at its instants."""
    own = reference.time[rows]
    curve = BPoly.from_derivatives(own, np.stack([part[rows] for part in curves], axis=1))
    ground = np.stack([np.interp(times, own, w) for w in reference.ground[rows].T], axis=1)
    force = np.zeros(len(times))
    since = times - reference.contact_start
    if phase == CONTACT and len(arrays.get("collision_time", ())) > 1:
        hit = arrays["collision_time"]
        force = np.clip(PchipInterpolator(hit, arrays["collision_force"])(since.clip(0, hit[-1])), 0.0, None)
        wrench = arrays["collision_ground"]
        if len(wrench) and np.any(wrench):
            at = hit[-len(wrench) :]
            # the ground has the swing's last wrench until the blow is felt
            at, wrench = np.append(0.0, at), np.vstack([reference.ground[rows[0] - 1], wrench])
            ground = np.stack([np.interp(since, at, w) for w in wrench.T], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        place = zmp(ground) if np.any(reference.ground) else np.zeros((len(times), 2))
    return {
        "time": times.copy(),
        "phase": np.full(len(times), phase),
        "position": curve(times),
        "velocity": curve.derivative()(times),
        "acceleration": curve.derivative(2)(times),
        "effort": np.stack([np.interp(times, own, tau) for tau in reference.torque[rows].T], axis=1),
        "force": force,
        "zmp": place,
    }


def _base(whole: Mapping[str, Any]) -> Base:
    position, rate = whole["position"], whole["velocity"]
    quaternion, turning = position[:, 3:7], rate[:, 3:7]
    size = np.linalg.norm(quaternion, axis=1, keepdims=True)
    # the spin in the link's axes is twice the vector of conj(quaternion) x its rate
    w, vector = quaternion[:, :1], quaternion[:, 1:]
    spin = 2 * (w * turning[:, 1:] - turning[:, :1] * vector - np.cross(vector, turning[:, 1:])) / size**2
    quaternion = quaternion / size
    return Base(
        position=position[:, :3],
        quaternion=quaternion,
        linear=rate[:, :3],
        angular=_turned(quaternion, spin),
    )


def _product(quaternion: Array, vector: Array) -> Array:
    """Quaternions (k, 4) times vectors (k, 3)."""
    w, u = quaternion[:, :1], quaternion[:, 1:]
    real = -np.einsum("ij,ij->i", u, vector)[:, None]
    return np.hstack([real, w * vector + np.cross(u, vector)])


def _turned(quaternion: Array, vector: Array) -> Array:
    """Vectors (k, 3) turned by quaternions (k, 4) of length 1."""
    w, u = quaternion[:, :1], quaternion[:, 1:]
    twice = 2 * np.cross(u, vector)
    return np.asarray(vector + w * twice + np.cross(u, twice))
