"""Objectives of a plan: quantities whose weighted sum is maximized; the impulse by default.

`base` has the interface of an objective, `plain` those without blocks of their own, and each other file one
objective. A new one is a file here, and is listed below.
"""

from impactopt.problem.objectives.base import Objective, check_objectives
from impactopt.problem.objectives.effort import Effort
from impactopt.problem.objectives.peak_force import PeakForce
from impactopt.problem.objectives.plain import AngularMomentum, Impulse, Penetration
from impactopt.problem.objectives.target_energy import TargetEnergy

DEFAULT_OBJECTIVES: tuple[Objective, ...] = (Impulse(),)
# all objectives of problem files, in their order
OBJECTIVES: tuple[type[Objective], ...] = (
    Impulse,
    PeakForce,
    TargetEnergy,
    Penetration,
    AngularMomentum,
    Effort,
)

__all__ = [
    "DEFAULT_OBJECTIVES",
    "OBJECTIVES",
    "AngularMomentum",
    "Effort",
    "Impulse",
    "Objective",
    "PeakForce",
    "Penetration",
    "TargetEnergy",
    "check_objectives",
]
