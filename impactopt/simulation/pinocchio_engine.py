"""Full dynamics in numeric Pinocchio.

Soles are bilateral constraints, the servo saturates, the target is moved by the contact law's force. Shares
no code with the planner: it reads a reference (times, positions, velocities, feed-forward), the robot's
numbers and the scene's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.robots.robot import Robot
from impactopt.simulation.motors import CutWatch, Delay, GearWatch, Motors, Servo
from impactopt.simulation.pinocchio_robot import PinocchioBody
from impactopt.simulation.result import (
    FollowedReference,
    Scene,
    Simulation,
    Touches,
    check_not_diverged,
    posture_error,
    simulation_of,
    stance_at,
)
from impactopt.simulation.target_dynamics import Push, Struck

Array = NDArray[np.float64]


@dataclass(frozen=True)
class _State:
    q: Array
    v: Array
    x: float  # the target's travel [m]
    target: Array  # and state
    impulses: Array  # that it was given by each striker [N s]
    drive: Array  # torque of the motors [N m]


@dataclass(frozen=True)
class _Rates:
    v: Array
    a: Array
    vt: float  # the target's speed [m/s]
    forces: Array  # of each striker [N]
    hand_speed: float
    asked: Array  # (2, n) of the servos: demand, and what saturation leaves of it
    demand: Array  # that reaches the motors
    wanted: Array  # of it, after saturation
    cut: Array  # what the motors' lines leave of that
    torque: Array  # of the motors, as they are in the state
    push: Push | None  # what the contact comes to in the step that begins here


class _World:
    def __init__(self, robot: Robot, scene: Scene, reference: Any, *, missing: bool = False) -> None:
        self.robot, self.scene, self.missing, self.followed = robot, scene, missing, reference
        self.model, self.base = robot.model, robot.model.nv - robot.n
        self._soles = [robot.model.getFrameId(frame) for frame in scene.soles]
        self._bodies: dict[int, tuple[NDArray[np.intp], PinocchioBody]] = {}
        self._stance = stance_at(reference, 0.0)
        self.held, self.body = self._held(self._stance)
        self.servo, self.struck = Servo(robot, reference), Struck(scene)
        self.motors, self.delay = Motors(robot), Delay(robot)

    def follow(self, reference: Any) -> None:
        """Sets the reference that the servo follows from now on."""
        self.servo, self.followed = Servo(self.robot, reference), reference

    def _held(self, stance: int) -> tuple[NDArray[np.intp], PinocchioBody]:
        """Indices of the soles and hands that are held in a stance phase, and the robot so held."""
        if stance not in self._bodies:
            scene = self.scene
            frames = (*scene.soles, *scene.hands)
            held = np.arange(len(frames))
            if scene.standing.size:
                held = np.flatnonzero(scene.standing[stance])
            chosen = tuple(frames[k] for k in held)
            body = PinocchioBody(
                self.robot, chosen, np.zeros(6), scene.strikers, scene.normal, scene.friction
            )
            self._bodies[stance] = held, body
        return self._bodies[stance]

    def stand(self, t: float, s: _State) -> _State:
        """The state with the soles held that stand from a time [s] on; those that touch down stop at once."""
        if (stance := stance_at(self.followed, t)) == self._stance:
            return s
        before = self.held
        self._stance = stance
        self.held, self.body = self._held(stance)
        if np.isin(self.held, before).all():
            return s
        self.body.look(s.q, s.v)
        return replace(s, v=self.body.stopped(s.v))

    def at_start(self, reference: Any) -> _State:
        """State at the motion's start: at rest, with motors that give the demanded torque."""
        travel = self.struck.travel_at_start(reference)
        return self._begin(0.0, np.array(reference.q[0]), np.zeros(self.model.nv), travel)

    def at_contact(self, reference: Any) -> _State:
        """State at the planned beginning of contact, where the swing's reference ends."""
        k = int(np.flatnonzero(reference.phase == 0)[-1])
        self._stance = stance_at(reference, float(reference.contact_start))
        self.held, self.body = self._held(self._stance)
        return self._begin(float(reference.contact_start), np.array(reference.q[k]), reference.v[k], 0.0)

    def _begin(self, t: float, q: Array, v: Array, travel: float) -> _State:
        """A state before any contact."""
        first = np.array(self.servo.torque(t, self.servo.angles(q), v[self.base :]))
        drive = self.motors.cut(first[1], v[self.base :])
        return _State(q, v, travel, self.struck.untouched, np.zeros(len(self.scene.strikers)), drive)

    def depths(self, s: _State) -> Array:
        """(h,) [m] of the striking points in the target, at the state at which the body has been last; -inf
        where there is none."""
        if self.missing:
            return np.full(len(self.scene.strikers), -np.inf)
        return self.struck.depths(self.body.hand_places(), s.x)

    def rates(self, t: float, s: _State, *, forces: Array | None = None, step: float = 0.0) -> _Rates:
        """Rates of a state under the forces [N] of its step, or those of the step [s] that begins here."""
        body = self.body
        speed = body.look(s.q, s.v)
        speeds, depths = body.rows @ s.v, self.depths(s)
        joints = s.v[self.base :]
        asked = np.array(self.servo.torque(t, self.servo.angles(s.q), joints))
        demand, wanted = self.delay.at(t, asked)
        cut = self.motors.cut(wanted, joints)
        torque = self.motors.now(s.drive, cut)
        push, struck = None, self.struck
        if forces is None:
            forces = struck.forces(depths, speeds, s.target)
            if struck.near(depths, speeds, s.target, step):
                units = np.eye(len(speeds))
                a = body.accelerate(torque, 0.0 * speeds)
                lost = np.column_stack([a - body.accelerate(torque, unit) for unit in units])
                push = struck.pushed(depths, speeds, body.drifts(a), body.rows @ lost, s.target, s.x, step)
        return _Rates(
            v=s.v.copy(),
            a=body.accelerate(torque, forces),
            vt=struck.speed(s.target),
            forces=forces,
            hand_speed=speed,
            asked=asked,
            demand=demand,
            wanted=wanted,
            cut=cut,
            torque=torque,
            push=push,
        )

    def ground(self) -> Array:
        """(soles and hands, 6) wrench of the world on what it holds, about its origin, of the last call of
        ``rates``.
        """
        found = self.body.wrenches()
        found[:, 3:] += np.cross(self.body.places(), found[:, :3])
        out = np.zeros((len(self.scene.soles) + len(self.scene.hands), 6))
        out[self.held] = found
        return out

    def corners(self) -> Array:
        """World places (k, 3) of all soles' corners."""
        at = [pin.updateFramePlacement(self.model, self.body.data, frame) for frame in self._soles]
        places = [
            np.column_stack([c, np.zeros(len(c))]) @ m.rotation.T + m.translation
            for m, c in zip(at, self.scene.corners, strict=True)
        ]
        return np.concatenate([np.zeros((0, 3)), *places])

    def step(self, t: float, s: _State, first: _Rates, h: float) -> _State:
        """A step of the midpoint rule from a state with its rates, under the contact's mean force in it.

        The body is where `rates` has left it: at the state.
        """
        push = first.push
        a = first.a
        if push is not None and np.any(push.halves != first.forces):
            a = self.body.accelerate(first.torque, push.halves)
        half = _State(
            q=pin.integrate(self.model, s.q, h / 2 * s.v),
            v=s.v + h / 2 * a,
            x=s.x,
            target=s.target,
            impulses=s.impulses,
            drive=self.motors.after(s.drive, first.cut, h / 2),
        )
        middle = self.rates(t + h / 2, half, forces=0.0 * first.forces if push is None else push.forces)
        if push is None:
            target, travel = self.struck.untouched_step(s.target, s.x, h)
        else:
            target, travel = push.state, push.travel
        after = _State(
            q=pin.integrate(self.model, s.q, h * middle.v),
            v=s.v + h * middle.a,
            x=travel,
            target=target,
            impulses=s.impulses + h * middle.forces,
            drive=self.motors.after(s.drive, middle.cut, h),
        )
        if push is None:
            return after
        # depths are the contact's: they are followed more exactly there than the arms are
        self.body.look(after.q, after.v)
        gone = self.depths(replace(after, x=0.0)) - push.depths
        known = gone[np.isfinite(gone)]
        return replace(after, x=float(known.mean())) if known.size else after


