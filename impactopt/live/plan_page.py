"""Live page of a plan: the planned motion, with controls for re-planning."""

from __future__ import annotations

import threading
import time
import traceback
from typing import Any

import numpy as np

from impactopt.errors import InputError
from impactopt.live.drawing import Drawing, moment_of
from impactopt.live.replanning import MAX_VIOLATIONS, Answer, Replanning
from impactopt.live.requests import LatestRequest, PlanRequest, request_of, slider_parameters
from impactopt.live.server import LivePage, served
from impactopt.planning.solution import Solution, impact_summary
from impactopt.report.stage import middle
from impactopt.report.tracks import Track
from impactopt.solvers.program import Status

FRAME = 1 / 30  # [s] between frames
SPEEDS = {"1": 1.0, "1/4": 0.25, "1/20": 0.05}  # of the motion over the real one


class PlanPage(LivePage):
    """Page of a plan, served until it is closed.

    first : first plan.  port : of the page, on this machine; 0: a free one.

    Attributes
    ----------
    address : of the page.
    answer : with the latest plan, which is drawn.
    sliders : by the argument names of `Solution.moved`.  hit : handle of the hit point in the scene.

    Raises
    ------
    InputError : viser is missing; the port is not available; the first plan is not a solution.
    """

    def __init__(self, first: Solution, *, port: int = 0) -> None:
        if not first.status.usable:
            raise InputError(
                f"this plan is not a solution ({first.status.value}) and cannot be re-planned: solve it first"
            )
        self.first, self.request = first, request_of(first.problem)
        replanning = Replanning(first)
        self.answer = replanning(self.request, lambda: False)
        self._server, self.address = served(port)
        # viser calls from several threads: locks of the scene, and of the request
        self._scene_lock, self._request_lock = threading.RLock(), threading.RLock()
        self._drawing = Drawing(self._server, first.problem.robot, first.problem.ground_height)
        self._add_controls()
        track, problem = self._track, first.problem
        self._drawing.aim_camera(track.mass[0], problem.point, problem.normal, middle(track.places))
        self._show_plan(self.answer)
        self._latest = LatestRequest(replanning, self._show)

    def ask(self, request: PlanRequest) -> None:
        """Plan for this request, in place of earlier ones."""
        self.request = request
        self.status.content = "Planning ..."
        self._latest.ask(request)

    def run(self) -> None:
        """Play the motion until Ctrl-C."""
        before = time.monotonic()
        while True:
            time.sleep(FRAME)
            now = time.monotonic()
            if self.playing.value:
                self.play(now - before)
            before = now

    def play(self, seconds: float) -> None:
        """Advance the motion by a real time [s]; after its end it begins again."""
        with self._scene_lock:
            end = float(self._track.time[-1])
            at = float(self.time.value) + seconds * SPEEDS[self.speed.value]
            self.time.value = 0.0 if at > end else at
            self._draw()

    @property
    def _track(self) -> Track:
        assert self.answer.track is not None
        return self.answer.track

    def _add_controls(self) -> None:
        gui, problem = self._server.gui, self.first.problem
        gui.configure_theme(show_share_button=False, show_logo=False)
        self.status = gui.add_markdown("")  # first, as it says whether the text below is of the controls
        self.text = gui.add_markdown("")
        with gui.add_folder("Motion"):
            self.time = gui.add_slider("time [s]", 0.0, 1.0, 1e-3, 0.0)
            self.playing = gui.add_checkbox("play", True)
            self.speed = gui.add_dropdown("speed", tuple(SPEEDS), initial_value="1/4")
        self.sliders: dict[str, Any] = {}
        with gui.add_folder("Plan"):
            for p in slider_parameters(problem):
                slider = gui.add_slider(p.label, p.least, p.most, p.step, p.value)
                slider.on_update(lambda _: self.changed())
                self.sliders[p.name] = slider
            self.again = gui.add_button("back to the first plan")
        self.hit = self._server.scene.add_transform_controls(
            "/hit point", scale=0.25, disable_rotations=True, position=problem.point, depth_test=False
        )
        # by the user; `play` draws by itself
        self.time.on_update(lambda event: self._draw() if event.client is not None else None)
        self.hit.on_update(lambda _: self.changed())
        self.again.on_click(lambda _: self.reset())

    def changed(self) -> None:
        """Request a plan for the controls, if they have changed."""
        with self._request_lock:
            x, y, z = (float(v) for v in self.hit.position)
            parameters = tuple((name, float(slider.value)) for name, slider in self.sliders.items())
            request = PlanRequest(point=(x, y, z), parameters=parameters)
            if request != self.request:
                self.ask(request)

    def reset(self) -> None:
        """Reset all controls, and with them the plan, to the first plan."""
        with self._request_lock:
            own = request_of(self.first.problem)
            self.ask(own)  # before the controls change, so that none of them requests a mixture
            for name, value in own.parameters:
                self.sliders[name].value = value
            self.hit.position = np.array(own.point)
            self.ask(own)

    def _show(self, request: PlanRequest, answer: Answer | Exception) -> None:
        if isinstance(answer, Exception):  # an internal error, which must not end the page
            traceback.print_exception(answer)
            answer = Answer(why=f"This is a fault of impactopt: {type(answer).__name__}: {answer}")
        if answer.track is not None:
            self._show_plan(answer)
        with self._request_lock:
            if request == self.request:  # else a newer one is planned, and the status says so
                self.status.content = failure_message(answer) if answer.track is None else ""

    def _show_plan(self, answer: Answer) -> None:
        """Draw this plan in place of the one before."""
        assert answer.solution is not None and answer.track is not None
        with self._scene_lock, self._server.atomic():
            self.answer = answer
            end = float(answer.track.time[-1])
            if float(self.time.value) > end:
                self.time.value = end
            self.time.max = end
            self._drawing.show(answer.solution.problem, answer.track, answer.solution.plan.polygon)
            self._draw()
        self.text.content = plan_message(answer, self.first)

    def _draw(self) -> None:
        with self._scene_lock, self._server.atomic():
            self._drawing.draw(moment_of(self._track, float(self.time.value)))


