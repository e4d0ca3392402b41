"""Instruction table: a function's operations as numbers, in runs of equal ones, for `transcription.simd`.

As C, an operation a line, a function of TALOS keeps a compiler busy for ten seconds. As numbers it is there
at once: an operation is the places of what it reads and of what it writes. Loops over runs of equal
operations are as quick as the lines were, megabytes of code that a CPU has to fetch, too. So operations are
brought into an order with long runs. None comes `WINDOW` operations before its turn: what they work on would
leave the caches. None is done twice, and a product and the sum with it are one.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from impactopt.codegen.compiler import address, find_compiler, native_library

__all__ = ["LESS_PRODUCT", "PRODUCT_LESS", "SUM_OF_PRODUCT", "Arranged", "arranged"]

WINDOW = 20_000
# kinds beside CasADi's: of numbers a, b, c it is a b + c, a b - c, c - a b
SUM_OF_PRODUCT, PRODUCT_LESS, LESS_PRODUCT = 252, 253, 254
_LOAD, _STORE = 250, 251
_NONE = -1
_GIVEN = {ca.OP_INPUT: 2, ca.OP_OUTPUT: 1, ca.OP_CONST: 0}
_OF_ONE = {ca.OP_SQ: ca.OP_MUL, ca.OP_TWICE: ca.OP_ADD}  # a number with itself

Numbers = npt.NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Arranged:
    """Table of instructions of a function whose registers are numbered memory places.

    words : of each run, its kind (an operation's in CasADi, or one of those above), how many operations, and
    of each the places that it reads and the one that it writes.

    Places are those of the inputs' numbers, of ``constants``, of the outputs' numbers, and of all in between:
    ``places`` in all.
    """

    words: npt.NDArray[np.uint32]
    kinds: frozenset[int]
    constants: tuple[float, ...]
    places: int


def arranged(function: ca.Function, known: Mapping[int, int]) -> Arranged | None:
    """Instruction table of an SX function of known operations, each with its number of operands; None for
    another function, or without a compiler.
    """
    library = None if find_compiler() is None else _library()
    if library is None:
        return None
    n, inputs = function.n_instructions(), sum(function.nnz_in(i) for i in range(function.n_in()))
    outputs = sum(function.nnz_out(i) for i in range(function.n_out()))
    kinds = np.fromiter(map(function.instruction_id, range(n)), np.int32, n)
    operands = {**known, **_GIVEN, **dict.fromkeys(_OF_ONE, 1)}
    if not {*kinds.tolist()} <= operands.keys():
        return None
    reads = np.zeros(max(operands) + 1, dtype=np.int32)
    reads[list(operands)] = list(operands.values())
    read, read2 = _pairs(function.instruction_input, reads[kinds])
    write, write2 = _pairs(function.instruction_output, np.where(kinds == ca.OP_OUTPUT, 2, 1))
    is_input, is_output, is_constant = (kinds == kind for kind in _GIVEN)
    constants = tuple(function.instruction_constant(int(k)) for k in np.flatnonzero(is_constant))
    fixed = inputs + len(constants) + outputs
    # numbers at fixed places
    read[is_input] = _starts(function.n_in(), function.nnz_in)[read[is_input]] + read2[is_input]
    read[is_constant] = inputs + np.arange(len(constants))
    ends = fixed - outputs + _starts(function.n_out(), function.nnz_out)
    write[is_output] = ends[write[is_output]] + write2[is_output]
    read2[is_input] = _NONE
    for kind, of_two in _OF_ONE.items():
        read2[kinds == kind] = read[kinds == kind]
        kinds[kinds == kind] = of_two
    kinds[is_input | is_constant], kinds[is_output] = _LOAD, _STORE
    words, places = np.empty(6 * n, dtype=np.uint32), np.zeros(1, dtype=np.int32)
    whole = (ca.OP_ADD, ca.OP_SUB, ca.OP_MUL, fixed, outputs, WINDOW)
    length = library.arrange(
        ctypes.c_int32(n),
        *(address(a) for a in (kinds, read, read2, write)),
        *(ctypes.c_int32(k) for k in (int(function.sz_w()), *whole)),
        address(words),
        address(places),
    )
    if length < 0:
        raise MemoryError(f"{function.name()}: no memory for {n} operations")
    done = {*kinds.tolist()} - {_LOAD, _STORE}
    return Arranged(
        words[:length].copy(),
        frozenset(
            done
            | {ca.OP_ASSIGN}
            | ({SUM_OF_PRODUCT, PRODUCT_LESS, LESS_PRODUCT} if ca.OP_MUL in done else set())
        ),
        constants,
        int(places[0]),
    )


def _pairs(of: Callable[[int], Sequence[int]], count: Numbers) -> tuple[Numbers, Numbers]:
    """First and second number (n,) of the ``count`` that are given for each instruction; _NONE where there is
    none.
    """
    # none of the short lists is kept: hundreds of thousands would keep Python's garbage collector busy
    numbers = np.fromiter(chain.from_iterable(map(of, range(count.size))), np.int32, int(count.sum()))
    out, start = np.full((2, count.size), _NONE, dtype=np.int32), np.cumsum(count) - count
    for k in range(2):
        out[k, count > k] = numbers[start[count > k] + k]
    return out[0], out[1]


def _starts(count: int, size: Callable[[int], int]) -> Numbers:
    """Offsets at which each input's or output's numbers begin."""
    return np.cumsum([0, *(size(i) for i in range(count))], dtype=np.int32)


@functools.cache
def _library() -> Any:
    library = native_library(__package__, "arrange")
    if library is not None:
        library.arrange.restype = ctypes.c_int64
    return library
