"""Terms: constraints of a plan with a name and a unit. A problem has at most one of each kind.

`base` has the interface of a term, and each other file one term, but for `default_limits` and `lazy_terms`.
DEFAULT_TERMS hold in every problem. ON_DEMAND_TERMS hold in every problem, too, but a program has their
constraints only if the term is given, or once a plan has violated it. All other terms hold only if they are
given. A new term is a file here, and is listed below.
"""

# X as X: a name that is exported, for type checkers, too
from impactopt.problem.terms.base import Term as Term
from impactopt.problem.terms.default_limits import Balance as Balance
from impactopt.problem.terms.default_limits import ContactWrenchCone as ContactWrenchCone
from impactopt.problem.terms.default_limits import GroundForce as GroundForce
from impactopt.problem.terms.default_limits import Incidence as Incidence
from impactopt.problem.terms.default_limits import KeepOut as KeepOut
from impactopt.problem.terms.default_limits import LegExtension as LegExtension
from impactopt.problem.terms.default_limits import PositionLimit as PositionLimit
from impactopt.problem.terms.default_limits import SelfCollision as SelfCollision
from impactopt.problem.terms.default_limits import TorqueLimit as TorqueLimit
from impactopt.problem.terms.default_limits import VelocityLimit as VelocityLimit
from impactopt.problem.terms.first_touch import FirstTouch as FirstTouch
from impactopt.problem.terms.gaze import Gaze as Gaze
from impactopt.problem.terms.grip import Grip as Grip
from impactopt.problem.terms.hand_orientation import HandOrientation as HandOrientation
from impactopt.problem.terms.hit_cone import HitCone as HitCone
from impactopt.problem.terms.hit_region import HitRegion as HitRegion
from impactopt.problem.terms.joint_acceleration import JointAcceleration as JointAcceleration
from impactopt.problem.terms.joint_jerk import JointJerk as JointJerk
from impactopt.problem.terms.lazy_terms import GearLoad as GearLoad
from impactopt.problem.terms.lazy_terms import ReferenceRange as ReferenceRange
from impactopt.problem.terms.lazy_terms import Slide as Slide
from impactopt.problem.terms.motor_curve import MotorCurve as MotorCurve
from impactopt.problem.terms.power_limit import PowerLimit as PowerLimit
from impactopt.problem.terms.target_speed import TargetSpeed as TargetSpeed
from impactopt.problem.terms.torque_rate import TorqueRate as TorqueRate
from impactopt.problem.terms.velocity_jump import VelocityJump as VelocityJump

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
    JointJerk,
    GearLoad,
    MotorCurve,
    PowerLimit,
    VelocityJump,
    TargetSpeed,
    Slide,
    ReferenceRange,
    Grip,
)
