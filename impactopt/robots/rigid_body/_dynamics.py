"""Kinematics and dynamics of a tree: placements, Jacobians, velocities; inertias, H, its factors, momentum.

Algorithms after Featherstone, Rigid Body Dynamics Algorithms (2008), chapters 5 and 6. They run in link
frames, and a rotation into the world's axes comes last. So H does not depend on the base's pose, and its
derivatives have no entries for it.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from impactopt.errors import InputError
from impactopt.robots.rigid_body._spatial import (
    IDENTITY,
    Matrix,
    Number,
    Vector,
    add,
    as_sx,
    column,
    cross,
    is_zero,
    move_tensor,
    product,
    rotate_back_z,
    rotate_z,
    scale,
    subtract,
    tensor_matrix,
    tensor_rotate,
    tensor_rotate_z,
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

    def to_parent(self, i: int, a: Vector) -> Vector:
        """Rotate a vector from link i's axes to its parent's."""
        joint = self.tree.joints[i]
        if joint.kind is Kind.REVOLUTE:
            a = rotate_z(*self.coordinates.cos_sin(i), a)
        return times(joint.rotation, a)

    def from_parent(self, i: int, a: Vector) -> Vector:
        """Rotate a vector from the axes of link i's parent to link i's."""
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
        """Entries of the frame's Jacobian, (6, nv), LOCAL_WORLD_ALIGNED, by (row, column).

        Only joints between the root and the frame have entries.
        """
        _, point = self.frame(name)
        entries: dict[tuple[int, int], Number] = {}
        for j in self.tree.support(self.tree.frame(name)[0]):
            joint, (R, p) = self.tree.joints[j], self.placement(j)
            arm = subtract(point, p)
            # (linear, angular) velocity of the frame per unit of each of the joint's velocities
            if joint.kind is Kind.FREE:
                columns = [(column(R, c), zero_vector()) for c in range(3)]
                columns += [(cross(column(R, c), arm), column(R, c)) for c in range(3)]
            elif joint.kind is Kind.REVOLUTE:
                columns = [(cross(column(R, 2), arm), column(R, 2))]
            else:
                columns = [(column(R, 2), zero_vector())]
            for c, parts in enumerate(columns):
                for r, entry in enumerate(joint.ratio * x for part in parts for x in part):
                    place = r, joint.v + c
                    # a follower and its leader have the same column, so their parts are added
                    entries[place] = entries[place] + entry if place in entries else entry
        return entries


class Velocities:
    """Link velocities, in link frames, for one v (a list of nv numbers); each is computed once, on demand."""

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
                # the parent's, plus the joint's own rate about z
                x, y, z = self.kinematics.from_parent(j, self._angular[joint.parent])
                turning = joint.kind is Kind.REVOLUTE
                self._angular[j] = [x, y, z + joint.along(self.v)] if turning else [x, y, z]
        return self._angular[i]

    def linear(self, i: int) -> Vector:
        """Velocity of link i's origin [m/s]."""
        for j in self.tree.support(i):
            if j not in self._linear:
                joint = self.tree.joints[j]
                if joint.kind is Kind.FREE:
                    self._linear[j] = self.v[joint.v : joint.v + 3]
                    continue
                # the velocity of the parent's point at this origin, plus the joint's own rate along z
                above = add(
                    self._linear[joint.parent], cross(self.angular(joint.parent), self.kinematics.offset(j))
                )
                x, y, z = self.kinematics.from_parent(j, above)
                sliding = joint.kind is Kind.PRISMATIC
                self._linear[j] = [x, y, z + joint.along(self.v)] if sliding else [x, y, z]
        return self._linear[i]

    def frame(self, name: str) -> Vector:
        """Six numbers J v: [linear; angular] velocity of a frame at its origin, along the world's axes."""
        i, _, translation = self.tree.frame(name)
        R, _ = self.kinematics.placement(i)
        w = self.angular(i)
        return times(R, add(self.linear(i), cross(w, translation))) + times(R, w)


