"""The methods and settings that the bench of collisions times, each ready to run, and what came out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from support.exact import ExactCollision

from benchmarks.clock import runner
from benchmarks.peers import cvodes, mujoco_loop, mujoco_steps, pinocchio_calls
from benchmarks.report import Say
from benchmarks.setup import EVALUATION, Setup, graph, inputs, outcome, run_of
from impactopt.collision import SDC, Collision, VirtualMass
from impactopt.errors import InputError
from impactopt.simulation.reference import FullDynamics

PAPER_STEPS = (1e-3, 1e-4, 1e-5, 2e-6)  # [s]; 1e-6 would be more steps than a model allows
OUR_TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-10)
FREEZES = (1, 2, 4, 8)
FULL_TOLERANCES = (1e-2, 1e-4, 1e-6)
FULL_STEP = 1e-4  # [s]
MUJOCO_STEPS = (1e-3, 2e-4, 1e-4, 5e-5)
TOLERANCES = (1e-4, 1e-6, 1e-8)
COLUMN = 1e-3  # [s] between instants of the histories, the same for all that are not longer steps


@dataclass(frozen=True, kw_only=True, eq=False)
class Entry:
    """A method and setting: what runs it once, and what came out, where that is known."""

    method: str
    setting: str
    run: Callable[[], Any]
    result: Collision | None = None
    impulse: float | None = None
    note: str | None = None

    @property
    def key(self) -> tuple[str, str]:
        return self.method, self.setting


def entries(setup: Setup, true: Collision, say: Say, quick: bool) -> tuple[list[Entry], list[dict[str, Any]]]:
    """What can be run, and rows of what cannot."""
    found: list[Entry] = []
    refused: list[dict[str, Any]] = []
    case, ours = setup.case, _ours(setup, say, found, refused)
    usual = f"tolerance {setup.model(SDC).tolerance:g}"
    ours("virtual mass", usual, lambda: setup.model(VirtualMass))
    paper = partial(setup.model, SDC.paper)
    for step in (1e-4,) if quick else PAPER_STEPS:
        ours("paper, by hand", f"{step:g} s", partial(_stepped, paper, step))
    for tolerance in (1e-7,) if quick else OUR_TOLERANCES:
        ours("sdc", f"tolerance {tolerance:g}", partial(setup.model, SDC, tolerance=tolerance))
    for freezes in (2,) if quick else FREEZES:
        ours(f"sdc, {freezes} freezes", usual, partial(setup.model, SDC, freezes=freezes))
    found += _by_graph(setup, paper, say)
    exact = ExactCollision(setup.model(SDC))
    frozen = exact.collide(case.q, case.v, case.torque)
    found.append(
        Entry(
            method="exact",
            setting="in Python",
            run=lambda: exact.collide(case.q, case.v, case.torque),
            result=frozen,
        )
    )
    found += _peers(setup, true, frozen, say, quick)
    return found, refused


def _ours(
    setup: Setup, say: Say, found: list[Entry], refused: list[dict[str, Any]]
) -> Callable[[str, str, Callable[[], Any]], None]:
    """Adds a model of ours, which it makes, to what is found, or the reason against it to what is refused."""
    case = setup.case

    def add(method: str, setting: str, make: Callable[[], Any]) -> None:
        say(f"{setup.name}: {method}, {setting}")
        try:
            model = make()
            longest = model.stable_step(case.q)
            if model.stepping != "implicit" and model.step_length >= longest:
                raise InputError(f"unstable: the longest stable step is {longest:.2g} s")
        except InputError as error:
            refused.append({"method": method, "setting": setting, "note": str(error)})
            return
        every = max(1, round(COLUMN / model.step_length))
        wanted = tuple(name for name in EVALUATION if name in model.available)
        run = run_of(model, case, wanted, every=every)
        result = outcome(model, case, every=every)
        found.append(Entry(method=method, setting=setting, run=run, result=result))

    return add


def _stepped(make: Callable[..., Any], step: float) -> Any:
    return replace(make(), step=step)


def _by_graph(setup: Setup, paper: Callable[..., Any], say: Say) -> list[Entry]:
    """The paper's scheme and ours by CasADi's route: from the graph to C, at -O1."""
    made = []
    ours = setup.model(SDC, method="rk4")
    for method, model in (("paper, CasADi's C", paper()), ("sdc, CasADi's C", ours)):
        say(f"{setup.name}: {method}")
        wanted = tuple(name for name in EVALUATION if name in model.available)
        run = runner(graph(model, wanted), inputs(model, setup.case))
        made.append(
            Entry(
                method=method,
                setting=f"{model.step_length:g} s",
                run=run,
                result=outcome(model, setup.case),
            )
        )
    return made


def _peers(setup: Setup, true: Collision, frozen: Collision, say: Say, quick: bool) -> list[Entry]:
    case, made = setup.case, []
    for tolerance in (1e-7,) if quick else TOLERANCES:
        run, impulse = cvodes(setup, frozen.duration, tolerance)
        note = "frozen; its end is given to it; the freeze is not in the time"
        made.append(
            Entry(
                method="CVODES by CasADi",
                setting=f"tolerance {tolerance:g}",
                run=run,
                impulse=impulse(),
                note=note,
            )
        )
    calls = pinocchio_calls(setup)["constrained dynamics"]
    for tolerance in (1e-6,) if quick else FULL_TOLERANCES:
        say(f"{setup.name}: full dynamics, tolerance {tolerance:g}")
        model = setup.model(FullDynamics, step=COLUMN, tolerance=tolerance, form="pinocchio")
        run = partial(model.collide, case.q, case.v, case.torque)
        setting = f"tolerance {tolerance:g}"
        made.append(Entry(method="Pinocchio, loop in Python", setting=setting, run=run, result=run()))
    alone: Callable[[], Any] = partial(_many, calls, 4 * round(true.duration / FULL_STEP))
    note = "constraintDynamics alone, four times a step, as Runge-Kutta's method: a bound from below"
    made.append(Entry(method="Pinocchio, calls alone", setting=f"{FULL_STEP:g} s", run=alone, note=note))
    for step in (1e-4,) if quick else MUJOCO_STEPS:
        say(f"{setup.name}: MuJoCo, {step:g} s")
        setting = f"{step:g} s"
        alone = mujoco_steps(setup, step, true.duration)
        note = "mj_step alone, without servo, law and records: a bound from below"
        made.append(Entry(method="MuJoCo, steps alone", setting=setting, run=alone, note=note))
        loop = mujoco_loop(setup, step)
        try:
            result = loop()
        except InputError:
            continue
        made.append(Entry(method="MuJoCo, loop in Python", setting=setting, run=loop, result=result))
    return made


def _many(call: Callable[[], Any], times: int) -> None:
    for _ in range(times):
        call()
