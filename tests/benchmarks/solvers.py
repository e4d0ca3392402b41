"""The solvers that `python -m benchmarks solve` compares, each an entry of a table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from impactopt.solvers.ipm import IPMOptions, solve_ipm
from impactopt.solvers.program import NonlinearProgram, SolverResult, Vector
from impactopt.solvers.sqp import QP_SOLVERS, SQPOptions, solve_sqp


@dataclass(frozen=True, kw_only=True)
class Solver:
    """A solver and what solves its QPs ("" where it has none, or one of its own).

    run : solves a program from a start within seconds.
    """

    name: str
    qp: str
    run: Callable[[NonlinearProgram, Vector, float], SolverResult]

    @property
    def label(self) -> str:
        """Name and QP solver: "sqp:osqp"."""
        return f"{self.name}:{self.qp}" if self.qp else self.name


def _sqp(program: NonlinearProgram, x0: Vector, time_limit: float, *, qp: str) -> SolverResult:
    return solve_sqp(program, x0, options=SQPOptions(qp_solver=qp, time_limit=time_limit))


def _ipm(program: NonlinearProgram, x0: Vector, time_limit: float) -> SolverResult:
    return solve_ipm(program, x0, options=IPMOptions(time_limit=time_limit))


def _ipopt(program: NonlinearProgram, x0: Vector, time_limit: float, *, linear: str) -> SolverResult:
    from impactopt.solvers.ipopt import solve_ipopt

    return solve_ipopt(program, x0, options={"linear_solver": linear}, time_limit=time_limit)


def _uno(program: NonlinearProgram, x0: Vector, time_limit: float, *, preset: str) -> SolverResult:
    from benchmarks.uno_peer import solve_uno

    return solve_uno(program, x0, time_limit, preset=preset)


def _pounce(program: NonlinearProgram, x0: Vector, time_limit: float) -> SolverResult:
    from benchmarks.pounce_peer import solve_pounce

    return solve_pounce(program, x0, time_limit)


def _casadi(program: NonlinearProgram, x0: Vector, time_limit: float, *, qp: str) -> SolverResult:
    from benchmarks.casadi_peer import solve_sqpmethod

    return solve_sqpmethod(program, x0, time_limit, qp=qp)


def _scipy(program: NonlinearProgram, x0: Vector, time_limit: float, *, method: str) -> SolverResult:
    from benchmarks import scipy_peer

    solve = {"slsqp": scipy_peer.solve_slsqp, "trust-constr": scipy_peer.solve_trust_constr}[method]
    return solve(program, x0, time_limit)


def _table() -> dict[str, Solver]:
    ours = [
        Solver(name="ipm", qp="", run=_ipm),
        *(Solver(name="sqp", qp=qp, run=partial(_sqp, qp=qp)) for qp in sorted(QP_SOLVERS)),
    ]
    others = [
        Solver(name="ipopt", qp="", run=partial(_ipopt, linear="mumps")),
        Solver(name="ipopt-spral", qp="", run=partial(_ipopt, linear="spral")),
        *(Solver(name=f"uno-{n}", qp="", run=partial(_uno, preset=n)) for n in ("filtersqp", "ipopt")),
        Solver(name="pounce", qp="", run=_pounce),
        *(Solver(name="sqpmethod", qp=qp, run=partial(_casadi, qp=qp)) for qp in ("osqp", "qpoases", "piqp")),
        *(Solver(name=n, qp="", run=partial(_scipy, method=n)) for n in ("slsqp", "trust-constr")),
    ]
    return {solver.label: solver for solver in (*ours, *others)}


SOLVERS = _table()
"""Label -> solver. A new one is an entry: what makes a `SolverResult` of a program, a start, a time limit."""
