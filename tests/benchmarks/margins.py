"""What does planning with margin cost in impulse, and what does it buy in robustness?

From one base, the problem without scenarios and with default terms, one option at a time goes from daring to
cautious. Each plan is replayed on free soles: as planned, with the target missing, and under the same drawn
perturbations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.pictures.margins import margins_picture
from benchmarks.planning import DEMO
from benchmarks.report import Report, Say, columns_table
from impactopt import Solution
from impactopt.errors import InputError
from impactopt.files.problem_file import read_problem_file
from impactopt.planning.solve import solve
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.scenario import Scenario
from impactopt.problem.terms import Balance, ContactWrenchCone, Term, TorqueLimit
from impactopt.simulation import Perturbation, simulate
from impactopt.simulation.robustness import STEP, robustness

TIME_LIMIT = 120.0  # [s] of the solver
SURVIVED = 0.06  # [m] the missing target's capture margin that problems/punch.toml asks for


@dataclass(frozen=True, kw_only=True)
class Value:
    """One value of an option: what it is called, and what it changes of the problem (nothing: the base).

    quick : stays in the short sweep.
    """

    label: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    quick: bool = False


@dataclass(frozen=True, kw_only=True)
class Option:
    """What is swept, and its values from daring to cautious."""

    name: str
    unit: str
    values: tuple[Value, ...]


BASE = Value(label="base", quick=True)


def _terms(label: str, *terms: Term, quick: bool = False) -> Value:
    """A value whose terms are the default ones leaves the problem as it is."""
    changed = tuple(term for term in terms if term != type(term)())
    return Value(label=label, changes={"terms": changed} if changed else {}, quick=quick or not changed)


def _missing(margin: float) -> Scenario:
    return Scenario(name="missing", missing=True, capture_margin=margin)


def _factors(name: str, *factors: float) -> tuple[Scenario, ...]:
    """Scenarios whose mass or stiffness is that many times the expected one's."""
    return tuple(_scenario(f"{name} x {factor:g}", {name: factor}) for factor in factors)


def _scenario(name: str, numbers: dict[str, Any]) -> Scenario:
    return Scenario(name=name, **numbers)


_MASS, _STIFFNESS = _factors("mass", 0.5, 2.0), _factors("stiffness", 0.3, 3.0)
NONE = replace(BASE, label="none")

OPTIONS = (
    Option(
        name="missing target, capture margin",
        unit="mm",
        values=(
            NONE,
            *(
                Value(label=f"{1e3 * m:g}", changes={"scenarios": (_missing(m),)}, quick=m == SURVIVED)
                for m in (0.0, 0.02, 0.04, SURVIVED, 0.08)
            ),
        ),
    ),
    Option(
        name="capture margin after impact",
        unit="mm",
        values=tuple(
            _terms(f"{1e3 * m:g}", Balance(capture_margin=m), quick=m == 0.06)
            for m in (0.0, 0.02, 0.04, 0.06)
        ),
    ),
    Option(
        name="angular momentum after impact",
        unit="N m s",
        values=tuple(
            _terms(f"{h:g}", Balance(angular_momentum=h), quick=h in (15, 6))
            for h in (15.0, 10.0, 8.0, 6.0, 4.0)
        ),
    ),
    Option(
        name="torque, of limit",
        unit="",
        values=tuple(
            _terms(f"{f:g}", TorqueLimit(fraction=f, collision=f), quick=f in (1.0, 0.65))
            for f in (1.0, 0.95, 0.85, 0.75, 0.65)
        ),
    ),
    Option(
        name="CoP margin of each sole",
        unit="mm",
        values=tuple(
            _terms(f"{1e3 * m:g}", ContactWrenchCone(margin=m, collision_margin=m), quick=m in (0.005, 0.04))
            for m in (0.005, 0.01, 0.02, 0.03, 0.04)
        ),
    ),
    Option(
        name="friction used",
        unit="",
        values=tuple(
            _terms(f"{mu:g}", ContactWrenchCone(friction=mu), quick=mu == 0.4) for mu in (0.8, 0.6, 0.4)
        ),
    ),
    Option(
        name="scenarios",
        unit="",
        values=(
            NONE,
            Value(label="mass x 0.7, 1.5", changes={"scenarios": _factors("mass", 0.7, 1.5)}),
            Value(label="mass x 0.5, 2", changes={"scenarios": _MASS}, quick=True),
            Value(label="stiffness x 0.3, 3", changes={"scenarios": _STIFFNESS}),
            Value(
                label="all of these",
                changes={"scenarios": (*_factors("mass", 0.7, 1.5), *_MASS, *_STIFFNESS)},
            ),
            Value(
                label="all, and missing",
                changes={"scenarios": (*_factors("mass", 0.7, 1.5), *_MASS, *_STIFFNESS, _missing(SURVIVED))},
            ),
        ),
    ),
)

