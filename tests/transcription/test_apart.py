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
from support.small_plans import BODILESS, changed
from support.small_robots import arm, biped, table

from impactopt import KeepOut, Obstacle, SelfCollision, load_problem, solve
from impactopt.bodies.clearance import Places
from impactopt.bodies.fit import PLANES, Planes
from impactopt.bodies.robot_bodies import bodies_of
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.planning.keeping_apart import BEAD, Margins, rounded_most, rows_near, spots_of
from impactopt.planning.solution import Solution
from impactopt.planning.too_near import missing_rows, rows_to_add
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import Term
from impactopt.robots.presets import g1, standin, talos
from impactopt.robots.robot import Robot
from impactopt.solvers.program import Status
from impactopt.transcription.apart import LENGTHS, ROUND, ApartRow, Chain, Held, apart, chain_between
from impactopt.transcription.plan import Plan
from impactopt.transcription.start import first_iterate
from impactopt.transcription.structured import derivative_functions
from impactopt.transcription.transcription import Transcription, block_functions

Array = NDArray[np.float64]
APART = (SelfCollision(), KeepOut())
LEVELS = int(np.log2(PLANES))  # at which two of what is left of the planes pass into each other
ROUNDED = LEVELS * ROUND / 2  # [m] at most
BY_LENGTH: dict[int, Any] = {}


def gap(chain: Chain, z: Array, p: Any) -> float:
    """A row's value [m]."""
    n = chain.length
    if n not in BY_LENGTH:
        b = apart(n)
        BY_LENGTH[n] = derivative_functions(f"apart{n}", b.z, b.p, b.out, b.through)[0]
    return float(BY_LENGTH[n](z, np.concatenate([np.ravel(x) for x in p])))


# ---- chains


@dataclasses.dataclass
class Posed:
    """A robot in a configuration, as a program's coordinates say it and as Pinocchio does."""

    robot: Robot
    c: StanceCoordinates
    both: Array  # y, and legs behind them
    data: Any

    @classmethod
    def at_random(cls, robot: Robot, posture: str, soles: tuple[str, ...], seed: int) -> Posed:
        c = StanceCoordinates(robot, tuple(robot.sole(s) for s in soles), robot.posture(posture))
        both = np.random.default_rng(seed).uniform(-1.2, 1.2, c.ny + c.nl)
        data = robot.model.createData()
        pin.forwardKinematics(robot.model, data, c.join(both[: c.ny], both[c.ny :]))
        return cls(robot, c, both, data)

    def z(self, chain: Chain, rotation: Array | None) -> Array:
        out = np.zeros(3 + chain.length)
        slots, columns, factors = chain.pattern(self.c, rotation)
        np.add.at(out, slots, factors * self.both[columns])
        return out

    def joint(self, rng: Any) -> int:
        return int(rng.integers(1, self.robot.model.njoints))


ROBOTS: dict[str, tuple[Callable[[], Robot], str, tuple[str, ...]]] = {
    "arm": (arm, "start", ()),
    "slides": (lambda: table(2.0, postures={"start": {}}), "start", ()),
    "biped": (biped, "half_sitting", ("left", "right")),
    "on one leg": (biped, "half_sitting", ("left",)),
    "stand-in": (standin, "half_sitting", ("left", "right")),
    "talos": (talos, "half_sitting", ("left", "right")),
    "g1": (g1, "half_sitting", ("left", "right")),
}


def along(direction: Array) -> Array:
    """A row's planes, all of which say how far a point is along a direction (3,)."""
    return np.concatenate([np.tile(direction, PLANES), np.zeros(PLANES)])


@pytest.mark.parametrize("name", ROBOTS)
def test_a_chain_takes_a_point_to_where_pinocchio_does(name: str) -> None:
    """From a link to another's frame, and to that of a body of the world; also from and to the base."""
    make, posture, soles = ROBOTS[name]
    robot, rng = make(), np.random.default_rng(0)
    directions = np.eye(3)
    for seed in range(3):
        posed = Posed.at_random(robot, posture, soles, seed)
        pairs = [(posed.joint(rng), posed.joint(rng)) for _ in range(6)]
        pairs += [(posed.joint(rng), 1), (1, posed.joint(rng))]
        worlds = [(posed.joint(rng), 0) for _ in range(3)] + [(1, 0)]
        for one, other in (*((a, b) for a, b in pairs if a != b), *worlds):
            centre, body = rng.uniform(-0.3, 0.3, 3), pin.SE3.Random()
            chain = chain_between(robot.model, one, other)
            assert chain.length in LENGTHS and chain.base == (robot.floating and other == 0)
            if other:
                z, before, frame = posed.z(chain, None), None, posed.data.oMi[other]
            else:
                z, before, frame = posed.z(chain, body.rotation), body.inverse(), body
            there = frame.actInv(posed.data.oMi[one].act(centre))
            found = [gap(chain, z, (chain.numbers(before), centre, along(d), 0.1)) for d in directions]
            np.testing.assert_allclose(np.array(found) + 0.1 - ROUNDED, there, atol=1e-9)


