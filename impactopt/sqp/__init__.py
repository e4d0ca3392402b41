"""Our SQP: a nonlinear program by a sequence of quadratic ones; NumPy, SciPy and a QP solver only."""

from impactopt.sqp.options import SQPOptions
from impactopt.sqp.qp import QP_SOLVERS, QPSolution, QPSolver, QPStatus, QuadraticProgram, make_qp_solver
from impactopt.sqp.solver import solve_sqp

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
