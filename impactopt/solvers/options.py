"""Options of our solvers, and the QP solvers by name."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields

from impactopt.errors import InputError, check_array, check_choice
from impactopt.solvers.qp.quadratic_program import QPSolver

HESSIANS = ("exact", "bfgs")


@dataclass(frozen=True, kw_only=True)
class SolverOptions:
    """Options that our solvers share; the defaults suit variables and constraints of order one.

    Attributes
    ----------
    violation_tolerance : largest violation at a solution.
    kkt_tolerance : largest scaled stationarity and complementarity at a solution.
    acceptable_tolerance : kkt_tolerance of the status ACCEPTABLE, if no step helps.
    max_iterations : most iterations of one program; if given, of all programs of a start together.
    time_limit : [s]; then the best iterate is returned.
    price : initial price of violations, which rises if necessary.
    price_max : largest price of violations.
    second_order_correction : whether to correct refused steps for the constraints' curvature.
    """

    violation_tolerance: float = 1e-6
    kkt_tolerance: float = 1e-6
    acceptable_tolerance: float = 1e-4
    max_iterations: int = 500
    time_limit: float | None = None
    price: float = 100.0
    price_max: float = 1e5
    second_order_correction: bool = True

    def __post_init__(self) -> None:
        """Check types and ranges.

        Raises
        ------
        InputError : a value of another type, or a number out of its range.
        """
        for option in fields(self):
            value, default = getattr(self, option.name), option.default
            # bool first, as True is an int; None stands for "no limit" where it is the default.
            if isinstance(default, (bool, str)) or (value is None and default is None):
                if default is not None and not isinstance(value, type(default)):
                    wanted = "text" if isinstance(default, str) else "true or false"
                    raise InputError(f"{option.name}: {value!r}; give {wanted}")
                continue
            number = float(check_array(option.name, value, ()))
            if isinstance(default, int) and number != int(number):
                raise InputError(f"{option.name}: {value!r}; give a whole number")
            # No iteration is a legal request: the initial guess is evaluated and reported.
            if not (value > 0 or (value == 0 and option.name == "max_iterations")):
                raise InputError(f"{option.name}: {value} is out of range; it must be positive")
        if self.price > self.price_max:
            raise InputError(f"price ({self.price:g}) must not exceed price_max ({self.price_max:g})")


@dataclass(frozen=True, kw_only=True)
class IPMOptions(SolverOptions):
    """Options of the interior-point method, `solve_ipm`; prices are those of its elastic phase.

    Attributes
    ----------
    complementarity_tolerance : largest product of a multiplier and the distance to its bound at a solution.
    barrier : initial barrier parameter for an initial guess without multipliers.
    barrier_warm : the same with multipliers; below 5e-3 it falls at once near a solution.
    push : distance by which the initial guess is moved inside its bounds; half way between two at most.
    push_warm : the same with multipliers, at most, over the barrier.
    """

    # Iterations of seven plans: 457 with these values; 583 and 483 with barriers of 0.1 and 3e-3; 508, 355,
    # 333 and 498 with pushes of 1e-3, 0.03, 0.1 and 0.3. But with a push of 0.1 punch_step takes 340 for 100.
    complementarity_tolerance: float = 1e-6
    barrier: float = 3e-2
    barrier_warm: float = 1e-5
    push: float = 1e-2
    push_warm: float = 1.0


@dataclass(frozen=True, kw_only=True)
class SQPOptions(SolverOptions):
    """Options of the SQP, `solve_sqp`; prices are those of its merit function f + price * sum of violations.

    Attributes
    ----------
    qp_solver : name in `QP_SOLVERS`; "ipm", the interior-point method, which ignores `hessian` and `radius`;
        or "auto": "osqp" for at most 300 free variables, "ipm" for more.
    hessian : "exact" (made convex) or "bfgs" (damped; for some hundred free variables at most).
    radius : largest radius of the trust region |d|_inf <= radius.
    """

    qp_solver: str = "auto"
    hessian: str = "exact"
    radius: float = 1.0

    def __post_init__(self) -> None:
        """Check names, then as `SolverOptions` does."""
        check_qp_solver(self.qp_solver, [*QP_SOLVERS, "auto", "ipm"])
        check_choice("hessian", self.hessian, HESSIANS)
        super().__post_init__()


OPTIONS: Mapping[str, type[SolverOptions]] = {"ipm": IPMOptions, "sqp": SQPOptions}
"""Options of our solvers, by the solver's name."""


def _active_set(_tolerance: float) -> QPSolver:
    from impactopt.solvers.qp.active_set import ActiveSetSolver

    return ActiveSetSolver()


def _osqp(tolerance: float) -> QPSolver:
    from impactopt.solvers.qp.osqp_solver import OsqpSolver

    return OsqpSolver(tolerance=tolerance)


QP_SOLVERS: dict[str, Callable[[float], QPSolver]] = {
    "active_set": _active_set,
    "osqp": _osqp,
}
"""Functions that make a QP solver for a tolerance of its error, by the solver's name. Add your own here."""
GONE = {"daqp": "osqp", "piqp": "osqp"}
"""Replacements of QP solvers that are no longer supported."""


def make_qp_solver(name: str, tolerance: float = 1e-6) -> QPSolver:
    """Make a QP solver by its name in `QP_SOLVERS`.

    Raises
    ------
    InputError : no such solver.
    """
    check_qp_solver(name, QP_SOLVERS)
    return QP_SOLVERS[name](tolerance)


def check_qp_solver(name: str, known: Iterable[str]) -> None:
    """Check that a name is among the known ones.

    Raises
    ------
    InputError : no such solver, or no longer supported.
    """
    known = sorted(known)
    if name in GONE and name not in known:
        raise InputError(f"qp_solver: {name!r} is no longer supported; give {GONE[name]!r}")
    check_choice("qp_solver", name, known)
