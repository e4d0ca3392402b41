"""Texts of problem files and robots that several tests share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

ARM = """\
<robot name="two links">
  <link name="ground"/>
  <link name="upper"><inertial><origin xyz="0 0 0.2"/><mass value="2"/>
    <inertia ixx="0.03" iyy="0.03" izz="0.005" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="lower"><inertial><origin xyz="0 0 0.2"/><mass value="1"/>
    <inertia ixx="0.02" iyy="0.02" izz="0.003" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="fist"><inertial><mass value="0.5"/>
    <inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="turn" type="revolute"><parent link="ground"/><child link="upper"/><origin xyz="0 0 0.5"/>
    <axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="80" velocity="6"/></joint>
  <joint name="bend" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0 0 0.4"/>
    <axis xyz="1 0 0"/><limit lower="-2" upper="2" effort="60" velocity="6"/></joint>
  <joint name="twist" type="revolute"><parent link="lower"/><child link="fist"/><origin xyz="0 0 0.4"/>
    <axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="40" velocity="6"/></joint>
</robot>
"""


def write(folder: Path, text: str, name: str = "problem.toml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def bolted_arm(
    *,
    frame: str,
    point: Sequence[float],
    normal: Sequence[float],
    start: str,
    postures: Mapping[str, Mapping[str, float]],
    name: str = "",
    tip: Sequence[float] = (0.0, 0.0, 0.0),
    robot: str = "",
) -> str:
    """A problem file of ``robot.urdf`` beside it, bolted, that hits a free mass of 1 kg.

    frame, tip (3,) [m] : of the striker "hand".  point (3,) [m], normal (3,) : where it hits.  start : of the
    postures, angles by joint.  name : of the problem.  robot : more keys of [robot].
    """
    named = [f'name = "{name}"'] if name else []
    angles = [
        line
        for posture, joints in postures.items()
        for line in (f"[robot.postures_rad.{posture}]", *(f"{joint} = {at}" for joint, at in joints.items()))
    ]
    return "\n".join(
        [
            *("[problem]", *named, 'striker = "hand"', f'start = "{start}"'),
            *(f"point_m = {list(point)}", f"normal = {list(normal)}"),
            *("[robot]", 'urdf = "robot.urdf"', "floating = false", robot),
            *("[[robot.strikers]]", 'name = "hand"', f'frame = "{frame}"', f"point_m = {list(tip)}", *angles),
            *("[target]", "mass_kg = 1.0", "[contact]", "stiffness_N_m = 1e4", "damping_N_s_m = 100.0", ""),
        ]
    )
