"""Loads of a motion: of gears and motors, and of each sole by itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from impactopt.robots.actuators import numbers_of
from impactopt.robots.robot import Robot

__all__ = [
    "BEARS",
    "SHARE",
    "DriveLoads",
    "cop_margin",
    "fading",
    "gear_torque",
    "least_kept",
    "least_margins",
    "motor_power",
    "motor_use",
    "shortfalls",
    "weight_of",
]

Array = NDArray[np.float64]


def gear_torque(robot: Robot, torque: ArrayLike, acceleration: ArrayLike) -> Array:
    """(..., n) [N m] through the gears: what the servo's torque leaves when it has moved the rotor.

    torque (..., n) [N m] of the servo; acceleration (..., n) [rad/s^2] of the joints.
    """
    return np.asarray(np.asarray(torque) - robot.armature * np.asarray(acceleration))


def motor_use(robot: Robot, torque: ArrayLike, velocity: ArrayLike) -> Array:
    """(..., n) |torque| / stall torque + |speed| / no-load speed; 1 is on the line, nan: not known.

    Friction counts as if it always opposed the motor, so this is on the safe side where the motor brakes.
    """
    stall, idle = (numbers_of(robot.actuators, name) for name in ("stall_torque", "no_load_speed"))
    return np.asarray(_efforts(robot, torque, velocity) / stall + np.abs(velocity) / idle)


def motor_power(robot: Robot, torque: ArrayLike, velocity: ArrayLike) -> Array:
    """(..., n) [W] largest mechanical power of the motors, driving or braking, friction as in `motor_use`."""
    return np.asarray(_efforts(robot, torque, velocity) * np.abs(velocity))


def _efforts(robot: Robot, torque: ArrayLike, velocity: ArrayLike) -> Array:
    """(..., n) [N m] of the motors: the servo's torque and what friction takes."""
    viscous, coulomb = (
        numbers_of(robot.actuators, name) for name in ("viscous_friction", "coulomb_friction")
    )
    return np.asarray(np.abs(torque) + coulomb + viscous * np.abs(velocity))


@dataclass(frozen=True, kw_only=True, eq=False)
class DriveLoads:
    """Peak loads of gears and motors in a motion, by joint; nan for a joint without data or without a drive.

    joints : their names.  gear_limit (n,) : `Robot.gear_limit`.
    gear (n,) : torque through the gear over the torque limit.  motor (n,) : as of `motor_use`.  power (n,)
    [W].  velocity_jump (n,) [rad/s] : how much faster or slower a joint is after the contact than before it.
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
        """Loads from histories: gear [N m] of torque through the gears, torque [N m] of the servos,
        velocity [rad/s], each (k, n); jump (n,) [rad/s].
        """
        driven = np.where(robot.passive, np.nan, 1.0)
        return cls(
            joints=robot.joint_names,
            gear_limit=robot.gear_limit,
            gear=driven * _most(np.asarray(gear) / robot.torque_limit, robot.n),
            motor=_most(motor_use(robot, torque, velocity), robot.n),
            power=driven * _most(motor_power(robot, torque, velocity), robot.n),
            velocity_jump=driven * np.abs(np.asarray(jump, dtype=np.float64)),
        )

    def summary(self) -> dict[str, Any]:
        """The worst joints, keys as in ``summary.json``; None where nothing is known."""
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
        """Message about gears that carry more than their momentary peak; "" if none does."""
        limit, names = self.gear_limit, self.joints
        worst = sorted(np.flatnonzero(self.gear > limit * (1 + 1e-3)), key=lambda k: -self.gear[k] / limit[k])
        if not worst:
            return ""
        k = int(worst[0])
        others = f", and {len(worst) - 1} more" if len(worst) > 1 else ""
        return (
            f"gear of {names[k]}: {self.gear[k]:.3g} times its torque limit, and {limit[k]:.3g} is its "
            f"momentary peak{others}; bound it with [terms.gear_load]"
        )


def _most(values: Array, n: int) -> Array:
    """(n,) largest magnitudes of (k, n); nan where there is none."""
    return np.abs(values).max(axis=0) if len(values) else np.full(n, np.nan)


BEARS = 0.02  # of the weight: a sole with less on it bears no load
ROUNDING = 0.01  # [mm, N]
SHARE, FREE = 0.5, 1e-3  # of a margin, and [m] of any: what may be given up between nodes


def weight_of(robot: Robot) -> float:
    """Weight [N]."""
    mass = float(sum(inertia.mass for inertia in robot.model.inertias))
    return mass * float(np.linalg.norm(robot.model.gravity.linear))


def cop_margin(robot: Robot, corners: Sequence[Array], wrench: Array) -> Array:
    """Distance (k, soles) [m] of each sole's centre of pressure from the nearest of its own edges.

    corners : (c, 2) [m] of each sole in its own frame, counter-clockwise.
    wrench (k, soles, 6) : of the ground on each, in its own frame [N, N m].

    Positive inside; 0 on an edge, about which the sole tips; negative outside, where only a sole that is held
    can have it. With next to no force the centre of pressure is a quotient of small numbers. So a sole that
    bears less than 2 % of the robot's weight counts as if what it lacks of that pressed at its middle: an
    unloaded sole has its middle's margin, and a moment with no force to bear it still counts. A sole that is
    pulled shows in its normal force alone.
    """
    out = np.empty(wrench.shape[:2])
    for k, polygon in enumerate(corners):
        force, moment = wrench[:, k, 2], np.stack([-wrench[:, k, 4], wrench[:, k, 3]], axis=1)
        lacking = np.maximum(BEARS * weight_of(robot) - force, 0.0)
        cop = (moment + lacking[:, None] * polygon.mean(axis=0)) / (force + lacking)[:, None]
        edge = np.roll(polygon, -1, axis=0) - polygon
        inward = np.stack([-edge[:, 1], edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
        out[:, k] = (cop @ inward.T - (inward * polygon).sum(axis=1)).min(axis=1)
    return out


def least_kept(asked: float) -> float:
    """Margin [m] that a plan has to keep between its nodes of one that it is asked for at them: half of it,
    or all but a millimetre.
    """
    return asked - max(SHARE * asked, FREE)


def fading(standing: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mask (phases, soles) of soles that stand, but not in the phase before or after; of what stands."""
    away = ~np.pad(standing, ((1, 1), (0, 0)), mode="edge")
    return np.asarray(standing & (away[:-2] | away[2:]))


