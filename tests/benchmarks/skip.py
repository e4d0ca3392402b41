"""What a setup does not need is left out when the function is built: what each saves.

The stand-in's motion B-3. Each row leaves one thing out of a function that has everything; the last rows have
a beginning of their own, which they name.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca

from benchmarks.cases import Case
from benchmarks.clock import medians
from benchmarks.pictures.skip import skip_picture
from benchmarks.report import Report, Say, columns_table
from benchmarks.setup import Setup, run_of
from impactopt.collision import SDC, Effects, JointFriction
from impactopt.collision.graph import independent_joints, instructions, joint_space_model, rk4_step
from impactopt.collision.outputs import HISTORIES, OF_SOLES
from impactopt.collision.symbolic import SymbolicModel
from impactopt.kinematics.stance import FixedBase, OneSole
from impactopt.robots.presets import standin
from impactopt.robots.robot import Robot

FRICTION = JointFriction(viscous=1.0, coulomb=1.0, transition=0.05)
WHOLE, FIXED = "everything", "everything, fixed base"
# joints of the stand-in that a blow of the right hand can do without: they are held as they stand
LOCKED = ("head", "left_wrist", "left_elbow", "right_wrist")
COLUMNS = (
    ("left out", "skipped", 0),
    ("instructions", "instructions", 0),
    ("of the freeze", "freeze_instructions", 0),
    ("of a step", "step_instructions", 0),
    ("time us", "time_us", 1),
    ("speed-up", "speedup", 2),
)
NOT_DONE = {
    "symmetric limbs": "in a posture that is its own mirror image the second leg's part of the freeze could "
    "be copied from the first's; that of a blow with one hand is none, so it is not done: at most, the "
    "instructions of one leg",
    "constant parameters": "the C code written by hand loads all numbers from memory; as constants of a "
    "graph they would save these instructions",
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Variant:
    """A function with something left out, beside the one it is compared with."""

    skipped: str
    model: SymbolicModel
    case: Case
    outputs: tuple[str, ...]
    beside: str = WHOLE


def run(say: Say, *, setup: Setup | None = None, repeats: int = 25) -> Report:
    """One row a thing left out."""
    setup = setup or Setup.of("standin")
    found = variants(setup)
    runs: dict[str, Callable[[], Any]] = {}
    for variant in found:
        say(f"compiling without {variant.skipped}")
        runs[variant.skipped] = run_of(variant.model, variant.case, variant.outputs)
    times = medians(runs, repeats=repeats, clock=time.thread_time)
    rows = []
    for variant in found:
        parts = instructions(variant.model, variant.outputs)
        own = times[variant.skipped]
        row: dict[str, Any] = {
            "skipped": variant.skipped,
            "instructions": sum(parts.values()),
            "time_us": 1e6 * own,
        }
        row |= {"speedup": times[variant.beside] / own, "beside": variant.beside}
        rows.append({**row, "freeze_instructions": parts["freeze"], "step_instructions": parts["step"]})
    rows += not_timed(setup, found)
    title = f"{setup.name}, {setup.case.name}: what is left out, and what it saves"
    table = columns_table(title, COLUMNS, rows)
    numbers = {"rows": rows, "not_done": NOT_DONE, "describe": found[0].model.describe().as_dict()}
    return Report(name="skip", numbers=numbers, tables=(table,), figures={"skip": lambda: skip_picture(rows)})


# ---------------------------------------------------------------- variants
def variants(setup: Setup) -> list[Variant]:
    """Everything, and everything but one; then what a planner asks for."""
    case = setup.case

    def model(*, effects: dict[str, bool] | None = None, **options: Any) -> SymbolicModel:
        chosen = Effects(**{"friction": True, **(effects or {})})
        friction = FRICTION if chosen.friction else None
        made: SymbolicModel = setup.model(SDC, effects=chosen, friction=friction, **options)
        return made

    whole = model()
    everything = whole.available
    soles = tuple(name for name in everything if name not in OF_SOLES)
    scalars = tuple(name for name in everything if name not in HISTORIES)
    out = [
        Variant(skipped=WHOLE, model=whole, case=case, outputs=everything),
        Variant(skipped="friction", model=model(effects={"friction": False}), case=case, outputs=everything),
        Variant(
            skipped="saturation", model=model(effects={"saturation": False}), case=case, outputs=everything
        ),
        Variant(
            skipped="bias and Jdot",
            model=model(effects={"bias": False, "jdot": False}),
            case=case,
            outputs=everything,
        ),
        Variant(skipped="histories", model=whole, case=case, outputs=scalars),
    ]
    if soles != everything:
        one = model(stance=OneSole(case.robot.soles[0].name))
        out += [
            Variant(skipped="ZMP and wrenches", model=whole, case=case, outputs=soles),
            Variant(skipped="one foot", model=one, case=case, outputs=everything),
        ]
    names = tuple(name for name in case.robot.joint_names if name.startswith(LOCKED))
    if names:
        out.append(without_joints(setup, names, everything))
    bare = setup.model(SDC, effects=Effects(saturation=False))
    out.append(Variant(skipped="all but the impulse", model=bare, case=case, outputs=("impulse",)))
    return out + (on_fixed_base(setup) if names else [])


def without_joints(setup: Setup, names: Sequence[str], outputs: tuple[str, ...]) -> Variant:
    """The stand-in with joints locked where they are."""
    case, small = locked(setup.case, names, floating=True)
    options = {**setup.options, "robot": small}
    model = SDC(**options, effects=Effects(friction=True), friction=FRICTION)
    return Variant(skipped=f"{len(names)} joints, locked", model=model, case=case, outputs=outputs)


def on_fixed_base(setup: Setup) -> list[Variant]:
    """The stand-in on a fixed base, whole, and with only the joints that the blow moves: the same."""
    case, robot = locked(setup.case, (), floating=False)
    options = {**setup.options, "stance": FixedBase()}
    whole = SDC(**{**options, "robot": robot})
    apart = independent_joints(whole)
    less, small = locked(setup.case, apart, floating=False)
    path = SDC(**{**options, "robot": small})
    outputs = ("impulse", "force", "torque")
    return [
        Variant(skipped=FIXED, model=whole, case=case, outputs=outputs, beside=FIXED),
        Variant(
            skipped=f"{len(apart)} joints off the path", model=path, case=less, outputs=outputs, beside=FIXED
        ),
    ]


def locked(case: Case, names: Sequence[str], *, floating: bool) -> tuple[Case, Robot]:
    """The case of the stand-in without some joints, which stay where they are, and its robot."""
    robot, angles = case.robot, case.robot.joint_positions(case.q)
    at = {name: float(angles[robot.joint_index(name)]) for name in names}
    small = standin(floating=floating, locked=at)
    kept = [robot.joint_index(name) for name in small.joint_names]
    base_q, base_v = (robot.nq - robot.n, robot.nv - robot.n) if floating else (0, 0)
    order_q = [*range(base_q), *(robot.nq - robot.n + k for k in kept)]
    order_v = [*range(base_v), *(robot.nv - robot.n + k for k in kept)]
    less = replace(case, robot=small, q=case.q[order_q], v=case.v[order_v], torque=case.torque[kept])
    return less, small


def not_timed(setup: Setup, found: Sequence[Variant]) -> list[dict[str, Any]]:
    """What is not done, with the instructions that it would leave."""
    whole = found[0]
    freeze, step = instructions(whole.model, whole.outputs).values()
    out: list[dict[str, Any]] = [
        {"skipped": "constant parameters", "freeze": freeze, "step": constant_step(whole)}
    ]
    leg = [name for name in setup.case.robot.joint_names if name.startswith("right_") and _of_leg(name)]
    if leg:
        _, small = locked(setup.case, leg, floating=True)
        one = SDC(**{**setup.options, "robot": small, "stance": OneSole("left")})
        both = setup.model(SDC)
        saved = instructions(both, ("impulse",))["freeze"] - instructions(one, ("impulse",))["freeze"]
        out.append({"skipped": "symmetric limbs", "freeze": freeze - saved, "step": step})
    empty = {"time_us": None, "speedup": None, "beside": WHOLE}
    return [
        {
            "skipped": r["skipped"],
            "instructions": r["freeze"] + r["step"],
            **empty,
            "freeze_instructions": r["freeze"],
            "step_instructions": r["step"],
        }
        for r in out
    ]


def _of_leg(name: str) -> bool:
    return any(part in name for part in ("hip", "knee", "ankle"))


def constant_step(variant: Variant) -> int:
    """Instructions of a step whose settings are constants of the graph."""
    model = joint_space_model(variant.model, variant.outputs)
    step = rk4_step(model, variant.model.step_of_graph)
    names = step.name_in()
    free = {name: ca.SX.sym(name, *step.size_in(name)) for name in names}
    given = [variant.model.settings.get(name, free[name]) for name in names]
    kept = [free[name] for name in names if name not in variant.model.settings]
    made = step.expand()(*[ca.SX(ca.DM(x)) if not isinstance(x, ca.SX) else x for x in given])
    return int(ca.Function("step", kept, [made]).n_instructions())
