"""A robot that has hit nothing stops by a motion of its own, planned with the swing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from support.small_plans import Planned, changed, planned, solution_of

from impactopt import InputError, Perturbation, Scenario, Solution, load_record
from impactopt.files.output import record_of, save_record
from impactopt.files.replay import load_planned
from impactopt.simulation import scene_of, simulate_mujoco
from impactopt.transcription.transcription import Transcription

PROBLEM = Path(__file__).resolve().parents[2] / "problems" / "punch.toml"


@pytest.fixture(scope="module")
def biped(biped_transcription: Transcription) -> Solution:
    """A plan with an abort motion."""
    scenario = Scenario(name="gone", missing=True, abort_after=0.025)
    return solution_of(planned(changed(biped_transcription, scenarios=(scenario,))))


def test_until_the_robot_should_have_felt_the_target_nothing_differs(biped: Solution) -> None:
    hit, missed = biped.trajectory, biped.missed_trajectory
    assert missed.contact_start == hit.contact_start
    assert missed.contact_end == pytest.approx(hit.contact_start + 0.025)
    swing = hit.phase == 0
    for name in ("time", "phase", "q", "v", "a", "torque", "ground"):
        np.testing.assert_array_equal(getattr(missed, name)[: swing.sum()], getattr(hit, name)[swing])
    coasting = (hit.phase == 1) & (hit.time < missed.contact_end)
    for name in ("q", "v", "torque"):
        for k in range(getattr(hit, name).shape[1]):
            there = np.interp(hit.time[coasting], missed.time, getattr(missed, name)[:, k])
            np.testing.assert_allclose(there, getattr(hit, name)[coasting, k], atol=1e-4)


def test_the_abort_motion_goes_on_from_coasting_and_comes_to_rest(biped: Solution) -> None:
    missed, model = biped.missed_trajectory, biped.problem.robot.model
    last, first = np.flatnonzero(missed.phase == 1)[-1], np.flatnonzero(missed.phase == 2)[0]
    assert missed.time[last] == missed.time[first] == missed.contact_end
    # the program's constraints hold to its tolerance; an impact changes some rate by far more
    step = np.abs(pin.difference(model, missed.q[last], missed.q[first])).max()
    assert step < 1e-4 and np.abs(missed.v[last] - missed.v[first]).max() < 1e-3
    hit = biped.trajectory
    before, after = np.flatnonzero(hit.phase == 1)[-1], np.flatnonzero(hit.phase == 2)[0]
    assert np.abs(hit.v[after] - hit.v[before]).max() > 0.1
    # where coasting ends, the soles press as the program has it: within their limits
    np.testing.assert_allclose(missed.sole_wrench[last], biped.plan.coast_wrench, atol=0.1)
    np.testing.assert_allclose(missed.v[missed.time >= missed.end], 0.0, atol=1e-12)
    # its feed-forward balances gravity and motion under the wrenches that it assumes
    data, k = model.createData(), (first + len(missed.time)) // 2
    tau = pin.rnea(model, data, missed.q[k], missed.v[k], missed.a[k])
    force = pin.SE3(np.eye(3), missed.q[k, :3]).actInv(pin.Force(missed.ground[k, :3], missed.ground[k, 3:]))
    turn = pin.Quaternion(missed.q[k, 3:7]).toRotationMatrix().T
    np.testing.assert_allclose(tau[:6], [*(turn @ force.linear), *(turn @ force.angular)], atol=1e-6)


def test_its_nodes_have_the_constraints_of_a_follow_through(biped_transcription: Transcription) -> None:
    scenario = Scenario(name="gone", missing=True, abort_after=0.02)
    program = changed(biped_transcription, scenarios=(scenario,)).program
    places: dict[str, set[str]] = {}
    for i in range(program.m):
        term, place, *_ = program.constraint_name(i).split(", ")
        places.setdefault(place, set()).add(term)
    assert places["abort"] == places["follow-through"] - {"displacement of the target"}
    assert {"contact wrench cone", "torque limit"} < places["end of coasting"]
    before = biped_transcription.program
    assert not any("abort" in before.constraint_name(i) for i in range(before.m))


@pytest.mark.slow
def test_the_punch_into_the_air_stands(punch: Solution) -> None:
    air = punch.validate(engine="mujoco", perturbation=Perturbation(missing=True))
    assert air.standing, air.fall
    assert air.impulse == 0.0 and air.slip.max() < 5e-3 and air.lift.max() < 2e-3
    np.testing.assert_allclose(air.q[-1, 7:], punch.missed_trajectory.q[-1, 7:], atol=0.02)
    # both rest near the posture that is asked for; what the robot does on its way there is the abort motion,
    # and far from the follow-through
    time = np.linspace(punch.missed_trajectory.contact_end, punch.missed_trajectory.end, 30)
    done, abort, follow = (
        np.array([np.interp(time, motion.time, joint) for joint in motion.q[:, 7:].T])
        for motion in (air, punch.missed_trajectory, punch.trajectory)
    )
    np.testing.assert_allclose(done, abort, atol=0.02)
    assert np.abs(done - follow).max() > 0.1


@pytest.mark.slow
def test_a_robot_that_hits_does_not_abort(punch: Solution) -> None:
    until = punch.missed_trajectory.contact_end + 0.1  # [s] an abort motion would begin 0.1 s earlier
    motion, scene = (punch.problem.robot, punch.trajectory), scene_of(punch.problem)
    with_abort, without, missing = (
        simulate_mujoco(*motion, scene, step=5e-4, until=until, missed=missed, perturbation=world)
        for missed, world in (
            (punch.missed_trajectory, None),
            (None, None),
            (punch.missed_trajectory, Perturbation(missing=True)),
        )
    )
    np.testing.assert_array_equal(with_abort.q, without.q)
    assert np.abs(missing.q[-1] - without.q[-1]).max() > 1e-3


@pytest.mark.slow
def test_the_record_keeps_it(punch: Solution, tmp_path: Path) -> None:
    save_record(record_of(punch, problem=PROBLEM.read_text(), problem_path=PROBLEM), tmp_path)
    assert "missed_time" in load_record(tmp_path).arrays
    found = load_planned(tmp_path).missed
    assert found is not None and found.end == punch.missed_trajectory.end
    # the record's histories are rounded
    np.testing.assert_allclose(found.q, punch.missed_trajectory.q, rtol=0, atol=1e-8)


def test_a_plan_without_an_abort_motion_says_how_to_get_one(arm_plan: Planned) -> None:
    with pytest.raises(InputError, match="abort_after"):
        arm_plan.plan.trajectory(missed=True)
