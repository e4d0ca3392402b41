"""Reference of the servo during contact: it coasts with the soles in place, as that of a plan."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from impactopt.collision.settings import REFERENCE_ORDER, constant_reference
from impactopt.errors import InputError, check_positive
from impactopt.kinematics.coordinates import StanceCoordinates, independent_rates

Array = NDArray[np.float64]
_NODES = 3 * REFERENCE_ORDER  # of the fit
_MIN_TIME = 1e-3  # [s] below which legs that do not reach are an error
_SHRINK = 0.9  # of the fitted time, as long as the fit is not good
_MAX_ERROR = 1e-4  # [rad/s] of a good fit


def coasting_reference(
    coordinates: StanceCoordinates, q: ArrayLike, v: ArrayLike, *, until: float = 0.1
) -> dict[str, NDArray[np.float64]]:
    """Settings of a collision model in which the servo's reference keeps the soles in place.

    During contact a plan's reference keeps the rates ydot of its independent coordinates: the base's pose and
    the joints outside the legs. The soles stay in place, so that the velocities of the leg joints change.
    Their change is fitted by t, t^2, ... t^10. The fit is exact in the acceleration at contact. It covers the
    longest time between half of `until` and `until` for which its error is below 1e-4 rad/s: less for legs
    that are nearly straight, whose velocities grow without bound.

    Parameters
    ----------
    coordinates : of the stance, such as `ImpactProblem.coordinates`.
    q, v : (nq,), (nv,) at contact, Pinocchio's, with the soles in place and at rest.
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
    _, start, acceleration = c.complete_motion(y, rates, np.zeros(c.ny), c.solve_legs(y, legs))
    orders = np.arange(2, REFERENCE_ORDER + 1)
    while True:
        # least squares at Chebyshev nodes are nearly the best uniform fit
        times = until * (1 - np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)) / 2
        try:
            velocities = np.array([_velocity(c, y + rates * t, rates, legs) for t in times])
        except InputError:  # the legs do not reach that far
            if until < _MIN_TIME:
                raise
        else:
            # the linear term is known, so the fit begins with t^2
            remainder = (velocities - start - np.outer(times, acceleration))[:, -robot.n :]
            powers = (times / until)[:, None] ** orders
            fitted = np.linalg.lstsq(powers, remainder, rcond=None)[0]
            if np.abs(powers @ fitted - remainder).max() < _MAX_ERROR or until * _SHRINK < shortest:
                break
        until *= _SHRINK
    # fitted in t / until, so that powers up to the tenth are of order one
    reference = np.column_stack([acceleration[-robot.n :], fitted.T / until**orders])
    return {"reference": reference, "reference_until": np.array(until)}


def _velocity(c: StanceCoordinates, y: Array, rates: Array, legs: Array) -> Array:
    """v (nv,) at y (ny,) with rates (ny,); `legs` is the initial guess of the inverse kinematics."""
    return c.complete_motion(y, rates, np.zeros(c.ny), c.solve_legs(y, legs))[1]
