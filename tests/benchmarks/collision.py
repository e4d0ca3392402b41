"""Run time of a collision against its error: every method and setting on the same blow, timed in one run.

The error is against converged full dynamics. Where a time is a bound from below, without the part that would
need the interpreter, its row has no error and says so in `note`.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from support.exact import ExactCollision

from benchmarks.clock import medians, runner, shortest
from benchmarks.methods import Entry, entries
from benchmarks.peers import mujoco_rollouts, pinocchio_calls
from benchmarks.pictures.pareto import pareto_picture
from benchmarks.report import Report, Say, cell, columns_table, make_table
from benchmarks.setup import (
    EVALUATION,
    MOTIONS,
    Setup,
    compiled_gradient,
    inputs,
    outcome,
    run_of,
)
from impactopt.collision import SDC, Collision
from impactopt.simulation.cases import errors_against
from impactopt.simulation.reference import FullDynamics

# calls of some 30 ms: of 200 collisions, checks of the inputs and a thread's start would be a tenth of the
# time, where MuJoCo's threads are started before
BATCH, ROLLOUTS = 2000, 2
DEFAULT = ("sdc", "tolerance 1e-07")
ERRORS = (
    ("impulse %", "impulse_error_pct", 4),
    ("peak %", "peak_force_error_pct", 4),
    ("ZMP mm", "zmp_error_mm", 4),
    ("torque %", "torque_error_pct", 4),
)
COLUMNS = (("method", "method", 0), ("setting", "setting", 0), ("time us", "time_us", 1), *ERRORS)
KEYS = tuple(key for _, key, _ in ERRORS)


def run(say: Say, *, setups: Sequence[Setup] | None = None, quick: bool = False, repeats: int = 15) -> Report:
    """One row a robot, method and setting; quick: the stand-in only, with few of them."""
    setups = list(setups or (Setup.of(name) for name in (("standin",) if quick else MOTIONS)))
    rows: list[dict[str, Any]] = []
    numbers: dict[str, Any] = {
        "rows": rows,
        "defaults": {},
        "profile": {},
        "cases": {},
        "load": os.getloadavg(),
    }
    for setup in setups:
        say(f"{setup.name}: converged full dynamics")
        case = setup.case
        model = setup.model(FullDynamics, step=1e-4)
        true, _ = model.converged(case.q, case.v, case.torque)
        numbers["cases"][setup.name] = {
            "case": case.name,
            "impulse_Ns": true.impulse,
            "duration_s": true.duration,
        }
        found, refused = entries(setup, true, say, quick)
        say(f"{setup.name}: timing {len(found)} methods and settings")
        own = timed_rows(setup, found, refused, true, repeats)
        rows += own
        say(f"{setup.name}: gradient, batches, stages")
        numbers["defaults"][setup.name] = default_of(setup, true, own, repeats)
        numbers["profile"][setup.name] = profile(setup, repeats)
    numbers["default"] = numbers["defaults"][setups[0].name]
    return Report(
        name="collision",
        numbers=numbers,
        tables=tables_of(numbers),
        figures={"collision": lambda: pareto_picture(rows)},
    )


def timed_rows(
    setup: Setup, found: Sequence[Entry], refused: Sequence[dict[str, Any]], true: Collision, repeats: int
) -> list[dict[str, Any]]:
    """Rows with times and errors; errors are None where nothing is known of the outcome."""
    names = {f"{e.method}|{e.setting}": e for e in found}
    times = medians(
        {name: e.run for name, e in names.items()}, repeats=repeats, longest=2.0, clock=time.thread_time
    )
    rows = []
    for name, e in names.items():
        row: dict[str, Any] = {"robot": setup.name, "method": e.method, "setting": e.setting}
        row |= {"time_us": 1e6 * times[name], **dict.fromkeys(KEYS)}
        if e.impulse is not None:
            row["impulse_error_pct"] = 100 * (e.impulse / true.impulse - 1)
        if e.result is not None:
            errors = errors_against(e.result, true, torque_limit=setup.case.robot.torque_limit)
            row |= {KEYS[0]: errors[KEYS[0]], KEYS[1]: errors["f_max_error_pct"]}
            row |= {key: errors[key] for key in KEYS[2:]}
        rows.append({**row, "note": e.note})
    empty = {"time_us": None, **dict.fromkeys(KEYS)}
    return rows + [{"robot": setup.name, **empty, **row} for row in refused]


def default_of(setup: Setup, true: Collision, rows: Sequence[dict[str, Any]], repeats: int) -> dict[str, Any]:
    """What the default model takes, and ratios to the others of the same run."""
    case, model = setup.case, setup.model(SDC)
    at = {(r["method"], r["setting"]): r["time_us"] for r in rows}
    own = at[DEFAULT]

    def ratio(method: str, setting: str) -> float | None:
        other = at.get((method, setting))
        return None if other is None else other / own

    exact = ExactCollision(setup.model(SDC)).collide(case.q, case.v, case.torque)
    gradient = runner(compiled_gradient(model, "impulse"), inputs(model, case))
    usual = runner(model.function(("impulse",)), [case.q, case.v, case.torque])
    runs = {"value": run_of(model, case, ("impulse",)), "gradient": gradient, "function": usual}
    value = medians(runs, repeats=repeats, clock=time.thread_time)
    throughput = batches(setup, true, 3 * repeats)
    return {
        "time_us": own,
        "impulse_alone_us": 1e6 * value["value"],
        "impulse_by_function_us": 1e6 * value["function"],
        "integration_error": abs(outcome(model, case).impulse / exact.impulse - 1),
        "speedup_vs_mujoco_1e-4": ratio("MuJoCo, loop in Python", "0.0001 s"),
        "speedup_vs_mujoco_1e-4_steps_alone": ratio("MuJoCo, steps alone", "0.0001 s"),
        "speedup_vs_paper_rk4_1e-4": ratio("paper, by hand", "0.0001 s"),
        "speedup_vs_paper_rk4_1e-4_casadi": ratio("paper, CasADi's C", "0.0001 s"),
        "gradient_us": 1e6 * value["gradient"],
        "gradient_cost_ratio": value["gradient"] / value["value"],
        **throughput,
    }


def batches(setup: Setup, true: Collision, repeats: int) -> dict[str, Any]:
    """Collisions a second on one core and two: ours (impulse alone), and MuJoCo's own rollouts of steps."""
    case, model = setup.case, setup.model(SDC)
    q, v = np.tile(case.q, (BATCH, 1)), np.tile(case.v, (BATCH, 1))
    v *= np.linspace(0.8, 1.2, BATCH)[:, None]
    runs: dict[str, Callable[[], Any]] = {}
    for k in (1, 2):
        runs[f"ours {k}"] = partial(model.batch, q, v, case.torque, outputs=("impulse",), threads=k)
        runs[f"mujoco {k}"] = mujoco_rollouts(setup, 1e-4, true.duration, ROLLOUTS, k)
    times = shortest(runs, repeats=repeats)
    return {
        "impacts_per_second_1_core": BATCH / times["ours 1"],
        "impacts_per_second_2_cores": BATCH / times["ours 2"],
        "scaling_2_cores": times["ours 1"] / times["ours 2"],
        "mujoco_rollouts_per_second_1_core": ROLLOUTS / times["mujoco 1"],
        "mujoco_rollouts_per_second_2_cores": ROLLOUTS / times["mujoco 2"],
        "mujoco_scaling_2_cores": times["mujoco 1"] / times["mujoco 2"],
    }


