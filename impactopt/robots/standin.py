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
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin

from impactopt.robots.links import Box, Link, add_links, link

__all__ = ["GRIPPER_LENGTH", "LINKS", "PELVIS", "SOLE_CORNERS", "SOLE_HEIGHT", "TOE", "standin_model"]

# Between the hips, on their axes. With thigh, shank and ankle it stands at 0.705 m.
PELVIS = Box(mass=9.0, sides=(0.16, 0.24, 0.20), center=(0.0, 0.0, 0.10))

GRIPPER_LENGTH = 0.13  # [m] from the wrist to the front of the closed gripper
_O = (0.0, 0.0, 0.0)
# joint, parent, axis, where [m], limits [rad], drive, mass [kg], sides [m], centre [m]
# fmt: off
_LEFT_LEG = (
    link("hip_yaw", "pelvis", "z", (0.0, 0.06, 0.0), (-0.75, 0.75),
         (86.0, 3.541, 384.0, 1.01e-6), 0.6, (0.08, 0.08, 0.08)),
    link("hip_roll", "hip_yaw", "x", _O, (-0.35, 0.60),
         (175.0, 3.810, 240.0, 6.96e-6), 1.2, (0.12, 0.10, 0.10)),
    link("hip_pitch", "hip_roll", "y", _O, (-2.10, 0.70),
         (151.0, 4.422, 180.0, 1.34e-6), 3.2, (0.12, 0.11, 0.30), (0.0, 0.02, -0.15)),
    # the shanks are farther apart than the hips, so that there is room between the feet
    link("knee", "hip_pitch", "y", (0.0, 0.035, -0.30), (0.0, 2.60),
         (168.0, 3.980, 200.0, 1.34e-6), 2.2, (0.10, 0.10, 0.30), (0.0, 0.0, -0.15)),
    link("ankle_pitch", "knee", "y", (0.0, 0.0, -0.30), (-1.30, 0.70),
         (131.0, 5.079, 180.0, 6.96e-6), 0.4, (0.07, 0.07, 0.07)),
    link("ankle_roll", "ankle_pitch", "x", _O, (-0.50, 0.50),
         (73.0, 9.143, 100.0, 6.96e-6), 1.4, (0.23, 0.131, 0.05), (0.015, 0.0095, -0.08)),
)
_TRUNK = (
    link("chest_yaw", "pelvis", "z", (0.0, 0.0, 0.22), (-0.78, 0.78),
         (151.0, 4.402, 207.69, 6.96e-6), 0.5, (0.10, 0.10, 0.10)),
    # chest and backpack
    link("chest_pitch", "chest_yaw", "y", _O, (-0.10, 1.00),
         (278.0, 2.396, 381.54, 6.96e-6), 19.0, (0.30, 0.34, 0.36), (-0.03, 0.0, 0.17)),
    link("head_yaw", "chest_pitch", "z", (0.0, 0.0, 0.36), (-0.78, 0.78),
         (9.6, 6.877, 100.0, 1.1e-6), 0.4, (0.06, 0.06, 0.08), (0.0, 0.0, 0.02)),
    link("head_pitch", "head_yaw", "y", (0.0, 0.0, 0.055), (-0.50, 0.75),
         (9.6, 6.877, 100.0, 1.1e-6), 1.6, (0.20, 0.16, 0.20), (0.0, 0.0, 0.10)),
)
_LEFT_ARM = (
    link("shoulder_pitch", "chest_pitch", "y", (0.0, 0.25, 0.225), (-3.10, 1.00),
         (160.0, 4.170, 219.23, 6.96e-6), 0.5, (0.10, 0.10, 0.10), (0.0, -0.03, 0.0)),
    link("shoulder_roll", "shoulder_pitch", "x", _O, (-0.17, 1.65),
         (100.0, 2.419, 231.25, 6.6e-6), 0.6, (0.10, 0.10, 0.10)),
    link("shoulder_yaw", "shoulder_roll", "z", _O, (-1.60, 1.60),
         (48.0, 4.157, 266.67, 1.0e-6), 1.3, (0.09, 0.09, 0.25), (0.0, 0.0, -0.125)),
    link("elbow", "shoulder_yaw", "y", (0.0, 0.0, -0.25), (-2.30, 0.0),
         (108.0, 2.238, 250.0, 6.6e-6), 0.9, (0.08, 0.08, 0.20), (0.0, 0.0, -0.10)),
    link("wrist_yaw", "elbow", "z", (0.0, 0.0, -0.25), (-1.60, 1.60),
         (13.9, 4.728, 145.45, 1.1e-6), 0.35, (0.07, 0.07, 0.06)),
    # with the gripper
    link("wrist_pitch", "wrist_yaw", "y", _O, (-1.60, 1.60),
         (63.0, 3.167, 350.0, 1.0e-6), 1.1, (0.08, 0.08, GRIPPER_LENGTH), (0.0, 0.0, -GRIPPER_LENGTH / 2)),
)
# fmt: on


def _side(side: str, links: tuple[Link, ...]) -> Iterator[Link]:
    own = {part.joint for part in links}
    for part in links:
        moved = part if side == "left" else part.mirrored()
        parent = f"{side}_{part.parent}" if part.parent in own else part.parent
        yield replace(moved, joint=f"{side}_{part.joint}", parent=parent)


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
# [m] from the ankle, left foot: the middle of the front of the foot's box, 25 mm above the sole
TOE = np.array([0.130, 0.0095, -0.080])


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
    add_links(model, LINKS, {"pelvis": root})
    return model
