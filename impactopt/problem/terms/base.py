"""Base class of terms: name and unit, checks of parameters, and constraints."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import Field, dataclass, fields
from typing import Any, ClassVar

import numpy as np

from impactopt.bodies.world import vector
from impactopt.contact.fields import About, Described, abouts, snake_case
from impactopt.errors import MOST, InputError, check_number, named_table, shortened

_NO_METADATA = About(what="", least=0)  # of fields without metadata


@dataclass(frozen=True, kw_only=True)
class Term(Described):
    """Base of all terms. ``name`` stands in reports and messages; ``unit`` is that of the constraints.

    A term has :meth:`add_constraints`, and :meth:`blocks` if its constraints are not linear. Most terms in
    DEFAULT_TERMS have neither, as the transcription adds their constraints. The metadata of fields
    (`impactopt.contact.fields.about`) describes them, and their values are checked by it; numbers without
    metadata must not be negative.

    whole_motion : a strike alone is planned without this term.
    needs_torques : the constraints need the torques at the nodes as variables.
    first_instant : there are constraints at the first instant of contact, at which accelerations jump.
    of_drives : the constraints are on the joints' drives, `impactopt.Actuator`: they need the torques during
        contact as variables, too.
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

    def add_constraints(self, program: Any) -> None:
        """Add the constraints to a program under construction,
        :class:`impactopt.transcription.contact_program.ContactProgram`.
        """
        raise NotImplementedError

    def __post_init__(self) -> None:
        metadata = {field.name: about for field, about in abouts(type(self))}
        for field in fields(self):
            self._check(field, metadata.get(field.name, _NO_METADATA))

    def _check(self, field: Field[Any], about: About) -> None:
        """Check a field's value, and replace numbers by floats; fields of other types are not checked."""
        value = named_table(getattr(self, field.name)) if about.by_joint else getattr(self, field.name)
        # a class, unless annotations are text, as with `from __future__ import annotations`
        kind = field.type.__name__ if isinstance(field.type, type) else str(field.type)
        if kind == "bool":
            if not isinstance(value, (bool, np.bool_)):
                where = f"{type(self).__name__}.{field.name}"
                raise InputError(f"{where} is {shortened(repr(value))}; give True or False")
        elif value is None and "None" in kind:
            return
        elif about.direction:
            self._keep_direction(field.name)
        elif about.by_joint and isinstance(value, Mapping):
            if not value:
                where = f"{type(self).__name__}.{field.name}"
                raise InputError(f"{where} names no joint, and would bound none; give a limit for one")
            # a copy, as the caller may change the table later, and the term is frozen
            table = {name: self._number(field.name, number, about) for name, number in value.items()}
            object.__setattr__(self, field.name, table)
        elif isinstance(value, (int, float)) or kind.startswith("float"):
            object.__setattr__(self, field.name, self._number(field.name, value, about))

    def _number(self, name: str, value: Any, about: About) -> float:
        """Number of field ``name`` as a float; InputError if it is not a number, or out of its range."""
        where = f"{type(self).__name__}.{name}"
        number = check_number(where, value, finite=not about.endless)
        if MOST < abs(number) < np.inf:
            raise InputError(f"{where}: {number:g}; give a number of at most {MOST:g}")
        if about.range == ">= 0" and number < 0:
            raise InputError(f"{where} must not be negative, it is {value}")
        if not about.allows(number):
            unit = f" {about.unit}" if about.unit else ""
            raise InputError(f"{where} is {number:g}{unit}; give a number {about.range}")
        return number

    def _keep_direction(self, name: str) -> None:
        """Replace the field by an array; InputError if it is not a unit vector."""
        where = f"{type(self).__name__}.{name}"
        axis = vector(where, getattr(self, name))
        length = float(np.linalg.norm(axis))
        if abs(length - 1) > 1e-6:
            raise InputError(f"{where} must be a unit vector, its length is {length:.6g}")
        object.__setattr__(self, name, axis)

    def check_angle(self) -> None:
        """InputError if field ``angle`` [rad] is not between 0 and pi/2."""
        value = self._number("angle", getattr(self, "angle", None), About(what=""))
        if not 0 < value < np.pi / 2:
            raise InputError(f"{type(self).__name__}.angle is {value:g} rad; give one between 0 and pi/2")

    @property
    def section(self) -> str:
        """Name of the term in problem files, such as ``torque_limit``."""
        return snake_case(type(self).__name__)

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
        """Joints that the robot must have: the keys of fields with values by joint."""
        given = [getattr(self, field.name) for field, about in abouts(type(self)) if about.by_joint]
        return tuple(name for value in given if isinstance(value, Mapping) for name in value)


def bound_at_each(
    program: Any,
    term: Term,
    block: str,
    spots: Sequence[tuple[Any, Any]],
    components: Sequence[str],
    parameters: Any = (),
    **bounds: Any,
) -> None:
    """Add a block with an instance at each spot, and a term's bounds on the outputs of each instance.

    spots : places and slots.  components : names of an instance's outputs.  bounds : arguments of
    `impactopt.transcription.layout.Constraints.add`, such as ``lower``, ``upper`` and ``measure``.
    """
    at = program.add_block(block, [slots for _, slots in spots], np.asarray(parameters, dtype=float))
    outputs = at + np.arange(len(spots) * len(components)).reshape(len(spots), len(components))
    for (place, _), own in zip(spots, outputs, strict=True):
        program.constraints.add(term=term.name, place=place, components=components, outputs=own, **bounds)


def of_joints(limit: float | Mapping[str, float], names: Iterable[str]) -> Any:
    """Limit of all joints, or by joint, as an array (n,) in the order of ``names``; inf without a limit."""
    return np.array([limit.get(n, np.inf) if isinstance(limit, Mapping) else limit for n in names])


def kind_of(thing: object, base: type) -> type:
    """First class of this package in the bases of a term or an objective; its own class if there is none."""
    kinds = (k for k in type(thing).__mro__ if issubclass(k, base) and k is not base)
    ours = (k for k in kinds if k.__module__.startswith("impactopt."))
    return next(ours, type(thing))


def check_known(things: Iterable[Any], base: type, method: str) -> None:
    """InputError for a user's own terms or objectives that would not change a program.

    base : Term or Objective.  method : name of the method that a user's own class must have.
    """
    for thing in things:
        kind = type(thing)
        ours = kind_of(thing, base).__module__.startswith("impactopt.")
        if kind is base or not (ours or getattr(kind, method) is not getattr(base, method)):
            raise InputError(
                f"{kind.__name__} has no {method}(program), without which a plan ignores it: give it one, as "
                '"Extending" in the documentation shows (docs/extending.md)'
            )
        if not thing.name:
            raise InputError(f"{kind.__name__}.name is empty; give a name for reports and messages")
