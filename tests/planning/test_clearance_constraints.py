"""Rounds against bodies that are too near between places: each adds a node, or asks a place for more."""

from __future__ import annotations

import dataclasses
import re
from itertools import pairwise
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from support.small_plans import rod_hammer

from impactopt import (
    FreeMass,
    GainFactor,
    Ground,
    ImpactProblem,
    KeepOut,
    Obstacle,
    SelfCollision,
    Solution,
    SpringDamper,
    Status,
    load_problem,
    load_solution,
    solve,
)
from impactopt.bodies.clearance import Places
from impactopt.planning import oracles
from impactopt.planning.budget import Budget
from impactopt.planning.clearance_constraints import (
    Margins,
    Watch,
    clearance_violations,
    node_placements,
    same_bodies,
)
from impactopt.planning.oracles import BetweenNodes
from impactopt.planning.refinement import Evaluation, Guess, Outcome
from impactopt.planning.solve import PlanSolver
from impactopt.solvers.program import max_violation
from impactopt.transcription.initial_guess import warm_start
from impactopt.transcription.transcription import Transcription, block_functions

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def free() -> Solution:
    """A planar arm's blow, with few nodes: its hammer goes 5 cm from one to the next."""
    problem = rod_hammer(load_problem("arm_planar"))
    swing = dataclasses.replace(problem.swing, intervals=6)
    return solve(dataclasses.replace(problem, swing=swing, style="strongest"))


def with_peg(problem: ImpactProblem, x: float, z: float) -> ImpactProblem:
    peg = Obstacle(name="peg", start=(x, -0.2, z), end=(x, 0.2, z), radius=0.005)
    return dataclasses.replace(problem, obstacles=(peg,))


def program_of(solution: Solution, problem: ImpactProblem) -> Transcription:
    return Transcription(problem, block_functions(problem), solution.nodes).with_clearance(
        solution.clearance_constraints
    )


def hammer(solution: Solution, time: float) -> Array:
    """Where the hammer's face is at a time [s]."""
    motion, robot = solution.plan.motion(), solution.problem.robot
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, motion.q[int(np.abs(motion.time - time).argmin())])
    return np.array(data.oMf[robot.model.getFrameId("striker:hammer")].translation)


def violation(t: Transcription, x: Array) -> float:
    return max_violation(t.program, x, t.program.constraints(x))


def test_starts_with_other_links_on_the_ground_have_other_bodies() -> None:
    """Their clearance constraints have the same keys for other links: a warm start ended in a KeyError."""
    problem = load_problem("arm_planar")

    def on_ground(start: list[float]) -> tuple[ImpactProblem, list[str]]:
        def above(floor: float) -> tuple[ImpactProblem, dict[str, float]]:
            there = dataclasses.replace(problem, start=start, ground=Ground(height=floor))
            at = Places.of(problem.robot, np.array([start]), np.zeros(1, dtype=np.intp))
            bodies = there.bodies
            return there, {bodies.links.name(j): bodies.exact(at, 0, (j, -1)) for j in bodies.links.joints}

        there, gaps = above(-2.0 + min(above(-2.0)[1].values()) + 1e-4)
        return there, [name for name, gap in gaps.items() if gap <= 0]

    (one, by_wrist), (other, by_elbow) = on_ground([-0.07, 2.03, 1.65]), on_ground([2.3, -1.56, 0.05])
    assert (by_wrist, by_elbow) == (["wrist"], ["elbow"])
    assert not same_bodies(one, other)
    assert same_bodies(one, dataclasses.replace(one, point=one.point + np.array([0.0, 0.0, 0.01])))


def test_stances_with_other_intervals_have_constraints_at_other_nodes() -> None:
    """A warm start with the constraints of a step's other grading ended in a KeyError."""
    problem = load_problem("punch_step")
    first, *rest = problem.stances
    assert first.phase is not None
    graded = dataclasses.replace(first, phase=dataclasses.replace(first.phase, grading=2.0))
    assert not same_bodies(problem, dataclasses.replace(problem, stances=(graded, *rest)))
    assert same_bodies(
        problem, dataclasses.replace(problem, point=problem.point + np.array([0.0, 0.0, 0.01]))
    )


