"""Batches of collisions: a C loop over arrays, on several cores.

CasADi's own maps are serial in its wheels, and its calls keep the interpreter's lock. So the compiled library
has a loop of its own, which is called through ctypes. That releases the lock, so that threads run on several
cores.
"""

from __future__ import annotations

import ctypes
import os
import threading
from collections.abc import Iterator, Mapping
from dataclasses import replace
from importlib.resources import files
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from impactopt.arrays import Array
from impactopt.codegen.cache import cached, library_path
from impactopt.collision.checks import (
    ACCURACY,
    Stability,
    breaks,
    left_out_by_breaking,
    too_large,
    without_contact,
)
from impactopt.collision.native import native_collision
from impactopt.collision.outputs import HISTORIES, SCALARS
from impactopt.collision.settings import NO_LIMIT
from impactopt.collision.stepped import SteppedModel
from impactopt.errors import InputError, check_array, check_whole, raw_array
from impactopt.robots.checks import unit_parts

_ALIGNED = 8  # doubles that a work array is longer, as the C code aligns it
_CHECKED_TOGETHER = 256  # cases whose step lengths are checked in one call


class Batch:
    """Compiled function of a model and outputs, evaluated for arrays of collisions.

    Parameters
    ----------
    model : collision model.
    outputs : names out of `impactopt.collision.OUTPUTS` that the model has.
    stability : stable step lengths of the model.
    every : keep every so many steps of the histories.
    """

    def __init__(
        self,
        model: SteppedModel,
        outputs: tuple[str, ...],
        stability: Stability,
        *,
        every: int = 1,
    ) -> None:
        # for the checks of a result; the first of them are returned with it
        checked = ("step_error", "separated") if model.stepping in ACCURACY else ("separated",)
        self._returned = {*outputs, *checked}
        checked = (*checked, "duration", "impulse")
        if breaks(model):
            checked = (*checked, "target_result")
        self.model, self._stability = model, stability
        self.outputs = tuple(dict.fromkeys((*outputs, *checked)))
        recipe = (*model._recipe, *self.outputs, every)

        def build() -> list[Any]:
            code = native_collision(model, self.outputs, every=every)
            loop = files(native_collision.__module__.rpartition(".")[0]).joinpath("batch.c")
            return [replace(code, code=f"{code.code}\n{loop.read_text(encoding='utf-8')}")]

        self._function = cached("collision_batch", recipe, build, report=model.report)["collision"]
        library = library_path("collision_batch", recipe, "collision")
        self._loop = None if library is None else ctypes.CDLL(str(library)).collision_batch

    def __call__(
        self,
        q: ArrayLike,
        v: ArrayLike,
        torque: ArrayLike | None,
        settings: Mapping[str, ArrayLike],
        *,
        threads: int | None = None,
    ) -> dict[str, Array]:
        """Outputs of many collisions; see `SteppedModel.batch`."""
        cores = (
            os.cpu_count() or 1 if threads is None else check_whole("threads", threads, least=1, most=10**4)
        )
        given = _inputs(self.model, q, v, torque, settings)
        unstable = None if self.model.stepping == "implicit" else self._unstable(given)
        count, function = given["q"].shape[0], self._function
        inputs = [_by_columns(given[name]) for name in function.name_in()]
        shapes = [function.size_out(k) for k in range(function.n_out())]
        found = [np.zeros((count, shape[0] * shape[1])) for shape in shapes]
        if self._loop is None:
            _one_by_one(function, inputs, found)
        else:
            _in_threads(self._loop, function.sz_w(), inputs, found, cores)
        by_name = dict(zip(function.name_out(), found, strict=True))

        def clear(cases: Any, *kept: str) -> None:
            """Sets the outputs of cases that `collide` refuses to NaN."""
            for name, x in by_name.items():
                if name not in ("step_error", *kept):
                    x[cases] = np.nan

        if "step_error" in by_name:  # steps that are too long or unstable
            error = by_name["step_error"]
            if breaks(self.model):
                impulse, results = by_name["impulse"][:, 0], by_name["target_result"]
                force = given["target_breaking_force"][:, 0]
                error[:, 0] += left_out_by_breaking(self.model, impulse, results, force)
            wrong = too_large(self.model.stepping, error[:, 0])
            if unstable is not None:
                error[unstable] = np.nan
                wrong |= unstable
            clear(wrong)
        impulse, duration = by_name["impulse"][:, 0], by_name["duration"][:, 0]
        separated = by_name["separated"][:, 0] > 0.5
        step = 0.0 if self.model.stepping == "implicit" else self.model.step_length
        # contacts whose force rounding hides
        clear(~np.isfinite(impulse) | without_contact(impulse, duration, step * separated))
        # collisions with so many events that the steps are used up
        clear(~separated & (duration < self.model.horizon * (1 - 1e-9)), "separated")
        return {
            name: self._shaped(name, x, shape)
            for (name, x), shape in zip(by_name.items(), shapes, strict=True)
            if name in self._returned
        }

    def _unstable(self, given: Mapping[str, Array]) -> Any:
        """Mask (N) of the cases for which the step is unstable; InputError if it is for all.

        Stability does not depend on the velocity: cases that differ in nothing else are checked once.
        """
        names = ("q", *self.model.settings)
        own = {name: given[name] for name in names}
        count = len(given["q"])
        # one row a case, of all that stability depends on
        flat = [x.reshape(len(x), -1) for x in own.values()]
        whole = np.concatenate([np.broadcast_to(x, (count, x.shape[1])) for x in flat], axis=1)
        _, first, back = np.unique(whole, axis=0, return_index=True, return_inverse=True)
        masks = [
            self._stability.unstable({name: x if len(x) == 1 else x[some] for name, x in own.items()})
            for some in np.split(first, range(_CHECKED_TOGETHER, len(first), _CHECKED_TOGETHER))
        ]
        unstable = np.concatenate(masks)[back.ravel()]
        if unstable.all():
            one = {name: given[name][0].reshape(x.shape) for name, x in self.model.settings.items()}
            longest = self._stability.longest(self._stability.frozen(given["q"][0], one), one)
            self.model.check_step(longest, "in every collision, as in the first")
        return unstable

    def _shaped(self, name: str, flat: Array, shape: tuple[int, int]) -> Array:
        """Output with axes (collision, instant, component), from matrices by columns (N, size)."""
        count = flat.shape[0]
        if name == "separated":
            mask: Any = flat[:, 0] > 0.5
            return np.asarray(mask)
        if name in SCALARS:
            return flat[:, 0]
        if name not in HISTORIES or shape[1] == 1:
            return flat
        if name in ("sole_wrench", "hand_wrench"):
            return flat.reshape(count, shape[1], -1, 6)
        return flat.reshape(count, shape[1], shape[0])


