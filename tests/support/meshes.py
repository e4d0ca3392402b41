"""Self-penetration of a robot by an independent check: Pinocchio's, of the meshes in its URDF.

Nothing of :mod:`impactopt.bodies` is used here, neither hulls nor spheres nor their pairs: this is what they
are checked against.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt import Robot
from impactopt.robots.checks import reduced


class Meshes:
    """The collision meshes of a robot's URDF, exactly, and the pairs of them that may not touch.

    start (nq,) : a posture. Pairs that touch there, and links that a joint connects, may touch for good.
    """

    def __init__(self, robot: Robot, start: NDArray[Any]) -> None:
        self.robot, self.start = robot, start

    @cached_property
    def known(self) -> bool:
        """True if the robot has meshes; one that is made of a table of links has none."""
        return self.robot.urdf is not None and self._read[1].ngeoms > 0

    @cached_property
    def _read(self) -> tuple[Any, Any]:
        """Model and geometry, with the joints that the robot does not have locked as its URDF has them."""
        robot = self.robot
        base = (pin.JointModelFreeFlyer(),) if robot.floating else ()
        full = pin.buildModelFromUrdf(robot.urdf, *base)
        folders = [str(folder) for folder in Path(str(robot.urdf)).resolve().parents]
        geometry = pin.buildGeomFromUrdf(full, robot.urdf, pin.COLLISION, package_dirs=folders)
        locked = [full.getJointId(name) for name in full.names if name not in set(robot.model.names)]
        model, geometry = reduced(full, locked, pin.neutral(full), geometry)
        geometry.addAllCollisionPairs()
        return model, geometry

    @cached_property
    def _data(self) -> tuple[Any, Any]:
        model, geometry = self._read
        data, found = model.createData(), geometry.createData()
        pin.computeCollisions(model, data, geometry, found, self._of_urdf(self.start), False)
        for k, pair in enumerate(geometry.collisionPairs):
            a, b = (geometry.geometryObjects[i].parentJoint for i in (pair.first, pair.second))
            together = a == b or model.parents[a] == b or model.parents[b] == a
            if together or found.collisionResults[k].isCollision():
                found.deactivateCollisionPair(k)
        return data, found

    def _of_urdf(self, q: NDArray[Any]) -> NDArray[Any]:
        """A configuration without the joints that the URDF does not have, such as a soft grip's."""
        own, model = self.robot.model, self._read[0]
        out = pin.neutral(model)
        for name, joint in zip(list(model.names)[1:], list(model.joints)[1:], strict=True):
            at = own.joints[own.getJointId(name)].idx_q
            out[joint.idx_q : joint.idx_q + joint.nq] = q[at : at + joint.nq]
        return np.asarray(out)

    def touching(self, motion: NDArray[Any]) -> list[tuple[str, str]]:
        """Names of the pairs that penetrate at any of the configurations (k, nq), each once."""
        (model, geometry), (data, found) = self._read, self._data
        pairs: set[tuple[str, str]] = set()
        for q in map(self._of_urdf, motion):
            if not pin.computeCollisions(model, data, geometry, found, q, True):
                continue
            pin.computeCollisions(model, data, geometry, found, q, False)
            for k, pair in enumerate(geometry.collisionPairs):
                if found.activeCollisionPairs[k] and found.collisionResults[k].isCollision():
                    one, two = (geometry.geometryObjects[i].name for i in (pair.first, pair.second))
                    pairs.add((one, two))
        return sorted(pairs)
