"""Inertias that no body can have: all of them at once, and how they are repaired where a user says so."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.errors import FARTHEST, InputError, Mistakes
from impactopt.robots.checks import HEAVIEST

__all__ = ["GIVEN", "INERTIAS", "REPAIRED", "check_inertias", "repair_inertias"]

Array = NDArray[np.float64]
GIVEN, REPAIRED = "given", "repaired"
INERTIAS = (GIVEN, REPAIRED)
TRIANGLE = 1e-3  # relative, of the triangle inequality: room for rounded decimals
THIN = 0.01  # [m] of the slab that a repaired body has at least the second moments of
DENSITY = 2000.0  # [kg/m3] of the ball that takes the place of a point: motors, gears and housing
_MEND = f'correct its <inertial>, with moments about the centre of mass, or take inertias="{REPAIRED}"'


def check_inertias(model: pin.Model) -> None:
    """InputError with all moving bodies whose mass or inertia cannot be those of matter."""
    found = Mistakes()
    for i in range(1, model.njoints):
        for text in _wrong(model, i):
            found.found.append(text)
    found.raise_if_any(f"the robot {model.name!r}")


def _wrong(model: pin.Model, i: int) -> Iterator[str]:
    """First physically impossible property of the body that joint i moves."""
    body = model.inertias[i]
    root = model.joints[i].nq == 7  # a free-flyer, which has no joint in the file
    link = _root(model) if root else f"the link moved by joint {model.names[i]!r}"
    where = f"{link} (with what is fixed to it)"
    inertia, placed = np.array(body.inertia), model.jointPlacements[i].translation
    if not 0 < body.mass <= HEAVIEST:
        bolt = ", or bolt the robot to the ground (floating = false)" if root else ""
        yield f"{where} has mass {body.mass:g} kg; give its <inertial> one > 0 and <= {HEAVIEST:g}{bolt}"
    elif not (np.isfinite(inertia).all() and np.isfinite(body.lever).all()):
        yield f"{where} has NaN or infinity in its <inertial>; give finite numbers"
    elif not (np.abs(inertia).max() <= HEAVIEST and max(np.abs(body.lever)) <= FARTHEST):
        yield (
            f"{where} has more than {HEAVIEST:g} kg m2, or its centre of mass more than {FARTHEST:g} m "
            "from its joint; correct its <inertial>"
        )
    elif not max(np.abs(placed)) <= FARTHEST:
        yield (
            f"joint {model.names[i]!r} is {max(np.abs(placed)):g} m from the one before, and "
            f"{FARTHEST:g} is the most; correct its <origin>"
        )
    else:
        small, middle, large = np.linalg.eigvalsh(inertia)
        moments = f"{small:.3g}, {middle:.3g}, {large:.3g} kg m2"
        if small <= 0:
            yield f"{where} has principal moments of inertia {moments}: not positive definite; {_MEND}"
        elif small + middle < large * (1 - TRIANGLE):
            yield (
                f"{where} has principal moments of inertia {moments}: one exceeds the sum of the others, "
                f"which no body has; {_MEND}"
            )


def _root(model: pin.Model) -> str:
    links = (f for f in model.frames if f.parentJoint == 1 and f.type == pin.FrameType.BODY)
    link = next(links, None)
    return f"the root link {link.name!r}" if link is not None else "the root link"


def repair_inertias(model: pin.Model) -> list[str]:
    """Change inertias that no body of this mass can have, in place, and say in words which.

    Mass and centre of mass stay. Moments come from second moments of mass along the principal axes, which are
    raised to those of a slab 1 cm thick where they are less; where all three are, the body becomes a ball of
    2000 kg/m3. A body that passes both is left alone.
    """
    said = []
    for i in range(1, model.njoints):
        body = model.inertias[i]
        if not (0 < body.mass <= HEAVIEST and np.isfinite(np.array(body.inertia)).all()):
            continue  # there is nothing to go by: it is refused
        moments, axes = np.linalg.eigh(np.array(body.inertia))
        second = moments.sum() / 2 - moments  # of mass, along the axes
        least = body.mass * THIN**2 / 12
        point = bool((second < least).all())
        if not point and moments[0] > 0 and moments[0] + moments[1] >= moments[2] * (1 - TRIANGLE):
            continue
        if point:
            second = np.full(3, body.mass / 5 * (3 * body.mass / (4 * np.pi * DENSITY)) ** (2 / 3))
        second = np.maximum(second, least)
        new = second.sum() - second
        model.inertias[i] = pin.Inertia(
            body.mass, np.array(body.lever), axes @ np.diag(new) @ axes.T if not point else np.diag(new)
        )
        how = f"a ball of {DENSITY:g} kg/m3" if point else "the nearest that a body can have"
        said.append(
            f"the link moved by joint {model.names[i]!r}, {body.mass:.3g} kg: {_three(moments)} became "
            f"{_three(np.sort(new))} kg m2, {how}"
        )
    return said


def _three(numbers: Any) -> str:
    return ", ".join(f"{x:.3g}" for x in numbers)


def check_choice(inertias: str) -> None:
    """InputError for what is neither "given" nor "repaired"."""
    if inertias not in INERTIAS:
        raise InputError(f'inertias = {inertias!r}; give "{GIVEN}" (as the file has them) or "{REPAIRED}"')
