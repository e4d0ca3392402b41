"""What is hit, as numbers: the contact's force and the target's motion under it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from impactopt.validation.result import Scene

Array = NDArray[np.float64]
State = TypeVar("State")
Move = Callable[[float], tuple[State, bool]]
FACE = 0.2  # [m] how far from the hit point, across the normal, there is something to hit
PIECES, HALVINGS = 20, 30  # of one step: switches that it ends on; how exactly each is found


class Struck:
    """The scene's law and target, evaluated. A target's state is (n_states,), zero at rest.

    Targets know their speed only; how far one has gone is the engine's to integrate.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene, self.law, self.target = scene, scene.law, scene.target
        self.at_rest: Array = np.zeros(self.target.n_states)
        self.switching = bool(self.target.switches(self.at_rest, 0.0))

    def speed(self, state: Array) -> float:
        """[m/s] of the hit surface along the normal."""
        return float(self.target.velocity(state))

    def force(self, place: Array, speed: float, travel: float, state: Array) -> float:
        """Contact force [N] on a target that has gone so far [m], of a striking point at a place (3,) [m]
        with a speed along the normal [m/s].
        """
        normal = self.scene.normal
        way = place - self.scene.point
        along = float(normal @ way)
        depth = along - travel
        if depth <= 0 or np.linalg.norm(way - along * normal) > FACE:
            return 0.0
        return float(self.law.force(depth, speed - self.speed(state)))

    def rates(self, state: Array, force: float) -> Array:
        """d(state)/dt (n_states,)."""
        return np.array([float(rate) for rate in self.target.derivative(state, force)])

    def side(self, state: Array, force: float) -> tuple[bool, ...]:
        """On which side of each of its switches the target is."""
        return tuple(float(switch) > 0 for switch in self.target.switches(state, force))

    def moved(self, state: Array, force: float, length: float) -> Array:
        """The state after a time [s] under one force, by Runge-Kutta's steps of order four: the swing of a
        board that has not broken does not grow by them.
        """

        def begin(_done: float, s: Array) -> Move[Array]:
            before = self.side(s, force)

            def move(h: float) -> tuple[Array, bool]:
                a = self.rates(s, force)
                b = self.rates(second := s + h / 2 * a, force)
                c = self.rates(third := s + h / 2 * b, force)
                d = self.rates(fourth := s + h * c, force)
                after = s + h / 6 * (a + 2 * b + 2 * c + d)
                return after, all(self.side(x, force) == before for x in (second, third, fourth, after))

            return move

        return smooth_steps(begin, state, length)


def smooth_steps(begin: Callable[[float, State], Move[State]], state: State, length: float) -> State:
    """`state` after `length` [s], in one step, or in several that end just beyond a switch.

    begin : from the time done [s] and the state there, the step: from its length to the state after it, and
        whether neither that nor what the step takes rates of is beyond a switch.
    """
    done = 0.0
    for _ in range(PIECES):
        move = begin(done, state)
        low, high = 0.0, length - done
        after, smooth = move(high)
        if smooth:
            return after
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            low, high = (middle, high) if move(middle)[1] else (low, middle)
        state, done = move(high)[0], done + high
    return begin(done, state)(length - done)[0]
