"""Small nonlinear programs with known optima.

HSn are Hock and Schittkowski's (Test Examples for Nonlinear Programming Codes, 1981).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import scipy.sparse as sp

from impactopt.solvers.ipm import IPMOptions, solve_ipm
from impactopt.solvers.options import SolverOptions
from impactopt.solvers.program import SolverResult
from impactopt.solvers.sqp import SQPOptions, solve_sqp

INF = np.inf


class Textbook:
    """A NonlinearProgram from CasADi expressions: minimize f with rows [(lower, expression, upper), ...]."""

    def __init__(
        self, n: int, objective: Callable, rows: Callable | None = None, lower: Any = -INF, upper: Any = INF
    ):
        x = ca.SX.sym("x", n)
        f = ca.SX(objective(*ca.vertsplit(x)))
        triples = list(rows(*ca.vertsplit(x))) if rows else []
        g = ca.vertcat(*[r[1] for r in triples]) if triples else ca.SX(0, 1)
        self.n, self.m = n, len(triples)
        self.x_lower, self.x_upper = (
            np.full(n, b, float) if np.isscalar(b) else np.array(b, float) for b in (lower, upper)
        )
        self.g_lower, self.g_upper = (np.array([r[k] for r in triples], float) for k in (0, 2))
        sigma, y = ca.SX.sym("sigma"), ca.SX.sym("y", self.m)
        jacobian = ca.jacobian(g, x)
        hessian = ca.hessian(sigma * f + ca.dot(y, g), x)[0]
        # The pattern of all multipliers, so that it is the same at every call.
        self._f = ca.Function("f", [x], [f, ca.densify(ca.gradient(f, x)), ca.densify(g)])
        self._jacobian, self._hessian = (
            ca.Function("J", [x], [jacobian]),
            ca.Function("H", [x, sigma, y], [hessian]),
        )
        self.evaluations = {"objective": 0, "constraints": 0, "gradient": 0, "jacobian": 0, "hessian": 0}

    def objective(self, x):
        self.evaluations["objective"] += 1
        return float(self._f(x)[0])

    def gradient(self, x):
        self.evaluations["gradient"] += 1
        return np.array(self._f(x)[1]).ravel()

    def constraints(self, x):
        self.evaluations["constraints"] += 1
        return np.array(self._f(x)[2]).ravel()

    def jacobian(self, x):
        self.evaluations["jacobian"] += 1
        return _csc(self._jacobian(x))

    def hessian(self, x, sigma, multipliers):
        self.evaluations["hessian"] += 1
        return _csc(self._hessian(x, sigma, multipliers))

    def constraint_name(self, i):
        return f"row {i + 1}"

    def variable_name(self, j):
        return f"x{j + 1}"


def _csc(matrix):
    pattern = matrix.sparsity()
    data = (np.array(matrix.nonzeros()), np.array(pattern.row()), np.array(pattern.colind()))
    return sp.csc_array(data, shape=matrix.shape)


@dataclass(frozen=True)
class Case:
    """A program, the start the book gives, and its optimal value."""

    build: Callable[[], Textbook]
    x0: tuple[float, ...]
    optimum: float


def _case(x0, optimum, objective, rows=None, **bounds):
    return Case(lambda: Textbook(len(x0), objective, rows, **bounds), tuple(x0), optimum)


def _hs100(x1, x2, x3, x4, x5, x6, x7):
    return (
        (x1 - 10) ** 2 + 5 * (x2 - 12) ** 2 + x3**4 + 3 * (x4 - 11) ** 2 + 10 * x5**6 + 7 * x6**2 + x7**4
        - 4 * x6 * x7 - 10 * x6 - 8 * x7
    )  # fmt: skip


def _hs100_rows(x1, x2, x3, x4, x5, x6, x7):
    return [
        (0, 127 - 2 * x1**2 - 3 * x2**4 - x3 - 4 * x4**2 - 5 * x5, INF),
        (0, 282 - 7 * x1 - 3 * x2 - 10 * x3**2 - x4 + x5, INF),
        (0, 196 - 23 * x1 - x2**2 - 6 * x6**2 + 8 * x7, INF),
        (0, -4 * x1**2 - x2**2 + 3 * x1 * x2 - 2 * x3**2 - 5 * x6 + 11 * x7, INF),
    ]


def _rosenbrock(*x):
    return sum(100 * (b - a**2) ** 2 + (1 - a) ** 2 for a, b in pairwise(x))


CASES: dict[str, Case] = {
    "HS6": _case(
        (-1.2, 1), 0.0,
        lambda x, y: (1 - x) ** 2,
        lambda x, y: [(0, 10 * (y - x**2), 0)],
    ),
    "HS7": _case(
        (2, 2), -np.sqrt(3),
        lambda x, y: ca.log(1 + x**2) - y,
        lambda x, y: [(4, (1 + x**2) ** 2 + y**2, 4)],
    ),
    "HS10": _case(
        (-10, 10), -1.0,
        lambda x, y: x - y,
        lambda x, y: [(0, -3 * x**2 + 2 * x * y - y**2 + 1, INF)],
    ),
    "HS12": _case(
        (0, 0), -30.0,
        lambda x, y: x**2 / 2 + y**2 - x * y - 7 * x - 7 * y,
        lambda x, y: [(0, 25 - 4 * x**2 - y**2, INF)],
    ),
    "HS14": _case(
        (2, 2), 9 - 2.875 * np.sqrt(7),
        lambda x, y: (x - 2) ** 2 + (y - 1) ** 2,
        lambda x, y: [(0, -(x**2) / 4 - y**2 + 1, INF), (0, x - 2 * y + 1, 0)],
    ),
    "HS21": _case(
        (-1, -1), -99.96,
        lambda x, y: 0.01 * x**2 + y**2 - 100,
        lambda x, y: [(0, 10 * x - y - 10, INF)],
        lower=(2, -50), upper=50,
    ),
    "HS26": _case(
        (-2.6, 2, 2), 0.0,
        lambda x, y, z: (x - y) ** 2 + (y - z) ** 4,
        lambda x, y, z: [(0, (1 + y**2) * x + z**4 - 3, 0)],
    ),
    "HS28": _case(
        (-4, 1, 1), 0.0,
        lambda x, y, z: (x + y) ** 2 + (y + z) ** 2,
        lambda x, y, z: [(0, x + 2 * y + 3 * z - 1, 0)],
    ),
    "HS35": _case(
        (0.5, 0.5, 0.5), 1 / 9,
        lambda x, y, z: 9 - 8 * x - 6 * y - 4 * z + 2 * x**2 + 2 * y**2 + z**2 + 2 * x * y + 2 * x * z,
        lambda x, y, z: [(0, 3 - x - y - 2 * z, INF)],
        lower=0,
    ),
    "HS39": _case(
        (2, 2, 2, 2), -1.0,
        lambda a, b, c, d: -a,
        lambda a, b, c, d: [(0, b - a**3 - c**2, 0), (0, a**2 - b - d**2, 0)],
    ),
    "HS40": _case(
        (0.8, 0.8, 0.8, 0.8), -0.25,
        lambda a, b, c, d: -a * b * c * d,
        lambda a, b, c, d: [(0, a**3 + b**2 - 1, 0), (0, a**2 * d - c, 0), (0, d**2 - b, 0)],
    ),
    "HS43": _case(
        (0, 0, 0, 0), -44.0,
        lambda a, b, c, d: a**2 + b**2 + 2 * c**2 + d**2 - 5 * a - 5 * b - 21 * c + 7 * d,
        lambda a, b, c, d: [
            (0, 8 - a**2 - b**2 - c**2 - d**2 - a + b - c + d, INF),
            (0, 10 - a**2 - 2 * b**2 - c**2 - 2 * d**2 + a + d, INF),
            (0, 5 - 2 * a**2 - b**2 - c**2 - 2 * a + b + d, INF),
        ],
    ),
    "HS48": _case(
        (3, 5, -3, 2, -2), 0.0,
        lambda a, b, c, d, e: (a - 1) ** 2 + (b - c) ** 2 + (d - e) ** 2,
        lambda a, b, c, d, e: [(5, a + b + c + d + e, 5), (-3, c - 2 * (d + e), -3)],
    ),
    "HS71": _case(
        (1, 5, 5, 1), 17.0140173,
        lambda a, b, c, d: a * d * (a + b + c) + c,
        lambda a, b, c, d: [(25, a * b * c * d, INF), (40, a**2 + b**2 + c**2 + d**2, 40)],
        lower=1, upper=5,
    ),
    "HS76": _case(
        (0.5, 0.5, 0.5, 0.5), -4.681818181,
        lambda a, b, c, d: a**2 + b**2 / 2 + c**2 + d**2 / 2 - a * c + c * d - a - 3 * b + c - d,
        lambda a, b, c, d: [
            (-INF, a + 2 * b + c + d, 5),
            (-INF, 3 * a + b + 2 * c - d, 4),
            (1.5, b + 4 * c, INF),
        ],
        lower=0,
    ),
    "HS100": _case((1, 2, 0, 4, 0, 1, 1), 680.6300573, _hs100, _hs100_rows),
    # Nocedal and Wright, example 15.4: full steps from the circle raise both f and the violation.
    "Maratos": _case(
        (np.cos(0.8), np.sin(0.8)), -1.0,
        lambda x, y: 2 * (x**2 + y**2 - 1) - x,
        lambda x, y: [(1, x**2 + y**2, 1)],
    ),
    "Rosenbrock, bounded": _case((-1.2, 1, -1.2, 1), 0.0, _rosenbrock, upper=1.5, lower=-1.5),
    "Rosenbrock, bound active": _case((-1.2, 1), 0.25, _rosenbrock, upper=(0.5, 10)),
    # The gradients of the first two rows are parallel at the optimum (0, 0): no unique multipliers.
    "degenerate": _case(
        (1, 1), 0.0,
        lambda x, y: x + y**2,
        lambda x, y: [(0, x + y**2 / 10, INF), (0, 2 * x + y**2 / 5, INF), (0, x**2 + y, 5)],
    ),
}  # fmt: skip


def infeasible() -> tuple[Textbook, np.ndarray]:
    """A disk of radius 1 (row 1), a half-plane that does not reach it (row 2), and a harmless row 3."""

    def rows(x, y):
        return [(-INF, x**2 + y**2, 1), (3, x + y, INF), (-INF, x - y, 10)]

    return Textbook(2, lambda x, y: (x - 1) ** 2 + y, rows), np.array([0.3, -0.4])


def textbook_program(file, _seed, start):
    """The program that a file's name names, and a start: in place of `planning_program` of the bench."""
    if file.stem == "infeasible":
        return infeasible()
    case = CASES[file.stem]
    return case.build(), np.array(case.x0) + 0.01 * start


