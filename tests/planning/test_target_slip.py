"""How far a striking point slides across the target: by hand, and told where it is far."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import pinocchio as pin
import pytest
from support.small_plans import BODILESS, arm_problem, transcribed

from impactopt import (
    FreeMass,
    GearLoad,
    HitRegion,
    Plan,
    Slide,
    SpringDamper,
    Status,
    Target,
    TargetSpeed,
    load_problem,
    solve,
)
from impactopt.kinematics.operational_space import across, striking_point
from impactopt.planning import lazy_constraints
from impactopt.planning.lazy_constraints import FAR, slide, slide_caution, slides_beyond
from impactopt.problem import problem as problems
from impactopt.simulation import scene_of
from impactopt.simulation.target_dynamics import TargetContact
from impactopt.solvers.ipopt import solve_ipopt
from impactopt.transcription.initial_guess import first_iterate


@pytest.fixture(scope="module")
def plan() -> Plan:
    t = transcribed(arm_problem())
    return t.decode(solve_ipopt(t.program, first_iterate(t)).x)


def test_a_slide_is_the_way_across_the_normal(plan: Plan) -> None:
    """Against the ends of the contact, which are the largest way of a short one; no way along the normal."""
    problem, model = plan.problem, plan.problem.robot.model
    data = model.createData()
    frame = model.getFrameId(problem.robot.striker(problem.striker).model_frame)
    ends = []
    for y in plan.through_contact(np.array([0.0, 1.0])):
        pin.framesForwardKinematics(model, data, plan.coordinates.join(y, np.zeros(0)))
        ends.append(np.array(data.oMf[frame].translation))
    way = ends[1] - ends[0]
    across = np.linalg.norm(way - (way @ problem.normal) * problem.normal)
    assert slide(problem, plan) == pytest.approx(across, rel=1e-6)
    turned = replace(problem, normal=way / np.linalg.norm(way))
    assert slide(turned, plan) < 0.1 * np.linalg.norm(way)


def test_a_bound_keeps_it_short(plan: Plan) -> None:
    """It is along each of two tangents, all the time that contact lasts."""
    most = 0.3 * slide(plan.problem, plan)
    t = transcribed(replace(plan.problem, terms=(*plan.problem.terms, Slide(most=most))))
    kept = t.decode(solve_ipopt(t.program, first_iterate(t)).x)
    model = kept.problem.robot.model
    data = model.createData()
    striker = kept.problem.robot.striker(kept.problem.striker).model_frame
    for y in kept.collision.motion[:, 0]:
        pin.framesForwardKinematics(model, data, kept.coordinates.join(y, np.zeros(0)))
        away = data.oMf[model.getFrameId(striker)].translation - kept.problem.point
        across_normal = away - (away @ kept.problem.normal) * kept.problem.normal
        assert np.linalg.norm(across_normal) < 1.001 * np.sqrt(2) * most
    assert slide(kept.problem, kept) < min(1.01 * np.sqrt(2) * most, slide(plan.problem, plan))
    assert 0.5 * plan.impulse < kept.impulse < plan.impulse


def test_only_a_long_slide_is_told() -> None:
    """The term is on by default, and in drafts: to name it alone would be no advice."""
    problem, two = arm_problem(), load_problem("push_two_hands")
    off = replace(problem, terms=(*problem.terms, Slide(enabled=False)))
    assert slide_caution(problem, FAR) == ""
    told = [slide_caution(p, 0.201) for p in (problem, off, two)]
    assert all("slides 201 mm" in text for text in told)
    assert "a smaller most_m in [terms.slide]" in told[0]
    assert "enabled = true in [terms.slide]" in told[1]
    assert "terms.slide" not in told[2]  # which is refused: it is for one striker


@pytest.mark.slow
def test_a_plan_that_slides_too_far_gets_rows(monkeypatch: pytest.MonkeyPatch, plan: Plan) -> None:
    """To the plan that rows from the start lead to; and none where it is switched off."""
    most = 0.3 * slide(plan.problem, plan)
    monkeypatch.setattr(lazy_constraints, "_KINDS", {"slide": Slide})
    monkeypatch.setattr(problems, "ON_DEMAND_TERMS", (GearLoad(), Slide(most=most)))
    kept = solve(plan.problem)
    assert kept.status.usable
    assert kept.summary()["rows_on_demand"] == ["slide"]
    assert slides_beyond(Slide(most=most), kept.plan) == ""
    free = solve(replace(plan.problem, terms=(*plan.problem.terms, Slide(most=most, enabled=False))))
    assert free.summary()["rows_on_demand"] == []
    assert "allowed" in slides_beyond(Slide(most=most), free.plan)
    assert free.problem.describe()["off"] == ["slide"]


def test_in_a_region_a_slide_begins_where_the_striker_hits() -> None:
    """Not at the middle of the region, which is farther away than a slide may be."""
    problem = arm_problem()
    region = HitRegion(size=(0.36, 0.02))
    aim = problem.point - np.array([0.17, 0.0, 0.0])
    problem = replace(problem, point=aim, terms=(*BODILESS, region))
    found = solve(problem, refine=False)
    assert found.status.usable and found.summary()["rows_on_demand"] == []
    ends = found.plan.closed(found.plan.through_contact(np.array([0.0, 1.0])))
    hit, end = (across(problem.normal) @ striking_point(problem.robot, "hand", q) for q in ends)
    assert np.abs(hit - across(problem.normal) @ aim).max() > 1.5 * Slide().most
    program = transcribed(replace(problem, terms=(*BODILESS, region, Slide()))).program
    rows = [i for i in range(program.m) if program.constraint_name(i).startswith("slide")]
    np.testing.assert_allclose(program.constraints(found.result.x)[rows[-2:]], end - hit, atol=1e-6)


def test_the_face_in_replays_is_beyond_the_region() -> None:
    """A slide from the region's edge stays on it."""
    problem, region = arm_problem(), HitRegion(size=(0.36, 0.02))
    tangent = across(problem.normal)[0]
    places = problem.point + np.outer([0.19, 0.37, 0.39], tangent) + 1e-3 * problem.normal
    for terms, on_it in ((BODILESS, [True, False, False]), ((*BODILESS, region), [True, True, False])):
        there = TargetContact(scene_of(replace(problem, terms=terms)))
        hit = [there.depths(place[None], 0.0)[0] > 0 for place in places]
        assert hit == on_it


