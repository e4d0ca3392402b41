"""What a collision costs over degrees of freedom, over the step, and over the size of a batch.

Over degrees of freedom, beside the paper's count of operations (its eq. 20), split as ours is: what is done
once, and what is done at every iteration, of which a Runge-Kutta step has four and ours six.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from impactopt.bench.clock import medians, shortest
from impactopt.bench.costs import Tree, cost_sdc, even_tree
from impactopt.bench.report import Report, Say, columns_table
from impactopt.bench.scene import Scene, compiled, inputs, run_of
from impactopt.bench.trees import random_robot, tip_speed
from impactopt.cases import Case
from impactopt.collision import SDC
from impactopt.collision.symbolic import SymbolicModel
from impactopt.errors import InputError
from impactopt.plotting.scaling import scaling_picture

CHAINS = (2, 4, 8, 16, 24, 32)  # the longest chains take a minute to compile
TREES = (8, 16, 32, 48, 64, 80, 100)  # of four limbs
HUMANOIDS = ("standin", "talos")
STEPS = (1e-3, 5e-4, 2.5e-4, 1e-4, 5e-5, 2e-5, 1e-5)  # [s]
BATCHES = (1, 10, 100, 1000)
X = np.array([1.0, 0.0, 0.0])
SPEED = 1.0  # [m/s] of the tip
OVER_DOF = (
    ("robot", "robot", 0),
    ("joints", "n", 0),
    ("freeze us", "freeze_us", 2),
    ("step us", "step_us", 3),
    ("steps", "steps", 0),
    ("collision us", "time_us", 1),
    ("paper: once", "paper_once", 0),
    ("a stage", "paper_iteration", 0),
)
OVER_STEP = (
    ("method", "method", 0),
    ("step s", "step_s", "g"),
    ("collision us", "time_us", 1),
    ("integration error", "integration_error", ".1e"),
)
OVER_BATCH = (
    ("batch", "batch", 0),
    ("threads", "threads", 0),
    ("us each", "time_us", 1),
    ("a second", "impacts_per_second", 0),
)
WANTED = ("impulse", "duration")


def run(
    say: Say,
    *,
    chains: Sequence[int] = CHAINS,
    trees: Sequence[int] = TREES,
    humanoids: Sequence[str] = HUMANOIDS,
    scene: Scene | None = None,
    steps: Sequence[float] = STEPS,
    batches: Sequence[int] = BATCHES,
    quick: bool = False,
    repeats: int = 25,
) -> Report:
    """Rows over "dof", "step" and "batch"; quick: no more than 32 joints, and the stand-in only."""
    if quick:
        chains, trees = ([n for n in sizes if n <= 32] for sizes in (chains, trees))
        humanoids = humanoids[:1]
    scene = scene or Scene.of("standin")
    known = {scene.name: scene}
    scenes = [("chain", n, tip_scene(n, 1)) for n in chains]
    scenes += [("tree", n, tip_scene(n, 4)) for n in trees]
    for name in humanoids:
        one = known.get(name) or Scene.of(name)
        scenes.append((name, one.case.robot.n, one))
    rows = over_dof(scenes, say, repeats) + over_step(scene, steps, say, repeats)
    say("batches")
    rows += over_batch(scene, batches, repeats)
    return Report(
        name="scaling",
        numbers={"rows": rows},
        tables=tables_of(rows),
        figures={"scaling": lambda: scaling_picture(rows)},
    )


def tip_scene(n: int, limbs: int) -> Scene:
    """A random chain or tree whose tip strikes at SPEED, with the least joint velocities that do."""
    robot, q = random_robot(n, limbs=limbs), np.random.default_rng(1).uniform(-1, 1, size=n)
    row = np.array([tip_speed(robot, q, e) for e in np.eye(n)])
    v = SPEED * row / (row @ row)
    case = Case(
        robot=robot,
        name=f"{n} joints",
        striker="tip",
        normal=X,
        q=q,
        v=v,
        torque=np.zeros(n),
        effective_mass=np.nan,
        speed=SPEED,
    )
    return Scene(name=robot.name, case=case)


def numbers_of(model: SymbolicModel, case: Case) -> dict[str, float]:
    """WANTED of the compiled function."""
    found = compiled(model, WANTED).call([ca.DM(x) for x in inputs(model, case)])
    return {name: float(x) for name, x in zip(WANTED, found, strict=True)}


# ---------------------------------------------------------------- degrees of freedom
def over_dof(scenes: Sequence[tuple[str, int, Scene]], say: Say, repeats: int) -> list[dict[str, Any]]:
    """Time of a freeze and of a step, from collisions of one step and of all."""
    runs: dict[str, Callable[[], Any]] = {}
    steps: dict[str, int] = {}
    for kind, n, scene in scenes:
        say(f"{kind} of {n} joints")
        # a step that is stable on all of them, whatever has been drawn
        model = scene.model(SDC)
        step = min(model.step_length, 0.5 * model.stable_step(scene.case.q))
        model = replace(model, step=step)
        runs[f"{kind} {n}"] = run_of(model, scene.case, WANTED)
        runs[f"{kind} {n} short"] = run_of(replace(model, horizon=step), scene.case, WANTED)
        steps[f"{kind} {n}"] = round(numbers_of(model, scene.case)["duration"] / step)
    times = medians(runs, repeats=repeats, clock=time.thread_time)
    rows = []
    for kind, n, scene in scenes:
        name = f"{kind} {n}"
        each = (times[name] - times[f"{name} short"]) / max(1, steps[name] - 1)
        tree = even_tree(n) if kind != "chain" else Tree(n=n, arms=(n,), colliding=n)
        once = cost_sdc(tree, 0)
        rows.append(
            {
                "over": "dof",
                "robot": kind,
                "n": n,
                "freeze_us": 1e6 * (times[f"{name} short"] - each),
                "step_us": 1e6 * each,
                "steps": steps[name],
                "time_us": 1e6 * times[name],
                "paper_once": once,
                "paper_iteration": cost_sdc(tree, 1) - once,
                "velocities": scene.case.robot.nv,
            }
        )
    return rows


# ---------------------------------------------------------------- step, batch
def over_step(scene: Scene, steps: Sequence[float], say: Say, repeats: int) -> list[dict[str, Any]]:
    """Time and error of the frozen collision, against its exact solution, of both methods."""
    case = scene.case
    exact = scene.model(SDC, method="exact").collide(case.q, case.v, case.torque)
    rows, runs = [], {}
    for method in ("events", "rk4"):
        for step in steps:
            try:
                model = scene.model(SDC, method=method, step=step)
            except InputError:
                continue  # more steps than there may be
            if step >= model.stable_step(case.q):
                continue
            say(f"{method}, {step:g} s")
            runs[f"{method} {step}"] = run_of(model, case, WANTED)
            error = abs(numbers_of(model, case)["impulse"] / exact.impulse - 1)
            rows.append({"over": "step", "method": method, "step_s": step, "integration_error": error})
    times = medians(runs, repeats=repeats, clock=time.thread_time)
    return [{**row, "time_us": 1e6 * times[f"{row['method']} {row['step_s']}"]} for row in rows]


def over_batch(scene: Scene, sizes: Sequence[int], repeats: int) -> list[dict[str, Any]]:
    """Collisions a second by size of the batch, on one core and on two."""
    case, model = scene.case, scene.model(SDC)
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


def tables_of(rows: Sequence[dict[str, Any]]) -> tuple[Any, ...]:
    """One a thing that it goes over."""
    of = {over: [r for r in rows if r["over"] == over] for over in ("dof", "step", "batch")}
    return (
        columns_table("over degrees of freedom", OVER_DOF, of["dof"]),
        columns_table(
            "over the step: the frozen collision against its exact solution", OVER_STEP, of["step"]
        ),
        columns_table("over the batch's size", OVER_BATCH, of["batch"]),
    )
