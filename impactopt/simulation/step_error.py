"""Estimates the error of a replay's impulse from an engine's steps, by a second replay with other steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from impactopt.errors import InputError
from impactopt.simulation.result import Simulation

__all__ = ["ALLOWED", "check_steps", "with_step_error"]

ALLOWED = 1e-2  # of the impulse
HALVINGS = 2
BEYOND = 0.02  # [s] after the blow that the comparison goes on


def with_step_error(run: Callable[..., Simulation], *given: Any, **options: Any) -> Simulation:
    """The simulation by an engine, with how far off its impulse is by its steps, as an estimate.

    It is compared up to the end of the blow with one of twice the step, or where that was given longer than
    the engine's own with one of that. Where more than 1 % is left, or it diverges, and the step is no longer,
    it is halved, twice at most.
    """
    own = float((run.__kwdefaults__ or {})["step"])
    step = float(options.pop("step", own))
    for left in range(HALVINGS, -1, -1):
        try:
            found = run(*given, **options, step=step)
        except InputError:  # light links on stiff servos need shorter steps
            if step > own or not left:
                raise
            step /= 2
            continue
        found = replace(found, step_error=_error(run, given, options, found, step, own))
        if not found.step_error > ALLOWED or step > own:
            break
        step /= 2
    return found


def _error(
    run: Callable[..., Simulation],
    given: tuple[Any, ...],
    options: dict[str, Any],
    found: Simulation,
    step: float,
    own: float,
) -> float:
    """Relative to the larger of the impulses; nan where both have missed the target."""
    until = np.inf if np.isnan(found.contact_end) else found.contact_end + BEYOND
    if found.missed or (until == np.inf and step <= own):
        return np.nan
    for other in (own if step > own else 2 * step, step / 2):
        try:
            compared = run(*given, **options, step=other, until=until)
        except InputError:
            continue  # twice the step may be too long for the servo
        impulses = [sum(touch[2] for touch in s.touches if touch[0] <= until) for s in (found, compared)]
        largest = max(impulses)
        return abs(impulses[0] - impulses[1]) / largest if largest > 0 else np.nan
    return np.inf


def check_steps(found: Simulation, step: float | None) -> None:
    """InputError where the steps leave more than 1 % of the impulse uncertain."""
    if found.step_error > ALLOWED:
        given = "the engine's steps leave" if step is None else f"steps of {step:g} s leave"
        raise InputError(
            f"the replay is not to be trusted: {given} {100 * min(found.step_error, 1.0):.2g} % of its "
            f"impulse, {found.impulse:.4g} N s, uncertain; give a shorter step (--step), or a softer contact"
        )
