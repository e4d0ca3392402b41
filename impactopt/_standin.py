"""The stand-in for HRP-2: a table of links and drives, and the `pin.Model` that is built from it.

HRP-2's own description is not public. Of what follows, torque and velocity limits, gear ratios, rotor
inertias and the soles' rectangle are public: github.com/andreadelprete/pinocchio_inv_dyn,
python/pinocchio_inv_dyn/sot_utils.py, commit 9938a96. It lists them without the joints' names, in the order
right leg, left leg, chest, head, right arm, left arm; the grippers, which it has too, are left out here.
Height and mass of the whole robot, 1.54 m and 58 kg, are from K. Kaneko et al., "Humanoid robot HRP-2", ICRA
2004. Everything else is chosen by us to fit these: lengths, the distribution of mass, inertias, position
limits.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

__all__ = ["GRIPPER_LENGTH", "LINKS", "PELVIS", "SOLE_CORNERS", "SOLE_HEIGHT", "Link", "standin_model"]

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


def _link(
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


# Between the hips, on their axes. With thigh, shank and ankle it stands at 0.705 m.
PELVIS = Box(mass=9.0, sides=(0.16, 0.24, 0.20), center=(0.0, 0.0, 0.10))

GRIPPER_LENGTH = 0.13  # [m] from the wrist to the front of the closed gripper
_O = (0.0, 0.0, 0.0)
# joint, parent, axis, where [m], limits [rad], drive, mass [kg], sides [m], centre [m]
# fmt: off
_LEFT_LEG = (
    _link("hip_yaw", "pelvis", "z", (0.0, 0.06, 0.0), (-0.75, 0.75),
          (86.0, 3.541, 384.0, 1.01e-6), 0.6, (0.08, 0.08, 0.08)),
    _link("hip_roll", "hip_yaw", "x", _O, (-0.35, 0.60),
          (175.0, 3.810, 240.0, 6.96e-6), 1.2, (0.12, 0.10, 0.10)),
    _link("hip_pitch", "hip_roll", "y", _O, (-2.10, 0.70),
          (151.0, 4.422, 180.0, 1.34e-6), 3.2, (0.12, 0.11, 0.30), (0.0, 0.02, -0.15)),
    # the shanks are farther apart than the hips, so that there is room between the feet
    _link("knee", "hip_pitch", "y", (0.0, 0.035, -0.30), (0.0, 2.60),
          (168.0, 3.980, 200.0, 1.34e-6), 2.2, (0.10, 0.10, 0.30), (0.0, 0.0, -0.15)),
    _link("ankle_pitch", "knee", "y", (0.0, 0.0, -0.30), (-1.30, 0.70),
          (131.0, 5.079, 180.0, 6.96e-6), 0.4, (0.07, 0.07, 0.07)),
    _link("ankle_roll", "ankle_pitch", "x", _O, (-0.50, 0.50),
          (73.0, 9.143, 100.0, 6.96e-6), 1.4, (0.23, 0.131, 0.05), (0.015, 0.0095, -0.08)),
)
_TRUNK = (
    _link("chest_yaw", "pelvis", "z", (0.0, 0.0, 0.22), (-0.78, 0.78),
          (151.0, 4.402, 207.69, 6.96e-6), 0.5, (0.10, 0.10, 0.10)),
    # chest and backpack
    _link("chest_pitch", "chest_yaw", "y", _O, (-0.10, 1.00),
          (278.0, 2.396, 381.54, 6.96e-6), 19.0, (0.30, 0.34, 0.36), (-0.03, 0.0, 0.17)),
    _link("head_yaw", "chest_pitch", "z", (0.0, 0.0, 0.36), (-0.78, 0.78),
          (9.6, 6.877, 100.0, 1.1e-6), 0.4, (0.06, 0.06, 0.08), (0.0, 0.0, 0.02)),
    _link("head_pitch", "head_yaw", "y", (0.0, 0.0, 0.055), (-0.50, 0.75),
          (9.6, 6.877, 100.0, 1.1e-6), 1.6, (0.20, 0.16, 0.20), (0.0, 0.0, 0.10)),
)
_LEFT_ARM = (
    _link("shoulder_pitch", "chest_pitch", "y", (0.0, 0.25, 0.225), (-3.10, 1.00),
          (160.0, 4.170, 219.23, 6.96e-6), 0.5, (0.10, 0.10, 0.10), (0.0, -0.03, 0.0)),
    _link("shoulder_roll", "shoulder_pitch", "x", _O, (-0.17, 1.65),
          (100.0, 2.419, 231.25, 6.6e-6), 0.6, (0.10, 0.10, 0.10)),
    _link("shoulder_yaw", "shoulder_roll", "z", _O, (-1.60, 1.60),
          (48.0, 4.157, 266.67, 1.0e-6), 1.3, (0.09, 0.09, 0.25), (0.0, 0.0, -0.125)),
    _link("elbow", "shoulder_yaw", "y", (0.0, 0.0, -0.25), (-2.30, 0.0),
          (108.0, 2.238, 250.0, 6.6e-6), 0.9, (0.08, 0.08, 0.20), (0.0, 0.0, -0.10)),
    _link("wrist_yaw", "elbow", "z", (0.0, 0.0, -0.25), (-1.60, 1.60),
          (13.9, 4.728, 145.45, 1.1e-6), 0.35, (0.07, 0.07, 0.06)),
    # with the gripper
    _link("wrist_pitch", "wrist_yaw", "y", _O, (-1.60, 1.60),
          (63.0, 3.167, 350.0, 1.0e-6), 1.1, (0.08, 0.08, GRIPPER_LENGTH), (0.0, 0.0, -GRIPPER_LENGTH / 2)),
)
# fmt: on


def _side(side: str, links: tuple[Link, ...]) -> Iterator[Link]:
    own = {link.joint for link in links}
    for link in links:
        moved = link if side == "left" else link.mirrored()
        parent = f"{side}_{link.parent}" if link.parent in own else link.parent
        yield replace(moved, joint=f"{side}_{link.joint}", parent=parent)


# in the source's order of joints
LINKS = (
    *_side("right", _LEFT_LEG),
    *_side("left", _LEFT_LEG),
    *_TRUNK,
    *_side("right", _LEFT_ARM),
    *_side("left", _LEFT_ARM),
)

# x and y from the ankle [m], left foot, counter-clockwise; the source has the right one's
SOLE_CORNERS = np.array([[0.130, 0.075], [-0.100, 0.075], [-0.100, -0.056], [0.130, -0.056]])
SOLE_HEIGHT = -0.105  # [m] from the ankle

_AXES = {"x": pin.JointModelRX, "y": pin.JointModelRY, "z": pin.JointModelRZ}


def standin_model(*, floating: bool = True) -> Any:
    """The pin.Model with limits and armature; a frame a joint, and the frame `pelvis` at the root.

    floating : with a free-flyer at the pelvis; else the pelvis is fixed to the world.
    """
    model = pin.Model()
    model.name = "standin"
    still = pin.SE3.Identity()
    root = model.addJoint(0, pin.JointModelFreeFlyer(), still, "root_joint") if floating else 0
    above = model.addJointFrame(root) if floating else 0
    model.appendBodyToJoint(root, PELVIS.inertia(), still)
    model.addBodyFrame("pelvis", root, still, above)
    joints = {"pelvis": root}
    for link in LINKS:
        drive, place = link.drive, pin.SE3(np.eye(3), np.array(link.at))
        bounds = [np.array([x]) for x in (drive.torque, drive.speed, *link.limits)]
        joint = model.addJoint(joints[link.parent], _AXES[link.axis](), place, link.joint, *bounds)
        model.addJointFrame(joint, model.getFrameId(link.parent))
        model.appendBodyToJoint(joint, link.box.inertia(), still)
        model.armature[model.joints[joint].idx_v] = drive.armature
        joints[link.joint] = joint
    return model
