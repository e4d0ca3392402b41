"""Tables of links and drives, and models made of them: arms, and the stand-in for HRP-2.

The planar arm is made up. Of the seven-joint arm these are public, KUKA's for the LBR iiwa 7 R800: the
distances between its axes (0.34, 0.4, 0.4 and 0.126 m, straight up at zero angles), limits of position (170
and 120 degrees in turn, 175 for the last), velocity (98, 98, 100, 130, 140, 180, 180 degrees/s) and torque
(176, 176, 110, 110, 110, 40, 40 N m), and some 24 kg for the whole arm. Everything else is chosen by us to
fit these: the distribution of mass, inertias of solid boxes, gears and rotors.

HRP-2's own description is not public. Of what follows, torque and velocity limits, gear ratios, rotor
inertias and the soles' rectangle are public: github.com/andreadelprete/pinocchio_inv_dyn,
python/pinocchio_inv_dyn/sot_utils.py, commit 9938a96. It lists them without the joints' names, in the order
right leg, left leg, chest, head, right arm, left arm; the grippers, which it has too, are left out here.
Height and mass of the whole robot, 1.54 m and 58 kg, are from K. Kaneko et al., "Humanoid robot HRP-2", ICRA
2004. Everything else is chosen by us to fit these: lengths, the distribution of mass, inertias, position
limits.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.errors import InputError, named_table
from impactopt.robots.build import joint_names, lock_joints
from impactopt.robots.robot import Robot, Striker, Tool

Vector = tuple[float, float, float]
Locked = Iterable[str] | Mapping[str, float]  # as of `Robot.from_urdf`


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
    """Drive of a joint: torque limit [N m], velocity limit [rad/s], gear ratio, and rotor inertia [kg m2]
    before the gear.
    """

    torque: float
    speed: float
    ratio: float
    rotor: float

    @property
    def armature(self) -> float:
        """Rotor inertia reflected to the joint [kg m2]."""
        return self.rotor * self.ratio**2


@dataclass(frozen=True, kw_only=True)
class Link:
    """A link and the revolute joint, of the same name, that moves it.

    At zero angles all frames are parallel to the world's: x forward, y left, z up. `at` [m] is the joint's
    position in the frame of `parent`, `axis` is "x", "y" or "z", `limits` [rad] are the least and largest
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
    """Add links with their limits and armature to a pin.Model, and a frame per joint.

    roots : indices of existing joints that links may hang on, by the name of a frame.
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


_O = (0.0, 0.0, 0.0)
WRIST = 0.08  # [m] from the planar arm's wrist to where its hand ends
FLANGE = 0.126  # [m] from the seven-joint arm's wrist to its flange

# joint, parent, axis, where [m], limits [rad], drive, mass [kg], sides [m], centre [m]
# fmt: off
PLANAR = (
    link("shoulder", "base", "y", (0.0, 0.0, 0.6), (-2.6, 2.6),
         (180.0, 4.0, 100.0, 4e-5), 5.0, (0.10, 0.10, 0.40), (0.0, 0.0, 0.18)),
    link("elbow", "shoulder", "y", (0.0, 0.0, 0.40), (-2.6, 2.6),
         (100.0, 5.0, 100.0, 2e-5), 3.0, (0.08, 0.08, 0.36), (0.0, 0.0, 0.16)),
    link("wrist", "elbow", "y", (0.0, 0.0, 0.36), (-1.9, 1.9),
         (40.0, 8.0, 100.0, 4e-6), 1.0, (0.07, 0.07, 0.10), (0.0, 0.0, 0.03)),
)
_FIST = [0.0, 0.0, FLANGE - 0.08]  # [m] from the last joint to the middle of the flange
_DEG = np.pi / 180


def _turn(k: int, axis: str, rise: float, torque: float, speed: float, mass: float, long: float) -> Link:
    """Link of joint k of seven, `rise` [m] above the joint before, `long` [m]; speed [degrees/s]."""
    limit = (175.0 if k == 7 else 170.0 if axis == "z" else 120.0) * _DEG
    rotor = {176.0: 2.0e-5, 110.0: 1.2e-5, 40.0: 4e-6}[torque]
    return link(f"joint_{k}", f"joint_{k - 1}" if k > 1 else "base", axis, (0.0, 0.0, rise), (-limit, limit),
                (torque, speed * _DEG, 160.0, rotor), mass, (0.12, 0.12, long), (0.0, 0.0, long / 2))


ARM7 = (
    _turn(1, "z", 0.15, 176.0, 98.0, 4.0, 0.19),
    _turn(2, "y", 0.19, 176.0, 98.0, 4.0, 0.20),
    _turn(3, "z", 0.20, 110.0, 100.0, 3.5, 0.20),
    _turn(4, "y", 0.20, 110.0, 130.0, 3.0, 0.20),
    _turn(5, "z", 0.20, 110.0, 140.0, 2.0, 0.20),
    _turn(6, "y", 0.20, 40.0, 180.0, 1.8, 0.08),
    _turn(7, "z", 0.08, 40.0, 180.0, 0.4, FLANGE - 0.08),
)
# fmt: on


def arm_model(name: str, links: tuple[Link, ...], base: Box | None = None) -> Any:
    """pin.Model of a chain on the frame `base`, which is fixed to the ground, or that of a floating body."""
    model, still, root, above = pin.Model(), pin.SE3.Identity(), 0, 0
    model.name = name
    if base is not None:
        root = model.addJoint(0, pin.JointModelFreeFlyer(), still, "root_joint")
        above = model.addJointFrame(root)
        model.appendBodyToJoint(root, base.inertia(), still)
    model.addBodyFrame("base", root, still, above)
    add_links(model, links, {"base": root})
    return model


def with_overrides(options: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """A preset's options with a user's; a table by joint or posture adds to that of the preset."""
    tables = {
        name: {**options[name], **table}
        for name, given in overrides.items()
        if isinstance(table := named_table(given), Mapping) and isinstance(options.get(name), Mapping)
    }
    return {**options, **overrides, **tables}


def _arm(
    whole: Any, links: tuple[Link, ...], ready: Mapping[str, float], locked: Locked, options: dict[str, Any]
) -> Robot:
    """An arm with its servo and its posture `ready` (angles by joint), without its locked joints."""
    if "floating" in options:
        raise InputError(f"floating: the base of {whole.name!r} is as it is; leave it out, or load a URDF")
    model = lock_joints(whole, locked)
    joints = joint_names(model)
    own = {
        "name": whole.name,
        "kd": {part.joint: 0.1 * part.drive.torque for part in links if part.joint in joints},
        "postures": {"ready": {joint: angle for joint, angle in ready.items() if joint in joints}},
    }
    return Robot.from_model(model, **with_overrides(own, options))


def planar_arm(*, locked: Locked = (), **overrides: Any) -> Robot:
    """An invented arm of three joints in the plane x-z, on a fixed base, with a hammer.

    * Joints `shoulder`, `elbow`, `wrist`, about y, straight up at zero angles: 0.4, 0.36, 0.08 m, 9 kg.
    * Torque 180, 100, 40 N m; velocity 4, 5, 8 rad/s; armature 0.4, 0.2, 0.04 kg m2.
    * Servo: Kd = 0.1 s/rad x torque limit, Kp = 30 1/s x Kd: soft enough for a hammer that rebounds.
    * Striker `hammer`: `Tool.hammer`, its handle along the hand, its face forward where the hand points up.
    * Posture `ready`: the hand level and in front, the hammer's face down.

    `locked` is as of `Robot.from_urdf`; `overrides` go to `Robot.from_model`.
    """
    ready = {"shoulder": -0.6, "elbow": 1.7, "wrist": 0.47}
    robot = _arm(arm_model("planar_arm", PLANAR), PLANAR, ready, locked, overrides)
    return robot.with_tool(Tool.hammer(frame="wrist", grip=[0.0, 0.0, WRIST]))


def _arm7(whole: Any, locked: Locked, options: dict[str, Any]) -> Robot:
    """The arm with seven joints, with its striker and posture."""
    ready = {"joint_2": -0.3, "joint_4": 1.6, "joint_6": 0.27}
    fist = Striker(name="fist", frame="joint_7", point=np.array(_FIST))
    return _arm(whole, ARM7, ready, locked, {"strikers": (fist,), **options})


def arm7(*, tool: Tool | None = None, locked: Locked = (), **overrides: Any) -> Robot:
    """An arm of seven joints on a fixed base, of the class of KUKA's LBR iiwa 7; it needs no files.

    Lengths, limits and the whole arm's mass are that arm's (source at the top of this file); the
    distribution of mass, inertias, gears and rotors are *ours*.

    * Joints `joint_1` to `joint_7` about z, y, z, y, z, y, z, straight up at zero angles; 19 kg move.
    * Armature: 0.51 kg m2 in the first two joints, 0.31 in the next three, 0.1 in the last two.
    * Servo: Kd = 0.1 s/rad x torque limit, Kp = 30 1/s x Kd, as the planar arm's.
    * Strikers `fist`, the middle of the flange, and that of the tool.
    * Posture `ready`: elbow bent, the flange looks ahead.

    `tool` is `Tool.hammer` along the flange's axis when left out. `locked` is as of `Robot.from_urdf`;
    `overrides` go to `Robot.from_model`.
    """
    robot = _arm7(arm_model("arm7", ARM7), locked, overrides)
    return robot.with_tool(Tool.hammer(frame="joint_7", grip=_FIST) if tool is None else tool)


def space_arm(*, locked: Locked = (), **overrides: Any) -> Robot:
    """The arm of `arm7` on an invented satellite of 60 kg, a cube of 0.5 m that floats without gravity.

    * Joints, drives, servo, striker `fist` and posture `ready` are those of `arm7`.

    `locked` is as of `Robot.from_urdf`; `overrides` go to `Robot.from_model`.
    """
    bus = Box(mass=60.0, sides=(0.5, 0.5, 0.5), center=(0.0, 0.0, -0.1))  # up to the first joint
    options = {"gravity": [0.0, 0.0, 0.0], **overrides}
    return _arm7(arm_model("space_arm", ARM7, bus), locked, options)


# Between the hips, on their axes. With thigh, shank and ankle it stands at 0.705 m.
PELVIS = Box(mass=9.0, sides=(0.16, 0.24, 0.20), center=(0.0, 0.0, 0.10))

GRIPPER_LENGTH = 0.13  # [m] from the wrist to the front of the closed gripper
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
    """Links of one side, from those of the left one: renamed, and mirrored for the right side."""
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
    """pin.Model of the stand-in with limits and armature; a frame per joint, and the frame `pelvis`.

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
