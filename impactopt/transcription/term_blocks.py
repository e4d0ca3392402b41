"""Blocks that a problem's terms and objectives bring, the package's own and a user's."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import casadi as ca

from impactopt.errors import InputError
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.problem.block import BlockExpression, BlockRecipe
from impactopt.problem.objectives import Objective
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import Term
from impactopt.transcription.blocks import builders
from impactopt.transcription.mesh import Elements, contact_mesh


@dataclass(frozen=True)
class ExtraBlock:
    """``key``: what shapes the block beside robot, stance and striker; ``build`` makes its expression."""

    key: tuple[Any, ...]
    build: Callable[[], BlockExpression]


def own_blocks(
    problem: ImpactProblem, c: StanceCoordinates, edges: int = 0
) -> dict[str, Callable[[], BlockExpression]]:
    """Name -> what builds it, of all that a problem's program has in any case; ``edges`` : of its polygon."""
    return builders(
        c,
        problem.striker,
        problem.law,
        problem.target,
        edges,
        instant=not problem.lasts,
        frozen=problem.frozen,
        freezes=problem.freezes,
        first=problem.first_instant,
        second="" if problem.second is None else problem.second.striker,
        chosen=problem.gain_joints,
    )


def extra_blocks(
    problem: ImpactProblem, c: StanceCoordinates, elements: Elements = ()
) -> dict[str, ExtraBlock]:
    """Block's name -> the block, of what the problem's objectives and terms ask for.

    elements : of the contact, if not those that the problem asks for.

    Raises
    ------
    InputError : a name that is taken or none for a function, something else than a block.
    """
    taken = {*own_blocks(problem, c)}
    out: dict[str, ExtraBlock] = {}
    things: list[Term | Objective] = [*problem.objectives, *problem.active_terms]
    for thing in sorted(things, key=lambda t: not type(t).__module__.startswith("impactopt.")):
        where = f"{type(thing).__name__}.blocks"
        for name, block in thing.blocks(problem, c).items():
            if not isinstance(block, (BlockExpression, BlockRecipe)):
                raise InputError(
                    f"{where}: {name!r} is {block!r}; give what impactopt.problem.block.make_block makes"
                )
            if name in taken or name in out:
                raise InputError(f"{where}: there is a block {name!r} already; give it another name")
            if not ca.Function.check_name(name):
                raise InputError(f"{where}: {name!r} is no name for a function; give letters, digits and _")
            out[name] = _extra(block, problem, elements)
    return out


def _extra(block: BlockExpression | BlockRecipe, problem: ImpactProblem, elements: Elements) -> ExtraBlock:
    if isinstance(block, BlockExpression):
        return ExtraBlock(key_of(block), lambda: block)
    if block.of_stages:
        stages = len(contact_mesh(problem, elements))
        return ExtraBlock((*block.key, stages), partial(block.build, stages))
    return ExtraBlock(block.key, block.build)


def key_of(block: BlockExpression) -> tuple[Any, ...]:
    """Hash of a block's expression, which identifies it, as a user's own block has no name."""
    stages = [stage.symbols for stage in block.through], [stage.expression for stage in block.through]
    graph = ca.Function("block", [block.z, block.p, *stages[0]], [block.out, *stages[1]])
    return hashlib.sha256(graph.serialize().encode()).hexdigest(), block.lanes
