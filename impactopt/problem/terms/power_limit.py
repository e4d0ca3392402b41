"""Limits on motor power, driving and braking."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from impactopt.contact.fields import described
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.problem.block import BlockExpression, BlockRecipe, joint_motion, make_block
from impactopt.problem.terms.base import Term, of_joints
from impactopt.problem.violation import Measure
from impactopt.robots.actuators import numbers_of

# Signs of the servo's power and of the power of Coulomb friction: as neither |torque x speed| nor |speed| is
# smooth, each combination is a constraint.
SIGNS = tuple(product((1.0, -1.0), repeat=2))


@dataclass(frozen=True, kw_only=True)
class PowerLimit(Term):
    """The mechanical power of each motor is bounded, whether it drives or brakes.

    The bound holds at the nodes of all motions and at the collocation points of all contacts. Friction counts
    as if it always opposed the motor. If the limit is given by joint, other joints have no bound.
    """

    name: ClassVar[str] = "power limit"
    unit: ClassVar[str] = "of limit"
    needs_torques: ClassVar[bool] = True
    of_drives: ClassVar[bool] = True
    limit: float | Mapping[str, float] | None = described(
        None,
        "largest power, of all or by joint; left out: that of `[[robot.actuators]]`",
        unit="W",
        above=0,
        by_joint=True,
    )

    def blocks(self, problem: Any, coordinates: StanceCoordinates) -> dict[str, BlockRecipe]:
        return {"motor_power": BlockRecipe(lambda: motor_power(coordinates))}

    def add_constraints(self, program: Any) -> None:
        robot, n = program.robot, program.robot.n
        most = numbers_of(robot.actuators, "power_limit")
        if self.limit is not None:
            most = np.where(robot.passive, np.inf, of_joints(self.limit, robot.joint_names))
        viscous, coulomb = (
            numbers_of(robot.actuators, name) for name in ("viscous_friction", "coulomb_friction")
        )
        known, points = np.flatnonzero(np.isfinite(most)), program.drive_points()
        if not known.size or not points:
            return
        per_power = np.nan_to_num(1 / most, posinf=0.0)
        numbers = np.concatenate([robot.torque_limit, viscous, coulomb, per_power])
        at = program.add_block("motor_power", [[p.torque, *p.slots] for p in points], numbers)
        signs = SIGNS if coulomb.any() else SIGNS[::2]
        for (k, point), (j, (servo, friction)) in product(enumerate(points), enumerate(SIGNS)):
            if (servo, friction) not in signs:
                continue
            word = "giving" if servo > 0 else "taking"
            word += ("" if friction > 0 else ", backwards") if coulomb.any() else ""
            program.constraints.add(
                term=self.name,
                place=point.place,
                components=[f"{robot.joint_names[i]} {word}" for i in known],
                outputs=at + (len(SIGNS) * k + j) * n + known,
                upper=1.0,
                measure=[Measure("%", 100.0, "over its limit")] * len(known),
            )


def motor_power(c: StanceCoordinates) -> BlockExpression:
    """Mechanical power of each motor.

    z = servo torque over limit (n), z of `joint_motion`;  p = torque limits, viscous and Coulomb friction,
    1 over the power limit (n each);  out = power over limit, for each of `SIGNS` (n each).
    """
    n, motion = c.robot.n, joint_motion(c)
    torque = ca.SX.sym("torque", n)
    p = limit, viscous, coulomb, per_power = [ca.SX.sym(s, n) for s in ("limit", "viscous", "coulomb", "per")]
    v = motion.velocity
    out = {
        f"power{k}": (servo * limit * torque * v + friction * coulomb * v + viscous * v**2) * per_power
        for k, (servo, friction) in enumerate(SIGNS)
    }
    return make_block([torque, *motion.z], list(p), out, motion.through)