# ---------------------------------------------------------------- running
def _in_threads(loop: Any, work: int, inputs: list[Array], found: list[Array], threads: int) -> None:
    """Evaluates a batch by the loop in C; see native/batch.c for its arguments."""
    count, steps, pointers = found[0].shape[0], ctypes.c_longlong, ctypes.c_void_p
    arg = (pointers * len(inputs))(*[x.ctypes.data for x in inputs])
    # a stride of zero repeats an input that all cases share
    arg_step = (steps * len(inputs))(*[0 if x.shape[0] == 1 else x.shape[1] for x in inputs])
    res = (pointers * len(found))(*[x.ctypes.data for x in found])
    res_step = (steps * len(found))(*[x.shape[1] for x in found])
    slices = _slices(count, threads)

    def run() -> None:
        # each thread needs its own work array; results are written to rows of its slice only
        memory = np.empty(work + _ALIGNED)
        work_array = pointers(memory.ctypes.data)
        # the threads share the iterator: each takes the next slice, under the interpreter's lock
        for begin, end in slices:
            loop(steps(begin), steps(end), arg, arg_step, res, res_step, work_array)

    # Plain threads, of which the calling one is one: the start of a pool takes as long as ten collisions.
    others = [threading.Thread(target=run) for _ in range(min(threads, count) - 1)]
    for thread in others:
        thread.start()
    try:
        run()
    finally:
        for thread in others:
            thread.join()