@pytest.mark.slow
@pytest.mark.parametrize("kept_off", [False, True])
def test_a_target_that_is_met_again_is_told(kept_off: bool) -> None:
    """A plan for least energy lets the mass go on towards the arm, which stops there."""
    apart = TargetSpeed(least=-np.inf, most=np.inf)
    problem = replace(
        load_problem("arm_planar"),
        target=FreeMass(mass=5.0, initial_velocity=-3.0),
        law=SpringDamper(stiffness=1e5, damping=100.0),
        terms=(apart,) if kept_off else (),
    )
    solution = solve(problem)
    replay = solution.validate()
    caution = solution.summary(replay).get("caution", "")
    assert solution.status is Status.SOLVED
    assert ("meets the target again" in caution) is (len(replay.touches) > 1) is not kept_off
    if not kept_off:
        share = f": {replay.impulse:.3g} N s in a replay, {solution.impulse:.3g} N s as planned; "
        assert share in caution and replay.impulse > 10 * solution.impulse
        assert share not in solution.summary()["caution"]


@dataclass(frozen=True, kw_only=True)
class Sprung(Target):
    """A mass on a spring, which swings back after the impact."""

    mass: float
    stiffness: float

    n_states = 2
    results: ClassVar[tuple[str, ...]] = ("speed",)

    def velocity(self, state: Any, parameters: Any = None) -> Any:
        return state[0]

    def derivative(self, state: Any, force: Any, parameters: Any = None) -> list[Any]:
        p = parameters or self.parameters
        return [(force - p["stiffness"] * state[1]) / p["mass"], state[0]]

    def energy(self, state: Any, parameters: Any = None) -> Any:
        p = parameters or self.parameters
        return (p["mass"] * state[0] ** 2 + p["stiffness"] * state[1] ** 2) / 2

    def result(self, state: Any, parameters: Any = None) -> list[Any]:
        return [state[0]]


@pytest.mark.slow
@pytest.mark.parametrize("mass", [1.0, 20.0])
def test_a_target_that_swings_back_is_told(mass: float) -> None:
    """The planned impulse was half of the replayed one, without a word. A heavy one comes back late."""
    problem = replace(
        load_problem("arm_planar"),
        target=Sprung(mass=mass, stiffness=2e4),
        law=SpringDamper(stiffness=1e5, damping=100.0),
        terms=(TargetSpeed(least=-np.inf, most=np.inf),),  # which takes the speed for constant
    )
    solution = solve(problem)
    caution, touches = solution.summary().get("caution", ""), solution.validate().touches
    assert (len(touches) > 1) is (mass == 1.0)
    assert ("meets the target again" in caution) is (mass == 1.0)
    assert "terms.target_speed" not in caution, "it does not keep the hammer off a target on a spring"
