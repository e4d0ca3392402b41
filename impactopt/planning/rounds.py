"""Refinement loop: solve, check between nodes, add nodes, elements or clearance constraints, solve again."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from impactopt.errors import InputError
from impactopt.planning.contact_replay import AGREED, REFUTED, ContactReplay, PlannedContact, checked
from impactopt.planning.keeping_apart import Margins, solved_apart
from impactopt.planning.models import planned_contact
from impactopt.planning.multistart import Budget, carried, one_after_the_other, touching, with_effort_of
from impactopt.planning.too_near import Violated, clearance_violations
from impactopt.planning.verdict import second_look
from impactopt.solvers.program import SolverResult, Status
from impactopt.transcription.clearance import ApartRow, Held
from impactopt.transcription.contact_refinement import (
    ASKED,
    ContactError,
    all_halved,
    contact_error,
    refined_elements,
)
from impactopt.transcription.initial_guess import carried_over, first_iterate
from impactopt.transcription.mesh import Elements, contact_elements
from impactopt.transcription.mesh_refinement import nodes_to_add
from impactopt.transcription.transcription import Transcription, block_functions

Array = NDArray[np.float64]
_BARRIER = 1e-4  # where constraints between bodies are new, which the solution before breaks
_BARRIER_DEEP = 1e-3  # of a finer contact, where the one before is far off
_STUCK = (Status.INFEASIBLE, Status.FAILED)
_NODE_ROUNDS = 3  # with a finer mesh, at most
_ROUNDS, _MOST = 12, 40  # of all, and while bodies penetrate: each round brings them nearer to an end
_ITERATIONS = 200  # from a solution, where there is another start: it goes on in a few, or hardly at all


@dataclass(frozen=True, kw_only=True)
class Round:
    """A program that is to be solved next, and from where: from one after the other, until it is."""

    program: Transcription
    starts: tuple[Array | SolverResult, ...]
    name: str
    why: str
    barrier: float | None = None

    def solved(self, budget: Budget, margins: Margins | None) -> tuple[Transcription, SolverResult]:
        """The first result that is a solution, or the last one, and its program."""
        *others, last = self.starts
        for start in others:
            most = _ITERATIONS if isinstance(start, SolverResult) else None
            t, new = solved_apart(budget, margins, self.program, start, self.barrier, most)
            if new.status.usable or new.status is Status.INTERRUPTED or budget.left == 0:
                return t, new
        return solved_apart(budget, margins, self.program, last, self.barrier)


def start_of(finer: Transcription, t: Transcription, x0: Array) -> Array:
    """Initial guess of a program, mapped to one with more nodes or elements."""
    return carried_over(finer, t, x0, np.zeros(t.program.m), np.zeros(t.layout.n))[0]


def more_of(nodes: int, elements: Elements | None, rows: int) -> str:
    """Text for the additions to a program."""
    words = [f"{nodes} more node{'s' if nodes > 1 else ''}"] if nodes else []
    words += [f"{sum(map(len, elements))} contact elements"] if elements is not None else []
    words += [f"{rows} constraint{'s' if rows > 1 else ''} between bodies with more margin"] if rows else []
    return ", ".join(words) or "constraints between bodies"


class Refining:
    """Refines a program until its solution is valid between the nodes, too.

    Where a solution has bodies penetrate between nodes, leaves its limits there, or has a contact
    that is too coarse, its program gets more nodes, elements or margins there and is solved again, from where
    it is.

    mesh : whether it may get finer; False: it does where bodies penetrate only.
    """

    def __init__(
        self,
        budget: Budget,
        margins: Margins | None,
        rows: Mapping[ApartRow, Held],
        report: Callable[[str], None] | None,
        *,
        mesh: bool = True,
    ) -> None:
        self.budget, self.margins, self.given_rows, self.report = budget, margins, rows, report
        self.mesh = mesh
        self._known: tuple[Transcription, Array, ContactError | None] | None = None
        self._contact: tuple[Transcription, Array, PlannedContact] | None = None
        self._near: tuple[Transcription, Array, Violated | None] | None = None
        self._refined = 0  # rounds with a finer mesh
        self._apart: tuple[Transcription, SolverResult] | None = None  # the last whose bodies are not
        self.blocked = False  # whether it ended with penetrating bodies: another start may not

    def error(self, t: Transcription, x: Array) -> ContactError | None:
        """Discretization error of a program's contact at its solution; the last one is cached."""
        if self._known is None or self._known[0] is not t or self._known[1] is not x:
            self._known = t, x, contact_error(t, x)
        return self._known[2]

    def anew(self, t: Transcription) -> Refining:
        """Another one, for a program that has constraints between bodies already."""
        return Refining(self.budget, self.margins, t.apart_rows, self.report)

    def contact(self, t: Transcription, x: Array) -> PlannedContact | None:
        """Planned contact of a program at its solution, with its replay in full dynamics; the last one is
        cached. None while gains are open, as the robot is another one then.
        """
        if t.problem.gains:
            return None
        known = self.known_contact(t, x)
        if known is None:
            known = planned_contact(t, x, t.decode(x))
            self._contact = t, x, known
        return known

    def known_contact(self, t: Transcription, x: Array) -> PlannedContact | None:
        """The same if it was the last one that was asked for."""
        if self._contact is None or self._contact[0] is not t or self._contact[1] is not x:
            return None
        return self._contact[2]

    def replay(self, t: Transcription, x: Array) -> ContactReplay | None:
        """Replay of the planned contact in full dynamics."""
        contact = self.contact(t, x)
        return None if contact is None else contact.replay

    def checked(self, t: Transcription, result: SolverResult) -> SolverResult:
        """A result that is solved only if its contact is, followed in full dynamics, what it says."""
        if not result.status.usable:
            return result
        found = checked(result, self.replay(t, result.x))
        self.blocked |= not found.status.usable
        return found

    def learn(self, other: Refining) -> None:
        """Take over what another has found of the last program that it had."""
        self.blocked, self._known, self._contact = other.blocked, other._known, other._contact

    def first(self, t: Transcription, start: Array | SolverResult) -> tuple[Transcription, SolverResult]:
        """The program with its first clearance constraints, and its result."""
        warm = isinstance(start, SolverResult)
        if warm and self.given_rows:
            t = t.with_apart(self.given_rows)
        if isinstance(start, SolverResult) and len(start.multipliers) != t.program.m:
            start = start.x  # of a program with other constraints
        t, result = solved_apart(self.budget, self.margins, t, start)
        if self.margins is None:
            result = self._looked_at(t, result, start.x if isinstance(start, SolverResult) else start)
        return t, result

    def _violated(self, t: Transcription, x: Array) -> Violated | None:
        """Clearance violations of a program at its variables; the last ones are cached."""
        if self.margins is None:
            return None
        if self._near is None or self._near[0] is not t or self._near[1] is not x:
            self._near = t, x, clearance_violations(t, x, self.margins)
        return self._near[2]

    def _looked_at(self, t: Transcription, result: SolverResult, x0: Array) -> SolverResult:
        """A result without a diagnosis with that of another solver, from the same start."""
        new = second_look(self.budget, t.program, x0, result, self.report)
        return result if new is result else one_after_the_other(result, new)

    def solve(self, t: Transcription, start: Array | SolverResult) -> tuple[Transcription, SolverResult]:
        """The last program, and its result with the effort of all."""
        x0 = start.x if isinstance(start, SolverResult) else start
        free, self.blocked = t, False
        t, result = self.first(free, start)
        if self._stuck(result) and t.apart_rows and self.budget.left != 0:
            t, result = self._solved_without_clearance(free, t, result, x0)
        else:
            t, result = self.judged(*self.rounds(t, result, x0)[:2])
        looked = self._looked_at(t, result, x0)
        if looked is result or not looked.status.usable:
            return t, looked
        return self.judged(*self.rounds(t, looked, x0)[:2])

    def _stuck(self, result: SolverResult) -> bool:
        """True if the solver has ended without a solution, and not at a limit that the caller has set."""
        if result.status is Status.ITERATION_LIMIT:
            return "max_iterations" not in (self.budget.options or {})
        return result.status in _STUCK

    def _solved_without_clearance(
        self, free: Transcription, t: Transcription, stuck: SolverResult, x0: Array
    ) -> tuple[Transcription, SolverResult]:
        """Solves from an initial guess with which the first clearance constraints of a program ``t`` lead
        nowhere.

        A solver that stops there does not show that there is no motion: the constraints are linearized for
        the bodies as they are in the guess. So the motion is first found without them and then moved out of
        penetration; if that fails too, the violated constraints name the obstacle.
        """
        if self.report is not None:
            self.report("no motion was found from there with clearance constraints: first without them")
        last, result = self.judged(*self.rounds(free, self.budget.run(free.program, x0), x0)[:2])
        if result.status.usable:
            return last, one_after_the_other(stuck, result)
        return t, one_after_the_other(result, stuck)

    def rounds(
        self, t: Transcription, result: SolverResult, x0: Array
    ) -> tuple[Transcription, SolverResult, list[tuple[Transcription, str, SolverResult]]]:
        """The last program that was solved, its result with the effort of all, and what came of each
        round.
        """
        found: list[tuple[Transcription, str, SolverResult]] = []
        self._apart = None
        self._refined = 0 if self.mesh else _NODE_ROUNDS
        while result.status.usable and self.budget.left != 0:
            if self.margins is None and len(found) == _NODE_ROUNDS:
                break
            following = self._next(t, result, x0)
            most = _MOST if not self._is_apart(result) else _ROUNDS if self.mesh else 0
            if following is None or len(found) >= most:
                break
            if self.report is not None:
                self.report(following.why)
            finer, new = following.solved(self.budget, self.margins)
            if not new.status.usable:
                break
            if following.program.layout.n != len(x0):  # more nodes or elements: the start has them too
                x0 = start_of(following.program, t, x0)
            t, result = finer, one_after_the_other(result, new)
            found.append((t, following.name, new))
        return t, result, found

    def _is_apart(self, result: SolverResult) -> bool:
        """True if a result has been checked and found without contacts between bodies."""
        return self._apart is not None and self._apart[1] is result

    def judged(self, t: Transcription, result: SolverResult) -> tuple[Transcription, SolverResult]:
        """Result after a failed repair: a solution only if no bodies touch; else the last one without
        contact, if there is one.
        """
        if self.margins is None or not result.status.usable or self._is_apart(result):
            return t, self.checked(t, result)
        with contextlib.suppress(InputError):
            left = clearance_violations(t, result.x, self.margins, share=1.0)
            if left is not None and left.depth > 0:
                if self._apart is not None:
                    before, clean = self._apart
                    return before, self.checked(before, with_effort_of(clean, result))
                self.blocked = True
                names = (" and ".join(self.margins.bodies.names(pair)) for pair in left.pairs)
                return t, touching(result, left.depth, names, "solution")
        return t, self.checked(t, result)

    def _next(self, t: Transcription, old: SolverResult, x0: Array) -> Round | None:
        """Next program to solve; None if the solution is valid."""
        shares, violated = t.hit.shares, None
        elements: Elements | None = None
        error: ContactError | None = None
        with contextlib.suppress(InputError):  # legs that do not reach: what completes the motion says so
            if self.margins is not None:
                violated = self._violated(t, old.x)
                if violated is None or violated.depth <= 0:
                    self._apart = t, old
        needed = nodes = t.nodes if violated is None else violated.nodes
        if self._refined < _NODE_ROUNDS:
            with contextlib.suppress(InputError):
                nodes = nodes_to_add(t.decode(old.x), needed)
            error = self.error(t, old.x)
            elements = refined_elements(error, t.hit.elements)
            shares = t.hit.drifted(old.x) or shares
            if shares != t.hit.shares:
                elements = contact_elements(t.problem, shares)
            self._refined += nodes != needed or elements is not None
        false = False
        if violated is None and nodes == t.nodes and elements is None:
            if self._refined >= _NODE_ROUNDS:
                return None
            replay = self.replay(t, old.x)
            if replay is None or replay.off <= ASKED or replay.partings:
                return None
            false, elements = replay.off > REFUTED, all_halved(t.hit.elements)
            if elements is None:
                return None
            self._refined += 1
        rows = {**t.apart_rows, **(violated.rows if violated is not None else {})}
        finer = t
        if nodes != t.nodes or elements is not None:
            finer_elements = elements or (t.hit.elements if t.hit.guarded else ())
            functions = block_functions(t.problem, t.coordinates, self.report, finer_elements)
            finer = Transcription(t.problem, t.coordinates, functions, nodes, finer_elements, shares)
        if self.margins is not None:
            finer = finer.with_apart(rows)
        # an optimum whose contact was missed is none of the finer program, nor near one
        missed = false or (error is not None and error.missed)
        starts: tuple[Array | SolverResult, ...]
        starts = (first_iterate(finer) if missed else carried(finer, t, old),)
        if violated is not None and finer.layout.n == len(old.x):
            starts = (*starts, old.x, x0)
        # a contact that is far off breaks the finer program's constraints by far
        far = elements is not None and error is not None and abs(error.pct) > AGREED
        name = more_of(
            nodes.total - t.nodes.total, elements, len(violated.rows) if violated is not None else 0
        )
        return Round(
            program=finer,
            starts=starts,
            barrier=_BARRIER_DEEP if far else None if violated is None else _BARRIER,
            name=name,
            why=f"the plan is not what it says between nodes: {name}, and on from there",
        )
