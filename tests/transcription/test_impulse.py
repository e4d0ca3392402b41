"""Impacts without duration, which plans can be compared with: impulse balance, restitution, plans."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from support.small_plans import LAW, Planned, changed, planned, solution_of

from impactopt import (
    FreeMass,
    ImpactProblem,
    KelvinVoigt,
    Plan,
    Status,
    TorqueLimit,
    load_problem,
    load_record,
    solve,
)
from impactopt.files.output import record_of, save_record
from impactopt.report.console import result_table
from impactopt.report.pictures import PICTURES, save_pictures
from impactopt.solvers.ipopt import solve_ipopt
from impactopt.transcription.contact_blocks import impact, two_mass_restitution
from impactopt.transcription.initial_guess import first_iterate
from impactopt.transcription.transcription import Transcription

Array = NDArray[np.float64]
RESTITUTION = 0.3
ARM = Path(__file__).resolve().parents[2] / "problems" / "arm_planar.toml"
KINDS: dict[str, dict[str, Any]] = {
    "rigid": {"collision": "rigid", "coefficient_of_restitution": RESTITUTION},
    "virtual-mass": {"collision": "virtual-mass"},
}


def jacobians(problem: ImpactProblem, q: Array) -> tuple[Array, Array, Array]:
    """By Pinocchio: inertia (nv, nv), striking point along the normal (nv,), fixed soles (6 a sole, nv)."""
    model = problem.robot.model
    data = model.createData()
    inertia = pin.crba(model, data, q)
    inertia = np.triu(inertia) + np.triu(inertia, 1).T
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)

    def jac(name: str) -> Array:
        return np.asarray(
            pin.getFrameJacobian(model, data, model.getFrameId(name), pin.LOCAL_WORLD_ALIGNED), dtype=float
        )

    row = problem.normal @ jac(f"striker:{problem.striker}")[:3]
    soles = [jac(leg.sole.frame) for leg in problem.coordinates.legs]
    return inertia, row, np.vstack([np.zeros((0, model.nv)), *soles])


def unit_impulse(problem: ImpactProblem, q: Array) -> tuple[Array, Array, float]:
    """1 N s on the hand, joints without torque: change of v, impulses on the soles, effective mass."""
    inertia, row, soles = jacobians(problem, q)
    k = len(soles)
    system = np.block([[inertia, -soles.T], [soles, np.zeros((k, k))]])
    found = np.linalg.solve(system, np.concatenate([-row, np.zeros(k)]))
    dv, wrench = found[: len(row)], found[len(row) :]
    return dv, wrench, float(-1 / (row @ dv))


def two_masses(stiffness: float, damping: float, first: float, second: float, speed: float) -> float:
    """Impulse [N s] of a mass that hits another at rest, by integration; damped while they approach."""
    mu = first * second / (first + second)

    def rates(t: float, z: Array) -> list[float]:
        return [z[1], -(stiffness * z[0] + (damping * z[1] if z[1] > 0 else 0.0)) / mu]

    def turns(t: float, z: Array) -> float:
        return float(z[1])

    def parts(t: float, z: Array) -> float:
        return float(z[0]) if t > 0 else 1.0

    turns.terminal, turns.direction = True, -1.0  # type: ignore[attr-defined]
    parts.terminal, parts.direction = True, -1.0  # type: ignore[attr-defined]
    long = 20 * max(np.sqrt(mu / stiffness), damping / stiffness)
    settings: dict[str, Any] = {"rtol": 1e-10, "atol": 1e-14}
    closed = solve_ivp(rates, (0, long), [0.0, speed], events=turns, **settings)
    assert closed.status == 1
    apart = solve_ivp(rates, (0, long), [closed.y[0, -1], -1e-12], events=parts, **settings)
    assert apart.status == 1
    return float(mu * (speed - apart.y[1, -1]))


# ---- restitution


def restitution(ratio: Any) -> Any:
    x = ca.SX.sym("x")
    return np.asarray(ca.Function("e", [x], [two_mass_restitution(x)]).map(np.size(ratio))(ratio)).ravel()


@pytest.mark.parametrize("ratio", [0.0, 0.05, 0.3, 0.7, 0.985, 0.995, 1.0, 1.005, 1.02, 1.5, 3.0])
def test_restitution_of_two_masses_is_that_of_the_integrated_collision(ratio: float) -> None:
    first, second, stiffness, speed = 4.0, 3.0, 1e4, 2.0
    mu = first * second / (first + second)
    damping = ratio * 2 * np.sqrt(stiffness * mu)
    e = two_masses(stiffness, damping, first, second, speed) / (mu * speed) - 1
    assert restitution(ratio)[0] == pytest.approx(e, abs=1e-7)


def test_restitution_falls_from_one_smoothly() -> None:
    ratio = np.linspace(0, 3, 601)
    e = restitution(ratio)
    assert e[0] == 1.0
    assert (np.diff(e) < 0).all() and (e > 0).all()
    x = ca.SX.sym("x")
    value = two_mass_restitution(x)
    slope = ca.gradient(value, x)
    both = ca.Function("d", [x], [slope, ca.gradient(slope, x)])
    for at in (*ratio, *np.linspace(0.985, 1.015, 61)):
        assert np.isfinite(np.array(both(at))).all()
    # across the two seams of the series
    h = 1e-4
    for seam in (0.99, 1.01):
        left, right = restitution([seam - 1e-12, seam + 1e-12])
        assert left == pytest.approx(right, abs=1e-9)
        differences = np.diff(restitution(seam + h * np.array([-1.5, -0.5, 0.5, 1.5]))) / h
        assert float(both(seam + h)[0]) == pytest.approx(differences[2], abs=1e-4)
        assert float(both(seam - h)[0]) == pytest.approx(differences[0], abs=1e-4)
        assert np.ptp(differences) < 1e-3


# ---- the block


@pytest.mark.parametrize("who", ["biped", "arm"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_block_is_the_impulse_balance(request: pytest.FixtureRequest, who: str, kind: str) -> None:
    """At random states Pinocchio's impulse makes all its rows zero, and another does not."""
    t: Transcription = request.getfixturevalue(f"{who}_transcription")
    problem, c, rng = t.problem, t.coordinates, np.random.default_rng(5)
    robot, n, expression = problem.robot, problem.robot.n, impact(c, problem.striker)
    block = ca.Function("impact", [expression.z, expression.p], [expression.out])
    given, mass = 0.6, problem.target.mass
    law = [LAW.stiffness, LAW.damping]
    units = t.builder.limits.units
    p = [*problem.normal, float(kind == "rigid"), given, *law, 1 / mass, 0.0, *robot.torque_limit, *units]
    for _ in range(5):
        y = t.y0 + 0.1 * rng.standard_normal(c.ny)
        y[: c.base] = t.y0[: c.base] + np.array([0, 0, -0.05, 0, 0, 0])[: c.base]  # where the legs reach
        y[: c.base] += 0.02 * rng.standard_normal(c.base)
        u0 = rng.standard_normal(c.ny)
        legs = c.solve_legs(y, t.legs0)
        q, v, _ = c.complete_motion(y, u0, np.zeros(c.ny), legs)
        dv, wrench, own = unit_impulse(problem, q)
        row = jacobians(problem, q)[1]
        mu = own * mass / (own + mass)
        speed = float(row @ v)
        ratio = LAW.damping / (2 * np.sqrt(LAW.stiffness * mu))
        e = given if kind == "rigid" else restitution(ratio)[0]
        blow = (1 + e) * mu * speed
        # rates of the independent coordinates whose velocities are the change: N(y) is linear
        columns = np.array([c.complete_motion(y, unit, np.zeros(c.ny), legs)[1] for unit in np.eye(c.ny)]).T
        du = np.linalg.lstsq(columns, blow * dv, rcond=None)[0]
        np.testing.assert_allclose(columns @ du, blow * dv, atol=1e-8)
        z = np.concatenate([y, legs, u0, du, blow * in_soles_axes(problem, q, wrench), [blow]])
        rows = np.asarray(block(z, p)).ravel()
        assert len(rows) == c.base + n + 1
        np.testing.assert_allclose(rows, 0, atol=1e-8)
        z[-1] *= 1.01
        wrong = np.abs(np.asarray(block(z, p)).ravel())
        assert wrong[:-1].max() > 1e-5 and wrong[-1] > 1e-4


