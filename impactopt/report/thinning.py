"""Histories with fewer instants, for plots."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

__all__ = ["BUCKETS", "thinned"]

Array = NDArray[np.float64]
BUCKETS = 400  # of a history; of each its ends, and its least and largest value are kept


def thinned(time: Array, *columns: Array, whole: Sequence[float] = (np.inf, -np.inf)) -> list[Array]:
    """Time (k,) and columns at fewer instants: of each bucket its ends, and where a column is least and most.

    Source: U. Jugel et al., "M4: a visualization-oriented time series data aggregation", VLDB 2014: lines
    through these look as through all. Between the two times of `whole`, which are looked at closely, all is
    kept.
    """
    if len(time) <= 3 * BUCKETS:
        return [time, *columns]
    edges = np.linspace(0, len(time), BUCKETS + 1).astype(int)
    close = np.flatnonzero((time >= whole[0]) & (time <= whole[1]))
    kept = {*edges[:-1].tolist(), *(edges[1:] - 1).tolist(), *close.tolist()}
    for low, high in pairwise(edges.tolist()):
        for column in columns:
            part = column[low:high]
            if np.isfinite(part).any():
                kept |= {low + int(np.nanargmin(part)), low + int(np.nanargmax(part))}
            if not np.isfinite(part).all():  # where a history has a gap, so has its picture
                kept.add(low + int(np.argmin(np.isfinite(part))))
    chosen = np.array(sorted(kept))
    return [time[chosen], *(column[chosen] for column in columns)]
