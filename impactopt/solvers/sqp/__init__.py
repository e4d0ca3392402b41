"""Our SQP: a nonlinear program by a sequence of quadratic ones; NumPy, SciPy and a QP solver only."""

from impactopt.solvers.sqp.options import SQPOptions
from impactopt.solvers.sqp.qp import QPSolution, QPSolver, QPStatus, QuadraticProgram
from impactopt.solvers.sqp.qp_solvers import QP_SOLVERS, make_qp_solver
from impactopt.solvers.sqp.solver import solve_sqp

__all__ = [
    "QP_SOLVERS",
    "QPSolution",
    "QPSolver",
    "QPStatus",
    "QuadraticProgram",
    "SQPOptions",
    "make_qp_solver",
    "solve_sqp",
]
