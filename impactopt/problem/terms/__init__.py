"""Terms: constraints of a plan with a name and a unit. A problem has at most one of each kind.

`base` has the interface of a term, `default_limits` the terms whose constraints the transcription adds, and
each other file one term, which adds its own. DEFAULT_TERMS hold in every problem. ON_DEMAND_TERMS hold in
every problem, too, but a program has their constraints only if the term is given, or once a plan has violated
it (`impactopt.planning.lazy_constraints`). All other terms hold only if they are given. A new term is a file
here, and is listed below.
"""

from impactopt.problem.terms.base import Term, check_known, kind_of
from impactopt.problem.terms.default_limits import (
    Balance,
    ContactWrenchCone,
    Incidence,
    KeepOut,
    LegExtension,
    PositionLimit,
    SelfCollision,
    TorqueLimit,
    VelocityLimit,
)
from impactopt.problem.terms.first_touch import FirstTouch
from impactopt.problem.terms.gaze import Gaze
from impactopt.problem.terms.gear_load import GearLoad
from impactopt.problem.terms.grip import Grip
from impactopt.problem.terms.ground_force import GroundForce
from impactopt.problem.terms.hand_orientation import HandOrientation
from impactopt.problem.terms.hit_cone import HitCone
from impactopt.problem.terms.hit_region import HitRegion
from impactopt.problem.terms.joint_acceleration import JointAcceleration
from impactopt.problem.terms.motor_curve import MotorCurve
from impactopt.problem.terms.power_limit import PowerLimit
from impactopt.problem.terms.reference_range import ReferenceRange
from impactopt.problem.terms.slide import Slide
from impactopt.problem.terms.target_speed import TargetSpeed
from impactopt.problem.terms.torque_rate import TorqueRate
from impactopt.problem.terms.velocity_jump import VelocityJump

DEFAULT_TERMS: tuple[Term, ...] = (
    TorqueLimit(),
    VelocityLimit(),
    PositionLimit(),
    ContactWrenchCone(),
    Balance(),
    Incidence(),
    LegExtension(),
    SelfCollision(),
    KeepOut(),
    GroundForce(),
    FirstTouch(),
)
ON_DEMAND_TERMS: tuple[Term, ...] = (GearLoad(), Slide(), ReferenceRange())
# all terms of problem files, in their order
TERMS: tuple[type[Term], ...] = (
    *map(type, DEFAULT_TERMS),
    TorqueRate,
    HandOrientation,
    Gaze,
    HitRegion,
    HitCone,
    JointAcceleration,
    GearLoad,
    MotorCurve,
    PowerLimit,
    VelocityJump,
    TargetSpeed,
    Slide,
    ReferenceRange,
    Grip,
)

__all__ = [
    "DEFAULT_TERMS",
    "ON_DEMAND_TERMS",
    "TERMS",
    "Balance",
    "ContactWrenchCone",
    "FirstTouch",
    "Gaze",
    "GearLoad",
    "Grip",
    "GroundForce",
    "HandOrientation",
    "HitCone",
    "HitRegion",
    "Incidence",
    "JointAcceleration",
    "KeepOut",
    "LegExtension",
    "MotorCurve",
    "PositionLimit",
    "PowerLimit",
    "ReferenceRange",
    "SelfCollision",
    "Slide",
    "TargetSpeed",
    "Term",
    "TorqueLimit",
    "TorqueRate",
    "VelocityJump",
    "VelocityLimit",
    "check_known",
    "kind_of",
]
