"""Gains of servos and springs of soft grips times a factor, given or for a plan to choose; rotor inertias."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from impactopt.contact.fields import about
from impactopt.errors import InputError, check_array, check_number
from impactopt.robots.actuators import fitting
from impactopt.robots.robot import Robot
from impactopt.robots.tools import grip_limits

__all__ = ["HEAVIEST_ROTOR", "LIGHTEST_ROTOR", "USUAL_ROTOR", "GainFactor", "scaled_gains", "with_room"]

# [s2] armature (rotor inertia x gear ratio^2) over torque limit. Known robots have 2e-4 (G1: gears of
# 14 to 22) to 3e-3 (arms: 160). Motors without gears have some 1e-5 to 1e-4: 10 N m on 1e-3 kg m2. Large
# industrial arms have 2e-2: at 0.1 a drive takes a second to 10 rad/s by itself.
LIGHTEST_ROTOR, USUAL_ROTOR, HEAVIEST_ROTOR = 1e-6, 1e-3, 0.1


WEAKEST, STRONGEST = 1e-3, 1e3  # factors: beyond, gains are others and not these


@dataclass(frozen=True, kw_only=True)
class GainFactor:
    """A factor on the stiffness of some joints, which a plan chooses; their damping gets its root.

    So the damping ratio stays. At a servo's joint these are its gains, from start to rest; at that of a soft
    grip they are the spring's and the damper's.

    joints : names, or patterns such as ``arm_right_*``; a soft grip's joint is the tool's name with ``_grip``
        behind.  factor : (least, largest).

    Raises
    ------
    InputError : no joints; factors that are none, or leave no choice.
    """

    joints: tuple[str, ...] = field(metadata=about("names of joints, or patterns"))
    factor: tuple[float, float]

    def __post_init__(self) -> None:
        listed = isinstance(self.joints, (list, tuple))
        if not listed or not self.joints or not all(isinstance(name, str) for name in self.joints):
            raise InputError(f"GainFactor: joints are names or patterns, at least one, not {self.joints!r}")
        object.__setattr__(self, "joints", tuple(self.joints))
        least, largest = check_array("GainFactor: factor", self.factor, (2,)).tolist()
        if not WEAKEST <= least < largest <= STRONGEST:
            raise InputError(
                f"GainFactor: factor is (least, largest) with {WEAKEST:g} <= least < largest <= "
                f"{STRONGEST:g}, not ({least:g}, {largest:g}); for one number take scaled_gains"
            )
        object.__setattr__(self, "factor", (least, largest))

    def indices(self, robot: Robot) -> tuple[int, ...]:
        """Indices of its joints, in arrays of length n; InputError for a name that fits none."""
        found = {k for name in self.joints for k in fitting(name, robot.joint_names, "gains")}
        return tuple(sorted(found))


def scaled_gains(robot: Robot, factors: Mapping[str, float]) -> Robot:
    """A copy of the robot whose stiffness is some times its own, and whose damping the root of that times.

    factors : by names of joints, or patterns of them such as ``arm_right_*``; of several that fit a joint the
        last one holds. At the joint of a soft grip it is the grip that changes.

    Raises
    ------
    InputError : what fits no joint; a factor that is none; gains too fast for the inertia they act on.
    """
    each = np.ones(robot.n)
    for pattern, given in factors.items():
        factor = check_number(f"gains of {pattern!r}", given)
        if not WEAKEST <= factor <= STRONGEST:
            raise InputError(
                f"gains of {pattern!r}: the factor {factor:g}; give {WEAKEST:g} to {STRONGEST:g}"
            )
        each[list(fitting(pattern, robot.joint_names, "gains"))] = factor
    kp, kd, limit = robot.kp * each, robot.kd * np.sqrt(each), np.array(robot.torque_limit)
    grips = {}
    for tool in robot.tools:
        if tool.grip is not None and each[at := robot.joint_index(tool.grip_joint)] != 1.0:
            grip = replace(tool.grip, stiffness=float(kp[at]), damping=float(kd[at]))
            grips[tool.name], limit[at] = grip, grip_limits(grip)[0]
    return replace(robot, kp=kp, kd=kd, torque_limit=limit, **_held(robot, grips))


def with_room(robot: Robot, factors: Mapping[str, float]) -> Robot:
    """The same robot, with torque limits at the joints of soft grips as if they were stiffer by such factors,
    by names of joints: a spring's limit is what it has at the end of its range.
    """
    limit = np.maximum(robot.torque_limit, scaled_gains(robot, factors).torque_limit)
    return replace(robot, torque_limit=limit)


def _held(robot: Robot, grips: Mapping[str, Any]) -> dict[str, Any]:
    """Tools, and those of the source, of which some are held by other grips, by the tools' names."""

    def held(tools: tuple[Any, ...]) -> tuple[Any, ...]:
        return tuple(replace(t, grip=grips[t.name]) if t.name in grips else t for t in tools)

    source = robot.source and replace(robot.source, tools=held(robot.source.tools))
    return {"tools": held(robot.tools), "source": source}
