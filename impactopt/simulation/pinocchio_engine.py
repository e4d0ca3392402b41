"""Replay in Pinocchio's full dynamics, with soles as bilateral constraints.

The servo saturates, and the contact law's force moves the target. The engine shares no code with the planner:
it reads a reference (times, positions, velocities, feed-forward), the robot's parameters and the scene.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pinocchio as pin

from impactopt.arrays import Array, Index
from impactopt.contact.friction import tangential_mobility, tangential_outcome
from impactopt.robots.robot import Robot
from impactopt.simulation.motors import CutWatch, Delay, GearWatch, Motors, Servo
from impactopt.simulation.pinocchio_robot import Body, recursive_body
from impactopt.simulation.result import (
    FollowedReference,
    Scene,
    Simulation,
    Touches,
    check_not_diverged,
    cross,
    posture_error,
    simulation_of,
    stance_at,
)
from impactopt.simulation.target_dynamics import Push, TargetContact


@dataclass(frozen=True)
class _State:
    """State of robot, target and motors, and the impulses so far."""

    q: Array
    v: Array
    travel: float  # of the target [m]
    target: Array  # its state
    impulses: Array  # (h,) of each striker on the target [N s]
    drive: Array  # (n,) torque of the motors [N m]
    deflections: Array  # (h, 3) of the strikers' bristles [m]
    tangential: Array  # (2, 3) displacement [m] and velocity [m/s] of the target across the normal


@dataclass(frozen=True)
class _Torques:
    """Torques (n,) [N m] in a state, from the servo to the joints."""

    commanded: Array  # (2, n) demand of the servo, and the demand after saturation
    demand: Array  # demand that reaches the motors, after the delay
    saturated: Array  # the same after saturation
    cut: Array  # after the motors' torque-speed lines
    motors: Array  # of the motors in this state, which follow `cut` with their time constant


@dataclass(frozen=True)
class _Rates:
    """Accelerations, contact and torques in the state in which a step begins."""

    a: Array
    hand_speed: float  # of the first striking point along the normal [m/s]
    torques: _Torques
    forces: Array | None  # (h,) of each striker [N]; None: no contact is near
    push: Push | None  # contact in the step; None: no contact is near


class _World:
    """Robot, target and servo of a replay, with the frames of the current stance phase fixed."""

    def __init__(self, robot: Robot, scene: Scene, reference: Any, *, missing: bool = False) -> None:
        self.robot, self.scene, self.missing, self.followed = robot, scene, missing, reference
        self.model, self.base = robot.model, robot.model.nv - robot.n
        self._soles = [robot.model.getFrameId(frame) for frame in scene.soles]
        self._bodies: dict[int, tuple[Index, Body]] = {}
        self._stance = stance_at(reference, 0.0)
        self.fixed, self.body = self._body_of(self._stance)
        self.servo, self.contact = Servo(robot, reference), TargetContact(scene)
        self.motors, self.delay = Motors(robot), Delay(robot)
        self.mobility = tangential_mobility(scene.friction, scene.target, scene.target.parameters)

    def follow(self, reference: Any) -> None:
        """Sets the reference that the servo follows from now on."""
        self.servo, self.followed = Servo(self.robot, reference), reference

    def _body_of(self, stance: int) -> tuple[Index, Body]:
        """Indices of the soles and hands that are fixed in a stance phase, and the robot's dynamics then."""
        if stance not in self._bodies:
            scene = self.scene
            frames = (*scene.soles, *scene.hands)
            fixed = np.arange(len(frames))
            if scene.standing.size:
                fixed = np.flatnonzero(scene.standing[stance])
            chosen = tuple(frames[k] for k in fixed)
            body = recursive_body(
                self.robot, chosen, np.zeros(6), scene.strikers, scene.normal, scene.friction
            )
            self._bodies[stance] = fixed, body
        return self._bodies[stance]

    def switch_stance(self, t: float, s: _State) -> _State:
        """State after fixing the soles that stand at a time [s]; soles that touch down stop inelastically."""
        if (stance := stance_at(self.followed, t)) == self._stance:
            return s
        before = self.fixed
        self._stance = stance
        self.fixed, self.body = self._body_of(stance)
        if np.isin(self.fixed, before).all():  # soles only lift off
            return s
        self.body.update(s.q, s.v)
        return replace(s, v=self.body.after_touchdown(s.v))

    def at_start(self, reference: Any) -> _State:
        """State at the motion's start: at rest, with motors that deliver the demanded torque."""
        travel = self.contact.travel_at_start(reference)
        return self._without_contact(0.0, np.array(reference.q[0]), np.zeros(self.model.nv), travel)

    def at_contact(self, reference: Any) -> _State:
        """State at the planned beginning of contact, where the swing's reference ends."""
        k = int(np.flatnonzero(reference.phase == 0)[-1])
        self._stance = stance_at(reference, float(reference.contact_start))
        self.fixed, self.body = self._body_of(self._stance)
        return self._without_contact(
            float(reference.contact_start), np.array(reference.q[k]), reference.v[k], 0.0
        )

    def _without_contact(self, t: float, q: Array, v: Array, travel: float) -> _State:
        """State before any contact."""
        commanded = np.array(self.servo.torque(t, self.robot.angles.of(q), v[self.base :]))
        drive = self.motors.cut(commanded[1], v[self.base :])
        h = len(self.scene.strikers)
        straight = np.zeros((h, 3)), np.zeros((2, 3))
        return _State(q, v, travel, self.contact.untouched, np.zeros(h), drive, *straight)

    def depths(self, s: _State) -> Array:
        """Depths (h,) [m] of the striking points in the target, in the current state; -inf without one."""
        if self.missing:
            return np.full(len(self.scene.strikers), -np.inf)
        return self.contact.depths(self.body.striking_points() - s.tangential[0], s.travel)

    def torques(self, t: float, s: _State) -> _Torques:
        """Torques in a state at a time [s]."""
        joints = s.v[self.base :]
        commanded = np.array(self.servo.torque(t, self.robot.angles.of(s.q), joints))
        demand, saturated = self.delay.at(t, commanded)
        cut = self.motors.cut(saturated, joints)
        return _Torques(commanded, demand, saturated, cut, self.motors.now(s.drive, cut))

    def rates(self, t: float, s: _State, step: float) -> _Rates:
        """Rates of a state; the contact is integrated over the step [s] that begins in it."""
        body, contact, torques = self.body, self.contact, self.torques(t, s)
        body.update(s.q, s.v)
        speeds, depths, torque = body.speeds(), self.depths(s), torques.motors
        push = forces = None
        if contact.near(depths, speeds, s.target, step):
            body.update_contact()
            forces = contact.forces(depths, speeds, s.target)
            body.bend(s.deflections, forces, s.tangential[1])
            units = np.eye(len(speeds))
            a = body.accelerate(torque, None)
            # Accelerations are affine in the contact forces: differences with unit forces give the
            # response, and with it J P J', whatever is fixed, without inverting H.
            response = np.column_stack([a - body.accelerate(torque, unit) for unit in units])
            inverse_mass = body.normal_jacobian @ response
            push = contact.pushed(
                depths, speeds, body.normal_accelerations(a), inverse_mass, s.target, s.travel, step
            )
        return _Rates(body.accelerate(torque, forces), float(speeds[0]), torques, forces, push)

    def ground(self) -> Array:
        """Wrenches (soles and hands, 6) of the world on them, about its origin, of the last `rates`."""
        wrenches = self.body.wrenches()
        wrenches[:, 3:] += cross(self.body.origins(), wrenches[:, :3])
        out = np.zeros((len(self.scene.soles) + len(self.scene.hands), 6))
        out[self.fixed] = wrenches
        return out

    def corners(self) -> Array:
        """World positions (k, 3) [m] of all soles' corners."""
        at = [pin.updateFramePlacement(self.model, self.body.data, frame) for frame in self._soles]
        places = [
            np.column_stack([c, np.zeros(len(c))]) @ m.rotation.T + m.translation
            for m, c in zip(at, self.scene.corners, strict=True)
        ]
        return np.concatenate([np.zeros((0, 3)), *places])

    def outcome(self, last_touched: Array, s: _State) -> dict[str, float]:
        """Outcome from the target's state at the last touch (n_states,), and a state after it."""
        found = self.scene.target.outcome(last_touched)
        return found | tangential_outcome(s.tangential[1]) if self.mobility else found

    def _pushed_tangentially(self, before: Array, s: _State, forces: Array | None, h: float) -> Array:
        """`_State.tangential` after a step [s] from `before`, by the rates in the body's state `s`.

        forces : (h,) [N] normal ones; None: there is no contact.
        """
        if not self.mobility or self.body.sliding is None:
            return before
        friction = np.zeros(3) if forces is None else self.body.sliding.on_target(forces)
        return before + h * np.array([s.tangential[1], self.mobility * friction])

    def step(self, t: float, s: _State, first: _Rates, h: float) -> _State:
        """State after a step h [s] of the explicit midpoint rule, under the contact's mean forces in it.

        first : rates at the state `s`, for which they must have been evaluated last.
        """
        push, body = first.push, self.body
        a, bent, forces = first.a, None, None
        if push is not None:
            # Mean forces of the whole step, so that momentum is exchanged exactly as the target's integration
            # has it; in its first half, those of that half.
            bent, forces = push.first_half, push.forces
            if np.any(bent != first.forces):
                a = body.accelerate(first.torques.motors, bent)
        deflections = body.deflected(s.deflections, bent, h / 2)
        tangential = self._pushed_tangentially(s.tangential, s, bent, h / 2)
        half = _State(
            # explicit midpoint rule: half a step by the rates at the start, then a whole one by the rates in
            # its middle
            q=pin.integrate(self.model, s.q, h / 2 * s.v),
            v=s.v + h / 2 * a,
            travel=s.travel,
            target=s.target,
            impulses=s.impulses,
            drive=self.motors.after(s.drive, first.torques.cut, h / 2),
            deflections=deflections,
            tangential=tangential,
        )
        middle = self.torques(t + h / 2, half)
        body.update(half.q, half.v)
        if forces is not None:
            body.update_contact()
            body.bend(half.deflections, forces, half.tangential[1])
        if push is None:
            target, travel = self.contact.untouched_step(s.target, s.travel, h)
        else:
            target, travel = push.state, push.travel
        after = _State(
            q=pin.integrate(self.model, s.q, h * half.v),
            v=s.v + h * body.accelerate(middle.motors, forces),
            travel=travel,
            target=target,
            impulses=s.impulses if forces is None else s.impulses + h * forces,
            drive=self.motors.after(s.drive, middle.cut, h),
            deflections=body.deflected(s.deflections, forces, h),
            tangential=self._pushed_tangentially(s.tangential, half, forces, h),
        )
        if push is None:
            return after
        # The contact's integration gives depths more exactly than the midpoint rule gives the robot: take the
        # travel that makes them agree.
        body.update(after.q, after.v)
        travels = self.depths(replace(after, travel=0.0)) - push.depths
        # a point beside the target's surface has no depth
        known = travels[np.isfinite(travels)]
        return replace(after, travel=float(known.mean())) if known.size else after


