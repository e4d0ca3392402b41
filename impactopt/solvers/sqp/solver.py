"""Choice between the two SQP methods, by the QP solver and the program's size."""

from __future__ import annotations

import numpy.typing as npt

from impactopt.solvers.options import SQPOptions
from impactopt.solvers.program import Callback, NonlinearProgram, SolverResult
from impactopt.solvers.run import BarrierState, Watch
from impactopt.solvers.sqp.interior_qp import InteriorQPRun, interior_options
from impactopt.solvers.sqp.reduced import ReducedRun

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
