"""Scalars, 3-vectors, rotations and inertias of symbolic rigid-body dynamics.

The algorithms of this package work on Python lists whose entries are either plain floats or `Scalar`.
Constants are folded before CasADi sees them (0 * x is the float 0.0, 1 * x is x), so structural zeros stay
recognizable as floats. Products call `SX.binary` directly: `a * b` on two SX takes ten times as long, for
finding out the types of a and b.

A symmetric tensor is the list (xx, xy, yy, xz, yz, zz), Pinocchio's order. A rigid body's inertia about a
point is ten numbers: its mass m [kg], first moment h = m c [kg m] and inertia tensor I about that point, not
about the centre of mass [kg m2].
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any, TypeAlias

import casadi as ca

from impactopt.errors import InputError

_ADD, _SUB, _MUL, _DIV, _NEG = ca.OP_ADD, ca.OP_SUB, ca.OP_MUL, ca.OP_DIV, ca.OP_NEG
_COS, _SIN, _TAN = ca.OP_COS, ca.OP_SIN, ca.OP_TAN
_binary, _unary = ca.SX.binary, ca.SX.unary

Number: TypeAlias = "float | Scalar"
Vector: TypeAlias = "list[float | Scalar]"  # (3,) unless stated otherwise
Matrix: TypeAlias = "list[list[float | Scalar]]"  # rows


@lru_cache(maxsize=1 << 14)
def _constant(value: float) -> Any:
    return ca.SX(value)


class Scalar:
    """One scalar SX expression `x`; mixes with floats in + - * /."""

    __slots__ = ("x",)
    __array_ufunc__ = None  # a NumPy number on the left leaves the operation to us

    def __init__(self, x: Any) -> None:
        self.x = x

    def __add__(self, other: Number) -> Number:
        if other.__class__ is Scalar:
            return Scalar(_binary(_ADD, self.x, other.x))
        return self if other == 0 else Scalar(_binary(_ADD, self.x, _constant(other)))

    __radd__ = __add__

    def __sub__(self, other: Number) -> Number:
        if other.__class__ is Scalar:
            return Scalar(_binary(_SUB, self.x, other.x))
        return self if other == 0 else Scalar(_binary(_SUB, self.x, _constant(other)))

    def __rsub__(self, other: float) -> Number:
        return -self if other == 0 else Scalar(_binary(_SUB, _constant(other), self.x))

    def __mul__(self, other: Number) -> Number:
        if other.__class__ is Scalar:
            return Scalar(_binary(_MUL, self.x, other.x))
        if other == 0:
            return 0.0
        if other == 1:
            return self
        return -self if other == -1 else Scalar(_binary(_MUL, self.x, _constant(other)))

    __rmul__ = __mul__

    def __truediv__(self, other: Number) -> Number:
        if other.__class__ is Scalar:
            return Scalar(_binary(_DIV, self.x, other.x))
        return self * (1.0 / other)

    def __rtruediv__(self, other: float) -> Number:
        return 0.0 if other == 0 else Scalar(_binary(_DIV, _constant(other), self.x))

    def __neg__(self) -> Scalar:
        return Scalar(_unary(_NEG, self.x))


def is_zero(number: Number) -> bool:
    """True where the number is structurally zero: a float 0."""
    return number.__class__ is not Scalar and number == 0


def cos(number: Scalar) -> Scalar:
    return Scalar(_unary(_COS, number.x))


def sin(number: Scalar) -> Scalar:
    return Scalar(_unary(_SIN, number.x))


def tan(number: Scalar) -> Scalar:
    return Scalar(_unary(_TAN, number.x))


# ---------------------------------------------------------------- between SX matrices and lists of numbers
def _to_sx(number: Number) -> Any:
    return number.x if isinstance(number, Scalar) else _constant(float(number))


def as_sx(name: str, value: Any) -> Any:
    """SX of an SX or of numbers.

    Raises
    ------
    InputError : neither, or numbers that are not finite.
    """
    try:
        matrix = ca.SX(value)
    except NotImplementedError as error:  # what SWIG raises for a type that it has no conversion from
        raise InputError(f"{name}: expected SX or numbers, got {type(value).__name__}") from error
    if matrix.is_constant() and not matrix.is_regular():
        raise InputError(f"{name}: NaN or infinite; give finite numbers")
    return matrix


def _from_sx(x: Any) -> Number:
    return float(x) if x.is_constant() else Scalar(x)


def unpack_entries(matrix: Any) -> dict[tuple[int, int], Number]:
    """The structural nonzeros {(row, column): number} of an SX matrix."""
    rows, columns = matrix.sparsity().get_triplet()
    return {(r, c): _from_sx(x) for r, c, x in zip(rows, columns, matrix.nonzeros(), strict=True)}


def unpack_vector(column: Any) -> Vector:
    """The entries of an SX column; structural zeros are floats."""
    entries = unpack_entries(column)
    return [entries.get((i, 0), 0.0) for i in range(column.numel())]


def pack_vector(vector: Iterable[Number]) -> Any:
    """A dense SX column."""
    return ca.vertcat(*[_to_sx(number) for number in vector])


def pack_entries(shape: tuple[int, int], entries: Mapping[tuple[int, int], Number]) -> Any:
    """A sparse SX matrix of the entries that are not zero."""
    kept = {place: _to_sx(number) for place, number in entries.items() if not is_zero(number)}
    # CasADi may have simplified an expression to zero
    places = sorted((p for p, x in kept.items() if not x.is_zero()), key=lambda place: (place[1], place[0]))
    sparsity = ca.Sparsity.triplet(*shape, [r for r, _ in places], [c for _, c in places])
    return ca.SX(sparsity, ca.vertcat(*[kept[place] for place in places]))


def pack_dense(rows: Sequence[Sequence[Number]]) -> Any:
    """A dense SX matrix from its rows."""
    return ca.vertcat(*[ca.horzcat(*[_to_sx(number) for number in row]) for row in rows])


def pack_symmetric(size: int, upper: Mapping[tuple[int, int], Number]) -> Any:
    """A sparse symmetric SX matrix from the entries of one of its triangles."""
    return pack_entries((size, size), {**{(c, r): x for (r, c), x in upper.items()}, **upper})


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
    """Rz I Rz', with half the operations of two matrix products."""
    xx, xy, yy, xz, yz, zz = tensor
    u = s * (xx - yy) + 2.0 * (c * xy)
    t = s * u
    return [xx - t, c * u - xy, yy + t, c * xz - s * yz, s * xz + c * yz, zz]


def tensor_rotate(R: Matrix, tensor: Vector) -> Vector:
    """R I R' for a constant R. If R permutes axes, folding of constants leaves no operations."""
    A = product(R, tensor_matrix(tensor))
    return [dot(A[i], R[j]) for i, j in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))]


def move_tensor(m: Number, h: Vector, tensor: Vector, p: Vector) -> Vector:
    """Tensor of a body of mass m and first moment h about another origin, in whose frame the old one is at p.

    The parallel axis theorem, without the centre of mass: I + 2 (w.p) 1 - w p' - p w' with w = h + m p/2.
    """
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
