"""Sequential quadratic programming in few variables, with QP solvers."""

from impactopt.solvers.options import SQPOptions
from impactopt.solvers.qp.quadratic_program import QPSolution, QPSolver, QPStatus, QuadraticProgram
from impactopt.solvers.qp.registry import QP_SOLVERS, make_qp_solver
from impactopt.solvers.sqp.reduced import solve_sqp

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
