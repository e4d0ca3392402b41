"""Blocks: symbolic nonlinear functions of variables z and parameters p, of which constraints and objectives
are made.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca

from impactopt.errors import InputError
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.kinematics.stages import Stage

# Instances that a compiled block evaluates at once (SIMD). On CPUs with narrower vectors the compiler uses
# several vectors. Blocks of few instances have fewer lanes, a power of two, as idle lanes cost as much as the
# others, above all in memory traffic.
LANES = 8


@dataclass(frozen=True)
class BlockExpression:
    """Expression of a block: SX columns of the variables z, the parameters p and the output.

    sizes : length of each named slice of ``out``.  through : intermediate quantities of ``out``, in stages.
    lanes : of `impactopt.transcription.simd.in_lanes`, about the number of instances.
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
    """Block from the parts of z and of p, and the named slices of its output.

    through : intermediate symbols of ``out``, each with its expression in z and p.  stages : further
        intermediate quantities, each in z, p and those before.

    Raises
    ------
    InputError : CasADi's MX in z, p or out.
    """
    if any(isinstance(part, ca.MX) for part in [*z, *p, *out.values()]):
        raise InputError("a block has CasADi's MX; write it with SX, as casadi.SX.sym")
    first = [Stage(*(ca.vertcat(*parts) for parts in zip(*through, strict=True)))] if through else []
    return BlockExpression(
        ca.vertcat(*z),
        ca.vertcat(*p),
        ca.SX(ca.vertcat(*out.values())),
        {k: int(ca.SX(v).numel()) for k, v in out.items()},
        (*first, *stages),
        lanes,
    )


@dataclass(frozen=True)
class BlockRecipe:
    """Recipe of a block, which is built only if its compiled functions are not in the cache.

    build : makes the block; with `of_stages` from the number of collocation points of the expected contact.
    key : everything that the block depends on beside robot, stance, striker, that number, and this package's
        sources. A term outside of the package has to give the block itself, as the cache does not know its
        sources.
    """

    build: Callable[..., BlockExpression]
    key: tuple[Any, ...] = ()
    of_stages: bool = False


class JointMotion(NamedTuple):
    """Velocities and accelerations of all joints.

    z : their variables, for which `ContactProgram.drive_points` has slots.  velocity (n) [rad/s],
    acceleration (n) [rad/s^2].  through : of `make_block`.
    """

    z: list[Any]
    velocity: Any
    acceleration: Any
    through: list[tuple[Any, Any]]


def joint_motion(c: StanceCoordinates) -> JointMotion:
    """Motion of all joints, as functions of coordinates y = y0 + T1 d1 + T d, rates ydot = r/S, accelerations
    yddot = r'/(S T) and legs (nl).
    """
    names = ("y0", "d1", "d", "r", "r1", "y", "u", "udot")
    y0, d1, d, r, r1, y, u, udot = (ca.SX.sym(name, c.ny) for name in names)
    T1, T, S, legs = ca.SX.sym("T1"), ca.SX.sym("T"), ca.SX.sym("S"), ca.SX.sym("legs", c.nl)
    v, a = c.motion(y, legs, u, udot)
    through = [(y, y0 + T1 * d1 + T * d), (u, r / S), (udot, r1 / (S * T))]
    return JointMotion([y0, d1, T1, d, T, r, r1, S, legs], v[c.base :], a[c.base :], through)