def solve_by(program: Textbook, x0, options: SolverOptions, **more) -> SolverResult:
    """Result of the solver whose options these are."""
    solvers: dict[type, Callable[..., SolverResult]] = {IPMOptions: solve_ipm, SQPOptions: solve_sqp}
    return solvers[type(options)](program, x0, options=options, **more)


def assert_optimal(program: Textbook, result, tolerance: float = 1e-5) -> None:
    """The KKT conditions, written out anew: rows and bounds met, stationary, signs, complementarity."""
    x, y, z = result.x, result.multipliers, result.bound_multipliers
    value = np.concatenate([program.constraints(x), x])
    lower = np.concatenate([program.g_lower, program.x_lower])
    upper = np.concatenate([program.g_upper, program.x_upper])
    multipliers = np.concatenate([y, z])
    assert (value >= lower - 1e-6).all()
    assert (value <= upper + 1e-6).all()
    scale = 1 + np.abs(multipliers).max(initial=0)
    assert np.abs(program.gradient(x) + program.jacobian(x).T @ y + z).max() <= tolerance * scale
    for v, low, high, multiplier in zip(value, lower, upper, multipliers, strict=True):
        if multiplier > tolerance * scale:
            assert v >= high - 1e-3, "a positive multiplier away from the upper bound"
        if multiplier < -tolerance * scale:
            assert v <= low + 1e-3, "a negative multiplier away from the lower bound"
