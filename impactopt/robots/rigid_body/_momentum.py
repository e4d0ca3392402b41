"""Centre of mass, centroidal map and centroidal momentum: at the centre of mass, along the world's axes."""

from __future__ import annotations

from impactopt.errors import InputError
from impactopt.robots.rigid_body._dynamics import CompositeInertias, MassMatrix
from impactopt.robots.rigid_body._motion import Velocities
from impactopt.robots.rigid_body._scalar import Number, Vector
from impactopt.robots.rigid_body._spatial import (
    add,
    cross,
    scale,
    subtract,
    tensor_matrix,
    times,
    zero_vector,
)
from impactopt.robots.rigid_body._tree import Kind


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
    """Entries of A_g, (6, nv): the forces that CRBA hands to the root, taken to the centre of mass."""
    composites = mass_matrix.composites
    R, _ = composites.kinematics.placement(composites.tree.root)
    c = com_in_root(composites)
    floating = composites.tree.floating
    entries: dict[tuple[int, int], Number] = {}
    for k, (force, moment) in mass_matrix.root_forces.items():
        # A free-flyer that only translates has no momentum about the centre of mass, whatever rounding says.
        about_com = zero_vector() if floating and k < 3 else subtract(moment, cross(c, force))
        linear, angular = times(R, force), times(R, about_com)
        for r in range(3):
            entries[r, k], entries[3 + r, k] = linear[r], angular[r]
    return entries


def centroidal_momentum(composites: CompositeInertias, velocities: Velocities) -> Vector:
    """Six numbers A_g v = [linear [kg m/s]; angular [kg m2/s]] from the links' momenta, without A_g."""
    kinematics, tree = composites.kinematics, composites.tree
    linear: list[Vector] = [zero_vector()]
    angular: list[Vector] = [zero_vector()]
    for i, joint in enumerate(tree.joints[1:], start=1):
        u, w, h = velocities.linear(i), velocities.angular(i), joint.first_moment
        linear.append(add(scale(joint.mass, u), cross(w, h)))
        angular.append(add(times(tensor_matrix(joint.tensor), w), cross(h, u)))
    for i in range(len(tree) - 1, 0, -1):
        joint = tree.joints[i]
        if joint.kind is not Kind.FREE:
            lifted = kinematics.up(i, linear[i])
            moment = add(kinematics.up(i, angular[i]), cross(kinematics.offset(i), lifted))
            linear[joint.parent] = add(linear[joint.parent], lifted)
            angular[joint.parent] = add(angular[joint.parent], moment)
    R, _ = kinematics.placement(tree.root)
    about_com = subtract(angular[tree.root], cross(com_in_root(composites), linear[tree.root]))
    return times(R, linear[tree.root]) + times(R, about_com)
