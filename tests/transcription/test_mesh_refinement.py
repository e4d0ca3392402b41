"""Limits between a program's nodes, and nodes that are added there."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from support.small_plans import BODILESS, Planned, changed
from support.term_cases import MILD

from impactopt import (
    AngularMomentum,
    ContactWrenchCone,
    Effort,
    FirstTouch,
    Grip,
    GroundForce,
    HitRegion,
    Impulse,
    InputError,
    Objective,
    Obstacle,
    PeakForce,
    Penetration,
    Phase,
    Plan,
    Scenario,
    Status,
    TargetBody,
    TargetEnergy,
    Term,
    TorqueLimit,
    TorqueRate,
)
from impactopt.kinematics.operational_space import static_wrenches
from impactopt.kinematics.splines import CubicSpline
from impactopt.planning import oracles
from impactopt.planning import solution as solutions
from impactopt.planning.solve import solve
from impactopt.problem.objectives import OBJECTIVES
from impactopt.problem.terms import DEFAULT_TERMS, TERMS
from impactopt.simulation.result import distance_inside
from impactopt.solvers.ipm import solve_ipm
from impactopt.transcription import mesh as between
from impactopt.transcription.initial_guess import first_iterate, warm_start
from impactopt.transcription.mesh import NO_MORE, MoreNodes, nodes_to_add
from impactopt.transcription.plan import complete_reference
from impactopt.transcription.transcription import Transcription

Array = NDArray[np.float64]


def forces(plan: Plan, curve: CubicSpline, places: Array) -> list[tuple[Array, Array]]:
    """q (nq) and tau (nv) of inverse dynamics without the ground, at places on [0, 1] of a spline."""
    c, model, out = plan.coordinates, plan.problem.robot.model, []
    legs = c.split(plan.problem.start_posture)[1]
    for y, yd, ydd in zip(*curve.sample(places * curve.duration), strict=True):
        legs = c.solve_legs(y, legs)
        q, v, a = c.complete_motion(y, yd, ydd, legs)
        out.append((q, pin.rnea(model, model.createData(), q, v, a).copy()))
    return out


def middles(nodes: Array) -> Array:
    return (nodes[1:] + nodes[:-1]) / 2


def with_term(plan: Plan, term: Any) -> Plan:
    return dataclasses.replace(plan, problem=dataclasses.replace(plan.problem, terms=(term,)))


def middles_of(nodes: Array, at: Array) -> tuple[float, ...]:
    """Middles of the intervals between nodes in which places lie."""
    first = np.searchsorted(nodes, at, side="right") - 1
    return tuple(middles(nodes)[np.unique(np.minimum(first, len(nodes) - 2))])


def each_millisecond(curve: CubicSpline) -> Array:
    return np.linspace(0.0, 1.0, round(curve.duration / 1e-3) + 1)


@pytest.mark.parametrize("fraction", [0.05, 0.1, 1.0])
def test_torques_between_nodes_by_inverse_dynamics(arm_plan: Planned, fraction: float) -> None:
    plan = with_term(arm_plan.plan, TorqueLimit(fraction=fraction))
    limit, expected = plan.problem.robot.torque_limit, []
    for curve, nodes in ((plan.swing, plan.swing_nodes), (plan.follow, plan.follow_nodes)):
        at = each_millisecond(curve)
        ratio = np.array([np.abs(tau / limit).max() for _, tau in forces(plan, curve, at)])
        expected.append(middles_of(nodes, at[ratio > 1.2 * fraction]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(between, "_MARGIN_LOSS", 0.0)
        patch.setattr(between, "_TORQUE_LOSS", 0.2 * fraction)
        assert nodes_to_add(plan, NO_MORE) == MoreNodes(*expected)
    assert bool(expected[0]) == (fraction < 1.0)
    assert nodes_to_add(plan, NO_MORE) == NO_MORE  # half of the room up to all that there is


def sole_wrenches(plan: Plan, phase: int) -> Array:
    """(k, soles, 6) in the soles' frames, at the instants of a phase: what each leg's torques leave to it."""
    c, ref, model = plan.coordinates, plan.trajectory(), plan.problem.robot.model
    data, at = model.createData(), ref.phase == phase
    out = []
    for q, v, a, torque in zip(ref.q[at], ref.v[at], ref.a[at], ref.torque[at], strict=True):
        lacking = pin.rnea(model, data, q, v, a)[c.base :] - torque
        jac = [pin.computeFrameJacobian(model, data, q, model.getFrameId(leg.frame)) for leg in c.legs]
        own = [(c.base + leg.joints, j) for leg, j in zip(c.legs, jac, strict=True)]
        out.append([np.linalg.solve(j[:, k].T, lacking[k - c.base]) for k, j in own])
    return np.array(out)


@pytest.mark.parametrize("margin", [0.0, 0.04])
def test_each_sole_between_nodes_by_its_legs_torques(biped_plan: Planned, margin: float) -> None:
    """Also where the ZMP of both is well inside their hull."""
    plan = with_term(biped_plan.plan, ContactWrenchCone(margin=margin, minimum_force=0.0, friction=5.0))
    soles, expected = plan.coordinates.soles, []
    for phase, curve, nodes in ((0, plan.swing, plan.swing_nodes), (2, plan.follow, plan.follow_nodes)):
        wrench = sole_wrenches(plan, phase)[: len(each_millisecond(curve))]
        cop = np.stack([-wrench[..., 4], wrench[..., 3]], axis=-1) / wrench[..., 2:3]
        inside = np.array([distance_inside(sole.polygon, cop[:, k]) for k, sole in enumerate(soles)])
        out = inside.min(axis=0) < min(margin / 2, margin - 1e-3)
        expected.append(middles_of(nodes, each_millisecond(curve)[out]))
    assert nodes_to_add(plan, NO_MORE) == MoreNodes(*expected)
    if margin == 0.04:
        assert expected[0] or expected[1]
    known = MoreNodes(swing=(0.123,), follow=(0.456,))
    assert nodes_to_add(plan, known).total == sum(map(len, expected)) + 2


def test_a_correction_between_nodes_is_shared_as_the_load_is(biped_plan: Planned) -> None:
    """A sole with a tenth of the load gets less of the correction, and its centre of pressure stays."""
    plan = biped_plan.plan
    c = plan.coordinates
    y, legs = c.split(plan.problem.start_posture)
    still, wrench = np.zeros((1, len(y))), static_wrenches(c, y, legs)[None]
    even = complete_reference(plan.problem, y[None], still, still, wrench, legs).sole_wrench
    moved, lean = even.copy(), np.array([0.0, 0.0, 0.8 * even[0, 8]])
    one, other = (leg.placement for leg in c.legs)  # level soles, side by side
    moved[0, 2], moved[0, 8] = even[0, 2] + lean[2], even[0, 8] - lean[2]
    moved[0, 3:6] -= one.rotation.T @ np.cross(one.translation - other.translation, lean)
    short = 0.97 * moved
    found = complete_reference(plan.problem, y[None], still, still, short, legs).sole_wrench
    gain = (found - short)[0, 2::6]
    assert 0 < gain[1] < 0.5 * gain[0]  # in even parts they are the same
    np.testing.assert_allclose(found[0, 9:11] / found[0, 8], moved[0, 9:11] / moved[0, 8], atol=5e-3)


def test_legs_between_nodes_keep_their_velocity_limits(biped_plan: Planned) -> None:
    """Their rates follow from the soles', so no control point bounds them."""
    plan = biped_plan.plan
    c, robot, places = plan.coordinates, plan.problem.robot, each_millisecond(plan.follow)
    legs, fastest = c.split(plan.problem.start_posture)[1], []
    for y, yd, ydd in zip(*plan.follow.sample(places * plan.follow.duration), strict=True):
        legs = c.solve_legs(y, legs)
        fastest.append(np.abs(c.complete_motion(y, yd, ydd, legs)[1][c.base + c.dependent]).max())
    limit = robot.velocity_limit.copy()
    limit[c.dependent] = 0.99 * np.max(fastest)
    slow = dataclasses.replace(plan.problem, robot=dataclasses.replace(robot, velocity_limit=limit))
    found = nodes_to_add(dataclasses.replace(plan, problem=slow), NO_MORE)
    assert found.follow == middles_of(plan.follow_nodes, places[[int(np.argmax(fastest))]])


