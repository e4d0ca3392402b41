"""Full dynamics in numeric Pinocchio.

Soles are bilateral constraints, the servo saturates, contact with a free mass is a spring-damper. Shares no
code with the planner: it reads a reference (times, positions, velocities, feed-forward), the
robot's numbers and the scene's.
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
from impactopt.validation.touch import FACE, Touches

Array = NDArray[np.float64]


@dataclass(frozen=True)
class _State:
    q: Array
    v: Array
    x: float  # the target's travel [m]
    vt: float  # and speed [m/s]


@dataclass(frozen=True)
class _Rates:
    v: Array
    a: Array
    vt: float
    at: float
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
        self.servo = Servo(robot, reference)
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

    def rates(self, t: float, s: _State) -> _Rates:
        model, data, scene = self.model, self.data, self.scene
        pin.computeJointJacobians(model, data, s.q)
        jac = pin.getFrameJacobian(model, data, self.hand, pin.LOCAL_WORLD_ALIGNED)
        jac = np.reshape(jac, (6, model.nv))[:3]  # pin drops an axis where nv is 1
        point = pin.updateFramePlacement(model, data, self.hand).translation
        row = scene.normal @ jac
        speed = float(row @ s.v)
        way = point - scene.point
        travel = float(scene.normal @ way)
        depth = travel - s.x
        hits = depth > 0 and np.linalg.norm(way - travel * scene.normal) <= FACE
        approach = speed - s.vt
        force = scene.stiffness * depth + scene.damping * max(approach, 0.0) if hits else 0.0
        demand, torque = self.servo.torque(t, self.servo.angles(s.q), s.v[self.base :])
        tau = -row * force
        tau[self.base :] += torque
        if self.sole_ids:
            a = pin.constraintDynamics(
                model, data, s.q, s.v, tau, self.contacts, self.contact_data, self.proximal
            )
        else:
            a = pin.aba(model, data, s.q, s.v, tau)
        return _Rates(s.v.copy(), np.array(a), s.vt, force / scene.mass, force, speed, demand, torque)

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
        return _State(pin.integrate(self.model, s.q, h * r.v), s.v + h * r.a, s.x + h * r.vt, s.vt + h * r.at)


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
    state = _State(np.array(reference.q[0]), np.zeros(robot.model.nv), 0.0, 0.0)
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
            motion = (state.q, state.v, first.force, state.vt, first.hand_speed)
            moves = slip_and_lift(corners, start)
            rows.append((t, *motion, first.demand, first.torque, world.ground(), *moves))
        middle = world.rates(t + step / 2, world.advance(state, first, step / 2))
        state = _State(
            pin.integrate(robot.model, state.q, step * middle.v),
            state.v + step * middle.a,
            state.x + step * middle.vt,
            state.vt + step * middle.at,
        )
        check_not_diverged(state.v, t, step)
    return simulation_of(
        robot,
        scene,
        rows,
        touches,
        engine="pinocchio",
        saturated=saturated,
        posture_error=posture_error(robot.model, state.q, np.asarray(reference.q[-1])),
        fall=None,
    )
