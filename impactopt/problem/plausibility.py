"""Plausibility checks of a robot's parameters: each is valid by itself, but missing or hard to believe."""

from __future__ import annotations

from collections.abc import Iterator
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from impactopt.bodies.convex_hulls import FAR, LEAST_DENSITY, distance_to_link, inertia_sides, is_far, size_of
from impactopt.bodies.file_shapes import lost_meshes, malformed_shapes, shapes_of
from impactopt.bodies.robot_bodies import bodies_of
from impactopt.bodies.solids import NOT_FOUND
from impactopt.errors import FARTHEST, counted
from impactopt.robots.gains import HEAVIEST_ROTOR, LIGHTEST_ROTOR
from impactopt.robots.robot import Robot

GIANT = 3.0  # length of a sole over that of its leg: no sole is so long
LIGHTEST = 1e-3  # [kg] of a link whose inertia is doubted
LARGEST = 50.0  # [m] between the joints of a limb, summed: a finger of 5 cm in millimetres
MOST_TURNS = 4  # to each side, of a joint with limits; ten degrees in place of radians are more than one
ALIKE = 0.2  # relative difference of left and right soles in length or width that is no doubt


def doubts(robot: Robot) -> list[str]:
    """Messages about parameters of a robot that are missing, or hard to believe, and that plans depend on."""
    return [
        *_without_armature(robot),
        *_armatures(robot),
        *unit_doubts(robot),
        *_sides(robot),
        *shape_doubts(robot),
    ]


def unit_doubts(robot: Robot) -> Iterator[str]:
    """Messages about lengths, angles and inertias that are plausible in other units only."""
    yield from _giant(robot)
    yield from _in_degrees(robot)
    yield from _in_radians(robot)
    yield from _light_links(robot)


def giant_soles(robot: Robot) -> Iterator[str]:
    """Messages about soles far longer than their legs, as when millimetres are taken for metres."""
    for sole in robot.soles:
        size = float(np.ptp(sole.polygon, axis=0).max())
        chain = robot.model.supports[_parent(robot, sole.frame)]
        # without the world and the base's joint
        leg = sum(float(np.linalg.norm(robot.model.jointPlacements[j].translation)) for j in list(chain)[2:])
        leg = max(leg, 1e-3)
        if size > GIANT * leg:
            yield (
                f"sole {sole.name!r} is {size:.3g} m long, on a leg of {leg:.2g} m: are its "
                "corners in millimetres? Give them in metres"
            )


def _giant(robot: Robot) -> Iterator[str]:
    """Message about a robot far larger than any, as when millimetres are taken for metres."""
    model = robot.model
    length = max(
        sum(float(np.linalg.norm(model.jointPlacements[j].translation)) for j in chain)
        for chain in model.supports
    )
    if length > LARGEST:
        yield (
            f"the longest limb of {robot.name} measures {length:.3g} m from joint to joint: is its file in "
            "millimetres? Give lengths in metres"
        )


def _in_degrees(robot: Robot) -> Iterator[str]:
    """Message about limits of angles that are as large as degrees, and no more than a few turns of them."""
    widest = np.maximum(np.abs(robot.lower), np.abs(robot.upper))
    doubtful = (widest > MOST_TURNS * 2 * np.pi) & (widest <= 720.0) & ~robot.prismatic
    names = [name for name, doubt in zip(robot.joint_names, doubtful, strict=True) if doubt]
    if names:
        k = robot.joint_index(names[0])
        yield (
            f"position limits of {_counted(names)}: {robot.lower[k]:.4g} to {robot.upper[k]:.4g} rad are "
            "hard to believe: are they in degrees? Give them in radians"
        )


def _in_radians(robot: Robot) -> Iterator[str]:
    """Message about an MJCF whose limits of angles are all smaller than a turn, had they been in radians."""
    turning = ~robot.prismatic & np.isfinite(robot.lower) & np.isfinite(robot.upper)
    widest = float(np.abs([robot.lower, robot.upper])[:, turning].max(initial=0.0))
    if robot.mjcf is not None and turning.sum() > 1 and 0 < widest < np.radians(2 * np.pi):
        yield (
            f"position limits of all joints are within {widest:.2g} rad ({np.degrees(widest):.2g} degrees), "
            'hard to believe: are angles of the file in radians? Give it <compiler angle="radian"/>'
        )


