"""Placements of links and frames, and frame Jacobians, each computed when first asked for."""

from __future__ import annotations

from impactopt.robots.rigid_body._coordinates import Coordinates
from impactopt.robots.rigid_body._scalar import Matrix, Number, Vector
from impactopt.robots.rigid_body._spatial import (
    IDENTITY,
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
from impactopt.robots.rigid_body._tree import Kind, Tree


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
