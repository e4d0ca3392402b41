"""Soles, strikers and tools, which touch the world; `Source`, the origin of a robot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from impactopt.arrays import Array
from impactopt.errors import FARTHEST, InputError, check_array, check_positive, raw_array
from impactopt.robots import checks
from impactopt.robots.checks import HEAVIEST

MAX_HINGE_RANGE = 0.5  # [rad]


@dataclass(frozen=True, kw_only=True, eq=False)
class Sole:
    """A flat, convex sole.

    Attributes
    ----------
    name : its name in problems and messages.
    frame : frame of the model at the sole: z up out of the ground, x forward.
    polygon : (k, 2) corners [m] in the x-y plane of the frame, counter-clockwise seen from above, convex.
    parent, placement : for a model without that frame, which is then added at `placement` (pin.SE3) in the
        frame `parent`.
    hinge : axis of the frame, "x", "y" or "z", about which the foot turns on the sole: for legs of five
        joints. It is a passive joint ``<name>_hinge``, so that the sole transmits no moment about this axis.
    hinge_range [rad] : largest angle of the hinge in a plan, in both directions.
    """

    name: str
    frame: str
    polygon: Array
    parent: str | None = None
    placement: Any = None
    hinge: str | None = None
    hinge_range: float = 0.005

    def __post_init__(self) -> None:
        polygon = check_array(f"sole {self.name!r}: polygon [m]", self.polygon, (None, 2), most=FARTHEST)
        checks.check_polygon(self.name, polygon)
        object.__setattr__(self, "polygon", read_only(polygon))
        if (self.parent is None) != (self.placement is None):
            raise InputError(f"sole {self.name!r}: give parent and placement together, or neither")
        if self.placement is not None:
            check_array(f"sole {self.name!r}: placement [m]", self.placement.translation, (3,), most=FARTHEST)
        if self.hinge not in (None, "x", "y", "z"):
            raise InputError(f'sole {self.name!r}: hinge is {self.hinge!r}; give "x", "y" or "z", or None')
        hinge_range = check_array(f"sole {self.name!r}: hinge_range [rad]", self.hinge_range, ())
        if not 0 < hinge_range <= MAX_HINGE_RANGE:
            raise InputError(
                f"sole {self.name!r}: hinge_range is {self.hinge_range:g} rad; give a number > 0, at most "
                f"{MAX_HINGE_RANGE:g}"
            )

    @property
    def hinge_joint(self) -> str:
        """Name of the hinge's joint."""
        return f"{self.name}_hinge"

    @classmethod
    def box(
        cls,
        *,
        name: str,
        frame: str,
        length: float,
        width: float,
        center: ArrayLike = (0.0, 0.0),
        **kwargs: Any,
    ) -> Sole:
        """A rectangle, `length` [m] along x and `width` [m] along y, about `center` (2,) [m]."""
        half = np.array([length, width]) / 2
        corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * half + np.asarray(center)
        return cls(name=name, frame=frame, polygon=corners, **kwargs)


@dataclass(frozen=True, kw_only=True, eq=False)
class Striker:
    """The striking point: `point` (3,) [m] in the model's frame `frame`."""

    name: str
    frame: str
    point: Array

    def __post_init__(self) -> None:
        point = check_array(f"striker {self.name!r}: point [m]", self.point, (3,), most=FARTHEST)
        object.__setattr__(self, "point", read_only(point))

    @property
    def model_frame(self) -> str:
        """Name of the frame at this point in the robot's model."""
        return f"striker:{self.name}"


@dataclass(frozen=True, kw_only=True, eq=False)
class SoftGrip:
    """A compliant grip: a spring and a damper about one axis between hand and tool, as of a loose grip.

    It is a passive joint. An impact on the tool reaches the hand through the spring and the damper alone.
    The spring carries the tool's weight in the start posture.

    Attributes
    ----------
    axis (3,), point (3,) [m] : axis of rotation, a unit vector, and a point on it, in the tool's `frame`.
    stiffness [N m/rad], damping [N m s/rad].
    range [rad] : largest angle of the tool, in both directions.

    Raises
    ------
    InputError : an axis that is no unit vector; numbers that are not positive.
    """

    axis: Array
    stiffness: float
    damping: float
    point: Array = field(default_factory=lambda: np.zeros(3))
    range: float = 1.0

    def __post_init__(self) -> None:
        axis = check_array("soft grip: axis", self.axis, (3,))
        if not np.isclose(np.linalg.norm(axis), 1.0, rtol=0, atol=1e-6):
            raise InputError(f"soft grip: the axis {axis} is no unit vector; divide it by its length")
        object.__setattr__(self, "axis", read_only(axis / np.linalg.norm(axis)))
        point = check_array("soft grip: point [m]", self.point, (3,), most=FARTHEST)
        object.__setattr__(self, "point", read_only(point))
        for name, unit in (("stiffness", "N m/rad"), ("damping", "N m s/rad"), ("range", "rad")):
            number = check_positive(f"soft grip: {name} [{unit}]", getattr(self, name), most=HEAVIEST)
            object.__setattr__(self, name, number)

    @property
    def placement(self) -> Any:
        """pin.SE3 of the joint in the tool's frame; its axis is z."""
        turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), np.array(self.axis))
        return pin.SE3(turn.matrix(), np.array(self.point))


