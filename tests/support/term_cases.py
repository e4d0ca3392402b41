"""A case of each term that only some problems have, on the small arm: what tests of all of them go through.

A new term adds its case to CASES.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt import (
    Gaze,
    GearLoad,
    HandOrientation,
    HitCone,
    HitRegion,
    JointAcceleration,
    JointJerk,
    MotorCurve,
    Plan,
    PowerLimit,
    ReferenceRange,
    Slide,
    TargetSpeed,
    Term,
    TorqueRate,
    VelocityJump,
)
from impactopt.solvers.program import SolverResult
from impactopt.transcription.transcription import Transcription

Array = NDArray[np.float64]


@dataclass
class Solved:
    """A plan of the arm, measured by Pinocchio and not by its program."""

    transcription: Transcription
    result: SolverResult
    plan: Plan

    def posture(self, s: float, phase: str = "swing") -> Array:
        """q (nq,) at a fraction of a phase of the arm's plan."""
        spline = getattr(self.plan, phase)
        return np.asarray(self.plan.coordinates.join(spline.sample(s * spline.duration)[0][0], np.zeros(0)))

    def frame(self, name: str, q: Array) -> Any:
        model = self.plan.problem.robot.model
        data = model.createData()
        pin.framesForwardKinematics(model, data, q)
        return data.oMf[model.getFrameId(name)]

    @property
    def hit(self) -> Array:
        return np.array(self.frame(f"striker:{self.plan.problem.striker}", self.posture(1.0)).translation)


@dataclass(frozen=True)
class Case:
    """A term that binds on the arm, the same loosened, and one that it can go on with beside others.

    reaches : of a plan with the tight one, how much of what it may it does: 1 where it binds. None: a test of
        its own says more.
    """

    tight: Term
    loose: Term
    mild: Term
    reaches: Callable[[Solved, Any], float] | None = None


def torque_rate(plan: Solved, term: TorqueRate) -> float:
    """By inverse dynamics at the nodes."""
    t, model, fastest = plan.transcription, plan.plan.problem.robot.model, 0.0
    of_all = not isinstance(term.limit, dict)
    limit = np.array([term.limit if of_all else term.limit.get(j, np.inf) for j in t.robot.joint_names])
    for spline, nodes in ((plan.plan.swing, [0, *t.swing_nodes]), (plan.plan.follow, t.follow_nodes)):
        times, torque = np.array(nodes) * spline.duration, []
        for y, v, a in zip(*spline.sample(times), strict=True):
            q = t.coordinates.join(y, np.zeros(0))
            torque.append(pin.rnea(model, model.createData(), q, v, a).copy())
        rate = np.abs(np.diff(torque, axis=0)) / np.diff(times)[:, None]
        fastest = max(fastest, float((rate / limit).max()))
    return fastest


def hand_orientation(plan: Solved, term: HandOrientation) -> float:
    axis = plan.frame("striker:hand", plan.posture(1.0)).rotation @ np.array(term.axis)
    return float(np.arccos(axis @ plan.plan.problem.normal)) / term.angle


def hit_cone(plan: Solved, term: HitCone) -> float:
    problem, model = plan.plan.problem, plan.plan.problem.robot.model
    normal, data = problem.normal, model.createData()
    v = plan.plan.swing.sample(plan.plan.swing.duration)[1][0]
    pin.forwardKinematics(model, data, plan.posture(1.0), v)
    frame = model.getFrameId("striker:hand")
    velocity = pin.getFrameVelocity(model, data, frame, pin.LOCAL_WORLD_ALIGNED).linear
    velocity -= float(problem.target.speed_before()) * normal
    return float(np.arccos(normal @ velocity / np.linalg.norm(velocity))) / term.angle


def joint_acceleration(plan: Solved, term: JointAcceleration) -> float:
    """Of the arm's joints, which are its splines: everywhere, not at the nodes alone."""
    names, limit = plan.transcription.robot.joint_names, term.limit
    most = np.array([limit.get(joint, np.inf) if isinstance(limit, dict) else limit for joint in names])
    found = [
        spline.sample(np.linspace(0, spline.duration, 1001))[2]
        for spline in (plan.plan.swing, plan.plan.follow)
    ]
    return float((np.abs(np.concatenate(found)) / most).max())


def joint_jerk(plan: Solved, term: JointJerk) -> float:
    """By differences of accelerations inside of the splines' intervals."""
    worst = 0.0
    for spline in (plan.plan.swing, plan.plan.follow):
        ends = spline.breaks * spline.duration
        inside = ends[:-1, None] + np.outer(np.diff(ends), [0.2, 0.8])
        one, two = (spline.sample(time)[2] for time in inside.T)
        worst = max(worst, float(np.abs((two - one) / (0.6 * np.diff(ends))[:, None]).max()))
    return worst / float(term.limit)  # type: ignore[arg-type]


