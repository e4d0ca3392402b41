"""Page of a robot's bodies: convex hulls over its meshes, and pairs that may touch."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from html import escape
from typing import Any

import numpy as np
import pinocchio as pin

from impactopt.arrays import Array
from impactopt.bodies.robot_bodies import RobotBodies, bodies_of
from impactopt.bodies.solids import Solid
from impactopt.bodies.world import WorldBody
from impactopt.kinematics.stance import USUAL_POSTURE
from impactopt.problem.problem import ImpactProblem
from impactopt.report.page import Page, html_table, report_html
from impactopt.report.result_rows import Cell, Row
from impactopt.report.stage import Arrays, middle, pack_robot, pack_solid, pack_track, pack_world
from impactopt.report.tracks import Track, places_of
from impactopt.robots.robot import Robot


def bodies_page(robot: Robot) -> Page:
    """Page of a robot's bodies in `USUAL_POSTURE`, else in its first posture, or else in the neutral."""
    names = sorted(robot.postures, key=lambda name: name != USUAL_POSTURE)
    posture = robot.posture(names[0]) if names else pin.neutral(robot.model)
    floor = 0.0 if robot.soles else None  # without soles it has ground only where a problem gives one
    return _page(robot, posture, names[0] if names else "neutral", robot.name, floor=floor)


def bodies_page_of_problem(problem: ImpactProblem) -> Page:
    """Page of the bodies of a problem's world, and of its robot in the initial posture."""
    posture = problem.start if isinstance(problem.start, str) else "start"
    title = problem.name or problem.robot.name
    return _page(
        problem.robot,
        problem.start_posture,
        posture,
        title,
        world=problem.world,
        normal=problem.normal,
        point=problem.point,
        floor=problem.ground_height,
    )


def _page(
    robot: Robot,
    q: Array,
    posture: str,
    title: str,
    *,
    world: tuple[WorldBody, ...] = (),
    normal: Array | None = None,
    point: Array | None = None,
    floor: float | None,
) -> Page:
    links, arrays = bodies_of(robot), dict[str, Any]()
    header = {
        "bodies": pack_robot(robot, arrays),
        "hulls": _pack_hulls(links, arrays),
        "world": pack_world(world, arrays),
        "tracks": [pack_track("track0", _still(robot, q, f"posture: {posture}"), arrays)],
        "soles": [],
        "normal": np.array([1.0, 0.0, 0.0]) if normal is None else normal,
        "point": arrays["track0_hand"][0] if point is None else point,  # in view, and seen from its side
        "side": middle(arrays["track0_places"]),
        "weight": 1.0,
        "around": 0.0,
        "far": 1.0,
        "floor": floor,
        "legged": False,
        "charts": [],
    }
    html = report_html(
        title=f"{title}: bodies",
        heading=title,
        about=f"{robot.name}: collision bodies",
        parts=_parts(robot, q, posture, world),
        header=header,
        arrays=arrays,
    )
    return Page(html)


def _pack_hulls(links: RobotBodies, arrays: Arrays) -> list[dict[str, Any]]:
    out = []
    for k, hull in enumerate(links.pieces):
        packed = pack_solid(f"hull{k}", Solid(vertices=hull.vertices, triangles=hull.triangles), arrays)
        out.append({"joint": hull.joint, "colour": links.joints.index(hull.joint), **packed})
    return out


def _still(robot: Robot, q: Array, label: str) -> Track:
    """Track of a single instant without contact."""
    zero, unknown = np.zeros(1), np.full((1, 3), np.nan)
    frames = [striker.model_frame for striker in robot.strikers.values()]
    places, hand, mass = places_of(robot, frames[0] if frames else "universe", q[None])
    return Track(
        name=label,
        time=zero,
        places=places,
        hand=hand if frames else mass,
        mass=mass,
        force=zero,
        travel=zero,
        aside=np.zeros((1, 3)),
        zmp=unknown[:, :2],
        ground=unknown,
        contact_start=np.nan,
        contact_end=np.nan,
    )


def _parts(robot: Robot, q: Array, posture: str, world: Sequence[WorldBody]) -> Iterator[str]:
    links = bodies_of(robot)
    yield f'<p id="source">Bodies are convex hulls of the {escape(links.source)}. Point at a row to see its '
    yield "link.</p>"
    yield '<div class="top"><section class="card stays" id="animation" aria-label="bodies"></section>'
    yield f'<section class="card" id="fit" aria-label="links"><h3>Links</h3>{_fit(links)}'
    yield "</section></div>"
    if world:
        yield f'<h2>The world</h2><section class="card" id="world">{_world(world)}</section>'
    yield "<h2>Pairs that may touch</h2>"
    for number, (why, pairs) in enumerate(_excluded_pairs(robot, q, posture)):
        yield f'<section class="card left-out" id="why{number}"><h3>{escape(why)}</h3>'
        yield f"{_table(('link', 'and link'), pairs or [('none', '')])}</section>"


def _fit(links: RobotBodies) -> str:
    rows = [(links.name(j), str(len(links.of_joint[j]))) for j in links.joints]
    return _table(("link", "hulls"), rows, links.joints)


def _world(world: Sequence[WorldBody]) -> str:
    def shape(body: WorldBody) -> str:
        if not body.radius:
            return f"box {' x '.join(f'{2 * h:.3g}' for h in body.half)} m"
        length = 2 * float(body.half[2])
        return f"{f'capsule {length:.3g} m long' if length else 'ball'}, radius {body.radius:.3g} m"

    def place(body: WorldBody) -> str:
        return f"({', '.join(f'{x:.3g}' for x in body.place)}) m"

    rows = [(b.name, shape(b), place(b)) for b in world if not (b.core or b.ground)]
    return _table(
        ("body", "shape", "centre"),
        rows or [("nothing but the ground" if any(b.ground for b in world) else "nothing", "", "")],
    )


def _excluded_pairs(robot: Robot, q: Array, posture: str) -> Iterator[tuple[str, list[tuple[str, str]]]]:
    """Reasons why pairs of links may touch, with the pairs."""
    links = bodies_of(robot)
    yield "A joint connects them", [(links.name(a), links.name(b)) for a, b in links.connected]
    disabled = {frozenset(pair) for pair in robot.disable_collisions}
    joints = {hull.link: hull.joint for hull in links.pieces}
    connected = {frozenset(pair) for pair in links.connected}
    known = [p for p in disabled if p <= joints.keys() and len(p) == 2]
    others = [p for p in known if len(of := {joints[n] for n in p}) == 2 and frozenset(of) not in connected]
    yield "The robot's files, or its disable_collisions, exclude them", _sorted(others)
    _, touching = links.piece_pairs(q, disabled)
    yield f"They touch, or nearly, in the posture {posture}", _sorted(map(frozenset, touching))


def _sorted(pairs: Iterable[frozenset[str]]) -> list[tuple[str, str]]:
    """Sorted pairs of names; a pair of one link with itself has its name twice."""
    return sorted({(min(pair), max(pair)) for pair in pairs})


def _table(head: Sequence[str], rows: Sequence[Sequence[str]], joints: Sequence[int] = ()) -> str:
    """Table with a label first in each row, which stands for a joint of the robot if these are given."""
    found = [Row(first, tuple(map(Cell, cells))) for first, *cells in rows]
    attributes = [f'data-joint="{joint}" tabindex="0"' for joint in joints]
    return f'<div class="scroll">{html_table(found, head, row_attributes=attributes)}</div>'
