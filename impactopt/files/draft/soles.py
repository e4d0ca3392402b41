"""Soles, from the shapes of the feet; names of limbs by their sides."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.spatial import ConvexHull

from impactopt.arrays import Array
from impactopt.bodies.convex_hulls import Piece
from impactopt.errors import InputError
from impactopt.files.draft.limbs import Limb, unshared
from impactopt.files.draft.strikers import first_link
from impactopt.robots.attachments import Sole
from impactopt.robots.build import neutral
from impactopt.robots.checks import LEG

SLICE = 0.005  # [m]: the part of a foot so near to its lowest plane is the sole
STEEP = np.cos(np.radians(40))  # least cosine between the normals of sole and ground in the zero posture
MAX_CORNERS = 8  # of a polygon
MIN_AREA = 2e-3  # [m2] of a sole
AHEAD = 0.01  # [m] least distance from ankle to the foot's centre that shows the forward direction
BENDS = 0.2  # [rad] least asymmetry |lower + upper| of a knee's limits that shows its bending direction
# random postures in which axes of hinges are compared, within so many [rad] of zero
POSTURES, SPREAD = 40, 0.4
ARM = 0.3  # [m] by which lengths in a Jacobian are divided
SINGULAR = 5e-3  # least singular value of the Jacobian of a leg with a hinge, so scaled, at least


def find_soles(
    model: pin.Model, legs: Sequence[Limb], pieces: Mapping[int, tuple[Piece, ...]]
) -> tuple[list[Sole], Array]:
    """A sole for each leg, on a new frame below the ankle; the forward direction (3,) in the root's frame.

    Raises
    ------
    InputError : a foot without a flat face; a leg of five joints that no hinge completes.
    """
    data = model.createData()
    pin.forwardKinematics(model, data, neutral(model))
    names = sides(model, [leg.tip for leg in legs])
    flats, ahead = [], np.zeros(3)
    for leg in legs:
        found = pieces.get(leg.tip, ())
        if not found:
            raise InputError(
                f"the foot at joint {str(model.names[leg.tip])!r} has no shapes, so its sole is not known: "
                "put its meshes where the file says, or write the problem file by hand (docs/howto/robot.md)"
            )
        points, turn = np.concatenate([p.vertices for p in found]), data.oMi[leg.tip].rotation
        up = -_face(points, turn)
        low = float((points @ up).min())
        flat = points[points @ up < low + SLICE]
        flats.append((up, low, flat))
        middle = turn @ ((flat.max(axis=0) + flat.min(axis=0)) / 2)
        ahead += middle * [1.0, 1.0, 0.0]
    forward = _forward(model, data, legs, ahead)
    soles = []
    for name, leg, own, (up, low, flat) in zip(names, legs, unshared(model, legs), flats, strict=True):
        x = data.oMi[leg.tip].rotation.T @ forward
        x = _unit(x - up * (up @ x))  # forward in the plane of the sole
        place = pin.SE3(np.column_stack([x, np.cross(up, x), up]), low * up)
        corners = (flat - place.translation) @ place.rotation[:, :2]
        if hinged := len(own) < LEG:
            # The centre of pressure stays on the hinge's axis, which is through the middle of the sole: the
            # ankle may be above an edge.
            middle = (corners.max(axis=0) + corners.min(axis=0)) / 2
            place, corners = place * pin.SE3(np.eye(3), np.append(middle, 0.0)), corners - middle
        polygon = _polygon(corners)
        if polygon is None:
            raise InputError(
                f"the foot at joint {str(model.names[leg.tip])!r} has no flat face of {1e4 * MIN_AREA:g} cm2 "
                "to stand on: point feet and round ones cannot be fixed as soles"
            )
        parent, above = first_link(model, leg.tip)
        soles.append(
            Sole(
                name=name,
                frame=f"{name}_sole" if not model.existFrame(f"{name}_sole") else f"{name}_drafted_sole",
                polygon=polygon,
                parent=parent,
                placement=_neat(above.inverse() * place),
                hinge=_hinge(model, leg, own, place) if hinged else None,
            )
        )
    return soles, forward


def _forward(model: pin.Model, data: Any, legs: Sequence[Limb], feet: Array) -> Array:
    """Forward direction (3,), an axis of the root: ahead of feet named left and right, else that in which the
    knees point, else that of the feet.

    feet (3,) [m] : sum of the horizontal vectors from the ankles to the centres of the feet.
    """
    back = np.zeros(3)
    pin.computeJointJacobians(model, data, neutral(model))
    for leg, own in zip(legs, unshared(model, legs), strict=True):
        hip, ankle = data.oMi[own[0]].translation, data.oMi[leg.tip].translation

        def from_ends(j: int, hip: Array = hip, ankle: Array = ankle) -> float:
            at = data.oMi[j].translation
            return min(float(np.linalg.norm(at - hip)), float(np.linalg.norm(at - ankle)))

        # the knee is the joint farthest from both hip and ankle; it moves the shin back
        index = max(own, key=from_ends)
        knee = model.joints[index]
        low, high = model.lowerPositionLimit[knee.idx_q], model.upperPositionLimit[knee.idx_q]
        jac = np.array(pin.getJointJacobian(model, data, index, pin.LOCAL_WORLD_ALIGNED))
        axis, shin = jac[3:, knee.idx_v], ankle - data.oMi[index].translation
        if knee.nq == 1 and abs(low + high) > BENDS:
            back += np.sign(low + high) * np.cross(axis, shin) * [1.0, 1.0, 0.0]
    spots = {_side(first_link(model, leg.tip)[0]): data.oMi[leg.tip].translation for leg in legs}
    named = np.zeros(3)
    if spots.keys() == {"left", "right"}:  # before the knees, as those of some robots point back
        named = np.cross(spots["left"] - spots["right"], [0.0, 0.0, 1.0])
    for way in (named, -back, feet):
        if np.abs(way).max() > AHEAD * len(legs):
            k = int(np.argmax(np.abs(way)))
            return np.asarray(np.eye(3)[k] * np.sign(way[k]))
    return np.array([1.0, 0.0, 0.0])


def _hinge(model: pin.Model, leg: Limb, own: Sequence[int], place: Any) -> str:
    """The axis of a sole for the hinge that best completes a leg of five joints.

    That is the one with the largest least singular values of the leg's Jacobian with the hinge, (6, 6), in
    random postures. place : pin.SE3 of the sole in its joint.
    """
    data, rng = model.createData(), np.random.default_rng(0)
    low, high = np.maximum(model.lowerPositionLimit, -SPREAD), np.minimum(model.upperPositionLimit, SPREAD)
    columns, scale = [model.joints[j].idx_v for j in own], np.repeat([1 / ARM, 1.0], 3)[:, None]
    singular_values: dict[str, list[float]] = {axis: [] for axis in "xyz"}
    for _ in range(POSTURES):
        q = neutral(model)
        for j in own:
            at = model.joints[j].idx_q
            q[at] = rng.uniform(low[at], max(low[at], high[at])) if model.joints[j].nq == 1 else q[at]
        jac = place.actionInverse @ pin.computeJointJacobian(model, data, q, leg.tip)[:, columns]
        for k, axis in enumerate("xyz"):
            whole = np.column_stack([jac, np.eye(6)[3 + k]]) * scale
            singular_values[axis].append(float(np.linalg.svd(whole, compute_uv=False)[-1]))
    best = max(singular_values, key=lambda axis: float(np.quantile(singular_values[axis], 0.1)))
    if np.quantile(singular_values[best], 0.5) < SINGULAR:
        raise InputError(
            f"the leg {', '.join(str(model.names[j]) for j in own)} cannot fix its sole with a hinge about "
            "any axis: two of its joints move it in the same way"
        )
    return best


def sides(model: pin.Model, tips: Sequence[int]) -> list[str]:
    """Names of limbs: "left" and "right" for one on each side of the robot, else those of the last links."""
    data = model.createData()
    pin.forwardKinematics(model, data, neutral(model))
    links = [first_link(model, tip)[0] for tip in tips]
    words = [_side(link) for link in links]
    if words.count("left") == words.count("right") == 1:
        return words
    if len(tips) != 2:
        return links
    y = [float(data.oMi[tip].translation[1]) for tip in tips]
    if min(y) < 0 < max(y):
        return ["left" if y[0] > y[1] else "right", "left" if y[1] > y[0] else "right"]
    return links


def _side(name: str) -> str:
    """Side in a link's name, "left" or "right"; else the name."""
    low = name.lower()
    if "left" in low or low.startswith(("l_", "l-")) or (name[:1] == "L" and name[1:2].isupper()):
        return "left"
    if "right" in low or low.startswith(("r_", "r-")) or (name[:1] == "R" and name[1:2].isupper()):
        return "right"
    return name


