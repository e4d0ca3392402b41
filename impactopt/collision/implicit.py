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

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from math import comb
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import roots_laguerre

from impactopt.collision.stepped import contact_functions, law_is_linear, target_is_linear
from impactopt.contact import ContactLaw, Target

Array = NDArray[np.float64]

# subintervals of [0, 1] shorter than this are not subdivided further
_SHORTEST_INTERVAL = 2.0**-50
# relative rounding error of the coefficients of a subdivided polynomial
_SUBDIVISION_ROUNDING = 1e-14


def bernstein_matrix(degree: int) -> Array:
    """Matrix (degree + 1, degree + 1) from coefficients of powers of s to Bernstein coefficients on [0, 1].

    No entry is negative, so that nothing cancels if the coefficients of the powers decrease.
    """
    n = range(degree + 1)
    return np.array([[comb(i, k) / comb(degree, k) if k <= i else 0.0 for k in n] for i in n])


def first_negative(b: Array, start: float = 0.0, length: float = 1.0) -> float | None:
    """First point at which a polynomial becomes negative, or None, from its Bernstein coefficients.

    The interval is [start, start + length]. The polynomial lies in the convex hull of its coefficients and
    has at most as many roots as they have sign changes (Lane and Riesenfeld, BIT 21 (1981) 112-117). The
    interval is halved until this decides.
    """
    if (b >= 0).all():
        return None
    if b[0] < 0 or (b <= 0).all():
        return start
    if length < _SHORTEST_INTERVAL:
        return start if b[-1] < 0 else None
    signs = np.sign(b[b != 0])
    if b[0] > 0 and b[-1] < 0 and (np.diff(signs) != 0).sum() == 1:
        # one sign change: exactly one root
        root = brentq(lambda s: _halves(b, s)[0][-1], 0.0, 1.0, xtol=1e-18, rtol=1e-15)
        return start + length * float(root)
    left, right = _halves(b, 0.5)
    found = first_negative(left, start, length / 2)
    return first_negative(right, start + length / 2, length / 2) if found is None else found


def largest(b: Array, end: float, least: float) -> float:
    """Maximum of `least` and of a polynomial on [0, end], up to rounding, from its Bernstein coefficients.

    The largest coefficient is an upper bound of the values. It converges to their maximum with the square of
    the subintervals' length.
    """
    if b.max() <= least + _SUBDIVISION_ROUNDING * np.abs(b).max():
        return least
    b = _halves(b, end)[0] if end < 1.0 else b
    # the end coefficients are values of the polynomial
    least = max(least, float(b[0]), float(b[-1]))
    if b.max() <= least + _SUBDIVISION_ROUNDING * np.abs(b).max():
        return least
    left, right = _halves(b, 0.5)
    return largest(right, 1.0, largest(left, 1.0, least))


def _halves(b: Array, s: float) -> tuple[Array, Array]:
    """Bernstein coefficients of a polynomial on [0, s] and on [s, 1] (de Casteljau)."""
    left, right, row = np.empty_like(b), np.empty_like(b), b
    for k in range(b.size):
        left[k], right[-1 - k] = row[0], row[-1]
        row = (1.0 - s) * row[:-1] + s * row[1:]
    return left, right


STAGES = 8
# Lobatto nodes of a step, besides its start, at which the nonlinear remainders are interpolated
NODES = 7


@dataclass(frozen=True, kw_only=True)
class StepControl:
    """Constants of events and step control, for the C kernel (as macros) and its NumPy twin.

    Errors are relative to the tolerance.

    Attributes
    ----------
    event_overshoot : part of its length by which a step passes an event, so that the next one begins in the
        new phase.
    immediate_event : part of a step before which an event is immediate: rounding may have hidden that the
        last one is over.
    first_step_phase : phase [rad] of the contact's fastest mode in the first step.
    first_speed_change, first_speed_change_flat : with a nonlinear law instead, the relative change of the
        hand's speed in it; the second where the force begins without a slope, as x^1.5.
    lengthen_below, lengthen_below_nonlinear : error below which the next step is longer, for an error of
        `aimed_error`. That costs a factorization, which nonlinear laws and targets need at each step anyway.
    retry_factor : of a step for which Newton's method has not converged; at most `max_tries` for a step.
    separation_fraction : part of the time left to separation that a step takes at most under a nonlinear
        law. A force like x^1.5 has no Taylor series there: steps get shorter, down to the first one's length.
    error_of_limit : permitted error of a joint's demand, relative to its torque limit.
    error_of_switch : permitted error of a target's switch by position, relative to other errors. A position
        that changes slowly passes its switch too late by it: without the factor, a board bent slowly to its
        break was off by 1.1e-5.
    """

    event_overshoot: float = 1e-9
    immediate_event: float = 1e-5
    first_step_phase: float = 0.5
    first_speed_change: float = 0.1
    first_speed_change_flat: float = 3e-4
    lengthen_below: float = 2e-3
    lengthen_below_nonlinear: float = 0.1
    aimed_error: float = 0.2
    retry_factor: float = 0.3
    separation_fraction: float = 0.6
    error_of_limit: float = 1e-2
    error_of_switch: float = 0.1
    max_tries: int = 200


