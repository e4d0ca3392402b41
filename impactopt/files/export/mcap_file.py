"""MCAP: the motion, the expected force and the ZMP as messages of ROS 2, for players, plots and bags.

Both libraries are the format's own (Foxglove; MIT licence). They need no ROS.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from impactopt.errors import missing_package
from impactopt.files.export.content import Export
from impactopt.files.export.motion import Motion
from impactopt.files.export.ros2 import stamp

WORLD = "world"  # frame_id of all messages
_RULE = "=" * 80  # between message definitions
# definitions of ROS 2's own packages, without their comments
_PARTS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    "geometry_msgs/Wrench": "geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque",
    "trajectory_msgs/JointTrajectoryPoint": "float64[] positions\nfloat64[] velocities\n"
    "float64[] accelerations\nfloat64[] effort\nbuiltin_interfaces/Duration time_from_start",
}
_TYPES = {
    "trajectory_msgs/msg/JointTrajectory": "std_msgs/Header header\nstring[] joint_names\n"
    "trajectory_msgs/JointTrajectoryPoint[] points",
    "geometry_msgs/msg/WrenchStamped": "std_msgs/Header header\ngeometry_msgs/Wrench wrench",
    "geometry_msgs/msg/PointStamped": "std_msgs/Header header\ngeometry_msgs/Point point",
    "geometry_msgs/msg/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose",
    "geometry_msgs/msg/TwistStamped": "std_msgs/Header header\ngeometry_msgs/Twist twist",
    "sensor_msgs/msg/JointState": "std_msgs/Header header\nstring[] name\nfloat64[] position\n"
    "float64[] velocity\nfloat64[] effort",
    "std_msgs/msg/UInt8": "uint8 data",
}


def write(export: Export, directory: Path) -> None:
    """`motion.mcap`: topics /motion, /missed, /joint_states, /phase, /expected_force, /zmp, /base_pose,
    /base_twist, and for a plan with stance phases /stance.

    meta.json is an attachment.

    Raises
    ------
    InputError : the extra `mcap` is not installed.
    """
    try:
        from mcap_ros2.writer import Writer
    except ImportError as error:
        raise missing_package("an MCAP file", "mcap-ros2-support", "mcap") from error
    with open(directory / "motion.mcap", "wb") as file:
        bag = Writer(file)
        schemas = {name: bag.register_msgdef(name, _definition(name)) for name in _TYPES}
        meta = json.dumps(export.meta, indent=2, allow_nan=False)
        bag.add_attachment(0, 0, "meta.json", "application/json", meta.encode())
        for topic, motion in export.motions.items():
            bag.write_message(
                topic=f"/{topic}",
                schema=schemas["trajectory_msgs/msg/JointTrajectory"],
                message=_trajectory(export, motion),
                log_time=0,
            )
        for k, time in enumerate(export.motion.time):
            for topic, kind, message in _messages(export, export.motion, k):
                log_time = round(1e9 * float(time))
                bag.write_message(topic=topic, schema=schemas[kind], message=message, log_time=log_time)
        bag.finish()


def _definition(name: str) -> str:
    parts = dict.fromkeys(_parts(_TYPES[name]))
    return "\n".join([_TYPES[name], *(f"{_RULE}\nMSG: {part}\n{_PARTS[part]}" for part in parts)])


def _parts(definition: str) -> Iterator[str]:
    """Names of the messages in a definition, and of those in them."""
    for line in definition.splitlines():
        kind = line.split()[0].removesuffix("[]")
        if kind in _PARTS:
            yield kind
            yield from _parts(_PARTS[kind])


def _trajectory(export: Export, motion: Motion) -> dict[str, Any]:
    points = [
        {
            "positions": motion.position[k].tolist(),
            "velocities": motion.velocity[k].tolist(),
            "accelerations": motion.acceleration[k].tolist(),
            "effort": motion.effort[k].tolist(),
            "time_from_start": _time(time),
        }
        for k, time in enumerate(motion.time)
    ]
    return {"header": _header(0.0), "joint_names": list(export.joints), "points": points}


def _messages(export: Export, motion: Motion, k: int) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Topics, types and messages of instant k."""
    header = _header(motion.time[k])
    joints = {"position": motion.position, "velocity": motion.velocity, "effort": motion.effort}
    state = {"name": list(export.joints), **{name: values[k].tolist() for name, values in joints.items()}}
    yield "/joint_states", "sensor_msgs/msg/JointState", {"header": header, **state}
    yield "/phase", "std_msgs/msg/UInt8", {"data": int(motion.phase[k])}
    if motion.stance is not None:
        yield "/stance", "std_msgs/msg/UInt8", {"data": int(motion.stance[k])}
    push = _vector(motion.force[k] * export.problem.normal)
    wrench = {"force": push, "torque": _vector(np.zeros(3))}
    yield "/expected_force", "geometry_msgs/msg/WrenchStamped", {"header": header, "wrench": wrench}
    if motion.zmp is not None:
        point = _vector([*motion.zmp[k], 0.0])
        yield "/zmp", "geometry_msgs/msg/PointStamped", {"header": header, "point": point}
    if (base := motion.base) is not None:
        turn = dict(zip("wxyz", base.quaternion[k].tolist(), strict=True))
        pose = {"position": _vector(base.position[k]), "orientation": turn}
        yield "/base_pose", "geometry_msgs/msg/PoseStamped", {"header": header, "pose": pose}
        twist = {"linear": _vector(base.linear[k]), "angular": _vector(base.angular[k])}
        yield "/base_twist", "geometry_msgs/msg/TwistStamped", {"header": header, "twist": twist}


def _header(time: float) -> dict[str, Any]:
    return {"stamp": _time(time), "frame_id": WORLD}


def _time(time: float) -> dict[str, int]:
    sec, nanosec = stamp(float(time))
    return {"sec": sec, "nanosec": nanosec}


def _vector(values: Any) -> dict[str, float]:
    return dict(zip("xyz", (float(x) for x in values), strict=True))
