"""The floor: of robots on soles z = 0, and of robots on a fixed base none, unless the problem has one."""

from __future__ import annotations

import dataclasses

import numpy as np
import pinocchio as pin
import pytest
from support.small_plans import arm_problem, biped_problem

from impactopt import Ground, InputError, Perturbation, planar_arm
from impactopt.bodies.clearance import Places
from impactopt.simulation import scene_of
from impactopt.simulation.collision_geometry import FLOOR
from impactopt.simulation.mujoco_world import MujocoOptions, build_world


def test_a_fixed_base_has_no_floor_unless_the_problem_says_so() -> None:
    bolted = dataclasses.replace(arm_problem(), terms=())
    assert bolted.ground_height is None
    assert not any(body.ground for body in bolted.world)
    assert bolted.describe()["ground"] == "none"
    low = dataclasses.replace(bolted, ground=Ground(height=-0.8))
    (floor,) = (body for body in low.world if body.ground)
    assert floor.place[2] + floor.half[2] == -0.8
    assert low.describe()["ground"] == "z = -0.8 m"
    assert len({problem.hash for problem in (bolted, low, dataclasses.replace(bolted, ground=Ground()))}) == 3


def test_soles_stand_on_the_ground_whatever_is_said() -> None:
    biped = biped_problem()
    (floor,) = (body for body in biped.world if body.ground)
    assert floor.place[2] + floor.half[2] == 0.0
    assert dataclasses.replace(biped, ground=Ground()).hash == biped.hash
    with pytest.raises(InputError, match=r"is z = 0, where its soles stand: leave `ground` out"):
        dataclasses.replace(biped, ground=Ground(height=0.1))
    with pytest.raises(InputError, match=r"must be a Ground, such as Ground\(height=-0\.8\), not -0\.8"):
        dataclasses.replace(biped, ground=-0.8)


@pytest.mark.parametrize("height", [-0.1, 0.2])
def test_distances_and_replays_have_the_floor_at_its_height(height: float) -> None:
    problem = dataclasses.replace(
        arm_problem(),
        robot=planar_arm(),
        striker="hammer",
        start="ready",
        point=np.array([0.5, 0.0, 0.9]),
        normal=np.array([1.0, 0.0, 0.0]),
        ground=Ground(height=height),
    )
    model, bodies, q = problem.robot.model, problem.bodies, problem.start_posture
    at = Places.of(problem.robot, q[None], np.zeros(1, dtype=np.intp))
    data = model.createData()
    pin.forwardKinematics(model, data, q)
    over = [j for j, w in bodies.world_pairs if problem.world[w].ground]
    assert over
    for joint in over:
        lowest = min(
            float((piece.vertices @ data.oMi[joint].rotation[2]).min() + data.oMi[joint].translation[2])
            for piece in bodies.links.of_joint[joint]
        )
        assert bodies.exact(at, 0, (joint, -1)) == pytest.approx(lowest - height, abs=1e-9)
    scene = scene_of(problem)
    near = [pair for pair in scene.solids.pairs if pair[1] == FLOOR]
    assert {scene.solids.solids[one].joint for one, _ in near} == set(over)
    world = build_world(problem.robot, scene, Perturbation(), MujocoOptions(), near)
    assert world.geom("floor").pos[2] == height
