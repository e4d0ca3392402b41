"""Functions of several instances at once: C in which each number of one instance is a vector, a lane each.

CasADi's C takes the instances one after the other, a number at a time. The same operations on vectors need
about as many of the CPU's instructions for eight instances as for one. They are numbers, which a few loops go
through.

As C, an operation a line, a function of TALOS keeps a compiler busy for ten seconds. As numbers it is there
at once: an operation is the places of what it reads and of what it writes. The loops are the same for all
functions, and are compiled once. Loops over runs of equal
operations are as quick as the lines were, megabytes of code that a CPU has to fetch, too. So operations are
brought into an order with long runs. None comes `WINDOW` operations before its turn: what they work on would
leave the caches. None is done twice, and a product and the sum with it are one.
"""

from __future__ import annotations

import ctypes
import functools
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from impactopt.codegen.compiler import NativeCode, SharedCode, address, find_compiler, native_library
from impactopt.problem.block import LANES

__all__ = ["LESS_PRODUCT", "PRODUCT_LESS", "SUM_OF_PRODUCT", "Arranged", "arranged", "in_lanes"]

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
    return Arranged(words[:length].copy(), constants, int(places[0]))


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


# each operation is rounded on its own, as CasADi has it: what cancels there cancels here
_LEVEL = "-O2 -ffp-contract=off -fno-strict-aliasing"

# of vectors a, b and c
_OF_VECTORS = {
    ca.OP_ASSIGN: "a",
    ca.OP_ADD: "a + b",
    ca.OP_SUB: "a - b",
    ca.OP_MUL: "a * b",
    ca.OP_DIV: "a / b",
    ca.OP_NEG: "-a",
    ca.OP_INV: "ALL(1.0) / a",
    SUM_OF_PRODUCT: "a * b + c",
    PRODUCT_LESS: "a * b - c",
    LESS_PRODUCT: "c - a * b",
}
# of the numbers x and y of each lane
_IN_EACH_LANE = {
    ca.OP_SQRT: "sqrt(x)",
    ca.OP_SIN: "sin(x)",
    ca.OP_COS: "cos(x)",
    ca.OP_TAN: "tan(x)",
    ca.OP_ASIN: "asin(x)",
    ca.OP_ACOS: "acos(x)",
    ca.OP_ATAN: "atan(x)",
    ca.OP_ATAN2: "atan2(x, y)",
    ca.OP_SINH: "sinh(x)",
    ca.OP_COSH: "cosh(x)",
    ca.OP_TANH: "tanh(x)",
    ca.OP_EXP: "exp(x)",
    ca.OP_LOG: "log(x)",
    ca.OP_POW: "pow(x, y)",
    ca.OP_CONSTPOW: "pow(x, y)",
    ca.OP_HYPOT: "hypot(x, y)",
    ca.OP_FABS: "fabs(x)",
    ca.OP_FMIN: "fmin(x, y)",
    ca.OP_FMAX: "fmax(x, y)",
    ca.OP_SIGN: "x > 0 ? 1 : x < 0 ? -1 : x",
    ca.OP_LT: "x < y",
    ca.OP_LE: "x <= y",
    ca.OP_EQ: "x == y",
    ca.OP_NE: "x != y",
    ca.OP_NOT: "!x",
    ca.OP_AND: "x && y",
    ca.OP_OR: "x || y",
    ca.OP_IF_ELSE_ZERO: "x ? y : 0",
}


def _formula(kind: int) -> str:
    """C expression of an operation on the vectors a, b and c."""
    return _OF_VECTORS.get(kind) or f"op_{kind}(a, {'b' if 'y' in _IN_EACH_LANE[kind] else 'a'})"


_OPERANDS = {k: len({*re.findall(r"\b[abc]\b", _formula(k))}) for k in (*_OF_VECTORS, *_IN_EACH_LANE)}

_VECTORS = """#define LANES %d
#include <math.h>
#include <stdint.h>
typedef %s place;
typedef double vec __attribute__((vector_size(8 * LANES)));
/* in one library with what calls them, and unknown outside of it */
#pragma GCC visibility push(hidden)
void into_lanes(const double *columns, int rows, vec *out);
void out_of_lanes(const vec *rows, int count, double *columns);
void into_all_lanes(const double *numbers, int count, vec *out);
void run_in_lanes(const place *p, const place *stop, vec *v);
#pragma GCC visibility pop
"""
_HEAD = """#define ALL(number) ((vec){0} + (number))
/* loops over lanes, which are to become vectors */
#define LOOPS __attribute__((optimize("O3", "no-math-errno", "no-trapping-math")))
#define IN_EACH_LANE(name, formula) \\
  LOOPS static vec name(vec a, vec b) { \\
    vec c; \\
    for (int i = 0; i < LANES; i++) { double x = a[i], y = b[i]; c[i] = formula; } \\
    return c; \\
  }
/* from a column an instance to a lane an instance, and back */
LOOPS void into_lanes(const double *columns, int rows, vec *out) {
  for (int k = 0; k < rows; k++)
    for (int i = 0; i < LANES; i++) out[k][i] = columns ? columns[i * rows + k] : 0;
}
LOOPS void out_of_lanes(const vec *rows, int count, double *columns) {
  if (columns)
    for (int i = 0; i < LANES; i++)
      for (int k = 0; k < count; k++) columns[i * count + k] = rows[k][i];
}
void into_all_lanes(const double *numbers, int count, vec *out) {
  for (int k = 0; k < count; k++) out[k] = ALL(numbers[k]);
}
#define OPERANDS_1 vec a = v[p[0]];
#define OPERANDS_2 vec a = v[p[0]], b = v[p[1]];
#define OPERANDS_3 vec a = v[p[0]], b = v[p[1]], c = v[p[2]];
#define RUN(kind, n, formula) \\
  case kind: \\
    end = p + count * (n + 1); \\
    _Pragma("GCC unroll 4") for (; p < end; p += n + 1) { OPERANDS_##n v[p[n]] = formula; } \\
    break;
"""
_LOOPS = """void run_in_lanes(const place *p, const place *stop, vec *v) {
  while (p < stop) {
    const place kind = p[0], count = p[1], *end;
    p += 2;
    switch (kind) {
      %s
    }
  }
}
"""
# of each byte, how C's text has it
_LITERAL = [chr(k) if k < 128 and chr(k).isalnum() else f"\\{k:03o}" for k in range(256)]