def test_only_the_joints_between_two_links_are_in_their_chain() -> None:
    robot = biped()
    c = StanceCoordinates(robot, (robot.sole("left"), robot.sole("right")), robot.posture("half_sitting"))
    names = {name: robot.model.getJointId(name) for name in robot.model.names}
    chain = chain_between(robot.model, names["elbow"], names["left knee"])
    columns = {robot.model.joints[names[n]].idx_v for n in ("shoulder pitch", "shoulder yaw", "elbow")}
    columns |= {robot.model.joints[names[f"left hip {n}"]].idx_v for n in ("yaw", "roll", "pitch")}
    columns |= {robot.model.joints[names["left knee"]].idx_v}
    assert set(chain.columns) == columns and not chain.base
    assert len(chain.places) == len(chain.columns) + 1
    slots, coordinates, _ = chain.pattern(c)
    assert sorted(slots) == list(range(3, 3 + len(columns)))
    assert sum(k >= c.ny for k in coordinates) == 4, "the leg's are not free"


@pytest.mark.parametrize("name", ["arm", "biped", "talos"])
def test_a_row_says_what_planes_and_sphere_do(name: str) -> None:
    """But for where planes meet, where it is more by what they are rounded by."""
    make, posture, soles = ROBOTS[name]
    robot, rng = make(), np.random.default_rng(1)
    bodies = bodies_of(robot)
    seen = 0.0
    for seed in range(20):
        posed = Posed.at_random(robot, posture, soles, seed)
        sphere = int(rng.integers(len(bodies.joint)))
        one, other = int(bodies.joint[sphere]), int(rng.choice(bodies.joints))
        if one == other:
            continue
        chain, planes = chain_between(robot.model, one, other), bodies.planes[other]
        reach = float(bodies.radius[sphere]) + 0.01
        numbers = (chain.numbers(), bodies.centre[sphere], planes.with_facing(None), reach)
        value = gap(chain, posed.z(chain, None), numbers)
        there = posed.data.oMi[other].actInv(posed.data.oMi[one].act(bodies.centre[sphere]))
        far = planes.normal @ there - planes.offset
        assert value == pytest.approx(rounded_most(far) - reach, abs=1e-12)
        more = value - (float(far.max()) - reach)
        assert -1e-12 <= more <= ROUNDED
        seen = max(seen, more)
    assert seen > 0


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
        rows = rows_near(bare, x, margins_of(bare), 0.2)
        t = bare.with_apart(rows)
        out[name] = t, x + 0.02 * rng.standard_normal(t.program.n)
    return out


@pytest.mark.parametrize("name", ["arm", "biped"])
def test_slopes_of_programs_with_such_rows_agree_with_differences(programs: Any, name: str) -> None:
    t, x = programs[name]
    held = [h.facing is not None for h in t.apart_rows.values()]
    assert len(held) > 20 and any(held) and not all(held)
    check_derivatives(t.program, x)


@pytest.mark.parametrize("name", ["arm", "biped"])
def test_rows_say_how_far_spheres_and_planes_are_apart_at_their_places(programs: Any, name: str) -> None:
    t, x = programs[name]
    names = [t.program.row_name(i) for i in range(t.program.m)]
    g, spots, bodies = t.program.constraints(x), spots_of(t, x), t.problem.bodies
    looked = 0
    for row, held in t.apart_rows.items():
        k = spots.names.index(row.place)
        expected = value_of(bodies, spots.at, k, row, held)
        what = " and ".join(bodies.names((row.joint, row.other)))
        term = SelfCollision.name if row.other >= 0 else KeepOut.name
        of_row = [i for i, text in enumerate(names) if text == f"{term}, {row.place}, {what}"]
        (i,) = of_row
        assert -1e-9 <= g[i] - expected <= ROUNDED, names[i]
        assert t.program.g_lower[i] == 0 and t.program.g_upper[i] == np.inf
        looked += 1
        told, by = t.program.describe_violation(i, x, 0.012)
        assert told.startswith(term) and told.endswith(what) and by == "12 mm too near"
    assert looked == len(t.apart_rows) == t.program.m - len(without(t).program.origins)


