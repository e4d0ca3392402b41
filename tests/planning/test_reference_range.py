"""A servo's reference that coasts out of the joints' limits in a long contact: bounded once it does."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from support.small_plans import BODILESS, Planned, arm_problem, biped_problem, transcribed

from impactopt import GearLoad, ReferenceRange, load_problem, solve
from impactopt.planning import lazy_constraints
from impactopt.planning.lazy_constraints import reference_beyond
from impactopt.problem import problem as problems
from impactopt.transcription import mesh
from impactopt.transcription.initial_guess import first_iterate, warm_start
from impactopt.transcription.mesh import NO_MORE, nodes_to_add


@pytest.mark.slow
def test_a_reference_that_goes_too_far_gets_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """And none where the term is switched off."""
    narrow = ReferenceRange(margin=1.9)
    monkeypatch.setattr(lazy_constraints, "_KINDS", {"reference_range": ReferenceRange})
    monkeypatch.setattr(problems, "ON_DEMAND_TERMS", (GearLoad(), narrow))
    kept = solve(arm_problem())
    assert kept.status.usable
    assert kept.summary()["rows_on_demand"] == ["reference_range"]
    assert reference_beyond(narrow, kept.plan) == ""
    off = ReferenceRange(margin=1.9, enabled=False)
    free = solve(replace(arm_problem(), terms=(*arm_problem().terms, off)))
    assert free.summary()["rows_on_demand"] == []
    assert re.search(r"reference of shoulder coasts 0\.00\d rad beyond", reference_beyond(narrow, free.plan))


@pytest.mark.parametrize(("collision", "freezes"), [("full", 0), ("sdc", 0), ("sdc", 2)])
def test_legs_are_bounded_where_the_reference_is_as_contact_ends(collision: str, freezes: int) -> None:
    """By the inverse kinematics of a base that coasts down, whose knees bend; in a program that gets the term
    after a first solution, too.
    """
    problem = replace(biped_problem(), collision=collision, freezes=freezes)
    plain = transcribed(replace(problem, terms=BODILESS))
    x, c, hit = first_iterate(plain), plain.coordinates, plain.expected
    y, legs = plain.contact_state[0].evaluate(x), plain.contact_legs.evaluate(x)
    rates = plain.u0.read(x)[0] - np.eye(c.ny)[2]
    plain.u0.write(x, rates)
    hit.guess_model(x, y, rates, legs)
    t = transcribed(replace(problem, terms=(*BODILESS, ReferenceRange())))
    x, *_ = warm_start(t, plain, x, np.zeros(plain.program.m), np.zeros(plain.program.n))
    end = c.solve_legs(y + rates * sum(t.expected.durations(x)), legs)
    origins, values = t.constraints.origins, t.program.constraints(x)
    place = {each.component: k for k, each in enumerate(origins) if each.term == ReferenceRange.name}
    assert np.abs(end - legs).max() > 0.2
    assert values[[place[label] for label in c.leg_labels]] == pytest.approx(end, abs=1e-4)


def test_a_leg_that_leaves_its_range_between_nodes_gets_nodes_there(
    monkeypatch: pytest.MonkeyPatch, biped_plan: Planned
) -> None:
    plan = biped_plan.plan
    robot, knee = plan.problem.robot, int(plan.coordinates.dependent[0])
    angles = robot.joint_positions(plan.reference.q)[plan.reference.phase == 0, knee]
    upper = robot.upper.copy()
    upper[knee] = np.quantile(angles, 0.9)
    known = set(nodes_to_add(plan, NO_MORE).swing)
    monkeypatch.setattr(mesh, "inside", lambda robot, margin: (robot.lower, upper))
    assert set(nodes_to_add(plan, NO_MORE).swing) > known


def test_joints_without_a_motor_have_no_reference() -> None:
    """As a hammer's soft grip, which is held by a spring."""
    robot = load_problem("nailing").robot
    grip = list(robot.joint_names).index("hammer_grip")
    lower, upper = ReferenceRange().limits(robot)
    assert lower[grip] == -np.inf and upper[grip] == np.inf
    assert np.isfinite(np.delete(lower, grip)).all()
