"""Solved, and true? Drawn boards, nails and masses, hit by three arms, planned and replayed.

One row a problem: how the solver ended; the planned impulse, and what of it Pinocchio and MuJoCo say is too
much; whether the plan says so itself. False is a plan that is called solved, is off by more than one per
cent in either engine besides that engine's own step error, and says nothing.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.report import Report, Say, columns_table
from impactopt.contact import Board, FreeMass, HuntCrossley, KelvinVoigt, Nail, SpringDamper
from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import Target
from impactopt.errors import InputError
from impactopt.files.problem_file import load_problem
from impactopt.planning.contact_replay import SOLVED_WITHIN
from impactopt.planning.solve import solve
from impactopt.problem.objectives import Impulse
from impactopt.problem.problem import ImpactProblem
from impactopt.solvers.program import Status

PROBLEMS = ("arm_planar", "arm7", "chop_arm")
LONGEST = 0.2  # [s] of a phase of the contact
TIME_LIMIT = 60.0  # [s] of the solver
COLUMNS = (
    ("", "number", 0),
    ("arm", "problem", 0),
    ("target", "target", 0),
    ("law", "law", 0),
    ("N/m", "stiffness", 0),
    ("status", "status", 0),
    ("N s", "impulse_Ns", 3),
    ("elements %", "elements_pct", 2),
    ("contact %", "contact_pct", 2),
    ("Pinocchio %", "pinocchio_pct", 2),
    ("MuJoCo %", "mujoco_pct", 2),
    ("told", "told", 0),
    ("false", "false", 0),
)


def run(say: Say, *, count: int = 200, seed: int = 0) -> Report:
    """``count`` problems, the arms by turns."""
    rows = [_row(number, seed, say) for number in range(count)]
    ends = Counter(row["status"] for row in rows)
    wrong = [row["number"] for row in rows if row["false"]]
    say(f"{dict(ends)}; false: {wrong or 'none'}")
    return Report(
        name="contacts",
        numbers={"rows": rows, "seed": seed, "statuses": dict(ends), "false": wrong},
        tables=(columns_table("drawn contacts: planned, and replayed", COLUMNS, rows),),
    )


def drawn_problem(number: int, seed: int = 0) -> ImpactProblem:
    """A problem of an arm with another target, another contact and room for its duration."""
    rng = np.random.default_rng([seed, number])
    problem = load_problem(PROBLEMS[number % len(PROBLEMS)])
    kind = (Board, Nail, FreeMass)[number // len(PROBLEMS) % 3]
    objectives = (Impulse(),) if rng.random() < 0.5 or kind is FreeMass else problem.objectives
    if kind is not Nail and any(o.name == "target energy" for o in objectives):
        objectives = (Impulse(),)
    return replace(
        problem,
        name=f"{number}",
        target=_target(kind, rng),
        law=_law(kind, rng),
        objectives=objectives,
        contact_duration=(0.0, LONGEST),
    )


def _target(kind: type[Target], rng: np.random.Generator) -> Target:
    if kind is Board:
        return Board(
            mass=_between(rng, 0.05, 1.0),
            stiffness=_between(rng, 1e4, 3e5),
            breaking_force=_between(rng, 50.0, 1000.0),
            damping=float(rng.uniform(0.0, 30.0)),
        )
    if kind is Nail:
        return Nail(
            mass=_between(rng, 0.01, 0.2),
            resistance=_between(rng, 100.0, 2000.0),
            hardening=_between(rng, 1e3, 1e5),
        )
    return FreeMass(mass=_between(rng, 0.1, 10.0))


def _law(kind: type[Target], rng: np.random.Generator) -> ContactLaw:
    """Its damping is a ratio of that of a kilogram; nails have laws that are the same in both phases."""
    stiffness, ratio = _between(rng, 1e3, 1e8), float(rng.uniform(0.0, 0.3))
    which = rng.integers(3)
    if which == 2:
        return HuntCrossley(stiffness=stiffness, dissipation=float(rng.uniform(0.0, 0.5)))
    law = KelvinVoigt if which or kind is Nail else SpringDamper
    return law(stiffness=stiffness, damping=2 * ratio * np.sqrt(stiffness))


def _between(rng: np.random.Generator, least: float, most: float) -> float:
    """Drawn by its logarithm."""
    return float(np.exp(rng.uniform(np.log(least), np.log(most))))


def _row(number: int, seed: int, say: Say) -> dict[str, Any]:
    problem = drawn_problem(number, seed)
    out: dict[str, Any] = {
        "number": number,
        "problem": PROBLEMS[number % len(PROBLEMS)],
        "target": problem.target.word,
        "law": type(problem.law).__name__,
        "stiffness": f"{problem.law.parameters['stiffness']:.2g}",
        "false": False,
    }
    try:
        solution = solve(problem, time_limit=TIME_LIMIT)
    except InputError as error:
        say(f"{number}: {error}")
        return out | {"status": "refused", "message": str(error)}
    replay = solution.contact_replay
    out |= {
        "status": solution.status.value,
        "message": solution.result.message,
        "impulse_Ns": solution.impulse,
        "seconds": solution.solve_seconds,
        "elements_pct": solution.contact_error_pct,
        "contact_pct": None if replay is None else replay.impulse_pct,
        "caution": solution.caution,
        "told": bool(solution.caution) or solution.status is not Status.SOLVED,
    }
    for engine in ("pinocchio", "mujoco") if solution.status.usable else ():
        try:
            found = solution.validate(engine=engine)
        except InputError as error:
            out[f"{engine}_error"] = str(error)
            continue
        pct = 100 * (solution.impulse / found.impulse - 1) if found.impulse > 0 else np.inf
        out[f"{engine}_pct"], out[f"{engine}_steps_pct"] = pct, 100 * found.step_error
    # what an engine is off by itself, from twice its step, says nothing about the plan
    worst = max(
        abs(out.get(f"{engine}_pct", 0.0)) - out.get(f"{engine}_steps_pct", 0.0)
        for engine in ("pinocchio", "mujoco")
    )
    out["false"] = solution.status is Status.SOLVED and worst > SOLVED_WITHIN and not solution.caution
    say(", ".join(f"{key} {out.get(key)}" for _, key, _ in COLUMNS[:-1] if key) + f", {out['false']}")
    return out
