"""Torque limit of a motor at its speed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from impactopt.contact.fields import described
from impactopt.errors import InputError
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.problem.block import BlockExpression, BlockRecipe, joint_motion, make_block
from impactopt.problem.terms.base import Term
from impactopt.problem.violation import percent
from impactopt.robots.actuators import numbers_of


@dataclass(frozen=True, kw_only=True)
class MotorCurve(Term):
    """|torque| / stall torque + |speed| / no-load speed is at most a fraction, for motors with known curves.

    The bound holds at the nodes of all motions and at the collocation points of all contacts. Friction adds
    to the torque as if it always opposed the motor, which is conservative if the motor brakes.
    """

    name: ClassVar[str] = "motor curve"
    unit: ClassVar[str] = "of the line"
    needs_torques: ClassVar[bool] = True
    of_drives: ClassVar[bool] = True
    fraction: float = described(1.0, "share of the line", above=0, most=1)

    def blocks(self, problem: Any, coordinates: StanceCoordinates) -> dict[str, BlockRecipe]:
        return {"motor_speed": BlockRecipe(lambda: motor_speed(coordinates))}

    def add_constraints(self, program: Any) -> None:
        robot = program.robot
        stall, idle, viscous, coulomb = (
            numbers_of(robot.actuators, name)
            for name in ("stall_torque", "no_load_speed", "viscous_friction", "coulomb_friction")
        )
        known, points = np.flatnonzero(np.isfinite(stall)), program.drive_points()
        if not known.size or not points:
            return
        for joint, have, lost in zip(robot.joint_names, self.fraction * stall, coulomb, strict=True):
            if lost >= have:
                raise InputError(
                    f"MotorCurve.fraction: {self.fraction:g} of the stall torque of {joint} is {have:g} N m, "
                    f"which its friction, {lost:g} N m, takes; give a larger fraction, or less of it"
                )
        per_speed = np.nan_to_num(1 / idle + viscous / stall)
        at = program.add_block("motor_speed", [p.slots for p in points], per_speed)
        most = (self.fraction - coulomb / stall)[known]
        labels = [robot.joint_names[k] for k in known]
        for k, point in enumerate(points):
            torque = (point.torque * (robot.torque_limit / np.where(np.isfinite(stall), stall, 1.0)))[known]
            for j, (word, sign) in enumerate((("driving", 1.0), ("braking", -1.0))):
                program.constraints.add(
                    term=self.name,
                    place=point.place,
                    components=[f"{label} {word}" for label in labels],
                    outputs=at + robot.n * (2 * k + j) + known,
                    affine=torque * sign,
                    lower=-most,
                    upper=most,
                    measure=percent("over its line", of=self.fraction),
                )


def motor_speed(c: StanceCoordinates) -> BlockExpression:
    """Part of the motor curve that each joint's speed takes.

    z of `joint_motion`;  p = part for each unit of speed [s/rad] (n);  out = p x speed (n), twice, as each
    constraint has its own output.
    """
    motion, per_speed = joint_motion(c), ca.SX.sym("per_speed", c.robot.n)
    speed = per_speed * motion.velocity
    return make_block(motion.z, [per_speed], {"driving": speed, "braking": speed}, motion.through)
