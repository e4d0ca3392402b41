"""How far is each collision model from full dynamics?

On each robot 27 collisions (`hierarchy.py`), with torque limits on. The reference is full dynamics with its
steps halved until the impulse stands still, and MuJoCo has the second word on it. What is measured is the
virtual mass, the paper's SDC, and ours with more and more freezes on the way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any

import numpy as np

from benchmarks.cases import PAPER_SPEEDS, Case
from benchmarks.hierarchy import (
    GAINS,
    HIERARCHY,
    HORIZON,
    LAW,
    MASS_RATIOS,
    TARGETS,
    Fidelity,
    situations,
)
from benchmarks.pictures.fidelity import fidelity_picture
from benchmarks.report import Report, Say, cell, columns_table, make_table
from impactopt.collision import Collision
from impactopt.errors import InputError
from impactopt.simulation.cases import errors_against
from impactopt.simulation.workers import map_on_workers

TOLERANCE = 1e-5  # relative, of the reference's impulse
ORDER_FROM = 2  # freezes

COLUMNS = (
    ("model", "label", 0),
    ("worst %", "worst_impulse_error_pct", 4),
    ("median %", "median_impulse_error_pct", 4),
    ("ZMP mm", "worst_zmp_error_mm", 2),
    ("torque %", "worst_torque_error_pct", 2),
    ("failed", "failed", 0),
    ("pushes", "pushes", 0),
)
PLACES = (
    ("model", "label", 0),
    ("worst impulse", "worst_impulse_error_at", 0),
    ("worst torque", "worst_torque_error_at", 0),
    ("joint", "worst_torque_joint", 0),
)
ERRORS = ("impulse_error_pct", "f_max_error_pct", "zmp_error_mm", "torque_error_pct")


@dataclass(frozen=True, kw_only=True)
class Task:
    """A collision by its place among a robot's, and what is asked of it."""

    robot: str
    index: int
    hierarchy: tuple[Fidelity, ...]
    mujoco: bool


def run(
    say: Say,
    *,
    robots: Sequence[str] | None = None,
    hierarchy: Sequence[Fidelity] | None = None,
    workers: int = 2,
    quick: bool = False,
) -> Report:
    """One row a robot and model; quick: three collisions of the stand-in, up to four freezes."""
    short = tuple(fidelity for fidelity in HIERARCHY if (fidelity.freezes or 0) in (0, 2, 4))
    names = tuple(robots or (("standin",) if quick else TARGETS))
    fidelities = tuple(hierarchy or (short if quick else HIERARCHY))
    # what takes longest to compile first, so that no process is left with it at the end
    compiled = [(name, fidelity) for fidelity in fidelities[::-1] for name in names]
    map_on_workers(
        compile_model,
        None,
        compiled,
        workers=workers,
        crashed=lambda _code: None,  # what needs the function says it better
        progress=lambda done, of: say(f"models compiled: {done} of {of}"),
    )
    tasks = [task for name in names for task in tasks_of(name, fidelities, quick)]
    found = map_on_workers(
        measured,
        None,
        tasks,
        workers=workers,
        crashed=_crashed,
        progress=lambda done, of: say(f"collisions: {done} of {of}"),
    )
    collisions = [{"robot": task.robot, **given} for task, given in zip(tasks, found, strict=True)]
    rows = [row_of(name, fidelity, collisions) for name in names for fidelity in fidelities]
    numbers = {
        "rows": rows,
        **orders(collisions, fidelities),
        **second_opinion(collisions),
        **_setting(names),
    }
    return Report(
        name="fidelity",
        numbers={**numbers, "collisions": collisions},
        tables=tables_of(rows, numbers),
        figures={"fidelity": lambda: fidelity_picture(rows)},
    )


# ---------------------------------------------------------------- collisions
def tasks_of(robot: str, hierarchy: tuple[Fidelity, ...], quick: bool) -> list[Task]:
    """MuJoCo gets those of a Latin square, nine of 27: each pair of posture, speed and gains once."""
    tasks = []
    places = product(range(len(MASS_RATIOS)), range(len(PAPER_SPEEDS)), range(len(GAINS)))
    for index, (i, j, k) in enumerate(places):
        if quick and not i == j == k:
            continue
        mujoco = i == j == k == 1 if quick else (i + j + k) % 3 == 0
        tasks.append(Task(robot=robot, index=index, hierarchy=hierarchy, mujoco=mujoco))
    return tasks


