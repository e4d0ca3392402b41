"""Primal-dual interior-point method: the default solver."""

from impactopt.solvers.ipm.interior_point import solve_ipm
from impactopt.solvers.options import IPMOptions

__all__ = ["IPMOptions", "solve_ipm"]
