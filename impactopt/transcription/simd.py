"""Functions of several instances at once: C in which each number of one instance is a vector, a lane each.

CasADi's C takes the instances one after the other, a number at a time. The same operations in the same order
on vectors need about as many of the CPU's instructions for eight instances as for one.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import pairwise, zip_longest

import casadi as ca

from impactopt.codegen.library import NativeCode
from impactopt.problem.block import LANES

__all__ = ["in_lanes"]

# a compiler takes more than linear time for a long function: it gets parts of so many operations
_PART = 500
# what runs one after the other stands one after the other
_LEVEL = "-O1 -fno-toplevel-reorder"

_OF_VECTORS = {
    ca.OP_ASSIGN: "{0}",
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_NEG: "-{0}",
    ca.OP_TWICE: "{0} + {0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_INV: "ALL(1.0) / {0}",
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
_KNOWN = {*_OF_VECTORS, *_IN_EACH_LANE, ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST}

# The passes left out look for what CasADi has found before: without them it compiles in two thirds of the
# time, and what it makes is as fast.
_HEAD = """#include <math.h>
#include <stdint.h>
typedef double vec __attribute__((vector_size(8 * LANES)));
#define ALL(number) ((vec){0} + (number))
/* loops over lanes, which the passes that are left out elsewhere make vectors of */
#define LOOPS __attribute__((optimize("O3", "no-math-errno", "no-trapping-math")))
#define IN_EACH_LANE(name, formula) \\
  LOOPS static vec name(vec a, vec b) { \\
    vec c; \\
    for (int i = 0; i < LANES; i++) { double x = a[i], y = b[i]; c[i] = formula; } \\
    return c; \\
  }
/* from a column an instance to a lane an instance, and back */
LOOPS static void into_lanes(const double *columns, int rows, vec *out) {
  for (int k = 0; k < rows; k++)
    for (int i = 0; i < LANES; i++) out[k][i] = columns ? columns[i * rows + k] : 0;
}
LOOPS static void out_of_lanes(const vec *rows, int count, double *columns) {
  if (columns)
    for (int i = 0; i < LANES; i++)
      for (int k = 0; k < count; k++) columns[i * count + k] = rows[k][i];
}
/* Code that runs once a call, megabytes of it, has left the caches by the next call: it is asked for a part
   ahead, or the CPU would wait for every line of it. */
