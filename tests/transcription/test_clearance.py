"""Rows that keep bodies apart: chains against Pinocchio, slopes against differences, plans with them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from support.derivative_checks import check_derivatives
from support.small_plans import BODILESS, changed, rod_hammer
from support.small_robots import arm, biped, parallelogram, table

from impactopt import (
    ImpactProblem,
    KeepOut,
    Obstacle,
    Plan,
    Robot,
    SelfCollision,
    Solution,
    Status,
    Term,
    g1,
    load_problem,
    solve,
    standin,
    talos,
)
from impactopt.bodies import separation
from impactopt.bodies.clearance import Places
from impactopt.bodies.separation import ROUNDING, THIN
from impactopt.bodies.world import WorldBody
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.planning.budget import Budget
from impactopt.planning.clearance_constraints import (
    Margins,
    Watch,
    clearance_violations,
    deepest_penetration,
    node_placements,
    solve_with_clearance,
)
from impactopt.planning.parameter_changes import parameter_of
from impactopt.planning.refinement import Evaluation, Guess
from impactopt.planning.solution import program_on
from impactopt.transcription.clearance import Chain, ClearanceKey, chain_between
from impactopt.transcription.initial_guess import first_iterate
from impactopt.transcription.transcription import Transcription, block_functions

Array = NDArray[np.float64]
APART = (SelfCollision(), KeepOut())


def taken(chain: Chain, z: Array, numbers: Array, x: Array) -> Array:
    """Where a chain takes a point (3,), from its last frame to its first."""
    n = len(chain.columns)
    places, turns = numbers[: 12 * (n + 1)].reshape(-1, 12), numbers[12 * (n + 1) :]

    def placed(place: Array, x: Array) -> Array:
        return place[:9].reshape(3, 3) @ x + place[9:]

    x = placed(places[n], x)
    for k in reversed(range(n)):
        x = pin.utils.rotate("z", z[3 + k]) @ x if turns[k] else x + np.array([0.0, 0.0, z[3 + k]])
        x = placed(places[k], x)
    return np.asarray(x + z[:3])


# ---- chains


@dataclasses.dataclass
class Posed:
    """A robot in a configuration, as a program's coordinates say it and as Pinocchio does."""

    robot: Robot
    c: StanceCoordinates
    both: Array  # y, legs, and the displacement of the target (3,) behind them
    data: Any

    @classmethod
    def at_random(cls, robot: Robot, posture: str, soles: tuple[str, ...], seed: int) -> Posed:
        c = StanceCoordinates(robot, tuple(robot.sole(s) for s in soles), robot.posture(posture))
        both = np.random.default_rng(seed).uniform(-1.2, 1.2, c.ny + c.nl + 3)
        data = robot.model.createData()
        pin.forwardKinematics(robot.model, data, c.join(both[: c.ny], both[c.ny : -3]))
        return cls(robot, c, both, data)

    def z(self, chain: Chain, body: WorldBody | None) -> Array:
        out = np.zeros(3 + len(chain.columns))
        slots, columns, factors = chain.pattern(self.c, body)
        np.add.at(out, slots, factors * self.both[columns])
        return out

    def joint(self, rng: Any) -> int:
        return int(rng.integers(1, self.robot.model.njoints))


ROBOTS: dict[str, tuple[Callable[[], Robot], str, tuple[str, ...]]] = {
    "arm": (arm, "start", ()),
    "parallelogram": (parallelogram, "start", ()),
    "slides": (lambda: table(2.0, postures={"start": {}}), "start", ()),
    "biped": (biped, "half_sitting", ("left", "right")),
    "on one leg": (biped, "half_sitting", ("left",)),
    "stand-in": (standin, "half_sitting", ("left", "right")),
    "talos": (talos, "half_sitting", ("left", "right")),
    "g1": (g1, "half_sitting", ("left", "right")),
}


