"""Contact of the hulls of striking links with the target's body, in place of striking points."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.errors import InputError
from impactopt.robots.robot import Robot
from impactopt.simulation.result import Scene

Array = NDArray[np.float64]
CONTACTS = ("point", "link")
MAX_DISTANCE = 0.05  # [m] between link and target; larger distances are not computed


def solids_in_contact(robot: Robot, scene: Scene) -> list[list[tuple[int, int]]]:
    """Pairs of solids that can touch, of each striker: a piece of its link, and a body of the target.

    Raises
    ------
    InputError : a striking link or the target has no body.
    """
    solids, out = scene.solids.solids, []
    targets = [k for k, solid in enumerate(solids) if solid.strikable]
    for striker in scene.strikers:
        joint = robot.model.frames[robot.model.getFrameId(striker)].parentJoint
        links = [k for k, solid in enumerate(solids) if solid.vertices is not None and solid.joint == joint]
        if not links or not targets:
            what = "the striking link" if targets else "the target"
            raise InputError(
                f"contact 'link' needs bodies, and {what} has none: switch on [terms.keep_out] and give "
                "[target.body] a shape, or take contact 'point'"
            )
        out.append([(link, body) for link in links for body in targets])
    return out


class LinkContact:
    """Deepest point of each striking link in the target, by MuJoCo's distances between convex bodies.

    pairs : of :func:`solids_in_contact`.
    """

    def __init__(self, mujoco: Any, world: Any, pairs: list[list[tuple[int, int]]]) -> None:
        self._mujoco, self._world = mujoco, world
        geom = {k: int(world.geom(f"solid {k}").id) for of_one in pairs for pair in of_one for k in pair}
        self._pairs = [[(geom[link], geom[body]) for link, body in of_one] for of_one in pairs]
        self._ends = np.zeros(6)

    def deepest(self, data: Any, striker: int) -> tuple[float, Array | None]:
        """Depth [m] of a striker's link in the target, and its deepest point (3,) [m].

        Without a touch the depth is negative. The point is None beyond `MAX_DISTANCE`.
        """
        distance, point = MAX_DISTANCE, None
        for link, body in self._pairs[striker]:
            # the distance up to a limit, negative in penetration; `_ends` gets the nearest points, first that
            # of the link
            of_pair = self._mujoco.mj_geomDistance(self._world, data, link, body, MAX_DISTANCE, self._ends)
            if of_pair < distance:
                distance, point = of_pair, self._ends[:3].copy()
        return -distance, point
