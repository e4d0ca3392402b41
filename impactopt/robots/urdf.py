"""Reads a `pin.Model` and other data of a robot from a URDF.

Pinocchio reads links and joints, but not <mimic>, Gazebo's extensions and <transmission>. Those of them that
change the dynamics become ties or notes of the `Description`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from copy import deepcopy
from os import PathLike
from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder, tostring
from xml.parsers.expat import ExpatError, ParserCreate

import numpy as np
import pinocchio as pin

from impactopt.errors import InputError, Mistakes, did_you_mean
from impactopt.robots.build import existing
from impactopt.robots.checks import HEAVIEST
from impactopt.robots.description import Description, Tie, between

# Negative principal moments of inertia that are tolerated, [kg m2] or relative to the largest entry: files
# have rounded decimals, and guesses for small parts such as antennas.
_ROUNDED = 1e-6


def read_urdf(
    path: str | PathLike[str],
    srdf: str | PathLike[str] | None = None,
    *,
    floating: bool,
    locked: Iterable[str] | Mapping[str, float] = (),
    repaired: bool = False,
) -> Description:
    """The robot of a URDF, with an SRDF's reference configurations and rotors (as armature).

    locked : joints that will be removed; couplings to them do not move a motor's numbers.
    repaired : do not check moments of inertia, as they will be repaired.

    Raises
    ------
    InputError : the file cannot be read; joints without limits; links with non-physical inertias.
    """
    urdf = existing(path, "URDF")
    joints = (pin.JointModelFreeFlyer(),) if floating else ()
    root = parse_urdf(urdf)
    if root.tag != "robot":
        raise InputError(
            f"{urdf} is no URDF: its first element is <{root.tag}>, not <robot>"
            + ("; give it as an MJCF: --mjcf, or `mjcf` in [robot]" * (root.tag == "mujoco"))
        )
    if any(tag.tag.startswith("xacro:") for tag in root.iter()):
        raise InputError(
            f"{urdf} is a xacro file, not yet a URDF: run `xacro {Path(urdf).name} > robot.urdf`, and give "
            "robot.urdf"
        )
    _check_joints(root, urdf)
    try:
        model = pin.buildModelFromXML(tostring(_for_pinocchio(root), encoding="unicode"), *joints)
    except (ValueError, RuntimeError) as error:
        raise InputError(f"URDF {urdf}: {error}; the URDF parser's own messages are above") from error
    _check_links(root, urdf, moments=not repaired)
    if srdf is not None:
        file = existing(srdf, "SRDF")
        try:
            pin.loadReferenceConfigurations(model, file, False)
            pin.loadRotorParameters(model, file, False)
        except (ValueError, RuntimeError) as error:
            raise InputError(f"SRDF {file}: {error}") from error
    out = Description(kind="URDF", model=model)
    out.ties += [*_mimics(root, model), *_of_gazebo(root, model), *_hollow(root, model)]
    out.springs |= _springs(root, model)
    out.unranged += _unranged(root)
    out.notes += [*_weightless(root), *_rotors(root)]
    out.lead_from_root(locked)
    return out


def parse_urdf(urdf: str) -> Element:
    """Root element of a URDF.

    Raises
    ------
    InputError : it is not well-formed.
    """
    # files may have tags of other tools with undeclared prefixes, hence a parser without namespaces
    parser, tree = ParserCreate(), TreeBuilder()
    parser.StartElementHandler, parser.EndElementHandler = tree.start, tree.end
    parser.CharacterDataHandler = tree.data
    try:
        with open(urdf, "rb") as file:
            parser.ParseFile(file)
    except ExpatError as error:
        raise InputError(f"URDF {urdf} is not well-formed XML: {error}; correct it there") from error
    return tree.close()


def _check_joints(root: Element, urdf: str) -> None:
    """InputError with all joints that lack a <limit>, or close a loop, with which no URDF is read, and with
    those whose axis is zero, which Pinocchio reads as joints that move nothing.
    """
    found, parents = Mistakes(), dict[str, str]()
    for joint in root.findall("joint"):
        kind, name = joint.get("type", ""), f"URDF {urdf}: joint {joint.get('name', '')!r}"
        if kind in ("revolute", "prismatic") and not joint.findall("limit"):
            found.found.append(f"{name} has no <limit>; give it lower, upper, effort and velocity there")
        for child in (element.get("link", "") for element in joint.findall("child")):
            if child in parents:
                found.found.append(f"{name} moves link {child!r}, as {parents[child]!r} does; take one out")
            parents[child] = joint.get("name", "")
        axis = " ".join(axis.get("xyz", "") for axis in joint.findall("axis")).split()
        if kind in ("revolute", "continuous", "prismatic") and axis and not any(map(_urdf_number, axis)):
            found.found.append(f"{name} has the axis {' '.join(axis)}; give its direction, as 0 0 1")
    found.raise_if_any(f"URDF {urdf}")


def _for_pinocchio(root: Element) -> Element:
    """Copy of a URDF that Pinocchio reads.

    Limits of torque and speed that are missing, or negative, which stands for none as in SDF, are 0; without
    capsules, which its parser calls errors.
    """
    out = deepcopy(root)
    for limit in out.findall("joint/limit"):
        for key in ("effort", "velocity"):
            if not limit.get(key, "") or _urdf_number(limit.get(key, "")) < 0:
                limit.set(key, "0")
    for link in out.findall("link"):
        for shape in (*link.findall("visual"), *link.findall("collision")):
            if shape.find("geometry/capsule") is not None:
                link.remove(shape)
    return out


def _mimics(root: Element, model: pin.Model) -> Iterator[Tie]:
    """Joints that follow others."""
    every = [joint.get("name", "") for joint in root.findall("joint")]
    for joint in root.findall("joint"):
        name = joint.get("name", "")
        for mimic in joint.findall("mimic"):
            other = mimic.get("joint", "")
            text = f"joint {name!r} follows {other!r} by <mimic>"
            if model.existJointName(name) and other not in every:
                text += f", and there is no such joint{did_you_mean(other, every)}"
                yield Tie(text=text, joints=(name,), free=0, fix="correct its name")
            elif model.existJointName(name):
                yield Tie(
                    text=text,
                    joints=(name, other),
                    follower=name,
                    follows=(
                        _urdf_number(mimic.get("offset", "")),
                        _urdf_number(mimic.get("multiplier", "") or "1"),
                    ),
                )


def _hollow(root: Element, model: pin.Model) -> Iterator[Tie]:
    """Moving links with shapes and without mass. One without shapes may just connect two joints."""
    shaped = {
        link.get("name", "")
        for link in root.findall("link")
        if link.findall("visual") or link.findall("collision")
    }
    for frame in model.frames:
        joint = frame.parentJoint
        massless = model.joints[joint].nv == 1 and not model.inertias[joint].mass
        if massless and frame.type == pin.FrameType.BODY and str(frame.name) in shaped:
            moving = str(model.names[joint])
            yield Tie(
                text=f"the link {frame.name!r}, moved by {moving!r}, has shapes and mass 0 kg",
                joints=(moving,),
                free=0,
                fix="give its <inertial> a mass > 0",
            )


def _unranged(root: Element) -> Iterator[str]:
    """Revolute joints of a file that has neither `lower` nor `upper`, whose default is 0, except followers.

    In a file that has some, those without are passive joints of loops, and fixed.
    """
    joints = [joint for joint in root.findall("joint") if joint.get("type", "") == "revolute"]
    limits = [limit for joint in joints for limit in joint.findall("limit")]
    if not any(key in limit.attrib for limit in limits for key in ("lower", "upper")):
        yield from (joint.get("name", "") for joint in joints if not joint.findall("mimic"))


def _springs(root: Element, model: pin.Model) -> dict[str, tuple[float, float]]:
    """Gazebo's springs by joint: stiffness [N m/rad] and rest angle [rad]."""
    out = {}
    for gazebo in root.findall("gazebo"):
        name = gazebo.get("reference", "")
        stiffness, rest = (list(_numbers(gazebo, f"spring{key}")) for key in ("Stiffness", "Reference"))
        if model.existJointName(name) and any(stiffness):
            out[name] = stiffness[0], (rest or [0.0])[0]
    return out


