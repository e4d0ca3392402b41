"""Interior-point method: bent steps, the watch, warm starts, short steps, restarts, elastic constraints."""

from __future__ import annotations

import dataclasses
import sys
import threading

import casadi as ca
import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from support.small_plans import changed, transcribed
from support.textbook import CASES, INF, Textbook, assert_optimal, solve_by

from impactopt import InputError, Status, load_problem
from impactopt.solvers.ipm import IPMOptions, interior_point, solve_ipm
from impactopt.solvers.program import Determined, max_violation
from impactopt.solvers.sqp import SQPOptions
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


def test_a_search_that_finds_no_point_is_repeated_with_larger_shifts(monkeypatch):
    """As where rounding refuses a step: constraints need not become elastic for that."""
    find, shifts = interior_point.LineSearch.find, []

    def refusing(self, problem, step, residual):
        shifts.append(problem.newton.shift)
        return None if len(shifts) in (4, 5) else find(self, problem, step, residual)

    monkeypatch.setattr(interior_point.LineSearch, "find", refusing)
    case = CASES["HS71"]
    result = solve_ipm(case.build(), case.x0)
    assert result.status is Status.SOLVED and result.objective == pytest.approx(case.optimum, rel=1e-5)
    assert shifts[3] < shifts[4] < shifts[5]
    assert not any("elastic" in record.note for record in result.history)


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


@pytest.mark.slow
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


@pytest.mark.parametrize("options", [IPMOptions(), SQPOptions(qp_solver="ipm")], ids=["ipm", "sqp_ipm"])
@pytest.mark.parametrize("bad", ["raises", "is nan"])
def test_a_hessian_that_cannot_be_computed_is_a_failure(bad, options):
    class Bad(Textbook):
        def hessian(self, x, sigma, multipliers):
            found = super().hessian(x, sigma, multipliers)
            if self.evaluations["hessian"] > 3:
                if bad == "raises":
                    raise ZeroDivisionError
                found.data[:] = np.nan
            return found

    case = CASES["HS71"]
    program = case.build()
    program.__class__ = Bad
    result = solve_by(program, case.x0, options)
    assert result.status is Status.FAILED
    assert np.isfinite(result.x).all()


def test_a_changing_pattern_is_an_error():
    """A dropped zero would shift all entries after it."""

    class Dropping(Textbook):
        def jacobian(self, x):
            found = super().jacobian(x).tolil()
            if self.evaluations["jacobian"] > 2:
                found[0, 0] = 0
            return sp.csc_array(found)

    case = CASES["HS43"]
    program = case.build()
    program.__class__ = Dropping
    with pytest.raises(InputError, match="pattern"):
        solve_ipm(program, case.x0)


def test_a_determined_variable_that_is_fixed_does_not_move():
    program = Textbook(
        2, lambda x, y: (y - 3) ** 2, lambda x, y: [(0.0, x - y, 0.0)], lower=[1, -INF], upper=[1, INF]
    )
    program.determined = [Determined((0,), np.array([0]))]
    result = solve_ipm(program, [1.0, 0.0])
    assert result.status is Status.SOLVED
    assert result.x == pytest.approx([1.0, 1.0], abs=1e-6)


def test_equalities_may_determine_all_variables():
    program = Textbook(2, lambda x, y: x, lambda x, y: [(1.0, x + y, 1.0), (0.0, x - y, 0.0)])
    program.determined = [Determined((0,), np.array([0, 1]))]
    result = solve_ipm(program, [0.0, 0.0])
    assert result.status is Status.SOLVED
    assert result.x == pytest.approx([0.5, 0.5], abs=1e-9)


def test_a_long_push_ends_half_way_between_the_bounds():
    program = Textbook(2, lambda x, y: (x - 0.2) ** 2 + (y - 3) ** 2, lower=0, upper=1)
    result = solve_ipm(program, [1.0, 0.0], options=IPMOptions(push=2.0))
    assert result.status is Status.SOLVED
    assert result.x == pytest.approx([0.2, 1.0], abs=1e-4)


