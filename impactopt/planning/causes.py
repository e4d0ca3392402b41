"""The single bound that keeps a problem from having a plan, and where it would have to be.

From the point of least violation the bounds of one kind after the other give way, by as little as it takes to
meet all others (`impactopt.solvers.relaxed`). What is named is a number of the problem, with a value at which
a motion is known that meets the whole program.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.contact.fields import snake_case
from impactopt.contact.laws import ContactLaw
from impactopt.errors import InputError
from impactopt.planning.bounds import MET, USUAL, Bound, Cause, bounds_of, changed_or_none
from impactopt.planning.budget import Budget
from impactopt.planning.lazy_constraints import with_rows
from impactopt.planning.parameter_changes import changed
from impactopt.planning.refinement import program_for
from impactopt.problem.scenario import LONGEST, SHORTEST, Phase
from impactopt.solvers.ipm import IPMOptions, solve_ipm
from impactopt.solvers.program import NonlinearProgram, SolverResult, max_violation
from impactopt.solvers.relaxed import RelaxedProgram
from impactopt.transcription.initial_guess import carried_over, first_iterate
from impactopt.transcription.transcription import Transcription

__all__ = ["Cause", "Search", "search"]

Array = NDArray[np.float64]
_LOOSE = 4.0  # times longer, or shorter, that durations may become, or usual
_CONTACT = 0.2  # [s] that a phase of contact may become
# at most, of all bounds together, of one, and of a plain start where it has moved: most take a third of it
_ITERATIONS, _SINGLE, _PLAIN = 100, 60, 200
_LEAST = 400  # of the whole search, at least
_TRIED = 5  # bounds that are tried alone
_FACTORS = tuple(10.0 ** (sign * k / 2) for k in (1, 2, 3, 4) for sign in (1, -1))  # of stiffness
_STIFF = 50  # iterations of each: where there is a solution, most are there in half of them
_BARRIER, _PUSH = 1e-2, 1e-3  # of a program that is nearly met
_ROUGH = 1e-4  # its tolerance: three digits are reported
_TRIES = 4  # of a value
_NONE = 1e-4  # what a relaxation comes to that is none


@dataclass(frozen=True, kw_only=True, eq=False)
class Search:
    """Result of a search for the bounds that make a problem infeasible.

    causes : bounds any one of which would do, the one that moves least first.  met : a program of
    the problem with constraints of all lazy terms, and variables (n,) that meet it; None if none are known.
    """

    causes: tuple[Cause, ...] = ()
    met: tuple[Transcription, Array] | None = None


def search(t: Transcription, result: SolverResult, budget: Budget) -> Search:
    """Searches for the cause of a program's infeasibility, in about as many iterations as its solve took.

    result : of the program, where its violation is least.
    """
    if budget.left == 0:
        return Search()
    try:
        return _Relaxing(t, result, budget).found()
    except InputError:  # of a problem with looser durations: nothing is known then
        return Search()


class _Relaxing:
    """A program with looser durations, and the bounds that hold it to those of the problem."""

    def __init__(self, t: Transcription, result: SolverResult, budget: Budget) -> None:
        self.given, self._budget = t.problem, budget
        self._iterations = max(_LEAST, result.iterations)
        # a bound that has moved would else break what has no constraints yet
        p = with_rows(t.problem, [snake_case(type(term).__name__) for term in t.problem.on_demand])
        self.t = program_for(t, p)
        nothing = np.zeros(t.program.m), np.zeros(t.layout.n)
        own = carried_over(self.t, t, result.x, *nothing)[0]
        shortest, longest = p.contact_duration
        loose = changed(
            p,
            swing=_loosened(p.swing),
            follow=_loosened(p.follow),
            contact_duration=(shortest, max(_CONTACT, longest)),
        )
        self.loose = program_for(self.t, loose)
        once = (USUAL, USUAL)
        usual = changed(
            loose, swing=replace(loose.swing, duration=once), follow=replace(loose.follow, duration=once)
        )
        self.starts = own, first_iterate(program_for(self.t, usual))
        self.bounds = bounds_of(self.t)

    def found(self) -> Search:
        common = self._common()
        if common is None:
            return Search(causes=tuple(self._stiffness()))
        x, sizes = common
        if sizes.max(initial=0.0) <= _NONE and self._meets(x):
            return Search(met=(self.t, x))
        order = np.argsort(-sizes, kind="stable").tolist()
        tried = [self.bounds[k] for k in order if sizes[k] > _NONE]
        tried += [bound for bound in self.bounds if bound.is_time and bound not in tried]
        causes: list[Cause] = []
        for bound in tried[:_TRIED]:
            alone = self._solved([bound], x, _SINGLE)
            if alone is not None:
                causes += filter(None, map(self._confirmed, bound.told(alone[0])))
        if not any(cause.problem for cause in causes):
            causes += self._stiffness()
        causes.sort(key=lambda cause: cause.problem is None)
        return Search(causes=tuple(causes))

    def _common(self) -> tuple[Array, Array] | None:
        """A point that meets the program with all bounds relaxed at once, if a start leads to one (see
        `_solved`).
        """
        for start in self.starts:
            found = self._solved(self.bounds, start, _ITERATIONS)
            if found is not None:
                return found
        return None

    def _confirmed(self, cause: Cause) -> Cause | None:
        """A cause whose value makes the problem solvable from a plain start; of a time where the least one
        does not, one nearer to usual ones. None if it does not; one that may not be is as it is.
        """
        for again in range(_TRIES):
            if cause.problem is None or (again and cause.nearer is None):
                break
            one = cause if not again or cause.nearer is None else cause.nearer(again / _TRIES)
            if one.problem is None:
                break
            t = program_for(self.t, one.problem)
            self._iterations += _PLAIN
            if self._run(t.program, first_iterate(t), _PLAIN) is not None:
                return replace(one, nearer=None)
        return replace(cause, nearer=None) if cause.problem is None else None

    def _stiffness(self) -> Iterator[Cause]:
        """A contact as stiff as it would have to be: what no bound says, and is found by trying."""
        p = self.t.problem
        known = p.law.parameters.get("stiffness")
        self._iterations = _STIFF * len(_FACTORS)
        for factor in () if known is None else _FACTORS:
            value = float(f"{known * factor:.2g}")
            law: ContactLaw = replace(p.law, stiffness=value)  # type: ignore[type-var]
            new = changed_or_none(p, law=law)
            if new is None:
                continue
            if self._budget.left == 0:
                return
            t = program_for(self.t.with_apart({}), new)
            if self._run(t.program, first_iterate(t), _STIFF) is not None:
                words = f"stiffness of the contact: {value:.2g} N/m for {known:.2g} N/m"
                kind = "a soft contact" if factor > 1 else "a stiff contact"
                at = changed(self.given, law=law)
                yield Cause(first=kind, text=f"{words} ([contact] stiffness_N_m)", problem=at)
                return

    def _run(self, program: NonlinearProgram, start: Array, most: int, **more: Any) -> SolverResult | None:
        """A solver's result after so many iterations at most; None if it is no solution."""
        most, left = min(most, self._iterations), self._budget.left
        if not most or left == 0:
            return None
        options = IPMOptions(
            max_iterations=most,
            time_limit=left,
            kkt_tolerance=_ROUGH,
            complementarity_tolerance=_ROUGH,
            **more,
        )
        result = solve_ipm(program, start, options=options, callback=lambda _: self._budget.stop.asked)
        self._iterations -= min(result.iterations, self._iterations)
        return result if result.status.usable else None

    def _meets(self, x: Array) -> bool:
        program = self.t.program
        return max_violation(program, x, program.constraints(x)) <= MET

    def _solved(self, bounds: Sequence[Bound], start: Array, most: int) -> tuple[Array, Array] | None:
        """Variables (n,) and how far each of the bounds has moved, at least; None if nothing is found."""
        program, own = self.loose.program, self.t.program
        wide = program.x_lower.copy(), program.x_upper.copy()
        program.x_lower, program.x_upper = own.x_lower, own.x_upper
        try:
            relaxed = RelaxedProgram(program, [bound.relaxation(self.loose) for bound in bounds], start)
        finally:
            program.x_lower, program.x_upper = wide
        durations = np.array([j for bound in bounds if bound.is_time for j in bound.variables], dtype=np.intp)
        relaxed.x_lower[durations] = np.maximum(relaxed.x_lower[durations], wide[0][durations])
        relaxed.x_upper[durations] = np.minimum(relaxed.x_upper[durations], wide[1][durations])
        result = self._run(relaxed, relaxed.start(start, _BARRIER), most, barrier=_BARRIER, push=_PUSH)
        if result is None:
            return None
        return result.x[: program.n], relaxed.sizes(result.x)


def _loosened(phase: Phase) -> Phase:
    shortest, longest = phase.duration
    shortest, longest = min(shortest / _LOOSE, USUAL), max(longest * _LOOSE, USUAL)
    return replace(phase, duration=(max(shortest, SHORTEST), min(longest, LONGEST)))
