"""Two hands push one target at once: the plan, full dynamics of its collision, and both replays."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from impactopt import (
    Board,
    FreeMass,
    GearLoad,
    HitCone,
    HitRegion,
    ImpactProblem,
    InputError,
    PeakForce,
    SecondStriker,
    Solution,
    SpringDamper,
    load_problem,
    optimize_strike,
    solve,
    write_problem,
)
from impactopt.codegen.compiler import find_compiler
from impactopt.files.problem_file import ProblemFile
from impactopt.planning.parameter_changes import moved_problem
from impactopt.simulation.result import Scene
from impactopt.simulation.target_dynamics import TargetContact

Array = NDArray[np.float64]
needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
AXES = pin.LOCAL_WORLD_ALIGNED


@pytest.fixture(scope="module")
def problem() -> ImpactProblem:
    return load_problem("push_two_hands")


@pytest.fixture(scope="module")
def solution(problem: ImpactProblem) -> Solution:
    found = solve(problem)
    assert found.status.usable, found.result.message
    return found


def places(problem: ImpactProblem, q: Array) -> Array:
    """(2, 3) of the striking points."""
    model = problem.robot.model
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    return np.array([data.oMf[model.getFrameId(f"striker:{name}")].translation for name in problem.strikers])


@pytest.mark.slow
@needs_compiler
def test_both_hands_touch_and_part_at_one_instant(solution: Solution) -> None:
    p, ref, hit = solution.problem, solution.trajectory, solution.plan.collision
    assert p.second is not None
    last = int(np.flatnonzero(ref.phase == 0)[-1])
    points = np.array([p.point, p.second.point])
    assert np.abs(places(p, ref.q[last]) - points).max() < 1e-5
    before = np.array([places(p, q) for q in ref.q[:last:20]])
    assert ((points - before) @ p.normal > 0).all()
    assert hit.forces.shape == (len(hit.time), 2)
    assert (hit.forces[:-1] > 1.0).all() and np.abs(hit.forces[-1]).max() < 1e-6
    np.testing.assert_allclose(hit.forces.sum(axis=1), hit.force)


def test_a_moved_point_leaves_the_other_hand_at_its_own(problem: ImpactProblem) -> None:
    assert problem.second is not None
    moved = moved_problem(problem, point=problem.point + np.array([0.05, 0.0, 0.05]))
    points = [moved.point, problem.second.point]
    np.testing.assert_allclose(places(moved, moved.contact_posture), points, atol=1e-6)


@needs_compiler
@pytest.mark.slow
def test_the_target_has_the_momentum_of_both_forces(solution: Solution) -> None:
    """By the trapezoidal rule on elements half as long: within what that leaves."""
    hit = solution.contact_error.finer[0] if solution.contact_error else solution.plan.collision
    given = np.trapezoid(hit.forces, hit.time, axis=0)
    target = solution.problem.target
    assert isinstance(target, FreeMass)
    speed = solution.plan.collision.outcome["speed_m_s"]
    assert solution.impulse == pytest.approx(target.mass * speed, rel=1e-6)
    assert given.sum() == pytest.approx(solution.impulse, rel=0.01)
    assert given.min() > 0.3 * solution.impulse  # neither hand is idle


def blow(solution: Solution, step: float) -> tuple[Array, float]:
    """Impulses (2,) [N s] and duration [s] of the plan's blow in full dynamics, by Heun's method: H, J and
    bias anew at every stage, soles held by Lagrange's multipliers, the servo on the plan's reference.
    """
    p, ref = solution.problem, solution.trajectory
    assert p.second is not None and isinstance(p.target, FreeMass)
    robot, model = p.robot, p.robot.model
    data, base = model.createData(), model.nv - robot.n
    soles = [model.getFrameId(frame) for frame in p.coordinates.frames]
    hands = [model.getFrameId(f"striker:{name}") for name in p.strikers]
    points, mass = np.array([p.point, p.second.point]), p.target.mass
    keep = ref.phase == 1
    times = ref.time[keep] - ref.contact_start
    wanted = np.array([robot.joint_positions(q) for q in ref.q[keep]]), ref.v[keep][:, base:]
    ff = ref.torque[keep][0]

    def rates(t: float, q: Array, v: Array, x: float, speed: float) -> tuple[Array, Array]:
        pin.forwardKinematics(model, data, q, v, 0 * v)
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        held = np.vstack([pin.getFrameJacobian(model, data, k, AXES) for k in soles])
        drift = np.concatenate(
            [pin.getFrameClassicalAcceleration(model, data, k, AXES).vector for k in soles]
        )
        rows = np.array([p.normal @ pin.getFrameJacobian(model, data, k, AXES)[:3] for k in hands])
        deep = np.array(
            [p.normal @ (data.oMf[k].translation - at) for k, at in zip(hands, points, strict=True)]
        )
        force = np.array(
            [
                float(p.law.force(d, r)) if d >= 0 else 0.0
                for d, r in zip(deep - x, rows @ v - speed, strict=True)
            ]
        )
        at, fast = (np.array([np.interp(t, times, column) for column in w.T]) for w in wanted)
        tau = np.zeros(model.nv)
        tau[base:] = ff + robot.kp * (at - robot.joint_positions(q)) + robot.kd * (fast - v[base:])
        n, m = model.nv, len(held)
        upper = np.triu(pin.crba(model, data, q))
        inertia = upper + np.triu(upper, 1).T
        bias = pin.nonLinearEffects(model, data, q, v)
        matrix = np.block([[inertia, held.T], [held, np.zeros((m, m))]])
        found = np.linalg.solve(matrix, np.concatenate([tau - bias - force @ rows, -drift]))
        return found[:n], force

    first = int(np.flatnonzero(keep)[0])
    q, v, x, speed, t = ref.q[first].copy(), ref.v[first].copy(), 0.0, 0.0, 0.0
    impulses = np.zeros(2)
    while t < 0.2:
        a, force = rates(t, q, v, x, speed)
        if t > 5e-3 and not force.any():
            break
        after = (
            pin.integrate(model, q, step * v),
            v + step * a,
            x + step * speed,
            speed + step * force.sum() / mass,
        )
        b, other = rates(t + step, *after)
        q = pin.integrate(model, q, step * (v + after[1]) / 2)
        x, speed = x + step * (speed + after[3]) / 2, speed + step * (force + other).sum() / 2 / mass
        v, impulses, t = v + step * (a + b) / 2, impulses + step * (force + other) / 2, t + step
    return impulses, t


@pytest.mark.slow
def test_what_limits_the_other_hand_has_its_name(solution: Solution) -> None:
    binding = {each.row for each in solution.sensitivity("target.mass").binding}
    assert {"incidence, contact", "incidence, contact, left_hand"} <= binding


@needs_compiler
@pytest.mark.slow
def test_the_collision_is_that_of_full_dynamics(solution: Solution) -> None:
    impulses, duration = blow(solution, 2e-4)
    assert impulses.sum() == pytest.approx(solution.impulse, rel=0.01)
    hit = solution.contact_error.finer[0] if solution.contact_error else solution.plan.collision
    assert impulses == pytest.approx(np.trapezoid(hit.forces, hit.time, axis=0), rel=0.02)
    assert duration == pytest.approx(hit.time[-1], rel=0.03)


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("engine", ["pinocchio", "mujoco"])
def test_it_is_true_in_both_engines(solution: Solution, engine: str) -> None:
    if engine == "mujoco":
        pytest.importorskip("mujoco")
    replay = solution.validate(engine=engine)
    assert replay.impulse == pytest.approx(solution.impulse, rel=5e-3)
    assert replay.standing in (None, True) and not replay.touched
    assert replay.impulses.shape == (2,) and replay.impulses.sum() == pytest.approx(replay.impulse)
    assert replay.impulses.min() > 0.3 * replay.impulse
    p = solution.problem
    told = replay.report(
        torque_limit=p.robot.torque_limit, polygon=solution.plan.polygon, planned_impulse=solution.impulse
    )
    assert told["impulses_Ns"] == pytest.approx(replay.impulses.tolist())
    if engine == "mujoco":
        led = solution.validate(engine="mujoco", controller="wbc")
        assert led.standing, led.fall
        assert led.impulse == pytest.approx(solution.impulse, rel=3e-2)


@pytest.mark.slow
@needs_compiler
def test_the_blow_alone_has_both_hands(problem: ImpactProblem) -> None:
    strike = optimize_strike(problem)
    assert strike.status.usable
    assert strike.strike.collision.forces.shape[1] == 2
    assert problem.second is not None
    points = np.array([problem.point, problem.second.point])
    assert np.abs(places(problem, strike.strike.posture) - points).max() < 1e-5


def scene(mass: float, *, second: bool) -> TargetContact:
    return TargetContact(
        Scene(
            point=np.zeros(3),
            normal=np.array([1.0, 0.0, 0.0]),
            law=SpringDamper(stiffness=1e4, damping=30.0),
            target=FreeMass(mass=mass),
            striker="right",
            soles=(),
            corners=(),
            polygon=np.zeros((0, 2)),
            second=("left", np.array([0.0, 0.4, 0.0])) if second else None,
        )
    )


def test_two_alike_are_one_on_half_the_target() -> None:
    """Hands that do not feel each other; and one that is away leaves the other alone."""
    both, one, step = scene(2.0, second=True), scene(1.0, second=False), 2e-3
    speed, depth, gain, yields = 1.5, 1e-3, -3.0, 0.4
    two = both.pushed(
        np.full(2, depth), np.full(2, speed), np.full(2, gain), yields * np.eye(2), np.array([0.2]), 0.1, step
    )
    half = one.pushed(
        np.array([depth]),
        np.array([speed]),
        np.array([gain]),
        np.array([[yields]]),
        np.array([0.2]),
        0.1,
        step,
    )
    assert two.forces == pytest.approx(np.repeat(half.forces, 2), rel=1e-5)
    assert two.total.max() == pytest.approx(2 * half.total.max(), rel=1e-4)
    assert two.given[-1] == pytest.approx(two.forces.sum() * step)
    assert two.state == pytest.approx(half.state, rel=1e-5) and two.travel == pytest.approx(half.travel)
    away = both.pushed(
        np.array([depth, -np.inf]),
        np.full(2, speed),
        np.full(2, gain),
        yields * np.eye(2),
        np.zeros(1),
        0.0,
        step,
    )
    alone = scene(2.0, second=False).pushed(
        np.array([depth]), np.array([speed]), np.array([gain]), np.array([[yields]]), np.zeros(1), 0.0, step
    )
    assert away.forces == pytest.approx([alone.forces[0], 0.0], rel=1e-5) and np.isneginf(away.depths[1])
    at = both.depths(np.array([[0.01, 0.0, 0.0], [0.02, 0.4, 0.0]]), 0.005)
    assert at == pytest.approx([0.005, 0.015])


def test_a_file_has_the_second_striker(problem: ImpactProblem) -> None:
    again = ProblemFile.parse(write_problem(problem), Path("problem.toml")).build()
    assert again.hash == problem.hash and again.strikers == ("right_hand", "left_hand")
    assert replace(problem, second=None).hash != problem.hash
    assert problem.describe()["second"]["striker"] == "left_hand"
    assert problem.middle == pytest.approx([0.5, 0.0, 1.0])


def test_terms_that_are_off_are_allowed_with_two(problem: ImpactProblem) -> None:
    off = GearLoad(enabled=False)
    assert off in replace(problem, terms=(*problem.terms, off)).terms


class OfOne(HitRegion):
    """A user's own term."""


