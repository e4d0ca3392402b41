"""Plans bent for other numbers, and what numbers are worth: against problems that are solved again."""

from __future__ import annotations

import dataclasses
import gc
import threading
import weakref
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.small_plans import BODILESS, arm_problem

from impactopt import (
    CustomLaw,
    GearLoad,
    HitRegion,
    Impulse,
    InputError,
    KelvinVoigt,
    Scenario,
    Slide,
    Solution,
    Status,
    TargetSpeed,
    load_problem,
    solve,
)
from impactopt.planning import replanning
from impactopt.planning.budget import Budget
from impactopt.planning.parameter_changes import changed, moved_problem, parameter_of
from impactopt.planning.replanning import parametric_program
from impactopt.planning.solution import program_on
from impactopt.solvers.predictor import Predictor
from impactopt.solvers.program import SolverResult

TIGHT: dict[str, Any] = {"kkt_tolerance": 1e-8, "complementarity_tolerance": 1e-8}


@pytest.fixture(scope="module")
def arm() -> Solution:
    """Its gears' load is not bounded, so that torque is."""
    problem = load_problem(Path(__file__).resolve().parents[2] / "problems" / "arm_planar.toml")
    problem = replace(problem, terms=(*problem.terms, GearLoad(enabled=False)))
    return solve(problem, options=TIGHT, refine=False)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "half"),
    [
        ("target.mass", 2e-4),
        ("contact.stiffness", 2e3),
        ("point.z", 2e-4),
        ("terms.torque_limit.collision", 1e-3),
    ],
)
def test_sensitivities_are_those_of_problems_solved_again(arm: Solution, name: str, half: float) -> None:
    number = parameter_of(arm.problem, name)
    sides = [
        solve(number.at(number.value + sign * half), start=arm, options=TIGHT, refine=False)
        for sign in (1, -1)
    ]
    wanted = (sides[0].impulse - sides[1].impulse) / (2 * half)
    found = arm.sensitivity(name)
    assert found.value == number.value
    assert found.impulse == pytest.approx(wanted, rel=1e-4)
    # the least durations of the contact, from a point mass, leave 1e-3 of the objective's slope uncertain
    worth = -(sides[0].result.objective - sides[1].result.objective) / (2 * half)
    assert found.objective == pytest.approx(worth, rel=3e-3)


def test_a_shadow_price_is_what_the_bound_is_worth(arm: Solution) -> None:
    """Torque in contact binds at one place, so its limit is worth its price."""
    found = arm.sensitivity("terms.torque_limit.collision")
    torques = [b for b in found.binding if b.row.startswith("torque limit in collision")]
    percent = found.value / 100
    assert sum(b.price for b in torques) == pytest.approx(found.objective * percent, rel=1e-3)
    assert {b.unit for b in torques} == {"%"}
    prices = [b.price for b in found.binding]
    assert {type(price) for price in prices} == {float}  # not NumPy's, whose name stands in a repr
    assert all(price > 0 for price in prices) and prices == sorted(prices, reverse=True)
    # no constraint that an interior point keeps at a distance, and durations in their unit
    assert len(found.binding) < 20
    assert {b.unit for b in found.binding if "duration" in b.row} == {"s"}


@pytest.mark.parametrize(
    "changes",
    [
        {"mass": 0.055},
        {"stiffness": 4.5e5},
        {"point": [0.705, 0.0, 0.745]},
        {"damping": 220.0, "mass": 0.045},
    ],
    ids=lambda changes: " ".join(changes),
)
def test_a_bent_plan_is_that_of_the_changed_problem(arm: Solution, changes: dict[str, Any]) -> None:
    bent = arm.moved(**changes, options=TIGHT)
    again = solve(bent.problem, start=arm, refine=False, options=TIGHT)
    assert bent.status is Status.SOLVED and again.status is Status.SOLVED
    assert bent.impulse == pytest.approx(again.impulse, rel=1e-5)
    assert bent.result.objective == pytest.approx(again.result.objective, rel=1e-6)
    first = arm.moved(**changes, polish=False)
    assert abs(first.impulse - bent.impulse) < abs(arm.impulse - bent.impulse) + 1e-6
    assert abs(first.impulse / bent.impulse - 1) < 1e-3
    assert first.status is Status.ACCEPTABLE and first.result.max_violation <= 1e-3
    assert first.result.iterations <= 5 and "first-order" in first.result.message


@pytest.mark.slow
def test_a_refined_plan_has_the_loads_of_a_solved_one(arm: Solution) -> None:
    """Between the collocation points a gear load is larger than at them."""
    bent = arm.moved(mass=0.06, refine=True)
    again = solve(bent.problem, start=bent)
    assert np.nanmax(bent.loads.gear) == pytest.approx(np.nanmax(again.loads.gear), rel=1e-3)


