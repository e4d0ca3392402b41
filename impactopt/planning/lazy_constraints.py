"""Terms that hold by default and get constraints once a plan without them breaks them: gear loads, how
far a blow slides.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from typing import Generic

import numpy as np

from impactopt.contact.fields import snake_case
from impactopt.errors import InputError
from impactopt.planning.cautions import gears_beyond, slides_beyond
from impactopt.planning.parameter_changes import changed
from impactopt.planning.refinement import Additions, Guess, Outcome, Program, program_for, start_of
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import ON_DEMAND_TERMS, GearLoad, Slide, Term
from impactopt.robots.actuator_loads import DriveLoads
from impactopt.robots.robot import Robot
from impactopt.transcription.plan import Plan, PlannedCollision
from impactopt.transcription.planned_loads import plan_loads, strike_loads
from impactopt.transcription.planned_strike import PlannedStrike

__all__ = ["LazyTerms", "rows_on_demand", "with_rows"]

_BARRIER = 1e-2  # a plan within such limits is another one: at a low barrier the way there is a crawl
_KINDS: dict[str, type[Term]] = {snake_case(type(term).__name__): type(term) for term in ON_DEMAND_TERMS}


def rows_on_demand(problem: ImpactProblem) -> tuple[str, ...]:
    """Names, as in files, of the lazy terms whose constraints a problem's programs have from the start."""
    own = {type(term) for term in problem.active_terms}
    return tuple(name for name, kind in _KINDS.items() if kind in own)


def with_rows(problem: ImpactProblem, names: Iterable[str]) -> ImpactProblem:
    """The same with the constraints of these lazy terms from the start; itself if it has them, or has
    switched them off.
    """
    kinds = [_KINDS[name] for name in names if name in _KINDS and problem.extra(_KINDS[name]) is None]
    if not kinds:
        return problem
    return changed(problem, terms=(*problem.terms, *(problem.term(kind) for kind in kinds)))


class LazyTerms(Generic[Program]):
    """Oracle for terms that hold in every problem and get constraints once a solution breaks them.

    report : called with a line of text.  finer : whether gears are checked at more instants of the contact
    than the program's, where these are known.
    """

    most = len(_KINDS)  # constraints of one may break another

    def __init__(self, report: Callable[[str], None] | None = None, *, finer: bool = True) -> None:
        self._report, self._finer = report, finer

    def missing(self, outcome: Outcome[Program]) -> Additions[Program] | None:
        """Constraints of the lazy terms that a solution breaks."""
        broken = self._broken(outcome)
        if not broken:
            return None
        t, origin = outcome.program, outcome.origin
        bounded, said = with_rows(t.problem, broken), "; ".join(broken.values())

        def guesses() -> Iterator[Guess[Program]]:
            yield Guess.mapped(
                program_for(t, bounded, report=self._report), t, outcome.result, barrier=_BARRIER
            )
            cold = program_for(origin.program, bounded, constraints={}, report=self._report)
            yield Guess(program=cold, start=start_of(cold, origin.program, origin.x))

        return Additions(
            name="lazy constraints",
            why=f"{said}: on with constraints of {', '.join(_KINDS[name].name for name in broken)}",
            guesses=guesses(),
            without=f"Without {', '.join(f'[terms.{name}]' for name in broken)} there is a plan, but {said}.",
        )

    def _broken(self, outcome: Outcome[Program]) -> dict[str, str]:
        """Violations of lazy terms that have no constraints yet: message by name of the term."""
        problem, planned = outcome.program.problem, outcome.at.planned
        has, out = rows_on_demand(problem), dict[str, str]()
        for name, kind in _KINDS.items():
            term = problem.term(kind)
            if name in has or term not in problem.on_demand:
                continue
            words = ""
            if isinstance(term, GearLoad):
                error = outcome.at.contact_error if self._finer else None
                finer = () if error is None or error.missed else error.finer
                words = gears_beyond(problem, _loads(outcome.program.robot, planned, finer))
            elif isinstance(term, Slide) and isinstance(planned, Plan):
                words = slides_beyond(term, planned)
            if words:
                out[name] = words
        return out


def _loads(
    robot: Robot, planned: Plan | PlannedStrike, finer: tuple[PlannedCollision, ...]
) -> list[DriveLoads]:
    """Gear and motor loads of all motions and all collisions."""
    hits = finer or [planned.collision, *(scenario.collision for scenario in planned.scenarios)]
    if isinstance(planned, PlannedStrike):
        still = np.zeros(robot.nv)
        return [strike_loads(robot, still, still, hit) for hit in hits]
    with contextlib.suppress(InputError):  # legs that do not reach: what completes the motion says so
        return plan_loads(robot, planned, hits)
    return []
