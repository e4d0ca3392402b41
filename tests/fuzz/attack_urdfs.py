"""URDFs with something wrong: small robots, and those of the arm presets."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fuzz.attack_cases import Found, Generator, attempt, odd_number, pick
from fuzz.attack_files import odd_text, spoil_bytes
from fuzz.attack_sound import wrong_with_robot
from impactopt.robots.link_tables import ARM7, PLANAR, Link
from impactopt.robots.robot import Robot


def urdf_of_links(name: str, links: Sequence[Link]) -> str:
    """A chain of links as a URDF; each link has a box to be seen and to touch with."""
    axes = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}
    parts = ['<link name="base"/>']
    for part in links:
        box = part.box
        inertia = np.array(box.inertia().inertia)
        center = _text(box.center)
        shape = f'<origin xyz="{center}" rpy="0 0 0"/><geometry><box size="{_text(box.sides)}"/></geometry>'
        moments = " ".join(
            f'i{a}{b}="{inertia[i, j]!s}"' for i, a in enumerate("xyz") for j, b in enumerate("xyz") if j >= i
        )
        low, high = part.limits
        parts += [
            f'<link name="{part.joint}_link"><inertial><origin xyz="{center}" rpy="0 0 0"/>'
            f'<mass value="{box.mass}"/><inertia {moments}/></inertial>'
            f"<visual>{shape}</visual><collision>{shape}</collision></link>",
            f'<joint name="{part.joint}" type="revolute">'
            f'<parent link="{"base" if part.parent == "base" else part.parent + "_link"}"/>'
            f'<child link="{part.joint}_link"/><origin xyz="{_text(part.at)}" rpy="0 0 0"/>'
            f'<axis xyz="{axes[part.axis]}"/>'
            f'<limit lower="{low}" upper="{high}" effort="{part.drive.torque}" '
            f'velocity="{part.drive.speed}"/></joint>',
        ]
    return f'<robot name="{name}">{"".join(parts)}</robot>'


def _text(numbers: Sequence[float]) -> str:
    return " ".join(map(str, numbers))


# a tree with every kind of joint and shape, a part that is fixed to another, and a joint that follows another
_TREE = """\
<robot name="tree">
  <material name="blue"><color rgba="0 0 1 1"/></material>
  <link name="base"><inertial><mass value="20"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><cylinder radius="0.2" length="0.5"/></geometry><material name="blue"/></visual></link>
  <link name="slide"><inertial><origin xyz="0 0 0.1" rpy="0.1 0 0"/><mass value="3"/>
    <inertia ixx="0.05" iyy="0.05" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><sphere radius="0.1"/></geometry></collision></link>
  <link name="arm"><inertial><origin xyz="0.2 0 0"/><mass value="2"/>
    <inertia ixx="0.01" iyy="0.03" izz="0.03" ixy="0.001" ixz="0" iyz="0"/></inertial>
    <visual><origin xyz="0.2 0 0" rpy="0 1.57 0"/><geometry><mesh filename="package://none/arm.stl" scale="1 1 1"/></geometry></visual>
    <collision><geometry><mesh filename="arm.stl"/></geometry></collision></link>
  <link name="hand"><inertial><mass value="0.5"/><inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><box size="0.1 0.1 0.1"/></geometry><material name="red"><color rgba="1 0 0 1"/></material></visual></link>
  <link name="wheel"><inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="rail" type="prismatic"><parent link="base"/><child link="slide"/><origin xyz="0 0 0.3"/><axis xyz="0 0 1"/>
    <limit lower="-0.2" upper="0.4" effort="500" velocity="1"/><dynamics damping="1" friction="0.5"/></joint>
  <joint name="elbow" type="revolute"><parent link="slide"/><child link="arm"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="80" velocity="4"/></joint>
  <joint name="grip" type="fixed"><parent link="arm"/><child link="hand"/><origin xyz="0.4 0 0" rpy="0 0 0.5"/></joint>
  <joint name="turn" type="continuous"><parent link="base"/><child link="wheel"/><origin xyz="0 0.3 0"/><axis xyz="0 1 0"/>
    <limit effort="20" velocity="9"/></joint>