def finer(t: Transcription) -> Transcription:
    nodes = MoreNodes(
        swing=tuple(middles(t.swing_nodes)[[1, -1]]), follow=tuple(middles(t.follow_nodes)[[0]])
    )
    return Transcription(t.problem, t.functions, nodes)


def test_a_program_with_more_nodes_starts_where_the_old_one_ended(biped_plan: Planned) -> None:
    old, result = biped_plan.transcription, biped_plan.result
    new = finer(old)
    assert len(new.swing_nodes) == len(old.swing_nodes) + 2
    assert len(new.follow_nodes) == len(old.follow_nodes) + 1
    x, y, z = warm_start(new, old, result.x, result.multipliers, result.bound_multipliers)
    plan = new.decode(x)
    np.testing.assert_array_equal(plan.swing.control, biped_plan.plan.swing.control)
    np.testing.assert_array_equal(plan.follow.control, biped_plan.plan.follow.control)
    # old constraints keep values and multipliers; new ones are met about as well as legs in between
    names = {str(row): i for i, row in enumerate(old.program.origins)}
    assert len(names) == old.program.m
    g, before = new.program.constraints(x), old.program.constraints(result.x)
    for i, row in enumerate(new.program.origins):
        k = names.pop(str(row), None)
        if k is None:
            assert y[i] == 0.0
            assert "0." in str(row) or "." in row.place.name, row
        else:
            assert g[i] == pytest.approx(before[k], abs=1e-9) and y[i] == result.multipliers[k], row
    assert not names
    off = np.maximum(new.program.g_lower - g, g - new.program.g_upper).max()
    assert off < 0.2
    assert np.count_nonzero(z) == np.count_nonzero(result.bound_multipliers)


