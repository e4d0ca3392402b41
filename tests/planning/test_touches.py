"""Boards that are met more than once, or break after the last touch: plans have the events of replays."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from impactopt import (
    Board,
    ContactFriction,
    FreeMass,
    GearLoad,
    ImpactProblem,
    InputError,
    KelvinVoigt,
    Nail,
    NotSolvedWarning,
    Penetration,
    Scenario,
    Solution,
    SpringDamper,
    Status,
    TargetEnergy,
    load_problem,
    optimize_strike,
    solve,
)
from impactopt.contact.targets.base import SEPARATION, TOUCH, contact_phases, order_of_touches
from impactopt.files.named_problems import problem_file
from impactopt.files.output import record_of, save_record
from impactopt.files.replay import load_planned
from impactopt.planning.models import largest_force
from impactopt.simulation.engines import scene_of
from impactopt.simulation.pinocchio_engine import follow_contact
from impactopt.transcription.contact_guess import (
    contact_order,
    guessed_contact,
    mass_at_contact,
    natural_durations,
    parting,
    speed_with_order,
)

BOARD = Board(mass=0.1, stiffness=1e5, breaking_force=700.0, damping=20.0)


def stiff(stiffness: float = 1e6, **changes: Any) -> ImpactProblem:
    """A hammer that bounces off its board before the board has bent far enough."""
    law = KelvinVoigt(stiffness=stiffness, damping=50.0)
    terms = (*load_problem("chop_arm").terms, GearLoad(enabled=False))
    return dataclasses.replace(load_problem("chop_arm"), **{"law": law, "terms": terms, **changes})


@pytest.fixture(scope="module", params=[pytest.param((1e6, None), marks=pytest.mark.slow), (1e7, 2)])
def chopped(request: pytest.FixtureRequest) -> Solution:
    stiffness, touches = request.param
    return solve(stiff(stiffness, touches=touches))


@pytest.fixture(
    scope="module",
    params=[
        pytest.param((KelvinVoigt, 1e8), marks=pytest.mark.slow),
        (SpringDamper, 1e7),
        pytest.param((KelvinVoigt, 1e7), marks=pytest.mark.slow),
    ],
)
def swung(request: pytest.FixtureRequest) -> Solution:
    law, stiffness = request.param
    return solve(stiff(law=law(stiffness=stiffness, damping=50.0)))


# ---- plans


@pytest.mark.slow
def test_it_is_solved_with_the_touches_that_point_masses_need(chopped: Solution) -> None:
    assert chopped.status is Status.SOLVED
    assert chopped.problem.planned_touches == 2
    assert chopped.plan.collision.outcome == {"broken": 1.0}
    assert "caution" not in chopped.summary()


@pytest.mark.slow
def test_it_is_replayed_as_planned(chopped: Solution) -> None:
    replay = chopped.validate()
    assert replay.impulse == pytest.approx(chopped.impulse, rel=2e-3)
    assert replay.peak_force == pytest.approx(chopped.plan.collision.force.max(), rel=0.02)
    duration = 1e-3 * chopped.summary()["contact_ms"]
    assert replay.contact_end - replay.contact_start == pytest.approx(duration, rel=0.03)
    assert len([touch for touch in replay.touches if touch[2] > 1e-3 * replay.impulse]) == 2
    followed = chopped.contact_replay
    assert followed is not None
    assert (followed.partings, followed.unforeseen) == (1, False)
    assert followed.outcome == {"broken": 1.0}


@pytest.mark.slow
def test_mujoco_says_so_too(chopped: Solution) -> None:
    replay = chopped.validate(engine="mujoco")
    assert replay.impulse == pytest.approx(chopped.impulse, rel=1e-2)
    assert replay.peak_force == pytest.approx(chopped.plan.collision.force.max(), rel=0.02)


@pytest.mark.slow
def test_bristles_of_both_touches_are_those_of_replays() -> None:
    """In a gap they are released: a touch begins with unbent ones, whatever bent them before."""
    rough = ContactFriction(coefficient=0.6, stiffness=8e5)
    solution = solve(stiff(friction=rough))
    assert solution.status is Status.SOLVED and solution.problem.planned_touches == 2
    assert "caution" not in solution.summary()
    peak = solution.plan.collision.force.max()
    for engine, near in (("pinocchio", 3e-3), ("mujoco", 1e-2)):
        replay = solution.validate(engine=engine)
        assert len(replay.touches) == 2
        assert replay.impulse == pytest.approx(solution.impulse, rel=near)
        assert replay.peak_force == pytest.approx(peak, rel=0.02)


def test_force_is_zero_between_the_touches_and_only_there(chopped: Solution) -> None:
    hit = chopped.plan.collision
    inside = hit.force[1:-1]
    assert (inside >= 0.0).all()
    began = np.flatnonzero((inside[1:] > 0.0) & (inside[:-1] == 0.0))
    assert len(began) == 1
    ended = hit.time[1:-1][:-1][(inside[1:] == 0.0) & (inside[:-1] > 0.0)]
    swings_on = chopped.problem.order[-1] == "break"
    assert len(ended) == 1 + swings_on
    assert not swings_on or ended[-1] < hit.time[-1]


def test_impulse_is_what_the_board_has_and_what_its_spring_took(chopped: Solution) -> None:
    """m v, and the spring's and the damper's force over time, up to the break."""
    p, hit = chopped.problem, chopped.plan.collision
    broken = chopped.contact_replay
    assert broken is not None
    until = hit.time <= broken.events[0]
    way = np.concatenate(
        [[0.0], np.cumsum(np.diff(hit.time) * (hit.target_speed[1:] + hit.target_speed[:-1]) / 2)]
    )
    bent = (BOARD.stiffness * way + BOARD.damping * hit.target_speed)[until]
    taken = float(np.trapezoid(bent, hit.time[until]))
    given = p.target.parameters["mass"] * hit.target_speed[-1] + taken
    assert given == pytest.approx(chopped.impulse, rel=2e-2)


def test_steps_of_replays_do_not_move_the_second_touch(chopped: Solution) -> None:
    """The board swings freely between them: its way in a step is not its first speed times the step."""
    p, duration = chopped.problem, chopped.plan.compression + chopped.plan.restitution
    coarse, fine = (
        follow_contact(
            p.robot,
            chopped.plan.reference,
            scene_of(p),
            step=duration / n,
            until=duration,
            longest=4 * duration,
        )
        for n in (60, 480)
    )
    assert coarse.impulse == pytest.approx(fine.impulse, rel=5e-4)
    assert coarse.touches[1][0] == pytest.approx(fine.touches[1][0], rel=5e-4)


@pytest.mark.slow
def test_a_servo_of_much_damping_is_followed_too(chopped: Solution) -> None:
    """An explicit rule is stable for steps below two over its fastest rate alone."""
    p, duration = chopped.problem, chopped.plan.compression + chopped.plan.restitution
    robot = dataclasses.replace(p.robot, kd=400 * p.robot.kd)
    coarse, fine = (
        follow_contact(
            robot, chopped.plan.reference, scene_of(p), step=step, until=duration, longest=duration
        )
        for step in (duration / 10, 1e-6)
    )
    assert coarse.impulse == pytest.approx(fine.impulse, rel=5e-3)


@pytest.mark.slow
def test_the_model_is_full_where_the_frozen_one_has_no_such_order() -> None:
    solution = solve(stiff(1e7, collision="auto"))
    assert solution.status is Status.SOLVED
    assert solution.problem.collision == "full"
    assert solution.problem.order == (SEPARATION, "break")


@pytest.mark.slow
def test_a_strike_is_planned_so_too() -> None:
    """Its contact is a motion's, which the quick tests solve."""
    strike = optimize_strike(stiff())
    assert strike.status is Status.SOLVED
    assert strike.problem.planned_touches == 2
    followed = strike.contact_replay
    assert followed is not None
    assert not followed.unforeseen
    assert abs(followed.impulse_pct) < 0.5


