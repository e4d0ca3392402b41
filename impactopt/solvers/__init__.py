"""Nonlinear programs and their solvers: interior-point method (`ipm`), SQP (`sqp`), IPOPT.

They know nothing of robots. The protocol of a program, options, iterates and their history are shared and lie
here; `qp` has the quadratic programs of `sqp`, `elimination` the linear algebra of both.
"""