def test_the_old_solution_is_a_warm_start(arm_plan: Planned) -> None:
    old = arm_plan.transcription
    first = solve_ipm(old.program, arm_plan.result.x)
    new = finer(old)
    x, y, z = warm_start(new, old, first.x, first.multipliers, first.bound_multipliers)
    again = solve_ipm(new.program, x, multipliers=y, bound_multipliers=z)
    assert again.status is Status.SOLVED
    assert again.objective == pytest.approx(first.objective, rel=0.02)


ON_TOP: dict[str, Objective | Term] = {
    "peak force": PeakForce(weight=-0.001),
    "energy": TargetEnergy(),
    "penetration": Penetration(weight=10.0),
    "effort": Effort(),
    **{term.name: term for term in MILD.values()},
}
KINDS = {type(thing) for thing in ON_TOP.values()} | {Impulse, AngularMomentum}


def test_all_objectives_and_extra_terms_are_tried_here() -> None:
    """The biped's test below has the angular momentum, and all about soles and the striking link. The small
    robots have no supporting hand: `Grip` has tests in tests/planning/test_supporting_hand.py.
    """
    assert {*OBJECTIVES, *TERMS} - {*map(type, DEFAULT_TERMS)} == KINDS | {Grip}


def with_more(t: Transcription, *things: Objective | Term, **changes: Any) -> Transcription:
    """Its program with objectives beside the impulse, and with terms."""
    objectives = tuple(o for o in things if isinstance(o, Objective))
    terms = tuple(term for term in things if isinstance(term, Term))
    return changed(t, objectives=(Impulse(), *objectives), terms=terms, **changes)


