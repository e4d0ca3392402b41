"""Refinement loop: solve, check the solution by oracles, add what they require, solve again.

An oracle checks one aspect of a solution (clearance, mesh and contact; gear loads and slips; prices of
motion) and returns the additions to the nonlinear program that this aspect requires. Plans, strikes and
re-planning all use `refine`, each with its own oracles.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from impactopt.arrays import Array
from impactopt.planning.budget import VIOLATED, Budget, one_after_the_other, rank_of, with_effort_of
from impactopt.planning.contact_replay import ContactReplay, PlannedContact, checked, model_error
from impactopt.problem.problem import ImpactProblem
from impactopt.solvers.program import SolverResult, Status, Violation, max_violation, worst_violations
from impactopt.transcription.clearance import ClearanceKey, SeparatingDirection
from impactopt.transcription.contact_program import ContactProgram
from impactopt.transcription.contact_refinement import ContactError, contact_error
from impactopt.transcription.initial_guess import warm_start
from impactopt.transcription.mesh import Elements, MoreNodes, Shares
from impactopt.transcription.strike import StrikeTranscription
from impactopt.transcription.transcription import Transcription, block_functions

Program = TypeVar("Program", Transcription, StrikeTranscription)
MAX_VIOLATIONS = 20  # that an outcome lists


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """Result of the solve from one initial guess, or of one round of refinement.

    start : name of the guess or round.  impulse [N s].  seconds : of the solver.  kept : True for the best.
    """

    start: str
    status: Status
    impulse: float
    objective: float
    max_violation: float
    iterations: int
    seconds: float
    kept: bool = False

    def summary(self) -> dict[str, Any]:
        """JSON form, as it stands in ``summary.json``."""
        return {
            "start": self.start,
            "status": self.status.value,
            "impulse_Ns": self.impulse,
            "objective": self.objective,
            "max_violation": self.max_violation,
            "iterations": self.iterations,
            "seconds": self.seconds,
            "kept": self.kept,
        }


@dataclass(frozen=True, kw_only=True, eq=False)
class Guess(Generic[Program]):
    """Nonlinear program with an initial guess.

    start : variables (n,), or the result of a neighbouring program with its multipliers: a warm start.
    barrier, most : as of `Budget.run`.
    """

    program: Program
    start: Array | SolverResult
    barrier: float | None = None
    most: int | None = None

    @property
    def x(self) -> Array:
        return self.start.x if isinstance(self.start, SolverResult) else self.start

    @property
    def warm(self) -> SolverResult | None:
        """Result for a warm start; None if its multipliers are those of other constraints."""
        # Only their number is compared: programs with as many constraints have the same
        # ones, or `carried` maps them.
        fits = isinstance(self.start, SolverResult) and len(self.start.multipliers) == self.program.program.m
        return self.start if fits and isinstance(self.start, SolverResult) else None

    @classmethod
    def mapped(cls, new: Program, old: Program, result: SolverResult, **more: Any) -> Guess[Program]:
        """A program's result as the warm start of another one (`warm_start`)."""
        return cls(program=new, start=carried(new, old, result), **more)


