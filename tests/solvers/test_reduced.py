"""Reduced SQP: optima with each QP solver and Hessian, elimination, models, given-up constraints, weights."""

from __future__ import annotations

import itertools

import casadi as ca
import numpy as np
import pytest
from benchmarks.attempts import judged
from benchmarks.solve import planning_program, strike_program
from support.textbook import INF, Textbook, assert_optimal

import impactopt.solvers.sqp.reduced_qp as reduced_qp_module
import impactopt.solvers.sqp.solver as solver_module
from impactopt import Status
from impactopt.files.named_problems import problem_file
from impactopt.solvers.ipm import solve_ipm
from impactopt.solvers.options import make_qp_solver
from impactopt.solvers.program import Determined, TimedProgram
from impactopt.solvers.sqp import SQPOptions, solve_sqp
from impactopt.solvers.sqp.reduced_qp import QPStep, ReducedQP, Reduction, make_model

WAYS = {
    "osqp": SQPOptions(qp_solver="osqp"),
    "active_set": SQPOptions(qp_solver="active_set"),
    "bfgs": SQPOptions(qp_solver="osqp", hessian="bfgs"),
    "ipm": SQPOptions(qp_solver="ipm"),
}


class Chain(Textbook):
    """x1 = sin x0 and x2 = x1^2 + x0 are determined by x0; an equality couples them with x3."""

    determined = (
        Determined((0,), np.array([1])),
        Determined((1,), np.array([2])),
    )


def chain(bound: float = 3.0) -> Chain:
    return Chain(
        4,
        lambda a, b, c, d: -c + (d - 1) ** 2 + 0.1 * a**2,
        lambda a, b, c, d: [
            (0, b - ca.sin(a), 0),
            (0, c - b**2 - a, 0),
            (0, a * d - 1, 0),
            (-INF, c + d, bound),
        ],
        lower=-3,
        upper=3,
    )


@pytest.mark.parametrize("way", WAYS)
def test_optima_are_those_of_the_whole_program(way: str) -> None:
    program, start = chain(), [0.5, 0.0, 0.0, 0.5]
    result = solve_sqp(program, start, options=WAYS[way])
    assert result.status is Status.SOLVED
    assert_optimal(program, result)
    assert result.objective == pytest.approx(solve_ipm(chain(), start).objective, abs=1e-5)
    assert (program.evaluations["hessian"] == 0) == (way == "bfgs")


def test_qps_of_the_interior_point_method_converge_fast_near_a_solution() -> None:
    options = WAYS["ipm"]
    found = solve_sqp(chain(), [0.5, 0.0, 0.0, 0.5], options=options)
    near = solve_sqp(
        chain(),
        found.x + 1e-2,
        options=options,
        multipliers=found.multipliers,
        bound_multipliers=found.bound_multipliers,
    )
    assert near.status is Status.SOLVED
    violations = [record.max_violation for record in near.history]
    assert len(violations) <= 5
    # each linearization squares what is off
    assert all(b <= max(10 * a**2, 1e-6) for a, b in itertools.pairwise(violations))


def test_large_programs_get_qps_of_the_interior_point_method(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solver_module, "MAX_DENSE", 1)
    result = solve_sqp(chain(), [0.5, 0.0, 0.0, 0.5])
    assert result.status is Status.SOLVED
    assert "barrier" in result.history[-1].note


def test_a_hessian_that_is_not_convex_is_lifted() -> None:
    bent = Chain(
        4,
        lambda a, b, c, d: ca.cos(3 * a) - 2 * (d - 0.2) ** 2 + c,
        lambda a, b, c, d: [(0, b - ca.sin(a), 0), (0, c - b**2 - a, 0), (-INF, a + d, 1)],
        lower=-1,
        upper=1,
    )
    result = solve_sqp(bent, [0.1, 0.0, 0.0, 0.2], options=WAYS["osqp"])
    assert result.status is Status.SOLVED
    assert_optimal(bent, result)


