"""Margins of each sole by itself: distance of its centre of pressure from its own edges, and its load."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.robots.robot import Robot

__all__ = ["BEARS", "cop_margin", "least_kept", "least_margins", "shortfalls", "weight_of"]

Array = NDArray[np.float64]
BEARS = 0.02  # of the weight: a sole with less on it bears no load
ROUNDING = 0.01  # [mm, N]
SHARE, FREE = 0.5, 1e-3  # of a margin, and [m] of any: what may be given up between nodes


def weight_of(robot: Robot) -> float:
    """Weight [N]."""
    mass = float(sum(inertia.mass for inertia in robot.model.inertias))
    return mass * float(np.linalg.norm(robot.model.gravity.linear))


def cop_margin(robot: Robot, corners: Sequence[Array], wrench: Array) -> Array:
    """Distance (k, soles) [m] of each sole's centre of pressure from the nearest of its own edges.

    corners : (c, 2) [m] of each sole in its own frame, counter-clockwise.
    wrench (k, soles, 6) : of the ground on each, in its own frame [N, N m].

    Positive inside; 0 on an edge, about which the sole tips; negative outside, where only a sole that is held
    can have it. With next to no force the centre of pressure is a quotient of small numbers. So a sole that
    bears less than 2 % of the robot's weight counts as if what it lacks of that pressed at its middle: an
    unloaded sole has its middle's margin, and a moment with no force to bear it still counts. A sole that is
    pulled shows in its normal force alone.
    """
    out = np.empty(wrench.shape[:2])
    for k, polygon in enumerate(corners):
        force, moment = wrench[:, k, 2], np.stack([-wrench[:, k, 4], wrench[:, k, 3]], axis=1)
        lacking = np.maximum(BEARS * weight_of(robot) - force, 0.0)
        cop = (moment + lacking[:, None] * polygon.mean(axis=0)) / (force + lacking)[:, None]
        edge = np.roll(polygon, -1, axis=0) - polygon
        inward = np.stack([-edge[:, 1], edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
        out[:, k] = (cop @ inward.T - (inward * polygon).sum(axis=1)).min(axis=1)
    return out


def least_kept(asked: float) -> float:
    """Margin [m] that a plan has to keep between its nodes of one that it is asked for at them: half of it,
    or all but a millimetre.
    """
    return asked - max(SHARE * asked, FREE)


def least_margins(
    names: Sequence[str], cop: Array, force: Array, phases: Mapping[str, NDArray[np.bool_]]
) -> dict[str, dict[str, dict[str, float]]]:
    """Least margin [mm] and least normal force [N] of each sole in each phase, as in ``summary.json``.

    cop (k, soles) [m] : of :func:`cop_margin`.  force (k, soles) [N].  phases : by name, which instants (k,)
    are in it; one without any is left out.
    """

    def least(values: Array) -> dict[str, dict[str, float]]:
        return {
            name: {phase: float(column[at].min()) for phase, at in phases.items() if at.any()}
            for name, column in zip(names, values.T, strict=True)
        }

    return {"sole_cop_margin_mm": least(1e3 * cop), "sole_force_N": least(force)}


def shortfalls(numbers: Mapping[str, Any]) -> list[str]:
    """The margins of which less than half is kept, in words, worst first.

    numbers : of `least_margins`, beside what is asked, as in ``summary.json``.
    """
    asked, found = numbers.get("sole_cop_margin_asked_mm") or {}, []
    for name, phases in (numbers.get("sole_cop_margin_mm") or {}).items():
        for phase, kept in phases.items():
            if phase in asked and kept < (least := 1e3 * least_kept(1e-3 * asked[phase])) - ROUNDING:
                what = f"centre of pressure of the sole {name!r}, {phase}"
                found.append((kept - least, f"{what}: {kept:.1f} mm kept of {asked[phase]:g} mm"))
    force = numbers.get("sole_force_asked_N") or 0.0
    for name, phases in (numbers.get("sole_force_N") or {}).items():
        for phase, kept in phases.items():
            if kept < SHARE * force - ROUNDING:
                what = f"normal force on the sole {name!r}, {phase}"
                found.append((kept - SHARE * force, f"{what}: {kept:.0f} N kept of {force:g} N"))
    return [words for _, words in sorted(found)]