@pytest.mark.slow
def test_one_touch_has_no_plan_and_the_order_that_has_one_is_named() -> None:
    """With scenarios it is not chosen."""
    with pytest.warns(NotSolvedWarning, match="one contact is not enough"):
        strike = optimize_strike(stiff(scenarios=(Scenario(name="heavier", mass=1.2),)))
    assert strike.status is Status.INFEASIBLE
    order = ["separation", "touch", "break", "separation"]
    assert f"`[collision] touches = {order}` plans them" in strike.result.message


# ---- nails that jump ahead of the hammer


@pytest.fixture(scope="module", params=[(1e7, 200.0), (1e8, 1000.0)], ids=["1e7", "1e8"])
def rattled(request: pytest.FixtureRequest) -> Solution:
    stiffness, damping = request.param
    problem = load_problem("arm_planar")
    law = KelvinVoigt(stiffness=stiffness, damping=damping)
    return solve(
        dataclasses.replace(problem, law=law, touches=3, terms=(*problem.terms, GearLoad(enabled=False)))
    )


@pytest.mark.slow
def test_a_nail_starts_in_its_first_touch_and_stops_in_its_last(rattled: Solution) -> None:
    assert rattled.status is Status.SOLVED
    assert rattled.problem.order == ("start", *(SEPARATION, TOUCH) * 2, "stop", SEPARATION)
    assert rattled.contact_replay is not None and not rattled.contact_replay.unforeseen
    assert "caution" not in rattled.summary()


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["pinocchio", "mujoco"])
def test_its_touches_are_those_of_replays(rattled: Solution, engine: str) -> None:
    """One touch would have 34 and 40 % less peak force."""
    replay, hit = rattled.validate(engine=engine), rattled.plan.collision
    assert hit.peak_force == pytest.approx(replay.peak_force, rel=0.03)
    assert replay.impulse == pytest.approx(rattled.impulse, rel=5e-3)
    assert replay.outcome == pytest.approx(hit.outcome, rel=5e-3)
    assert len(replay.touches) == 3
    edges = np.flatnonzero(np.diff(hit.force > 1e-6 * hit.peak_force))
    found = np.array([touch[:2] for touch in replay.touches]) - replay.contact_start
    # separations are collocation points; a touch begins between one without a force and one with it
    ends, begins = hit.time[edges[::2] + 1], hit.time[edges[1::2]]
    np.testing.assert_allclose(ends, found[:, 1], rtol=0.03)
    np.testing.assert_allclose(begins, found[1:, 0], rtol=0.05)


