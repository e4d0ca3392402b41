"""Generated C code of the native collision: the robot's tree, and law and target."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import partial
from typing import Any

import casadi as ca

from impactopt.collision.contact_slopes import contact_functions
from impactopt.collision.frozen import FrozenDynamics
from impactopt.collision.graph import target_start
from impactopt.collision.model import JointSpaceModel
from impactopt.contact import ContactLaw
from impactopt.kinematics.stance import Stance

__all__ = [
    "TreeFunctions",
    "backwards",
    "c_code",
    "gamma_of",
    "scalar_functions",
    "tangent_back",
    "tree_functions",
]


@dataclass(frozen=True, kw_only=True)
class TreeFunctions:
    """Functions of the robot's tree, and where their sparse results go.

    Attributes
    ----------
    functions : `tree` (q, v, normal) -> nonzeros of the roots W of all velocities and the hand, of those of
        what is held, hand speed, and further ones; `drift` (q, v, normal) -> bias force, drifts of the hand
        and of what is held, as far as they act; `integrate` (q, d) and `hand_speed_at` (q, v, normal).
    root, held : (row, column) of the nonzeros. Columns of `root` are joints, hand, other velocities.
    """

    functions: list[Any]
    root: list[tuple[int, int]]
    held: list[tuple[int, int]]


def tree_functions(frozen: FrozenDynamics, n: int, *, ground: bool) -> TreeFunctions:
    """Functions of the robot's tree, with those for the ground's wrench on request; n is the number of
    servos.
    """
    tree, robot = frozen._tree, frozen.robot
    rb, normal = tree.rb, tree.normal
    root = tree.inverse_root(tree.mass_matrix)
    hand = ca.mtimes(root, ca.sparsify(tree.hand_row.T))
    held = ca.mtimes(root, ca.sparsify(tree.held_jacobian.T))
    others = robot.nv - n
    columns = [i - others if i >= others else n + 1 + i for i in range(robot.nv)]
    places = [(r, columns[c]) for r, c in _nonzeros(root)] + [(r, n) for r, _ in _nonzeros(hand)]
    out = [ca.vertcat(root.nz[:], hand.nz[:]), ca.densify(held.nz[:]), tree.hand_speed]
    if ground:
        out += [ca.densify(tree.sole_positions)]
        out += [] if frozen.bias else [tree.carrying_wrench]
    drifts = [ca.densify(tree.bias_force)] if frozen.bias else []
    drifts += [tree.hand_drift, ca.densify(tree.held_drift)] if frozen.jdot else []
    d = ca.SX.sym("d", robot.nv)
    known = [rb.q, rb.v, normal]
    functions = [
        ca.Function("tree", known, out),
        ca.Function("drift", known, drifts),
        ca.Function("integrate", [rb.q, d], [rb.integrate(d)]),
        ca.Function("hand_speed_at", known, [tree.hand_speed]),
    ]
    return TreeFunctions(functions=functions, root=places, held=_nonzeros(held))


def _nonzeros(matrix: Any) -> list[tuple[int, int]]:
    rows, columns = matrix.sparsity().get_triplet()
    return list(zip(map(int, rows), map(int, columns), strict=True))


def gamma_of(stance: Stance, held: int) -> list[float]:
    """Compliance of each row of what is held."""
    return [float(x) for x in stance.compliance] * held


def scalar_functions(model: JointSpaceModel, *, method: str) -> list[Any]:
    """Law and target as SX functions; with implicit steps also their values and slopes (`contact_functions`).

    `law` and `target` are the numbers of both, z the target's state:

        left_force (x, rate, law) : above zero while contact lasts in restitution
        contact_force (x, rate, law) -> force
        target_velocity (z, target), target_rates (z, force, target), target_energy, target_result (z, target)
        target_yield, target_before (target): the numbers of `target_start`
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
        ca.Function("target_yield", [target], [_number(start[0])]),
        ca.Function("target_before", [target], [_number(start[1])]),
    ]
    return functions + (contact_functions(model.law, model.target) if method == "implicit" else [])


def _restitution(law: ContactLaw, x: Any, rate: Any, numbers: Any) -> Any:
    return law.branch(x, rate, False, numbers)


def _number(expression: Any) -> Any:
    return ca.densify(ca.SX(expression))


# of each function, the inputs that it is differentiated by
_BACK: dict[str, tuple[int, ...]] = {"contact_force": (0, 1), "target_rates": (0, 1)}
_BACK |= {"target_velocity": (0,), "target_energy": (0,), "tree": (0, 1), "drift": (0, 1)}


def backwards(functions: list[Any]) -> list[Any]:
    """<name>_back (inputs, derivatives by the outputs) -> derivatives by some of the inputs, where used."""
    made = []
    for function in functions:
        if function.name() in _BACK:
            x = [ca.SX.sym(name, *function.size_in(name)) for name in function.name_in()]
            y = function.call(x)
            seeds = [ca.SX.sym("seed", *part.shape) for part in y]
            by = [x[i] for i in _BACK[function.name()]]
            (out,) = ca.reverse(y, by, [seeds])
            out = [ca.densify(part) for part in out]
            made.append(ca.Function(f"{function.name()}_back", [*x, *seeds], out))
    return made


def tangent_back(frozen: FrozenDynamics) -> Any:
    """ca.Function tangent_back (q, derivatives by q (nq)) -> the same in v's basis (nv)."""
    rb = frozen._tree.rb
    by_q = ca.SX.sym("by_q", rb.q.size1())
    return ca.Function("tangent_back", [rb.q, by_q], [ca.densify(ca.mtimes(rb.tangent_map().T, by_q))])


def c_code(name: str, functions: list[Any]) -> str:
    """C of static functions f(arg, res, iw, w, mem); several such texts go into one file."""
    generator = ca.CodeGenerator(f"{name}.c", {"with_header": False})
    for function in functions:
        generator.add(function)
    # its helpers too: several such files go into one library
    static = re.sub(
        r"^(casadi_real|casadi_int|void|int) casadi_", r"static \g<0>", generator.dump(), flags=re.M
    )
    return f"#undef CASADI_PREFIX\n{static}\n"
