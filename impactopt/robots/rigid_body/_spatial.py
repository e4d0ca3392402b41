"""3-vectors, rotations and inertias, written out entry by entry so that constants fold.

A symmetric tensor is the list (xx, xy, yy, xz, yz, zz), Pinocchio's order. A rigid body's inertia about a
point is ten numbers: its mass m [kg], first moment h = m c [kg m] and inertia tensor I about that point, not
about the centre of mass [kg m2].
"""

from __future__ import annotations

from collections.abc import Sequence

from impactopt.robots.rigid_body._scalar import Matrix, Number, Vector

IDENTITY: Matrix = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


def zero_vector() -> Vector:
    return [0.0, 0.0, 0.0]


def add(a: Vector, b: Vector) -> Vector:
    return [a[0] + b[0], a[1] + b[1], a[2] + b[2]]


def subtract(a: Vector, b: Vector) -> Vector:
    return [a[0] - b[0], a[1] - b[1], a[2] - b[2]]


def scale(k: Number, a: Vector) -> Vector:
    return [k * a[0], k * a[1], k * a[2]]


def cross(a: Vector, b: Vector) -> Vector:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def dot(a: Vector, b: Vector) -> Number:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def times(R: Matrix, a: Vector) -> Vector:
    """R a."""
    return [dot(R[0], a), dot(R[1], a), dot(R[2], a)]


def transpose_times(R: Matrix, a: Vector) -> Vector:
    """R' a."""
    return [dot([R[0][j], R[1][j], R[2][j]], a) for j in range(3)]


def product(A: Matrix, B: Matrix) -> Matrix:
    """A B."""
    columns = [[B[0][j], B[1][j], B[2][j]] for j in range(3)]
    return [[dot(row, column) for column in columns] for row in A]


def column(R: Matrix, j: int) -> Vector:
    return [R[0][j], R[1][j], R[2][j]]


def rotate_z(c: Number, s: Number, a: Vector) -> Vector:
    """Rz a for the rotation about z with cosine c and sine s."""
    return [c * a[0] - s * a[1], s * a[0] + c * a[1], a[2]]


def rotate_back_z(c: Number, s: Number, a: Vector) -> Vector:
    """Rz' a for the rotation about z with cosine c and sine s."""
    return [c * a[0] + s * a[1], c * a[1] - s * a[0], a[2]]


# ---------------------------------------------------------------- symmetric tensors
def tensor_matrix(tensor: Sequence[Number]) -> Matrix:
    xx, xy, yy, xz, yz, zz = tensor
    return [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]


def tensor_rotate_z(c: Number, s: Number, tensor: Vector) -> Vector:
    """Rz I Rz': half the work of two matrix products, and zz is untouched."""
    xx, xy, yy, xz, yz, zz = tensor
    u = s * (xx - yy) + 2.0 * (c * xy)
    t = s * u
    return [xx - t, c * u - xy, yy + t, c * xz - s * yz, s * xz + c * yz, zz]


def tensor_rotate(R: Matrix, tensor: Vector) -> Vector:
    """R I R' for a constant R; costs nothing when R permutes axes."""
    A = product(R, tensor_matrix(tensor))
    return [dot(A[i], R[j]) for i, j in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))]


def move_tensor(m: Number, h: Vector, tensor: Vector, p: Vector) -> Vector:
    """The tensor, of a body of mass m and first moment h, about a new origin that sees the old one at p."""
    w = [h[k] + (0.5 * m) * p[k] for k in range(3)]
    x, y, z = (w[k] * p[k] for k in range(3))
    xx, xy, yy, xz, yz, zz = tensor
    return [
        xx + 2.0 * (y + z),
        xy - (w[0] * p[1] + p[0] * w[1]),
        yy + 2.0 * (x + z),
        xz - (w[0] * p[2] + p[0] * w[2]),
        yz - (w[1] * p[2] + p[1] * w[2]),
        zz + 2.0 * (x + y),
    ]
