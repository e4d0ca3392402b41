"""The SQP in the variables that nothing determines: the same optima, whatever solves its QPs."""

from __future__ import annotations

import numpy as np
import pytest
from support.textbook import INF, Textbook, assert_optimal

from impactopt.solvers.program import Determined, Status
from impactopt.solvers.sqp import SQPOptions, solve_sqp
from impactopt.solvers.sqp.point import TimedProgram
from impactopt.solvers.sqp.reduction import Reduction

WAYS = {
    "osqp": SQPOptions(qp_solver="osqp"),
    "daqp": SQPOptions(qp_solver="daqp"),
    "bfgs": SQPOptions(qp_solver="osqp", hessian="bfgs"),
}


class Chain(Textbook):
    """x1 = sin x0 and x2 = x1^2 + x0 follow from x0; a row couples them with x3."""

    determined = (
        Determined((0,), np.array([1])),
        Determined((1,), np.array([2])),
    )


def chain(bound: float = 3.0) -> Chain:
    import casadi as ca

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
    assert result.objective == pytest.approx(solve_sqp(chain(), start).objective, abs=1e-5)
    assert (program.evaluations["hessian"] == 0) == (way == "bfgs")


def test_rows_that_cannot_be_met_are_said_so() -> None:
    result = solve_sqp(chain(bound=-5.0), [0.5, 0.0, 0.0, 0.5], options=WAYS["osqp"])
    assert not result.status.usable
    assert result.status in (Status.INFEASIBLE, Status.FAILED)
    assert result.max_violation > 1e-3


def test_steps_keep_what_rows_determine() -> None:
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
