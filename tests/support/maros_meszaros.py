"""Convex QPs of Maros and Meszaros (A Repository of Convex Quadratic Programming Problems, 1999) and of CUTE.

Only those that a formula states; with the optima that are printed for them, or, where the original has ten
thousand variables and this one a few dozen, None: there the solvers have to agree.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from impactopt.solvers.sqp import QuadraticProgram
from support.textbook import CASES, INF, Case, Textbook

QPS: dict[str, Case] = {name: CASES[name] for name in ("HS21", "HS35", "HS76")}


def quadratic(program: Textbook) -> QuadraticProgram:
    """A program whose objective is quadratic and whose rows are linear, as a QP; the constant is left out."""
    zero, no_multipliers = np.zeros(program.n), np.zeros(program.m)
    offset = program.constraints(zero)
    return QuadraticProgram(
        P=program.hessian(zero, 1.0, no_multipliers).toarray(),
        q=program.gradient(zero),
        A=program.jacobian(zero).toarray(),
        lower=program.g_lower - offset,
        upper=program.g_upper - offset,
        x_lower=program.x_lower,
        x_upper=program.x_upper,
    )


def _add(name, x0, optimum, objective, rows=None, *, lower=-INF, upper=INF):
    def build():
        return Textbook(len(x0), objective, rows, lower=lower, upper=upper)

    QPS[name] = Case(build, tuple(map(float, x0)), optimum)


def _linear(A, lower, upper):
    """Rows lower <= A x <= upper, of dense A."""

    def rows(*x):
        products = [sum(a * v for a, v in zip(row, x, strict=True) if a) for row in np.asarray(A)]
        return list(zip(lower, products, upper, strict=True))

    return rows


# ---------------------------------------------------------------- small
_add(
    "HS35MOD", (0.5, 0.5, 0.5), 0.25,
    lambda x, y, z: 9 - 8 * x - 6 * y - 4 * z + 2 * x**2 + 2 * y**2 + z**2 + 2 * x * y + 2 * x * z,
    lambda x, y, z: [(-INF, x + y + 2 * z, 3)],
    lower=(0, 0.5, 0), upper=(INF, 0.5, INF),
)  # fmt: skip
_add("TAME", (0, 0), 0.0, lambda x, y: (x - y) ** 2, lambda x, y: [(1, x + y, 1)], lower=0)
_add(
    "QPTEST", (0, 0), 4.371875,
    lambda x, y: 1.5 * x - 2 * y + 4 * x**2 + 2 * x * y + 5 * y**2,
    lambda x, y: [(2, 2 * x + y, INF), (-INF, -x + 2 * y, 6)],
    lower=0, upper=(20, INF),
)  # fmt: skip


def _hs51_rows(first):
    return lambda a, b, c, d, e: [(first, a + 3 * b, first), (0, c + d - 2 * e, 0), (0, b - e, 0)]


def _hs51(a, b, c, d, e):
    return (a - b) ** 2 + (b + c - 2) ** 2 + (d - 1) ** 2 + (e - 1) ** 2


_add("HS51", (2.5, 0.5, 2, -1, 0.5), 0.0, _hs51, _hs51_rows(4))
_add(
    "HS52", (2,) * 5, 1859 / 349,
    lambda a, b, c, d, e: (4 * a - b) ** 2 + (b + c - 2) ** 2 + (d - 1) ** 2 + (e - 1) ** 2,
    _hs51_rows(0),
)  # fmt: skip
_add("HS53", (2,) * 5, 176 / 43, _hs51, _hs51_rows(0), lower=-10, upper=10)

# D x = b at (1, 2, -1, 3, -4), which is within the rows: the unconstrained minimum
_D = np.array(
    [
        [10197, -12454, -1013, 1948, 329],
        [-12454, 20909, -1733, -4914, -186],
        [-1013, -1733, 1755, 1089, -174],
        [1948, -4914, 1089, 1515, -22],
        [329, -186, -174, -22, 27],
    ],
    float,
)
_B = np.array([-9170, 17099, -2271, -4336, -43], float)
_add(
    "HS268", (1,) * 5, 0.0,
    lambda *x: 14463 + sum(
        x[i] * _D[i, j] * x[j] for i in range(5) for j in range(5)
    ) - 2 * sum(b * v for b, v in zip(_B, x, strict=True)),
    _linear(
        [[-1, -1, -1, -1, -1], [10, 10, -3, 5, 4], [-8, 1, -2, -5, 3], [8, -1, 2, 5, -3], [-4, -2, 3, -5, 1]],
        (-5, 20, -40, 11, -30), (INF,) * 5,
    ),
)  # fmt: skip

_add(
    "GENHS28", (-4,) + (1,) * 9, 0.927173694,
    lambda *x: sum((a + b) ** 2 for a, b in pairwise(x)),
    lambda *x: [(1, a + 2 * b + 3 * c, 1) for a, b, c in zip(x, x[1:], x[2:], strict=False)],
)  # fmt: skip


def _hs118(*x):
    return sum(
        2.3 * a + 1e-4 * a**2 + 1.7 * b + 1e-4 * b**2 + 2.2 * c + 1.5e-4 * c**2
        for a, b, c in zip(x[::3], x[1::3], x[2::3], strict=True)
    )


def _hs118_rows(*x):
    changes = [(-7, x[k + 3] - x[k], 7 if k % 3 == 1 else 6) for k in range(12)]
    sums = [(s, sum(x[3 * k : 3 * k + 3]), INF) for k, s in enumerate((60, 50, 70, 85, 100))]
    return [*changes, *sums]


_add(
    "HS118", (20, 55, 15, 20, 60, 20, 20, 60, 20, 20, 60, 20, 20, 60, 20), 664.82045, _hs118, _hs118_rows,
    lower=(8, 43, 3) + (0, 0, 0) * 4, upper=(21, 57, 16) + (90, 120, 60) * 4,
)  # fmt: skip


# ---------------------------------------------------------------- generated
def _cvxqp(n, m):
    """CUTE's CVXQP: sparse, ever stiffer terms, semidefinite."""

    def objective(*x):
        return sum(
            0.5 * i * (x[i - 1] + x[(2 * i - 1) % n] + x[(3 * i - 1) % n]) ** 2 for i in range(1, n + 1)
        )

    def rows(*x):
        return [(6, x[i - 1] + 2 * x[(4 * i - 1) % n] + 3 * x[(5 * i - 1) % n], 6) for i in range(1, m + 1)]

    return objective, rows


