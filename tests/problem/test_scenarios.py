"""Scenarios: other targets that the same swing has to survive, as the plan foresees them and as they come."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from support.small_plans import LAW, Planned, changed, planned, solution_of

from impactopt import (
    Balance,
    ContactWrenchCone,
    FreeMass,
    Scenario,
    SpringDamper,
    Status,
    TorqueLimit,
)
from impactopt.kinematics.stance import margin, zmp
from impactopt.simulation import scene_of
from impactopt.solvers.ipopt import solve_ipopt
from impactopt.transcription import contact_conditions as nlp
from impactopt.transcription.initial_guess import first_iterate
from impactopt.transcription.plan import PlannedCollision, PlannedScenario
from impactopt.transcription.transcription import Transcription

Array = NDArray[np.float64]
EXPECTED = Scenario(name="as expected", torque=0.85, cone_margin=0.02, capture_margin=0.02)
HEAVY = Scenario(name="heavy", mass=1.4, capture_margin=0.01)
MISSING = Scenario(name="missing", missing=True, capture_margin=0.03)
HARD = Scenario(name="hard", stiffness=2.0, damping=0.5)


def comes(transcription: Transcription, scenario: Scenario) -> Planned:
    """The plan, and the simulation of the scenario in full dynamics."""
    scene = scene_of(transcription.problem)
    law, target = scene.law, scene.target
    assert isinstance(law, SpringDamper) and isinstance(target, FreeMass)
    scene = dataclasses.replace(
        scene,
        law=SpringDamper(
            stiffness=scenario.stiffness * law.stiffness, damping=scenario.damping * law.damping
        ),
        target=FreeMass(mass=scenario.mass * target.mass),
    )
    return planned(transcription, scene)


@pytest.fixture(scope="module")
def biped(biped_transcription: Transcription) -> Planned:
    return comes(changed(biped_transcription, scenarios=(EXPECTED, HEAVY, MISSING)), HEAVY)


@pytest.fixture(scope="module")
def arm(arm_transcription: Transcription) -> Planned:
    return comes(changed(arm_transcription, scenarios=(HEAVY, HARD, EXPECTED)), HARD)


@pytest.fixture(params=["biped", "arm"])
def solved(request: pytest.FixtureRequest) -> Planned:
    return request.getfixturevalue(request.param)


def foreseen(solved: Planned, name: str) -> PlannedScenario:
    (found,) = [s for s in solved.plan.scenarios if s.name == name]
    return found


def balance(solved: Planned, q: Array, v: Array) -> tuple[float, float, float]:
    """By Pinocchio: capture point's margin [m], vertical speed [m/s], largest angular momentum [N m s]."""
    model = solved.problem.robot.model
    data = model.createData()
    momentum = pin.computeCentroidalMomentum(model, data, q, v)
    velocity = momentum.linear / pin.computeTotalMass(model)
    com = pin.centerOfMass(model, data, q)
    capture = com[:2] + velocity[:2] * np.sqrt(com[2] / 9.81)
    inside = float(margin(solved.plan.polygon, capture[None]).min())
    return inside, float(velocity[2]), float(np.abs(momentum.angular).max())


@pytest.mark.slow
def test_it_solves_and_each_target_that_is_hit_is_foreseen(solved: Planned) -> None:
    assert solved.result.status is Status.SOLVED
    wanted = [s.name for s in solved.problem.scenarios if not s.missing]
    assert [s.name for s in solved.plan.scenarios] == wanted


@pytest.mark.slow
def test_a_scenario_that_is_as_expected_is_the_expected_collision(solved: Planned) -> None:
    plan, same = solved.plan, foreseen(solved, EXPECTED.name)
    assert same.impulse == pytest.approx(plan.impulse, rel=1e-6)
    for field in ("time", "force", "target_speed", "torque"):
        ours, theirs = getattr(plan.collision, field), getattr(same.collision, field)
        np.testing.assert_allclose(theirs, ours, rtol=1e-5, atol=1e-6 * np.abs(ours).max())


