"""Whether a saved result is what it says: rows, objective and KKT residual, by this room's own code."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.errors import InputError
from impactopt.problem.problem import ImpactProblem
from oracle.kkt import Residual, lagrangian_gradient, residual
from oracle.program import Claims, Program
from oracle.recorded import off_in_record
from oracle.variables import Piece, RowName, Variables

Array = NDArray[np.float64]
VIOLATION = 1e-5  # of rows, which are of order one, and of what a record says
KKT = 1e-4  # as of solvers that call a point acceptable
TOLD = 3  # rows at most, in a reason
OBJECTIVE = 1e-9  # of its size, and of one


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What was found.

    ok : nothing is violated, the KKT conditions hold, and all that the problem states was computed.
    max_violation : of all rows and of what the record says.  kkt : residual; None with another `reason`.
    objective : what is minimized [N s], computed here; None where it is not known.
    rows : by name, worst violation and where.
    reason : why it is not ok, or what could not be computed; "".
    """

    ok: bool
    max_violation: float
    kkt: float | None
    objective: float | None
    rows: dict[str, tuple[float, str]]
    reason: str = ""

    def describe(self) -> dict[str, Any]:
        """What `impactopt verify --json` prints."""
        return {
            "ok": self.ok,
            "max_violation": self.max_violation,
            "kkt": self.kkt,
            "objective": self.objective,
            "rows": {name: {"violation": by, "where": where} for name, (by, where) in self.rows.items()},
            "reason": self.reason,
        }


def claims_of(arrays: Mapping[str, NDArray[Any]]) -> Claims:
    """What a record says of its program.

    Raises
    ------
    InputError : it says nothing, or what cannot be read.
    """
    if "program_statement" not in arrays:
        raise InputError(
            "this result does not say what its program's variables and rows are: it is a strike, or of an "
            "impactopt before `verify`; solve again with `impactopt solve`"
        )
    try:
        told = json.loads(str(arrays["program_statement"]))
        lists = [tuple(map(str, components)) for components in told["components"]]
        return Claims(
            groups=[(str(name), int(count), int(size)) for name, count, size in told["groups"]],
            rows=[(str(term), str(place), c) for term, place, k in told["constraints"] for c in lists[k]],
            more=[tuple(map(float, places)) for places in told["added_nodes"]],
            elements=[tuple(map(float, phase)) for phase in told["elements"]],
            shortest=[tuple(map(float, times)) for times in told["shortest"]],
            guarded=bool(told["guarded"]),
            apart=[dict(row) for row in told["clearance"]],
        )
    except (ValueError, KeyError, TypeError, IndexError) as error:
        mend = "solve again with `impactopt solve`"
        raise InputError(f"what this result says of its program is damaged ({error!r}); {mend}") from error


def verify_record(
    problem: ImpactProblem, arrays: Mapping[str, NDArray[Any]], summary: Mapping[str, Any]
) -> Verdict:
    """Check a record: what is in its `solution.npz`, against its problem.

    Raises
    ------
    InputError : it does not say what its variables are.
    """
    claims = claims_of(arrays)
    program = Program(problem, claims)
    x = np.asarray(arrays["solver_x"], dtype=float)
    v = Variables(claims.groups, program.scales, x)
    if v.n != len(x):
        raise InputError(f"this result has {len(x)} variables, and names {v.n}; solve again")
    return _Checked(program, claims, v, arrays, summary).verdict()


