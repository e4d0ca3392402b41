"""The sections [terms] and [objectives]: one below them for each class, of its own fields."""

from __future__ import annotations

from impactopt.contact.fields import snake_case
from impactopt.files.problem_file.field_sections import sections_of
from impactopt.problem.objectives import OBJECTIVES
from impactopt.problem.terms import DEFAULT_TERMS, ON_DEMAND_TERMS, TERMS

__all__ = ["ObjectiveSections", "TermSections"]

_TERMS = {snake_case(kind.__name__): kind for kind in TERMS}
_FIRST, *_, _LAST = list(_TERMS)[: len(DEFAULT_TERMS)]
_ON_DEMAND = " and ".join(snake_case(type(term).__name__) for term in ON_DEMAND_TERMS)

TermSections = sections_of(
    "TermSections",
    f"Constraints. Those from {_FIRST} to {_LAST}, and {_ON_DEMAND}, hold with their defaults if they are "
    "left out.",
    _TERMS,
)
ObjectiveSections = sections_of(
    "ObjectiveSections",
    "What is maximized: the impulse, or if there are sections here, only these.",
    {snake_case(kind.__name__): kind for kind in OBJECTIVES},
)