COLUMNS = (
    ("planned N s", "impulse_planned_Ns", 2),
    ("replayed", "impulse_replayed_Ns", 2),
    ("stands", "standing", 0),
    ("if missing", "standing_missing", 0),
    ("of draws", "standing_rate", 2),
    ("slip mm", "slip_p95_mm", 1),
    ("solve s", "solve_seconds", 1),
)


def run(
    say: Say, *, file: Path = DEMO, draws: int = 40, seed: int = 0, workers: int = 2, quick: bool = False
) -> Report:
    """One row a value; the base is measured once, and stands in every option.

    quick : fewer values, and no program of many scenarios.
    """
    base = replace(read_problem_file(file).build(), scenarios=(), terms=())
    base_row: dict[str, Any] | None = None
    rows = []
    for option in OPTIONS:
        for value in option.values:
            if quick and not value.quick:
                continue
            if value.changes or base_row is None:
                name = f"{option.name}: {value.label}" if value.changes else "the base"
                found = row(replace(base, **value.changes), name, say, draws, seed, workers)
                base_row = base_row if value.changes else found
            else:
                found = base_row
            what = {"option": option.name, "unit": option.unit, "value": value.label}
            rows.append({**what, "base": not value.changes, **found})
    numbers = {
        "rows": rows,
        "problem": str(file),
        "draws": draws,
        "seed": seed,
        "step_s": STEP,
        "time_limit_s": TIME_LIMIT,
    }
    return Report(
        name="margins",
        numbers=numbers,
        tables=tables_of(rows),
        figures={"margins": lambda: margins_picture(rows)},
    )


def row(problem: ImpactProblem, name: str, say: Say, draws: int, seed: int, workers: int) -> dict[str, Any]:
    """Plan and replay one problem; a plan that is not solved is its status."""
    out: dict[str, Any] = {"status": "error", **{key: None for _, key, _ in COLUMNS}}
    say(f"planning {name}")
    try:
        solution = solve(problem, time_limit=TIME_LIMIT)
        out |= {"status": solution.status.value, "solve_seconds": solution.solve_seconds}
        out["iterations"] = solution.result.iterations
        if not solution.status.usable:
            say(f"{name}: {solution.result.message}")
            return {**out, "reason": solution.result.message}
        out["impulse_planned_Ns"] = solution.impulse
        return out | replays(solution, name, say, draws, seed, workers)
    except InputError as error:
        say(f"{name}: {error}")
        return {**out, "reason": str(error)}


def replays(solution: Solution, name: str, say: Say, draws: int, seed: int, workers: int) -> dict[str, Any]:
    """As planned, with the target missing, and under drawn perturbations; slip is of the draws that stand."""
    problem, reference = solution.problem, solution.trajectory
    say(f"replaying {name}: {solution.impulse:.2f} N s, {solution.solve_seconds:.1f} s")
    nominal = simulate(problem, reference, engine="mujoco", step=STEP)
    missing = simulate(
        problem, reference, engine="mujoco", step=STEP, perturbation=Perturbation(missing=True)
    )
    many = robustness(
        problem, reference, solution.impulse, draws=draws, seed=seed, workers=workers, step=STEP
    )
    slip = many.slip[many.standing]  # a robot that fell slides far, which says nothing of its soles' grip
    return {
        "impulse_replayed_Ns": nominal.impulse,
        "standing": bool(nominal.standing),
        "reason": nominal.fall or None,
        "standing_missing": bool(missing.standing),
        "standing_rate": many.rate,
        "standing_interval_95": list(many.interval),
        "slip_p95_mm": 1e3 * float(np.quantile(slip, 0.95)) if slip.size else None,
    }


def tables_of(rows: list[dict[str, Any]]) -> tuple[Any, ...]:
    """One an option, whose name is its title: a single one would not fit into a terminal."""
    tables = []
    for option in dict.fromkeys(r["option"] for r in rows):
        chosen = [r for r in rows if r["option"] == option]
        shown = []
        for r in chosen:
            value = f"{r['value']}{' (base)' if r['base'] else ''}"
            planned = r["status"] if r["impulse_planned_Ns"] is None else r["impulse_planned_Ns"]
            shown.append({**r, "value": value, "impulse_planned_Ns": planned})
        unit = f" [{chosen[0]['unit']}]" if chosen[0]["unit"] else ""
        tables.append(columns_table(f"margins: {option}{unit}", (("value", "value", 0), *COLUMNS), shown))
    return tuple(tables)
