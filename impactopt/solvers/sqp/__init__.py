"""Sequential quadratic programming: reduced QPs by QP solvers, large ones by the interior-point method."""

from impactopt.solvers.options import QP_SOLVERS, SQPOptions, make_qp_solver
from impactopt.solvers.qp.quadratic_program import QPSolution, QPSolver, QPStatus, QuadraticProgram
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
