"""Contact law and target dynamics, evaluated numerically for the replay engines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
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
    """Contact forces and target motion within one step of an engine.

    Of each striker (h,): forces [N], their means over the step, and over its first half (halves); peaks [N],
    when their sum is largest; depths [m] in the target, at the end. state, travel [m]: of the target, then;
    since [s]: up to when in the step there was no force. times (k,) [s] in the step, and whether there is a
    force then (touching); last [N]: the force at the end.
    """

    forces: Array
    halves: Array
    peaks: Array
    state: Array
    travel: float
    depths: Array
    since: float = 0.0
    times: Array = field(default_factory=lambda: np.zeros(0))
    touching: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    last: float = 0.0

    @property
    def force(self) -> float:
        """Mean over the step [N], of all strikers together."""
        return float(self.forces.sum())

    @property
    def peak(self) -> float:
        """The largest force [N] of all strikers together."""
        return float(self.peaks.sum())


class Struck:
    """The scene's law and target, evaluated. A target's state is (n_states,), zero before contact.

    Targets know their speed only; how far one has gone is the engine's to integrate.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene, self.law, self.target = scene, scene.law, scene.target
        points = [scene.point, *([] if scene.second is None else [scene.second[1]])]
        # as floats: of three of them, arrays would take several times as long
        self._points, self._normal = [tuple(p.tolist()) for p in points], tuple(scene.normal.tolist())
        self.untouched: Array = np.zeros(self.target.n_states)
        # read once: they are asked for in every step
        self._law, self._target = self.law.parameters, self.target.parameters

    def speed(self, state: Array) -> float:
        """[m/s] of the hit surface along the normal."""
        return float(self.target.velocity(state, self._target))

    def travel_at_start(self, reference: Any) -> float:
        """[m] that it has to go until contact is planned, below zero, as it moves before contact already."""
        before = self.speed(self.untouched)
        return -before * float(reference.contact_start) if before else 0.0

    def depths(self, places: Array, travel: float) -> Array:
        """(h,) [m] of striking points at places (h, 3) [m] in a target that has gone so far [m]; beside its
        face minus infinity.
        """
        depths, (nx, ny, nz) = [], self._normal
        for (x, y, z), (px, py, pz) in zip(places.tolist(), self._points, strict=True):
            dx, dy, dz = x - px, y - py, z - pz
            along = nx * dx + ny * dy + nz * dz
            across = (dx - along * nx) ** 2 + (dy - along * ny) ** 2 + (dz - along * nz) ** 2
            depths.append(-np.inf if across > FACE**2 else along - travel)
        return np.array(depths)

    def forces(self, depths: Array, speeds: Array, state: Array) -> Array:
        """Contact forces (h,) [N] of striking points so deep in the target [m], with speeds along the normal
        [m/s].
        """
        rates = speeds - self.speed(state)
        pairs = zip(depths, rates, strict=True)
        force, numbers = self.law.force, self._law
        return np.array([float(force(depth, rate, numbers)) if depth > 0 else 0.0 for depth, rate in pairs])

    def near(self, depths: Array, speeds: Array, state: Array, step: float) -> bool:
        """True if any of the strikers may touch the target within a step [s]."""
        speed, pairs = self.speed(state), zip(depths.tolist(), speeds.tolist(), strict=True)
        return any(depth + NEAR * step * (abs(rate - speed) + 1.0) > 0 for depth, rate in pairs)

    def pushed(
        self,
        depths: Array,
        speeds: Array,
        gains: Array,
        yields: Array,
        state: Array,
        travel: float,
        step: float,
    ) -> Push:
        """The contact over one step [s] of the engine: hands and target alone, with errors of their own.

        Hands are points whose speeds (h,) [m/s] gain so much [m/s2] without the contact, and lose `yields`
        (h, h) [1/kg] times their impulses. A light target behind a stiff contact moves a thousand times
        within a step, which an engine could not follow.
        """
        h = len(speeds)
        there = np.maximum(depths, -FACE)  # beside the face: far away

        def forces(t: float, y: Array) -> tuple[Array, Array, float]:
            """Forces, and the speeds of hands and target."""
            hands, target = speeds + gains * t - yields @ y[h : 2 * h], self.speed(y[2 * h + 1 :])
            return self.forces(y[:h], hands, y[2 * h + 1 :]), hands, target

        def rates(t: float, y: Array) -> list[float]:
            force, hands, target = forces(t, y)
            moves = self.target.derivative(y[2 * h + 1 :], float(force.sum()), self._target)
            return [*(hands - target), *force, target, *moves]

        begin = np.concatenate([there, np.zeros(h + 1), state])
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
        end, impulses = found.y[:, -1], found.y[h : 2 * h]
        values = np.array([forces(t, y)[0] for t, y in zip(found.t, found.y.T, strict=True)])
        total = values.sum(axis=1)
        return Push(
            forces=impulses[:, -1] / step,
            halves=np.array([np.interp(step / 2, found.t, impulse) for impulse in impulses]) / (step / 2),
            peaks=values[int(np.argmax(total))],
            state=np.array(end[2 * h + 1 :]),
            travel=travel + float(end[2 * h]),
            depths=np.where(np.isfinite(depths), end[:h], -np.inf),
            since=float(found.t[max(int(np.argmax(total > 0)) - 1, 0)]),
            times=found.t,
            touching=total > 0,
            last=float(total[-1]),
        )

    def untouched_step(self, state: Array, travel: float, step: float) -> tuple[Array, float]:
        """State and travel [m] after a step [s] without a force, the travel by the trapezoidal rule."""
        after = self.moved(state, 0.0, step)
        return after, travel + step / 2 * (self.speed(state) + self.speed(after))

    def rates(self, state: Array, force: float) -> Array:
        """d(state)/dt (n_states,)."""
        return np.array([float(rate) for rate in self.target.derivative(state, force, self._target)])

    def side(self, state: Array, force: float) -> tuple[bool, ...]:
        """Side of each of its switches that the target is on."""
        return tuple(float(switch) > 0 for switch in self.target.switches(state, force, self._target))

    def moved(self, state: Array, force: float, length: float) -> Array:
        """The state after a time [s] under one force, by Runge-Kutta's steps of order four: the swing of a
        board that has not broken does not grow by them.
        """
        if not any(self.target.derivative(state, force, self._target)):
            return state  # as it is before a blow

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