def test_a_program_stays_as_it_is_when_one_with_more_rows_is_made_of_it(
    arm_transcription: Transcription,
) -> None:
    t = changed(arm_transcription)
    x = first_iterate(t)
    more = t.with_apart(rows_near(t, x, margins_of(t), 0.2))
    assert more.program.m > t.program.m
    for program in (more.program, t.program):
        check_derivatives(program, x + 0.01)


def without(t: Transcription) -> Transcription:
    return t.with_apart({})


def value_of(bodies: Any, at: Places, k: int, row: ApartRow, held: Held) -> float:
    """max n . x - h less reach [m], by Pinocchio's placements."""
    turn, place = bodies.placement(at, k, row.joint)
    centre = turn @ np.array(held.centre) + place
    planes: Planes = bodies.links.planes[row.other] if row.other >= 0 else bodies.world[-1 - row.other].planes
    turn, place = bodies.placement(at, k, row.other)
    if row.other < 0:  # rows know where the target was when they were made
        body = bodies.world[-1 - row.other]
        place = body.place + held.travel * bodies.normal * body.moves
    there = (centre - place) @ turn
    known = planes.with_facing(held.facing)
    normal, offset = known[: 3 * PLANES].reshape(-1, 3), known[3 * PLANES :]
    return float((normal @ there - offset).max()) - held.reach


@pytest.mark.parametrize("name", ["arm", "biped"])
def test_a_row_that_knows_the_hulls_is_their_distance_where_it_was_made(
    name: str, request: pytest.FixtureRequest
) -> None:
    """Less the margin; not where the two are in each other, of which other planes tell too."""
    t: Transcription = request.getfixturevalue(f"{name}_transcription")
    x, margins = first_iterate(t), margins_of(t)
    spots, looked = spots_of(t, x), 0
    for row, held in rows_near(t, x, margins, 0.2).items():
        pair, k = margins.bodies.known(row.joint, row.other), spots.names.index(row.place)
        apart = margins.bodies.exact(spots.at, k, pair)
        value = value_of(margins.bodies, spots.at, k, row, held)
        if held.facing is not None and apart > 0:
            assert held.reach == pytest.approx(BEAD + margins.of(pair))
            assert value == pytest.approx(apart - margins.of(pair), abs=1e-6)
            looked += 1
        elif apart > 0:
            assert value <= apart - margins.of(pair) + 2e-3
    assert looked > 3


def test_margins_are_less_where_bodies_are_near_at_the_start(arm_transcription: Transcription) -> None:
    problem = arm_transcription.problem
    margins, bodies = margins_of(arm_transcription, (SelfCollision(margin=0.5), KeepOut())), problem.bodies
    start = Places.of(problem.robot, problem.start_posture[None], np.zeros(1), np.zeros(1, dtype=np.intp))
    for pair in bodies.pairs:
        apart = bodies.exact(start, 0, pair)
        assert margins.of(pair) == pytest.approx(min(0.5, 0.25 * apart))
    for j, w in bodies.world_pairs:
        assert margins.of((j, -1 - w)) <= KeepOut().margin


def test_rows_of_spheres_are_met_at_the_start(biped_transcription: Transcription) -> None:
    """Its back stands 2 mm before a wall, and the spheres of the trunk stick out by centimetres."""
    free = biped_transcription.problem
    root = free.robot.model.getJointId("root")
    at = Places.of(free.robot, free.start_posture[None], np.zeros(1), np.zeros(1, dtype=np.intp))
    back = at.translation[0, root] + at.rotation[0, root] @ (-0.092 - 0.05, -0.01, 0.25)
    wall = Obstacle(name="wall", size=(0.1, 1.0, 0.1), position=tuple(back))
    t = changed(biped_transcription, obstacles=(wall,))
    margins, pair = margins_of(t), (root, -1 - [body.name for body in t.problem.world].index("wall"))
    assert 0 < margins.bodies.exact(at, 0, pair) < 3e-3
    spheres = {r: h for r, h in rows_near(t, first_iterate(t), margins).items() if h.facing is None}
    assert any(row[1:3] == pair for row in spheres)
    for row, held in spheres.items():
        assert value_of(margins.bodies, at, 0, row, held) > 0, row


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
        rows = rows_near(biped_transcription, x, Margins(problem), 1.0)
        assert any(row.other < 0 for row in rows) == world
        assert any(row.other >= 0 for row in rows) == own


# ---- plans