@dataclass(frozen=True, eq=False)
class Evaluation(Generic[Program]):
    """Values of a program at variables (n,), each computed once."""

    program: Program
    x: Array

    @cached_property
    def planned(self) -> Any:
        """The `Plan`, or `PlannedStrike`."""
        return self.program.decode(self.x)

    @cached_property
    def contact_error(self) -> ContactError | None:
        """Discretization error of the contact; None for a strike, and for an impact without duration."""
        return contact_error(self.program, self.x) if isinstance(self.program, Transcription) else None

    @cached_property
    def contact(self) -> PlannedContact | None:
        """The planned contact; None while gains are open, as the robot's own are not those of the plan."""
        problem = self.program.problem
        if problem.gains:
            return None
        error = model_error(self.program, self.x, self.planned)
        return PlannedContact(problem=problem, planned=self.planned, model_error=error)

    @property
    def replay(self) -> ContactReplay | None:
        """Replay of the planned contact in full dynamics."""
        return None if self.contact is None else self.contact.replay


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome(Generic[Program]):
    """Result of a refinement.

    at : the last program, evaluated at its solution.  result : with the effort of all rounds.
    origin : initial guess of the first round.  attempts : of all rounds, or all guesses.
    """

    at: Evaluation[Program]
    result: SolverResult
    origin: Guess[Program]
    attempts: tuple[Attempt, ...] = ()

    @classmethod
    def of(
        cls, program: Program, result: SolverResult, origin: Guess[Program] | None = None
    ) -> Outcome[Program]:
        """Outcome of one solve; ``origin``: its guess, if not the result itself."""
        origin = Guess(program=program, start=result) if origin is None else origin
        return cls(at=Evaluation(program, result.x), result=result, origin=origin)

    @property
    def program(self) -> Program:
        return self.at.program

    @property
    def usable(self) -> bool:
        return self.result.status.usable

    @property
    def own_violation(self) -> float:
        """Largest violation of the program's own constraints."""
        program = self.program.program
        return max_violation(program, self.result.x, program.constraints(self.result.x))

    @property
    def refused(self) -> bool:
        """True if the constraints are met, and the solution is refused: for penetration, its replay, or what
        an oracle still lacks after its last round.
        """
        # Those who refuse it raise max_violation, and the program's own violation stays.
        failed = self.result.status is Status.FAILED and self.result.max_violation > VIOLATED
        return failed and self.own_violation <= VIOLATED

    @property
    def violations(self) -> tuple[Violation, ...]:
        """Violated constraints, worst first."""
        x, program = self.result.x, self.program.program
        g = program.constraints(x)
        return tuple(worst_violations(program, x, g, tolerance=VIOLATED, count=MAX_VIOLATIONS))

    def attempt(self, name: str) -> Attempt:
        r = self.result
        return Attempt(
            start=name,
            status=r.status,
            impulse=self.program.impulse(r.x),
            objective=r.objective,
            max_violation=r.max_violation,
            iterations=r.iterations,
            seconds=r.seconds,
            # The latest is kept until another one is (`then`, `best_of`).
            kept=True,
        )

    def then(self, new: Outcome[Program], name: str = "") -> Outcome[Program]:
        """New outcome with the effort and the attempts of both; ``name``: of its attempt."""
        attempts = (*(replace(a, kept=False) for a in self.attempts), new.attempt(name))
        result = one_after_the_other(self.result, new.result)
        return replace(new, result=result, origin=self.origin, attempts=attempts)

    def else_then(self, new: Outcome[Program], name: str = "") -> Outcome[Program]:
        """New outcome after a failure; this one if the new one has failed with a larger violation. Either has
        the effort of both; ``name``: of the new one's attempt.
        """
        # An interruption ends the work: its result is the latest, whatever its rank.
        both, ended = self.then(new, name), new.usable or new.result.status is Status.INTERRUPTED
        if ended or not rank_of(self.result) < rank_of(new.result):
            return both
        attempts = (*self.attempts, replace(both.attempts[-1], kept=False))
        return replace(self, result=with_effort_of(self.result, both.result), attempts=attempts)

    def checked(self) -> Outcome[Program]:
        """Outcome with the status that the replay of its contact permits (`contact_replay.checked`)."""
        return replace(self, result=checked(self.result, self.at.replay)) if self.usable else self


