"""Targets and contact laws of drafted strikes with an arm: a free mass, a board, a nail."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from impactopt.arrays import Array
from impactopt.contact.fields import snake_case
from impactopt.contact.laws import ContactLaw, KelvinVoigt, SpringDamper
from impactopt.contact.targets import Board, FreeMass, Nail, Target
from impactopt.files.problem_file.writing import law_data, target_data
from impactopt.problem.objectives import Objective, PeakForce, TargetEnergy
from impactopt.problem.strength import DOWN, NORMALS
from impactopt.robots.robot import Robot

MASS_RATIO = 0.06  # of a punched target to the robot
MASSES = (0.5, 5.0)  # [kg] least and largest mass of a punched target
PAPER_DAMPING = 300.0  # [N s/m] of the contact with the largest one
FORCE_PER_MASS = 30.0  # [N/kg] of the robot: breaking force of a board, resistance of a nail
MIN_FORCE, MAX_FORCE = 5.0, 600.0  # [N]
FRACTIONS = (1.0, 0.5, 0.25)  # of that force, tried in this order


@dataclass(frozen=True, kw_only=True, eq=False)
class Hit:
    """A target with its contact law, and the normals (3,) along which it may be hit.

    objectives, duration : objectives, and bounds [s] of the contact's duration; () and None: the defaults.
    """

    law: ContactLaw
    target: Target
    normals: Sequence[Array]
    objectives: tuple[Objective, ...] = ()
    duration: tuple[float, float] | None = None

    @property
    def given(self) -> dict[str, Any]:
        """Arguments of `ImpactProblem`."""
        more: dict[str, Any] = {} if self.duration is None else {"contact_duration": self.duration}
        more |= {"objectives": self.objectives} if self.objectives else {}
        return {"law": self.law, "target": self.target, **more}

    @property
    def data(self) -> dict[str, Any]:
        """The same as sections of a problem file."""
        out: dict[str, Any] = {"target": target_data(self.target), "contact": law_data(self.law)}
        if self.duration is not None:
            out["collision"] = {"duration_s": [*self.duration]}
        if self.objectives:
            out["objectives"] = {snake_case(type(one).__name__): {} for one in self.objectives}
        return out


def hits(motion: str | None, robot: Robot) -> list[Hit]:
    """Targets of a motion, "chop", "nail", or else a punch, the hardest first."""
    mass = sum(float(body.mass) for body in robot.model.inertias)
    largest = np.clip(FORCE_PER_MASS * mass, MIN_FORCE, MAX_FORCE)
    forces = [float(f"{fraction * largest:.2g}") for fraction in FRACTIONS]
    if motion == "chop":
        return [
            Hit(
                law=KelvinVoigt(stiffness=5e4, damping=50.0),
                target=Board(mass=0.1, stiffness=5e4, breaking_force=force, damping=20.0),
                normals=(DOWN,),
                objectives=(PeakForce(),),
                duration=(0.001, 0.03),
            )
            for force in forces
        ]
    if motion == "nail":
        return [
            Hit(
                law=KelvinVoigt(stiffness=5e5, damping=100.0),
                target=Nail(mass=0.05, resistance=force, hardening=1e4),
                normals=(DOWN,),
                objectives=(TargetEnergy(),),
                duration=(0.0, 0.015),
            )
            for force in forces
        ]
    target = FreeMass(mass=float(f"{np.clip(MASS_RATIO * mass, *MASSES):.1g}"))
    # The paper's contact has 300 N s/m and a target of 5 kg. With as much damping the first force on a small
    # robot is many times its weight, so lighter targets get the same damping ratio.
    damping = float(f"{PAPER_DAMPING * np.sqrt(target.mass / MASSES[1]):.2g}")
    return [Hit(law=SpringDamper(stiffness=1e4, damping=damping), target=target, normals=NORMALS)]
