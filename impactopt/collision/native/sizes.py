"""Generated C of a collision model: macros and tables, functions of tree, law and target, SIMD tangents.

Most of the code that CasADi's forward mode generates does not depend on the direction. That part becomes a
function of its own, called once. The rest is linear in the direction and is written here for a vector of
directions, where CasADi has one.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from impactopt.collision.checks import LEAST_PIVOT
from impactopt.collision.frozen import FrozenDynamics
from impactopt.collision.graph import (
    BLOCK,
    LEFT_OUT_BY_RK4,
    MOST_STEPS,
    columns_of,
    joint_space_model,
    target_start,
)
from impactopt.collision.implicit import NODES, STAGES, gamma, tables
from impactopt.collision.model import GIVES_WAY, JointSpaceModel, cuts, shape_of
from impactopt.collision.outputs import HISTORIES, OF_SOLES, frozen_for
from impactopt.collision.stepped import (
    SteppedModel,
    contact_functions,
    law_is_linear,
    number_of_steps,
    target_is_linear,
)
from impactopt.contact import ContactLaw
from impactopt.contact.friction import TINY
from impactopt.kinematics.stance import Stance


@dataclass(frozen=True, kw_only=True)
class TreeFunctions:
    """Functions of the kinematic tree, and the places of their nonzeros.

    Attributes
    ----------
    functions : `tree` (q, v, normal) -> nonzeros of the roots W of all velocities and the hand, nonzeros of
        the roots of the constraints, hand speed, and optional outputs; `drift` (q, v, normal) -> bias force
        and drifts of hand and constraints, as far as the model has them; `integrate` (q, d) and
        `hand_speed_at` (q, v, normal). With friction also the striking point's root, velocity and drift.
    root, held : (row, column) of the nonzeros. Columns of `root` are joints, hand, other velocities; those
        of `held` are the constraints.
    ground : whether `tree` has the outputs for the ground's wrench.
    """

    functions: list[Any]
    root: list[tuple[int, int]]
    held: list[tuple[int, int]]
    ground: bool


def tree_functions(frozen: FrozenDynamics, n: int, *, ground: bool, slides: bool = False) -> TreeFunctions:
    """Functions of the kinematic tree.

    n : number of servos.  ground, slides : with outputs for the ground's wrench, and for friction at the
    striking point.
    """
    tree, robot = frozen._tree, frozen.robot
    rb, normal = tree.rb, tree.normal
    root = tree.inverse_root(tree.mass_matrix)
    hand = ca.mtimes(root, ca.sparsify(tree.hand_row.T))
    held = ca.mtimes(root, ca.sparsify(tree.held_jacobian.T))
    others = robot.nv - n
    # joints first, as the time loop needs these and the hand; the base's velocities, for the constraints, are
    # last
    columns = [i - others if i >= others else n + 1 + i for i in range(robot.nv)]
    places = [(r, columns[c]) for r, c in _nonzeros(root)] + [(r, n) for r, _ in _nonzeros(hand)]
    out = [ca.vertcat(root.nz[:], hand.nz[:]), ca.densify(held.nz[:]), tree.hand_speed]
    if ground:
        out += [ca.densify(tree.sole_positions)]
        out += [] if frozen.bias else [tree.carrying_wrench]
    drifts = [ca.densify(tree.bias_force)] if frozen.bias else []
    drifts += [tree.hand_drift, ca.densify(tree.held_drift)] if frozen.jdot else []
    speeds = [tree.hand_speed]
    if slides:
        out += [ca.densify(ca.mtimes(root, tree.point_jacobian.T)), tree.point_velocity]
        drifts += [tree.point_drift] if frozen.jdot else []
        speeds += [tree.point_velocity]
    d = ca.SX.sym("d", robot.nv)
    known = [rb.q, rb.v, normal]
    functions = [
        ca.Function("tree", known, out),
        ca.Function("drift", known, drifts),
        ca.Function("integrate", [rb.q, d], [rb.integrate(d)]),
        ca.Function("hand_speed_at", known, speeds),
    ]
    return TreeFunctions(functions=functions, root=places, held=_nonzeros(held), ground=ground)


def _nonzeros(matrix: Any) -> list[tuple[int, int]]:
    rows, columns = matrix.sparsity().get_triplet()
    return list(zip(map(int, rows), map(int, columns), strict=True))


def gamma_of(stance: Stance, held: int) -> list[float]:
    """Compliance of each constraint of soles and hands (6 per frame)."""
    return [float(x) for x in stance.compliance] * held


def scalar_functions(model: JointSpaceModel, *, method: str) -> list[Any]:
    """Law and target as SX functions; with implicit steps also their values and slopes (`contact_functions`).

    `law` and `target` are the vectors of their parameters, z is the target's state:

        left_force (x, rate, law) : above zero while contact lasts in restitution
        contact_force (x, rate, law) -> force
        target_velocity (z, target), target_rates (z, force, target), target_energy, target_result (z, target)
        target_inverse_mass, target_speed_before (target) : the results of `target_start`
        tangential_mobility (target) : inverse mass of a target that friction moves across the normal
    """
    law_numbers, target_numbers = list(model.law.parameters), list(model.target.parameters)
    law, target = ca.SX.sym("law", len(law_numbers)), ca.SX.sym("target", len(target_numbers))
    of_law = {name: law[i] for i, name in enumerate(law_numbers)}
    of_target = {name: target[i] for i, name in enumerate(target_numbers)}
    x, rate, force = ca.SX.sym("x"), ca.SX.sym("rate"), ca.SX.sym("force")
    z = ca.SX.sym("z", model.target.n_states)
    states = [z[i] for i in range(model.target.n_states)]
    thing = model.target
    left = model.law.separation if method == "implicit" else partial(_restitution, model.law)

    def column(values: Any) -> Any:
        return ca.densify(ca.vertcat(ca.SX(0, 1), *values))

    start = target_start(thing, of_target)
    functions = [
        ca.Function("left_force", [x, rate, law], [_number(left(x, rate, of_law))]),
        ca.Function("contact_force", [x, rate, law], [model.law.force(x, rate, of_law)]),
        ca.Function("target_velocity", [z, target], [_number(thing.velocity(states, of_target))]),
        ca.Function("target_rates", [z, force, target], [column(thing.derivative(states, force, of_target))]),
        ca.Function("target_energy", [z, target], [_number(thing.energy(states, of_target))]),
        ca.Function("target_result", [z, target], [column(thing.result(states, of_target))]),
        ca.Function("target_inverse_mass", [target], [_number(start[0])]),
        ca.Function("target_speed_before", [target], [_number(start[1])]),
    ]
    if model.moves_target:
        mobility = _number(1 / thing.tangential_mass(of_target))
        functions.append(ca.Function("tangential_mobility", [target], [mobility]))
    return functions + (contact_functions(model.law, model.target) if method == "implicit" else [])


def _restitution(law: ContactLaw, x: Any, rate: Any, numbers: Any) -> Any:
    return law.branch(x, rate, False, numbers)


def _number(expression: Any) -> Any:
    return ca.densify(ca.SX(expression))


# numbers of the inputs that a function's adjoint is taken by
_DIFFERENTIATED_BY: dict[str, tuple[int, ...]] = {"contact_force": (0, 1), "target_rates": (0, 1)}
_DIFFERENTIATED_BY |= {"target_velocity": (0,), "target_energy": (0,), "tree": (0, 1), "drift": (0, 1)}


def backwards(functions: list[Any]) -> list[Any]:
    """Adjoints <name>_adjoint (inputs, derivatives by the outputs) -> derivatives by some of the inputs."""
    made = []
    for function in functions:
        if function.name() in _DIFFERENTIATED_BY:
            x = [ca.SX.sym(name, *function.size_in(name)) for name in function.name_in()]
            y = function.call(x)
            seeds = [ca.SX.sym("seed", *part.shape) for part in y]
            by = [x[i] for i in _DIFFERENTIATED_BY[function.name()]]
            (out,) = ca.reverse(y, by, [seeds])
            out = [ca.densify(part) for part in out]
            made.append(ca.Function(f"{function.name()}_adjoint", [*x, *seeds], out))
    return made


def to_velocity_basis(frozen: FrozenDynamics) -> Any:
    """ca.Function to_velocity_basis (q, derivatives by q (nq)) -> the same in v's basis (nv)."""
    rb = frozen._tree.rb
    by_q = ca.SX.sym("by_q", rb.q.size1())
    return ca.Function("to_velocity_basis", [rb.q, by_q], [ca.densify(ca.mtimes(rb.tangent_map().T, by_q))])