def test_a_constraint_without_bounds_changes_no_infeasible_program():
    rows = [(5.0, lambda x, y: x**2 + y**2, INF), (-INF, lambda x, y: x**2 + y**2, 1.0)]
    free = (-INF, lambda x, y: x - y, INF)
    for several in (rows, [free, *rows]):
        program = Textbook(
            2,
            lambda x, y: (y - 3) ** 2 + (x - 0.2) ** 2,
            lambda x, y, several=several: [(low, of(x, y), high) for low, of, high in several],
            lower=-4,
            upper=4,
        )
        result = solve_ipm(program, [1.0, 0.0])
        assert result.status is Status.INFEASIBLE
        # Between both levels all points have the same sum of violations.
        assert 1.0 - 1e-3 <= np.sum(result.x**2) <= 5.0 + 1e-3


@pytest.mark.parametrize("x0", [0.0, 1.0, 5.0])
def test_a_least_sum_of_violations_is_infeasible_where_the_largest_one_is_less_elsewhere(x0):
    """x >= 1 and 300 times 0.008 x <= 0: the sum is least at 0, the largest one near 1, 120 times smaller."""
    rows = [(1.0, 1.0, INF), *[(-INF, 0.008, 0.0)] * 300]
    program = Textbook(
        1, lambda x: x**2, lambda x: [(low, of * x, high) for low, of, high in rows], lower=-10, upper=10
    )
    result = solve_ipm(program, [x0])
    assert result.status is Status.INFEASIBLE


def test_too_many_changes_of_the_aim_are_a_failure(monkeypatch):
    """Elastic constraints that are met would become hard, and may not: the solve must not go on in place."""
    monkeypatch.setattr(interior_point, "_SHORT_STEP", 2.0)
    monkeypatch.setattr(interior_point, "_MAX_SHORT_STEPS", 2)
    monkeypatch.setattr(interior_point, "_MAX_MET_ITERATIONS", 0)
    monkeypatch.setattr(interior_point, "_MAX_CHANGES", 0)
    monkeypatch.setattr(interior_point, "_MAX_RESTARTS", 0)
    result = solve_ipm(projection(np.full(3, 5.0)), np.ones(3))
    assert result.status is Status.FAILED
    assert result.iterations < 20


class LimitWatch(HalvingWatch):
    """Watch that permits no step of more than this size."""

    def __init__(self, most: float) -> None:
        super().__init__(-1)
        self.most = most

    def limit(self, x, step, most):
        return min(most, self.most / np.abs(step).max())


def test_a_watch_limits_corrected_steps():
    case, watch = CASES["Maratos"], LimitWatch(0.3)
    result = solve_ipm(case.build(), case.x0, watch=watch)
    assert result.status is Status.SOLVED
    assert any("corrections" in record.note for record in result.history)
    assert np.abs(np.diff(watch.asked, axis=0)).max() <= 0.3 * (1 + 1e-9)


def test_solves_may_run_in_threads():
    """Programs with the same equalities share Newton systems, but one at a time."""

    def program(number):
        normals = np.random.default_rng(number).normal(size=(1 + number, 6))
        found = Textbook(
            6,
            lambda *x: ca.sumsqr(ca.vertcat(*x) - 2),
            lambda *x: [
                (0.0, x[0] - x[1] - x[2], 0.0),
                *[(-INF, ca.dot(ca.DM(normal), ca.vertcat(*x)), 1.0) for normal in normals],
            ],
        )
        found.determined = [Determined((0,), np.array([0]))]
        return found

    programs = [program(k) for k in range(5)]
    wanted = [solve_ipm(p, np.zeros(6)).x for p in programs]
    found = []

    def solve_all(seed):
        for k in np.random.default_rng(seed).integers(0, 5, size=15):
            found.append(np.abs(solve_ipm(programs[k], np.zeros(6)).x - wanted[k]).max())

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        workers = [threading.Thread(target=solve_all, args=(seed,)) for seed in range(4)]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
    finally:
        sys.setswitchinterval(interval)
    assert len(found) == 60
    assert max(found) < 1e-5