@pytest.mark.parametrize(("who", "scenario"), [("biped", HEAVY), ("arm", HARD)], ids=["heavy", "hard"])
def test_a_scenario_comes_as_foreseen(request: pytest.FixtureRequest, who: str, scenario: Scenario) -> None:
    solved: Planned = request.getfixturevalue(who)
    plan, sim = foreseen(solved, scenario.name), solved.simulation
    hit = plan.collision
    assert plan.impulse == pytest.approx(sim.impulse, rel=0.01)
    assert abs(plan.impulse / solved.plan.impulse - 1) > 0.03, "it would pass for the expected target too"
    assert hit.force.max() == pytest.approx(sim.peak_force, rel=0.01)
    assert hit.time[-1] == pytest.approx(sim.contact_end - sim.contact_start, rel=0.03)
    assert hit.force[0] == pytest.approx(scenario.damping * LAW.damping * solved.plan.hand_speed)
    # torque and ZMP at the plan's collocation points; torque once the servo's fast start is over
    during, since = sim.phase() == 1, sim.time - sim.contact_start
    limit = solved.problem.robot.torque_limit
    for j, planned_torque in enumerate(hit.torque.T):
        found = np.interp(hit.time, since[during], sim.demand[during, j])
        np.testing.assert_allclose(found[4:-1] / limit[j], planned_torque[4:-1] / limit[j], atol=0.01)
    for planned_zmp, found in zip(zmp(hit.ground).T, sim.zmp().T, strict=True) if who == "biped" else ():
        there = np.interp(hit.time[1:-1], since[during], found[during])
        np.testing.assert_allclose(there, planned_zmp[:-1], atol=0.01)


def test_a_scenario_keeps_limits_of_its_own(solved: Planned) -> None:
    problem = solved.problem
    for scenario in (s for s in problem.scenarios if not s.missing):
        hit = foreseen(solved, scenario.name).collision
        assert np.abs(hit.torque[1:] / problem.robot.torque_limit).max() <= scenario.torque + 1e-5
        if problem.coordinates.legs:
            inside = margin(solved.plan.polygon, zmp(hit.ground)).min()
            assert inside >= scenario.cone_margin - 1e-4  # more, as both soles' edges are in the polygon


def test_a_scenario_costs_impulse(biped: Planned, biped_plan: Planned) -> None:
    assert biped.plan.impulse < biped_plan.plan.impulse - 0.01


def test_the_robot_keeps_its_balance_after_a_scenario(biped: Planned) -> None:
    t, x = biped.transcription, biped.result.x
    limit, c = biped.problem.term(Balance), biped.problem.coordinates
    assert [s.scenario for s in t.hit.scenarios] == [EXPECTED, HEAVY]
    for other in t.hit.scenarios:
        assert other.scenario is not None
        y, rate = other.after.read(x)[0], other.u.read(x)[other.end[1]]
        legs = c.solve_legs(y, other.legs.read(x)[other.end[1]])
        np.testing.assert_allclose(legs, other.legs.read(x)[other.end[1]], atol=1e-4)
        q, v, _ = c.complete_motion(y, rate, np.zeros(c.ny), legs)
        inside, vertical, angular = balance(biped, q, v)
        assert inside >= other.scenario.capture_margin - 1e-4
        assert abs(vertical) <= limit.vertical_speed + 1e-4
        assert angular <= limit.angular_momentum + 1e-3


def test_the_state_after_a_scenario_is_where_its_collision_ends(biped: Planned) -> None:
    sim, t, c = biped.simulation, biped.transcription, biped.problem.coordinates
    (other,) = [s for s in t.hit.scenarios if s.scenario is HEAVY]
    end = sim.contact_start + foreseen(biped, HEAVY.name).collision.time[-1]
    near = np.flatnonzero(np.abs(sim.time - end) < 5e-3)
    y = np.array([c.split(sim.q[k])[0] for k in near])
    found = [np.interp(end, sim.time[near], each) for each in y.T]
    moved = np.abs(other.after.read(biped.result.x)[0] - t.contact_state[0].evaluate(biped.result.x))
    error = np.abs(found - other.after.read(biped.result.x)[0])
    assert error.max() < 0.03 * moved.max()