def c_code(name: str, functions: list[Any], *, linkage: str = "") -> str:
    """C of static functions f(arg, res, iw, w, mem); several such texts go into one file.

    linkage : in place of static, but for all they call.
    """
    generator = ca.CodeGenerator(f"{name}.c", {"with_header": False})
    for function in functions:
        generator.add(function)
    # its helpers too: several such files go into one library
    static = re.sub(
        r"^(casadi_real|casadi_int|void|int) casadi_", r"static \g<0>", generator.dump(), flags=re.M
    )
    if linkage:
        main = r"^CASADI_SYMBOL_EXPORT (?=int \w+\(const casadi_real\*\* arg)"
        static = re.sub(main, f"{linkage} ", static, flags=re.M)
    return f"#undef CASADI_PREFIX\n{static}\n"


_LINEAR = {
    ca.OP_ASSIGN: "{0}",
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_NEG: "-{0}",
    ca.OP_TWICE: "{0} + {0}",
}


def simd_tree(frozen: FrozenDynamics, tree: TreeFunctions) -> list[tuple[Any, str]]:
    """Tangents (`simd_tangent`) of `tree` by q, of its outputs that depend on v (`approach`) by v, and of
    `drift` by both; directions of q are in the basis of v."""
    parts = frozen._tree
    known = [parts.rb.q, parts.rb.v, parts.normal]
    basis = ca.Function("basis", [parts.rb.q], [parts.rb.tangent_map()])
    out = [parts.hand_speed] + ([parts.carrying_wrench] if tree.ground and not frozen.bias else [])
    whole, drift, *_ = tree.functions
    made = [simd_tangent(whole, {0: basis})]
    made.append(simd_tangent(ca.Function("approach", known, out), {1: None}))
    if drift.n_out():
        made.append(simd_tangent(drift, {0: basis, 1: None}))
    return made


