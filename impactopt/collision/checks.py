"""Checks of a collision: what is refused, the longest stable step, the estimated error of freezing.

With N freezes the error of the impulse falls as 1/N^2 where the robot moves little, and by leaps where a push
ends or not by a hair. So no constant is a bound of it, but the difference from a collision that is frozen
more often tells both. Twice the difference, and a thousandth, is what is said; `python -m benchmarks freezes`
measures against full dynamics how often the error is more.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impactopt.collision.graph import frozen_dynamics, joint_space_model
from impactopt.collision.interface import Collision
from impactopt.collision.model import JointSpaceModel
from impactopt.collision.runge_kutta import rate_of_change
from impactopt.collision.stepped import SteppedModel
from impactopt.contact import Board
from impactopt.errors import InputError

__all__ = [
    "ACCURACY",
    "FREEZE_ERROR",
    "LEAST_PIVOT",
    "Stability",
    "breaks",
    "caution",
    "check_course",
    "check_finite",
    "check_frozen",
    "freeze_error",
    "left_out_by_breaking",
    "longest_stable_step",
    "more_often",
    "slope_function",
    "spoiled",
    "too_large",
    "unstable_rows",
    "without_contact",
]

Array = NDArray[np.float64]

# name of the output of a batch
FREEZE_ERROR = "freeze_error"
# the least that is said, relative: below it differences are as often luck
_LEAST = 1e-3
_SAFETY = 2.0


def more_often(freezes: int) -> int:
    """Freezes on the way of the collision that one is compared with: 4, 8, or twice as many.

    Fewer are too like it: of 204 drawn collisions, those frozen at contact only were off by more than was
    said in four beside two freezes, and in none beside four; those frozen twice in two beside four, and in
    none beside eight.
    """
    return max(4, 2 * freezes, min(4 * freezes, 8))


def freeze_error(impulse: Array, better: Array, ends: NDArray[Any]) -> Array:
    """Estimated relative error (N) of each impulse that freezing causes.

    impulse, better : (N) [N s], and of the collisions frozen more often.  ends : (N) whether those separate;
    where they do not, the error is infinite.
    """
    off = np.abs(impulse - better)
    # nothing delivered by both is no difference
    apart = np.divide(off, np.abs(better), out=np.where(off > 0, np.inf, 0.0), where=better != 0)
    return np.where(np.isfinite(better) & ends, _SAFETY * apart + _LEAST, np.inf)


def caution(error: float, accuracy: float, freezes: int) -> str:
    """A sentence where the error is above the accuracy, both relative; else nothing."""
    if not error > accuracy:
        return ""
    off = f"{100 * error:.2g} %" if error < 1 else "any amount"
    often = f"at contact and {freezes} times on the way" if freezes else "at contact only"
    return (
        f"the impulse may be off by {off}, and {100 * accuracy:g} % is asked for, as H, J and the bias are "
        f"frozen {often}: give freezes={more_often(freezes)} (--freezes) or more, or take the full dynamics"
    )


# error of the impulse beyond which the step is refused, relative (see `SteppedModel`); and the power of the
# step that it goes with
ACCURACY = {"rk4": 1e-2}
_ORDERS = {"rk4": 2}
# of a factorization's pivot, and of the hand's mobility, relative: with less, rounding reaches 1e-7
LEAST_PIVOT = 1e-9


def check_frozen(frozen: dict[str, Array]) -> None:
    """InputError where rounding spoils what is frozen (with `pivots` and `freedom` among it)."""
    if not (frozen["pivots"] > LEAST_PIVOT).all():
        raise InputError(
            "q: what holds the robot cannot be told apart here (held frames' directions depend on each "
            "other, so that their wrenches are undetermined): hold fewer frames, or give the legs more "
            "joints, or bend them, or use a virtual base (base_mass, base_inertia)"
        )
    if not frozen["freedom"].item() > LEAST_PIVOT and frozen["m"].item() != 0:
        raise InputError(
            "q: what holds the robot leaves its striking point no motion along the normal here: an "
            "effective mass without end; bend the arm, or turn the normal"
        )
    for name in {*frozen} - {"pivots", "freedom"}:
        if not np.isfinite(frozen[name]).all():
            raise InputError(f"q: the frozen dynamics have no finite {name} here; check the robot's inertias")


def spoiled(frozen: dict[str, Array]) -> Any:
    """(N) rows that `check_frozen` refuses; numbers (N, ...)."""
    bad = ~(frozen["pivots"] > LEAST_PIVOT).all(axis=1)
    bad |= ~(frozen["freedom"][:, 0] > LEAST_PIVOT) & (frozen["m"][:, 0] != 0)
    for name in {*frozen} - {"pivots", "freedom"}:
        bad |= ~np.isfinite(frozen[name]).all(axis=1)
    return bad


def without_contact(impulse: Array, duration: Array, step: Any = 0.0) -> Any:
    """True for contacts that ended so soon that rounding hides their force, or within one explicit step
    [s].
    """
    return (duration > 0) & ((impulse < 0) | (duration <= step))


def check_finite(outputs: dict[str, Array], step: float) -> None:
    """InputError where an output is no number."""
    # the zero-moment point of a robot without weight on its soles is nowhere
    bad = [name for name, x in outputs.items() if name != "zmp" and not np.isfinite(x).all()]
    if bad:
        raise InputError(
            f"step [s]: with {step:g} the collision diverges ({', '.join(bad)} without end): "
            "give a shorter step, or a slower v or softer contact, if that is what was meant"
        )


def too_large(method: str, error: Array) -> Any:
    """True if the estimated error of Runge-Kutta's impulses is more than the method may have."""
    return ~(error <= ACCURACY[method])


