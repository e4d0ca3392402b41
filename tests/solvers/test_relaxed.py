"""Relaxed programs: least relaxations in closed form, derivatives against finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from support.textbook import INF, Textbook

from impactopt import Status
from impactopt.solvers.ipm import solve_ipm
from impactopt.solvers.relaxed import Relaxation, RelaxedProgram

NONE = np.zeros(0, dtype=np.intp)


def of(*numbers: int) -> np.ndarray:
    return np.array(numbers, dtype=np.intp)


def infeasible() -> Textbook:
    """x0 + x1 = 3 and 4 <= x0 x1 <= 4.5 with -1 <= x0 - x1 <= 1, 0 <= x <= 1."""
    return Textbook(
        2,
        lambda x, y: (x - 1) ** 2,
        lambda x, y: [(3.0, x + y, 3.0), (-1.0, x - y, 1.0), (0.5, x * y, 4.5)],
        lower=0.0,
        upper=1.0,
    )


def test_derivatives_are_those_of_differences() -> None:
    relaxed = RelaxedProgram(
        infeasible(),
        [Relaxation(of(1, 2), NONE, 2.0), Relaxation(NONE, of(0, 1), 0.5), Relaxation(of(2), of(1), 1.0)],
        np.array([0.4, 0.7]),
    )
    rng = np.random.default_rng(3)
    x, d, y = rng.normal(size=relaxed.n), rng.normal(size=relaxed.n), rng.normal(size=relaxed.m)
    h = 1e-6

    def slope(z: np.ndarray) -> np.ndarray:
        return relaxed.gradient(z) + relaxed.jacobian(z).T @ y

    along_g = (relaxed.constraints(x + h * d) - relaxed.constraints(x - h * d)) / (2 * h)
    np.testing.assert_allclose(relaxed.jacobian(x) @ d, along_g, atol=1e-8)
    curved = (slope(x + h * d) - slope(x - h * d)) / (2 * h)
    np.testing.assert_allclose(relaxed.hessian(x, 1.0, y) @ d, curved, atol=1e-8)
    along = (relaxed.objective(x + h * d) - relaxed.objective(x - h * d)) / (2 * h)
    assert relaxed.gradient(x) @ d == pytest.approx(along, abs=1e-8)


@pytest.mark.parametrize(
    ("relaxations", "sizes"),
    [
        # both upper bounds together: x = y = 1.5
        ([Relaxation(NONE, of(0, 1), 0.5)], [1.0]),
        # the second one alone, as far as the difference of one lets it: y = 2 with x = 1
        ([Relaxation(NONE, of(1), 1.0)], [1.0]),
        # the sum's unit makes it dearer than the bounds
        ([Relaxation(of(0), NONE, 0.1), Relaxation(NONE, of(0, 1), 0.5)], [0.0, 1.0]),
    ],
)
def test_bounds_move_as_far_as_they_have_to(relaxations: list[Relaxation], sizes: list[float]) -> None:
    x = np.array([0.5, 0.5])
    relaxed = RelaxedProgram(infeasible(), relaxations, x)
    result = solve_ipm(relaxed, relaxed.start(x, 1e-2))
    assert result.status is Status.SOLVED
    np.testing.assert_allclose(relaxed.sizes(result.x), sizes, atol=2e-3)


def test_both_sides_of_a_constraint_are_relaxed() -> None:
    program = Textbook(1, lambda x: x, lambda x: [(-1.0, x, 1.0)], lower=3.0, upper=INF)
    for sign in (1.0, -1.0):
        program.x_lower, program.x_upper = (np.array([v]) for v in ((3.0, INF) if sign > 0 else (-INF, -3.0)))
        x = np.array([3.0 * sign])
        relaxed = RelaxedProgram(program, [Relaxation(of(0), NONE, 4.0)], x)
        result = solve_ipm(relaxed, relaxed.start(x, 1e-2))
        assert relaxed.sizes(result.x)[0] == pytest.approx(0.5, abs=1e-3)