def simd_tangent(function: Any, seeds: Mapping[int, Any]) -> tuple[Any, str]:
    """(ca.Function <name>_parts, C of <name>_tangent) of an SX function with dense outputs.

    <name>_parts (the function's inputs) -> the <NAME>_PARTS intermediate values that its tangents need.
    <name>_tangent (parts, seeds, out) : seeds[i] has a vector of directions for each entry of the i-th seeded
    input; out[i] becomes one for each entry of the i-th output.

    Parameters
    ----------
    seeds : seeded inputs by number: ca.Function from the input to the matrix that maps directions to its
        changes, or None for the identity.
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
        f"static void {name}_tangent(",
        "  const double *c, const vec *const *seeds, vec *const *out) {",
        f"  vec {', '.join(registers or ['a'])};",
        *[f"  {line};" for line in lines],
        "}\n",
    ]
    return ca.Function(f"{name}_parts", inputs, [ca.vertcat(ca.SX(0, 1), *numbers)]), "\n".join(code)


def _split(whole: Any, n_given: int) -> tuple[list[Any], list[str]]:
    """Split of a function's instructions: values that do not depend on the directions but are needed with
    them, and lines of C for the instructions that do.

    The inputs from `n_given` on are directions.
    """
    expressions = whole.instructions_sx()
    held: dict[int, str] = {}  # register -> its C expression, where it depends on the directions; else
    since: dict[int, int] = {}  # register -> the instruction that set it
    places: dict[int, int] = {}  # instruction -> index of its value in `numbers`
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
            # a tangent is linear in its direction, so there are no other operations of it
            lines.append(f"a{write[0]} = " + _LINEAR[kind].format(*map(operand, read)))
            held[write[0]] = f"a{write[0]}"
        else:
            # CasADi uses a register again and again: from here on it has no direction
            held.pop(write[0], None)
            since[write[0]] = k
            if kind == ca.OP_INPUT:
                expressions[k] = whole.sx_in(read[0]).nz[read[1]]
    return numbers, lines


def shapes_in(collision: SteppedModel) -> dict[str, tuple[int, int]]:
    """Shapes of the inputs by name."""
    robot = collision.robot
    shapes = {"q": (robot.nq, 1), "v": (robot.nv, 1)}
    if collision.effects.feedforward:
        shapes["feedforward"] = (robot.n, 1)
    return shapes | {name: shape_of(value) for name, value in collision.settings.items()}


def shapes_out(collision: SteppedModel, outputs: tuple[str, ...], every: int) -> dict[str, tuple[int, int]]:
    """Shapes of the outputs by name."""
    robot, columns = collision.robot, sum(_columns(collision, every))
    shapes = dict.fromkeys(outputs, (1, 1))
    shapes |= {
        "velocity": (robot.nv, 1),
        "configuration": (robot.nq, 1),
        "target_result": (len(collision.target.results), 1),
        "tangential_velocity": (3, 1),
    }
    for name in HISTORIES:
        rows = _rows(collision, name)
        shapes[name] = (columns, 1) if rows == 1 else (rows, columns)
    return {name: shapes[name] for name in outputs}


def directions(collision: SteppedModel) -> dict[str, int]:
    """Number of directions of each input by name; q has as many as v."""
    shapes = {name: rows * columns for name, (rows, columns) in shapes_in(collision).items()}
    return {**shapes, "q": collision.robot.nv}


def with_derivatives(
    shapes: dict[str, tuple[int, int]], by: Mapping[str, int], *, values: bool = False
) -> dict[str, tuple[int, int]]:
    """Shapes of the outputs' Jacobians, each after its output if with `values`.

    by : number of directions of each input.
    """
    made: dict[str, tuple[int, int]] = {}
    for name, (rows, columns) in shapes.items():
        made |= {name: (rows, columns)} if values else {}
        made |= {f"{name}_by_{given}": (rows * columns, count) for given, count in by.items()}
    return made


def with_jacobians(shapes: dict[str, tuple[int, int]], by: Mapping[str, int]) -> dict[str, tuple[int, int]]:
    """Shapes of each output followed by those of its Jacobians by the inputs that have tangents."""
    carried = {name: by[name] for name in ("q", "v", "feedforward") if name in by}
    return with_derivatives(shapes, carried, values=True)


def _rows(collision: SteppedModel, history: str) -> int:
    n, soles = collision.n_servos, 6 * len(collision.held_by.sole_frames(collision.robot))
    hands = 6 * len(collision.held_by.hand_frames(collision.robot))
    rows = {"joint_velocity": n, "torque": n, "demand": n, "sole_wrench": soles, "hand_wrench": hands}
    return {**rows, "ground_wrench": 6, "zmp": 2}.get(history, 1)


def _ends(collision: SteppedModel) -> list[float]:
    """Ends of the segments, as fractions of the contact's duration."""
    return cuts(max(collision.n_freezes, 1))


