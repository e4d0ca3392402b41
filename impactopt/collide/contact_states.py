"""States of a robot at contact for many cases: posture, velocity and feed-forward torque, in compiled code.

`impactopt.kinematics.operational_space` computes the same for one state, by Pinocchio and least squares; each
is tested against the other. It takes some milliseconds a state, which for millions of states would be hours.

A case's posture is one of a few, each found once, with changes of some joint angles.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impactopt.arrays import Array, Index, Mask
from impactopt.codegen.batched import BatchedFunction
from impactopt.codegen.cache import cached, model_hash
from impactopt.collision.frozen import _inverse_of_cholesky
from impactopt.collision.settings import coasting_reference
from impactopt.errors import InputError, check_choice
from impactopt.files.record import load_record
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.kinematics.inverse_kinematics import inverse_kinematics
from impactopt.kinematics.stance import Free, Stance, support_polygon
from impactopt.robots.rigid_body import RigidBody
from impactopt.robots.robot import Robot

# [m/s], [rad/s] In the place of velocity limits of the base, which has none. It is so large that base
# velocities cost next to nothing: they follow from the constraints of the legs.
_BASE_VELOCITY_SCALE = 100.0


def striking_functions(robot: Robot, *, striker: str, stance: Stance) -> dict[str, Any]:
    """Compiled ca.Functions for the states at contact of a robot whose stance's frames are fixed exactly.

    * ``least_energy`` (q (nq), -) -> (B (nv, 3), G (3, 3), J (3, nv)): J is the striking point's linear
      Jacobian. With the inverse inertia P of the constrained robot, B = P J' and G = J P J'. The velocity
      v = B x has the least kinetic energy of all that give the striking point the velocity G x.
    * ``least_rates``: likewise with the sum of squares of the joint velocities over their limits in the
      place of the kinetic energy.
    * ``holding`` ((q, v), -) -> tau (n) [N m]: as of `holding_torque`.

    The second input of each is empty. Outputs are joined in one vector, matrices by columns.
    """
    frame, held = robot.striker(striker).model_frame, stance.constraint_frames(robot)

    def build() -> list[Any]:
        tree = _StrikingGraphs(robot, held, frame)
        return [tree.least_energy(), tree.least_rates(), tree.holding()]

    hinges = np.flatnonzero(robot.hinges).tolist()
    recipe = (model_hash(robot.model, robot.springs), frame, held, robot.velocity_limit, hinges)
    return cached("striking", recipe, build)


class _StrikingGraphs:
    """Graphs of `striking_functions`: algebra on the kinematic tree in SX, dense algebra in MX."""

    def __init__(self, robot: Robot, held: tuple[str, ...], frame: str) -> None:
        self.rb = RigidBody(robot.model, springs=robot.springs)
        self.base = robot.nv - robot.n
        hinges = self.base + np.flatnonzero(robot.hinges)
        self.undriven = [*range(self.base), *hinges.tolist()]
        self.driven = np.setdiff1d(np.arange(robot.nv), self.undriven).tolist()
        self.nq, self.nv, self.held, self.frame = robot.nq, robot.nv, held, frame
        self.velocity_scale = np.concatenate([np.full(self.base, _BASE_VELOCITY_SCALE), robot.velocity_limit])

    def least_energy(self) -> Any:
        H = self.rb.mass_matrix()
        entries = ca.SX.sym("H", H.sparsity())
        factor = self.rb.factorize(entries)
        root = ca.mtimes(ca.diag(1 / ca.sqrt(factor.diagonal)), factor.half_solve(ca.SX.eye(self.nv)))
        inverse_root = ca.Function("inverse_root", [entries], [root])
        inertia = ca.Function("inertia", [self.rb.q], [H])
        return self._mobility("least_energy", lambda q: inverse_root(inertia(q)))

    def least_rates(self) -> Any:
        return self._mobility("least_rates", lambda q: ca.MX(ca.diag(ca.DM(self.velocity_scale))))

    def _mobility(self, name: str, root: Callable[[Any], Any]) -> Any:
        """ca.Function q -> (B, G, J); root : q -> W, with W' W the inverse of the minimized form's matrix."""
        q, none = ca.MX.sym("q", self.nq), ca.MX.sym("none", 0)
        point = ca.densify(self.rb.jacobian(self.frame)[:3, :])
        J, J_c = ca.Function("jacobians", [self.rb.q], [point, self._held])(q)
        W = root(q)
        hand = ca.mtimes(W, J.T)
        if self.held:
            # the projection I - Q Q' imposes the constraints; Q = W J_c' R' is an orthonormal basis of W J_c'
            held = ca.mtimes(W, J_c.T)
            R = _inverse_of_cholesky(held.size2())(ca.mtimes(held.T, held))
            hand = hand - ca.mtimes(held, ca.mtimes(R.T, ca.mtimes(R, ca.mtimes(held.T, hand))))
        return ca.Function(name, [q, none], [_column(ca.mtimes(W.T, hand), ca.mtimes(hand.T, hand), J)])

    def holding(self) -> Any:
        state, none = ca.MX.sym("state", self.nq + self.nv), ca.MX.sym("none", 0)
        rb = self.rb
        bias = ca.Function("bias", [rb.q, rb.v], [rb.rnea(rb.v, None), self._held])
        b, J_c = bias(state[: self.nq], state[self.nq :])
        of_undriven, of_driven = b[self.undriven], b[self.driven]
        if self.held:
            J_u, J_d = J_c[:, self.undriven], J_c[:, self.driven]
            # least |tau|^2 + |w|^2 with J_u' w = b_undriven and tau = b_driven - J_d' w, by the normal
            # equations in w with the matrix I + J_d J_d', and a Schur complement for the undriven equations
            R = _inverse_of_cholesky(J_c.size1())(ca.DM.eye(J_c.size1()) + ca.mtimes(J_d, J_d.T))
            y, U = ca.mtimes(R, ca.mtimes(J_d, of_driven)), ca.mtimes(R, J_u)
            if self.undriven:
                S = _inverse_of_cholesky(len(self.undriven))(ca.mtimes(U.T, U))
                y = y + ca.mtimes(U, ca.mtimes(S.T, ca.mtimes(S, of_undriven - ca.mtimes(U.T, y))))
            driven = of_driven - ca.mtimes(J_d.T, ca.mtimes(R.T, y))
        elif self.undriven:
            # nothing is fixed: H_uu a_u + b_u = 0, and tau = H_du a_u + b_driven
            H = ca.Function("inertia", [rb.q], [ca.densify(rb.mass_matrix())])(state[: self.nq])
            S = _inverse_of_cholesky(len(self.undriven))(H[self.undriven, self.undriven])
            acceleration = -ca.mtimes(S.T, ca.mtimes(S, of_undriven))
            driven = of_driven + ca.mtimes(H[self.driven, self.undriven], acceleration)
        else:
            driven = of_driven
        torque = ca.MX.zeros(self.nv)
        torque[self.driven] = driven
        return ca.Function("holding", [state, none], [_column(torque[self.base :])])

    @property
    def _held(self) -> Any:
        """Jacobians J_c (c, nv) of the constrained frames."""
        frames = [self.rb.jacobian(frame) for frame in self.held]
        return ca.densify(ca.vertcat(ca.SX(0, self.nv), *frames))


def _column(*parts: Any) -> Any:
    return ca.densify(ca.vertcat(*[ca.vec(part) for part in parts]))


Reasons = NDArray[np.object_]

_BLOCK = 256  # states in one call of a compiled function
# Duration of a servo's reference: relative to the planned contact, as with other targets contact may last
# longer; and [s] if the record has no contact.
_REFERENCE_TIME, _DEFAULT_REFERENCE_TIME = 2.1, 0.1
_VELOCITY_ERROR = 1e-6  # [m/s] permitted of the striking point, at 1 m/s


NOT_APPROACHING = "the target moves away at least as fast as the striking point"


@dataclass(frozen=True, kw_only=True, eq=False)
class Posture:
    """Posture q (nq,) that the joint angles of cases are relative to.

    polygon (k, 2) [m] : support polygon; without corners on a fixed base.
    v (nv,), torque (n,) [N m], reference : velocity and torque of a saved result, and the reference of its
        servo, settings as of `coasting_reference`.
    """

    q: Array
    polygon: Array
    v: Array | None = None
    torque: Array | None = None
    reference: Mapping[str, Array] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class States:
    """States at contact of N cases.

    q (N, nq), v (N, nv), torque (N, n) [N m].
    speed (N) [m/s], mass (N) [kg] : speed and effective mass of the striking point along the normal.
    reason (N) : why a case is impossible; "" if it is possible.
    reference (N, n, k), reference_until (N) : settings of the servo's reference, of a saved result.
    """

    q: Array
    v: Array
    torque: Array
    speed: Array
    mass: Array
    reason: Reasons
    reference: Array | None = None
    reference_until: Array | None = None

    @property
    def reference_settings(self) -> dict[str, Array]:
        """Settings of the servo's reference, one of each a case; empty without a saved result."""
        if self.reference is None or self.reference_until is None:
            return {}
        return {"reference": self.reference, "reference_until": self.reference_until}

    def approaching(self, before: Any) -> States:
        """States with the reason of those in which no contact begins; before : the target's speed [m/s]."""
        flees = (self.reason == "") & (self.speed <= before)
        return replace(self, reason=np.where(flees, NOT_APPROACHING, self.reason))

    def some(self, cases: Index) -> States:
        """States of the cases with these indices."""
        kept: dict[str, Any] = {name: None if x is None else x[cases] for name, x in vars(self).items()}
        return States(**kept)


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactStates:
    """Computes states at contact of one robot on one stance.

    start (nq,) : initial guess of the inverse kinematics.  folder : directory that paths of results are
        relative to.
    """

    robot: Robot
    striker: str
    stance: Stance
    start: Array
    folder: Path
    _postures: dict[Any, Posture | str] = field(init=False, repr=False, default_factory=dict)
    _batched: dict[str, BatchedFunction] = field(init=False, repr=False, default_factory=dict)

    # ------------------------------------------------------------ postures
    def posture(self, name: str, result: str | None, point: tuple[float, ...]) -> Posture | str:
        """Posture of [at_contact] posture or result, or the reason why there is none.

        point (3,) [m] : of the posture "reach".

        Raises
        ------
        InputError : an unknown posture; no such result, or one of another robot.
        """
        reaches = result is None and name == "reach"
        key = (name, result, point if reaches else None)
        if key not in self._postures:
            self._postures[key] = self._reach(point) if reaches else self._named(name, result)
        return self._postures[key]

    def _reach(self, point: tuple[float, ...]) -> Posture | str:
        robot, q = self.robot, self.start
        if isinstance(self.stance, Free):
            raise InputError(
                f"[at_contact] posture: {robot.name} floats freely, so its position at contact is unknown: "
                f"name a posture; there are {', '.join(robot.postures)}"
            )
        coordinates = self._coordinates(q)
        try:
            q = inverse_kinematics(coordinates, self.striker, np.array(point), q)
        except InputError:
            return "the point is out of reach"
        return Posture(q=q, polygon=support_polygon(robot, coordinates))

    def _named(self, name: str, result: str | None) -> Posture:
        robot, v, torque, until = self.robot, None, None, _DEFAULT_REFERENCE_TIME
        if result is not None:
            q, v, torque, until = self._of_result(result)
        else:
            known = ("reach", *robot.postures)
            check_choice(f"[at_contact] posture: {robot.name} has no posture", name, known)
            q = robot.posture(name)
        if isinstance(self.stance, Free) and result is None:
            return Posture(q=q, polygon=np.zeros((0, 2)))
        robot.check_stance(q, self.stance.sole_names(robot))
        coordinates = self._coordinates(q)
        reference = None if v is None else coasting_reference(coordinates, q, v, until=until)
        polygon = support_polygon(robot, coordinates)
        return Posture(q=q, v=v, torque=torque, reference=reference, polygon=polygon)

    def _coordinates(self, q: Array) -> StanceCoordinates:
        """Coordinates with the stance's frames fixed at their places in a posture (nq,)."""
        robot, stance = self.robot, self.stance
        return StanceCoordinates(robot, stance.soles(robot), q, stance.held_hands(robot))

    def _of_result(self, result: str) -> tuple[Array, Array, Array, float]:
        """q, v, torque of a saved result at contact, and the duration [s] of its reference."""
        record = load_record(self.folder / result)
        a = record.arrays
        if tuple(a["joints"]) != self.robot.joint_names:
            raise InputError(
                f"[at_contact] result: {result} is of a robot with other joints than {self.robot.name}"
            )
        until = _DEFAULT_REFERENCE_TIME
        if "collision_time" in a:
            until = _REFERENCE_TIME * float(a["collision_time"][-1])
        until = max(until, _DEFAULT_REFERENCE_TIME / 2)
        if "strike_posture" in a:
            return a["strike_posture"], a["strike_velocity"], a["strike_torque"], until
        if not record.completed:
            raise InputError(f"[at_contact] result: {result} has no motion; solve it again")
        last = int(np.flatnonzero(a["reference_phase"] == 0)[-1])  # the end of the swing
        return a["reference_q"][last], a["reference_v"][last], a["reference_torque"][last], until

    # ------------------------------------------------------------ cases
    def check_joint(self, name: str) -> None:
        """InputError for an unknown joint, or one whose motion would move a fixed frame."""
        k = self.robot.joint_index(name)
        for sole in self.stance.soles(self.robot):
            if k in self.robot.limb(sole.frame):
                raise InputError(
                    f"[at_contact] joints_rad: {name} would move the sole {sole.name!r}, which is held; move "
                    "joints above the legs, or [problem] point_m"
                )
        for hand in self.stance.held_hands(self.robot):
            if k in self.robot.limb(hand.model_frame):
                raise InputError(
                    f"[at_contact] joints_rad: {name} would move the hand {hand.name!r}, which holds on; "
                    "move other joints, or [problem] point_m"
                )

    def compute(
        self,
        posture: Posture,
        joints: Mapping[str, Array],
        speed: Array | None,
        normal: Array,
        count: int,
        *,
        velocity: str = "least energy",
    ) -> States:
        """States of `count` cases.

        joints : changes (count,) [rad] of the posture's joint angles.  speed (count,) [m/s].  normal (3,).
        velocity : as of [at_contact].
        """
        changes = np.stack([*joints.values()], axis=1) if joints else np.zeros((count, 0))
        # P distinct postures, and the index (count,) of each case's, as cases that differ in speed share one
        same = not changes.size or bool((changes == changes[0]).all())
        kept, back = changes[:1], np.zeros(count, dtype=np.intp)
        if not same:
            kept, back = np.unique(changes, axis=0, return_inverse=True)
            back = back.ravel()
        q, reason = self._moved(posture.q, tuple(joints), kept)
        robot, nv = self.robot, self.robot.nv
        B, G, J = self._mobility("least_energy", q)
        mass = 1 / np.einsum("i,rij,j->r", normal, G, normal)
        if posture.v is None:
            # v = B x with G x = normal: the striking point has 1 m/s along the normal
            if velocity != "least energy":
                B, G, J = self._mobility("least_rates", q)
            # G is singular if the point cannot move in some direction
            x = np.linalg.pinv(G, rcond=1e-12, hermitian=True) @ normal
            stuck = np.abs(np.einsum("rij,rj->ri", G, x) - normal).max(axis=1) > _VELOCITY_ERROR
            _set_reason(reason, stuck, "the striking point cannot move along the normal here")
            unit = np.einsum("rkv,rk->rv", B, x)
        else:
            unit = np.broadcast_to(posture.v, (len(q), nv))
        own = np.einsum("i,rvi,rv->r", normal, J, unit)
        _set_reason(reason, own <= 0, "the striking point does not approach the target")
        # of each case's velocity, relative to the `unit` of its posture
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = np.ones(count) if speed is None else speed / own[back]
        rest = self._call("holding", np.hstack([q, np.zeros_like(unit)]))
        moving = self._call("holding", np.hstack([q, unit]))
        # bias forces are quadratic in the velocity
        torque = rest[back] + (moving - rest)[back] * factor[:, None] ** 2
        if posture.torque is not None:
            torque += posture.torque - self._call("holding", np.hstack([posture.q, unit[0]])[None])
        v = unit[back] * factor[:, None]
        reasons = reason[back]
        over = np.abs(v[:, nv - robot.n :]) > robot.velocity_limit * (1 + 1e-9)
        for k in np.flatnonzero(over.any(axis=0)):
            _set_reason(reasons, over[:, k], f"{robot.joint_names[k]} would be faster than its limit")
        reference: dict[str, Any] = {}
        if posture.reference is not None:
            # the same path at `factor` times the speed: t^k of a velocity gets the factor's power k + 1
            coefficients = posture.reference["reference"]
            powers = np.arange(2, coefficients.shape[1] + 2)
            reference["reference"] = coefficients * factor[:, None, None] ** powers
            reference["reference_until"] = posture.reference["reference_until"] / factor
        return States(
            q=q[back],
            v=v,
            torque=torque,
            speed=own[back] * factor,
            mass=mass[back],
            reason=reasons,
            **reference,
        )

    def _mobility(self, name: str, q: Array) -> tuple[Array, Array, Array]:
        """B' (P, 3, nv), G (P, 3, 3) and J' (P, nv, 3) of `striking_functions` at P configurations."""
        found, nv = self._call(name, q), self.robot.nv
        ends = 3 * nv, 3 * nv + 9
        B, G, J = found[:, : ends[0]], found[:, ends[0] : ends[1]], found[:, ends[1] :]
        return B.reshape(-1, 3, nv), G.reshape(-1, 3, 3), J.reshape(-1, nv, 3)

    def _moved(self, start: Array, names: tuple[str, ...], by: Array) -> tuple[Array, Reasons]:
        """Configurations (P, nq) with the named joints moved by angles (P, joints), and reasons (P)."""
        robot, reason = self.robot, np.full(len(by), "", dtype=object)
        angles = np.repeat(robot.joint_positions(start)[None], len(by), axis=0)
        for name, angle in zip(names, by.T, strict=True):
            k = robot.joint_index(name)
            angles[:, k] += angle
            out = (angles[:, k] < robot.lower[k] - 1e-9) | (angles[:, k] > robot.upper[k] + 1e-9)
            _set_reason(reason, out, f"{name} would be beyond its limit")
        return robot.angles.put(np.repeat(start[None], len(by), axis=0), angles), reason

    def _call(self, name: str, inputs: Array) -> Array:
        """Outputs (N, ...) of a compiled function for inputs (N, size), in blocks of a fixed size."""
        if len(inputs) == 1:
            return np.array(self._functions[name](inputs[0], ())).reshape(1, -1)
        if name not in self._batched:
            self._batched[name] = BatchedFunction(self._functions[name], _BLOCK, np.zeros((_BLOCK, 0)))
        function, out = self._batched[name], []
        for begin in range(0, len(inputs), _BLOCK):
            block = inputs[begin : begin + _BLOCK]
            filled = np.vstack([block, np.repeat(block[-1:], _BLOCK - len(block), 0)])
            out.append(function(filled)[: len(block)].copy())
        return np.concatenate(out)

    @cached_property
    def _functions(self) -> dict[str, Any]:
        return striking_functions(self.robot, striker=self.striker, stance=self.stance)


def _set_reason(reason: Reasons, where: Mask, text: str) -> None:
    """Sets the reason where there is none yet."""
    reason[where & (reason == "")] = text