def left_out_by_breaking(collision: SteppedModel, impulse: Any, results: Any, force: Any) -> Any:
    """Relative error of Runge-Kutta's impulse that a board's break within a step may cause.

    Its stages judge whether it has broken: for up to half a step its force is taken for what it is not.
    results (..., k) : of the target.  force [N] : that breaks it.
    """
    broken = np.asarray(results)[..., list(collision.target.results).index("broken")] > 0.5
    return broken * 0.5 * collision.step_length * np.asarray(force) / np.maximum(impulse, 1e-300)


def breaks(collision: SteppedModel) -> bool:
    """True if `left_out_by_breaking` has to be checked."""
    return collision.stepping == "rk4" and isinstance(collision.target, Board)


def check_course(collision: SteppedModel, result: Collision, error: float) -> None:
    """InputError where the steps were too few, or too long for the contact's own modes.

    error : what Runge-Kutta steps left out of the impulse, relative, as an estimate.
    """
    length, method = collision.step_length, collision.stepping
    if not result.separated and result.duration < collision.horizon * (1 - 1e-9):
        fix = (
            "shorten the horizon, or give a larger tolerance"
            if method == "implicit"
            else "raise the horizon or give a shorter step, both of which make more steps"
        )
        raise InputError(
            f"horizon [s]: the steps are used up by events after {result.duration:.3g} s, before the "
            f"horizon, {collision.horizon:g} s: joints saturate or slide again and again; {fix}"
        )
    if result.duration == 0:
        return
    if method == "implicit":
        if without_contact(np.array(result.impulse), np.array(result.duration)):
            raise InputError(
                f"v: the contact ends within {result.duration:.2g} s, where rounding hides its force: "
                "give one that approaches faster"
            )
        return
    within = length if result.separated else 0.0
    if without_contact(np.array(result.impulse), np.array(result.duration), within):
        raise InputError(
            f"step [s]: the contact ends within {result.duration:.2g} s, too soon for steps of "
            f"{length:g}: give a shorter step, or a v that approaches faster"
        )
    if too_large(method, np.array(error)):
        shorter = 0.8 * length * (ACCURACY[method] / error) ** (1 / _ORDERS[method])
        raise InputError(
            f"step [s]: {length:g} is too long to follow this contact within {ACCURACY[method]:g} of its "
            f"impulse, of which it leaves out {error:.2g}: give a step below {shorter:.2g}"
        )


# the classical Runge-Kutta method is stable for decaying modes with |rate| h up to this
_LIMIT = 2.6
_BALANCED = 4  # times, before a matrix has its norm taken


def slope_function(model: JointSpaceModel) -> Any:
    """ca.Function (y, *data) -> the Jacobian of dy/dt."""
    y, data = ca.SX.sym("y", model.n_states), model.symbols()
    rate = rate_of_change(model, y, model.velocity_change(y, data), data)
    return ca.Function("slope", [y, *data.values()], [ca.jacobian(rate, y)])


def longest_stable_step(model: JointSpaceModel, slope: Any, data: dict[str, Any]) -> float:
    """[s] beyond which a step is unstable, with no joint saturated and friction in its transition band."""
    rates = [1e-12]
    for y, worst in _worst(model, data):
        matrix = np.array(slope(y, *[worst[name] for name in model.data]))
        rates.append(float(np.abs(np.linalg.eigvals(matrix)).max()))
    return _LIMIT / max(rates)


def _worst(model: JointSpaceModel, data: dict[str, Any]) -> Iterator[tuple[Array, dict[str, Any]]]:
    """States that bound the rates, with the data there."""
    worst = dict(data)
    for name in {"feedforward", "joint_velocity"} & {*model.data}:
        worst[name] = np.zeros(model.n)
    y = model.start()
    y[model.layout["penetration"]] = 1e-3
    for worst["hand_speed"] in (1.0, -1.0):  # compression, restitution
        for y[model.layout["target"]] in (0.0, 1e-3):  # a target that sticks hides how fast it can move
            yield y, worst


