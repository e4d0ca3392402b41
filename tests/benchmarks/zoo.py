"""Does planning hold up on problems that nobody has tuned? Drawn punches, or every problem that there is.

One row a problem: what was drawn, how the solver ended from its one plain start, and what became of the plan
on free soles (MuJoCo), with nothing held. No row is left out: an exception is a row too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from oracle.verdict import verify_record

from benchmarks.kept import Kept
from benchmarks.planning import DEMO, solved
from benchmarks.report import Report, Say, columns_table
from benchmarks.truth import least_of_soles, sole_shares
from impactopt import Solution
from impactopt.contact.laws import SpringDamper
from impactopt.contact.targets import FreeMass
from impactopt.errors import InputError, did_you_mean
from impactopt.files.output import record_of
from impactopt.files.problem_file import load_problem, read_problem_file
from impactopt.kinematics.operational_space import across
from impactopt.planning.solve import solve
from impactopt.problem.feasibility import hopeless
from impactopt.problem.problem import ImpactProblem

Array = NDArray[np.float64]
ROWS = Path("results/bench/zoo.jsonl")
TIME_LIMIT = 300.0  # [s] of the solver, for drawn problems: G1 takes up to two minutes with its bodies
TRIES = 50  # points drawn for one problem until one is within reach

MASS = (0.5, 20.0)  # [kg]
STIFFNESS = (2e3, 1e5)  # [N/m]
DAMPING_RATIO = (0.05, 1.0)
SWING = (0.6, 1.2)  # [s]
TILT = np.radians(25.0)  # of the normal from the file's, at most


@dataclass(frozen=True, kw_only=True)
class Base:
    """What problems are drawn about.

    file : whose point, normal, terms and mesh are taken.  around (3,) [m] : half the sides of the box about
    its point; robots with shorter arms have smaller ones.
    """

    file: str
    around: tuple[float, float, float]


BASES = {
    "talos": Base(file="punch.toml", around=(0.15, 0.20, 0.25)),
    "g1": Base(file="punch_g1.toml", around=(0.10, 0.12, 0.15)),
    "standin": Base(file="punch_standin.toml", around=(0.15, 0.20, 0.25)),
}

DRAWN = (
    ("problem", "problem", 0),
    ("striker", "striker", 0),
    ("mass kg", "mass_kg", 1),
    ("k N/m", "stiffness_N_m", ".1e"),
    ("d N s/m", "damping_N_s_m", 0),
    ("zeta", "damping_ratio", 2),
    ("swing s", "swing_s", 2),
)
FOUND = (
    ("problem", "problem", 0),
    ("status", "status", 0),
    ("steps", "iterations", 0),
    ("s", "seconds", 1),
    ("N s", "impulse_planned_Ns", 2),
    ("error %", "error_pct", 2),
    ("stands", "stands", 0),
    ("clean", "clean", 0),
    ("mm", "clearance_mm", 0),
    ("CoP planned", "cop_planned", 2),
    ("held", "cop_held", 2),
    ("force held", "force_held", 2),
    ("free N", "force_free_N", 0),
)


def run(
    say: Say,
    *,
    random: int | None = None,
    robot: str | None = None,
    seed: int = 0,
    resume: bool = False,
    rows: Path = ROWS,
    folder: Path = DEMO.parent,
) -> Report:
    """One row a problem.

    random : so many drawn problems, of the robots in turn; None: every file of the folder whose name does
    not end in "infeasible".  robot : only this one's.  seed : of the draws; a robot's problem of a number is
    the same however many are drawn.  rows : file that keeps every row as it comes, a JSON object a line.
    resume : do not repeat rows that it has.

    Raises
    ------
    InputError : an unknown robot; no problem at all; the file of rows cannot be written or read.
    """
    jobs = _files(folder, robot, say) if random is None else _drawn(random, robot, seed, folder, say)
    if not jobs:
        raise InputError(f"no problem to solve in {folder}" + (f" for the robot {robot}" if robot else ""))
    kept = Kept(rows, ("problem", "seed"), resume=resume)
    found = []
    for k, (key, plan) in enumerate(jobs.items(), start=1):
        if key not in kept.found:
            kept.add({"seed": key[1], **row(key[0], plan)})
        found.append({name: value for name, value in kept.found[key].items() if name != "seed"})
        say(f"{k} of {len(jobs)}: {_told(found[-1])}")
    numbers = {**_counts(found), "seed": seed, "rows": found}
    title = (
        f"{numbers['problems']} problems: {numbers['solved']} solved, {numbers['standing']} stand, "
        f"{'-' if numbers['clean'] is None else numbers['clean']} clean"
    )
    drawn = () if random is None else (columns_table(f"drawn, seed {seed}", DRAWN, found),)
    return Report(name="zoo", numbers=numbers, tables=(*drawn, columns_table(title, FOUND, found)))


# ---------------------------------------------------------------- drawing
def draw(base: ImpactProblem, around: Sequence[float], rng: np.random.Generator) -> dict[str, Any]:
    """What is drawn of a problem but its point, and ``points`` (TRIES, 3) [m] to be tried in turn.

    base : whose point, normal and striker are drawn about; its striker is named ``right_hand``.  around (3,)
    [m] : half the sides of the box.  Masses and stiffnesses are uniform in their logarithm, normals on the
    cap of the sphere, all else is uniform.
    """
    left = bool(rng.integers(2))
    mirror = np.array([1.0, -1.0 if left else 1.0, 1.0])
    offsets = rng.uniform(-1.0, 1.0, (TRIES, 3)) * around
    mass, stiffness = (float(np.exp(rng.uniform(*np.log(bounds)))) for bounds in (MASS, STIFFNESS))
    ratio = float(rng.uniform(*DAMPING_RATIO))
    return {
        "striker": "left_hand" if left else "right_hand",
        "points": mirror * base.point + offsets,
        "normal": _tilted(mirror * base.normal, rng),
        "mass_kg": mass,
        "stiffness_N_m": stiffness,
        "damping_ratio": ratio,
        "damping_N_s_m": 2.0 * ratio * float(np.sqrt(stiffness * mass)),
        "swing_s": float(rng.uniform(*SWING)),
    }


def _tilted(normal: Array, rng: np.random.Generator) -> Array:
    """A unit vector (3,) within TILT of the given one, uniform on that cap of the sphere."""
    along = rng.uniform(np.cos(TILT), 1.0)
    turn = rng.uniform(0.0, 2.0 * np.pi)
    side = np.array([np.cos(turn), np.sin(turn)]) @ across(normal)
    return np.asarray(along * normal + np.sqrt(1.0 - along**2) * side)


def drawn_problem(
    base: ImpactProblem, around: Sequence[float], rng: np.random.Generator, name: str = "drawn"
) -> tuple[ImpactProblem, dict[str, Any]]:
    """A problem about another one, and its drawn numbers as a row has them.

    Raises
    ------
    InputError : none of the drawn points can be reached, or `check` finds all of them hopeless.
    """
    numbers = draw(base, around, rng)
    points = numbers.pop("points")
    changes: dict[str, Any] = {
        "name": name,
        "striker": numbers["striker"],
        "normal": numbers["normal"],
        "target": FreeMass(mass=numbers["mass_kg"]),
        "law": SpringDamper(stiffness=numbers["stiffness_N_m"], damping=numbers["damping_N_s_m"]),
        "swing": replace(base.swing, duration=(numbers["swing_s"],) * 2),
    }
    why = ""
    for tries, point in enumerate(points, start=1):
        try:
            problem = replace(base, point=point, **changes)
        except InputError as error:  # of all that is drawn only a point can be refused
            why = str(error)
            continue
        found = hopeless(problem)  # the hand starts beyond the target, or balance does not reach it
        if not found:
            return problem, {**numbers, "point_m": point.tolist(), "points_drawn": tries}
        why = found[0]
    raise InputError(f"{name}: of {len(points)} points none makes a sound problem; the last one: {why}")


# ---------------------------------------------------------------- rows
Key = tuple[str, int | None]  # a row's problem and the seed of its draws; None: nothing was drawn
# fills the row's drawn numbers, so that a solve that fails has them too, and solves
PlanOf = Callable[[dict[str, Any]], Solution]


def _drawn(count: int, robot: str | None, seed: int, folder: Path, say: Say) -> dict[Key, PlanOf]:
    if robot is not None and robot not in BASES:
        near = did_you_mean(robot, BASES)
        raise InputError(f"nothing is drawn for the robot {robot!r}{near}: there are {', '.join(BASES)}")
    bases = cache(lambda name: load_problem(folder / BASES[name].file))
    robots = list(BASES) if robot is None else [robot]
    jobs: dict[Key, PlanOf] = {}
    for k in range(count):
        which, number = robots[k % len(robots)], k // len(robots)
        name = f"{which} {number}"
        jobs[name, seed] = partial(_solve_drawn, name, which, number, seed, bases, say)
    return jobs


def _solve_drawn(
    name: str,
    robot: str,
    number: int,
    seed: int,
    bases: Callable[[str], ImpactProblem],
    say: Say,
    out: dict[str, Any],
) -> Solution:
    out |= {"robot": robot, "number": number}
    rng = np.random.default_rng([seed, number, *map(ord, robot)])
    problem, numbers = drawn_problem(bases(robot), BASES[robot].around, rng, name)
    out |= numbers
    say(f"planning {name}: {numbers['mass_kg']:.2g} kg, {numbers['stiffness_N_m']:.2g} N/m")
    return solve(problem, time_limit=TIME_LIMIT)


def _files(folder: Path, robot: str | None, say: Say) -> dict[Key, PlanOf]:
    files = [file for file in sorted(folder.glob("*.toml")) if not file.stem.endswith("infeasible")]
    if robot is not None:
        files = [file for file in files if _robot_of(file) == robot]
    return {(file.stem, None): partial(_solve_file, file, say) for file in files}


def _robot_of(file: Path) -> str | None:
    """None for a file that is wrong: whose it is cannot be told."""
    try:
        return str(read_problem_file(file).build().robot.name)
    except InputError:
        return None


def _solve_file(file: Path, say: Say, out: dict[str, Any]) -> Solution:
    solution = solved(file, say)
    out["robot"] = solution.problem.robot.name
    return solution


def row(name: str, plan: PlanOf) -> dict[str, Any]:
    """What one problem gives; whatever goes wrong is its status, and ends what can be said of it."""
    out: dict[str, Any] = {"problem": name, "status": None}
    try:
        solution = plan(out)
        out |= {
            "status": solution.status.value,
            "iterations": solution.result.iterations,
            "seconds": solution.solve_seconds,
            "impulse_planned_Ns": solution.impulse,
            "collision_error_pct": solution.contact_error_pct,
        }
        if not solution.status.usable:
            out["reason"] = solution.result.message
            return out
        replay = solution.validate(engine="mujoco")
        said = solution.summary(replay=replay)["replayed"]
        out |= {
            "impulse_replayed_Ns": said["impulse_Ns"],
            "error_pct": said["impulse_error_pct"],
            "stands": said["standing"],
            "reason": said["reason"],
            **cleanliness(solution, replay),
            **_soles(solution, said),
            **_verified(solution),
        }
    except Exception as error:  # one of a hundred must not end the others
        out["status"] = out["status"] or "error"
        out["error"] = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
    return out


def _soles(solution: Solution, free: Mapping[str, Any]) -> dict[str, Any]:
    """Least shares of what is asked of a sole, planned and held; least force on free soles; as in `truth`."""
    replay = solution.validate()
    told = solution.summary(replay)
    return {
        "error_held_pct": told["simulated"]["impulse_error_pct"],
        **sole_shares(told, told, "planned"),
        **sole_shares(told["simulated"], told, "held"),
        "force_free_N": least_of_soles(free.get("sole_force_N")),
    }


def _verified(solution: Solution) -> dict[str, Any]:
    """What `impactopt verify` would say of it."""
    if not solution.statement:
        return {}
    record = record_of(solution)
    verdict = verify_record(solution.problem, record.arrays, record.summary)
    return {"verified": verdict.ok, "kkt": verdict.kkt, "not_verified": verdict.reason or None}


def cleanliness(solution: Solution, replay: Any) -> dict[str, Any]:
    """What else touched in a replay: ``contacts_besides``, ``clearance_mm`` and ``clean``.

    Clean is a motion in which nothing but soles and striker has touched anything. All of it is None where the
    summary does not say.
    """
    summary = solution.summary(replay=replay)
    said: Mapping[str, Any] = {**summary, **summary["replayed"]}
    besides = said.get("contacts_besides")
    return {
        "clean": None if besides is None else not besides,
        "clearance_mm": said.get("clearance_mm"),
        "contacts_besides": besides,
    }


def _counts(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    errors = [abs(r["error_pct"]) for r in rows if r.get("error_pct") is not None]
    seconds = [r["seconds"] for r in rows if r.get("seconds") is not None]
    known = [r["clean"] for r in rows if r.get("clean") is not None]
    return {
        "problems": len(rows),
        "solved": sum(r["status"] in ("solved", "acceptable") for r in rows),
        "standing": sum(bool(r.get("stands")) for r in rows),
        "clean": sum(known) if known else None,
        "worst_error_pct": max(errors, default=None),
        "median_seconds": float(np.median(seconds)) if seconds else None,
        "statuses": dict(Counter(r["status"] for r in rows).most_common()),
    }


def _told(r: Mapping[str, Any]) -> str:
    """A row in words."""
    if r.get("error_pct") is None:
        return f"{r['problem']}: {r['status']}; {r.get('error') or r.get('reason')}"
    stands = "stands" if r["stands"] else "falls"
    return (
        f"{r['problem']}: {r['status']}, {r['impulse_planned_Ns']:.2f} N s, {r['seconds']:.1f} s, {stands}, "
        f"error {r['error_pct']:.2f} %"
    )
