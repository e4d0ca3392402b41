"""What reports and animations are made of: solids, meshes, motions, histories, packed numbers."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import trapezoid
from support.fake_solution import still_problem, still_solution
from support.pages import unpack

from impactopt import (
    Board,
    Free,
    FreeMass,
    InputError,
    KelvinVoigt,
    Nail,
    Obstacle,
    RigidWall,
    Robot,
    Solution,
    Target,
    TargetBody,
    load_robot,
)
from impactopt.bodies.convex_hulls import pieces_of
from impactopt.bodies.solids import (
    Solid,
    box,
    capsule,
    cylinder,
    find_mesh,
    joined,
    read_mesh,
    rounded_box,
    simplified,
    sphere,
)
from impactopt.bodies.visuals import surroundings_of, visuals_of
from impactopt.files.output import BITS, record_of
from impactopt.files.record import Record
from impactopt.report.charts import charts_of
from impactopt.report.histories import thinned
from impactopt.report.page import pack
from impactopt.report.stage import stage_of
from impactopt.report.tracks import FAR, tracks_of


@pytest.fixture(scope="module")
def solution() -> Solution:
    return still_solution()


@pytest.fixture(scope="module")
def record(solution: Solution) -> Record:
    return record_of(solution, simulation=solution.validate(), replay=solution.validate(engine="mujoco"))


def volume(solid: Solid) -> float:
    """Divergence theorem; positive where triangles look outwards."""
    a, b, c = (solid.vertices[solid.triangles[:, k]] for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


# ---- solids


@pytest.mark.parametrize(
    ("solid", "exact"),
    [
        (box([0.2, 0.3, 0.4]), 0.2 * 0.3 * 0.4),
        (cylinder(0.1, 0.5, sides=200), np.pi * 0.1**2 * 0.5),
        (cylinder(0.1, 0.3, tip=0.0, sides=200), np.pi * 0.1**2 * 0.3 / 3),
        (sphere(0.2, sides=100), 4 / 3 * np.pi * 0.2**3),
        (capsule(0.1, 0.3, sides=202), np.pi * 0.1**2 * (0.3 + 4 / 3 * 0.1)),
        (joined([box([0.1, 0.1, 0.1]), box([0.1, 0.2, 0.1]).moved(np.eye(3), np.ones(3))]), 0.003),
    ],
)
def test_solids_are_closed_and_of_their_volume(solid: Solid, exact: float) -> None:
    assert volume(solid) == pytest.approx(exact, rel=2e-3)
    edges = solid.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    forward, backward = ({tuple(e) for e in way.tolist()} for way in (edges, edges[:, ::-1]))
    assert forward == backward, "each edge has a triangle on both sides, turned the same way"


def test_a_rounded_box_fills_its_box() -> None:
    solid = rounded_box([0.2, 0.4, 0.6])
    assert np.ptp(solid.vertices, axis=0) == pytest.approx([0.2, 0.4, 0.6])
    assert 0.85 < volume(solid) / (0.2 * 0.4 * 0.6) < 1.0


def test_fewer_triangles_keep_a_sphere_round_and_a_box_sharp() -> None:
    fine = sphere(0.2, sides=160)
    few = simplified(fine, 0.02)
    assert len(few.triangles) < len(fine.triangles) / 5
    assert np.linalg.norm(few.vertices, axis=1) == pytest.approx(0.2, abs=2e-3)
    assert volume(few) == pytest.approx(volume(fine), rel=0.02)
    corners = np.array([0.1, 0.15, 0.2])
    split = box(2 * corners)
    for _ in range(5):  # each triangle into four
        v, t = split.vertices, split.triangles
        a, b, c = v[t[:, 0]], v[t[:, 1]], v[t[:, 2]]
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        vertices = np.concatenate([np.stack(p, axis=1).reshape(-1, 3) for p in parts])
        split = Solid(vertices=vertices, triangles=np.arange(len(vertices)).reshape(-1, 3))
    few = simplified(split, 0.03)
    assert len(few.triangles) < len(split.triangles) / 4
    gap = np.linalg.norm(np.abs(few.vertices)[:, None] - corners, axis=2).min(axis=0)
    assert gap.max() < 5e-4, "quadrics put vertices on the corners, not at the mean of their cells"


# ---- what a robot looks like

INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
MESHES = "package://lamp_description/meshes"
URDF = f"""\
<robot name="lamp"><material name="red"><color rgba="1 0 0 1"/></material>
<link name="base">{INERTIAL}
<visual><origin xyz="0 0 0.1"/><geometry><box size="0.2 0.2 0.2"/></geometry><material name="red"/></visual>
<visual><geometry><mesh filename="{MESHES}/gone.stl"/></geometry></visual></link>
<link name="shade">{INERTIAL}
<visual><origin xyz="0 0 0.5" rpy="1.5707963267948966 0 0"/>
<geometry><cylinder radius="0.1" length="0.4"/></geometry>
<material name=""><color rgba="0 0 1 1"/></material></visual>
<visual><geometry><mesh filename="{MESHES}/tip.stl" scale="0.001 0.001 0.001"/></geometry></visual></link>
<joint name="hinge" type="revolute"><parent link="base"/><child link="shade"/>
<origin xyz="0 0 1"/><axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="10" velocity="5"/></joint></robot>
"""


def write_stl(path: Path, solid: Solid) -> None:
    facets = np.zeros(len(solid.triangles), dtype=[("at", "<f4", (4, 3)), ("attribute", "<u2")])
    facets["at"][:, 1:] = solid.vertices[solid.triangles]
    path.write_bytes(bytes(80) + len(facets).to_bytes(4, "little") + facets.tobytes())


@pytest.fixture
def lamp(tmp_path: Path) -> Path:
    folder = tmp_path / "lamp_description"
    (folder / "meshes").mkdir(parents=True)
    (folder / "urdf").mkdir()
    write_stl(folder / "meshes" / "tip.stl", box([100.0, 200.0, 300.0]))
    (folder / "urdf" / "lamp.urdf").write_text(URDF)
    return folder / "urdf" / "lamp.urdf"


def test_shapes_of_a_urdf(lamp: Path) -> None:
    red, blue, tip = visuals_of(Robot.from_urdf(lamp, floating=False))
    assert (red.joint, red.colour) == (0, (1.0, 0.0, 0.0)) and (blue.joint, blue.colour) == (
        1,
        (0.0, 0.0, 1.0),
    )
    assert [*red.solid.vertices.min(axis=0), *red.solid.vertices.max(axis=0)] == pytest.approx(
        [-0.1, -0.1, 0.0, 0.1, 0.1, 0.2]
    )
    # turned by a quarter about x, its axis is along y
    assert np.ptp(blue.solid.vertices, axis=0) == pytest.approx([0.2, 0.4, 0.2])
    assert np.ptp(tip.solid.vertices, axis=0) == pytest.approx([0.1, 0.2, 0.3]), "the mesh is in millimetres"
    assert volume(tip.solid) == pytest.approx(0.006, rel=1e-5)


def test_locked_and_floating_joints_keep_shapes_in_place(lamp: Path) -> None:
    robot = Robot.from_urdf(lamp, floating=True)
    assert [v.joint for v in visuals_of(robot)] == [1, 2, 2]
    with pytest.raises(FileNotFoundError):
        find_mesh("package://lamp_description/meshes/gone.stl", lamp)


def test_a_mesh_is_found_where_its_file_has_a_slash_too_many(lamp: Path) -> None:
    """As TALOS's in example-robot-data."""
    found = find_mesh("package:///lamp_description/meshes/tip.stl", lamp)
    assert found == find_mesh("package://lamp_description/meshes/tip.stl", lamp)


