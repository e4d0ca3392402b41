"""Anyone's robot at the first try: every arm and biped of example-robot-data, drafted, planned and replayed.

One row a robot, with no line of its draft edited: seconds of drafting, how the solver ended, the replays in
both engines, whether it stands; and for a bolted arm the impulse of the drafted motion over that of the best
one to random targets. What cannot be drafted is a row, too, with the reason.
"""

from __future__ import annotations

import re
import shutil
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from benchmarks.kept import Kept
from benchmarks.report import Report, Say, columns_table
from impactopt.bodies.robot_bodies import striker_face
from impactopt.errors import InputError
from impactopt.files.draft.drafting import draft_problem
from impactopt.files.draft.strong import durations, strike_problem
from impactopt.files.output import record_of, save_record
from impactopt.files.problem_file import read_problem_file
from impactopt.planning.solution import Solution
from impactopt.planning.solve import solve
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.strength import Strength
from impactopt.robots.presets import example_robots

Array = NDArray[np.float64]
ROWS = Path("results/bench/robots.jsonl")
DRAFTS = Path("results/robots")
TIME_LIMIT, ITERATIONS = 240.0, 300  # [s] of a solve; iterations of one to a random target, as in a draft
PLANNED, TRIED = 8, 24  # motions that are solved to random targets; at most so many are tried
FRONT = 0.0  # [m] ahead of the base that a random target is at least
BEHIND = 0.06  # [m] behind a random target's plane that its start is at least
DRAWN = 20000  # postures for random targets at most
# name -> file below the robots of example-robot-data
ROBOTS = {
    "Franka Panda": "panda_description/urdf/panda.urdf",
    "UR3": "ur_description/urdf/ur3_robot.urdf",
    "UR5": "ur_description/urdf/ur5_robot.urdf",
    "UR5 with gripper": "ur_description/urdf/ur5_gripper.urdf",
    "UR10": "ur_description/urdf/ur10_robot.urdf",
    "xArm7": "xarm_description/urdf/xarm7.urdf",
    "Kinova": "kinova_description/robots/kinova.urdf",
    "Unitree Z1": "z1_description/urdf/z1.urdf",
    "SO-100": "so_arm_description/urdf/so100.urdf",
    "SO-101": "so_arm_description/urdf/so101.urdf",
    "TALOS's left arm": "talos_data/robots/talos_left_arm.urdf",
    "two pendulums": "double_pendulum_description/urdf/double_pendulum.urdf",
    "Finger Edu": "finger_edu_description/robots/finger_edu.urdf",
    "Tiago": "tiago_description/robots/tiago.urdf",
    "Tiago Pro": "tiago_pro_description/robots/tiago_pro.urdf",
    "Baxter": "baxter_description/urdf/baxter.urdf",
    "PR2": "pr2_description/urdf/pr2.urdf",
    "TALOS": "talos_data/robots/talos_full_v2.urdf",
    "Unitree G1": "g1_description/urdf/g1_29dof_rev_1_0.urdf",
    "Romeo": "romeo_description/urdf/romeo.urdf",
    "iCub": "icub_description/robots/icub.urdf",
    "Alex": "alex_description/urdf/alex_nub_hands.urdf",
    "Alexander's legs": "alexander_description/urdf/alexander_v1.lowerBodyOnly.urdf",
    "simple humanoid": "simple_humanoid_description/urdf/simple_humanoid.urdf",
    "human": "human_description/robots/human.urdf",
    "Bolt": "bolt_description/robots/bolt.urdf",
}
COLUMNS = (
    ("robot", "robot", 0),
    ("joints", "joints", 0),
    ("drafted s", "draft_seconds", 1),
    ("status", "status", 0),
    ("iterations", "iterations", 0),
    ("solved s", "seconds", 1),
    ("N s", "impulse_Ns", 2),
    ("of the best", "share", 2),
    ("of motions", "motions", 0),
    ("held %", "held_pct", 2),
    ("free %", "free_pct", 2),
    ("stands", "stands", 0),
)


def run(
    say: Say,
    *,
    names: list[str] | None = None,
    targets: int = 0,
    motion: str | None = None,
    seed: int = 0,
    resume: bool = False,
    rows: Path = ROWS,
    drafts: Path = DRAFTS,
) -> Report:
    """One row a robot.

    names : of `ROBOTS`, all by default.  targets : random targets whose best motion a bolted arm's is
    compared with; 0: none are.  motion : that is drafted; None: the usual one.  seed : of the targets.
    resume : do not repeat rows that `rows` has.
    drafts : folder of the drafted files and the results.

    Raises
    ------
    InputError : example-robot-data is not installed; an unknown name; the file of rows is damaged.
    """
    chosen = names or list(ROBOTS)
    for name in chosen:
        if name not in ROBOTS:
            raise InputError(f"there is no robot {name!r} in this bench: there are {', '.join(ROBOTS)}")
    folder = example_robots("this bench")
    kept = Kept(rows, ("robot", "motion"), resume=resume)
    drafts.mkdir(parents=True, exist_ok=True)
    found = []
    for name in chosen:
        if (name, motion) not in kept.found:
            file = folder / ROBOTS[name]
            row = _row(name, file, drafts, np.random.default_rng(seed), targets, motion)
            kept.add({"motion": motion, **row})
        found.append(kept.found[(name, motion)])
        row = found[-1]
        say(", ".join(f"{key} {row[key]}" for _, key, _ in COLUMNS if row.get(key) is not None))
        if row.get("reason"):
            say(f"  {row['reason']}")
    true = [row for row in found if _true(row)]
    title = f"{len(found)} robots, no line edited: {len(true)} from file to a true plan"
    numbers = {"rows": found, "true": len(true), "targets": targets, "motion": motion, "seed": seed}
    return Report(name="robots", numbers=numbers, tables=(columns_table(title, COLUMNS, found),))


