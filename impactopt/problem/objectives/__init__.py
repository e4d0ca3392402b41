"""Objectives of a plan: quantities whose weighted sum is maximized; the impulse by default.

`base` has the interface of an objective, `plain` those without blocks of their own, and each other file one
objective. A new one is a file here, and is listed below.
"""

# X as X: a name that is exported, for type checkers, too
from impactopt.problem.objectives.base import Objective as Objective
from impactopt.problem.objectives.effort import Effort as Effort
from impactopt.problem.objectives.peak_force import PeakForce as PeakForce
from impactopt.problem.objectives.plain import AngularMomentum as AngularMomentum
from impactopt.problem.objectives.plain import Impulse as Impulse
from impactopt.problem.objectives.plain import Penetration as Penetration
from impactopt.problem.objectives.target_energy import TargetEnergy as TargetEnergy

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
