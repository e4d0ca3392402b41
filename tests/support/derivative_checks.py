"""A program's derivatives against differences."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

Array = NDArray[np.float64]


def check_derivatives(program: Any, x: Array) -> None:
    """Jacobian, Hessian and gradient at x, along dense random directions: every entry has its part."""
    rng = np.random.default_rng(0)
    y, sigma, h = rng.standard_normal(program.m), 0.7, 1e-6

    def slope(at: Array) -> Array:
        return np.asarray(sigma * program.gradient(at) + program.jacobian(at).T @ y)

    jacobian, hessian = program.jacobian(x), program.hessian(x, sigma, y)
    assert abs(hessian - hessian.T).max() < 1e-9 * abs(hessian).max()
    for _ in range(3):
        d = rng.standard_normal(program.n)
        of_rows = (program.constraints(x + h * d) - program.constraints(x - h * d)) / (2 * h)
        # against the terms that a row or a column adds up, not against their sum
        size = abs(jacobian) @ np.abs(d)
        assert (np.abs(jacobian @ d - of_rows) <= 1e-6 * size + 1e-6).all()
        of_slope = (slope(x + h * d) - slope(x - h * d)) / (2 * h)
        size = abs(hessian) @ np.abs(d)
        assert (np.abs(hessian @ d - of_slope) <= 1e-5 * size + 1e-5 * size.max()).all()
        of_f = (program.objective(x + h * d) - program.objective(x - h * d)) / (2 * h)
        assert of_f == pytest.approx(program.gradient(x) @ d, rel=1e-6, abs=1e-6)
