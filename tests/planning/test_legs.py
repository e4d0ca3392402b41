"""Legs of seven joints below a waist, and of five on hinged soles: plans, checked and replayed."""

from __future__ import annotations

import dataclasses

import numpy as np
import pinocchio as pin
import pytest
from oracle.verdict import verify_record
from support.small_plans import biped_problem
from support.small_robots import biped

from impactopt import FullDynamics, Solution, coasting_reference, solve
from impactopt.codegen.compiler import find_compiler
from impactopt.files.output import record_of
from impactopt.simulation import scene_of, simulate_mujoco
from impactopt.simulation.collision_geometry import Solids

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
ROBOTS = {"seven and a waist": lambda: biped(7, waist=True), "five": lambda: biped(5)}
_solved: dict[str, Solution] = {}


def solved(name: str) -> Solution:
    if name not in _solved:
        _solved[name] = solve(biped_problem(ROBOTS[name]()))
    return _solved[name]


@pytest.fixture(params=list(ROBOTS))
def solution(request: pytest.FixtureRequest) -> Solution:
    found = solved(request.param)
    assert found.status.usable, found.result.message
    return found


@pytest.mark.slow
def test_the_soles_stay_where_they_are(solution: Solution) -> None:
    p, ref = solution.problem, solution.trajectory
    model, data = p.robot.model, p.robot.model.createData()
    for q, v, a in zip(ref.q[::25], ref.v[::25], ref.a[::25], strict=True):
        pin.forwardKinematics(model, data, q, v, a)
        pin.updateFramePlacements(model, data)
        for leg in p.coordinates.legs:
            frame = model.getFrameId(leg.frame)
            assert np.abs(pin.log6(leg.placement.actInv(data.oMf[frame])).vector).max() < 1e-9
            assert np.abs(pin.getFrameVelocity(model, data, frame).vector).max() < 1e-9
            assert np.abs(pin.getFrameAcceleration(model, data, frame).vector).max() < 1e-8


@pytest.mark.slow
def test_it_is_verified() -> None:
    solution = solved("five")
    record = record_of(solution)
    verdict = verify_record(solution.problem, record.arrays, record.summary)
    assert verdict.ok, verdict.reason


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["pinocchio", "mujoco"])
def test_it_is_true_on_held_and_on_free_soles(solution: Solution, engine: str) -> None:
    if engine == "mujoco":
        pytest.importorskip("mujoco")
    replay = solution.validate(engine=engine)
    assert replay.impulse == pytest.approx(solution.impulse, rel=1e-2)
    assert replay.standing in (None, True) and replay.slip.max() < 3e-3


@pytest.mark.slow
def test_the_collision_is_that_of_full_dynamics(solution: Solution) -> None:
    p, ref = solution.problem, solution.trajectory
    last = int(np.flatnonzero(ref.phase == 0)[-1])
    q, v, torque = ref.q[last], ref.v[last], ref.torque[last]
    bend = coasting_reference(p.coordinates, q, v, until=2 * float(solution.plan.collision.time[-1]))
    full = FullDynamics(
        robot=p.robot,
        striker=p.striker,
        normal=p.normal,
        law=p.law,
        target=p.target,
        stance=p.stance,
        step=1e-4,
    ).collide(q, v, torque, **bend)
    assert solution.impulse == pytest.approx(full.impulse, rel=2e-3)


@pytest.mark.slow
def test_what_is_before_the_last_six_joints_moves() -> None:
    s = solved("seven and a waist")
    free = [k for k, name in enumerate(s.problem.robot.joint_names) if "waist" in name or "tilt" in name]
    assert len(free) == 4 and (np.ptp(s.trajectory.q[:, 7:][:, free], axis=0) > 0.05).all()


@pytest.mark.slow
def test_hinges_bear_no_torque_and_keep_to_their_range() -> None:
    s = solved("five")
    r, ref = s.problem.robot, s.trajectory
    assert r.hinges.sum() == 2 and np.abs(ref.torque[:, r.hinges]).max() < 1e-9
    turned = np.abs(ref.q[:, 7:][:, r.hinges]).max()
    assert 1e-3 < turned <= 0.005
    wrench = np.concatenate([s.plan.swing_wrench, s.plan.follow_wrench, s.plan.collision.sole_wrench])
    assert np.abs(wrench[:, [3, 9]]).max() < 1.0  # [N m]: what turns the half of a foot
    assert np.abs(wrench[:, [4, 10]]).max() > 5.0


@pytest.mark.slow
def test_feet_that_do_not_turn_bring_the_same_blow() -> None:
    """On free soles, of a robot whose soles are its feet: the plan hardly turns its hinges."""
    pytest.importorskip("mujoco")
    s = solved("five")
    own, ref, rigid = ~s.problem.robot.hinges, s.trajectory, biped(5, hinge=None)
    flat = dataclasses.replace(
        ref,
        q=ref.q[:, np.append(np.ones(7, dtype=bool), own)],
        v=ref.v[:, np.append(np.ones(6, dtype=bool), own)],
        a=ref.a[:, np.append(np.ones(6, dtype=bool), own)],
        torque=ref.torque[:, own],
    )
    scene = dataclasses.replace(scene_of(s.problem), solids=Solids())  # they are by joints of the other
    replay = simulate_mujoco(rigid, flat, scene)
    assert replay.standing and replay.impulse == pytest.approx(s.impulse, rel=1e-2)