static inline void fetch(const void *from, const void *to) {
  for (const char *line = from; line < (const char *)to; line += 64) __builtin_prefetch(line, 0, 2);
}
#pragma GCC optimize ("no-tree-dse", "no-dse", "no-tree-fre", "no-tree-forwprop")
"""


def in_lanes(function: ca.Function, lanes: int = LANES) -> NativeCode | ca.Function:
    """The function of so many instances, called as ``function.map(lanes)``: an instance a column.

    lanes : a power of two.
    function : of SX. One with an operation that is not known here stays as it is, and takes the place of the
        other where there is no compiler: how many instances a function takes is read off its columns.
    """
    kinds = {function.instruction_id(k) for k in range(function.n_instructions())}
    if not kinds <= _KNOWN:
        return function
    return NativeCode(
        name=function.name(), code=_code(function, kinds, lanes), graph=lambda: function, level=_LEVEL
    )


def _code(function: ca.Function, kinds: set[int], lanes: int) -> str:
    """One array of vectors: the registers that CasADi numbers, the inputs, the outputs."""
    at = int(function.sz_w())
    places, before, after = [], [], []
    for i in range(function.n_in()):
        places.append(f"#define IN_{i} {at}")
        before.append(f"into_lanes(arg[{i}], {function.nnz_in(i)}, v + IN_{i});")
        at += function.nnz_in(i)
    for i in range(function.n_out()):
        places.append(f"#define OUT_{i} {at}")
        after.append(f"out_of_lanes(v + OUT_{i}, {function.nnz_out(i)}, res[{i}]);")
        at += function.nnz_out(i)
    parts = _parts(list(_operations(function)))
    called = [f"part_{k}" for k in range(len(parts))]
    ahead = [f"fetch({part}, {end});" for part, end in pairwise(called[1:])]
    calls = [f"{fetch}\n  {part}(v);" for part, fetch in zip_longest(called, ahead, fillvalue="")]
    body = [*before, *calls, *after]
    each = [f"IN_EACH_LANE(op_{kind}, {formula})" for kind, formula in _IN_EACH_LANE.items() if kind in kinds]
    head = f"#define LANES {lanes}\n{_HEAD}"
    return "\n".join([head, *each, *places, *parts, _interface(function, body, at, lanes)])


Operation = tuple[str, list[int], list[int]]  # in C, with register 5 as a5; the registers read; and written


def _operations(function: ca.Function) -> Iterator[Operation]:
    for k in range(function.n_instructions()):
        kind, read, write = (
            function.instruction_id(k),
            function.instruction_input(k),
            function.instruction_output(k),
        )
        if kind in _OF_VECTORS:
            value = _OF_VECTORS[kind].format(f"a{read[0]}", f"a{read[-1]}")
        elif kind in _IN_EACH_LANE:
            value = f"op_{kind}(a{read[0]}, a{read[-1]})"
        elif kind == ca.OP_OUTPUT:
            yield f"v[OUT_{write[0]} + {write[1]}] = a{read[0]};", read, []
            continue
        elif kind == ca.OP_INPUT:
            value, read = f"v[IN_{read[0]} + {read[1]}]", []
        else:
            value, read = f"ALL({_number(function.instruction_constant(k))})", []
        yield f"a{write[0]} = {value};", read, write


def _number(value: float) -> str:
    return repr(value).replace("inf", "INFINITY").replace("nan", "NAN")


def _parts(operations: list[Operation]) -> list[str]:
    """C functions to call in turn. Registers are variables in them, and in the array in between."""
    parts: list[str] = []
    needed: set[int] = set()  # registers that the parts after this one read
    starts = range(0, len(operations), _PART)
    for start in reversed(starts):
        part = operations[start : start + _PART]
        last = {r: k for k, (_, _, write) in enumerate(part) for r in write}
        used: set[int] = set()
        loaded: set[int] = set()
        lines = []
        for k, (text, read, write) in enumerate(part):
            for r in read:
                if r not in used:
                    lines.append(f"a{r} = v[{r}];")
                    loaded.add(r)
                    used.add(r)
            lines.append(text)
            used.update(write)
            lines += [f"v[{r}] = a{r};" for r in write if last[r] == k and r in needed]
        needed = needed - set(last) | loaded
        variables = ", ".join(f"a{r}" for r in sorted(used))
        head = f"static __attribute__((noinline)) void part_{len(starts) - 1 - len(parts)}(vec *v) {{"
        parts.append("\n  ".join([head, f"vec {variables};", *lines]) + "\n}")
    return parts[::-1]


def _interface(function: ca.Function, body: list[str], vectors: int, lanes: int) -> str:
    """What CasADi writes around a function of as many instances as there are lanes, around this body."""
    names = function.name_in(), function.name_out()
    inputs = [ca.SX.sym("x", ca.repmat(function.sparsity_in(i), 1, lanes)) for i in range(function.n_in())]
    shapes = [ca.repmat(function.sparsity_out(i), 1, lanes) for i in range(function.n_out())]
    hollow = ca.Function(function.name(), inputs, [ca.SX(ca.DM(shape, 0.0)) for shape in shapes], *names)
    generator = ca.CodeGenerator("c", {"with_header": False})
    generator.add(hollow)
    code = str(generator.dump())
    start = code.index("{", code.index("static int casadi_f0(")) + 1
    end = code.index("\n}\n", start)
    aligned = "vec *v = (vec *)(((uintptr_t)w + sizeof(vec) - 1) / sizeof(vec) * sizeof(vec));"
    code = code[:start] + "\n  ".join(["", aligned, *body, "return 0;"]) + code[end:]
    return re.sub(r"(\*sz_w = )\d+", rf"\g<1>{lanes * (vectors + 1)}", code)
