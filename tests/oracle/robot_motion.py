"""A robot on fixed soles as numbers: configuration, rates, forces, in Pinocchio alone."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.problem.problem import ImpactProblem

Array = NDArray[np.float64]
GRAVITY = 9.81  # [m/s2] of the scale of forces, whatever the robot's is
LEVER = 0.1  # [m] by which rows weigh moments against forces
_AXES = pin.LOCAL_WORLD_ALIGNED
STILL = np.zeros(3)


class RobotMotion:
    """Independent coordinates y (base's position, roll, pitch, yaw; joints outside held legs) and leg joints.

    Attributes
    ----------
    ny, nl, n, base : numbers of coordinates, leg joints, joints, and the base's coordinates (6 or 0).
    drifts : whether nothing holds the base.
    undriven : indices in v of the base and of soles' hinges.
    y0 (ny,), legs0 (nl,) : the start posture.  weight : of the robot [N].
    soles : what is held, each with its leg, frame, joints in v, and placement: soles first, then hands.
    wrench_scale (6 a sole), base_scale (base,) : weight, and weight x lever for moments [N, N m].
    """

    def __init__(self, problem: ImpactProblem, number: int | None = None) -> None:
        """number : of a stance phase, if not that with the blow."""
        held, robot = problem.stance_coordinates[problem.blow if number is None else number], problem.robot
        self.robot, self.model = robot, robot.model
        self.data: Any = robot.model.createData()
        self.base, self.n = held.base, robot.n
        self.soles = [
            (leg, self.model.getFrameId(leg.frame), self.base + leg.joints, leg.placement)
            for leg in held.legs
        ]
        joints = [joint for joint in self.model.joints if joint.nv == 1]
        # those that turn without end have a cosine and a sine
        where = [(joint.idx_q, joint.idx_v - self.base) for joint in joints]
        plain = [at for at, joint in zip(where, joints, strict=True) if joint.nq == 1]
        self._plain = np.array(plain, dtype=np.intp).reshape(-1, 2).T
        self._endless = [at for at, joint in zip(where, joints, strict=True) if joint.nq == 2]
        # those that stand; the others are hands that hold on
        self.standing = len(held.soles)
        self.independent, self.dependent = held.independent, held.dependent
        self.undriven = held.undriven
        self.drifts = bool(self.base) and not self.soles
        self.ny, self.nl = self.base + len(self.independent), len(self.dependent)
        self.labels, self.leg_labels = held.labels, held.leg_labels
        self.y0, self.legs0 = self.split(held.posture)
        self.weight = GRAVITY * float(sum(inertia.mass for inertia in self.model.inertias))
        six = self.weight * np.array([1, 1, 1, LEVER, LEVER, LEVER])
        self.wrench_scale = np.tile(six, len(self.soles))
        self.base_scale = six[: self.base]
        self.hands = [self.model.getFrameId(f"striker:{name}") for name in problem.strikers]
        self.normal, self.friction = np.asarray(problem.normal, dtype=float), problem.friction
        self._seen: Array | None = None
        self._places: list[Any] = []
        self._jacobians: list[Array] = []
        start = self.posture(self.y0, self.legs0)
        self._determinants = np.ones(len(self.soles))
        self._determinants = self.extension(start)

    # ------------------------------------------------------------------ configurations
    def split(self, q: Array) -> tuple[Array, Array]:
        """(y, legs) of a configuration (nq,)."""
        joints = self.robot.joint_positions(q)
        base = np.zeros(0)
        if self.base:
            turn = pin.Quaternion(*q[[6, 3, 4, 5]]).matrix()
            base = np.concatenate([q[:3], pin.rpy.matrixToRpy(turn)])
        return np.concatenate([base, joints[self.independent]]), joints[self.dependent]

    def posture(self, y: Array, legs: Array) -> Array:
        """Configuration (nq,) of coordinates and legs."""
        q = np.empty(self.model.nq)
        if self.base:
            q[:3] = y[:3]
            q[3:7] = pin.Quaternion(pin.rpy.rpyToMatrix(*y[3:6])).coeffs()
        self._write(q, self.joints(y, legs))
        return q

    def joints(self, y: Array, legs: Array) -> Array:
        """Angles (n,) of coordinates and legs."""
        out = np.empty(self.n)
        out[self.independent], out[self.dependent] = y[self.base :], legs
        return out

    def _write(self, q: Array, joints: Array) -> None:
        q[self._plain[0]] = joints[self._plain[1]]
        for at, k in self._endless:
            q[at : at + 2] = np.cos(joints[k]), np.sin(joints[k])

    def look(self, q: Array) -> None:
        """Placements and Jacobians (6, nv) of the soles, in their own frames; known where it was last."""
        if q is self._seen:
            return
        self._seen = q
        pin.computeJointJacobians(self.model, self.data, q)
        self._places, self._jacobians = [], []
        for _, frame, _, _ in self.soles:
            self._places.append(pin.updateFramePlacement(self.model, self.data, frame).copy())
            jac = pin.getFrameJacobian(self.model, self.data, frame, pin.LOCAL)
            self._jacobians.append(np.reshape(jac, (6, self.model.nv)))

    def motion(self, y: Array, legs: Array, u: Array, slope: Array) -> tuple[Array, Array, Array]:
        """q, v, a of rates u and second rates (ny,) [1/s, 1/s^2]; the legs' keep the soles at rest.

        The soles' Jacobians are computed then.
        """
        model, data, b = self.model, self.data, self.base
        q = self.posture(y, legs)
        v, a = np.zeros(model.nv), np.zeros(model.nv)
        if b:
            rates = self.base_rates(y)
            bend = pin.rpy.computeRpyJacobianTimeDerivative(y[3:6], u[3:6], pin.LOCAL)
            v[:6] = rates @ u[:6]
            drift = np.concatenate([-pin.skew(v[3:6]) @ v[:3], bend @ u[3:6]])
            a[:6] = rates @ slope[:6] + drift
        v[b + self.independent], a[b + self.independent] = u[b:], slope[b:]
        blocks = []
        if self.soles:
            self.look(q)
        for (_, frame, columns, _), jac in zip(self.soles, self._jacobians, strict=True):
            blocks.append((frame, columns, jac[:, columns]))
            v[columns] = 0.0
            v[columns] = np.linalg.solve(jac[:, columns], -jac @ v)
        if blocks:
            pin.forwardKinematics(model, data, q, v, a)
            found = [pin.getFrameAcceleration(model, data, frame, pin.LOCAL).vector for frame, _, _ in blocks]
            for (_, columns, block), drift in zip(blocks, found, strict=True):
                a[columns] = np.linalg.solve(block, -drift)
        return q, v, a

    def base_rates(self, y: Array) -> Array:
        """(6, 6) the base's velocity, in its own axes, by the rates of its coordinates."""
        out = np.zeros((6, 6))
        out[:3, :3] = pin.rpy.rpyToMatrix(*y[3:6]).T
        out[3:, 3:] = pin.rpy.computeRpyJacobian(y[3:6], pin.LOCAL)
        return out

    def closed_legs(self, y: Array, guess: Array) -> Array:
        """Leg joints (nl,) that put the soles where they are held, by Newton's method from a guess."""
        legs = guess.copy()
        for _ in range(20):
            self.look(self.posture(y, legs))
            worst = 0.0
            for k, (_, _, columns, place) in enumerate(self.soles):
                error = pin.log6(self._places[k].actInv(place)).vector
                worst = max(worst, float(np.abs(error).max()))
                step = np.linalg.solve(self._jacobians[k][:, columns], error)
                legs[6 * k : 6 * k + 6] += np.clip(step, -0.3, 0.3)
            if worst < 1e-13:
                break
        return legs

    # ------------------------------------------------------------------ what rows are of
    def closure(self, q: Array) -> Array:
        """(6 a sole) how far the soles are from where they are held [m], and turned [rad]."""
        self.look(q)
        out = [np.zeros(0)]
        for (_, _, _, place), at in zip(self.soles, self._places, strict=True):
            d = at.rotation @ place.rotation.T
            turn = 0.5 * np.array([d[2, 1] - d[1, 2], d[0, 2] - d[2, 0], d[1, 0] - d[0, 1]])
            out += [at.translation - place.translation, turn]
        return np.concatenate(out)

    def twists(self, q: Array, v: Array) -> Array:
        """(6 a sole) [m/s, rad/s] of the soles, in the base's axes."""
        pin.forwardKinematics(self.model, self.data, q, v)
        turn = np.eye(3) if not self.base else self.data.oMi[1].rotation
        out = [np.zeros(0)]
        for _, frame, _, _ in self.soles:
            pin.updateFramePlacement(self.model, self.data, frame)
            found = pin.getFrameVelocity(self.model, self.data, frame, _AXES)
            out += [turn.T @ found.linear, turn.T @ found.angular]
        return np.concatenate(out)

    def extension(self, q: Array) -> Array:
        """Of each leg, the determinant of its Jacobian over that of the start posture."""
        self.look(q)
        legs = zip(self.soles, self._jacobians, strict=True)
        found = [np.linalg.det(jac[:, columns]) for (_, _, columns, _), jac in legs]
        return np.array(found) / self._determinants if found else np.zeros(0)

    def torque(
        self,
        q: Array,
        v: Array,
        a: Array,
        wrenches: Array,
        forces: Iterable[float] = (),
        bent: Sequence[Array] = (),
        side: Array = STILL,
    ) -> Array:
        """Generalized force (nv,) that this motion needs, under wrenches (6 a sole) in the soles' frames and
        the contact's normal forces [N] at the hands.

        side : (3,) [m/s] velocity of the target across the normal.
        """
        model, data = self.model, self.data
        tau: Array = np.array(pin.rnea(model, data, q, v, a))
        drives = self.robot.actuators
        for name, drive in zip(list(model.names)[-len(drives) :], drives, strict=True):
            if drive.spring_stiffness:
                joint = model.joints[model.getJointId(name)]
                tau[joint.idx_v] += drive.spring_stiffness * (q[joint.idx_q] - drive.spring_rest)
        if self.soles:
            self.relieve(tau, q, wrenches)
        return tau + self.pushed(q, v, forces, bent, side)

    def pushed(
        self, q: Array, v: Array, forces: Iterable[float], bent: Sequence[Array] = (), side: Array = STILL
    ) -> Array:
        """Generalized force (nv,) against normal forces [N] on the hands, and against their friction."""
        pushes = self.pushes(q, v, forces, bent, side)
        return np.asarray(sum((jac.T @ push for jac, push in pushes), np.zeros(self.model.nv)))

    def pushes(
        self, q: Array, v: Array, forces: Iterable[float], bent: Sequence[Array] = (), side: Array = STILL
    ) -> list[tuple[Array, Array]]:
        """Jacobian (3, nv) of each hand, and its force (3,) on the target, by normal forces [N].

        bent : deflections (3,) [m] of each hand's bristles; (): not bent.
        """
        out = []
        for k, (hand, force) in enumerate(zip(self.hands, forces, strict=False)):
            jac, slide, full = self._slide(q, v, hand, side)
            push = self.normal * force
            if self.friction is not None and self.friction.stiffness:
                limit = self.friction.coefficient * force
                push = push + (limit * self.leaning(force, bent[k]) if len(bent) else 0.0)
            elif self.friction is not None:
                push = push + self.friction.coefficient * force * slide / full
            out.append((jac, push))
        return out

    def _slide(self, q: Array, v: Array, hand: int, side: Array) -> tuple[Array, Array, float]:
        """Jacobian (3, nv) of a hand, its velocity (3,) across the target, and that speed with the slip's."""
        self._seen = None
        frame = pin.computeFrameJacobian(self.model, self.data, q, hand, _AXES)
        jac = np.reshape(frame, (6, self.model.nv))[:3]
        fast = jac @ v - side
        slide = fast - (fast @ self.normal) * self.normal
        slip = 0.0 if self.friction is None else self.friction.slip_speed
        return jac, slide, float(np.hypot(np.linalg.norm(slide), slip))

    def leaning(self, force: float, bent: Array) -> Array:
        """Force (3,) of bristles under a normal force [N] over the limit that it cannot exceed."""
        limit, stiffness = self.friction.coefficient * force, self.friction.stiffness
        elastic = stiffness * float(np.hypot(np.linalg.norm(bent), 1e-9))  # bent by a nanometre at least
        return stiffness * bent / max(limit, elastic)

    def bending(
        self, q: Array, v: Array, forces: Iterable[float], bent: Sequence[Array], side: Array
    ) -> Array:
        """Rates (3 hands,) [m/s] of the deflections of the hands' bristles."""
        rates = []
        for hand, force, each in zip(self.hands, forces, bent, strict=False):
            _, slide, full = self._slide(q, v, hand, side)
            rates.append(slide - full * self.leaning(force, each))
        return np.concatenate(rates)

    def resting(self) -> Array:
        """Torques (n,) [N m] at rest in the start posture, on the least sole wrenches that carry it.

        A moment of 1 N m counts as 10 N.
        """
        q, still = self.posture(self.y0, self.legs0), np.zeros(self.model.nv)
        tau = self.torque(q, still, still, np.zeros(6 * len(self.soles)))
        if self.soles:
            self.look(q)
            whole = np.vstack([jac[:, self.undriven] for jac in self._jacobians])
            cost = np.tile([1.0, 1, 1, 10, 10, 10], len(self.soles))
            w = np.linalg.lstsq(whole.T / cost, tau[self.undriven], rcond=None)[0] / cost
            self.relieve(tau, q, w)
        return np.asarray(tau[self.base :])

    def wrenches(self, q: Array, lacking: Array) -> Array:
        """(6 a sole) in the soles' frames, of legs whose torques lack so much (nv,)."""
        self.look(q)
        legs = zip(self.soles, self._jacobians, strict=True)
        return np.concatenate(
            [np.linalg.solve(jac[:, columns].T, lacking[columns]) for (_, _, columns, _), jac in legs]
        )

    def relieve(self, tau: Array, q: Array, wrenches: Array) -> None:
        """Take from a generalized force (nv,) what wrenches (6 a sole) do at q."""
        self.look(q)
        for k, jac in enumerate(self._jacobians):
            tau -= jac.T @ wrenches[6 * k : 6 * k + 6]

    def ground(self, wrenches: Array) -> Array:
        """(6,) [N, N m] about the world's origin, of wrenches (6 a sole) on the fixed soles."""
        total = np.zeros(6)
        for k, (_, _, _, place) in enumerate(self.soles[: self.standing]):
            total += place.act(pin.Force(wrenches[6 * k : 6 * k + 6])).vector
        return total

    def striking(self, y: Array, u: Array, k: int = 0) -> tuple[Array, Array, Array]:
        """Place (3) [m], velocity (3) [m/s] and axes (3, 3) of striker k, which no held leg carries."""
        q, v, _ = self._upper(y, u)
        pin.forwardKinematics(self.model, self.data, q, v)
        at = pin.updateFramePlacement(self.model, self.data, self.hands[k])
        fast = pin.getFrameVelocity(self.model, self.data, self.hands[k], _AXES)
        return np.array(at.translation), np.array(fast.linear), np.array(at.rotation)

    def _upper(self, y: Array, u: Array) -> tuple[Array, Array, Array]:
        q, v = self.posture(y, np.zeros(self.nl)), np.zeros(self.model.nv)
        if self.base:
            v[:6] = self.base_rates(y) @ u[:6]
        v[self.base + self.independent] = u[self.base :]
        return q, v, np.zeros(self.model.nv)

    def coasting(self, y: Array, legs: Array, u: Array, rates: Array) -> Array:
        """(12 a sole) closure, and twists of soles whose legs go at given rates (nl,)."""
        q, v, _ = self._upper(y, u)
        self._write(q, self.joints(y, legs))
        v[self.base + self.dependent] = rates
        return np.concatenate([self.closure(q), self.twists(q, v)])

    def momentum(self, q: Array, v: Array) -> tuple[Array, Array, Array]:
        """Centre of mass (3) [m], its velocity (3) [m/s], angular momentum (3) about it [N m s]."""
        h = pin.computeCentroidalMomentum(self.model, self.data, q, v)
        total = float(sum(inertia.mass for inertia in self.model.inertias))
        return np.array(self.data.com[0]), np.array(h.linear) / total, np.array(h.angular)

    def weighed_momentum(self, q: Array, v: Array) -> Array:
        """(6,) [s] momentum, and angular momentum about the centre of mass, over the scale of forces."""
        h = pin.computeCentroidalMomentum(self.model, self.data, q, v)
        return np.asarray(np.concatenate([h.linear, h.angular]) / self.base_scale)

    @property
    def pull(self) -> Array:
        """(6,) that gravity adds to it in a second."""
        return np.append(np.array(self.model.gravity.linear) / GRAVITY, np.zeros(3))
