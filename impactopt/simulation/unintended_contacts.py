"""Unintended contacts in a MuJoCo replay: all beside those of soles and striker."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.simulation.collision_geometry import Solids, Touched

Array = NDArray[np.float64]


class Besides:
    """Watches a compiled world's solids, named ``solid <number>``; the floor is geom 0."""

    def __init__(self, world: Any, solids: Solids) -> None:
        self._names = np.array(["ground", *(s.name for s in solids.solids)])
        self._number = np.full(world.ngeom, -1)
        self._number[0] = 0
        for k in range(world.ngeom):
            kind, _, number = world.geom(k).name.partition(" ")
            if kind == "solid":
                self._number[k] = 1 + int(number)
        self._mocap = int(world.body("target").mocapid[0])
        self._found: dict[tuple[int, int], list[float]] = {}

    def place(self, data: Any, way: Array) -> None:
        """Bodies that move with the target are ``way`` (3,) [m] from where they were."""
        data.mocap_pos[self._mocap] = way

    def look(self, data: Any, t: float) -> None:
        """Records the contacts at a time [s]; called once a step's forces are known."""
        if not data.ncon:
            return
        contacts = data.contact
        numbers = self._number[contacts.geom]
        both = numbers.min(axis=1) >= 0
        if not both.any():
            return
        for k in np.flatnonzero(both & (contacts.dist < 0)):
            one, other = (int(n) for n in sorted(numbers[k], reverse=True))
            address = contacts.efc_address[k]
            force = float(data.efc_force[address]) if address >= 0 else 0.0
            row = self._found.setdefault((one, other), [t, t, 0.0, 0.0])
            row[1] = t
            row[2] = max(row[2], -float(contacts.dist[k]))
            row[3] = max(row[3], force)

    def touched(self) -> tuple[Touched, ...]:
        """All that has touched, deepest first."""
        rows = [
            Touched(
                one=str(self._names[one]),
                other=str(self._names[other]),
                start=start,
                end=end,
                depth=depth,
                force=force,
            )
            for (one, other), (start, end, depth, force) in self._found.items()
        ]
        return tuple(sorted(rows, key=lambda row: -row.depth))
