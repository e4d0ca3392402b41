"""An infeasible problem names the bound that has to move: moved there, it is solved."""

from __future__ import annotations

import dataclasses
import signal
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from support.causes import searched
from support.small_plans import BODILESS, arm_problem, transcribed

from impactopt import (
    Effort,
    FreeMass,
    ImpactProblem,
    Impulse,
    JointAcceleration,
    Nail,
    NotSolvedWarning,
    Obstacle,
    Phase,
    Scenario,
    Solution,
    SpringDamper,
    Status,
    TorqueLimit,
    load_problem,
    load_solution,
    solve,
)
from impactopt.planning.bounds import bounds_of
from impactopt.planning.budget import stopping
from impactopt.planning.diagnosis import with_reason
from impactopt.problem.feasibility import too_weak
from impactopt.transcription.initial_guess import first_iterate


@pytest.fixture(scope="module")
def arm() -> ImpactProblem:
    return load_problem("arm_planar")


def unsolved(problem: ImpactProblem) -> Solution:
    with pytest.warns(NotSolvedWarning, match="not solved; its numbers are not a plan: Infeasible"):
        solution = solve(problem)
    assert solution.status is Status.INFEASIBLE
    return solution


def changes(arm: ImpactProblem) -> dict[str, tuple[ImpactProblem, str]]:
    law = dataclasses.replace(arm.law, stiffness=3.9e4)
    wood = Nail(mass=0.05, resistance=800.0, hardening=1e4)
    few = dataclasses.replace(arm.swing, duration=2.09)
    return {
        "hard wood": (dataclasses.replace(arm, target=wood), "gears"),
        "short swing": (dataclasses.replace(arm, swing=Phase(duration=0.02)), "time"),
        "soft contact": (dataclasses.replace(arm, law=law, swing=few), "a soft contact"),
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hard wood", "short swing", "soft contact"])
def test_the_bound_that_is_named_is_the_one_that_has_to_move(arm: ImpactProblem, name: str) -> None:
    problem, first = changes(arm)[name]
    t, result, found = searched(problem)
    assert found.causes
    cause = found.causes[0]
    assert cause.kind == first
    assert with_reason(t, result, found.causes).message.startswith(
        f"Infeasible: {first}. {cause.text} would do"
    )
    assert cause.problem is not None
    assert solve(cause.problem).status.usable


@pytest.mark.slow
def test_no_problem_is_called_infeasible_that_is_solved_from_its_neighbour(arm: ImpactProblem) -> None:
    """Here a swing of 18.1 s, and a follow-through of 0.848 s in place of 0.8 s, were said to be needed."""
    stiff = SpringDamper(stiffness=1e5, damping=300.0 * 10**0.5)
    heavy = dataclasses.replace(arm_problem(), target=FreeMass(mass=6.5), law=stiff)
    for problem in (heavy, dataclasses.replace(arm, swing=Phase(duration=50.0))):
        assert solve(problem).status is Status.SOLVED


def test_a_scenario_may_be_called_as_a_phase_begins() -> None:
    """Its durations are those of a contact, whatever its name."""
    told = []
    for name in ("stance heavy", "follow up", "heavy"):
        t = transcribed(
            dataclasses.replace(arm_problem(), terms=BODILESS, scenarios=(Scenario(name=name, mass=2.0),))
        )
        x = np.full(t.layout.n, 100.0)  # all durations are too long
        told.append([[cause.text for cause in b.causes(x)] for b in bounds_of(t) if b.is_time])
    assert len(told[2]) == 3 and told[0] == told[1] == told[2]


@pytest.mark.slow
def test_no_cause_is_confirmed_by_a_motion_through_an_obstacle(arm: ImpactProblem) -> None:
    """Here another stiffness was named, which is solved without the obstacle."""
    low = [dataclasses.replace(phase, intervals=6) for phase in (arm.swing, arm.follow)]
    shelf = Obstacle(name="shelf", size=(0.3, 0.3, 0.1), position=(0.7, 0.0, 0.8))
    blocked = dataclasses.replace(arm, swing=low[0], follow=low[1], obstacles=(shelf,))
    assert not searched(blocked)[2].causes


@pytest.mark.slow
def test_clearances_that_are_too_many_together_are_named(arm: ImpactProblem) -> None:
    """A shelf of several boxes at the hit point: without one of them alone there is no motion."""
    low = [dataclasses.replace(phase, intervals=6) for phase in (arm.swing, arm.follow)]
    shelf = Obstacle(name="shelf", size=(0.3, 0.3, 0.1), position=(0.7, 0.0, 0.8))
    blocked = dataclasses.replace(arm, swing=low[0], follow=low[1], obstacles=(shelf,))
    t, result, found = searched(blocked, near=True)
    (cause,) = found.causes
    assert cause.kind == "keep out"
    assert cause.text.count("wrist and shelf") == 2 and cause.text.count("mm nearer than allowed") == 2
    assert with_reason(t, result, found.causes).message.startswith("Infeasible: keep out. wrist and shelf")


@pytest.mark.slow
def test_no_less_would_do(arm: ImpactProblem) -> None:
    """The swing of the message is the shortest there is, within a few per cent."""
    problem = load_problem("punch_infeasible")
    named = searched(problem)[2].causes[0].problem
    assert named is not None
    shortest = named.swing.duration[1]
    assert shortest > problem.swing.duration[1]
    shorter = dataclasses.replace(problem, swing=dataclasses.replace(problem.swing, duration=0.93 * shortest))
    unsolved(shorter)


def test_the_robots_own_weight(arm: ImpactProblem) -> None:
    robot, q = arm.robot, arm.start_posture
    bears = np.abs(pin.rnea(robot.model, robot.model.createData(), q, np.zeros(3), np.zeros(3)))
    share = bears / robot.torque_limit
    k = int(share.argmax())
    for more, told in ((1.01, ""), (0.99, f"{robot.joint_names[k]} needs {share[k]:.3g} of its limit")):
        terms = (*arm.terms, TorqueLimit(fraction=more * share[k]))
        text = too_weak(dataclasses.replace(arm, terms=terms))
        assert told in text
        assert bool(text) == bool(told)


@pytest.mark.slow
def test_a_window_that_takes_nearly_all_is_told(arm: ImpactProblem, tmp_path: Path) -> None:
    """Half a period of 1 kg on 1e3 N/m takes 99 ms: in 15 ms a phase there is no blow worth its name."""
    law = dataclasses.replace(arm.law, stiffness=1e3, damping=0.0)
    problem = dataclasses.replace(arm, target=FreeMass(mass=1.0), law=law, objectives=(Impulse(),))
    narrow = solve(dataclasses.replace(problem, contact_duration=(0.0, 0.015)))
    assert narrow.status.usable
    assert "[collision] duration_s allows, 15 ms" in narrow.window
    assert narrow.window in narrow.summary()["caution"]
    # also of the solution that is saved, and of one that is moved
    assert load_solution(narrow.save(tmp_path)).window == narrow.window
    assert "of the objective" in narrow.moved(mass=1.05).window
    # effort is a cost: the same impulse leaves less, of which the same gain is a larger part
    costly = solve(dataclasses.replace(narrow.problem, objectives=(Impulse(), Effort(weight=0.03))))
    told, of_less = (float(s.window.split("gains ")[1].split(" %")[0]) for s in (narrow, costly))
    assert costly.impulse == pytest.approx(narrow.impulse, rel=1e-3)
    left = 1 - 0.03 * costly.objectives["effort"] / costly.impulse
    assert of_less == pytest.approx(told / left, rel=0.02)
    wide = solve(dataclasses.replace(problem, contact_duration=(0.0, 0.2)))
    assert wide.window == ""
    assert wide.impulse > 10 * narrow.impulse


@pytest.fixture
def handlers() -> Iterator[None]:
    """Both signals raise KeyboardInterrupt, as in commands; a shell's background job ignores the first."""
    before = {n: signal.signal(n, signal.default_int_handler) for n in (signal.SIGINT, signal.SIGTERM)}
    yield
    assert all(signal.getsignal(n) is signal.default_int_handler for n in before)
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.usefixtures("handlers")
def test_a_signal_between_two_solves_keeps_the_plan(arm: ImpactProblem, number: signal.Signals) -> None:
    """Here while the program gets rows for gears: the plan before is there, and is not lost."""

    def report(text: str) -> None:
        if "constraints of gear load" in text:
            signal.raise_signal(number)

    harder = dataclasses.replace(arm, target=Nail(mass=0.05, resistance=800.0, hardening=1e4))
    with pytest.warns(NotSolvedWarning):
        solution = solve(harder, report=report)
    assert solution.status is Status.INTERRUPTED
    assert solution.result.iterations > 10
    assert solution.plan.impulse > 1.0


@pytest.mark.usefixtures("handlers")
def test_a_second_signal_ends_at_once() -> None:
    with stopping() as stop:
        stop.armed = True
        signal.raise_signal(signal.SIGINT)
        assert stop.asked
        with stopping() as inner:
            assert inner is stop
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
    with stopping(), pytest.raises(KeyboardInterrupt):  # nothing is there yet
        signal.raise_signal(signal.SIGINT)


def test_a_wide_range_of_durations_starts_from_a_usual_one(arm: ImpactProblem) -> None:
    """From the middle of 0.4 to 50 s the arm would be guessed nearly still at contact."""
    wide = dataclasses.replace(arm.swing, duration=(0.4, 50.0))
    assert solve(dataclasses.replace(arm, swing=wide)).status.usable


@dataclasses.dataclass(frozen=True, kw_only=True)
class Noted(JointAcceleration):
    """A term of a user's own, with a table that is no limit."""

    notes: Mapping[str, str] = dataclasses.field(default_factory=lambda: {"shoulder": "weak"})


def test_a_table_of_a_term_of_ones_own_is_no_limit() -> None:
    """Its texts were multiplied by a factor: a TypeError in place of the reason that there is no plan."""
    t = transcribed(dataclasses.replace(arm_problem(), terms=(*BODILESS, Noted(limit=2.0))))
    (bound,) = [b for b in bounds_of(t) if b.name == Noted.name]
    assert [cause.text for cause in bound.causes(first_iterate(t))]


def test_a_limit_by_joint_is_named_as_one_for_all_joints_is() -> None:
    """At the same motion, the same accelerations are allowed."""
    found = {}
    names = arm_problem().robot.joint_names
    for kind, limit in {"of all": 2.0, "by joint": dict.fromkeys(names, 2.0)}.items():
        terms = (*BODILESS, JointAcceleration(limit=limit))
        t = transcribed(dataclasses.replace(arm_problem(), terms=terms))
        (bound,) = [b for b in bounds_of(t) if b.name == "joint acceleration"]
        (found[kind],) = bound.causes(first_iterate(t))
    problems = [cause.problem for cause in found.values()]
    assert all(problems)
    allowed = [p.term(JointAcceleration).limit for p in problems if p is not None]
    assert allowed[0] > 2.0
    assert allowed[1] == pytest.approx(dict.fromkeys(names, allowed[0]), rel=0.01)
    assert f"{allowed[1][names[0]] / 2:.3g} times the limit of each joint" in found["by joint"].text
