"""Default terms: limits of joints, soles and their load, the impact and bodies.

The transcription adds their constraints; `GroundForce` adds its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from impactopt.contact.fields import described
from impactopt.errors import InputError
from impactopt.problem.terms.base import Term
from impactopt.problem.violation import Measure, degrees
from impactopt.robots.loads import fading, weight_of
from impactopt.robots.robot import Robot
from impactopt.robots.tools import inside


@dataclass(frozen=True, kw_only=True)
class TorqueLimit(Term):
    """|torque| is at most a fraction of each joint's limit; the servo has the rest for its feedback."""

    name: ClassVar[str] = "torque limit"
    unit: ClassVar[str] = "of limit"
    fraction: float = described(0.85, "share of the limit in swing and follow-through", above=0, most=1)
    collision: float = described(0.85, "share of the limit in contact", above=0, most=1)


@dataclass(frozen=True, kw_only=True)
class VelocityLimit(Term):
    """|joint velocity| is at most a fraction of each joint's limit.

    The bounds are on the spline's velocity control points, so they hold everywhere; those of the legs are at
    the nodes.
    """

    name: ClassVar[str] = "velocity limit"
    unit: ClassVar[str] = "of limit"
    fraction: float = described(0.95, "share of the limit", above=0, most=1)

    def most(self, robot: Robot) -> Any:
        """Largest magnitude (n,) of each joint's velocity [rad/s] or [m/s]."""
        return self.fraction * robot.velocity_limit


@dataclass(frozen=True, kw_only=True)
class PositionLimit(Term):
    """Joints stay inside their limits of position.

    The bounds are on the spline's control points, so they hold everywhere; those of legs and tendons are at
    the nodes. The margin of tendons and of hinges of soles, whose range may be small, is at most a quarter of
    it.
    """

    name: ClassVar[str] = "position limit"
    unit: ClassVar[str] = "rad"
    margin: float = described(0.02, "distance from each limit", unit="rad", least=0)

    def add_constraints(self, program: Any) -> None:
        """Add the constraints of the tendons; joints have bounds of variables."""
        c, own = program.coordinates, program.robot.ranges
        lower, upper = (limit[program.robot.n :] for limit in inside(program.robot, self.margin))
        if not lower.size:
            return
        # tendon lengths are of_y @ y + (matrix of the legs) @ legs
        of_y = np.pad(own.matrix[:, c.independent], ((0, 0), (c.base, 0)))
        for place, (y, legs) in program.body_spots:
            program.constraints.add(
                term=self.name,
                place=place,
                components=own.names[program.robot.n :],
                affine=y.apply(of_y) + legs.apply(own.matrix[:, c.dependent]),
                lower=lower,
                upper=upper,
                measure=degrees("outside"),
            )


@dataclass(frozen=True, kw_only=True)
class ContactWrenchCone(Term):
    """Each sole's wrench lies in the cone of its corners: centre of pressure, friction and torsion.

    Source: Caron et al. 2015, see :mod:`impactopt.kinematics.stance`. The cone bounds friction, centre
    of pressure and yaw torsion of each sole together: where friction or pressure use it up, less torsion is
    left. So there are no terms for one of them alone.
    """

    name: ClassVar[str] = "contact wrench cone"
    unit: ClassVar[str] = "of weight"
    friction: float = described(
        0.6, "friction coefficient that the plan may use along each axis of the sole", above=0
    )
    margin: float = described(
        0.02, "least distance from the centre of pressure to the sole's edges", unit="m", least=0
    )
    collision_margin: float | None = described(
        0.02, 'the same in contact; "anywhere": no constraint', unit="m", least=0, none="anywhere"
    )
    minimum_force: float = described(50.0, "least normal force of each sole", unit="N", least=0)


@dataclass(frozen=True, kw_only=True)
class Balance(Term):
    """Bounds on the state after the impact, so that the robot does not fall; inf: no bound."""

    name: ClassVar[str] = "balance after impact"
    unit: ClassVar[str] = "m, m/s, N m s"
    capture_margin: float | None = described(
        0.02,
        'margin of the capture point in the support polygon; "anywhere": no constraint',
        unit="m",
        least=0,
        none="anywhere",
    )
    vertical_speed: float = described(
        0.2, "largest vertical speed of the centre of mass", unit="m/s", least=0, endless=True
    )
    angular_momentum: float = described(
        10.0, "largest angular momentum about each axis; inf: any", unit="N m s", least=0, endless=True
    )

    def __post_init__(self) -> None:
        if isinstance(self.capture_margin, float) and self.capture_margin == np.inf:
            raise InputError("Balance.capture_margin is inf, which nothing can keep; give None for anywhere")
        super().__post_init__()


