"""Accelerations of a reference that coasts with its soles in place, as a plan's servo keeps it in contact."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from impactopt.collision.settings import REFERENCE_ORDER, constant_reference
from impactopt.errors import InputError, check_positive
from impactopt.kinematics.coordinates import StanceCoordinates, independent_rates

__all__ = ["coasting_reference"]

Array = NDArray[np.float64]
_NODES = 3 * REFERENCE_ORDER
_SHORTEST = 1e-3  # [s]
_SHORTER = 0.9
_OFF = 1e-4  # [rad/s] of a fit that is good


def coasting_reference(
    coordinates: StanceCoordinates, q: ArrayLike, v: ArrayLike, *, until: float = 0.1
) -> dict[str, NDArray[np.float64]]:
    """The settings of a collision whose servo's reference keeps the soles in place.

    During contact a plan's reference keeps the rates ydot of its independent coordinates: the base's pose and
    the joints outside the legs. The soles stay where they are, so the velocities of the leg joints change.
    Their change is fitted by t, t^2, ... t^10. The fit is exact in the acceleration at contact, and best over
    a time from half of `until` to `until`: the longest for which it is within 1e-4 rad/s. The time is shorter
    for legs that are nearly straight, whose velocities grow without bound.

    Parameters
    ----------
    coordinates : where the soles are held, such as `ImpactProblem.coordinates`.
    q, v : (nq), (nv) at contact, Pinocchio's, with the soles in place and at rest.
    until : [s] since contact; twice the contact's duration is a good value.

    Returns
    -------
    reference (n, 10) [rad/s^(k + 1)], reference_until [s] : by name, as `collide` takes them.

    Raises
    ------
    InputError : wrong shapes or NaN; soles that are not in place; a time that is not positive.
    """
    c, robot = coordinates, coordinates.robot
    q, v = robot.check_configuration(q), robot.check_velocity(v)
    check_positive("until [s]", until)
    if not c.legs:
        return constant_reference(robot.n)
    y, legs = c.split(q)
    rates, shortest = independent_rates(c, y, v), until / 2
    _, start, bend = c.complete_motion(y, rates, np.zeros(c.ny), c.solve_legs(y, legs))
    orders = np.arange(2, REFERENCE_ORDER + 1)
    while True:
        # Chebyshev's nodes: a fit at them is nearly the best at all times
        times = until * (1 - np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)) / 2
        try:
            there = np.array([_at(c, y + rates * t, rates, legs) for t in times])
        except InputError:
            if until < _SHORTEST:
                raise
        else:
            left = (there - start - np.outer(times, bend))[:, -robot.n :]
            share = (times / until)[:, None] ** orders
            fitted = np.linalg.lstsq(share, left, rcond=None)[0]
            if np.abs(share @ fitted - left).max() < _OFF or until * _SHORTER < shortest:
                break
        until *= _SHORTER
    reference = np.column_stack([bend[-robot.n :], fitted.T / until**orders])
    return {"reference": reference, "reference_until": np.array(until)}


def _at(c: StanceCoordinates, y: Array, rates: Array, near: Array) -> Array:
    """v (nv) there; `near` are leg joints that inverse kinematics begins with."""
    return c.complete_motion(y, rates, np.zeros(c.ny), c.solve_legs(y, near))[1]
