"""Objective of an NLP: minus the weighted sum of the problem's objectives, plus small regularizing costs.

It is quadratic in the variables. Another function is an output of a block, with a variable that equals it
(:meth:`impactopt.transcription.builder.Builder.lift`); it is in the program only if an objective needs it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import scipy.sparse as sp

from impactopt.arrays import Array
from impactopt.errors import InputError
from impactopt.problem.objectives import MotionPrices, Objective
from impactopt.transcription.builder import Builder
from impactopt.transcription.layout import Affine, Group, Layout, stack
from impactopt.transcription.motion_phase import MotionPhase


@dataclass(frozen=True)
class Quantity:
    """Quantity of an objective: an affine expression plus the sum of squares of a group of variables."""

    affine: Affine
    squares: Group | None = None

    def evaluate(self, x: Array) -> float:
        """Value at solver variables x (n,)."""
        squared = float(np.sum(self.squares.read(x) ** 2)) if self.squares is not None else 0.0
        return float(self.affine.evaluate(x)[0]) + squared


def quantities(program: Any, objectives: tuple[Objective, ...]) -> list[tuple[Objective, Quantity]]:
    """Objectives with their quantities, which may add variables and constraints to the program."""
    return [(o, _quantity(program, o)) for o in objectives]


def _quantity(program: Any, objective: Objective) -> Quantity:
    found = objective.quantity(program)
    quantity = found if isinstance(found, Quantity) else Quantity(found)
    if not isinstance(quantity.affine, Affine) or quantity.affine.size != 1:
        raise InputError(
            f"{type(objective).__name__}.quantity gave {found!r}; give one affine expression, such as "
            "program.swing_T[0], or an impactopt.transcription.objective.Quantity"
        )
    if not quantity.affine.finite:
        raise InputError(f"{type(objective).__name__}.quantity has a number that is not finite")
    return quantity


@dataclass(frozen=True)
class Prices:
    """Regularizing cost  1/2 x'Qx + q'x + constant  [N s], which makes the optimum unique.

    quadratic (n, n) : Q.  linear (n,) : q.
    """

    quadratic: Any
    linear: Array
    constant: float = 0.0

    def __add__(self, other: Prices) -> Prices:
        return Prices(
            self.quadratic + other.quadratic, self.linear + other.linear, self.constant + other.constant
        )

    def evaluate(self, x: Array) -> float:
        """Cost [N s] at solver variables x (n,)."""
        return float(x @ (self.quadratic @ x) / 2 + self.linear @ x) + self.constant


def assemble(
    layout: Layout, wanted: list[tuple[Objective, Quantity]], prices: Prices
) -> tuple[Affine, Any, Array]:
    """Objective, Q and q of :class:`impactopt.transcription.structured.StructuredProgram` [N s]."""
    objective, diagonal = Affine.constant(prices.constant), np.zeros(layout.n)
    for o, quantity in wanted:
        gain = -o.weight if o.cost else o.weight  # the program minimizes, so gains are subtracted
        objective = objective - quantity.affine * gain
        if (group := quantity.squares) is not None:
            span = slice(group.offset, group.offset + group.count * group.size)
            # 1/2 x'Qx has the factor 1/2, and x is in solver units: physical value = scale x
            diagonal[span] -= 2 * gain * np.tile(group.scale**2, group.count)
    return objective, prices.quadratic + sp.diags_array(diagonal), prices.linear


def wrench_prices(b: Builder, groups: list[tuple[Group, int]]) -> Array:
    """Diagonal (n,) of the price of sole wrenches.

    groups : groups of wrenches, each with a number of nodes by which its price is divided.
    """
    diagonal = np.zeros(b.layout.n)
    for group, nodes in groups:
        span = slice(group.offset, group.offset + group.count * group.size)
        diagonal[span] = b.problem.wrench_price / max(1, nodes)
    return diagonal


def motion_prices(
    b: Builder, motions: Sequence[MotionPhase], to_rest: Sequence[MotionPhase], wrenches: list[Group]
) -> Prices:
    """Small prices of accelerations, sole wrenches, and the distance of the end posture from the start.

    to_rest : those of the motions that end at rest.  wrenches : groups whose mean squares are priced.
    """
    p = b.problem
    prices = MotionPrices(acceleration=p.smoothness, end=p.return_price)
    of_wrenches = wrench_prices(b, [(group, group.count) for group in wrenches])
    return cost_of_motion(b, prices, motions, to_rest) + Prices(
        sp.diags_array(of_wrenches), np.zeros(b.layout.n)
    )


def cost_of_motion(
    b: Builder, prices: MotionPrices, motions: Sequence[MotionPhase], to_rest: Sequence[MotionPhase]
) -> Prices:
    """Cost of prices of integrals over motions, and of the end posture.

    to_rest : those of the motions that end at rest.

    Integrals become sums over the nodes, |M x + constants|^2 / 2. With the duration as a variable they would
    not be quadratic, so each phase's mean permitted duration T stands for it.
    """
    n, c = b.layout.n, b.coordinates
    speeds = np.full(b.ny, prices.speed)
    speeds[: c.base] *= not c.drifts  # after contact the impact fixes how fast a free-floating base drifts
    speeds[c.base :] += prices.idle_speed * b.problem.idle_joints[c.independent]
    residuals: list[Affine] = []
    for motion in motions:
        T = float(np.mean(motion.phase.duration))
        # `np.gradient` gives each node half of the intervals beside it, and an end node the whole of its one.
        for s, length in zip(motion.nodes, np.gradient(motion.nodes), strict=True):
            _, y1, y2 = motion.at(s)
            # integral of (y''/T^2)^2 dt, dt = T ds
            if prices.acceleration:
                residuals.append(y2 * np.sqrt(2 * prices.acceleration * length / T**3))
            if speeds.any():
                residuals.append(y1 * np.sqrt(2 * speeds * length / T))
        # the jerk of a cubic spline is constant in an interval: y''' = step / (end - s)
        for s, end in pairwise(motion.breaks) if prices.jerk else ():
            step = motion.at(float(end))[2] - motion.at(float(s))[2]
            # integral of (y'''/T^3)^2 dt over the interval, dt = T ds: step^2 / (T^5 (end - s))
            residuals.append(step * np.sqrt(2 * prices.jerk / (T**5 * (end - s))))
    m = sp.csr_array((0, n))
    constants = np.zeros(0)
    if residuals:
        stacked = stack(residuals)
        m, constants = stacked.matrix(n), stacked.const
    # |M x + k|^2 / 2 = x'M'M x / 2 + k'M x + k'k / 2
    linear, constant = m.T @ constants, float(constants @ constants) / 2
    diagonal = np.zeros(n)
    for motion in to_rest:  # price (y_end - y_start)^2, without the pose of a free-floating base
        known = 6 * c.drifts
        end, start = motion.c.index(-1)[known:], b.y0[known:]
        diagonal[end] += 2 * prices.end
        linear[end] -= 2 * prices.end * start
        constant += prices.end * float(start @ start)
    return Prices(m.T @ m + sp.diags_array(diagonal), linear, constant)
