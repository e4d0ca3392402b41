"""Blocks and elimination order of the variables of a sparse symmetric matrix."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from impactopt.solvers.elimination.kernels import Index

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
        for child in _alike(waiting.pop(k, []), sizes):
            joined = child.joined(block, sizes)
            if joined is None:
                block.children.append(child)
            else:
                block = joined
        touched = np.flatnonzero(block.below)
        parent = int(touched[np.argmin(place[touched])]) if touched.size else -1
        waiting.setdefault(parent, []).append(block)
    return waiting.get(-1, [])


def _alike(blocks: list[_Block], sizes: Index) -> list[_Block]:
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
