"""Implicit integration steps of order eight, by Norsett's restricted Pade approximations of the exponential.

Between events the frozen equations of motion are linear with constant coefficients, dy/dt = J y + c, so that
the exponential of h J gives their solution. With S = (I - gamma h J)^-1, from one factorization,

    y(t + theta h) = y(t) + sum over j = 1 ... 8 of p_j(theta) w_j
    w_1 = S h (J y + c),    w_(j+1) = h J S w_j
    p_j(theta) = (-gamma)^j L_j^(-1)(theta / gamma),    L_j^(-1) generalized Laguerre polynomials

is of order eight at every theta in [0, 1] (dense output). 1/gamma is the root of L_8 for which the stability
function R has R(infinity) = 0 and |R| <= 1 on the left half-plane: L-stability; no other root gives both.
A step that ends on an event, at theta < 1, amplifies the fastest modes by a third at most. The first
neglected term, p_9(1) z^9, is smaller than that of the Taylor polynomial of degree eight.

A nonlinear contact law or target is split: J has its derivatives at the start of the step, and the remainder
n(theta) = sum of n_j p_j(theta) enters as an input through the matrix B,

    (I - gamma h J) w_(j+1) = h J w_j + h B (n_j + gamma n_(j+1)).

The inputs n are scalars: the remainders of the contact force, of the target's rates and of the target's
velocity. Each is a polynomial of degree seven, exact at the step's start and at the seven other Lobatto
nodes. Newton's method on their values at the nodes is cheap beside the stages, which are computed three
times: without n, for unit inputs, and with n. If law and target are linear, n is zero.

Source: S. P. Norsett, "Restricted Pade approximations to the exponential function", SIAM J. Numer. Anal. 15
(1978) 1008-1029; E. Hairer and G. Wanner, Solving Ordinary Differential Equations II, section IV.6.
"""

from __future__ import annotations

from functools import cache
from math import comb

import numpy as np
from scipy.special import roots_laguerre

from impactopt.arrays import Array


def bernstein_matrix(degree: int) -> Array:
    """Matrix (degree + 1, degree + 1) from coefficients of powers of s to Bernstein coefficients on [0, 1].

    No entry is negative, so that nothing cancels if the coefficients of the powers decrease.
    """
    n = range(degree + 1)
    return np.array([[comb(i, k) / comb(degree, k) if k <= i else 0.0 for k in n] for i in n])


STAGES = 8
# Lobatto nodes of a step, besides its start, at which the nonlinear remainders are interpolated
NODES = 7


@cache
def gamma() -> float:
    """Diagonal coefficient of the method: one over the fourth root of the Laguerre polynomial L_8."""
    return float(1.0 / roots_laguerre(STAGES)[0][3])


def polynomials(count: int = STAGES) -> Array:
    """Coefficients of p_0, p_1, ... p_count (rows) by powers of theta (columns), (count + 1, count + 1)."""
    g, L = gamma(), np.zeros((count + 1, count + 1))
    # recurrence of the generalized Laguerre polynomials L_j^(-1)
    L[0, 0], L[1, 1] = 1.0, -1.0
    for j in range(1, count):
        L[j + 1] = (2 * j * L[j] - np.append(0.0, L[j, :-1]) - (j - 1) * L[j - 1]) / (j + 1)
    powers = np.arange(count + 1)
    # p_j(theta) = (-g)^j L_j(theta / g): rows have the factor (-g)^j, columns the powers of 1 / g
    found: Array = L * (-g) ** powers[:, None] / g**powers
    return found


def tables() -> dict[str, Array | float]:
    """Constants of the method, for the C kernel.

    POWERS (9, 9) : p_j (rows) by powers of theta.  AT_ONE (9) : p_j(1).
    HULL (9, 16) : w' HULL are the Bernstein coefficients of the sum of w_j p_j, padded with zeros.
    BOUND (9) : maximum of |p_j| on [0, 1].
    LEFT_OUT : |p_9(1)|, factor of the first neglected term.
    AT_NODES (7, 9) : p_j at the Lobatto nodes.  FROM_NODES (9, 7) : coefficients in the p_j of the polynomial
        that is zero at the start and has given values at the nodes.
    ANSWERS (8, 7, 7) : response at the nodes to inputs given at the nodes, as factors of (h J S)^k S h.
    """
    P, theta = polynomials(), np.linspace(0.0, 1.0, 2001)
    at, back = node_tables()
    values = np.vander(theta, STAGES + 1, increasing=True) @ P.T
    return {
        "POWERS": P,
        "AT_ONE": P.sum(axis=1),
        "HULL": np.pad(P @ bernstein_matrix(STAGES).T, ((0, 0), (0, 16 - STAGES - 1))),
        "BOUND": np.abs(values).max(axis=0),
        "LEFT_OUT": float(abs(polynomials(STAGES + 1)[-1].sum())),
        "AT_NODES": at,
        "FROM_NODES": back,
        "ANSWERS": _node_responses(at, back),
    }


@cache
def node_tables() -> tuple[Array, Array]:
    """AT_NODES and FROM_NODES of `tables`; Lobatto nodes, as they include the end of the step."""
    # the eight Lobatto nodes of [0, 1]: its ends and the roots of the derivative of P_7
    inner = np.polynomial.legendre.legroots(np.polynomial.legendre.Legendre.basis(NODES).deriv().coef)
    nodes = np.array([0.0, *((np.sort(inner) + 1.0) / 2.0), 1.0])
    values = np.vander(nodes, STAGES + 1, increasing=True) @ polynomials().T
    back = np.zeros((STAGES + 1, NODES))
    # p_8 is left out: eight values, the start's among them, determine a polynomial of degree seven
    back[:STAGES] = np.linalg.inv(values[:, :STAGES])[:, 1:]
    back[0] = 0.0
    return values[1:], back


def _node_responses(at: Array, back: Array) -> Array:
    """Table ANSWERS of `tables`.

    n_m enters the stage w_m with the factor gamma, and w_(m+1) with one. After k more stages, each of which
    multiplies by h J S, it is in w_(m+k) and w_(m+k+1).
    """
    found = np.zeros((STAGES, NODES, NODES))
    for k in range(STAGES):
        for m in range(STAGES + 1):
            response = gamma() * at[:, m + k] if m >= 1 and m + k <= STAGES else np.zeros(NODES)
            if m + k + 1 <= STAGES:
                response = response + at[:, m + k + 1]
            found[k] += np.outer(response, back[m])
    return found
