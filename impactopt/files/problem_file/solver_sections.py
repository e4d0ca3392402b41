"""The section [solver]: which one, and its options."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_type_hints

from pydantic import create_model

from impactopt.files.problem_file.section import Section, attribute_docs, optional
from impactopt.files.problem_file.toml import Place
from impactopt.files.problem_file.values import IpoptOptions, Positive
from impactopt.solvers.options import INTERIOR, IPMOptions, SolverOptions, SQPOptions


def _section(kind: type[SolverOptions], about: str) -> Any:
    """A section with a key for each option but the time limit, as the options' own docstring describes it."""
    said, hints = attribute_docs(kind), get_type_hints(kind)
    keys: dict[str, Any] = {n: (hints[n], optional(said[n])) for n in hints if n != "time_limit"}
    section: Any = create_model(kind.__name__, __base__=Section, __doc__=about, **keys)
    section.kind = kind
    return section


IPM: Any = _section(IPMOptions, "Options of the interior-point method.")
SQP: Any = _section(SQPOptions, "Options of the SQP.")


@dataclass(frozen=True, kw_only=True)
class SolverSettings:
    """Solver settings of a file's [solver] section.

    name : of the solver.  time_limit [s] : None for no limit.  options : by solver, the solver's own.
    """

    name: str = "ipm"
    time_limit: float | None = None
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def arguments(self, solver: str | None = None, time_limit: float | None = None) -> dict[str, Any]:
        """Solver arguments of `solve` and its like; given ones take precedence over the file's."""
        chosen = self.name if solver is None else solver
        limit = self.time_limit if time_limit is None else time_limit
        # for one version "sqp" without a QP solver means "ipm": `with_todays_name`
        options = self.options.get(chosen, self.options.get("ipm") if chosen == "sqp" else None)
        return {"solver": chosen, "options": options, "time_limit": limit}


def with_todays_names(
    data: Mapping[str, Any], lines: Mapping[Place, int]
) -> tuple[Mapping[str, Any], Mapping[Place, int]]:
    """Data of a file, and its lines, with the section [solver] as it is spelled now.

    For one version "sqp" without a QP solver means "ipm", as it did, and "sqp" with one needs no name.

    Warns
    -----
    FutureWarning : the spelling has changed; it says what to write.
    """
    section = data.get("solver")
    if not isinstance(section, Mapping) or "ipm" in section or section.get("name") not in (None, "sqp"):
        return data, lines
    options = section.get("sqp")
    named = options.get("qp_solver") if isinstance(options, Mapping) else None
    if named not in (None, INTERIOR):
        if "name" in section:
            return data, lines
        write, new = 'give [solver] name = "sqp" beside [solver.sqp] qp_solver', {**section, "name": "sqp"}
    elif options is None and "name" not in section:
        return data, lines
    else:
        write = 'the interior-point method, the default, is now name = "ipm", its options [solver.ipm]'
        new = {key: value for key, value in section.items() if key not in ("name", "sqp")}
        if isinstance(options, Mapping):
            new["ipm"] = {key: value for key, value in options.items() if key != "qp_solver"}
        here = {place: n for place, n in lines.items() if place[:2] == ("solver", "sqp")}
        lines = {**lines, **{("solver", "ipm", *place[2:]): n for place, n in here.items()}}
    warnings.warn(write, FutureWarning, stacklevel=2)
    return {**data, "solver": new}, lines


class SolverSection(Section):
    """Solver, and its options."""

    name: Literal["ipm", "sqp", "ipopt"] = optional("name of the solver")
    time_limit: Positive = optional(
        "longest time of the solver, after which its best iterate is kept [s]", "time_limit_s"
    )
    ipopt: IpoptOptions = optional("IPOPT's own options by name")
    ipm: IPM = optional("")
    sqp: SQP = optional("")

    @classmethod
    def defaults(cls) -> dict[str, Any]:
        return {"name": SolverSettings.name}
