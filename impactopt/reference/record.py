"""From the instants of a collision to its result."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..collision.result import Collision
from .forces import Forces
from .motion import Instant

__all__ = ["collision_from"]

Array = NDArray[np.float64]


def collision_from(
    instants: Sequence[Instant], last: Array, nv: int, soles: int, forces: Forces, separated: bool
) -> Collision:
    """The result of a collision with that last state, on `soles` soles, which are the first held frames."""
    columns = {name: np.array([getattr(i, name) for i in instants]) for name in Instant._fields}
    wrench, places = columns.pop("wrench"), columns.pop("places")
    k = len(instants)
    sole_wrench = ground = zmp = None
    if soles:
        sole_wrench = wrench.reshape(k, -1, 6)[:, :soles]
        force = sole_wrench[..., :3]
        moment = sole_wrench[..., 3:] + np.cross(places[:, :soles], force)
        ground = np.hstack([force.sum(axis=1), moment.sum(axis=1)])
        zmp = np.stack([-ground[:, 4], ground[:, 3]], axis=1) / ground[:, 2:3]
    target, numbers = forces.target, forces.target_numbers
    at_rest = np.zeros(target.n_states)
    return Collision(
        impulse=float(last[2 * nv + 1]),
        peak_force=float(columns["force"].max()),
        duration=instants[-1].time,
        energy=float(target.energy(last[2 * nv + 2 :], numbers) - target.energy(at_rest, numbers)),
        separated=separated,
        velocity=last[nv : 2 * nv].copy(),
        displacement=last[:nv].copy(),
        sole_wrench=sole_wrench,
        ground_wrench=ground,
        zmp=zmp,
        **{name: columns[name] for name in columns},
    )
