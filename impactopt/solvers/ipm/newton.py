"""Newton system of one interior-point iteration: condensed, then factored by block Cholesky."""

from __future__ import annotations

import hashlib
import math
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from impactopt.arrays import Index, Mask
from impactopt.solvers.elimination.condense import Condenser, find_eliminations
from impactopt.solvers.elimination.kernels import Kernels, Panels, Places, Products
from impactopt.solvers.elimination.kernels import kernels as fastest_kernels
from impactopt.solvers.program import Determined, Matrix, Vector


def elimination_blocks(pattern: Any) -> list[Index]:
    """Elimination order in blocks of variables (supernodes), the first to be eliminated in front.

    Variables with the same neighbours form a block. Blocks are ordered by minimum degree: the one with the
    fewest neighbours first (Davis, Direct Methods for Sparse Linear Systems, 2006, section 7.1).

    pattern (n, n) : which entries may be nonzero, symmetric.
    """
    # With the diagonal, coupled variables with the same other neighbours have the same row. They stay
    # indistinguishable when others are eliminated: the 1104 free variables of the demo's punch are 99 groups.
    neighbours = np.asarray(pattern, dtype=bool) | np.eye(len(pattern), dtype=bool)
    members: dict[bytes, list[int]] = {}
    for i, row in enumerate(np.packbits(neighbours, axis=1)):
        # Rows as bytes, a bit a variable: hashing finds equal ones without comparing all pairs.
        members.setdefault(row.tobytes(), []).append(i)
    groups = [np.array(same) for same in members.values()]
    first, sizes = (np.array([of(g) for g in groups], dtype=np.intp) for of in (np.min, np.size))
    # One member stands for its group, and the group's size counts in degrees.
    return [groups[k] for k in _minimum_degree(neighbours[np.ix_(first, first)], sizes)]


def _minimum_degree(neighbours: Any, sizes: Index) -> list[int]:
    """Order of the groups (g,), of these sizes."""
    neighbours, left, order = neighbours.copy(), np.ones(sizes.size, dtype=bool), []
    # In variables, those of the group itself included.
    degree = neighbours @ sizes
    for _ in range(sizes.size):
        order.append(k := int(np.argmin(np.where(left, degree, np.inf))))
        left[k] = False
        # elimination makes all neighbours of k neighbours of each other
        rows = np.flatnonzero(neighbours[k] & left)
        neighbours[np.ix_(rows, rows)] = True
        # Only the neighbours of k have new degrees.
        degree[rows] = (neighbours[rows] & left) @ sizes
    return order


class BlockCholesky:
    """Cholesky factorization L L' = K of matrices with a fixed pattern.

    Variables come in blocks. Of each block of columns, the nonzero blocks of rows are stacked in one dense
    panel, so that the work is a few dense products a panel (Davis, Direct Methods for Sparse Linear Systems,
    2006, chapter 4: a supernodal factorization).

    Attributes
    ----------
    size : number of values of all panels.
    """

    def __init__(self, pattern: Any, kernels: Kernels):
        """pattern (n, n) : which entries may be nonzero, symmetric."""
        n, self._kernels = pattern.shape[0], kernels
        blocks = elimination_blocks(pattern)
        count, sizes = len(blocks), np.array([b.size for b in blocks], dtype=np.intp)
        self._n, self._order = n, np.concatenate([np.zeros(0, np.intp), *blocks])
        self._place = np.empty(n, dtype=np.intp)  # of each variable in the order
        self._place[self._order] = np.arange(n)
        self._block = np.repeat(np.arange(count), sizes)  # of each place
        start = np.append(0, np.cumsum(sizes))
        # symbolic factorization: the rows below a block's diagonal couple each other
        i, j = np.nonzero(pattern)
        filled = np.zeros((count, count), dtype=bool)
        filled[self._block[self._place[i]], self._block[self._place[j]]] = True
        below: list[Places] = []
        for k in range(count):
            rows = (np.flatnonzero(filled[k + 1 :, k]) + k + 1).astype(np.int32)
            filled[np.ix_(rows, rows)] = True
            below.append(rows)
        # layout of the panels: the diagonal block, then the blocks below it
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
        """Places of the entries (i, j) in the values; either triangle may be named."""
        low, high = np.maximum(self._place[i], self._place[j]), np.minimum(self._place[i], self._place[j])
        row, column = self._block[low], self._block[high]
        p = self._panels
        across, down = high - p.start[column], p.row_at[row, column] + low - p.start[row]
        # By columns, with the panel's height as the leading dimension.
        out: Index = p.at[column] + p.height[column] * across + down
        return out

    def factor(self, values: Vector) -> bool:
        """Factor the matrix with these values (size,), overwriting them; False: not positive definite."""
        self._values = values
        return self._kernels.factor(self._panels, values)

    def solve(self, right: Vector) -> Vector:
        """K^-1 times a vector (n,) or columns (n, k)."""
        # BLAS takes columns; a vector is one.
        x = np.asfortranarray(right[self._order].reshape(self._n, math.prod(right.shape[1:])))
        x = self._kernels.solve(self._panels, self._values, x)
        out = np.empty(x.shape)
        out[self._order] = x
        return out.reshape(right.shape)


