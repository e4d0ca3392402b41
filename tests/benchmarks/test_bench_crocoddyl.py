"""Crocoddyl as a peer: what goes to it, the reference that is made of its plan, and errors."""

from __future__ import annotations

import importlib
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from benchmarks.crocoddyl_peer import _against_target, _reference, _task, crocoddyl_plan
from impactopt import FreeMass, ImpactProblem, InputError, load_problem
from impactopt.simulation.motors import Servo


@pytest.fixture(scope="module")
def punch() -> ImpactProblem:
    return load_problem("punch_standin")


@pytest.fixture
def plan(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The other environment's program, without crocoddyl."""
    monkeypatch.setitem(sys.modules, "crocoddyl", types.ModuleType("crocoddyl"))
    return importlib.import_module("benchmarks.crocoddyl_plan")


@pytest.mark.parametrize("name", ["punch_standin", "punch"])
def test_the_robot_that_goes_there_is_ours(name: str, plan: Any) -> None:
    problem = load_problem(name)
    task = {name: np.asarray(x) for name, x in _task(problem).items()}
    ours, theirs = problem.robot.model, plan.model_of(task)
    a, b = ours.createData(), theirs.createData()
    rng = np.random.default_rng(0)
    q = pin.integrate(ours, problem.start_posture, 0.3 * rng.standard_normal(ours.nv))
    v = rng.standard_normal(ours.nv)
    inertias = [np.triu(pin.crba(m, d, q)) for m, d in ((ours, a), (theirs, b))]
    assert inertias[1] == pytest.approx(inertias[0], abs=1e-10)
    bias = [pin.nonLinearEffects(m, d, q, v) for m, d in ((ours, a), (theirs, b))]
    assert bias[1] == pytest.approx(bias[0], abs=1e-8)
    pin.framesForwardKinematics(ours, a, q)
    pin.framesForwardKinematics(theirs, b, q)
    for frame in task["frames"]:
        places = [d.oMf[m.getFrameId(str(frame))].homogeneous for m, d in ((ours, a), (theirs, b))]
        assert places[1] == pytest.approx(places[0], abs=1e-12)


def test_a_plan_that_jumps_becomes_a_reference_that_jumps(punch: ImpactProblem) -> None:
    """Three steps at a constant acceleration, a stop, and two steps at rest."""
    robot, step = punch.robot, 0.01
    states, q, v = [], punch.start_posture, np.zeros(robot.nv)
    push = np.zeros(robot.nv)
    push[-1] = 2.0
    for _ in range(4):
        states.append(np.concatenate([q, v]))
        v = v + step * push
        q = pin.integrate(robot.model, q, step * v)
    at_rest = np.concatenate([states[-1][: robot.nq], np.zeros(robot.nv)])
    torques = np.arange(5.0)[:, None] * np.ones(robot.n)
    made = _reference(punch, np.array([*states, at_rest, at_rest, at_rest]), torques, 3, step)
    assert made.time == pytest.approx([0.0, 0.01, 0.02, 0.03, 0.03, 0.04, 0.05])
    assert made.contact_start == made.contact_end == pytest.approx(0.03)
    assert made.torque[:, 0] == pytest.approx([0, 1, 2, 2, 3, 4, 4])
    assert made.a[:, -1] == pytest.approx([2, 2, 2, 2, 0, 0, 0])
    servo, last = Servo(robot, made), 2 * robot.n - 1
    assert servo.target(0.03 - 1e-9)[last] == pytest.approx(0.06, abs=1e-6)
    assert servo.target(0.03)[last] == 0.0
    weight = 9.81 * sum(body.mass for body in robot.model.inertias)
    assert made.ground[-1][2] == pytest.approx(weight)
    com = pin.centerOfMass(robot.model, robot.model.createData(), made.q[-1])
    assert made.ground[-1][3:5] == pytest.approx([weight * com[1], -weight * com[0]], abs=1e-6)


def test_a_blow_against_a_wall_is_that_of_two_masses_against_a_target(punch: ImpactProblem) -> None:
    model, data = punch.robot.model, punch.robot.model.createData()
    q = punch.start_posture
    pin.computeJointJacobians(model, data, q)
    frame = model.getFrameId(punch.robot.striker(punch.striker).model_frame)
    J = np.asarray(pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED))[:3]
    v = 2.0 * np.linalg.pinv(J) @ punch.normal  # 2 m/s along the normal
    made = _against_target(punch, 2.0 * 3.0, np.concatenate([q, v]))  # an effective mass of 3 kg
    assert isinstance(punch.target, FreeMass)
    mass = punch.target.mass
    assert made == pytest.approx(2.0 * 3.0 * mass / (3.0 + mass))
    assert _against_target(punch, 6.0, np.concatenate([q, -v])) == 0.0


def test_what_it_does_not_know_is_told_before_anything_runs() -> None:
    nowhere = Path("/nowhere/python")
    with pytest.raises(InputError, match="stand on soles alone"):
        crocoddyl_plan(load_problem("arm_planar"), nowhere)
    with pytest.raises(InputError, match="one hand against a free mass"):
        crocoddyl_plan(load_problem("nailing"), nowhere)


def test_an_interpreter_without_it_is_told(punch: ImpactProblem) -> None:
    with pytest.raises(InputError, match="does not run crocoddyl"):
        crocoddyl_plan(punch, Path("/nowhere/python"))
    with pytest.raises(InputError, match="No module named 'crocoddyl'"):
        crocoddyl_plan(punch, Path(sys.executable))


def test_what_comes_back_is_read(punch: ImpactProblem, tmp_path: Path) -> None:
    """An interpreter that makes a plan of standing still."""
    nq, nv, n = punch.robot.nq, punch.robot.nv, punch.robot.n
    stand_in = tmp_path / "python"
    stand_in.write_text(
        f"""#!{sys.executable}
import sys, pathlib, numpy as np
there = pathlib.Path(sys.argv[3])
q0 = np.load(there / "task.npz")["q0"]
states = np.tile(np.concatenate([q0, np.zeros({nv})]), (7, 1))
np.savez(there / "plan.npz", states=states, torques=np.zeros((5, {n})), impulse=0.0, before=3, step=0.01,
         seconds=1.0, iterations=2, solved=True)
""",
        encoding="utf-8",
    )
    stand_in.chmod(0o755)
    found = crocoddyl_plan(punch, stand_in)
    assert (found.impulse, found.iterations, found.solved) == (0.0, 2, True)
    assert found.reference.q.shape == (7, nq)
    assert found.reference.end == pytest.approx(0.05)
