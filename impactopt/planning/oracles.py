"""Oracles of a motion's refinement: for violations between its nodes, and for the prices of its style.

The first finds violated clearances and limits, and the discretization error of the contact.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from impactopt.errors import InputError
from impactopt.planning.budget import Budget, touching, with_effort_of
from impactopt.planning.clearance_constraints import (
    ClearanceViolations,
    Margins,
    clearance_violations,
    solve_with_clearance,
)
from impactopt.planning.contact_replay import ACCEPTABLE_WITHIN, SOLVED_WITHIN
from impactopt.planning.diagnosis import MAX_NAMED, lost_in_contact
from impactopt.planning.refinement import Additions, Guess, Outcome, program_for, refine, start_of
from impactopt.problem.objectives import MotionPrices
from impactopt.solvers.program import SolverResult, Status
from impactopt.transcription.contact_refinement import TOLERANCE_PCT, all_halved, finest, refined_elements
from impactopt.transcription.initial_guess import first_iterate
from impactopt.transcription.mesh import Elements, contact_elements, nodes_to_add
from impactopt.transcription.transcription import Transcription

# First barriers of a warm start that violates constraints of the new program: new clearance constraints; a
# finer contact that differs from the coarse one by more than a solved plan may.
_BARRIER_CLEARANCE, _BARRIER_CONTACT = 1e-4, 1e-3
# With the first nodes in contact the motion changes much: TOCABI's punch takes 395 iterations, 666 with 1e-4.
_BARRIER_IN_CONTACT = 6e-3
_MESH_ROUNDS = 3  # rounds that refine the mesh, at most
# Rounds of one refinement, and its rounds while bodies still penetrate, which each round reduces.
_ROUNDS, _MAX_ROUNDS = 12, 40
# Iterations from a warm start, if there are other guesses: it converges in a few, or hardly at all.
_ITERATIONS_WARM = 200


class BetweenNodes:
    """Oracle of one refinement, for penetration and violated limits between nodes, and for a contact whose
    mesh is too coarse.

    mesh : refine the mesh for limits and contact, too; False: for clearance only.
    """

    most = _MAX_ROUNDS
    of_refused = False

    def __init__(self, budget: Budget, margins: Margins | None, *, mesh: bool = True) -> None:
        self._budget, self._margins, self._mesh = budget, margins, mesh
        self._rounds, self._refined = 0, 0 if mesh else _MESH_ROUNDS
        # the last one without penetration, and the clearances that it loses nevertheless
        self._clear: Outcome[Transcription] | None = None
        self._lost: ClearanceViolations | None = None

    def refined(self, outcome: Outcome[Transcription]) -> Outcome[Transcription]:
        """Outcome refined by this oracle alone; failed if bodies still penetrate or its replay disagrees."""

        def solve(guess: Guess[Transcription]) -> Outcome[Transcription]:
            return solve_with_clearance(self._budget, self._margins, guess)

        return self.checked(refine(outcome, [self], solve, self._budget))

    def checked(self, outcome: Outcome[Transcription]) -> Outcome[Transcription]:
        """Outcome checked by its replay; if bodies penetrate, the last outcome without penetration instead,
        or a failed one. Bodies that keep less than half of their clearance make it acceptable.
        """
        if self._margins is None or not outcome.usable:
            return outcome.checked()
        with contextlib.suppress(InputError):
            # `missing` has checked the last clear outcome already.
            clear = outcome is self._clear
            lost = self._lost if clear else clearance_violations(outcome.at, self._margins)
            if lost is not None and lost.depth > 0:
                if self._clear is None:
                    pairs = (pair for pair, distance in lost.nearest.items() if distance < 0)
                    names = (" and ".join(self._margins.bodies.names(pair)) for pair in pairs)
                    return replace(outcome, result=touching(outcome.result, lost.depth, names, "solution"))
                result = with_effort_of(self._clear.result, outcome.result)
                outcome, lost = replace(self._clear, result=result), self._lost
            if lost is not None:
                outcome = replace(outcome, result=self._too_near(outcome.result, lost))
        return outcome.checked()

    def _too_near(self, result: SolverResult, lost: ClearanceViolations) -> SolverResult:
        """Acceptable result, whose message names the bodies that keep less than half of their clearance."""
        margins, told = self._margins, []
        assert margins is not None
        for pair, distance in sorted(lost.nearest.items(), key=lambda item: item[1])[:MAX_NAMED]:
            told.append(
                f"{' and '.join(margins.bodies.names(pair))} {1e3 * distance:.2g} mm instead of "
                f"{1e3 * margins.of(pair):.2g} ([terms.{margins.term(pair).section}] margin_m)"
            )
        message = f"Bodies keep less than half of their clearance: {'; '.join(told)}."
        return replace(result, status=Status.ACCEPTABLE, message=message)

    def missing(self, outcome: Outcome[Transcription]) -> Additions[Transcription] | None:
        """Nodes, contact elements and clearance constraints that a solution lacks."""
        t, x, violated = outcome.program, outcome.result.x, None
        if self._budget.is_over():
            return None
        with contextlib.suppress(InputError):  # legs out of reach: completing the motion reports it
            if self._margins is not None:
                violated = clearance_violations(outcome.at, self._margins)
                if violated is None or violated.depth <= 0:
                    self._clear, self._lost = outcome, violated
        if self._rounds >= self._most_for(outcome):
            return None
        # nodes of the next program: those for clearance, and with those for limits; elements None: the same
        for_clearance = nodes = t.nodes if violated is None else violated.nodes
        shares, error = t.hit.shares, None
        elements: Elements | None = None
        if self._refined < _MESH_ROUNDS:
            with contextlib.suppress(InputError):
                nodes = nodes_to_add(outcome.at.planned, for_clearance)
            error = outcome.at.contact_error
            elements = refined_elements(error, t.hit.elements)
            # open gains: the robot's own are not those of the plan
            if elements is None and not t.problem.gains:
                with contextlib.suppress(InputError):
                    planned = outcome.at.planned
                    lost = lost_in_contact(planned, finest(planned, error)[0])
                    elements = all_halved(t.hit.elements) if lost else None
            # freezes are at given shares of the contact's duration: other durations need other elements
            shares = t.hit.drifted(x) or shares
            if shares != t.hit.shares:
                elements = contact_elements(t.problem, shares)
            # Nodes for clearance do not count as a refinement of the mesh.
            self._refined += nodes != for_clearance or elements is not None
        # If the coarse contact misses an event, its optimum is not near one of the finer program.
        missed = error is not None and error.missed
        if violated is None and nodes == t.nodes and elements is None:
            # Nothing is missing by the estimates: the replay may still differ, and ask for finer elements.
            # They cannot add a parting that the program does not plan.
            replay = outcome.at.replay if self._refined < _MESH_ROUNDS else None
            if replay is None or replay.off <= TOLERANCE_PCT or replay.unforeseen:
                return None
            missed, elements = missed or replay.off > ACCEPTABLE_WITHIN, all_halved(t.hit.elements)
            if elements is None:
                return None
            self._refined += 1
        # a contact with a large error violates the finer program's constraints by much
        far = elements is not None and error is not None and abs(error.pct) > SOLVED_WITHIN
        in_contact = nodes.contact and not t.nodes.contact
        barrier = _BARRIER_CONTACT if far else None if violated is None else _BARRIER_CLEARANCE
        barrier = _BARRIER_IN_CONTACT if in_contact else barrier
        raised = {} if violated is None else violated.constraints
        name = _name(nodes.total - t.nodes.total, elements, len(raised), in_contact=in_contact)
        self._rounds += 1

        def guesses() -> Iterator[Guess[Transcription]]:
            constraints, finer = {**t.clearance_constraints, **raised}, t
            if nodes != t.nodes or elements is not None:
                finer = program_for(
                    t,
                    nodes=nodes,
                    elements=elements,
                    shares=shares,
                    constraints=constraints,
                    report=self._budget.report,
                )
            # Same variables, same mesh: no new program has to be built.
            elif raised:
                finer = t.with_clearance(constraints)
            # With the same variables and other clearance constraints, there are three guesses: the solution
            # with its multipliers, without them, and the initial guess of the refinement.
            others = violated is not None and finer.layout.n == len(x)
            if missed:
                yield Guess(program=finer, start=first_iterate(finer), barrier=barrier)
            else:
                most = _ITERATIONS_WARM if others else None
                yield Guess.mapped(finer, t, outcome.result, barrier=barrier, most=most)
            if others:
                yield Guess(program=finer, start=x, barrier=barrier)
                first = outcome.origin
                start = first.x if finer.layout.n == len(first.x) else start_of(finer, first.program, first.x)
                yield Guess(program=finer, start=start, barrier=barrier)

        why = f"the plan violates limits between nodes, or its contact is too coarse: solving with {name}"
        return Additions(name=name, why=why, guesses=guesses(), without="")

    def _most_for(self, outcome: Outcome[Transcription]) -> int:
        """Largest number of rounds; more if the outcome penetrates."""
        if self._margins is None:
            return _MESH_ROUNDS
        if outcome is not self._clear:
            return _MAX_ROUNDS
        return _ROUNDS if self._mesh else 0


def _name(nodes: int, elements: Elements | None, raised: int, *, in_contact: bool) -> str:
    """Name of the additions to a program: numbers of nodes, elements and raised clearances."""
    parts = [f"{nodes} more node{'s' if nodes > 1 else ''}"] if nodes else []
    parts += ["nodes in contact"] if in_contact else []
    parts += [f"{sum(map(len, elements))} contact elements"] if elements is not None else []
    parts += [f"{raised} clearance{'s' if raised > 1 else ''} raised"] if raised else []
    return ", ".join(parts) or "clearance constraints"


# [N s] Objective of the initial guess of the problem `punch`, for which the prices were chosen.
_REFERENCE_OBJECTIVE = 4.0
_MIN_SCALE = 0.02  # of the prices, if the objective of the initial guess is nearly zero
# Reductions at most: lower prices permit a motion that costs more, so one may not be enough.
_MAX_REDUCTIONS = 3
_SHARE_TOLERANCE = 0.02  # of the allowed share: a plan within it is not solved again
_SHARE_AIM = 0.9  # of the allowed share, that a reduction aims at


def with_first_scale(t: Transcription) -> Transcription:
    """Program whose prices of the motion style are scaled by the objective of its initial guess.

    The prices are for impacts of some newton seconds. The guess has a part of the objective of the plan. If
    that is far less than `_REFERENCE_OBJECTIVE`, unscaled prices would outweigh the objective.
    """
    p = t.problem
    # A scale that a user or a solution has given stays.
    if p.price_scale != 1.0 or p.style_prices == MotionPrices():
        return t
    objective = t.objective_sum(first_iterate(t))
    scale = float(np.clip(objective / _REFERENCE_OBJECTIVE, _MIN_SCALE, 1.0))
    if not np.isfinite(objective) or scale == 1.0:
        return t
    return t.repriced(scale)


class MotionPrice:
    """Oracle that reduces the prices of the motion style if their share of the objective is larger than
    `ImpactProblem.motion_price`.
    """

    most = _MAX_REDUCTIONS
    of_refused = False

    def missing(self, outcome: Outcome[Transcription]) -> Additions[Transcription] | None:
        """Program with reduced prices, from the solution."""
        t, allowed = outcome.program, outcome.program.problem.motion_price
        if not t.problem.price_scale:
            return None
        share, style = t.price_shares(outcome.result.x)  # of all prices, and of the style's
        if share <= allowed * (1 + _SHARE_TOLERANCE):
            return None
        # What the other prices leave of the aim; the style's share is proportional to
        # the scale, to first order.
        left = max(_SHARE_AIM * allowed - (share - style), 0.0) if np.isfinite(share) else 0.0
        scale = t.problem.price_scale * left / style if style > 0 else 0.0

        def guesses() -> Iterator[Guess[Transcription]]:
            yield Guess.mapped(t.repriced(scale), t, outcome.result)

        why = f"the motion's style takes {100 * share:.1f} % of the objective: its prices are reduced"
        return Additions(name="lower prices of motion", why=why, guesses=guesses(), without="")
