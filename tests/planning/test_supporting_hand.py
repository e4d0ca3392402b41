"""One hand holds on while the other strikes: plans, their collisions in full dynamics, and both replays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from impactopt import (
    BothSoles,
    FullDynamics,
    Grip,
    ImpactProblem,
    InputError,
    OneSole,
    Solution,
    coasting_reference,
    load_problem,
    load_robot,
    solve,
    write_problem,
)
from impactopt.codegen.compiler import find_compiler
from impactopt.files.problem_file import ProblemFile
from impactopt.kinematics.operational_space import static_wrenches

HAND = "striker:left_hand"
needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")


@pytest.fixture(scope="module")
def problem() -> ImpactProblem:
    return load_problem("strike_holding_on")


@pytest.fixture(scope="module")
def solution(problem: ImpactProblem) -> Solution:
    found = solve(problem)
    assert found.status.usable, found.result.message
    return found


def grip_of(problem: ImpactProblem) -> Grip:
    grip = problem.extra(Grip)
    assert grip is not None
    return grip


@pytest.mark.slow
@needs_compiler
def test_the_hand_stays_where_it_is(solution: Solution) -> None:
    """At every instant of the reference, by Pinocchio; and at rest, without a grip's force."""
    p, ref = solution.problem, solution.trajectory
    model = p.robot.model
    data, frame = model.createData(), model.getFrameId(HAND)
    pin.framesForwardKinematics(model, data, p.start_posture)
    held = data.oMf[frame].copy()
    for q, v, a in zip(ref.q[::25], ref.v[::25], ref.a[::25], strict=True):
        pin.forwardKinematics(model, data, q, v, a)
        pin.updateFramePlacements(model, data)
        assert np.abs(pin.log6(held.actInv(data.oMf[frame])).vector).max() < 1e-9
        assert np.abs(pin.getFrameVelocity(model, data, frame).vector).max() < 1e-9
        assert np.abs(pin.getFrameAcceleration(model, data, frame).vector).max() < 1e-8
    moves = np.ptp(ref.q[:, 7:], axis=0)
    waist = [p.robot.joint_index(name) for name in ("chest_yaw", "left_shoulder_pitch")]
    assert (moves[waist] > 0.05).all()  # the trunk turns while it holds on
    at_rest = static_wrenches(p.coordinates, *p.coordinates.split(p.start_posture))
    assert at_rest.shape == (18,) and not at_rest[12:].any() and at_rest[2] > 100


@needs_compiler
@pytest.mark.slow
def test_the_grip_bears_what_it_may_and_no_more(solution: Solution) -> None:
    """At nodes and in contact; it is used to its limit."""
    plan, grip = solution.plan, grip_of(solution.problem)
    most = np.repeat([grip.force, grip.moment], 3)
    used = [w[:, 12:] / most for w in (plan.swing_wrench, plan.follow_wrench, plan.collision.sole_wrench)]
    largest = max(float(np.abs(w).max()) for w in used)
    assert largest == pytest.approx(1.0, abs=1e-5)
    assert (plan.collision.sole_wrench[:, [2, 8]] > 0).all()  # soles press, as ever


@needs_compiler
@pytest.mark.slow
def test_motion_and_wrenches_balance_at_the_nodes(solution: Solution) -> None:
    """Inverse dynamics of the whole robot against J' w of soles and hand, by Pinocchio alone."""
    p, plan = solution.problem, solution.plan
    c, model = p.coordinates, p.robot.model
    data, legs = model.createData(), c.split(p.start_posture)[1]
    for s, w in list(zip(plan.swing_nodes, plan.swing_wrench, strict=True))[1::4]:
        y, yd, ydd = (x[0] for x in plan.swing.sample(s * plan.swing.duration))
        legs = c.solve_legs(y, legs)
        q, v, a = c.complete_motion(y, yd, ydd, legs)
        tau = np.array(pin.rnea(model, data, q, v, a))
        for k, frame in enumerate(c.frames):
            jac = pin.computeFrameJacobian(model, data, q, model.getFrameId(frame), pin.LOCAL)
            tau -= jac.T @ w[6 * k : 6 * k + 6]
        assert np.abs(tau[:6]).max() < 0.05  # [N, N m]
        assert (np.abs(tau[6:]) <= p.robot.torque_limit).all()


