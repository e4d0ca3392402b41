"""Stances: soles and hands that are fixed, or a fixed base; and the support of soles on level ground.

The virtual base (paper, eqs. 1-4) adds a mass M_g and an inertia I_g E to each fixed sole. This is equivalent
to a constraint with the compliances 1/M_g and 1/I_g on the diagonal of its inverse inertia J H^-1 J^T, which
avoids the rounding errors of huge masses in H. M_g to infinity is the exact constraint.

Unilateral frictional forces at the corners of a sole can transmit a wrench (f, m) at its frame if and only if
it lies in the cone spanned by them. The cone bounds centre of pressure (CoP), friction and yaw torsion
*together*; torsion capacity vanishes as the CoP nears a corner. Source: Caron, Pham, Nakamura, "Stability of
surface contacts for humanoid robots", ICRA 2015, whose closed form for a rectangle the tests compare with.
"""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull, QhullError

from impactopt.arrays import Array
from impactopt.errors import InputError, check_array, check_kind
from impactopt.robots.robot import Robot, Sole, Striker

USUAL_POSTURE = "half_sitting"  # name of the start posture where none is given


class Stance(ABC):
    """Base class of stances: frames of the robot that are fixed to the world."""

    @abstractmethod
    def soles(self, robot: Robot) -> tuple[Sole, ...]:
        """Fixed soles, in the robot's order; InputError if the robot cannot stand like this."""

    def sole_names(self, robot: Robot) -> tuple[str, ...]:
        """Names of the fixed soles."""
        return tuple(sole.name for sole in self.soles(robot))

    def sole_frames(self, robot: Robot) -> tuple[str, ...]:
        """Frames of the fixed soles."""
        return tuple(sole.frame for sole in self.soles(robot))

    def held_hands(self, robot: Robot) -> tuple[Striker, ...]:
        """Supporting hands; InputError for an unknown one."""
        return ()

    def hand_frames(self, robot: Robot) -> tuple[str, ...]:
        """Frames of the supporting hands; InputError for an unknown one."""
        return tuple(hand.model_frame for hand in self.held_hands(robot))

    def constraint_frames(self, robot: Robot) -> tuple[str, ...]:
        """Frames of the model that are fixed in all six directions: soles first, then hands."""
        return self.sole_frames(robot) + self.hand_frames(robot)

    @property
    def compliance(self) -> Array:
        """Compliance (6,) of each fixed frame in world axes, acceleration over force.

        [1/kg] in translation, [1/(kg m2)] in rotation.
        """
        return np.zeros(6)


@dataclass(frozen=True, kw_only=True)
class _OnSoles(Stance):
    """Fixed soles, and hands that support the robot; exactly, or by a virtual base.

    Attributes
    ----------
    base_mass, base_inertia : M_g [kg] and I_g [kg m2] added to each fixed sole and hand (paper, eqs. 1, 2);
        None: exact.
    hands : names of strikers with which the robot holds on to the world, in all six directions (paper,
        section II-A).

    Raises
    ------
    InputError : one of the two is missing, or is not a positive number.
    """

    base_mass: float | None = None
    base_inertia: float | None = None
    hands: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.hands, (tuple, list)) or len(set(self.hands)) != len(self.hands):
            raise InputError(f"hands: {self.hands!r}; give a tuple of strikers' names, each once")
        object.__setattr__(self, "hands", tuple(self.hands))
        if (self.base_mass is None) != (self.base_inertia is None):
            raise InputError(
                "virtual base: give both base_mass [kg] and base_inertia [kg m2], or neither (exact)"
            )
        for name, value in (("base_mass [kg]", self.base_mass), ("base_inertia [kg m2]", self.base_inertia)):
            if value is not None and not check_array(f"virtual base: {name}", value, ()) > 0:
                raise InputError(
                    f"virtual base: {name}: {value:g}; give a number > 0, or None for exactly fixed soles"
                )

    def held_hands(self, robot: Robot) -> tuple[Striker, ...]:
        return tuple(robot.striker(name) for name in self.hands)

    @property
    def compliance(self) -> Array:
        if self.base_mass is None or self.base_inertia is None:
            return np.zeros(6)
        return np.array([1.0 / self.base_mass] * 3 + [1.0 / self.base_inertia] * 3)


