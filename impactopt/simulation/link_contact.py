"""Contact of the striking links' hulls with the target's body, in place of their striking points."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.errors import InputError
from impactopt.robots.robot import Robot
from impactopt.simulation.result import Scene

__all__ = ["CONTACTS", "LinkContact", "solids_in_contact"]

Array = NDArray[np.float64]
CONTACTS = ("point", "link")
FAR = 0.05  # [m] between a link and the target: how far they are apart beyond that is not asked


def solids_in_contact(robot: Robot, scene: Scene) -> list[list[tuple[int, int]]]:
    """Numbers of solids that meet: of each striker, pieces of its link, each with a body of the target.

    Raises
    ------
    InputError : a striking link or the target has no body.
    """
    solids, out = scene.solids.solids, []
    struck = [k for k, solid in enumerate(solids) if solid.strikable]
    for striker in scene.strikers:
        joint = robot.model.frames[robot.model.getFrameId(striker)].parentJoint
        links = [k for k, solid in enumerate(solids) if solid.vertices is not None and solid.joint == joint]
        if not links or not struck:
            what = "the striking link" if struck else "the target"
            raise InputError(
                f"contact 'link' needs bodies, and {what} has none: switch on [terms.keep_out] and give "
                "[target.body] a shape, or take contact 'point'"
            )
        out.append([(link, body) for link in links for body in struck])
    return out


class LinkContact:
    """The point of each striking link that is deepest in the target, by MuJoCo's distances of convex bodies.

    pairs : of :func:`solids_in_contact`.
    """

    def __init__(self, mujoco: Any, world: Any, pairs: list[list[tuple[int, int]]]) -> None:
        self._mujoco, self._world = mujoco, world
        geom = {k: int(world.geom(f"solid {k}").id) for each in pairs for pair in each for k in pair}
        self._pairs = [[(geom[link], geom[body]) for link, body in each] for each in pairs]
        self._ends = np.zeros(6)

    def deepest(self, data: Any, striker: int) -> tuple[float, Array | None]:
        """Depth [m] of a striker's link in the target, below 0 apart, and the place (3,) [m] of its point
        there; None where they are farther apart than 5 cm.
        """
        apart, place = FAR, None
        for link, body in self._pairs[striker]:
            found = self._mujoco.mj_geomDistance(self._world, data, link, body, FAR, self._ends)
            if found < apart:
                apart, place = found, self._ends[:3].copy()
        return -apart, place
