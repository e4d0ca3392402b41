"""The sections of a problem file: their keys and units.

Each pydantic model is a section, each field a key, whose name in the file is its `alias` if it has a unit.
`build` makes an instance of the class `kind` from the keys given. Defaults and further checks are those of
that class only.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, Literal, get_type_hints

from pydantic import BaseModel, create_model

from impactopt.bodies.world import Ground, Obstacle
from impactopt.contact.fields import snake_case
from impactopt.files.problem_file.ipopt_options import IpoptOptions
from impactopt.files.sections.collision import CollisionSection, CollisionSections, ProblemSection, with_kinds
from impactopt.files.sections.diagnostics import section_at
from impactopt.files.sections.values import (
    AtLeastOne,
    Duration,
    NotNegative,
    Positive,
    Section,
    Vector,
    attribute_docs,
    optional,
    required,
    section_of,
    sections_of,
)
from impactopt.files.toml import Place
from impactopt.problem.objectives import OBJECTIVES
from impactopt.problem.phases import Phase
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.scenario import Scenario, SecondStriker
from impactopt.problem.terms import DEFAULT_TERMS, ON_DEMAND_TERMS, TERMS
from impactopt.simulation.controller import ControllerSettings
from impactopt.solvers.options import IPMOptions, SolverOptions, SQPOptions


def _section(kind: type[SolverOptions], about: str) -> Any:
    """A section with a key for each option but the time limit, described as in the class's docstring."""
    docs, hints = attribute_docs(kind), get_type_hints(kind)
    keys: dict[str, Any] = {n: (hints[n], optional(docs[n])) for n in hints if n != "time_limit"}
    section: Any = create_model(kind.__name__, __base__=Section, __doc__=about, **keys)
    section.kind = kind
    return section


IPM: Any = _section(IPMOptions, "Options of the interior-point method.")
SQP: Any = _section(SQPOptions, "Options of the SQP.")


@dataclass(frozen=True, kw_only=True)
class SolverSettings:
    """Solver settings of a file's [solver] section.

    name : of the solver.  time_limit [s] : None for no limit.  options : of each solver, by its name.
    """

    name: str = "ipm"
    time_limit: float | None = None
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def arguments(self, solver: str | None = None, time_limit: float | None = None) -> dict[str, Any]:
        """Solver arguments of `solve` and similar functions; given ones take precedence over the file's."""
        chosen = self.name if solver is None else solver
        limit = self.time_limit if time_limit is None else time_limit
        return {"solver": chosen, "options": self.options.get(chosen), "time_limit": limit}


class SolverSection(Section):
    """Solver, and its options."""

    name: Literal["ipm", "sqp", "ipopt"] = optional("name of the solver")
    time_limit: Positive = optional("longest time; then the best iterate is kept [s]", "time_limit_s")
    ipopt: IpoptOptions = optional("IPOPT's own options by name")
    ipm: IPM = optional("")
    sqp: SQP = optional("")

    @classmethod
    def defaults(cls) -> dict[str, Any]:
        return {"name": SolverSettings.name}


_TERMS = {snake_case(kind.__name__): kind for kind in TERMS}
_FIRST, *_, _LAST = list(_TERMS)[: len(DEFAULT_TERMS)]
_LAZY = " and ".join(term.section for term in ON_DEMAND_TERMS)

TermSections: Any = sections_of(
    "TermSections",
    f"Constraints. Those from {_FIRST} to {_LAST}, and {_LAZY}, hold with their defaults if they are "
    "left out.",
    _TERMS,
)
ObjectiveSections: Any = sections_of(
    "ObjectiveSections",
    "Objectives: the impulse, or if there are sections here, only these.",
    {snake_case(kind.__name__): kind for kind in OBJECTIVES},
)


ELEMENTS = ("compression", "restitution")  # keys of ImpactProblem.collision_elements


class SecondSection(Section):
    """Another striker that hits the same target at the same time."""

    kind = SecondStriker
    striker: str = required("the robot's other striker")
    point: Vector = required("its hit point on the target [m]", "point_m")


class PhaseSection(Section):
    """A phase of the motion: its duration and its spline."""

    kind = Phase
    duration: Duration = required("duration; a range is optimized over [s]", "duration_s")
    intervals: int = optional("intervals of the spline, at least 6; more: a freer motion, a longer solve")
    grading: AtLeastOne = optional("longest over shortest interval, the short ones at the contact")


