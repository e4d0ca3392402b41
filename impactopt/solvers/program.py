"""Interface of nonlinear programs and of solver results; violations, optimality, and evaluated points.

It is the border between the symbolic and the numeric half of the package: the solvers use NumPy and SciPy
only.
"""

from __future__ import annotations

import enum
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from impactopt.errors import InputError, check_array

Vector = npt.NDArray[np.float64]
Matrix = Any  # scipy.sparse.csc_array; SciPy ships no types


PATTERN_CHANGED = "a derivative of the program changed its sparsity pattern; keep structural zeros explicit"


class Determined(NamedTuple):
    """Variables, by number, that equalities determine; those of lower rank are eliminated first.

    A program may declare a sequence ``determined`` of them. Each takes the first equalities that contain its
    variables and are not taken by one before it.
    """

    rank: tuple[int, ...]
    variables: npt.NDArray[np.intp]


@runtime_checkable
class NonlinearProgram(Protocol):
    """Minimize f(x) subject to g_lower <= g(x) <= g_upper and x_lower <= x <= x_upper.

    Equal bounds make an equality; +-inf means no bound. Shapes: x (n,), g (m,). The Lagrangian is
    L = f + multipliers . g + bound_multipliers . x, so that a multiplier is positive if an upper bound is
    active and negative if a lower one is.

    Attributes
    ----------
    n, m : number of variables and of constraints.
    x_lower, x_upper : bounds of the variables (n,).
    g_lower, g_upper : bounds of the constraints (m,).
    """

    n: int
    m: int
    x_lower: Vector
    x_upper: Vector
    g_lower: Vector
    g_upper: Vector

    def objective(self, x: Vector) -> float:
        """f(x)."""
        ...

    def gradient(self, x: Vector) -> Vector:
        """df/dx, (n,)."""
        ...

    def constraints(self, x: Vector) -> Vector:
        """g(x), (m,)."""
        ...

    def jacobian(self, x: Vector) -> Matrix:
        """dg/dx as scipy.sparse.csc_array (m, n), without duplicates, with the same pattern at every x."""
        ...

    def hessian(self, x: Vector, sigma: float, multipliers: Vector) -> Matrix:
        """Hessian of sigma f + multipliers . g, full symmetric csc_array (n, n), always the same pattern."""
        ...

    def constraint_name(self, i: int) -> str:
        """Readable name of constraint i: "torque limit, swing, node 7, arm_right_4_joint"."""
        ...

    def variable_name(self, j: int) -> str:
        """Readable name of variable j."""
        ...


@runtime_checkable
class DescribedProgram(NonlinearProgram, Protocol):
    """Program that describes violations of its constraints in words."""

    def constraint_group(self, i: int) -> tuple[str, str]:
        """Term and node of constraint i; a message has only the worst constraint of each such group."""
        ...

    def describe_violation(self, i: int, x: Vector, amount: float) -> tuple[str, str]:
        """Constraint i at x ("torque limit, swing at 0.61 s, elbow") and amount ("12 % over its limit")."""
        ...


@dataclass(frozen=True)
class Violation:
    """Violated constraint or bound: its name, the violation in words, and the scaled amount."""

    what: str
    by: str
    amount: float

    def __str__(self) -> str:
        return f"{self.what}: {self.by}"


MINOR = 0.01  # fraction of the worst violation; messages leave out less than that


class Status(enum.Enum):
    """Status with which a solver ended."""

    SOLVED = "solved"
    ACCEPTABLE = "acceptable"
    ITERATION_LIMIT = "iteration_limit"
    TIME_LIMIT = "time_limit"
    INFEASIBLE = "infeasible"
    INTERRUPTED = "interrupted"
    FAILED = "failed"

    @property
    def message(self) -> str:
        """The status as a sentence."""
        return _MESSAGES[self]

    @property
    def usable(self) -> bool:
        """True if the iterate meets the solver's tolerances, or nearly so (SOLVED, ACCEPTABLE)."""
        return self in (Status.SOLVED, Status.ACCEPTABLE)