def test_bodies_that_are_near_at_the_start_may_not_penetrate_more_than_their_rounded_shapes() -> None:
    """Rounded shapes of bodies 1 mm apart penetrate; these were allowed to, by 2 mm, and so were refused."""
    problem = load_problem("arm_planar")

    def beside(place: float) -> tuple[Margins, float]:
        wall = Obstacle(name="wall", size=(2.0, 0.1, 2.0), position=(0.5, place, 0.8))
        margins = Margins(dataclasses.replace(problem, obstacles=(wall,)))
        bodies = margins.bodies
        (number,) = [-1 - k for k, body in enumerate(bodies.world) if body.name == "wall"]
        at = Places.of(problem.robot, problem.start_posture[None], np.zeros(1, dtype=np.intp))
        return margins, min(bodies.exact(at, 0, (joint, number)) for joint in bodies.links.joints)

    margins, distance = beside(1.0 - beside(1.0)[1] + 1e-3)
    assert distance == pytest.approx(1e-3, abs=1e-6)
    shapes, none = margins.bodies.shapes, np.zeros((1, len(margins.bodies.shapes), 3))
    at = Places.of(problem.robot, problem.start_posture[None], np.zeros(1, dtype=np.intp))
    found = shapes.look(margins.bodies.placed(at), 0.1, none, margins.wanted)
    gap, required = found.gap.min(), margins.pieces[found.pair[found.gap.argmin()]]
    assert gap < 0 and gap - distance < required < gap


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.35, 0.5, 0.65])
def test_every_look_finds_what_is_violated_there_or_a_node(free: Solution, share: float) -> None:
    """Pegs in the hammer's way, between any two nodes of the swing: near ones, and such as it passes by with
    centimetres to spare at both.
    """
    nodes, looked = free.plan.swing_nodes * free.plan.swing.duration, 0
    for first, last in pairwise(nodes[4:-1]):
        x, _, z = hammer(free, first + share * (last - first))
        problem = with_peg(free.problem, x, z)
        margins, t = Margins(problem), program_of(free, problem)
        violated = clearance_violations(Evaluation(t, free.result.x), margins)
        assert violated is not None and violated.depth > 0
        if violated.nodes == t.nodes:
            rows = {**Watch(t, margins, free.result.x).constraints(), **violated.constraints}
            assert violation(t.with_clearance(rows), free.result.x) > 1e-3
        else:
            functions = block_functions(problem)
            finer = Transcription(problem, functions, violated.nodes)
            there, _, _ = warm_start(finer, t, free.result.x, np.zeros(t.program.m), np.zeros(t.layout.n))
            rows = Watch(finer, margins, there).constraints()
            known = set(node_placements(t, free.result.x).names)
            assert any(row.place not in known for row in rows)
            assert violation(finer.with_clearance(rows), there) > 1e-3
        looked += 1
    assert looked > 3


