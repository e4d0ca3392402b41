"""Parameters of a problem by name, and problems with changed ones, for re-planning and sensitivities."""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from impactopt.contact.fields import snake_case
from impactopt.errors import InputError, check_array, check_choice, check_number
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import DEFAULT_TERMS, TERMS, ContactWrenchCone, Term

# Cached properties of a problem that stay valid with the same robot, stance and start; and those that also
# need the same terms, or other ones that do not switch the bodies of the world on or off.
_CACHED = ("stance_coordinates", "start_posture")
_CACHED_BODIES = ("world", "bodies")


def changed(problem: ImpactProblem, **fields: Any) -> ImpactProblem:
    """`dataclasses.replace` with the cached properties that stay valid.

    Robot, stance, start and `near_contact` have to be the same. The posture at contact is searched from the
    old one.
    """
    # `dataclasses.replace` would lose the cached properties, bodies and coordinates among them.
    new = object.__new__(type(problem))
    new.__dict__.update({f.name: getattr(problem, f.name) for f in dataclasses.fields(problem)} | fields)
    # set before the checks (`__post_init__`), which use the cached properties
    same_bodies = fields.keys() <= {"terms"} and new.keep_out.enabled == problem.keep_out.enabled
    cached = (*_CACHED, *_CACHED_BODIES) if same_bodies else _CACHED
    new.__dict__.update({name: problem.__dict__[name] for name in cached if name in problem.__dict__})
    if "contact_posture" in problem.__dict__:
        # From the old posture the search ends in the nearest one, so a small change of
        # the point changes it little.
        with contextlib.suppress(InputError):  # then the checks search from the start posture
            aim = {name: check_array(name, getattr(new, name), (3,)) for name in ("point", "normal")}
            new.__dict__.update(aim)
            same = new.second is problem.second and all(
                np.array_equal(value, getattr(problem, name)) for name, value in aim.items()
            )
            near = problem.contact_posture
            new.__dict__["contact_posture"] = near if same else new.contact_posture_near(near)
    new.__post_init__()
    return new


def moved_problem(
    problem: ImpactProblem,
    *,
    point: ArrayLike | None = None,
    normal: ArrayLike | None = None,
    mass: float | None = None,
    stiffness: float | None = None,
    damping: float | None = None,
    margin: float | None = None,
) -> ImpactProblem:
    """Problem with another hit point [m], normal, mass of the target [kg], stiffness or damping of the
    contact (in the law's units), or margin of the soles' centres of pressure [m], during contact too.

    Raises
    ------
    InputError : nothing is changed; target or law do not have the parameter; a value that is not allowed.
    """
    new: dict[str, Any] = {}
    for name, vector in (("point", point), ("normal", normal)):
        if vector is not None:
            new[name] = check_array(f"moved: {name}", vector, (3,))
    if mass is not None:
        new["target"] = with_parameter(problem.target, "mass", mass)
    law = problem.law
    for name, value in (("stiffness", stiffness), ("damping", damping)):
        if value is not None:
            law = new["law"] = with_parameter(law, name, value)
    if margin is not None:
        cone = problem.term(ContactWrenchCone)
        both = {"margin": margin} | ({} if cone.collision_margin is None else {"collision_margin": margin})
        new["terms"] = with_term(problem, dataclasses.replace(cone, **both))
    if not new:
        raise InputError("nothing is moved: give point, normal, mass, stiffness, damping or margin")
    return changed(problem, **new)


MOVABLE = tuple(inspect.signature(moved_problem).parameters)[1:]


def with_parameter(thing: Any, name: str, value: float) -> Any:
    """Law or target with another value of a parameter; InputError if it has no such parameter."""
    # not by dataclasses.replace: a CustomLaw is no dataclass
    numbers = thing.parameters
    check_choice(f"{type(thing).__name__} has no parameter", name, numbers)
    return type(thing)(**{**numbers, name: value})


def with_term(problem: ImpactProblem, term: Term) -> tuple[Term, ...]:
    # A problem has one term of a kind.
    others = [other for other in problem.terms if type(other) is not type(term)]
    return (*others, term)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Parameter:
    """Parameter of a problem, by its name.

    typical : magnitude of it, for difference steps.
    """

    name: str
    problem: ImpactProblem
    value: float
    _field: str
    _part: Any

    @property
    def typical(self) -> float:
        return max(abs(self.value), 1e-2)

    def at(self, value: float) -> ImpactProblem:
        """Problem with another value of the parameter."""
        if self._field == "point":
            point = np.array(self.problem.point, dtype=float)
            point["xyz".index(self._part)] = value
            return changed(self.problem, point=point)
        if self._field == "terms":
            kind, name = self._part
            term = dataclasses.replace(self.problem.term(kind), **{name: value})
            return changed(self.problem, terms=with_term(self.problem, term))
        part = getattr(self.problem, self._field)
        return changed(self.problem, **{self._field: with_parameter(part, self._part, value)})


def parameter_of(problem: ImpactProblem, name: str) -> Parameter:
    """Parameter of a name: ``target.mass``, ``contact.stiffness``, ``point.x``, or of a term of the problem,
    such as ``terms.contact_wrench_cone.margin``. Names are those of problem files, without units.

    Raises
    ------
    InputError : there is no such parameter.
    """
    known: dict[str, tuple[str, Any, float]] = {
        f"point.{axis}": ("point", axis, float(problem.point[k])) for k, axis in enumerate("xyz")
    }
    for section, field in (("target", "target"), ("contact", "law")):
        numbers = getattr(problem, field).parameters
        known |= {f"{section}.{key}": (field, key, float(value)) for key, value in numbers.items()}
    # Terms that hold by default have parameters, too.
    others = [term for term in DEFAULT_TERMS if not any(isinstance(t, type(term)) for t in problem.terms)]
    for term in (*problem.terms, *others):
        section, kind = term.section, type(term)
        for parameter in dataclasses.fields(term):
            value = getattr(term, parameter.name)
            if isinstance(value, float) and np.isfinite(value):
                known[f"terms.{section}.{parameter.name}"] = ("terms", (kind, parameter.name), value)
    sections = {f"terms.{snake_case(kind.__name__)}": kind for kind in TERMS}
    section, _, key = str(name).rpartition(".")
    if name not in known and key in getattr(sections.get(section), "__dataclass_fields__", ()):
        raise InputError(f"{name}: the problem has no number for it; give {sections[section].__name__} one")
    check_choice("this problem has no parameter", name, known)
    field, part, value = known[name]
    return Parameter(
        name=name, problem=problem, value=check_number(name, value), _field=str(field), _part=part
    )