@dataclass(frozen=True, kw_only=True)
class BothSoles(_OnSoles):
    """All soles of the robot are fixed."""

    def soles(self, robot: Robot) -> tuple[Sole, ...]:
        _check_floating(robot)
        if not robot.soles:
            raise InputError(f"robot {robot.name!r} has no soles to stand on; give it some (Robot's soles=)")
        return tuple(robot.soles)


@dataclass(frozen=True, kw_only=True)
class OneSole(_OnSoles):
    """One sole, given by its name, is fixed; the others are free."""

    name: str = field(kw_only=False)

    def soles(self, robot: Robot) -> tuple[Sole, ...]:
        _check_floating(robot)
        return (robot.sole(self.name),)


@dataclass(frozen=True, kw_only=True)
class FixedBase(Stance):
    """Root link fixed to the ground: for robots without a free-flyer."""

    def soles(self, robot: Robot) -> tuple[Sole, ...]:
        if robot.floating:
            raise InputError(
                f"robot {robot.name!r} has a free-flyer: give stance=BothSoles() or OneSole(name), "
                "or build it with floating=False"
            )
        return ()


@dataclass(frozen=True, kw_only=True)
class Free(Stance):
    """Free-floating robot, such as one in space or in flight.

    The joints' reaction, gravity and the impact move its base.
    """

    def soles(self, robot: Robot) -> tuple[Sole, ...]:
        _check_floating(robot)
        return ()


def stance_of(robot: Robot, stance: Stance | None) -> Stance:
    """The stance; None: both soles of a robot with a free-flyer, else its fixed base.

    Raises
    ------
    InputError : no robot, or no stance.
    """
    check_kind("robot", robot, Robot)
    if stance is None:
        return BothSoles() if robot.floating else FixedBase()
    check_kind("stance", stance, Stance)
    return stance


def _check_floating(robot: Robot) -> None:
    if not robot.floating:
        raise InputError(
            f"robot {robot.name!r} has a fixed base: give stance=FixedBase(), or build it with floating=True"
        )


_ON_LINE = 1e-9  # [m] a corner nearer to a line than this lies on it