def plan_message(answer: Answer, first: Solution) -> str:
    """Text with a plan's main results, the effort of its solve, and its worst constraints."""
    solution = answer.solution
    assert solution is not None
    plan, duration = solution.plan, solution.plan.compression + solution.plan.restitution
    lines = [
        f"**{solution.impulse:.2f} N s** (first plan: {first.impulse:.2f})",
        f"- {plan.hand_speed:.2f} m/s at contact",
    ]
    if duration > 0:
        peak = impact_summary(plan, solution.collision, solution.contact_replay)["peak_force_N"]
        lines.append(f"- {peak:.0f} N at most, for {1e3 * duration:.1f} ms")
    for name, label, unit, factor in (
        ("zmp_margin_m", "ZMP margin", " mm", 1e3),
        ("torque_ratio", "torque", " % of its limit", 1e2),
    ):
        values = ", ".join(f"{phase} {factor * x:.0f}" for phase, x in answer.margins.get(name, {}).items())
        lines += [f"- {label}: {values}{unit}"] if values else []
    seconds = first.solve_seconds if solution is first else answer.seconds
    lines.append(f"\n{solution.status.value}: {solution.result.iterations} iterations, {seconds:.2f} s")
    worst = [f"- {violation}" for violation in solution.violations[:MAX_VIOLATIONS]]
    # of an acceptable plan the message has what its program's constraints leave out, such as a clearance
    met = "All constraints are met." if solution.status is Status.SOLVED else solution.result.message
    return "\n".join([*lines, *(["\nViolated constraints:", *worst] if worst else [f"\n{met}"])])


def failure_message(answer: Answer) -> str:
    """Text with the reason that there is no plan; the one before stays drawn."""
    return f"**No plan for this.** {answer.why}\n\nThe plan before is shown ({answer.seconds:.2f} s)."