@pytest.mark.parametrize("kind", KINDS)
def test_the_block_is_finite_where_an_iterate_speeds_the_hand_up(
    arm_transcription: Transcription, kind: str
) -> None:
    """On a wall the law's root was of a number below zero: nan, with a given restitution, too."""
    t, rng = arm_transcription, np.random.default_rng(6)
    problem, c = t.problem, t.coordinates
    expression, given = impact(c, problem.striker), 0.6
    slopes = ca.jacobian(expression.out, expression.z)
    block = ca.Function("impact", [expression.z, expression.p], [expression.out, slopes])
    law, wall = [LAW.stiffness, LAW.damping], 0.0
    p = [*problem.normal, float(kind == "rigid"), given, *law, wall, 0.0]
    p += [*problem.robot.torque_limit, *t.builder.limits.units]
    u0 = rng.standard_normal(c.ny)
    q = c.complete_motion(t.y0, u0, np.zeros(c.ny), t.legs0)[0]
    row = jacobians(problem, q)[1]
    du = row / (row @ row)  # the hand gets faster by 1 m/s
    out, derivatives = map(np.asarray, block(np.concatenate([t.y0, u0, du, [2.0]]), p))
    assert np.isfinite(out).all() and np.isfinite(derivatives).all()
    if kind == "rigid":
        assert out[-1, 0] == pytest.approx(-1.0 - (1 + given) * (row @ u0))


