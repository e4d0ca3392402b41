"""Live page of one collision: sliders for the posture and the speed, with force and ZMP at once."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.collision import SDC, Collision
from impactopt.errors import InputError
from impactopt.kinematics.operational_space import holding_torque, striking_velocity
from impactopt.kinematics.support import margin, support_polygon
from impactopt.live.drawing import Drawing, Moment
from impactopt.live.requests import LatestRequest
from impactopt.live.server import LOCAL, LivePage, served
from impactopt.problem.problem import ImpactProblem

__all__ = ["Blow", "LiveBlow"]

Array = NDArray[np.float64]
_SPEED = 0.05, 1.0, 4.0  # [m/s] least, at first, and most
_STEPS = 200  # of a slider
_FREEZES = 4
_ENDLESS = np.pi  # [rad] of a joint without limits


@dataclass(frozen=True, kw_only=True, eq=False)
class Blow:
    """Collision of a posture. q (nq): as drawn; collision: None if there is none, and why gives the
    reason.
    """

    q: Array | None = None
    collision: Collision | None = None
    seconds: float = 0.0
    why: str = ""


class LiveBlow(LivePage):
    """A page that is served until it is closed: the robot hits with its hand where that is, along the normal.

    problem : its robot, stance, contact law and target; the posture at first reaches its point. What holds
        the soles stays, as legs follow by inverse kinematics. The model is the SDC with 4 freezes.
    host, port : where the page is served; 0: a port that is free.

    Attributes
    ----------
    address : of the page.  blow : the newest.  joints : sliders [rad] by name; speed : that of the hand
    [m/s].

    Raises
    ------
    InputError : viser is missing; a problem with two strikers, or a hand that holds on; host or port cannot
        be had.
    """

    def __init__(self, problem: ImpactProblem, *, host: str = LOCAL, port: int = 0) -> None:
        self.problem, c = problem, problem.coordinates
        if problem.second is not None or c.hands or problem.friction is not None:
            raise InputError(
                "a collision's page has one hand that strikes, without friction, and none that holds on: "
                "solve it"
            )
        self._y, self._legs = c.split(problem.contact_posture)
        self._polygon = support_polygon(problem.robot, c)
        names = ("robot", "striker", "normal", "law", "target", "stance")
        self._model = SDC(**{name: getattr(problem, name) for name in names}, freezes=_FREEZES)
        self._server, self.address = served(host, port)
        self._drawing = Drawing(self._server, problem.robot, problem.ground_height)
        self._drawing.normal = problem.normal
        self._drawing.polygon(self._polygon)
        model = problem.robot.model
        mass = np.array(pin.centerOfMass(model, model.createData(), problem.contact_posture))
        self._drawing.watch(mass, problem.point, problem.normal, float(mass[1]))
        self._controls()
        self.blow = Blow()
        self._latest = LatestRequest(self._strike, self._told)
        self.changed()

    def changed(self) -> None:
        """Collide in the posture and at the speed that the sliders say."""
        self._latest.ask(np.array([float(s.value) for s in (self.speed, *self.joints.values())]))

    def run(self) -> None:
        """Serves the page until Ctrl-C."""
        while True:
            time.sleep(1.0)

    def _controls(self) -> None:
        gui, robot, c = self._server.gui, self.problem.robot, self.problem.coordinates
        gui.configure_theme(show_share_button=False, show_logo=False)
        self.told = gui.add_markdown("Colliding ...")
        least, first, most = _SPEED
        self.speed = gui.add_slider("speed [m/s]", least, most, (most - least) / _STEPS, first)
        self.joints: dict[str, Any] = {}
        with gui.add_folder("Posture [rad]"):
            for k, joint in enumerate(c.independent):
                low, high = max(robot.lower[joint], -_ENDLESS), min(robot.upper[joint], _ENDLESS)
                value = float(np.clip(self._y[c.base + k], low, high))
                step = float(high - low) / _STEPS
                name = robot.joint_names[joint]
                self.joints[name] = gui.add_slider(name, float(low), float(high), step, value)
        for slider in (self.speed, *self.joints.values()):
            slider.on_update(lambda _: self.changed())

    def _strike(self, request: Array, stale: Callable[[], bool]) -> Blow:
        began = time.perf_counter()
        p, c = self.problem, self.problem.coordinates
        speed, y = float(request[0]), self._y.copy()
        y[c.base :] = request[1:]
        q = c.join(y, self._legs)
        try:
            v = striking_velocity(p.robot, q, p.striker, p.normal, speed, stance=p.stance)
            torque = holding_torque(p.robot, q, v, stance=p.stance)
            collision = self._model.collide(q, v, torque, require_separation=False)
        except InputError as error:
            return Blow(q=q, seconds=time.perf_counter() - began, why=str(error))
        why = "" if collision.separated else "the contact does not end"
        return Blow(q=q, collision=collision, seconds=time.perf_counter() - began, why=why)

    def _told(self, _: Array, blow: Blow | Exception) -> None:
        if isinstance(blow, Exception):  # a fault of ours, which must not end the page
            traceback.print_exception(blow)
            self.told.content = f"This is a fault of impactopt: {type(blow).__name__}: {blow}"
            return
        self.blow = blow
        with self._server.atomic():
            self._draw(blow)
        self.told.content = self._words(blow)

    def _draw(self, blow: Blow) -> None:
        assert blow.q is not None
        robot, hit = self.problem.robot, blow.collision
        model, data = robot.model, robot.model.createData()
        pin.framesForwardKinematics(model, data, blow.q)
        places = np.array([pin.SE3ToXYZQUAT(place) for place in data.oMi])
        zmp = np.full(2, np.nan)
        if hit is not None and hit.zmp is not None and len(self._polygon):
            inside = margin(self._polygon, hit.zmp)
            zmp = hit.zmp[int(np.argmin(np.where(np.isfinite(inside), inside, np.inf)))]
            self._drawing.path("/path of the ZMP", np.column_stack([hit.zmp, np.zeros(len(hit.zmp))]))
        frame = model.getFrameId(robot.striker(self.problem.striker).model_frame)
        force = 0.0 if hit is None else hit.peak_force
        self._drawing.largest = max(self._drawing.largest, force)
        self._drawing.at(
            Moment(
                time=0.0,
                place=places[:, :3],
                turn=places[:, [6, 3, 4, 5]],
                hand=np.array(data.oMf[frame].translation),
                mass=np.array(pin.centerOfMass(model, data, blow.q)),
                force=force,
                travel=0.0,
                zmp=zmp,
            )
        )

    def _words(self, blow: Blow) -> str:
        hit = blow.collision
        if hit is None:
            return f"**No collision.** {blow.why}"
        lines = [f"**{hit.impulse:.3g} N s**" + (f" ({blow.why})" if blow.why else "")]
        lines.append(f"- {hit.peak_force:.0f} N at most, for {1e3 * hit.duration:.1f} ms")
        if hit.zmp is not None and len(self._polygon):
            inside = float(np.min(margin(self._polygon, hit.zmp)))
            lines.append(
                f"- ZMP margin {1e3 * inside:.0f} mm" + ("" if inside > 0 else ": it leaves the soles")
            )
        if hit.demand is not None:
            ratio = np.abs(hit.demand / self.problem.robot.torque_limit).max(axis=0)
            worst = int(np.argmax(ratio))
            name = self.problem.robot.joint_names[worst]
            lines.append(f"- torque demand {100 * ratio[worst]:.0f} % of the limit ({name})")
        return "\n".join([*lines, f"\n{blow.seconds:.2f} s"])