CONTROL = StepControl()


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
    """Constants of the method, for the C kernel and its NumPy twin.

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


# of Newton's method on the remainders: the last change, relative to what they are remainders of. Its error is
# the square of that (native/implicit_remainders.h).
_MAX_NEWTON_ITERATIONS, _NEWTON_TOLERANCE = 12, 1e-6


class Contact:
    """Numeric functions of a law and a target, with their derivatives; see `contact_functions`."""

    def __init__(self, law: ContactLaw, target: Target) -> None:
        self.law_is_nonlinear = not law_is_linear(law)
        self.target_is_nonlinear = not target_is_linear(target)
        self._functions = {f.name(): f for f in contact_functions(law, target)}
        self.target = target

    @property
    def is_nonlinear(self) -> bool:
        return self.law_is_nonlinear or self.target_is_nonlinear

    def of(self, law: dict[str, float], target: dict[str, float]) -> Law:
        """The same with these parameters."""
        return Law(self, ca.DM(list(law.values())), target)

    def call(self, name: str, *given: Any) -> list[Array]:
        """Outputs of a function of `contact_functions`."""
        return [np.array(x, dtype=float) for x in self._functions[name].call([ca.DM(x) for x in given])]


class Law:
    """Law and target with the parameters of one collision."""

    def __init__(self, contact: Contact, law: Any, target: dict[str, float]) -> None:
        self.contact, self._law, self._parameters = contact, law, target
        self._target = ca.DM(list(target.values()))
        self._linear = None if contact.law_is_nonlinear else contact.call("law_slopes", law)[0]

    def force(self, x: float, rate: float, compressing: bool) -> tuple[float, float, float]:
        """Contact force [N], and its derivatives by penetration [N/m] and by rate of penetration [N s/m]."""
        if self._linear is None:
            (found,) = self.contact.call(
                "law_compressing" if compressing else "law_restoring", x, rate, self._law
            )
            f, k, d = (float(value) for value in found.ravel())
            return f, k, d
        k, d = (float(value) for value in self._linear[:, int(compressing)])
        return k * x + d * rate, k, d

    def separation(self, x: float, rate: float) -> float:
        """Function that is positive while contact lasts in restitution."""
        if self._linear is None:
            return float(self.contact.call("separation", x, rate, self._law)[0][0, 0])
        return self.force(x, rate, False)[0]

    def velocity(self, z: Array) -> float:
        """Velocity of the target's surface along the normal [m/s]."""
        return float(self.contact.target.velocity([*z], self._parameters))

    def rates(self, z: Array, force: float) -> Array:
        """Time derivative of the target's state z (k)."""
        return np.array([float(x) for x in self.contact.target.derivative([*z], force, self._parameters)])

    def slopes(self, z: Array, force: float) -> tuple[Array, Array, Array]:
        """Derivatives of the rates by state (k, k) and force (k), and of the velocity by state (k)."""
        Z, G, velocity_by_z = self.contact.call("target_slopes", z, force, self._target)
        return Z.reshape(z.size, z.size), G.ravel(), velocity_by_z.ravel()

    def switches(self, z: Array, force: float) -> tuple[Array, Array, Array]:
        """Switching functions of the target (m), and their derivatives by state (m, k) and force (m)."""
        values, by_z, by_force = self.contact.call("switch_slopes", z, force, self._target)
        return values.ravel(), by_z.reshape(values.size, z.size), by_force.ravel()