def _blocks(collision: SteppedModel, fraction: float) -> int:
    """Largest number of steps in a fraction of the horizon, in whole blocks."""
    if collision.stepping == "implicit":
        return MOST_STEPS
    # as `graph.run` does, so that the histories have as many columns
    return -(-number_of_steps(collision, fraction) // BLOCK) * BLOCK


def _steps(collision: SteppedModel) -> list[int]:
    """Steps of each segment; the last may take as long as the horizon."""
    shares = [b - a for a, b in pairwise(_ends(collision))]
    return [_blocks(collision, share) for share in (*shares[:-1], 1.0)]


def _columns(collision: SteppedModel, every: int) -> list[int]:
    if collision.stepping == "implicit":
        shares = [b - a for a, b in pairwise(_ends(collision))]
        return [columns_of(collision, share, every) for share in (*shares[:-1], 1.0)]
    return [-(-count // every) + 1 for count in _steps(collision)]


def sizes(collision: SteppedModel, outputs: tuple[str, ...], every: int, tree: TreeFunctions) -> str:
    """Macros and tables of the model, for the kernel."""
    robot, effects, settings, n = collision.robot, collision.effects, collision.settings, collision.n_servos
    model = joint_space_model(collision, outputs, freezes=collision.n_freezes)
    held = collision.held_by.constraint_frames(robot)
    soles = collision.held_by.sole_frames(robot)
    shapes = shapes_in(collision)
    names = list(shapes)
    laws, targets = list(model.law.parameters), list(model.target.parameters)
    switch_count = len(
        model.target.switches([0.0] * model.target.n_states, 0.0, dict(model.target.parameters))
    )
    freezes, ends, counts = collision.n_freezes, _ends(collision), _steps(collision)
    held_rows = 6 * len(held)
    numbers: dict[str, Any] = {
        "N": n,
        "NQ": robot.nq,
        "NV": robot.nv,
        "C": held_rows,
        "SOLES": len(soles),
        "NZ": model.target.n_states,
        "N_LAW": len(laws),
        "N_TARGET": len(targets),
        "SWITCHES": switch_count,
        "COLUMN(i)": f"((i) >= {robot.nv - n} ? (i) - {robot.nv - n} : {n + 1} + (i))",
        "LENGTH": repr(float(collision.step_length)),
        "STAGES": STAGES,
        "NODES": NODES,
        "LAW_NONLINEAR": int(not law_is_linear(collision.law)),
        "TARGET_NONLINEAR": int(not target_is_linear(collision.target)),
        "TOLERANCE": repr(float(collision.tolerance)),
        "GAMMA_OF_STEPS": repr(gamma()),
        "GIVES_WAY": repr(GIVES_WAY),
        "LEAST_PIVOT": repr(LEAST_PIVOT),
        "HORIZON": repr(float(collision.horizon)),
        "TRANSITION": repr(float(model.transition)),
        "STIFFNESS": int(effects.stiffness and n > 0),
        "FEEDFORWARD": int(effects.feedforward and n > 0),
        "SATURATION": int(effects.saturation and n > 0),
        "FRICTION": int(effects.friction and n > 0),
        "REFERENCE": settings["reference"].shape[1] if "reference" in settings else 0,
        "BIAS": int(effects.bias),
        "JDOT": int(effects.jdot),
        "KD_MATRIX": int(n > 0 and settings["kd"].ndim == 2),
        "KP_MATRIX": int(n > 0 and effects.stiffness and settings["kp"].ndim == 2),
        "SLIDES": int(model.slides),
        "BRISTLES": int(model.bristles),
        "MOVES_TARGET": int(model.moves_target),
        "TINY": repr(TINY),
        "PEAK": int(model.peak),
        "STEP_ERROR": int(model.error),
        "LEFT_OUT_BY_RK4": repr(LEFT_OUT_BY_RK4),
        "SECOND_INTEGRALS": int(model.second_integrals),
        "FREEZES": freezes,
        "GROUND": int(tree.ground),
        "WRENCHES": int(bool(frozen_for(outputs)) or freezes > 0),
        "HELD_HISTORY": int(bool({*OF_SOLES, "hand_wrench"} & {*outputs})),
        "HISTORIES": int(bool({*HISTORIES} & {*outputs})),
        "EVERY": every,
        "STEPS_AT_ALL": _blocks(collision, 1.0),
        "N_IN": len(names),
        "ARG_law": names.index(f"contact_{laws[0]}") if laws else 0,
        "ARG_target": names.index(f"target_{targets[0]}") if targets else 0,
        "ROOT_NONZEROS": len(tree.root),
        "HELD_NONZEROS": len(tree.held),
        **{f"ARG_{name}": i for i, name in enumerate(names)},
        **{f"OUT_{name}": i for i, name in enumerate(outputs)},
    }
    text = [f"#define {name} {value}" for name, value in numbers.items()]
    text += [
        _places("ROOT", tree.root),
        _places("HELD", tree.held),
        *_rows_of_columns("ROOT", tree.root, n + 1),
        *_rows_of_columns("HELD", tree.held, held_rows),
        _table("double", "GAMMA", gamma_of(collision.held_by, len(held))),
        _table("int", "ROWS", [_rows(collision, x) if x in HISTORIES else 0 for x in outputs]),
        _table("int", "STEPS", counts),
        _table("int", "N_COLUMNS", _columns(collision, every)),
        _table("int", "STEPS_TO_MIDDLE", [_blocks(collision, float(x) / 2) for x in np.diff(ends)]),
        _table("double", "ENDS", list(ends)),
        names_table("NAMES_IN", names),
        shapes_table("SHAPES_IN", shapes.values()),
    ]
    if collision.stepping == "implicit":
        text += [_matrix(name, x) for name, x in tables().items()]
    return "\n".join(text) + "\n"


def _places(name: str, places: list[tuple[int, int]]) -> str:
    entries = ", ".join(f"OF_{name}({r}, {c})" for r, c in places)
    return f"static const int {name}_AT[] = {{{entries or '0'}}};"


def _rows_of_columns(name: str, places: list[tuple[int, int]], columns: int) -> list[str]:
    """Rows of the nonzeros by columns, and the begin of each column (compressed sparse columns)."""
    rows = [[r for r, c in places if c == column] for column in range(columns)]
    starts = [0, *(int(x) for x in np.cumsum([len(x) for x in rows]))]
    return [
        _table("int", f"{name}_ROWS", starts),
        _table("int", f"{name}_ROW", [r for column in rows for r in column]),
    ]


def _matrix(name: str, values: Any) -> str:
    if np.ndim(values) == 0:
        return f"#define {name} {values!r}"
    shape = "".join(f"[{size}]" for size in values.shape)
    entries = str(values.tolist()).replace("[", "{").replace("]", "}")
    return f"static const double {name}{shape} __attribute__((aligned(64))) = {entries};"


def _table(kind: str, name: str, values: Iterable[Any]) -> str:
    return f"static const {kind} {name}[] = {{{', '.join(map(repr, values)) or '0'}}};"


def names_table(name: str, values: Iterable[str]) -> str:
    return f"static const char *const {name}[] = {{{', '.join(f'{chr(34)}{x}{chr(34)}' for x in values)}}};"


def shapes_table(name: str, shapes: Iterable[tuple[int, int]]) -> str:
    # a 1 after the shape means dense, in CasADi's C interface
    return f"static const long long {name}[][3] = {{{', '.join(f'{{{a}, {b}, 1}}' for a, b in shapes)}}};"
