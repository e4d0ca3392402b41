"""Numbers of the implicit steps: Norsett's restricted Pade approximations of the exponential, of order eight.

Between events the frozen equations are linear with constant coefficients, dy/dt = J y + c, so that their
solution is known by the exponential of J. With S = (I - gamma h J)^-1, which one factorization gives,

    y(t + theta h) = y(t) + sum over j = 1 ... 8 of p_j(theta) w_j
    w_1 = S h (J y + c),    w_(j+1) = h J S w_j
    p_j(theta) = (-gamma)^j L_j^(-1)(theta / gamma),    L_j^(-1) Laguerre's polynomials

has order eight for every theta. Where 1/gamma is a root of L_8 the fastest modes are damped away: R(infinity)
= 0, and |R| <= 1 on the left half-plane, which of the roots only this one gives (steps that end on events, at
theta < 1, let them grow by a third at most). What is left out, p_9(1) z^9, is smaller than what Taylor's
polynomial of degree eight leaves out.

Source: S. P. Norsett, "Restricted Pade approximations to the exponential function", SIAM J. Numer. Anal. 15
(1978) 1008-1029; E. Hairer and G. Wanner, Solving Ordinary Differential Equations II, section IV.6.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.special import roots_laguerre

from impactopt.collision.bernstein import bernstein_matrix
from impactopt.contact import ContactLaw, Target

__all__ = ["STAGES", "gamma", "is_linear", "linear_contact", "tables"]

Array = NDArray[np.float64]

STAGES = 8


def gamma() -> float:
    """1 / gamma is the fourth root of L_8."""
    return float(1.0 / roots_laguerre(STAGES)[0][3])


def polynomials(count: int = STAGES) -> Array:
    """(count + 1, count + 1): coefficients of 1, theta, theta^2, ... of p_0, p_1, ..., a row each."""
    g, L = gamma(), np.zeros((count + 1, count + 1))
    L[0, 0], L[1, 1] = 1.0, -1.0
    for j in range(1, count):
        L[j + 1] = (2 * j * L[j] - np.append(0.0, L[j, :-1]) - (j - 1) * L[j - 1]) / (j + 1)
    powers = np.arange(count + 1)
    found: Array = L * (-g) ** powers[:, None] / g**powers
    return found


def tables() -> dict[str, Array | float]:
    """What the kernel needs.

    POWERS (9, 9) : coefficients of the powers of theta of each p_j. AT_ONE (9) : p_j(1).
    HULL (9, 16) : Bernstein coefficients of a sum of w_j p_j are w' HULL, and zeros.
    BOUND (9) : largest |p_j| on [0, 1].
    LEFT_OUT : |p_9(1)|, what a further term would be multiplied by.
    """
    P, theta = polynomials(), np.linspace(0.0, 1.0, 2001)
    values = np.vander(theta, STAGES + 1, increasing=True) @ P.T
    return {
        "POWERS": P,
        "AT_ONE": P.sum(axis=1),
        "HULL": np.pad(P @ bernstein_matrix(STAGES).T, ((0, 0), (0, 16 - STAGES - 1))),
        "BOUND": np.abs(values).max(axis=0),
        "LEFT_OUT": float(abs(polynomials(STAGES + 1)[-1].sum())),
    }


# ---------------------------------------------------------------- law and target
def is_linear(law: ContactLaw, target: Target) -> bool:
    """Whether both are linear between events, as implicit steps need them: their second derivatives are zero
    in all of some hundred places."""
    rng = np.random.default_rng(0)
    of_law, branches = _law_parts(law)
    of_target, whole = _target_part(target)
    cases = [(of_law, law.parameters, f, x) for f, x in branches] + [(of_target, target.parameters, *whole)]
    for numbers, values, f, x in cases:
        bending = ca.jacobian(ca.vec(ca.jacobian(f, x)), x)
        if bending.nnz():
            function = ca.Function("bending", [numbers, x], [bending])
            for size in np.repeat(np.logspace(-6, 4, 11), 12):
                place = size * rng.uniform(-1.0, 1.0, x.size1())
                if not (np.array(function(ca.DM(list(values.values())), place)) == 0).all():
                    return False
    return True


def linear_contact(law: ContactLaw, target: Target) -> list[Any]:
    """Law and target as coefficients, SX functions; law and target stand for the columns of their numbers.

    law_slopes (law) -> f_0, k, d of f = f_0 + k x + d dx/dt (3, 2): in restitution, in compression
    target_slopes (z, force, target) -> d(dz/dt)/dz, d(dz/dt)/df, d(velocity)/dz, of the piece that z is in
    switch_slopes (z, force, target) -> switches, and their derivatives by z and force
    """
    numbers, branches = _law_parts(law)
    columns = []
    for f, x in branches:
        at_rest = ca.substitute(f, x, ca.SX.zeros(2))
        columns.append(ca.vertcat(at_rest, ca.jacobian(f, x).T))
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
        ca.Function("law_slopes", [numbers], dense(ca.horzcat(*columns))),
        ca.Function(
            "target_slopes",
            known,
            dense(ca.jacobian(rates, z), ca.jacobian(rates, force), ca.jacobian(velocity, z)),
        ),
        ca.Function(
            "switch_slopes", known, dense(switches, ca.jacobian(switches, z), ca.jacobian(switches, force))
        ),
    ]


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