</robot>
"""  # noqa: E501
URDFS = (urdf_of_links("planar_arm", PLANAR), urdf_of_links("arm7", ARM7), _TREE)


def attack_urdf(text: str, folder: Path, rng: Generator) -> Found:
    """One URDF with something wrong: is it refused, or is it a robot of matter, and can it be drawn?"""
    content = mutated_urdf(text, rng)
    path = folder / "robot.urdf"
    path.write_bytes(content)
    floating = bool(rng.random() < 0.2)

    def work() -> str:
        from impactopt.bodies.visuals import visuals_of

        robot = Robot.from_urdf(path, floating=floating, urdf=path)
        for shown in visuals_of(robot):
            if not (np.isfinite(shown.solid.vertices).all() and np.isfinite(shown.colour).all()):
                return "a shape that is nowhere"
        return wrong_with_robot(robot) or _links_of_no_matter(content, robot, floating)

    return attempt("urdf", content.decode(errors="replace"), work)


def mutated_urdf(text: str, rng: Generator) -> bytes:
    """A URDF with one to three things wrong."""
    if rng.random() < 0.25:
        return spoil_bytes(text.encode(), rng)
    root = ElementTree.fromstring(text)
    for _ in range(int(rng.choice([1, 1, 1, 2, 3]))):
        _spoil(root, rng)
    made: bytes = ElementTree.tostring(root)
    return made


def _spoil(root: Any, rng: Generator) -> None:
    every = list(root.iter())
    element = pick(rng, every)
    kind = rng.integers(10)
    if kind == 0 and element is not root:
        parent = next(p for p in every if element in list(p))
        parent.remove(element)
    elif kind == 1:
        other = pick(rng, every)
        # an element in itself would have no end
        if other not in list(element.iter()):
            other.append(element)
    elif kind == 2:
        element.tag = str(pick(rng, ("link", "joint", "inertial", "mass", "x", "mimic", "sphere", "axis")))
    elif kind == 3 and element.attrib:
        del element.attrib[pick(rng, list(element.attrib))]
    elif kind == 4:
        names = [e.get("name") for e in every if e.get("name")]
        if element.attrib and names:
            element.set(pick(rng, list(element.attrib)), str(pick(rng, names)))
    else:
        given = [(e, key) for e in every for key in e.attrib]
        if given:
            element, key = pick(rng, given)
            element.set(key, _other(element.get(key), rng))


def _other(value: str, rng: Generator) -> str:
    words = value.split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        kinds = ("fixed", "floating", "planar", "spherical", "continuous", "prismatic", "revolute")
        return str(pick(rng, kinds)) if value in kinds else _xml(odd_text(rng))
    if rng.random() < 0.15:
        return _xml(odd_text(rng))
    if rng.random() < 0.15:
        numbers = numbers[:-1] if rng.random() < 0.5 else [*numbers, 0.0]
    if numbers:
        k = int(rng.integers(len(numbers)))
        numbers[k] = odd_number(rng, numbers[k])
    return " ".join(map(repr, numbers))


def _xml(text: str) -> str:
    """Without what no XML can hold: other files have that."""
    return "".join(c for c in text if c.isprintable() or c in "\t\n")


def _links_of_no_matter(content: bytes, robot: Robot, floating: bool) -> str:
    """A moving link whose own <inertial> is that of no body, though it may be that of one with what is fixed
    to it."""
    try:
        root = ElementTree.fromstring(content)
    except ElementTree.ParseError:
        return "what is no XML"
    moving = {str(f.name) for f in robot.model.frames if f.parentJoint > 0}
    for element in root.findall("link"):
        mass, inertia = element.find("inertial/mass"), element.find("inertial/inertia")
        if element.get("name") not in moving or mass is None or inertia is None:
            continue
        try:
            m = float(mass.get("value", "nan"))
            i = {k: float(inertia.get(f"i{k}", "nan")) for k in ("xx", "yy", "zz", "xy", "xz", "yz")}
        except ValueError:
            continue  # the parser has its own way to read what is no number
        if np.isnan([m, *i.values()]).any():
            continue
        least = np.linalg.eigvalsh(
            [[i["xx"], i["xy"], i["xz"]], [i["xy"], i["yy"], i["yz"]], [i["xz"], i["yz"], i["zz"]]]
        )[0]
        if m < 0 or least < -1e-5 * max(1.0, *map(abs, i.values())):
            return f"link {element.get('name')!r} has mass {m:g} kg and a least moment of {least:.3g} kg m2"
    return ""
