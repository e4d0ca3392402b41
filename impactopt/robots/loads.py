"""Loads in a motion: of gears and motors, and of each sole (normal force, centre-of-pressure margin)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from impactopt.arrays import Array, Index, Mask
from impactopt.robots.actuators import numbers_of
from impactopt.robots.robot import Robot


def gear_torque(robot: Robot, torque: ArrayLike, acceleration: ArrayLike) -> Array:
    """Torque (..., n) [N m] through the gears: the servo's minus that which accelerates the rotor.

    torque (..., n) [N m] of the servo; acceleration (..., n) [rad/s^2] of the joints.
    """
    return np.asarray(np.asarray(torque) - robot.armature * np.asarray(acceleration))


def motor_use(robot: Robot, torque: ArrayLike, velocity: ArrayLike) -> Array:
    """(..., n) |torque| / stall torque + |speed| / no-load speed; 1: at the motor's limit, nan: not known.

    Friction is taken to oppose the motor always, which is conservative when the motor brakes.
    """
    stall, idle = (numbers_of(robot.actuators, name) for name in ("stall_torque", "no_load_speed"))
    return np.asarray(_motor_torque(robot, torque, velocity) / stall + np.abs(velocity) / idle)


def motor_power(robot: Robot, torque: ArrayLike, velocity: ArrayLike) -> Array:
    """(..., n) [W] magnitude of the motors' mechanical power, with friction as in `motor_use`."""
    return np.asarray(_motor_torque(robot, torque, velocity) * np.abs(velocity))


def _motor_torque(robot: Robot, torque: ArrayLike, velocity: ArrayLike) -> Array:
    """(..., n) [N m] magnitude of the motors' torque: the servo's and friction's."""
    viscous, coulomb = (
        numbers_of(robot.actuators, name) for name in ("viscous_friction", "coulomb_friction")
    )
    return np.asarray(np.abs(torque) + coulomb + viscous * np.abs(velocity))


@dataclass(frozen=True, kw_only=True, eq=False)
class DriveLoads:
    """Peak loads of gears and motors in a motion, by joint; nan for a joint without data or without a drive.

    joints : their names.  gear_limit (n,) : `Robot.gear_limit`.
    gear (n,) : torque through the gear over the torque limit.  motor (n,) : as of `motor_use`.  power (n,)
    [W].  velocity_jump (n,) [rad/s] : change of the velocity by the contact, in magnitude.
    """

    joints: tuple[str, ...]
    gear_limit: Array
    gear: Array
    motor: Array
    power: Array
    velocity_jump: Array

    @classmethod
    def of(
        cls, robot: Robot, *, gear: ArrayLike, torque: ArrayLike, velocity: ArrayLike, jump: ArrayLike
    ) -> DriveLoads:
        """Peak loads of histories: torque through the gears [N m], torque of the servos [N m] and velocity
        [rad/s], each (k, n); jump of the velocity (n,) [rad/s].
        """
        driven = np.where(robot.passive, np.nan, 1.0)
        return cls(
            joints=robot.joint_names,
            gear_limit=robot.gear_limit,
            gear=driven * _peak(np.asarray(gear) / robot.torque_limit, robot.n),
            motor=_peak(motor_use(robot, torque, velocity), robot.n),
            power=driven * _peak(motor_power(robot, torque, velocity), robot.n),
            velocity_jump=driven * np.abs(np.asarray(jump, dtype=np.float64)),
        )

    def summary(self) -> dict[str, Any]:
        """Largest loads and their joints, keys as in ``summary.json``; None without data."""
        out: dict[str, Any] = {}
        for values, key, name in (
            (self.gear, "gear_ratio", "gear_joint"),
            (self.motor, "motor_ratio", "motor_joint"),
            (self.power, "power_W", "power_joint"),
            (self.velocity_jump, "velocity_jump_rad_s", "velocity_jump_joint"),
        ):
            known = np.flatnonzero(np.isfinite(values))
            worst = int(known[np.argmax(values[known])]) if known.size else -1
            out[key] = float(values[worst]) if known.size else None
            out[name] = self.joints[worst] if known.size else None
        return out

    def beyond_peak(self) -> str:
        """Message about gears beyond their momentary peak; "" if there is none."""
        limit, names = self.gear_limit, self.joints
        beyond = np.flatnonzero(self.gear > limit * (1 + 1e-3))
        worst_first = sorted(beyond, key=lambda k: -self.gear[k] / limit[k])
        if not worst_first:
            return ""
        k = int(worst_first[0])
        others = f", and {len(beyond) - 1} more" if len(beyond) > 1 else ""
        return (
            f"gear of {names[k]}: {self.gear[k]:.3g} times its torque limit, above its momentary peak of "
            f"{limit[k]:.3g}{others}; bound it with [terms.gear_load]"
        )


def _peak(values: Array, n: int) -> Array:
    """(n,) largest magnitudes of a history (k, n); nan if it is empty."""
    return np.abs(values).max(axis=0) if len(values) else np.full(n, np.nan)


