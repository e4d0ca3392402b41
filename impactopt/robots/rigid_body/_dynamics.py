"""Composite inertias, generalized inertia H (CRBA) and inverse dynamics (RNEA), all in link frames.

H does not contain the base's pose, so neither do its derivatives. Algorithms after Featherstone, Rigid Body
Dynamics Algorithms (2008), chapters 5 and 6.
"""

from __future__ import annotations

from impactopt.robots.rigid_body._kinematics import Kinematics
from impactopt.robots.rigid_body._motion import Accelerations
from impactopt.robots.rigid_body._scalar import Number, Vector, is_zero
from impactopt.robots.rigid_body._spatial import (
    add,
    cross,
    move_tensor,
    scale,
    tensor_matrix,
    tensor_rotate,
    tensor_rotate_z,
    times,
    zero_vector,
)
from impactopt.robots.rigid_body._tree import Kind


class CompositeInertias:
    """Mass, first moment and tensor of every link together with all that it carries, about its origin."""

    def __init__(self, kinematics: Kinematics) -> None:
        self.kinematics, self.tree = kinematics, kinematics.tree
        self.mass = [joint.mass for joint in self.tree.joints]
        for i in range(len(self.tree) - 1, 0, -1):
            self.mass[self.tree.joints[i].parent] += self.mass[i]
        self._first_moments: list[Vector] | None = None
        self._lifted: dict[int, Vector] = {}
        self._tensors: list[Vector] | None = None

    def first_moment(self, i: int) -> Vector:
        """h = m c of the subtree at link i [kg m]."""
        if self._first_moments is None:
            h = [list(joint.first_moment) for joint in self.tree.joints]
            for j in range(len(self.tree) - 1, 0, -1):
                joint = self.tree.joints[j]
                if joint.kind is not Kind.FREE:
                    self._lifted[j] = self.kinematics.up(j, h[j])
                    moved = add(self._lifted[j], scale(self.mass[j], self.kinematics.offset(j)))
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
                        x + y for x, y in zip(above, self._lift(j, tensors[j]), strict=True)
                    ]
            self._tensors = tensors
        return self._tensors[i]

    def _lift(self, i: int, tensor: Vector) -> Vector:
        """The subtree's tensor along the axes and about the origin of link i's parent."""
        self.first_moment(i)
        joint = self.tree.joints[i]
        if joint.kind is Kind.REVOLUTE:
            tensor = tensor_rotate_z(*self.kinematics.coordinates.cos_sin(i), tensor)
        tensor = tensor_rotate(joint.rotation, tensor)
        return move_tensor(self.mass[i], self._lifted[i], tensor, self.kinematics.offset(i))


class MassMatrix:
    """H, read off the force that each joint's unit acceleration hands down the chain.

    Attributes
    ----------
    entries : {(i, j): H_ij} with i <= j along the tree, armature on the diagonal; what is missing is zero.
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
        m, (hx, hy, hz) = self.composites.mass[i], self.composites.first_moment(i)
        tensor = tensor_matrix(self.composites.tensor(i))
        k = self.tree.joints[i].v
        moments: list[Vector] = [[0.0, 0.0 - hz, hy], [hz, 0.0, 0.0 - hx], [0.0 - hy, hx, 0.0]]  # [h]x
        for c in range(3):
            force: Vector = [m if r == c else 0.0 for r in range(3)]
            self.root_forces[k + c] = (force, [moments[r][c] for r in range(3)])
            # A unit angular acceleration about axis c pulls with -[h]x e_c, the row c of [h]x.
            self.root_forces[k + 3 + c] = (moments[c], tensor[c])
            self.entries[k + c, k + c] = m
            for r in range(3):
                self.entries[k + r, k + 3 + c] = moments[c][r]
                if r <= c:
                    self.entries[k + 3 + r, k + 3 + c] = tensor[r][c]

    def _joint(self, i: int) -> None:
        joints, kinematics, m = self.tree.joints, self.kinematics, self.composites.mass[i]
        (hx, hy, _), k = self.composites.first_moment(i), joints[i].v
        force: Vector
        moment: Vector
        if joints[i].kind is Kind.REVOLUTE:
            tensor = self.composites.tensor(i)
            force, moment = [0.0 - hy, hx, 0.0], [tensor[3], tensor[4], tensor[5]]
            own: Number = tensor[5]
        else:
            force, moment, own = [0.0, 0.0, m], [hy, 0.0 - hx, 0.0], m
        self.entries[k, k] = own + self.tree.armature[k]
        j = i
        while j and joints[j].kind is not Kind.FREE:
            force = kinematics.up(j, force)
            moment = add(kinematics.up(j, moment), cross(kinematics.offset(j), force))
            j = joints[j].parent
            if j and joints[j].kind is Kind.FREE:
                for c in range(3):
                    self.entries[c, k], self.entries[3 + c, k] = force[c], moment[c]
            elif j:
                self.entries[joints[j].v, k] = moment[2] if joints[j].kind is Kind.REVOLUTE else force[2]
        self.root_forces[k] = (force, moment)


def rnea(accelerations: Accelerations, *, gravity: bool) -> Vector:
    """tau (nv) = H a + C v + g, by Newton and Euler on each link and the forces handed down the tree.

    No link's linear velocity is needed: with U = [dw/dt]x + [w]x[w]x and the pseudo-inertia S = tr(I)/2 - I,
    the force is m a + U h and the moment about the origin h x a + (the axial vector of U S).
    """
    kinematics, tree = accelerations.kinematics, accelerations.tree
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
    for i in range(len(tree) - 1, 0, -1):
        joint = tree.joints[i]
        if joint.kind is Kind.FREE:
            tau[joint.v : joint.v + 6] = forces[i] + moments[i]
            continue
        tau[joint.v] = moments[i][2] if joint.kind is Kind.REVOLUTE else forces[i][2]
        tau[joint.v] = tau[joint.v] + tree.armature[joint.v] * accelerations.a[joint.v]
        if joint.parent:
            force = kinematics.up(i, forces[i])
            moment = add(kinematics.up(i, moments[i]), cross(kinematics.offset(i), force))
            forces[joint.parent] = add(forces[joint.parent], force)
            moments[joint.parent] = add(moments[joint.parent], moment)
    return tau
