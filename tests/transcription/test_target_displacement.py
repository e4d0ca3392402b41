"""Tests of the target's displacement as variables of a program, against the plan's own integral."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from support.small_plans import arm_problem, biped_problem, transcribed

from impactopt import (
    Board,
    ContactFriction,
    FreeMass,
    Phase,
    RigidWall,
    Scenario,
    StancePhase,
    TargetBody,
    solve,
)
from impactopt.bodies.clearance import MISSED
from impactopt.planning.clearance_constraints import node_placements
from impactopt.planning.solution import program_of
from impactopt.problem.terms import KeepOut, SelfCollision
from impactopt.solvers.program import Status
from impactopt.transcription.clearance import DISPLACEMENT
from impactopt.transcription.initial_guess import first_iterate

OFF = (KeepOut(enabled=False), SelfCollision(enabled=False))
TARGETS: dict[str, dict[str, Any]] = {
    "free": {},
    "frozen model": {"collision": "sdc"},
    "rigid": {"collision": "rigid"},
    "pushed aside": {"friction": ContactFriction(coefficient=0.6, moves_target=True)},
    "coming": {"target": FreeMass(mass=1.0, initial_velocity=-0.5)},
}


@pytest.mark.parametrize("name", TARGETS)
def test_a_solution_has_the_target_where_its_plan_has_it(name: str) -> None:
    """Up to the trapezoidal rule of the plan's integral in contact."""
    solution = solve(dataclasses.replace(arm_problem(), **TARGETS[name]))
    assert solution.status is Status.SOLVED
    t, x = program_of(solution), solution.result.x
    nodes = node_placements(t, x)
    moved = solution.plan.displacement(nodes.time)
    assert np.abs(moved).max() > 1e-3
    np.testing.assert_allclose(nodes.at.displacement, moved, atol=1e-3)


def test_the_target_moves_on_in_later_stance_phases_and_comes_in_earlier_ones() -> None:
    both = StancePhase(soles=("left", "right"), phase=Phase(duration=0.5, intervals=6))
    ball, left = FreeMass(mass=1.0, initial_velocity=-0.3), StancePhase(soles=("left",))
    gone = Scenario(name="gone", missing=True, abort_after=0.02)
    t = transcribed(
        dataclasses.replace(
            biped_problem(),
            target=ball,
            scenarios=(gone,),
            stances=(both, left, both),
        )
    )
    x = first_iterate(t)
    nodes, plan = node_placements(t, x), t.decode(x)
    assert nodes.names == tuple(place.name for place, _ in t.body_spots)
    here = nodes.at.phase != MISSED
    moved = plan.displacement(nodes.time[here])
    assert moved[0] @ t.problem.normal > 0.1 and (moved @ t.problem.normal).max() > 0.5
    np.testing.assert_allclose(nodes.at.displacement[here], moved, atol=0.02)
    assert not nodes.at.displacement[~here].any()


@pytest.mark.parametrize(
    "changes",
    [
        {"target": RigidWall()},
        {"body": TargetBody(shape="none")},
        {"terms": OFF},
        {"terms": OFF[:1]},
        {"target": Board(mass=0.3, stiffness=1e5, breaking_force=900.0)},
    ],
)
def test_where_no_body_moves_with_the_target_after_contact_there_are_no_such_variables(
    changes: dict[str, Any],
) -> None:
    t = transcribed(dataclasses.replace(arm_problem(), **changes))
    assert not [name for name in t.layout.groups if name.startswith(DISPLACEMENT)]
    assert not node_placements(t, first_iterate(t)).at.displacement.any()