def test_a_missing_target_finds_the_robot_balanced_at_contact(biped: Planned, biped_plan: Planned) -> None:
    limit = biped.problem.term(Balance)

    def at_contact(solved: Planned) -> tuple[float, float, float]:
        k = int(np.flatnonzero(solved.trajectory.phase == 0)[-1])
        return balance(solved, solved.trajectory.q[k], solved.trajectory.v[k])

    inside, vertical, angular = at_contact(biped)
    assert inside >= MISSING.capture_margin - 1e-4
    assert abs(vertical) <= limit.vertical_speed + 1e-4
    assert angular <= limit.angular_momentum + 1e-3


def test_only_a_missing_target_asks_for_balance_at_contact(biped_transcription: Transcription) -> None:
    def rows(scenarios: tuple[Scenario, ...]) -> set[str]:
        program = changed(biped_transcription, scenarios=scenarios).program
        return {program.constraint_name(i) for i in range(program.m)}

    added = rows((MISSING,)) - rows(())
    kinds = {row.split(", contact, if missing")[0] for row in added}
    assert kinds == {"capture point", "vertical speed", "angular momentum"}
    assert not any("if missing" in row for row in rows((HEAVY,)))


def test_rows_of_a_scenario_say_so(biped: Planned) -> None:
    program = biped.transcription.program
    rows = [program.constraint_name(i) for i in range(program.m)]
    for term in (TorqueLimit.name, ContactWrenchCone.name, "capture point", "end of compression"):
        assert any(row.startswith(term) and "if heavy" in row for row in rows)
    assert any(program.variable_name(j).startswith("heavy: contact force") for j in range(program.n))


# ---- what a problem and its results say of them


def test_the_summary_has_the_scenarios(biped: Planned) -> None:
    solution = solution_of(biped)
    summary = json.loads(json.dumps(solution.summary()))
    assert [s["name"] for s in summary["scenarios"]] == ["as expected", "heavy"]
    same, heavy = summary["scenarios"]
    for key in ("impulse_Ns", "peak_force_N", "contact_ms"):
        assert same[key] == pytest.approx(summary[key], rel=1e-5)
    assert same["torque_ratio"] == pytest.approx(summary["torque_ratio"]["collision"], rel=1e-5)
    assert same["zmp_margin_m"] == pytest.approx(summary["zmp_margin_m"]["collision"], abs=1e-6)
    assert heavy["contact_ms"] > same["contact_ms"]
    assert summary["problem"]["scenarios"] == [
        "as expected: as expected",
        "heavy: 1.4 x mass",
        "missing: no target",
    ]


def test_a_robot_without_soles_has_no_zmp_margin() -> None:
    nothing = np.zeros((2, 0))
    hit = PlannedCollision(
        time=np.array([0.0, 0.01, 0.02]),
        force=np.array([3.0, 5.0, 0.0]),
        target_speed=np.array([0.0, 0.5, 1.0]),
        outcome={"speed_m_s": 1.0},
        torque=np.array([[1.0, -8.0], [2.0, 4.0], [0.0, 0.0]]),
        ground=np.zeros((2, 6)),
        sole_wrench=nothing,
    )
    given = PlannedScenario(name="light", impulse=2.0, collision=hit)
    assert given.summary(torque_limit=np.array([10.0, 16.0]), polygon=np.zeros((0, 2))) == {
        "name": "light",
        "impulse_Ns": 2.0,
        "target": {"speed_m_s": 1.0},
        "peak_force_N": 5.0,
        "contact_ms": pytest.approx(20.0),
        "torque_ratio": pytest.approx(0.5),
    }


