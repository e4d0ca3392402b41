"""Small programs where theory promises little: dependent rows, no constraint qualification, no solution."""

from __future__ import annotations

import casadi as ca

from support.textbook import INF, Case, Textbook


def _case(x0, optimum, objective, rows=None, *, lower=-INF, upper=INF):
    return Case(lambda: Textbook(len(x0), objective, rows, lower=lower, upper=upper), x0, optimum)


# Multipliers exist, but not only one set of them: the gradients of the active rows are dependent.
DEPENDENT: dict[str, Case] = {
    "an equality three times": _case(
        (-4.0, 1.0, 1.0), 0.0,
        lambda x, y, z: (x + y) ** 2 + (y + z) ** 2,
        lambda x, y, z: [
            (1, x + 2 * y + 3 * z, 1), (-2, -2 * x - 4 * y - 6 * z, -2), (10, 10 * x + 20 * y + 30 * z, 10)
        ],
    ),
    "an equality and its square": _case(
        (2.0, 1.0), 2.0,
        lambda x, y: x**2 + (y - 1) ** 2 + 2 * x * y,
        lambda x, y: [(1, x, 1), (1, x**2, 1), (0, y, 0)],
    ),
    "four rows through a vertex": _case(
        (-1.0, 0.0), 2.0,
        lambda x, y: (x - 2) ** 2 + (y - 2) ** 2,
        lambda x, y: [(-INF, x + y, 2), (-INF, x, 1), (-INF, y, 1), (-INF, 2 * x + y, 3)],
    ),
    "a row and a bound that say the same": _case(
        (3.0, 3.0), 1.0,
        lambda x, y: x**2 + (x - y) ** 2,
        lambda x, y: [(2, 2 * x, INF), (-1e3, x - y, 1e3)],
        lower=(1, -INF),
    ),
    # LICQ holds nowhere on the line, MFCQ neither: an equality written as two rows
    "an equality as two rows": _case(
        (0.3, -0.2), -2.0**0.5,
        lambda x, y: x + y,
        lambda x, y: [(-INF, x**2 + y**2, 1), (1, x**2 + y**2, INF)],
    ),
    # x y <= 0 beside x, y >= 0: MFCQ fails at every point that is feasible
    "complementarity": _case(
        (0.9, 0.2), 1.0,
        lambda x, y: (x - 1) ** 2 + (y - 1) ** 2,
        lambda x, y: [(-INF, x * y, 0)],
        lower=0,
    ),
    # Hock and Schittkowski 55: six equalities of rank five; the book starts near its other optimum, 20/3
    "HS55": _case(
        (0.1, 1.3, 1.6, 0.9, 0.7, 0.4), 19 / 3,
        lambda a, b, c, d, e, f: a + 2 * b + 4 * e + ca.exp(a * d),
        lambda a, b, c, d, e, f: [
            (6, a + 2 * b + 5 * e, 6), (3, a + b + c, 3), (2, d + e + f, 2),
            (1, a + d, 1), (2, b + e, 2), (2, c + f, 2),
        ],
        lower=0, upper=(1, INF, INF, 1, INF, INF),
    ),
}  # fmt: skip

# No multipliers exist at the optimum: the gradients of the active rows vanish, or cancel.
NO_MULTIPLIERS: dict[str, Case] = {
    # Hock and Schittkowski 13: the feasible set ends in a cusp
    "cusp": _case(
        (0.5, 0.05), 1.0,
        lambda x, y: (x - 2) ** 2 + y**2,
        lambda x, y: [(0, (1 - x) ** 3 - y, INF)],
        lower=0,
    ),
    "an equality squared": _case(
        (1.0, 1.0), 1.0, lambda x, y: (x - 1) ** 2 + y**2, lambda x, y: [(0, x**2, 0)]
    ),
    "two disks that touch": _case(
        (0.4, 0.6), 1.0,
        lambda x, y: (y - 1) ** 2 + x,
        lambda x, y: [(-INF, (x - 1) ** 2 + y**2, 1), (-INF, (x + 1) ** 2 + y**2, 1)],
    ),
}  # fmt: skip

# name -> (program, start, the rows at fault)
INFEASIBLE: dict[str, tuple[Case, tuple[str, ...]]] = {
    "two values of one variable": (
        _case((0.0, 0.0), 0.0, lambda x, y: x + y**2, lambda x, y: [(1, x, 1), (0, y, 5), (2, x, 2)]),
        ("row 1", "row 3"),
    ),
    "no square is negative": (
        _case((3.0, 1.0), 0.0, lambda x, y: y**2, lambda x, y: [(-INF, x**2, -1), (0, y, 5)]),
        ("row 1",),
    ),
    "out of the bounds": (
        _case((0.5, 0.5), 0.0, lambda x, y: x - y, lambda x, y: [(3, x + y, INF)], lower=0, upper=1),
        ("row 1",),
    ),
    # CUTE's "isolated": the point of least violation is isolated, and violates all rows alike
    "isolated": (
        _case(
            (3.0, 2.0), 0.0,
            lambda x, y: x + y,
            lambda x, y: [
                (-INF, x**2 - y, -1), (-INF, x**2 + y, -1), (-INF, y**2 - x, -1), (-INF, y**2 + x, -1)
            ],
        ),
        ("row 1", "row 2", "row 3", "row 4"),
    ),
}  # fmt: skip

UNBOUNDED: dict[str, Case] = {
    "a line": _case((1.0, 1.0), -INF, lambda x, y: x - y, lambda x, y: [(0, x + y, 1)]),
    "a parabola": _case((0.1, 0.2), -INF, lambda x, y: y**2 - x**2, lambda x, y: [(-1, y, 1)]),
}
