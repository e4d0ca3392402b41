"""Bodies of robots and of the world: what stands for them, against exact geometry and closed forms."""

from __future__ import annotations

import dataclasses
import gc
import os
import re
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.spatial import ConvexHull
from support import urdfs
from support.small_plans import arm_problem, biped_problem

from impactopt import (
    Board,
    FreeMass,
    ImpactProblem,
    InputError,
    KeepOut,
    Nail,
    Obstacle,
    RigidWall,
    Robot,
    TargetBody,
    Tool,
    g1,
    load_problem,
    planar_arm,
    standin,
    talos,
)
from impactopt.bodies.clearance import FAR, MISSED, SLACK, Bodies, Places
from impactopt.bodies.convex_hulls import Piece, inertia_box, pieces_of
from impactopt.bodies.file_shapes import lost_meshes
from impactopt.bodies.robot_bodies import bodies_of, distance
from impactopt.bodies.world import BEHIND, WorldBody, face_axes, ground_body, obstacle_bodies, target_bodies
from impactopt.files.draft.drafting import draft_problem
from impactopt.simulation.collision_geometry import FLOOR
from impactopt.simulation.engines import solids_of

Array = NDArray[np.float64]
EXACT = 1e-6  # [m] of coal's distances
IDENTITY = coal.Transform3s.Identity()


def at(place: Array) -> Any:
    return coal.Transform3s(np.eye(3), np.asarray(place, dtype=float))


# ---- pieces


@pytest.mark.parametrize("make", [pytest.param(g1, marks=pytest.mark.slow), talos])
def test_hulls_are_about_what_pinocchio_reads(make: Callable[[], Robot]) -> None:
    """Between shapes there is never less than between their hulls, but where polygons stand for circles."""
    robot = make()
    assert robot.urdf is not None
    folders = [str(folder) for folder in Path(robot.urdf).resolve().parents]
    geometry = pin.buildGeomFromUrdf(
        robot.model, robot.urdf, pin.GeometryType.COLLISION, package_dirs=folders
    )
    pieces, source = pieces_of(robot)
    assert "collision" in source
    model, data = robot.model, robot.model.createData()
    by_link: dict[str, list[Any]] = {}
    for piece in pieces:
        by_link.setdefault(piece.link, []).append(piece)
    theirs: dict[str, list[Any]] = {}
    for thing in geometry.geometryObjects:
        theirs.setdefault(model.frames[thing.parentFrame].name, []).append(thing)
    shared = [link for link in theirs if link in by_link]
    assert len(shared) >= 0.9 * len(theirs)
    for link in shared:
        assert {p.joint for p in by_link[link]} == {t.parentJoint for t in theirs[link]}
    rng, looked = np.random.default_rng(0), 0
    while looked < 25:
        q = pin.randomConfiguration(model, *_box(robot))
        pin.forwardKinematics(model, data, q)
        one, two = rng.choice(shared, 2, replace=False)
        if by_link[one][0].joint == by_link[two][0].joint:
            continue
        hulls = min(
            distance(a.shape, _placed(data, a.joint), b.shape, _placed(data, b.joint))
            for a in by_link[one]
            for b in by_link[two]
        )
        exact = min(
            distance(
                a.geometry,
                _coal(data.oMi[a.parentJoint] * a.placement),
                b.geometry,
                _coal(data.oMi[b.parentJoint] * b.placement),
            )
            + _sagitta(a.geometry)
            + _sagitta(b.geometry)
            for a in theirs[one]
            for b in theirs[two]
        )
        if hulls > 0:
            assert exact >= hulls - 2 * EXACT, (one, two)  # both are coal's
        looked += 1


def _sagitta(shape: Any) -> float:
    """How far [m] a cylinder of 20 sides, or a sphere of 16 and 8, is inside the round one."""
    if isinstance(shape, coal.Cylinder):
        return float(shape.radius * (1 - np.cos(np.pi / 20)))
    return float(shape.radius * (1 - np.cos(np.pi / 16) ** 2)) if isinstance(shape, coal.Sphere) else 0.0


def _box(robot: Robot) -> tuple[Array, Array]:
    """Ranges of configurations, a free base within a metre."""
    low, high = np.array(robot.model.lowerPositionLimit), np.array(robot.model.upperPositionLimit)
    if robot.floating:
        low[:7], high[:7] = -1.0, 1.0
    return np.maximum(low, -3.0), np.minimum(high, 3.0)


def _coal(place: Any) -> Any:
    return coal.Transform3s(np.array(place.rotation), np.array(place.translation))


def _placed(data: Any, joint: int) -> Any:
    return _coal(data.oMi[joint])


def test_a_robot_without_shapes_has_boxes_of_inertia() -> None:
    robot = standin()
    pieces, source = pieces_of(robot)
    assert "inertia" in source and {p.joint for p in pieces} == set(range(1, robot.model.njoints))
    for piece in pieces:
        assert piece.link == robot.model.names[piece.joint]