def file_of(name: str, drafts: Path) -> Path:
    """Drafted file of a robot; its result is in the directory of the same name."""
    return drafts / f"{re.sub('[^a-z0-9]+', '_', name.lower())}.toml"


def _true(row: Mapping[str, Any]) -> bool:
    """A plan that is solved, replayed within a per cent held and two free, and stands."""
    if row["status"] != "solved" or not row.get("stands"):
        return False
    return abs(row["held_pct"]) < 1.0 and abs(row["free_pct"]) < 2.0


def _row(
    name: str, file: Path, drafts: Path, rng: np.random.Generator, targets: int, motion: str | None
) -> dict[str, Any]:
    out: dict[str, Any] = {"robot": name}
    began = time.process_time()
    try:
        draft = draft_problem(file, folder=drafts, motion=motion)
        place = file_of(name, drafts)
        shutil.rmtree(place.with_suffix(""), ignore_errors=True)  # the result of an earlier run
        place.write_text(draft.text, encoding="utf-8")
        out["draft_seconds"] = time.process_time() - began
        problem = read_problem_file(place).build()
    except InputError as error:
        return out | {"status": "refused", "reason": str(error)}
    out |= {"joints": problem.robot.n, "said": list(draft.said)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the row says so
        began = time.process_time()
        try:
            solution = solve(problem, time_limit=TIME_LIMIT)
        except InputError as error:
            return out | {"status": "refused", "reason": str(error)}
    out |= {
        "status": solution.status.value,
        "iterations": solution.result.iterations,
        "seconds": time.process_time() - began,
        "impulse_Ns": solution.impulse,
        "reason": "" if solution.status.usable else solution.result.message,
    }
    if targets and not problem.robot.floating:
        motions = motions_to_random(problem, rng, targets)
        own = solution.impulse if solution.status.usable else 0.0
        best = max(motions, default=None)
        out |= {"motions": len(motions), "best_Ns": best, "share": own / best if best else None}
    return out | (_replayed(solution, place) if solution.status.usable else {})


def _replayed(solution: Solution, file: Path) -> dict[str, Any]:
    """Numbers of both replays; the result is saved beside the draft."""
    held, free = (solution.validate(engine=engine) for engine in ("pinocchio", "mujoco"))
    text = file.read_text(encoding="utf-8")
    record = record_of(solution, simulation=held, replay=free, problem=text, problem_path=file)
    save_record(record, file.with_suffix(""))
    return {
        "held_pct": 100 * (held.impulse / solution.impulse - 1),
        "free_pct": 100 * (free.impulse / solution.impulse - 1),
        "stands": free.standing,
    }


def motions_to_random(problem: ImpactProblem, rng: np.random.Generator, count: int) -> list[float]:
    """Impulses [N s] of motions of a bolted arm to the hardest of so many random targets ahead.

    Motions are planned to the targets with the largest estimates until `PLANNED` are solved, of at most
    `TRIED`.
    """
    targets = sorted(islice(_targets(problem, rng), count), key=lambda one: -one[1])
    found = list[float]()
    for target, _ in targets[:TRIED]:
        with warnings.catch_warnings(), suppress(InputError):
            warnings.simplefilter("ignore")  # one that fails counts as none
            solution = solve(target, options={"max_iterations": ITERATIONS}, time_limit=TIME_LIMIT)
            found += [solution.impulse] if solution.status.usable else []
        if len(found) == PLANNED:
            break
    return found


def _targets(problem: ImpactProblem, rng: np.random.Generator) -> Iterator[tuple[ImpactProblem, float]]:
    """Problems with random targets ahead, each with a start and durations as a draft has them, and estimates
    of their impulses [N s].

    A target is where the striking point is in a random posture of the arm, struck along the link's face in
    it. Those without a feasible start are left out.
    """
    robot = problem.robot
    model, data, name = robot.model, robot.model.createData(), problem.striker
    frame = model.getFrameId(robot.striker(name).model_frame)
    face, limb = striker_face(robot, name), np.array(robot.limb(robot.striker(name).model_frame))
    low, high = np.maximum(robot.lower, -np.pi)[limb], np.minimum(robot.upper, np.pi)[limb]
    own = robot.joint_positions(problem.start_posture)
    strength = Strength(robot=robot, striker=name, law=problem.law, target=problem.target)
    keys = "law", "target", "terms", "objectives", "contact_duration", "swing", "follow"
    given = {key: getattr(problem, key) for key in keys}
    for _ in range(DRAWN):
        step = np.zeros(robot.nv)
        step[robot.nv - robot.n + limb] = rng.uniform(low, high) - own[limb]
        q = np.array(pin.integrate(model, problem.start_posture, step))
        pin.framesForwardKinematics(model, data, q)
        at = data.oMf[frame]
        normal = rng.standard_normal(3) if face is None else at.rotation @ face.normal
        if at.translation[0] < FRONT or (at.translation[2] < 0.1 and normal[2] < 0):
            continue
        for impact in strength.at(q[None], normal[None] / np.linalg.norm(normal)):
            if not impact.impulse:  # a limit of position holds the arm
                continue
            found = strike_problem(robot, name, impact, behind=BEHIND, given=given)
            if found is not None:
                way = robot.joint_positions(q) - robot.joint_positions(found.start_posture)
                timed = {
                    key: replace(getattr(found, key), duration=bounds)
                    for key, bounds in durations(robot, way).items()
                }
                yield replace(found, **timed), impact.impulse
