"""Lazy terms, whose constraints are added on demand: gear load, slide, range of the reference.

They hold with their defaults in every problem. A program has their constraints once a plan violates them, or
from the start if the problem gives the term (`impactopt.planning.lazy_constraints`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from impactopt.contact.fields import described
from impactopt.kinematics.coordinates import StanceCoordinates, striker_kinematics
from impactopt.kinematics.operational_space import across
from impactopt.problem.block import BlockExpression, BlockRecipe, joint_motion, make_block
from impactopt.problem.terms.base import Term, bound_at_each, of_joints
from impactopt.problem.violation import Measure, millimetres, percent
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
    limit: float | Mapping[str, float] | None = described(
        None,
        "largest load over the torque limit, of all or by joint; left out: the gear's momentary peak, or 2",
        above=0,
        by_joint=True,
    )
    enabled: bool = described(True, "false: gear loads are not bounded")

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


@dataclass(frozen=True, kw_only=True)
class Slide(Term):
    """The striking point is near the hit point until contact ends.

    Its offset along each of two tangents is bounded at the collocation points of the collision with the
    expected target (`slide_mm` in `summary.json`: the largest). With little friction or none, a long push at
    an angle may slide off the target, whose face ends 0.2 m from the hit point in replays, or from a
    `HitRegion`. The hit point is where the striking point meets the target, anywhere in a `HitRegion`; it
    stays there also on a target that friction moves across the normal.

    The term holds with its defaults in every problem. Its constraints are added once a plan violates them, or
    from the start if the problem gives the term, also in strikes.
    """

    name: ClassVar[str] = "slide"
    unit: ClassVar[str] = "m"
    most: float = described(0.1, "largest offset along each tangent", unit="m", above=0)
    enabled: bool = described(True, "false: the offset is not bounded")

    def blocks(self, problem: Any, coordinates: StanceCoordinates) -> dict[str, BlockRecipe]:
        return {"slide": BlockRecipe(lambda: slide(coordinates, problem.striker))}

    def add_constraints(self, program: Any) -> None:
        # none in an impact without duration: nothing slides
        points, tangents = program.positions_in_contact(), across(program.problem.normal)
        bounds: dict[str, Any] = {"lower": -self.most, "upper": self.most, "measure": millimetres("too far")}
        names = ["tangent 1", "tangent 2"]
        bound_at_each(program, self, "slide", points, names, tangents.ravel(), **bounds)


def slide(c: StanceCoordinates, striker: str) -> BlockExpression:
    """Slide of the striking point across the target since contact.

    z = of `ContactProgram.positions_in_contact`;  p = tangents (6, one after the other);  out = slide along
    each [m].
    """
    y, d1, d = (ca.SX.sym(name, c.ny) for name in ("y", "d1", "d"))
    T1, T = ca.SX.sym("T1"), ca.SX.sym("T")
    after, tangents, zero = y + T1 * d1 + T * d, ca.SX.sym("tangents", 6), ca.SX.zeros(c.ny)
    at = striker_kinematics(c, striker)
    begin, end = (at(*c.upper_motion(each, zero, zero)[:2], ca.SX.zeros(c.rb.nv))[0] for each in (y, after))
    moved = ca.mtimes(ca.reshape(tangents, 3, 2).T, end - begin)
    return make_block([y, d1, T1, d, T], [tangents], {"moved": moved}, lanes=1)


@dataclass(frozen=True, kw_only=True)
class ReferenceRange(Term):
    """The servo's reference stays inside the joints' position limits until contact ends.

    During contact the reference coasts at the rates at contact, while the target brakes the robot. So in a
    long contact it moves farther than the joints, and a robot's controller would clip it. Joints without a
    motor, hinges of soles and soft grips, have no reference.

    The term holds with its defaults in every problem. Its constraints are added once a plan violates them, or
    from the start if the problem gives the term, also in strikes.
    """

    name: ClassVar[str] = "reference range"
    unit: ClassVar[str] = "rad"
    margin: float = described(0.0, "distance from each limit as contact ends", unit="rad", least=0)
    enabled: bool = described(True, "false: the reference is not bounded")

    def limits(self, robot: Any) -> tuple[Any, Any]:
        """Least and largest angles (n,) of the reference [rad], infinite for joints without a motor."""
        margin = np.where(robot.passive, -np.inf, self.margin)
        return robot.lower + margin, robot.upper - margin

    def blocks(self, problem: Any, coordinates: StanceCoordinates) -> dict[str, BlockRecipe]:
        phases = len(problem.contact_phases)
        return {"coasted": BlockRecipe(lambda: coasted(coordinates, phases), key=(phases,))}

    def add_constraints(self, program: Any) -> None:
        if not program.problem.lasts:
            return
        c, hit = program.coordinates, program.expected
        lower, upper = self.limits(program.robot)
        z = [program.contact_state[0], program.u0[0], *(duration[0] for duration in hit.T)]
        at = program.add_block("coasted", [z], np.zeros(0))
        bounds = {
            "term": self.name,
            "place": "end of contact",
            "measure": Measure("rad", 1.0, "too far"),
        }
        program.constraints.add(
            components=c.labels[c.base :],
            outputs=at + np.arange(c.ny - c.base),
            lower=lower[c.independent],
            upper=upper[c.independent],
            **bounds,
        )
        if c.legs:  # their angles at the end of contact are variables already
            program.constraints.add(
                components=c.leg_labels,
                affine=hit.coast_legs[hit.coast_legs.count - 1],
                lower=lower[c.dependent],
                upper=upper[c.dependent],
                **bounds,
            )


def coasted(c: StanceCoordinates, phases: int) -> BlockExpression:
    """Reference at the end of contact.

    z = y, ydot at contact, duration [s] of each phase of the contact;  out = joints at its end [rad].
    """
    y, rate, times = ca.SX.sym("y", c.ny), ca.SX.sym("rate", c.ny), ca.SX.sym("T", phases)
    return make_block([y, rate, times], [], {"joints": (y + rate * ca.sum1(times))[c.base :]}, lanes=1)
