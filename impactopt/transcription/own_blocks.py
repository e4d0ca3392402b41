"""Blocks of terms and objectives that a user has written."""

from __future__ import annotations

import hashlib
from collections.abc import Collection
from typing import Any

import casadi as ca

from impactopt.errors import InputError
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.problem.objectives import Objective
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import Term
from impactopt.transcription.blocks import BlockExpression


def own_blocks(
    problem: ImpactProblem, c: StanceCoordinates, taken: Collection[str]
) -> dict[str, BlockExpression]:
    """Block's name -> the block, of what the problem's terms and objectives bring.

    taken : names that others have.

    Raises
    ------
    InputError : a name that is taken or none for a function, something else than a block.
    """
    out: dict[str, BlockExpression] = {}
    things: tuple[Term | Objective, ...] = (*problem.objectives, *problem.terms)
    for thing in things:
        where = f"{type(thing).__name__}.blocks"
        for name, block in thing.blocks(problem, c).items():
            if not isinstance(block, BlockExpression):
                raise InputError(
                    f"{where}: {name!r} is {block!r}; give what "
                    "impactopt.transcription.blocks.make_block makes"
                )
            if name in taken or name in out:
                raise InputError(f"{where}: there is a block {name!r} already; give it another name")
            if not ca.Function.check_name(name):
                raise InputError(f"{where}: {name!r} is no name for a function; give letters, digits and _")
            out[name] = block
    return out


def key_of(block: BlockExpression) -> tuple[Any, ...]:
    """What a block computes, as a short text: a user's own has no name to be known by."""
    inner, of_z = ([], []) if block.through is None else ([block.through[0]], [block.through[1]])
    graph = ca.Function("block", [block.z, block.p, *inner], [block.out, *of_z])
    return hashlib.sha256(graph.serialize().encode()).hexdigest(), block.lanes
