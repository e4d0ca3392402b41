"""SQP whose QPs are solved by the interior-point method, or of few variables (`reduced`).

The QP at an iterate has the exact Hessian of the Lagrangian and the patterns of the program. So the same
Newton system, with the same elimination of variables, solves it in some few to some dozen steps, and its
inertia correction takes the place of a convex Hessian. A QP is solved inexactly: to the barrier parameter,
which falls as the iterates converge; near a solution a QP takes one or two Newton steps.

Barrier parameter, line search and elastic constraints are those of the interior-point method
(`ipm.interior_point`), whose step is the first Newton step of the QP. That step is also tried if the QP's is
refused, and is taken far from the constraints and while they are elastic.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
import numpy.typing as npt

from impactopt.solvers.ipm.barrier_problem import BarrierProblem, Step
from impactopt.solvers.ipm.interior_point import MAX_MULTIPLIER, InteriorRun, LineSearch
from impactopt.solvers.options import IPMOptions, SolverOptions, SQPOptions
from impactopt.solvers.program import Callback, NonlinearProgram, SolverResult, Status, Vector
from impactopt.solvers.run import BarrierState, Watch
from impactopt.solvers.sqp.reduced import ReducedRun

_MAX_VIOLATION = 1.0  # of an iterate whose QP is solved: farther from the constraints Newton steps do better
_MAX_NEWTON_STEPS = 40  # of one QP; its last iterate is used as it is
_MAX_STEP = 1e3  # of a variable; the QP has no bound then
_MAX_GROWTH = 30.0  # of the violation, from the first iterate with a barrier parameter
_QP_ERROR = 1.0  # of a solved QP, times the barrier parameter


def interior_options(options: SQPOptions) -> IPMOptions:
    """Options of the interior-point method with those that all solvers have."""
    shared = {field.name: getattr(options, field.name) for field in fields(SolverOptions)}
    # Corrections of refused steps are for Newton steps: the QP's matrix is factored elsewhere.
    shared |= {"second_order_correction": False, "complementarity_tolerance": options.kkt_tolerance}
    return IPMOptions(**shared)


class InteriorQPRun(InteriorRun):
    """One solve: the loop of the interior-point method, with steps to the solutions of QPs.

    The options are those of `interior_options`.
    """

    def __init__(self, *given: Any, watch: Watch | None, state: BarrierState | None):
        super().__init__(*given, watch=watch, state=state)
        self._search = LineSearch(watch, _MAX_GROWTH)

    def _advance(self, residual: Vector) -> str | Status:
        problem = self._problem
        if problem.elastic is None and problem.point.max_violation <= _MAX_VIOLATION:
            begin = self.report.elapsed()
            step, taken = _solve_qp(problem)
            self.report.seconds_qp += self.report.elapsed() - begin
            accepted = None if step is None else self._search.find(problem, step, residual)
            if accepted is not None:
                return self._move(accepted, f"QP {taken}")
        return super()._advance(residual)


def _solve_qp(problem: BarrierProblem) -> tuple[Step | None, int]:
    """Step to the solution of the QP's barrier problem, None without; and the Newton steps that it took."""
    qp, search, taken = problem.quadratic(), LineSearch(), 0
    if qp is None:
        return None, taken
    while taken < _MAX_NEWTON_STEPS:
        residual = qp.residual(qp.point, qp.s.values)
        qp.update_multipliers()
        if taken and qp.error(qp.mu, residual) <= _QP_ERROR * qp.mu:
            break
        step = qp.step(residual)
        if step is None or np.abs(step.y).max(initial=0.0) > MAX_MULTIPLIER:
            break
        accepted = search.find(qp, step, residual)
        if accepted is None:
            break
        qp.move(accepted.step, accepted.trial, accepted.length)
        taken += 1
        if np.abs(qp.point.x - problem.point.x).max() > _MAX_STEP:
            break
    return problem.step_to(qp) if taken else None, taken


# Free variables up to which "auto" reduces the QPs to these: a reduced QP is dense, as the null space of the
# equalities couples all instants of a motion.
MAX_DENSE = 300


def solve_sqp(
    program: NonlinearProgram,
    x0: npt.ArrayLike,
    *,
    options: SQPOptions | None = None,
    callback: Callback | None = None,
    multipliers: npt.ArrayLike | None = None,
    bound_multipliers: npt.ArrayLike | None = None,
    watch: Watch | None = None,
    state: BarrierState | None = None,
) -> SolverResult:
    """Solve a nonlinear program by SQP.

    Parameters, result and errors are those of :func:`impactopt.solvers.ipm.solve_ipm`.
    options : see `SQPOptions`.  watch, state : only for QPs solved by the interior-point method.
    """
    options = options or SQPOptions()
    given = program, x0
    more = callback, multipliers, bound_multipliers
    if _interior(program, options):
        return InteriorQPRun(*given, interior_options(options), *more, watch=watch, state=state).solve()
    return ReducedRun(*given, options, *more).solve()


def _interior(program: NonlinearProgram, options: SQPOptions) -> bool:
    """True if the QPs are solved by the interior-point method."""
    if options.qp_solver != "auto":
        return options.qp_solver == "ipm"
    eliminated = sum(variables.size for _, variables in getattr(program, "determined", ()))
    return options.hessian == "exact" and program.n - eliminated > MAX_DENSE
