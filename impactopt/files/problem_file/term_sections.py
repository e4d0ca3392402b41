"""The sections below [terms]: what a plan must respect."""

from __future__ import annotations

from impactopt.files.problem_file.section import Section, optional, required
from impactopt.files.problem_file.values import (
    Fraction,
    Margin,
    NotNegative,
    NotNegativeOrAny,
    PerJoint,
    Point2,
    Positive,
    Restitution,
    UnitVector,
)
from impactopt.problem import extra_terms, terms


class TorqueLimit(Section):
    """|torque| is at most a fraction of each joint's limit: the rest is the servo's."""

    kind = terms.TorqueLimit
    fraction: Fraction = optional("of the limit, in swing and follow-through")
    collision: Fraction = optional("of the limit, while in contact")


class VelocityLimit(Section):
    """|joint velocity| is at most a fraction of each joint's limit."""

    kind = terms.VelocityLimit
    fraction: Fraction = optional("of the limit")


class PositionLimit(Section):
    """Joints stay inside their limits of position."""

    kind = terms.PositionLimit
    margin: NotNegative = optional("from each limit [rad]", "margin_rad")


class ContactWrenchCone(Section):
    """Each sole's wrench lies in the cone of its corners: centre of pressure, friction and torsion."""

    kind = terms.ContactWrenchCone
    friction: Positive = optional("coefficient that the soles may use")
    margin: NotNegative = optional("from the centre of pressure to the sole's edges [m]", "margin_m")
    collision_margin: Margin = optional(
        'the same, while in contact [m]; "anywhere": the ground may then do what it cannot, to compare',
        "collision_margin_m",
    )
    minimum_force: NotNegative = optional("that each sole keeps on the ground [N]", "minimum_force_N")


class Balance(Section):
    """What the impact may leave behind, so that the robot stays up; inf: any."""

    kind = terms.Balance
    capture_margin: Margin = optional(
        'from the capture point to the support polygon\'s edges [m]; "anywhere": none is asked',
        "capture_margin_m",
    )
    vertical_speed: NotNegativeOrAny = optional("of the centre of mass [m/s]", "vertical_speed_m_s")
    angular_momentum: NotNegativeOrAny = optional(
        "about each axis through the centre of mass [N m s]", "angular_momentum_N_m_s"
    )


class Incidence(Section):
    """No glancing blow: the striking point's speed across the normal at contact is bounded."""

    kind = terms.Incidence
    speed: NotNegativeOrAny = optional("along each of two tangents [m/s]; inf: any", "speed_m_s")


class LegExtension(Section):
    """Held legs stay away from a straight knee."""

    kind = terms.LegExtension
    minimum: Restitution = optional("of the start posture's leg determinant; 0 would be a straight knee")


class TorqueRate(Section):
    """|d torque/dt| is bounded, from node to node of swing and follow-through."""

    kind = extra_terms.TorqueRate
    limit: PerJoint = required("of all joints, or by joint [N m/s]", "limit_N_m_s")


class SelfCollision(Section):
    """Links of the robot keep apart, but for those that a joint connects or that touch at the start."""

    kind = terms.SelfCollision
    margin: NotNegative = optional("between two links [m]", "margin_m")
    enabled: bool = optional("false: links may pass through each other")


class KeepOut(Section):
    """The robot keeps off target, ground and obstacles; the link that strikes may touch the target."""

    kind = terms.KeepOut
    margin: NotNegative = optional("from a link to any of them [m]", "margin_m")
    enabled: bool = optional("false: the robot may pass through them")


class HandOrientation(Section):
    """The hand looks some way at contact."""

    kind = extra_terms.HandOrientation
    axis: UnitVector = required("unit vector in the striker's frame")
    direction: UnitVector = optional("where it looks, in the world; left out: along the normal")
    angle: Positive = optional("between the two, at most [rad]", "angle_rad")


class Gaze(Section):
    """A frame, such as the head's, looks at the hit point in the swing."""

    kind = extra_terms.Gaze
    frame: str = required("of the robot")
    axis: UnitVector = required("unit vector in the frame: the way it looks")
    angle: Positive = optional("off the hit point, at most [rad]", "angle_rad")
    since: NotNegative = optional("fraction of the swing from which it holds")


class HitRegion(Section):
    """The hit point is anywhere in a disc or a rectangle about `point_m`; give one of the keys."""

    kind = extra_terms.HitRegion
    radius: Positive = optional("of the disc [m]", "radius_m")
    size: Point2 = optional("of the rectangle, across and up [m]", "size_m")


class HitCone(Section):
    """The striking point's velocity at contact is near the normal; in place of `incidence`."""

    kind = extra_terms.HitCone
    angle: Positive = optional("between the two, at most [rad]", "angle_rad")


class Terms(Section):
    """What the plan must respect; of these, torque_limit to keep_out hold if left out too."""

    torque_limit: TorqueLimit = optional("")
    velocity_limit: VelocityLimit = optional("")
    position_limit: PositionLimit = optional("")
    contact_wrench_cone: ContactWrenchCone = optional("")
    balance: Balance = optional("")
    incidence: Incidence = optional("")
    leg_extension: LegExtension = optional("")
    self_collision: SelfCollision = optional("")
    keep_out: KeepOut = optional("")
    torque_rate: TorqueRate = optional("")
    hand_orientation: HandOrientation = optional("")
    gaze: Gaze = optional("")
    hit_region: HitRegion = optional("")
    hit_cone: HitCone = optional("")