@pytest.mark.parametrize("name", ROBOTS)
def test_a_chain_takes_a_point_to_where_pinocchio_does(name: str) -> None:
    """From a link to another's frame, and to that of a body of the world; also from and to the base."""
    make, posture, soles = ROBOTS[name]
    robot, rng = make(), np.random.default_rng(0)
    for seed in range(3):
        posed = Posed.at_random(robot, posture, soles, seed)
        pairs = [(posed.joint(rng), posed.joint(rng)) for _ in range(6)]
        pairs += [(posed.joint(rng), 1), (1, posed.joint(rng))]
        worlds = [(posed.joint(rng), 0) for _ in range(3)] + [(1, 0)]
        for one, other in (*((a, b) for a, b in pairs if a != b), *worlds):
            centre, place = rng.uniform(-0.3, 0.3, 3), pin.SE3.Random()
            body = WorldBody(
                name="body",
                half=np.ones(3),
                place=place.translation,
                rotation=place.rotation,
                moves=bool(seed % 2),
            )
            chain = chain_between(robot.model, one, other)
            assert chain.base == (robot.floating and other == 0)
            if other:
                z, before, frame = posed.z(chain, None), None, posed.data.oMi[other]
            else:
                z, before = posed.z(chain, body), place.inverse()
                frame = pin.SE3(place.rotation, place.translation + posed.both[-3:] * body.moves)
            there = frame.actInv(posed.data.oMi[one].act(centre))
            np.testing.assert_allclose(taken(chain, z, chain.parameters(before), centre), there, atol=1e-9)


def test_only_the_joints_between_two_links_are_in_their_chain() -> None:
    robot = biped()
    c = StanceCoordinates(robot, (robot.sole("left"), robot.sole("right")), robot.posture("half_sitting"))
    names = {name: robot.model.getJointId(name) for name in robot.model.names}
    chain = chain_between(robot.model, names["elbow"], names["left knee"])
    columns = {robot.model.joints[names[n]].idx_v for n in ("shoulder pitch", "shoulder yaw", "elbow")}
    columns |= {robot.model.joints[names[f"left hip {n}"]].idx_v for n in ("yaw", "roll", "pitch")}
    columns |= {robot.model.joints[names["left knee"]].idx_v}
    assert set(chain.columns) == columns and not chain.base
    assert len(chain.placements) == len(chain.columns) + 1
    slots, coordinates, _ = chain.pattern(c)
    assert sorted(slots) == list(range(3, 3 + len(columns)))
    assert sum(k >= c.ny for k in coordinates) == 4, "the leg's are not free"


# ---- programs


def margins_of(t: Transcription, terms: tuple[Term, ...] = APART) -> Margins:
    return Margins(dataclasses.replace(t.problem, terms=terms))


@pytest.fixture(scope="module")
def programs(
    arm_transcription: Transcription, biped_transcription: Transcription
) -> dict[str, tuple[Transcription, Array]]:
    """Those of the small robots with rows between all that is nearer than 20 cm, and a point a little off."""
    out = {}
    for name, shared in (("arm", arm_transcription), ("biped", biped_transcription)):
        bare = changed(shared)
        x, rng = first_iterate(bare), np.random.default_rng(0)
        rows = Watch(bare, margins_of(bare), x).constraints(0.2)
        t = bare.with_clearance(rows)
        out[name] = t, x + 0.02 * rng.standard_normal(t.program.n)
    return out


@pytest.mark.parametrize("name", ["arm", "biped"])
def test_slopes_of_programs_with_such_rows_agree_with_differences(programs: Any, name: str) -> None:
    t, x = programs[name]
    assert len(t.clearance_constraints) > 20 and any(row.other < 0 for row in t.clearance_constraints)
    assert name == "arm" or any(row.other >= 0 for row in t.clearance_constraints)
    check_derivatives(t.program, x)


