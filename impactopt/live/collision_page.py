"""Live page of one collision, with sliders for the posture and the speed."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from impactopt.arrays import Array
from impactopt.collide.contact_states import NOT_APPROACHING
from impactopt.collide.single_collision import finer, meets_again, zmp_margins
from impactopt.collision import SDC, Collision
from impactopt.errors import InputError
from impactopt.kinematics.operational_space import holding_torque, striking_velocity
from impactopt.kinematics.stance import support_polygon
from impactopt.live.drawing import Drawing, Moment
from impactopt.live.requests import LatestRequest
from impactopt.live.server import LivePage, served
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.strength import drawn_ranges
from impactopt.report.tracks import places_of

_MIN_SPEED, _FIRST_SPEED, _MAX_SPEED = 0.05, 1.0, 4.0  # [m/s]
_SLIDER_STEPS = 200
_FREEZES = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class ShownCollision:
    """Collision in a posture.

    q (nq,) : as drawn.  v (nv,) : at contact.  collision : None if there is none.  seconds : of the
    computation.  why : reason that there is no collision, or that it has not ended; else "".
    """

    q: Array | None = None
    v: Array | None = None
    collision: Collision | None = None
    seconds: float = 0.0
    why: str = ""


class CollisionPage(LivePage):
    """Page of a collision, served until it is closed: the striker hits where it is, along the normal.

    problem : its robot, stance, contact law and target; the first posture reaches its point. The soles stay
        in place, as the legs follow by inverse kinematics. The model is the SDC with 4 freezes.
    port : of the page, on this machine; 0: a free one.

    Attributes
    ----------
    address : of the page.  shown : the latest collision.  joints : sliders [rad], [m] by name.  speed :
    slider of the striker's speed [m/s].

    Raises
    ------
    InputError : viser is missing; a problem with two strikers, a supporting hand, friction or a soft grip;
        the port is not available.
    """

    def __init__(self, problem: ImpactProblem, *, port: int = 0) -> None:
        self.problem, c = problem, problem.coordinates
        if problem.second is not None or c.hands or problem.friction is not None:
            raise InputError(
                "a collision's page has one hand that strikes, without friction, and none that holds on: "
                "solve it"
            )
        if problem.robot.sprung.any():
            raise InputError(
                "a collision's page has no soft grip, which needs full dynamics: solve the problem"
            )
        self._y, self._legs = c.split(problem.contact_posture)
        self._polygon = support_polygon(problem.robot, c)
        self._model = SDC(**problem.scene, freezes=_FREEZES)
        self._server, self.address = served(port)
        self._drawing = Drawing(self._server, problem.robot, problem.ground_height)
        self._drawing.normal = problem.normal
        self._drawing.polygon(self._polygon)
        model = problem.robot.model
        mass = np.array(pin.centerOfMass(model, model.createData(), problem.contact_posture))
        self._drawing.aim_camera(mass, problem.point, problem.normal, float(mass[1]))
        self._add_controls()
        self.shown = ShownCollision()
        self._latest = LatestRequest(self._collide, self._show)
        self.changed()

    def changed(self) -> None:
        """Request the collision in the posture and at the speed of the sliders."""
        self._latest.ask(np.array([float(s.value) for s in (self.speed, *self.joints.values())]))

    def run(self) -> None:
        """Serve the page until Ctrl-C."""
        while True:
            time.sleep(1.0)

    def _add_controls(self) -> None:
        gui, robot, c = self._server.gui, self.problem.robot, self.problem.coordinates
        gui.configure_theme(show_share_button=False, show_logo=False)
        self.text = gui.add_markdown("Colliding ...")
        step = (_MAX_SPEED - _MIN_SPEED) / _SLIDER_STEPS
        self.speed = gui.add_slider("speed [m/s]", _MIN_SPEED, _MAX_SPEED, step, _FIRST_SPEED)
        self.joints: dict[str, Any] = {}
        with gui.add_folder("Posture"):
            lower, upper = drawn_ranges(robot)
            for k, joint in enumerate(c.independent):
                low, high = lower[joint], upper[joint]
                value = float(np.clip(self._y[c.base + k], low, high))
                step = float(high - low) / _SLIDER_STEPS
                name, unit = robot.joint_names[joint], "m" if robot.prismatic[joint] else "rad"
                self.joints[name] = gui.add_slider(f"{name} [{unit}]", float(low), float(high), step, value)
        for slider in (self.speed, *self.joints.values()):
            slider.on_update(lambda _: self.changed())

    def _collide(self, request: Array, stale: Callable[[], bool]) -> ShownCollision:
        """Collision for a request: speed [m/s], and the sliders' angles [rad] and travels [m]."""
        began = time.perf_counter()
        p, c = self.problem, self.problem.coordinates
        speed, y = float(request[0]), self._y.copy()
        y[c.base :] = request[1:]
        q = c.join(y, self._legs)
        if speed <= p.target.speed_before():
            return ShownCollision(q=q, seconds=time.perf_counter() - began, why=NOT_APPROACHING)
        try:
            v = striking_velocity(p.robot, q, p.striker, p.normal, speed, stance=p.stance)
            torque = holding_torque(p.robot, q, v, stance=p.stance)
            collision = self._model.collide(q, v, torque, require_separation=False)
            for model, _ in finer(self._model, np.array([collision.duration])):
                collision = model.collide(q, v, torque, require_separation=False)
        except InputError as error:
            return ShownCollision(q=q, seconds=time.perf_counter() - began, why=str(error))
        why = "" if collision.separated else "the contact does not end"
        return ShownCollision(q=q, v=v, collision=collision, seconds=time.perf_counter() - began, why=why)

    def _show(self, _: Array, outcome: ShownCollision | Exception) -> None:
        if isinstance(outcome, Exception):  # an internal error, which must not end the page
            traceback.print_exception(outcome)
            self.text.content = f"This is a fault of impactopt: {type(outcome).__name__}: {outcome}"
            return
        self.shown = outcome
        with self._server.atomic():
            self._draw(outcome)
        self.text.content = self._summary(outcome)

    def _draw(self, shown: ShownCollision) -> None:
        assert shown.q is not None
        robot, collision = self.problem.robot, shown.collision
        striker = robot.striker(self.problem.striker)
        places, hand, mass = places_of(robot, striker.model_frame, shown.q[None])
        zmp = np.full(2, np.nan)
        if collision is not None and collision.zmp is not None and len(self._polygon):
            # drawn where its margin is least
            inside = self._margins(collision)
            zmp = collision.zmp[int(np.argmin(np.where(np.isfinite(inside), inside, np.inf)))]
            path = np.column_stack([collision.zmp, np.zeros(len(collision.zmp))])
            self._drawing.path("/path of the ZMP", path)
        force = 0.0 if collision is None else collision.peak_force
        self._drawing.largest = max(self._drawing.largest, force)
        self._drawing.draw(
            Moment(
                place=places[0, :, :3],
                turn=places[0][:, [6, 3, 4, 5]],  # Pinocchio has w last, viser first
                hand=hand[0],
                mass=mass[0],
                force=force,
                travel=0.0,
                aside=np.zeros(3),
                zmp=zmp,
            )
        )

    def _margins(self, collision: Collision) -> Array:
        """Margins (k,) [m] of the ZMP, minus infinity without a load on the ground."""
        assert collision.ground_wrench is not None
        return zmp_margins(self.problem.robot, self._polygon, collision.ground_wrench)

    def _summary(self, shown: ShownCollision) -> str:
        collision, robot = shown.collision, self.problem.robot
        if collision is None:
            return f"**No collision.** {shown.why}"
        lines = [f"**{collision.impulse:.3g} N s**" + (f" ({shown.why})" if shown.why else "")]
        lines.append(f"- {collision.peak_force:.0f} N at most, for {1e3 * collision.duration:.1f} ms")
        if again := meets_again(self.problem.target, collision):
            lines.append(f"- {again}")
        if collision.zmp is not None and len(self._polygon):
            inside = float(self._margins(collision).min())
            lines.append(
                f"- ZMP margin {1e3 * inside:.0f} mm" + ("" if inside > 0 else ": it leaves the soles")
                if np.isfinite(inside)
                else "- no ZMP: the ground would have to pull the soles"
            )
        if collision.demand is not None:
            lines.append(self._worst("torque demand", collision.demand / robot.torque_limit))
        if shown.v is not None:
            lines.append(self._worst("joint speed", shown.v[-robot.n :] / robot.velocity_limit))
        return "\n".join([*lines, f"\n{shown.seconds:.2f} s"])

    def _worst(self, what: str, shares: Array) -> str:
        """Line about the joint with the largest share (..., n) of its limit."""
        most = np.abs(shares).reshape(-1, self.problem.robot.n).max(axis=0)
        worst = int(np.argmax(most))
        return f"- {what} {100 * most[worst]:.0f} % of the limit ({self.problem.robot.joint_names[worst]})"