@pytest.mark.slow
@needs_compiler
def test_the_collision_is_that_of_full_dynamics(solution: Solution) -> None:
    """Impulse within 1 %, and so are the forces on soles and hand, of what both hold."""
    p, hit, ref = solution.problem, solution.plan.collision, solution.trajectory
    last = int(np.flatnonzero(ref.phase == 0)[-1])
    q, v, torque = ref.q[last], ref.v[last], ref.torque[last]
    bend = coasting_reference(p.coordinates, q, v, until=2 * hit.time[-1])
    names = ("robot", "striker", "normal", "law", "target", "stance")
    scene: dict[str, Any] = {name: getattr(p, name) for name in names}
    full = FullDynamics(**scene, step=1e-4).collide(q, v, torque, **bend)
    assert solution.impulse == pytest.approx(full.impulse, rel=5e-3)
    assert full.hand_wrench is not None and full.hand_wrench.shape[1] == 1
    turn = p.coordinates.hands[0].placement.rotation
    at = (hit.time[1:] > 0.002) & (hit.time[1:] < full.time[-1])
    planned = hit.sole_wrench[at, 12:15] @ turn.T
    found = np.array([np.interp(hit.time[1:][at], full.time, f) for f in full.hand_wrench[:, 0, :3].T]).T
    assert np.abs(planned - found).max() < 0.02 * grip_of(p).force
    # the same blow with the hand let go is another one
    let_go = {**scene, "stance": BothSoles()}
    free = FullDynamics(**let_go, step=1e-4).collide(q, v, torque, require_separation=False, **bend)
    assert abs(free.impulse / full.impulse - 1) > 0.01


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("engine", ["pinocchio", "mujoco"])
def test_it_is_true_in_both_engines(solution: Solution, engine: str) -> None:
    if engine == "mujoco":
        pytest.importorskip("mujoco")
    replay = solution.validate(engine=engine)
    p = solution.problem
    assert replay.impulse == pytest.approx(solution.impulse, rel=5e-3)
    assert replay.standing in (None, True) and not replay.touched
    assert replay.grip_force.max() < 1.05 * np.sqrt(3) * grip_of(p).force
    assert replay.grip_force.max() > 0.5 * grip_of(p).force
    assert replay.sole_ground.shape[1] == 2 and replay.slip.max() < 1e-3
    model = p.robot.model
    data, frame, places = model.createData(), model.getFrameId(HAND), []
    for q in replay.q[::20]:
        pin.framesForwardKinematics(model, data, q)
        places.append(data.oMf[frame].translation.copy())
    assert np.ptp(places, axis=0).max() < 1e-3
    told = replay.report(
        torque_limit=p.robot.torque_limit, polygon=solution.plan.polygon, planned_impulse=solution.impulse
    )
    assert told["grip_force_N"] == pytest.approx(replay.grip_force.max())
    if engine == "mujoco":
        led = solution.validate(engine="mujoco", controller="wbc")
        assert led.standing, led.fall
        assert led.impulse == pytest.approx(solution.impulse, rel=3e-2)


def test_a_file_says_which_hands_hold_on(problem: ImpactProblem) -> None:
    assert problem.describe()["holds_on_with"] == ["left_hand"]
    again = ProblemFile.parse(write_problem(problem), Path("problem.toml")).build()
    assert again.hash == problem.hash and again.stance.hand_frames(again.robot) == (HAND,)
    start = load_robot("standin").posture("on_left_foot")
    stance = OneSole("left", hands=("left_hand",))
    on_one = replace(problem, stance=stance, start=start, obstacles=())
    assert [leg.end for leg in on_one.coordinates.legs] == ["left sole", "left_hand grip"]
    assert on_one.hash != problem.hash


def test_what_cannot_hold_on_is_refused(problem: ImpactProblem) -> None:
    others = tuple(term for term in problem.terms if not isinstance(term, Grip))
    for changes, told in (
        ({"terms": others}, "give the limits of its grip"),
        ({"stance": BothSoles()}, "none does"),
        ({"striker": "left_hand"}, "cannot carry the striker"),
        ({"collision": "sdc"}, 'needs collision="full"'),
        ({"stance": BothSoles(hands=("left_toe",))}, "also move a fixed sole or another supporting hand"),
        ({"stance": BothSoles(hands=("left_hnd",))}, "left_hand"),
        ({"stance": BothSoles(hands=("left_hand",), base_mass=1e5, base_inertia=1e5)}, "exactly"),
    ):
        with pytest.raises(InputError, match=told):
            replace(problem, **changes)  # type: ignore[arg-type]
    short = load_robot("standin", locked=("left_wrist_yaw", "left_wrist_pitch"))
    with pytest.raises(InputError, match="of the last 6 joints before it, chest_yaw, chest_pitch"):
        replace(
            problem, robot=short, start="half_sitting", stance=BothSoles(hands=("left_hand", "right_hand"))
        )