_CACHE_SIZE = 3  # Newton systems
_PENALTY = 1e9  # weight of an equality that remains, relative to the curvature along it
_RANK_TOLERANCE = 1e-15  # relative: smaller singular values of the Schur complement count as zero
# A step is refined while the residual falls by half, as stiff contacts give weights of ten decades, which
# cost digits: with one refinement 1e-4 of the dual residual remained, and solves ended as merely acceptable.
_MAX_SOLVES, _REFINEMENT_FACTOR = 6, 0.5  # the first solve and five refinements
_FIXED_WEIGHT = 1e15  # on the diagonal of fixed variables
# Shift of the Hessian's diagonal: Waechter and Biegler 2006, section 3.1, with its names.
_SHIFT_FIRST, _SHIFT_MIN, _SHIFT_MAX = 1e-4, 1e-20, 1e20  # delta_w^0, delta_w^min, delta_w^max
_KAPPA_PLUS, _KAPPA_PLUS_FIRST = 8.0, 100.0  # growth; and of the very first shift
_DECREASE = 3.0  # 1 / kappa_w^-
_SHIFT_NEGLIGIBLE = 1e-5  # a first shift that would be smaller is left out
_SHIFT_RELATIVE = 0.1  # to the Hessian's largest entry: the first shift of an iteration is at most that


