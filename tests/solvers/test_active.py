"""Sensitivities of a textbook problem, whose solution is known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from impactopt.solvers.predictor import ActiveSystem, Offset, Predictor
from impactopt.solvers.program import Vector


class Nearest:
    """The point nearest to (a, b) with x + y = c and x <= u: for a + (c - a - b)/2 > u it is (u, c - u)."""

    n, m = 2, 1
    x_lower = np.full(2, -np.inf)

    def __init__(self, a: float, b: float, c: float, u: float) -> None:
        self.aim = np.array([a, b])
        self.x_upper = np.array([u, np.inf])
        self.g_lower = self.g_upper = np.array([c])

    def objective(self, x: Vector) -> float:
        return float(0.5 * np.sum((x - self.aim) ** 2))

    def gradient(self, x: Vector) -> Vector:
        return x - self.aim

    def constraints(self, x: Vector) -> Vector:
        return np.array([x.sum()])

    def jacobian(self, x: Vector) -> sp.csc_array:
        return sp.csc_array(np.ones((1, 2)))

    def hessian(self, x: Vector, sigma: float, multipliers: Vector) -> sp.csc_array:
        return sp.csc_array(sigma * np.eye(2))

    def constraint_name(self, i: int) -> str:
        return "sum"

    def variable_name(self, j: int) -> str:
        return "xy"[j]


def solved(p: Nearest) -> tuple[Vector, Vector, Vector]:
    """x, y and z, of both cases."""
    c, u = float(p.g_upper[0]), float(p.x_upper[0])
    y = (p.aim.sum() - c) / 2
    x = p.aim - y
    if x[0] <= u:
        return x, np.array([y]), np.zeros(2)
    x = np.array([u, c - u])
    y = float(p.aim[1] - x[1])
    return x, np.array([y]), np.array([float(p.aim[0] - u) - y, 0.0])


@pytest.mark.parametrize("u", [0.3, 5.0], ids=["held", "free"])
@pytest.mark.parametrize("change", [(0.01, 0, 0, 0), (0, 0.02, 0, 0), (0, 0, 0.03, 0), (0, 0, 0, -0.01)])
def test_a_step_leads_to_the_changed_solution(u: float, change: tuple[float, ...]) -> None:
    """Linear-quadratic: the step is exact while the active set stays."""
    numbers = np.array([2.0, 1.0, 1.5, u])
    old, new = Nearest(*numbers), Nearest(*(numbers + change))
    system = ActiveSystem(old, *solved(old))
    step = system.step(system.offset(new))
    x, y, z = solved(new)
    assert system.x + step.x == pytest.approx(x, abs=1e-9)
    assert system.y + step.y == pytest.approx(y, abs=1e-9)
    assert system.z + step.z == pytest.approx(z, abs=1e-9)
    assert (system.bounds != 0).tolist() == [u < 1.0, False]


def test_a_weakly_active_bound_is_left() -> None:
    """A multiplier of 1e-6 with a slack as large, where an interior-point method ends, is no active bound."""
    p = Nearest(2.0, 1.0, 1.5, 1.25 + 1e-4)
    x, y, _ = solved(p)
    system = ActiveSystem(p, x, y, np.array([1e-6, 0.0]))
    step = system.step(Offset(dual=np.array([-0.1, 0.1]), constraints=np.zeros(1), variables=np.zeros(2)))
    assert step.x == pytest.approx([0.1, -0.1], rel=0.02)


@pytest.mark.parametrize(
    "numbers",
    [(2.0, 1.0, 1.5, 0.9), (2.0, 1.0, 1.5, 1.4), (2.4, 1.0, 1.6, 1.3), (1.0, 1.0, 1.5, 1.3)],
    ids=["held", "let go", "held elsewhere", "free"],
)
@pytest.mark.parametrize("u", [1.2, 1.3], ids=["was held", "was free"])
def test_a_prediction_finds_the_changed_active_set(u: float, numbers: tuple[float, ...]) -> None:
    """From an active bound to an inactive one, and back; but for the proximal hundredth of a step."""
    old, new = Nearest(2.0, 1.0, 1.5, u), Nearest(*numbers)
    found = Predictor(old, *solved(old)).predict(new)
    assert found is not None and found.violation < 1e-5
    x, y, z = solved(new)
    far = 0.02 * np.linalg.norm(x - solved(old)[0])
    assert found.x == pytest.approx(x, abs=far + 1e-5)
    assert found.y == pytest.approx(y, abs=far + 1e-5)
    assert found.z == pytest.approx(z, abs=far + 1e-5)
    assert (found.z[0] > 1e-6) == (z[0] > 0)


def test_unchanged_parameters_predict_the_solution() -> None:
    """With the slack of an active bound and the multiplier of an inactive one of an interior point."""
    p = Nearest(2.0, 1.0, 1.5, 1.0)
    x = np.array([1.0 - 1e-3, 0.5 + 1e-3])
    y = p.aim[1] - x[1]
    z = np.array([p.aim[0] - x[0] - y, 0.0])
    found = Predictor(p, x, np.array([y]), z).predict(p)
    assert found is not None and found.x == pytest.approx(x, abs=1e-9)


def test_constraints_that_are_not_finite_at_the_solution_give_no_prediction() -> None:
    old, new = Nearest(2.0, 1.0, 1.5, 1.2), Nearest(2.0, 1.0, 1.5, 0.9)
    new.constraints = lambda x: np.array([x.sum() if x[0] > 1.0 else np.nan])  # type: ignore[method-assign]
    assert Predictor(old, *solved(old)).predict(new) is None
