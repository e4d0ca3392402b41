"""Newton system of one interior-point iteration, condensed; ordering and Cholesky factor of the rest."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from impactopt.solvers.elimination.condense import Condenser, Mask, find_eliminations
from impactopt.solvers.elimination.kernels import Index, Kernels, Panels, Places, Products
from impactopt.solvers.elimination.kernels import kernels as fastest
from impactopt.solvers.program import Determined, Matrix, Vector

_WIDEST = 24  # variables of a block that is made of several
_ZEROS = 0.1  # part of a block's panel that may be zeros, so that it is one block instead of two


def elimination_blocks(pattern: Any) -> list[Index]:
    """Variables in blocks, those to be eliminated first in front.

    Variables that touch the same others are one group. The order is found for groups: the one that touches
    the fewest variables first (minimum degree; Davis, Direct Methods for Sparse Linear Systems, 2006, section
    7.1). Then groups that touch nearly the same become one block, as a few large products take less time than
    many small ones.

    pattern (n, n) : which entries may be nonzero, symmetric.
    """
    touches = np.asarray(pattern, dtype=bool) | np.eye(len(pattern), dtype=bool)
    members: dict[bytes, list[int]] = {}
    for i, row in enumerate(np.packbits(touches, axis=1)):
        members.setdefault(row.tobytes(), []).append(i)
    groups = [np.array(same) for same in members.values()]
    first, sizes = (np.array([of(g) for g in groups], dtype=np.intp) for of in (np.min, np.size))
    order, below = _minimum_degree(touches[np.ix_(first, first)], sizes)
    blocks = _blocks(order, below, sizes)
    return [np.concatenate([groups[g] for g in b.groups]) for root in blocks for b in root.in_order()]


def _minimum_degree(touches: Any, sizes: Index) -> tuple[Index, Any]:
    """Groups in order, and which others the elimination of each touches (g, g)."""
    touches, left = touches.copy(), np.ones(sizes.size, dtype=bool)
    order, below = np.zeros_like(sizes), np.zeros_like(touches)
    degree = touches @ sizes
    for i in range(sizes.size):
        k = order[i] = int(np.argmin(np.where(left, degree, np.inf)))
        left[k] = False
        below[k] = touches[k] & left
        rows = np.flatnonzero(below[k])
        touches[np.ix_(rows, rows)] = True
        degree[rows] = (touches[rows] & left) @ sizes
    return order, below


@dataclass
class _Block:
    """Groups to be eliminated one after the other.

    below : groups that they touch.  width, height : variables of both.  entries : of the groups' own panels,
    which are not zero.  children : blocks that have to be eliminated before.
    """

    groups: list[int]
    below: Any
    width: int
    height: int
    entries: float
    children: list[_Block] = field(default_factory=list)

    def in_order(self) -> list[_Block]:
        """This block after all that are below it, without recursion: a long motion's are thousands deep."""
        out, waiting = list[_Block](), [self]
        while waiting:  # parents before their children, and the last child first
            out.append(block := waiting.pop())
            waiting += block.children
        return out[::-1]

    def joined(self, other: _Block, sizes: Index) -> _Block | None:
        """Panel joined with one that comes after it; None where that would be too many zeros."""
        width = self.width + other.width
        below = self.below | other.below
        below[other.groups] = False
        height = int(below @ sizes)
        entries = self.entries + other.entries
        if width > _WIDEST or entries < (1.0 - _ZEROS) * _entries(width, height):
            return None
        groups, children = self.groups + other.groups, self.children + other.children
        return _Block(groups, below, width, height, entries, children)


def _entries(width: int, height: int) -> float:
    """Number of entries of a panel, with the lower triangle of its own block."""
    return width * (height + 0.5 * (width + 1))


def _blocks(order: Index, below: Any, sizes: Index) -> list[_Block]:
    """The last of them, with their children."""
    place = np.empty_like(order)
    place[order] = np.arange(order.size)
    waiting: dict[int, list[_Block]] = {}  # by the first group that they touch
    for k in map(int, order):
        width, height = int(sizes[k]), int(below[k] @ sizes)
        block = _Block([k], below[k], width, height, _entries(width, height))
        for child in _of_equal_size(waiting.pop(k, []), sizes):
            joined = child.joined(block, sizes)
            if joined is None:
                block.children.append(child)
            else:
                block = joined
        touched = np.flatnonzero(block.below)
        parent = int(touched[np.argmin(place[touched])]) if touched.size else -1
        waiting.setdefault(parent, []).append(block)
    return waiting.get(-1, [])


def _of_equal_size(blocks: list[_Block], sizes: Index) -> list[_Block]:
    """Blocks that touch nearly the same, and not each other, as one."""
    out: list[_Block] = []
    for block in blocks:
        for i, other in enumerate(out):
            joined = other.joined(block, sizes)
            if joined is not None:
                out[i] = joined
                break
        else:
            out.append(block)
    return out


