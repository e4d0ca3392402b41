"""Options of our solver."""

from __future__ import annotations

from dataclasses import dataclass, fields

from impactopt.errors import InputError, check_array, did_you_mean
from impactopt.solvers.qp.registry import QP_SOLVERS, check_qp_solver

HESSIANS = ("exact", "bfgs")


@dataclass(frozen=True, kw_only=True)
class SQPOptions:
    """Options of `solve_sqp`; the defaults suit variables and constraints of order one.

    Attributes
    ----------
    qp_solver : "interior": a primal-dual interior-point method, one Newton step on each quadratic model; or a
        name in `QP_SOLVERS`: an SQP that solves every QP to its end.
    hessian : with QP solvers, "exact" (made convex) or "bfgs" (damped; dense, for some hundred free
        variables at most).
    violation_tolerance : largest violation of a constraint or bound at a solution.
    kkt_tolerance : largest scaled stationarity and complementarity at a solution.
    complementarity_tolerance : of "interior", largest product of a multiplier and the distance to its bound
        at a solution. The objective's error is at most this times the number of active bounds.
    acceptable_tolerance : tolerance in place of kkt_tolerance for the status ACCEPTABLE, if no step helps.
    max_iterations : most iterations; then the best iterate is returned.
    time_limit : [s]; then the best iterate is returned.
    radius : with QP solvers, largest radius of the trust region |d|_inf <= radius.
    price : first price of violations: with QP solvers in the merit function f + price * sum of violations,
        with "interior" in its elastic phase. It rises by itself.
    price_max : largest price of violations; if it is too low, the end may be infeasible.
    second_order_correction : whether a refused step is corrected for the constraints' curvature.
    barrier : of "interior", first barrier parameter of an initial guess without multipliers.
    barrier_warm : the same of a warm start, which has multipliers.
    push : of "interior", how far the initial guess is moved inside its bounds.
    """

    qp_solver: str = "interior"
    hessian: str = "exact"
    violation_tolerance: float = 1e-6
    kkt_tolerance: float = 1e-6
    complementarity_tolerance: float = 1e-6
    acceptable_tolerance: float = 1e-4
    max_iterations: int = 500
    time_limit: float | None = None
    radius: float = 1.0
    price: float = 100.0
    price_max: float = 1e5
    second_order_correction: bool = True
    barrier: float = 3e-2
    barrier_warm: float = 1e-5
    push: float = 1e-2

    def __post_init__(self) -> None:
        """Refuse what cannot be meant.

        Raises
        ------
        InputError : an unknown name, or a number out of its range.
        """
        check_qp_solver(self.qp_solver, ("interior", *QP_SOLVERS))
        if self.hessian not in HESSIANS:
            near = did_you_mean(self.hessian, HESSIANS)
            raise InputError(f"hessian: no '{self.hessian}'{near}; there are: {', '.join(sorted(HESSIANS))}")
        if self.qp_solver == "interior" and self.hessian != "exact":
            raise InputError(
                'hessian: with qp_solver "interior" it is "exact"; for "bfgs" give another qp_solver, '
                'such as "active_set"'
            )
        for option in fields(self):
            value, default = getattr(self, option.name), option.default
            if isinstance(default, (bool, str)) or (value is None and default is None):
                if default is not None and not isinstance(value, type(default)):
                    wanted = "text" if isinstance(default, str) else "true or false"
                    raise InputError(f"{option.name}: {value!r}; give {wanted}")
                continue
            number = float(check_array(option.name, value, ()))
            if isinstance(default, int) and number != int(number):
                raise InputError(f"{option.name}: {value!r}; give a whole number")
            if not (value > 0 or (value == 0 and option.name == "max_iterations")):
                raise InputError(f"{option.name}: {value} is out of range; it must be positive")
        if self.price > self.price_max:
            raise InputError(f"price ({self.price:g}) must not exceed price_max ({self.price_max:g})")
