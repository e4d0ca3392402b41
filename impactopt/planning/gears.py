"""Warnings about gear loads of a plan that exceed the gears' peak torque."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from impactopt.problem.problem import ImpactProblem
from impactopt.robots.actuator_loads import DriveLoads
from impactopt.transcription.mesh_refinement import GEAR

__all__ = ["gear_caution", "gears_beyond"]

REPLAYED = 0.1  # beyond what gears may bear: replays of a plan that keeps to it stay within this


def gears_beyond(problem: ImpactProblem, found: Iterable[DriveLoads], more: float = GEAR) -> str:
    """The gear that bears most beyond what a problem lets it, in words; "" if none does.

    more : by so much at least, of what it may bear. Rows would keep it within 3 % between the program's
    points.
    """
    most = problem.gear_load.most(problem.robot)
    worst, said = 1.0 + more, ""
    for loads in found:
        share = np.nan_to_num(loads.gear / most)
        k = int(share.argmax())
        if share[k] > worst:
            of_limit = f"{loads.gear[k]:.3g} times its torque limit, which may be {most[k]:.3g}"
            worst, said = share[k], f"gear of {loads.joints[k]}: {of_limit}"
    return said


def gear_caution(problem: ImpactProblem, found: Sequence[DriveLoads | None]) -> dict[str, str]:
    """Warning about overloaded gears, for a plan that permits them or for replays; {} if there are none."""
    loads = [one for one in found if one is not None]
    if problem.gear_load.active:
        text = gears_beyond(problem, loads, more=REPLAYED)
        return {"gear_caution": f"{text}, more than it may"} if text else {}
    beyond = [text for one in loads if (text := one.beyond_peak())]
    return {"gear_caution": beyond[0]} if beyond else {}