def test_a_mesh_is_found_whose_name_differs_in_case(lamp: Path) -> None:
    """Exporters on Windows write .STL for a file .stl; one with the exact name comes first."""
    found = find_mesh("package://lamp_description/meshes/tip.stl", lamp)
    assert find_mesh("package://lamp_description/meshes/Tip.STL", lamp) == found
    (found.parent / "Tip.STL").write_bytes(found.read_bytes())
    assert find_mesh("package://lamp_description/meshes/Tip.STL", lamp).name == "Tip.STL"
    assert find_mesh("package://lamp_description/meshes/tip.stl", lamp) == found


def test_what_has_lost_its_meshes_is_a_box_and_bones(
    lamp: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = Robot.from_urdf(lamp, floating=False)
    assert [piece.joint for piece in pieces_of(robot)[0]] == [0, 1, 1] and "lost" not in pieces_of(robot)[1]
    alone = tmp_path_factory.mktemp("elsewhere") / "alone.urdf"  # its meshes are not beside it
    shade = URDF.index('<link name="shade">')
    no_cylinder = '<geometry><mesh filename="package://lamp_description/meshes/tip.stl"/></geometry>'
    alone.write_text(
        URDF[:shade]
        + URDF[shade:].replace('<geometry><cylinder radius="0.1" length="0.4"/></geometry>', no_cylinder)
    )
    robot = Robot.from_urdf(alone, floating=False)
    base, *rest = visuals_of(robot)
    assert base.joint == 0 and {visual.joint for visual in rest} == {1}, "the shade is drawn all the same"
    pieces, source = pieces_of(robot)
    assert [piece.joint for piece in pieces] == [0, 1], "and kept apart"
    assert "inertia of 1 that have lost" in source
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(lamp.parents[2]))
    assert "lost" not in pieces_of(robot)[1], "ROS knows where its packages are"


