"""The engines by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from impactopt.errors import InputError, did_you_mean
from impactopt.problem import ImpactProblem
from impactopt.validation.accuracy import with_step_error
from impactopt.validation.clearing import with_clearance
from impactopt.validation.mujoco_engine import simulate_mujoco
from impactopt.validation.pinocchio_engine import simulate_pinocchio
from impactopt.validation.result import Simulation
from impactopt.validation.scene import scene_of

ENGINES: dict[str, Callable[..., Simulation]] = {
    "pinocchio": simulate_pinocchio,
    "mujoco": simulate_mujoco,
}


def simulate(
    problem: ImpactProblem, reference: Any, *, engine: str = "pinocchio", **options: Any
) -> Simulation:
    """Re-simulate a reference for a problem: "pinocchio" holds the soles, "mujoco" holds nothing.

    reference : as of :class:`impactopt.plan.Trajectory`.  options : of the engine, such as ``step`` [s].

    Raises
    ------
    InputError : an unknown engine or option.
    """
    if engine not in ENGINES:
        raise InputError(
            f"unknown engine {engine!r}{did_you_mean(engine, ENGINES)}: there are {', '.join(ENGINES)}"
        )
    run = ENGINES[engine]
    known = set(run.__kwdefaults__ or {})
    for name in options:
        if name == "conditions" and name not in known:
            raise InputError(
                f"engine {engine!r} replays what was planned, no other conditions; take engine 'mujoco'"
            )
        if name not in known:
            raise InputError(
                f"engine {engine!r} has no option {name!r}{did_you_mean(name, known)}: there are "
                f"{', '.join(sorted(known))}"
            )
    found = with_step_error(run, problem.robot, reference, scene_of(problem), **options)
    return with_clearance(problem, found)