def in_soles_axes(problem: ImpactProblem, q: Array, wrench: Array) -> Array:
    """Wrenches at the soles' origins (6 a sole) from the world's axes to each sole's."""
    model = problem.robot.model
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    out = wrench.copy()
    for k, leg in enumerate(problem.coordinates.legs):
        turn = data.oMf[model.getFrameId(leg.sole.frame)].rotation.T
        for part in (slice(6 * k, 6 * k + 3), slice(6 * k + 3, 6 * k + 6)):
            out[part] = turn @ wrench[part]
    return out


# ---- plans


@pytest.fixture(scope="module", params=[("arm", "rigid"), ("arm", "virtual-mass"), ("biped", "virtual-mass")])
def solved(request: pytest.FixtureRequest) -> Planned:
    who, kind = request.param
    transcription = changed(request.getfixturevalue(f"{who}_transcription"), **KINDS[kind])
    return planned(transcription)


def contact_state(plan: Plan) -> tuple[Array, Array, Array]:
    """q, v before and v after the impact, of the plan's own splines."""
    c = plan.coordinates
    legs = c.split(plan.problem.contact_posture)[1]
    y, before, _ = plan.swing.sample([plan.swing.duration])
    start, after, _ = plan.follow.sample([0.0])
    np.testing.assert_allclose(start, y, atol=1e-6)
    legs = c.solve_legs(y[0], legs)
    zero = np.zeros(c.ny)
    q, v, _ = c.complete_motion(y[0], before[0], zero, legs)
    return q, v, c.complete_motion(y[0], after[0], zero, legs)[1]