@pytest.mark.parametrize("sides", [(0.1, 0.2, 0.3), (0.3, 0.29, 0.05), (0.02, 0.5, 0.1)])
def test_the_box_of_inertia_is_the_box_that_has_it(sides: tuple[float, float, float]) -> None:
    turn = pin.rpy.rpyToMatrix(0.3, -0.2, 0.5)
    body = pin.SE3(turn, np.array([0.1, 0.2, 0.3])).act(pin.Inertia.FromBox(2.0, *sides))
    local = (inertia_box(body).vertices - body.lever) @ turn
    np.testing.assert_allclose(local.max(axis=0), np.array(sides) / 2, rtol=1e-6)
    np.testing.assert_allclose(local.min(axis=0), -np.array(sides) / 2, rtol=1e-6)


def test_the_box_of_an_inertia_that_stands_for_none_is_no_lighter_than_foam() -> None:
    """10 g with 0.001 kg m2, as many files have, would fill 0.8 m, and be in the way of any motion."""
    box = inertia_box(pin.Inertia(0.01, np.array([0.1, 0.0, 0.0]), 1e-3 * np.eye(3))).vertices
    np.testing.assert_allclose(np.ptp(box, axis=0), 0.1, rtol=1e-6)
    np.testing.assert_allclose((box.max(axis=0) + box.min(axis=0)) / 2, [0.1, 0.0, 0.0], atol=1e-9)


