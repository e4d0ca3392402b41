"""The QP solvers by name; each is imported when it is asked for."""

from __future__ import annotations

from collections.abc import Callable

from impactopt.errors import InputError, did_you_mean, missing_package
from impactopt.solvers.sqp.qp import QPSolver


def _active_set(_tolerance: float) -> QPSolver:
    from impactopt.solvers.sqp.active_set import ActiveSetSolver

    return ActiveSetSolver()


def _daqp(tolerance: float) -> QPSolver:
    from impactopt.solvers.sqp.daqp_solver import DaqpSolver

    return DaqpSolver(tolerance=tolerance)


def _osqp(tolerance: float) -> QPSolver:
    from impactopt.solvers.sqp.osqp_solver import OsqpSolver

    return OsqpSolver(tolerance=tolerance)


def _piqp(tolerance: float) -> QPSolver:
    from impactopt.solvers.sqp.piqp_solver import PiqpSolver

    return PiqpSolver(tolerance=tolerance)


QP_SOLVERS: dict[str, Callable[[float], QPSolver]] = {
    "active_set": _active_set,
    "daqp": _daqp,
    "osqp": _osqp,
    "piqp": _piqp,
}
"""Name of a QP solver -> what makes one, given the tolerance of its residuals. Add your own here.

Ours, and OSQP, are always there. `impactopt[qp]` brings DAQP (MIT, 4 MB, needs NumPy), the quickest up to
some hundred variables, and PIQP (BSD, 5 MB, NumPy and SciPy), the quickest beyond.
"""


def make_qp_solver(name: str, tolerance: float = 1e-6) -> QPSolver:
    """A new QP solver by its name in `QP_SOLVERS`.

    Raises
    ------
    InputError : no such solver; or its package is not installed.
    """
    if name not in QP_SOLVERS:
        raise InputError(
            f"no QP solver '{name}'{did_you_mean(name, QP_SOLVERS)}; "
            f"there are: {', '.join(sorted(QP_SOLVERS))}"
        )
    try:
        return QP_SOLVERS[name](tolerance)
    except ImportError as error:
        raise missing_package(f"the QP solver {name!r}", name, "qp") from error