MIN_LOAD_FRACTION = 0.02  # a sole with a smaller fraction of the weight counts as unloaded
ROUNDING = 0.01  # [mm, N]
# Constraints hold at nodes. Between them a margin may fall to this share of its bound, or by so much [m].
SHARE, FREE = 0.5, 1e-3


def weight_of(robot: Robot) -> float:
    """Weight [N]."""
    mass = float(sum(inertia.mass for inertia in robot.model.inertias))
    return mass * float(np.linalg.norm(robot.model.gravity.linear))


def cop_margin(robot: Robot, corners: Sequence[Array], wrench: Array) -> Array:
    """Distance (k, soles) [m] of each sole's centre of pressure from the nearest of its own edges.

    corners : (c, 2) [m] of each sole in its own frame, counter-clockwise.
    wrench (k, soles, 6) : of the ground on each, in its own frame [N, N m].

    Positive inside; 0 on an edge, about which the sole tips; negative outside, which only a replay with fixed
    soles can have. Without a normal force the centre of pressure is not defined. So for a force below 2 % of
    the weight, the rest to 2 % is taken to act at the polygon's centre: an unloaded sole has the margin of
    its centre, and a moment without force still shows. A pulling force shows in the normal force alone.
    """
    out = np.empty(wrench.shape[:2])
    for k, polygon in enumerate(corners):
        # centre of pressure times force: (-m_y, m_x)
        force, moment = wrench[:, k, 2], np.stack([-wrench[:, k, 4], wrench[:, k, 3]], axis=1)
        lacking = np.maximum(MIN_LOAD_FRACTION * weight_of(robot) - force, 0.0)
        cop = (moment + lacking[:, None] * polygon.mean(axis=0)) / (force + lacking)[:, None]
        # distances (k, c) from the edges, along their inward normals
        edge = np.roll(polygon, -1, axis=0) - polygon
        inward = np.stack([-edge[:, 1], edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
        out[:, k] = (cop @ inward.T - (inward * polygon).sum(axis=1)).min(axis=1)
    return out


def margin_between_nodes(asked: float) -> float:
    """Least margin [m] between nodes if `asked` [m] is required at the nodes: half of it, or 1 mm less than
    it, whichever is smaller.
    """
    return asked - max(SHARE * asked, FREE)


def fading(standing: Mask) -> Mask:
    """Mask (phases, soles) of soles that stand in a phase, but not in the one before or after.

    standing (phases, soles) : mask of standing soles.
    """
    lifted = ~np.pad(standing, ((1, 1), (0, 0)), mode="edge")
    return np.asarray(standing & (lifted[:-2] | lifted[2:]))


def least_margins(
    names: Sequence[str],
    cop: Array,
    force: Array,
    phases: Mapping[str, Mask],
    standing: Mask | None = None,
    stance: Index | None = None,
) -> dict[str, dict[str, dict[str, float]]]:
    """Least margin [mm] and least normal force [N] of each sole in each phase, as in ``summary.json``.

    cop (k, soles) [m] : of :func:`cop_margin`.  force (k, soles) [N].  phases : mask of instants (k,) by the
    phase's name; a phase without instants is left out.  standing (stances, soles), stance (k,) : mask of
    standing soles, and index of the stance at each instant; None: all soles stand always. Forces of soles
    that lift off next, or have just touched down, are left out, as they go through zero.
    """
    stands = loaded = np.ones(force.shape, dtype=bool)
    if standing is not None and stance is not None:
        stands, loaded = standing[stance], (standing & ~fading(standing))[stance]

    def least(values: Array, chosen: Mask) -> dict[str, dict[str, float]]:
        return {
            name: {phase: float(column[at & own].min()) for phase, at in phases.items() if (at & own).any()}
            for name, column, own in zip(names, values.T, chosen.T, strict=True)
        }

    return {"sole_cop_margin_mm": least(1e3 * cop, stands), "sole_force_N": least(force, loaded)}


def shortfalls(numbers: Mapping[str, Any], only: str = "") -> list[str]:
    """Messages about margins below what is required between nodes, worst first.

    numbers : least margins (`least_margins`) and required ones, keys as in ``summary.json``.
    only : a phase; "": all.
    """
    asked, found = numbers.get("sole_cop_margin_asked_mm") or {}, []
    for name, phases in (numbers.get("sole_cop_margin_mm") or {}).items():
        for phase, kept in phases.items():
            if (
                phase in asked
                and only in ("", phase)
                and kept < (least := 1e3 * margin_between_nodes(1e-3 * asked[phase])) - ROUNDING
            ):
                what = f"centre of pressure of the sole {name!r}, {phase}"
                found.append((kept - least, f"{what}: {kept:.1f} mm kept of {asked[phase]:g} mm"))
    force = numbers.get("sole_force_asked_N") or 0.0
    for name, phases in (numbers.get("sole_force_N") or {}).items():
        for phase, kept in phases.items():
            if only in ("", phase) and kept < SHARE * force - ROUNDING:
                what = f"normal force on the sole {name!r}, {phase}"
                found.append((kept - SHARE * force, f"{what}: {kept:.0f} N kept of {force:g} N"))
    return [message for _, message in sorted(found)]