# ---- balance that is not asked for


@pytest.mark.parametrize(
    ("term", "left"),
    [
        (Balance(), {"capture point", "vertical speed", "angular momentum"}),
        (Balance(capture_margin=None), {"vertical speed", "angular momentum"}),
        (Balance(vertical_speed=np.inf), {"capture point", "angular momentum"}),
        (Balance(angular_momentum=np.inf), {"capture point", "vertical speed"}),
        (Balance(capture_margin=None, vertical_speed=np.inf, angular_momentum=np.inf), set()),
    ],
    ids=["all", "anywhere", "any vertical speed", "any angular momentum", "none"],
)
def test_balance_has_the_rows_that_it_asks_for(
    biped_transcription: Transcription, term: Balance, left: set[str]
) -> None:
    program = changed(biped_transcription, terms=(term,)).program
    names = {program.constraint_name(i).split(",")[0] for i in range(program.m)}
    assert names & {"capture point", "vertical speed", "angular momentum"} == left
    x = first_iterate(biped_transcription)
    assert np.isfinite(program.constraints(x)).all()
    assert np.isfinite(program.hessian(x, 1.0, np.ones(program.m)).data).all()


# ---- clearance


def swing_gaps(t: Transcription, x: Array) -> dict[float, float]:
    """How far [m] behind the target the striking point is at the swing's nodes, by Pinocchio."""
    p, c = t.problem, t.coordinates
    plan = t.decode(x)
    model = p.robot.model
    data = model.createData()
    frame = model.getFrameId(f"striker:{p.striker}")
    out, legs = {}, t.legs0
    for s in t.swing_nodes[:-1]:
        y = plan.swing.sample([s * plan.swing.duration])[0][0]
        legs = c.solve_legs(y, legs)
        pin.framesForwardKinematics(model, data, c.join(y, legs))
        out[float(s)] = float(p.normal @ (p.point - data.oMf[frame].translation))
    return out


LEISURE = 1.5  # [s] for a way of centimetres


def hovering(t: Transcription, *, gap: float) -> tuple[Transcription, Array]:
    """A hand that starts near the target, with time to spare; winding up is dear, so it does not go back."""
    c = t.coordinates
    data = c.model.createData()
    pin.framesForwardKinematics(c.model, data, t.problem.start_posture)
    start = data.oMf[c.model.getFrameId(f"striker:{t.problem.striker}")].translation
    swing = dataclasses.replace(t.problem.swing, duration=LEISURE)
    near = changed(t, point=start + gap * t.problem.normal, swing=swing, smoothness=10.0)
    result = solve_ipopt(near.program, first_iterate(near))
    assert result.status is Status.SOLVED
    return near, result.x


def test_the_hand_keeps_clear_of_the_target_until_just_before_contact(
    arm_transcription: Transcription, monkeypatch: pytest.MonkeyPatch
) -> None:
    near, x = hovering(arm_transcription, gap=0.022)
    wanted = {float(s): min(nlp.CLEARANCE, nlp.CLEARANCE_RATE * (1 - s) * LEISURE) for s in near.swing_nodes}
    assert max(wanted.values()) == nlp.CLEARANCE
    assert all(gap >= wanted[s] - 1e-5 for s, gap in swing_gaps(near, x).items())
    monkeypatch.setattr(nlp, "CLEARANCE", 0.0)
    free, x = hovering(arm_transcription, gap=0.022)
    assert any(gap < wanted[s] - 1e-3 for s, gap in swing_gaps(free, x).items()), "it would not have hovered"


def test_a_hand_that_starts_nearer_may_stay_as_near(arm_transcription: Transcription) -> None:
    near, x = hovering(arm_transcription, gap=0.005)
    gaps = list(swing_gaps(near, x).values())
    assert gaps[0] == pytest.approx(0.005, abs=1e-3)
    assert min(gaps) > 0