class Accelerations:
    """Link accelerations, in link frames, for one v and a: dw/dt, and the *point* acceleration of the origin.

    Linear velocities of links are not needed for them, except that of the free-flyer, which is given along
    turning axes.
    """

    def __init__(self, velocities: Velocities, a: Vector) -> None:
        self.velocities, self.a = velocities, a
        self.kinematics, self.tree = velocities.kinematics, velocities.tree
        self._angular: dict[int, Vector] = {0: zero_vector()}
        self._spin: dict[int, Matrix] = {0: [zero_vector() for _ in range(3)]}
        # with gravity as an upward acceleration of the universe (Featherstone 2008, section 5.3), and without
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
                x, y, z = self.kinematics.from_parent(j, self._angular[joint.parent])
                if joint.kind is Kind.REVOLUTE:
                    # w x (0, 0, rate), as the axis turns with the link, and the joint's own about z
                    w, rate = self.velocities.angular(j), joint.along(self.velocities.v)
                    x, y, z = x + w[1] * rate, y - w[0] * rate, z + joint.along(self.a)
                self._angular[j] = [x, y, z]
        return self._angular[i]

    def spin(self, i: int) -> Matrix:
        """U = [dw/dt]x + [w]x [w]x, (3, 3): the acceleration of a point r of link i relative to its origin
        is U r.
        """
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
        """Acceleration of link i's origin [m/s2]; minus that of gravity (as an accelerometer measures it) if
        `gravity`.
        """
        known = self._linear[gravity]
        for j in self.tree.support(i):
            if j not in known:
                known[j] = self._accelerate(j, known[self.tree.joints[j].parent])
        return known[i]

    def _accelerate(self, i: int, above: Vector) -> Vector:
        joint, v = self.tree.joints[i], self.velocities.v
        if joint.kind is Kind.FREE:
            R, _ = self.kinematics.placement(i)
            # Pinocchio's a is dv/dt along the base's own, turning axes: w x v is missing in it
            turning = cross(v[joint.v + 3 : joint.v + 6], v[joint.v : joint.v + 3])
            return add(add(self.a[joint.v : joint.v + 3], turning), transpose_times(R, above))
        at_joint = add(above, times(self.spin(joint.parent), self.kinematics.offset(i)))
        x, y, z = self.kinematics.from_parent(i, at_joint)
        if joint.kind is Kind.PRISMATIC:
            # Coriolis acceleration 2 w x (0, 0, rate), and the joint's own along z
            w, rate = self.velocities.angular(i), joint.along(v)
            x, y, z = x + 2.0 * (w[1] * rate), y - 2.0 * (w[0] * rate), z + joint.along(self.a)
        return [x, y, z]

    def frame(self, name: str) -> Vector:
        """Six numbers: acceleration of a frame's origin and angular acceleration, along the world's axes."""
        i, _, translation = self.tree.frame(name)
        R, _ = self.kinematics.placement(i)
        origin = self.linear(i, gravity=False)
        return times(R, add(origin, times(self.spin(i), translation))) + times(R, self.angular(i))


class Factor:
    """Factorization H = L' D L of a symmetric positive definite matrix, SX (nv, nv).

    L is unit lower triangular, D diagonal. Eliminating from the leaves to the root makes no fill-in
    (Featherstone 2008, section 6.5). Structural zeros of a right-hand side are kept, so that the cost of a
    solve is that of the branches with nonzeros.
    """

    def __init__(self, H: Any) -> None:
        self.nv = H.size1()
        for k in range(self.nv):
            if H[k, k].is_zero():
                raise InputError(
                    f"H: velocity {k} has no inertia (its row is zero); give the link inertia or armature"
                )
        # CasADi eliminates from the first row on, and has L as a strictly triangular matrix
        self._leaves_first = slice(None, None, -1)
        self._D, strict, _ = ca.ldl(H[self._leaves_first, self._leaves_first], False)
        self._L = strict.T + ca.SX.eye(self.nv)

    def half_solve(self, b: Any) -> Any:
        """L^-T b, SX (nv, k): with y = half_solve(b), b' H^-1 b = y' D^-1 y."""
        return self._half(b)[self._leaves_first, :]

    def solve(self, b: Any) -> Any:
        """H^-1 b, SX (nv, k)."""
        y = self._half(b)
        return ca.solve(self._L.T, y / ca.repmat(self._D, 1, y.size2()))[self._leaves_first, :]

    @property
    def diagonal(self) -> Any:
        """D, SX (nv)."""
        return self._D[self._leaves_first]

    def _half(self, b: Any) -> Any:
        b = as_sx("b", b)
        if b.size1() != self.nv:
            raise InputError(f"b: expected {self.nv} rows, got shape {b.shape}")
        return ca.solve(self._L, ca.sparsify(b)[self._leaves_first, :])


