"""A solution's program with other parameters, and its KKT system: what bent plans and sensitivities need."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import fields
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np

from impactopt.errors import InputError
from impactopt.planning.clearance_constraints import same_bodies
from impactopt.planning.parameter_changes import changed
from impactopt.planning.reconstruction import program_on
from impactopt.planning.solution import Solution
from impactopt.problem.problem import ImpactProblem
from impactopt.solvers.predictor import ActiveSystem, Offset, Predictor
from impactopt.transcription.transcription import Transcription

__all__ = ["Bent", "bent_of"]

_MORE, _ASIDE = 1.01, 1e-3  # of law and target; [m]
_PROXIMAL = 1e-2  # [N s] beside the objective's curvature, per square of a variable of order one


class Bent:
    """A solution's own program, and its KKT system, factored once."""

    def __init__(self, solution: Solution) -> None:
        self.solution = solution
        self.program = self._built(solution.problem)
        self._moving = self._follows()

    def program_for(
        self,
        problem: ImpactProblem,
        report: Callable[[str], None] | None = None,
        *,
        anew: bool = True,
    ) -> Transcription:
        """The solution's program with the numbers of another problem: the same variables and constraints.

        Where point, contact law and target alone are others it is good until the next one is asked for.
        anew : as of `ContactProgram.move_to`.

        Raises
        ------
        InputError : they are others.
        """
        if self._moving is not None and _alike(problem, self.solution.problem):
            self._moving.move_to(problem, anew=anew)
            return self._moving
        return self._built(problem, report)

    def _follows(self) -> Transcription | None:
        """A program that follows the problem; None if parts of it do not, such as a term of someone's own."""
        problem = self.solution.problem
        try:
            t = self._built(_beside(problem))
        except InputError:
            return None
        t.move_to(problem)
        return t if t.program.same_numbers(self.program.program) else None

    def _built(self, problem: ImpactProblem, report: Callable[[str], None] | None = None) -> Transcription:
        s = self.solution
        t = program_on(problem, s.nodes, s.elements, s.shares, report)
        if s.apart:
            if not same_bodies(problem, s.problem):
                raise InputError("the world has other bodies then: use solve(problem, start=solution)")
            t = t.with_apart(s.apart)
        if (t.program.n, t.program.m) != (len(s.result.x), len(s.result.multipliers)):
            raise InputError("the program has other constraints then: use solve(problem, start=solution)")
        return t

    @cached_property
    def predictor(self) -> Predictor:
        r = self.solution.result
        return Predictor(self.program.program, r.x, r.multipliers, r.bound_multipliers)

    @cached_property
    def system(self) -> ActiveSystem:
        r = self.solution.result
        return ActiveSystem(self.program.program, r.x, r.multipliers, r.bound_multipliers)

    @cached_property
    def steady(self) -> tuple[ActiveSystem, Offset]:
        """The same for steps that are not small, and leave alone what hardly matters; and what the solver has
        left, which is no part of what a change does.
        """
        r = self.solution.result
        common = r.x, r.multipliers, r.bound_multipliers
        system = ActiveSystem(self.program.program, *common, proximal=_PROXIMAL)
        return system, system.offset(self.program.program)


def _alike(problem: ImpactProblem, other: ImpactProblem) -> bool:
    """True if the programs of the two problems differ in bounds, constants and parameters only."""
    changing = {"point", "law", "target", "name"}
    pairs = [
        (getattr(problem, f.name), getattr(other, f.name)) for f in fields(problem) if f.name not in changing
    ]
    same = all(
        one is two or (np.array_equal(one, two) if isinstance(one, np.ndarray) else one == two)
        for one, two in pairs
    )
    kinds = type(problem.law) is type(other.law) and type(problem.target) is type(other.target)
    kinds = kinds and problem.target.speed_before() == other.target.speed_before()
    return same and kinds and (not problem.keeps_apart or same_bodies(problem, other))


def _beside(problem: ImpactProblem) -> ImpactProblem:
    """A problem with a point, law and target that are a little others."""
    law, target = (
        type(part)(**{name: _MORE * value for name, value in part.parameters.items()})
        for part in (problem.law, problem.target)
    )
    with contextlib.suppress(InputError):  # an arm in a plane reaches no point beside it
        return changed(problem, law=law, target=target, point=problem.point + _ASIDE)
    return changed(problem, law=law, target=target, point=problem.point + _ASIDE * problem.normal)


_known: WeakKeyDictionary[Solution, Bent] = WeakKeyDictionary()


def bent_of(solution: Solution) -> Bent:
    if not solution.status.usable:
        raise InputError(
            f"this plan is no solution ({solution.status.value}): it has no sensitivities; solve it first"
        )
    if solution not in _known:
        _known[solution] = Bent(solution)
    return _known[solution]