@cache
def _model(robot: str, fidelity: Fidelity) -> Any:
    return fidelity.make(robot)


def compile_model(_shared: None, given: tuple[str, Fidelity]) -> None:
    """The model's function into the cache on disk, by using it once."""
    robot, fidelity = given
    try:
        situations(robot)[0].collide(_model(robot, fidelity))
    except InputError:
        return  # said again, and kept, where the model is measured


def measured(_shared: None, task: Task) -> dict[str, Any]:
    """What reference, MuJoCo and models say of one collision; a model that refuses it is its reason."""
    case = situations(task.robot)[task.index]
    out: dict[str, Any] = {"case": case.name, "models": [], "mujoco_vs_pinocchio_pct": None, "reason": None}
    try:
        reference, change = _converged(case, Fidelity(model="reference"), task.robot, TOLERANCE)
    except InputError as error:
        return out | {"reason": f"reference: {error}"}
    out |= {
        "impulse_Ns": reference.impulse,
        "duration_s": reference.duration,
        "separated": reference.separated,
        "reference_change_Ns": change,
        "saturated_joints": _saturated(reference, case),
    }
    if task.mujoco:
        try:
            other, _ = _converged(case, Fidelity(model="mujoco"), task.robot, 1e-4)
            out["mujoco_vs_pinocchio_pct"] = 100 * (other.impulse / reference.impulse - 1)
        except InputError as error:
            out["reason"] = f"mujoco: {error}"
    out["models"] = [_compared(case, fidelity, task.robot, reference) for fidelity in task.hierarchy]
    return out


def _saturated(collision: Collision, case: Case) -> int:
    """Joints that are at their limit at some time."""
    over = np.abs(np.asarray(collision.demand)) > case.robot.torque_limit
    return int(over.any(axis=0).sum())


def _converged(case: Case, fidelity: Fidelity, robot: str, tolerance: float) -> tuple[Collision, float]:
    model = _model(robot, fidelity)
    options: dict[str, Any] = {"tolerance": tolerance, "require_separation": False, **case.overrides}
    found: tuple[Collision, float] = model.converged(case.q, case.v, case.torque, **options)
    return found


def _compared(case: Case, fidelity: Fidelity, robot: str, reference: Collision) -> dict[str, Any]:
    out: dict[str, Any] = {"model": fidelity.model, "freezes": fidelity.freezes, **dict.fromkeys(ERRORS)}
    out |= {"torque_joint": None, "separated": None, "reason": None}
    try:
        result = case.collide(_model(robot, fidelity))
    except InputError as error:
        return out | {"reason": str(error)}
    limit = case.robot.torque_limit
    out |= {**errors_against(result, reference, torque_limit=limit), "separated": result.separated}
    if out["torque_error_pct"] is not None:
        # alone, a joint has the error of all where it is the worst
        alone = [
            errors_against(
                result, reference, torque_limit=np.where(np.arange(limit.size) == j, limit, np.inf)
            )
            for j in range(limit.size)
        ]
        worst = int(np.argmax([errors["torque_error_pct"] or 0.0 for errors in alone]))
        out["torque_joint"] = case.robot.joint_names[worst]
    return out


def _crashed(code: int) -> dict[str, Any]:
    reason = f"its process ended with exit code {code}"
    return {"case": None, "models": [], "mujoco_vs_pinocchio_pct": None, "reason": reason}


