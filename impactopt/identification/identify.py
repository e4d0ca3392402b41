"""Identification of contact laws from a measured log."""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from impactopt.contact.laws import LAWS, ContactLaw
from impactopt.errors import InputError, check_choice, check_number
from impactopt.identification.fitting import fit_law
from impactopt.identification.free_parameters import sample_law
from impactopt.identification.log import ImpactLog, find_impacts, force_offset, read_log
from impactopt.identification.result import Identification
from impactopt.robots.robot import Robot


def identify(
    log: ImpactLog | str | os.PathLike[str],
    *,
    laws: str | type[ContactLaw] | ContactLaw | Sequence[str | type[ContactLaw] | ContactLaw] = LAWS,
    target_mass: float = np.inf,
    level: float = 0.95,
    robot: Robot | None = None,
    striker: str = "",
    normal: ArrayLike | None = None,
) -> Identification:
    """Identifies stiffness, damping and effective mass, with intervals, from a log of one impact or several.

    For each law, the collision of the hand, as a mass, with the target is fitted to force and motion of all
    impacts together by least squares: `VirtualMass` with unknown parameters and mass, and for each impact an
    unknown speed and instant of touch. Intervals are those of the linearized fit with white noise, whose
    standard deviations follow from the residuals of force and motion. Samples on flat tops, where the
    sensor's range has cut off the force, are left out, and so are impacts with less than 20 % of the largest
    force. The hand's drives do not act in the model, which holds
    for short impacts. Exponents, and other parameters that may not be 0, are fixed.

    Parameters
    ----------
    log : measured; or a file, as in `read_log`, which also takes `robot`, `striker` and `normal`.
    laws : to fit, or a single one: their words in problem files, classes, or laws with fixed parameters, such
        as another exponent. All parameters of a `CustomLaw` are fitted, with its values as initial guess.
    target_mass : [kg] of a free target; infinite for a fixed one, such as a load cell on a wall.
    level : of the intervals.

    Raises
    ------
    InputError : an unusable log, with the reason; an unknown law; values out of range.
    """
    if not 0 < check_number("level", level) < 1:
        raise InputError(f"level: {level:g}; give a number between 0 and 1, such as 0.95")
    if not check_number("target_mass [kg]", target_mass, finite=False) > 0:
        raise InputError(
            f"target_mass [kg]: {target_mass:g}; give a number > 0, or infinity for a fixed target"
        )
    given = [laws] if isinstance(laws, (str, type, ContactLaw)) else laws or ()
    chosen = [_law(law) for law in given]
    if not chosen:
        raise InputError("laws: none; give at least one")
    if isinstance(log, ImpactLog):
        measured = log
    elif not isinstance(log, (str, os.PathLike)):
        raise InputError(
            f"log: this is of type {type(log).__name__}; give a file, or ImpactLog(time=, force=, speed=)"
        )
    else:
        measured = read_log(log, robot=robot, striker=striker, normal=normal)
    impacts, weak = find_impacts(measured)
    fits = [fit_law(law, impacts, float(target_mass), level) for law in chosen]
    return Identification(
        log=measured.name,
        fits=tuple(sorted(fits, key=lambda fit: fit.aic)),
        samples=sum(len(impact.time) for impact in impacts),
        clipped=tuple(int(impact.clipped.sum()) for impact in impacts),
        top=max(impact.peak for impact in impacts),
        weak=weak,
        force_offset=force_offset(impacts),
        level=level,
        target_mass=float(target_mass),
        model_mass=tuple(impact.model_mass for impact in impacts),
    )


def _law(law: str | type[ContactLaw] | ContactLaw) -> ContactLaw:
    """Law from its word, its class, or itself."""
    if isinstance(law, ContactLaw):
        return law
    if isinstance(law, str):
        words = {kind.word: kind for kind in LAWS}
        check_choice("there is no law", law, words)
        law = words[law]
    if law not in LAWS:
        raise InputError(f"laws: {law!r}; give one of the package's, or one with parameters")
    return sample_law(law)
