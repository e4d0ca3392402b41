"""Hock and Schittkowski's programs beyond those in `textbook.py`, with the optima that the book prints.

Test Examples for Nonlinear Programming Codes, 1981; without those that have several local optima near their
start.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from support.textbook import INF, Case, Textbook

SQRT2, SQRT3 = np.sqrt(2.0), np.sqrt(3.0)
BOOK: dict[str, Case] = {}
OUT_OF_SCALE = ("HS64", "HS72")  # variables of a thousand and more, from a start of one


def _add(name, x0, optimum, objective, rows=None, *, lower=-INF, upper=INF):
    def build():
        return Textbook(len(x0), objective, rows, lower=lower, upper=upper)

    BOOK[name] = Case(build, tuple(map(float, x0)), optimum)


def _banana(x, y):
    return 100 * (y - x**2) ** 2 + (1 - x) ** 2


# ---------------------------------------------------------------- two variables
_add("HS1", (-2, 1), 0.0, _banana, lower=(-INF, -1.5))
_add("HS3", (10, 1), 0.0, lambda x, y: y + 1e-5 * (y - x) ** 2, lower=(-INF, 0))
_add("HS4", (1.125, 0.125), 8 / 3, lambda x, y: (x + 1) ** 3 / 3 + y, lower=(1, 0))
_add(
    "HS5", (0, 0), -SQRT3 / 2 - np.pi / 3,
    lambda x, y: ca.sin(x + y) + (x - y) ** 2 - 1.5 * x + 2.5 * y + 1,
    lower=(-1.5, -3), upper=(4, 3),
)  # fmt: skip
_add("HS8", (2, 1), -1.0, lambda x, y: -1 + 0 * x, lambda x, y: [(25, x**2 + y**2, 25), (9, x * y, 9)])
_add(
    "HS9", (0, 0), -0.5,
    lambda x, y: ca.sin(np.pi * x / 12) * ca.cos(np.pi * y / 16),
    lambda x, y: [(0, 4 * x - 3 * y, 0)],
)  # fmt: skip
_add(
    "HS11", (4.9, 0.1), -8.498464223,
    lambda x, y: (x - 5) ** 2 + y**2 - 25,
    lambda x, y: [(-INF, x**2 - y, 0)],
)  # fmt: skip
_add(
    "HS15", (-2, 1), 306.5, _banana,
    lambda x, y: [(1, x * y, INF), (0, x + y**2, INF)],
    upper=(0.5, INF),
)  # fmt: skip
_add(
    "HS17", (-2, 1), 1.0, _banana,
    lambda x, y: [(0, y**2 - x, INF), (0, x**2 - y, INF)],
    lower=(-0.5, -INF), upper=(0.5, 1),
)  # fmt: skip
_add(
    "HS18", (2, 2), 5.0,
    lambda x, y: 0.01 * x**2 + y**2,
    lambda x, y: [(25, x * y, INF), (25, x**2 + y**2, INF)],
    lower=(2, 0), upper=50,
)  # fmt: skip
_add(
    "HS19", (20.1, 5.84), -6961.81381,
    lambda x, y: (x - 10) ** 3 + (y - 20) ** 3,
    lambda x, y: [(100, (x - 5) ** 2 + (y - 5) ** 2, INF), (-INF, (x - 6) ** 2 + (y - 5) ** 2, 82.81)],
    lower=(13, 0), upper=100,
)  # fmt: skip
_add(
    "HS22", (2, 2), 1.0,
    lambda x, y: (x - 2) ** 2 + (y - 1) ** 2,
    lambda x, y: [(-INF, x + y, 2), (0, y - x**2, INF)],
)  # fmt: skip
_add(
    "HS23", (3, 1), 2.0,
    lambda x, y: x**2 + y**2,
    lambda x, y: [
        (1, x + y, INF), (1, x**2 + y**2, INF), (9, 9 * x**2 + y**2, INF),
        (0, x**2 - y, INF), (0, y**2 - x, INF),
    ],
    lower=-50, upper=50,
)  # fmt: skip
_add(
    "HS24", (1, 0.5), -1.0,
    lambda x, y: ((x - 3) ** 2 - 9) * y**3 / (27 * SQRT3),
    lambda x, y: [(0, x / SQRT3 - y, INF), (0, x + SQRT3 * y, 6)],
    lower=0,
)  # fmt: skip

# ---------------------------------------------------------------- three variables
_add(
    "HS27", (2, 2, 2), 0.04,
    lambda x, y, z: 0.01 * (x - 1) ** 2 + (y - x**2) ** 2,
    lambda x, y, z: [(-1, x + z**2, -1)],
)  # fmt: skip
_add(
    "HS29", (1, 1, 1), -16 * SQRT2,
    lambda x, y, z: -x * y * z,
    lambda x, y, z: [(-INF, x**2 + 2 * y**2 + 4 * z**2, 48)],
)  # fmt: skip
_add(
    "HS30", (1, 1, 1), 1.0,
    lambda x, y, z: x**2 + y**2 + z**2,
    lambda x, y, z: [(1, x**2 + y**2, INF)],
    lower=(1, -10, -10), upper=10,
)  # fmt: skip
_add(
    "HS31", (1, 1, 1), 6.0,
    lambda x, y, z: 9 * x**2 + y**2 + 9 * z**2,
    lambda x, y, z: [(1, x * y, INF)],
    lower=(-10, 1, -10), upper=(10, 10, 1),
)  # fmt: skip
_add(
    "HS32", (0.1, 0.7, 0.2), 1.0,
    lambda x, y, z: (x + 3 * y + z) ** 2 + 4 * (x - y) ** 2,
    lambda x, y, z: [(3, 6 * y + 4 * z - x**3, INF), (1, x + y + z, 1)],
    lower=0,
)  # fmt: skip
_add(
    "HS34", (0, 1.05, 2.9), -np.log(np.log(10.0)),
    lambda x, y, z: -x,
    lambda x, y, z: [(0, y - ca.exp(x), INF), (0, z - ca.exp(y), INF)],
    lower=0, upper=(100, 100, 10),
)  # fmt: skip
_add(
    "HS36", (10, 10, 10), -3300.0,
    lambda x, y, z: -x * y * z,
    lambda x, y, z: [(-INF, x + 2 * y + 2 * z, 72)],
    lower=0, upper=(20, 11, 42),
)  # fmt: skip
_add(
    "HS37", (10, 10, 10), -3456.0,
    lambda x, y, z: -x * y * z,
    lambda x, y, z: [(0, x + 2 * y + 2 * z, 72)],
    lower=0, upper=42,
)  # fmt: skip
_add(
    "HS60", (2, 2, 2), 0.03256820025,
    lambda x, y, z: (x - 1) ** 2 + (x - y) ** 2 + (y - z) ** 4,
    lambda x, y, z: [(4 + 3 * SQRT2, x * (1 + y**2) + z**4, 4 + 3 * SQRT2)],
    lower=-10, upper=10,
)  # fmt: skip
_add(
    "HS61", (0, 0, 0), -143.6461422,
    lambda x, y, z: 4 * x**2 + 2 * y**2 + 2 * z**2 - 33 * x + 16 * y - 24 * z,
    lambda x, y, z: [(7, 3 * x - 2 * y**2, 7), (11, 4 * x - z**2, 11)],
)  # fmt: skip
_add(
    "HS63", (2, 2, 2), 961.7151721,
    lambda x, y, z: 1000 - x**2 - 2 * y**2 - z**2 - x * y - x * z,
    lambda x, y, z: [(56, 8 * x + 14 * y + 7 * z, 56), (25, x**2 + y**2 + z**2, 25)],
    lower=0,
)  # fmt: skip
_add(
    "HS64", (1, 1, 1), 6299.842428,
    lambda x, y, z: 5 * x + 5e4 / x + 20 * y + 7.2e4 / y + 10 * z + 1.44e5 / z,
    lambda x, y, z: [(-INF, 4 / x + 32 / y + 120 / z, 1)],
    lower=1e-5,
)  # fmt: skip
_add(
    "HS65", (-5, 5, 0), 0.9535288567,
    lambda x, y, z: (x - y) ** 2 + (x + y - 10) ** 2 / 9 + (z - 5) ** 2,
    lambda x, y, z: [(-INF, x**2 + y**2 + z**2, 48)],
    lower=(-4.5, -4.5, -5), upper=(4.5, 4.5, 5),
)  # fmt: skip
_add(
    "HS66", (0, 1.05, 2.9), 0.5181632741,
    lambda x, y, z: 0.2 * z - 0.8 * x,
    lambda x, y, z: [(0, y - ca.exp(x), INF), (0, z - ca.exp(y), INF)],
    lower=0, upper=(100, 100, 10),
)  # fmt: skip

# ---------------------------------------------------------------- four to six variables
_add(
    "HS38", (-3, -1, -3, -1), 0.0,
    lambda a, b, c, d: (
        _banana(a, b) + 90 * (d - c**2) ** 2 + (1 - c) ** 2
        + 10.1 * ((b - 1) ** 2 + (d - 1) ** 2) + 19.8 * (b - 1) * (d - 1)
    ),
    lower=-10, upper=10,
)  # fmt: skip
_add(
    "HS41", (2, 2, 2, 2), 52 / 27,
    lambda a, b, c, d: 2 - a * b * c,
    lambda a, b, c, d: [(0, a + 2 * b + 2 * c - d, 0)],
    lower=0, upper=(1, 1, 1, 2),
)  # fmt: skip
_add(
    "HS42", (1, 1, 1, 1), 28 - 10 * SQRT2,
    lambda a, b, c, d: (a - 1) ** 2 + (b - 2) ** 2 + (c - 3) ** 2 + (d - 4) ** 2,
    lambda a, b, c, d: [(2, a, 2), (2, c**2 + d**2, 2)],
)  # fmt: skip
_add(
    "HS72", (1, 1, 1, 1), 727.67937,
    lambda a, b, c, d: 1 + a + b + c + d,
    lambda a, b, c, d: [
        (-INF, 4 / a + 2.25 / b + 1 / c + 0.25 / d, 0.0401),
        (-INF, 0.16 / a + 0.36 / b + 0.64 / c + 0.64 / d, 0.010085),
    ],
    lower=1e-3, upper=(4e5, 3e5, 2e5, 1e5),
)  # fmt: skip
_add(
    "HS73", (1, 1, 1, 1), 29.894378,
    lambda a, b, c, d: 24.55 * a + 26.75 * b + 39 * c + 40.5 * d,
    lambda a, b, c, d: [
        (5, 2.3 * a + 5.6 * b + 11.1 * c + 1.3 * d, INF),
        (
            21,
            12 * a + 11.9 * b + 41.8 * c + 52.1 * d
            - 1.645 * ca.sqrt(0.28 * a**2 + 0.19 * b**2 + 20.5 * c**2 + 0.62 * d**2),
            INF,
        ),
        (1, a + b + c + d, 1),
    ],
    lower=0,
)  # fmt: skip
_add("HS45", (2,) * 5, 1.0, lambda a, b, c, d, e: 2 - a * b * c * d * e / 120, lower=0, upper=(1, 2, 3, 4, 5))
_add(
    "HS50", (35, -31, 11, 5, -5), 0.0,
    lambda a, b, c, d, e: (a - b) ** 2 + (b - c) ** 2 + (c - d) ** 4 + (d - e) ** 2,
    lambda a, b, c, d, e: [(6, a + 2 * b + 3 * c, 6), (6, b + 2 * c + 3 * d, 6), (6, c + 2 * d + 3 * e, 6)],
)  # fmt: skip
_add(
    "HS77", (2,) * 5, 0.24150513,
    lambda a, b, c, d, e: (a - 1) ** 2 + (a - b) ** 2 + (c - 1) ** 2 + (d - 1) ** 4 + (e - 1) ** 6,
    lambda a, b, c, d, e: [
        (2 * SQRT2, a**2 * d + ca.sin(d - e), 2 * SQRT2), (8 + SQRT2, b + c**4 * d**2, 8 + SQRT2)
    ],
)  # fmt: skip


def _sphere(a, b, c, d, e):
    squares = a**2 + b**2 + c**2 + d**2 + e**2
    return [(10, squares, 10), (0, b * c - 5 * d * e, 0), (-1, a**3 + b**3, -1)]


_PEAK = {"lower": (-2.3, -2.3, -3.2, -3.2, -3.2), "upper": (2.3, 2.3, 3.2, 3.2, 3.2)}
_add("HS78", (-2, 1.5, 2, -1, -1), -2.91970041, lambda a, b, c, d, e: a * b * c * d * e, _sphere)
_add(
    "HS79", (2,) * 5, 0.0787768209,
    lambda a, b, c, d, e: (a - 1) ** 2 + (a - b) ** 2 + (b - c) ** 2 + (c - d) ** 4 + (d - e) ** 4,
    lambda a, b, c, d, e: [
        (2 + 3 * SQRT2, a + b**2 + c**3, 2 + 3 * SQRT2),
        (-2 + 2 * SQRT2, b - c**2 + d, -2 + 2 * SQRT2),
        (2, a * e, 2),
    ],
)  # fmt: skip
_add(
    "HS80",
    (-2, 2, 2, -1, -1),
    0.0539498478,
    lambda a, b, c, d, e: ca.exp(a * b * c * d * e),
    _sphere,
    **_PEAK,
)
_add(
    "HS81", (-2, 2, 2, -1, -1), 0.0539498478,
    lambda a, b, c, d, e: ca.exp(a * b * c * d * e) - 0.5 * (a**3 + b**3 + 1) ** 2, _sphere, **_PEAK,
)  # fmt: skip


# ---------------------------------------------------------------- ten variables
def _hs110(*x):
    product = 1.0
    for value in x:
        product = product * value
    return sum(ca.log(v - 2) ** 2 + ca.log(10 - v) ** 2 for v in x) - product**0.2


_ENERGIES = (-6.089, -17.164, -34.054, -5.914, -24.721, -14.986, -24.100, -10.708, -26.662, -22.179)


def _hs112(*x):
    total = sum(x)
    return sum(v * (c + ca.log(v / total)) for c, v in zip(_ENERGIES, x, strict=True))


def _hs112_rows(*x):
    return [
        (2, x[0] + 2 * x[1] + 2 * x[2] + x[5] + x[9], 2),
        (1, x[3] + 2 * x[4] + x[5] + x[6], 1),
        (1, x[2] + x[6] + x[7] + 2 * x[8] + x[9], 1),
    ]


def _hs113(a, b, c, d, e, f, g, h, i, j):
    return (
        a**2 + b**2 + a * b - 14 * a - 16 * b + (c - 10) ** 2 + 4 * (d - 5) ** 2 + (e - 3) ** 2
        + 2 * (f - 1) ** 2 + 5 * g**2 + 7 * (h - 11) ** 2 + 2 * (i - 10) ** 2 + (j - 7) ** 2 + 45
    )  # fmt: skip


def _hs113_rows(a, b, c, d, e, f, g, h, i, j):
    return [
        (-INF, 4 * a + 5 * b - 3 * g + 9 * h, 105),
        (-INF, 10 * a - 8 * b - 17 * g + 2 * h, 0),
        (-INF, -8 * a + 2 * b + 5 * i - 2 * j, 12),
        (-INF, 3 * (a - 2) ** 2 + 4 * (b - 3) ** 2 + 2 * c**2 - 7 * d, 120),
        (-INF, 5 * a**2 + 8 * b + (c - 6) ** 2 - 2 * d, 40),
        (-INF, 0.5 * (a - 8) ** 2 + 2 * (b - 4) ** 2 + 3 * e**2 - f, 30),
        (-INF, a**2 + 2 * (b - 2) ** 2 - 2 * a * b + 14 * e - 6 * f, 0),
        (-INF, -3 * a + 6 * b + 12 * (i - 8) ** 2 - 7 * j, 0),
    ]


_add("HS110", (9,) * 10, -45.77846971, _hs110, lower=2.001, upper=9.999)
_add("HS112", (0.1,) * 10, -47.76109026, _hs112, _hs112_rows, lower=1e-6)
_add("HS113", (2, 3, 5, 5, 1, 2, 7, 3, 6, 10), 24.3062091, _hs113, _hs113_rows)
