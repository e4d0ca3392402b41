"""Convex quadratic programs and their solvers: OSQP, and a dense active-set method."""
