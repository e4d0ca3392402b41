"""Wrench cones and contact pressure of soles, as constraints on the torques."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.linalg import block_diag

from impactopt.simulation.controller.settings import ControllerSettings

__all__ = ["Cones", "cone_of"]

Array = NDArray[np.float64]


def cone_of(corners: Array, settings: ControllerSettings) -> Array:
    """Rows (k, 6) that are >= 0 of a wrench that a sole with these corners (c, 2) [m] can have, in its frame.

    Its edges' rows are its own; those of torsion are of the rectangle with its extents (Caron, Pham,
    Nakamura, "Stability of surface contacts for humanoid robots", ICRA 2015).
    """
    s, mu = settings, settings.friction
    edge = np.roll(corners, -1, axis=0) - corners
    inward = np.stack([-edge[:, 1], edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
    least = (inward * corners).sum(axis=1) + s.cop_margin
    (x0, y0), (x1, y1) = corners.min(axis=0), corners.max(axis=0)
    X, Y, cx, cy = (x1 - x0) / 2, (y1 - y0) / 2, (x0 + x1) / 2, (y0 + y1) / 2
    # the wrench at the rectangle's centre
    shift = np.eye(6)
    shift[3:, :3] = -pin.skew(np.array([cx, cy, 0.0]))
    rows = [[0.0, 0, 1, 0, 0, 0]]
    rows += [[i * a, (1 - i) * a, mu, 0, 0, 0] for i in (0, 1) for a in (1, -1)]
    for turn in (1, -1):
        for a in (1, -1):
            for b in (1, -1):
                f, m = [a * Y, b * X, mu * (X + Y)], [-turn * a * mu, -turn * b * mu, turn]
                rows.append([*f, *m])
    out = np.array(rows, dtype=float) @ shift
    edges = [[0, 0, -c, n[1], -n[0], 0] for n, c in zip(inward, least, strict=True)]
    return np.vstack([out, np.array(edges, dtype=float)])


class Cones:
    """Wrench cones of soles with corners (c, 2) [m] each, for a robot of n joints and a weight [N].

    m : rows of all of them.
    """

    def __init__(
        self, corners: tuple[Array, ...], settings: ControllerSettings, n: int, weight: float
    ) -> None:
        cones = [cone_of(c, settings) for c in corners]
        self.m = sum(len(cone) for cone in cones)
        self._weight, self._soles = weight, len(cones)
        self._rows = block_diag(*cones) / weight if cones else np.zeros((0, 0))
        self._least = np.zeros(self.m)  # of the normal force, which is each cone's first row
        self._least[np.cumsum([0, *map(len, cones)])[:-1]] = settings.least_force / weight
        self._low = np.array([[*c.min(axis=0), 0.0] for c in corners])
        self._high = np.array([[*c.max(axis=0), 0.0] for c in corners])
        self._turn = np.zeros((6 * len(cones), 6 * len(cones)))  # from the world's axes to the soles'
        # wrenches by torques over their limits, and at none: in the soles' axes
        self._local = np.zeros((6 * len(cones), n + 1))

    def look(self, places: list[Any], B: Array, b0: Array) -> tuple[Array, Array]:
        """C (m, n + 1) and c (m,), C x >= c, of x: n torques over their limits, and what the cones may be
        left by, over the weight.

        B (6 a frame, n), b0 : wrenches in world axes, B x + b0.  places : of the frames.  Those of the soles
        come first, and are looked at alone.
        """
        turn, local = self._turn, self._local
        for k, place in enumerate(places[: self._soles]):
            at, back = 6 * k, place.rotation.T
            turn[at : at + 3, at : at + 3] = turn[at + 3 : at + 6, at + 3 : at + 6] = back
        local[:, :-1], local[:, -1] = turn @ B[: len(turn)], turn @ b0[: len(turn)]
        C = self._rows @ local
        c = self._least - C[:, -1]
        C[:, -1] = 1.0
        return C, c

    def pressed(self, x: Array) -> tuple[Array, Array]:
        """Normal forces (soles,) [N] and centres of pressure (soles, 3) [m], in the soles' frames, at torques
        over their limits x (n,), where `look` was last.
        """
        wrench = self._local[:, :-1] @ x + self._local[:, -1]
        loads = np.maximum(wrench[2::6], 1e-3 * self._weight)
        points = np.zeros((self._soles, 3))
        points[:, 0], points[:, 1] = -wrench[4::6] / loads, wrench[3::6] / loads
        np.clip(points, self._low, self._high, out=points)
        return loads, points