def test_mesh_files_of_other_kinds_are_read_too(tmp_path: Path) -> None:
    solid = box([0.1, 0.2, 0.3])
    lines = [f"v {x} {y} {z}" for x, y, z in solid.vertices]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in solid.triangles]
    (tmp_path / "box.obj").write_text("\n".join(lines))
    assert volume(read_mesh(tmp_path / "box.obj", np.full(3, 2.0))) == pytest.approx(8 * 0.006, rel=1e-5)


def test_without_files_links_are_boxes_of_their_inertia() -> None:
    robot = load_robot("standin")
    by_joint = {v.joint: v.solid for v in reversed(visuals_of(robot))}  # the first of each
    thigh = robot.model.getJointId("left_hip_pitch")
    # the table says 0.12 x 0.11 x 0.30 m about (0, 0.02, -0.15)
    middle = (by_joint[thigh].vertices.max(axis=0) + by_joint[thigh].vertices.min(axis=0)) / 2
    assert np.ptp(by_joint[thigh].vertices, axis=0) == pytest.approx([0.12, 0.11, 0.30], abs=1e-6)
    assert middle == pytest.approx([0.0, 0.02, -0.15], abs=1e-6)


# ---- what the world looks like

LAW = KelvinVoigt(stiffness=1e5, damping=100.0)
BOARD = Board(mass=0.1, stiffness=5e4, breaking_force=400.0)
TABLE = Obstacle(name="table", size=(0.4, 0.6, 0.03), position=(1.5, 0.2, 0.5), rpy=(0.1, -0.2, 0.7))
RAIL = Obstacle(name="rail", start=(1.0, 1.0, 0.2), end=(1.4, 1.2, 1.0), radius=0.03)