def least_margins(
    names: Sequence[str],
    cop: Array,
    force: Array,
    phases: Mapping[str, NDArray[np.bool_]],
    standing: NDArray[np.bool_] | None = None,
    stance: NDArray[np.intp] | None = None,
) -> dict[str, dict[str, dict[str, float]]]:
    """Least margin [mm] and least normal force [N] of each sole in each phase, as in ``summary.json``.

    cop (k, soles) [m] : of :func:`cop_margin`.  force (k, soles) [N].  phases : by name, which instants (k,)
    are in it; one without any is left out.  standing (stances, soles), stance (k,) : which soles stand, and
    when; None: all of them, always. Forces are of soles that are not about to lift, or just down.
    """
    on = bears = np.ones(force.shape, dtype=bool)
    if standing is not None and stance is not None:
        on, bears = standing[stance], (standing & ~fading(standing))[stance]

    def least(values: Array, chosen: NDArray[np.bool_]) -> dict[str, dict[str, float]]:
        return {
            name: {phase: float(column[at & own].min()) for phase, at in phases.items() if (at & own).any()}
            for name, column, own in zip(names, values.T, chosen.T, strict=True)
        }

    return {"sole_cop_margin_mm": least(1e3 * cop, on), "sole_force_N": least(force, bears)}


def shortfalls(numbers: Mapping[str, Any]) -> list[str]:
    """The margins of which less than half is kept, in words, worst first.

    numbers : of `least_margins`, beside what is asked, as in ``summary.json``.
    """
    asked, found = numbers.get("sole_cop_margin_asked_mm") or {}, []
    for name, phases in (numbers.get("sole_cop_margin_mm") or {}).items():
        for phase, kept in phases.items():
            if phase in asked and kept < (least := 1e3 * least_kept(1e-3 * asked[phase])) - ROUNDING:
                what = f"centre of pressure of the sole {name!r}, {phase}"
                found.append((kept - least, f"{what}: {kept:.1f} mm kept of {asked[phase]:g} mm"))
    force = numbers.get("sole_force_asked_N") or 0.0
    for name, phases in (numbers.get("sole_force_N") or {}).items():
        for phase, kept in phases.items():
            if kept < SHARE * force - ROUNDING:
                what = f"normal force on the sole {name!r}, {phase}"
                found.append((kept - SHARE * force, f"{what}: {kept:.0f} N kept of {force:g} N"))
    return [words for _, words in sorted(found)]