for _name, _m, _optimum in (
    ("CVXQP1_S", 50, 11590.7181),
    ("CVXQP2_S", 25, 8120.94045),
    ("CVXQP3_S", 75, 11943.4322),
):
    _add(_name, (0.5,) * 100, _optimum, *_cvxqp(100, _m), lower=0.1, upper=10)


def _semi_infinite_rows(*x):
    return [(np.tan(t), sum(v * t**k for k, v in enumerate(x)), INF) for t in np.linspace(0, 1, 301)]


# a polynomial above the tangent everywhere, as in KSIP: neighbouring rows are all but parallel
_add(
    "semi-infinite", (2,) + (0,) * 11, None,
    lambda *x: sum(v**2 / (2 * (k + 1)) + v / (k + 1) for k, v in enumerate(x)), _semi_infinite_rows,
)  # fmt: skip


def _liswet(n, k, values):
    """Li and Swetits (1993): the nearest values whose k-th differences are not negative."""
    B = [
        (-1) ** j * np.prod(range(k - j + 1, k + 1)) / max(np.prod(range(1, j + 1)), 1) for j in range(k + 1)
    ]

    def rows(*x):
        return [(0, sum(b * x[i + k - j] for j, b in enumerate(B)), INF) for i in range(n)]

    def objective(*x):
        return sum(0.5 * v**2 - c * v for v, c in zip(x, values, strict=True))

    return objective, rows


_T = np.arange(60) / 59
_SIN = 0.1 * np.sin(np.arange(1, 61))
_add("LISWET1, 60", np.zeros(60), None, *_liswet(57, 3, np.sqrt(_T) + _SIN))
_add("LISWET4, 60", np.zeros(60), None, *_liswet(57, 3, np.where(_T < 0.5, 0, 1) + _SIN))
_add("YAO, 60", np.zeros(60), None, *_liswet(58, 2, np.sin(np.arange(60) / 59)))


def _powell20(n):
    def rows(*x):
        steps = [(-0.5 + (-1) ** k * k, x[k] - x[k - 1], INF) for k in range(1, n)]
        return [*steps, (n - 0.5, x[0] - x[n - 1], INF)]

    return lambda *x: sum(0.5 * v**2 for v in x), rows


_add("POWELL20, 20", np.zeros(20), None, *_powell20(20))
