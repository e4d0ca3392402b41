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

In one phase the state's rates are F(y), of which J y + B n is made: J has the slopes of servo, law and target
at the step's begin, and n is what force, target's rates and target's velocity have beyond these.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import comb
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import roots_laguerre

from impactopt.collision.stepped import contact_functions, law_is_linear, target_is_linear
from impactopt.contact import ContactLaw, Target

__all__ = [
    "NODES",
    "STAGES",
    "Contact",
    "Law",
    "Step",
    "Watched",
    "bernstein_matrix",
    "first_negative",
    "gamma",
    "largest",
    "node_tables",
    "polynomials",
    "tables",
]

Array = NDArray[np.float64]

# parts of [0, 1] below this length are not told apart
_SHORTEST = 2.0**-50
# relative: halves of a polynomial are exact up to this
_ROUNDING = 1e-14


def bernstein_matrix(degree: int) -> Array:
    """(degree + 1, degree + 1): Bernstein coefficients are this times those of 1, s, s^2, ...

    No entry is negative, so that nothing is lost by rounding where the powers' coefficients fall off.
    """
    n = range(degree + 1)
    return np.array([[comb(i, k) / comb(degree, k) if k <= i else 0.0 for k in n] for i in n])


def first_negative(b: Array, start: float = 0.0, length: float = 1.0) -> float | None:
    """First place at which a polynomial, given by its Bernstein coefficients, falls below zero; None if
    nowhere.

    The polynomial lies in its coefficients' convex hull, and has no more roots than they have sign changes
    (Lane and Riesenfeld, BIT 21 (1981) 112-117): parts are halved until that decides.
    """
    if (b >= 0).all():
        return None
    if b[0] < 0 or (b <= 0).all():
        return start
    if length < _SHORTEST:
        return start if b[-1] < 0 else None
    signs = np.sign(b[b != 0])
    if b[0] > 0 and b[-1] < 0 and (np.diff(signs) != 0).sum() == 1:
        root = brentq(lambda s: _halves(b, s)[0][-1], 0.0, 1.0, xtol=1e-18, rtol=1e-15)
        return start + length * float(root)
    left, right = _halves(b, 0.5)
    found = first_negative(left, start, length / 2)
    return first_negative(right, start + length / 2, length / 2) if found is None else found


def largest(b: Array, end: float, least: float) -> float:
    """The greatest of `least` and a polynomial's values on [0, end], but for rounding.

    No value is above the greatest coefficient, which comes down to the values with the square of the length
    of the parts.
    """
    if b.max() <= least + _ROUNDING * np.abs(b).max():
        return least
    b = _halves(b, end)[0] if end < 1.0 else b
    least = max(least, float(b[0]), float(b[-1]))
    if b.max() <= least + _ROUNDING * np.abs(b).max():
        return least
    left, right = _halves(b, 0.5)
    return largest(right, 1.0, largest(left, 1.0, least))


def _halves(b: Array, s: float) -> tuple[Array, Array]:
    """Coefficients of the parts on [0, s] and [s, 1] (de Casteljau)."""
    left, right, row = np.empty_like(b), np.empty_like(b), b
    for k in range(b.size):
        left[k], right[-1 - k] = row[0], row[-1]
        row = (1.0 - s) * row[:-1] + s * row[1:]
    return left, right


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


_TABLES = tables()
_AT_NODES, _FROM_NODES = np.asarray(_TABLES["AT_NODES"]), np.asarray(_TABLES["FROM_NODES"])
# as in native/implicit_remainders.h
_MOST_ITERATIONS, _CONVERGED = 12, 1e-6


class Contact:
    """Law and target as numbers, with their slopes."""

    def __init__(self, law: ContactLaw, target: Target) -> None:
        self.law_bends, self.target_bends = not law_is_linear(law), not target_is_linear(target)
        self._functions = {f.name(): f for f in contact_functions(law, target)}
        self.target = target

    def of(self, law: dict[str, float], target: dict[str, float]) -> Law:
        """Law with these parameters."""
        return Law(self, ca.DM(list(law.values())), target)

    def call(self, name: str, *given: Any) -> list[Array]:
        """A function of `contact_functions`."""
        return [np.array(x, dtype=float) for x in self._functions[name].call([ca.DM(x) for x in given])]


