"""Registry of the QP solvers by name; each is imported when it is made."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from impactopt.errors import InputError, check_choice
from impactopt.solvers.qp.quadratic_program import QPSolver


def _active_set(_tolerance: float) -> QPSolver:
    from impactopt.solvers.qp.active_set import ActiveSetSolver

    return ActiveSetSolver()


def _osqp(tolerance: float) -> QPSolver:
    from impactopt.solvers.qp.osqp_solver import OsqpSolver

    return OsqpSolver(tolerance=tolerance)


QP_SOLVERS: dict[str, Callable[[float], QPSolver]] = {
    "active_set": _active_set,
    "osqp": _osqp,
}
"""Functions that make a QP solver for a tolerance of its error, by the solver's name. Add your own here."""
GONE = {"daqp": "osqp", "piqp": "osqp"}
"""Replacements of QP solvers that are no longer supported."""


def make_qp_solver(name: str, tolerance: float = 1e-6) -> QPSolver:
    """Make a QP solver by its name in `QP_SOLVERS`.

    Raises
    ------
    InputError : no such solver.
    """
    check_qp_solver(name, QP_SOLVERS)
    return QP_SOLVERS[name](tolerance)


def check_qp_solver(name: str, known: Iterable[str]) -> None:
    """Check that a name is among the known ones.

    Raises
    ------
    InputError : no such solver, or no longer supported.
    """
    known = sorted(known)
    if name in GONE and name not in known:
        raise InputError(f"qp_solver: {name!r} is no longer supported; give {GONE[name]!r}")
    check_choice("qp_solver", name, known)