@dataclass(frozen=True, kw_only=True, eq=False)
class Tool:
    """A rigid body attached to a link, with a striking point. Vectors are in the model's frame `frame`.

    Attributes
    ----------
    name : of the tool, and of its striker.
    frame : frame of the model at the link that holds it.
    mass [kg], center (3,) [m] : mass and centre of mass.
    inertia (3, 3) [kg m2] : about the centre of mass, along the axes of `frame`; or (3,), its diagonal.
    head (3,) [m] : the striking point.
    bar (3,) [m] : of a hammer, from the back of the bar to its striking face, where `head` is; None: the tool
        is a rod to `head`.  bar_width [m] : side of the bar's square section.
    grip : a compliant grip; None: the link holds the tool rigidly. It adds the joint ``<name>_grip`` and the
        frame ``tool:<name>``, which coincides with `frame` at the spring's angle zero.

    Raises
    ------
    InputError : a mass that is not positive, an inertia that is not symmetric or negative. `Robot.with_tool`
        checks whether tool and link together have a physical inertia.
    """

    name: str
    frame: str
    mass: float
    center: Array
    inertia: Array
    head: Array
    bar: Array | None = None
    bar_width: float = 0.03
    grip: SoftGrip | None = None

    def __post_init__(self) -> None:
        what = f"tool {self.name!r}"
        check_positive(f"{what}: mass [kg]", self.mass, most=HEAVIEST)
        inertia = raw_array(f"{what}: inertia [kg m2]", self.inertia)
        inertia = check_array(
            f"{what}: inertia [kg m2]",
            np.diag(inertia) if inertia.shape == (3,) else inertia,
            (3, 3),
            most=HEAVIEST,
        )
        if not np.allclose(inertia, inertia.T, rtol=0, atol=1e-12):
            raise InputError(f"{what}: its inertia is not symmetric; give the same number on both sides")
        least = float(np.linalg.eigvalsh(inertia)[0])
        if least < 0:
            raise InputError(
                f"{what}: its inertia has the principal moment {least:.3g} kg m2; give moments >= 0"
            )
        object.__setattr__(self, "inertia", read_only(inertia))
        for part in ("center", "head"):
            point = check_array(f"{what}: {part} [m]", getattr(self, part), (3,), most=FARTHEST)
            object.__setattr__(self, part, read_only(point))
        if self.bar is not None:
            bar = check_array(f"{what}: bar [m]", self.bar, (3,), most=FARTHEST)
            if not np.linalg.norm(bar) > 0:
                raise InputError(f"{what}: its bar has no length; leave it out for a rod")
            object.__setattr__(self, "bar", read_only(bar))
        check_positive(f"{what}: bar_width [m]", self.bar_width, most=FARTHEST)

    @classmethod
    def hammer(
        cls,
        *,
        frame: str,
        name: str = "hammer",
        grip: ArrayLike = (0.0, 0.0, 0.0),
        handle: ArrayLike = (0.0, 0.0, 1.0),
        face: ArrayLike = (1.0, 0.0, 0.0),
        length: float = 0.25,
        handle_mass: float = 0.15,
        head_mass: float = 0.5,
        head_length: float = 0.1,
        head_width: float = 0.03,
    ) -> Tool:
        """A thin rod with a square bar across its end, one end face of which strikes.

        grip (3,) [m] : beginning of the rod.  handle, face : directions of the rod and of the striking face's
        normal, perpendicular unit vectors.  length, head_length, head_width [m]; masses [kg].
        """
        rod = check_array("hammer: handle", handle, (3,))
        bar = check_array("hammer: face", face, (3,))
        if not np.allclose([rod @ rod, bar @ bar, rod @ bar], [1, 1, 0], rtol=0, atol=1e-9):
            raise InputError(f"hammer: handle {rod} and face {bar} are no unit vectors at right angles")
        along, across = np.outer(rod, rod), np.outer(bar, bar)
        start = check_array("hammer: grip [m]", grip, (3,))
        end = start + length * rod
        # mass, centre of mass, and inertia about it per mass: of a thin rod, and of a solid box
        parts = (
            (handle_mass, start + length / 2 * rod, length**2 / 12 * (np.eye(3) - along)),
            (
                head_mass,
                end,
                head_length**2 / 12 * (np.eye(3) - across) + head_width**2 / 12 * (np.eye(3) + across),
            ),
        )
        whole = sum((pin.Inertia(m, at, m * gyration) for m, at, gyration in parts), pin.Inertia.Zero())
        return cls(
            name=name,
            frame=frame,
            mass=float(whole.mass),
            center=np.array(whole.lever),
            inertia=np.array(whole.inertia),
            head=end + head_length / 2 * bar,
            bar=head_length * bar,
            bar_width=head_width,
        )

    @property
    def striker(self) -> Striker:
        """Striker at the tool's striking point."""
        return Striker(name=self.name, frame=self.own_frame, point=self.head)

    @property
    def own_frame(self) -> str:
        """Name of the frame that moves with the tool."""
        return self.frame if self.grip is None else f"tool:{self.name}"

    @property
    def grip_joint(self) -> str:
        """Name of a soft grip's joint."""
        return f"{self.name}_grip"


@dataclass(frozen=True, kw_only=True, eq=False)
class Source:
    """Origin of a robot, from which a problem file can rebuild it.

    Attributes
    ----------
    preset : name of one, or None.
    urdf, mjcf : path of a URDF or an MJCF, or None.
    options : keyword arguments given to the preset, to `Robot.from_urdf` or to `Robot.from_mjcf`.
    tools : tools added after that.
    repairs : messages about inertias that were changed.
    notes : messages about features of the file that were left out or interpreted differently.
    """

    preset: str | None = None
    urdf: str | None = None
    mjcf: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    tools: tuple[Tool, ...] = ()
    repairs: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def read_only(array: ArrayLike) -> Array:
    """A float64 copy that cannot be written to."""
    copy = np.array(array, dtype=np.float64)
    copy.flags.writeable = False
    return copy
