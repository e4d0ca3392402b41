"""Robots of one joint on the ground, a ram and a swinging arm: the smallest there are."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from impactopt import (
    FixedBase,
    FreeMass,
    ImpactProblem,
    Phase,
    Robot,
    SpringDamper,
    Status,
    Striker,
    VelocityLimit,
    effective_mass,
)
from impactopt.planning.solve import solve
from impactopt.planning.strike import optimize_strike
from impactopt.simulation import scene_of, simulate_pinocchio
from impactopt.transcription.contact_guess import fastest_at_contact

MASS, ARMATURE = 2.0, 0.1  # [kg], [kg] or [kg m2]
REACH = 0.5  # [m] of the arm


def problem(kind: str) -> ImpactProblem:
    model = pin.Model()
    slides = kind == "ram"
    joint = model.addJoint(
        0, pin.JointModelPX() if slides else pin.JointModelRZ(), pin.SE3.Identity(), "joint"
    )
    # a point mass, of which the guessed body surrounds the striker
    at = np.zeros(3) if slides else np.array([0.0, -REACH, 0.0])
    model.appendBodyToJoint(joint, pin.Inertia(MASS, at, 0.01 * np.eye(3)), pin.SE3.Identity())
    model.addFrame(pin.Frame("tip", joint, 0, pin.SE3(np.eye(3), at), pin.FrameType.OP_FRAME))
    robot = Robot.from_model(
        model,
        armature=ARMATURE,
        torque_limit=500.0,
        velocity_limit=20.0,
        position_limit={"joint": (-3.0, 3.0)},
        strikers=[Striker(name="tip", frame="tip", point=np.zeros(3))],
        postures={"start": {"joint": 0.0 if slides else -0.8}},
    )
    return ImpactProblem(
        robot=robot,
        striker="tip",
        start="start",
        stance=FixedBase(),
        point=[0.25, 0.0, 0.0] if slides else [0.0, -REACH, 0.0],
        normal=[1.0, 0.0, 0.0],
        target=FreeMass(mass=1.0),
        law=SpringDamper(stiffness=2e4, damping=50.0),
        swing=Phase(duration=(0.2, 0.8), intervals=8),
        follow=Phase(duration=(0.2, 1.0), intervals=8),
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ram", "arm"])
def test_one_joint_strikes_with_all_that_it_has(kind: str) -> None:
    made = problem(kind)
    found = solve(made)
    assert found.status is Status.SOLVED and found.plan is not None
    plan, hit = found.plan, found.plan.collision
    # the mass that the target meets, in closed form
    mass = MASS + ARMATURE if kind == "ram" else MASS + (0.01 + ARMATURE) / REACH**2
    met = effective_mass(made.robot, striker="tip", normal=made.normal)
    assert float(met(made.contact_posture)) == pytest.approx(mass, rel=1e-6)
    assert plan.impulse == pytest.approx(hit.outcome["speed_m_s"], rel=1e-3)  # of a free mass of 1 kg
    replay = simulate_pinocchio(made.robot, found.trajectory, scene_of(made))
    assert replay.impulse == pytest.approx(plan.impulse, rel=5e-3)
    blow = optimize_strike(made)
    assert blow.status is Status.SOLVED
    assert blow.impulse > 0.999 * plan.impulse  # the blow alone can do no less


@pytest.mark.parametrize(("kind", "lever"), [("ram", 1.0), ("arm", REACH)])
def test_the_fastest_contact_is_that_of_the_joint(kind: str, lever: float) -> None:
    made = problem(kind)
    most = made.term(VelocityLimit).fraction * 20.0
    assert fastest_at_contact(made) == pytest.approx(lever * most, rel=1e-6)
