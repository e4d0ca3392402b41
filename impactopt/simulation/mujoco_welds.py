"""Frames of a robot that are welded to the world in MuJoCo: soles of references, hands that hold on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.simulation.mujoco_world import mujoco_module

__all__ = ["Welds"]

Array = NDArray[np.float64]


class Welds:
    """The welds of a compiled world that has no other equalities.

    frames : as :func:`impactopt.simulation.mujoco_world.add_welds` has added them.
    """

    def __init__(self, world: Any, frames: Sequence[str]) -> None:
        self.mujoco, self.world = mujoco_module(), world
        self.frames = [world.site(name).id for name in frames]
        self.ground = [world.site(f"ground {name}").id for name in frames]
        world.site_sameframe[self.ground] = self.mujoco.mjtSameFrame.mjSAMEFRAME_NONE  # they are moved
        self._map = np.zeros((6, world.nv))

    def put(self, data: Any) -> None:
        """They hold the frames where they are; needs kinematics."""
        for frame, ground in zip(self.frames, self.ground, strict=True):
            self.world.site_pos[ground] = data.site_xpos[frame]
            rotation = np.zeros(4)
            self.mujoco.mju_mat2Quat(rotation, data.site_xmat[frame])
            self.world.site_quat[ground] = rotation

    def wrenches(self, data: Any) -> tuple[Array, Array]:
        """Wrenches of the world on the frames (frames, 6), world axes, and their places, at the last step's
        start.
        """
        d, J = data, self._map
        out, places = np.empty((len(self.frames), 6)), np.empty((len(self.frames), 3))
        if not self.frames:
            return out, places
        rows = np.reshape(d.efc_J, (-1, self.world.nv))
        for k, frame in enumerate(self.frames):
            its = slice(6 * k, 6 * k + 6)
            self.mujoco.mj_jacSite(self.world, d, J[:3], J[3:], frame)
            # the rows of a weld are in coordinates of its own
            out[k] = np.linalg.lstsq(J.T, rows[its].T @ d.efc_force[its], rcond=None)[0]
            places[k] = d.site_xpos[frame]
        return out, places