_MESSAGES = {
    Status.SOLVED: "Solved: a local optimum within the tolerances.",
    Status.ACCEPTABLE: "Solved to an acceptable level: near a local optimum, not within the tolerances.",
    Status.ITERATION_LIMIT: "Stopped at the iteration limit; the best iterate so far is returned.",
    Status.TIME_LIMIT: "Stopped at the time limit; the best iterate so far is returned.",
    Status.INFEASIBLE: "Infeasible: no point near by meets all constraints; the least violation is returned.",
    Status.INTERRUPTED: "Interrupted; the best iterate so far is returned.",
    Status.FAILED: "The solver gave up; the best iterate so far is returned.",
}


@dataclass(frozen=True, kw_only=True)
class IterationRecord:
    """One iteration of a solver, as given to progress callbacks and kept in the history.

    Attributes
    ----------
    iteration : number, from 0 (the initial guess).
    objective : f(x).
    max_violation : largest violation of a constraint or a bound, in the units of the constraints.
    kkt : scaled stationarity (see `stationarity`); nan if the solver does not have it.
    step : largest absolute entry of the step to this iterate.
    seconds : time since the solve began [s].
    note : remark of the solver: barrier, step length, QP iterations, second-order correction.
    """

    iteration: int
    objective: float
    max_violation: float
    kkt: float
    step: float
    seconds: float
    note: str = ""


Callback = Callable[[IterationRecord], Any]
"""Called once an iteration; True or KeyboardInterrupt from it stops the solver with its best iterate."""


@dataclass(frozen=True, kw_only=True)
class SolverResult:
    """Last iterate of a solver, or the best one if it did not converge.

    Attributes
    ----------
    x : variables (n,).
    multipliers : of the constraints (m,), positive if an upper bound is active.
    bound_multipliers : of the variables' bounds (n,), likewise.
    objective : f(x).
    status : how it ended.
    iterations : number of iterations.
    seconds : wall time.  seconds_functions : of that in the program's functions.  seconds_qp : of that in QPs
        or Newton systems.
    max_violation : largest violation of a constraint or a bound, in the units of the constraints.
    kkt : scaled stationarity (see `stationarity`).
    message : a sentence, with the names of violated constraints if there are any.
    history : one record an iteration.
    """

    x: Vector = field(repr=False)
    multipliers: Vector = field(repr=False)
    bound_multipliers: Vector = field(repr=False)
    objective: float
    status: Status
    iterations: int
    seconds: float
    seconds_functions: float
    seconds_qp: float
    max_violation: float
    kkt: float
    message: str
    history: tuple[IterationRecord, ...] = field(default=(), repr=False)


def check_program(program: NonlinearProgram, x0: npt.ArrayLike) -> Vector:
    """Check bounds and initial guess before a solve; returns the initial guess as float64 (n,).

    Raises
    ------
    InputError : wrong shapes, NaN, crossing bounds; the message names the constraint or variable.
    """
    n, m = program.n, program.m
    sides = (("x", n, program.variable_name), ("g", m, program.constraint_name))
    for kind, size, name in sides:
        lower = check_array(f"{kind}_lower", getattr(program, f"{kind}_lower"), (size,), finite=False)
        upper = check_array(f"{kind}_upper", getattr(program, f"{kind}_upper"), (size,), finite=False)
        # A lower bound of inf, or an upper one of -inf, leaves no value either.
        bad = np.flatnonzero((lower > upper) | (lower == np.inf) | (upper == -np.inf))
        if bad.size:
            i = int(bad[0])
            raise InputError(
                f"the bounds of '{name(i)}' ({kind}[{i}]) leave no value: "
                f"lower {lower[i]:g}, upper {upper[i]:g}; the lower bound must not exceed the upper"
            )
    return check_array("x0", x0, (n,))


def constraint_violations(program: NonlinearProgram, g: Vector) -> Vector:
    """Violation of each constraint's bounds, (m,), >= 0; nan where g is nan."""
    return np.maximum(np.maximum(program.g_lower - g, g - program.g_upper), 0.0)


def bound_violations(program: NonlinearProgram, x: Vector) -> Vector:
    """Violation of each variable's bounds, (n,), >= 0."""
    return np.maximum(np.maximum(program.x_lower - x, x - program.x_upper), 0.0)