def check_carried_over(old: Transcription) -> None:
    """Each variable, constraint and multiplier of a program is in the finer one, at the same place."""
    new, rng = finer(old), np.random.default_rng(0)
    x = old.with_lifted(first_iterate(old) + 0.02 * rng.standard_normal(old.program.n))
    y, z = rng.standard_normal(old.program.m), rng.standard_normal(old.program.n)
    x = np.clip(x, old.layout.lower, old.layout.upper)  # as iterates are; what is lifted may be off by then
    there, of_rows, of_bounds = warm_start(new, old, x, y, z)
    places = {"swing": (old.swing_nodes, new.swing_nodes)}
    places |= dict.fromkeys(("follow", "abort"), (old.follow_nodes, new.follow_nodes))
    lifted = {group.name for group, *_ in old.builder.lifted}
    found = 0
    for name, group in old.layout.groups.items():
        mine = new.layout.groups[name]
        assert (
            (mine.count, mine.size) == (group.count, group.size)
            or group.size == 0
            or (name in lifted or name.endswith((" legs", " sole wrench")))
        )
        for k in range(group.count):
            now = k
            if mine.count != group.count:
                before, after = places[name.split()[0]]
                now = int(np.flatnonzero(after == before[k])[0])
            columns = [mine.labels.index(label) for label in group.labels]
            at = mine.index(now)[columns]
            if name not in lifted:
                np.testing.assert_allclose(there[at], x[group.index(k)], atol=1e-12)
            np.testing.assert_array_equal(of_bounds[at], z[group.index(k)])
            found += len(columns)
    assert found == old.program.n
    assert np.count_nonzero(of_bounds) == old.program.n, "what is new has none"
    np.testing.assert_allclose(there, np.clip(new.with_lifted(there), new.layout.lower, new.layout.upper))
    names = {str(row): i for i, row in enumerate(new.program.origins)}
    assert len(names) == new.program.m
    same = {names[str(row)]: i for i, row in enumerate(old.program.origins) if str(row) in names}
    if TorqueRate not in map(type, old.problem.terms):  # whose constraints connect neighbouring nodes
        assert len(same) == old.program.m
    np.testing.assert_array_equal(of_rows[list(same)], y[list(same.values())])
    assert np.count_nonzero(of_rows) == len(same)


@pytest.mark.slow
@pytest.mark.parametrize("name", ON_TOP)
def test_more_nodes_go_together_with(arm_transcription: Transcription, name: str) -> None:
    """The finer program has what the old one had where it was, and is solved from there in fewer steps."""
    old = with_more(arm_transcription, ON_TOP[name])
    check_carried_over(old)
    first = solve_ipm(old.program, first_iterate(old))
    assert first.status is Status.SOLVED
    new = finer(old)
    x, y, z = warm_start(new, old, first.x, first.multipliers, first.bound_multipliers)
    again = solve_ipm(new.program, x, multipliers=y, bound_multipliers=z)
    assert again.status is Status.SOLVED and again.iterations < first.iterations
    assert again.objective == pytest.approx(first.objective, rel=0.02)
    for o, quantity in new.objectives:
        assert quantity.evaluate(again.x) == pytest.approx(old.achieved(first.x)[o.name], rel=0.05)


def test_more_nodes_go_together_with_everything_on_two_legs(biped_transcription: Transcription) -> None:
    """Also with a second way to rest, which has nodes of its own."""
    check_carried_over(
        with_more(
            biped_transcription,
            *(thing for name, thing in ON_TOP.items() if name in ("peak force", "energy", "effort")),
            AngularMomentum(),
            TorqueRate(limit=500.0),
            HitRegion(radius=0.1),
            GroundForce(),
            FirstTouch(),
            scenarios=(Scenario(name="gone", missing=True, abort_after=0.02),),
        )
    )


