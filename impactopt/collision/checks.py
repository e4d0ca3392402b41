"""Checks by which `collide` refuses a collision whose numbers would not be right."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.collision.result import Collision
from impactopt.collision.stepped import SteppedModel
from impactopt.contact import Board
from impactopt.errors import InputError

__all__ = [
    "ACCURACY",
    "LEAST_PIVOT",
    "breaks",
    "check_course",
    "check_finite",
    "check_frozen",
    "left_out_by_breaking",
    "spoiled",
    "too_large",
    "without_contact",
]

Array = NDArray[np.float64]

# error of the impulse beyond which the step is refused, relative (see `SteppedModel`); and the power of the
# step that it goes with
ACCURACY = {"rk4": 1e-2}
_ORDERS = {"rk4": 2}
# of a factorization's pivot, and of the hand's mobility, relative: with less, rounding reaches 1e-7
LEAST_PIVOT = 1e-9


def check_frozen(frozen: dict[str, Array]) -> None:
    """InputError where rounding spoils what is frozen (with `pivots` and `freedom` among it)."""
    if not (frozen["pivots"] > LEAST_PIVOT).all():
        raise InputError(
            "q: what holds the robot cannot be told apart here (held frames' directions depend on each "
            "other, so that their wrenches are undetermined): hold fewer frames, or give the legs more "
            "joints, or bend them, or use a virtual base (base_mass, base_inertia)"
        )
    if not frozen["freedom"].item() > LEAST_PIVOT and frozen["m"].item() != 0:
        raise InputError(
            "q: what holds the robot leaves its striking point no motion along the normal here: an "
            "effective mass without end; bend the arm, or turn the normal"
        )
    for name in {*frozen} - {"pivots", "freedom"}:
        if not np.isfinite(frozen[name]).all():
            raise InputError(f"q: the frozen dynamics have no finite {name} here; check the robot's inertias")


def spoiled(frozen: dict[str, Array]) -> Any:
    """(N) rows that `check_frozen` refuses; numbers (N, ...)."""
    bad = ~(frozen["pivots"] > LEAST_PIVOT).all(axis=1)
    bad |= ~(frozen["freedom"][:, 0] > LEAST_PIVOT) & (frozen["m"][:, 0] != 0)
    for name in {*frozen} - {"pivots", "freedom"}:
        bad |= ~np.isfinite(frozen[name]).all(axis=1)
    return bad


def without_contact(impulse: Array, duration: Array, step: Any = 0.0) -> Any:
    """True for contacts that ended so soon that rounding hides their force, or within one explicit step
    [s].
    """
    return (duration > 0) & ((impulse < 0) | (duration <= step))


def check_finite(outputs: dict[str, Array], step: float) -> None:
    """InputError where an output is no number."""
    # the zero-moment point of a robot without weight on its soles is nowhere
    bad = [name for name, x in outputs.items() if name != "zmp" and not np.isfinite(x).all()]
    if bad:
        raise InputError(
            f"step [s]: with {step:g} the collision diverges ({', '.join(bad)} without end): "
            "give a shorter step, or a slower v or softer contact, if that is what was meant"
        )


def too_large(method: str, error: Array) -> Any:
    """True if the estimated error of Runge-Kutta's impulses is more than the method may have."""
    return ~(error <= ACCURACY[method])


def left_out_by_breaking(collision: SteppedModel, impulse: Any, results: Any, force: Any) -> Any:
    """Relative error of Runge-Kutta's impulse that a board's break within a step may cause.

    Its stages judge whether it has broken: for up to half a step its force is taken for what it is not.
    results (..., k) : of the target.  force [N] : that breaks it.
    """
    broken = np.asarray(results)[..., list(collision.target.results).index("broken")] > 0.5
    return broken * 0.5 * collision.step_length * np.asarray(force) / np.maximum(impulse, 1e-300)


def breaks(collision: SteppedModel) -> bool:
    """True if `left_out_by_breaking` has to be checked."""
    return collision.stepping == "rk4" and isinstance(collision.target, Board)


def check_course(collision: SteppedModel, result: Collision, error: float) -> None:
    """InputError where the steps were too few, or too long for the contact's own modes.

    error : what Runge-Kutta steps left out of the impulse, relative, as an estimate.
    """
    length, method = collision.step_length, collision.stepping
    if not result.separated and result.duration < collision.horizon * (1 - 1e-9):
        fix = (
            "shorten the horizon, or give a larger tolerance"
            if method == "implicit"
            else "raise the horizon or give a shorter step, both of which make more steps"
        )
        raise InputError(
            f"horizon [s]: the steps are used up by events after {result.duration:.3g} s, before the "
            f"horizon, {collision.horizon:g} s: joints saturate or slide again and again; {fix}"
        )
    if result.duration == 0:
        return
    if method == "implicit":
        if without_contact(np.array(result.impulse), np.array(result.duration)):
            raise InputError(
                f"v: the contact ends within {result.duration:.2g} s, where rounding hides its force: "
                "give one that approaches faster"
            )
        return
    within = length if result.separated else 0.0
    if without_contact(np.array(result.impulse), np.array(result.duration), within):
        raise InputError(
            f"step [s]: the contact ends within {result.duration:.2g} s, too soon for steps of "
            f"{length:g}: give a shorter step, or a v that approaches faster"
        )
    if too_large(method, np.array(error)):
        shorter = 0.8 * length * (ACCURACY[method] / error) ** (1 / _ORDERS[method])
        raise InputError(
            f"step [s]: {length:g} is too long to follow this contact within {ACCURACY[method]:g} of its "
            f"impulse, of which it leaves out {error:.2g}: give a step below {shorter:.2g}"
        )
