"""Nonlinear functions of variables z and numbers p, symbolic: what constraints and objectives are written
with.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca

from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.kinematics.stages import Stage

__all__ = ["LANES", "BlockExpression", "BlockRecipe", "JointMotion", "joint_motion", "make_block"]

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


class JointMotion(NamedTuple):
    """Velocities and accelerations of all joints.

    z : what it is a function of, as `ContactProgram.drive_points` has slots for it.  velocity (n) [rad/s],
    acceleration (n) [rad/s^2].  through : of `make_block`.
    """

    z: list[Any]
    velocity: Any
    acceleration: Any
    through: list[tuple[Any, Any]]


def joint_motion(c: StanceCoordinates) -> JointMotion:
    """z = y0; d1, T1, d, T: y = y0 + T1 d1 + T d; r, r', S: ydot = r/S, yddot = r'/(S T); legs (nl)."""
    names = ("y0", "d1", "d", "r", "r1", "y", "u", "udot")
    y0, d1, d, r, r1, y, u, udot = (ca.SX.sym(name, c.ny) for name in names)
    T1, T, S, legs = ca.SX.sym("T1"), ca.SX.sym("T"), ca.SX.sym("S"), ca.SX.sym("legs", c.nl)
    v, a = c.motion(y, legs, u, udot)
    through = [(y, y0 + T1 * d1 + T * d), (u, r / S), (udot, r1 / (S * T))]
    return JointMotion([y0, d1, T1, d, T, r, r1, S, legs], v[c.base :], a[c.base :], through)