@pytest.mark.parametrize(
    ("target", "body", "kinds"),
    [
        (FreeMass(mass=1.0), TargetBody(), ["target"]),
        (FreeMass(mass=1.0), TargetBody(shape="ball", size=(0.22,)), ["target"]),
        (FreeMass(mass=1.0), TargetBody(shape="none"), []),
        (RigidWall(), TargetBody(), ["held"]),
        (Nail(mass=0.1, resistance=1.0, depth=0.02), TargetBody(size=(0.3, 0.2, 0.1)), ["target", "held"]),
        (BOARD, TargetBody(size=(0.4, 0.2, 0.03)), ["target", "target", "held", "held"]),
    ],
)
def test_what_is_drawn_of_the_world_is_what_a_plan_keeps_off(
    target: Target, body: TargetBody, kinds: list[str]
) -> None:
    problem = still_problem(
        target=target, body=body, law=LAW, obstacles=(TABLE, RAIL), normal=[0.6, 0.0, -0.8]
    )
    parts = surroundings_of(problem.world)
    assert [part.kind for part in parts] == [*kinds, "obstacle", "obstacle"]
    kept = [b for b in problem.world if not (b.ground or b.core)]
    drawn = np.concatenate([part.solid.vertices for part in parts])
    for part in parts:  # no corner of what is drawn is off all bodies that are there
        gaps = [
            [gap(coal.Sphere(1e-9), coal.Transform3s(np.eye(3), v), b.shape, at(b)) for b in kept]
            for v in part.solid.vertices
        ]
        assert np.min(gaps, axis=1).max() < 1e-6 and volume(part.solid) > 0
    for b in kept:  # and all of each is drawn: it goes as far along each of its axes
        ends = b.place + np.concatenate([s * (b.half + b.radius) * np.eye(3) @ b.rotation.T for s in (-1, 1)])
        for end in ends:
            way = (end - b.place) / np.linalg.norm(end - b.place)
            inside = drawn[gap_to(b, drawn) < 1e-6]
            # balls and capsules are drawn with 50 sides, around and from pole to pole
            short = (1 - np.cos(np.pi / 50) ** 2) * b.radius
            assert end @ way - short - 1e-9 < (inside @ way).max() < end @ way + 1e-9


def gap(*given: Any) -> float:
    return float(coal.distance(*given, coal.DistanceRequest(), coal.DistanceResult()))


def at(body: Any) -> Any:
    return coal.Transform3s(body.rotation, body.place)


def gap_to(body: Any, points: Any) -> Any:
    """How far (k,) points (k, 3) are from a body of the world."""
    sphere = coal.Sphere(1e-9)
    return np.array([gap(sphere, coal.Transform3s(np.eye(3), p), body.shape, at(body)) for p in points])


def test_what_hides_the_robot_is_seen_through_and_what_stands_still_stays() -> None:
    parts = surroundings_of(still_problem(target=RigidWall(), obstacles=(TABLE,)).world)
    assert [(p.clear, p.moves) for p in parts] == [(True, False), (True, False)]
    parts = surroundings_of(still_problem(target=Nail(mass=0.1, resistance=1.0), law=LAW).world)
    assert [(p.clear, p.moves) for p in parts] == [(False, True), (False, False)]


def test_a_board_opens_over_the_inner_edges_of_its_supports() -> None:
    problem = still_problem(target=BOARD, normal=[0.0, 0.0, -1.0])
    one, other, *supports = surroundings_of(problem.world)
    for half, support in zip((one, other), supports, strict=True):
        assert half.hinge is not None
        along = half.hinge.place - problem.point
        across = problem.world[1].rotation[:, 0]
        # the support's corner that is nearest to the blow, under the board
        nearest = np.abs((support.solid.vertices - problem.point) @ across).min()
        assert abs(along @ across) == pytest.approx(nearest) == pytest.approx(half.hinge.arm)
        assert along @ problem.normal == pytest.approx(0.02)
        # turned by a little about its axis, the middle goes along the blow
        speed = np.cross(half.hinge.axis, problem.point + 0.02 * problem.normal - half.hinge.place)
        assert speed == pytest.approx(half.hinge.arm * problem.normal, abs=1e-12)


def test_a_page_has_a_motion_in_a_world_that_a_plan_would_refuse() -> None:
    """An old result may be one: its problem is built, and the start is in what stands about now."""
    around = Obstacle(name="cage", size=(5.0, 5.0, 5.0))
    problem = still_problem(obstacles=(around,))
    with pytest.raises(InputError, match="cage"):
        _ = problem.bodies
    header, arrays = stage_of(record_of(still_solution()), problem)
    cage = header["world"][-1]
    size = arrays[f"{cage['name']}_vertices"].max(axis=0) * cage["step"]
    assert cage["kind"] == "obstacle" and size == pytest.approx([5.0, 5.0, 5.0])


