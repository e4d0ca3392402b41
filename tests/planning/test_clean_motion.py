"""A motion whose bodies keep apart, by someone else's reading of the robot: exact meshes of its URDF, not
our hulls.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from support.meshes import Meshes

from impactopt import Solution, load_problem, solve
from impactopt.files.output import record_of


@pytest.mark.slow
def test_no_mesh_is_in_another_from_start_to_rest_or_after_a_miss(punch: Solution) -> None:
    assert punch.status.usable, punch.result.message
    meshes = Meshes(punch.problem.robot, punch.problem.start_posture)
    assert meshes.known
    for missed in (False, True):
        assert meshes.touching(punch.plan.motion(missed=missed).q) == []


def test_the_meshes_know_what_is_in_each_other() -> None:
    """A forearm turned through the pelvis is found: what never fails would say nothing."""
    problem = load_problem("punch")
    robot, q = problem.robot, problem.start_posture.copy()
    for joint in ("arm_left_4_joint", "arm_left_2_joint"):
        q[robot.model.joints[robot.model.getJointId(joint)].idx_q] = 0.0
    meshes = Meshes(robot, problem.start_posture)
    assert any("arm_left" in one or "arm_left" in two for one, two in meshes.touching(q[None]))


@pytest.mark.slow
@pytest.mark.parametrize("aside", [(0.017, 0.004, 0.009), (-0.005, 0.02, 0.019)])
def test_nor_when_it_is_bent(punch: Solution, aside: tuple[float, float, float]) -> None:
    """So far that other bodies come near than those that the plan has rows for."""
    bent = punch.moved(point=punch.problem.point + aside)
    assert bent.status.usable, bent.result.message
    assert Meshes(bent.problem.robot, bent.problem.start_posture).touching(bent.plan.motion().q) == []


@pytest.mark.slow
def test_nor_in_another_problem() -> None:
    """All of them: `python -m benchmarks truth`."""
    solution = solve(load_problem("chop"))
    assert solution.status.usable, solution.result.message
    meshes = Meshes(solution.problem.robot, solution.problem.start_posture)
    assert meshes.known
    for missed in (False, True) if solution.plan.abort is not None else (False,):
        assert meshes.touching(solution.plan.motion(missed=missed).q) == []


@pytest.mark.slow
def test_the_summary_says_so(punch: Solution) -> None:
    said = punch.clearance()
    assert said["contacts_besides"] == [] and said["clearance_mm"] > 0 and " and " in said["nearest"]
    assert np.isfinite(said["clearance_mm"]) and len(punch.clearance_constraints) > 0


@pytest.mark.slow
def test_bodies_that_pass_through_each_other_are_told(punch: Solution) -> None:
    """The plan with its left arm turned through leg and pelvis: the meshes find the same links there."""
    c, plan = punch.problem.coordinates, punch.plan
    control = plan.swing.control.copy()
    for joint in ("arm_left_4_joint", "arm_left_2_joint"):
        control[3:-3, c.labels.index(joint)] = 0.0
    swing = dataclasses.replace(plan.swing, control=control)
    turned = dataclasses.replace(punch, plan=dataclasses.replace(plan, swing=swing))
    said = turned.clearance()
    assert said["clearance_mm"] < -30
    told = {frozenset((touch["one"], touch["other"])) for touch in said["contacts_besides"]}
    found = Meshes(punch.problem.robot, punch.problem.start_posture).touching(turned.plan.motion().q)
    assert len(told) > 1
    assert told <= {frozenset(name.removesuffix("_0") for name in pair) for pair in found}


@pytest.mark.slow
def test_bodies_that_stay_apart_have_no_distance(hammered: Solution) -> None:
    none = {"clearance_mm": None, "nearest": "", "contacts_besides": []}
    assert hammered.clearance() == none
    replayed = record_of(hammered, simulation=hammered.validate()).summary["simulated"]
    assert none.items() <= replayed.items()
