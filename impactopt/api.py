"""Public planning functions, for a problem or its file, and their result, `Solution`."""

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
from typing import Any, Literal, TypeVar, cast

import numpy as np

from impactopt.errors import InputError, NotSolvedWarning, missing_package, shortened
from impactopt.files.problem_file import read_problem_file
from impactopt.planning import nail_driving, replanning, solution, strike
from impactopt.planning import solve as planning
from impactopt.planning.replanning import Sensitivity, sensitivity_of
from impactopt.problem.problem import ImpactProblem

R = TypeVar("R")
GROUND = ("fx", "fy", "fz", "mx", "my", "mz")  # components of the ground's wrench

_log = logging.getLogger("impactopt")

# parts of the docstrings of the public functions
_GIVEN = """problem : an :class:`impactopt.ImpactProblem`; or the path of a problem file, or the name of one
    that comes with the package (`impactopt problems`), whose [solver] section then has the
    default options.
report : if it is None, its lines go to the logger "impactopt", with level INFO.

"""
_WARNS = """

Warns
-----
NotSolvedWarning : the result is not a solution, but the best iterate.
"""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Solution(solution.Solution):
    """Result of a solved (or stopped) impact problem, with methods for re-planning, pictures and exports.

    Its attributes are those of :class:`impactopt.planning.solution.Solution`.
    """

    @classmethod
    def of(cls, found: solution.Solution) -> Solution:
        """A planner's solution with these methods."""
        return cls(**{f.name: getattr(found, f.name) for f in fields(found)})

    def moved(self, *, polish: bool = True, **changes: Any) -> Solution:
        """Re-planned solution for changed parameters.

        Parameters are ``point`` [m], ``normal``, ``mass`` of the target [kg], ``stiffness`` and
        ``damping`` of the contact (the law's units), and ``margin`` of the centres of pressure [m].

        The solver starts from this plan, on its mesh, and adds clearance constraints for bodies that would
        penetrate. ``polish=False`` solves quadratic programs about this plan instead, which find the changes
        of the active set. These are quick; constraints then hold to a thousandth if the status is
        "acceptable", and with another status the result is not usable. Bounds that this plan was made
        without, on gear loads, slides and clearance, are not checked then: see `loads` and :meth:`clearance`.
        ``refine=True`` also refines the mesh, as `impactopt.solve` does; without it `loads`, margins in
        contact and ``collision.peak_force`` are those at the collocation points, which may be exceeded
        between them by some per cent; `summary` has the peak force of the `contact_replay`.
        ``callback``, ``options`` and ``time_limit`` are those of `impactopt.solve`, but for looser tolerances
        of the optimum, with which the impulse is within 0.1 %; constraints are met as usual.

        Raises
        ------
        InputError : this is not a solution; no change is given, or one that target or law do not have; the
            changed program has other constraints or bodies.
        """
        return Solution.of(replanning.moved_solution(self, polish=polish, **changes))

    def sensitivity(self, parameter: str) -> Sensitivity:
        """Derivatives of impulse and objective by a parameter, and shadow prices of the active constraints.

        parameter : such as ``"target.mass"``, ``"contact.stiffness"``, ``"point.x"`` or
            ``"terms.torque_limit.fraction"``.

        Raises
        ------
        InputError : an unknown parameter, or one at its bound, such as a nail's depth of 0; this is not a
            solution, or its KKT system is singular.
        """
        return sensitivity_of(self, parameter)

    def animate(self, *, simulation: Any | None = None, replay: Any | None = None) -> Any:
        """Animation of the motion in 3D, for a notebook or a file: ``solution.animate().save("punch.html")``.

        simulation, replay : as of :func:`impactopt.animate`.
        """
        from impactopt.report.animation import animate

        return animate(self, simulation=simulation, replay=replay)

    def report(
        self, path: str | PathLike[str], *, simulation: Any | None = None, replay: Any | None = None
    ) -> Path:
        """Writes the page of `impactopt show`; simulation, replay : as of :func:`impactopt.animate`.

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
        """Picture of poses, contact force, ZMP and torque, or another one by name; a matplotlib figure.

        what, ax, simulation, replay : as of :func:`impactopt.plot`, such as ``solution.plot("strobe")``, or
        ``solution.plot("force", ax=ax)``, which draws in your axes and returns them.
        """
        from impactopt.report.pictures import plot

        return plot(self, what, ax=ax, simulation=simulation, replay=replay)

    def save(self, directory: str | PathLike[str]) -> Path:
        """Writes `solution.npz` and `summary.json`, as `impactopt solve --out` does; returns their directory.

        `load_solution` and all commands read them. A failed solution does not replace a good one: it goes
        into the subdirectory `failed`.

        Raises
        ------
        InputError : they cannot be written; a problem that no file can have (`write_problem`), as one with
            classes of your own. Pickle keeps such a solution, for the same version of the package.
        """
        from impactopt.files.output import keep_record, make_directory, record_of
        from impactopt.files.problem_file import write_problem

        text = write_problem(self.problem, folder=directory)
        return keep_record(record_of(self, problem=text), make_directory(directory))[0].parent

    def to_frame(self, *, missed: bool = False) -> Any:
        """Servo's reference as a pandas table, by time [s]: ``solution.to_frame()["q leg_left_4_joint"]``.

        Columns are phase (0 swing, 1 collision, 2 follow-through); position q [rad], velocity v, acceleration
        a and torque [N m] of each joint; and, of a robot on soles, force fx, fy, fz [N] and moment mx, my, mz
        [N m] of the ground about the world's origin. In collision the reference coasts: the table is without
        the impact's forces and what they change, which `collision` has. Times stand twice where it jumps, at
        the beginning and the end of contact.

        missed : the motion for a missed target, with the abort motion.

        Raises
        ------
        InputError : pandas is not installed; with `missed`, the plan has no abort motion.
        """
        try:
            import pandas
        except ImportError as error:
            raise missing_package("a table of a motion", "pandas", "frame") from error
        if missed and self.plan.abort is None:
            raise InputError("the plan has no motion that follows a missed blow; leave `missed` out")
        t, robot = self.missed_trajectory if missed else self.trajectory, self.problem.robot
        angles = np.array([robot.joint_positions(q) for q in t.q])
        columns: dict[str, Any] = {"phase": t.phase}
        joints = {"q": angles, "v": t.v[:, -robot.n :], "a": t.a[:, -robot.n :], "torque": t.torque}
        for what, values in joints.items():
            columns |= {f"{what} {n}": c for n, c in zip(robot.joint_names, values.T, strict=True)}
        if self.problem.stands:  # else nothing is known of the force at a bolted base
            columns |= {f"ground {n}": c for n, c in zip(GROUND, t.ground.T, strict=True)}
        return pandas.DataFrame(columns, index=pandas.Index(t.time, name="time [s]"))

    def export(
        self,
        to: str,
        directory: str | PathLike[str],
        *,
        rate: float | None = None,
        joints: Sequence[str] | None = None,
        gravity: bool = True,
        smooth: Literal["terms"] | tuple[float, float] | None = None,
    ) -> list[Path]:
        """Writes the plan for other programs, ``solution.export("csv", "results/csv")``; returns the files.

        to, directory, rate, joints, gravity, smooth : as of :func:`impactopt.export`.
        """
        from impactopt.files.export import export

        return export(self, to, directory, rate=rate, joints=joints, gravity=gravity, smooth=smooth)


def load_solution(
    result: str | PathLike[str], *, problem_file: str | PathLike[str] | None = None
) -> Solution:
    """The solution that `impactopt solve` saved: to plot, validate, change, export or start from.

    It has no history of the iterations. If the package makes another program of the problem today, that is
    solved again, from the saved motion if it has as many variables.

    result : its directory, or its `solution.npz`.
    problem_file : used instead of the saved text, such as when the problem's URDF has moved; another problem
        is solved in the same way.

    Raises
    ------
    InputError : there is no result, it is damaged, or it is no plan of a motion.

    Warns
    -----
    UserWarning : its own problem is another one today, as after a change of the robot's URDF.
    """
    from impactopt.files.replay import load_planned, resumed

    planned = load_planned(result, problem_file=problem_file)
    again = resumed(planned.record, planned.problem, other=planned.of_other_problem)
    return cast(Solution, _public(again))


def _or_file(run: Callable[..., R]) -> Callable[..., R]:
    """Public form of a planning function, which also takes a problem file, and warns if it is not solved."""

    @functools.wraps(run)
    def of_either(problem: ImpactProblem | str | os.PathLike[str], *args: Any, **options: Any) -> R:
        if options.get("report") is None:
            options["report"] = _log.info
        if isinstance(problem, ImpactProblem):
            return _public(run(problem, *args, **options))
        if not isinstance(problem, (str, os.PathLike)):
            raise InputError(
                f"problem: {shortened(repr(problem))} is none; give an ImpactProblem, the path of a problem "
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
    """Planner's result with the public `Solution`; warns if it is not solved."""
    if isinstance(found, solution.Solved) and not found.status.usable:
        warnings.warn(
            f"not solved; its numbers are not a plan: {found.result.message}",
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
    """Re-planned solution for changed parameters: `Solution.moved`."""
    return Solution.of(replanning.moved_solution(plan, **changes))


solve = _or_file(planning.solve)
optimize_strike = _or_file(strike.optimize_strike)
drive_nail = _or_file(nail_driving.drive_nail)