@dataclass(frozen=True, kw_only=True)
class Followed:
    """A contact, from where it is planned to begin.

    impulse [N s] to the target.  peak [N] : the largest force of all strikers together.  outcome : of the
    target, by name and unit.  touches : start and end [s] since contact of each time that they touch.
    events : when [s] since contact the target has switched.
    """

    impulse: float
    peak: float
    outcome: dict[str, float]
    touches: tuple[tuple[float, float], ...]
    events: tuple[float, ...]


def follow_contact(
    robot: Robot, reference: Any, scene: Scene, *, step: float, until: float, longest: float
) -> Followed:
    """The contact alone, in the same full dynamics, from the state and at the time at which it is planned.

    reference : as of :func:`simulate_pinocchio`.
    step [s] : at most; less where the servo's damping needs it.
    until [s] : since contact: it goes on for so long, and from then on while they touch, for the `longest`
        time.

    Raises
    ------
    InputError : it diverges.
    """
    world = _World(robot, scene, reference)
    state, start = world.at_contact(reference), float(reference.contact_start)
    world.body.look(state.q, state.v)
    fastest = world.body.fastest_rate(np.diag(world.servo.kd))
    step = min(step, 1 / fastest) if fastest > 0 else step  # explicit midpoint rule: stable up to twice that
    left, peak, touches = state.target, 0.0, list[list[float]]()
    side, events = world.struck.side(state.target, 0.0), list[float]()
    touching = False
    for k in range(round(longest / step)):
        since = k * step
        if since >= until and not touching:
            break
        first = world.rates(start + since, state, step=step)
        world.delay.keep(start + since, first.asked)
        push = first.push
        if push is None:
            touching = False
        else:
            peak = max(peak, push.peak)
            for t, on in zip(since + push.times, push.touching, strict=True):
                if on and not touching:
                    touches.append([t, t])
                if on:
                    touches[-1][1] = t
                touching = bool(on)
        before, state = state, world.step(start + since, state, first, step)
        now = world.struck.side(state.target, 0.0 if push is None else push.last)
        events += [since + step] if now != side else []
        side = now
        left = state.target if state.impulses.sum() > before.impulses.sum() else left
        check_not_diverged(state.v, start + since, step)
    return Followed(
        impulse=float(state.impulses.sum()),
        peak=peak,
        outcome=scene.target.outcome(left),
        touches=tuple((float(a), float(b)) for a, b in touches),
        events=tuple(events),
    )


