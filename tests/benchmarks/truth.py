"""Is what is planned what happens? Punches, planned and then replayed with fixed soles and with free ones.

One row a problem: how the solver ended; from the replay with fixed soles (Pinocchio) the impulse's error, the
least ZMP margin, what each sole by itself keeps of the margins asked of it, and the largest torque demand
over limit; from the replay with free soles (MuJoCo) the impulse's error, each sole's least margin and force,
slip, lift in the collision, and whether the robot stands at the end. What fails stays in.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from support.meshes import Meshes

from benchmarks.planning import DEMO, solved
from benchmarks.report import Report, Say, columns_table
from impactopt import Solution
from impactopt.contact.friction import ContactFriction
from impactopt.contact.laws import SpringDamper
from impactopt.contact.targets import FreeMass
from impactopt.errors import InputError
from impactopt.planning.solve import solve
from impactopt.problem.phases import Phase
from impactopt.problem.problem import ImpactProblem
from impactopt.robots.presets import talos
from impactopt.simulation.perturbation import Perturbation

Array = NDArray[np.float64]
EVERY = 1e-3  # [s] at which the meshes of a motion are looked at
TIME_LIMIT = 60.0  # [s] of the solver, for the variants

# what differs from the demo's punch
VARIANTS: dict[str, dict[str, Any]] = {
    "demo": {},
    "nearer": {"point": [0.55, -0.2, 1.05]},
    "higher": {"point": [0.55, -0.3, 1.25]},
    "20 kg": {"target": FreeMass(mass=20.0)},
    "1 kg": {"target": FreeMass(mass=1.0)},
    "10 x stiffer": {"law": SpringDamper(stiffness=1e5, damping=300.0)},
    "left hand": {"striker": "left_hand", "point": [0.6, 0.25, 1.1]},
    "free durations": {
        "swing": Phase(duration=(0.5, 1.0)),
        "follow": Phase(duration=(0.6, 1.4), intervals=10),
    },
}

HELD = (
    ("problem", "problem", 0),
    ("status", "status", 0),
    ("steps", "iterations", 0),
    ("s", "solve_seconds", 1),
    ("N s", "impulse_planned_Ns", 2),
    ("stances", "stances", 0),
    ("error %", "impulse_error_pct", 2),
    ("ZMP mm", "zmp_margin_mm", 1),
    ("CoP planned", "cop_planned", 2),
    ("held", "cop_held", 2),
    ("torque", "torque_ratio", 2),
    ("gear planned", "gear_planned", 2),
    ("gear", "gear_held", 2),
    ("force planned", "force_planned", 2),
    ("held", "force_held", 2),
    ("apart mm", "clearance_mm", 1),
    ("touches", "touches", 0),
    ("in meshes", "mesh_touches", 0),
)
FREE = (
    ("problem", "problem", 0),
    ("error %", "replay_impulse_error_pct", 2),
    ("gear", "gear_free", 2),
    ("CoP mm", "cop_free_mm", 1),
    ("force N", "force_free_N", 0),
    ("slip mm", "replay_slip_mm", 1),
    ("lift mm", "replay_lift_collision_mm", 2),
    ("apart mm", "replay_clearance_mm", 1),
    ("touches", "replay_touches", 0),
    ("in meshes", "replay_mesh_touches", 0),
    ("stands", "standing", 0),
)


MISSED = (
    ("problem", "problem", 0),
    ("torque planned", "missed_torque_planned", 2),
    ("torque", "missed_torque", 2),
    ("gear", "missed_gear", 2),
    ("CoP mm", "missed_cop_mm", 1),
    ("force N", "missed_force_N", 0),
    ("slip mm", "missed_slip_mm", 1),
    ("apart mm", "missed_clearance_mm", 1),
    ("touches", "missed_touches", 0),
    ("stands", "missed_standing", 0),
)
MOTION = (
    ("problem", "problem", 0),
    ("idle rad", "idle_travel_rad", 1),
    ("reversals", "reversals", 0),
    ("jerk rad/s3", "peak_jerk_rad_s3", 0),
    ("work J", "work_J", 0),
    ("end rad", "end_posture_rad", 2),
    ("ground, least", "ground_least", 2),
    ("largest", "ground_most", 2),
    ("touch mm", "first_touch_mm", 1),
    ("early ms", "first_touch_ms", 2),
    ("price %", "motion_price_pct", 1),
)


def run(say: Say, *, folder: Path = DEMO.parent, controller: str = "servo") -> Report:
    """Every problem file of the folder, and the variants of the demo's punch.

    controller : of the replay on free soles, "servo" or "wbc" with the defaults.
    """
    rows = [row(name, solution, say, controller) for name, solution in problems(folder, say)]
    margins = [r.get("zmp_margin_m") for r in rows]
    shown = [
        {**r, "zmp_margin_mm": None if m is None else 1e3 * m} for r, m in zip(rows, margins, strict=True)
    ]
    tables = (
        columns_table("planned, and replayed on fixed soles", HELD, shown),
        columns_table("replayed on free soles", FREE, shown),
        columns_table(
            "with the target missing, on free soles", MISSED, [r for r in shown if "missed_standing" in r]
        ),
        columns_table("the planned motion", MOTION, [r for r in shown if "work_J" in r]),
    )
    return Report(name="truth", numbers={"rows": rows, "controller": controller}, tables=tables)


# problems that are planned with friction of the striking point, too: without bristles, and with such of this
# part of the normal stiffness
RUBBING, ROUGH = ("punch.toml", "door.toml", "punch_g1.toml", "chop.toml"), ContactFriction(coefficient=0.6)
BRISTLES = 0.8


def problems(folder: Path, say: Say) -> Iterator[tuple[str, Callable[[], Solution]]]:
    """Names, and what solves them."""
    files = sorted(folder.glob("*.toml"))
    for file in files:
        yield file.name, lambda file=file: solved(file, say)  # type: ignore[misc]
    for file, part in product((file for file in files if file.name in RUBBING), (0.0, BRISTLES)):

        def rubbing(file: Path = file, part: float = part) -> Solution:
            return solved(file, say, lambda problem: _rough(problem, part))

        yield f"{file.stem}, friction {ROUGH.coefficient:g}{', bristles' if part else ''}", rubbing
    for name, changes in VARIANTS.items():
        if name != "demo" or folder / DEMO.name not in files:
            yield name, lambda name=name, changes=changes: _variant(name, changes, say)  # type: ignore[misc]


def _rough(problem: ImpactProblem, part: float) -> ImpactProblem:
    """With friction, and bristles of this part of the normal stiffness; 0: none."""
    stiffness = part * problem.law.parameters["stiffness"]
    return replace(problem, friction=replace(ROUGH, stiffness=stiffness))


def _variant(name: str, changes: dict[str, Any], say: Say) -> Solution:
    options: dict[str, Any] = {
        "robot": talos(),
        "striker": "right_hand",
        "point": [0.6, -0.25, 1.1],
        "normal": [1.0, 0.0, 0.0],
        "law": SpringDamper(stiffness=1e4, damping=300.0),
        "target": FreeMass(mass=5.0),
    }
    say(f"planning {name}")
    return solve(ImpactProblem(**{**options, **changes}), time_limit=TIME_LIMIT)


def row(name: str, plan: Callable[[], Solution], say: Say, controller: str = "servo") -> dict[str, Any]:
    """What one problem gives; an error is its status, and ends what can be said of it.

    clearance_mm, touches : of the plan and its replay on fixed soles; replay_... : on free ones.
    mesh_touches : pairs that are in each other by the exact meshes of the robot's URDF, looked at every
    millisecond of the plan, the missed blow and the replay (None: it has no meshes).
    cop_planned, cop_held, force_planned, force_held : least that a sole keeps of the margin of its centre of
    pressure and of its normal force, over what is asked of it, in the plan (its missed blow included) and in
    its replay on fixed soles; cop_free_mm, force_free_N : least on free ones.  soles : all of these numbers,
    by sole and phase.
    missed_... : of the replay on free soles where the target is missing.
    idle_travel_rad ... first_touch_ms : `impactopt.planning.solution`.
    gear_planned, gear_held, gear_free : load of the worst gear over its torque limit, None without armature.
    """
    out: dict[str, Any] = {"problem": name}
    try:
        solution = plan()
        summary = solution.outcome()
        out |= {key: summary[key] for key in ("status", "iterations", "solve_seconds")}
        out["impulse_planned_Ns"] = solution.impulse
        out["stances"] = max(1, len(solution.problem.stances))
        replay = solution.validate()
        told = solution.summary(replay)
        held = _with_missed(told["simulated"], _miss(solution, missing=True))
        out |= {
            "clearance_mm": _least(told["clearance_mm"], held["clearance_mm"]),
            "touches": len([*told["contacts_besides"], *(held["contacts_besides"] or ())]),
            "mesh_touches": _mesh_touches(solution, *_planned(solution), replay.q[_each(replay.time)]),
            "impulse_error_pct": held["impulse_error_pct"],
            "zmp_margin_m": min(held.get("zmp_margin_m", {}).values(), default=None),
            "torque_ratio": max(held["torque_ratio"].values()),
            "gear_planned": told.get("gear_ratio"),
            "gear_held": held.get("gear_ratio"),
            **sole_shares(told, told, "planned"),
            **sole_shares(held, told, "held"),
            "soles": {name: _soles(found) for name, found in (("planned", told), ("held", held))},
            **{key: told[key] for _, key, _ in MOTION[1:] if key in told},
        }
        least, most = told.get("ground_force_share") or (None, None)
        out |= {
            "ground_force_share": told.get("ground_force_share"),
            "ground_least": least,
            "ground_most": most,
        }
    except InputError as error:
        out["status"] = out.get("status", "error")
        out["error"] = str(error)
        say(f"{name}: {error}")
        return out
    try:
        replay = solution.validate(engine="mujoco", controller=controller)
        missed = _miss(
            solution, engine="mujoco", controller=controller, perturbation=Perturbation(missing=True)
        )
        free = _with_missed(solution.summary(replay)["simulated"], missed)
    except InputError as error:
        out |= {"standing": None, "reason": str(error)}
        return out
    out["soles"]["free"] = _soles(free)
    out |= {
        "cop_free_mm": least_of_soles(free.get("sole_cop_margin_mm")),
        "force_free_N": least_of_soles(free.get("sole_force_N")),
        "replay_impulse_error_pct": free["impulse_error_pct"],
        "gear_free": free.get("gear_ratio"),
        "replay_slip_mm": free.get("sole_slip_mm"),
        "replay_lift_collision_mm": free.get("sole_lift_collision_mm"),
        "replay_clearance_mm": free["clearance_mm"],
        "replay_touches": len(free["contacts_besides"] or ()),
        "replay_mesh_touches": _mesh_touches(solution, replay.q[_each(replay.time)]),
        "standing": free["standing"],
        "reason": free["reason"],
    }
    return out | ({} if missed is None else _missed(solution, missed))


def _miss(solution: Solution, **options: Any) -> dict[str, Any] | None:
    """Numbers of the replay where the target is missing, of a plan that has a motion for that."""
    if solution.plan.abort is None:
        return None
    return dict(solution.summary(solution.validate(**options))["simulated"])


def _missed(solution: Solution, free: Mapping[str, Any]) -> dict[str, Any]:
    """The columns of a replay on free soles where the target is missing."""
    return {
        "missed_torque_planned": solution.margins()["torque_ratio"].get("missed"),
        "missed_torque": max(free["torque_ratio"].values()),
        "missed_gear": free.get("gear_ratio"),
        "missed_cop_mm": least_of_soles(free.get("sole_cop_margin_mm")),
        "missed_force_N": least_of_soles(free.get("sole_force_N")),
        "missed_slip_mm": free.get("sole_slip_mm"),
        "missed_clearance_mm": free["clearance_mm"],
        "missed_touches": len(free["contacts_besides"] or ()),
        "missed_standing": free["standing"],
        "missed_reason": free["reason"],
    }


def _with_missed(found: dict[str, Any], miss: Mapping[str, Any] | None) -> dict[str, Any]:
    """A replay's numbers with those of the soles in the replay of the missed blow, if there is one."""
    if miss is None:
        return found
    for key in ("sole_cop_margin_mm", "sole_force_N"):
        for sole, phases in (miss.get(key) or {}).items():
            found[key][sole] |= {phase: kept for phase, kept in phases.items() if phase == "missed"}
    return found