class CompositeInertias:
    """Mass, first moment and inertia tensor of each link's subtree, about the link's origin."""

    def __init__(self, kinematics: Kinematics) -> None:
        self.kinematics, self.tree = kinematics, kinematics.tree
        self.mass = [joint.mass for joint in self.tree.joints]
        for i in range(len(self.tree) - 1, 0, -1):
            self.mass[self.tree.joints[i].parent] += self.mass[i]
        self._first_moments: list[Vector] | None = None
        self._first_moments_in_parent: dict[int, Vector] = {}  # along the parent's axes
        self._tensors: list[Vector] | None = None

    def first_moment(self, i: int) -> Vector:
        """h = m c of the subtree at link i [kg m]."""
        if self._first_moments is None:
            h = [list(joint.first_moment) for joint in self.tree.joints]
            for j in range(len(self.tree) - 1, 0, -1):
                joint = self.tree.joints[j]
                if joint.kind is not Kind.FREE:
                    in_parent = self._first_moments_in_parent[j] = self.kinematics.to_parent(j, h[j])
                    moved = add(in_parent, scale(self.mass[j], self.kinematics.offset(j)))
                    h[joint.parent] = add(h[joint.parent], moved)
            self._first_moments = h
        return self._first_moments[i]

    def tensor(self, i: int) -> Vector:
        """Inertia tensor of the subtree at link i about the link's origin [kg m2]."""
        if self._tensors is None:
            tensors = [list(joint.tensor) for joint in self.tree.joints]
            for j in range(len(self.tree) - 1, 0, -1):
                joint = self.tree.joints[j]
                if joint.parent:
                    above = tensors[joint.parent]
                    tensors[joint.parent] = [
                        x + y for x, y in zip(above, self._tensor_in_parent(j, tensors[j]), strict=True)
                    ]
            self._tensors = tensors
        return self._tensors[i]

    def _tensor_in_parent(self, i: int, tensor: Vector) -> Vector:
        """Tensor of link i's subtree, along the axes and about the origin of link i's parent."""
        self.first_moment(i)  # fills _first_moments_in_parent
        joint = self.tree.joints[i]
        if joint.kind is Kind.REVOLUTE:
            tensor = tensor_rotate_z(*self.kinematics.coordinates.cos_sin(i), tensor)
        tensor = tensor_rotate(joint.rotation, tensor)
        first_moment = self._first_moments_in_parent[i]
        return move_tensor(self.mass[i], first_moment, tensor, self.kinematics.offset(i))