@pytest.mark.slow
def test_the_planned_impulse_is_that_of_the_effective_mass(solved: Planned) -> None:
    problem, plan = solved.problem, solved.plan
    assert solved.result.status is Status.SOLVED
    q, v, after = contact_state(plan)
    dv, _, own = unit_impulse(problem, q)
    mass, speed = problem.target.mass, plan.hand_speed
    if problem.collision == "rigid":
        expected = (1 + RESTITUTION) * own * mass / (own + mass) * speed
    else:
        expected = two_masses(LAW.stiffness, LAW.damping, own, mass, speed)
    assert plan.impulse == pytest.approx(expected, rel=1e-4)
    assert plan.impulse == pytest.approx(mass * plan.collision.target_speed[-1], rel=1e-12)
    np.testing.assert_allclose(after - v, plan.impulse * dv, atol=1e-4 * np.abs(v).max())


def test_its_trajectory_has_no_time_of_contact(solved: Planned) -> None:
    plan, t = solved.plan, solved.trajectory
    assert plan.contact_start == plan.contact_end == t.contact_start == t.contact_end
    assert plan.duration == pytest.approx(plan.swing.duration + plan.follow.duration)
    for part in dataclasses.fields(t):
        assert np.isfinite(getattr(t, part.name)).all()
    np.testing.assert_array_equal(t.time[t.phase == 1], plan.contact_start)
    ends = [t.q[t.phase == 0][-1], *t.q[t.phase == 1], t.q[t.phase == 2][0]]
    for q in ends:
        np.testing.assert_allclose(q, ends[0], atol=1e-6)


def test_it_says_nothing_of_the_collision_that_it_does_not_know(solved: Planned) -> None:
    margins = solved.plan.margins()
    for numbers in margins.values():
        assert numbers.keys() == {"swing", "follow"}
    assert solved.plan.scenarios == ()


@pytest.mark.slow
def test_it_is_kept_shown_and_drawn(solved: Planned, tmp_path: Path) -> None:
    solution = solution_of(solved)
    for simulation in (None, solved.simulation):
        folder = tmp_path / ("planned" if simulation is None else "simulated")
        save_record(record_of(solution, simulation=simulation), folder)
        record = load_record(folder)
        assert record.summary["contact_ms"] == 0.0
        assert record.summary["peak_force_N"] is None
        assert record.summary["problem"]["collision"].startswith(solved.problem.collision)
        assert result_table(record.summary).row_count > 4
        # drawing is slow: one plan's pictures are without its replay
        if (simulation is None) != (solved.problem.collision == "rigid"):
            continue
        names = {path.stem for path in save_pictures(record, folder)}
        assert names == set(PICTURES) - {"replay"} - ({"zmp"} if not len(solved.plan.polygon) else set())


def test_a_higher_restitution_gives_more(arm_transcription: Transcription) -> None:
    impulses = []
    for e in (0.0, 1.0):
        t = changed(arm_transcription, collision="rigid", coefficient_of_restitution=e)
        result = solve_ipopt(t.program, first_iterate(t))
        assert result.status is Status.SOLVED
        impulses.append(t.decode(result.x).impulse)
    assert impulses[1] > 1.5 * impulses[0]


def test_torque_limits_of_the_collision_mean_nothing_to_it(arm_transcription: Transcription) -> None:
    """Nor does the servo: only what the swing can reach counts."""
    found = []
    for collision in (0.85, 0.2):
        t = changed(arm_transcription, collision="rigid", terms=(TorqueLimit(collision=collision),))
        found.append(solve_ipopt(t.program, first_iterate(t)).objective)
    assert found[0] == pytest.approx(found[1], rel=1e-9)


def test_a_target_of_a_tenth_of_a_gram_has_its_impulse() -> None:
    """Its impulse was bounded by 1e-3 N s, more than the hand can give it."""
    problem = load_problem(ARM)
    light = dataclasses.replace(
        problem, target=FreeMass(mass=1e-4), law=KelvinVoigt(stiffness=100.0, damping=0.0), **KINDS["rigid"]
    )
    found = solve(light)
    assert found.status is Status.SOLVED
    # of the arm, whose effective mass is ten thousand times as large, it takes no speed
    assert found.impulse / 1e-4 == pytest.approx((1 + RESTITUTION) * found.plan.hand_speed, rel=1e-3)
