"""The proximal term of the SQP's steps: what it is, and that it changes steps but not solutions."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from support.textbook import INF, Textbook

from impactopt import Status
from impactopt.solvers.ipm import solve_ipm


def test_directions_that_nothing_decides_are_left_alone():
    # y enters no constraint and no objective: without the term its curvature is zero, and a shift is needed
    program = Textbook(2, lambda x, y: ca.exp(x) - x + 0.0 * y, lambda x, y: [(0.5, x, INF)])
    result = solve_ipm(program, [2.0, 7.0])
    assert result.status is Status.SOLVED
    assert result.x == pytest.approx([0.5, 7.0], abs=1e-5)
    assert not any("shift" in record.note for record in result.history)


def test_a_neighbouring_solution_saves_iterations():
    def program(level: float) -> Textbook:
        return Textbook(
            2, lambda x, y: (x - 2) ** 2 + (y - 1) ** 2, lambda x, y: [(-INF, x**2 + y**2, level)], lower=-5
        )

    near = solve_ipm(program(1.0), [0.1, 0.1])
    cold = solve_ipm(program(1.05), [0.1, 0.1])
    warm = solve_ipm(
        program(1.05), near.x, multipliers=near.multipliers, bound_multipliers=near.bound_multipliers
    )
    assert warm.status is Status.SOLVED
    assert warm.iterations < cold.iterations
    assert warm.x == pytest.approx(np.sqrt(1.05) * np.array([2, 1]) / np.sqrt(5), abs=1e-5)