def max_violation(program: NonlinearProgram, x: Vector, g: Vector) -> float:
    """Largest violation of a constraint or a bound at x with g = g(x); inf if any is nan."""
    constraints, bounds = constraint_violations(program, g), bound_violations(program, x)
    worst = max(float(np.max(constraints, initial=0.0)), float(np.max(bounds, initial=0.0)))
    finite = not (np.isnan(constraints).any() or np.isnan(bounds).any())
    return worst if finite else np.inf


def stationarity(gradient: Vector, jacobian: Matrix, multipliers: Vector, bound_multipliers: Vector) -> float:
    """Scaled stationarity |grad f + J' y + z|_inf / s, s = max(100, mean |(y, z)|) / 100.

    The scale is IPOPT's (Waechter and Biegler 2006, eq. 6): large multipliers would else make the tolerance
    unreachable.
    """
    residual = gradient + jacobian.T @ multipliers + bound_multipliers
    return scaled_residual(residual, multipliers, bound_multipliers)


def scaled_residual(residual: Vector, multipliers: Vector, bound_multipliers: Vector) -> float:
    """`stationarity` for a known residual grad f + J' y + z (n,)."""
    total = multipliers.size + bound_multipliers.size
    mean = (np.abs(multipliers).sum() + np.abs(bound_multipliers).sum()) / max(total, 1)
    return float(np.max(np.abs(residual), initial=0.0) / (max(100.0, mean) / 100.0))


def complementarity(
    program: NonlinearProgram, x: Vector, g: Vector, multipliers: Vector, bound_multipliers: Vector
) -> float:
    """Largest |multiplier| x distance to its bound; |multiplier| if that bound does not exist."""
    value = np.concatenate([g, x])
    lower = np.concatenate([program.g_lower, program.x_lower])
    upper = np.concatenate([program.g_upper, program.x_upper])
    y = np.concatenate([multipliers, bound_multipliers])
    # The sign of a multiplier tells which bound it belongs to; the distance counts
    # on both sides of that bound.
    gap = np.where(y > 0, np.abs(upper - value), np.abs(value - lower))
    gap[np.isinf(gap)] = 1.0  # a multiplier of the wrong sign counts by its size: one of 1e-8 is rounding
    return float(np.max(np.abs(y[y != 0]) * gap[y != 0], initial=0.0))


_STATIONARY = 1e-3  # slope of a stationary violation, over what it would be without opposed constraints


def is_stationary_violation(program: NonlinearProgram, x: Vector, g: Vector, jacobian: Matrix) -> bool:
    """True if no small step reduces the violation 1/2 |v|^2 of the constraints: a locally infeasible point.

    The criterion: the gradient J' v, projected on the variables' bounds, is small relative to |J||v|.
    """
    v = np.maximum(g - program.g_upper, 0.0) - np.maximum(program.g_lower - g, 0.0)
    # v_i is positive above the upper bound and negative below the lower one, so J' v is
    # the gradient of |v|^2 / 2.
    slope = jacobian.T @ v
    # Interior-point iterates stop short of their bounds, so a variable near its bound counts as at it.
    # Descent is along -slope: at a bound, a component that leads outside does not count.
    margin = 1e-6 * (1.0 + np.abs(x))
    at_bound = ((x >= program.x_upper - margin) & (slope < 0)) | (
        (x <= program.x_lower + margin) & (slope > 0)
    )
    slope = np.where(at_bound, 0.0, slope)
    # With the rows J_i, |J' v| <= sum |J_i| |v_i|: what the slope would be if no two constraints opposed each
    # other. Without a violation the point counts as stationary (0 <= 1e-300).
    return bool(np.linalg.norm(slope) <= _STATIONARY * max(float(row_norms(jacobian) @ np.abs(v)), 1e-300))


def row_norms(matrix: Any) -> Vector:
    """Euclidean norms (m,) of the rows of a matrix (m, n), sparse or dense."""
    squares = matrix.multiply(matrix) if sp.issparse(matrix) else matrix**2
    return np.sqrt(np.asarray(squares.sum(axis=1)).ravel())


