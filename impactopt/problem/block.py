"""Nonlinear functions of variables z and numbers p, symbolic: what constraints and objectives are written
with.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

from impactopt.kinematics.stages import Stage

__all__ = ["LANES", "BlockExpression", "BlockRecipe", "make_block"]

# Instances that a compiled block takes at once, on any CPU: where its vectors are narrower, the compiler
# takes several. Fewer, a power of two, for blocks of few instances: lanes that are idle cost as much as the
# others, in memory between the caches above all.
LANES = 8


@dataclass(frozen=True)
class BlockExpression:
    """z (variables), p (parameters), out: SX columns, and the length of each named slice of ``out``.

    through : numbers that ``out`` is written with, in stages.  lanes : of
        `impactopt.transcription.simd.in_lanes`, about as many as there are instances.
    """

    z: Any
    p: Any
    out: Any
    sizes: dict[str, int]
    through: tuple[Stage, ...] = ()
    lanes: int = LANES


def make_block(
    z: list[Any],
    p: list[Any],
    out: dict[str, Any],
    through: Sequence[tuple[Any, Any]] = (),
    lanes: int = LANES,
    stages: Sequence[Stage] = (),
) -> BlockExpression:
    """A block from parts of z and of p, and the named slices of its output.

    through : numbers that it is written with, in place of an expression of z and p each.  stages : more of
        them, each of z, p and of those before.
    """
    first = [Stage(*(ca.vertcat(*parts) for parts in zip(*through, strict=True)))] if through else []
    return BlockExpression(
        ca.vertcat(*z),
        ca.vertcat(*p),
        ca.vertcat(*out.values()),
        {k: int(v.numel()) for k, v in out.items()},
        (*first, *stages),
        lanes,
    )


@dataclass(frozen=True)
class BlockRecipe:
    """A block that is only built where its compiled functions are not in the cache.

    build : makes it; with `of_stages` from the number of collocation points of the expected contact.
    key : all that shapes it beside robot, stance, striker, that number, and this package's sources. What is
        written outside the package has to be given as the block itself: its sources are not looked at.
    """

    build: Callable[..., BlockExpression]
    key: tuple[Any, ...] = ()
    of_stages: bool = False
