"""`solve`, `optimize_strike` and `drive_nail` of a problem, or of the file that describes it."""

from __future__ import annotations

import functools
import inspect
import logging
import os
import warnings
from collections.abc import Callable
from typing import Any, TypeVar

from impactopt.errors import InputError, NotSolvedWarning
from impactopt.files.problem_file import read_problem_file
from impactopt.planning import nail_driving, strike
from impactopt.planning import solve as planning
from impactopt.planning.solution import Solved
from impactopt.problem.problem import ImpactProblem

__all__ = ["drive_nail", "optimize_strike", "solve"]

R = TypeVar("R")

_log = logging.getLogger("impactopt")  # its lines are seen by who asks for level INFO

_GIVEN = """problem : an :class:`impactopt.ImpactProblem`; or the path of a problem file, or the name of one
    that comes with the package (`impactopt problems`), whose [solver] section then holds where nothing else
    is given.
report : where it is None, its lines go to the logger "impactopt", with level INFO.

"""
_WARNS = """

Warns
-----
NotSolvedWarning : the result is no solution; it is of the best iterate.
"""


def _or_file(run: Callable[..., R]) -> Callable[..., R]:
    @functools.wraps(run)
    def of_either(problem: ImpactProblem | str | os.PathLike[str], *args: Any, **options: Any) -> R:
        if options.get("report") is None:
            options["report"] = _log.info
        if isinstance(problem, ImpactProblem):
            return _told(run(problem, *args, **options))
        if not isinstance(problem, (str, os.PathLike)):
            raise InputError(
                f"problem: a {type(problem).__name__} is none; give an ImpactProblem, the path of a problem "
                "file, or the name of one that comes with the package (`impactopt problems`)"
            )
        read = read_problem_file(problem)
        chosen = read.solver.arguments(options.get("solver"), options.get("time_limit"))
        given = {k: v for k, v in options.items() if v is not None}
        return _told(run(read.build(), *args, **(chosen | given)))

    about, raises, errors = inspect.cleandoc(run.__doc__ or "").partition("Raises\n")
    given = "" if "Parameters\n" in about else _GIVEN
    of_either.__doc__ = f"{about}{given}{raises}{errors}{_WARNS}"
    return of_either


def _told(found: R) -> R:
    """A warning with a result that is no solution: its numbers look like those of one."""
    if isinstance(found, Solved) and not found.status.usable:
        warnings.warn(
            f"not solved, so its numbers are those of no plan: {found.result.message}",
            NotSolvedWarning,
            stacklevel=3,
        )
    return found


solve = _or_file(planning.solve)
optimize_strike = _or_file(strike.optimize_strike)
drive_nail = _or_file(nail_driving.drive_nail)