def _slices(count: int, threads: int) -> Iterator[tuple[int, int]]:
    """Starts and ends of ever shorter slices: collisions differ in time, and threads should end together."""
    ends = [0]
    while ends[-1] < count:
        left = count - ends[-1]
        # half of an equal share of what is left, as in guided self-scheduling
        ends.append(ends[-1] + (left if threads == 1 else -(-left // (2 * threads))))
    return iter([*pairwise(ends)])


def _one_by_one(function: Any, inputs: list[Array], found: list[Array]) -> None:
    """Evaluates a batch without a compiler, one collision at a time."""
    shapes = [function.size_in(k) for k in range(function.n_in())]
    for i in range(found[0].shape[0]):
        case = [x[0 if x.shape[0] == 1 else i] for x in inputs]
        values = [ca.DM(x.reshape(shape, order="F")) for x, shape in zip(case, shapes, strict=True)]
        for into, out in zip(found, function.call(values), strict=True):
            into[i] = np.array(out).ravel(order="F")


# ---------------------------------------------------------------- inputs
def _by_columns(x: Array) -> Array:
    """Array (cases, size), each case's matrix by columns, as CasADi stores it."""
    return np.ascontiguousarray(np.swapaxes(x, 1, 2) if x.ndim == 3 else x).reshape(x.shape[0], -1)


def _inputs(
    model: SteppedModel, q: ArrayLike, v: ArrayLike, torque: ArrayLike | None, settings: Mapping[str, Any]
) -> dict[str, Array]:
    """Checked inputs by name, each (N, ...), or (1, ...) if all cases share it."""
    robot = model.robot
    given = {"q": check_array("q", q, (None, robot.nq))}
    count = given["q"].shape[0]
    if not count:
        raise InputError("q: no collision; give at least one, (N, nq)")
    given["v"] = check_array("v", v, (count, robot.nv))
    model.check_grips(given["v"])
    for _, part in unit_parts(robot.model):
        worst = int(np.abs(np.linalg.norm(given["q"][:, part], axis=1) - 1).argmax())
        robot.check_configuration(given["q"][worst], name=f"q of collision {worst}")
    if model.effects.feedforward:
        if torque is None:
            raise InputError("torque: give the feed-forward torque (N, n) [N m], or (n) for all")
        one = raw_array("torque", torque).ndim == 1
        given["feedforward"] = check_array("torque [N m]", torque, (robot.n,) if one else (count, robot.n))
        given["feedforward"] = given["feedforward"].reshape(-1, robot.n)
    return given | _settings(model, settings, count)


def _settings(model: SteppedModel, settings: Mapping[str, Any], count: int) -> dict[str, Array]:
    """Values of each setting, shared or one a collision, checked against its range."""
    shared = model.settings.override(
        {
            name: x
            for name, x in settings.items()
            if name not in model.settings or raw_array(name, x).ndim <= model.settings[name].ndim
        }
    )
    out = {name: value[None] if value.ndim else value.reshape(1, 1) for name, value in shared.items()}
    for name, given in settings.items():
        default = model.settings[name]
        if raw_array(name, given).ndim > default.ndim:
            value = check_array(name, given, (count, *default.shape), finite=name != "torque_limit")
            # The range of a number is an interval: least and largest suffice. Directions and matrices are
            # checked one by one.
            whole = name == "normal" or (name in ("kp", "kd") and default.ndim == 2)
            least, largest = value.min(axis=0), value.max(axis=0)
            extremes = [least] if np.array_equal(least, largest) else [least, largest]
            for one in value if whole else extremes:
                model.settings.override({name: one})
            capped = np.minimum(value, NO_LIMIT) if name == "torque_limit" else value
            out[name] = capped if default.ndim else capped.reshape(count, 1)
    return out