def _soles(found: Mapping[str, Any]) -> dict[str, Any]:
    """What a summary says of each sole by itself."""
    return {key: value for key, value in found.items() if key.startswith(("sole_cop_margin", "sole_force"))}


def least_of_soles(soles: Mapping[str, Mapping[str, float]] | None) -> float | None:
    return _least(*(kept for phases in (soles or {}).values() for kept in phases.values()))


def sole_shares(found: Mapping[str, Any], told: Mapping[str, Any], name: str) -> dict[str, float | None]:
    """Least share of what is asked of a sole; a centre of pressure of which nothing is asked is left out."""
    asked, force = told.get("sole_cop_margin_asked_mm") or {}, told.get("sole_force_asked_N")
    shares = [
        kept / asked[phase]
        for phases in (found.get("sole_cop_margin_mm") or {}).values()
        for phase, kept in phases.items()
        if asked.get(phase)
    ]
    least = least_of_soles(found.get("sole_force_N"))
    return {
        f"cop_{name}": _least(*shares),
        f"force_{name}": least / force if force and least is not None else None,
    }


def _planned(solution: Solution) -> list[Array]:
    """Configurations (k, nq) of the plan and of its missed blow."""
    ways = (False, True) if solution.plan.abort is not None else (False,)
    return [solution.plan.motion(missed=missed).q for missed in ways]


def _each(time: Array) -> NDArray[np.intp]:
    """Which instants (k,) [s] of a replay are about `EVERY` apart."""
    return np.unique(time // EVERY, return_index=True)[1]


def _mesh_touches(solution: Solution, *motions: Array) -> int | None:
    meshes = Meshes(solution.problem.robot, solution.problem.start_posture)
    return len({pair for q in motions for pair in meshes.touching(q)}) if meshes.known else None


def _least(*lengths: float | None) -> float | None:
    """Of those that are known."""
    return min((length for length in lengths if length is not None), default=None)