class Law:
    """The same, of one collision."""

    def __init__(self, contact: Contact, law: Any, target: dict[str, float]) -> None:
        self.contact, self._law, self._numbers = contact, law, target
        self._target = ca.DM(list(target.values()))
        self._linear = None if contact.law_bends else contact.call("law_slopes", law)[0]

    def force(self, x: float, rate: float, compressing: bool) -> tuple[float, float, float]:
        """Force [N], and its slopes by penetration and rate."""
        if self._linear is None:
            (found,) = self.contact.call(
                "law_compressing" if compressing else "law_restoring", x, rate, self._law
            )
            f, k, d = (float(value) for value in found.ravel())
            return f, k, d
        f_0, k, d = (float(value) for value in self._linear[:, int(compressing)])
        return f_0 + k * x + d * rate, k, d

    def left(self, x: float, rate: float) -> float:
        """Above zero while contact lasts in restitution."""
        if self._linear is None:
            return float(self.contact.call("separation", x, rate, self._law)[0][0, 0])
        return self.force(x, rate, False)[0]

    def velocity(self, z: Array) -> float:
        """Velocity of the target [m/s]."""
        return float(self.contact.target.velocity([*z], self._numbers))

    def rates(self, z: Array, force: float) -> Array:
        """Rates of the target's state."""
        return np.array([float(x) for x in self.contact.target.derivative([*z], force, self._numbers)])

    def slopes(self, z: Array, force: float) -> tuple[Array, Array, Array]:
        """Slopes of the rates by state and force, and of the velocity by state."""
        Z, G, at = self.contact.call("target_slopes", z, force, self._target)
        return Z.reshape(z.size, z.size), G.ravel(), at.ravel()

    def switches(self, z: Array, force: float) -> tuple[Array, Array, Array]:
        """The target's switches, and their slopes by state and force."""
        values, by_z, by_force = self.contact.call("switch_slopes", z, force, self._target)
        return values.ravel(), by_z.reshape(values.size, z.size), by_force.ravel()


@dataclass(frozen=True, eq=False, kw_only=True)
class Watched:
    """Rows that give what is watched from a state: of the state alone, so that constants are left out.

    speeds (n + 1, m) of joints and hand; demand (n, m); penetration, impulse (m); target (k, m).
    """

    speeds: Array
    demand: Array
    penetration: Array
    impulse: Array
    target: Array