@pytest.fixture
def coarse(arm_transcription: Transcription, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A problem whose torques are a little over their limit between the nodes, where nothing is given up."""
    monkeypatch.setattr(solutions, "block_functions", lambda *_: arm_transcription.functions)
    monkeypatch.setattr(between, "_MARGIN_LOSS", 0.0)
    monkeypatch.setattr(between, "_TORQUE_LOSS", 1e-6)
    return dataclasses.replace(
        arm_transcription.problem,
        swing=Phase(duration=0.4, intervals=6),
        follow=Phase(duration=0.35, intervals=6),
        terms=(TorqueLimit(fraction=0.15, collision=0.15), *BODILESS),
    )


@pytest.mark.slow
def test_solve_adds_nodes_where_they_are_missing(coarse: Any) -> None:
    plain, better = solve(coarse, refine=False), solve(coarse)
    assert plain.status is better.status is Status.SOLVED
    assert plain.nodes == NO_MORE and better.nodes.total > 0
    over = [
        max(s.plan.margins()["torque_ratio"][phase] for phase in ("swing", "follow")) - 0.15
        for s in (plain, better)
    ]
    assert over[0] > 1.5 * over[1]
    assert better.impulse == pytest.approx(plain.impulse, rel=1e-3)
    assert [a.kept for a in better.attempts] == [False] * (len(better.attempts) - 1) + [True]
    assert better.attempts[0].iterations == plain.result.iterations < better.result.iterations
    steps = [record.iteration for record in better.result.history]
    assert steps == sorted(steps) and steps[-1] == better.result.iterations
    assert better.summary()["nodes_added"] == better.nodes.total
    # a neighbour starts with the same nodes
    moved = dataclasses.replace(coarse, point=np.asarray(coarse.point) - np.array([0.0, 0.0, 0.005]))
    again = solve(moved, start=better)
    assert again.status is Status.SOLVED and set(again.nodes.swing) >= set(better.nodes.swing)


def test_nodes_are_added_where_effort_counts(
    coarse: Any, arm_transcription: Transcription, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each node's effort is a variable, so there are more of them then."""
    objectives = (Impulse(), Effort(weight=0.1))
    functions = changed(arm_transcription, objectives=objectives).functions
    monkeypatch.setattr(solutions, "block_functions", lambda *_: functions)
    solution = solve(dataclasses.replace(coarse, objectives=objectives))
    assert solution.status is Status.SOLVED and solution.nodes.total > 0
    assert len(solution.attempts) > 1 and solution.attempts[-1].kept


def test_nodes_and_clearance_constraints_are_added_together(coarse: Any) -> None:
    """In one attempt, as a motion whose bodies are in each other is no answer yet."""
    post = Obstacle(name="post", start=(0.65, 0.14, 0.85), end=(0.65, 0.34, 0.85), radius=0.03)
    none = TargetBody(shape="none")  # before it the arm is nowhere over its limits
    near = dataclasses.replace(coarse, terms=coarse.terms[:1], body=none, obstacles=(post,))
    solution = solve(near)
    assert solution.status is Status.SOLVED and solution.nodes.total > 0 and solution.clearance_constraints
    assert [attempt.kept for attempt in solution.attempts] == [True]


@pytest.mark.slow
def test_bodies_that_are_near_at_the_start_are_kept_apart(
    coarse: Any, arm_transcription: Transcription, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A clean motion is found from a start at which bodies are near. Where none is found with them, one is
    sought without them first; and what would do in place of a post at the hit point is named.
    """
    objectives = (Impulse(), Effort(weight=0.1))
    functions = changed(arm_transcription, objectives=objectives).functions
    monkeypatch.setattr(solutions, "block_functions", lambda *_: functions)
    problem = dataclasses.replace(coarse, objectives=objectives, terms=coarse.terms[:1])
    solution = solve(problem)
    assert solution.status is Status.SOLVED and solution.clearance()["contacts_besides"] == []
    assert solution.result.iterations == solution.result.history[-1].iteration
    # what no way leads out of says what is in the way
    post = Obstacle(name="post", size=(0.1, 0.1, 0.1), position=tuple(problem.point))
    told: list[str] = []
    barred = solve(dataclasses.replace(problem, obstacles=(post,)), report=told.append)
    assert barred.status is Status.INFEASIBLE
    assert any("solving without them first" in line for line in told)
    assert "post" in barred.result.message or barred.causes


def test_a_solution_that_keeps_its_limits_is_the_plain_one(coarse: Any) -> None:
    fine = dataclasses.replace(coarse, terms=(TorqueLimit(fraction=0.5),))
    solution = solve(fine)
    assert solution.nodes == NO_MORE and len(solution.attempts) == 1


def test_a_plan_that_cannot_be_checked_is_not_lost(coarse: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def unreachable(*_: Any) -> MoreNodes:
        raise InputError("a leg does not reach")

    monkeypatch.setattr(oracles, "nodes_to_add", unreachable)
    assert solve(coarse).status is Status.SOLVED