def in_lanes(functions: Sequence[ca.Function], lanes: int = LANES) -> list[NativeCode | ca.Function]:
    """The functions of so many instances, called as ``function.map(lanes)``: an instance a column.

    lanes : a power of two.
    functions : of SX, which are compiled together. One with an operation that is not known here stays as it
        is, as all do where there is no compiler: how many instances a function takes is read off its columns.
    """
    programs = {f: found for f in functions if (found := arranged(f, _OPERANDS)) is not None}
    short = all(program.places <= 1 << 16 for program in programs.values())
    place = "uint16_t" if short else "uint32_t"
    code, loops = _code(programs, lanes, place), _loops(lanes, place)

    def native(function: ca.Function) -> NativeCode:
        # without loops of its own, there is nothing to optimize
        return NativeCode(name=function.name(), code=code, graph=lambda: function, level="-O0", shared=loops)

    return [native(f) if f in programs else f for f in functions]


@functools.cache
def _loops(lanes: int, place: str) -> SharedCode:
    """Loops over operations of all kinds, that every function's program runs through."""
    each = [f"IN_EACH_LANE(op_{kind}, {formula})" for kind, formula in _IN_EACH_LANE.items()]
    loops = _LOOPS % "\n      ".join(map(_run, _OPERANDS))
    code = "\n".join([_VECTORS % (lanes, place), _HEAD, *each, loops])
    return SharedCode(name="lanes", code=code, level=_LEVEL)


def _code(programs: Mapping[ca.Function, Arranged], lanes: int, place: str) -> str:
    """One translation unit: of each function its program, and calls of the loops."""
    data = []
    for k, program in enumerate(programs.values()):
        words = program.words.astype(np.dtype(place.removesuffix("_t"))).tobytes()
        text = "".join(map(_LITERAL.__getitem__, words))
        constants = ", ".join(map(_number, program.constants)) or "0"
        data.append(f"static const double constants_{k}[] = {{{constants}}};")
        data.append(f'static const char program_{k}[] __attribute__((aligned(64))) = "{text}";')
    return "\n".join([_VECTORS % (lanes, place), *data, _interface(programs, lanes)])


def _body(function: ca.Function, program: Arranged, number: int) -> list[str]:
    """One array of vectors for all places: inputs', constants', outputs', and those in between."""
    at, constants, before, after = 0, len(program.constants), [], []
    for i in range(function.n_in()):
        before.append(f"into_lanes(arg[{i}], {function.nnz_in(i)}, v + {at});")
        at += function.nnz_in(i)
    before.append(f"into_all_lanes(constants_{number}, {constants}, v + {at});")
    at += constants
    for i in range(function.n_out()):
        after.append(f"out_of_lanes(v + {at}, {function.nnz_out(i)}, res[{i}]);")
        at += function.nnz_out(i)
    start = f"(const place *)program_{number}"
    return [*before, f"run_in_lanes({start}, {start} + {program.words.size}, v);", *after]


def _run(kind: int) -> str:
    """The loop over operations of a kind."""
    return f"RUN({kind}, {_OPERANDS[kind]}, {_formula(kind)})"


def _number(value: float) -> str:
    return repr(value).replace("inf", "INFINITY").replace("nan", "NAN")


def _interface(programs: Mapping[ca.Function, Arranged], lanes: int) -> str:
    """Interface code of CasADi for functions of as many instances as there are lanes, around these bodies."""
    generator = ca.CodeGenerator("c", {"with_header": False})
    for f in programs:
        inputs = [ca.SX.sym("x", ca.repmat(f.sparsity_in(i), 1, lanes)) for i in range(f.n_in())]
        shapes = [ca.repmat(f.sparsity_out(i), 1, lanes) for i in range(f.n_out())]
        zeros = [ca.SX(ca.DM(shape, 0.0)) for shape in shapes]
        generator.add(ca.Function(f.name(), inputs, zeros, f.name_in(), f.name_out()))
    code = str(generator.dump())
    aligned = "vec *v = (vec *)(((uintptr_t)w + sizeof(vec) - 1) / sizeof(vec) * sizeof(vec));"
    for number, (f, program) in enumerate(programs.items()):
        start = code.index("{", code.index(f"static int casadi_f{number}(")) + 1
        end = code.index("\n}\n", start)
        code = code[:start] + "\n  ".join(["", aligned, *_body(f, program, number), "return 0;"]) + code[end:]
        start = code.index(f" {f.name()}_work(")
        room = re.sub(r"(\*sz_w = )\d+", rf"\g<1>{lanes * (program.places + 1)}", code[start:], count=2)
        code = code[:start] + room
    return code
