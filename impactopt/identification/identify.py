"""Contact laws from a measured log of blows."""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from impactopt.contact.laws import LAWS, ContactLaw
from impactopt.errors import InputError, check_choice, check_number
from impactopt.identification.fitting import fit_law
from impactopt.identification.log import ImpactLog, find_blows, read_log
from impactopt.identification.result import Identification
from impactopt.identification.start import sample_law
from impactopt.robots.robot import Robot

__all__ = ["identify"]


def identify(
    log: ImpactLog | str | os.PathLike[str],
    *,
    laws: Sequence[str | type[ContactLaw] | ContactLaw] = LAWS,
    target_mass: float = np.inf,
    level: float = 0.95,
    robot: Robot | None = None,
    striker: str = "",
    normal: ArrayLike | None = None,
) -> Identification:
    """Stiffness, damping and effective mass from a measured log of one blow or several, with intervals.

    For each law, the collision of the hand, as a mass, with the target is fitted to force and motion of all
    blows together by least squares: `VirtualMass` with unknown numbers, an unknown mass, and for each blow an
    unknown speed and instant of touch. Intervals are those of the linearized fit with white noise, whose size
    on force and motion follows from what is left. Samples on flat tops, where the sensor's range has cut
    the force off, are left out. The hand's drives do not act in the model: that is right for short blows.
    Exponents are held at their values.

    Parameters
    ----------
    log : measured; or a file, as of `read_log`, which takes `robot`, `striker` and `normal` too.
    laws : to fit: by their words in problem files, classes, or laws, whose held numbers are taken, such as
        another exponent; all numbers of a `CustomLaw` are looked for, from those that it has.
    target_mass : [kg] of a target that is free; infinite for one that stays, such as a load cell on a wall.
    level : of the intervals.

    Raises
    ------
    InputError : a log that cannot be used, with what is wrong; an unknown law; numbers out of their range.
    """
    if not 0 < check_number("level", level) < 1:
        raise InputError(f"level: {level:g}; give a number between 0 and 1, such as 0.95")
    if not check_number("target_mass [kg]", target_mass, finite=False) > 0:
        raise InputError(f"target_mass [kg]: {target_mass:g}; give a number > 0; infinity: it stays")
    chosen = [_law(law) for law in laws]
    if not chosen:
        raise InputError("laws: none; give at least one")
    if isinstance(log, ImpactLog):
        measured = log
    else:
        measured = read_log(log, robot=robot, striker=striker, normal=normal)
    blows = find_blows(measured)
    fits = [fit_law(law, blows, float(target_mass), level) for law in chosen]
    return Identification(
        log=measured.name,
        fits=tuple(sorted(fits, key=lambda fit: fit.aic)),
        samples=sum(len(blow.time) for blow in blows),
        clipped=tuple(int(blow.clipped.sum()) for blow in blows),
        top=max(blow.peak for blow in blows),
        level=level,
        target_mass=float(target_mass),
        model_mass=tuple(blow.model_mass for blow in blows),
    )


def _law(law: str | type[ContactLaw] | ContactLaw) -> ContactLaw:
    if isinstance(law, ContactLaw):
        return law
    if isinstance(law, str):
        words = {kind.word: kind for kind in LAWS}
        check_choice("there is no law", law, words)
        law = words[law]
    if law not in LAWS:
        raise InputError(f"laws: {law!r}; give one of the package's, or one with numbers")
    return sample_law(law)
