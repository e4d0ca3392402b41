"""Public functions that plan, of a problem or of the file that describes it, and the `Solution` they give."""

from __future__ import annotations

import functools
import inspect
import logging
import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from impactopt.errors import InputError, NotSolvedWarning, missing_package
from impactopt.files.problem_file import read_problem_file
from impactopt.planning import nail_driving, replanning, solution, strike
from impactopt.planning import solve as planning
from impactopt.planning.replanning import Sensitivity, sensitivity_of
from impactopt.problem.problem import ImpactProblem

__all__ = ["Solution", "drive_nail", "moved_solution", "optimize_strike", "solve"]

R = TypeVar("R")
GROUND = ("fx", "fy", "fz", "mx", "my", "mz")  # of the ground's wrench

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


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Solution(solution.Solution):
    """A solved (or stopped) impact problem, and what can be made of it.

    Its attributes are those of :class:`impactopt.planning.solution.Solution`.
    """

    @classmethod
    def of(cls, found: solution.Solution) -> Solution:
        """A planner's solution with all that can be made of it."""
        return cls(**{f.name: getattr(found, f.name) for f in fields(found)})

    def moved(self, *, polish: bool = True, **changes: Any) -> Solution:
        """The plan bent for another ``point`` [m], ``normal``, ``mass`` of the target [kg], ``stiffness`` or
        ``damping`` of the contact (the law's units), or ``margin`` of the centres of pressure [m].

        The solver goes on from this plan, with its mesh, and with new constraints where bodies come into each
        other that have none. ``polish=False``: quadratic programs about this plan in its place, which find
        constraints that begin and cease to hold. They are quick and within a thousandth of the constraints
        where status says "acceptable"; other plans of theirs are none. ``refine=True`` refines the mesh too,
        as `impactopt.solve` does. ``callback``, ``options`` and ``time_limit`` are those of
        `impactopt.solve`.

        Raises
        ------
        InputError : this is no solution; nothing is changed, or what target and law do not have; the program
            has other constraints or bodies then.
        """
        return Solution.of(replanning.moved_solution(self, polish=polish, **changes))

    def sensitivity(self, parameter: str) -> Sensitivity:
        """Derivatives of impulse and objective by a parameter of the problem, such as ``"target.mass"``,
        ``"contact.stiffness"``, ``"point.x"`` or ``"terms.torque_limit.fraction"``, and the active
        constraints with their shadow prices.

        Raises
        ------
        InputError : there is no such number; this is no solution, or its KKT system is singular.
        """
        return sensitivity_of(self, parameter)

    def animate(self, *, simulation: Any | None = None, replay: Any | None = None) -> Any:
        """The motion in 3D, in a notebook or as a file: ``solution.animate().save("punch.html")``.

        simulation, replay : as of :func:`impactopt.animate`.
        """
        from impactopt.report.animation import animate

        return animate(self, simulation=simulation, replay=replay)

    def report(
        self, path: str | PathLike[str], *, simulation: Any | None = None, replay: Any | None = None
    ) -> Path:
        """Write the page of `impactopt show`; simulation, replay : as of :func:`impactopt.animate`.

        Raises
        ------
        InputError : it cannot be written, or its name does not end in .html.
        """
        from impactopt.report.report import report_page

        return report_page(self, simulation=simulation, replay=replay).save(path)

    def plot(
        self,
        what: str = "overview",
        *,
        ax: Any | None = None,
        simulation: Any | None = None,
        replay: Any | None = None,
    ) -> Any:
        """Poses, contact force, ZMP and torque as one picture, or another one by name; a matplotlib figure.

        what, ax, simulation, replay : as of :func:`impactopt.plot`, such as ``solution.plot("strobe")``, or
        ``solution.plot("force", ax=ax)``, which draws in your axes and returns them.
        """
        from impactopt.report.pictures import plot

        return plot(self, what, ax=ax, simulation=simulation, replay=replay)

    def to_frame(self, *, missed: bool = False) -> Any:
        """The planned motion as a pandas table, by time [s]: ``solution.to_frame()["q leg_left_4_joint"]``.

        Columns are phase (0 swing, 1 collision, 2 follow-through); of every joint its position q [rad],
        velocity v, acceleration a and torque [N m]; and of the ground its force fx, fy, fz [N] and moment
        mx, my, mz [N m] about the world's origin.
        missed : the motion that follows a blow that has hit nothing.

        Raises
        ------
        InputError : pandas is not installed; of a missed blow, the plan has no such motion.
        """
        try:
            import pandas
        except ImportError as error:
            raise missing_package("a table of a motion", "pandas", "frame") from error
        if missed and self.plan.abort is None:
            raise InputError("the plan has no motion that follows a missed blow; leave `missed` out")
        way, robot = self.missed_trajectory if missed else self.trajectory, self.problem.robot
        angles = np.array([robot.joint_positions(q) for q in way.q])
        columns: dict[str, Any] = {"phase": way.phase}
        joints = {"q": angles, "v": way.v[:, -robot.n :], "a": way.a[:, -robot.n :], "torque": way.torque}
        for what, values in joints.items():
            columns |= {f"{what} {n}": c for n, c in zip(robot.joint_names, values.T, strict=True)}
        columns |= {f"ground {n}": c for n, c in zip(GROUND, way.ground.T, strict=True)}
        return pandas.DataFrame(columns, index=pandas.Index(way.time, name="time [s]"))

    def export(
        self,
        to: str,
        directory: str | PathLike[str],
        *,
        rate: float | None = None,
        joints: Sequence[str] | None = None,
        gravity: bool = True,
        smooth: tuple[float, float] | None = None,
    ) -> list[Path]:
        """Write the plan for other programs: ``solution.export("csv", "results/csv")``; the files.

        to, directory, rate, joints, gravity, smooth : as of :func:`impactopt.export`.
        """
        from impactopt.files.export import export

        return export(self, to, directory, rate=rate, joints=joints, gravity=gravity, smooth=smooth)