def _of_gazebo(root: Element, model: pin.Model) -> Iterator[Tie]:
    """Closed loops, which Gazebo's extensions can describe and URDF cannot."""
    for gazebo in root.findall("gazebo"):
        for loop in gazebo.findall("joint"):
            ends = [_text(end) for tag in ("parent", "child") for end in loop.findall(tag)]
            frames = [
                model.getFrameId(end, pin.FrameType.BODY)
                for end in ends
                if model.existFrame(end, pin.FrameType.BODY)
            ]
            if len(frames) == 2:
                one, other = (int(model.frames[i].parentJoint) for i in frames)
                text = f"Gazebo's <joint> {loop.get('name', '')!r} closes a loop, and robots here are trees"
                yield Tie(text=text, joints=between(model, one, other), free=0, fix="take it out")


def _weightless(root: Element) -> Iterator[str]:
    """Note on links with mass that have no gravity in Gazebo."""
    heavy = {link.get("name", "") for link in root.findall("link") if link.findall("inertial")}
    names = []
    for gazebo in root.findall("gazebo"):
        off = [_text(tag) in ("false", "0") for tag in gazebo.findall("gravity")]
        off += [_text(tag) in ("true", "1") for tag in gazebo.findall("turnGravityOff")]
        if any(off) and gazebo.get("reference", "") in heavy:
            names.append(gazebo.get("reference", ""))
    if names:
        yield f"links without gravity in Gazebo have their weight here: {_listed(names)}"


