"""Adaptive integration of a collision by SciPy's LSODA, for machines without a C compiler.

It takes the place of the implicit steps in C (native/implicit.h), and is some hundred times slower. The time
loop is a CasADi callback, so that the freezes before it and the outputs after it are the same graph as with
Runge-Kutta steps.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import casadi as ca
import numpy as np
from scipy.integrate import LSODA
from scipy.optimize import brentq, minimize_scalar

from impactopt.arrays import Array
from impactopt.collision.model import JointSpaceModel
from impactopt.collision.stepped import target_is_linear

# Permitted error of a step over the tolerance, relative, and absolute in SI units: errors of steps add up.
_RELATIVE, _ABSOLUTE = 1e-3, 1e-8
_LEAST_RELATIVE = 3e-14  # that SciPy accepts
_MOST_STEPS, _MOST_PHASES = 5_000, 5_000  # steps of one phase, and phases
_NEAR_PEAK = 0.999  # of the largest force so far, from which a step's own is located
_PARTS = 4  # of a step, at whose ends events are looked for
_OVERSHOOT = 1e-9  # part of an interval by which it passes an event, at least, to begin in the new phase

# CasADi holds no reference to a callback: a function that calls a deleted one would crash the process
_ALIVE: list[ca.Callback] = []


class AdaptiveLoop(ca.Callback):
    """ca.Function (y, *data) -> (final state; states (n_states, columns)).

    The final state is that at separation, or at the end of the freeze.

    tolerance : see `SymbolicModel`.  spacing [s] : of the states; the last one is repeated.
    """

    def __init__(self, model: JointSpaceModel, *, tolerance: float, spacing: float, columns: int) -> None:
        ca.Callback.__init__(self)
        self.model, self.spacing, self.columns = model, spacing, columns
        self.errors = {"rtol": max(_RELATIVE * tolerance, _LEAST_RELATIVE), "atol": _ABSOLUTE * tolerance}
        self.functions = _phase_functions(model)
        self.construct("adaptive_loop", {})
        _ALIVE.append(self)

    def get_n_in(self) -> int:
        return 1 + len(self.model.data)

    def get_n_out(self) -> int:
        return 2

    def get_sparsity_in(self, i: int) -> Any:
        shape = [*self.model.data.values()][i - 1] if i else (self.model.n_states, 1)
        return ca.Sparsity.dense(*shape)

    def get_sparsity_out(self, i: int) -> Any:
        return ca.Sparsity.dense(self.model.n_states, self.columns if i else 1)

    def eval(self, given: list[Any]) -> list[Any]:
        y, *data = [np.array(x, dtype=float).ravel(order="F") for x in given]
        until = dict(zip(self.model.data, data, strict=True)).get("until", [self.model.horizon])[0]
        functions = tuple(_Evaluator(function, data) for function in self.functions)
        watch = functions[-1]
        kept, time = [y], self.model.layout["time"].start
        for _ in range(_MOST_PHASES):
            rate, separation, _, closing, *switches = watch(1.0, y, y)
            compressing = rate > 0.0 or (rate == 0.0 and closing > 0.0)
            if not (compressing or separation > 0.0) or not y[time] < until:
                break
            y = self._phase(y, until, float(compressing), np.sign(switches), functions, kept)
        if np.isnan(watch(1.0, y, y)[0]):
            y = np.full_like(y, np.nan)
        kept = kept[: max(self.columns - 1, 0)]
        kept += [y] * (self.columns - len(kept))
        return [ca.DM(y), ca.DM(np.array(kept).T)]

    def _phase(
        self,
        y: Array,
        until: float,
        compressing: float,
        signs: Array,
        functions: tuple[_Evaluator, ...],
        kept: list[Array],
    ) -> Array:
        """State just after the event that ends a phase, or at `until`; NaN if the integration fails.

        compressing : 1 in compression, 0 in restitution.  signs : of the target's switches in the phase.
        kept : states of the histories so far, to which those of the phase are added.
        """
        flow, slopes, watch = (partial(f, compressing, y) for f in functions)
        layout, time = self.model.layout, self.model.layout["time"].start
        place = layout.get("peak", slice(0))
        peak = y[place]
        solver = LSODA(lambda _, x: flow(x), y[time], y, until, jac=lambda _, x: slopes(x), **self.errors)
        values = None
        for _ in range(_MOST_STEPS):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # LSODA's of a failure
                solver.step()
            if solver.status == "failed" or not np.isfinite(solver.y).all():
                return np.full_like(y, np.nan)
            step = _Step(solver, watch, compressing, signs)
            event, values = step.event(values), step.values[-1]
            end = solver.t if event is None else event
            while len(kept) < self.columns - 1 and len(kept) * self.spacing < end:
                kept.append(step.at(len(kept) * self.spacing))
            if peak.size:
                peak = np.maximum(peak, step.largest_force(end, peak.item()))
            if event is not None or solver.status == "finished":
                break
        out: Array = np.array(step.at(end))
        # exactly, as the loop ends at this time, and rounding would add a step
        out[time], out[place] = end, peak
        return out


class _Step:
    """One step of LSODA in a phase, as a polynomial `at` of the time."""

    def __init__(self, solver: LSODA, watch: Callable[[Array], Array], compressing: float, signs: Array):
        self.at, self._watch, self._compressing, self._signs = (
            solver.dense_output(),
            watch,
            compressing,
            signs,
        )
        self._times = np.linspace(solver.t_old, solver.t, _PARTS + 1)
        self.values = np.array([self._ends(t) for t in self._times])

    def _force(self, t: float) -> float:
        return float(self._watch(self.at(t))[2])

    def _ends(self, t: float) -> Array:
        """Numbers that fall below zero where the phase ends."""
        rate, separation, _, _, *switches = self._watch(self.at(t))
        ends = [rate, 1.0] if self._compressing else [-rate, separation]
        # a switch that is zero at the start: the target's mode is that of zero, which may not be the next one
        return np.array([*ends, *np.where(self._signs, self._signs * switches, -np.abs(switches))])

    def event(self, before: Array | None) -> float | None:
        """Time just after the first event; None without one.

        before : `values` at the end of the step before, from which this one's may differ by rounding.
        """
        if before is not None and ((before >= 0.0) & (self.values[0] < 0.0)).any():
            return float(self._times[0])
        fallen = (self.values[:-1] >= 0.0) & (self.values[1:] < 0.0)
        if not fallen.any():
            return None
        i = int(fallen.any(axis=1).argmax())
        a, b = self._times[i : i + 2]
        numbers = np.flatnonzero(fallen[i])
        found = [brentq(lambda t, k: self._ends(t)[k], a, b, (k,), 1e-300) for k in numbers]
        first = int(np.argmin(found))
        t, more = found[first], _OVERSHOOT * (b - a)
        # beyond rounding: LSODA would creep through a rate that jumps just after its start
        while t < b and self._ends(t)[numbers[first]] >= 0.0:
            t, more = min(t + more, b), 8.0 * more
        return float(t)

    def largest_force(self, end: float, least: float) -> float:
        """Maximum of `least` and of the contact force until the time `end` [N]."""
        times = np.append(self._times[self._times < end], end)
        forces = np.array([self._force(t) for t in times])
        k = int(forces.argmax())
        near = times[max(k - 1, 0)], times[min(k + 1, times.size - 1)]
        if forces[k] < _NEAR_PEAK * least or near[0] == near[1]:
            return max(least, float(forces[k]))
        options = {"xatol": 1e-4 * (near[1] - near[0])}
        found = minimize_scalar(lambda t: -self._force(t), bounds=near, method="bounded", options=options)
        return max(least, float(forces[k]), -float(found.fun))


def _phase_functions(model: JointSpaceModel) -> list[Any]:
    """ca.Functions of (y, y at the start of the phase, 1 in compression, *data), smooth in a phase.

    They are dy/dt, its Jacobian by y, and a column of the rate of penetration, the law's `separation`, the
    contact force, the acceleration of the hand towards the target at equal speeds, and the target's switches.
    """
    y, start = ca.SX.sym("y", model.n_states), ca.SX.sym("start", model.n_states)
    compressing, data, target = ca.SX.sym("compressing"), model.symbols(), model.target

    def contact(y: Any) -> tuple[Any, Any, Any]:
        x, rate, numbers = model.part(y, "penetration"), model.rate(y, data), model.law_numbers(data)
        push, pull = (model.law.branch(x, rate, compression, numbers) for compression in (True, False))
        force = ca.if_else(compressing, ca.fmax(push, 0.0), pull)
        return rate, model.law.separation(x, rate, numbers), force

    rate, separation, force = contact(y)
    flow = model.rate_of_change(y, model.velocity_change(y, data), data, force)
    states, numbers = model.target_state(y), model.target_numbers(data)
    switches = ca.vertcat(ca.SX(0, 1), *target.switches(states, force, numbers))
    if target_is_linear(target):  # continued beyond its switches, as LSODA could hardly step across a jump
        z, f = ca.SX.sym("z", target.n_states), ca.SX.sym("f")
        states = ca.vertsplit(z)
        both = ca.vertcat(*target.derivative(states, f, numbers), *target.switches(states, f, numbers))
        at, now = (ca.vertcat(model.part(state, "target"), contact(state)[2]) for state in (start, y))
        slopes = ca.jacobian(both, ca.vertcat(z, f))
        linear = ca.substitute(both + ca.mtimes(slopes, now - at), ca.vertcat(z, f), at)
        flow[model.layout["target"]], switches = linear[: target.n_states], linear[target.n_states :]
    watched = ca.vertcat(rate, separation, force, model.closing(y, data), switches)
    given, parts = [y, start, compressing, *data.values()], (flow, ca.jacobian(flow, y), watched)
    return [ca.Function("phase", given, [ca.densify(part)]) for part in parts]


class _Evaluator:
    """A function of `_phase_functions` with these data; CasADi's own call takes ten times as long."""

    def __init__(self, function: Any, data: list[Array]) -> None:
        # kept, as the memory points to the arrays and holds none of them
        self._memory, self._run = function.buffer()
        self._given = [*(np.zeros(function.nnz_in(i)) for i in range(3)), *map(np.ascontiguousarray, data)]
        self._out, self._shape = np.zeros(function.nnz_out(0)), function.size_out(0)
        for i, array in enumerate(self._given):
            self._memory.set_arg(i, array.data)
        self._memory.set_res(0, self._out.data)

    def __call__(self, compressing: float, start: Array, y: Array) -> Array:
        for array, value in zip(self._given, (y, start, compressing), strict=False):
            array[:] = value
        self._run()
        return self._out.reshape(self._shape, order="F").squeeze().copy()