def _or_file(run: Callable[..., R]) -> Callable[..., R]:
    @functools.wraps(run)
    def of_either(problem: ImpactProblem | str | os.PathLike[str], *args: Any, **options: Any) -> R:
        if options.get("report") is None:
            options["report"] = _log.info
        if isinstance(problem, ImpactProblem):
            return _public(run(problem, *args, **options))
        if not isinstance(problem, (str, os.PathLike)):
            raise InputError(
                f"problem: a {type(problem).__name__} is none; give an ImpactProblem, the path of a problem "
                "file, or the name of one that comes with the package (`impactopt problems`)"
            )
        read = read_problem_file(problem)
        chosen = read.solver.arguments(options.get("solver"), options.get("time_limit"))
        given = {k: v for k, v in options.items() if v is not None}
        return _public(run(read.build(), *args, **(chosen | given)))

    about, raises, errors = inspect.cleandoc(run.__doc__ or "").partition("Raises\n")
    given = "" if "Parameters\n" in about else _GIVEN
    of_either.__doc__ = f"{about}{given}{raises}{errors}{_WARNS}"
    return of_either


def _public(found: R) -> R:
    """Planner's result as users get it; a warning with a result that is no solution: its numbers look
    like those of one.
    """
    if isinstance(found, solution.Solved) and not found.status.usable:
        warnings.warn(
            f"not solved, so its numbers are those of no plan: {found.result.message}",
            NotSolvedWarning,
            stacklevel=3,
        )
    made: Any = found
    if isinstance(found, nail_driving.Series):
        blows = [replace(blow, solution=Solution.of(blow.solution)) for blow in found.blows]
        made = replace(found, blows=tuple(blows))
    elif isinstance(found, solution.Solution):
        made = Solution.of(found)
    return made


def moved_solution(plan: solution.Solution, **changes: Any) -> Solution:
    """The plan for a problem with other parameters: `Solution.moved`."""
    return Solution.of(replanning.moved_solution(plan, **changes))


solve = _or_file(planning.solve)
optimize_strike = _or_file(strike.optimize_strike)
drive_nail = _or_file(nail_driving.drive_nail)
