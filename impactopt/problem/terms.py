"""What a plan must respect, as named terms with units.  A problem holds one of each kind at most.

These hold in every problem; those in :mod:`impactopt.problem.extra_terms` only where they are given.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np

from impactopt.bodies.shapes import vector
from impactopt.errors import MOST, InputError, check_number, shortened


@dataclass(frozen=True, kw_only=True)
class Term:
    """Base of all terms: ``name`` is what reports and messages call it, ``unit`` is that of its rows.

    One of a user's own has :meth:`add_rows`, and :meth:`blocks` if its rows are not linear.

    whole_motion : it says nothing of a strike alone, which is planned without it.
    needs_torques : its rows take the torques at the nodes, which are variables then.
    endless : fields that may be infinite, where anything is allowed.
    """

    name: ClassVar[str] = ""
    unit: ClassVar[str] = ""
    whole_motion: ClassVar[bool] = False
    needs_torques: ClassVar[bool] = False
    endless: ClassVar[tuple[str, ...]] = ()

    def blocks(self, problem: Any, coordinates: Any) -> Mapping[str, Any]:
        """Nonlinear functions that the rows need, by name.

        See :func:`impactopt.transcription.blocks.make_block`.
        """
        return {}

    def add_rows(self, program: Any) -> None:
        """Add the rows to a program under construction,
        :class:`impactopt.transcription.at_contact.ContactProgram`.

        The package's own terms have theirs there.
        """
        raise NotImplementedError

    def __post_init__(self) -> None:
        for f in fields(self):
            value, kind = getattr(self, f.name), str(f.type)
            number = isinstance(value, (int, float)) or kind in ("float", "float | None")
            if kind == "bool" or not number or (value is None and "None" in kind):
                if kind == "bool" and not isinstance(value, (bool, np.bool_)):
                    told = f"{type(self).__name__}.{f.name} is {shortened(repr(value))}"
                    raise InputError(f"{told}; give True or False")
                continue
            if not self.keep_number(f.name) >= 0:
                raise InputError(f"{type(self).__name__}.{f.name} must not be negative, it is {value}")

    def keep_number(self, name: str) -> float:
        """Field ``name`` as a float, which it is kept as; InputError if it is none, or larger than any."""
        what, value = f"{type(self).__name__}.{name}", getattr(self, name)
        number = check_number(what, value, finite=name not in self.endless)
        if MOST < abs(number) < np.inf:
            raise InputError(f"{what}: {number:g}; give a number of at most {MOST:g}")
        object.__setattr__(self, name, number)
        return number

    def check_fractions(self, *names: str) -> None:
        """InputError if one of these fields is no fraction, above 0 and at most 1."""
        for name in names:
            value = self.keep_number(name)
            if not 0 < value <= 1:
                raise InputError(f"{type(self).__name__}.{name} is {value:g}; give a fraction > 0 and <= 1")

    @property
    def frames(self) -> tuple[str, ...]:
        """Frames that the robot must have."""
        return ()

    @property
    def joints(self) -> tuple[str, ...]:
        """Joints that the robot must have."""
        return ()

    def check_angle(self) -> None:
        """InputError if field ``angle`` [rad] is none between 0 and a right one."""
        value = self.keep_number("angle")
        if not 0 < value < np.pi / 2:
            raise InputError(f"{type(self).__name__}.angle is {value:g} rad; give one between 0 and pi/2")

    def make_axis(self, name: str) -> None:
        """Keep field ``name`` as a unit vector; InputError if it is none."""
        axis = vector(f"{type(self).__name__}.{name}", getattr(self, name))
        length = float(np.linalg.norm(axis))
        if abs(length - 1) > 1e-6:
            raise InputError(
                f"{type(self).__name__}.{name} must be a unit vector, its length is {length:.6g}"
            )
        object.__setattr__(self, name, axis)


@dataclass(frozen=True, kw_only=True)
class TorqueLimit(Term):
    """|torque| <= fraction x the joint's limit: headroom for the servo.

    ``collision`` : the fraction while in contact.
    """

    name: ClassVar[str] = "torque limit"
    unit: ClassVar[str] = "of limit"
    fraction: float = 0.85
    collision: float = 0.85

    def __post_init__(self) -> None:
        self.check_fractions("fraction", "collision")


@dataclass(frozen=True, kw_only=True)
class VelocityLimit(Term):
    """|joint velocity| <= fraction x limit, everywhere.

    On the spline's velocity control points; the legs at the nodes.
    """

    name: ClassVar[str] = "velocity limit"
    unit: ClassVar[str] = "of limit"
    fraction: float = 0.95

    def __post_init__(self) -> None:
        self.check_fractions("fraction")


@dataclass(frozen=True, kw_only=True)
class PositionLimit(Term):
    """Joint positions stay ``margin`` [rad] inside their limits, everywhere.

    On the spline's control points; the legs at the nodes.
    """

    name: ClassVar[str] = "position limit"
    unit: ClassVar[str] = "rad"
    margin: float = 0.02


@dataclass(frozen=True, kw_only=True)
class ContactWrenchCone(Term):
    """Each sole's wrench lies in the cone of its corners: CoP, friction and torsion together.

    Source: Caron et al. 2015, see :mod:`impactopt.kinematics.wrench_cone`.

    friction: coefficient that the plan may use; margin [m]: distance of the CoP from the sole's edges;
    collision_margin [m]: the same while in contact with the target, None: the ground may do then what it
    cannot, pull too, to compare; minimum_force [N] a sole. There are no terms for friction or the centre of
    pressure alone: this cone bounds them foot by foot, and yaw torsion with them, which shrinks where they
    are used up.
    """

    name: ClassVar[str] = "contact wrench cone"
    unit: ClassVar[str] = "of weight"
    friction: float = 0.6
    margin: float = 0.02
    collision_margin: float | None = 0.02
    minimum_force: float = 50.0


@dataclass(frozen=True, kw_only=True)
class Balance(Term):
    """What may be left after the impact.

    capture_margin [m]: distance of the capture point from the support polygon's edges, None: anywhere;
    vertical_speed [m/s] of the centre of mass; angular_momentum [N m s] about each axis through the centre of
    mass; inf: any.
    """

    name: ClassVar[str] = "balance after impact"
    unit: ClassVar[str] = "m, m/s, N m s"
    endless: ClassVar[tuple[str, ...]] = ("vertical_speed", "angular_momentum")
    capture_margin: float | None = 0.02
    vertical_speed: float = 0.2
    angular_momentum: float = 10.0

    def __post_init__(self) -> None:
        if isinstance(self.capture_margin, float) and self.capture_margin == np.inf:
            raise InputError("Balance.capture_margin is inf, which nothing can keep; give None for anywhere")
        super().__post_init__()


@dataclass(frozen=True, kw_only=True)
class Incidence(Term):
    """The striking point's speed across the normal at contact is at most ``speed`` [m/s].

    Along each of two tangents; inf: any, the direction is free. :class:`HitCone` takes its place.
    """

    name: ClassVar[str] = "incidence"
    unit: ClassVar[str] = "m/s"
    endless: ClassVar[tuple[str, ...]] = ("speed",)
    speed: float = 0.05


@dataclass(frozen=True, kw_only=True)
class LegExtension(Term):
    """Held legs stay away from the singularity of a straight knee, at the nodes of swing and follow-through.

    minimum: determinant of the leg's Jacobian (joints to sole) over its value in the start posture, at least.
    Near a straight knee the joint rates that hold the sole grow without bound, and a few millimetres between
    two nodes are more than the leg has left: at 0.35 TALOS has 7 mm.
    """

    name: ClassVar[str] = "leg extension"
    unit: ClassVar[str] = "of start"
    minimum: float = 0.35

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.minimum <= 1:
            raise InputError(f"LegExtension.minimum is {self.minimum:g}; give a fraction from 0 to 1")


@dataclass(frozen=True, kw_only=True)
class SelfCollision(Term):
    """No two links of the robot come nearer than ``margin`` [m], from start to rest, after a miss too.

    Links that a joint connects are left out, and those that touch in the start posture. Where two are nearer
    than that at the start, they may stay as near.  enabled : False lets links pass through each other.
    """

    name: ClassVar[str] = "self-collision"
    unit: ClassVar[str] = "m"
    margin: float = 0.01
    enabled: bool = True


@dataclass(frozen=True, kw_only=True)
class KeepOut(Term):
    """No link comes nearer than ``margin`` [m] to the target, to the ground and to obstacles.

    The link that strikes may touch the target, from the side that it strikes; held soles stand on the ground.
    enabled : False lets the robot pass through them.
    """

    name: ClassVar[str] = "keep out"
    unit: ClassVar[str] = "m"
    margin: float = 0.01
    enabled: bool = True


DEFAULT_TERMS: tuple[Term, ...] = (
    TorqueLimit(),
    VelocityLimit(),
    PositionLimit(),
    ContactWrenchCone(),
    Balance(),
    Incidence(),
    LegExtension(),
    SelfCollision(),
    KeepOut(),
)


def kind_of(thing: object, base: type) -> type:
    """The package's own class that a term or an objective is one of; its class if it is a user's own."""
    ours = (k for k in type(thing).__mro__ if k is not base and k.__module__.startswith("impactopt."))
    return next(ours, type(thing))


def check_known(things: Iterable[Any], base: type, method: str) -> None:
    """InputError for terms or objectives of a user's own that a program would know nothing of.

    base : Term or Objective; method : what one of a user's own has to have.
    """
    for thing in things:
        kind = type(thing)
        ours = kind_of(thing, base).__module__.startswith("impactopt.")
        if kind is base or not (ours or getattr(kind, method) is not getattr(base, method)):
            raise InputError(
                f"{kind.__name__} has no {method}(program), without which a plan would know nothing of it: "
                'give it one, as "Extending" in the documentation shows (docs/extending.md)'
            )
        if not thing.name:
            raise InputError(f"{kind.__name__}.name is empty; give what reports and messages call it")
