"""Live page of a plan: the planned motion, and controls that make new plans."""

from __future__ import annotations

import threading
import time
import traceback
from typing import Any

import numpy as np

from impactopt.errors import InputError
from impactopt.live.drawing import Drawing, moment_of
from impactopt.live.replanning import Answer, Replanning
from impactopt.live.requests import LatestRequest, PlanRequest, numbers_of, request_of
from impactopt.live.server import LOCAL, LivePage, served
from impactopt.planning.solution import Solution
from impactopt.report.tracks import Track

__all__ = ["LiveLook", "failure_message", "plan_message"]

FRAME = 1 / 30  # [s]
SPEEDS = {"1": 1.0, "1/4": 0.25, "1/20": 0.05}
_WORST = 5  # constraints


class LiveLook(LivePage):
    """A page that is served until it is closed.

    first : the plan to begin with.  host, port : where it is served; 0: a port that is free.

    Attributes
    ----------
    address : of the page.
    answer : of the newest plan, which is drawn.
    sliders : by the names of `Solution.moved`; hit : the gizmo at the hit point.

    Raises
    ------
    InputError : viser is missing; host or port cannot be had; the first plan is none.
    """

    def __init__(self, first: Solution, *, host: str = LOCAL, port: int = 0) -> None:
        if not first.status.usable:
            raise InputError(
                f"this plan is no solution ({first.status.value}), so no other can be made of it: solve it"
            )
        self.first, self.request = first, request_of(first.problem)
        replanning = Replanning(first)
        self.answer = replanning(self.request, lambda: False)
        self._server, self.address = served(host, port)
        self._drawn, self._asking = threading.RLock(), threading.RLock()
        self._drawing = Drawing(self._server, first.problem.robot, first.problem.ground_height)
        self._controls()
        track, problem = self._track, first.problem
        middle = float(track.places[0, 1:, 1].mean())
        self._drawing.watch(track.mass[0], problem.point, problem.normal, middle)
        self._take(self.answer)
        self._latest = LatestRequest(replanning, self._told)

    def ask(self, request: PlanRequest) -> None:
        """Plan for this, in place of what was asked for before."""
        self.request = request
        self.status.content = "Planning ..."
        self._latest.ask(request)

    def run(self) -> None:
        """Play the motion, until Ctrl-C."""
        before = time.monotonic()
        while True:
            time.sleep(FRAME)
            now = time.monotonic()
            if self.playing.value:
                self.play(now - before)
            before = now

    def play(self, seconds: float) -> None:
        """Go on by so long of the watcher's time; at its end a motion begins again."""
        with self._drawn:
            end = float(self._track.time[-1])
            at = float(self.time.value) + seconds * SPEEDS[self.speed.value]
            self.time.value = 0.0 if at > end else at
            self._draw()

    @property
    def _track(self) -> Track:
        assert self.answer.track is not None
        return self.answer.track

    def _controls(self) -> None:
        gui, problem = self._server.gui, self.first.problem
        gui.configure_theme(show_share_button=False, show_logo=False)
        self.told = gui.add_markdown("")
        self.status = gui.add_markdown("")
        with gui.add_folder("Motion"):
            self.time = gui.add_slider("time [s]", 0.0, 1.0, 1e-3, 0.0)
            self.playing = gui.add_checkbox("play", True)
            self.speed = gui.add_dropdown("speed", tuple(SPEEDS), initial_value="1/4")
        self.sliders: dict[str, Any] = {}
        with gui.add_folder("Plan"):
            for number in numbers_of(problem):
                slider = gui.add_slider(number.label, number.least, number.most, number.step, number.value)
                slider.on_update(lambda _: self.changed())
                self.sliders[number.name] = slider
            self.again = gui.add_button("back to the first plan")
        self.hit = self._server.scene.add_transform_controls(
            "/hit point", scale=0.25, disable_rotations=True, position=problem.point, depth_test=False
        )
        self.time.on_update(lambda event: self._draw() if event.client is not None else None)
        self.hit.on_update(lambda _: self.changed())
        self.again.on_click(lambda _: self.reset())

    def changed(self) -> None:
        """Ask for what the controls say, if that is something else than before."""
        with self._asking:  # viser calls from several threads
            x, y, z = (float(v) for v in self.hit.position)
            numbers = tuple((name, float(slider.value)) for name, slider in self.sliders.items())
            request = PlanRequest(point=(x, y, z), numbers=numbers)
            if request != self.request:
                self.ask(request)

    def reset(self) -> None:
        """Put all controls, and with them the plan, back to the first."""
        with self._asking:
            own = request_of(self.first.problem)
            self.ask(own)  # at first, so that no control asks on its way
            for name, value in own.numbers:
                self.sliders[name].value = value
            self.hit.position = np.array(own.point)
            self.ask(own)

    def _told(self, _: PlanRequest, answer: Answer | Exception) -> None:
        if isinstance(answer, Exception):  # a fault of ours, which must not end the page
            traceback.print_exception(answer)
            answer = Answer(why=f"This is a fault of impactopt: {type(answer).__name__}: {answer}")
        if answer.track is None:
            self.status.content = failure_message(answer)
        else:
            self._take(answer)

    def _take(self, answer: Answer) -> None:
        """Draw this plan in place of the one before."""
        assert answer.solution is not None and answer.track is not None
        with self._drawn, self._server.atomic():
            self.answer = answer
            end = float(answer.track.time[-1])
            if float(self.time.value) > end:
                self.time.value = end
            self.time.max = end
            self._drawing.show(answer.solution.problem, answer.track, answer.solution.plan.polygon)
            self._draw()
        self.told.content = plan_message(answer, self.first)
        self.status.content = ""

    def _draw(self) -> None:
        with self._drawn, self._server.atomic():
            self._drawing.at(moment_of(self._track, float(self.time.value)))


def plan_message(answer: Answer, first: Solution) -> str:
    """A plan's numbers, how it was found, and its worst constraints."""
    solution = answer.solution
    assert solution is not None
    plan, duration = solution.plan, solution.plan.compression + solution.plan.restitution
    lines = [
        f"**{solution.impulse:.2f} N s** (first plan: {first.impulse:.2f})",
        f"- {plan.hand_speed:.2f} m/s at contact",
    ]
    if duration > 0:
        lines.append(f"- {plan.collision.force.max():.0f} N at most, for {1e3 * duration:.1f} ms")
    for name, words, unit, factor in (
        ("zmp_margin_m", "ZMP margin", " mm", 1e3),
        ("torque_ratio", "torque", " % of its limit", 1e2),
    ):
        told = ", ".join(f"{phase} {factor * x:.0f}" for phase, x in answer.margins.get(name, {}).items())
        lines += [f"- {words}: {told}{unit}"] if told else []
    seconds = first.solve_seconds if solution is first else answer.seconds
    lines.append(f"\n{solution.status.value}: {solution.result.iterations} iterations, {seconds:.2f} s")
    worst = [f"- {row}" for row in solution.violations[:_WORST]]
    return "\n".join(
        [*lines, *(["\nViolated constraints:", *worst] if worst else ["\nAll constraints are met."])]
    )


def failure_message(answer: Answer) -> str:
    """Message that there is no plan, with the reason, and that the one before is still drawn."""
    return f"**No plan for this.** {answer.why}\n\nThe one before is shown ({answer.seconds:.2f} s)."