def inward_edges(polygon: Array) -> tuple[Array, Array]:
    """Inward unit normals (k, 2), offsets (k,) [m] of a counter-clockwise polygon; inside, n.p >= offset."""
    edge = np.roll(polygon, -1, axis=0) - polygon
    # A quarter turn to the left of an edge points inside, as corners are counter-clockwise.
    inward = np.stack([-edge[:, 1], edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
    return inward, np.einsum("ij,ij->i", inward, polygon)


def shrink(polygon: ArrayLike, margin: float) -> Array:
    """Convex polygon (k, 2) [m], counter-clockwise, with every edge moved inwards by ``margin`` [m].

    It may have fewer corners, as short edges can vanish. InputError if nothing is left.
    """
    p = np.array(polygon, dtype=float)
    if margin == 0.0:
        return p
    inward, offset = inward_edges(p)
    for normal, least in zip(inward, offset + margin, strict=True):
        p = _clip(p, p @ normal - least)
    if len(p) < 3:
        raise InputError(
            f"a margin of {margin:g} m leaves nothing of the sole: make it smaller than half the sole's width"
        )
    return p


def _clip(corners: Array, inside: Array) -> Array:
    """Part of a convex polygon where the signed distances ``inside`` [m] of its corners are positive."""
    out: list[Array] = []
    for k in range(len(corners)):
        # Sutherland and Hodgman's clipping, by one line.
        a, b = inside[k - 1], inside[k]
        if min(a, b) < -_ON_LINE and max(a, b) > _ON_LINE:  # the line cuts the edge that ends at corner k
            out.append(corners[k - 1] + a / (a - b) * (corners[k] - corners[k - 1]))
        if b >= -_ON_LINE:
            out.append(corners[k])
    return np.array(out) if len(out) > 2 and max(inside) > _ON_LINE else np.zeros((0, 2))


def contact_wrench_cone(polygon: ArrayLike, friction: float, *, margin: float = 0.0) -> Array:
    """Facets F (k, 6) of the contact wrench cone:  F @ (f, m) >= 0  for what the sole can transmit only.

    polygon (c, 2) : corners in the sole's frame, counter-clockwise [m].
    friction : coefficient mu of the pyramid |f_x|, |f_y| <= mu f_z along the sole's axes.
    margin : distance of the CoP from the edges [m].
    Facets are scaled so that a unit normal force at the middle gives values of order one.
    """
    if not friction > 0:
        raise InputError(f"friction must be positive, not {friction}")
    corners = np.asarray(polygon, dtype=float).tolist()
    return _facets(tuple(map(tuple, corners)), float(friction), float(margin)).copy()


@functools.lru_cache(maxsize=64)  # every node of a program needs those of the same few soles
def _facets(polygon: tuple[tuple[float, float], ...], friction: float, margin: float) -> Array:
    # rays of the cone: forces along the four edges of the friction pyramid at each corner
    rays = []
    for x, y in shrink(polygon, margin):
        for fx, fy in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            # Facets do not depend on the length of rays, so f_z = 1.
            f = np.array([friction * fx, friction * fy, 1.0])
            rays.append(np.concatenate([f, np.cross([x, y, 0.0], f)]))
    r = np.array(rays)
    # Every ray has f_z = 1, so the cone's facets are those of the 5-dimensional polytope of the other
    # components.
    size = np.maximum(np.abs(np.delete(r, 2, axis=1)).max(axis=0), _ON_LINE)
    points = np.delete(r, 2, axis=1) / size
    try:
        hull = ConvexHull(points)
    except QhullError as error:  # pragma: no cover - degenerate polygons are refused by Sole
        raise InputError(
            "the sole's polygon is degenerate: give at least three corners that span an area"
        ) from error
    # Qhull cuts a facet into simplices, which have equal equations: normal (5,) and offset, <= 0 inside
    equations = np.unique(np.round(hull.equations, 10), axis=0)
    facets = np.zeros((len(equations), 6))
    # normal . p + offset <= 0 for p = (others / size) / f_z, times -f_z: the offset
    # is the coefficient of f_z.
    facets[:, [0, 1, 3, 4, 5]] = -equations[:, :5] / size
    facets[:, 2] = -equations[:, 5]
    return facets


COLLINEAR = 1e-6  # [m] a corner nearer than this to the line of its neighbours is no corner


def corners_at(polygon: Array, placement: Any) -> Array:
    """World positions (k, 3) [m] of the corners of a sole's polygon (k, 2); ``placement``: pin.SE3."""
    flat = np.column_stack([polygon, np.zeros(len(polygon))])
    return np.asarray(flat @ placement.rotation.T + placement.translation)


def support_polygon(robot: Any, coordinates: Any) -> Array:
    """Convex hull (k, 2) [m] of the fixed soles' corners on the ground, counter-clockwise, world x and y.

    (0, 2) without soles.
    """
    standing = [leg for leg in coordinates.legs if leg.sole is not None]
    corners = [corners_at(leg.sole.polygon, leg.placement)[:, :2] for leg in standing]
    return convex_polygon(np.vstack(corners)) if corners else np.zeros((0, 2))


def convex_polygon(points: Array) -> Array:
    """Convex hull (k, 2) [m] of points (n, 2), counter-clockwise, without corners inside an edge."""
    hull = list(points[ConvexHull(points).vertices])
    k = 0
    while k < len(hull):  # by rounding a point in the middle of an edge may be a corner of the hull
        before, after = hull[k - 1], hull[(k + 1) % len(hull)]
        along, arm = (after - before) / np.linalg.norm(after - before), hull[k] - before
        # `along` is a unit vector: the cross product is the corner's distance from the line.
        if len(hull) > 3 and abs(along[0] * arm[1] - along[1] * arm[0]) < COLLINEAR:
            hull.pop(k)
        else:
            k += 1
    return np.array(hull)


def overlap(one: Array, other: Array) -> bool:
    """True if two convex polygons (k, 2) [m], counter-clockwise, overlap: no edge separates them."""
    for a, b in ((one, other), (other, one)):
        inward, offset = inward_edges(a)
        if (b @ inward.T < offset).all(axis=0).any():
            return False
    return True


def margin(polygon: Array, points: Array) -> Array:
    """Distance (n,) [m] of points (n, 2) from the polygon's nearest edge line, positive inside."""
    inward, offset = inward_edges(polygon)
    return np.asarray((points @ inward.T - offset).min(axis=1))


def zmp(wrench: Array) -> Array:
    """ZMP (n, 2) [m] on the ground z = 0 from ground wrenches (n, 6) [N, N m] about the world's origin."""
    w = np.atleast_2d(wrench)
    # Where the horizontal moment vanishes (paper, section II-B): m_x = p_y f_z and m_y = -p_x f_z on z = 0.
    return np.stack([-w[:, 4] / w[:, 2], w[:, 3] / w[:, 2]], axis=1)