class MassMatrix:
    """Mass matrix H by the composite-rigid-body algorithm (Featherstone 2008, section 6.2).

    Column k of H has the generalized forces of a unit acceleration of velocity k: the inertial force of the
    moving subtree is propagated to the root, and projected on the axis of each joint that it passes.

    Attributes
    ----------
    entries : {(i, j): H_ij} with i <= j along the tree, armature on the diagonal; entries left out are zero.
    root_forces : {k: (force, moment)} on the root link, about its origin, from a unit acceleration of
        velocity k.
    """

    def __init__(self, composites: CompositeInertias) -> None:
        self.composites = composites
        self.kinematics, self.tree = composites.kinematics, composites.tree
        self.entries: dict[tuple[int, int], Number] = {}
        self.root_forces: dict[int, tuple[Vector, Vector]] = {}
        for i, joint in enumerate(self.tree.joints[1:], start=1):
            if joint.kind is Kind.FREE:
                self._free_flyer(i)
            else:
                self._joint(i)
        self.entries = {place: number for place, number in self.entries.items() if not is_zero(number)}

    def _free_flyer(self, i: int) -> None:
        """Enter the base's own block: [[m 1, -[h]x], [[h]x, I]]."""
        m, (hx, hy, hz) = self.composites.mass[i], self.composites.first_moment(i)
        tensor = tensor_matrix(self.composites.tensor(i))
        k = self.tree.joints[i].v
        moments: list[Vector] = [[0.0, 0.0 - hz, hy], [hz, 0.0, 0.0 - hx], [0.0 - hy, hx, 0.0]]  # [h]x
        for c in range(3):
            force: Vector = [m if r == c else 0.0 for r in range(3)]
            self.root_forces[k + c] = (force, [moments[r][c] for r in range(3)])
            # the force of a unit angular acceleration about axis c is -[h]x e_c, row c of [h]x
            self.root_forces[k + 3 + c] = (moments[c], tensor[c])
            self.entries[k + c, k + c] = m
            for r in range(3):
                self.entries[k + r, k + 3 + c] = moments[c][r]
                if r <= c:
                    self.entries[k + 3 + r, k + 3 + c] = tensor[r][c]

    def _joint(self, i: int) -> None:
        """Enter the column of a joint with one degree of freedom."""
        joints, kinematics, m = self.tree.joints, self.kinematics, self.composites.mass[i]
        (hx, hy, _), k = self.composites.first_moment(i), joints[i].v
        # force and moment on the subtree, about link i's origin, for a unit acceleration about or along z
        force: Vector
        moment: Vector
        if joints[i].kind is Kind.REVOLUTE:
            tensor = self.composites.tensor(i)
            force, moment = [0.0 - hy, hx, 0.0], [tensor[3], tensor[4], tensor[5]]
            own: Number = tensor[5]
        else:
            force, moment, own = [0.0, 0.0, m], [hy, 0.0 - hx, 0.0], m
        ratio, j = joints[i].ratio, i
        # a follower has no motor of its own: its armature is in that of its leader
        self._add(k, k, ratio**2 * own + (0.0 if joints[i].follows else self.tree.armature[k]))
        while j and joints[j].kind is not Kind.FREE:
            # to the parent's frame: the same force, its moment about the parent's origin
            force = kinematics.to_parent(j, force)
            moment = add(kinematics.to_parent(j, moment), cross(kinematics.offset(j), force))
            j = joints[j].parent
            if j and joints[j].kind is Kind.FREE:
                for c in range(3):
                    self._add(c, k, ratio * force[c])
                    self._add(3 + c, k, ratio * moment[c])
            elif j:
                ratios, row = ratio * joints[j].ratio, joints[j].v
                entry = ratios * (moment[2] if joints[j].kind is Kind.REVOLUTE else force[2])
                # A follower above or below its leader has the same velocity k: H_ij and H_ji of the two
                # joints both fall on the diagonal.
                self._add(row, k, 2.0 * entry if row == k else entry)
        # what has arrived at the root, in addition to that of followers with the same velocity
        root_force, root_moment = self.root_forces.get(k, (zero_vector(), zero_vector()))
        self.root_forces[k] = (
            add(root_force, scale(ratio, force)),
            add(root_moment, scale(ratio, moment)),
        )

    def _add(self, i: int, j: int, number: Number) -> None:
        """Add to H_ij, to which a follower contributes besides its leader."""
        place = min(i, j), max(i, j)
        self.entries[place] = self.entries[place] + number if place in self.entries else number