class BlockCholesky:
    """L L' = K for matrices whose pattern does not change.

    Variables come in blocks; of each block of columns the blocks of rows that become nonzero are
    kept as one panel, so that the work is a few dense products a panel (Davis, Direct Methods for Sparse
    Linear Systems, 2006, chapter 4: a supernodal factorization).

    Attributes
    ----------
    size : of the array of all panels' numbers.
    """

    def __init__(self, pattern: Any, kernels: Kernels):
        """pattern: which entries may be nonzero (n, n), symmetric."""
        n, self._kernels = pattern.shape[0], kernels
        blocks = elimination_blocks(pattern)
        count, sizes = len(blocks), np.array([b.size for b in blocks], dtype=np.intp)
        self._n, self._order = n, np.concatenate([np.zeros(0, np.intp), *blocks])
        self._place = np.empty(n, dtype=np.intp)
        self._place[self._order] = np.arange(n)
        self._block = np.repeat(np.arange(count), sizes)  # of each place
        start = np.append(0, np.cumsum(sizes))
        i, j = np.nonzero(pattern)
        filled = np.zeros((count, count), dtype=bool)
        filled[self._block[self._place[i]], self._block[self._place[j]]] = True
        below: list[Places] = []
        for k in range(count):
            rows = (np.flatnonzero(filled[k + 1 :, k]) + k + 1).astype(np.int32)
            filled[np.ix_(rows, rows)] = True
            below.append(rows)
        row_at = np.full((count, count), -1, dtype=np.int32)
        height, at = np.zeros(count, dtype=np.int32), np.zeros(count + 1, dtype=np.intp)
        for k, rows in enumerate(below):
            stacked = np.concatenate([[k], rows]).astype(np.intp)
            ends = np.cumsum(sizes[stacked])
            row_at[stacked, k] = ends - sizes[stacked]
            height[k] = ends[-1]
            at[k + 1] = at[k] + ends[-1] * sizes[k]
        self._panels = Panels(
            start=start.astype(np.int32), at=at, height=height, below=tuple(below), row_at=row_at
        )
        self.size = int(at[-1])

    def places(self, i: Index, j: Index) -> Index:
        """Places of the entries (i, j) of the lower triangle, or (j, i)."""
        low, high = np.maximum(self._place[i], self._place[j]), np.minimum(self._place[i], self._place[j])
        row, column = self._block[low], self._block[high]
        p = self._panels
        across, down = high - p.start[column], p.row_at[row, column] + low - p.start[row]
        out: Index = p.at[column] + p.height[column] * across + down
        return out

    def factor(self, values: Vector) -> bool:
        """Factor the matrix with these values (size,), overwriting them; False: not positive definite."""
        self._values = values
        return self._kernels.factor(self._panels, values)

    def solve(self, right: Vector) -> Vector:
        """K^-1 times a vector (n,) or columns (n, k)."""
        x = np.asfortranarray(right[self._order].reshape(self._n, -1))
        x = self._kernels.solve(self._panels, self._values, x)
        out = np.empty(x.shape)
        out[self._order] = x
        return out.reshape(right.shape)


_KEPT = 3  # structures
_PENALTY = 1e9  # times the curvature along it: weight of an equality that is left; it changes no step
_RANK = 1e-15  # singular values below this part of the largest are none
# of a solve, at most, each of which leaves less than this part of what was left: weights of ten decades cost
# digits
_ROUNDS, _LESS = 6, 0.5
_HELD = 1e15  # on the diagonal of variables that must not move
_FIRST, _LEAST, _MOST = 1e-4, 1e-20, 1e20  # shifts of the diagonal (Waechter and Biegler 2006, section 3.1)
_SMALL = 1e-5  # none is tried before a shift that would be smaller
_RELATIVE = 0.1  # the first shift is at most this part of the Hessian's largest entry
_GROW, _GROW_FIRST, _SHRINK = 8.0, 100.0, 3.0  # kappa_w+, its first value, 1 / kappa_w- (same section)


