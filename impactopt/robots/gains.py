"""Factors on servo gains and on springs of soft grips, given or optimized; plausible rotor inertias."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from numbers import Real

import numpy as np

from impactopt.contact.fields import about
from impactopt.errors import InputError, check_array, check_kind, check_number, named_table
from impactopt.robots.actuators import fitting
from impactopt.robots.robot import Robot
from impactopt.robots.tools import grip_limits, replaced_grips

# [s2] armature (rotor inertia x gear ratio^2) over torque limit. Known robots have 2e-4 (G1: gears of
# 14 to 22) to 3e-3 (arms: 160). Motors without gears have some 1e-5 to 1e-4: 10 N m on 1e-3 kg m2. Large
# industrial arms have 2e-2: at 0.1 a drive takes a second to 10 rad/s by itself.
LIGHTEST_ROTOR, USUAL_ROTOR, HEAVIEST_ROTOR = 1e-6, 1e-3, 0.1
MIN_FACTOR, MAX_FACTOR = 1e-3, 1e3  # on the stiffness


@dataclass(frozen=True, kw_only=True)
class GainFactor:
    """An optimized factor on the stiffness of some joints, whose root multiplies their damping.

    So the damping ratio is constant. For a driven joint these are the servo's gains, from start to rest; for
    the joint of a soft grip they are those of the spring and the damper.

    joints : names, or patterns such as ``arm_right_*``; the joint of a soft grip is ``<tool>_grip``.
    factor : (least, largest).

    Raises
    ------
    InputError : no joints; bounds that are no factors, or not least < largest.
    """

    joints: tuple[str, ...] = field(metadata=about("names of joints, or patterns"))
    factor: tuple[float, float]

    def __post_init__(self) -> None:
        listed = isinstance(self.joints, (list, tuple))
        if not listed or not self.joints or not all(isinstance(name, str) for name in self.joints):
            raise InputError(f"GainFactor: joints are names or patterns, at least one, not {self.joints!r}")
        object.__setattr__(self, "joints", tuple(self.joints))
        given = (self.factor, self.factor) if isinstance(self.factor, Real) else self.factor
        least, largest = check_array("GainFactor: factor", given, (2,)).tolist()
        if not MIN_FACTOR <= least < largest <= MAX_FACTOR:
            raise InputError(
                f"GainFactor: factor is (least, largest) with {MIN_FACTOR:g} <= least < largest <= "
                f"{MAX_FACTOR:g}, not ({least:g}, {largest:g}); for one number take scaled_gains"
            )
        object.__setattr__(self, "factor", (least, largest))

    def indices(self, robot: Robot) -> tuple[int, ...]:
        """Indices of its joints, in arrays of length n; InputError for a name that matches none."""
        found = {k for name in self.joints for k in fitting(name, robot.joint_names, "gains")}
        return tuple(sorted(found))


def scaled_gains(robot: Robot, factors: Mapping[str, float]) -> Robot:
    """A copy of the robot with stiffness multiplied by factors, and damping by their roots.

    factors : by names of joints, or patterns such as ``arm_right_*``; for a joint that several match, the
        last one holds. For the joint of a soft grip they change the grip.

    Raises
    ------
    InputError : a name that matches no joint; a factor out of range; gains too fast for the inertia that they
        act on.
    """
    check_kind("robot", robot, Robot)
    check_kind("factors", factors := named_table(factors), Mapping)
    each = np.ones(robot.n)
    for pattern, given in factors.items():
        factor = check_number(f"gains of {pattern!r}", given)
        if not MIN_FACTOR <= factor <= MAX_FACTOR:
            raise InputError(
                f"gains of {pattern!r}: the factor {factor:g}; give {MIN_FACTOR:g} to {MAX_FACTOR:g}"
            )
        each[fitting(pattern, robot.joint_names, "gains")] = factor
    kp, kd, limit = robot.kp * each, robot.kd * np.sqrt(each), np.array(robot.torque_limit)
    grips = {}
    for tool in robot.tools:
        if tool.grip is not None and each[at := robot.joint_index(tool.grip_joint)] != 1.0:
            grip = replace(tool.grip, stiffness=float(kp[at]), damping=float(kd[at]))
            grips[tool.name], limit[at] = grip, grip_limits(grip)[0]
    return replace(robot, kp=kp, kd=kd, torque_limit=limit, **replaced_grips(robot, grips))


def with_room(robot: Robot, factors: Mapping[str, float]) -> Robot:
    """The same robot, with larger torque limits at the joints of soft grips: those that grips stiffer by
    these factors, by joint, reach at the ends of their ranges.
    """
    limit = np.maximum(robot.torque_limit, scaled_gains(robot, factors).torque_limit)
    return replace(robot, torque_limit=limit)
