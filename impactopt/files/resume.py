"""Saved plans as solutions again, from which others can be planned."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import numpy as np

from impactopt.files.output import Record
from impactopt.planning.gain_selection import ChosenGains
from impactopt.planning.reconstruction import program_on, solution_of
from impactopt.planning.refinement import Outcome
from impactopt.planning.solution import Solution
from impactopt.planning.solve import solve
from impactopt.problem.problem import ImpactProblem
from impactopt.solvers.program import SolverResult, Status, max_violation
from impactopt.transcription.clearance import ApartRow, Held
from impactopt.transcription.mesh import Elements
from impactopt.transcription.mesh_refinement import MoreNodes
from impactopt.transcription.transcription import Transcription

__all__ = ["program_of_record", "resumed", "solution_of_record"]

_SAME = 1e-6  # of constraints: those of a program that is not the record's are off by more


def resumed(record: Record, problem: ImpactProblem) -> Solution:
    """The solution that a record is of, as far as a start has to know it: of its history it knows nothing.

    The program is made again from what the record says of it. Where it says nothing, or the program is
    another one today, the problem is solved anew, from the record's variables if they fit.

    problem : the record's, as `impactopt.files.replay.load_planned` builds it.
    """
    made = program_of_record(record, problem)
    x = np.asarray(record.arrays["solver_x"])
    if made is not None and _is_of(made, record):
        return solution_of_record(record, made)
    if made is None or made.program.n != len(x):
        return solve(problem)
    return solve(problem, start=x)


def program_of_record(record: Record, problem: ImpactProblem) -> Transcription | None:
    """The program that a record says it is of, made again; None where it says nothing."""
    if "program_statement" not in record.arrays:
        return None
    told: dict[str, Any] = json.loads(str(record.arrays["program_statement"]))
    elements: Elements = tuple(tuple(e) for e in told["elements"]) if told["guarded"] else ()
    nodes = MoreNodes(*(tuple(places) for places in told["more"]))
    t = program_on(problem, nodes, elements, tuple(told.get("shares", ())))
    return t.with_apart(_apart(told["apart"])) if told["apart"] else t


def _apart(told: list[dict[str, Any]]) -> dict[ApartRow, Held]:
    """Constraints between bodies."""
    return {
        ApartRow(*(row[key] for key in ApartRow._fields)): Held(
            tuple(row["way"]), row["reach"], row["travel"]
        )
        for row in told
    }


def _is_of(t: Transcription, record: Record) -> bool:
    """True if a program has the record's variables and constraints, with the violation that it reports."""
    x, rows = record.arrays["solver_x"], record.arrays["solver_multipliers"]
    if (t.program.n, t.program.m) != (len(x), len(rows)):
        return False
    found = max_violation(t.program, x, t.program.constraints(x))
    return bool(found <= float(record.arrays["solver_max_violation"]) + _SAME)


def solution_of_record(record: Record, t: Transcription) -> Solution:
    """The solution that a program's variables in a record are."""
    summary = record.summary
    given = {f.name: record.arrays.get(f"solver_{f.name}") for f in dataclasses.fields(SolverResult)}
    numbers: dict[str, Any] = {k: v if v.ndim else v.item() for k, v in given.items() if v is not None}
    status = Status(summary["status"])
    result = SolverResult(**numbers, status=status, message=str(summary["message"]))
    return solution_of(
        Outcome.of(t, result),
        solver=str(summary["solver"]),
        seconds=(float(summary["build_seconds"]), float(summary["solve_seconds"])),
        statement=str(record.arrays["program_statement"]),
        gains=tuple(map(ChosenGains.told, summary.get("gains", ()))),
    )