def test_quasi_newton_steps_learn_how_the_equalities_bend() -> None:
    """The objective is straight, so that all there is to learn is the circle's curvature."""
    circle = Chain(
        4,
        lambda a, b, c, d: a + d,
        lambda a, b, c, d: [(0, b - a, 0), (0, c - b, 0), (0, a**2 + d**2 - 1, 0)],
        lower=-3,
        upper=3,
    )
    timed, multiplier = TimedProgram(circle), 50.0
    angles = (0.40, 0.41)
    points = [timed.point(np.array([np.cos(x), np.cos(x), np.cos(x), np.sin(x)])) for x in angles]
    reduction = Reduction(timed, points[0].jacobian, Chain.determined)
    rule, y = make_model(timed, WAYS["bfgs"], reduction), np.array([0.0, 0.0, multiplier])
    for point in points:
        reduction.load(point)
        model = rule.at(point, y, lambda: np.zeros((0, 1)), True)
    assert model.B.shape == (1, 1)
    assert model.B[0, 0] == pytest.approx(2 * multiplier, rel=1e-3)


def test_a_kink_is_no_curvature_to_learn() -> None:
    """The gradient jumps between two points that nearly coincide: the BFGS matrix stays."""
    bent = Chain(
        4,
        lambda a, b, c, d: c + 0.5 * (a**2 + d**2) + ca.if_else(a > 0.3, 5 * (a - 0.3), 0),
        lambda a, b, c, d: [(0, b - ca.sin(a), 0), (0, c - b**2 - a, 0)],
        lower=-3,
        upper=3,
    )
    timed = TimedProgram(bent)
    points = [
        timed.point(np.array([a, np.sin(a), np.sin(a) ** 2 + a, 0.5])) for a in (0.3 - 1e-6, 0.3 + 1e-6)
    ]
    reduction = Reduction(timed, points[0].jacobian, Chain.determined)
    rule, learned = make_model(timed, WAYS["bfgs"], reduction), []
    for point in points:
        reduction.load(point)
        learned.append(rule.at(point, np.zeros(bent.m), lambda: np.zeros((0, 2)), True).B)
    np.testing.assert_allclose(learned[1], learned[0], atol=1e-6)


def test_iterates_follow_the_curve_of_determined_variables() -> None:
    curve = lambda a: 0.3 * a**2  # noqa: E731

    class Curve(Textbook):
        determined = (Determined((0,), np.array([1])),)

    program = Curve(2, lambda a, b: (a - 2) ** 2 + b, lambda a, b: [(0, b - curve(a), 0)], lower=-9, upper=9)
    violations: list[float] = []
    result = solve_sqp(
        program,
        [-1.0, curve(-1.0)],
        options=WAYS["osqp"],
        callback=lambda record: violations.append(record.max_violation),
    )
    assert result.status is Status.SOLVED
    # the tangent leaves it by 0.3 step^2
    assert max(violations) < 1e-6


@pytest.mark.parametrize("kind", ["strike", "motion"])
def test_osqp_solves_an_arm(kind: str) -> None:
    make = strike_program if kind == "strike" else planning_program
    program, start = make(problem_file("arm_planar"), seed=0, start=1)
    result = solve_sqp(program, start, options=WAYS["osqp"])
    found = judged(program, result)
    assert result.status is Status.SOLVED
    assert found.max_violation < 1e-6
    assert found.kkt < 1e-4


def test_infeasible_programs_are_not_usable() -> None:
    result = solve_sqp(chain(bound=-5.0), [0.5, 0.0, 0.0, 0.5], options=WAYS["osqp"])
    assert not result.status.usable
    assert result.status in (Status.INFEASIBLE, Status.FAILED)
    assert result.max_violation > 1e-3


def test_basis_and_normal_step_meet_the_equalities() -> None:
    program = TimedProgram(chain())
    point = program.point(np.array([0.5, 0.1, -0.2, 0.5]))
    reduction = Reduction(program, point.jacobian, Chain.determined)
    reduction.load(point)
    assert sorted(reduction.variables) == [1, 2]
    assert reduction.T.shape == (4, 1)  # of four variables, two determined, one by the equality left
    equal = np.arange(3)
    np.testing.assert_allclose((point.jacobian @ reduction.T)[equal], 0, atol=1e-12)
    d = reduction.normal(point.g)
    np.testing.assert_allclose((point.g + point.jacobian @ d)[equal], 0, atol=1e-12)