def _face(points: Array, turn: Array) -> Array:
    """Outward normal (3,) of a foot's largest flat face that points down; turn (3, 3) : its rotation."""
    hull = ConvexHull(points)
    corners = points[hull.simplices]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    normals, down = hull.equations[:, :3], -turn[2]
    best, size = down, 0.0
    for normal in [down, *normals[(normals @ down > STEEP) & (area > 0.05 * area.max())]]:
        alike = normals @ normal > np.cos(np.radians(3))
        if area[alike].sum() > size * (1 + 1e-9):
            best, size = _unit((area[alike, None] * normals[alike]).sum(axis=0)), float(area[alike].sum())
    return down if best @ down > np.cos(np.radians(1)) else np.asarray(best)


def _polygon(corners: Array) -> Array | None:
    """A convex polygon (k, 2) inside the hull of points, counter-clockwise; None if it is too small.

    Corners that enclose the smallest areas are removed, to at most `MAX_CORNERS`.
    """
    try:
        points = corners[ConvexHull(corners).vertices]
    except (ValueError, RuntimeError):
        return None
    while True:
        before, after = np.roll(points, 1, axis=0), np.roll(points, -1, axis=0)
        (ax, ay), (bx, by) = (points - before).T, (after - points).T
        lost = (ax * by - ay * bx) / 2
        if len(points) <= 3 or (len(points) <= MAX_CORNERS and lost.min() > 2e-5):
            break
        points = np.delete(points, int(np.argmin(lost)), axis=0)
    x, y = points.T
    area = float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2)
    return np.round(points, 4) + 0.0 if area > MIN_AREA else None


def _neat(place: Any) -> Any:
    """Placement rounded for a file."""
    turn = np.where(
        np.abs(place.rotation - np.round(place.rotation)) < 1e-6, np.round(place.rotation), place.rotation
    )
    return pin.SE3(turn + 0.0, np.round(place.translation, 4) + 0.0)


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))
