"""A motion whose bodies keep apart, by someone else's reading of the robot: exact meshes of its URDF, not
our hulls.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from small_plans import BODILESS

from impactopt import Solution, solve


def meshes(solution: Solution) -> tuple[Any, Any]:
    """Pinocchio's model and geometry of the robot, with the pairs that may not touch: not what a joint
    connects, nor what touches at the start."""
    robot = solution.problem.robot
    full = pin.buildModelFromUrdf(robot.urdf, pin.JointModelFreeFlyer())
    folders = [str(folder) for folder in Path(str(robot.urdf)).resolve().parents]
    geometry = pin.buildGeomFromUrdf(full, robot.urdf, pin.COLLISION, package_dirs=folders)
    locked = [full.getJointId(name) for name in full.names if name not in set(robot.model.names)]
    model, geometry = pin.buildReducedModel(full, geometry, locked, pin.neutral(full))
    geometry.addAllCollisionPairs()
    data, found = model.createData(), geometry.createData()
    pin.computeCollisions(model, data, geometry, found, solution.problem.start_posture, False)
    for k, pair in enumerate(geometry.collisionPairs):
        a, b = (geometry.geometryObjects[i].parentJoint for i in (pair.first, pair.second))
        together = a == b or model.parents[a] == b or model.parents[b] == a
        if together or found.collisionResults[k].isCollision():
            found.deactivateCollisionPair(k)
    return model, (geometry, found)


def test_no_mesh_is_in_another_from_start_to_rest_or_after_a_miss(punch: Solution) -> None:
    assert punch.status.usable, punch.result.message
    model, (geometry, found) = meshes(punch)
    data = model.createData()
    for missed in (False, True):
        for q in punch.plan.motion(4e-3, missed=missed).q:
            assert not pin.computeCollisions(model, data, geometry, found, q, True)


def test_the_summary_says_so(punch: Solution) -> None:
    said = punch.clearance()
    assert said["contacts_besides"] == [] and said["clearance_mm"] > 0 and " and " in said["nearest"]
    assert np.isfinite(said["clearance_mm"]) and len(punch.apart) > 0


def test_what_is_switched_off_is_told(punch: Solution) -> None:
    """The same punch without these terms: another's count of the pairs that pass through each other was
    29.
    """
    said = solve(dataclasses.replace(punch.problem, terms=(*punch.problem.terms, *BODILESS))).clearance()
    assert said["clearance_mm"] < -50
    assert len({(touch["one"], touch["other"]) for touch in said["contacts_besides"]}) > 20
