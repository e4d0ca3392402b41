"""What CasADi writes of the native collision: the robot's tree, and jets of law and target."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca

from impactopt.collision.frozen import FrozenDynamics
from impactopt.collision.graph import target_yield
from impactopt.collision.implicit import linear_contact
from impactopt.collision.jets import derivative
from impactopt.collision.model import JointSpaceModel
from impactopt.collision.taylor import ORDER
from impactopt.kinematics.stance import Stance

__all__ = ["Tree", "backwards", "c_code", "gamma_of", "scalar_functions", "tangent_back", "tree_functions"]


@dataclass(frozen=True, kw_only=True)
class Tree:
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


def tree_functions(frozen: FrozenDynamics, n: int, *, ground: bool) -> Tree:
    """With what the ground's wrench needs, where it is wanted; n is the number of servos."""
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
    return Tree(functions=functions, root=places, held=_nonzeros(held))


def _nonzeros(matrix: Any) -> list[tuple[int, int]]:
    rows, columns = matrix.sparsity().get_triplet()
    return list(zip(map(int, rows), map(int, columns), strict=True))


def gamma_of(stance: Stance, held: int) -> list[float]:
    """Compliance of each row of what is held."""
    return [float(x) for x in stance.compliance] * held


def scalar_functions(model: JointSpaceModel, *, method: str) -> list[Any]:
    """Law and target as SX functions; with Taylor steps also their time derivatives order by order, and with
    implicit ones their coefficients (`linear_contact`).

    `law` and `target` are the numbers of both, z the target's state; jets have a column for each order:

        restitution_force (x, rate, law), contact_force (x, rate, law) -> force
        target_velocity (z, target), target_rates (z, force, target), target_energy, target_result (z, target)
        target_yield (target)
        order_<k> (hand speed's derivative, compressing, x, rates, forces, z, law, target)
            -> rate, force, and the next derivative of z; the last without it
        switches (forces, z, target) -> jets of the switches, a column each
    """
    law_numbers, target_numbers = list(model.law.parameters), list(model.target.parameters)
    law, target = ca.SX.sym("law", len(law_numbers)), ca.SX.sym("target", len(target_numbers))
    of_law = {name: law[i] for i, name in enumerate(law_numbers)}
    of_target = {name: target[i] for i, name in enumerate(target_numbers)}
    x, rate, force = ca.SX.sym("x"), ca.SX.sym("rate"), ca.SX.sym("force")
    z = ca.SX.sym("z", model.target.n_states)
    states = [z[i] for i in range(model.target.n_states)]
    thing = model.target

    def column(values: Any) -> Any:
        return ca.densify(ca.vertcat(ca.SX(0, 1), *values))

    functions = [
        ca.Function("restitution_force", [x, rate, law], [model.law.branch(x, rate, False, of_law)]),
        ca.Function("contact_force", [x, rate, law], [model.law.force(x, rate, of_law)]),
        ca.Function("target_velocity", [z, target], [_number(thing.velocity(states, of_target))]),
        ca.Function("target_rates", [z, force, target], [column(thing.derivative(states, force, of_target))]),
        ca.Function("target_energy", [z, target], [_number(thing.energy(states, of_target))]),
        ca.Function("target_result", [z, target], [column(thing.result(states, of_target))]),
        ca.Function("target_yield", [target], [_number(target_yield(thing, of_target))]),
    ]
    if method == "implicit":
        return functions + linear_contact(model.law, model.target)
    return functions + (_jets(model, law, target, of_law, of_target) if method == "events" else [])


def _jets(
    model: JointSpaceModel, law: Any, target: Any, of_law: dict[str, Any], of_target: dict[str, Any]
) -> list[Any]:
    thing, size = model.target, ORDER + 1
    speed, compressing, x = (ca.SX.sym(name) for name in ("speed", "compressing", "x"))
    rates, forces = ca.SX.sym("rates", size), ca.SX.sym("forces", size)
    z = ca.SX.sym("z", size, thing.n_states)
    states = [[z[k, i] for k in range(size)] for i in range(thing.n_states)]
    functions = []
    for k in range(size):
        moved = derivative(lambda *s: thing.velocity(s, of_target), states, k)
        rate = speed - moved
        known = [*[rates[i] for i in range(k)], rate]
        penetration = [x, *known[:k]]
        branches = [
            derivative(lambda a, b, c=c: model.law.branch(a, b, c, of_law), [penetration, known], k)
            for c in (True, False)
        ]
        force = ca.if_else(compressing, *branches)
        reached = [*[forces[i] for i in range(k)], force]
        nexts = [
            derivative(lambda f, *s, i=i: thing.derivative(s, f, of_target)[i], [reached, *states], k)
            for i in range(thing.n_states)
        ]
        out = [_number(rate), _number(force)]
        if k < ORDER:
            out.append(ca.densify(ca.vertcat(ca.SX(0, 1), *nexts)))
        inputs = [speed, compressing, x, rates, forces, z, law, target]
        functions.append(ca.Function(f"order_{k}", inputs, out))
    jets = [forces[i] for i in range(size)]
    count = len(thing.switches([state[0] for state in states], jets[0], of_target))
    switches = [
        ca.vertcat(
            *[
                derivative(lambda f, *s, i=i: thing.switches(s, f, of_target)[i], [jets, *states], k)
                for k in range(size)
            ]
        )
        for i in range(count)
    ]
    made = ca.densify(ca.horzcat(ca.SX(size, 0), *switches))
    return [*functions, ca.Function("switches", [forces, z, target], [made])]


def _number(expression: Any) -> Any:
    return ca.densify(ca.SX(expression))


# of each function, the inputs that it is differentiated by
_BACK = {"order": (0, 2, 3, 4, 5), "switches": (0, 1), "contact_force": (0, 1), "target_rates": (0, 1)}
_BACK |= {"target_velocity": (0,), "target_energy": (0,), "tree": (0, 1), "drift": (0, 1)}


def backwards(functions: list[Any]) -> list[Any]:
    """<name>_back (inputs, derivatives by the outputs) -> derivatives by some of the inputs, where used."""
    made = []
    for function in functions:
        kind = function.name().split("_")[0] if function.name().startswith("order_") else function.name()
        if kind in _BACK:
            x = [ca.SX.sym(name, *function.size_in(name)) for name in function.name_in()]
            y = function.call(x)
            seeds = [ca.SX.sym("seed", *part.shape) for part in y]
            by = [x[i] for i in _BACK[kind]]
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
    return f"#undef CASADI_PREFIX\n{generator.dump()}\n"