class _Checked:
    def __init__(
        self,
        program: Program,
        claims: Claims,
        v: Variables,
        arrays: Mapping[str, NDArray[Any]],
        summary: Mapping[str, Any],
    ) -> None:
        self.program, self.claims, self.v, self.arrays, self.summary = program, claims, v, arrays, summary
        self.found: dict[str, tuple[float, str]] = {}
        self.reasons = [f"not known to verify: {what}" for what in program.missing]

    def note(self, name: str, amount: float, where: str) -> None:
        """Keep the worst violation of each name; what is no number is as bad as can be."""
        amount = float(amount) if np.isfinite(amount) else np.inf
        if name not in self.found or amount > self.found[name][0]:
            self.found[name] = max(amount, 0.0), where

    def verdict(self) -> Verdict:
        values = [piece.value(self.v) for piece in self.program.rows]
        for piece, value in zip(self.program.rows, values, strict=True):
            off = np.maximum(np.maximum(piece.lower - value, value - piece.upper), 0.0)
            for (term, place, component), amount in zip(piece.names, off, strict=True):
                self.note(term, amount, ", ".join(part for part in (place, component) if part))
        bounds = self._bounds()
        objective = self._objective()
        weights, unknown = self._multipliers()
        self.reasons += [f"not known to verify: the rows {name!r}" for name in sorted(unknown)]
        for told in off_in_record(self.program, self.v, self.arrays, self.summary):
            self.note(*told)
        left: Residual | None = None
        worst = max((by for by, _ in self.found.values()), default=0.0)
        if not self.reasons and worst <= VIOLATION:  # a violation is reason enough
            left = self._residual(weights, values, bounds)
            if left.kkt > KKT:
                name = self._variable(left.variable)
                self.reasons.append(f"the KKT residual is {left.kkt:.2g}, more than {KKT:g}; worst: {name}")
            if left.doubt > KKT:
                self.reasons.append(f"the KKT residual is known to {left.doubt:.2g} only")
        off_by = sorted(self.found.items(), key=lambda item: -item[1][0])[:TOLD]
        self.reasons[:0] = [
            f"{name}, {where}: off by {by:.3g}, more than {VIOLATION:g}"
            for name, (by, where) in off_by
            if by > VIOLATION
        ]
        return Verdict(
            ok=not self.reasons,
            max_violation=worst,
            kkt=None if left is None else left.kkt,
            objective=objective,
            rows=self.found,
            reason="; ".join(self.reasons),
        )

    def _variable(self, number: int) -> str:
        """The group of a variable, and its member."""
        for name, count, size in self.claims.groups:
            if number < count * size:
                return f"{name}[{number // size}], {number % size}"
            number -= count * size
        raise IndexError(number)

    def _bounds(self) -> tuple[Array, Array]:
        lower, upper = np.full(self.v.n, -np.inf), np.full(self.v.n, np.inf)
        for name, sides in self.program.bounds.items():
            if name in self.v and self.v.count(name):
                for bound, side in zip((lower, upper), sides, strict=True):
                    bound[self.v.span(name)] = self.v.scaled(name, side)
        off = np.maximum(np.maximum(lower - self.v.x, self.v.x - upper), 0.0)
        for name, count, size in self.claims.groups:
            if count * size:
                span = off[self.v.span(name)]
                self.note("bounds of variables", float(span.max()), name)
        return lower, upper

    def _objective(self) -> float | None:
        if self.program.missing:
            return None
        found = sum(float(part.value(self.v)[0]) for part in self.program.worth)
        told = float(self.arrays["solver_objective"])
        off = abs(found - told) / max(1.0, abs(found))
        self.note("objective", 0.0 if off < OBJECTIVE else off, "solver_objective")
        return found

    def _multipliers(self) -> tuple[list[Array], set[str]]:
        """Of each piece's rows, by their names; and the terms of rows that are told, and not known here."""
        told = np.asarray(self.arrays["solver_multipliers"], dtype=float)
        if len(told) != len(self.claims.rows):
            raise InputError(
                f"this result has {len(told)} multipliers, and names {len(self.claims.rows)} rows"
            )
        of_name: dict[RowName, list[float]] = {}
        for name, multiplier in zip(reversed(self.claims.rows), told[::-1], strict=True):
            of_name.setdefault(name, []).append(float(multiplier))  # taken from the end: in their order
        weights = []
        for piece in self.program.rows:
            bounded = np.isfinite(piece.lower) | np.isfinite(piece.upper)
            found = np.zeros(len(piece.names))
            for i in np.flatnonzero(bounded):
                left = of_name.get(piece.names[i])
                if left:
                    found[i] = left.pop()
                elif not self.program.missing:
                    self.reasons.append(f"it has no row {', '.join(filter(None, piece.names[i]))}")
            weights.append(found)
        return weights, {term for (term, _, _), left in of_name.items() if left}

    def _residual(self, weights: list[Array], values: list[Array], bounds: tuple[Array, Array]) -> Residual:
        rows: list[Piece] = self.program.rows
        pieces = [*rows, *self.program.worth]
        gradient, doubt = lagrangian_gradient(
            pieces, [*weights, *(np.ones(1) for _ in self.program.worth)], self.v
        )
        lower, upper = (np.concatenate([getattr(p, side) for p in rows]) for side in ("lower", "upper"))
        z = np.asarray(self.arrays["solver_bound_multipliers"], dtype=float)
        if z.shape != self.v.x.shape:
            raise InputError(f"this result has {len(self.v.x)} variables, and {z.size} multipliers of bounds")
        of_rows = np.concatenate(values), lower, upper, np.concatenate(weights)
        return residual(gradient, doubt, (self.v.x, *bounds, z), of_rows)
