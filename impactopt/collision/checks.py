"""What `collide` refuses because its numbers would not be right."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .model import JointSpaceModel
from .result import Collision
from .stability import contact_rate, servo_modes, step_error

if TYPE_CHECKING:
    from .symbolic import SymbolicModel

__all__ = ["check_course", "check_finite", "check_frozen"]

Array = NDArray[np.float64]

# error of the impulse beyond which the step is refused, relative (see `SymbolicModel`)
_ACCURACY = {"events": 1e-5, "rk4": 1e-2}
# of a factorization's pivot, and of the hand's mobility, relative: with less, rounding reaches 1e-7
_LEAST_PIVOT = 1e-9
# force that pulls at separation, of the peak's; steps that find their events leave 1e-5 of a step's change
_OVERSHOT = 1e-4


def check_frozen(frozen: dict[str, Array]) -> None:
    """InputError where rounding spoils what is frozen (with `pivots` and `freedom` among it)."""
    if not (frozen["pivots"] > _LEAST_PIVOT).all():
        raise InputError(
            "q: what holds the robot cannot be told apart here (held frames' directions depend on each "
            "other, so that their wrenches are undetermined): hold fewer frames, or give the legs more "
            "joints, or bend them, or use a virtual base (base_mass, base_inertia)"
        )
    if not frozen["freedom"].item() > _LEAST_PIVOT and frozen["m"].item() != 0:
        raise InputError(
            "q: what holds the robot leaves its striking point no motion along the normal here: an "
            "effective mass without end; bend the arm, or turn the normal"
        )
    for name in {*frozen} - {"pivots", "freedom"}:
        if not np.isfinite(frozen[name]).all():
            raise InputError(f"q: the frozen dynamics have no finite {name} here; check the robot's inertias")


def check_finite(outputs: dict[str, Array], step: float) -> None:
    """InputError where an output is no number."""
    # the zero-moment point of a robot without weight on its soles is nowhere
    bad = [name for name, x in outputs.items() if name != "zmp" and not np.isfinite(x).all()]
    if bad:
        raise InputError(
            f"step [s]: with {step:g} the collision diverges ({', '.join(bad)} without end): "
            "give a shorter step, or a slower v or softer contact, if that is what was meant"
        )


def check_course(
    collision: SymbolicModel,
    result: Collision,
    data: dict[str, Array],
    point_mass: tuple[JointSpaceModel, Any],
) -> None:
    """InputError where the steps were too few, or too long for the contact's own modes.

    data : what is frozen, and the settings.
    point_mass : the robot as one, and its slope (`slope_function`).
    """
    length, method = collision.step_length, collision.stepping
    if not result.separated and result.duration < collision.horizon * (1 - 1e-9):
        mend = (
            "shorten the horizon, or give a larger tolerance"
            if method == "implicit"
            else "raise the horizon or give a shorter step, both of which make more steps"
        )
        raise InputError(
            f"horizon [s]: the steps are used up by events after {result.duration:.3g} s, before the "
            f"horizon, {collision.horizon:g} s: joints saturate or slide again and again; {mend}"
        )
    if result.duration == 0:
        return
    if method == "implicit":
        if result.impulse < 0:
            raise InputError(
                f"v: the contact ends within {result.duration:.2g} s, where rounding hides its force: "
                "give one that approaches faster"
            )
        return
    if result.impulse < 0 or (method == "events" and _overshot(collision, result, data) > _OVERSHOT):
        raise InputError(
            f"step [s]: the contact ends within {result.duration:.2g} s, too soon for steps of "
            f"{length:g}: give a shorter step, or a v that approaches faster"
        )
    model, slope = point_mass
    rate = result.hand_speed - result.target_speed
    contact = contact_rate(model, slope, data, result.penetration, rate)
    modes = servo_modes(data, length) if collision.n_servos else (np.zeros(0), np.zeros(0))
    if step_error(method, length, contact, *modes) <= _ACCURACY[method]:
        return
    step = length
    while step_error(method, step, contact, *modes) > _ACCURACY[method]:
        step *= 0.9
    raise InputError(
        f"step [s]: {length:g} is too long to follow this contact, whose rate is {contact:.2g} 1/s, within "
        f"{_ACCURACY[method]:g} of its impulse: give a step below {step:.2g}"
    )


def _overshot(collision: SymbolicModel, result: Collision, data: dict[str, Array]) -> float:
    """How far below zero the force is at separation, of its peak: the search for events starts from a whole
    step, and may miss a separation that comes after a small part of it."""
    if not result.separated:
        return 0.0
    law = collision.law
    numbers = {name: float(data[f"contact_{name}"].item()) for name in law.parameters}
    rate = float(result.hand_speed[-1] - result.target_speed[-1])
    left = ca.DM(law.branch(float(result.penetration[-1]), rate, False, numbers))
    return max(0.0, -float(left)) / max(result.peak_force, 1e-300)
