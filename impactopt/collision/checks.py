"""Checks of a collision: inputs and results that are refused, stable steps, the estimated error of freezing.

With N freezes the error of the impulse falls as 1/N^2 if the robot moves little, and by leaps if a tiny
difference decides whether a push ends. So there is no bound with a constant. The difference from a collision
that is frozen more often shows both; twice this difference plus a thousandth is the estimate. `python -m
benchmarks freezes` measures against full dynamics how often the error is larger.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from impactopt.arrays import Array, Mask
from impactopt.collision.graph import frozen_dynamics, joint_space_model
from impactopt.collision.interface import Collision
from impactopt.collision.model import JointSpaceModel
from impactopt.collision.stepped import TAKE_FULL, SteppedModel
from impactopt.contact import Board
from impactopt.errors import InputError

# name of the output of a batch
FREEZE_ERROR = "freeze_error"
# Smallest relative estimate: below it, differences are as often due to chance.
_SMALLEST_ESTIMATE = 1e-3
_SAFETY_FACTOR = 2.0


def more_often(freezes: int) -> int:
    """Freezes, besides that at contact, of the collision that one with `freezes` of them is compared with.

    With fewer the two are too alike. Of 204 drawn collisions, the error of those frozen at contact only
    exceeded its estimate in four if compared with two freezes, and in none with four; that of those with two
    freezes in two if compared with four, and in none with eight.
    """
    return max(4, 2 * freezes, min(4 * freezes, 8))


def freeze_error(impulse: Array, better: Array, ends: NDArray[Any]) -> Array:
    """Estimated relative error (N) of each impulse that freezing causes.

    impulse (N) [N s].  better (N) [N s] : impulses of the collisions frozen more often.  ends (N) : whether
    these separate; the error is infinite if not.
    """
    difference = np.abs(impulse - better)
    # two impulses of zero do not differ
    relative = np.divide(
        difference, np.abs(better), out=np.where(difference > 0, np.inf, 0.0), where=better != 0
    )
    return np.where(np.isfinite(better) & ends, _SAFETY_FACTOR * relative + _SMALLEST_ESTIMATE, np.inf)


def caution(error: float, accuracy: float, freezes: int) -> str:
    """Warning about an estimated error above the required accuracy, both relative; "" if it is not."""
    if not error > accuracy:
        return ""
    off = f"{100 * error:.2g} %" if error < 1 else "any amount"
    often = f"at contact and {freezes} times during it" if freezes else "at contact only"
    return (
        f"the impulse may be off by {off}, more than the required {100 * accuracy:g} %, as H, J and the bias "
        f"are frozen {often}: give freezes={more_often(freezes)} (--freezes) or more, or take full dynamics"
    )


# largest relative error of the impulse, by method, with which a step is accepted (see `SteppedModel`); and
# the order of that error in the step
ACCURACY = {"rk4": 1e-2}
_ORDERS = {"rk4": 2}
# smallest pivot of the constraints' factorization, and smallest mobility of the hand, both relative: with
# less, the rounding error exceeds 1e-7
LEAST_PIVOT = 1e-9


def check_frozen(frozen: dict[str, Array]) -> None:
    """InputError if the frozen dynamics (`pivots` and `freedom` among them) are dominated by rounding."""
    if not (frozen["pivots"] > LEAST_PIVOT).all():
        raise InputError(
            "q: the constraints of the held frames depend on each other here, so that their wrenches are "
            "undetermined: hold fewer frames, or give the legs more joints, or bend them, or use a virtual "
            "base (base_mass, base_inertia)"
        )
    if not frozen["freedom"].item() > LEAST_PIVOT and frozen["m"].item() != 0:
        raise InputError(
            "q: the held frames leave the striking point no motion along the normal here: its effective mass "
            "is infinite; bend the arm, or turn the normal"
        )
    for name in {*frozen} - {"pivots", "freedom"}:
        if not np.isfinite(frozen[name]).all():
            raise InputError(f"q: the frozen dynamics have no finite {name} here; check the robot's inertias")


def without_contact(impulse: Array, duration: Array, step: Any = 0.0) -> Any:
    """True for contacts so short that rounding hides their force, or within one explicit step [s]."""
    return (duration > 0) & ((impulse < 0) | (duration <= step))


def check_finite(outputs: dict[str, Array], step: float) -> None:
    """InputError if an output is not finite."""
    # the zero-moment point is undefined if the soles carry no load
    bad = [name for name, x in outputs.items() if name != "zmp" and not np.isfinite(x).all()]
    if bad:
        raise InputError(
            f"step [s]: with {step:g} the collision diverges (not finite: {', '.join(bad)}): "
            "give a shorter step, or a slower v or softer contact, if that is what was meant"
        )


def too_large(method: str, error: Array) -> Any:
    """True if the estimated relative error of Runge-Kutta's impulse exceeds the accuracy of the method."""
    return ~(error <= ACCURACY[method])


