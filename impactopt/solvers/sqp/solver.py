"""Entry of our own solvers: the interior-point method, or SQP with a QP solver."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from impactopt.errors import check_array
from impactopt.solvers.ipm.interior_point import InteriorRun
from impactopt.solvers.options import SQPOptions
from impactopt.solvers.program import Callback, NonlinearProgram, SolverResult, Status, check_program
from impactopt.solvers.run import Path, Run, Task, Watch
from impactopt.solvers.sqp.reduced import ReducedRun
from impactopt.solvers.threads import threads


def solve_sqp(
    program: NonlinearProgram,
    x0: npt.ArrayLike,
    *,
    options: SQPOptions | None = None,
    callback: Callback | None = None,
    multipliers: npt.ArrayLike | None = None,
    bound_multipliers: npt.ArrayLike | None = None,
    watch: Watch | None = None,
    path: Path | None = None,
) -> SolverResult:
    """Solve a nonlinear program by the interior-point method, or by SQP if the options name a QP solver.

    Parameters
    ----------
    program : the program; its rows and variables should be of order one.
    x0 : start (n,); moved into the variables' bounds, where every iterate stays.
    options : see `SQPOptions`.
    callback : progress, once an iteration; True or KeyboardInterrupt stops with the best iterate.
    multipliers, bound_multipliers : guess of the multipliers (m,), (n,), from a similar program.
    watch : of the interior-point method; asked at every iterate whether the program lacks constraints there,
        which ends the solve with the status `ACCEPTABLE`, and before every step how far it may go.
    path : where a solve was left that x0 and the multipliers are of: it goes on as that would have.

    Returns
    -------
    The result; infeasible programs, interruption (Ctrl-C) and limits are statuses, not exceptions.

    Raises
    ------
    InputError : wrong shapes, NaN, crossing bounds.
    """
    x0 = check_program(program, x0)
    y = np.zeros(program.m) if multipliers is None else check_array("multipliers", multipliers, (program.m,))
    z = (
        np.zeros(program.n)
        if bound_multipliers is None
        else check_array("bound_multipliers", bound_multipliers, (program.n,))
    )
    x0 = np.clip(x0, program.x_lower, program.x_upper)
    options = options or SQPOptions()
    task = Task(
        program=program,
        options=options,
        callback=callback,
        x=x0,
        y=y,
        z=z,
        watch=watch,
        path=path,
    )
    interior = options.qp_solver == "interior"
    determined = getattr(program, "determined", ())
    run: Run = InteriorRun(task) if interior else ReducedRun(task, determined)
    with threads().limit(limits=1, user_api="blas"):
        try:
            status = run.iterate()
        except KeyboardInterrupt:
            status = Status.INTERRUPTED
    return run.report.result(status, run.program, run.point, run.y, run.z)
