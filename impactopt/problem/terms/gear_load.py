"""Limit on gear loads, above all in the impact."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from impactopt.contact.fields import about
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.problem.block import BlockExpression, BlockRecipe, joint_motion, make_block
from impactopt.problem.terms.base import Term, of_joints
from impactopt.problem.violation import percent
from impactopt.robots.robot import Robot


@dataclass(frozen=True, kw_only=True)
class GearLoad(Term):
    """|torque through the gear| is bounded: servo torque - armature x joint acceleration.

    The bound holds at the nodes of all motions, at the collocation points of all contacts, and in their first
    instant, at which the force of a damped contact jumps. If the limit is given by joint, other joints have
    no bound.

    The term holds with its defaults in every problem. Its constraints are added once a plan violates them, or
    from the start if the problem gives the term.
    """

    name: ClassVar[str] = "gear load"
    unit: ClassVar[str] = "of limit"
    needs_torques: ClassVar[bool] = True
    first_instant: ClassVar[bool] = True
    of_drives: ClassVar[bool] = True
    limit: float | Mapping[str, float] | None = field(
        default=None,
        metadata=about(
            "largest load over the torque limit, of all or by joint; left out: the gear's "
            "momentary peak, or 2",
            above=0,
            by_joint=True,
        ),
    )
    enabled: bool = field(default=True, metadata=about("false: gear loads are not bounded"))

    def blocks(self, problem: Any, coordinates: StanceCoordinates) -> dict[str, BlockRecipe]:
        return {"rotors": BlockRecipe(lambda: rotors(coordinates))}

    def most(self, robot: Robot) -> Any:
        """Largest loads (n,) over the torque limits; inf: no bound."""
        if self.limit is None:
            return robot.gear_limit
        return np.where(robot.passive, np.inf, of_joints(self.limit, robot.joint_names))

    def add_constraints(self, program: Any) -> None:
        robot, names = program.robot, program.robot.joint_names
        most = self.most(robot)
        points, first = program.drive_points(), program.first_instants()
        # of each place: torque over its limit (affine) + output of the block, -armature x acceleration over
        # it
        outputs = [output for _, output in first]
        if points:
            at = program.add_block("rotors", [p.slots for p in points], robot.armature / robot.torque_limit)
            outputs = [at + robot.n * k + np.arange(robot.n) for k in range(len(points))] + outputs
        torques = [*(p.torque for p in points), *(program.feedforward[0] for _ in first)]
        places = [*(p.place for p in points), *(place for place, _ in first)]
        for place, torque, output in zip(places, torques, outputs, strict=True):
            program.constraints.add(
                term=self.name,
                place=place,
                components=names,
                outputs=output,
                affine=torque,
                lower=-most,
                upper=most,
                measure=[percent("over its limit", of=limit) for limit in most],
            )


def rotors(c: StanceCoordinates) -> BlockExpression:
    """Torques that the rotors take.

    z of `joint_motion`;  p = armature over torque limit (n);  out = -p x acceleration (n).
    """
    motion, inertia = joint_motion(c), ca.SX.sym("inertia", c.robot.n)
    return make_block(motion.z, [inertia], {"rotors": -inertia * motion.acceleration}, motion.through)
