"""Forward derivatives of CasADi's functions in C, many directions at once: each in a lane of a vector.

Most of what CasADi's forward mode writes does not depend on the direction. That part becomes a function of
its own, called once; the rest is linear, and is written here with a vector of directions where CasADi has a
number.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca

from impactopt.collision.frozen import FrozenDynamics
from impactopt.collision.native.generated import TreeFunctions

__all__ = ["simd_forward", "simd_tree"]

_LINEAR = {
    ca.OP_ASSIGN: "{0}",
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_NEG: "-{0}",
    ca.OP_TWICE: "{0} + {0}",
}


def simd_tree(frozen: FrozenDynamics, tree: TreeFunctions, *, ground: bool) -> list[tuple[Any, str]]:
    """`simd_forward` of `tree` by q, of `approach`, which is what of it depends on v, by v, and of
    `drift` by both; q's directions are in the basis of v."""
    parts = frozen._tree
    known = [parts.rb.q, parts.rb.v, parts.normal]
    basis = ca.Function("basis", [parts.rb.q], [parts.rb.tangent_map()])
    out = [parts.hand_speed] + ([parts.carrying_wrench] if ground and not frozen.bias else [])
    whole, drift, *_ = tree.functions
    made = [simd_forward(whole, {0: basis})]
    made.append(simd_forward(ca.Function("approach", known, out), {1: None}))
    if drift.n_out():
        made.append(simd_forward(drift, {0: basis, 1: None}))
    return made


def simd_forward(function: Any, seeds: Mapping[int, Any]) -> tuple[Any, str]:
    """(ca.Function <name>_parts, C of <name>_forward) of an SX function with dense outputs.

    <name>_parts (the function's inputs) -> the numbers that its derivatives need, <NAME>_PARTS of them.
    <name>_forward (parts, seeds, out) : seeds[i] has a vector of seed directions for each entry of the i-th
    input that moves; out[i] gets one for each entry of the i-th output.

    Parameters
    ----------
    seeds : by number of an input that moves: ca.Function of the input to the matrix that takes directions to
        its changes; or None, where they are the same.
    """
    name, inputs = function.name(), function.sx_in()
    directions, changes = [], []
    for number, basis in seeds.items():
        matrix = ca.SX.eye(inputs[number].size1()) if basis is None else basis(inputs[number])
        directions.append(ca.SX.sym("direction", matrix.size2()))
        changes.append(ca.mtimes(matrix, directions[-1]))
    (out,) = ca.forward(function.call(inputs), [inputs[number] for number in seeds], [changes])
    whole = ca.Function("whole", [*inputs, *directions], [ca.densify(part) for part in out])
    numbers, lines = _split(whole, len(inputs))
    registers = sorted({line.split(" ", 1)[0] for line in lines if line.startswith("a")})
    code = [
        f"#define {name.upper()}_PARTS {max(len(numbers), 1)}",
        f"static void {name}_forward(",
        "  const double *c, const vec *const *seeds, vec *const *out) {",
        f"  vec {', '.join(registers or ['a'])};",
        *[f"  {line};" for line in lines],
        "}\n",
    ]
    return ca.Function(f"{name}_parts", inputs, [ca.vertcat(ca.SX(0, 1), *numbers)]), "\n".join(code)


def _split(whole: Any, n_given: int) -> tuple[list[Any], list[str]]:
    """Part that does not depend on the directions, as far as the rest needs it; and the rest's lines of C.

    The inputs from `n_given` on are directions.
    """
    expressions = whole.instructions_sx()
    held: dict[int, str] = {}  # by register: what it holds, in C; or
    since: dict[int, int] = {}  # the instruction that it has a number from
    places: dict[int, int] = {}  # by instruction: where that number is kept
    numbers: list[Any] = []
    lines: list[str] = []

    def operand(register: int) -> str:
        if register in held:
            return held[register]
        made = since[register]
        if whole.instruction_id(made) == ca.OP_CONST:
            return f"({whole.instruction_constant(made)!r})"
        if made not in places:
            places[made] = len(numbers)
            numbers.append(expressions[made])
        return f"c[{places[made]}]"

    for k in range(whole.n_instructions()):
        kind, read, write = whole.instruction_id(k), whole.instruction_input(k), whole.instruction_output(k)
        if kind == ca.OP_OUTPUT:
            value = operand(read[0]) if read[0] in held else f"(vec){{0}} + {operand(read[0])}"
            lines.append(f"out[{write[0]}][{write[1]}] = {value}")
        elif kind == ca.OP_INPUT and read[0] >= n_given:
            held[write[0]] = f"a{write[0]}"
            lines.append(f"a{write[0]} = seeds[{read[0] - n_given}][{read[1]}]")
        elif kind not in (ca.OP_INPUT, ca.OP_CONST) and any(register in held for register in read):
            lines.append(f"a{write[0]} = " + _LINEAR[kind].format(*map(operand, read)))
            held[write[0]] = f"a{write[0]}"
        else:
            held.pop(write[0], None)
            since[write[0]] = k
            if kind == ca.OP_INPUT:
                expressions[k] = whole.sx_in(read[0]).nz[read[1]]
    return numbers, lines