def velocity_jump(plan: Solved, term: VelocityJump) -> float:
    before = plan.plan.swing.sample(plan.plan.swing.duration)[1][0]
    after = plan.plan.follow.sample(0.0)[1][0]
    return float(np.abs(after - before).max()) / float(term.limit)  # type: ignore[arg-type]


def target_speed(plan: Solved, term: TargetSpeed) -> float:
    return float(plan.plan.collision.outcome["speed_m_s"]) / term.most


def slid(plan: Solved, term: Slide) -> float:
    """Along the tangent in which it is farther, at the collision's states."""
    problem = plan.plan.problem
    _, _, rows = np.linalg.svd(problem.normal.reshape(1, 3))
    far = 0.0
    for y, _ in plan.plan.collision.motion:
        q = plan.plan.coordinates.join(y, np.zeros(0))
        way = np.array(plan.frame(f"striker:{problem.striker}", q).translation) - problem.point
        far = max(far, float(np.abs(rows[1:] @ way).max()))
    return far / term.most


def coasted(plan: Solved, term: ReferenceRange) -> float:
    """By the reference every millisecond: the margin over what is left of it."""
    way, robot = plan.plan.reference, plan.plan.problem.robot
    angles = robot.joint_positions(way.q[way.phase == 1][-1])
    return term.margin / float(np.minimum(angles - robot.lower, robot.upper - angles).min())


CASES: dict[str, Case] = {
    "torque rate": Case(TorqueRate(limit=20.0), TorqueRate(limit=30.0), TorqueRate(limit=200.0), torque_rate),
    "rate of some joints": Case(
        TorqueRate(limit={"wrist": 5.0, "elbow": 20.0}),
        TorqueRate(limit={"wrist": 8.0, "elbow": 30.0}),
        TorqueRate(limit=200.0),
        torque_rate,
    ),
    "hand orientation": Case(
        HandOrientation(axis=(0, 0, 1), angle=1.15),
        HandOrientation(axis=(0, 0, 1), angle=1.2),
        HandOrientation(axis=(0, 0, 1), angle=1.3),
        hand_orientation,
    ),
    "gaze": Case(
        Gaze(frame="elbow", axis=(0, 0, 1), angle=0.05),
        Gaze(frame="elbow", axis=(0, 0, 1), angle=0.1),
        Gaze(frame="elbow", axis=(0, 0, 1), angle=0.5),
    ),
    "disc": Case(HitRegion(radius=0.02), HitRegion(radius=0.05), HitRegion(radius=0.02)),
    "rectangle": Case(HitRegion(size=(0.1, 0.02)), HitRegion(size=(0.1, 0.05)), HitRegion(radius=0.02)),
    "joint acceleration": Case(
        JointAcceleration(limit=40.0),
        JointAcceleration(limit=50.0),
        JointAcceleration(limit=200.0),
        joint_acceleration,
    ),
    "acceleration of a joint": Case(
        JointAcceleration(limit={"wrist": 20.0}),
        JointAcceleration(limit={"wrist": 30.0}),
        JointAcceleration(limit=200.0),
        joint_acceleration,
    ),
    "joint jerk": Case(JointJerk(limit=300.0), JointJerk(limit=400.0), JointJerk(limit=1e5), joint_jerk),
    "gear load": Case(GearLoad(limit=0.6), GearLoad(limit=0.7), GearLoad(limit=1.0)),
    "motor curve": Case(MotorCurve(fraction=0.2), MotorCurve(fraction=0.25), MotorCurve()),
    "power limit": Case(PowerLimit(limit=30.0), PowerLimit(limit=40.0), PowerLimit(limit=200.0)),
    "velocity jump": Case(
        VelocityJump(limit=0.1), VelocityJump(limit=0.13), VelocityJump(limit=2.0), velocity_jump
    ),
    "target speed": Case(
        TargetSpeed(least=-np.inf, most=0.8),
        TargetSpeed(least=-np.inf, most=1.0),
        TargetSpeed(least=0.0, most=5.0),
        target_speed,
    ),
    "reference range": Case(
        ReferenceRange(margin=1.935), ReferenceRange(margin=1.9315), ReferenceRange(margin=0.1), coasted
    ),
    "slide": Case(Slide(most=1e-4), Slide(most=2.5e-3), Slide(most=0.1), slid),
    "hit cone": Case(HitCone(angle=0.05), HitCone(angle=0.2), HitCone(angle=0.2), hit_cone),
}
# one of each kind, all of which a plan of the arm can have
MILD: dict[type[Term], Term] = {type(case.mild): case.mild for case in CASES.values()}
