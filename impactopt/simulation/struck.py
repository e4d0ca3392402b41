"""What is hit, as numbers: the contact's force and the target's motion under it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from impactopt.errors import InputError
from impactopt.simulation.result import Scene

Array = NDArray[np.float64]
State = TypeVar("State")
Move = Callable[[float], tuple[State, bool]]
FACE = 0.2  # [m] how far from the hit point, across the normal, there is something to hit
PIECES, HALVINGS = 20, 30  # of one step: switches that it ends on; how exactly each is found
RELATIVE, ABSOLUTE = 1e-6, 1e-10  # errors of the contact within a step; [m], [N s], and of the target's state
NEAR = 2.0  # steps before a touch from which on the contact is followed within them
MOST = 20_000  # places within one step: a contact that needs more is no contact to be followed


@dataclass(frozen=True)
class Push:
    """What a contact has come to within one step of an engine.

    force [N]: mean over the step, and over its first half (half); peak [N]; state, travel [m]: of the target
    at the end; depth [m]: of the striking point in it, then; since [s]: up to when in the step there was no
    force.
    """

    force: float
    half: float
    peak: float
    state: Array
    travel: float
    depth: float
    since: float = 0.0


class Struck:
    """The scene's law and target, evaluated. A target's state is (n_states,), zero before contact.

    Targets know their speed only; how far one has gone is the engine's to integrate.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene, self.law, self.target = scene, scene.law, scene.target
        self.untouched: Array = np.zeros(self.target.n_states)

    def speed(self, state: Array) -> float:
        """[m/s] of the hit surface along the normal."""
        return float(self.target.velocity(state))

    def travel_at_start(self, reference: Any) -> float:
        """[m] that it has to go until contact is planned, below zero, as it moves before contact already."""
        before = self.speed(self.untouched)
        return -before * float(reference.contact_start) if before else 0.0

    def depth(self, place: Array, travel: float) -> float:
        """[m] of a striking point at a place (3,) [m] in a target that has gone so far [m]; beside its face
        minus infinity.
        """
        normal = self.scene.normal
        way = place - self.scene.point
        along = float(normal @ way)
        return -np.inf if np.linalg.norm(way - along * normal) > FACE else along - travel

    def force(self, depth: float, speed: float, state: Array) -> float:
        """Contact force [N] of a striking point so deep in the target [m], with a speed along the normal
        [m/s].
        """
        return float(self.law.force(depth, speed - self.speed(state))) if depth > 0 else 0.0

    def near(self, depth: float, speed: float, state: Array, step: float) -> bool:
        """Whether the two may touch within a step [s]."""
        return depth + NEAR * step * (abs(speed - self.speed(state)) + 1.0) > 0

    def pushed(
        self, depth: float, speed: float, gain: float, yields: float, state: Array, travel: float, step: float
    ) -> Push:
        """The contact over one step [s] of the engine: hand and target alone, with errors of their own.

        The hand is a point whose speed [m/s] gains so much [m/s2] without the contact, and loses `yields`
        [1/kg] times the impulse. A light target behind a stiff contact moves a thousand times within a step,
        which an engine could not follow.
        """

        def forces(t: float, y: Array) -> tuple[float, float, float]:
            """Force, and the speeds of hand and target."""
            hand, target = speed + gain * t - yields * y[1], self.speed(y[3:])
            force = float(self.law.force(y[0], hand - target)) if y[0] > 0 else 0.0
            return force, hand, target

        def rates(t: float, y: Array) -> list[float]:
            force, hand, target = forces(t, y)
            return [hand - target, force, target, *self.target.derivative(y[3:], force)]

        begin = np.concatenate([[depth, 0.0, 0.0], state])
        found = solve_ivp(
            rates,
            (0.0, step),
            begin,
            method="RK45",  # an implicit method's Newton steps do not get over a target's switches
            rtol=RELATIVE,
            atol=ABSOLUTE,
            max_step=0.5 * step,
        )
        if not found.success or found.t.size > MOST or not np.isfinite(found.y).all():
            raise InputError(
                f"the contact cannot be followed within a step of {step:g} s: soften it, or give the target "
                "more mass"
            )
        end, impulse = found.y[:, -1], found.y[1]
        values = np.array([forces(t, y)[0] for t, y in zip(found.t, found.y.T, strict=True)])
        return Push(
            force=float(impulse[-1]) / step,
            half=float(np.interp(step / 2, found.t, impulse)) / (step / 2),
            peak=float(values.max()),
            state=np.array(end[3:]),
            travel=travel + float(end[2]),
            depth=float(end[0]),
            since=float(found.t[max(int(np.argmax(values > 0)) - 1, 0)]),
        )

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