@dataclass(frozen=True, eq=False, kw_only=True)
class StateMaps:
    """Matrices and vectors that map a state (m) to the quantities that forces, events and errors depend on.

    They give the parts that are linear in the state; constant terms are left out.

    speeds (n + 1, m) : velocities of the joints, and speed of the hand.  demand (n, m) : servo torques.
    penetration, impulse (m).  target (k, m) : the target's state.
    """

    speeds: Array
    demand: Array
    penetration: Array
    impulse: Array
    target: Array


class Step:
    """Dense output of a step: y(t + theta h) = sum of p_j(theta) times row j of `terms` (9, m).

    rate, force (9) : rate of penetration [m/s] and contact force [N], in the same polynomials.
    converged : whether Newton's method has converged, with a nonlinear law or target.

    Parameters
    ----------
    y, rates : state (m), and its time derivative F(y).
    slopes : Jacobian of the rates by the state, without law and target (m, m).
    maps : quantities of the state that law and target depend on.
    law : of one collision.  now : rate of penetration [m/s], and whether it is compression.  h : [s].
    """

    def __init__(
        self,
        y: Array,
        rates: Array,
        slopes: Array,
        maps: StateMaps,
        law: Law,
        now: tuple[float, bool],
        h: float,
    ) -> None:
        self.y, self.h, self.law, self.maps, (self._rate, self._compressing) = y, h, law, maps, now
        x, z = float(maps.penetration @ y), maps.target @ y
        self._force, k, d = law.force(x, self._rate, self._compressing)
        Z, G, velocity_by_z = law.slopes(z, self._force)
        # gradients (m) of rate of penetration and contact force, and of the target's rates (k, m), by the
        # state
        rate = maps.speeds[-1] - velocity_by_z @ maps.target
        force = k * maps.penetration + d * rate
        target = Z @ maps.target + np.outer(G, force)
        self._J = slopes + np.outer(maps.penetration, rate) + np.outer(maps.impulse, force)
        self._J += maps.target.T @ target
        # columns of B: remainders of the force, of the target's rates, and of its velocity. The last one
        # lowers the rate of penetration, and with it the damping force.
        of_force = maps.impulse + maps.target.T @ G
        self._B = np.column_stack([of_force, maps.target.T, -maps.penetration - d * of_force])
        self._k, self._d, self._slopes, self._rates = k, d, (Z, G, velocity_by_z), law.rates(z, self._force)
        self._S = np.linalg.inv(np.eye(y.size) - gamma() * h * self._J)
        n = np.zeros((STAGES + 1, 2 + z.size))
        self.converged = True
        if law.contact.is_nonlinear:
            n, self.converged = self._solve_remainders(rates)
        self.terms = self._series(y, h * rates, n)
        self.rate, self.force = self.terms @ rate - n[:, -1], self.terms @ force
        self.force = self.force - d * n[:, -1] + n[:, 0]
        self.rate[0], self.force[0] = self._rate, self._force

    def _series(self, y: Array, first: Array, n: Array) -> Array:
        """Terms w_j (9, m) from the state, h times its rates, and the inputs' coefficients (9, inputs)."""
        g, w = gamma(), np.zeros((STAGES + 1, y.size))
        w[0], w[1] = y, self._S @ (first + g * self.h * (self._B @ n[1]))
        for j in range(1, STAGES):
            w[j + 1] = self.h * (self._S @ (self._J @ w[j] + self._B @ (n[j] + g * n[j + 1])))
        return w

    def at_nodes(self, terms: Array) -> Array:
        """Values at the nodes (7, ...) of polynomials given by their terms (9, ...)."""
        found: Array = node_tables()[0] @ terms
        return found

    def through_nodes(self, start: Any, function: Callable[[int], Any]) -> Array:
        """Terms (9, ...) of a polynomial with these values at the start and at node 0 ... 6."""
        terms: Array = node_tables()[1] @ np.array([np.asarray(function(i)) - start for i in range(NODES)])
        terms[0] = start
        return terms

    def _solve_remainders(self, rates: Array) -> tuple[Array, bool]:
        """Inputs n as terms (9, inputs), by Newton's method on n = R(o(n)); and whether it has converged.

        o are the arguments of law and target at the nodes, (penetration, rate, target's state), which are
        affine in the inputs: o = base + K n. R are the remainders at these arguments.
        """
        inputs, rest, from_nodes = self._B.shape[1], 0.0 * rates, node_tables()[1]
        base = self._arguments(self._series(self.y, self.h * rates, np.zeros((STAGES + 1, inputs))))
        arguments = base.shape[1]
        responses = np.zeros((NODES, arguments, NODES, inputs))
        for i in range(NODES):
            for a in range(inputs):
                unit = np.zeros((STAGES + 1, inputs))
                unit[:, a] = from_nodes[:, i]
                responses[:, :, i, a] = self._argument_changes(self._series(rest, rest, unit))
                if a == inputs - 1:
                    # the remainder of the target's velocity also acts on the rate directly
                    responses[i, 1, i, a] -= 1.0
        K, n = responses.reshape(NODES * arguments, NODES * inputs), np.zeros(NODES * inputs)
        for _ in range(_MAX_NEWTON_ITERATIONS):
            at_nodes = base + (K @ n).reshape(NODES, arguments)
            evaluated = [self._remainders(node) for node in at_nodes]
            R, sizes = np.array([x[0] for x in evaluated]), np.max([x[2] for x in evaluated], axis=0)
            # block diagonal: the remainders of a node depend on the arguments there only
            R_by_o = np.zeros((NODES * inputs, NODES * arguments))
            for i, (_, slope, _) in enumerate(evaluated):
                R_by_o[i * inputs : (i + 1) * inputs, i * arguments : (i + 1) * arguments] = slope
            change = np.linalg.solve(np.eye(n.size) - R_by_o @ K, R.ravel() - n)
            n = n + change
            if (np.abs(change).reshape(NODES, inputs) <= _NEWTON_TOLERANCE * sizes).all():
                return from_nodes @ n.reshape(NODES, inputs), True
        return from_nodes @ n.reshape(NODES, inputs), False

    def _argument_changes(self, terms: Array) -> Array:
        """Changes of the arguments at the nodes (7, 2 + k) with a change of the state."""
        maps, velocity_by_z = self.maps, self._slopes[2]
        states = self.at_nodes(terms)
        rate = states @ (maps.speeds[-1] - velocity_by_z @ maps.target)
        return np.column_stack([states @ maps.penetration, rate, states @ maps.target.T])

    def _arguments(self, terms: Array) -> Array:
        """Arguments at the nodes (7, 2 + k): penetration, its rate, the target's state."""
        found = self._argument_changes(terms)
        maps, velocity_by_z = self.maps, self._slopes[2]
        # the constant term of the rate, which the maps leave out
        found[:, 1] += self._rate - self.y @ (maps.speeds[-1] - velocity_by_z @ maps.target)
        return found

    def _remainders(self, arguments: Array) -> tuple[Array, Array, Array]:
        """Remainders R (inputs) at one node, their derivatives by the arguments (inputs, 2 + k), and the
        magnitudes (inputs) of the quantities that they are remainders of.
        """
        maps, law, (Z, G, velocity_by_z) = self.maps, self.law, self._slopes
        x, rate, z = arguments[0], arguments[1], arguments[2:]
        start = maps.target @ self.y
        force, k, d = law.force(x, rate, self._compressing)
        more = force - self._force
        linear = self._k * (x - float(maps.penetration @ self.y)) + self._d * (rate - self._rate)
        by = np.zeros((2 + z.size, arguments.size))
        by[0, :2] = k - self._k, d - self._d
        if not law.contact.target_is_nonlinear:
            return np.array([more - linear, *(0.0 * z), 0.0]), by, np.array([abs(force), *(0 * z + 1), 1.0])
        rates, (Z_1, G_1, velocity_by_z_1) = law.rates(z, force), law.slopes(z, force)
        by[1:-1, 0], by[1:-1, 1], by[1:-1, 2:] = (G_1 - G) * k, (G_1 - G) * d, Z_1 - Z
        by[-1, 2:] = velocity_by_z_1 - velocity_by_z
        R = [more - linear, *(rates - self._rates - Z @ (z - start) - G * more)]
        R.append(law.velocity(z) - law.velocity(start) - velocity_by_z @ (z - start))
        return np.array(R), by, np.array([abs(force), *np.abs(rates), abs(rate)])
