"""Time of a plan over its truth: every model of the collision that a plan can have in it.

Each problem is solved from one plain start with each model, and the plan is replayed in full dynamics, on
fixed soles; whether it stands is said by MuJoCo, on free ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from benchmarks.report import Report, Say, columns_table
from impactopt import Solution
from impactopt.errors import InputError
from impactopt.files.problem_file import load_problem
from impactopt.planning.solve import solve
from impactopt.problem.checks import INSTANT
from impactopt.problem.problem import ImpactProblem
from impactopt.simulation.engines import has_mujoco

# a long push, a stiff hammer's blow, a light humanoid, an arm
PROBLEMS = ("punch", "nailing", "punch_g1", "arm7")
QUICK = ("arm_planar", "arm7")
MODELS = (("virtual-mass", 0), ("sdc-paper", 0), ("sdc", 0), ("sdc", 4), ("full", 0), ("auto", 0))
TIME_LIMIT = 120.0  # [s] of the solver
COLUMNS = (
    ("problem", "problem", 0),
    ("model", "model", 0),
    ("freezes", "freezes", 0),
    ("s", "seconds", 2),
    ("iterations", "iterations", 0),
    ("planned N s", "planned_Ns", 3),
    ("replayed", "replayed_Ns", 3),
    ("error %", "error_pct", 2),
    ("ZMP margin mm", "zmp_margin_planned_mm", 1),
    ("replayed", "zmp_margin_replayed_mm", 1),
    ("stands", "stands", 0),
)
KEYS = (*(key for _, key, _ in COLUMNS), "status", "chosen", "model_error_pct", "reason")


def run(
    say: Say,
    *,
    quick: bool = False,
    problems: Sequence[str] = (),
    models: Sequence[tuple[str, int]] = MODELS,
) -> Report:
    """One row a problem and model.  quick : two arms only, if no problems are named."""
    rows = []
    for name in problems or (QUICK if quick else PROBLEMS):
        problem = load_problem(name)
        for model, freezes in models:
            say(f"{name}: {model}" + (f", {freezes} freezes" if freezes else ""))
            own = {**dict.fromkeys(KEYS), "problem": name, "model": model, "freezes": freezes}
            try:
                rows.append({**own, **_row(_with_model(problem, model, freezes), say)})
            except InputError as error:  # a model that does not know the law or the target stays in
                rows.append({**own, "reason": str(error)})
    title = "plans by the model of their collision, replayed in full dynamics"

    def picture() -> Any:
        from benchmarks.pictures.models import models_picture

        return models_picture(rows)

    return Report(
        name="models",
        numbers={"rows": rows},
        tables=(columns_table(title, COLUMNS, rows),),
        figures={"models": picture},
    )


def _with_model(problem: ImpactProblem, model: str, freezes: int) -> ImpactProblem:
    """The problem with another model; those of no duration know no scenarios."""
    known = () if model in INSTANT else problem.scenarios
    return replace(problem, collision=model, freezes=freezes, scenarios=known)


def _row(problem: ImpactProblem, say: Say) -> dict[str, Any]:
    """What a plan promises, and what comes of it."""
    solution = solve(problem, time_limit=TIME_LIMIT, report=say)
    found = {
        "seconds": solution.solve_seconds,
        "iterations": solution.result.iterations,
        "status": solution.status.value,
        "chosen": solution.problem.collision,
        "planned_Ns": solution.impulse,
    }
    if solution.model_error is not None:
        found["model_error_pct"] = solution.model_error.impulse_pct
    if not solution.status.usable:
        return {**found, "reason": solution.result.message}
    planned = solution.margins().get("zmp_margin_m", {})
    return {**found, "zmp_margin_planned_mm": _in_mm(planned), **_replayed(solution)}


def _replayed(solution: Solution) -> dict[str, Any]:
    held = solution.validate()
    plan = solution.plan
    told = held.summary(
        torque_limit=solution.problem.robot.torque_limit, polygon=plan.polygon, planned_impulse=plan.impulse
    )
    out = {
        "replayed_Ns": held.impulse,
        "error_pct": 100 * (plan.impulse / held.impulse - 1) if held.impulse else None,
        "zmp_margin_replayed_mm": _in_mm(told.get("zmp_margin_m", {})),
    }
    if solution.problem.robot.floating and has_mujoco():
        out["stands"] = bool(solution.validate(engine="mujoco").standing)
    return out


def _in_mm(margins: dict[str, float]) -> float | None:
    return 1e3 * margins["collision"] if "collision" in margins else None
