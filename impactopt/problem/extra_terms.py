"""Terms that only hold in a problem that gives them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from impactopt.bodies.shapes import Vector
from impactopt.errors import MOST, InputError, check_array, check_number
from impactopt.problem.terms import Term

REACH = 0.2  # [m] of a hit region: further off the replays' target has ended


@dataclass(frozen=True, kw_only=True)
class TorqueRate(Term):
    """|d torque/dt| <= ``limit`` [N m/s], from node to node of swing and follow-through.

    limit : of all joints, or by joint; those that are not named have none.
    """

    name: ClassVar[str] = "torque rate"
    unit: ClassVar[str] = "of limit"
    whole_motion: ClassVar[bool] = True
    needs_torques: ClassVar[bool] = True
    limit: float | Mapping[str, float]

    def __post_init__(self) -> None:
        limits = self.limit.values() if isinstance(self.limit, Mapping) else (self.limit,)
        for value in limits:
            if not check_number("TorqueRate.limit [N m/s]", value, most=MOST) > 0:
                raise InputError(f"TorqueRate.limit is {value:g} N m/s; give a number > 0")

    @property
    def joints(self) -> tuple[str, ...]:
        return tuple(self.limit) if isinstance(self.limit, Mapping) else ()


@dataclass(frozen=True, kw_only=True)
class HandOrientation(Term):
    """``axis`` of the striker's frame is within ``angle`` [rad] of ``direction`` (world) at contact.

    direction None: the problem's normal. Unit vectors.
    """

    name: ClassVar[str] = "hand orientation"
    unit: ClassVar[str] = "rad"
    axis: Vector
    direction: Vector | None = None
    angle: float = 0.2

    def __post_init__(self) -> None:
        self.check_angle()
        self.make_axis("axis")
        if self.direction is not None:
            self.make_axis("direction")


@dataclass(frozen=True, kw_only=True)
class Gaze(Term):
    """``axis`` (unit) of ``frame`` looks from its origin at the problem's point within ``angle`` [rad].

    At the nodes of the swing from its fraction ``since`` on, and at contact.
    """

    name: ClassVar[str] = "gaze"
    unit: ClassVar[str] = "rad"
    frame: str
    axis: Vector
    angle: float = 0.5
    since: float = 0.5

    def __post_init__(self) -> None:
        self.check_angle()
        self.make_axis("axis")
        if not 0 <= self.keep_number("since") <= 1:
            raise InputError(f"Gaze.since is {self.since:g}; give a fraction of the swing, from 0 to 1")

    @property
    def frames(self) -> tuple[str, ...]:
        return (self.frame,)


@dataclass(frozen=True, kw_only=True)
class HitRegion(Term):
    """The hit point is anywhere in a region about the problem's point, in the plane of the normal.

    A disc of ``radius`` [m], or a rectangle of ``size`` (across, up) [m]: see
    :func:`impactopt.bodies.shapes.face_axes`. It reaches no further than 0.2 m, where the replays' target
    ends.
    """

    name: ClassVar[str] = "hit region"
    unit: ClassVar[str] = "m"
    radius: float | None = None
    size: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if (self.radius is None) == (self.size is None):
            raise InputError("HitRegion: give either radius, of a disc, or size, of a rectangle [m]")
        given: Any = self.size if self.radius is None else [check_number("HitRegion.radius [m]", self.radius)]
        lengths = check_array("HitRegion [m]", given, (None,))
        reach = float(lengths.sum()) if self.size is None else float(np.linalg.norm(lengths)) / 2
        if len(lengths) != (1 if self.size is None else 2) or not (lengths > 0).all() or reach > REACH:
            raise InputError(
                f"HitRegion of {lengths.tolist()} m: give lengths > 0 that reach no further than {REACH} m "
                "from the point"
            )
        if self.size is not None:
            object.__setattr__(self, "size", (float(lengths[0]), float(lengths[1])))


@dataclass(frozen=True, kw_only=True)
class HitCone(Term):
    """The striking point's velocity at contact is within ``angle`` [rad] of the normal.

    In place of :class:`Incidence`.
    """

    name: ClassVar[str] = "hit cone"
    unit: ClassVar[str] = "m/s"
    angle: float = 0.1

    def __post_init__(self) -> None:
        self.check_angle()
