"""Collision models as CasADi functions: compiled with just the outputs asked for, or graphs to build with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import ceil
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from impactopt.codegen.cache import cached, model_hash
from impactopt.collision.batch import Batch
from impactopt.collision.checks import (
    breaks,
    check_course,
    check_finite,
    check_frozen,
    left_out_by_breaking,
    spoiled,
)
from impactopt.collision.describe import Description, describe
from impactopt.collision.exact import ExactCollision
from impactopt.collision.freezing import FREEZE_ERROR, freeze_error
from impactopt.collision.graph import (
    METHODS,
    collision_graph,
    frozen_dynamics,
    joint_space_model,
    number_of_steps,
    target_yield,
)
from impactopt.collision.implicit import is_linear
from impactopt.collision.interface import CollisionModel
from impactopt.collision.native import native_collision, native_gradient, native_jacobian
from impactopt.collision.outputs import OF_SERVO, OF_SOLES, OUTPUTS, SCALARS, check_jacobian, check_outputs
from impactopt.collision.result import Collision
from impactopt.collision.settings import Settings
from impactopt.collision.stability import longest_stable_step, slope_function, unstable_rows
from impactopt.collision.terms import JointFriction, Terms
from impactopt.errors import InputError, check_array, did_you_mean

__all__ = ["SymbolicModel"]

# [s] by method: of the histories, where steps find their own length; of Taylor's steps, which are held by
# events and by the servo's fastest mode; and the paper's
_STEPS = {"implicit": 1e-3, "exact": 2.5e-4, "events": 2.5e-4, "rk4": 1e-4}
_MOST_STEPS = 50_000


@dataclass(frozen=True, kw_only=True, eq=False)
class SymbolicModel(CollisionModel):
    """A model of a collision that can be differentiated.

    Attributes
    ----------
    terms : effects that are taken into account.
    method : how the frozen system is integrated; None: the first of these that law, target and gains allow.
        "implicit": A-stable steps of order eight that end on events and find their own length, for laws and
        targets that are linear between events and gains that are one number a joint. Without a C compiler
        they are done in NumPy: the same numbers, a hundred times slower, and without derivatives.
        "events": Taylor steps of order six that end on events, with the impulse within 1e-5 of the exact
        solution, most often within 1e-9. "rk4": the paper's fixed Runge-Kutta steps, for laws that have no
        such derivatives, within 1e-2. The last two are of the impulse, or of a plastic blow's where contact
        is broken off before; `collide` refuses a step that it estimates not to hold this.
        Or "exact", up to rounding, where law and target are linear between events, to measure the others by:
        for `collide` only.
    step : [s] of "events" and "rk4", their length, below `stable_step(q)`; None: 2.5e-4, and the paper's
        1e-4. Of "implicit" and "exact", which any step suits, the histories' spacing; None: 1e-3 and 2.5e-4.
    tolerance : of "implicit", what a step may leave out of the hand's speed and of the impulse, relative to
        their changes. The impulse is most often that exact; contacts that are pushed on and on by servos
        that swing undamped, or saturate to and fro, gather more.
    report : told what is going on while functions are compiled, one line a call.

    Raises
    ------
    InputError : as `CollisionModel`; an unknown method, or one that law or target do not allow; a step that
        is not positive.
    """

    terms: Terms = field(default_factory=Terms)
    method: str | None = None
    step: float | None = None
    tolerance: float = 1e-7
    report: Callable[[str], None] | None = None
    _functions: dict[tuple[Any, ...], Any] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.method is not None and self.method not in _STEPS:
            raise InputError(
                f"method {self.method!r}{did_you_mean(self.method, _STEPS)}; there are {', '.join(_STEPS)}"
            )
        for thing in (self.law, self.target):
            if self.method == "events" and not thing.analytic:
                raise InputError(
                    f"method 'events': {type(thing).__name__} lacks the derivatives that Taylor steps need; "
                    "use 'rk4'"
                )
        if not 1e-14 <= check_array("tolerance", self.tolerance, ()) <= 1e-2:
            raise InputError(f"tolerance: {self.tolerance:g}; give a number from 1e-14 to 1e-2")
        if not check_array("step [s]", self.step_length, ()) > 0:
            raise InputError(f"step [s]: {self.step_length:g}; give a number > 0")
        if self.step_length > self.horizon:
            raise InputError(f"step [s]: {self.step_length:g} is longer than the horizon, {self.horizon:g} s")
        steps = (
            ceil(self.horizon / self.step_length) if self.stepping == "implicit" else number_of_steps(self)
        )
        if self.method != "exact" and steps > _MOST_STEPS:
            raise InputError(
                f"step [s]: {self.step_length:g} takes {steps} steps to the horizon, {self.horizon:g} s, and "
                f"{_MOST_STEPS} are the most: shorten the horizon, or lengthen the step"
            )
        # checks the numbers now, and not when they are first used
        _ = self.settings
        if self.method == "implicit" and (why := self._not_implicit()):
            raise InputError(f"method 'implicit': {why}; use 'events' or 'rk4'")
        if self.method == "exact":
            if self.n_freezes:
                raise InputError("method 'exact': only without further freezes: freezes=0, or use 'events'")
            _ = self._exact

    # ------------------------------------------------------------ what is modelled
    @property
    def joint_friction(self) -> JointFriction:
        """The joints' friction, or none."""
        return JointFriction()

    @property
    def n_servos(self) -> int:
        """Joints whose servos act: all, or none of a point mass."""
        return self.robot.n

    @property
    def n_freezes(self) -> int:
        """Freezes on the way, besides the one at contact."""
        return 0

    @cached_property
    def stepping(self) -> str:
        """The method, or the first that can be had."""
        if self.method is not None:
            return self.method
        return self._explicit if self._not_implicit() else "implicit"

    @property
    def step_length(self) -> float:
        """The step [s], or the method's own."""
        return min(_STEPS[self.stepping], self.horizon) if self.step is None else self.step

    @property
    def of_graph(self) -> tuple[str, float]:
        """Method and step [s] of `graph`: "implicit" finds its way as it goes, which a graph cannot, and has
        Taylor steps there."""
        if self.stepping in METHODS:
            return self.stepping, self.step_length
        return self._explicit, min(_STEPS[self._explicit], self.horizon)

    @property
    def _explicit(self) -> str:
        return "events" if self.law.analytic and self.target.analytic else "rk4"

    def _not_implicit(self) -> str:
        """What stands against implicit steps, or nothing."""
        if not is_linear(self.law, self.target):
            return f"{type(self.law).__name__} and {type(self.target).__name__} are not linear between events"
        if any(self.settings[name].ndim == 2 for name in {"kp", "kd"} & {*self.settings}):
            return "kp and kd have to be one number a joint"
        return ""

    @cached_property
    def settings(self) -> Settings:
        """Numbers that are inputs of the functions, with their defaults."""
        return Settings(self.law, self.target, self.normal, self._servo_settings())

    def _servo_settings(self) -> dict[str, ArrayLike]:
        return {}

    @cached_property
    def available(self) -> tuple[str, ...]:
        """Names of the outputs that this model has, out of `impactopt.collision.OUTPUTS`."""
        missing = set() if self.n_servos else {*OF_SERVO}
        if not self.held_by.soles(self.robot):
            missing |= {*OF_SOLES}
        if not self.held_by.hand_frames(self.robot):
            missing.add("hand_wrench")
        if not self.target.results:
            missing.add("target_result")
        if self.stepping not in METHODS:
            missing.add("step_error")
        return tuple(name for name in OUTPUTS if name not in missing)

    # ------------------------------------------------------------ functions
    def graph(self, outputs: tuple[str, ...] = ("impulse",), *, every: int = 1) -> Any:
        """The collision as a differentiable ca.Function that is not compiled, to build larger graphs with.

        Inputs as of `function` with all settings; see there.
        """
        self._check_outputs(outputs, every)
        return collision_graph(self, tuple(outputs), every=every)

    def function(
        self, outputs: tuple[str, ...] = ("impulse",), *, parameters: tuple[str, ...] = (), every: int = 1
    ) -> Any:
        """The collision as a compiled ca.Function of what it needs, to the outputs asked for.

        Inputs: q (nq), v (nv), Pinocchio's; feedforward (n) [N m] with terms.feedforward; then the settings
        that `parameters` name (any of `settings`), the others being fixed. It does not contain what no
        output needs, and has no derivatives. Where an input is NaN, so are all outputs, `separated` too.

        Parameters
        ----------
        outputs : names out of `impactopt.collision.OUTPUTS`, which says what they are; histories have a
            column an instant, and repeat the last one after separation.
        parameters : settings that are inputs.
        every : keep every so many steps, and the last, of the histories.
        """
        self._check_outputs(outputs, every)
        return self._with_parameters(self._collision(tuple(outputs), every), parameters)

    def _collision(self, outputs: tuple[str, ...], every: int = 1) -> Any:
        """With all settings as inputs, in C written by hand where there is a compiler."""
        return self._compiled(
            "collision", (*outputs, every), lambda: native_collision(self, outputs, every=every)
        )

    def gradient_function(self, output: str = "impulse", *, parameters: tuple[str, ...] = ()) -> Any:
        """A compiled ca.Function with the inputs of `function`, to a scalar output and its gradients.

        Returns (value, d/dq (nv), d/dv (nv)): q's gradient is in the basis of v, as `pin.integrate` moves q.
        """
        self._check_outputs((output,), 1)
        numbers = [name for name in SCALARS if name != "step_error"]
        if output not in numbers:
            raise InputError(f"gradient of {output!r}: only of a number: {', '.join(numbers)}")
        return self._with_parameters(self._gradient(output), parameters)

    def _gradient(self, output: str) -> Any:
        """Likewise, with its gradients."""
        return self._compiled("collision_gradient", (output,), lambda: native_gradient(self, output))

    def jacobian_function(
        self,
        outputs: tuple[str, ...] = ("zmp", "torque"),
        *,
        parameters: tuple[str, ...] = (),
        every: int = 1,
    ) -> Any:
        """A compiled ca.Function with the inputs of `function`, to outputs and their Jacobians by q and v.

        Of each output, in turn: its value, `<output>_by_q` and `<output>_by_v` (number of its entries, nv),
        dense; rows are the entries column by column, instant after instant; q's Jacobian is in the basis of
        v, as `pin.integrate` moves q. Instants stay where they are in time, but for that of separation, and
        those after it, which repeat it: they move with it.

        Only with implicit steps and a single freeze, and neither of what the target's `results` say nor of
        configuration and velocity: else InputError. For more than a few collisions, a horizon not much longer
        than contact keeps the Jacobians small.
        """
        self._check_outputs(outputs, every)
        check_jacobian(outputs, self.stepping, self.n_freezes, self._not_implicit())
        return self._with_parameters(self._jacobian(tuple(outputs), every), parameters)

    def _jacobian(self, outputs: tuple[str, ...], every: int) -> Any:
        """Likewise, with all settings as inputs."""
        return self._compiled(
            "collision_jacobian", (*outputs, every), lambda: native_jacobian(self, outputs, every=every)
        )

    def describe(
        self, outputs: tuple[str, ...] = ("impulse",), *, parameters: tuple[str, ...] = ()
    ) -> Description:
        """What `function` contains for these outputs, with its instructions, and what was left out and why:
        text by str(), numbers by `as_dict`."""
        self._check_outputs(outputs, 1)
        return describe(self, tuple(outputs), parameters)

    def batch(
        self,
        q: ArrayLike,
        v: ArrayLike,
        torque: ArrayLike | None = None,
        *,
        outputs: tuple[str, ...] = ("impulse", "duration"),
        every: int = 1,
        threads: int | None = None,
        **settings: ArrayLike,
    ) -> dict[str, NDArray[np.float64]]:
        """Collisions by name of output, with no interpreter between them, on several cores.

        Parameters
        ----------
        q, v : (N, nq), (N, nv) at contact.
        torque : (N, n), or (n) for all [N m]; needed with terms.feedforward.
        outputs : names out of `impactopt.collision.OUTPUTS`; or "freeze_error", which is not computed unless
            it is named: of one freeze it takes some six times as long as the impulse.
        every : keep every so many steps, and the last, of the histories.
        threads : cores to use; None: all.
        settings : other values of any of `settings`, for all, or with a first axis of N, one each.

        Returns
        -------
        Arrays (N, ...): numbers (N), vectors (N, size), histories (N, k), (N, k, size), wrenches (N, k,
        frames, 6), where the last instant is repeated after separation; and always `separated` (N) of bool,
        False also where there came out no number. With explicit steps also `step_error` (N), what they left
        out of each impulse, as an estimate: collisions that it is too large of (more than 1e-5 of "events",
        1e-2 of "rk4") have no numbers, and neither have those that the step is unstable of.
        `freeze_error` (N) is that of `Collision`, nan where the contact has not ended.

        Raises
        ------
        InputError : wrong shapes, NaN, or numbers out of their range; a step that is unstable in every row.
        """
        own = tuple(name for name in outputs if name != FREEZE_ERROR)
        if len(own) < len(outputs):
            own = tuple(dict.fromkeys((*own, "impulse")))
        self._check_outputs(own, every)
        key = ("batch", *own, every)
        if key not in self._functions:
            self._functions[key] = Batch(self, own, every=every)
        found: dict[str, NDArray[np.float64]] = self._functions[key](q, v, torque, settings, threads=threads)
        if FREEZE_ERROR in outputs:
            error = self._freeze_error(found["impulse"], q, v, torque, settings, threads)
            found[FREEZE_ERROR] = np.where(found["separated"], error, np.nan)
        return found

    def _compiled(self, name: str, what: tuple[Any, ...], build: Callable[[], Any]) -> Any:
        key = (name, *what)
        if key not in self._functions:
            functions = cached(name, (*self._recipe, *what), lambda: [build()], report=self.report)
            self._functions[key] = functions[name]
        return self._functions[key]

    @cached_property
    def _recipe(self) -> tuple[Any, ...]:
        """All that shapes the functions; numbers that are inputs do not."""
        held = (self.held_by.sole_frames(self.robot), self.held_by.hand_frames(self.robot))
        held_by = (*held, tuple(self.held_by.compliance))
        transition = self.joint_friction.transition if self.terms.friction else None
        kinds = (self.law.formula(), self.target.formula(), self.terms, transition)
        shapes = tuple((name, value.shape) for name, value in self.settings.items())
        frame = self.robot.striker(self.striker).model_frame
        steps = (self.stepping, self.step_length, self.tolerance, *self.of_graph, number_of_steps(self))
        course = (*steps, self.horizon, self.n_freezes)
        return (model_hash(self.robot.model), self.n_servos, frame, *held_by, *kinds, shapes, *course)

    def _with_parameters(self, whole: Any, parameters: tuple[str, ...]) -> Any:
        for name in parameters:
            self.settings.override({name: self.settings.get(name, 0.0)})
        inputs = {name: ca.MX.sym(name, *whole.size_in(name)) for name in whole.name_in()}
        kept = {name: x for name, x in inputs.items() if name not in self.settings or name in parameters}
        values = [kept.get(name, self.settings.get(name)) for name in inputs]
        return ca.Function(
            whole.name(), list(kept.values()), whole.call(values), list(kept), whole.name_out()
        )

    def _check_outputs(self, outputs: tuple[str, ...], every: int) -> None:
        check_outputs(tuple(outputs))
        if self.stepping == "exact":
            raise InputError("method 'exact' gives numbers only, by `collide`; use 'events' for functions")
        if every < 1:
            raise InputError(f"every: {every}; give a number of steps >= 1")
        for name in outputs:
            if name in self.available:
                continue
            if name in OF_SERVO and not self.n_servos:
                why = "a point mass knows nothing of it"
            elif name == "target_result":
                why = f"a {type(self.target).__name__} has none"
            elif name == "step_error":
                why = "implicit steps keep it below `tolerance`"
            elif name == "hand_wrench":
                why = "no hand is held"
            else:
                why = "a robot on a fixed base has no soles"
            raise InputError(f"output {name!r}: {why}; leave it out")

    # ------------------------------------------------------------ numbers
    def collide(
        self,
        q: ArrayLike,
        v: ArrayLike,
        torque: ArrayLike | None = None,
        *,
        require_separation: bool = True,
        **overrides: ArrayLike,
    ) -> Collision:
        q, v = self.robot.check_configuration(q), self.robot.check_velocity(v)
        values = self.settings.override(overrides)
        arguments: list[Any] = [q, v]
        if self.terms.feedforward and torque is None:
            raise InputError(
                "torque: give the feed-forward torque (n) [N m], or switch terms.feedforward off"
            )
        if torque is not None:
            given = check_array("torque [N m]", torque, (self.robot.n,))
            if self.terms.feedforward:
                arguments.append(given)
        if self.stepping == "exact":
            result = self._exact(q, v, arguments[2] if self.terms.feedforward else None, values)
        else:
            result = self._by_steps(arguments, values)
        if require_separation:
            self.check_separation(result)
        if self._more_often is None or not result.separated:
            return result
        impulse, one = np.array([result.impulse]), arguments[2] if self.terms.feedforward else None
        (error,) = self._freeze_error(impulse, q[None], v[None], one, values, threads=1)
        return replace(result, freeze_error=float(error), caution=self._caution(float(error)))

    # ------------------------------------------------------------ what freezing costs
    @property
    def _more_often(self) -> SymbolicModel | None:
        """The model that says what freezing costs, or None: not estimated."""
        return None

    def _caution(self, error: float) -> str:
        """What is said of an error of the impulse, relative, that comes from freezing."""
        return ""

    def _freeze_error(
        self,
        impulse: NDArray[np.float64],
        q: ArrayLike,
        v: ArrayLike,
        torque: ArrayLike | None,
        settings: Mapping[str, Any],
        threads: int | None,
    ) -> NDArray[np.float64]:
        """What freezing may have cost of each impulse (N) [N s], relative; nan where it is not estimated."""
        if self._more_often is None:
            return np.full(len(impulse), np.nan)
        better = self._more_often.batch(q, v, torque, outputs=("impulse",), threads=threads, **settings)
        return freeze_error(impulse, better["impulse"], better["separated"])

    def _by_steps(self, arguments: list[Any], values: dict[str, NDArray[np.float64]]) -> Collision:
        frozen = self._frozen_at(arguments[0], values)
        if self.stepping != "implicit":
            self.check_step(self.step_length, self._longest(frozen, values))
        names = self.available
        found = self._collision(names).call([ca.DM(x) for x in (*arguments, *values.values())])
        outputs = {name: np.array(x) for name, x in zip(names, found, strict=True)}
        check_finite(outputs, self.step_length)
        error = float(outputs.get("step_error", np.zeros(1)).item())
        result = Collision.from_outputs(outputs, self.target)
        if breaks(self):
            force = values["target_breaking_force"]
            error += float(left_out_by_breaking(self, result.impulse, outputs["target_result"][:, 0], force))
        # of a plastic blow, where the contact is broken off before
        numbers = {name: values[f"target_{name}"] for name in self.target.parameters}
        yields = float(frozen["m"].item()) + float(target_yield(self.target, numbers))
        plastic = float(result.hand_speed[0] - result.target_speed[0]) / max(yields, 1e-300)
        check_course(self, result, error * result.impulse / max(result.impulse, plastic, 1e-300))
        return result

    @cached_property
    def _exact(self) -> ExactCollision:
        return ExactCollision(self)

    def stable_step(self, q: ArrayLike, **overrides: ArrayLike) -> float:
        """[s] that steps of "events" and "rk4" have to stay below at q: 2.6 over the fastest rate, with no
        joint saturated.

        InputError where what holds the robot cannot be told apart.
        """
        values = self.settings.override(overrides)
        return self._longest(self._frozen_at(self.robot.check_configuration(q), values), values)

    def unstable_rows(self, given: Mapping[str, NDArray[np.float64]]) -> NDArray[np.bool_]:
        """(N) rows of a batch that explicit steps are unstable of, or that rounding spoils; inputs by name
        have a first axis of N or 1."""
        count, function = len(given["q"]), self._stability[0]
        inputs = (given["q"], np.zeros((1, self.robot.nv)), given["normal"], np.zeros((1, 1)))
        columns = [np.broadcast_to(x, (count, x.shape[1])).T for x in inputs]
        found = function.map(count).call([ca.DM(x) for x in columns])
        frozen = {name: np.array(x).T for name, x in zip(function.name_out(), found, strict=True)}
        data: dict[str, Any] = frozen | {name: given[name] for name in self.settings}
        if self.terms.bias or self.terms.jdot:
            data |= {"d": np.zeros((1, self.robot.n)), "e": np.zeros((1, 1))}
        model = joint_space_model(self)
        own = {name: x for name, x in data.items() if name in model.data}
        unstable = unstable_rows(model, self._stability[1], own, self.step_length)
        return np.asarray(unstable | spoiled(frozen))

    def _longest(
        self, frozen: dict[str, NDArray[np.float64]], values: dict[str, NDArray[np.float64]]
    ) -> float:
        data: dict[str, Any] = frozen | values
        if self.terms.bias or self.terms.jdot:
            data |= {"d": np.zeros(self.robot.n), "e": 0.0}
        return longest_stable_step(joint_space_model(self), self._stability[1], data)

    def _frozen_at(
        self, q: NDArray[np.float64], values: dict[str, NDArray[np.float64]]
    ) -> dict[str, NDArray[np.float64]]:
        """What is frozen at q; InputError where rounding spoils it."""
        function = self._stability[0]
        found = function.call([ca.DM(x) for x in (q, np.zeros(self.robot.nv), values["normal"], 0.0)])
        frozen = {name: np.array(x) for name, x in zip(function.name_out(), found, strict=True)}
        check_frozen(frozen)
        return frozen

    @cached_property
    def _stability(self) -> tuple[Any, Any]:
        names = ("A", "s", "m") if self.n_servos else ("m",)
        function = frozen_dynamics(self).function("frozen", (*names, "pivots", "freedom"))
        return function, slope_function(joint_space_model(self))
