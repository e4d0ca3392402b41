"""Objective of a program: minus the weighted sum of the problem's objectives, plus small regularizing costs.

Every objective is affine or quadratic in the variables. What is neither is an output of a block first, with a
variable that equals it (:meth:`impactopt.transcription.builder.Builder.lift`); only what a problem asks for
is there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import scipy.sparse as sp

from impactopt.errors import InputError
from impactopt.problem.motion_style import MotionPrices
from impactopt.problem.objectives import Objective
from impactopt.transcription.builder import Builder
from impactopt.transcription.layout import Affine, Array, Group, Layout, stack
from impactopt.transcription.motion_phase import MotionPhase


@dataclass(frozen=True)
class Quantity:
    """Quantity that an objective weighs: an affine expression plus the squares of a group of variables."""

    affine: Affine
    squares: Group | None = None

    def evaluate(self, x: Array) -> float:
        """Its value for solver variables (n,)."""
        squared = float(np.sum(self.squares.read(x) ** 2)) if self.squares is not None else 0.0
        return float(self.affine.evaluate(x)[0]) + squared


def quantities(program: Any, objectives: tuple[Objective, ...]) -> list[tuple[Objective, Quantity]]:
    """Objectives with their quantities; adds what they need to the program, which they get to see whole."""
    return [(o, _quantity(program, o)) for o in objectives]


def _quantity(program: Any, objective: Objective) -> Quantity:
    found = objective.quantity(program)
    whole = found if isinstance(found, Quantity) else Quantity(found)
    if not isinstance(whole.affine, Affine) or whole.affine.size != 1:
        raise InputError(
            f"{type(objective).__name__}.quantity gave {found!r}; give one affine expression, such as "
            "program.swing_T[0], or an impactopt.transcription.objective.Quantity"
        )
    return whole


@dataclass(frozen=True)
class Prices:
    """1/2 x'Qx + q'x + constant [N s], small beside the objectives: what makes the optimum unique."""

    quadratic: Any
    linear: Array
    constant: float = 0.0

    def __add__(self, other: Prices) -> Prices:
        return Prices(
            self.quadratic + other.quadratic, self.linear + other.linear, self.constant + other.constant
        )

    def evaluate(self, x: Array) -> float:
        """Their sum [N s] for solver variables (n,)."""
        return float(x @ (self.quadratic @ x) / 2 + self.linear @ x) + self.constant


def assemble(
    layout: Layout, wanted: list[tuple[Objective, Quantity]], prices: Prices
) -> tuple[Affine, Any, Array]:
    """Objective, Q and q of :class:`impactopt.transcription.structured.StructuredProgram` [N s]."""
    objective, diagonal = Affine.constant(prices.constant), np.zeros(layout.n)
    for o, quantity in wanted:
        worth = -o.weight if o.cost else o.weight
        objective = objective - quantity.affine * worth
        if (group := quantity.squares) is not None:
            span = slice(group.offset, group.offset + group.count * group.size)
            diagonal[span] -= 2 * worth * np.tile(group.scale**2, group.count)
    return objective, prices.quadratic + sp.diags_array(diagonal), prices.linear


def wrench_prices(b: Builder, groups: list[tuple[Group, int]]) -> Array:
    """Diagonal (n,) of the price of sole wrenches: the mean of so many nodes as each group comes with."""
    diagonal = np.zeros(b.layout.n)
    for group, nodes in groups:
        span = slice(group.offset, group.offset + group.count * group.size)
        diagonal[span] = b.problem.wrench_price / max(1, nodes)
    return diagonal


def motion_prices(
    b: Builder, motions: Sequence[MotionPhase], to_rest: Sequence[MotionPhase], wrenches: list[Group]
) -> Prices:
    """Small prices of accelerations, of sole wrenches, and of ending away from the start posture.

    to_rest : those of the motions that end at rest.  wrenches : the means of these groups.
    """
    p = b.problem
    prices = MotionPrices(acceleration=p.smoothness, end=p.return_price)
    of_wrenches = wrench_prices(b, [(group, group.count) for group in wrenches])
    return _priced(b, prices, motions, to_rest) + Prices(sp.diags_array(of_wrenches), np.zeros(b.layout.n))


def style_prices(b: Builder, motions: Sequence[MotionPhase], to_rest: Sequence[MotionPhase]) -> Prices:
    """Prices of the problem's motion style."""
    return _priced(b, b.problem.style_prices, motions, to_rest)


def _priced(
    b: Builder, prices: MotionPrices, motions: Sequence[MotionPhase], to_rest: Sequence[MotionPhase]
) -> Prices:
    """Integrals by the nodes' shares of a phase; its typical duration makes all of it quadratic."""
    n, c = b.layout.n, b.coordinates
    speeds = np.full(b.ny, prices.speed)
    speeds[: c.base] *= not c.drifts  # the blow says how fast it drifts
    speeds[c.base :] += prices.idle_speed * b.problem.idle_joints[c.independent]
    priced: list[Affine] = []
    for motion in motions:
        T = float(np.mean(motion.phase.duration))
        for s, length in zip(motion.nodes, np.gradient(motion.nodes), strict=True):
            _, rate, bend = motion.at(s)
            if prices.acceleration:
                priced.append(bend * np.sqrt(2 * prices.acceleration * length / T**3))
            if speeds.any():
                priced.append(rate * np.sqrt(2 * speeds * length / T))
        for s, end in pairwise(motion.breaks) if prices.jerk else ():  # of a cubic it is constant there
            step = motion.at(float(end))[2] - motion.at(float(s))[2]
            priced.append(step * np.sqrt(2 * prices.jerk / (T**5 * (end - s))))
    m = sp.csr_array((0, n))
    constants = np.zeros(0)
    if priced:
        weighted = stack(priced)
        m, constants = weighted.matrix(n), weighted.const
    linear, constant = m.T @ constants, float(constants @ constants) / 2
    diagonal = np.zeros(n)
    for motion in to_rest:  # price (y_end - y_start)^2
        known = 6 * c.drifts
        end, start = motion.c.index(-1)[known:], b.y0[known:]
        diagonal[end] += 2 * prices.end
        linear[end] -= 2 * prices.end * start
        constant += prices.end * float(start @ start)
    return Prices(m.T @ m + sp.diags_array(diagonal), linear, constant)
