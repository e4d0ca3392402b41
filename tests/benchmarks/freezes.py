"""What does freezing cost, and does the estimate of it hold?

Collisions of the right hand, drawn on each robot: joints off the legs within 0.5 rad of half-sitting, 0.2 to
3 m/s, gains x 0.1 to 10, every law and target of the package, stiffness of 1e3 to 1e9 N/m, targets of 0.1 to
2 times the effective mass; feed-forward that holds the robot's velocities. Only contacts that end count. The
truth is full dynamics by Pinocchio's own constrained dynamics, with tolerances tightened until it stands
still.

Of each number of freezes: the true error of the impulse as quantiles over contact time, and how often it is
more than `Collision.freeze_error` says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from benchmarks.report import Report, Say, make_table
from benchmarks.stability_cases import LAWS, TARGETS
from impactopt.collision import SDC, effective_mass
from impactopt.contact import Board, FreeMass, HertzDamped, HuntCrossley
from impactopt.errors import InputError
from impactopt.kinematics.operational_space import holding_torque, striking_velocity
from impactopt.robots.presets import load_robot
from impactopt.robots.robot import Robot
from impactopt.simulation.reference import FullDynamics
from impactopt.simulation.workers import map_on_workers

Array = NDArray[np.float64]

ROBOTS = ("talos", "g1", "standin")
FREEZES = (0, 4)
COUNT = 10
STRIKER, NORMAL = "right_hand", np.array([1.0, 0.0, 0.0])
HORIZON = 0.4  # [s]
ACCURACY = 1.0  # [%] that flags are of
TIMES = (0.0, 5e-3, 20e-3, 50e-3, 100e-3, HORIZON)  # [s] of the table
QUANTILES = (0.5, 0.9, 0.99, 1.0)
KINDS: dict[str, tuple[Any, Any]] = {
    f"{law}, {target}": (LAWS[law], TARGETS[target])
    for law, target in (
        *(("spring", target) for target in ("mass", "nail", "board", "wall")),
        *((law, "mass") for law in ("kelvin", "hertz", "hunt")),
    )
}
# two of five are the common pair
_ORDER = (*KINDS, "spring, mass", "spring, mass", "spring, mass")
_TRIES = 60
_TOLERANCE = 2e-5  # relative, of its impulse


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawn:
    """One collision: its kind, and arguments of `collide`."""

    kind: str
    q: Array
    v: Array
    torque: Array
    settings: dict[str, Any]


# ---------------------------------------------------------------- what is drawn
def draw(robot: Robot, kind: str, rng: np.random.Generator) -> Drawn | None:
    """A collision of this kind; None where its posture or hand cannot be had."""
    q = pin.integrate(robot.model, robot.posture("half_sitting"), _bent(robot, rng))
    joints = robot.joint_positions(q)
    inside = np.clip(joints, robot.lower + 0.01, robot.upper - 0.01)
    q = pin.integrate(robot.model, q, np.concatenate([np.zeros(robot.nv - robot.n), inside - joints]))
    speed = 10 ** rng.uniform(-0.7, 0.5)
    try:
        v = striking_velocity(robot, q, STRIKER, NORMAL, speed)
    except InputError:
        return None
    mass = float(_mass(robot)(q))
    target = mass * 10 ** rng.uniform(-1.0, 0.3)
    settings: dict[str, Any] = {
        "kp": robot.kp * 10 ** rng.uniform(-1.0, 1.0),
        "kd": robot.kd * 10 ** rng.uniform(-1.0, 1.0),
    }
    law, hit = KINDS[kind]
    if isinstance(hit, FreeMass):
        settings["target_mass"] = target
    elif isinstance(hit, Board):
        settings["target_breaking_force"] = 10 ** rng.uniform(1.5, 3.0)
    mu = 1 / (1 / mass + (1 / target if isinstance(hit, FreeMass) else 0.0))
    if isinstance(law, HertzDamped):
        settings |= {"contact_stiffness": 10 ** rng.uniform(4.5, 8), "contact_damping": rng.uniform(0, 30)}
    elif isinstance(law, HuntCrossley):
        settings |= {
            "contact_stiffness": 10 ** rng.uniform(4, 7),
            "contact_dissipation": rng.uniform(0, 0.6),
        }
    else:
        # half of them soft, where contacts are long
        k = 10 ** rng.uniform(3.0, rng.choice([5.0, 9.0]))
        settings |= {
            "contact_stiffness": k,
            "contact_damping": 2 * rng.uniform(0.0, 0.6) * np.sqrt(k * mu),
        }
    return Drawn(kind=kind, q=q, v=v, torque=holding_torque(robot, q, v), settings=settings)


@cache
def _mass(robot: Robot) -> Any:
    return effective_mass(robot, striker=STRIKER, normal=NORMAL)


def _bent(robot: Robot, rng: np.random.Generator) -> Array:
    """(nv) [rad] of the joints that carry no sole."""
    model, out = robot.model, np.zeros(robot.nv)
    soles = [model.frames[model.getFrameId(sole.frame)].parentJoint for sole in robot.soles]
    legs = {int(j) for parent in soles for j in model.supports[parent]}
    for joint in range(1, model.njoints):
        if joint not in legs and model.joints[joint].nv == 1:
            out[model.joints[joint].idx_v] = rng.uniform(-0.5, 0.5)
    return out


# ---------------------------------------------------------------- what is said of it, and the truth
@cache
def _robot(name: str) -> Robot:
    return load_robot(name)


def _options(robot: Robot, kind: str) -> dict[str, Any]:
    law, target = KINDS[kind]
    return {
        "robot": robot,
        "striker": STRIKER,
        "normal": NORMAL,
        "law": law,
        "target": target,
        "horizon": HORIZON,
    }


@cache
def _model(robot: Robot, kind: str, freezes: int) -> SDC:
    return SDC(**_options(robot, kind), freezes=freezes)


def judge(robot: Robot, case: Drawn, freezes: Sequence[int] = FREEZES) -> dict[str, Any] | None:
    """True and said errors [%] by number of freezes; None of a contact that does not end, or that full
    dynamics cannot follow."""
    said: dict[str, Any] = {}
    outputs: tuple[str, ...] = ("impulse", "freeze_error", "duration")
    for n in freezes:
        found = _model(robot, case.kind, n).batch(
            case.q[None],
            case.v[None],
            case.torque,
            outputs=outputs,
            threads=1,
            **case.settings,
        )
        outputs = ("impulse", "freeze_error")
        if not np.isfinite(found["impulse"][0]):
            return None
        said[str(n)] = {name: x[0].item() for name, x in found.items()}
    truth = _truth(robot, case)
    if truth is None:
        return None
    impulse, duration = truth
    errors = {
        n: {
            "true_pct": 100 * abs(x["impulse"] / impulse - 1),
            # a model in which contact does not end refuses to say
            "said_pct": 100 * x["freeze_error"] if x["separated"] else None,
        }
        for n, x in said.items()
    }
    return {"kind": case.kind, "duration_s": duration, "impulse_Ns": impulse, "freezes": errors}


def _truth(robot: Robot, case: Drawn) -> tuple[float, float] | None:
    """Impulse [N s] and duration [s] by full dynamics; None: no contact that ends."""
    model = FullDynamics(**_options(robot, case.kind), tolerance=_TOLERANCE, form="pinocchio")
    try:
        found = model.collide(case.q, case.v, case.torque, require_separation=False, **case.settings)
    except InputError:
        return None
    return (found.impulse, found.duration) if found.separated and found.impulse > 0 else None


# ---------------------------------------------------------------- the bench
def run(
    say: Say,
    *,
    robots: Sequence[str] = ROBOTS,
    count: int = COUNT,
    seed: int = 0,
    workers: int = 2,
) -> Report:
    """So many collisions a robot."""
    jobs = [(name, kind, seed, k) for name in robots for k, kind in enumerate(_kinds(count))]
    # one kind after the other: each process compiles its own
    jobs.sort(key=lambda job: (job[0], job[1]))
    found = map_on_workers(
        _job,
        None,
        jobs,
        workers=workers,
        crashed=lambda _code: None,
        progress=lambda done, of: say(f"collisions: {done} of {of}"),
    )
    rows = [{"robot": job[0], **row} for job, row in zip(jobs, found, strict=True) if row is not None]
    numbers = {"count": count, "seed": seed, "robots": list(robots), **summary(rows), "collisions": rows}
    return Report(name="freezes", numbers=numbers, tables=_tables(numbers))


def _kinds(count: int) -> list[str]:
    return [_ORDER[k % len(_ORDER)] for k in range(count)]


def _job(_shared: None, job: tuple[str, str, int, int]) -> dict[str, Any] | None:
    """The first collision of this kind that ends."""
    name, kind, seed, number = job
    robot, rng = _robot(name), np.random.default_rng([seed, number, *map(ord, name)])
    for _ in range(_TRIES):
        case = draw(robot, kind, rng)
        try:
            row = None if case is None else judge(robot, case)
        except InputError:  # a step that is too long for the servos: refused, with its reason
            continue
        if row is not None:
            return row
    return None


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Quantiles by number of freezes and contact time; `off`: collisions off by more than was said."""
    table, off = [], 0
    for n in map(str, FREEZES):
        for low, high in [*pairwise(TIMES), (TIMES[0], TIMES[-1])]:
            own = [row["freezes"][n] for row in rows if low <= row["duration_s"] < high]
            true = np.array([x["true_pct"] for x in own])
            judged = [x for x in own if x["said_pct"] is not None]
            more = sum(x["true_pct"] > x["said_pct"] for x in judged)
            whole = (low, high) == (TIMES[0], TIMES[-1])
            off += more if whole else 0
            quantiles = np.quantile(true, QUANTILES).tolist() if own else [None] * len(QUANTILES)
            table.append(
                {
                    "freezes": int(n),
                    "from_s": low,
                    "to_s": high,
                    "collisions": len(own),
                    **dict(zip(("p50", "p90", "p99", "max"), quantiles, strict=True)),
                    "off": more,
                    "not_ended": len(own) - len(judged),
                    "above": sum(x["true_pct"] > ACCURACY for x in judged),
                    "flagged": sum(x["said_pct"] > ACCURACY for x in judged),
                    "missed": sum(x["said_pct"] <= ACCURACY < x["true_pct"] for x in judged),
                }
            )
    return {"judged": len(rows), "off": off, "rows": table}


def _tables(numbers: dict[str, Any]) -> tuple[Any, ...]:
    heads = ["contact, ms", "n", "50 %", "90 %", "99 %", "max", "off", "not ended", "> 1 %", "flagged"]
    tables = []
    for n in FREEZES:
        cells = []
        for row in numbers["rows"]:
            if row["freezes"] == n:
                between = f"{1e3 * row['from_s']:g} to {1e3 * row['to_s']:g}"
                errors = ["-" if row[q] is None else f"{row[q]:.3f}" for q in ("p50", "p90", "p99", "max")]
                counts = [str(row[key]) for key in ("off", "not_ended", "above", "flagged")]
                cells.append([between, str(row["collisions"]), *errors, *counts])
        title = f"SDC, freezes={n}: error of the impulse, % of full dynamics'"
        tables.append(make_table(title, heads, cells))
    return tuple(tables)
