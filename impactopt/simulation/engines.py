"""The engines by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from impactopt.errors import InputError, check_array, did_you_mean
from impactopt.problem.problem import ImpactProblem
from impactopt.simulation.clearance import with_clearance
from impactopt.simulation.controller import controller_of
from impactopt.simulation.mujoco_engine import simulate_mujoco
from impactopt.simulation.pinocchio_engine import simulate_pinocchio
from impactopt.simulation.result import Simulation
from impactopt.simulation.scene import scene_of
from impactopt.simulation.step_error import with_step_error

ENGINES: dict[str, Callable[..., Simulation]] = {
    "pinocchio": simulate_pinocchio,
    "mujoco": simulate_mujoco,
}


STEPS = (1e-6, 1e-2)  # [s]: below, a replay takes hours; above, it steps over most contacts
LONGEST = 60.0  # [s] beyond the motion: what falls has fallen in a tenth of that
MOST_STEPS = 20_000_000  # an hour's work


def simulate(
    problem: ImpactProblem, reference: Any, *, engine: str = "pinocchio", **options: Any
) -> Simulation:
    """Re-simulate a reference for a problem: "pinocchio" holds the soles, "mujoco" holds nothing.

    reference : as of :class:`impactopt.transcription.plan.Trajectory`.  options : of the engine, such as
        ``step`` [s]; of "mujoco" also ``controller``, "servo" or "wbc", or its settings.

    Raises
    ------
    InputError : an unknown engine or option; a step or a time beyond the motion that no replay has.
    """
    if engine not in ENGINES:
        raise InputError(
            f"unknown engine {engine!r}{did_you_mean(engine, ENGINES)}: there are {', '.join(ENGINES)}"
        )
    run = ENGINES[engine]
    known = set(run.__kwdefaults__ or {})
    if "controller" in options:
        options["controller"] = controller_of(options["controller"])
        if "controller" not in known and options.pop("controller") is not None:
            raise InputError(f"engine {engine!r} has the joints' servo only; take engine 'mujoco'")
    for name in options:
        if name == "perturbation" and name not in known:
            raise InputError(
                f"engine {engine!r} replays what was planned, no perturbation; take engine 'mujoco'"
            )
        if name not in known:
            raise InputError(
                f"engine {engine!r} has no option {name!r}{did_you_mean(name, known)}: there are "
                f"{', '.join(sorted(known))}"
            )
    _check_times({**(run.__kwdefaults__ or {}), **options}, float(reference.end))
    found = with_step_error(run, problem.robot, reference, scene_of(problem), **options)
    return with_clearance(problem, replace(found, expected=float(reference.contact_start)))


def _check_times(options: Mapping[str, Any], end: float) -> None:
    """InputError for a step or a time to settle that is out of its range."""
    given = {name: 0.0 if options[name] is None else options[name] for name in ("step", "settle")}
    step, settle = (float(check_array(f"{name} [s]", value, ())) for name, value in given.items())
    if not STEPS[0] <= step <= STEPS[1]:
        raise InputError(f"step [s]: {step:g}; give a number of {STEPS[0]:g} to {STEPS[1]:g}")
    if not 0 <= settle <= LONGEST:
        raise InputError(f"settle [s]: {settle:g}; give a number of 0 to {LONGEST:g}")
    if (end + settle) / step > MOST_STEPS:
        raise InputError(
            f"a replay of {end + settle:g} s in steps of {step:g} s has {(end + settle) / step:.2g} of them; "
            f"give a longer step, for at most {MOST_STEPS:.2g}"
        )