def left_out_by_breaking(collision: SteppedModel, impulse: Any, results: Any, force: Any) -> Any:
    """Relative error of Runge-Kutta's impulse by a board that breaks within a step.

    Each stage decides for itself whether the board is broken, so its force is wrong for up to half a step.

    results (..., k) : of the target.  force [N] : breaking force.
    """
    broken = np.asarray(results)[..., list(collision.target.results).index("broken")] > 0.5
    return broken * 0.5 * collision.step_length * np.asarray(force) / np.maximum(impulse, 1e-300)


def breaks(collision: SteppedModel) -> bool:
    """True if `left_out_by_breaking` has to be checked."""
    return collision.stepping == "rk4" and isinstance(collision.target, Board)


def check_steps(collision: SteppedModel, result: Collision, error: float) -> None:
    """InputError if the steps were too few, or too long for the modes of the contact.

    error : estimated relative error of the impulse by Runge-Kutta steps.
    """
    length, method = collision.step_length, collision.stepping
    if not result.separated and result.duration < collision.horizon * (1 - 1e-9):
        fix = (
            "shorten the horizon, or give a larger tolerance"
            if method == "implicit"
            else "raise the horizon or give a shorter step, both of which make more steps"
        )
        raise InputError(
            f"horizon [s]: the steps are used up after {result.duration:.3g} s, before the horizon, "
            f"{collision.horizon:g} s, as events end them: joints saturate or slide again and again; {fix}"
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
            f"{length:g}: give a shorter step, or a v that approaches faster, or {TAKE_FULL}"
        )
    if too_large(method, np.array(error)):
        # the estimate is not exact, so the step that is advised is a fifth shorter than by its order
        shorter = 0.8 * length * (ACCURACY[method] / error) ** (1 / _ORDERS[method])
        raise InputError(
            f"step [s]: {length:g} is too long to follow this contact within {ACCURACY[method]:g} of its "
            f"impulse, whose estimated error is {error:.2g}: give a step below {shorter:.2g}, or {TAKE_FULL}"
        )


# The classical Runge-Kutta method is stable for all decaying modes with |eigenvalue| h up to this
# The region's boundary is at 2.785 on the negative real axis, at 2.828 on the imaginary one, and nearest to
# zero at 2.615, at 122 degrees.
_STABILITY_LIMIT = 2.6
_BALANCING_SWEEPS = 4  # of a matrix, before its norm is taken


def _fastest_states(model: JointSpaceModel, data: dict[str, Any]) -> Iterator[tuple[Array, dict[str, Any]]]:
    """States with the fastest modes, and the data there."""
    there = dict(data)
    for name in {"feedforward", "joint_velocity"} & {*model.data}:
        # no saturation, which would switch the servo's modes off, and joints at rest, in the band of steep
        # friction
        there[name] = np.zeros(model.n)
    y = model.start()
    # a law such as k x^1.5 has no stiffness at zero penetration
    y[model.layout["penetration"]] = 1e-3
    for there["hand_speed"] in (1.0, -1.0):  # compression, restitution
        for y[model.layout["target"]] in (0.0, 1e-3):  # a target that sticks does not show its modes
            yield y, there


