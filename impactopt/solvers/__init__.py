"""Nonlinear programs (NLP) and their solvers: interior-point method (`ipm`), SQP (`sqp`), IPOPT.

Nothing here depends on robots. The modules are shared by the solvers: the protocol of a program, options,
runs. `qp` has the quadratic programs of `sqp`, `elimination` the linear algebra of `ipm` and `sqp`.
"""