@dataclass(frozen=True, kw_only=True)
class Incidence(Term):
    """The striking point's speed across the normal at contact is bounded, so that it does not glance off.

    :class:`impactopt.HitCone` replaces it.
    """

    name: ClassVar[str] = "incidence"
    unit: ClassVar[str] = "m/s"
    speed: float = described(
        0.05, "largest speed along each of two tangents; inf: any", unit="m/s", least=0, endless=True
    )


@dataclass(frozen=True, kw_only=True)
class LegExtension(Term):
    """The knees of standing legs stay bent.

    At the nodes of swing and follow-through, the determinant of the leg's Jacobian (from joints to sole) over
    its value in the start posture has a lower bound. Near a straight knee the joint rates that keep the sole
    in place grow without bound, and the leg could become too short between two nodes: at 0.35 TALOS has 7 mm
    left.
    """

    name: ClassVar[str] = "leg extension"
    unit: ClassVar[str] = "of start"
    minimum: float = described(
        0.35, "least determinant of the leg's Jacobian over that at the start", least=0, most=1
    )


@dataclass(frozen=True, kw_only=True)
class SelfCollision(Term):
    """Links of the robot have clearance, except where a joint connects them or they touch at the start
    (neighbours: start within 2 mm).

    It is required from start to rest, after a miss too. Of links that start nearer than four times the
    margin it is a quarter of their distance there.
    """

    name: ClassVar[str] = "self-collision"
    unit: ClassVar[str] = "m"
    margin: float = described(0.01, "least distance between two links", unit="m", least=0)
    enabled: bool = described(True, "false: links may pass through each other")


@dataclass(frozen=True, kw_only=True)
class KeepOut(Term):
    """The robot has clearance from target, ground and obstacles; the striking link may touch the target's
    face.

    Fixed soles stand on the ground.
    """

    name: ClassVar[str] = "keep out"
    unit: ClassVar[str] = "m"
    margin: float = described(0.01, "least distance from a link to any of them", unit="m", least=0)
    enabled: bool = described(True, "false: the robot may pass through them")


@dataclass(frozen=True, kw_only=True)
class GroundForce(Term):
    """The normal forces of the soles, of each and in all, are bounded, so that they stay loaded and the robot
    does not land hard.

    The bounds hold at the nodes of the motion, and during contact with all targets. The contact wrench cone
    does not contain them, as it has no scale: near free fall a wrench within it may be too small for a sole
    to stay in place on a soft floor.
    """

    name: ClassVar[str] = "ground force"
    unit: ClassVar[str] = "of weight"
    least: float = described(0.5, "least normal force of all soles over the weight", least=0, most=0.9)
    most: float = described(1.7, "largest normal force of all soles over the weight", least=1.1)
    sole: float = described(0.2, "least normal force of each sole over the weight", least=0, most=0.45)

    enabled: bool = described(True, "false: soles may be unloaded, and land hard")

    def add_constraints(self, program: Any) -> None:
        legs, weight = program.coordinates.legs, weight_of(program.problem.robot)
        soles = [k for k, leg in enumerate(legs) if leg.sole is not None]
        if not soles or not weight:
            return
        p = program.problem
        # soles that touch down or lift off at an end of the phase are unloaded there
        fades = {s.name for s, on in zip(p.soles, fading(p.standing)[p.blow], strict=True) if on}
        each = [k for k in soles if len(soles) > 1 and legs[k].name not in fades]
        sets = [("all soles", soles), *((legs[k].end, [k]) for k in each)]
        # sums of normal forces over the weight, one row for each set of soles
        normal = np.zeros((len(sets), 6 * len(legs)))
        for row, (_, indices) in zip(normal, sets, strict=True):
            row[6 * np.array(indices) + 2] = 1 / weight
        alone = len(sets) - 1
        for place, wrench in program.wrenches():
            program.constraints.add(
                term=self.name,
                place=place,
                components=[name for name, _ in sets],
                affine=wrench.apply(normal),
                lower=[self.least, *[self.sole] * alone],
                upper=[self.most, *[np.inf] * alone],
                measure=Measure("% of the weight", 100.0, "out of range"),
            )