class NewtonSystem:
    """Minimize q.d + 1/2 d'(H + diag) d with y = w (J d + r) of weighted, J d + r = 0 of hard constraints.

    1. The weighted constraints enter the Hessian, W = H + diag + J' diag(w) J + shift I.
    2. The eliminated equalities are solved for their variables (`Condenser`).
    3. The matrix of the free variables gets a Cholesky factor. The shift makes it positive definite, and with
       it the inertia of the whole system right.
    4. Hard equalities that remain are met by their Schur complement.
    5. The step is refined with the residual of the whole system.

    Attributes
    ----------
    condenser : of this system.  fixed : numbers of the free variables that do not move.
    shift : the last.
    """

    def __init__(self, condenser: Condenser, fixed: Index, kernels: Kernels):
        """fixed : numbers of the free variables that do not move."""
        self.condenser, self.fixed = condenser, fixed
        self._matrix = BlockCholesky(condenser.pattern, kernels)
        self._from, i, j = condenser.free_entries
        places = self._matrix.places
        self._to = places(i, j).astype(np.int32)
        self._diagonal_to = places(np.arange(condenser.free.size), np.arange(condenser.free.size))
        # products A' diag(w) A of the equalities that remain, one group each
        self._products, self._kernels = [], kernels
        for number, (columns, at) in enumerate(condenser.remaining_equalities):
            i, j = np.tril_indices(columns.size)
            to = places(columns[i], columns[j]).astype(np.int32)
            row, once = np.full(1, number, dtype=np.int32), np.ones(1, dtype=np.intp)
            self._products.append(Products(counts=once, rows=row, values=at[None], to=to[None]))
        self.begin(b"")

    def begin(self, key: bytes) -> None:
        """Begin with another program: no shift is known; key : of its structure."""
        self.key = key
        self._equal = self.condenser.remaining[self.condenser.equal]  # numbers of the equalities that remain
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
        least: float = 0.0,
    ) -> bool:
        """Factor the system, with the least shift of a growing sequence that makes it positive definite.

        Parameters
        ----------
        diagonal : (f,) of the free variables.
        weights : gives the weights (k,) of the constraints that remain, for a shift of all variables and
            slacks: proximal plus the shift of the Hessian.
        hard : whether equalities have no weights and are met exactly.
        least : shift to try first, if it is larger than that of the sequence.

        Returns
        -------
        False if no shift suffices, or eliminated constraints do not determine their variables, or values are
        not finite.
        """
        c = self.condenser
        if not (np.isfinite(jacobian.data).all() and np.isfinite(hessian.data).all()):
            return False  # BLAS's Cholesky factorization may take nan for positive
        try:
            c.load(jacobian, hessian)
        except np.linalg.LinAlgError:
            return False
        self._jacobian, self._hessian, self._hard = jacobian, hessian, hard
        self._transposed = jacobian.T
        self._A = c.A
        of_all = np.zeros(c.n)
        of_all[c.free] = diagonal
        # Elastic equalities have weights as inequalities do: they need not be met exactly.
        penalty = self._penalty() if hard else None
        self.shift = max(least, self._initial_shift())
        while True:
            shift = proximal + self.shift
            self._diagonal = of_all + shift
            self._weights = np.zeros(c.m)
            self._weights[c.remaining] = weights(shift)
            if penalty is not None:
                self._weights[self._equal] = penalty
            if self._matrix.factor(self._values()):
                break
            self.shift = self._next_shift()
            if self.shift > _SHIFT_MAX:
                return False
        # The last shift that was needed, not the last: after iterations without one it is
        # where the next search begins.
        self._last = self.shift or self._last
        if hard and self._equal.size:
            # With F = K^-1 A', of shape (f, l), the Schur complement of the l equalities that remain is A F;
            # l is small (5 of 2248 in the demo's punch), so it is dense.
            self._spread = self._matrix.solve(self._A.T)
            # pseudo-inverse of the Schur complement, as equalities may depend on each other
            self._inverse = np.linalg.pinv(self._A @ self._spread, rcond=_RANK_TOLERANCE)
        return True

    def _penalty(self) -> Vector:
        """Weights of the equalities that remain: far above the curvature along them, but not farther."""
        # The term is constant on steps that meet A d = -off, so it changes no step. And a matrix that is
        # positive definite on A's null space becomes so altogether with a weight that is large enough
        # (Debreu's lemma): then the success of Cholesky shows that the inertia is right.
        squares = self._A**2
        length = np.maximum(1e-30, squares.sum(axis=1))
        curvature = squares @ np.abs(self.condenser.curvature) / length
        out: Vector = _PENALTY * np.maximum(1.0, curvature) / np.maximum(1.0, length)
        return out

    def _initial_shift(self) -> float:
        """Shift to try first: after an iteration that needed one, a smaller one instead of none."""
        # The paper tries none first. If the Hessian was indefinite it mostly still is, and that try costs a
        # factorization an iteration.
        shift = self._decreased_shift() if self.shift else 0.0
        return shift if shift > _SHIFT_NEGLIGIBLE else 0.0

    def _next_shift(self) -> float:
        """Shift to try after one that was too small."""
        if not self.shift:
            return self._decreased_shift() if self._last else _SHIFT_FIRST
        return self.shift * (_KAPPA_PLUS if self._last else _KAPPA_PLUS_FIRST)

    def _decreased_shift(self) -> float:
        """Less than the last shift, and in proportion to the Hessian, which may have been far larger then."""
        most = _SHIFT_RELATIVE * float(np.abs(self._hessian.data).max(initial=1.0))
        return min(most, max(_SHIFT_MIN, self._last / _DECREASE))

    def _values(self) -> Vector:
        """Values of the condensed matrix, in the layout of `BlockCholesky`."""
        c = self.condenser
        values = np.zeros(self._matrix.size)
        W = c.reduce(self._weights, self._diagonal)
        self._kernels.copy(W, self._from, values, self._to)
        # Fixed variables keep their places in the pattern; this diagonal leaves them no step.
        values[self._diagonal_to[self.fixed]] += _FIXED_WEIGHT
        self._kernels.add_products(self._products, c.J, self._weights[self._equal], values)
        return values

    def solve(self, q: Vector, r: Vector, tolerance: float = 0.0) -> tuple[Vector, Vector]:
        """Solve for the step (n,) and the new multipliers (m,) of all constraints.

        q (n,) : gradient.  r (m,) : residuals, with the offsets of weighted constraints.  tolerance :
        refinement ends if no equation's residual is larger.
        """
        c, w, equal = self.condenser, self._weights.copy(), self._equal
        w[equal] = 0.0
        exact = np.concatenate([c.eliminated, equal]) if self._hard else c.eliminated
        # y = w (J d + r) in the Lagrangian's gradient: w r is constant, w J belongs to the matrix.
        g, left, worst = q + self._transposed_product(w * r), r, np.inf
        d, y, change = np.zeros(c.n), np.zeros(c.m), np.zeros(c.m)
        for _ in range(_MAX_SOLVES):
            # Iterative refinement with the same factors: each solve is for the residual of the sum so far.
            more_d, more_y, more_change, g = self._solve_once(g, left, w)
            d, y, change = d + more_d, y + more_y, change + more_change
            # what rounding leaves of the equalities, and of the gradient of the Lagrangian
            left, of_equalities = np.zeros(c.m), np.zeros(c.m)
            left[exact] = (change + r)[exact]
            of_equalities[c.eliminated], of_equalities[equal] = more_y[c.eliminated], more_y[equal]
            g += self._transposed_product(of_equalities)
            # Bounds of fixed variables have the multiplier that makes them stationary.
            g[c.free[self.fixed]] = 0.0
            before, worst = worst, max(np.abs(g).max(initial=0.0), np.abs(left).max(initial=0.0))
            if worst <= tolerance or worst > _REFINEMENT_FACTOR * before:
                break
        return d, y + w * r

    def _solve_once(self, g: Vector, r: Vector, w: Vector) -> tuple[Vector, Vector, Vector, Vector]:
        """Solve the system without refinement, for a gradient (n,) and residuals (m,) of the equalities.

        Returns the step (n,), the multipliers (m,; w J d for weighted constraints), J d (m,), and the
        gradient of the Lagrangian without the equalities (n,).
        """
        c, equal = self.condenser, self._equal
        penalty = self._weights[equal]
        by_free, off = c.forward(g, r)
        # The penalty's term is penalty / 2 |A d + off|^2, whose gradient has this constant part.
        by_free += self._A.T @ (penalty * off)
        by_free[self.fixed] = 0.0
        free = -self._matrix.solve(by_free)
        extra = np.zeros(equal.size)
        if self._hard and equal.size:
            extra = self._inverse @ (self._A @ free + off)
            free -= self._spread @ extra
        free[self.fixed] = 0.0
        d = c.expand(free)
        # The condenser's constraints: the program's, then the bounds of eliminated variables, whose
        # gradients are unit vectors.
        change = np.concatenate([self._jacobian @ d, d[c.bounded]])
        y = w * change
        dual = g + self._hessian @ d + self._diagonal * d + self._transposed_product(y)
        # the penalty's force is a part of these multipliers
        y[equal] = penalty * (self._A @ free + off) + extra
        # Last, as these multipliers make the eliminated variables stationary for all others.
        y[c.eliminated] = c.multipliers(dual, y[equal])
        return d, y, change, dual

    def _transposed_product(self, y: Vector) -> Vector:
        """J' y (n,) for all constraints (m,), those of bounded eliminated variables among them."""
        m = self._jacobian.shape[0]
        out: Vector = self._transposed @ y[:m]
        out[self.condenser.bounded] += y[m:]
        return out


