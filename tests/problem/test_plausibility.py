"""Numbers of robots that are sound by themselves and hard to believe are told, or refused."""

from __future__ import annotations

import dataclasses

import numpy as np
import pinocchio as pin
import pytest
from support.small_plans import biped_problem
from support.small_robots import biped

from impactopt import FixedBase, Robot, arm7, planar_arm
from impactopt.kinematics.holding import least_holding_share
from impactopt.problem.doubts import hopeless
from impactopt.problem.plausibility import doubts


def _with_soles(robot: Robot, **changes: dict[str, object]) -> Robot:
    soles = [dataclasses.replace(s, **changes.get(s.name, changes.get("each", {}))) for s in robot.soles]
    return dataclasses.replace(robot, soles=tuple(soles))


def _with_armature(robot: Robot, value: float) -> Robot:
    model = robot.model.copy()
    model.armature = np.concatenate([np.zeros(robot.nv - robot.n), np.full(robot.n, value)])
    return dataclasses.replace(robot, model=model, kp=0.01 * robot.kp, kd=0.01 * robot.kd)


def test_robots_of_the_package_are_believed() -> None:
    for robot in (biped(), planar_arm(), arm7()):
        assert [text for text in doubts(robot) if "no joint has armature" not in text] == []


@pytest.mark.parametrize(("value", "word"), [(1e-5, "too small"), (100.0, "too large")])
def test_armatures_that_no_drive_has_are_doubted(value: float, word: str) -> None:
    robot = _with_armature(arm7(), value)
    (told,) = doubts(robot)
    assert word in told and f"{value:.2g} kg m2" in told and "rotor inertia x gear ratio^2" in told


def test_soles_in_millimetres_are_refused() -> None:
    problem = biped_problem()
    polygon = 1e3 * problem.robot.soles[0].polygon
    wrong = _with_soles(problem.robot, each={"polygon": polygon})
    told = hopeless(dataclasses.replace(problem, robot=wrong))
    assert len(told) == 2 and all("are its corners in millimetres?" in text for text in told)
    assert hopeless(problem) == []


def test_soles_on_the_wrong_side_and_unlike_ones_are_doubted() -> None:
    robot = biped()
    left, right = (next(s for s in robot.soles if s.name == name) for name in ("left", "right"))
    swapped = _with_soles(robot, left={"frame": right.frame}, right={"frame": left.frame})
    assert any("'left' is to the right of 'right'" in text for text in doubts(swapped))
    longer = _with_soles(robot, left={"polygon": left.polygon * [1.5, 1.0]})
    assert any("are not alike" in text for text in doubts(longer))


def test_torque_that_does_not_hold_the_start_is_refused_before_a_solve() -> None:
    problem = biped_problem()
    weak = dataclasses.replace(problem.robot, torque_limit=np.full(problem.robot.n, 0.5))
    (told,) = hopeless(dataclasses.replace(problem, robot=weak))
    assert (
        told.startswith("the start posture cannot be held at rest: gravity asks")
        and "correct the torque" in told
    )


def test_an_arm_is_held_by_its_gravity_torque_alone() -> None:
    """Closed form: nothing but the joints bears a fixed base's weight."""
    robot = arm7()
    q = next(iter(robot.postures.values()))
    gravity = np.abs(pin.computeGeneralizedGravity(robot.model, robot.model.createData(), q))
    share = gravity / robot.torque_limit
    found = least_holding_share(robot, q, FixedBase().constraint_frames(robot), robot.torque_limit)
    assert found is not None
    assert found.share == pytest.approx(share.max(), rel=1e-6)
    assert found.joint == int(np.argmax(share))
    assert found.torque == pytest.approx(gravity[found.joint], rel=1e-6)


def test_two_legs_share_the_weight_as_well_as_they_can() -> None:
    """No wrench of the soles does with less: 200 drawn ones, each with the torque that it leaves."""
    problem = biped_problem()
    robot, q = problem.robot, problem.start_posture
    frames = problem.stance.constraint_frames(robot)
    found = least_holding_share(robot, q, frames, robot.torque_limit)
    assert found is not None
    model, data = robot.model, robot.model.createData()
    gravity = pin.computeGeneralizedGravity(model, data, q)
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    J = np.vstack(
        [pin.getFrameJacobian(model, data, model.getFrameId(f), pin.LOCAL_WORLD_ALIGNED) for f in frames]
    )
    base = J.T[:6]
    one = np.linalg.lstsq(base, gravity[:6], rcond=None)[0]
    free = np.eye(base.shape[1]) - np.linalg.pinv(base) @ base
    rng = np.random.default_rng(0)
    for _ in range(200):
        wrench = one + free @ (50 * rng.standard_normal(len(one)))
        assert np.abs(gravity[:6] - base @ wrench).max() < 1e-8
        assert np.max(np.abs((gravity - J.T @ wrench)[6:] / robot.torque_limit)) >= found.share * (1 - 1e-9)