def test_a_board_that_holds_springs_back(record: Record, solution: Solution) -> None:
    ends = {}
    for broken in (0.0, 1.0):
        told = Record(summary={**record.summary, "target": {"broken": broken}}, arrays=record.arrays)
        track = tracks_of(told, solution.problem)[0]
        # speed grows linearly to 2 m/s over 40 ms of contact
        at_end = np.interp(track.contact_end, track.time, track.travel)
        assert at_end == pytest.approx(0.04, abs=1e-3)
        ends[broken] = track.travel[-1]
    assert ends[0.0] == 0.0 and ends[1.0] > 0.04


# ---- what moves


def test_a_track_says_what_the_record_says(record: Record, solution: Solution) -> None:
    planned, simulated, free = tracks_of(record, solution.problem)
    assert [t.name for t in (planned, simulated, free)] == ["planned", "simulated", "free soles"]
    model, hit = solution.problem.robot.model, solution.plan.collision
    data = model.createData()
    weight = 9.81 * pin.computeTotalMass(model)
    for track, prefix in ((planned, "reference"), (simulated, "simulated"), (free, "replayed")):
        assert (np.diff(track.time) >= 0).all()
        k = len(track.time) // 2
        q = record.arrays[f"{prefix}_q"][0]  # it stands still
        kept = 0.5 ** BITS[prefix]  # what a record keeps of a history, of its largest value
        com = pin.centerOfMass(model, data, q)
        assert track.mass[k] == pytest.approx(com, abs=1e-9)
        pin.forwardKinematics(model, data, q)
        for j in range(1, model.njoints):
            assert track.places[k, j] == pytest.approx(pin.SE3ToXYZQUAT(data.oMi[j]), abs=1e-9)
        # standing still, the ground carries the weight, and the ZMP is below the centre of mass
        assert track.ground[0] == pytest.approx([0, 0, weight], abs=1e-6 + weight * kept)
        assert track.zmp[0] == pytest.approx(com[:2], abs=1e-6 + kept)
    contact = (planned.time > planned.contact_start) & (planned.time < planned.contact_end)
    since = planned.time[contact] - planned.contact_start
    assert planned.force[contact] == pytest.approx(np.interp(since, hit.time, hit.force))
    assert planned.force[planned.time == planned.contact_start].tolist() == [0.0, hit.force[0]], "a jump"
    # made up: from 10 to 40 ms, 400 N that press 8 N m / 400 N in front of the origin
    later = contact & (planned.time > planned.contact_start + 0.01)
    assert later.sum() > 5
    np.testing.assert_allclose(planned.zmp[later], np.tile([0.02, 0.0], (later.sum(), 1)), atol=1e-9)
    # speed grows linearly to 2 m/s over 40 ms, and stays
    end = planned.time[-1] - planned.contact_end
    assert planned.travel[-1] == pytest.approx(min(2.0 * (0.02 + end), FAR), abs=1e-3)


def test_a_motion_in_contact_is_the_plans_in_a_problem_of_another_stance(solution: Solution) -> None:
    """The stance of `show RESULT --problem FILE` has other coordinates: a page of it was a traceback."""
    plan, problem = solution.plan, solution.problem
    hit, (y, _) = plan.collision, problem.coordinates.split(problem.start_posture)
    motion = np.stack([np.tile(y, (len(hit.time), 1)), np.zeros((len(hit.time), len(y)))], axis=1)
    motion[:, 0, 2] -= 0.5 * hit.time  # the base sinks at 0.5 m/s
    motion[:, 1, 2] = -0.5
    sinking = dataclasses.replace(plan, collision=dataclasses.replace(hit, motion=motion))
    record = record_of(dataclasses.replace(solution, plan=sinking))
    drawn = [tracks_of(record, of)[0] for of in (problem, dataclasses.replace(problem, stance=Free()))]
    for track in drawn:
        contact = (track.time > track.contact_start) & (track.time < track.contact_end)
        sunk = 0.5 * (track.time[contact] - track.contact_start)
        assert contact.sum() > 5
        np.testing.assert_allclose(track.places[0, 1, 2] - track.places[contact, 1, 2], sunk, atol=1e-9)
    np.testing.assert_array_equal(drawn[0].places, drawn[1].places)


