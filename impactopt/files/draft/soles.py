"""Soles, found in the shapes of the links that end legs; sides of limbs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from impactopt.bodies.convex_hulls import Piece
from impactopt.errors import InputError
from impactopt.files.draft.limbs import Limb, unshared
from impactopt.files.draft.strikers import first_link
from impactopt.robots.attachments import Sole
from impactopt.robots.build import neutral
from impactopt.robots.checks import LEG

__all__ = ["find_soles", "sides"]

Array = NDArray[np.float64]
SLICE = 0.005  # [m] of a foot above its lowest point, that stands on the ground
STEEP = np.cos(np.radians(40))  # least cosine between a sole and the ground in the zero posture
CORNERS = 8  # of a polygon at most
SMALLEST = 2e-3  # [m2] of a sole
AHEAD = 0.01  # [m] of a foot's middle ahead of its ankle that says which way is forward
BENDS = 0.2  # [rad] of a knee's range more to one side than to the other, twice
NEAR, FAR, DRAWN = 0.4, 0.3, 40  # [rad] about zero, [m]: postures in which axes of hinges are compared
HELD = 5e-3  # of a leg with a hinge: its Jacobian's least singular value, moments by FAR, at least


def find_soles(
    model: pin.Model, legs: Sequence[Limb], pieces: Mapping[int, tuple[Piece, ...]]
) -> tuple[list[Sole], Array]:
    """A sole for each leg, on a new frame below the ankle, and the way forward (3,) in the root's frame.

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
        x = _unit(x - up * (up @ x))
        place = pin.SE3(np.column_stack([x, np.cross(up, x), up]), low * up)
        corners = (flat - place.translation) @ place.rotation[:, :2]
        polygon = _polygon(corners)
        if polygon is None:
            raise InputError(
                f"the foot at joint {str(model.names[leg.tip])!r} has no flat face of {1e4 * SMALLEST:g} cm2 "
                "to stand on: point feet and round ones cannot be held as soles"
            )
        parent, above = first_link(model, leg.tip)
        soles.append(
            Sole(
                name=name,
                frame=f"{name}_sole" if not model.existFrame(f"{name}_sole") else f"{name}_drafted_sole",
                polygon=polygon,
                parent=parent,
                placement=_neat(above.inverse() * place),
                hinge=None if len(own) >= LEG else _hinge(model, leg, own, place),
            )
        )
    return soles, forward


def _forward(model: pin.Model, data: Any, legs: Sequence[Limb], feet: Array) -> Array:
    """Forward direction (3,): opposite to the knees' bend, else towards the feet's middles, feet (3,) [m]."""
    back = np.zeros(3)
    pin.computeJointJacobians(model, data, neutral(model))
    for leg, own in zip(legs, unshared(model, legs), strict=True):
        hip, ankle = data.oMi[own[0]].translation, data.oMi[leg.tip].translation

        def room(j: int, hip: Array = hip, ankle: Array = ankle) -> float:
            at = data.oMi[j].translation
            return min(float(np.linalg.norm(at - hip)), float(np.linalg.norm(at - ankle)))

        bend = max(own, key=room)
        knee = model.joints[bend]
        low, high = model.lowerPositionLimit[knee.idx_q], model.upperPositionLimit[knee.idx_q]
        jac = np.array(pin.getJointJacobian(model, data, bend, pin.LOCAL_WORLD_ALIGNED))
        axis, shin = jac[3:, knee.idx_v], ankle - data.oMi[bend].translation
        if knee.nq == 1 and abs(low + high) > BENDS:
            back += np.sign(low + high) * np.cross(axis, shin) * [1.0, 1.0, 0.0]
    for way in (-back, feet):
        if np.abs(way).max() > AHEAD * len(legs):
            k = int(np.argmax(np.abs(way)))
            return np.asarray(np.eye(3)[k] * np.sign(way[k]))
    return np.array([1.0, 0.0, 0.0])


def _hinge(model: pin.Model, leg: Limb, own: Sequence[int], place: Any) -> str:
    """The axis of a sole, at a placement in its joint, about which a leg of these joints lacks a turn."""
    data, rng = model.createData(), np.random.default_rng(0)
    low, high = np.maximum(model.lowerPositionLimit, -NEAR), np.minimum(model.upperPositionLimit, NEAR)
    columns, scale = [model.joints[j].idx_v for j in own], np.repeat([1 / FAR, 1.0], 3)[:, None]
    worth: dict[str, list[float]] = {axis: [] for axis in "xyz"}
    for _ in range(DRAWN):
        q = neutral(model)
        for j in own:
            at = model.joints[j].idx_q
            q[at] = rng.uniform(low[at], max(low[at], high[at])) if model.joints[j].nq == 1 else q[at]
        jac = place.actionInverse @ pin.computeJointJacobian(model, data, q, leg.tip)[:, columns]
        for k, axis in enumerate("xyz"):
            whole = np.column_stack([jac, np.eye(6)[3 + k]]) * scale
            worth[axis].append(float(np.linalg.svd(whole, compute_uv=False)[-1]))
    best = max(worth, key=lambda axis: float(np.quantile(worth[axis], 0.1)))
    if np.quantile(worth[best], 0.5) < HELD:
        raise InputError(
            f"the leg {', '.join(str(model.names[j]) for j in own)} cannot hold its sole, about whichever "
            "axis the foot may turn on it: two of its joints do the same"
        )
    return best


def sides(model: pin.Model, tips: Sequence[int]) -> list[str]:
    """Names for limbs: "left" and "right" where two are on both sides of the middle, else their links'."""
    data = model.createData()
    pin.forwardKinematics(model, data, neutral(model))
    links = [first_link(model, tip)[0] for tip in tips]
    if len(tips) != 2:
        return links
    words = [_side(link) for link in links]
    if set(words) == {"left", "right"}:
        return words
    y = [float(data.oMi[tip].translation[1]) for tip in tips]
    if min(y) < 0 < max(y):
        return ["left" if y[0] > y[1] else "right", "left" if y[1] > y[0] else "right"]
    return links


def _side(name: str) -> str:
    """Side that a link's name refers to."""
    low = name.lower()
    if "left" in low or low.startswith(("l_", "l-")) or (name[:1] == "L" and name[1:2].isupper()):
        return "left"
    if "right" in low or low.startswith(("r_", "r-")) or (name[:1] == "R" and name[1:2].isupper()):
        return "right"
    return name


def _face(points: Array, turn: Array) -> Array:
    """Outward normal (3,) of a foot's largest flat face that looks down; turn (3, 3) : its joint's."""
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
    """A convex polygon (k, 2) inside the hull of points, counter-clockwise, few corners; None: too small."""
    try:
        points = corners[ConvexHull(corners).vertices]
    except (ValueError, RuntimeError):
        return None
    while True:
        before, after = np.roll(points, 1, axis=0), np.roll(points, -1, axis=0)
        (ax, ay), (bx, by) = (points - before).T, (after - points).T
        lost = (ax * by - ay * bx) / 2
        if len(points) <= 3 or (len(points) <= CORNERS and lost.min() > 2e-5):
            break
        points = np.delete(points, int(np.argmin(lost)), axis=0)
    x, y = points.T
    area = float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2)
    return np.round(points, 4) + 0.0 if area > SMALLEST else None


def _neat(place: Any) -> Any:
    """Placement without digits that are rounding errors."""
    turn = np.where(
        np.abs(place.rotation - np.round(place.rotation)) < 1e-6, np.round(place.rotation), place.rotation
    )
    return pin.SE3(turn + 0.0, np.round(place.translation, 4) + 0.0)


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))
