"""States at contact of many rows: posture, velocity and feed-forward torque, in compiled code.

`impactopt.kinematics.operational_space` has the same for one state, by Pinocchio and least squares; they
are tested against each other. That takes some milliseconds a state, which for millions would be hours.

A robot's posture in a row is one of a few, found once each, with joints moved from there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impactopt.codegen.cache import cached, model_hash
from impactopt.collision.frozen import _inverse_of_cholesky
from impactopt.errors import InputError, check_choice
from impactopt.files.output import load_record
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.kinematics.inverse_kinematics import inverse_kinematics
from impactopt.kinematics.stance import Free, Stance
from impactopt.kinematics.support import support_polygon
from impactopt.robots.rigid_body import RigidBody
from impactopt.robots.robot import Robot
from impactopt.simulation.reference import coasting_reference
from impactopt.transcription.batched import BatchedFunction

__all__ = ["ContactStates", "Posture", "States", "striking_functions"]

_BASE = 100.0  # [m/s], [rad/s]


def striking_functions(robot: Robot, *, striker: str, stance: Stance) -> dict[str, Any]:
    """Compiled ca.Functions of a robot on a stance whose soles are held exactly.

    * ``least_energy`` (q (nq), -) -> (B (nv, 3), G (3, 3), J (3, nv)): J is the striking point's linear
      Jacobian, and with P the inverse inertia of the robot as held B = P J' and G = J P J'. A velocity
      v = B x has the least kinetic energy of all that move the striking point at G x.
    * ``least_rates``: likewise with the sum of squares of the joints' speeds over their limits in place of
      the kinetic energy.
    * ``holding`` ((q, v), -) -> tau (n) [N m]: the least-norm torque and wrenches that keep all velocities as
      they are.

    The second input of each is empty, and outputs lie one after the other by columns.
    """
    frame, held = robot.striker(striker).model_frame, stance.constraint_frames(robot)

    def build() -> list[Any]:
        tree = _StrikingGraphs(robot, held, frame)
        return [tree.least_energy(), tree.least_rates(), tree.holding()]

    recipe = (model_hash(robot.model, robot.springs), frame, held, robot.velocity_limit)
    return cached("striking", recipe, build)


class _StrikingGraphs:
    """Quantities that depend on the robot's tree in SX, dense algebra in MX, as in `FrozenDynamics`."""

    def __init__(self, robot: Robot, held: tuple[str, ...], frame: str) -> None:
        self.rb = RigidBody(robot.model, springs=robot.springs)
        self.n, self.base = robot.n, robot.nv - robot.n
        self.nq, self.nv, self.held, self.frame = robot.nq, robot.nv, held, frame
        # the base's speeds are those that the legs leave it: they cost next to nothing
        self.ease = np.concatenate([np.full(self.base, _BASE), robot.velocity_limit])

    def least_energy(self) -> Any:
        H = self.rb.mass_matrix()
        entries = ca.SX.sym("H", H.sparsity())
        factor = self.rb.factorize(entries)
        root = ca.mtimes(ca.diag(1 / ca.sqrt(factor.diagonal)), factor.half_solve(ca.SX.eye(self.nv)))
        inverse_root = ca.Function("inverse_root", [entries], [root])
        inertia = ca.Function("inertia", [self.rb.q], [H])
        return self._mobility("least_energy", lambda q: inverse_root(inertia(q)))

    def least_rates(self) -> Any:
        return self._mobility("least_rates", lambda q: ca.MX(ca.diag(ca.DM(self.ease))))

    def _mobility(self, name: str, root: Callable[[Any], Any]) -> Any:
        """Function of the mobility W of a configuration, with W' W the inverse of the least quantity."""
        q, none = ca.MX.sym("q", self.nq), ca.MX.sym("none", 0)
        rows = ca.Function("rows", [self.rb.q], [ca.densify(self.rb.jacobian(self.frame)[:3, :]), self._held])
        J, J_c = rows(q)
        W = root(q)
        hand = ca.mtimes(W, J.T)
        if self.held:
            soles = ca.mtimes(W, J_c.T)
            R = _inverse_of_cholesky(soles.size2())(ca.mtimes(soles.T, soles))
            hand = hand - ca.mtimes(soles, ca.mtimes(R.T, ca.mtimes(R, ca.mtimes(soles.T, hand))))
        return ca.Function(name, [q, none], [_column(ca.mtimes(W.T, hand), ca.mtimes(hand.T, hand), J)])

    def holding(self) -> Any:
        state, none = ca.MX.sym("state", self.nq + self.nv), ca.MX.sym("none", 0)
        rb = self.rb
        bias = ca.Function("bias", [rb.q, rb.v], [rb.rnea(rb.v, None), self._held])
        b, J_c = bias(state[: self.nq], state[self.nq :])
        of_base, of_joints = b[: self.base, :], b[self.base :, :]
        if not self.held:
            return ca.Function("holding", [state, none], [_column(of_joints)])
        J_b, J_j = J_c[:, : self.base], J_c[:, self.base :]
        # least |tau|^2 + |w|^2 with J_b' w = b_base and tau = b_joints - J_j' w
        R = _inverse_of_cholesky(J_c.size1())(ca.DM.eye(J_c.size1()) + ca.mtimes(J_j, J_j.T))
        y, U = ca.mtimes(R, ca.mtimes(J_j, of_joints)), ca.mtimes(R, J_b)
        if self.base:
            S = _inverse_of_cholesky(self.base)(ca.mtimes(U.T, U))
            y = y + ca.mtimes(U, ca.mtimes(S.T, ca.mtimes(S, of_base - ca.mtimes(U.T, y))))
        torque = of_joints - ca.mtimes(J_j.T, ca.mtimes(R.T, y))
        return ca.Function("holding", [state, none], [_column(torque)])

    @property
    def _held(self) -> Any:
        """J_c (c, nv)."""
        frames = [self.rb.jacobian(frame) for frame in self.held]
        return ca.densify(ca.vertcat(ca.SX(0, self.nv), *frames))


