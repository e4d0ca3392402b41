"""Robots as tables: links of even density with their joints and drives, and the `pin.Model` made of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

__all__ = ["Box", "Drive", "Link", "add_links", "link"]

Vector = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Box:
    """A solid box of even density: mass [kg], its sides [m] along x, y, z, its centre [m] in the link."""

    mass: float
    sides: Vector
    center: Vector = (0.0, 0.0, 0.0)

    def inertia(self) -> Any:
        """pin.Inertia in the link's frame."""
        inertia = pin.Inertia.FromBox(self.mass, *self.sides)
        inertia.lever = np.array(self.center)
        return inertia

    def corners(self) -> NDArray[np.float64]:
        """(8, 3) corners [m] in the link's frame."""
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T
        return np.array(self.center) + signs * np.array(self.sides) / 2


class Drive(NamedTuple):
    """The public part of a joint: torque limit [N m], velocity limit [rad/s], gear ratio, rotor inertia
    before the gear [kg m2].
    """

    torque: float
    speed: float
    ratio: float
    rotor: float

    @property
    def armature(self) -> float:
        """Inertia of the rotor as the joint feels it [kg m2]."""
        return self.rotor * self.ratio**2


@dataclass(frozen=True, kw_only=True)
class Link:
    """A link and the revolute joint, of the same name, that moves it.

    At zero angles all frames are parallel to the world's: x forward, y left, z up. `at` [m] is where the
    joint is in the frame of `parent`, `axis` is "x", "y" or "z", `limits` [rad] are the lowest and highest
    angle.
    """

    joint: str
    parent: str
    axis: str
    at: Vector
    limits: tuple[float, float]
    drive: Drive
    box: Box

    def mirrored(self) -> Link:
        """The same link across the plane y = 0: turns about x and z change their sign."""
        (x, y, z), (a, b, c), (low, high) = self.at, self.box.center, self.limits
        return replace(
            self,
            at=(x, -y, z),
            limits=self.limits if self.axis == "y" else (-high, -low),
            box=replace(self.box, center=(a, -b, c)),
        )


def link(
    joint: str,
    parent: str,
    axis: str,
    at: Vector,
    limits: tuple[float, float],
    drive: tuple[float, float, float, float],
    mass: float,
    sides: Vector,
    center: Vector = (0.0, 0.0, 0.0),
) -> Link:
    box = Box(mass=mass, sides=sides, center=center)
    return Link(joint=joint, parent=parent, axis=axis, at=at, limits=limits, drive=Drive(*drive), box=box)


_AXES = {"x": pin.JointModelRX, "y": pin.JointModelRY, "z": pin.JointModelRZ}


def add_links(model: Any, links: Iterable[Link], roots: Mapping[str, int]) -> None:
    """Add links with their limits and armature to a pin.Model, and a frame a joint.

    roots : what the first of them may hang on: indices of joints by the name of a frame.
    """
    joints = dict(roots)
    for item in links:
        drive, place = item.drive, pin.SE3(np.eye(3), np.array(item.at))
        bounds = [np.array([x]) for x in (drive.torque, drive.speed, *item.limits)]
        joint = model.addJoint(joints[item.parent], _AXES[item.axis](), place, item.joint, *bounds)
        model.addJointFrame(joint, model.getFrameId(item.parent))
        model.appendBodyToJoint(joint, item.box.inertia(), pin.SE3.Identity())
        model.armature[model.joints[joint].idx_v] = drive.armature
        joints[item.joint] = joint