@pytest.mark.parametrize("failing", [0, 1])
def test_where_one_start_leads_nowhere_the_next_does(
    arm: Solution, failing: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the plan with a high barrier, or with a low one."""
    own, done = Budget.run, list[SolverResult]()

    def run(self: Budget, *given: Any) -> SolverResult:
        found = own(self, *given)
        done.append(found)
        lost = replace(found, status=Status.ITERATION_LIMIT, max_violation=0.1)
        return lost if len(done) <= failing else found

    monkeypatch.setattr(Budget, "run", run)
    mass = 1.02 * arm.problem.target.parameters["mass"]
    bent = arm.moved(mass=mass, options=TIGHT)
    assert bent.status is Status.SOLVED
    assert len(done) == failing + 1
    assert bent.result.iterations == sum(result.iterations for result in done)
    assert bent.impulse == pytest.approx(arm.moved(mass=mass, options=TIGHT).impulse, rel=1e-5)


def test_threads_that_move_one_plan_at_once_get_the_plans_that_they_ask_for(arm: Solution) -> None:
    """All changes of a plan share one program, so a second change must not reach into an unfinished one."""
    light, heavy = (factor * arm.problem.target.parameters["mass"] for factor in (0.98, 1.04))
    others: list[float] = []
    second = threading.Thread(target=lambda: others.append(arm.moved(mass=heavy).impulse))

    def meanwhile(_: Any) -> None:
        if second.ident is None:
            second.start()
            second.join(timeout=0.5)  # it has to wait for this change, which therefore must not wait for it

    first = arm.moved(mass=light, callback=meanwhile).impulse
    second.join()
    assert [first, *others] == [arm.moved(mass=mass).impulse for mass in (light, heavy)]


def test_a_plan_is_moved_while_another_one_is(arm: Solution) -> None:
    """They share no program, so neither waits for the other."""
    mass, another = arm.problem.target.parameters["mass"], dataclasses.replace(arm)
    moved: list[float] = []
    second = threading.Thread(target=lambda: moved.append(another.moved(mass=0.98 * mass).impulse))

    def meanwhile(_: Any) -> None:
        if second.ident is None:
            second.start()
            second.join(timeout=60.0)
            assert moved

    first = arm.moved(mass=1.04 * mass, callback=meanwhile).impulse
    assert [*moved, first] == [arm.moved(mass=factor * mass).impulse for factor in (0.98, 1.04)]


def test_a_program_with_other_numbers_is_that_of_its_problem(arm: Solution) -> None:
    """What takes the numbers of another program has its functions."""
    bent = parametric_program(arm)
    problem = dataclasses.replace(
        arm.problem,
        point=arm.problem.point + np.array([0.01, 0.0, 0.02]),
        target=dataclasses.replace(arm.problem.target, mass=0.07, depth=0.004),
        law=dataclasses.replace(arm.problem.law, stiffness=3e5),
    )
    quick, moving = bent.program_for(problem).program, bent._movable
    assert moving is not None and quick is moving.program
    whole = bent._built(problem).program
    x, y = arm.result.x, arm.result.multipliers
    for name in ("x_lower", "x_upper", "g_lower", "g_upper"):
        assert np.array_equal(getattr(quick, name), getattr(whole, name)), name
    assert np.array_equal(quick.constraints(x), whole.constraints(x))
    assert quick.objective(x) == whole.objective(x)
    assert np.array_equal(quick.jacobian(x).toarray(), whole.jacobian(x).toarray())
    assert np.array_equal(quick.hessian(x, 1.0, y).toarray(), whole.hessian(x, 1.0, y).toarray())


@pytest.mark.parametrize(
    "more",
    [
        {"terms": (Slide(most=0.05), TargetSpeed(least=0.0, most=100.0))},
        {"terms": (HitRegion(radius=0.01),), "objectives": (Impulse(),)},
        {"terms": (GearLoad(limit=5.0),)},
        {"scenarios": (Scenario(name="heavy", mass=2.0),)},
    ],
    ids=["slide and speed", "region", "gears", "scenario"],
)
def test_programs_follow_their_problem(arm: Solution, more: dict[str, Any]) -> None:
    """Terms and scenarios take the numbers of another problem, as if built for it."""
    terms = tuple(t for t in arm.problem.terms if type(t) not in {type(m) for m in more.get("terms", ())})
    problem = changed(arm.problem, **{**more, "terms": (*terms, *more.get("terms", ()))})
    other = changed(
        problem,
        point=problem.point + np.array([0.01, 0.0, 0.02]),
        target=dataclasses.replace(problem.target, mass=0.07),
        law=dataclasses.replace(problem.law, stiffness=3e5),
    )
    moving, whole = program_on(problem, arm.nodes, (), ()), program_on(other, arm.nodes, (), ())
    assert not moving.program.same_parameters(whole.program)
    moving.move_to(other)
    assert moving.program.same_parameters(whole.program)


class _OwnTerm(Slide):
    """One that reads the point and does not say so."""

    def add_constraints(self, program: Any) -> None:
        place = float(program.problem.point[2])
        program.constraints.add(term="own", components=["x"], affine=program.swing_T[0], lower=place - 10.0)


def test_parameters_of_a_law_from_a_formula_change(arm: Solution) -> None:
    """They ended in a TypeError, as a CustomLaw is no dataclass."""
    law = CustomLaw(compression=lambda x, rate, stiffness, h: stiffness * x + h * x**3, stiffness=5e5, h=1e9)
    problem = replace(arm.problem, law=law)
    softer = moved_problem(problem, stiffness=2e5).law
    assert softer.parameters == {"stiffness": 2e5, "h": 1e9} and softer.force(1e-3, 0.0) == 201.0
    assert parameter_of(problem, "contact.h").at(2e9).law.parameters == {"stiffness": 5e5, "h": 2e9}
    with pytest.raises(InputError, match="CustomLaw has no parameter 'damping'"):
        moved_problem(problem, damping=1.0)


@pytest.mark.slow
def test_a_program_that_does_not_follow_is_built_anew(arm: Solution) -> None:
    problem = changed(arm.problem, terms=(*arm.problem.terms, _OwnTerm()))
    solution = solve(problem, start=arm, refine=False)
    bent = parametric_program(solution)
    assert bent._movable is None
    moved = solution.moved(point=problem.point + np.array([0.01, 0.0, 0.01]), polish=False)
    own = [i for i, row in enumerate(bent.program.constraints.origins) if row.term == "own"]
    lower = bent.program_for(moved.problem).program.g_lower[own]
    assert lower == pytest.approx([moved.problem.point[2] - 10.0])


def test_what_cannot_be_bent_is_said(arm: Solution) -> None:
    with pytest.raises(InputError, match=r"moved: a plan has no parameter 'masss' \(did you mean 'mass'\?\)"):
        arm.moved(masss=0.06)
    with pytest.raises(InputError, match="moved: point: expected numbers, got 'here'"):
        arm.moved(point="here")
    with pytest.raises(InputError, match="nothing is moved"):
        arm.moved()
    with pytest.raises(InputError, match=r"target\.mas.*target\.mass"):
        arm.sensitivity("target.mas")
    with pytest.raises(InputError, match=r"terms\.power_limit\.limit: .* give PowerLimit one"):
        arm.sensitivity("terms.power_limit.limit")
    with pytest.raises(InputError, match=r"both sides of target\.depth = 0, and one is not allowed"):
        arm.sensitivity("target.depth")
    stopped = dataclasses.replace(arm, result=dataclasses.replace(arm.result, status=Status.ITERATION_LIMIT))
    with pytest.raises(InputError, match="not a solution"):
        stopped.moved(mass=0.06)
    with pytest.raises(InputError, match="margin"):
        arm.moved(margin=-1.0)


def test_a_damper_that_is_new_gets_its_constraints() -> None:
    """Gear loads at the first instant, with which moving is refused; and a force that does not pull."""
    elastic, gears = KelvinVoigt(stiffness=2e4, damping=0.0), GearLoad(limit=0.9)
    problem = replace(arm_problem(), law=elastic, terms=(*BODILESS, gears))
    with pytest.raises(InputError, match="has other constraints then"):
        solve(problem, refine=False).moved(damping=3000.0)
    free = solve(replace(problem, terms=(*BODILESS, replace(gears, enabled=False))), refine=False)
    damped = moved_problem(free.problem, damping=300.0)
    wanted = program_on(damped, free.nodes, (), ()).program.x_lower
    np.testing.assert_array_equal(parametric_program(free).program_for(damped).program.x_lower, wanted)


def test_a_plan_that_was_moved_is_freed(arm: Solution) -> None:
    solution = replace(arm)
    known = weakref.ref(solution)
    moved = solution.moved(mass=1.01 * solution.problem.target.parameters["mass"])
    assert moved.status.usable
    del solution
    gc.collect()
    assert known() is None


def test_a_first_order_plan_without_finite_constraints_is_refused(arm: Solution, monkeypatch: Any) -> None:
    monkeypatch.setattr(Predictor, "predict", lambda self, program: None)
    monkeypatch.setattr(replanning, "max_violation", lambda program, x, g: np.inf)
    with pytest.raises(InputError, match="not finite"):
        arm.moved(polish=False, stiffness=6e5)
