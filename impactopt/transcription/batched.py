"""Compiled functions called for many instances through buffers."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from impactopt.errors import InputError
from impactopt.transcription.layout import Affine, Array, Index, stack

# of functions that take one instance a call: those in lanes are done before a thread has started
THREADS = 2
_LONGEST = 64  # calls at once


class BatchedFunction:
    """A CasADi function of ``count`` instances, called through its buffer: no copies, no Python lists.

    The function takes as many instances a call as z has columns.
    """

    def __init__(self, function: Any, count: int, parameters: Array) -> None:
        self._function = function
        self.columns = columns = function.size2_in(0)
        calls = -(-count // columns)
        # instances beyond `count` fill the last call up: they are the last one, again
        self.inputs = [np.zeros((calls * columns, function.size1_in(i))) for i in range(function.n_in())]
        self.count, self._shape = count, (calls * columns, function.nnz_out(0) // columns)
        self.take_parameters(parameters)
        self._parts = []  # of all instances, with the buffer of each
        for first, last in _parts(calls, calls if columns == 1 else _LONGEST):
            buffer, run = _repeated(function, last - first).buffer()
            self._parts.append((slice(first * columns, last * columns), buffer, run))
        for part, buffer, _ in self._parts:
            for i, a in enumerate(self.inputs):
                if a.size:
                    buffer.set_arg(i, a[part].data)
        self.write_to(np.zeros(self.size))

    def take_parameters(self, parameters: Array) -> None:
        """Others (count, n_p) from now on."""
        self.inputs[1][...] = parameters[np.minimum(np.arange(len(self.inputs[1])), self.count - 1)]

    def copy(self) -> BatchedFunction:
        """The same, with numbers of its own."""
        return BatchedFunction(self._function, self.count, self.inputs[1][: self.count])

    @property
    def size(self) -> int:
        """Numbers that a call writes: those of the instances, and behind them what fills the last call up."""
        return self._shape[0] * self._shape[1]

    def write_to(self, numbers: Array) -> None:
        """Sets the array (size,) that later calls write to."""
        self._all = numbers.reshape(self._shape)
        self.output = self._all[: self.count]
        for part, buffer, _ in self._parts if numbers.size else ():
            buffer.set_res(0, self._all[part].data)

    def __call__(self, z: Array, multipliers: Array | None = None) -> Array:
        """Rows are instances: z (count, n_z) -> (count, nnz of the output).

        The result is overwritten by the next call.
        """
        self.inputs[0][: self.count] = z
        self.inputs[0][self.count :] = z[-1:]
        if multipliers is not None:
            self.inputs[2][: self.count] = multipliers
        for _, _, run in self._parts:
            run()
        return self.output

    @property
    def pattern(self) -> tuple[Index, Index]:
        """Rows and columns of an instance's nonzeros, in CasADi's (column-major) order."""
        rows, columns = pattern(self._function.sparsity_out(0))
        return rows[: self.output.shape[1]], columns[: self.output.shape[1]]


def _parts(calls: int, longest: int) -> Iterator[tuple[int, int]]:
    """First and last of as few calls at once as there are powers of two, up to ``longest``."""
    first = 0
    while first < calls:
        size = min(calls - first, longest)
        size = size if size in (calls, longest) else 1 << (size.bit_length() - 1)
        yield first, first + size
        first += size


@functools.lru_cache(maxsize=1024)
def _repeated(function: Any, calls: int) -> Any:
    """So many calls at once: for a hundred, CasADi takes longer to make this than to run it ten times."""
    threads = ("thread", THREADS) if function.size2_in(0) == 1 else ()
    return function.map(calls, *threads) if calls > 1 else function


def pattern(sparsity: Any) -> tuple[Index, Index]:
    """Rows and columns of a CasADi sparsity's nonzeros, in its (column-major) order."""
    start = np.array(sparsity.colind(), dtype=np.intp)
    columns = np.repeat(np.arange(sparsity.size2()), start[1:] - start[:-1])
    return np.array(sparsity.row(), dtype=np.intp), columns


@dataclass
class Block:
    """``count`` instances of a compiled function  out = f(z), its Jacobian and the Hessian of lambda.out."""

    name: str
    value: BatchedFunction
    jacobian: BatchedFunction
    hessian: BatchedFunction
    n_in: int
    n_out: int
    count: int
    lift: Affine  # (count * n_in)
    jac_pattern: tuple[Index, Index]
    hess_pattern: tuple[Index, Index]

    @property
    def parameters(self) -> Array:
        """(count, n_p)"""
        return self.value.inputs[1][: self.count]

    def take_parameters(self, parameters: Array) -> None:
        """Others (count, n_p), or (n_p,) of all, from now on."""
        parameters = np.broadcast_to(parameters, self.parameters.shape)
        for function in (self.value, self.jacobian, self.hessian):
            function.take_parameters(parameters)

    def copy(self) -> Block:
        """The same for another program: a program tells its functions where to write."""
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
        """``functions``: of one instance, or `in_lanes`; ``instances``: of each, the slots that make up z.

        ``parameters``: (n_p,) for all or (count, n_p).
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
        """Makes the block (:meth:`make`) with the z of all instances (count * n_in) as one expression."""
        f, j, h = functions[name], functions[f"{name}_jac"], functions[f"{name}_hess"]
        n_in, n_out = f.size1_in(0), f.size1_out(0)
        p, n_p = np.asarray(parameters, dtype=float), f.size1_in(1)
        if p.ndim and p.shape[-1] != n_p:
            raise InputError(f"block {name} takes {n_p} numbers, was given {p.shape[-1]}")
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
