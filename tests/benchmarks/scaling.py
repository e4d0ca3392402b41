"""What a collision costs over degrees of freedom, over the step, and over the size of a batch.

Over degrees of freedom, split as the paper's count of operations is (its eq. 20): the freeze, done once, and
the time loop. Ours finds its own few steps where the paper's takes a thousand: so a stage of the paper's
Runge-Kutta scheme, in our C, stands beside its count of one.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import casadi as ca
import numpy as np
from support.exact import ExactCollision

from benchmarks.cases import Case
from benchmarks.clock import medians, shortest
from benchmarks.costs import TreeSize, cost_sdc, even_tree, iterations
from benchmarks.pictures.scaling import scaling_picture
from benchmarks.report import Report, Say, columns_table
from benchmarks.scaling_robots import depth, humanoid_setups, tip_setup
from benchmarks.setup import Setup, compiled, inputs, run_of
from impactopt.collision import SDC
from impactopt.collision.symbolic import SymbolicModel
from impactopt.errors import InputError
from impactopt.simulation.workers import map_on_workers

CHAINS = (2, 4, 8, 16, 24, 32, 48, 64, 100)
TREES = (8, 16, 32, 48, 64, 80, 100)  # of four limbs
HUMANOIDS = ("standin", "talos", "g1")
QUICK_CHAINS, QUICK_TREES = (2, 8, 16, 24), (8, 16, 32)
STEPS = (5e-4, 2.5e-4, 1e-4, 5e-5, 1e-5)  # [s] of the paper's scheme
TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9)  # of the steps that find their own length
BATCHES = (1, 10, 100, 1000)
STAGES = 4  # of a Runge-Kutta step
PAPER_STEP = 1e-4  # [s]
WANTED = ("impulse", "duration")
OVER_DOF = (
    ("robot", "robot", 0),
    ("joints", "n", 0),
    ("collision us", "time_us", 1),
    ("freeze us", "freeze_us", 2),
    ("loop us", "loop_us", 1),
    ("a stage us", "stage_us", 3),
    ("paper: once", "paper_once", 0),
    ("a stage", "paper_stage", 0),
)
EXPONENTS = (
    ("robot", "robot", 0),
    ("time of", "part", 0),
    ("joints from", "from", 0),
    ("to", "to", 0),
    ("exponent", "exponent", 2),
    ("paper's formula", "paper", 2),
)
OVER_STEP = (
    ("method", "method", 0),
    ("step s", "step_s", "g"),
    ("tolerance", "tolerance", "g"),
    ("collision us", "time_us", 1),
    ("integration error", "integration_error", ".1e"),
    ("paper: operations", "paper_operations", 0),
)
OVER_BATCH = (
    ("batch", "batch", 0),
    ("threads", "threads", 0),
    ("us each", "time_us", 1),
    ("a second", "impacts_per_second", 0),
)


def run(
    say: Say,
    *,
    chains: Sequence[int] | None = None,
    trees: Sequence[int] | None = None,
    humanoids: Sequence[str] = HUMANOIDS,
    setup: Setup | None = None,
    steps: Sequence[float] = STEPS,
    tolerances: Sequence[float] = TOLERANCES,
    batches: Sequence[int] = BATCHES,
    workers: int = 2,
    quick: bool = False,
    repeats: int = 25,
) -> Report:
    """Rows over "dof", "step" and "batch", and the exponents of cost in the number of joints.

    humanoids : presets; those that are not installed are left out.  setup : of steps and batches.
    workers : processes that compile.
    quick : no more than 32 joints, the stand-in only, and a few steps.
    """
    chains = chains or (QUICK_CHAINS if quick else CHAINS)
    trees = trees or (QUICK_TREES if quick else TREES)
    if quick:
        humanoids, steps, tolerances = humanoids[:1], steps[1:3], tolerances[:2]
    setup = setup or Setup.of("standin")
    setups = [tip_setup("chain", n) for n in chains] + [tip_setup("tree", n) for n in trees]
    setups += humanoid_setups(humanoids, say)
    stages = [stage_model(one) for one in setups]
    of_steps = step_models(setup, steps, tolerances)
    whole = [one.model(SDC) for one in setups]
    compile_all([*whole, *(m for m in stages if m is not None), *of_steps], say, workers)
    say("measuring")
    rows = over_dof(setups, stages, repeats)
    powers = exponents(rows)
    rows += over_step(setup, of_steps, repeats) + over_batch(setup, batches, repeats)
    return Report(
        name="scaling",
        numbers={"rows": rows, "exponents": powers},
        tables=tables_of(rows, powers),
        figures={"scaling": lambda: scaling_picture(rows, powers)},
    )


def compile_all(models: Sequence[SymbolicModel], say: Say, workers: int) -> None:
    """Their functions into the cache on disk, what takes longest first."""
    # the tree's code grows so
    longest_first = sorted(models, key=lambda m: -m.robot.n * depth(m.robot) ** 2)
    map_on_workers(
        compile_one,
        None,
        longest_first,
        workers=workers,
        crashed=lambda _code: None,  # what needs the function says it better
        progress=lambda done, of: say(f"functions compiled: {done} of {of}"),
    )


def compile_one(_shared: None, model: SymbolicModel) -> None:
    compiled(model, WANTED)


def numbers_of(model: SymbolicModel, case: Case) -> dict[str, float]:
    """WANTED of the compiled function."""
    found = compiled(model, WANTED).call([ca.DM(x) for x in inputs(model, case)])
    return {name: float(x) for name, x in zip(WANTED, found, strict=True)}


# ---------------------------------------------------------------- degrees of freedom
def parted(case: Case) -> Case:
    """With the hand going away: frozen, and over before the first step."""
    return replace(case, v=-case.v)


def stage_model(setup: Setup) -> SymbolicModel | None:
    """The paper's scheme on the same frozen dynamics; None of chains: it does not know a tree's shape, and
    those take long to compile."""
    if setup.name == "chain":
        return None
    model = setup.model(SDC, method="rk4")
    # a step that is stable on all of them, whatever has been drawn
    step = min(PAPER_STEP, 0.5 * model.stable_step(setup.case.q))
    staged: SymbolicModel = replace(model, step=step)
    return staged


def over_dof(
    setups: Sequence[Setup], stages: Sequence[SymbolicModel | None], repeats: int
) -> list[dict[str, Any]]:
    """Time of a collision, of its freeze and its time loop, and of a stage of the paper's scheme."""
    runs: dict[str, Callable[[], Any]] = {}
    for k, (setup, staged) in enumerate(zip(setups, stages, strict=True)):
        for name, model in (("whole", setup.model(SDC)), ("staged", staged)):
            if model is not None:
                runs[f"{k} {name}"] = run_of(model, setup.case, WANTED)
                runs[f"{k} {name} frozen"] = run_of(model, parted(setup.case), WANTED)
    # the best: code of megabytes is thrown out of the caches by whatever else runs
    found = shortest(runs, repeats=repeats, warm=True)
    times = {name: 1e6 * seconds for name, seconds in found.items()}
    rows = []
    for k, (setup, staged) in enumerate(zip(setups, stages, strict=True)):
        case, stage = setup.case, None
        n = case.robot.n
        if staged is not None:
            steps = np.ceil(numbers_of(staged, case)["duration"] / staged.step_length)
            stage = (times[f"{k} staged"] - times[f"{k} staged frozen"]) / (STAGES * max(1.0, steps))
        tree = TreeSize(n=n, arms=(n,), colliding=n) if setup.name == "chain" else even_tree(n)
        once = cost_sdc(tree, 0)
        rows.append(
            {
                "over": "dof",
                "robot": setup.name,
                "n": n,
                "velocities": case.robot.nv,
                "time_us": times[f"{k} whole"],
                "freeze_us": times[f"{k} whole frozen"],
                "loop_us": times[f"{k} whole"] - times[f"{k} whole frozen"],
                "stage_us": stage,
                "paper_once": once,
                "paper_stage": cost_sdc(tree, 1) - once,
            }
        )
    return rows


