"""Full dynamics in numeric Pinocchio.

Soles are bilateral constraints, the servo saturates, the target is moved by the contact law's force. Shares
no code with the planner: it reads a reference (times, positions, velocities, feed-forward), the robot's
numbers and the scene's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.robot import Robot
from impactopt.validation.histories import check_not_diverged, posture_error, simulation_of, slip_and_lift
from impactopt.validation.result import Scene, Simulation
from impactopt.validation.servo import Servo
from impactopt.validation.struck import Move, Struck, smooth_steps
from impactopt.validation.touch import Touches

Array = NDArray[np.float64]


@dataclass(frozen=True)
class _State:
    q: Array
    v: Array
    x: float  # the target's travel [m]
    target: Array  # and state
    impulse: float  # that it was given [N s]


@dataclass(frozen=True)
class _Rates:
    v: Array
    a: Array
    vt: float  # the target's speed [m/s]
    target: Array
    force: float
    hand_speed: float
    demand: Array
    torque: Array


class _World:
    def __init__(self, robot: Robot, scene: Scene, reference: Any) -> None:
        self.robot, self.scene = robot, scene
        self.model, self.data = robot.model, robot.model.createData()
        self.base = robot.model.nv - robot.n
        self.hand = self.model.getFrameId(scene.striker)
        self.servo, self.struck = Servo(robot, reference), Struck(scene)
        self.contacts = pin.StdVec_RigidConstraintModel()
        for name in scene.soles:
            frame = self.model.frames[self.model.getFrameId(name)]
            self.contacts.append(
                pin.RigidConstraintModel(
                    pin.ContactType.CONTACT_6D,
                    self.model,
                    frame.parentJoint,
                    frame.placement,
                    0,
                    pin.SE3.Identity(),
                    pin.LOCAL,
                )
            )
        self.contact_data = pin.StdVec_RigidConstraintData()
        for contact in self.contacts:
            self.contact_data.append(contact.createData())
        pin.initConstraintDynamics(self.model, self.data, self.contacts, self.contact_data)
        self.proximal = pin.ProximalSettings(1e-12, 1e-12, 1)
        self.sole_ids = [self.model.getFrameId(name) for name in scene.soles]

    def contact(self, s: _State) -> tuple[float, float, Array]:
        """Force [N] and hand speed [m/s] along the normal, and the row (nv,) of the Jacobian."""
        model, data = self.model, self.data
        pin.computeJointJacobians(model, data, s.q)
        jac = pin.getFrameJacobian(model, data, self.hand, pin.LOCAL_WORLD_ALIGNED)
        jac = np.reshape(jac, (6, model.nv))[:3]  # pin drops an axis where nv is 1
        point = pin.updateFramePlacement(model, data, self.hand).translation
        row = self.scene.normal @ jac
        speed = float(row @ s.v)
        return self.struck.force(point, speed, s.x, s.target), speed, row

    def rates(self, t: float, s: _State) -> _Rates:
        model, data = self.model, self.data
        force, speed, row = self.contact(s)
        demand, torque = self.servo.torque(t, self.servo.angles(s.q), s.v[self.base :])
        tau = -row * force
        tau[self.base :] += torque
        if self.sole_ids:
            a = pin.constraintDynamics(
                model, data, s.q, s.v, tau, self.contacts, self.contact_data, self.proximal
            )
        else:
            a = pin.aba(model, data, s.q, s.v, tau)
        struck = self.struck
        return _Rates(
            v=s.v.copy(),
            a=np.array(a),
            vt=struck.speed(s.target),
            target=struck.rates(s.target, force),
            force=force,
            hand_speed=speed,
            demand=demand,
            torque=torque,
        )

    def ground(self) -> Array:
        """(soles, 6) wrench of the ground on each held sole about the world's origin, of the last call of
        ``rates``.
        """
        out = np.zeros((len(self.sole_ids), 6))
        for k, i in enumerate(self.sole_ids):
            m = pin.updateFramePlacement(self.model, self.data, i)
            wrench = self.data.lambda_c[6 * k : 6 * k + 6]
            out[k, :3] = m.rotation @ wrench[:3]
            out[k, 3:] = m.rotation @ wrench[3:] + np.cross(m.translation, out[k, :3])
        return out

    def corners(self) -> list[Array]:
        """World places (k, 3) of each held sole's corners."""
        placements = [pin.updateFramePlacement(self.model, self.data, i) for i in self.sole_ids]
        return [
            np.column_stack([c, np.zeros(len(c))]) @ m.rotation.T + m.translation
            for m, c in zip(placements, self.scene.corners, strict=True)
        ]

    def advance(self, s: _State, r: _Rates, h: float) -> _State:
        return _State(
            q=pin.integrate(self.model, s.q, h * r.v),
            v=s.v + h * r.a,
            x=s.x + h * r.vt,
            target=s.target + h * r.target,
            impulse=s.impulse + h * r.force,
        )

    def step(self, t: float, s: _State, first: _Rates, h: float) -> _State:
        """A step of the midpoint rule from a state with its rates; several, where the target switches."""
        struck = self.struck

        def begin(done: float, at: _State) -> Move[_State]:
            now = first if done == 0 else self.rates(t + done, at)
            before = struck.side(at.target, now.force)

            def move(length: float) -> tuple[_State, bool]:
                half = self.advance(at, now, length / 2)
                middle = self.rates(t + done + length / 2, half)
                after = self.advance(at, middle, length)
                if not struck.switching:
                    return after, True
                stays = struck.side(half.target, middle.force) == before
                return after, stays and struck.side(after.target, self.contact(after)[0]) == before

            return move

        return smooth_steps(begin, s, h)


def simulate_pinocchio(
    robot: Robot, reference: Any, scene: Scene, *, step: float = 1e-4, settle: float = 0.3, record: int = 5
) -> Simulation:
    """The whole motion from the reference's first posture at rest, in constrained forward dynamics.

    reference : time (k,) [s], q (k, nq), v (k, nv), torque (k, n), as of :class:`impactopt.plan.Trajectory`.
    step [s] : of the explicit midpoint rule (second order).  settle [s] : simulated beyond the end of the
        reference's motion.
    record : steps between recorded instants; every step is recorded in contact.

    Raises
    ------
    InputError : the simulation diverges (with the time at which it did).
    """
    world = _World(robot, scene, reference)
    struck = world.struck
    state = _State(np.array(reference.q[0]), np.zeros(robot.model.nv), 0.0, struck.at_rest, 0.0)
    left = state.target  # as the last touch has left it
    end = float(reference.end) + settle
    rows: list[tuple[Any, ...]] = []
    saturated = 0.0
    start: list[Array] | None = None
    touches = Touches()
    for k in range(round(end / step)):
        t = k * step
        first = world.rates(t, state)
        saturated += step * bool(np.any(np.abs(first.demand) > robot.torque_limit))
        touches.add(t, first.force, step)
        if first.force > 0 or k % record == 0:
            corners = world.corners()
            start = corners if start is None else start
            motion = (state.q, state.v, first.force, first.vt, first.hand_speed)
            moves = slip_and_lift(corners, start)
            rows.append((t, *motion, first.demand, first.torque, world.ground(), *moves))
        before, state = state, world.step(t, state, first, step)
        left = state.target if state.impulse > before.impulse else left
        check_not_diverged(state.v, t, step)
    return simulation_of(
        robot,
        scene,
        rows,
        touches,
        engine="pinocchio",
        impulse=state.impulse,
        outcome=scene.target.outcome(left),
        saturated=saturated,
        posture_error=posture_error(robot.model, state.q, np.asarray(reference.q[-1])),
        fall=None,
    )