class NewtonSystem:
    """Minimize q.d + 1/2 d'(H + diag) d with rows y = w (J d + r), and J d + r = 0 for hard equalities.

    The rows with weights enter the Hessian, W = H + diag + J' diag(w) J + shift I; then the eliminated
    equalities are solved for their variables (`Condenser`), and the matrix left gets a Cholesky factor; hard
    equalities that are left, by their Schur complement. The shift makes that matrix positive definite, and
    with it the whole system's inertia right. What rounding leaves, all of the system's own equations tell.

    Attributes
    ----------
    condenser : of this system; held : numbers of the free variables that do not move.
    shift : the last.
    """

    def __init__(self, condenser: Condenser, held: Index, kernels: Kernels):
        """held: numbers of the free variables that do not move."""
        self.condenser, self.held = condenser, held
        self._matrix = BlockCholesky(condenser.pattern, kernels)
        self._from, i, j = condenser.at_free
        places = self._matrix.places
        self._to = places(i, j).astype(np.int32)
        self._diagonal_to = places(np.arange(condenser.free.size), np.arange(condenser.free.size))
        self._products, self._kernels = [], kernels
        for row, (columns, at) in enumerate(condenser.left):
            i, j = np.tril_indices(columns.size)
            to = places(columns[i], columns[j]).astype(np.int32)
            number, once = np.full(1, row, dtype=np.int32), np.ones(1, dtype=np.intp)
            self._products.append(Products(counts=once, rows=number, values=at[None], to=to[None]))
        self.begin(b"")

    def begin(self, key: bytes) -> None:
        """Forget the shifts of another program; key: of the structure."""
        self.key = key
        self._equal = self.condenser.rows[self.condenser.equal]  # numbers of the equalities left
        self._last = self.shift = 0.0

    def factor(
        self,
        jacobian: Matrix,
        hessian: Matrix,
        diagonal: Vector,
        weights: Callable[[float], Vector],
        *,
        hard: bool,
        proximal: float = 0.0,
    ) -> bool:
        """Factor, shifted as far as it takes.

        diagonal : (f,) of the free variables; weights : gives those of the rows left (k,) for more curvature
        of all variables and slacks: proximal and shift; hard : equalities among them have none.

        False: nothing helps.
        """
        c = self.condenser
        try:
            c.load(jacobian, hessian)
        except np.linalg.LinAlgError:
            return False
        self._jacobian, self._hessian, self._hard = jacobian, hessian, hard
        self._transposed = jacobian.T
        self._A = c.A
        everywhere = np.zeros(c.n)
        everywhere[c.free] = diagonal
        penalty = self._penalty() if hard else None
        self.shift = self._first()
        while True:
            more = proximal + self.shift
            self._diagonal = everywhere + more
            self._weights = np.zeros(c.m)
            self._weights[c.rows] = weights(more)
            if penalty is not None:
                self._weights[self._equal] = penalty
            if self._matrix.factor(self._values()):
                break
            self.shift = self._next()
            if self.shift > _MOST:
                return False
        self._last = self.shift or self._last
        if hard and self._equal.size:
            self._spread = self._matrix.solve(self._A.T)
            # of the Schur complement: pseudo, as rows may depend on each other
            self._inverse = np.linalg.pinv(self._A @ self._spread, rcond=_RANK)
        return True

    def _penalty(self) -> Vector:
        """Weights of the equalities left: far above the curvature along them, and no farther."""
        # The term is constant on steps that meet A d = -off, so it changes none. And a matrix that is
        # positive definite on A's null space becomes so altogether for a weight that is large enough
        # (Debreu's lemma): then Cholesky's success says that the inertia is right.
        squares = self._A**2
        length = np.maximum(1e-30, squares.sum(axis=1))
        curvature = squares @ np.abs(self.condenser.curvature) / length
        out: Vector = _PENALTY * np.maximum(1.0, curvature) / np.maximum(1.0, length)
        return out

    def _first(self) -> float:
        """The shift to try first: after an iteration that needed one, a smaller one instead of none."""
        # The paper tries none first. Where the Hessian was indefinite it mostly still is, and that try costs
        # a factorization an iteration.
        shift = self._smaller() if self.shift else 0.0
        return shift if shift > _SMALL else 0.0

    def _next(self) -> float:
        """The shift to try where this one was not enough."""
        if not self.shift:
            return self._smaller() if self._last else _FIRST
        return self.shift * (_GROW if self._last else _GROW_FIRST)

    def _smaller(self) -> float:
        """Than the last; what a far more curved Hessian needed is no guide."""
        most = _RELATIVE * float(np.abs(self._hessian.data).max(initial=1.0))
        return min(most, max(_LEAST, self._last / _SHRINK))

    def _values(self) -> Vector:
        """The matrix as `BlockCholesky` takes it."""
        c = self.condenser
        values = np.zeros(self._matrix.size)
        W = c.reduce(self._weights, self._diagonal)
        self._kernels.copy(W, self._from, values, self._to)
        values[self._diagonal_to[self.held]] += _HELD
        self._kernels.add_products(self._products, c.J, self._weights[self._equal], values)
        return values

    def solve(self, q: Vector, r: Vector, close: float = 0.0) -> tuple[Vector, Vector]:
        """The step (n,) and the new multipliers (m,) of all rows, for a gradient (n,) and the rows' residuals
        (m,): what they are off by, with weights.

        close : what may be left of an equation.
        """
        c, w, equal = self.condenser, self._weights.copy(), self._equal
        w[equal] = 0.0
        exact = np.concatenate([c.eliminated, equal]) if self._hard else c.eliminated
        g, left, worst = q + self._pulled(w * r), r, np.inf
        d, y, rows = np.zeros(c.n), np.zeros(c.m), np.zeros(c.m)
        for _ in range(_ROUNDS):
            more_d, more_y, more_rows, g = self._respond(g, left, w)
            d, y, rows = d + more_d, y + more_y, rows + more_rows
            left, hard = np.zeros(c.m), np.zeros(c.m)
            left[exact] = (rows + r)[exact]
            hard[c.eliminated], hard[equal] = more_y[c.eliminated], more_y[equal]
            g += self._pulled(hard)
            g[c.free[self.held]] = 0.0
            before, worst = worst, max(np.abs(g).max(initial=0.0), np.abs(left).max(initial=0.0))
            if worst <= close or worst > _LESS * before:
                break
        return d, y + w * r

    def _respond(self, g: Vector, r: Vector, w: Vector) -> tuple[Vector, Vector, Vector, Vector]:
        """Step for a gradient and the residuals of equalities; multipliers, of rows with weights w what the
        step changes; how all rows change; gradient of the Lagrangian without the equalities.
        """
        c, equal = self.condenser, self._equal
        own = self._weights[equal]
        by_free, off = c.forward(g, r)
        by_free += self._A.T @ (own * off)
        by_free[self.held] = 0.0
        free = -self._matrix.solve(by_free)
        extra = np.zeros(equal.size)
        if self._hard and equal.size:
            extra = self._inverse @ (self._A @ free + off)
            free -= self._spread @ extra
        free[self.held] = 0.0
        d = c.expand(free)
        rows = np.concatenate([self._jacobian @ d, d[c.bounded]])
        y = w * rows
        dual = g + self._hessian @ d + self._diagonal * d + self._pulled(y)
        # the penalty's pull is a part of these multipliers
        y[equal] = own * (self._A @ free + off) + extra
        y[c.eliminated] = c.multipliers(dual, y[equal])
        return d, y, rows, dual

    def _pulled(self, y: Vector) -> Vector:
        """Gradient of all rows with multipliers (m,)."""
        m = self._jacobian.shape[0]
        out: Vector = self._transposed @ y[:m]
        out[self.condenser.bounded] += y[m:]
        return out