def worst_violations(
    program: NonlinearProgram,
    x: Vector,
    g: Vector,
    *,
    tolerance: float,
    count: int = 5,
    once_a_term: bool = False,
) -> list[Violation]:
    """Violations beyond the tolerance, largest first, ``count`` at most.

    Of a term's constraints at a node only the worst is listed; with ``once_a_term``, of all its constraints.
    """
    violations = np.concatenate([constraint_violations(program, g), bound_violations(program, x)])
    # A constraint that cannot be evaluated comes first; argsort would put nan last.
    violations = np.where(np.isnan(violations), np.inf, violations)
    m, out, seen = program.m, list[Violation](), set[tuple[str, str]]()
    described = program if isinstance(program, DescribedProgram) else None
    for i in np.argsort(-violations, kind="stable").tolist():
        amount = float(violations[i])
        if not amount > tolerance or len(out) == count:
            break
        what, by = f"bound of {program.variable_name(i - m)}" if i >= m else "", f"by {amount:.3g}"
        if i < m and described is not None:
            term, place = described.constraint_group(i)
            if (group := (term, "" if once_a_term else place)) in seen:
                continue
            seen.add(group)
            what, by = described.describe_violation(i, x, amount)
        out.append(Violation(what or program.constraint_name(i), by, amount))
    return out


_HEADINGS = ("Constraints not met", "Constraints that cannot be met")  # the second of an infeasible program


def explain(program: NonlinearProgram, status: Status, x: Vector, g: Vector, *, tolerance: float) -> str:
    """Message of a status: a sentence, then each term's worst violation in words."""
    worst = worst_violations(program, x, g, tolerance=tolerance, once_a_term=True)
    if not worst:
        return status.message
    # constraints are of order one, so a much smaller violation is only a consequence of the others
    worst = [violation for violation in worst if violation.amount >= MINOR * worst[0].amount]
    listed = "; ".join(str(violation) for violation in worst)
    heading = _HEADINGS[status is Status.INFEASIBLE]
    # ~(v <= tolerance) counts nan, too.
    more = int(
        np.sum(~(constraint_violations(program, g) <= tolerance))
        + np.sum(~(bound_violations(program, x) <= tolerance))
    )
    tail = f"; {more} constraints in all" if more > len(worst) else ""
    return f"{status.message} {heading}: {listed}{tail}."


def without_violations(message: str) -> str:
    """A result's message without the violations that `explain` lists."""
    for heading in _HEADINGS:
        message = message.partition(f" {heading}: ")[0]
    return message


class BestIterate:
    """Best point of a solve: least violation, then least objective."""

    def __init__(self, program: NonlinearProgram, tolerance: float):
        self._program, self._tolerance = program, tolerance
        self.x: Vector | None = None
        self.objective = np.inf
        self.violation = np.inf

    def consider(self, x: Vector, objective: float, g: Vector) -> bool:
        """Keep (x, f, g) if it is better than the best so far and finite; True if so."""
        if not (np.isfinite(objective) and np.isfinite(g).all()):
            return False
        violation = max_violation(self._program, x, g)
        # Among points that meet the tolerance the objective alone decides.
        rank = (max(violation, self._tolerance), objective)
        if self.x is not None and rank >= (max(self.violation, self._tolerance), self.objective):
            return False
        self.x, self.objective, self.violation = x.copy(), objective, violation
        return True


