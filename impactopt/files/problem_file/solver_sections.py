"""The section [solver]: which one, and its options."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_type_hints

from pydantic import create_model

from impactopt.files.problem_file.section import Section, attribute_docs, optional
from impactopt.files.problem_file.values import IpoptOptions, Positive
from impactopt.solvers.sqp import SQPOptions


def _sqp_keys() -> dict[str, Any]:
    """A key for each option but the time limit, as the options' own docstring describes it."""
    said = attribute_docs(SQPOptions)
    hints = get_type_hints(SQPOptions)
    return {name: (hints[name], optional(said[name])) for name in hints if name != "time_limit"}


SQP: Any = create_model("SQP", __base__=Section, __doc__="Options of the default solver.", **_sqp_keys())
SQP.kind = SQPOptions


@dataclass(frozen=True, kw_only=True)
class SolverSettings:
    """Solver settings of a file's [solver] section.

    name : of the solver.  time_limit [s] : None for no limit.  options : by solver, the solver's own.
    """

    name: str = "sqp"
    time_limit: float | None = None
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def arguments(self, solver: str | None = None, time_limit: float | None = None) -> dict[str, Any]:
        """Solver arguments of `solve` and its like; given ones take precedence over the file's."""
        chosen = self.name if solver is None else solver
        limit = self.time_limit if time_limit is None else time_limit
        return {"solver": chosen, "options": self.options.get(chosen), "time_limit": limit}


class SolverSection(Section):
    """Solver, and its options."""

    name: Literal["ipopt", "sqp"] = optional("name of the solver")
    time_limit: Positive = optional(
        "longest time of the solver, after which its best iterate is kept [s]", "time_limit_s"
    )
    ipopt: IpoptOptions = optional("IPOPT's own options by name")
    sqp: SQP = optional("")

    @classmethod
    def defaults(cls) -> dict[str, Any]:
        return {"name": SolverSettings.name}