@pytest.mark.parametrize("name", ["arm", "biped"])
def test_constraints_say_how_far_bodies_are_apart_at_their_places(programs: Any, name: str) -> None:
    """By coal, whose distance theirs is less by what is rounded; where bodies are in each other, at most."""
    t, x = programs[name]
    names = [t.program.constraint_name(i) for i in range(t.program.m)]
    g, spots, bodies = t.program.constraints(x), node_placements(t, x), t.problem.bodies
    for row, held in t.clearance_constraints.items():
        k = spots.names.index(row.place)
        one, two = pieces(bodies, row)
        at = [coal.Transform3s(*bodies.placement(spots.at, k, body)) for body in (row.joint, row.other)]
        apart = coal.distance(one, at[0], two, at[1], coal.DistanceRequest(), coal.DistanceResult())
        what = " and ".join(bodies.names((row.joint, row.other)))
        term = SelfCollision.name if row.other >= 0 else KeepOut.name
        (i,) = [i for i, text in enumerate(names) if text == f"{term}, {row.place}, {what}"]
        most = THIN + 1e-6
        assert g[i] + held.least_distance <= apart + most, names[i]
        if apart > 1e-3:
            assert g[i] + held.least_distance >= apart - 10e-3, names[i]
        assert t.program.g_lower[i] == 0 and t.program.g_upper[i] == np.inf
        told, by = t.program.describe_violation(i, x, 0.012)
        assert told.startswith(term) and told.endswith(what) and by == "12 mm too near"
    assert len(t.clearance_constraints) == t.program.m - len(without(t).program.origins)


def pieces(bodies: Any, row: ClearanceKey) -> tuple[Any, Any]:
    """As coal has them."""
    if row.other < 0:
        return bodies.links.of_joint[row.joint][row.number].shape, bodies.world[-1 - row.other].shape
    one, two = bodies.pairs[row.joint, row.other][row.number]
    return one.shape, two.shape


def test_a_program_stays_as_it_is_when_one_with_more_rows_is_made_of_it(
    arm_transcription: Transcription,
) -> None:
    t = changed(arm_transcription)
    x = first_iterate(t)
    more = t.with_clearance(Watch(t, margins_of(t), x).constraints(0.2))
    assert more.program.m > t.program.m
    for program in (more.program, t.program):
        check_derivatives(program, x + 0.01)


def test_a_program_with_such_rows_takes_the_numbers_of_another_problem(
    arm_transcription: Transcription,
) -> None:
    bare = changed(arm_transcription)
    rows = Watch(bare, margins_of(bare), first_iterate(bare)).constraints(0.2)
    problem = bare.problem
    other = parameter_of(problem, "contact.stiffness").at(1.3 * problem.law.parameters["stiffness"])
    moving, whole = (
        program_on(p, bare.nodes, bare.hit.elements, bare.hit.shares).with_clearance(rows)
        for p in (problem, other)
    )
    assert moving.program.m > bare.program.m
    assert not moving.program.same_parameters(whole.program)
    moving.move_to(other)
    assert moving.program.same_parameters(whole.program)


def without(t: Transcription) -> Transcription:
    return t.with_clearance({})


def test_margins_are_less_where_bodies_are_near_at_the_start(arm_transcription: Transcription) -> None:
    problem = arm_transcription.problem
    margins, bodies = margins_of(arm_transcription, (SelfCollision(margin=0.5), KeepOut())), problem.bodies
    start = Places.of(problem.robot, problem.start_posture[None], np.zeros(1, dtype=np.intp))
    for pair in bodies.pairs:
        apart = bodies.exact(start, 0, pair)
        assert margins.of(pair) == pytest.approx(min(0.5, 0.25 * apart))
    for j, w in bodies.world_pairs:
        assert margins.of((j, -1 - w)) <= KeepOut().margin


def test_constraints_are_met_at_the_start(biped_transcription: Transcription) -> None:
    """Its back stands 2 mm before a wall, which is less than rounding takes."""
    free = biped_transcription.problem
    root = free.robot.model.getJointId("root")
    at = Places.of(free.robot, free.start_posture[None], np.zeros(1, dtype=np.intp))
    back = at.translation[0, root] + at.rotation[0, root] @ (-0.092 - 0.05, -0.01, 0.25)
    wall = Obstacle(name="wall", size=(0.1, 1.0, 0.1), position=tuple(back))
    t = changed(biped_transcription, obstacles=(wall,))
    margins, pair = margins_of(t), (root, -1 - [body.name for body in t.problem.world].index("wall"))
    assert 0 < margins.bodies.exact(at, 0, pair) < 3e-3
    x = first_iterate(t)
    rows = Watch(t, margins, x).constraints()
    assert any(row[1:3] == pair for row in rows)
    shapes = margins.bodies.shapes
    gaps = shapes.look(margins.bodies.placed(at), 1.0, np.zeros((1, len(shapes), 3)), margins.wanted).gaps[0]
    for row, held in rows.items():
        assert gaps[shapes.index[row[1:]]] > held.least_distance, row