class Step:
    """The series of a step: y(t + theta h) = sum of p_j(theta) times row j of `terms` (9, m).

    rate, force (9) : of penetration, and of the contact, in the same polynomials.
    found : whether Newton's method has found what bends in law and target.

    Parameters
    ----------
    y, rates : state (m), and its rates F(y).
    slopes : of the rates by the state, without law and target (m, m).
    rows : what law and target see of the state.
    law : of one collision.  now : rate of penetration [m/s], and whether it compresses.  h : [s].
    """

    def __init__(
        self,
        y: Array,
        rates: Array,
        slopes: Array,
        rows: Watched,
        law: Law,
        now: tuple[float, bool],
        h: float,
    ) -> None:
        self.y, self.h, self.law, self.rows, (self._rate, self._compressing) = y, h, law, rows, now
        x, z = float(rows.penetration @ y), rows.target @ y
        self._force, k, d = law.force(x, self._rate, self._compressing)
        Z, G, at = law.slopes(z, self._force)
        rate = rows.speeds[-1] - at @ rows.target
        force = k * rows.penetration + d * rate
        target = Z @ rows.target + np.outer(G, force)
        self._J = slopes + np.outer(rows.penetration, rate) + np.outer(rows.impulse, force)
        self._J += rows.target.T @ target
        # a target's velocity that is more than its slopes say takes it off the rate
        of_force = rows.impulse + rows.target.T @ G
        self._B = np.column_stack([of_force, rows.target.T, -rows.penetration - d * of_force])
        self._k, self._d, self._slopes, self._rates = k, d, (Z, G, at), law.rates(z, self._force)
        self._S = np.linalg.inv(np.eye(y.size) - gamma() * h * self._J)
        n = np.zeros((STAGES + 1, 2 + z.size))
        self.found = True
        if law.contact.law_bends or law.contact.target_bends:
            n, self.found = self._bend(rates)
        self.terms = self._series(y, h * rates, n)
        self.rate, self.force = self.terms @ rate - n[:, -1], self.terms @ force
        self.force = self.force - d * n[:, -1] + n[:, 0]
        self.rate[0], self.force[0] = self._rate, self._force

    def _series(self, y: Array, first: Array, n: Array) -> Array:
        g, w = gamma(), np.zeros((STAGES + 1, y.size))
        w[0], w[1] = y, self._S @ (first + g * self.h * (self._B @ n[1]))
        for j in range(1, STAGES):
            w[j + 1] = self.h * (self._S @ (self._J @ w[j] + self._B @ (n[j] + g * n[j + 1])))
        return w

    def at_nodes(self, terms: Array) -> Array:
        """(7, ...): values at the nodes."""
        found: Array = _AT_NODES @ terms
        return found

    def through_nodes(self, start: Any, function: Callable[[int], Any]) -> Array:
        """Terms (9, ...) of a polynomial with these values at the begin and at node 0 ... 6."""
        terms: Array = _FROM_NODES @ np.array([np.asarray(function(i)) - start for i in range(NODES)])
        terms[0] = start
        return terms

    def _bend(self, rates: Array) -> tuple[Array, bool]:
        """(n as terms (9, inputs), whether it was found)."""
        inputs, rest = self._B.shape[1], 0.0 * rates
        base = self._seen(self._series(self.y, self.h * rates, np.zeros((STAGES + 1, inputs))))
        seen = base.shape[1]
        answers = np.zeros((NODES, seen, NODES, inputs))
        for i in range(NODES):
            for a in range(inputs):
                unit = np.zeros((STAGES + 1, inputs))
                unit[:, a] = _FROM_NODES[:, i]
                answers[:, :, i, a] = self._changes(self._series(rest, rest, unit))
                if a == inputs - 1:
                    answers[i, 1, i, a] -= 1.0
        K, n = answers.reshape(NODES * seen, NODES * inputs), np.zeros(NODES * inputs)
        for _ in range(_MOST_ITERATIONS):
            places = base + (K @ n).reshape(NODES, seen)
            parts = [self._remainders(place) for place in places]
            R, sizes = np.array([x[0] for x in parts]), np.max([x[2] for x in parts], axis=0)
            by = np.zeros((NODES * inputs, NODES * seen))
            for i, (_, slope, _) in enumerate(parts):
                by[i * inputs : (i + 1) * inputs, i * seen : (i + 1) * seen] = slope
            change = np.linalg.solve(np.eye(n.size) - by @ K, R.ravel() - n)
            n = n + change
            if (np.abs(change).reshape(NODES, inputs) <= _CONVERGED * sizes).all():
                return _FROM_NODES @ n.reshape(NODES, inputs), True
        return _FROM_NODES @ n.reshape(NODES, inputs), False

    def _changes(self, terms: Array) -> Array:
        """Changes of penetration, rate and target at the nodes (7, 2 + k), by terms of a change of the
        state.
        """
        rows, at = self.rows, self._slopes[2]
        places = self.at_nodes(terms)
        rate = places @ (rows.speeds[-1] - at @ rows.target)
        return np.column_stack([places @ rows.penetration, rate, places @ rows.target.T])

    def _seen(self, terms: Array) -> Array:
        """Likewise, themselves."""
        found = self._changes(terms)
        rows, at = self.rows, self._slopes[2]
        found[:, 1] += self._rate - self.y @ (rows.speeds[-1] - at @ rows.target)
        return found

    def _remainders(self, place: Array) -> tuple[Array, Array, Array]:
        """(R (inputs), its slopes by what is seen, the sizes of what it is a remainder of)."""
        rows, law, (Z, G, at) = self.rows, self.law, self._slopes
        x, rate, z = place[0], place[1], place[2:]
        start = rows.target @ self.y
        force, k, d = law.force(x, rate, self._compressing)
        more = force - self._force
        linear = self._k * (x - float(rows.penetration @ self.y)) + self._d * (rate - self._rate)
        by = np.zeros((2 + z.size, place.size))
        by[0, :2] = k - self._k, d - self._d
        if not law.contact.target_bends:
            return np.array([more - linear, *(0.0 * z), 0.0]), by, np.array([abs(force), *(0 * z + 1), 1.0])
        rates, (Z_1, G_1, at_1) = law.rates(z, force), law.slopes(z, force)
        by[1:-1, 0], by[1:-1, 1], by[1:-1, 2:] = (G_1 - G) * k, (G_1 - G) * d, Z_1 - Z
        by[-1, 2:] = at_1 - at
        R = [more - linear, *(rates - self._rates - Z @ (z - start) - G * more)]
        R.append(law.velocity(z) - law.velocity(start) - at @ (z - start))
        return np.array(R), by, np.array([abs(force), *np.abs(rates), abs(rate)])