def _unstable_cases(model: JointSpaceModel, slope: Any, data: dict[str, Array], step: float) -> Any:
    """Mask (N) of the cases for which a step [s] is unstable; `data` have a first axis of N or 1.

    Eigenvalues take longer than a collision, and most cases are far from the limit. These are accepted by a
    bound of the eigenvalues, the norm of the balanced matrix.
    """
    count, limit = max(len(x) for x in data.values()), _STABILITY_LIMIT / step
    many, size = slope.map(count), model.n_states
    found = np.zeros(count, dtype=bool)

    def side_by_side(name: str, x: Any) -> Array:
        """Matrices of all cases side by side, as CasADi's map takes them."""
        shape, given = model.data[name], np.asarray(x, dtype=float)
        own = x is data.get(name)  # else a number or a vector of `_fastest_states`, which all cases share
        each = given.reshape(len(given) if own else 1, *(shape if given.size > 1 or own else (1, 1)))
        each = np.broadcast_to(each, (count, *shape))
        return np.moveaxis(each, 0, 1).reshape(shape[0], -1)

    for y, there in _fastest_states(model, data):
        slopes = np.array(many(y, *[side_by_side(name, there[name]) for name in model.data]))
        slopes = slopes.reshape(size, count, size).swapaxes(0, 1)
        # negated, so that NaN counts as close
        close = np.flatnonzero(~(_eigenvalue_bound(slopes) < limit))
        finite = np.isfinite(slopes[close]).all(axis=(1, 2))
        found[close[~finite]] = True
        rates = np.abs(np.linalg.eigvals(slopes[close[finite]])).max(axis=-1)
        found[close[finite]] |= rates >= limit
    return found


def _eigenvalue_bound(matrices: Array) -> Array:
    """Upper bound (N) of the magnitudes of eigenvalues of matrices (N, k, k): a norm after balancing."""
    a = np.abs(matrices)
    scale = np.ones(a.shape[:2])
    for _ in range(_BALANCING_SWEEPS):
        scaled = a * scale[:, :, None] / scale[:, None, :]
        rows, columns = scaled.sum(axis=2), scaled.sum(axis=1)
        both = (rows > 0) & (columns > 0)
        # A diagonal similarity keeps the eigenvalues. The states have other units, so that without it the
        # norm is much larger than they are.
        scale *= np.sqrt(np.where(both, columns, 1.0) / np.where(both, rows, 1.0))
    scaled = a * scale[:, :, None] / scale[:, None, :]
    bound: Array = np.minimum(scaled.sum(axis=2).max(axis=1), scaled.sum(axis=1).max(axis=1))
    return bound


class Stability:
    """Stable steps of a model, with no joint saturated and all joint friction in its transition band."""

    def __init__(self, collision: SteppedModel) -> None:
        self._collision = collision

    @cached_property
    def _model(self) -> JointSpaceModel:
        return joint_space_model(self._collision)

    @cached_property
    def _freeze(self) -> Any:
        names = [name for name in ("A", "s", "m", "s_point", "m_point") if name in self._model.data]
        return frozen_dynamics(self._collision).function("frozen", (*names, "pivots", "freedom"))

    @cached_property
    def _slope(self) -> Any:
        """ca.Function (y, *data) -> Jacobian of dy/dt by y."""
        y, data = ca.SX.sym("y", self._model.n_states), self._model.symbols()
        rate = self._model.rate_of_change(y, self._model.velocity_change(y, data), data)
        return ca.Function("slope", [y, *data.values()], [ca.jacobian(rate, y)])

    def frozen(self, q: Array, values: dict[str, Array]) -> dict[str, Array]:
        """Frozen quantities at q (nq), by name; InputError if rounding dominates them."""
        function = self._freeze
        # A, s and m do not depend on the velocity, nor on `target_start`
        at_rest = np.zeros(self._collision.robot.nv)
        found = function.call([ca.DM(x) for x in (q, at_rest, values["normal"], np.zeros(2))])
        frozen = {name: np.array(x) for name, x in zip(function.name_out(), found, strict=True)}
        check_frozen(frozen)
        return frozen

    def longest(self, frozen: dict[str, Array], values: dict[str, Array]) -> float:
        """Longest stable step [s], from the frozen quantities and the settings' values."""
        data: dict[str, Any] = frozen | values
        drifts = {name for name in self._model.data if name not in data}
        data |= {name: np.zeros(self._model.data[name]) for name in drifts}
        # a system that does not move has a step as long as any
        rates = [1e-12]
        for y, there in _fastest_states(self._model, data):
            matrix = np.array(self._slope(y, *[there[name] for name in self._model.data]))
            rates.append(float(np.abs(np.linalg.eigvals(matrix)).max()))
        return _STABILITY_LIMIT / max(rates)

    def unstable(self, given: Mapping[str, Array]) -> Mask:
        """Mask (N) of the cases of a batch with an unstable step.

        given : inputs by name, with a first axis of N or 1.
        """
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
        return np.asarray(_unstable_cases(self._model, self._slope, own, collision.step_length))