def test_a_target_that_friction_pushes_aside_is_drawn_there(record: Record, solution: Solution) -> None:
    a, across = record.arrays, np.array([0.0, 0.5, -0.2])
    time = a["collision_time"]
    histories = {"collision_tangential_velocity": np.outer(time / time[-1], across)}
    histories["replayed_target_aside"] = np.outer(a["replayed_time"], across)
    for track in tracks_of(record, solution.problem):
        assert not track.aside.any()
    moved = dataclasses.replace(record, arrays={**a, **histories})
    planned, *_, free = tracks_of(moved, solution.problem)
    since = planned.time[-1] - planned.contact_start
    # the velocity grows linearly in contact, and stays
    np.testing.assert_allclose(planned.aside[-1], (since - time[-1] / 2) * across, atol=1e-3)
    np.testing.assert_allclose(free.aside, np.outer(free.time, across), atol=1e-9)
    _, arrays = stage_of(moved, solution.problem)
    assert any(name.endswith("_aside") and np.any(values) for name, values in arrays.items())


def test_the_motion_for_a_missing_target_is_there_without_the_target(
    record: Record, solution: Solution
) -> None:
    a = record.arrays
    missed = {f"missed_{n.removeprefix('reference_')}": a[n] for n in a if n.startswith("reference_")}
    missed["missed_ground"] = np.tile([0.0, 0.0, 500.0, 0.0, -5.0, 0.0], (len(a["reference_time"]), 1))
    both = dataclasses.replace(record, arrays={**a, **missed})
    *others, track = tracks_of(both, solution.problem)
    assert track.name == "planned, target missing" and track.missing
    assert not any(other.missing for other in others) and others[0].name == "planned"
    assert np.isnan(track.contact_start) and not track.force.any() and not track.travel.any()
    np.testing.assert_allclose(track.zmp, np.tile([0.01, 0.0], (len(track.time), 1)))
    header, _ = stage_of(both, solution.problem)
    assert [t["missing"] for t in header["tracks"]] == [False, False, False, True]


@pytest.mark.parametrize("older", [False, True])
def test_in_contact_the_planned_robot_moves_on_between_its_planned_states(
    biped_plan: Any, older: bool
) -> None:
    """The reference coasts and jumps back; what is drawn has the plan's states and rates at both ends, also
    of a record of an older version, without states within the collision.
    """
    plan, problem = biped_plan.plan, biped_plan.problem
    solved = still_solution(problem=problem)
    made = record_of(type(solved)(**{**vars(solved), "plan": plan}))
    kept = {name: a for name, a in made.arrays.items() if not older or name != "collision_q"}
    (track,) = tracks_of(dataclasses.replace(made, arrays=kept), problem)
    start, end = plan.contact_start, plan.contact_end
    rate = np.diff(track.hand, axis=0) / np.maximum(np.diff(track.time), 1e-12)[:, None]
    inside = (track.time[:-1] >= start) & (track.time[1:] <= end) & (np.diff(track.time) > 0)
    normal = problem.normal
    assert float(rate[inside][0] @ normal) == pytest.approx(plan.hand_speed, rel=0.15)
    steps = np.linalg.norm(np.diff(track.hand, axis=0), axis=1)
    assert steps[inside].max() < 1.5 * np.abs(rate[inside]).max() * 2.1e-3, "no jump"
    last = np.flatnonzero(track.time <= end)[-2:]  # both sides of the reference's jump
    np.testing.assert_allclose(*track.hand[last], atol=1e-5)
    coasting = biped_plan.trajectory
    jump = np.flatnonzero((np.diff(coasting.phase) == 1) & (coasting.phase[:-1] == 1))[0]
    assert np.abs(pin.difference(problem.robot.model, *coasting.q[jump : jump + 2])).max() > 1e-3, (
        "it does jump"
    )


# ---- numbers in a page


def test_what_is_packed_is_unpacked() -> None:
    rng = np.random.default_rng(3)
    arrays = {
        "odd": rng.integers(0, 9, 5).astype("<u2"),
        "kept": rng.normal(size=(4, 3)).astype("<f4"),
        "gap": np.array([1.0, np.nan, 2.0]),
        "none": np.zeros((0, 2)),
    }
    header, back = unpack(pack({"a": [1, {"b": np.float64(0.5)}], "n": np.nan}, arrays))
    assert header == {"a": [1, {"b": 0.5}], "n": None}
    for name, array in arrays.items():
        assert back[name].shape == array.shape
        np.testing.assert_array_equal(back[name], array.astype(back[name].dtype))