def _rotors(root: Element) -> Iterator[str]:
    """Note on rotor inertias in <transmission>, which are not read, as there are several dialects."""
    names = [
        joint.get("name", "")
        for transmission in root.findall("transmission")
        if any("inertia" in tag.tag.lower() for tag in transmission.iter())
        for joint in transmission.findall("joint")
    ]
    if names:
        yield f"rotors' inertia in <transmission> is left out, of {_listed(names)}; give `armature`"


def _check_links(root: Element, urdf: str, *, moments: bool) -> None:
    """InputError with all links of a non-physical inertia.

    Pinocchio adds up links that are fixed to each other, and the sum may hide the mistake of one. Links
    without mass or inertia are frames, and allowed.

    moments : check the moments of inertia, too.
    """
    found = Mistakes()
    for link in root.findall("link"):
        given = link.findall("inertial")
        masses = [mass for part in given for mass in part.findall("mass")]
        inertias = [inertia for part in given for inertia in part.findall("inertia")]
        if not masses or not inertias:
            continue
        keys = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
        entries = [_urdf_number(inertias[0].get(key, "")) for key in keys]
        m, (xx, yy, zz, xy, xz, yz) = _urdf_number(masses[0].get("value", "")), entries
        where = f"URDF {urdf}: the <inertial> of link {link.get('name', '')!r}"
        numbers = np.array([m, *entries])
        if not np.isfinite(numbers).all() or m < 0 or np.abs(numbers).max() > HEAVIEST:
            found.found.append(
                f"{where} has mass {m:g} kg and moments {xx:g}, {yy:g}, {zz:g} kg m2; give numbers from 0 to "
                f"{HEAVIEST:g}"
            )
            continue
        least = float(np.linalg.eigvalsh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))[0])
        if moments and least < -_ROUNDED * max(1.0, float(np.abs(numbers[1:]).max())):
            found.found.append(
                f"{where} has a principal moment of inertia of {least:.3g} kg m2; correct its <inertia>, "
                'which is about the centre of mass, or take inertias="repaired"'
            )
    found.raise_if_any(f"URDF {urdf}")


def _urdf_number(text: str) -> float:
    """A number of a URDF; 0 for text that is no number, as its parser has taken it before."""
    try:
        return float(text or 0.0)
    except ValueError:
        return 0.0


def _listed(names: list[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def _text(element: Element) -> str:
    """The attribute `link` of an element, which Gazebo's loops have, or else its text."""
    words = [element.text, *(child.tail for child in element)]
    return (element.get("link", "") or "".join(filter(None, words))).strip()


def _numbers(element: Element, tag: str) -> list[float]:
    return [_urdf_number(_text(child)) for child in element.findall(tag)]
