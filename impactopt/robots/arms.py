"""Two arms on a fixed base: tables of links and drives, and the presets that are built from them.

The planar arm is made up. Of the seven-joint arm these are public, KUKA's for the LBR iiwa 7 R800: the
distances between its axes (0.34, 0.4, 0.4 and 0.126 m, straight up at zero angles), limits of position (170
and 120 degrees in turn, 175 for the last), velocity (98, 98, 100, 130, 140, 180, 180 degrees/s) and torque
(176, 176, 110, 110, 110, 40, 40 N m), and some 24 kg for the whole arm. Everything else is chosen by us to
fit these: the distribution of mass, inertias of solid boxes, gears and rotors.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pinocchio as pin

from impactopt.robots.links import Link, add_links, link
from impactopt.robots.robot import Robot, Striker, Tool

__all__ = ["ARM7", "arm7", "arm_model", "planar_arm"]

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
_DEG = np.pi / 180


def _turn(k: int, axis: str, rise: float, torque: float, speed: float, mass: float, long: float) -> Link:
    """Joint k of the seven: `rise` [m] above the one before, its link `long` [m]; speed [degrees/s]."""
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


def arm_model(name: str, links: tuple[Link, ...]) -> Any:
    """The pin.Model of a chain on the frame `base`, which is fixed to the ground."""
    model = pin.Model()
    model.name = name
    model.addBodyFrame("base", 0, pin.SE3.Identity(), 0)
    add_links(model, links, {"base": 0})
    return model


def _soft_kd(links: Iterable[Link]) -> dict[str, float]:
    """Kd [N m s/rad] by joint of an arm's servo."""
    return {part.joint: 0.1 * part.drive.torque for part in links}


def planar_arm(**overrides: Any) -> Robot:
    """An arm of three joints in the plane x-z, on a fixed base, with a hammer; all of it is made up.

    * Joints `shoulder`, `elbow`, `wrist`, about y, straight up at zero angles: 0.4, 0.36, 0.08 m, 9 kg.
    * Torque 180, 100, 40 N m; velocity 4, 5, 8 rad/s; armature 0.4, 0.2, 0.04 kg m2.
    * Servo: Kd = 0.1 s/rad x torque limit, Kp = 30 1/s x Kd: soft enough for a hammer that rebounds.
    * Striker `hammer`: `Tool.hammer`, its handle along the hand, its face forward where the hand points up.
    * Posture `ready`: the hand level and in front, the hammer's face down.

    `overrides` go to `Robot.from_model`.
    """
    options: dict[str, Any] = {
        "name": "planar_arm",
        "kd": _soft_kd(PLANAR),
        "postures": {"ready": {"shoulder": -0.6, "elbow": 1.7, "wrist": 0.47}},
    }
    robot = Robot.from_model(arm_model("planar_arm", PLANAR), **{**options, **overrides})
    return robot.with_tool(Tool.hammer(frame="wrist", grip=[0.0, 0.0, WRIST]))


def arm7(*, tool: Tool | None = None, **overrides: Any) -> Robot:
    """An arm of seven joints on a fixed base, of the class of KUKA's LBR iiwa 7; it needs no files.

    Lengths, limits and the whole arm's mass are that arm's (source in `robots/arms.py`); the distribution
    of mass, inertias, gears and rotors are *ours*.

    * Joints `joint_1` to `joint_7` about z, y, z, y, z, y, z, straight up at zero angles; 19 kg move.
    * Armature: 0.51 kg m2 in the first two joints, 0.31 in the next three, 0.1 in the last two.
    * Servo: Kd = 0.1 s/rad x torque limit, Kp = 30 1/s x Kd, as the planar arm's.
    * Strikers `fist`, the middle of the flange, and that of the tool.
    * Posture `ready`: elbow bent, the flange looks ahead.

    `tool` is `Tool.hammer` along the flange's axis when left out. `overrides` go to `Robot.from_model`.
    """
    options: dict[str, Any] = {
        "name": "arm7",
        "kd": _soft_kd(ARM7),
        "strikers": (Striker(name="fist", frame="joint_7", point=np.array([0.0, 0.0, FLANGE - 0.08])),),
        "postures": {"ready": {"joint_2": -0.3, "joint_4": 1.6, "joint_6": 0.27}},
    }
    robot = Robot.from_model(arm_model("arm7", ARM7), **{**options, **overrides})
    grip = [0.0, 0.0, FLANGE - 0.08]
    return robot.with_tool(Tool.hammer(frame="joint_7", grip=grip) if tool is None else tool)
