"""Oracle for what a plan does between its nodes: clearance violations, limits, error of the contact."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import replace

from impactopt.errors import InputError
from impactopt.planning.budget import Budget, touching, with_effort_of
from impactopt.planning.clearance_constraints import Margins, clearance_violations, solve_with_clearance
from impactopt.planning.contact_replay import ACCEPTABLE_WITHIN, SOLVED_WITHIN
from impactopt.planning.refinement import Additions, Guess, Outcome, program_for, refine, start_of
from impactopt.transcription.contact_refinement import ASKED, all_halved, refined_elements
from impactopt.transcription.initial_guess import first_iterate
from impactopt.transcription.mesh import Elements, contact_elements, nodes_to_add
from impactopt.transcription.transcription import Transcription

__all__ = ["BetweenNodes"]

_BARRIER = 1e-4  # where constraints between bodies are new, which the solution before breaks
_BARRIER_DEEP = 1e-3  # of a finer contact, where the one before is far off
_MESH_ROUNDS = 3  # with a finer mesh, at most
_ROUNDS, _MOST = 12, 40  # of all, and while bodies penetrate: each round brings them nearer to an end
_ITERATIONS = 200  # from a solution, where there is another guess: it goes on in a few, or hardly at all


class BetweenNodes:
    """Oracle of one refinement: where a plan's bodies penetrate between nodes, limits are left there, or the
    contact is too coarse.

    mesh : whether limits and contact may get a finer mesh; False: it gets finer for clearance only.
    """

    most = _MOST

    def __init__(self, budget: Budget, margins: Margins | None, *, mesh: bool = True) -> None:
        self._budget, self._margins, self._mesh = budget, margins, mesh
        self._rounds, self._refined = 0, 0 if mesh else _MESH_ROUNDS
        self._clear: Outcome[Transcription] | None = None  # the last one without penetration

    def refined(self, outcome: Outcome[Transcription]) -> Outcome[Transcription]:
        """Outcome refined by this oracle alone, and checked: penetration that is left is no solution."""

        def solve(guess: Guess[Transcription]) -> Outcome[Transcription]:
            return solve_with_clearance(self._budget, self._margins, guess)

        return self._checked(refine(outcome, [self], solve, self._budget))

    def _checked(self, outcome: Outcome[Transcription]) -> Outcome[Transcription]:
        """Outcome whose contact is replayed; where bodies penetrate, the last one without."""
        if self._margins is None or not outcome.usable or outcome is self._clear:
            return outcome.checked()
        with contextlib.suppress(InputError):
            left = clearance_violations(outcome.program, outcome.result.x, self._margins, share=1.0)
            if left is not None and left.depth > 0:
                if self._clear is not None:
                    result = with_effort_of(self._clear.result, outcome.result)
                    return replace(self._clear, result=result).checked()
                names = (" and ".join(self._margins.bodies.names(pair)) for pair in left.pairs)
                return replace(outcome, result=touching(outcome.result, left.depth, names, "solution"))
        return outcome.checked()

    def missing(self, outcome: Outcome[Transcription]) -> Additions[Transcription] | None:
        """Nodes, contact elements and clearance constraints that a solution lacks."""
        t, x, violated = outcome.program, outcome.result.x, None
        if self._budget.left == 0:
            return None
        with contextlib.suppress(InputError):  # legs that do not reach: what completes the motion says so
            if self._margins is not None:
                violated = clearance_violations(t, x, self._margins)
                if violated is None or violated.depth <= 0:
                    self._clear = outcome
        if self._rounds >= self._most_for(outcome):
            return None
        needed = nodes = t.nodes if violated is None else violated.nodes
        shares, error = t.hit.shares, None
        elements: Elements | None = None
        if self._refined < _MESH_ROUNDS:
            with contextlib.suppress(InputError):
                nodes = nodes_to_add(outcome.at.planned, needed)
            error = outcome.at.contact_error
            elements = refined_elements(error, t.hit.elements)
            shares = t.hit.drifted(x) or shares
            if shares != t.hit.shares:
                elements = contact_elements(t.problem, shares)
            self._refined += nodes != needed or elements is not None
        # an optimum whose contact was missed is none of the finer program, nor near one
        missed = error is not None and error.missed
        if violated is None and nodes == t.nodes and elements is None:
            replay = outcome.at.replay if self._refined < _MESH_ROUNDS else None
            if replay is None or replay.off <= ASKED or replay.unforeseen:
                return None
            missed, elements = missed or replay.off > ACCEPTABLE_WITHIN, all_halved(t.hit.elements)
            if elements is None:
                return None
            self._refined += 1
        # a contact that is far off breaks the finer program's constraints by far
        far = elements is not None and error is not None and abs(error.pct) > SOLVED_WITHIN
        barrier = _BARRIER_DEEP if far else None if violated is None else _BARRIER
        added = {} if violated is None else violated.constraints
        name = _name(nodes.total - t.nodes.total, elements, len(added))
        self._rounds += 1

        def guesses() -> Iterator[Guess[Transcription]]:
            rows, finer = {**t.apart_rows, **added}, t
            if nodes != t.nodes or elements is not None:
                finer = program_for(
                    t,
                    nodes=nodes,
                    elements=elements,
                    shares=shares,
                    constraints=rows,
                    report=self._budget.report,
                )
            elif added:
                finer = t.with_apart(rows)
            others = violated is not None and finer.layout.n == len(x)
            if missed:
                yield Guess(program=finer, start=first_iterate(finer), barrier=barrier)
            else:
                most = _ITERATIONS if others else None
                yield Guess.mapped(finer, t, outcome.result, barrier=barrier, most=most)
            if others:
                yield Guess(program=finer, start=x, barrier=barrier)
                first = outcome.origin
                start = first.x if finer.layout.n == len(first.x) else start_of(finer, first.program, first.x)
                yield Guess(program=finer, start=start, barrier=barrier)

        why = f"the plan is not what it says between nodes: {name}, and on from there"
        return Additions(name=name, why=why, guesses=guesses())

    def _most_for(self, outcome: Outcome[Transcription]) -> int:
        """Rounds at most, of an outcome whose clearance is known."""
        if self._margins is None:
            return _MESH_ROUNDS
        if outcome is not self._clear:
            return _MOST
        return _ROUNDS if self._mesh else 0


def _name(nodes: int, elements: Elements | None, rows: int) -> str:
    """Text for the additions to a program."""
    words = [f"{nodes} more node{'s' if nodes > 1 else ''}"] if nodes else []
    words += [f"{sum(map(len, elements))} contact elements"] if elements is not None else []
    words += [f"{rows} constraint{'s' if rows > 1 else ''} between bodies with more margin"] if rows else []
    return ", ".join(words) or "constraints between bodies"