@pytest.mark.slow
def test_work_on_its_head_is_that_of_the_wood(rattled: Solution) -> None:
    """R z + hardening z^2 / 2, with what the nail coasts in the gaps; impulse and momentum agree there."""
    wood, hit = rattled.problem.target, rattled.plan.collision
    depth = hit.outcome["depth_m"]
    assert isinstance(wood, Nail)
    assert np.trapezoid(hit.target_speed, hit.time) == pytest.approx(depth, rel=0.02)
    gaps = (hit.force[1:-1] == 0) & (hit.force[:-2] == 0) & (hit.force[2:] == 0)
    resisted = np.gradient(hit.target_speed, hit.time)[1:-1][gaps]
    deep = wood.resistance + wood.hardening * np.array([0.0, depth])
    assert gaps.any() and (-wood.mass * resisted >= 0.99 * deep[0]).all()
    assert (-wood.mass * resisted <= 1.01 * deep[1]).all()


@pytest.mark.slow
@pytest.mark.parametrize(("damping", "number"), [(200.0, "touches = 3"), (20.0, "")])
def test_a_plan_of_one_touch_names_the_number_that_plans_them(damping: float, number: str) -> None:
    """With less damping the nail stops in a gap and is driven again: no number of touches plans that."""
    problem = load_problem("arm_planar")
    law = KelvinVoigt(stiffness=1e7, damping=damping)
    solution = solve(dataclasses.replace(problem, law=law, terms=(*problem.terms, GearLoad(enabled=False))))
    caution = solution.summary()["caution"]
    assert "part and meet again" in caution
    assert caution.count("touches = ") == bool(number) and number in caution


@pytest.mark.slow
def test_a_plan_that_does_not_drive_its_nail_says_so() -> None:
    """A nail that just starts to move takes no energy, to first order: plans can end there."""
    problem = load_problem("arm_planar")
    least = dataclasses.replace(problem, objectives=(TargetEnergy(weight=-1.0),))
    for given, driven in ((problem, True), (least, False)):
        solution = solve(given)
        assert (solution.validate(engine="mujoco").outcome["depth_m"] > 1e-3) == driven
        assert ("is not driven" not in solution.summary().get("caution", "")) == driven


# ---- boards that break after the last touch


