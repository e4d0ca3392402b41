"""The paper's computation costs, in arithmetic operations (its eqs. 18 to 23)."""

from __future__ import annotations

from dataclasses import dataclass

from impactopt.errors import InputError

TOTAL_TIME = 0.1  # [s] t_total of figs. 3 and 4


@dataclass(frozen=True, kw_only=True)
class TreeSize:
    """A robot as the formulas see it.

    Attributes
    ----------
    n : degrees of freedom.
    arms : n_1 to n_l, those of each arm or leg.
    colliding : n_k, those of the arm that collides.
    """

    n: float
    arms: tuple[float, ...]
    colliding: float


# 28 DOF without hands: legs of 6, arms of 7; chest and head make up the rest
HRP2 = TreeSize(n=28, arms=(6, 6, 7, 7), colliding=7)


def even_tree(n: float) -> TreeSize:
    """l = 4 and n_k = n / 4, as for fig. 4."""
    return TreeSize(n=n, arms=(n / 4,) * 4, colliding=n / 4)


def iterations(step: float, total: float = TOTAL_TIME) -> float:
    """T_i = t_total / t_s (19), with both in [s]."""
    if not (step > 0 and total > 0):
        raise InputError(f"step, total [s]: {step:g}, {total:g}; give numbers > 0")
    return total / step


def _once(tree: TreeSize) -> float:
    """The terms that (18) and (20) share."""
    squares = sum(k**2 for k in tree.arms)
    return (15 + 2 / 3) * tree.n**3 + 63 * tree.n**2 + 6 * squares + 18 * tree.colliding


def cost_full(tree: TreeSize, count: float) -> float:
    """C_1 of `count` iterations of steps 1a to 4a (18)."""
    return (_once(tree) + 254.5 * tree.n + 88) * count


def cost_sdc(tree: TreeSize, count: float) -> float:
    """C_2 of steps 1b, 2b, and `count` iterations of 3b to 6b (20)."""
    n = tree.n
    return _once(tree) + 242 * n + 73 + (2 * n**2 + 25 * n - 6) * count


def cost_aba(tree: TreeSize, count: float) -> float:
    """C_3 of `count` iterations of the articulated-body algorithm (22)."""
    return (373 * tree.n - 371) * count
