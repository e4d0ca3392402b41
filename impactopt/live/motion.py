"""State of a motion at an instant, interpolated between the instants of its track."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from impactopt.report.tracks import Track

__all__ = ["Moment", "moment_of"]

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Moment:
    """An instant of a :class:`~impactopt.report.tracks.Track`: the same numbers at one time.

    place (joints, 3) [m], turn (joints, 4): of the joints in the world, quaternions w, x, y, z.
    """

    time: float
    place: Array
    turn: Array
    hand: Array
    mass: Array
    force: float
    travel: float
    zmp: Array


def moment_of(track: Track, time: float) -> Moment:
    """State at a time [s], clipped to the track's ends; right of a jump."""
    at = float(np.clip(time, track.time[0], track.time[-1]))
    after = min(int(np.searchsorted(track.time, at, side="right")), len(track.time) - 1)
    before = max(after - 1, 0)
    span = float(track.time[after] - track.time[before])
    share = (at - float(track.time[before])) / span if span > 0 else 1.0

    def between(values: Array) -> Array:
        return np.asarray((1 - share) * values[before] + share * values[after])

    one, other = track.places[before, :, 3:], track.places[after, :, 3:]
    same = np.where((one * other).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)  # of two signs, one is far
    turn = (1 - share) * one + share * same * other
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    return Moment(
        time=at,
        place=between(track.places[:, :, :3]),
        turn=turn[:, [3, 0, 1, 2]],
        hand=between(track.hand),
        mass=between(track.mass),
        force=float(between(track.force)),
        travel=float(between(track.travel)),
        zmp=between(track.zmp),
    )