@pytest.mark.slow
def test_a_board_swings_on_after_one_touch_and_breaks(swung: Solution) -> None:
    assert swung.status is Status.SOLVED
    assert swung.problem.order[-2:] == (SEPARATION, "break")
    assert "caution" not in swung.summary()
    followed = swung.contact_replay
    assert followed is not None
    assert (followed.partings, followed.unforeseen) == (0, False)
    assert followed.outcome == swung.plan.collision.outcome == {"broken": 1.0}
    duration = swung.plan.compression + swung.plan.restitution
    assert followed.events == pytest.approx([duration], rel=0.02)
    assert 1e3 * followed.contact == pytest.approx(swung.summary()["contact_ms"], rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["pinocchio", "mujoco"])
def test_its_touch_is_that_of_replays(swung: Solution, engine: str) -> None:
    replay = swung.validate(engine=engine)
    assert replay.impulse == pytest.approx(swung.impulse, rel=2e-3)
    assert replay.peak_force == pytest.approx(swung.plan.collision.force.max(), rel=0.02)
    assert replay.outcome == {"broken": 1.0}
    assert len(replay.touches) == 1


def test_its_peak_is_that_of_two_masses_with_a_spring_between_them(swung: Solution) -> None:
    """v sqrt(k mu), less what the damper takes: exp(-z pi / 2) with z = d / (2 sqrt(k mu)), for small z."""
    p, hit = swung.problem, swung.plan.collision
    mass = 1 / (1 / mass_at_contact(p) + 1 / BOARD.mass)
    root = np.sqrt(p.law.parameters["stiffness"] * mass)
    compressed = root * swung.plan.hand_speed * np.exp(-50.0 / (2 * root) * np.pi / 2)
    assert hit.force.max() == pytest.approx(compressed, rel=0.03)


def test_it_swings_from_the_speed_that_the_impulse_gave_it(swung: Solution) -> None:
    """Energy at the end of the touch, less what the board's damper takes, is that of the break and after."""
    hit = swung.plan.collision
    after = hit.time >= 1e-3 * swung.summary()["contact_ms"] * (1 - 1e-9)
    speed, time = hit.target_speed[after], hit.time[after]
    bent = BOARD.breaking_force / BOARD.stiffness - np.array([np.trapezoid(speed, time), 0.0])
    energy = 0.5 * BOARD.mass * speed[[0, -1]] ** 2 + 0.5 * BOARD.stiffness * bent**2
    damped = np.trapezoid(BOARD.damping * speed**2, time)
    assert energy[0] == pytest.approx(energy[-1] + damped, rel=0.01)


@pytest.mark.parametrize("plan", [solve, optimize_strike])
@pytest.mark.parametrize(("stiffness", "touches"), [(1e5, 2), (1e6, 3)])
def test_touches_that_do_not_come_are_refused(plan: Any, stiffness: float, touches: int) -> None:
    with pytest.raises(InputError, match=f"touches is {touches}, but at no speed .*'break': leave it out"):
        plan(stiff(stiffness, touches=touches))


@pytest.mark.slow
def test_a_plan_starts_from_a_neighbour(chopped: Solution) -> None:
    again = solve(stiff(1.05 * chopped.problem.law.parameters["stiffness"]), start=chopped)
    assert again.status is Status.SOLVED
    assert again.problem.order == chopped.problem.order


def test_a_start_with_other_touches_is_refused(chopped: Solution) -> None:
    ball = stiff(target=FreeMass(mass=1.0))
    switching = stiff(law=SpringDamper(stiffness=1e6, damping=50.0))
    for problem in (stiff(touches=1), stiff(touches=3), ball, switching):
        with pytest.raises(InputError, match=r"start: .* separation, touch, .*, and not so in this problem"):
            solve(problem, start=chopped)


def test_what_is_saved_is_read_with_its_touches(chopped: Solution, tmp_path: Path) -> None:
    """Its problem does not say how many: the plan does."""
    k = chopped.problem.law.parameters["stiffness"]
    text = (Path(__file__).resolve().parents[2] / "problems" / "chop_arm.toml").read_text("utf-8")
    text = text.replace("stiffness_N_m = 1e5\ndamping_N_s_m = 50", f"stiffness_N_m = {k}\ndamping_N_s_m = 50")
    text += "\n[terms.gear_load]\nenabled = false\n"
    record = record_of(chopped, problem=text, problem_path=tmp_path / "chop.toml")
    save_record(record, tmp_path)
    planned = load_planned(tmp_path)
    assert planned.problem.order == chopped.problem.order
    assert planned.problem.law == chopped.problem.law
    older = dataclasses.replace(record, summary={**record.summary, "touches": 2, "problem": {}})
    save_record(older, tmp_path / "older")  # older versions have their number
    phases = order_of_touches(planned.problem.law, BOARD, 2)
    assert load_planned(tmp_path / "older").problem.order == phases