def _without_armature(robot: Robot) -> Iterator[str]:
    """Message about driven joints without armature."""
    driven = zip(robot.joint_names, robot.armature, robot.passive, strict=True)
    without = [joint for joint, a, passive in driven if a == 0 and not passive]
    if without:
        every = len(without) == robot.n - np.sum(robot.passive)
        which = "no joint has" if every else f"{', '.join(without)}: no"
        yield (
            f"{which} armature: without the rotors' inertia (x gear ratio^2) a geared robot is planned too "
            "light and hits too softly, and its gear loads are not known; give `[robot] armature_kg_m2`, by "
            "joint"
        )


def _armatures(robot: Robot) -> Iterator[str]:
    """Messages about armatures that are too small or too large for the joint's torque limit."""
    ratio = robot.armature / robot.torque_limit
    for wrong, bound, what, end in (
        ((ratio > 0) & (ratio < LIGHTEST_ROTOR), LIGHTEST_ROTOR, "small", "least"),
        (ratio > HEAVIEST_ROTOR, HEAVIEST_ROTOR, "large", "most"),
    ):
        names = [
            name for name, doubtful in zip(robot.joint_names, wrong & ~robot.passive, strict=True) if doubtful
        ]
        if names:
            k = robot.joint_index(names[0])
            armature, torque = robot.armature[k], robot.torque_limit[k]
            inertia, effort = ("kg", "N") if robot.prismatic[k] else ("kg m2", "N m")
            yield (
                f"armature of {_counted(names)}: {armature:.2g} {inertia} is hard to believe of a drive of "
                f"{torque:.3g} {effort}, too {what}; {bound * torque:.2g} {inertia} is the {end} (rotor "
                "inertia x gear ratio^2)"
            )


def _light_links(robot: Robot) -> Iterator[str]:
    """Message about links whose inertia is that of a body lighter than any robot's."""
    model, sizes = robot.model, dict[str, tuple[float, float]]()
    for name, body in zip(list(model.names)[1:], list(model.inertias)[1:], strict=True):
        sides = inertia_sides(body)[0] if body.mass > LIGHTEST else np.zeros(3)
        if body.mass < LEAST_DENSITY * np.prod(sides):
            sizes[str(name)] = float(sides.max()), float(body.mass)
    if sizes:
        names = sorted(sizes, key=lambda name: -sizes[name][0])
        size, mass = sizes[names[0]]
        yield (
            f"inertia of {_counted(names)}: that of {mass:.2g} kg in a box {size:.2g} m long is hard to "
            "believe; give the link's own, in kg m2"
        )


def _sides(robot: Robot) -> Iterator[str]:
    """Messages about soles on the opposite side of their names, and about a pair of different sizes."""
    names = {sole.name.lower(): sole for sole in robot.soles}
    left = next((sole for name, sole in names.items() if "left" in name), None)
    right = next((sole for name, sole in names.items() if "right" in name), None)
    if left is None or right is None:
        return
    model, data = robot.model, robot.model.createData()
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    one, other = (data.oMf[model.getFrameId(sole.frame)] for sole in (left, right))
    if float(other.actInv(one.translation)[1]) < 0:
        yield (
            f"sole {left.name!r} is to the right of {right.name!r}, seen along the soles' x: are their "
            "frames swapped, or does x point backwards?"
        )
    size, same = np.ptp(left.polygon, axis=0), np.ptp(right.polygon, axis=0)
    if np.any(np.abs(size - same) > ALIKE * np.maximum(size, same)):
        yield (f"soles {left.name!r} and {right.name!r} are not alike: {_times(size)} and {_times(same)}")