Solve = Callable[[Guess[Program]], Outcome[Program]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Additions(Generic[Program]):
    """Additions to a program that a solution requires.

    name : for the list of attempts.  why : for the report.
    guesses : programs with the additions, each made when it is needed; they are solved in turn until one
        succeeds.
    without : why the solution before is not valid without the additions; it ends the message of the failure
        if all guesses fail, or the oracle has no rounds left. "": it is valid, and stays.
    """

    name: str
    why: str
    guesses: Iterable[Guess[Program]]
    without: str


class Oracle(Protocol[Program]):
    """Check of one aspect of a solution.

    most : rounds of one refinement, at most; the solution of the last one is checked, too.
    of_refused : True if it also checks refused solutions, which its additions may make valid.
    """

    most: int
    of_refused: bool

    def missing(self, outcome: Outcome[Program]) -> Additions[Program] | None:
        """Additions that a solution requires; None if there are none, or none that are possible."""


def refine(
    outcome: Outcome[Program], oracles: Sequence[Oracle[Program]], solve: Solve[Program], budget: Budget
) -> Outcome[Program]:
    """Outcome that all oracles accept; else the last solution, if that is valid, or a failure.

    Oracles are nested: a program with one's additions is solved and refined by those before it, and then
    checked again.

    outcome : of the initial guess.  solve : solves one program from one guess.
    """
    if not oracles:
        return outcome
    before: Sequence[Oracle[Program]] = oracles[:-1]
    oracle = oracles[-1]
    # Recursion from the last oracle to the first: the first one is the innermost loop, and runs most often.
    outcome = refine(outcome, before, solve, budget)

    # an addition changes the motion, so the oracles before have to accept it again before this one is called
    def refined(guess: Guess[Program]) -> Outcome[Program]:
        return refine(solve(guess), before, solve, budget)

    for left in range(oracle.most, -1, -1):
        # Of a program without a solution nothing is known to be missing: additions only restrict it further.
        met = outcome.usable or (oracle.of_refused and outcome.refused)
        lacks = oracle.missing(outcome) if met else None
        # without rounds or time left, a solution that is not valid without the additions becomes a failure
        if lacks is None or ((left == 0 or budget.is_over()) and not lacks.without):
            break
        if left == 0:
            message = f"{oracle.most} rounds of {lacks.name} are not enough. {lacks.without}"
            worst = max(outcome.result.max_violation, 2 * VIOLATED)
            result = replace(outcome.result, status=Status.FAILED, max_violation=worst, message=message)
            return replace(outcome, result=result)
        budget.say(lacks.why)
        new = _first_usable(lacks.guesses, refined, budget)
        if not new.usable:
            if not lacks.without or not outcome.usable:
                break  # the solution before the additions stays, or the reason that it was refused for
            if new.result.status is not Status.INTERRUPTED:
                message = f"{new.result.message} {lacks.without}"
                new = replace(new, result=replace(new.result, message=message))
        outcome = outcome.then(new, lacks.name)
    return outcome


def _first_usable(
    guesses: Iterable[Guess[Program]], solve: Solve[Program], budget: Budget
) -> Outcome[Program]:
    """First outcome that is a solution, or the best of all, with the effort of all."""
    done: Outcome[Program] | None = None
    for guess in guesses:
        new = solve(guess)
        done = new if done is None else done.else_then(new)
        if new.usable or new.result.status is Status.INTERRUPTED or budget.is_over():
            break
    assert done is not None
    return done


def program_for(
    t: Program,
    problem: ImpactProblem | None = None,
    *,
    nodes: MoreNodes | None = None,
    elements: Elements | None = None,
    shares: Shares | None = None,
    constraints: Mapping[ClearanceKey, SeparatingDirection] | None = None,
    report: Callable[[str], None] | None = None,
) -> Program:
    """Program like ``t`` for another problem, on another mesh, or with other clearance constraints."""
    constraints = t.clearance_constraints if constraints is None else constraints
    problem = problem or t.problem
    # Given elements forbid a force that pulls (`ContactSet.guarded`): a program's default ones are not given.
    elements = elements or (t.hit.elements if t.hit.guarded else ())
    shares = t.hit.shares if shares is None else shares
    functions = block_functions(problem, report, elements)
    new: Program
    if isinstance(t, StrikeTranscription):
        new = type(t)(problem, functions, elements, shares)
    else:
        new = Transcription(problem, functions, nodes or t.nodes, elements, shares)
    return new.with_clearance(constraints) if constraints else new


def carried(new: ContactProgram, old: ContactProgram, result: SolverResult) -> SolverResult:
    """Result of a program mapped to another one, see `warm_start`."""
    if new is old:
        return result
    x, y, z = warm_start(new, old, result.x, result.multipliers, result.bound_multipliers)
    return replace(result, x=x, multipliers=y, bound_multipliers=z)


def start_of(new: Program, old: Program, x: Array) -> Array:
    """Variables (n,) of a program mapped to another one."""
    # Without multipliers: for a guess from which no solve has ended.
    return warm_start(new, old, x, np.zeros(old.program.m), np.zeros(old.layout.n))[0]