def _column(*parts: Any) -> Any:
    return ca.densify(ca.vertcat(*[ca.vec(part) for part in parts]))


Array = NDArray[np.float64]
Reasons = NDArray[np.object_]

_BLOCK = 256  # states a call of a compiled function
_UNTIL = 2.1  # of a planned contact: how long its reference is known, for other targets too
_LONG = 0.1  # [s] likewise, where a record does not say
_OFF = 1e-6  # [m/s] at 1 m/s, across what can be moved


@dataclass(frozen=True, kw_only=True, eq=False)
class Posture:
    """Posture that rows start from: q (nq,); of a saved result also its velocity v (nv,), torque (n,) [N m]
    and its servo's reference, the settings of `coasting_reference`.

    polygon (k, 2) [m] : support polygon; without corners on a fixed base.
    """

    q: Array
    polygon: Array
    v: Array | None = None
    torque: Array | None = None
    bend: Mapping[str, Array] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class States:
    """States at contact of N rows: q (N, nq), v (N, nv), torque (N, n) [N m], the striking point's speed
    along the normal (N) [m/s], the effective mass there (N) [kg], and why a row is impossible, "" where it is
    not; of a result also the settings `reference` (N, n, k) and `reference_until` (N)."""

    q: Array
    v: Array
    torque: Array
    speed: Array
    mass: Array
    reason: Reasons
    reference: Array | None = None
    reference_until: Array | None = None

    @property
    def bend(self) -> dict[str, Array]:
        """Settings of the servo's reference, a row each; none of a posture."""
        if self.reference is None or self.reference_until is None:
            return {}
        return {"reference": self.reference, "reference_until": self.reference_until}

    def some(self, rows: NDArray[np.intp]) -> States:
        """States of these rows alone."""
        kept: dict[str, Any] = {name: None if x is None else x[rows] for name, x in vars(self).items()}
        return States(**kept)


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactStates:
    """States at contact of one robot on one stance.

    start : posture (nq,) that reaches begin from.  folder : where a result's relative path begins.
    """

    robot: Robot
    striker: str
    stance: Stance
    start: Array
    folder: Path
    _postures: dict[Any, Posture | str] = field(init=False, repr=False, default_factory=dict)
    _compiled: dict[Any, Any] = field(init=False, repr=False, default_factory=dict)

    # ------------------------------------------------------------ postures
    def posture(self, name: str, result: str | None, point: tuple[float, ...]) -> Posture | str:
        """Posture of [at_contact] posture or result, and the point (3,) [m] of a reach; or why there is none.

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
                f"[at_contact] posture: {robot.name} floats freely, so it reaches the point from no "
                f"known place: name a posture; there are {', '.join(robot.postures)}"
            )
        coordinates = self._coordinates(q)
        try:
            q = inverse_kinematics(coordinates, self.striker, np.array(point), q)
        except InputError:
            return "the point is out of reach"
        return Posture(q=q, polygon=support_polygon(robot, coordinates))

    def _named(self, name: str, result: str | None) -> Posture:
        robot, v, torque, lasts = self.robot, None, None, _LONG
        if result is not None:
            q, v, torque, lasts = self._of_result(result)
        else:
            known = ("reach", *robot.postures)
            check_choice(f"[at_contact] posture: {robot.name} has no posture", name, known)
            q = robot.posture(name)
        if isinstance(self.stance, Free) and result is None:
            return Posture(q=q, polygon=np.zeros((0, 2)))
        robot.check_stance(q, self.stance.sole_names(robot))
        coordinates = self._coordinates(q)
        bend = None if v is None else coasting_reference(coordinates, q, v, until=lasts)
        polygon = support_polygon(robot, coordinates)
        return Posture(q=q, v=v, torque=torque, bend=bend, polygon=polygon)

    def _coordinates(self, q: Array) -> StanceCoordinates:
        """Coordinates with the stance's frames fixed where they are in a posture (nq,)."""
        robot, stance = self.robot, self.stance
        return StanceCoordinates(robot, stance.soles(robot), q, stance.held_hands(robot))

    def _of_result(self, result: str) -> tuple[Array, Array, Array, float]:
        """q, v, torque, and for how long [s] the reference is to be known."""
        record = load_record(self.folder / result)
        a = record.arrays
        if tuple(a["joints"]) != self.robot.joint_names:
            raise InputError(
                f"[at_contact] result: {result} is of a robot with other joints than {self.robot.name}"
            )
        lasts = _UNTIL * float(a["collision_time"][-1]) if "collision_time" in a else _LONG
        lasts = max(lasts, _LONG / 2)
        if "strike_posture" in a:
            return a["strike_posture"], a["strike_velocity"], a["strike_torque"], lasts
        if not record.completed:
            raise InputError(f"[at_contact] result: {result} has no motion; solve it again")
        last = int(np.flatnonzero(a["reference_phase"] == 0)[-1])  # the end of the swing
        return a["reference_q"][last], a["reference_v"][last], a["reference_torque"][last], lasts

    # ------------------------------------------------------------ rows
    def check_joint(self, name: str) -> None:
        """InputError for a joint that there is not, or one whose motion would move what is held."""
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

    def rows(
        self,
        posture: Posture,
        joints: Mapping[str, Array],
        speed: Array | None,
        normal: Array,
        count: int,
        *,
        velocity: str = "least energy",
    ) -> States:
        """States of `count` rows; joints (count,) [rad] are added to the posture's; speed (count,) [m/s];
        normal (3,); velocity as of [at_contact]."""
        moves = np.stack([*joints.values()], axis=1) if joints else np.zeros((count, 0))
        # rows that differ in speed only have one posture
        same = not moves.size or bool((moves == moves[0]).all())
        kept, back = (moves[:1], np.zeros(count, dtype=np.intp)) if same else _distinct(moves)
        q, reason = self._moved(posture.q, tuple(joints), kept)
        robot, nv = self.robot, self.robot.nv
        B, G, J = self._mobility("least_energy", q)
        mass = 1 / np.einsum("i,rij,j->r", normal, G, normal)
        if posture.v is None:
            if velocity != "least energy":
                B, G, J = self._mobility("least_rates", q)
            x = np.linalg.pinv(G, rcond=1e-12, hermitian=True) @ normal
            stuck = np.abs(np.einsum("rij,rj->ri", G, x) - normal).max(axis=1) > _OFF
            _say(reason, stuck, "the striking point cannot move along the normal here")
            unit = np.einsum("rkv,rk->rv", B, x)
        else:
            unit = np.broadcast_to(posture.v, (len(q), nv))
        own = np.einsum("i,rvi,rv->r", normal, J, unit)
        _say(reason, own <= 0, "the striking point does not approach the target")
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
            _say(reasons, over[:, k], f"{robot.joint_names[k]} would be faster than its limit")
        bend: dict[str, Any] = {}
        if posture.bend is not None:  # the same way, in less time
            reference = posture.bend["reference"]
            powers = np.arange(2, reference.shape[1] + 2)
            bend["reference"] = reference * factor[:, None, None] ** powers
            bend["reference_until"] = posture.bend["reference_until"] / factor
        return States(
            q=q[back],
            v=v,
            torque=torque,
            speed=own[back] * factor,
            mass=mass[back],
            reason=reasons,
            **bend,
        )

    def _mobility(self, name: str, q: Array) -> tuple[Array, Array, Array]:
        """B (R, 3, nv), G (R, 3, 3) and J (R, nv, 3) of `striking_functions`, by columns."""
        found, nv = self._call(name, q), self.robot.nv
        ends = 3 * nv, 3 * nv + 9
        B, G, J = found[:, : ends[0]], found[:, ends[0] : ends[1]], found[:, ends[1] :]
        return B.reshape(-1, 3, nv), G.reshape(-1, 3, 3), J.reshape(-1, nv, 3)

    def _moved(self, start: Array, names: tuple[str, ...], by: Array) -> tuple[Array, Reasons]:
        robot, model = self.robot, self.robot.model
        q = np.repeat(start[None], len(by), axis=0)
        reason = np.full(len(by), "", dtype=object)
        own = robot.joint_positions(start)
        for name, angle in zip(names, by.T, strict=True):
            k = robot.joint_index(name)
            joint = model.joints[model.getJointId(name)]
            place = int(joint.idx_q)
            if joint.nq == 1:
                q[:, place] += angle
            else:  # a continuous joint: cosine and sine
                q[:, place], q[:, place + 1] = np.cos(own[k] + angle), np.sin(own[k] + angle)
            out = (own[k] + angle < robot.lower[k] - 1e-9) | (own[k] + angle > robot.upper[k] + 1e-9)
            _say(reason, out, f"{name} would be beyond its limit")
        return q, reason

    def _call(self, name: str, rows: Array) -> Array:
        """A compiled function of rows (N, numbers)."""
        if "functions" not in self._compiled:
            self._compiled["functions"] = striking_functions(
                self.robot, striker=self.striker, stance=self.stance
            )
        size = 1 if len(rows) == 1 else _BLOCK
        key = (name, size)
        if key not in self._compiled:
            function = self._compiled["functions"][name]
            self._compiled[key] = BatchedFunction(function, size, np.zeros((size, 0)))
        function, out = self._compiled[key], []
        for begin in range(0, len(rows), size):
            block = rows[begin : begin + size]
            filled = (
                block
                if len(block) == size
                else np.vstack([block, np.repeat(block[-1:], size - len(block), 0)])
            )
            out.append(function(filled)[: len(block)].copy())
        return np.concatenate(out)


def _distinct(moves: Array) -> tuple[Array, NDArray[np.intp]]:
    kept, back = np.unique(moves, axis=0, return_inverse=True)
    return kept, back.ravel()


def _say(reason: Reasons, where: NDArray[np.bool_], text: str) -> None:
    """The first reason stays."""
    reason[where & (reason == "")] = text
