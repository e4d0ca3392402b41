"""Blocks: many instances of a compiled function with its derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from impactopt.codegen.batched import BatchedFunction
from impactopt.errors import InputError
from impactopt.transcription.layout import Affine, Array, Index, stack


@dataclass
class Block:
    """``count`` instances of a compiled function out = f(z, p), its Jacobian, and the Hessian of lambda.out.

    lift : z of all instances (count * n_in) as affine expressions in the program's variables.
    jac_pattern, hess_pattern : row and column indices of an instance's nonzeros.
    """

    name: str
    value: BatchedFunction
    jacobian: BatchedFunction
    hessian: BatchedFunction
    n_in: int
    n_out: int
    count: int
    lift: Affine
    jac_pattern: tuple[Index, Index]
    hess_pattern: tuple[Index, Index]

    @property
    def parameters(self) -> Array:
        """Parameters (count, n_p)."""
        return self.value.inputs[1][: self.count]

    def take_parameters(self, parameters: Array) -> None:
        """Use these parameters (count, n_p), or (n_p,) for all instances, from now on."""
        parameters = np.broadcast_to(parameters, self.parameters.shape)
        for function in (self.value, self.jacobian, self.hessian):
            function.take_parameters(parameters)

    def copy(self) -> Block:
        """Copy for another program, as a program sets the arrays that its blocks write to."""
        parts = {name: getattr(self, name).copy() for name in ("value", "jacobian", "hessian")}
        return replace(self, **parts)

    @classmethod
    def make(
        cls,
        name: str,
        functions: dict[str, Any],
        instances: Sequence[Sequence[Affine]],
        parameters: ArrayLike,
    ) -> Block:
        """Block whose z is given as parts.

        functions : compiled, of one instance or by `impactopt.transcription.simd.in_lanes`: ``name``,
            ``name_jac`` and ``name_hess``.
        instances : of each, the affine expressions ("slots") that make up its z, in order.
        parameters : (n_p,) for all instances, or (count, n_p).
        """
        n_in = functions[name].size1_in(0)
        lifts = [stack(slots) for slots in instances]
        for lift in lifts:
            if lift.size != n_in:
                raise InputError(f"block {name} takes {n_in} inputs, was given {lift.size}")
        return cls.of_lift(name, functions, stack(lifts), len(lifts), parameters)

    @classmethod
    def of_lift(
        cls, name: str, functions: dict[str, Any], lift: Affine, count: int, parameters: ArrayLike
    ) -> Block:
        """Block, as of :meth:`make`, with z of all instances (count * n_in) as one expression."""
        f, j, h = functions[name], functions[f"{name}_jac"], functions[f"{name}_hess"]
        n_in, n_out = f.size1_in(0), f.size1_out(0)
        p, n_p = np.asarray(parameters, dtype=float), f.size1_in(1)
        if p.ndim and p.shape[-1] != n_p:
            raise InputError(f"block {name} takes {n_p} parameters, was given {p.shape[-1]}")
        if p.ndim == 2 and len(p) not in (1, count):
            raise InputError(f"block {name} has {count} instances, was given parameters of {len(p)}")
        if np.isnan(p).any():
            raise InputError(f"block {name}: a parameter is NaN; give numbers")
        p = np.broadcast_to(p, (count, n_p))
        value, jacobian, hessian = (BatchedFunction(function, count, p) for function in (f, j, h))
        return cls(
            name=name,
            value=value,
            jacobian=jacobian,
            hessian=hessian,
            n_in=n_in,
            n_out=n_out,
            count=count,
            lift=lift,
            jac_pattern=jacobian.pattern,
            hess_pattern=hessian.pattern,
        )