def test_multipliers_of_equalities_make_the_gradient_zero_where_they_can() -> None:
    program = TimedProgram(chain())
    point = program.point(np.array([0.5, 0.1, -0.2, 0.5]))
    reduction = Reduction(program, point.jacobian, Chain.determined)
    reduction.load(point)
    y = reduction.add_multipliers(np.zeros(4), point.gradient)
    left = point.gradient + point.jacobian.T @ y
    np.testing.assert_allclose(left[[1, 2]], 0, atol=1e-12)
    np.testing.assert_allclose(reduction.T.T @ left, reduction.T.T @ point.gradient, atol=1e-12)


def _step(beyond: float, radius: float, monkeypatch: pytest.MonkeyPatch) -> QPStep:
    """Step of a QP that gives up constraints violated by more than this fraction of their reach."""
    monkeypatch.setattr(reduced_qp_module, "_GIVE_UP", beyond)
    program = TimedProgram(chain(bound=1.5))
    point = program.point(np.array([0.5, np.sin(0.5), np.sin(0.5) ** 2 + 0.5, 2.0]))
    reduction = Reduction(program, point.jacobian, Chain.determined)
    reduction.load(point)
    qp = ReducedQP(program, reduction, make_qp_solver("osqp"))
    model = make_model(program, WAYS["osqp"], reduction).at(
        point, np.zeros(4), lambda: qp.active(point), True
    )
    found = qp.solve(point, model, point.g, radius=radius, price=100.0, time_limit=None)
    assert found is not None
    return found


@pytest.mark.parametrize("radius", [0.1, 10.0])
def test_given_up_constraints_cost_as_much_as_elastic_ones(
    radius: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    elastic, given_up = (_step(beyond, radius, monkeypatch) for beyond in (1e9, 0.0))
    assert elastic.elastic == 1
    # inside a wide radius the constraint can be met: it returns to the working set
    assert given_up.elastic == (radius > 1)
    np.testing.assert_allclose(given_up.d, elastic.d, atol=1e-6)
    assert given_up.linear_violation == pytest.approx(elastic.linear_violation, abs=1e-6)


def test_a_structure_is_kept_for_the_next_program_that_has_it() -> None:
    first, second = TimedProgram(chain()), TimedProgram(chain(bound=1.0))
    x = np.array([0.5, 0.1, -0.2, 0.5])
    made = [Reduction(first, first.point(x).jacobian, Chain.determined)]
    made[0].release()
    made.append(Reduction(second, second.point(x).jacobian, Chain.determined))
    assert made[1]._condenser is made[0]._condenser
    other = Reduction(second, second.point(x).jacobian, Chain.determined)
    assert other._condenser is not made[1]._condenser  # as that is in use


class Geared(Textbook):
    """x0 determines x1; a constraint on x0 changes ten thousand times as fast with the residual of x1."""

    determined = (Determined((0,), np.array([1])),)


def geared(price: float = 1.0) -> Geared:
    return Geared(
        2,
        lambda a, b: -price * a + 0.5 * price * (a - 1) ** 2,
        lambda a, b: [(0, b - a, 0), (-INF, 1e4 * (b - a) + a, 0.5)],
        lower=-3,
        upper=3,
    )


def test_weights_follow_total_gradients_and_multipliers() -> None:
    program = TimedProgram(geared())
    point = program.point(np.array([0.2, 0.2]))
    reduction = Reduction(program, point.jacobian, Geared.determined)
    reduction.load(point)
    qp = ReducedQP(program, reduction, make_qp_solver("osqp"))
    assert point.row_norms[1] > 1e4
    qp.weigh(point, np.zeros(2), 100.0)
    assert program.weights[1] == pytest.approx(1.0)
    qp.weigh(point, np.array([0.0, 300.0]), 100.0)
    assert program.weights[1] * 100.0 > 300.0


def test_a_violated_constraint_with_a_long_gradient_is_met_at_once() -> None:
    violations: list[float] = []
    result = solve_sqp(
        geared(price=10.0),
        [0.6, 0.6],
        options=WAYS["osqp"],
        callback=lambda record: violations.append(record.max_violation),
    )
    assert result.status is Status.SOLVED
    assert result.x[0] == pytest.approx(0.5, abs=1e-6)
    assert max(violations) <= 0.1 + 1e-9, "the objective does not lead away from it first"