# ---------------------------------------------------------------- what comes out
def row_of(robot: str, fidelity: Fidelity, collisions: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Worst and median over the robot's collisions, and where the worst are; `failed` have no error."""
    own = [c for c in collisions if c["robot"] == robot]
    pairs = [(c["case"], found) for c in own for found in _of(fidelity, c)]
    good = [(case, found) for case, found in pairs if found["impulse_error_pct"] is not None]
    row: dict[str, Any] = {"robot": robot, "model": fidelity.model, "freezes": fidelity.freezes}
    for what in ("impulse_error_pct", "zmp_error_mm", "torque_error_pct"):
        sized = [(abs(found[what]), case, found) for case, found in good if found[what] is not None]
        worst: tuple[Any, Any, Any] = max(sized, key=lambda entry: entry[0], default=(None, None, {}))
        row |= {f"worst_{what}": worst[0], f"worst_{what.rsplit('_', 1)[0]}_at": worst[1]}
        if what == "torque_error_pct":
            row["worst_torque_joint"] = worst[2].get("torque_joint")
    errors = [abs(found["impulse_error_pct"]) for _, found in good]
    row["median_impulse_error_pct"] = float(np.median(errors)) if errors else None
    pushes = [c["case"] for c in own if c.get("separated") is False]
    return row | {"collisions": len(own), "failed": len(own) - len(good), "pushes": pushes}


def _of(fidelity: Fidelity, collision: dict[str, Any]) -> list[dict[str, Any]]:
    return [
        m for m in collision["models"] if (m["model"], m["freezes"]) == (fidelity.model, fidelity.freezes)
    ]


def orders(collisions: Sequence[dict[str, Any]], hierarchy: Sequence[Fidelity]) -> dict[str, Any]:
    """Order in the number of freezes, from two on: of the worst impulse error, and of the median one.

    Minus the slope of a straight line through the logarithms; robots' own beside that of all together. None
    from fewer than two numbers of freezes.
    """
    fidelities = [
        fidelity for fidelity in hierarchy if fidelity.freezes is not None and fidelity.freezes >= ORDER_FROM
    ]
    out: dict[str, Any] = {"order_in_freezes": None, "order_in_freezes_median": None}
    by_robot = {}
    for name in (None, *dict.fromkeys(c["robot"] for c in collisions)):
        errors = [
            [
                abs(found["impulse_error_pct"])
                for c in collisions
                if name in (None, c["robot"])
                for found in _of(fidelity, c)
                if found["impulse_error_pct"] is not None
            ]
            for fidelity in fidelities
        ]
        if len(fidelities) < 2 or not all(errors):
            continue
        counts = np.log([float(fidelity.freezes or 0) for fidelity in fidelities])
        slopes = {
            key: -float(np.polyfit(counts, np.log([of(e) for e in errors]), 1)[0])
            for key, of in (("order_in_freezes", np.max), ("order_in_freezes_median", np.median))
        }
        if name is None:
            out |= slopes
        else:
            by_robot[name] = slopes
    return out | {"orders": by_robot}


def second_opinion(collisions: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The largest difference of MuJoCo's impulses from the reference's, and of how many collisions."""
    found = [
        abs(c["mujoco_vs_pinocchio_pct"]) for c in collisions if c["mujoco_vs_pinocchio_pct"] is not None
    ]
    return {"mujoco_vs_pinocchio_pct": max(found, default=None), "mujoco_collisions": len(found)}


def _setting(robots: Sequence[str]) -> dict[str, Any]:
    return {
        "law": {"stiffness_N_m": LAW.stiffness, "damping_Ns_m": LAW.damping},
        "targets_kg": {name: TARGETS[name] for name in robots},
        "mass_ratios": list(MASS_RATIOS),
        "speeds_m_s": list(PAPER_SPEEDS),
        "gains": list(GAINS),
        "horizon_s": HORIZON,
        "tolerance": TOLERANCE,
    }


def tables_of(rows: Sequence[dict[str, Any]], numbers: dict[str, Any]) -> tuple[Any, ...]:
    """One a robot, one of where the worst are, and one of the orders and of MuJoCo."""
    tables = []
    for robot in dict.fromkeys(r["robot"] for r in rows):
        own = [
            {
                **r,
                "label": Fidelity(model=r["model"], freezes=r["freezes"]).label,
                "pushes": len(r["pushes"]),
            }
            for r in rows
            if r["robot"] == robot
        ]
        title = f"{robot}: errors of {own[0]['collisions']} collisions against full dynamics"
        tables += [columns_table(title, COLUMNS, own), columns_table(f"{robot}: where", PLACES, own)]
    last = [
        ["order in freezes, of the worst impulse error", cell(numbers["order_in_freezes"], 2)],
        ["order in freezes, of the median", cell(numbers["order_in_freezes_median"], 2)],
        [
            f"MuJoCo against the reference, worst of {numbers['mujoco_collisions']} impulses, %",
            cell(numbers["mujoco_vs_pinocchio_pct"], 6),
        ],
    ]
    return (*tables, make_table("all robots", ["", ""], last))
