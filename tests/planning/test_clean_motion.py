"""A motion whose bodies keep apart, by someone else's reading of the robot: exact meshes of its URDF, not
our hulls.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from support.meshes import Meshes
from support.small_plans import BODILESS

from impactopt import Solution, load_problem, solve, talos
from impactopt.files.output import record_of
from impactopt.problem.terms import GroundForce


def test_no_mesh_is_in_another_from_start_to_rest_or_after_a_miss(punch: Solution) -> None:
    assert punch.status.usable, punch.result.message
    meshes = Meshes(punch.problem.robot, punch.problem.start_posture)
    assert meshes.known
    for missed in (False, True):
        assert meshes.touching(punch.plan.motion(1e-3, missed=missed).q) == []


def test_the_meshes_know_what_is_in_each_other(punch: Solution) -> None:
    """A forearm turned through the pelvis is found: what never fails would say nothing."""
    robot, q = punch.problem.robot, punch.problem.start_posture.copy()
    for joint in ("arm_left_4_joint", "arm_left_2_joint"):
        q[robot.model.joints[robot.model.getJointId(joint)].idx_q] = 0.0
    meshes = Meshes(robot, punch.problem.start_posture)
    assert any("arm_left" in one or "arm_left" in two for one, two in meshes.touching(q[None]))


@pytest.mark.parametrize("aside", [(0.017, 0.004, 0.009), (-0.005, 0.02, 0.019)])
def test_nor_when_it_is_bent(punch: Solution, aside: tuple[float, float, float]) -> None:
    """So far that other bodies come near than those that the plan has rows for."""
    bent = punch.moved(point=punch.problem.point + aside)
    assert bent.status.usable, bent.result.message
    assert Meshes(bent.problem.robot, bent.problem.start_posture).touching(bent.plan.motion(1e-3).q) == []


def test_nor_in_another_problem() -> None:
    """All of them: `python -m benchmarks truth`."""
    solution = solve(load_problem("kick_talos"))
    assert solution.status.usable, solution.result.message
    meshes = Meshes(solution.problem.robot, solution.problem.start_posture)
    assert meshes.known
    for missed in (False, True) if solution.plan.abort is not None else (False,):
        assert meshes.touching(solution.plan.motion(1e-3, missed=missed).q) == []


def test_the_summary_says_so(punch: Solution) -> None:
    said = punch.clearance()
    assert said["contacts_besides"] == [] and said["clearance_mm"] > 0 and " and " in said["nearest"]
    assert np.isfinite(said["clearance_mm"]) and len(punch.clearance_constraints) > 0


def test_what_is_switched_off_is_told() -> None:
    """A punch without these terms: another's count of the pairs that pass through each other was 29."""
    problem = load_problem("punch")
    hand = dataclasses.replace(problem.robot.striker("right_hand"), point=[0.0, 0.0, -0.125])
    robot = talos(strikers=[hand])
    terms = (*problem.terms, *BODILESS, GroundForce(enabled=False))
    said = solve(dataclasses.replace(problem, robot=robot, terms=terms, style="strongest")).clearance()
    assert said["clearance_mm"] < -50
    assert len({(touch["one"], touch["other"]) for touch in said["contacts_besides"]}) > 20


def test_bodies_that_stay_apart_have_no_distance() -> None:
    solution = solve(load_problem("arm_planar"))
    none = {"clearance_mm": None, "nearest": "", "contacts_besides": []}
    assert solution.clearance() == none
    replayed = record_of(solution, simulation=solution.validate()).summary["simulated"]
    assert none.items() <= replayed.items()