def simulate_pinocchio(
    robot: Robot,
    reference: Any,
    scene: Scene,
    *,
    step: float = 2e-4,
    settle: float = 0.3,
    record: int = 5,
    missing: bool = False,
    missed: Any = None,
    until: float = np.inf,
) -> Simulation:
    """The whole motion from the reference's first posture at rest, in constrained forward dynamics.

    reference : time (k,) [s], q (k, nq), v (k, nv), torque (k, n), as of
    :class:`impactopt.transcription.plan.Trajectory`. step [s] : of the explicit midpoint rule (second
        order).  settle [s] : simulated beyond the end of the reference's motion.
    until [s] : it ends, if that is earlier.
    record : steps between recorded instants; every step is recorded in contact.
    missing : there is no target.  missed : the reference of a robot that hits nothing, which it notices at
        ``missed.contact_end`` (:class:`impactopt.simulation.result.FollowedReference`); default: it
        does not.

    Raises
    ------
    InputError : the simulation diverges (with the time at which it did).
    """
    world = _World(robot, scene, reference, missing=missing)
    state = world.at_start(reference)
    left = state.target  # as the last touch has left it
    end = min(float(reference.end) + settle, until)
    rows: list[tuple[Any, ...]] = []
    saturated = peak = 0.0
    touches, gears, cuts = Touches(), GearWatch(robot), CutWatch(robot)
    followed = FollowedReference(reference, missed)
    for k in range(round(end / step)):
        t = k * step
        if (now := followed.at(t, bool(touches.intervals))) is not world.followed:
            world.follow(now)
        state = world.stand(t, state)
        first = world.rates(t, state, step=step)
        world.delay.keep(t, first.asked)
        cuts.look(t, first.wanted, first.cut, step)
        push = first.push
        saturated += step * bool(np.any(np.abs(first.demand) > world.servo.limit))
        if push is None:
            touches.add(t, 0.0, step)
        else:
            touches.add(t, push.force, step, push.since)
        peak = max(peak, float(first.forces.sum()) if push is None else push.peak)
        gears.look(first.torque, first.a)
        if touches.touched or k % record == 0:
            motion = (state.q, state.v, float(first.forces.sum()), first.vt, first.hand_speed)
            rows.append(
                (
                    t,
                    *motion,
                    first.demand,
                    first.torque,
                    world.ground(),
                    world.corners(),
                    gears.taken(),
                    stance_at(now, t),
                )
            )
        if push is not None:  # the force of a contact that begins within the step jumps there
            gears.look(first.torque, world.body.accelerate(first.torque, push.peaks))
        before, state = state, world.step(t, state, first, step)
        left = state.target if state.impulses.sum() > before.impulses.sum() else left
        check_not_diverged(state.v, t, step)
    return simulation_of(
        robot,
        scene,
        rows,
        touches,
        engine="pinocchio",
        impulse=float(state.impulses.sum()),
        impulses=state.impulses,
        peak_force=peak,
        outcome=scene.target.outcome(left),
        saturated=saturated,
        cuts=cuts.told() if world.motors.lines else None,
        posture_error=posture_error(robot.model, state.q, np.asarray(world.followed.q[-1])),
        fall=None,
        missed=missing,
    )
