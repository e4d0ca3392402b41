"""Placements, Jacobians, velocities and accelerations of links and frames, computed when first asked for.

They are in link frames; the world's axes enter at the end only, by one rotation.
"""

from __future__ import annotations

from impactopt.robots.rigid_body._spatial import (
    IDENTITY,
    Matrix,
    Number,
    Vector,
    add,
    column,
    cross,
    product,
    rotate_back_z,
    rotate_z,
    scale,
    subtract,
    times,
    transpose_times,
    zero_vector,
)
from impactopt.robots.rigid_body._tree import Coordinates, Kind, Tree


class Kinematics:
    """Placements and velocities of links and frames."""

    def __init__(self, tree: Tree, coordinates: Coordinates) -> None:
        self.tree, self.coordinates = tree, coordinates
        self._placements: dict[int, tuple[Matrix, Vector]] = {0: (IDENTITY, zero_vector())}
        self._frames: dict[str, tuple[Matrix, Vector]] = {}

    def offset(self, i: int) -> Vector:
        """Origin of link i in its parent's frame [m]."""
        joint = self.tree.joints[i]
        if joint.kind is Kind.PRISMATIC:
            return add(joint.translation, scale(self.coordinates.travel(i), column(joint.rotation, 2)))
        return joint.translation

    def up(self, i: int, a: Vector) -> Vector:
        """A vector given in link i's frame, in its parent's."""
        joint = self.tree.joints[i]
        if joint.kind is Kind.REVOLUTE:
            a = rotate_z(*self.coordinates.cos_sin(i), a)
        return times(joint.rotation, a)

    def down(self, i: int, a: Vector) -> Vector:
        """A vector given in the frame of link i's parent, in link i's."""
        joint = self.tree.joints[i]
        a = transpose_times(joint.rotation, a)
        return rotate_back_z(*self.coordinates.cos_sin(i), a) if joint.kind is Kind.REVOLUTE else a

    def placement(self, i: int) -> tuple[Matrix, Vector]:
        """(R, p [m]) of link i in the world."""
        for j in self.tree.support(i):
            if j not in self._placements:
                self._placements[j] = self._place(j)
        return self._placements[i]

    def _place(self, i: int) -> tuple[Matrix, Vector]:
        joint = self.tree.joints[i]
        if joint.kind is Kind.FREE:
            return self.coordinates.base_pose()
        R, p = self._placements[joint.parent]
        p = add(p, times(R, self.offset(i)))
        R = product(R, joint.rotation)
        if joint.kind is Kind.REVOLUTE:
            c, s = self.coordinates.cos_sin(i)
            R = [rotate_back_z(c, s, row) for row in R]
        return R, p

    def frame(self, name: str) -> tuple[Matrix, Vector]:
        """(R, p [m]) of a frame in the world."""
        if name not in self._frames:
            i, rotation, translation = self.tree.frame(name)
            R, p = self.placement(i)
            self._frames[name] = product(R, rotation), add(p, times(R, translation))
        return self._frames[name]

    def jacobian(self, name: str) -> dict[tuple[int, int], Number]:
        """Entries of the frame's Jacobian, (6, nv), LOCAL_WORLD_ALIGNED; other joints have no column."""
        _, point = self.frame(name)
        entries: dict[tuple[int, int], Number] = {}
        for j in self.tree.support(self.tree.frame(name)[0]):
            joint, (R, p) = self.tree.joints[j], self.placement(j)
            arm = subtract(point, p)
            if joint.kind is Kind.FREE:
                columns = [(column(R, c), zero_vector()) for c in range(3)]
                columns += [(cross(column(R, c), arm), column(R, c)) for c in range(3)]
            elif joint.kind is Kind.REVOLUTE:
                columns = [(cross(column(R, 2), arm), column(R, 2))]
            else:
                columns = [(column(R, 2), zero_vector())]
            for c, (linear, angular) in enumerate(columns):
                for r in range(3):
                    entries[r, joint.v + c], entries[3 + r, joint.v + c] = linear[r], angular[r]
        return entries