@dataclass(frozen=True, kw_only=True)
class Point:
    """f and g at x, and their derivatives, which are evaluated when first used."""

    # A search refuses many points for their values alone; derivatives take several times as long.
    x: Vector
    objective: float
    g: Vector
    program: TimedProgram

    @cached_property
    def finite(self) -> bool:
        """True if f and g are finite."""
        return bool(np.isfinite(self.objective) and np.isfinite(self.g).all())

    @cached_property
    def differentiable(self) -> bool:
        """True if f, g and their derivatives are finite."""
        if not self.finite:
            return False
        # Finite values do not imply finite derivatives (sqrt at 0), and some programs raise in place of inf.
        try:
            return bool(np.isfinite(self.gradient).all() and np.isfinite(self.jacobian.data).all())
        except (ArithmeticError, np.linalg.LinAlgError):
            return False

    @cached_property
    def gradient(self) -> Vector:
        """df/dx (n,)."""
        return np.asarray(self.program.gradient(self.x), dtype=np.float64)

    @cached_property
    def jacobian(self) -> Matrix:
        """dg/dx, csc_array (m, n)."""
        # A program may return any sparse format; the solvers read data, indices and indptr by columns.
        found = self.program.jacobian(self.x)
        return found if isinstance(found, sp.csc_array) else sp.csc_array(found)

    @cached_property
    def jacobian_csr(self) -> Matrix:
        """dg/dx as csr_array (m, n)."""
        return self.jacobian.tocsr()

    @cached_property
    def row_norms(self) -> Vector:
        """Euclidean norms of the rows of the Jacobian (m,); 1 for zero rows."""
        norms = row_norms(self.jacobian)
        return np.where(norms > 1e-12, norms, 1.0)

    @cached_property
    def violation(self) -> float:
        """Weighted sum of the constraints' violations; inf if not finite."""
        return (
            float(self.program.weights @ constraint_violations(self.program, self.g))
            if self.finite
            else np.inf
        )

    @cached_property
    def max_violation(self) -> float:
        """Largest violation of a constraint or a bound."""
        return max_violation(self.program, self.x, self.g)

    def kkt(self, y: Vector, z: Vector) -> float:
        """Scaled `stationarity` with multipliers y (m,) and z (n,); nan if derivatives are not finite."""
        return stationarity(self.gradient, self.jacobian, y, z) if self.differentiable else np.nan


class TimedProgram:
    """A program whose function evaluations are timed, with weights of its constraints.

    Attributes
    ----------
    seconds : spent in the program's functions.
    weights : of the constraints in the merit function (m,).
    """

    def __init__(self, program: NonlinearProgram):
        self.seconds = 0.0
        self.n, self.m = program.n, program.m
        self.x_lower, self.x_upper = np.asarray(program.x_lower, float), np.asarray(program.x_upper, float)
        self.g_lower, self.g_upper = np.asarray(program.g_lower, float), np.asarray(program.g_upper, float)
        self.weights = np.ones(program.m)
        self.constraint_name, self.variable_name = program.constraint_name, program.variable_name
        for name in ("objective", "gradient", "constraints", "jacobian", "hessian"):
            setattr(self, name, self._timed(getattr(program, name)))

    objective: Callable[[Vector], float]
    gradient: Callable[[Vector], Vector]
    constraints: Callable[[Vector], Vector]
    jacobian: Callable[[Vector], Matrix]
    hessian: Callable[[Vector, float, Vector], Matrix]

    def point(self, x: Vector) -> Point:
        """Evaluate f and g; nan if they cannot be computed (ArithmeticError, LinAlgError)."""
        try:
            objective, g = float(self.objective(x)), np.asarray(self.constraints(x), dtype=np.float64)
        except (ArithmeticError, np.linalg.LinAlgError):
            objective, g = np.nan, np.full(self.m, np.nan)
        return Point(x=x, objective=objective, g=g, program=self)

    def unknown(self, x: Vector) -> Point:
        """Point without values: nothing is evaluated."""
        # Not finite, so that neither a search nor `BestIterate` takes it for an iterate.
        return Point(x=x, objective=np.nan, g=np.full(self.m, np.nan), program=self)

    def weigh(self, point: Point) -> None:
        """Set the weights to 1 over the gradients' norms, 1 at most: one price suits all constraints."""
        # Over its gradient's norm a violation is the distance to the linearized constraint.
        self.weights = 1.0 / np.clip(point.row_norms, 1.0, 1e6)

    def _timed(self, function: Callable[..., Any]) -> Callable[..., Any]:
        # In `finally`, so that evaluations that raise count too.
        def timed(*arguments: Any) -> Any:
            begin = time.perf_counter()
            try:
                return function(*arguments)
            finally:
                self.seconds += time.perf_counter() - begin

        return timed
