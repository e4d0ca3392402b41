"""A problem with other parameters: those that a plan can be bent for."""

from __future__ import annotations

import contextlib
import dataclasses
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from impactopt.contact.fields import snake_case
from impactopt.errors import InputError, check_array, check_choice, check_number
from impactopt.kinematics.inverse_kinematics import inverse_kinematics
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import DEFAULT_TERMS, ContactWrenchCone, Term

__all__ = ["Parameter", "changed", "moved_problem", "parameter_of", "with_term"]

# what no term changes but that on the world's bodies, which may be switched off
_BODIES = ("world", "bodies")
_KEPT = ("stance_coordinates", "start_posture")  # of a problem on the same robot, stance and start


def changed(problem: ImpactProblem, **fields: Any) -> ImpactProblem:
    """`dataclasses.replace`, without computing anew what stays: robot, stance and start are the same, and the
    posture at contact is looked for from the one known.
    """
    new = object.__new__(type(problem))
    new.__dict__.update({f.name: getattr(problem, f.name) for f in dataclasses.fields(problem)} | fields)
    # before the checks, which need them too
    same = fields.keys() <= {"terms"} and new.keep_out.enabled == problem.keep_out.enabled
    kept = (*_KEPT, *_BODIES) if same else _KEPT
    new.__dict__.update({name: problem.__dict__[name] for name in kept if name in problem.__dict__})
    if "contact_posture" in problem.__dict__:
        near, point = problem.contact_posture, fields.get("point", problem.point)
        with contextlib.suppress(InputError):  # the checks look for one from the start
            new.__dict__["contact_posture"] = (
                near
                if np.array_equal(point, problem.point)
                else inverse_kinematics(
                    problem.coordinates, problem.striker, check_array("point [m]", point, (3,)), near
                )
            )
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
    """A problem with another hit point [m], normal, mass of the target [kg], stiffness or damping of the
    contact (the law's units), or margin of the soles' centres of pressure [m], in contact too.

    Raises
    ------
    InputError : nothing is changed; target or law have no such number; a value that is none.
    """
    new: dict[str, Any] = {}
    for name, vector in (("point", point), ("normal", normal)):
        if vector is not None:
            new[name] = np.array(vector, dtype=float)
    if mass is not None:
        new["target"] = _with(problem.target, "mass", mass)
    law = problem.law
    for name, value in (("stiffness", stiffness), ("damping", damping)):
        if value is not None:
            law = new["law"] = _with(law, name, value)
    if margin is not None:
        cone = problem.term(ContactWrenchCone)
        both = {"margin": margin} | ({} if cone.collision_margin is None else {"collision_margin": margin})
        new["terms"] = with_term(problem, dataclasses.replace(cone, **both))
    if not new:
        raise InputError("nothing is moved: give point, normal, mass, stiffness, damping or margin")
    return changed(problem, **new)


def _with(thing: Any, name: str, value: float) -> Any:
    known = [field.name for field in dataclasses.fields(thing)]
    check_choice(f"{type(thing).__name__} has no number", name, known)
    return dataclasses.replace(thing, **{name: value})


def with_term(problem: ImpactProblem, term: Term) -> tuple[Term, ...]:
    others = [other for other in problem.terms if type(other) is not type(term)]
    return (*others, term)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Parameter:
    """A number of a problem by its name.

    typical : a size of it, for steps.
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
        """The problem with another value of it."""
        if self._field == "point":
            point = np.array(self.problem.point, dtype=float)
            point["xyz".index(self._part)] = value
            return changed(self.problem, point=point)
        if self._field == "terms":
            kind, name = self._part
            term = dataclasses.replace(self.problem.term(kind), **{name: value})
            return changed(self.problem, terms=with_term(self.problem, term))
        part = getattr(self.problem, self._field)
        return changed(self.problem, **{self._field: _with(part, self._part, value)})


def parameter_of(problem: ImpactProblem, name: str) -> Parameter:
    """The number of a name: ``target.mass``, ``contact.stiffness``, ``point.x``, and of a term that the
    problem has ``terms.contact_wrench_cone.margin``, as problem files call them, without units.

    Raises
    ------
    InputError : there is no such number.
    """
    known: dict[str, tuple[str, Any, float]] = {
        f"point.{axis}": ("point", axis, float(problem.point[k])) for k, axis in enumerate("xyz")
    }
    for section, field in (("target", "target"), ("contact", "law")):
        numbers = getattr(problem, field).parameters
        known |= {f"{section}.{key}": (field, key, float(value)) for key, value in numbers.items()}
    others = [term for term in DEFAULT_TERMS if not any(isinstance(t, type(term)) for t in problem.terms)]
    for term in (*problem.terms, *others):
        section = snake_case(type(term).__name__)
        for told in dataclasses.fields(term):
            value = getattr(term, told.name)
            if isinstance(value, float) and np.isfinite(value):
                known[f"terms.{section}.{told.name}"] = ("terms", (type(term), told.name), value)
    check_choice("this problem has no number", name, known)
    field, part, value = known[name]
    return Parameter(
        name=name, problem=problem, value=check_number(name, value), _field=str(field), _part=part
    )
