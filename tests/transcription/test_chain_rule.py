"""Derivatives in stages are those of the whole expression."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray
from support.small_plans import biped_problem
from support.small_robots import biped

from impactopt.kinematics.coordinates import elimination_order, solve_in_order
from impactopt.kinematics.stages import Stage, motion_in_stages, velocity_in_stages
from impactopt.problem.block import BlockExpression
from impactopt.transcription.blocks import own_blocks
from impactopt.transcription.structured import derivative_functions

Array = NDArray[np.float64]


def written_out(expressions: list[Any], stages: tuple[Stage, ...]) -> list[Any]:
    """Expressions with the stages' expressions in place of their symbols."""
    for stage in reversed(stages):
        expressions = ca.substitute(expressions, [stage.symbols], [stage.expression])
    return expressions


def compare(z: Any, p: Any, out: Any, stages: tuple[Stage, ...], numbers: tuple[Array, ...]) -> None:
    split = derivative_functions("f", z, p, out, stages)
    whole = derivative_functions("f", z, p, written_out([out], stages)[0])
    for one, other in zip(split, whole, strict=True):
        assert one.nnz_out(0) <= other.nnz_out(0)  # nothing that only seems to depend
        a, b = (f(*numbers[: f.n_in()]).full() for f in (one, other))
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12 * np.abs(b).max())


def test_stages_written_with_stages_and_solved_for() -> None:
    """w solves A(z, s) w = -b(z, s) in two blocks; s is given."""
    rng = np.random.default_rng(0)
    z, p, s, w = (ca.SX.sym(name, n) for name, n in (("z", 4), ("p", 2), ("s", 2), ("w", 4)))
    of_z = ca.vertcat(z[0] * z[1] + p[0], ca.sin(z[2]))
    matrices = [ca.blockcat([[3 + z[0] ** 2, s[0]], [z[1], 2 + s[1] ** 2]]) for _ in range(2)]
    matrices[1] = matrices[1] * z[3]
    right = [ca.vertcat(s[0] * z[k] + p[1], ca.cos(z[k + 1]) * s[1]) for k in range(2)]
    orders = [elimination_order([rng.random((2, 2))]) for _ in range(2)]
    assert any((rows != columns).any() for rows, columns in orders)
    blocks = tuple(zip(matrices, orders, strict=True))
    solved = [solve_in_order(a, -b, order)[0] for (a, order), b in zip(blocks, right, strict=True)]
    zero = [a @ w[2 * k : 2 * k + 2] + b for k, (a, b) in enumerate(zip(matrices, right, strict=True))]
    stages = (Stage(s, of_z), Stage(w, ca.vertcat(*solved), ca.vertcat(*zero), blocks))
    out = ca.vertcat(w[0] * w[3] * z[0], s[1] * w[1] ** 2, ca.exp(w[2]) + z[3] * p[0])
    compare(z, p, out, stages, (1 + rng.random(4), rng.random(2), rng.standard_normal(3)))


@pytest.fixture(scope="module")
def blocks() -> dict[str, Callable[[], BlockExpression]]:
    problem = biped_problem()
    return own_blocks(problem, 4)


@pytest.mark.parametrize("name", ["node", "collision", "balance"])
def test_blocks_on_held_soles(blocks: dict[str, Callable[[], BlockExpression]], name: str) -> None:
    block, rng = blocks[name](), np.random.default_rng(1)
    assert any(stage.zero is not None for stage in block.through)
    numbers = [0.2 + 0.3 * rng.random(n) for n in (block.z.numel(), block.p.numel(), block.out.numel())]
    compare(block.z, block.p, block.out, block.through, (numbers[0], numbers[1], numbers[2]))


def test_motion_in_stages_is_the_motion() -> None:
    c = biped_problem(biped()).coordinates
    y, legs, u, udot = (ca.SX.sym("x", n) for n in (c.ny, c.nl, c.ny, c.ny))
    v, a, stages = motion_in_stages(c, y, legs, u, udot)
    only_v, fewer = velocity_in_stages(c, y, legs, u)
    zero = [stage.zero for stage in stages if stage.zero is not None]
    assert len(zero) == 2
    of_stages = [*written_out([v, a, *zero], tuple(stages)), *written_out([only_v], tuple(fewer))]
    plain = [*c.motion(y, legs, u, udot), c.velocity(y, legs, u)]
    rng = np.random.default_rng(2)
    at, knees = c.split(c.robot.posture("half_sitting"))
    numbers = at, knees, rng.standard_normal(c.ny), rng.standard_normal(c.ny)
    given = [y, legs, u, udot]
    found = [x.full() for x in ca.Function("f", given, of_stages)(*numbers)]
    expected = [x.full() for x in ca.Function("f", given, plain)(*numbers)]
    for one, other in zip((found[0], found[1], found[4]), expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-12)
    for left in found[2:4]:
        np.testing.assert_allclose(left, 0.0, atol=1e-9)
