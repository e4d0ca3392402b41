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

Law and target need not be linear. J then has their slopes at the step's begin, and what they are beyond
these, n(theta), acts on the linear rest as an input: with n = sum of n_j p_j and e what it acts on,

    (I - gamma h J) w_(j+1) = h J w_j + h e (n_j + gamma n_(j+1)).

n is a polynomial of degree seven that is right at the step's begin and at Lobatto's other seven places. It is
a few scalars (force, target), so that Newton's method on them costs little beside the stages, of which there
are three sets: without n, its answers, and with n. For what is linear n is zero, and nothing is different.

Source: S. P. Norsett, "Restricted Pade approximations to the exponential function", SIAM J. Numer. Anal. 15
(1978) 1008-1029; E. Hairer and G. Wanner, Solving Ordinary Differential Equations II, section IV.6.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import roots_laguerre

from impactopt.collision.bernstein import bernstein_matrix

__all__ = ["NODES", "STAGES", "gamma", "tables"]

Array = NDArray[np.float64]

STAGES = 8
# places of a step, besides its begin, where what bends in law and target is right
NODES = 7


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
    """Tables of constants for the kernel.

    POWERS (9, 9) : coefficients of the powers of theta of each p_j. AT_ONE (9) : p_j(1).
    HULL (9, 16) : Bernstein coefficients of a sum of w_j p_j are w' HULL, and zeros.
    BOUND (9) : largest |p_j| on [0, 1].
    LEFT_OUT : |p_9(1)|, what a further term would be multiplied by.
    AT_NODES (7, 9) : p_j at the nodes. FROM_NODES (9, 7) : coefficients of the p_j of a polynomial that is 0
        at the begin, from its values at the nodes.
    ANSWERS (8, 7, 7) : of inputs with these values at the nodes, what the nodes see of (h J S)^k S h.
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
        "ANSWERS": _answers(at, back),
    }


def node_tables() -> tuple[Array, Array]:
    """AT_NODES and FROM_NODES of `tables`: Lobatto's places, so that what a step ends with is right too."""
    inner = np.polynomial.legendre.legroots(np.polynomial.legendre.Legendre.basis(NODES).deriv().coef)
    places = np.array([0.0, *((np.sort(inner) + 1.0) / 2.0), 1.0])
    values = np.vander(places, STAGES + 1, increasing=True) @ polynomials().T
    back = np.zeros((STAGES + 1, NODES))
    back[:STAGES] = np.linalg.inv(values[:, :STAGES])[:, 1:]
    back[0] = 0.0
    return values[1:], back


def _answers(at: Array, back: Array) -> Array:
    """A stage j takes n_j + gamma n_(j+1) in, but the first n_1, and hands it on by h J S."""
    found = np.zeros((STAGES, NODES, NODES))
    for k in range(STAGES):
        for m in range(STAGES + 1):
            taken = gamma() * at[:, m + k] if m >= 1 and m + k <= STAGES else np.zeros(NODES)
            if m + k + 1 <= STAGES:
                taken = taken + at[:, m + k + 1]
            found[k] += np.outer(taken, back[m])
    return found