@pytest.mark.slow
def test_a_board_with_a_heavier_one_as_a_scenario() -> None:
    """All targets are met as often; point masses are not asked then."""
    others = (Scenario(name="heavier", mass=1.2),)
    solution = solve(stiff(scenarios=others, touches=2))
    assert solution.status is Status.SOLVED
    heavier = solution.plan.scenarios[0]
    assert heavier.collision.outcome == {"broken": 1.0}
    assert heavier.impulse != solution.impulse


@pytest.mark.slow
def test_contact_time_of_a_scenario_is_without_the_swing_to_the_break() -> None:
    others = (Scenario(name="heavier", mass=1.2),)
    solution = solve(stiff(1e7, scenarios=others, touches=(SEPARATION, "break")))
    assert solution.status is Status.SOLVED
    (heavier,) = solution.summary()["scenarios"]
    collision = solution.plan.scenarios[0].collision
    last = int(np.flatnonzero(collision.force > 1e-6 * collision.force.max())[-1])
    assert heavier["contact_ms"] == pytest.approx(1e3 * collision.time[last + 1], rel=1e-3)
    assert heavier["contact_ms"] < 0.5e3 * collision.time[-1]


# ---- phases and their number


@pytest.mark.parametrize("target", [BOARD, FreeMass(mass=1.0), Nail(mass=0.05, resistance=600.0)])
def test_phases_of_one_touch_are_the_targets(target: Any) -> None:
    phases = contact_phases(target)
    assert tuple(phase.name for phase in phases) == target.phases
    assert [phase.mode for phase in phases] == list(range(len(phases)))
    assert phases[-1].end == SEPARATION
    assert tuple(phase.end for phase in phases[: len(target.guards)]) == target.guards


@pytest.mark.parametrize("touches", [2, 3, 4])
def test_phases_of_several_touches(touches: int) -> None:
    law = KelvinVoigt(stiffness=1e6, damping=50.0)
    phases = contact_phases(BOARD, order_of_touches(law, BOARD, touches))
    assert len(phases) == 2 * touches
    assert [phase.end for phase in phases[:-2]] == [SEPARATION, TOUCH] * (touches - 1)
    assert [phase.end for phase in phases[-2:]] == ["break", SEPARATION]
    assert [phase.apart for phase in phases[:-2]] == [False, True] * (touches - 1)
    assert [phase.mode for phase in phases] == [0] * (2 * touches - 1) + [1]
    assert len({phase.name for phase in phases}) == len(phases)


@pytest.mark.slow
def test_touches_of_point_masses() -> None:
    """Without damping they part after half a period of the spring between them."""
    soft, hard = (KelvinVoigt(stiffness=k, damping=50.0) for k in (1e5, 1e7))
    after_one, after_two = ((SEPARATION, *(TOUCH, SEPARATION) * k, "break") for k in (0, 1))
    assert [contact_order(soft, BOARD, 0.9, 8.0, k) for k in (None, 1, 2)] == [(), (), None]
    assert [contact_order(hard, BOARD, 0.9, 8.0, k) for k in (None, 1, 2)] == [
        after_one,
        after_one,
        after_two,
    ]
    found = parting(hard, BOARD, 0.9, 8.0)
    assert found is not None
    assert found.order == after_one
    undamped = KelvinVoigt(stiffness=1e7, damping=0.0)
    first = natural_durations(undamped, BOARD, 2.5, after_two)[0]
    reduced = 1 / (1 / 2.5 + 1 / BOARD.mass)
    assert first == pytest.approx(np.pi * np.sqrt(reduced / 1e7), rel=0.02)


def test_the_order_is_one_whose_force_is_borne() -> None:
    hard = KelvinVoigt(stiffness=1e7, damping=50.0)
    for most, touches in ((np.inf, 1), (4300.0, 2), (1.0, 1)):  # the last is not possible
        order = contact_order(hard, BOARD, 0.9, 8.0, most=most)
        assert order is not None
        assert order.count(TOUCH) + 1 == touches