class Velocities:
    """Link velocities, in link frames, for one v (a list of nv numbers)."""

    def __init__(self, kinematics: Kinematics, v: Vector) -> None:
        self.kinematics, self.tree, self.v = kinematics, kinematics.tree, v
        self._angular: dict[int, Vector] = {0: zero_vector()}
        self._linear: dict[int, Vector] = {0: zero_vector()}

    def angular(self, i: int) -> Vector:
        """Angular velocity of link i [rad/s]."""
        for j in self.tree.support(i):
            if j not in self._angular:
                joint = self.tree.joints[j]
                if joint.kind is Kind.FREE:
                    self._angular[j] = self.v[joint.v + 3 : joint.v + 6]
                    continue
                x, y, z = self.kinematics.down(j, self._angular[joint.parent])
                self._angular[j] = [x, y, z + self.v[joint.v]] if joint.kind is Kind.REVOLUTE else [x, y, z]
        return self._angular[i]

    def linear(self, i: int) -> Vector:
        """Velocity of link i's origin [m/s]."""
        for j in self.tree.support(i):
            if j not in self._linear:
                joint = self.tree.joints[j]
                if joint.kind is Kind.FREE:
                    self._linear[j] = self.v[joint.v : joint.v + 3]
                    continue
                above = add(
                    self._linear[joint.parent], cross(self.angular(joint.parent), self.kinematics.offset(j))
                )
                x, y, z = self.kinematics.down(j, above)
                self._linear[j] = [x, y, z + self.v[joint.v]] if joint.kind is Kind.PRISMATIC else [x, y, z]
        return self._linear[i]

    def frame(self, name: str) -> Vector:
        """Six numbers J v: [linear; angular] velocity of a frame at its origin, along the world's axes."""
        i, _, translation = self.tree.frame(name)
        R, _ = self.kinematics.placement(i)
        w = self.angular(i)
        return times(R, add(self.linear(i), cross(w, translation))) + times(R, w)


class Accelerations:
    """Link accelerations, in link frames, for one v and a: dw/dt, and the *point* acceleration of the origin.

    Linear velocity is not needed for them, except the base's own.
    """

    def __init__(self, velocities: Velocities, a: Vector) -> None:
        self.velocities, self.a = velocities, a
        self.kinematics, self.tree = velocities.kinematics, velocities.tree
        self._angular: dict[int, Vector] = {0: zero_vector()}
        self._spin: dict[int, Matrix] = {0: [zero_vector() for _ in range(3)]}
        self._linear: dict[bool, dict[int, Vector]] = {
            False: {0: zero_vector()},
            True: {0: scale(-1.0, self.tree.gravity)},
        }

    def angular(self, i: int) -> Vector:
        """Angular acceleration of link i [rad/s2]."""
        for j in self.tree.support(i):
            if j not in self._angular:
                joint = self.tree.joints[j]
                if joint.kind is Kind.FREE:
                    self._angular[j] = self.a[joint.v + 3 : joint.v + 6]
                    continue
                x, y, z = self.kinematics.down(j, self._angular[joint.parent])
                if joint.kind is Kind.REVOLUTE:
                    w, rate = self.velocities.angular(j), self.velocities.v[joint.v]
                    x, y, z = x + w[1] * rate, y - w[0] * rate, z + self.a[joint.v]
                self._angular[j] = [x, y, z]
        return self._angular[i]

    def spin(self, i: int) -> Matrix:
        """U = [dw/dt]x + [w]x [w]x: a point at r in link i accelerates by U r against the origin."""
        if i not in self._spin:
            (x, y, z), (ax, ay, az) = self.velocities.angular(i), self.angular(i)
            xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
            self._spin[i] = [
                [0.0 - (yy + zz), xy - az, xz + ay],
                [xy + az, 0.0 - (xx + zz), yz - ax],
                [xz - ay, yz + ax, 0.0 - (xx + yy)],
            ]
        return self._spin[i]

    def linear(self, i: int, *, gravity: bool) -> Vector:
        """Acceleration of link i's origin [m/s2]; less gravity's (an accelerometer's) where `gravity`."""
        known = self._linear[gravity]
        for j in self.tree.support(i):
            if j not in known:
                known[j] = self._accelerate(j, known[self.tree.joints[j].parent])
        return known[i]

    def _accelerate(self, i: int, above: Vector) -> Vector:
        joint, v = self.tree.joints[i], self.velocities.v
        if joint.kind is Kind.FREE:
            R, _ = self.kinematics.placement(i)
            # Pinocchio's a is dv/dt along the base's own, turning axes.
            turning = cross(v[joint.v + 3 : joint.v + 6], v[joint.v : joint.v + 3])
            return add(add(self.a[joint.v : joint.v + 3], turning), transpose_times(R, above))
        at_joint = add(above, times(self.spin(joint.parent), self.kinematics.offset(i)))
        x, y, z = self.kinematics.down(i, at_joint)
        if joint.kind is Kind.PRISMATIC:
            w, rate = self.velocities.angular(i), v[joint.v]
            x, y, z = x + 2.0 * (w[1] * rate), y - 2.0 * (w[0] * rate), z + self.a[joint.v]
        return [x, y, z]

    def frame(self, name: str) -> Vector:
        """Six numbers: acceleration of a frame's origin and angular acceleration, along the world's axes."""
        i, _, translation = self.tree.frame(name)
        R, _ = self.kinematics.placement(i)
        origin = self.linear(i, gravity=False)
        return times(R, add(origin, times(self.spin(i), translation))) + times(R, self.angular(i))
