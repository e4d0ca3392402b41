"""Law and target with their slopes, as implicit steps need them, and which are linear between events."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impactopt.contact import ContactLaw, Target

__all__ = ["contact_functions", "law_is_linear", "target_is_linear"]


def law_is_linear(law: ContactLaw) -> bool:
    """True if both branches are linear for all values of the law's parameters; a kink counts as nonlinear."""
    numbers, branches = _law_parts(law)
    slopes = ca.horzcat(*[ca.jacobian(f, x) for f, x in branches])
    found = [_at(numbers, law.parameters, slopes, branches[0][1], k) for k in range(_DRAWS)]
    return all((values == values[0]).all() for values in found)


def target_is_linear(target: Target) -> bool:
    """True if rates, velocity and switches are linear between switches, for all values of the parameters."""
    numbers, (whole, x) = _target_part(target)
    bending = ca.jacobian(ca.vec(ca.jacobian(whole, x)), x)
    if not bending.nnz():
        return True
    return all((_at(numbers, target.parameters, bending, x, k) == 0).all() for k in range(_DRAWS))


# sets of numbers that law and target are looked at with: their own, and others
_DRAWS = 3


def _at(numbers: Any, values: dict[str, float], f: Any, x: Any, draw: int) -> NDArray[np.float64]:
    """f in some hundred places, a row each."""
    rng, function = np.random.default_rng(draw), ca.Function("f", [numbers, x], [ca.densify(f)])
    own = np.array(list(values.values()))
    given = own * rng.uniform(0.5, 2.0, own.size) + rng.uniform(0.1, 0.5, own.size) if draw else own
    sizes = np.repeat(np.logspace(-6, 4, 11), 12)
    places = sizes * rng.uniform(-1.0, 1.0, (x.size1(), sizes.size))
    return np.array([np.array(function(given, place)).ravel() for place in places.T])


def contact_functions(law: ContactLaw, target: Target) -> list[Any]:
    """SX functions of law and target; these stand for the columns of their numbers.

    Of a law that is linear

        law_slopes (law) -> f_0, k, d of f = f_0 + k x + d dx/dt (3, 2): in restitution, in compression

    and of others, each with its slopes by penetration and rate (3):

        law_compressing, law_restoring (x, rate, law) -> force, in compression never below zero
        separation (x, rate, law) -> what falls through zero where contact ends

    target_slopes (z, force, target) -> d(dz/dt)/dz, d(dz/dt)/df, d(velocity)/dz, of the piece that z is in
    switch_slopes (z, force, target) -> switches, and their derivatives by z and force
    """
    of_target, z = ca.SX.sym("target", len(target.parameters)), ca.SX.sym("z", target.n_states)
    force, p = ca.SX.sym("force"), dict(zip(target.parameters, ca.vertsplit(of_target), strict=True))
    states = [z[i] for i in range(target.n_states)]
    rates = ca.vertcat(ca.SX(0, 1), *target.derivative(states, force, p))
    velocity = ca.SX(target.velocity(states, p))
    switches = ca.vertcat(ca.SX(0, 1), *target.switches(states, force, p))
    known = [z, force, of_target]

    def dense(*parts: Any) -> list[Any]:
        return [ca.densify(part) for part in parts]

    return [
        *_law_functions(law),
        ca.Function(
            "target_slopes",
            known,
            dense(ca.jacobian(rates, z), ca.jacobian(rates, force), ca.jacobian(velocity, z)),
        ),
        ca.Function(
            "switch_slopes", known, dense(switches, ca.jacobian(switches, z), ca.jacobian(switches, force))
        ),
    ]


def _law_functions(law: ContactLaw) -> list[Any]:
    numbers, ((restitution, at), (compression, _)) = _law_parts(law)
    if law_is_linear(law):
        columns = []
        for f in (restitution, compression):
            start = ca.substitute(f, at, ca.SX.zeros(2))
            columns.append(ca.vertcat(start, ca.substitute(ca.jacobian(f, at), at, ca.SX.zeros(2)).T))
        return [ca.Function("law_slopes", [numbers], [ca.densify(ca.horzcat(*columns))])]
    x, rate = ca.SX.sym("x"), ca.SX.sym("rate")
    p = dict(zip(law.parameters, ca.vertsplit(numbers), strict=True))
    left = ca.substitute(ca.SX(law.separation(x, rate, p)), ca.vertcat(x, rate), at)
    parts = {
        "law_compressing": ca.if_else(compression > 0, compression, 0.0),
        "law_restoring": restitution,
        "separation": left,
    }
    made = []
    for name, f in parts.items():
        with_slopes = ca.substitute(ca.vertcat(f, ca.jacobian(f, at).T), at, ca.vertcat(x, rate))
        made.append(ca.Function(name, [x, rate, numbers], [ca.densify(with_slopes)]))
    return made


def _law_parts(law: ContactLaw) -> tuple[Any, list[tuple[Any, Any]]]:
    """(its numbers, [(force, (x, rate)) in restitution, and in compression])."""
    numbers, x = ca.SX.sym("law", len(law.parameters)), ca.SX.sym("x", 2)
    p = dict(zip(law.parameters, ca.vertsplit(numbers), strict=True))
    return numbers, [(ca.SX(law.branch(x[0], x[1], c, p)), x) for c in (False, True)]


def _target_part(target: Target) -> tuple[Any, tuple[Any, Any]]:
    """(its numbers, (rates, velocity and switches, (state, force)))."""
    numbers, x = ca.SX.sym("target", len(target.parameters)), ca.SX.sym("x", target.n_states + 1)
    p = dict(zip(target.parameters, ca.vertsplit(numbers), strict=True))
    *states, force = [x[i] for i in range(target.n_states + 1)]
    moved = [*target.derivative(states, force, p), target.velocity(states, p)]
    return numbers, (ca.SX(ca.vertcat(*moved, *target.switches(states, force, p))), x)