class SwingSection(PhaseSection):
    """Wind-up and strike, from rest to contact."""


class FollowSection(PhaseSection):
    """Follow-through, from the state after the impact to rest."""


ScenarioSection: Any = section_of(Scenario)
ObstacleSection: Any = section_of(Obstacle)
GroundSection: Any = section_of(Ground)
ControllerSection: Any = section_of(ControllerSettings)


class ObjectiveSection(Section):
    """The motion's style, and small prices that make the optimum unique."""

    style: Literal["natural", "strongest"] = optional(
        '"natural": prices on jerk, travel of joints and the end posture; "strongest": none'
    )
    motion_price: NotNegative = optional("largest share of these prices in the objective")
    price_scale: NotNegative = optional("factor on these prices")
    smoothness: NotNegative = optional("price of accelerations [N s per (rad/s^2)^2 s]")
    wrench_price: NotNegative = optional("price of the soles' wrenches")
    return_price: NotNegative = optional("price of ending away from the start posture [N s per rad^2]")


class File(CollisionSections):
    """A whole problem file; `with_kinds` sets the classes of [target] and [contact]."""

    second: SecondSection = optional("")
    swing: SwingSection = optional("")
    follow: FollowSection = optional("")
    collision: CollisionSection = optional("")
    scenarios: list[ScenarioSection] = optional("")
    obstacles: list[ObstacleSection] = optional("")
    ground: GroundSection = optional("")
    objectives: ObjectiveSections = optional("")
    objective: ObjectiveSection = optional("")
    terms: TermSections = optional("")
    solver: SolverSection = optional("")
    controller: ControllerSection = optional("")

    def given_terms(self) -> Iterator[tuple[str, Any]]:
        """Names and terms of the file's sections below [terms]."""
        for name in TermSections.model_fields if self.terms is not None else ():
            section = getattr(self.terms, name)
            if section is not None:
                yield name, section.build()

    def arguments(self) -> dict[str, Any]:
        """Arguments of `ImpactProblem` that the file gives, without robot and stance."""
        out = {name: value for name, value in self.problem.given().items() if name != "robot"}
        out |= {"law": self.contact.build(), "target": self.target.build()}
        for name in ("second", "swing", "follow", "friction", "ground"):
            if (section := getattr(self, name)) is not None:
                out[name] = section.build()
        for name in ("stances", "scenarios", "obstacles"):
            if (sections := getattr(self, name)) is not None:
                out[name] = tuple(each.build() for each in sections)
        out |= self.objective.given() if self.objective else {}
        if self.collision is not None:
            given = self.collision.given()
            defaults = zip(ELEMENTS, ImpactProblem.collision_elements, strict=True)
            elements = [given.pop(name, lengths) for name, lengths in defaults]
            if "contact_duration" in given:
                given["contact_duration"] = tuple(given["contact_duration"])
            out |= {**given, "collision_elements": tuple(tuple(lengths) for lengths in elements)}
        if self.robot is not None and self.robot.choices:
            out["gains"] = self.robot.choices
        if self.target.body is not None:
            out["body"] = self.target.body.build()
        for name, section in (("terms", self.terms), ("objectives", self.objectives)):
            if section is not None:
                found = (getattr(section, field) for field in type(section).model_fields)
                out[name] = tuple(part.build() for part in found if part is not None)
        return out


def defaults_of(section: type[Section]) -> dict[str, Any]:
    """Default values by field; a field without a default is left out."""
    if section not in (ProblemSection, CollisionSection, ObjectiveSection):
        return section.defaults()
    known = {f.name: f.default for f in fields(ImpactProblem) if f.default is not MISSING}
    known |= zip(ELEMENTS, ImpactProblem.collision_elements, strict=True)
    return {name: known[name] for name in section.model_fields if name in known}


def about_section(section: type[BaseModel]) -> str:
    """Description of a section: its docstring's first sentence."""
    return " ".join((section.__doc__ or "").split("\n\n")[0].split()).rstrip(".")


def comment_at(data: Mapping[str, Any], place: Place) -> str:
    """Comment on a key or a section of a file with these data; "" if there is none."""
    section, sections = section_at(with_kinds(File, data), place)
    if sections == len(place):
        return about_section(section)
    for name, info in section.model_fields.items():
        if len(place) == sections + 1 and place[-1] in (info.alias, name):
            return info.description or ""
    return ""