def unstable_rows(model: JointSpaceModel, slope: Any, data: dict[str, Array], step: float) -> Any:
    """(N) whether a step [s] is unstable, of data with a first axis of N or 1, else as of
    `longest_stable_step`.

    Eigenvalues take longer than a collision, and most rows are far from their limit: those get a bound, the
    norm of the balanced matrix.
    """
    count, limit = max(len(x) for x in data.values()), _LIMIT / step
    many, size = slope.map(count), model.n_states
    found = np.zeros(count, dtype=bool)

    def wide(name: str, x: Any) -> Array:
        """Rows' matrices side by side, as CasADi has them; one for all, or a number, as often."""
        shape, given = model.data[name], np.asarray(x, dtype=float)
        own = x is data.get(name)  # what is not is one for all, a number or a vector
        rows = given.reshape(len(given) if own else 1, *(shape if given.size > 1 or own else (1, 1)))
        rows = np.broadcast_to(rows, (count, *shape))
        return np.moveaxis(rows, 0, 1).reshape(shape[0], -1)

    for y, worst in _worst(model, data):
        slopes = np.array(many(y, *[wide(name, worst[name]) for name in model.data]))
        slopes = slopes.reshape(size, count, size).swapaxes(0, 1)
        close = np.flatnonzero(~(_bound(slopes) < limit))
        known = np.isfinite(slopes[close]).all(axis=(1, 2))
        found[close[~known]] = True
        rates = np.abs(np.linalg.eigvals(slopes[close[known]])).max(axis=-1)
        found[close[known]] |= rates >= limit
    return found


def _bound(matrices: Array) -> Array:
    """(N) that no eigenvalue of matrices (N, k, k) is above."""
    a = np.abs(matrices)
    scale = np.ones(a.shape[:2])
    for _ in range(_BALANCED):
        scaled = a * scale[:, :, None] / scale[:, None, :]
        rows, columns = scaled.sum(axis=2), scaled.sum(axis=1)
        both = (rows > 0) & (columns > 0)
        scale *= np.sqrt(np.where(both, columns, 1.0) / np.where(both, rows, 1.0))
    scaled = a * scale[:, :, None] / scale[:, None, :]
    bound: Array = np.minimum(scaled.sum(axis=2).max(axis=1), scaled.sum(axis=1).max(axis=1))
    return bound


class Stability:
    """Stable step lengths of a model, with its freezing functions cached."""

    def __init__(self, collision: SteppedModel) -> None:
        self._collision, self._model = collision, joint_space_model(collision)

    @cached_property
    def _freeze(self) -> Any:
        names = [name for name in ("A", "s", "m", "s_point", "m_point") if name in self._model.data]
        return frozen_dynamics(self._collision).function("frozen", (*names, "pivots", "freedom"))

    @cached_property
    def _slope(self) -> Any:
        return slope_function(self._model)

    def frozen(self, q: Array, values: dict[str, Array]) -> dict[str, Array]:
        """Frozen quantities at q (nq), by name; InputError if rounding spoils them."""
        function = self._freeze
        at_rest = np.zeros(self._collision.robot.nv)
        found = function.call([ca.DM(x) for x in (q, at_rest, values["normal"], np.zeros(2))])
        frozen = {name: np.array(x) for name, x in zip(function.name_out(), found, strict=True)}
        check_frozen(frozen)
        return frozen

    def longest(self, frozen: dict[str, Array], values: dict[str, Array]) -> float:
        """[s], of what is frozen and the settings' values."""
        data: dict[str, Any] = frozen | values
        drifts = {name for name in self._model.data if name not in data}
        data |= {name: np.zeros(self._model.data[name]) for name in drifts}
        return longest_stable_step(self._model, self._slope, data)

    def unstable(self, given: Mapping[str, Array]) -> NDArray[np.bool_]:
        """(N) rows of a batch that the model's steps are unstable of, or that rounding spoils; inputs by name
        have a first axis of N or 1."""
        collision, count = self._collision, len(given["q"])
        inputs = (given["q"], np.zeros((1, collision.robot.nv)), given["normal"], np.zeros((1, 2)))
        columns = [np.broadcast_to(x, (count, x.shape[1])).T for x in inputs]
        found = self._freeze.map(count).call([ca.DM(x) for x in columns])
        frozen: dict[str, Array] = {}
        for name, x in zip(self._freeze.name_out(), found, strict=True):
            rows, columns = x.shape[0], x.shape[1] // count
            each = np.array(x).reshape(rows, count, columns).swapaxes(0, 1)
            frozen[name] = each.reshape(count, rows * columns)
        data: dict[str, Any] = frozen | {name: given[name] for name in collision.settings}
        own = {name: x for name, x in data.items() if name in self._model.data}
        own |= {name: np.zeros((1, *shape)) for name, shape in self._model.data.items() if name not in own}
        step = collision.step_length
        return np.asarray(unstable_rows(self._model, self._slope, own, step) | spoiled(frozen))