def passing(problem: ImpactProblem, plan: Plan) -> float:
    """The least distance [m] of any two bodies on a plan's way by coal alone, < 0 in each other."""
    bodies, robot = problem.bodies, problem.robot
    motion, data = plan.motion(4e-3), robot.model.createData()
    least = np.inf
    pieces = bodies.links.of_joint
    for q, travel in zip(motion.q, motion.travel, strict=True):
        pin.forwardKinematics(robot.model, data, q)
        for a, b in bodies.pairs:
            for one in pieces[a]:
                for two in pieces[b]:
                    least = min(least, _apart(one.shape, data.oMi[a], two.shape, data.oMi[b]))
        for j, w in bodies.world_pairs:
            body = bodies.world[w]
            place = pin.SE3(body.rotation, body.place + travel * problem.normal * body.moves)
            for one in pieces[j]:
                least = min(least, _apart(one.shape, data.oMi[j], body.shape, place))
    return least


def _apart(one: Any, at_one: Any, two: Any, at_two: Any) -> float:
    places = [coal.Transform3s(np.array(m.rotation), np.array(m.translation)) for m in (at_one, at_two)]
    return float(coal.distance(one, places[0], two, places[1], coal.DistanceRequest(), coal.DistanceResult()))


BAR = Obstacle(name="bar", start=(0.6, -0.2, 1.04), end=(0.6, 0.2, 1.04), radius=0.02)


@pytest.fixture(scope="module")
def free() -> Solution:
    return solve(load_problem("arm_planar"))


@pytest.fixture(scope="module")
def barred(free: Solution) -> Solution:
    return solve(dataclasses.replace(free.problem, obstacles=(BAR,)))


def test_a_plan_goes_around_what_is_in_its_way(free: Solution, barred: Solution) -> None:
    """Without the bar it goes where that would be, and so it does if the problem says that it may."""
    assert free.status is barred.status is Status.SOLVED
    assert passing(free.problem, free.plan) > 0
    assert passing(barred.problem, free.plan) < -0.02
    assert passing(barred.problem, barred.plan) > 0
    assert barred.apart and barred.problem.hash != free.problem.hash
    ignoring = solve(dataclasses.replace(barred.problem, terms=(*barred.problem.terms, *BODILESS)))
    assert ignoring.status is Status.SOLVED
    assert not ignoring.apart
    assert passing(barred.problem, ignoring.plan) < -0.02


def test_a_neighbour_starts_with_the_same_rows(barred: Solution) -> None:
    point = np.asarray(barred.problem.point) + np.array([0.0, 0.0, 0.005])
    moved = solve(dataclasses.replace(barred.problem, point=point), start=barred)
    assert moved.status is Status.SOLVED and passing(moved.problem, moved.plan) > 0
    assert set(moved.apart) >= set(barred.apart)


def test_a_solution_is_a_start_in_another_world_too(free: Solution, barred: Solution) -> None:
    """Whose bodies are others, or none."""
    again = solve(free.problem, start=barred)
    assert again.status is Status.SOLVED and passing(free.problem, again.plan) > 0
    post = dataclasses.replace(BAR, name="post", start=(0.9, 0.0, 0.5), end=(0.9, 0.0, 1.2))
    more = dataclasses.replace(barred.problem, obstacles=(post, BAR))
    again = solve(more, start=barred)
    assert again.status is Status.SOLVED and passing(more, again.plan) > 0


def program_of(solution: Solution, problem: ImpactProblem) -> Transcription:
    c = problem.coordinates
    return Transcription(problem, c, block_functions(problem, c), solution.nodes).with_apart(solution.apart)


def test_rows_are_added_where_a_solution_touches_something(free: Solution, barred: Solution) -> None:
    problem, x = barred.problem, free.result.x
    margins, t = Margins(problem), program_of(free, problem)
    violated = rows_to_add(t, x, margins)
    assert violated is not None and 0.02 < violated.depth < 0.1
    bar = -1 - [body.name for body in problem.bodies.world].index("bar")
    assert {row.other for row in violated.rows} == {bar}
    spots = {row.place for row in violated.rows}
    assert spots <= set(spots_of(t, x).names)
    here = missing_rows(t, x, margins)
    assert here and {row.other for row in here} == {bar} and {row.place for row in here} <= spots
    assert all(held.facing is not None for held in here.values())
    # what has them already is asked for more, by rows of their own
    again = missing_rows(t.with_apart(here), x, margins)
    assert {row[:3] for row in again} == {row[:3] for row in here}
    assert {row.number for row in again} == {row.number + 1 for row in here}
    assert rows_to_add(program_of(barred, problem), barred.result.x, margins) is None
