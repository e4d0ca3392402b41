"""Animated picture of a replay: the robot as sticks from three sides, slow around contact."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pinocchio as pin
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image, ImageColor
from scipy.spatial import ConvexHull

from impactopt.arrays import Array, Index
from impactopt.bodies.visuals import surroundings_of
from impactopt.files.output import check_ending, write_file
from impactopt.files.replay import Replay
from impactopt.kinematics.stance import corners_at
from impactopt.report.pictures.style import BLACK, BLUE, GREEN, PHASES, RIGHT, STYLE, VERMILION
from impactopt.robots.loads import MIN_LOAD_FRACTION, weight_of
from impactopt.simulation import scene_of
from impactopt.simulation.reference.poses import bones
from impactopt.simulation.result import centre_of_pressure

FPS, SLOW = 20, 10  # frames a second; factor by which time is slower around contact
AROUND = 0.05  # [s] before and after contact that are slow too
AFTER = 0.6  # [s] shown beyond the end of the reference's motion
REST = 1500  # [ms] duration of the last frame
ARROW = 0.5  # [m] length of an arrow for the robot's weight, or for the largest contact force
NEAR = 0.3  # [m] distance from the hand beyond which a target may leave the picture
GREY, LIGHT = "#777777", "#dddddd"
DRAWN = (BLACK, GREY, LIGHT, BLUE, GREEN, VERMILION)
SIDE, BEHIND, ABOVE = (
    np.eye(3)[[0, 2]],
    np.array([[0, -1, 0], [0, 0, 1.0]]),
    np.array([[0, -1, 0], [1.0, 0, 0]]),
)


@dataclass(frozen=True, kw_only=True)
class _Instant:
    """Drawn state of one instant: positions and arrows in the world [m]."""

    sticks: Array  # (links, 2, 3)
    soles: list[Array]  # (corners, 3) each
    hand: Array  # (3,)
    world: list[Array]  # vertices (k, 3) of the target, its support, and obstacles
    near: list[Array]  # those of them that must be in the picture
    face: Array | None  # (3,) where the target is hit; None: there is no target
    push: Array  # (3,) arrow
    feet: list[tuple[Array, Array]]  # centre of pressure (3,) and arrow (3,)
    zmp: Array | None  # (3,)


class _Drawing:
    """Figure of one frame, whose contents are drawn anew at each instant."""

    def __init__(self, done: Replay) -> None:
        self.done, self.sim = done, done.simulation
        self.robot, self.scene = done.planned.problem.robot, scene_of(done.planned.problem)
        self.scene = done.perturbation.scene(self.scene)
        model = self.robot.model
        self.data = model.createData()
        self.per_newton = ARROW / max(weight_of(self.robot), 1.0)
        self.per_push = ARROW / max(float(self.sim.force.max()), 1e-9)
        self.links = bones(self.robot)
        self.striker = model.getFrameId(self.scene.striker)
        ends = [model.frames[model.getFrameId(name)].parentJoint for name in self.scene.strikers]
        chain = {joint for end in ends for joint in model.supports[end]}
        self.strikes = np.array([j in chain for _, j in self.links])
        self.travel, self.aside = self.sim.target_travel, self.sim.aside()
        self.figure = Figure(figsize=(9.4, 4.2), dpi=80)
        self.canvas: Any = FigureCanvasAgg(self.figure)
        self.panels: list[Any] = []
        self.world = surroundings_of(done.planned.problem.world)
        self.shift = self.scene.point - done.planned.problem.point  # of the target, by the perturbation
        self.head = self.figure.text(0.02, 0.93, "", fontsize=11, family="monospace")
        self.views = (SIDE, BEHIND, ABOVE)

    def look(self, k: int) -> _Instant:
        """Drawn state at recorded instant `k`."""
        model, data, sim, scene = self.robot.model, self.data, self.sim, self.scene
        pin.framesForwardKinematics(model, data, sim.q[k])
        joints = np.array([place.translation for place in data.oMi])
        hand = np.array(data.oMf[self.striker].translation)
        sticks = joints[np.array(self.links)]
        frames = [data.oMf[model.getFrameId(sole.frame)] for sole in self.robot.soles]
        soles = [
            corners_at(sole.polygon, frame) for sole, frame in zip(self.robot.soles, frames, strict=True)
        ]
        cops, ground = sim.sole_cop()[k], sim.sole_ground[k]
        loaded = sim.sole_normal[k] >= MIN_LOAD_FRACTION * weight_of(self.robot)
        feet = [
            (np.array([*cop, 0.0]), self.per_newton * wrench[:3])
            for cop, wrench, is_loaded in zip(cops, ground, loaded, strict=True)
            if is_loaded
        ]
        world = [
            (
                part,
                part.placed(self.travel[k], scene.normal, self.aside[k])
                + (part.kind != "obstacle") * self.shift,
            )
            for part in self.world
            if part.kind == "obstacle" or not self.done.perturbation.missing
        ]
        zmp = centre_of_pressure(sim.ground[k]) if len(ground) else np.full(2, np.nan)
        return _Instant(
            sticks=sticks,
            soles=soles,
            hand=hand,
            world=[vertices for _, vertices in world],
            near=[v for part, v in world if not part.clear and np.linalg.norm(v.mean(axis=0) - hand) < NEAR],
            face=None
            if self.done.perturbation.missing
            else scene.point + self.travel[k] * scene.normal + self.aside[k],
            push=self.per_push * sim.force[k] * scene.normal,
            feet=feet,
            zmp=np.array([*zmp, 0.0]) if np.isfinite(zmp).all() else None,
        )

    def set_up(self, scenes: list[_Instant]) -> None:
        """Makes panels that contain all scenes; the first two have the same scale."""
        body = np.concatenate([part for s in scenes for part in (s.sticks.reshape(-1, 3), s.hand[None])])
        near = [vertices for s in scenes for vertices in s.near]
        low, high = _bounds(np.concatenate([body, *near, *scenes[0].soles]), 0.08)
        floor = self.done.planned.problem.ground_height
        if floor is not None:
            low[2] = min(low[2], floor - 0.1)
        spans = [_bounds(np.array([low, high]) @ view.T, 0.0) for view in self.views]
        stands = bool(scenes[0].soles)
        if stands:
            spans[2] = _bounds(np.concatenate(scenes[0].soles) @ ABOVE.T, 0.06)
        widths = [float(high[0] - low[0]) for low, high in spans[:2]]
        grid = self.figure.add_gridspec(
            1, 3, left=0.07, right=0.99, bottom=0.11, top=0.84, wspace=0.3, width_ratios=[*widths, widths[1]]
        )
        labels = (("x [m]", "z [m]"), (RIGHT, "z [m]"), (RIGHT, "x [m]"))
        names = ("from its right", "from behind", "soles from above" if stands else "from above")
        for k, ((lowest, highest), name, (across, up)) in enumerate(zip(spans, names, labels, strict=True)):
            axes = self.figure.add_subplot(grid[k])
            axes.set_aspect("equal")
            axes.grid(False)
            axes.set(title=name, xlabel=across, ylabel=up)
            axes.set(xlim=(lowest[0], highest[0]), ylim=(lowest[1], highest[1]))
            if k < 2 and floor is not None:
                axes.axhline(floor, color=GREY, linewidth=1.0, zorder=0)
            self.panels.append(axes)
        key = [
            Line2D([], [], color=VERMILION, label="force on the target"),
            Line2D([], [], color=GREEN, marker="o", label="force of the floor on a sole"),
            Line2D([], [], color=BLACK, marker="D", linestyle="", markersize=4, label="zero-moment point"),
        ]
        if stands:
            self.figure.legend(handles=key, loc="lower right", fontsize=8)
        else:
            self.figure.legend(handles=key[:1], loc="upper right", fontsize=8)

    def draw(self, scene: _Instant, text: str) -> Image.Image:
        """Draws one frame."""
        self.head.set_text(text)
        moving: list[Any] = []
        for axes, view in zip(self.panels, self.views, strict=True):
            from_above = view is ABOVE
            if not (from_above and scene.soles):
                self._robot(axes, view, scene, moving)
            for corners in scene.soles:
                flat = corners @ view.T
                moving += axes.fill(*flat.T, facecolor=LIGHT, edgecolor=BLACK, linewidth=1.5, zorder=2)
            for place, arrow in scene.feet:
                start, way = view @ place, view @ arrow
                if from_above:
                    moving += axes.plot(*start, "o", color=GREEN, markersize=6, zorder=6)
                else:
                    moving.append(_arrow(axes, start, way, GREEN))
            if scene.zmp is not None:
                moving += axes.plot(*(view @ scene.zmp), "D", color=BLACK, markersize=4, zorder=7)
        self.canvas.draw()
        picture = Image.frombuffer("RGBA", self.canvas.get_width_height(), self.canvas.buffer_rgba())
        for thing in moving:
            thing.remove()
        return picture.convert("RGB")

    def _robot(self, axes: Any, view: Array, scene: _Instant, moving: list[Any]) -> None:
        for vertices in scene.world:
            flat = vertices @ view.T
            outline = flat[ConvexHull(flat).vertices]
            moving += axes.fill(*outline.T, facecolor=LIGHT, edgecolor=GREY, zorder=1)
        if scene.face is not None:
            self._plane(axes, view, scene.face, moving)
        for stick, strikes in zip(scene.sticks @ view.T, self.strikes, strict=True):
            colour, order = (BLUE, 4) if strikes else (BLACK, 3)
            moving += axes.plot(*stick.T, color=colour, linewidth=3.0, solid_capstyle="round", zorder=order)
        wrist = scene.sticks[np.flatnonzero(self.strikes)[-1], 1]
        moving += axes.plot(*(view @ np.array([wrist, scene.hand]).T), color=BLUE, linewidth=3.0, zorder=4)
        moving += axes.plot(*(view @ scene.hand), "o", color=BLUE, markersize=6, zorder=5)
        if np.any(scene.push):
            moving.append(_arrow(axes, view @ scene.hand, view @ scene.push, VERMILION))

    def _plane(self, axes: Any, view: Array, place: Array, moving: list[Any]) -> None:
        """Draws the plane of contact, if it is seen edge-on: the hand touches it beside the target too."""
        normal = view @ self.scene.normal
        if np.linalg.norm(normal) > 0.9:
            face, way = view @ place, np.array([-normal[1], normal[0]])
            ends = np.array([face - 3 * way, face + 3 * way])
            moving += axes.plot(*ends.T, ":", color=GREY, linewidth=1.0, scalex=False, scaley=False, zorder=0)


def _arrow(axes: Any, start: Array, way: Array, colour: str) -> Any:
    style = {"arrowstyle": "-|>", "color": colour, "linewidth": 2.0, "shrinkA": 0, "shrinkB": 0}
    return axes.annotate("", start + way, start, arrowprops=style, zorder=8, annotation_clip=True)


def _bounds(points: Array, margin: float) -> tuple[Array, Array]:
    return points.min(axis=0) - margin, points.max(axis=0) + margin


def save_animation(done: Replay, path: Path) -> Path:
    """Writes a replay as an animated GIF; around contact, time is ten times slower.

    Raises
    ------
    InputError : the file cannot be written, or its name does not end with .gif.
    """
    check_ending("an animation is a GIF", path, ".gif")
    sim = done.simulation
    last = min(float(sim.time[-1]), float(done.planned.reference.end) + AFTER)
    times, paces = shown_times(sim.contact_start, sim.contact_end, last)
    instants = np.searchsorted(sim.time, times).clip(0, len(sim.time) - 1)
    phase = sim.phase()
    with matplotlib.rc_context({**STYLE, "figure.constrained_layout.use": False}):
        stage = _Drawing(done)
        scenes = [stage.look(int(k)) for k in instants]
        stage.set_up(scenes)
        pictures = []
        for k, pace, scene in zip(instants, paces, scenes, strict=True):
            slow = f"   {pace} x slower" if pace > 1 else ""
            text = f"{sim.time[k]:6.3f} s   {PHASES[phase[k]]:<14}{sim.force[k]:4.0f} N on the target{slow}"
            pictures.append(stage.draw(scene, text))
        end = _end_text(sim.fall) if scenes[-1].soles else ""
        pictures.append(stage.draw(scenes[-1], f"{sim.time[instants[-1]]:6.3f} s   {end}"))
    data = _gif(pictures)
    write_file(path, lambda file: file.write(data))
    return path


def _end_text(fall: str | None) -> str:
    """Text of the last frame."""
    if fall is None:
        return "the soles are fixed"
    return fall or "stands"


def _gif(pictures: list[Image.Image]) -> bytes:
    """GIF with one palette for all frames, to store changes only: shades of each colour on white."""
    fraction = np.linspace(0.0, 1.0, 9)[:, None]
    shades = [fraction * np.array(ImageColor.getrgb(colour)) + (1 - fraction) * 255 for colour in DRAWN]
    palette = Image.new("P", (1, 1))
    palette.putpalette(np.concatenate(shades).round().astype(np.uint8).tobytes())
    first, *rest = (p.quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures)
    duration = [1000 // FPS] * len(rest) + [REST]
    memory = io.BytesIO()
    first.save(memory, "GIF", save_all=True, append_images=rest, duration=duration, loop=0)
    return memory.getvalue()


def shown_times(start: float, end: float, last: float) -> tuple[Array, Index]:
    """Instants (k,) [s] of the frames until `last`, and the factor by which time is slower at each."""
    times, paces, t = [], [], 0.0
    while t <= last:
        slow = start - AROUND <= t < end + AROUND  # nan compares false: without contact nothing is slow
        times.append(t)
        paces.append(SLOW if slow else 1)
        t += 1 / FPS / paces[-1]
    return np.array(times), np.array(paces)
