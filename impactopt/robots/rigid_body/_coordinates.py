"""Coordinates q of a tree: the base's pose and each joint's angle or travel, and how they change with v.

`"quaternion"` is Pinocchio's q: p, quaternion (x, y, z, w), joints; a continuous joint is (cos, sin).
`"rpy"` has one number for each velocity: p, (roll, pitch, yaw), joints; R = Rz(yaw) Ry(pitch) Rx(roll). A
fixed base has no pose, so the two differ there in continuous joints only.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from impactopt.errors import InputError, check_array, did_you_mean
from impactopt.robots.rigid_body._scalar import (
    Matrix,
    Number,
    Scalar,
    Vector,
    cos,
    pack_entries,
    pack_vector,
    sin,
    tan,
    unpack_vector,
)
from impactopt.robots.rigid_body._spatial import (
    IDENTITY,
    add,
    cross,
    product,
    scale,
    subtract,
    times,
    transpose_times,
    zero_vector,
)
from impactopt.robots.rigid_body._tree import Kind, Tree

BASES = ("quaternion", "rpy")


class Coordinates:
    """The symbols q of a tree, and every joint's cosine and sine, or travel, in them."""

    def __init__(self, tree: Tree, base: str) -> None:
        if base not in BASES:
            raise InputError(f"base={base!r}: use 'quaternion' or 'rpy'{did_you_mean(str(base), BASES)}")
        self.tree, self.base = tree, base
        self.nq = tree.nq if base == "quaternion" else tree.nv
        self.q = ca.SX.sym("q", self.nq)
        q: list[Any] = unpack_vector(self.q)
        self._cos_sin: dict[int, tuple[Number, Number]] = {}
        self._travel: dict[int, Number] = {}
        for i, joint in enumerate(tree.joints[1:], start=1):
            k = joint.q if base == "quaternion" else joint.v
            if joint.kind is Kind.PRISMATIC:
                self._travel[i] = q[k]
            elif joint.continuous and base == "quaternion":
                self._cos_sin[i] = (q[k], q[k + 1])
            elif joint.kind is Kind.REVOLUTE:
                self._cos_sin[i] = (cos(q[k]), sin(q[k]))
        self._position: Vector = zero_vector()
        self._rotation: Matrix = IDENTITY
        if tree.floating:
            self._position = q[:3]
            if base == "quaternion":
                self._quaternion = q[3:7]
                self._rotation = _quaternion_matrix(*q[3:7])
            else:
                (cr, sr), (cp, sp), (cy, sy) = [(cos(angle), sin(angle)) for angle in q[3:6]]
                self._tan_pitch = tan(q[4])
                self._rpy = (cr, sr, cp, sp)
                self._rotation = [
                    [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
                    [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
                    [-sp, cp * sr, cp * cr],
                ]

    def cos_sin(self, i: int) -> tuple[Number, Number]:
        """Cosine and sine of revolute joint i."""
        return self._cos_sin[i]

    def travel(self, i: int) -> Number:
        """Travel of prismatic joint i [m]."""
        return self._travel[i]

    def base_pose(self) -> tuple[Matrix, Vector]:
        """(R, p [m]) of the free-flyer's link in the world."""
        root = self.tree.joints[1]
        return product(root.rotation, self._rotation), add(
            root.translation, times(root.rotation, self._position)
        )

    # ------------------------------------------------------------ q and v
    def velocity_map(self) -> Any:
        """T(q), (nv, nv) sparse, with v = T dq/dt; for coordinates with one number a velocity."""
        self._one_number_a_velocity("velocity_map")
        if not self.tree.floating:
            return ca.SX.eye(self.tree.nv)
        entries: dict[tuple[int, int], Number] = {}
        W = self._rpy_rates_to_angular_velocity()
        for r in range(3):
            for c in range(3):
                entries[r, c] = self._rotation[c][r]
                entries[3 + r, 3 + c] = W[r][c]
        return ca.diagcat(pack_entries((6, 6), entries), ca.SX.eye(self.tree.nv - 6))

    def acceleration(self, rate: Vector, second: Vector) -> Any:
        """a = dv/dt = T d2q/dt2 + dT/dt dq/dt, SX (nv), from dq/dt and d2q/dt2."""
        self._one_number_a_velocity("acceleration")
        if not self.tree.floating:
            return pack_vector(second)
        (cr, sr, cp, sp), (dr, dp, dy) = self._rpy, rate[3:6]
        W = self._rpy_rates_to_angular_velocity()
        angular_velocity = times(W, rate[3:6])
        velocity = transpose_times(self._rotation, rate[:3])
        # v is measured along axes that turn with the base.
        linear = subtract(transpose_times(self._rotation, second[:3]), cross(angular_velocity, velocity))
        rate_of_W_times_rate = [
            -(cp * dp * dy),
            (cp * cr * dr - sp * sr * dp) * dy - sr * dr * dp,
            -(cp * sr * dr + sp * cr * dp) * dy - cr * dr * dp,
        ]
        angular = add(times(W, second[3:6]), rate_of_W_times_rate)
        return pack_vector([*linear, *angular, *second[6:]])

    def tangent_map(self) -> Any:
        """dq/dv, (nq, nv) sparse: dq/dt = tangent_map v. With "rpy" it is singular at pitch = +-90 deg."""
        entries: dict[tuple[int, int], Number] = {}
        if self.tree.floating:
            G = self._angular_velocity_to_rates()
            for c in range(3):
                entries.update({(r, c): self._rotation[r][c] for r in range(3)})
                entries.update({(3 + r, 3 + c): row[c] for r, row in enumerate(G)})
        for i, joint in enumerate(self.tree.joints[1:], start=1):
            k = joint.q if self.base == "quaternion" else joint.v
            if joint.kind is Kind.FREE:
                continue
            if joint.continuous and self.base == "quaternion":
                c_, s_ = self._cos_sin[i]
                entries[k, joint.v], entries[k + 1, joint.v] = 0.0 - s_, c_
            else:
                entries[k, joint.v] = 1.0
        return pack_entries((self.nq, self.tree.nv), entries)

    def integrate(self, d: Any) -> Any:
        """q after moving with the constant velocity d, SX (nv), for one second, as pin.integrate; for
        "quaternion"."""
        if self.base != "quaternion":
            raise InputError("integrate: needs Pinocchio's q; build with base='quaternion'")
        q = ca.SX(self.q)
        if self.tree.floating:
            shift, quaternion = _exponential(d[:3], d[3:6])
            x, y, z, w = self._quaternion
            entries = {(r, c): self._rotation[r][c] for r in range(3) for c in range(3)}
            rotation = pack_entries((3, 3), entries)
            vector, scalar = ca.vertcat(x.x, y.x, z.x), w.x
            q[:3] += ca.mtimes(rotation, shift)
            q[3:6] = scalar * quaternion[:3] + quaternion[3] * vector + ca.cross(vector, quaternion[:3])
            q[6] = scalar * quaternion[3] - ca.dot(vector, quaternion[:3])
        for joint in self.tree.joints[1:]:
            if joint.kind is Kind.FREE:
                continue
            if joint.continuous:
                c, s = self.q[joint.q], self.q[joint.q + 1]
                turn = d[joint.v]
                q[joint.q] = c * ca.cos(turn) - s * ca.sin(turn)
                q[joint.q + 1] = s * ca.cos(turn) + c * ca.sin(turn)
            else:
                q[joint.q] += d[joint.v]
        return q

    def _one_number_a_velocity(self, method: str) -> None:
        if self.nq != self.tree.nv:
            raise InputError(
                f"{method}: needs nq = nv, but nq = {self.nq}, nv = {self.tree.nv}; build with base='rpy'"
            )

    def _rpy_rates_to_angular_velocity(self) -> Matrix:
        cr, sr, cp, sp = self._rpy
        return [[1.0, 0.0, 0.0 - sp], [0.0, cr, cp * sr], [0.0, 0.0 - sr, cp * cr]]

    def _angular_velocity_to_rates(self) -> Matrix:
        if self.base == "quaternion":
            x, y, z, w = self._quaternion
            return [scale(0.5, row) for row in ([w, -z, y], [z, w, -x], [-y, x, w], [-x, -y, -z])]
        cr, sr, cp, _ = self._rpy
        t = self._tan_pitch
        return [[1.0, sr * t, cr * t], [0.0, cr, 0.0 - sr], [0.0, sr / cp, cr / cp]]

    # ------------------------------------------------------------ numeric
    def from_pin(self, q: ArrayLike) -> NDArray[np.float64]:
        """These coordinates of Pinocchio's q; angles in (-pi, pi] where q does not tell turns apart."""
        q = check_array("q (pinocchio)", q, (self.tree.nq,))
        unit = [("quaternion", 3, 7)] if self.tree.floating else []
        unit += [(f"joint {j.name!r} (cos, sin)", j.q, j.q + 2) for j in self.tree.joints if j.continuous]
        for part, k, end in unit:
            if abs(np.linalg.norm(q[k:end]) - 1.0) > 1e-6:
                raise InputError(
                    f"q (pinocchio): {part}, q[{k}:{end}], must be of norm 1; pin.normalize(model, q)"
                )
        if self.base == "quaternion":
            return q
        out = np.empty(self.nq)
        if self.tree.floating:
            out[:3] = q[:3]
            out[3:6] = pin.rpy.matrixToRpy(pin.XYZQUATToSE3(q[:7]).rotation)
        for joint in self.tree.joints[1:]:
            if joint.kind is not Kind.FREE:
                out[joint.v] = np.arctan2(q[joint.q + 1], q[joint.q]) if joint.continuous else q[joint.q]
        return out

    def to_pin(self, q: ArrayLike) -> NDArray[np.float64]:
        """Pinocchio's q of these coordinates."""
        q = check_array("q", q, (self.nq,))
        if self.base == "quaternion":
            return q
        out = np.empty(self.tree.nq)
        if self.tree.floating:
            out[:7] = pin.SE3ToXYZQUAT(pin.SE3(pin.rpy.rpyToMatrix(q[3:6]), q[:3]))
        for joint in self.tree.joints[1:]:
            if joint.continuous:
                out[joint.q : joint.q + 2] = np.cos(q[joint.v]), np.sin(q[joint.v])
            elif joint.kind is not Kind.FREE:
                out[joint.q] = q[joint.v]
        return out


def _quaternion_matrix(x: Scalar, y: Scalar, z: Scalar, w: Scalar) -> Matrix:
    return [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]


def _exponential(linear: Any, angular: Any) -> tuple[Any, Any]:
    """(translation (3), quaternion (4)) of the twist's exponential; series where the angle is small."""
    square = ca.dot(angular, angular)
    small = square < 1e-6
    angle = ca.sqrt(ca.if_else(small, 1.0, square))
    half = ca.if_else(small, 0.5 - square / 48.0, ca.sin(angle / 2) / angle)
    first = ca.if_else(small, 0.5 - square / 24.0, (1 - ca.cos(angle)) / angle**2)
    second = ca.if_else(small, 1.0 / 6.0 - square / 120.0, (angle - ca.sin(angle)) / angle**3)
    turned = ca.cross(angular, linear)
    shift = linear + first * turned + second * ca.cross(angular, turned)
    cosine = ca.if_else(small, 1.0 - square / 8.0 + square**2 / 384.0, ca.cos(angle / 2))
    return shift, ca.vertcat(half * angular, cosine)