def test_what_two_cannot_do_is_refused(problem: ImpactProblem) -> None:
    second = problem.second
    assert second is not None
    for changes, told in (
        ({"collision": "sdc"}, 'collision="full"'),
        ({"target": Board(mass=1.0, stiffness=1e4, breaking_force=100.0)}, "FreeMass or a RigidWall"),
        ({"terms": (*problem.terms, HitCone(angle=0.1))}, r"\[terms.hit_cone\], is for one striker"),
        ({"objectives": (PeakForce(weight=-1.0),)}, r"\[objectives.peak_force\], is for one striker"),
        ({"terms": (*problem.terms, OfOne(radius=0.1))}, r"^OfOne is for one striker"),  # which no file has
        ({"second": SecondStriker(striker="right_hand", point=second.point)}, "limb of its own"),
        ({"second": SecondStriker(striker="left_hnd", point=second.point)}, "left_hand"),
        ({"second": SecondStriker(striker="left_hand", point=np.array([0.5, 3.0, 1.0]))}, "out of reach"),
        ({"second": "left_hand"}, "must be a SecondStriker"),
    ):
        with pytest.raises(InputError, match=told):
            replace(problem, **changes)  # type: ignore[arg-type]
    far = SecondStriker(striker="left_hand", point=np.array([2.0, 0.2, 1.0]))
    # the first point is in reach: that alone would be the wrong one to move
    with pytest.raises(InputError, match=r"the striking points at \[.*\] m and \[.*\] m \(they start at"):
        replace(problem, second=far)
    with pytest.raises(InputError, match="point"):
        SecondStriker(striker="left_hand", point=np.array([0.5, np.nan, 1.0]))
    held: dict[str, Any] = {"hands": ("left_hand",)}
    with pytest.raises(InputError, match="holds on"):
        replace(problem, stance=replace(problem.stance, **held))


@pytest.mark.slow
def test_an_export_has_both_strikers_and_where_they_hit(
    problem: ImpactProblem, solution: Solution, tmp_path: Path
) -> None:
    meta = json.loads(solution.export("csv", tmp_path / "csv")[0].read_text("utf-8"))
    model, reference = problem.robot.model, solution.trajectory
    data, at_contact = model.createData(), np.flatnonzero(reference.phase == 0)[-1]
    pin.framesForwardKinematics(model, data, reference.q[at_contact])
    hit = meta["target"]["point_m"], meta["second"]["target_point_m"]
    for striker, point in zip((meta["striker"], meta["second"]["striker"]), hit, strict=True):
        link = data.oMf[model.getFrameId(striker["link"])]
        np.testing.assert_allclose(link.act(np.array(striker["point_m"])), point, atol=1e-4)