def profile(setup: Setup, repeats: int) -> dict[str, float]:
    """[us] of our stages, by differences of functions that contain more and more; and Pinocchio's functions
    less their call from Python."""
    case, model = setup.case, setup.model(SDC)
    short = setup.model(SDC, horizon=1e-9)  # one step
    wanted = tuple(name for name in EVALUATION if name in model.available)
    ours = {
        "freeze": run_of(short, case, ("impulse",)),
        "impulse": run_of(model, case, ("impulse",)),
        "all": run_of(model, case, wanted),
    }
    theirs = {f"pinocchio {name}": call for name, call in pinocchio_calls(setup).items()}
    found = medians({**ours, **theirs}, repeats=repeats, clock=time.thread_time)
    times = {name: 1e6 * t for name, t in found.items()}
    out = {
        "freeze_and_a_step_us": times["freeze"],
        "other_steps_us": times["impulse"] - times["freeze"],
        "outputs_us": times["all"] - times["impulse"],
    }
    overhead = times["pinocchio call"]
    return out | {f"{k}_us": times[k] - overhead for k in theirs if k != "pinocchio call"}


def tables_of(numbers: dict[str, Any]) -> tuple[Any, ...]:
    """One a robot, and one of the default's ratios and stages."""
    tables = []
    for robot in dict.fromkeys(r["robot"] for r in numbers["rows"]):
        own = [r for r in numbers["rows"] if r["robot"] == robot]
        title = f"{robot}: time of a collision, error against full dynamics"
        tables.append(columns_table(title, COLUMNS, own))
        rows = [
            [key.replace("_", " "), cell(x, ".4g")]
            for part in ("defaults", "profile")
            for key, x in numbers[part][robot].items()
        ]
        tables.append(make_table(f"{robot}: the default, and its stages", ["", ""], rows))
    return tuple(tables)