# ---------------------------------------------------------------- structures
_structures: OrderedDict[bytes, NewtonSystem] = OrderedDict()


def acquire(
    jacobian: Matrix,
    hessian: Matrix,
    *,
    determined: Sequence[Determined],
    equal: Mask,
    bounded: Mask,
    moves: Mask,
) -> NewtonSystem:
    """The system for these patterns, for one who gives it back: its structure takes as long as 10 iterations
    and serves all programs that differ in their numbers, or in inequalities that couple nothing new.

    determined : what rows determine; equal (m,): which rows are equalities; bounded, moves (n,): which
    variables have a finite bound, and which are not fixed.
    """
    mine = equal[jacobian.indices]
    starts = np.append(0, np.cumsum(mine))[jacobian.indptr]
    of_equalities = np.cumsum(equal)[jacobian.indices[mine]], starts
    known = [variables for _, variables in determined]
    structure = _digest([rank for rank, _ in determined], *of_equalities, *known, bounded, moves)
    patterns = [a for matrix in (jacobian, hessian) for a in (matrix.indptr, matrix.indices)]
    key = structure + _digest(None, *patterns, equal)
    system = _structures.pop(key, None) or _alike(structure, jacobian, hessian, equal)
    if system is None:
        algebra = fastest()
        eliminations = find_eliminations(jacobian, equal, determined)
        condenser = Condenser(jacobian, hessian, eliminations, equal, bounded, algebra)
        held = np.flatnonzero(~moves[condenser.free])
        system = NewtonSystem(condenser, held, algebra)
    system.begin(key)
    return system


def _alike(structure: bytes, jacobian: Matrix, hessian: Matrix, equal: Mask) -> NewtonSystem | None:
    """One with the same equalities, made to be that of these patterns: other inequalities change little."""
    for key, system in reversed(_structures.items()):
        if key.startswith(structure) and system.condenser.take(jacobian, hessian, equal):
            return _structures.pop(key)
    return None


def _digest(words: Any, *arrays: Index | Mask) -> bytes:
    digest = hashlib.sha256(repr(words).encode())
    for array in arrays:
        digest.update(f"{array.dtype} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.digest()


def release(system: NewtonSystem) -> None:
    """Keep the structure for the next program that has it."""
    _structures[system.key] = system
    while len(_structures) > _KEPT:
        _structures.popitem(last=False)
