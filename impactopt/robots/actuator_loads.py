"""Gear and motor loads of a motion: torque through the gear, use of the motor's line, power, jumps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from impactopt.robots.actuators import numbers_of
from impactopt.robots.robot import Robot

__all__ = ["DriveLoads", "gear_torque", "motor_power", "motor_use"]

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
