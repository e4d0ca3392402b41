"""Assembles a collision's result from its recorded instants."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.collision.interface import Collision
from impactopt.simulation.reference.equations_of_motion import Instant
from impactopt.simulation.reference.forces import Forces

__all__ = ["collision_from"]

Array = NDArray[np.float64]


def collision_from(
    instants: Sequence[Instant],
    configuration: Array,
    velocity: Array,
    impulse: float,
    peak: float,
    target: Array,
    soles: int,
    forces: Forces,
    separated: bool,
) -> Collision:
    """The result of a collision with that end, and that largest force [N].

    soles : how many of the constrained frames, the first, are soles.
    """
    columns: dict[str, Any] = {
        name: np.array([getattr(i, name) for i in instants]) for name in Instant._fields
    }
    k = len(instants)
    wrench, places = columns.pop("wrench").reshape(k, -1, 6), columns.pop("places")
    sole_wrench = ground = zmp = None
    if soles:
        sole_wrench = wrench[:, :soles]
        force = sole_wrench[..., :3]
        moment = sole_wrench[..., 3:] + np.cross(places[:, :soles], force)
        ground = np.hstack([force.sum(axis=1), moment.sum(axis=1)])
        zmp = np.stack([-ground[:, 4], ground[:, 3]], axis=1) / ground[:, 2:3]
    kind, numbers = forces.target, forces.target_numbers
    at_rest = np.zeros(kind.n_states)
    return Collision(
        impulse=impulse,
        peak_force=peak,
        duration=instants[-1].time,
        energy=float(kind.energy(target, numbers) - kind.energy(at_rest, numbers)),
        separated=separated,
        velocity=velocity,
        configuration=configuration,
        target_result=dict(zip(kind.results, map(float, kind.result(target, numbers)), strict=True)),
        sole_wrench=sole_wrench,
        hand_wrench=wrench[:, soles:] if wrench.shape[1] > soles else None,
        ground_wrench=ground,
        zmp=zmp,
        freeze_error=0.0,
        **columns,
    )