def shape_doubts(robot: Robot) -> Iterator[str]:
    """Messages about missing meshes, malformed shapes, shapes and centres of mass far from their link, shapes
    larger than the robot, and striking links without shapes.
    """
    yield from _lost_meshes(robot)
    yield from _shapes_left_out(robot)
    bodies = bodies_of(robot)
    for piece in bodies.too_large:
        yield (
            f"a shape of link {piece.link!r} is {size_of(piece):.2g} m large, more than the whole robot: "
            "scale it, as from millimetres; a box of the link's inertia takes its place"
        )
    for striker in robot.strikers.values():
        if _parent(robot, striker.frame) not in bodies.of_joint:
            yield (
                f"the link of striker {striker.name!r} has no shapes: it may pass through other bodies, and "
                "which part of it touches first is not known; give it a <collision>"
            )
    for piece in bodies.pieces:
        same_link = [other for other in bodies.pieces if other.joint == piece.joint]
        if is_far(robot.model, piece, same_link):
            yield (
                f"a shape of link {piece.link!r}, {size_of(piece):.2g} m large, is "
                f"{distance_to_link(robot.model, piece, same_link):.2g} m away from the link's joint, mass "
                "and frames: correct its <origin>"
            )
    for joint, pieces in bodies.of_joint.items():
        centre = np.array(robot.model.inertias[joint].lever)
        beyond = min(-piece.depth(centre) for piece in pieces)
        size = float(np.linalg.norm(np.ptp(np.concatenate([p.vertices for p in pieces]), axis=0)))
        # of right models some are half of their shapes' size outside: files have shapes of parts of a link
        if robot.model.inertias[joint].mass and beyond > max(FAR, size):
            yield (
                f"the centre of mass of link {bodies.name(joint)!r} is {beyond:.2g} m outside of its shapes, "
                f"which are {size:.2g} m large: is its <inertial> in another unit or frame? Give its place "
                "in metres, in the link's frame"
            )


def _lost_meshes(robot: Robot) -> Iterator[str]:
    """Message about missing or unreadable meshes, and the consequences."""
    found = lost_meshes(robot.model, robot.urdf)
    reasons = dict(sorted(pair for meshes in found.values() for pair in meshes.items()))
    by_reason = {why: [name for name, other in reasons.items() if other == why] for why in reasons.values()}
    each = "; ".join(
        f"{names[0]}{f' and {len(names) - 1} more' * (len(names) > 1)}: {why}"
        for why, names in by_reason.items()
    )
    if reasons:
        where = (
            "; put them into a folder above the URDF, or name the folder of their package in ROS_PACKAGE_PATH"
        )
        yield (
            f"{counted(len(reasons), 'mesh is', 'meshes are')} lost, and boxes of inertia stand for links "
            f"without any: {each}{where * (NOT_FOUND in by_reason)}"
        )


def _shapes_left_out(robot: Robot) -> Iterator[str]:
    """Messages about shapes that are left out, as they cannot be read or are too far; each once of a link."""
    for link, element in dict.fromkeys(
        (link, ElementTree.tostring(element, encoding="unicode").strip())
        for link, element in malformed_shapes(robot.urdf)
    ):
        yield (
            f"a shape of link {link!r} is left out, as its kind is unknown, or its numbers are missing, no "
            f"numbers or negative: {element}; correct it"
        )
    shapes = (
        shape
        for kind in ("collision", "visual")
        for shape in shapes_of(robot.model, robot.urdf, kind, far=True)
    )
    for link in dict.fromkeys(shape.link for shape in shapes):
        yield (
            f"a shape of link {link!r} is left out, as it reaches more than {FARTHEST:g} m from the link's "
            "joint: correct its <origin>, its size or its mesh's scale"
        )


def _counted(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} and {counted(len(names) - 1, 'more joint')}"


def _times(size: np.ndarray) -> str:
    return " x ".join(f"{x:.3g}" for x in size) + " m"


def _parent(robot: Robot, frame: str) -> int:
    return int(robot.model.frames[robot.model.getFrameId(frame)].parentJoint)