def test_a_guess_has_the_speed_of_its_order() -> None:
    """And of a ball that comes, faster than the hand that goes back, the contact itself."""
    hard = KelvinVoigt(stiffness=1e7, damping=50.0)
    for order in ((SEPARATION, "break"), (SEPARATION, TOUCH, SEPARATION, "break")):
        speed = speed_with_order(hard, BOARD, 0.9, 1.0, order)
        assert speed_with_order(hard, BOARD, 0.9, speed, order) == pytest.approx(speed)
        assert contact_order(hard, BOARD, 0.9, speed, len(order) // 2) == order
    ball, at = FreeMass(mass=0.5, initial_velocity=-3.0), np.arange(2)
    found = guessed_contact(KelvinVoigt(stiffness=1e5, damping=100.0), ball, 2.0, -2.0, at, np.ones(2))
    assert found.durations[1] < 0.95 * found.durations[0]  # the damper ends it early


# ---- gears


@pytest.mark.slow
def test_gears_that_bear_no_impact_are_named_without_a_search() -> None:
    problem = stiff(1e7, terms=load_problem("chop_arm").terms)
    with pytest.warns(NotSolvedWarning):
        solution = solve(problem)
    assert solution.status is Status.INFEASIBLE
    assert "gears. Point masses have the target's 'break' from" in solution.result.message
    assert solution.result.iterations < 500


@pytest.mark.slow
def test_an_estimate_of_gears_does_not_end_a_solve_that_has_a_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few iterations are for problems without one: a motion within all bounds goes on to the optimum."""
    problem = stiff(touches=2)
    best = solve(problem, refine=False)
    monkeypatch.setattr("impactopt.planning.solve.overloaded", lambda _: ["gears, by a wrong estimate"])
    monkeypatch.setattr("impactopt.planning.solve._HOPELESS_ITERATIONS", best.result.iterations - 2)
    found = solve(problem, refine=False)
    assert found.status is Status.SOLVED
    assert found.impulse == pytest.approx(best.impulse, rel=1e-4)
    limit = {"max_iterations": best.result.iterations - 2}
    with pytest.warns(NotSolvedWarning, match="iteration limit"):
        assert solve(problem, refine=False, options=limit).status is Status.ITERATION_LIMIT
    monkeypatch.setattr("impactopt.planning.solve._HOPELESS_ITERATIONS", 1)
    near = solve(stiff(1.02e6, touches=2), refine=False, start=best)
    assert near.status is Status.SOLVED


def test_what_gears_bear_is_what_they_carry_at_that_force(swung: Solution) -> None:
    force, joint = largest_force(stiff(terms=load_problem("chop_arm").terms))
    loads = swung.loads
    assert loads is not None
    at_peak = loads.gear[loads.joints.index(joint)] / 2.0  # its limit
    assert at_peak == pytest.approx(swung.plan.collision.force.max() / force, rel=0.1)


# ---- refusals


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"touches": 0}, "touches"),
        ({"touches": 5}, "touches"),
        ({"touches": 1.5}, "touches"),
        ({"touches": 2, "target": FreeMass(mass=1.0)}, "a FreeMass is met once"),
        ({"touches": 2, "target": 7}, "target must be a Target"),
        ({"touches": 2, "law": "stiff"}, "law must be a ContactLaw"),
        ({"touches": ("touch",)}, "no ends of a contact's phases, such as .'separation', 'break'."),
        (
            {"touches": (SEPARATION, "start", "stop"), "target": Nail(mass=0.05, resistance=600.0)},
            "such as .'start', 'separation', 'stop'.",
        ),
        ({"touches": (SEPARATION, "break"), "law": SpringDamper(stiffness=1e6, damping=50.0)}, "'end of com"),
        ({"touches": (SEPARATION, "break"), "collision": "sdc"}, "'sdc' of the collision has one contact"),
        ({"touches": 2, "collision": "sdc"}, "'sdc' of the collision has one contact"),
        ({"touches": 2, "objectives": (Penetration(),)}, "Penetration is for one touch"),
    ],
)
def test_touches_that_no_plan_has_are_refused(changes: dict[str, Any], why: str) -> None:
    with pytest.raises(InputError, match=why):
        stiff(**changes)


def test_another_problem_has_not_the_plans_touches(chopped: Solution, tmp_path: Path) -> None:
    """A mass was refused for touches that its file does not have, and a soft board had no plan."""
    result = chopped.save(tmp_path / "chopped")
    assert load_planned(result).problem.order == chopped.problem.order
    for name in ("arm_planar", "chop_arm"):
        assert load_planned(result, problem_file=problem_file(name)).problem.order == ()