def rnea(accelerations: Accelerations, *, gravity: bool) -> Vector:
    """tau (nv) = H a + C v + g, by the recursive Newton-Euler algorithm (Featherstone 2008, section 5.3).

    With U = [dw/dt]x + [w]x[w]x and the pseudo-inertia S = tr(I)/2 - I, the force on a link is m a + U h,
    and the moment about its origin h x a + (the axial vector of U S). So no link's linear velocity is needed.
    """
    kinematics, tree = accelerations.kinematics, accelerations.tree
    # of each link alone, about its origin
    forces: list[Vector] = [zero_vector()]
    moments: list[Vector] = [zero_vector()]
    for i, joint in enumerate(tree.joints[1:], start=1):
        U, acceleration = accelerations.spin(i), accelerations.linear(i, gravity=gravity)
        xx, xy, yy, xz, yz, zz = joint.tensor
        half_trace = 0.5 * (xx + yy + zz)
        S: list[Vector] = [
            [half_trace - xx, -xy, -xz],
            [-xy, half_trace - yy, -yz],
            [-xz, -yz, half_trace - zz],
        ]
        US = [times(U, S[c]) for c in range(3)]  # columns, S is symmetric
        axial = [US[1][2] - US[2][1], US[2][0] - US[0][2], US[0][1] - US[1][0]]
        forces.append(add(scale(joint.mass, acceleration), times(U, joint.first_moment)))
        moments.append(add(axial, cross(joint.first_moment, acceleration)))
    tau: Vector = [0.0] * tree.nv
    # from the leaves to the root: forces[i], moments[i] become those that joint i transmits to its link
    for i in range(len(tree) - 1, 0, -1):
        joint = tree.joints[i]
        if joint.kind is Kind.FREE:
            tau[joint.v : joint.v + 6] = forces[i] + moments[i]
            continue
        own = moments[i][2] if joint.kind is Kind.REVOLUTE else forces[i][2]
        tau[joint.v] = tau[joint.v] + joint.ratio * own
        if not joint.follows:
            tau[joint.v] = tau[joint.v] + tree.armature[joint.v] * accelerations.a[joint.v]
        if joint.parent:
            force = kinematics.to_parent(i, forces[i])
            moment = add(kinematics.to_parent(i, moments[i]), cross(kinematics.offset(i), force))
            forces[joint.parent] = add(forces[joint.parent], force)
            moments[joint.parent] = add(moments[joint.parent], moment)
    return tau


def com_in_root(composites: CompositeInertias) -> Vector:
    """Centre of mass in the root link's frame [m]."""
    root = composites.tree.root
    if composites.mass[root] <= 0.0:
        raise InputError(
            "model: its moving links have no mass, so there is no centre of mass; give them inertias"
        )
    return scale(1.0 / composites.mass[root], composites.first_moment(root))


def com(composites: CompositeInertias) -> Vector:
    """Centre of mass in the world [m]."""
    R, p = composites.kinematics.placement(composites.tree.root)
    return add(p, times(R, com_in_root(composites)))


def centroidal_map(mass_matrix: MassMatrix) -> dict[tuple[int, int], Number]:
    """Entries of A_g, (6, nv): `MassMatrix.root_forces` moved to the centre of mass, along the world's axes.

    The momentum of unit velocity k is, in numbers, the force of unit acceleration k.
    """
    composites = mass_matrix.composites
    R, _ = composites.kinematics.placement(composites.tree.root)
    c = com_in_root(composites)
    floating = composites.tree.floating
    entries: dict[tuple[int, int], Number] = {}
    for k, (force, moment) in mass_matrix.root_forces.items():
        # A translating free-flyer has no momentum about the centre of mass. The difference would be zero up
        # to rounding errors, and so no structural zero.
        about_com = zero_vector() if floating and k < 3 else subtract(moment, cross(c, force))
        linear, angular = times(R, force), times(R, about_com)
        for r in range(3):
            entries[r, k], entries[3 + r, k] = linear[r], angular[r]
    return entries


def centroidal_momentum(composites: CompositeInertias, velocities: Velocities) -> Vector:
    """Six numbers A_g v = [linear [kg m/s]; angular [kg m2/s]] from the links' momenta, without A_g."""
    kinematics, tree = composites.kinematics, composites.tree
    # momentum of each link about its origin: m u + w x h, and I w + h x u
    linear: list[Vector] = [zero_vector()]
    angular: list[Vector] = [zero_vector()]
    for i, joint in enumerate(tree.joints[1:], start=1):
        u, w, h = velocities.linear(i), velocities.angular(i), joint.first_moment
        linear.append(add(scale(joint.mass, u), cross(w, h)))
        angular.append(add(times(tensor_matrix(joint.tensor), w), cross(h, u)))
    # added up to the root, each moved to its parent's frame
    for i in range(len(tree) - 1, 0, -1):
        joint = tree.joints[i]
        if joint.kind is not Kind.FREE:
            in_parent = kinematics.to_parent(i, linear[i])
            moment = add(kinematics.to_parent(i, angular[i]), cross(kinematics.offset(i), in_parent))
            linear[joint.parent] = add(linear[joint.parent], in_parent)
            angular[joint.parent] = add(angular[joint.parent], moment)
    R, _ = kinematics.placement(tree.root)
    about_com = subtract(angular[tree.root], cross(com_in_root(composites), linear[tree.root]))
    return times(R, linear[tree.root]) + times(R, about_com)