def test_thinned_histories_keep_peaks_ends_and_what_is_looked_at_closely() -> None:
    rng = np.random.default_rng(5)
    time = np.linspace(0.0, 1.0, 20_001)
    y = np.where(time < 0.31234, 0.0, 1.0) + 0.01 * rng.normal(size=len(time))
    y[7777] = 5.0
    t, kept = thinned(time, y, whole=(0.31, 0.32))
    assert len(t) < 1900 and t[0] == 0.0 and t[-1] == 1.0
    assert (kept.min(), kept.max()) == (y.min(), 5.0) and t[kept.argmax()] == time[7777]
    close = (time >= 0.31) & (time <= 0.32)
    assert kept[(t >= 0.31) & (t <= 0.32)].tolist() == y[close].tolist(), "a step stays one"


def test_charts_hold_the_records_numbers(record: Record) -> None:
    charts, arrays = charts_of(record)
    by_title = {chart["title"]: chart for chart in charts}
    force = {s["label"]: arrays[s["y"]] for s in by_title["Force on the target"]["series"]}
    assert {name: float(y.max()) for name, y in force.items()} == {
        "planned": 700.0,
        "simulated": 700.0,
        "free soles": 700.0,
    }
    for s in by_title["Torque demand over limit"]["series"]:
        most = record.summary if s["label"] == "planned" else record.summary["simulated"]
        assert arrays[s["y"]].max() == pytest.approx(max(most["torque_ratio"].values()))
    for s in by_title["ZMP margin"]["series"]:
        key = {"planned": record.summary, "simulated": record.summary["simulated"]}.get(s["label"])
        if key is not None:
            assert np.nanmin(arrays[s["y"]]) == pytest.approx(1e3 * min(key["zmp_margin_m"].values()))
    for chart in charts:
        for s in chart["series"]:
            assert {s[key] for key in ("x", "y", "xy", "time") if key in s} <= set(arrays)
    joints = next(chart["joints"] for chart in charts if "joints" in chart)
    assert joints == list(record.arrays["joints"]), "by the names that a file takes"
    assert not record.arrays["prismatic"].any() and by_title["One joint's angle"]["y"] == "angle [rad]"
    prismatic = np.arange(len(joints)) == 0
    rail = dataclasses.replace(record, arrays={**record.arrays, "prismatic": prismatic})
    units = {chart["title"]: chart["y"] for chart in charts_of(rail)[0] if "joints" in chart}
    assert all("[N m or N]" in y or "[rad or m]" in y for y in units.values()), "a prismatic joint's, too"


def test_the_planned_hand_is_as_fast_as_the_plan_says(biped_plan: Any) -> None:
    plan, problem = biped_plan.plan, biped_plan.problem
    solved = still_solution(problem=problem)
    made = record_of(type(solved)(**{**vars(solved), "plan": plan}))
    charts, arrays = charts_of(made, problem)
    (chart,) = (chart for chart in charts if chart["title"].startswith("Speed of striking point"))
    (hand,) = (s for s in chart["series"] if s["label"] == "striking point, planned")
    time, speed = arrays[hand["x"]], arrays[hand["y"]]
    assert speed[0] == pytest.approx(0.0, abs=1e-6), "from rest"
    assert np.nanmax(speed[time <= plan.contact_start]) == pytest.approx(plan.hand_speed, rel=1e-3)
    assert np.isnan(speed[(time > plan.contact_start) & (time < plan.contact_end)]).all()
    # what it covers in the swing is its way from the start to the target
    swing = np.isfinite(speed) & (time <= plan.contact_start)
    way = problem.normal @ (problem.point - tracks_of(made, problem)[0].hand[0])
    assert trapezoid(speed[swing], time[swing]) == pytest.approx(way, abs=2e-3)