def exponents(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Of time in n, and of the paper's count in the same n: least squares through the logarithms, over the
    upper half of the sizes of chains and of trees."""
    found = []
    for kind in ("chain", "tree"):
        for part, time_of, count in (
            ("freeze", "freeze_us", "paper_once"),
            ("time loop", "loop_us", "paper_stage"),
            ("a stage", "stage_us", "paper_stage"),
        ):
            own = sorted(
                (r for r in rows if r["robot"] == kind and r[time_of] is not None and r[time_of] > 0),
                key=lambda r: float(r["n"]),
            )
            upper = own[len(own) // 2 :]
            if len(upper) < 2:
                continue
            n, y, paper = (np.log([float(r[key]) for r in upper]) for key in ("n", time_of, count))
            row = {"robot": kind, "part": part, "from": upper[0]["n"], "to": upper[-1]["n"]}
            slopes = {"exponent": np.polyfit(n, y, 1)[0], "paper": np.polyfit(n, paper, 1)[0]}
            found.append(row | {key: float(value) for key, value in slopes.items()})
    return found


# ---------------------------------------------------------------- step, batch
def step_models(setup: Setup, steps: Sequence[float], tolerances: Sequence[float]) -> list[SymbolicModel]:
    """Of all methods, as far as their steps are stable and not too many."""
    models: list[SymbolicModel] = [setup.model(SDC, tolerance=tolerance) for tolerance in tolerances]
    for step in steps:
        try:
            model = setup.model(SDC, method="rk4", step=step)
        except InputError:
            continue  # more steps than there may be
        if step < model.stable_step(setup.case.q):
            models.append(model)
    return models


def over_step(setup: Setup, models: Sequence[SymbolicModel], repeats: int) -> list[dict[str, Any]]:
    """Time and error of the frozen collision, against its exact solution."""
    case, default = setup.case, setup.model(SDC)
    exact = ExactCollision(setup.model(SDC)).collide(case.q, case.v, case.torque)
    runs = {str(k): run_of(model, case, WANTED) for k, model in enumerate(models)}
    times = medians(runs, repeats=repeats, clock=time.thread_time)
    rows = []
    for k, model in enumerate(models):
        own = model.stepping == "implicit"
        step = None if own else model.step_length
        count = None if step is None else iterations(step, exact.duration)
        rows.append(
            {
                "over": "step",
                "robot": setup.name,
                "method": model.stepping,
                "step_s": step,
                "tolerance": model.tolerance if own else None,
                "default": own and model.tolerance == default.tolerance,
                "time_us": 1e6 * times[str(k)],
                "integration_error": abs(numbers_of(model, case)["impulse"] / exact.impulse - 1),
                "paper_operations": None if count is None else cost_sdc(even_tree(case.robot.n), count),
            }
        )
    return rows


def over_batch(setup: Setup, sizes: Sequence[int], repeats: int) -> list[dict[str, Any]]:
    """Collisions a second by size of the batch, on one core and on two."""
    case, model = setup.case, setup.model(SDC)
    runs: dict[str, Callable[[], Any]] = {}
    for size in sizes:
        q, v = np.tile(case.q, (size, 1)), np.tile(case.v, (size, 1))
        for threads in (1, 2):
            call = partial(model.batch, q, v, case.torque, outputs=("impulse",), threads=threads)
            runs[f"{size} {threads}"] = call
    times = shortest(runs, repeats=repeats)
    return [
        {
            "over": "batch",
            "batch": size,
            "threads": threads,
            "time_us": 1e6 * times[f"{size} {threads}"] / size,
            "impacts_per_second": size / times[f"{size} {threads}"],
        }
        for size in sizes
        for threads in (1, 2)
    ]


def tables_of(rows: Sequence[dict[str, Any]], powers: Sequence[dict[str, Any]]) -> tuple[Any, ...]:
    """One a thing that it goes over, and one of the exponents."""
    of = {over: [r for r in rows if r["over"] == over] for over in ("dof", "step", "batch")}
    return (
        columns_table("over degrees of freedom", OVER_DOF, of["dof"]),
        columns_table("exponents in the number of joints", EXPONENTS, powers),
        columns_table(
            "over the step: the frozen collision against its exact solution", OVER_STEP, of["step"]
        ),
        columns_table("over the batch's size", OVER_BATCH, of["batch"]),
    )