# ---------------------------------------------------------------- cache of Newton systems
_systems: OrderedDict[bytes, NewtonSystem] = OrderedDict()


def acquire(
    jacobian: Matrix,
    hessian: Matrix,
    *,
    determined: Sequence[Determined],
    equal: Mask,
    bounded: Mask,
    moves: Mask,
) -> NewtonSystem:
    """Newton system for these patterns, for a caller that will `release` it.

    Its analysis takes as long as ten iterations, so systems are cached, for programs that differ in their
    values only, or in inequalities that couple no other variables.

    determined : variables that constraints determine.  equal (m,) : which constraints are equalities.
    bounded, moves (n,) : which variables have a finite bound, and which are not fixed.
    """
    # A fixed variable follows from nothing but its bounds.
    determined = [Determined(*one) for one in determined if moves[one[1]].all()]
    # The key has two parts. Programs with the same first part have the same equalities, bounds and variables:
    # their systems differ in inequalities at most, and can be adapted.
    mine = equal[jacobian.indices]
    starts = np.append(0, np.cumsum(mine))[jacobian.indptr]
    of_equalities = np.cumsum(equal)[jacobian.indices[mine]], starts
    sizes = [(one.rank, one.variables.size) for one in determined]
    variables = np.concatenate([np.zeros(0, np.intp), *[one.variables for one in determined]])
    structure = _digest(sizes, *of_equalities, variables, bounded, moves)
    patterns = [a for matrix in (jacobian, hessian) for a in (matrix.indptr, matrix.indices)]
    key = structure + _digest(None, *patterns, equal)
    # Taken out of the cache while it is in use: it has state, and solves may be nested, or run in threads.
    system = _systems.pop(key, None) or _adapted(structure, jacobian, hessian, equal)
    if system is None:
        kernels = fastest_kernels()
        eliminations = find_eliminations(jacobian, equal, determined)
        condenser = Condenser(jacobian, hessian, eliminations, equal, bounded, kernels)
        fixed = np.flatnonzero(~moves[condenser.free])
        system = NewtonSystem(condenser, fixed, kernels)
    system.begin(key)
    return system


def _adapted(structure: bytes, jacobian: Matrix, hessian: Matrix, equal: Mask) -> NewtonSystem | None:
    """Cached system with the same equalities, adapted to these inequalities; None if there is none."""
    for key in [key for key in list(_systems)[::-1] if key.startswith(structure)]:
        # Taken out first: another thread must not use it meanwhile, nor a later solve if Ctrl-C leaves it
        # half adapted.
        system = _systems.pop(key, None)
        if system is None:
            continue
        if system.condenser.adapt(jacobian, hessian, equal):
            return system
        release(system)
    return None


def _digest(more: Any, *arrays: Index | Mask) -> bytes:
    digest = hashlib.sha256(repr(more).encode())
    for array in arrays:
        digest.update(f"{array.dtype} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.digest()


def release(system: NewtonSystem) -> None:
    """Put a system into the cache, for the next program of the same structure."""
    _systems[system.key] = system
    while len(_systems) > _CACHE_SIZE:
        _systems.popitem(last=False)
