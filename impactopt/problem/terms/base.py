"""Base class of terms: name and unit, checks of parameters, and constraints."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import Field, dataclass, fields
from typing import Any, ClassVar

import numpy as np

from impactopt.bodies.world import vector
from impactopt.contact.fields import About, Described, abouts
from impactopt.errors import MOST, InputError, check_number, shortened

__all__ = ["Term", "check_known", "kind_of", "of_joints"]

_UNSAID = About(what="", least=0)  # of fields that do not say what they are


@dataclass(frozen=True, kw_only=True)
class Term(Described):
    """Base of all terms: ``name`` is what reports and messages call it, ``unit`` is that of its constraints.

    A term has :meth:`add_rows`, and :meth:`blocks` if its constraints are not linear. Most terms in
    DEFAULT_TERMS have neither: the transcription has their constraints. The metadata of fields
    (`impactopt.contact.fields.about`) describes them, and they are checked by it; numbers without metadata
    must not be negative.

    whole_motion : a strike alone is planned without this term.
    needs_torques : its constraints need the torques at the nodes as variables.
    first_instant : its constraints look at the first instant of contact, at which accelerations jump.
    of_drives : its constraints are about the joints' drives, `impactopt.Actuator`: they need the torques in
        contact as variables too.
    """

    name: ClassVar[str] = ""
    unit: ClassVar[str] = ""
    whole_motion: ClassVar[bool] = False
    needs_torques: ClassVar[bool] = False
    first_instant: ClassVar[bool] = False
    of_drives: ClassVar[bool] = False

    def blocks(self, problem: Any, coordinates: Any) -> Mapping[str, Any]:
        """Nonlinear functions that the constraints need, by name: `impactopt.problem.block.make_block`.

        problem : `impactopt.ImpactProblem`.  coordinates :
            `impactopt.kinematics.coordinates.StanceCoordinates`.
        """
        return {}

    def add_rows(self, program: Any) -> None:
        """Add the constraints to a program under construction,
        :class:`impactopt.transcription.contact_program.ContactProgram`.
        """
        raise NotImplementedError

    def __post_init__(self) -> None:
        told = {field.name: what for field, what in abouts(type(self))}
        for field in fields(self):
            self._check(field, told.get(field.name, _UNSAID))

    def _check(self, field: Field[Any], told: About) -> None:
        value, kind = getattr(self, field.name), str(field.type)
        if kind == "bool":
            if not isinstance(value, (bool, np.bool_)):
                where = f"{type(self).__name__}.{field.name}"
                raise InputError(f"{where} is {shortened(repr(value))}; give True or False")
        elif value is None and "None" in kind:
            return
        elif told.direction:
            self._keep_direction(field.name)
        elif told.by_joint and isinstance(value, Mapping):
            for number in value.values():
                self._number(field.name, number, told)
        elif isinstance(value, (int, float)) or kind.startswith("float"):
            object.__setattr__(self, field.name, self._number(field.name, value, told))

    def _number(self, name: str, value: Any, told: About) -> float:
        """A number of field ``name`` as a float; InputError if it is none, or out of its range."""
        where = f"{type(self).__name__}.{name}"
        number = check_number(where, value, finite=not told.endless)
        if MOST < abs(number) < np.inf:
            raise InputError(f"{where}: {number:g}; give a number of at most {MOST:g}")
        if told.range == ">= 0" and number < 0:
            raise InputError(f"{where} must not be negative, it is {value}")
        if not told.allows(number):
            unit = f" {told.unit}" if told.unit else ""
            raise InputError(f"{where} is {number:g}{unit}; give a number {told.range}")
        return number

    def _keep_direction(self, name: str) -> None:
        where = f"{type(self).__name__}.{name}"
        axis = vector(where, getattr(self, name))
        length = float(np.linalg.norm(axis))
        if abs(length - 1) > 1e-6:
            raise InputError(f"{where} must be a unit vector, its length is {length:.6g}")
        object.__setattr__(self, name, axis)

    def check_angle(self) -> None:
        """InputError if field ``angle`` [rad] is none between 0 and a right one."""
        value = self._number("angle", getattr(self, "angle", None), About(what=""))
        if not 0 < value < np.pi / 2:
            raise InputError(f"{type(self).__name__}.angle is {value:g} rad; give one between 0 and pi/2")

    @property
    def active(self) -> bool:
        """True unless the term is switched off, as by a field ``enabled``."""
        return bool(getattr(self, "enabled", True))

    @property
    def frames(self) -> tuple[str, ...]:
        """Frames that the robot must have."""
        return ()

    @property
    def joints(self) -> tuple[str, ...]:
        """Joints that the robot must have: those that a field by joint names."""
        given = [getattr(self, field.name) for field, told in abouts(type(self)) if told.by_joint]
        return tuple(name for value in given if isinstance(value, Mapping) for name in value)


def of_joints(limit: float | Mapping[str, float], names: Iterable[str]) -> Any:
    """A limit of all joints, or by joint, as an array (n,) in the order of ``names``; inf: it has none."""
    return np.array([limit.get(n, np.inf) if isinstance(limit, Mapping) else limit for n in names])


def kind_of(thing: object, base: type) -> type:
    """The package's own class that a term or an objective is one of; its class if it is a user's own."""
    kinds = (k for k in type(thing).__mro__ if issubclass(k, base) and k is not base)
    ours = (k for k in kinds if k.__module__.startswith("impactopt."))
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