@pytest.mark.parametrize("compiled", [True, False])
def test_gaps_are_bounded_by_how_far_bodies_have_moved(
    biped_transcription: Transcription, compiled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By their gaps in another posture: never too large, and exact where bodies may have met."""
    if not compiled:
        monkeypatch.setattr(separation, "_library", lambda: None)
    margins, problem = margins_of(biped_transcription), biped_transcription.problem
    bodies, shapes, model = margins.bodies, margins.bodies.shapes, problem.robot.model
    turns = np.random.default_rng(5).uniform(-1, 1, (20, model.nv))
    # five postures each that differ by less than a micrometre, a little, much, and altogether
    turns *= np.repeat([1e-6, 0.01, 0.3, 1.0], 5)[:, None]

    def placed(turns: Array, travel: float) -> Any:
        q = np.array([pin.integrate(model, problem.start_posture, turn) for turn in turns])
        moved = np.tile(travel * problem.normal, (20, 1))
        return bodies.placed(Places.of(problem.robot, q, np.zeros(20, dtype=np.intp), moved))

    one, two = placed(0.0 * turns, 0.0), placed(turns, 0.03)
    directions = np.zeros((20, len(shapes), 3))
    before = shapes.look(one, np.inf, directions, margins.wanted)
    exact = shapes.look(two, np.inf, directions.copy(), margins.wanted)
    found = shapes.look(two, 0.0, directions.copy(), margins.wanted, (one, before))
    # bounds of balls are of sharp hulls, whose distances exceed those of rounded ones
    assert (found.gaps <= exact.gaps + 2 * ROUNDING * np.log(100)).all()
    inside = exact.gaps < 0
    assert inside.any() and np.array_equal(found.gaps[inside], exact.gaps[inside])


def test_only_what_is_switched_off_is_not_kept_apart(biped_transcription: Transcription) -> None:
    x = first_iterate(biped_transcription)
    for terms, own, world in (
        ((), True, True),
        (APART, True, True),
        (BODILESS[:1], False, True),
        (BODILESS[1:], True, False),
        (BODILESS, False, False),
    ):
        problem = dataclasses.replace(biped_transcription.problem, terms=terms)
        assert problem.keeps_apart == (own or world)
        rows = Watch(biped_transcription, Margins(problem), x).constraints(1.0)
        assert any(row.other < 0 for row in rows) == world
        assert any(row.other >= 0 for row in rows) == own


# ---- plans


def passing(problem: ImpactProblem, plan: Plan) -> float:
    """The least distance [m] of any two bodies on a plan's way by coal alone, < 0 in each other."""
    bodies, robot = problem.bodies, problem.robot
    motion, data = plan.motion(plan.trajectory(step=4e-3)), robot.model.createData()
    least = np.inf
    pieces = bodies.links.of_joint
    for q, moved in zip(motion.q, motion.displacement, strict=True):
        pin.forwardKinematics(robot.model, data, q)
        for a, b in bodies.pairs:
            for one in pieces[a]:
                for two in pieces[b]:
                    least = min(least, _apart(one.shape, data.oMi[a], two.shape, data.oMi[b]))
        for j, w in bodies.world_pairs:
            body = bodies.world[w]
            place = pin.SE3(body.rotation, body.place + moved * body.moves)
            for one in pieces[j]:
                least = min(least, _apart(one.shape, data.oMi[j], body.shape, place))
    return least


def _apart(one: Any, at_one: Any, two: Any, at_two: Any) -> float:
    places = [coal.Transform3s(np.array(m.rotation), np.array(m.translation)) for m in (at_one, at_two)]
    return float(coal.distance(one, places[0], two, places[1], coal.DistanceRequest(), coal.DistanceResult()))


BAR = Obstacle(name="bar", start=(0.6, -0.2, 1.04), end=(0.6, 0.2, 1.04), radius=0.02)


@pytest.fixture(scope="module")
def free() -> Solution:
    return solve(dataclasses.replace(load_problem("arm_planar"), style="strongest"))


@pytest.fixture(scope="module")
def barred(free: Solution) -> Solution:
    return solve(dataclasses.replace(free.problem, obstacles=(BAR,)))


@pytest.mark.slow
def test_a_plan_goes_around_what_is_in_its_way(free: Solution, barred: Solution) -> None:
    """Without the bar it goes where that would be, and so it does if the problem says that it may."""
    assert free.status is barred.status is Status.SOLVED
    assert passing(free.problem, free.plan) > 0
    assert passing(barred.problem, free.plan) < -0.02
    assert passing(barred.problem, barred.plan) > 0
    assert barred.clearance_constraints and barred.problem.hash != free.problem.hash
    ignoring = solve(dataclasses.replace(barred.problem, terms=(*barred.problem.terms, *BODILESS)))
    assert ignoring.status is Status.SOLVED
    assert not ignoring.clearance_constraints
    assert passing(barred.problem, ignoring.plan) < -0.02


def test_a_neighbour_starts_with_the_same_rows(barred: Solution) -> None:
    point = np.asarray(barred.problem.point) + np.array([0.0, 0.0, 0.005])
    moved = solve(dataclasses.replace(barred.problem, point=point), start=barred)
    assert moved.status is Status.SOLVED and passing(moved.problem, moved.plan) > 0
    assert set(moved.clearance_constraints) >= set(barred.clearance_constraints)


@pytest.mark.slow
def test_a_solution_is_a_start_in_another_world_too(free: Solution, barred: Solution) -> None:
    """Whose bodies are others, or none."""
    again = solve(free.problem, start=barred)
    assert again.status is Status.SOLVED and passing(free.problem, again.plan) > 0
    post = dataclasses.replace(BAR, name="post", start=(0.9, 0.0, 0.5), end=(0.9, 0.0, 1.2))
    more = dataclasses.replace(barred.problem, obstacles=(post, BAR))
    again = solve(more, start=barred)
    assert again.status is Status.SOLVED and passing(more, again.plan) > 0


def program_of(solution: Solution, problem: ImpactProblem) -> Transcription:
    return Transcription(problem, block_functions(problem), solution.nodes).with_clearance(
        solution.clearance_constraints
    )


@pytest.mark.slow
def test_a_solution_that_touches_something_is_told_and_mended(free: Solution, barred: Solution) -> None:
    problem, x = barred.problem, free.result.x
    margins, t = Margins(problem), program_of(free, problem)
    violated = clearance_violations(Evaluation(t, x), margins)
    assert violated is not None and 0.02 < violated.depth < 0.1
    bar = -1 - [body.name for body in problem.bodies.world].index("bar")
    assert {other for _, other in violated.nearest} == {bar}
    assert clearance_violations(Evaluation(program_of(barred, problem), barred.result.x), margins) is None
    depth, pairs = deepest_penetration(t, x, margins)
    assert 0 < depth <= violated.depth + 1e-9 and {other for _, other in pairs} == {bar}
    budget = Budget(solver="ipm", options=None, time_limit=None, callback=None)
    fixed = solve_with_clearance(budget, margins, Guess(program=t, start=free.result))
    assert fixed.result.status is Status.SOLVED
    assert deepest_penetration(fixed.program, fixed.result.x, margins)[0] <= 0


@pytest.mark.slow
def test_constraints_enter_before_bodies_can_touch(free: Solution) -> None:
    """From a start that is nowhere near the bar, at an iterate at which bodies are apart."""
    free = solve(rod_hammer(free.problem))
    barred = solve(dataclasses.replace(free.problem, obstacles=(BAR,)))
    problem = barred.problem
    margins, t = Margins(problem), program_of(free, problem).with_clearance({})
    x = first_iterate(t)
    watch = Watch(t, margins, x)
    bar = -1 - [body.name for body in problem.bodies.world].index("bar")
    step = free.result.x - x  # into the bar
    part = watch.limit(x, step, 1.0)
    assert 0 < part < 1
    there = x + part * step
    assert watch.lacks(there)
    assert deepest_penetration(t, there, margins)[0] <= 0 < deepest_penetration(t, free.result.x, margins)[0]
    rows = watch.constraints()
    assert bar in {row.other for row in rows} and not watch.lacks(there)
