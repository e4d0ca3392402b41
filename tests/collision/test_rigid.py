"""The rigid impact against Pinocchio's, balances of momentum and energy, and stiff contacts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from support.small_robots import arm, biped, slider

from impactopt import (
    SDC,
    BothSoles,
    FixedBase,
    FreeMass,
    InputError,
    Nail,
    RigidImpact,
    RigidWall,
    Robot,
    SpringDamper,
    striking_velocity,
)
from impactopt.kinematics.stance import Stance

NORMAL = np.array([0.6, 0.0, 0.8])


def blow(robot: Robot, stance: Stance, **changes: Any) -> RigidImpact:
    usual = {"target": RigidWall(), "coefficient_of_restitution": 0.3}
    (striker,) = robot.strikers
    return RigidImpact(robot=robot, striker=striker, normal=NORMAL, stance=stance, **{**usual, **changes})


def moving(robot: Robot, stance: Stance) -> tuple[np.ndarray, np.ndarray]:
    q = robot.posture(next(iter(robot.postures)))
    (striker,) = robot.strikers
    return q, striking_velocity(robot, q, striker, NORMAL, 1.2, stance=stance)


def jacobian(robot: Robot, q: np.ndarray, frame: str) -> np.ndarray:
    model, data = robot.model, robot.model.createData()
    return pin.computeFrameJacobian(model, data, q, model.getFrameId(frame), pin.LOCAL_WORLD_ALIGNED)


@pytest.mark.parametrize("e", [0.0, 0.3, 1.0])
def test_a_wall_is_pinocchios_impulse_dynamics(e: float) -> None:
    robot, stance = biped(), BothSoles()
    q, v = moving(robot, stance)
    found = blow(robot, stance, coefficient_of_restitution=e).collide(q, v)
    held = [jacobian(robot, q, frame) for frame in stance.constraint_frames(robot)]
    hand = NORMAL @ jacobian(robot, q, robot.striker(*robot.strikers).model_frame)[:3]
    data = robot.model.createData()
    after = pin.impulseDynamics(robot.model, data, q, v, np.vstack([*held, hand]), e, 0.0)
    np.testing.assert_allclose(found.velocity, after, rtol=0, atol=1e-12 * np.abs(after).max())
    assert found.impulse == pytest.approx(-data.impulse_c[-1], rel=1e-12)
    assert found.energy == 0.0 and found.hand_speed[0] == pytest.approx(-e * 1.2, rel=1e-12)


@pytest.mark.parametrize("before", [0.0, -0.7])
def test_a_free_mass_is_pinocchios_with_the_mass_in_the_model(before: float) -> None:
    robot, stance, mass, e = arm(), FixedBase(), 2.5, 0.4
    q, v = moving(robot, stance)
    target = FreeMass(mass=mass, initial_velocity=before)
    found = blow(robot, stance, target=target, coefficient_of_restitution=e).collide(q, v)
    model = robot.model.copy()
    joint = model.addJoint(0, pin.JointModelPrismaticUnaligned(*NORMAL), pin.SE3.Identity(), "target")
    model.appendBodyToJoint(joint, pin.Inertia(mass, np.zeros(3), np.zeros((3, 3))), pin.SE3.Identity())
    data, frame = model.createData(), model.getFrameId(robot.striker(*robot.strikers).model_frame)
    q_all, v_all = np.append(q, 0.0), np.append(v, before)
    hand = NORMAL @ pin.computeFrameJacobian(model, data, q_all, frame, pin.LOCAL_WORLD_ALIGNED)[:3]
    hand[-1] = -1.0
    after = pin.impulseDynamics(model, data, q_all, v_all, hand[None], e, 0.0)
    np.testing.assert_allclose(found.velocity, after[:-1], rtol=0, atol=1e-12 * np.abs(after).max())
    assert found.target_result["speed"] == pytest.approx(after[-1], rel=1e-12)
    assert found.impulse == pytest.approx(mass * (after[-1] - before), rel=1e-12)
    assert found.energy == pytest.approx(0.5 * mass * (after[-1] ** 2 - before**2), rel=1e-12)


def test_an_elastic_impact_keeps_the_energy() -> None:
    robot, stance = biped(), BothSoles()
    q, v = moving(robot, stance)
    model, data = robot.model, robot.model.createData()
    found = blow(robot, stance, target=FreeMass(mass=3.0), coefficient_of_restitution=1.0).collide(q, v)
    energies = [pin.computeKineticEnergy(model, data, q, each) for each in (v, found.velocity)]
    assert energies[0] == pytest.approx(energies[1] + found.energy, rel=1e-12)


@pytest.mark.parametrize("zeta", [0.0, 0.2, 0.6])
def test_a_stiff_contact_tends_to_it(zeta: float) -> None:
    """With the restitution of a damped spring, docs/how/collision.md; as the duration, with the root of k."""
    robot, stance = biped(), BothSoles()
    q, v = moving(robot, stance)
    target = FreeMass(mass=3.0)
    e = np.exp(-zeta * np.arccos(zeta) / np.sqrt(1 - zeta**2))
    rigid = blow(robot, stance, target=target, coefficient_of_restitution=e).collide(q, v)
    reduced = rigid.impulse / ((1 + e) * 1.2)
    off = []
    for stiffness in (1e8, 1e10):
        law = SpringDamper(stiffness=stiffness, damping=2 * zeta * np.sqrt(stiffness * reduced))
        sdc = SDC(
            robot=robot, striker="fist", normal=NORMAL, law=law, target=target, stance=stance, accuracy=None
        )
        found = sdc.collide(q, v, np.zeros(robot.n))
        off.append((abs(found.impulse / rigid.impulse - 1), np.abs(found.velocity - rigid.velocity).max()))
    assert off[0][0] < 0.05
    np.testing.assert_allclose(off[1], 0.1 * np.array(off[0]), rtol=0.1)


def test_a_virtual_base_yields() -> None:
    robot = biped()
    q, v = moving(robot, BothSoles())
    exact, soft, heavy = (
        blow(robot, BothSoles(base_mass=m, base_inertia=m)).collide(q, v).impulse for m in (None, 1.0, 1e9)
    )
    assert soft < 0.999 * exact and heavy == pytest.approx(exact, rel=1e-6)


def test_bodies_that_part_do_not_hit() -> None:
    robot, stance = arm(), FixedBase()
    q, v = moving(robot, stance)
    found = blow(robot, stance).collide(q, -v)
    assert found.impulse == 0.0 and np.array_equal(found.velocity, -v)


def test_a_hand_that_no_joint_moves_along_the_normal_is_refused_at_a_wall() -> None:
    robot = slider(2.0)  # along x
    model = RigidImpact(robot=robot, striker="tip", normal=[0.0, 1.0, 0.0], target=RigidWall())
    with pytest.raises(InputError, match="no motion along the normal here"):
        model.collide([0.0], [1.0])


def test_other_numbers_and_bad_input() -> None:
    robot, stance = arm(), FixedBase()
    q, v = moving(robot, stance)
    model = blow(robot, stance, target=FreeMass(mass=1.0))
    heavier = blow(robot, stance, target=FreeMass(mass=4.0))
    assert model.collide(q, v, target_mass=4.0).impulse == heavier.collide(q, v).impulse
    with pytest.raises(InputError, match=r"no setting 'target_mas'.*target_mass"):
        model.collide(q, v, target_mas=4.0)
    with pytest.raises(InputError, match=r"mass \[kg\]: -4; give a number > 0"):
        model.collide(q, v, target_mass=-4.0)
    with pytest.raises(InputError, match="stance must be a Stance, not 'soles'"):
        blow(robot, "soles")  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"between 0 and 1, not 1\.1"):
        blow(robot, stance, coefficient_of_restitution=1.1)
    with pytest.raises(InputError, match="FreeMass and RigidWall only, not Nail"):
        blow(robot, stance, target=Nail(mass=0.1, resistance=500.0))
