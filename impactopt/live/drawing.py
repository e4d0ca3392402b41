"""3D scene of a live page, drawn by viser: robot, world, force, ZMP, centre of mass and path of the hand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from impactopt.arrays import Array
from impactopt.bodies.solids import cylinder
from impactopt.bodies.visuals import Part, surroundings_of
from impactopt.bodies.world import face_axes
from impactopt.problem.problem import ImpactProblem
from impactopt.report.stage import bodies_drawn
from impactopt.report.tracks import Track
from impactopt.robots.robot import Robot


@dataclass(frozen=True, kw_only=True, eq=False)
class Moment:
    """State at one time of a motion, as in :class:`~impactopt.report.tracks.Track`.

    place (joints, 3) [m], turn (joints, 4) : placements of the joints in the world, with quaternions w, x, y,
    z.
    """

    place: Array
    turn: Array
    hand: Array
    mass: Array
    force: float
    travel: float
    aside: Array
    zmp: Array


def moment_of(track: Track, time: float) -> Moment:
    """State at a time [s], clipped to the track's ends; after a jump, if the time is at one."""
    at = float(np.clip(time, track.time[0], track.time[-1]))
    after = min(int(np.searchsorted(track.time, at, side="right")), len(track.time) - 1)
    before = max(after - 1, 0)
    span = float(track.time[after] - track.time[before])
    fraction = (at - float(track.time[before])) / span if span > 0 else 1.0

    def interpolated(values: Array) -> Array:
        return np.asarray((1 - fraction) * values[before] + fraction * values[after])

    one, other = track.places[before, :, 3:], track.places[after, :, 3:]
    # q and -q are the same rotation: interpolate between the nearer ones
    sign = np.where((one * other).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
    turn = (1 - fraction) * one + fraction * sign * other
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    return Moment(
        place=interpolated(track.places[:, :, :3]),
        turn=turn[:, [3, 0, 1, 2]],  # w first
        hand=interpolated(track.hand),
        mass=interpolated(track.mass),
        force=float(interpolated(track.force)),
        travel=float(interpolated(track.travel)),
        aside=interpolated(track.aside),
        zmp=interpolated(track.zmp),
    )


RED, BLUE, GREEN, WOOD, GREY = (214, 69, 65), (31, 119, 180), (44, 160, 44), (201, 160, 106), (150, 155, 160)
MAX_ARROW = 0.4  # [m] length of the arrow of the largest force
MARK = 0.05, 0.01  # [m] radius and thickness of the disc that stands for a target without a known body
OPACITY = 0.35  # of transparent parts
CAMERA_DISTANCE = 1.8  # [m]
MIN_HORIZONTAL = 1e-3  # horizontal part of a normal: one with less has no left and right


class Drawing:
    """Scene of a server with a robot and what it hits.

    server : a `viser.ViserServer`.  floor : height [m]; None: no floor.
    """

    def __init__(self, server: Any, robot: Robot, floor: float | None) -> None:
        self.scene, self.camera = server.scene, server.initial_camera
        self.scene.set_up_direction("+z")
        if floor is not None:
            self.scene.add_grid("/ground", width=4.0, height=4.0, cell_size=0.25, position=(0.0, 0.0, floor))
        self.joints: dict[int, Any] = {}
        for k, body in enumerate(bodies_drawn(robot)):
            name = f"/robot/{body.joint}"
            if body.joint not in self.joints:
                self.joints[body.joint] = self.scene.add_frame(name, show_axes=False)
            red, green, blue = (round(255 * c) for c in body.colour)
            self.scene.add_mesh_simple(
                f"{name}/body{k}",
                body.solid.vertices.astype(np.float32),
                body.solid.triangles.astype(np.uint32),
                color=(red, green, blue),
                flat_shading=True,
                side="double",
            )
        self.zmp = self.scene.add_icosphere("/marks/zmp", radius=0.02, color=BLUE)
        self.mass = self.scene.add_icosphere("/marks/centre of mass", radius=0.025, color=GREEN)
        self.parts: list[tuple[Part, Any]] = []
        self.mark: Any = None
        self.normal, self.point, self.largest = np.zeros(3), np.zeros(3), 1.0

    def show(self, problem: ImpactProblem, track: Track, polygon: Array) -> None:
        """Draw a plan's world, path and support polygon (k, 2) [m] in place of those before."""
        self.normal, self.point = problem.normal, problem.point
        self.largest = max(float(track.force.max()), 1e-9)
        for _, handle in self.parts:
            handle.remove()
        parts = surroundings_of(problem.world)
        if not any(part.moves for part in parts):
            turned = face_axes(self.normal)[[1, 2, 0]].T
            solid = cylinder(*MARK).moved(turned, self.point + self.normal * MARK[1] / 2)
            parts.append(Part(kind="target", solid=solid, moves=True))
        self.parts = [(part, self._add(k, part)) for k, part in enumerate(parts)]
        self.path("/path of the hand", track.hand, RED)
        self.polygon(polygon)

    def path(self, name: str, places: Array, colour: tuple[int, int, int] = BLUE) -> None:
        """Draw a line through points (k, 3) [m]."""
        self._lines(name, np.stack([places[:-1], places[1:]], axis=1), colour)

    def polygon(self, polygon: Array) -> None:
        """Draw the support polygon's edges."""
        if len(polygon):
            corners = np.column_stack([polygon, np.full(len(polygon), 1e-3)])
            edges = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
            self._lines("/support polygon", edges, BLUE)

    def aim_camera(self, mass: Array, point: Array, normal: Array, middle: float) -> None:
        """Set the camera beside the impact, a little ahead and above, on the hand's side of the robot.

        mass, point (3,) [m] : centre of mass and hit point.  middle [m] : y of the robot's middle.
        """
        aside = np.array([normal[1], -normal[0], 0.0])  # to the right of the normal
        size = float(np.linalg.norm(aside))
        aside = aside / size if size > MIN_HORIZONTAL else np.array([0.0, -1.0, 0.0])
        if (point[1] - middle) * aside[1] < 0:
            aside = -aside
        ahead = normal * [1.0, 1.0, 0.0]
        offset = CAMERA_DISTANCE * aside + 0.5 * CAMERA_DISTANCE * ahead
        self.camera.look_at = 0.4 * mass + 0.6 * point
        self.camera.position = self.camera.look_at + offset + [0.0, 0.0, 0.5]

    def draw(self, moment: Moment) -> None:
        """Move everything to its place at an instant."""
        for joint, handle in self.joints.items():
            handle.position, handle.wxyz = moment.place[joint], moment.turn[joint]
        for part, handle in self.parts:
            if part.hinge is not None:
                place, axis, arm = part.hinge
                turn = Rotation.from_rotvec(np.arctan2(moment.travel, arm) * axis)
                x, y, z, w = turn.as_quat()
                handle.position, handle.wxyz = place - turn.apply(place), (w, x, y, z)
            elif part.moves:
                handle.position = moment.travel * self.normal + moment.aside
        self.mass.position = moment.mass
        self.zmp.visible = bool(np.isfinite(moment.zmp).all())
        if self.zmp.visible:
            self.zmp.position = np.append(moment.zmp, 0.0)
        length = MAX_ARROW * moment.force / self.largest
        ends = np.array([[moment.hand, moment.hand + max(length, 1e-6) * self.normal]])
        if self.mark is not None:
            self.mark.remove()
            self.mark = None
        if length > 0:
            self.mark = self._lines("/marks/force", ends, RED, 0.012)

    def _add(self, k: int, part: Part) -> Any:
        return self.scene.add_mesh_simple(
            f"/world/{part.kind}{k}",
            part.solid.vertices.astype(np.float32),
            part.solid.triangles.astype(np.uint32),
            color=WOOD if part.kind == "target" else GREY,
            opacity=OPACITY if part.clear else None,
            flat_shading=True,
            side="double",
        )

    def _lines(self, name: str, points: Array, colour: tuple[int, int, int], thickness: float = 0.006) -> Any:
        colours = np.broadcast_to(np.array(colour, dtype=np.uint8), points.shape)
        return self.scene.add_line_segments(
            name, points.astype(np.float32), colours, thickness=thickness, thickness_units="world"
        )