@dataclass(frozen=True, kw_only=True)
class Followed:
    """Result of the contact alone, from its planned beginning.

    impulse [N s] : on the target
    peak [N] : largest force of all strikers together
    outcome : of the target, by name and unit
    touches : start and end [s] of each touch, since the planned beginning of contact
    events : times [s] since then at which the target switched
    """

    impulse: float
    peak: float
    outcome: dict[str, float]
    touches: tuple[tuple[float, float], ...]
    events: tuple[float, ...]


def follow_contact(
    robot: Robot, reference: Any, scene: Scene, *, step: float, until: float, longest: float
) -> Followed:
    """Simulates the contact alone, in the same full dynamics, from its planned state and time.

    reference : as of :func:`simulate_pinocchio`.
    step [s] : at most; smaller where the servo's damping requires it.
    until, longest [s] : since contact; the simulation ends at the first instant after `until` without a
        touch, and at `longest` in any case.

    Raises
    ------
    InputError : the simulation diverges.
    """
    world = _World(robot, scene, reference)
    state, start = world.at_contact(reference), float(reference.contact_start)
    world.body.update(state.q, state.v)
    fastest = world.body.fastest_rate(np.diag(world.servo.kd))
    step = min(step, 1 / fastest) if fastest > 0 else step  # explicit midpoint rule: stable up to 2 / fastest
    last_touched, touches = state.target, Touches()  # target state at the last touch
    side, events = world.contact.side(state.target, 0.0), list[float]()
    for k in range(round(longest / step)):
        since = k * step
        if since >= until and not touches.touching:
            break
        first = world.rates(start + since, state, step)
        world.delay.keep(start + since, first.torques.commanded)
        push = first.push
        touches.add(since, push)
        state = world.step(start + since, state, first, step)
        now = world.contact.side(state.target, 0.0 if push is None else float(push.total[-1]))
        events += [since + step] if now != side else []
        side = now
        last_touched = state.target if push is not None and push.given[-1] > 0 else last_touched
        check_not_diverged(state.v, start + since, step)
    return Followed(
        impulse=float(state.impulses.sum()),
        peak=float(touches.curve()[1].max(initial=0.0)),
        outcome=world.outcome(last_touched, state),
        touches=tuple((start, end) for start, end, _ in touches.intervals),
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
    """Simulates the whole motion from the reference's first posture at rest, in constrained forward dynamics.

    reference : time (k,) [s], q (k, nq), v (k, nv), torque (k, n), as
        :class:`impactopt.transcription.plan.Trajectory`.
    step [s] : of the explicit midpoint rule (second order).
    settle [s] : simulated beyond the end of the reference's motion.
    until [s] : ends the simulation earlier.
    record : steps between recorded instants; in contact every step is recorded.
    missing : there is no target.
    missed : reference of a robot that hit nothing, followed from ``missed.contact_end`` on
        (:class:`impactopt.simulation.result.FollowedReference`); default: the robot does not notice.

    Raises
    ------
    InputError : the simulation diverges (with the time at which it did).
    """
    world = _World(robot, scene, reference, missing=missing)
    state = world.at_start(reference)
    last_touched = state.target  # the target's state at the last touch
    end = min(float(reference.end) + settle, until)
    recorded: list[tuple[Any, ...]] = []
    saturated = 0.0
    touches, gears, cuts = Touches(), GearWatch(robot), CutWatch(robot)
    followed = FollowedReference(reference, missed)
    for k in range(round(end / step)):
        t = k * step
        if (now := followed.at(t, bool(touches.intervals))) is not world.followed:
            world.follow(now)
        state = world.switch_stance(t, state)
        first = world.rates(t, state, step)
        torques, push = first.torques, first.push
        world.delay.keep(t, torques.commanded)
        if world.motors.lines:
            cuts.update(t, torques.saturated, torques.cut, step)
        saturated += step * bool(np.count_nonzero(np.abs(torques.demand) > world.servo.limit))
        touches.add(t, push)
        gears.update(torques.motors, first.a)
        if touches.touched or k % record == 0:
            force = 0.0 if first.forces is None else float(first.forces.sum())
            motion = (state.q, state.v, force, world.contact.speed(state.target), first.hand_speed)
            recorded.append(
                (
                    t,
                    *motion,
                    state.travel,
                    state.tangential[0],
                    torques.demand,
                    torques.motors,
                    world.ground(),
                    world.corners(),
                    gears.take(),
                    stance_at(now, t),
                )
            )
        if push is not None:  # forces jump within the step in which a contact begins
            gears.update(torques.motors, world.body.accelerate(torques.motors, push.peaks))
        state = world.step(t, state, first, step)
        last_touched = state.target if push is not None and push.given[-1] > 0 else last_touched
        check_not_diverged(state.v, t, step)
    return simulation_of(
        robot,
        scene,
        recorded,
        touches,
        engine="pinocchio",
        impulse=float(state.impulses.sum()),
        impulses=state.impulses,
        outcome=world.outcome(last_touched, state),
        saturated=saturated,
        cuts=cuts.cuts() if world.motors.lines else None,
        posture_error=posture_error(robot.model, state.q, np.asarray(world.followed.q[-1])),
        fall=None,
        missed=missing,
    )
