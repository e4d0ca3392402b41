"""How a reference that coasts with its soles in place bends: what a plan's servo holds on to in contact."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..collision.settings import REFERENCE_ORDER, no_bend
from ..coordinates import StanceCoordinates, base_motion
from ..errors import InputError, check_array

__all__ = ["coasting_reference"]

Array = NDArray[np.float64]
_NODES = 3 * REFERENCE_ORDER
_SHORTEST = 1e-3  # [s]


def coasting_reference(
    coordinates: StanceCoordinates, q: ArrayLike, v: ArrayLike, *, until: float = 0.1
) -> NDArray[np.float64]:
    """The setting `reference` (n, 6) [rad/s^(k + 1)] of a collision whose reference keeps the soles in place.

    A plan's reference goes on in contact at the rates ydot of its independent coordinates: the base's pose
    and the joints outside the legs. So the legs' joint velocities change, as the soles stay where they are.
    What they gain is fitted by t, t^2, ... t^6, exact in the acceleration at contact, and else best at all
    times up to `until` [s], which should be beyond separation; sooner, where the legs end before.

    Parameters
    ----------
    coordinates : where the soles are held, such as `ImpactProblem.coordinates`.
    q, v : (nq), (nv) at contact, Pinocchio's, with the soles in place and at rest.
    until : [s] since contact.

    Raises
    ------
    InputError : wrong shapes or NaN; soles that are not in place; a time that is not positive.
    """
    c, robot = coordinates, coordinates.robot
    q, v = robot.check_configuration(q), robot.check_velocity(v)
    if not check_array("until [s]", until, ()) > 0:
        raise InputError(f"until [s]: {until:g}; give a number > 0")
    if not c.legs:
        return no_bend(robot.n)
    y, legs = c.split(q)
    rates, none = _rates(c, y, v), np.zeros(c.ny)
    _, start, bend = c.complete_motion(y, rates, none, c.solve_legs(y, legs))
    while True:
        # Chebyshev's nodes: a fit at them is nearly the best at all times
        times = until * (1 - np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)) / 2
        try:
            gained = [_at(c, y + rates * t, rates, legs)[-robot.n :] - start[-robot.n :] for t in times]
            break
        except InputError:
            if until < _SHORTEST:
                raise
            until *= 0.7
    share = (times / until)[:, None] ** np.arange(2, REFERENCE_ORDER + 1)
    left = np.array(gained) - times[:, None] * bend[-robot.n :]
    fitted = np.linalg.lstsq(share, left, rcond=None)[0].T
    return np.column_stack([bend[-robot.n :], fitted / until ** np.arange(2, REFERENCE_ORDER + 1)])


def _rates(c: StanceCoordinates, y: Array, v: Array) -> Array:
    """ydot (ny) of a Pinocchio velocity."""
    rates, b = np.zeros(c.ny), c.base
    if b:
        # v is linear in them
        columns = [base_motion(y[:6], unit, np.zeros(6))[0] for unit in np.eye(6)]
        rates[:6] = np.linalg.solve(np.transpose(columns), v[:6])
    rates[b:] = v[b + c.independent]
    return rates


def _at(c: StanceCoordinates, y: Array, rates: Array, near: Array) -> Array:
    """v (nv) there; `near` are leg joints that inverse kinematics begins with."""
    return c.complete_motion(y, rates, np.zeros(c.ny), c.solve_legs(y, near))[1]
