"""Interior-point method: bent steps, the watch, warm starts, short steps, restarts, elastic constraints."""

from __future__ import annotations

import dataclasses

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.small_plans import changed, transcribed
from support.textbook import CASES, INF, Textbook, assert_optimal

from impactopt import Status, load_problem
from impactopt.solvers.ipm import IPMOptions, interior_point, solve_ipm
from impactopt.solvers.program import max_violation
from impactopt.transcription.initial_guess import first_iterate


def projection(wanted):
    """Projection of a point onto the positive orthant, whose bounds are constraints."""
    return Textbook(
        len(wanted),
        lambda *x: ca.sumsqr(ca.vertcat(*x) - wanted) / 2,
        lambda *x: [(0.0, each, INF) for each in x],
    )


def test_one_slack_does_not_stop_a_step():
    """Constraint 0 is close to its bound and would be violated; all others are far from theirs."""
    wanted = np.array([-50.0, *np.full(19, 5.0)])
    start = np.array([0.02, *np.ones(19)])
    program = projection(wanted)
    distances = []
    result = solve_ipm(program, start, callback=lambda r: distances.append(r.step))
    assert result.status is Status.SOLVED
    assert "bent" in result.history[1].note
    assert distances[1] > 1.0  # as without constraint 0; a step that is not bent would be 0.1
    np.testing.assert_allclose(result.x, np.maximum(wanted, 0.0), atol=1e-5)
    assert_optimal(program, result)


@given(seed=st.integers(0, 10**6))
@settings(max_examples=25, deadline=None)
def test_bent_steps_lead_to_the_same_optimum(seed):
    """A convex program has one optimum."""
    rng = np.random.default_rng(seed)
    wanted, start = rng.normal(size=12), 0.02 + rng.random(12)
    # near a bound that all but holds, the barrier leaves a distance of the root of this
    result = solve_ipm(projection(wanted), start, options=IPMOptions(complementarity_tolerance=1e-10))
    assert result.status is Status.SOLVED
    np.testing.assert_allclose(result.x, np.maximum(wanted, 0.0), atol=1e-4)


class HalvingWatch:
    """Watch that ends a solve at an iterate of this number, and halves all steps."""

    def __init__(self, at: int) -> None:
        self.at, self.asked, self.state = at, [], None

    def lacks(self, x):
        self.asked.append(x.copy())
        return len(self.asked) == self.at + 1

    def leave(self, state):
        self.state = state

    def limit(self, x, step, most):
        return 0.5 * most


def test_a_solve_that_was_ended_early_is_continued():
    """Slacks, multipliers and barrier are kept; only the split of a multiplier between two bounds is lost."""
    wanted = np.array([-1.0, 0.5, 2.0, 5.0])
    program, start, whole = projection(wanted), np.ones(4), HalvingWatch(-1)
    solved = solve_ipm(program, start, watch=whole)
    assert solved.status is Status.SOLVED
    lengths = np.abs(np.diff(whole.asked[:3], axis=0)).max(axis=1)
    assert lengths[0] <= 0.5 * np.abs(wanted - 1.0).max(), "the watch limits the step"
    first = HalvingWatch(3)
    left = solve_ipm(program, start, watch=first)
    assert left.status is Status.ACCEPTABLE and left.iterations == 3
    np.testing.assert_array_equal(left.x, whole.asked[3])
    on = HalvingWatch(-1)
    again = solve_ipm(
        program,
        left.x,
        multipliers=left.multipliers,
        bound_multipliers=left.bound_multipliers,
        watch=on,
        state=first.state,
    )
    assert again.status is Status.SOLVED
    np.testing.assert_array_equal(on.asked[0], left.x)
    np.testing.assert_allclose(on.asked[1], whole.asked[4], atol=0.02)
    assert left.iterations + again.iterations <= solved.iterations + 1
    np.testing.assert_allclose(again.x, solved.x, atol=1e-6)


def test_steps_are_not_bent_while_constraints_are_far_off():
    """One constraint is violated by more than one."""
    wanted = np.array([-1.0, *np.full(19, 5.0)])
    start = np.array([-3.0, *np.ones(19)])
    result = solve_ipm(projection(wanted), start)
    assert result.status is Status.SOLVED
    assert "bent" not in result.history[1].note


@pytest.mark.parametrize(("barrier", "follows"), [(1e-2, True), (1e-3, False)])
def test_warm_starts_follow_the_central_path_from_a_high_barrier_only(barrier, follows):
    """With multipliers of another optimum: a low barrier falls at once."""
    old = solve_ipm(projection(np.full(12, -1.0)), np.ones(12))
    program = projection(np.linspace(-2.0, 2.0, 12))
    result = solve_ipm(
        program,
        old.x,
        options=IPMOptions(barrier_warm=barrier),
        multipliers=old.multipliers,
        bound_multipliers=old.bound_multipliers,
    )
    assert result.status is Status.SOLVED
    assert (f"barrier {barrier:.0e}" in result.history[1].note) is follows
    np.testing.assert_allclose(result.x, np.maximum(np.linspace(-2.0, 2.0, 12), 0.0), atol=1e-3)


def test_many_short_steps_count_as_none(monkeypatch):
    """Every step counts as short here: after a few of them the constraints become elastic."""
    monkeypatch.setattr(interior_point, "_SHORT_STEP", 2.0)
    monkeypatch.setattr(interior_point, "_MAX_SHORT_STEPS", 2)
    case = CASES["HS71"]
    result = solve_ipm(case.build(), case.x0)
    assert next(k for k, r in enumerate(result.history) if r.note == "constraints become elastic") == 3


def test_a_failure_restarts_from_the_best_iterate(monkeypatch):
    case = CASES["HS71"]
    advance, calls = interior_point.InteriorRun._advance, []

    def failing(self, residual):
        calls.append(self.point.x)
        return Status.FAILED if len(calls) == 4 else advance(self, residual)

    monkeypatch.setattr(interior_point.InteriorRun, "_advance", failing)
    program = case.build()
    result = solve_ipm(program, case.x0)
    assert result.status is Status.SOLVED
    assert result.objective == pytest.approx(case.optimum, rel=1e-5)
    assert [r.note for r in result.history].count("again from the best iterate") == 1


def test_repeated_failures_end_the_solve(monkeypatch):
    monkeypatch.setattr(interior_point.InteriorRun, "_advance", lambda self, residual: Status.FAILED)
    case = CASES["HS71"]
    result = solve_ipm(case.build(), case.x0)
    assert result.status is Status.FAILED
    assert len(result.history) <= 3


def test_elastic_constraints_that_are_met_become_hard_again():
    """Nails in wood: the first two once ended at the iteration limit, with constraints elastic and met."""
    problem = load_problem("arm_planar")
    base = transcribed(problem)
    for resistance in (568.1043576449156, 569.6147318929434, 789.978655):
        t = changed(base, target=dataclasses.replace(problem.target, resistance=resistance))
        result = solve_ipm(t.program, first_iterate(t))
        assert result.status is Status.SOLVED and result.iterations < 200, resistance


@pytest.mark.parametrize("name", CASES)
def test_a_loose_stationarity_leaves_constraints_met(name):
    case = CASES[name]
    program = case.build()
    result = solve_ipm(program, case.x0, options=IPMOptions(kkt_tolerance=1e-2, violation_tolerance=1e-7))
    assert result.status is Status.SOLVED
    assert max_violation(program, result.x, program.constraints(result.x)) <= 1e-7
