"""Preset robots: humanoids, and arms on a fixed base or a satellite.

The stand-in for HRP-2 and the arms need no files. TALOS and G1 are made of the URDFs of the package
example-robot-data (extra `robots`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any, ParamSpec

import numpy as np
import pinocchio as pin

from impactopt.errors import check_choice, missing_package
from impactopt.robots import link_tables
from impactopt.robots.actuators import Actuator
from impactopt.robots.attachments import Source
from impactopt.robots.build import joint_names, lock_joints, locked_angles
from impactopt.robots.link_tables import (
    GRIPPER_LENGTH,
    SOLE_CORNERS,
    SOLE_HEIGHT,
    TOE,
    Locked,
    standin_model,
    with_overrides,
)
from impactopt.robots.robot import Robot, Sole, Striker

P = ParamSpec("P")


def _preset(make: Callable[P, Robot]) -> Callable[P, Robot]:
    """Decorator of a preset's function, which records name and arguments as the robot's `source`."""

    @wraps(make)
    def made(*args: P.args, **overrides: P.kwargs) -> Robot:
        robot = make(*args, **overrides)
        # not `replace`, which would check a new robot again
        object.__setattr__(robot, "source", Source(preset=make.__name__, options=overrides))
        return robot

    return made


arm7, planar_arm, space_arm = map(_preset, (link_tables.arm7, link_tables.planar_arm, link_tables.space_arm))


@_preset
def talos(*, locked: Locked = (), **overrides: Any) -> Robot:
    """PAL Robotics' TALOS: 90 kg, grippers locked, 30 joints and a free-flyer.

    * Armature: the SRDF has a rotor inertia of 1e-5 kg m2 and a gear ratio of 100 for every joint, wrists
      included: 0.1 kg m2, which is an assumption. Nothing else about its motors and gears is public.
    * Limits: the URDF's.
    * Servo: Kd = min(150, 1.5 s/rad x torque limit) N m s/rad and Kp = 30 1/s x Kd.
    * Soles: 0.20 x 0.12 m about `left_sole_link` and `right_sole_link`, 5 mm inside the 0.21 x 0.13 m
      collision box of the URDF's simplified variant, as the foot's edges are round (flat part of the mesh:
      0.195 x 0.117 m).
    * Strikers `right_hand`, `left_hand`: 0.1515 m from the gripper's base along its approach axis (-z), the
      mean of the tips of the three fingers, which touch first (`FirstTouch`).
    * Posture `half_sitting`: the SRDF's, with the ankles' roll set to 0, as its 1.7 mrad tilt the soles.

    `locked` joints are so beside the grippers'; `overrides` go to `Robot.from_urdf`.
    """
    folder = example_robots() / "talos_data"
    options: dict[str, Any] = {
        "srdf": folder / "srdf" / "talos.srdf",
        "name": "talos",
        "locked": {"gripper_left_joint": 0.0, "gripper_right_joint": 0.0, **locked_angles(locked)},
        "soles": tuple(
            Sole.box(name=side, frame=f"{side}_sole_link", length=0.20, width=0.12)
            for side in ("left", "right")
        ),
        "strikers": tuple(
            Striker(name=f"{side}_hand", frame=f"gripper_{side}_base_link", point=np.array([0, 0, -0.1515]))
            for side in ("right", "left")
        ),
        "postures": {"half_sitting": {"leg_left_6_joint": 0.0, "leg_right_6_joint": 0.0}},
    }
    return Robot.from_urdf(folder / "robots" / "talos_reduced.urdf", **with_overrides(options, overrides))


# Reflected rotor inertia [kg m2] of G1's actuators, from the rotor and gear data that public simulation
# models of it (mjlab, whole_body_tracking) list by motor: 5020, 7520 with gears 14.3 and 22.5, 4010.
_5020, _7520_14, _7520_22, _4010 = 3.609725e-3, 1.017752e-2, 2.5101925e-2, 4.25e-3


def _g1_motor(
    knee_speed: float, no_load_speed: float, torque: float, coulomb: float, viscous: float
) -> Actuator:
    """A motor with `torque` [N m] up to `knee_speed`, from there a linear decrease to zero at `no_load_speed`
    [rad/s], and its friction.

    Measured by Unitree: X1, X2, Y1, Fs, Fd of the actuators in its `unitree_rl_lab`. Ratings of its gears are
    not public.
    """
    return Actuator(
        stall_torque=torque * no_load_speed / (no_load_speed - knee_speed),  # the line's, at speed zero
        no_load_speed=no_load_speed,
        coulomb_friction=coulomb,
        viscous_friction=viscous,
    )


_OF_5020 = _g1_motor(30.86, 40.13, 24.8, 0.6, 0.06)
_OF_7520_14 = _g1_motor(22.63, 35.52, 71.0, 1.6, 0.16)
_OF_7520_22 = _g1_motor(14.5, 22.7, 111.0, 2.4, 0.24)
_OF_4010 = _g1_motor(15.3, 24.76, 4.8, 0.6, 0.06)
# two in parallel, at the same speed: an assumption, as rods connect them to the joint
_OF_TWO_5020 = _g1_motor(30.86, 40.13, 2 * 24.8, 2 * 0.6, 2 * 0.06)
_G1_MOTORS = {
    _5020: _OF_5020,
    _7520_14: _OF_7520_14,
    _7520_22: _OF_7520_22,
    _4010: _OF_4010,
    2 * _5020: _OF_TWO_5020,
}
# joint: (armature [kg m2], Kd [N m s/rad]); two motors in parallel move ankles, waist roll and waist pitch
_G1_SIDES = {
    "hip_pitch": (_7520_14, 17.6),
    "hip_roll": (_7520_22, 27.8),
    "hip_yaw": (_7520_14, 17.6),
    "knee": (_7520_22, 27.8),
    "ankle_pitch": (2 * _5020, 7.0),
    "ankle_roll": (2 * _5020, 7.0),
    "shoulder_pitch": (_5020, 5.0),
    "shoulder_roll": (_5020, 5.0),
    "shoulder_yaw": (_5020, 5.0),
    "elbow": (_5020, 5.0),
    "wrist_roll": (_5020, 5.0),
    "wrist_pitch": (_4010, 1.0),
    "wrist_yaw": (_4010, 1.0),
}
_G1_WAIST = {"waist_yaw": (_7520_14, 17.6), "waist_roll": (2 * _5020, 7.0), "waist_pitch": (2 * _5020, 7.0)}


@_preset
def g1(*, locked: Locked = (), **overrides: Any) -> Robot:
    """Unitree's G1 with 29 joints and rubber hands: 33 kg.

    * Armature: of the motors, 0.0036 to 0.025 kg m2. Also known are their torque-speed lines and friction
      (sources beside the numbers).
    * Limits: the URDF's.
    * Servo: Kd = 0.2 s/rad x torque limit, Kp = 30 1/s x Kd, a choice of ours: stiffer than what walking
      policies use, and just stiff enough in the ankles (2 x 210 N m/rad) to stand without balance feedback (m
      g h = 230 N m/rad).
    * Soles: frames `left_sole`, `right_sole` 35 mm below the ankle-roll links, corners at the four collision
      spheres of the URDF's feet (narrower at the heel; the mesh is larger, 0.208 x 0.076 m).
    * Strikers `right_hand`, `left_hand`: front of the rubber hand's knuckles (its mesh ends at x = 0.132 m).
    * Posture `half_sitting`: knees bent by 0.67 rad, soles flat, elbows bent.

    `locked` and `overrides` go to `Robot.from_urdf`.
    """
    corners = np.array([[0.12, 0.03], [-0.05, 0.025], [-0.05, -0.025], [0.12, -0.03]])
    posture: dict[str, float] = {}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        posture |= {
            f"{side}_hip_pitch_joint": -0.312,
            f"{side}_knee_joint": 0.669,
            f"{side}_ankle_pitch_joint": -0.357,
            f"{side}_shoulder_pitch_joint": 0.2,
            f"{side}_shoulder_roll_joint": sign * 0.2,
            f"{side}_elbow_joint": 0.6,
        }
    locked = locked_angles(locked)
    drives = {f"{side}_{joint}": drive for side in ("left", "right") for joint, drive in _G1_SIDES.items()}
    drives = {f"{joint}_joint": drive for joint, drive in (drives | _G1_WAIST).items()}
    drives = {joint: drive for joint, drive in drives.items() if joint not in locked}
    options: dict[str, Any] = {
        "name": "g1",
        "locked": locked,
        "armature": {joint: armature for joint, (armature, _) in drives.items()},
        "actuators": {joint: _G1_MOTORS[armature] for joint, (armature, _) in drives.items()},
        "kd": {joint: kd for joint, (_, kd) in drives.items()},
        "soles": tuple(
            Sole(
                name=side,
                frame=f"{side}_sole",
                polygon=corners,
                parent=f"{side}_ankle_roll_link",
                placement=pin.SE3(np.eye(3), np.array([0.0, 0.0, -0.035])),
            )
            for side in ("left", "right")
        ),
        "strikers": tuple(
            Striker(
                name=f"{side}_hand", frame=f"{side}_rubber_hand", point=np.array([0.1318, sign * 0.03, 0.007])
            )
            for side, sign in (("right", 1.0), ("left", -1.0))
        ),
        "postures": {"half_sitting": {joint: x for joint, x in posture.items() if joint in drives}},
    }
    urdf = example_robots() / "g1_description" / "urdf" / "g1_29dof_rev_1_0.urdf"
    return Robot.from_urdf(urdf, **with_overrides(options, overrides))


_HALF_SITTING = {  # of the left side; the right one is its mirror image
    "hip_pitch": -0.35,
    "knee": 0.7,
    "ankle_pitch": -0.35,
    "shoulder_pitch": 0.3,
    "shoulder_roll": 0.15,
    "elbow": -1.6,
}


_ON_LEFT_FOOT = {  # half sitting, but leaning to the left, with the right foot in the air
    "left_hip_roll": -0.2,
    "left_ankle_roll": 0.2,
    "right_hip_roll": -0.05,
    "right_ankle_roll": 0.05,
    "right_hip_pitch": -0.7,
    "right_knee": 1.4,
    "right_ankle_pitch": -0.7,
}


@_preset
def standin(*, floating: bool = True, locked: Locked = (), **overrides: Any) -> Robot:
    """A stand-in for the paper's robot, HRP-2: 58 kg, 28 joints and a free-flyer. It needs no files.

    HRP-2's own description is not public. Torque and velocity limits, gear ratios, rotor inertias and soles
    are HRP-2's from a public source (named in `robots/link_tables.py`), and so are 58 kg and 1.54 m. Lengths,
    the masses of the links, inertias (of solid boxes) and position limits are *ours*: results are those of a
    robot of HRP-2's class, not HRP-2's.

    * Joints of a side: hip yaw, roll, pitch, knee, ankle pitch, roll; shoulder pitch, roll, yaw, elbow, wrist
      yaw, pitch. Chest and head: yaw, pitch each. The grippers' are left out, as in the paper.
    * Armature: rotor inertia x gear ratio^2, 0.011 to 1.01 kg m2.
    * Servo: as OpenHRP3's sample controller: Kp 8000 N m/rad in legs and chest, 3000 in the arms, Kd 100 N m
      s/rad in all of them; the neck, which is not in it, has the defaults of `Robot.from_model`.
    * Soles: 0.230 x 0.131 m, 0.105 m below the ankle.
    * Strikers `right_hand`, `left_hand`: front of the closed gripper, on the forearm's axis; `right_toe`,
      `left_toe`: middle of the foot's front, 25 mm above the sole.
    * Postures: `half_sitting`, knees bent by 0.7 rad, soles flat, elbows bent, hands in front;
      `on_left_foot`, the same with the weight on the left sole and the right foot 9 cm up.

    `floating` and `locked` are as of `Robot.from_urdf`; `overrides` go to `Robot.from_model`.
    """
    model = lock_joints(standin_model(floating=floating), locked)
    joints = joint_names(model)
    driven = [joint for joint in joints if not joint.startswith("head")]
    arms = [joint for joint in driven if any(part in joint for part in ("shoulder", "elbow", "wrist"))]
    posture = {
        f"{side}_{joint}": sign * angle if joint.endswith("roll") else angle
        for side, sign in (("left", 1.0), ("right", -1.0))
        for joint, angle in _HALF_SITTING.items()
    }
    options: dict[str, Any] = {
        "name": "standin",
        "kp": {joint: 3000.0 if joint in arms else 8000.0 for joint in driven},
        "kd": dict.fromkeys(driven, 100.0),
        "soles": tuple(
            Sole(
                name=side,
                frame=f"{side}_sole",
                polygon=corners,
                parent=f"{side}_ankle_roll",
                placement=pin.SE3(np.eye(3), np.array([0.0, 0.0, SOLE_HEIGHT])),
            )
            for side, corners in (("left", SOLE_CORNERS), ("right", (SOLE_CORNERS * [1, -1])[::-1]))
        ),
        "strikers": tuple(
            Striker(
                name=f"{side}_hand", frame=f"{side}_wrist_pitch", point=np.array([0.0, 0.0, -GRIPPER_LENGTH])
            )
            for side in ("right", "left")
        )
        + tuple(
            Striker(name=f"{side}_toe", frame=f"{side}_ankle_roll", point=TOE * [1, sign, 1])
            for side, sign in (("right", -1), ("left", 1))
        ),
        "postures": {
            name: {joint: x for joint, x in angles.items() if joint in joints}
            for name, angles in (("half_sitting", posture), ("on_left_foot", {**posture, **_ON_LEFT_FOOT}))
        },
    }
    return Robot.from_model(model, **with_overrides(options, overrides))


_PRESETS: dict[str, Callable[..., Robot]] = {
    "standin": standin,
    "talos": talos,
    "g1": g1,
    "planar_arm": planar_arm,
    "arm7": arm7,
    "space_arm": space_arm,
}


def load_robot(name: str, /, **overrides: Any) -> Robot:
    """The preset of that name; `overrides` go to its function, such as `standin`."""
    check_choice("no robot", name, _PRESETS)
    return _PRESETS[name](**overrides)


def robot_names() -> tuple[str, ...]:
    """Names of the presets, as `load_robot` takes them."""
    return tuple(_PRESETS)


def example_robots(what: str = "this robot (not 'standin')") -> Path:
    """Folder of the robots of example-robot-data.

    what : the thing that needs it, in the message.

    Raises
    ------
    InputError : the package is not installed.
    """
    try:
        package = distribution("example-robot-data")
    except PackageNotFoundError as error:
        raise missing_package(what, "example-robot-data", "robots") from error
    return Path(str(package.locate_file("cmeel.prefix/share/example-robot-data/robots")))
