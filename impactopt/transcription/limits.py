"""The terms that hold in every problem, as numbers: bounds of variables, scales and units of constraints."""

from __future__ import annotations

from typing import Any

import numpy as np

from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import (
    Balance,
    ContactWrenchCone,
    Incidence,
    LegExtension,
    PositionLimit,
    TorqueLimit,
    VelocityLimit,
)
from impactopt.problem.terms.grip import WRENCH
from impactopt.robots.tools import inside
from impactopt.transcription.constraints import Measure

GRAVITY = 9.81
LEVER = 0.1  # [m] scale of sole moments against forces
BASE_BOX = np.array([0.6, 0.6, 0.6, 0.8, 0.8, 1.2])  # [m, rad] how far the base may go from its start
DIRECTIONS = ("x", "y", "z", "roll", "pitch", "yaw")


class Limits:
    """Read by all parts of a program.

    Attributes
    ----------
    torque, velocity, position, cone, balance, incidence, extension : the problem's terms.
    weight : of the robot [N].  units : of base rows, weight [N] and lever [m].  unbalanced : how their
        violation is reported.
    wrench_scale (6 a sole) : of sole wrenches [N, N m].
    y_lower, y_upper (ny,), legs_lower, legs_upper (nl,) : of the coordinates and the legs.
    rate_limit (n,) : of the joints [rad/s].
    of_y, of_legs, of_wrenches : what every group of coordinates, of legs and of sole wrenches has.
    """

    def __init__(self, problem: ImpactProblem, coordinates: StanceCoordinates) -> None:
        p, c, r = problem, coordinates, problem.robot
        self.torque, self.velocity = p.term(TorqueLimit), p.term(VelocityLimit)
        self.position, self.cone = p.term(PositionLimit), p.term(ContactWrenchCone)
        self.balance, self.incidence = p.term(Balance), p.term(Incidence)
        self.extension = p.term(LegExtension)
        self.weight = GRAVITY * float(sum(i.mass for i in r.model.inertias))
        lower, upper = inside(r, self.position.margin)
        box, y0 = BASE_BOX[: c.base], c.split(p.start_posture)[0]
        self.y_lower = np.concatenate([y0[: c.base] - box, lower[c.independent]])
        self.y_upper = np.concatenate([y0[: c.base] + box, upper[c.independent]])
        self.legs_lower, self.legs_upper = lower[c.dependent], upper[c.dependent]
        self.rate_limit = self.velocity.fraction * r.velocity_limit
        self.units = np.array([self.weight, LEVER])
        force, moment = Measure("N", self.weight, "off"), Measure("N m", self.weight * LEVER, "off")
        self.unbalanced = [force if name in "xyz" else moment for name in DIRECTIONS[: c.base]]
        self.wrench_scale = self.weight * np.array([1, 1, 1, LEVER, LEVER, LEVER] * len(c.legs))
        self.of_y: dict[str, Any] = {"lower": self.y_lower, "upper": self.y_upper, "labels": c.labels}
        self.of_legs: dict[str, Any] = {
            "lower": self.legs_lower,
            "upper": self.legs_upper,
            "labels": c.leg_labels,
        }
        wrench_labels = [f"{leg.end} {k}" for leg in c.legs for k in WRENCH]
        self.of_wrenches: dict[str, Any] = {"scale": self.wrench_scale, "labels": wrench_labels}