def test_a_capsule_is_a_body(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Its length is that of its line, as in Drake and newer versions of the format."""
    text, path = urdfs.arm(), tmp_path / "arm.urdf"
    round_ = text.replace('<box size="0.08 0.08 0.3"/>', '<capsule radius="0.04" length="0.22"/>')
    assert round_ != text
    path.write_text(round_)
    pieces = bodies_of(Robot.from_urdf(path, floating=False, armature=0.01)).pieces
    size = next(np.ptp(piece.vertices, axis=0) for piece in pieces if piece.link == "elbow_link")
    assert size == pytest.approx([0.08, 0.08, 0.3], abs=1e-3)
    assert capfd.readouterr().err == ""


def test_shapes_beside_tags_of_other_tools_are_bodies(tmp_path: Path) -> None:
    """With prefixes that no one declares, as many exporters write."""
    path, sizes = tmp_path / "arm.urdf", []
    for more in ("", '<drake:collision_filter_group name="hand"/>'):
        path.write_text(urdfs.arm().replace("</robot>", f"{more}</robot>"))
        robot = Robot.from_urdf(path, floating=False, armature=0.01)
        sizes.append({piece.link: np.ptp(piece.vertices, axis=0) for piece in bodies_of(robot).pieces})
    assert sizes[0].keys() == sizes[1].keys()
    assert all(sizes[1][link] == pytest.approx(sizes[0][link]) for link in sizes[0])


def test_a_disc_of_many_corners_is_a_body(tmp_path: Path) -> None:
    """The fan of triangles on its face has one corner in all of them, more than coal counts."""
    turn = np.linspace(0.0, 2 * np.pi, 900, endpoint=False)
    rim = np.stack([0.05 * np.cos(turn), 0.05 * np.sin(turn)], axis=1)
    points = np.vstack([np.column_stack([rim, np.full(900, z)]) for z in (-0.01, 0.01)])
    faces = ConvexHull(points).simplices
    text = "\n".join(
        [*(f"v {x} {y} {z}" for x, y, z in points), *(f"f {a} {b} {c}" for a, b, c in faces + 1)]
    )
    (tmp_path / "disc.obj").write_text(text)
    plain = urdfs.arm()
    shape = re.search(r'<link name="wrist_link">.*?</inertial>', plain, re.DOTALL)
    assert shape is not None
    disc = '<collision><geometry><mesh filename="disc.obj"/></geometry></collision>'
    (tmp_path / "robot.urdf").write_text(plain.replace(shape[0], shape[0] + disc))
    robot = Robot.from_urdf(tmp_path / "robot.urdf", floating=False)
    (found,) = (p for p in pieces_of(robot)[0] if p.link == "wrist_link" and len(p.vertices) > 100)
    wide = np.linalg.norm(found.vertices[:, :2], axis=1)
    assert wide.max() == pytest.approx(0.05) and wide.min() > 0.0499
    assert found.shape.num_points == len(found.vertices)


def test_a_tool_is_a_rod_to_its_head() -> None:
    hammer = Tool.hammer(frame="elbow", name="second")
    bare, tool = planar_arm(), dataclasses.replace(hammer, bar=None)
    robot = bare.with_tool(tool)
    for link in ("elbow", "wrist"):  # whose boxes are without it
        (with_it,), (without,) = ([p for p in pieces_of(r)[0] if p.link == link] for r in (robot, bare))
        np.testing.assert_allclose(with_it.vertices, without.vertices, atol=1e-9)
    rod = next(p for p in pieces_of(robot)[0] if p.link == tool.name)
    frame = robot.model.frames[robot.model.getFrameId(tool.frame)]
    assert rod.joint == frame.parentJoint
    ends = np.array([frame.placement.translation, frame.placement.act(np.array(tool.head))])
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    reach = (rod.vertices - ends[0]) @ along
    assert reach.min() == pytest.approx(0.0, abs=1e-9)
    assert reach.max() == pytest.approx(np.linalg.norm(ends[1] - ends[0]), abs=1e-9)
    off = rod.vertices - ends[0] - np.outer(reach, along)
    assert np.linalg.norm(off, axis=1).max() == pytest.approx(0.012, abs=1e-9)


# ---- how far all are apart


def scenes() -> dict[str, Callable[[], ImpactProblem]]:
    return {
        "arm": arm_problem,
        "biped": biped_problem,
        "punch": lambda: load_problem("punch"),
        "one foot": lambda: load_problem("punch_one_foot"),
    }


def random_places(problem: ImpactProblem, count: int) -> Places:
    """Half of them near the start, all within limits."""
    robot, rng = problem.robot, np.random.default_rng(0)
    low, high = _box(robot)
    start = problem.start_posture
    q = []
    for k in range(count):
        if k % 2:
            q.append(pin.integrate(robot.model, start, 0.3 * rng.standard_normal(robot.model.nv)))
        else:
            q.append(pin.randomConfiguration(robot.model, low, high))
    phase = rng.integers(0, 3, count)
    return Places.of(robot, np.array(q), phase, np.outer(0.01 * (phase == 2), problem.normal))


@pytest.mark.parametrize("name", scenes())
def test_lower_bounds_are_no_more_than_exact_distances(name: str) -> None:
    """But for the vertices that smooth distances leave out."""
    problem = scenes()[name]()
    bodies = problem.bodies
    places, within = random_places(problem, 16), 0.15
    found: dict[tuple[int, Any], float] = {}
    slack = SLACK
    assert slack <= 2e-3
    for bound, k, pair in bodies.lower_bounds(places, within):
        assert (k, pair) not in found
        found[k, pair] = bound
    assert len(found) > 5
    for (k, pair), bound in found.items():
        exact = bodies.exact(places, k, pair)
        if exact > 0:
            assert bound <= exact + slack, (k, bodies.names(pair))
        else:  # how deep they are is a local answer
            assert bound <= slack, (k, bodies.names(pair))
    # and what is not among them is not near
    rest = [(k, pair) for k in range(len(places)) for pair in all_pairs(bodies, places, k)]
    rest = [key for key in rest if key not in found]
    for n in np.random.default_rng(1).permutation(len(rest))[:150]:
        k, pair = rest[n]
        assert bodies.exact(places, k, pair) > within - slack, bodies.names(pair)


def all_pairs(bodies: Bodies, places: Places, k: int) -> list[tuple[int, int]]:
    return [*bodies.pairs] + [
        (j, -1 - w) for j, w in bodies.world_pairs if bodies.present(bodies.world[w], places)[k]
    ]


@pytest.mark.parametrize("name", ["arm", "one foot"])
def test_the_nearest_of_all_is_the_nearest(name: str) -> None:
    problem = scenes()[name]()
    bodies, places = problem.bodies, random_places(problem, 5)
    found = bodies.survey(np.arange(len(places), dtype=float), places, within=0.3)
    least, when = found.clearance, int(found.time)
    exact = {
        (k, pair): bodies.exact(places, k, pair)
        for k in range(len(places))
        for pair in all_pairs(bodies, places, k)
    }
    (which,) = {pair for (k, pair) in exact if k == when and bodies.names(pair) == found.nearest}
    assert least == pytest.approx(min(exact.values()), abs=1e-9)
    assert exact[when, which] == pytest.approx(least, abs=1e-9)
    deep = {key for key, apart in exact.items() if apart < -1e-5}
    touches = found.touches
    assert len(touches) == len({pair for _, pair in deep})
    assert [t.depth for t in touches] == sorted((t.depth for t in touches), reverse=True)
    if touches:
        assert touches[0].depth == pytest.approx(-min(exact.values()), abs=1e-9)


def test_far_from_all_nothing_is_near() -> None:
    problem = dataclasses.replace(arm_problem(), body=TargetBody(shape="none"))
    bodies = problem.bodies
    start = Places.of(problem.robot, problem.start_posture[None], np.zeros(1, dtype=np.intp))
    assert bodies.survey(np.zeros(1), start, within=1e-3) == (FAR, 0.0, (), ())


def test_what_touches_in_the_start_posture_may_touch() -> None:
    problem = load_problem("punch")
    bodies = problem.bodies
    start = Places.of(problem.robot, problem.start_posture[None], np.zeros(1, dtype=np.intp))
    assert bodies.survey(np.zeros(1), start).touches == ()
    assert min(bodies.exact(start, 0, pair) for pair in all_pairs(bodies, start, 0)) > 0
    model = problem.robot.model
    for a, b in bodies.pairs:
        assert model.parents[a] != b and model.parents[b] != a


@pytest.mark.parametrize(("apart", "touch"), [(1.5e-3, True), (3e-3, False)])
def test_links_that_fit_into_each_other_touch(apart: float, touch: bool) -> None:
    problem = arm_problem()
    bodies, pair, q = problem.bodies, max(problem.bodies.pairs), problem.start_posture.copy()

    def distance_at(elbow: float) -> float:
        q[3] = elbow
        return bodies.exact(Places.of(problem.robot, q[None], np.zeros(1, np.intp)), 0, pair)

    q[3] = brentq(lambda elbow: distance_at(elbow) - apart, 1.2, 3.1)
    pairs, touching = bodies.links.piece_pairs(q)
    assert (pair in pairs) != touch
    assert bool(touching) == touch


@pytest.mark.parametrize(("apart", "touch"), [(1.5e-3, True), (3e-3, False)])
def test_pointed_links_that_fit_touch(apart: float, touch: bool) -> None:
    """Two octahedra, tip to tip, are as far apart as the balls around them."""
    problem = arm_problem()
    q, model, pair = problem.start_posture, problem.robot.model, max(problem.bodies.pairs)
    data = model.createData()
    pin.forwardKinematics(model, data, q)
    one, other = (data.oMi[joint] for joint in pair)
    between = np.linalg.norm(other.translation - one.translation)
    radius = 0.5 * (float(between) - apart)
    along = (other.translation - one.translation) / between
    axes = np.linalg.qr(np.column_stack([along, np.eye(3)]))[0]
    pieces = []
    for joint, place in zip(pair, (one, other), strict=True):
        turned = radius * place.rotation.T @ axes
        vertices = np.vstack([turned.T, -turned.T])
        corners = [
            (k, i, j) if np.linalg.det(vertices[[k, i, j]]) > 0 else (k, j, i)
            for k in (0, 3)
            for i in (1, 4)
            for j in (2, 5)
        ]
        pieces.append(
            Piece(link=f"link {joint}", joint=joint, vertices=vertices, triangles=np.array(corners))
        )
    links = dataclasses.replace(problem.bodies.links, pieces=tuple(pieces))
    pairs, touching = links.piece_pairs(q)
    assert (len(pairs), len(touching)) == ((0, 1) if touch else (1, 0))


def test_links_that_may_pass_through_each_other_are_no_pair() -> None:
    problem = arm_problem()
    names = problem.bodies.links.name
    (a, b), *rest = problem.bodies.pairs
    robot = dataclasses.replace(problem.robot, disable_collisions=((names(b), names(a)),))
    assert list(dataclasses.replace(problem, robot=robot).bodies.pairs) == rest


def test_the_target_comes_goes_and_moves() -> None:
    problem = dataclasses.replace(arm_problem(), target=Board(mass=0.3, stiffness=1e5, breaking_force=900.0))
    bodies = problem.bodies
    q = np.tile(problem.start_posture, (4, 1))
    moved = np.outer([0.0, 0.0, 1.0, 0.0], [0.2, 0.1, -0.3])
    places = Places.of(problem.robot, q, np.array([0, 1, 2, MISSED]), moved)
    there = {body.name: bodies.present(body, places).tolist() for body in bodies.world}
    assert "ground" not in there, "the base is fixed"
    assert there["target"] == [True, False, False, False], "a board is broken"
    assert there["target's support"] == [True, True, True, False]
    free = arm_problem().bodies
    w = next(k for k, body in enumerate(free.world) if body.name == "target")
    (_, before), (_, after) = (free.placement(places, k, -1 - w) for k in (0, 2))
    np.testing.assert_allclose(after - before, moved[2], atol=1e-12)
    np.testing.assert_allclose(free.placed(places).world[2, w, 9:] - before, moved[2], atol=1e-12)
    assert free.present(free.world[w], places).tolist() == [True, True, True, False]


def test_the_bodies_of_a_robot_do_not_outlive_it() -> None:
    """A sweep of many robots has the memory of one."""
    robot = planar_arm()
    freed = weakref.ref(robot)
    assert bodies_of(robot).overlaps([]) == set()
    del robot
    gc.collect()
    assert freed() is None


def test_a_file_whose_time_of_change_is_set_back_is_read_again(tmp_path: Path) -> None:
    """As by an archive's tool: the new shapes count."""
    file, found = tmp_path / "robot.urdf", []
    for width in (0.08, 0.5):
        assert "0.08 0.08 0.3" in urdfs.arm()
        file.write_text(urdfs.arm().replace("0.08 0.08 0.3", f"{width} 0.08 0.3", 1), "utf-8")
        os.utime(file, (1e9, 1e9))
        pieces = bodies_of(Robot.from_urdf(file)).pieces
        found.append(max(np.ptp(piece.vertices[:, 0]) for piece in pieces))
    assert found[0] < 0.5 <= found[1]


# ---- the world

POINT, NORMAL = np.array([0.6, 0.1, 1.1]), np.array([1.0, 0.0, 0.0])


def corners(body: WorldBody) -> Array:
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return np.asarray(body.place + (signs * body.half) @ body.rotation.T)


def spans(body: WorldBody) -> Array:
    """(3, 2) from the point along normal, across and up [m]."""
    way = (corners(body) - POINT) @ face_axes(NORMAL).T
    return np.column_stack([way.min(axis=0), way.max(axis=0)])


def bodies_at(target: Any, body: TargetBody | None = None) -> dict[str, list[WorldBody]]:
    out: dict[str, list[WorldBody]] = {}
    for found in target_bodies(body or TargetBody(), target, POINT, NORMAL):
        assert found.of_target
        out.setdefault(found.name, []).append(found)
    return out


@pytest.mark.parametrize(
    ("target", "size", "given"),
    [
        (FreeMass(mass=1.0), (0.18, 0.18, 0.18), None),
        (FreeMass(mass=1.0), (0.2, 0.3, 0.1), (0.2, 0.3, 0.1)),
        (RigidWall(), (1.5, 1.5, 0.1), None),
    ],
)
def test_a_boxs_face_has_the_point_in_its_middle(
    target: Any, size: tuple[float, float, float], given: tuple[float, ...] | None
) -> None:
    found = bodies_at(target, TargetBody(size=given))
    (main,), (core,) = found["target"], found["target from behind"]
    across, up, deep = size
    expected = [[0.0, deep], [-across / 2, across / 2], [-up / 2, up / 2]]
    np.testing.assert_allclose(spans(main), expected, atol=1e-12)
    assert main.strikable and not main.before
    assert main.moves == (not isinstance(target, RigidWall))
    np.testing.assert_allclose(spans(core)[0, 0], BEHIND, atol=1e-12)
    np.testing.assert_allclose(spans(core)[1:], expected[1:], atol=1e-12)
    assert core.core and core.before and not core.strikable and not core.moves


@pytest.mark.parametrize(
    ("target", "body", "told"),
    [
        (FreeMass(mass=1.0), TargetBody(), "assumed: box, 18 x 18 x 18 cm"),
        (RigidWall(), TargetBody(), "assumed: wall, 150 x 150 x 10 cm"),
        (FreeMass(mass=1.0), TargetBody(shape="ball"), "assumed: ball, 18 cm"),
        (FreeMass(mass=1.0), TargetBody(shape="ball", size=(0.1,)), "ball, 10 cm"),
        (FreeMass(mass=1.0), TargetBody(size=(0.9, 2.0, 0.04)), "box, 90 x 200 x 4 cm"),
        (FreeMass(mass=1.0), TargetBody(shape="none"), "none: nothing keeps off it"),
    ],
)
def test_a_problem_says_which_body_its_target_has_and_whether_it_is_assumed(
    target: Any, body: TargetBody, told: str
) -> None:
    problem = dataclasses.replace(arm_problem(), target=target, body=body)
    assert problem.describe()["target_body"] == told
    # and it is that size
    for found in bodies_at(target, body).get("target", []):
        sides = 2 * (found.half if found.radius == 0 else np.array([found.radius]))
        assert " x ".join(f"{100 * side:.3g}" for side in sides) in told


def test_a_ball_begins_at_the_point() -> None:
    (ball,) = bodies_at(FreeMass(mass=1.0), TargetBody(shape="ball", size=(0.1,)))["target"]
    np.testing.assert_allclose(ball.place, POINT + 0.05 * NORMAL)
    assert isinstance(ball.shape, coal.Sphere) and ball.shape.radius == 0.05


def test_a_target_may_have_no_body() -> None:
    assert bodies_at(FreeMass(mass=1.0), TargetBody(shape="none")) == {}


def test_a_board_lies_on_two_supports() -> None:
    found = bodies_at(Board(mass=0.3, stiffness=1e5, breaking_force=900.0))
    (board,) = found["target"]
    np.testing.assert_allclose(spans(board), [[0, 0.02], [-0.15, 0.15], [-0.12, 0.12]], atol=1e-12)
    assert board.before and board.moves and board.strikable
    left, right = sorted(found["target's support"], key=lambda b: spans(b)[1, 0])
    np.testing.assert_allclose(spans(left), [[0.02, 0.14], [-0.15, -0.11], [-0.12, 0.12]], atol=1e-12)
    np.testing.assert_allclose(spans(right), [[0.02, 0.14], [0.11, 0.15], [-0.12, 0.12]], atol=1e-12)
    assert not (left.before or left.moves or left.strikable)


def test_a_nail_stands_out_of_its_block() -> None:
    found = bodies_at(Nail(mass=0.1, resistance=300.0, depth=0.02))
    (shank,), (block,) = found["target"], found["target's block"]
    assert isinstance(shank.shape, coal.Capsule)
    ends = [shank.place + sign * shank.half[2] * shank.rotation[:, 2] for sign in (-1, 1)]
    np.testing.assert_allclose(ends, [POINT + 0.004 * NORMAL, POINT + 0.046 * NORMAL], atol=1e-12)
    assert shank.shape.radius == 0.004 and 2 * shank.shape.halfLength == pytest.approx(0.042)
    np.testing.assert_allclose(spans(block), [[0.05, 0.11], [-0.1, 0.1], [-0.1, 0.1]], atol=1e-12)
    assert shank.moves and not block.moves
    deep = bodies_at(Nail(mass=0.1, resistance=300.0, depth=0.065))
    assert list(deep) == ["target's block"]
    np.testing.assert_allclose(spans(deep["target's block"][0])[0, 0], 0.005, atol=1e-12)


def test_a_foot_without_load_that_is_on_the_ground_at_the_start_sinks_no_deeper() -> None:
    """It was exempt from the ground: a plan kept it 5 mm below, and the robot fell in MuJoCo."""
    problem = load_problem("punch_one_foot")
    robot = problem.robot
    model, data = robot.model, robot.model.createData()
    leg = [7 + robot.joint_names.index(f"right_{name}") for name in ("hip_pitch", "knee", "ankle_pitch")]

    def lowered(bend: float) -> tuple[Array, float]:
        q = np.array(robot.posture("on_left_foot"))
        q[leg] = -bend, 2 * bend, -bend  # the foot stays level
        pin.framesForwardKinematics(model, data, q)
        return q, float(data.oMf[model.getFrameId("right_sole")].translation[2])

    def foot_at(height: float) -> Array:
        return lowered(brentq(lambda bend: lowered(bend)[1] - height, 0.1, 1.0))[0]

    bodies = dataclasses.replace(problem, start=foot_at(-0.001)).bodies
    for height, depth in ((-0.001, None), (-0.003, None), (-0.009, 0.005)):
        places = Places.of(robot, foot_at(height)[None], np.zeros(1, dtype=np.intp))
        touches = bodies.survey(np.zeros(1), places).touches
        assert [(t.one, t.other) for t in touches] == ([("right_ankle_roll", "ground")] if depth else [])
        assert [t.depth for t in touches] == pytest.approx([depth] if depth else [], abs=1e-5)
    # its clearance from the ground is none, whatever it may sink
    places = Places.of(robot, foot_at(-0.003)[None], np.zeros(1, dtype=np.intp))
    survey = bodies.survey(np.zeros(1), places)
    assert survey.nearest and "ground" not in survey.nearest
    # nor does it collide with it in MuJoCo, where its sole does
    solids = solids_of(dataclasses.replace(problem, start=foot_at(-0.001)))
    with_ground = {solids.solids[one].name for one, other in solids.pairs if other == FLOOR}
    assert "right_ankle_roll" not in with_ground and "right_knee" in with_ground


def test_feet_on_hinged_soles_stand_on_the_ground(tmp_path: Path) -> None:
    """The sole moves with its hinge, the foot's body with the ankle: that one collided with the ground in
    MuJoCo from the start, and the robot fell."""
    text = urdfs.biped(without="ankle_roll")
    (tmp_path / "robot.urdf").write_text(text, encoding="utf-8")
    draft = draft_problem(tmp_path / "robot.urdf", folder=tmp_path, planned=False)
    (tmp_path / "robot.toml").write_text(draft.text, encoding="utf-8")
    problem = load_problem(tmp_path / "robot.toml")
    assert [sole.hinge for sole in problem.robot.soles] == ["x", "x"]
    bodies = problem.bodies
    on_ground = {bodies.links.name(j) for j, w in bodies.world_pairs if bodies.world[w].ground}
    assert "left_knee_link" in on_ground
    assert on_ground.isdisjoint({"left_ankle_pitch_link", "right_ankle_pitch_link"})


def test_the_ground_is_what_is_below() -> None:
    floor = ground_body(0.0)
    assert distance(coal.Sphere(0.1), at(np.array([1.0, 2.0, 0.3])), floor.shape, at(floor.place)) == (
        pytest.approx(0.2, abs=1e-9)
    )


def test_obstacles_are_where_they_are_said_to_be() -> None:
    box, bar, ball = obstacle_bodies(
        (
            Obstacle(name="box", size=(0.2, 0.4, 0.6), position=(1, 2, 3), rpy=(0.1, -0.2, 0.3)),
            Obstacle(name="bar", start=(0, 0, 1), end=(0.3, 0.4, 1), radius=0.05),
            Obstacle(name="ball", start=(1, 1, 1), radius=0.2),
        )
    )
    np.testing.assert_allclose(box.rotation, pin.rpy.rpyToMatrix(0.1, -0.2, 0.3), atol=1e-12)
    np.testing.assert_allclose(box.place, [1, 2, 3])
    np.testing.assert_allclose(2 * box.half, [0.2, 0.4, 0.6])
    ends = [bar.place + sign * bar.half[2] * bar.rotation[:, 2] for sign in (-1, 1)]
    np.testing.assert_allclose(ends, [[0, 0, 1], [0.3, 0.4, 1]], atol=1e-12)
    np.testing.assert_allclose(bar.rotation.T @ bar.rotation, np.eye(3), atol=1e-12)
    assert np.linalg.det(bar.rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(ball.place, [1, 1, 1])
    assert isinstance(ball.shape, coal.Sphere)
    assert not any(b.of_target or b.moves or b.strikable for b in (box, bar, ball))
    rng = np.random.default_rng(0)
    for body, exact in (
        (bar, lambda x: _from_line(x, np.array([0, 0, 1.0]), np.array([0.3, 0.4, 1.0])) - 0.05),
        (ball, lambda x: np.linalg.norm(x - 1.0) - 0.2),
    ):
        for x in rng.uniform(-1, 2, (20, 3)):
            place = coal.Transform3s(body.rotation, body.place)
            assert distance(coal.Sphere(1e-9), at(x), body.shape, place) == pytest.approx(exact(x), abs=1e-6)


def _from_line(x: Array, a: Array, b: Array) -> float:
    s = np.clip((x - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    return float(np.linalg.norm(x - a - s * (b - a)))


# ---- what makes no sense


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: TargetBody(shape="bal"), "did you mean 'ball'"),
        (lambda: TargetBody(size=(0.1, 0.1)), "TargetBody.size"),
        (lambda: TargetBody(shape="ball", size=(0.1, 0.1, 0.1)), "TargetBody.size"),
        (lambda: TargetBody(size=(0.1, 0.0, 0.1)), "lengths > 0"),
        (lambda: TargetBody(shape="none", size=(0.1, 0.1, 0.1)), "none of shape 'none'"),
        (lambda: Obstacle(name="it"), "either size, of a box"),
        (lambda: Obstacle(name="it", size=(1, 1, 1), start=(0, 0, 0)), "either size, of a box"),
        (lambda: Obstacle(name="it", size=(1, -1, 1)), "lengths > 0"),
        (lambda: Obstacle(name="it", size=(1, 1, 1), radius=0.1), "no end and no radius"),
        (lambda: Obstacle(name="it", size=(1, 1)), "'it': size"),
        (lambda: Obstacle(name="it", start=(0, 0, 0)), "radius > 0"),
        (lambda: Obstacle(name="it", start=(0, 0, 0), radius=float("nan")), "radius > 0"),
        (lambda: Obstacle(name="it", start=(0, 0, 0), radius=0.1, position=(1, 0, 0)), "no position"),
        (lambda: Obstacle(name="", size=(1, 1, 1)), "give a word"),
    ],
)
def test_bodies_that_make_no_sense_are_refused(make: Callable[[], Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        make()


def test_a_world_that_makes_no_sense_is_refused() -> None:
    problem = arm_problem()
    ball = Obstacle(name="ball", start=(3, 3, 3), radius=0.1)
    for changes, words in (
        ({"obstacles": (ball, ball)}, "two obstacles are called 'ball'"),
        ({"obstacles": ("ball",)}, "a tuple of Obstacle"),
        ({"body": "box"}, "a TargetBody"),
    ):
        with pytest.raises(InputError, match=words):
            dataclasses.replace(problem, **changes)


def test_a_start_in_something_is_refused() -> None:
    problem = arm_problem()
    model, data = problem.robot.model, problem.robot.model.createData()
    pin.forwardKinematics(model, data, problem.start_posture)
    elbow = tuple(data.oMi[3].translation.tolist())
    post = Obstacle(name="post", start=elbow, radius=0.05)
    inside = dataclasses.replace(problem, obstacles=(post,))
    with pytest.raises(InputError, match=r"at the start the link '\w+' is in the body 'post'"):
        _ = inside.bodies
    free = dataclasses.replace(inside, terms=(KeepOut(enabled=False),))
    assert len(free.bodies.world) == len(inside.obstacles) + 2, "who switches it off is not told"
    large = dataclasses.replace(problem, body=TargetBody(size=(0.9, 3.0, 3.0)))
    moved = dataclasses.replace(large, point=np.array(problem.point) - np.array([0.0, 0.4, 0.0]))
    with pytest.raises(InputError, match="is in the body 'target"):
        _ = moved.bodies


@pytest.mark.parametrize(
    ("pairs", "words"),
    [
        ((("elbow", "wirst"),), "no frame 'wirst'.*did you mean 'wrist'"),
        ((("elbow",),), "no pair of links' names"),
        ((("elbow", 3),), "no pair of links' names"),
    ],
)
def test_pairs_of_links_that_there_are_not_are_refused(pairs: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        planar_arm(disable_collisions=pairs)


def test_an_srdf_says_which_links_may_touch_but_for_what_it_sampled(tmp_path: Path) -> None:
    from support.problem_texts import ARM, write

    urdf = write(tmp_path, ARM, "arm.urdf")
    srdf = write(
        tmp_path,
        """<robot name="two links">
  <rotor_params> <joint name="turn" mass="1e-5" gear_ratio="100.0"/> </rotor_params>
  <disable_collisions link1="upper" link2="lower" reason="Adjacent"/>
  <disable_collisions link1="upper" link2="fist" reason="Never"/>
  <disable_collisions link1="ground" link2="fist" reason="User"/>
</robot>""",
        "arm.srdf",
    )
    robot = Robot.from_urdf(
        urdf, srdf=srdf, floating=False, armature=0.05, disable_collisions=[("lower", "ground")]
    )
    assert robot.disable_collisions == (("upper", "lower"), ("ground", "fist"), ("lower", "ground"))


def test_a_robots_bodies_are_made_once() -> None:
    robot = planar_arm()
    found = bodies_of(robot)
    assert bodies_of(robot) is found
    assert bodies_of(dataclasses.replace(robot)) is not found


@pytest.mark.parametrize("count", [8, 12])
def test_a_link_of_many_shapes_has_one_hull(tmp_path: Path, count: int) -> None:
    """Of all their corners; a few shapes stay apart."""
    shape = '<collision><origin xyz="{} 0 0.1"/><geometry><box size="0.01 0.02 0.03"/></geometry></collision>'
    shapes = "".join(shape.format(0.02 * k) for k in range(count))
    text = re.sub(r'(<link name="elbow_link">.*?)<collision>.*?</collision>', rf"\1{shapes}", urdfs.arm())
    (tmp_path / "robot.urdf").write_text(text)
    robot = Robot.from_urdf(tmp_path / "robot.urdf", floating=False, locked=["slide_0", "slide_1"])
    own = [piece for piece in bodies_of(robot).pieces if piece.link == "elbow_link"]
    assert bodies_of(robot).too_large == ()
    assert len(own) == (1 if count > 8 else 8)
    corners = np.concatenate([piece.vertices for piece in own])
    np.testing.assert_allclose(corners.min(axis=0), [-0.005, -0.01, 0.085], atol=1e-9)
    np.testing.assert_allclose(corners.max(axis=0), [0.02 * count - 0.015, 0.01, 0.115], atol=1e-9)


MESHES = {
    "pointer.stl": (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", "git lfs pull"),
    "cut.stl": (b"\0" * 80 + (99).to_bytes(4, "little") + b"\0" * 60, "cannot be read"),
    "empty.stl": (b"\0" * 80 + (0).to_bytes(4, "little"), "no triangles"),
    "nan.stl": (b"\0" * 80 + (1).to_bytes(4, "little") + b"\xff" * 50, "vertices are NaN or infinite"),
    "broken.obj": (b"f 1 2", "cannot be read"),
    "gone.stl": (None, "not found"),
}


@pytest.mark.parametrize("name", MESHES)
def test_a_mesh_that_is_no_body_is_told(tmp_path: Path, name: str) -> None:
    data, said = MESHES[name]
    if data is not None:
        (tmp_path / name).write_bytes(data)
    mesh = f'<geometry><mesh filename="{name}"/></geometry>'
    after = '</collision></link><joint name="elbow"'
    text = urdfs.arm().replace(f'<geometry><box size="0.08 0.08 0.3"/></geometry>{after}', f"{mesh}{after}")
    (tmp_path / "robot.urdf").write_text(text)
    robot = Robot.from_urdf(tmp_path / "robot.urdf", floating=False)
    pieces, source = pieces_of(robot)
    assert "boxes of the inertia of 1 that have lost their meshes" in source
    elbow = robot.model.getJointId("elbow")
    assert [piece.link for piece in pieces if piece.joint == elbow] == ["elbow"]  # its joint's box
    assert said in lost_meshes(robot.model, robot.urdf)[elbow][name]