@pytest.mark.slow
@pytest.mark.parametrize(("interval", "warm"), [(9, True), (10, False)], ids=["warm", "from its solution"])
def test_rounds_end_with_bodies_that_are_apart(
    free: Solution, interval: int, warm: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A peg that the hammer meets only between two nodes, near the nail: no round begins where all its rows
    are met already.

    warm : the solutions' multipliers lead to the next one; else these guesses fail, and others follow.
    """
    if not warm:
        monkeypatch.setattr(oracles, "_ITERATIONS_WARM", 5)
    first, last = free.plan.swing_nodes[interval : interval + 2] * free.plan.swing.duration
    x, _, z = hammer(free, 0.35 * first + 0.65 * last)
    problem, began, solved = with_peg(free.problem, x, z), list[float](), oracles.solve_with_clearance

    def watched(budget: Budget, margins: Margins, guess: Guess[Transcription]) -> Outcome[Transcription]:
        t = guess.program
        rows = {**Watch(t, margins, guess.x).constraints(), **t.clearance_constraints}
        began.append(violation(t.with_clearance(rows), guess.x))
        return solved(budget, margins, guess)

    monkeypatch.setattr(oracles, "solve_with_clearance", watched)
    solution = solve(problem)
    assert solution.status is Status.SOLVED and solution.nodes.total > 0
    assert solution.clearance()["clearance_mm"] > 0 and not solution.clearance()["contacts_besides"]
    assert began and min(began) > 1e-3


def test_a_result_that_touches_nothing_goes_before_a_later_one_that_does(free: Solution) -> None:
    x, _, z = hammer(free, 0.9 * free.plan.swing.duration)
    problem = with_peg(free.problem, x, z)
    later = dataclasses.replace(free.result, iterations=1000)
    budget = Budget(solver="ipm", options=None, time_limit=None, callback=None)
    budget.stop.asked = True  # so nothing is added
    between, found = BetweenNodes(budget, Margins(problem)), Outcome.of(program_of(free, problem), later)
    assert between.refined(found).result.status is Status.FAILED
    before = between._clear = Outcome.of(program_of(free, free.problem), free.result)
    kept = between.refined(found)
    assert kept.program is before.program
    assert kept.result.status is Status.SOLVED and kept.result.iterations == 1000


def test_a_limit_of_iterations_that_nobody_has_set_is_no_answer(free: Solution) -> None:
    ended = dataclasses.replace(free.result, status=Status.ITERATION_LIMIT)
    for options, stuck in ((None, True), ({"max_iterations": 5}, False)):
        budget = Budget(solver="ipm", options=options, time_limit=None, callback=None)
        assert PlanSolver(budget=budget, margins=None, refined=True)._stuck(ended) is stuck


@pytest.mark.slow
@pytest.mark.parametrize("gains", [(), (GainFactor(joints=["elbow"], factor=(0.5, 2.0)),)])
def test_a_plan_that_loses_most_of_a_clearance_is_not_called_solved(gains: tuple[GainFactor, ...]) -> None:
    """The hammer's face goes to 9 mm above this floor, and may not: it drives the nail 6 mm into it."""
    problem = load_problem("arm_planar")
    terms = (*problem.terms, KeepOut(margin=0.05))
    found = solve(dataclasses.replace(problem, ground=Ground(height=0.735), terms=terms, gains=gains))
    assert found.clearance()["clearance_mm"] < 25
    assert found.status is not Status.SOLVED
    assert re.search(r"wrist and ground .* instead of 50 \(\[terms.keep_out\] margin_m", found.result.message)


def test_a_lost_clearance_of_two_links_names_its_section(free: Solution) -> None:
    problem = dataclasses.replace(free.problem, terms=(*free.problem.terms, SelfCollision(margin=2.0)))
    budget, margins = Budget(solver="ipm", options=None, time_limit=None, callback=None), Margins(problem)
    budget.stop.asked = True  # so nothing is added
    # as far as in a start posture that is stretched out
    margins._required = {pair: 2.0 for pair in map(tuple, margins.bodies.shapes.pairs) if pair[1] >= 0}
    found = BetweenNodes(budget, margins).refined(Outcome.of(program_of(free, problem), free.result)).result
    assert found.status is Status.ACCEPTABLE and "[terms.self_collision] margin_m" in found.message


@pytest.mark.slow
def test_bodies_keep_apart_during_a_long_contact(tmp_path: Path) -> None:
    """A shove of 0.8 s, in which a link other than the striker would enter the target."""
    problem = dataclasses.replace(
        load_problem("arm7"),
        target=FreeMass(mass=80.0),
        law=SpringDamper(stiffness=1500.0, damping=12.0),
        contact_duration=(0.0, 0.5),
    )
    solution = solve(problem)
    assert solution.status is Status.SOLVED and solution.nodes.contact
    assert solution.clearance()["clearance_mm"] > 0 and not solution.clearance()["contacts_besides"]
    replayed = solution.validate()
    assert replayed.impulse == pytest.approx(solution.impulse, rel=6e-3)
    solution.save(tmp_path / "shove")
    again = load_solution(tmp_path / "shove")
    assert again.nodes == solution.nodes
    np.testing.assert_array_equal(again.result.x, solution.result.x)
