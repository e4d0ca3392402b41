"""Collision models as CasADi functions: compiled with the requested outputs only, or as graphs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from impactopt.codegen.cache import cached
from impactopt.collision.batch import Batch
from impactopt.collision.checks import (
    FREEZE_ERROR,
    Stability,
    breaks,
    check_finite,
    check_steps,
    freeze_error,
    left_out_by_breaking,
)
from impactopt.collision.derivatives import Part, differentiable, export, in_order, native_part
from impactopt.collision.graph import Description, collision_graph, describe, target_start
from impactopt.collision.interface import Collision
from impactopt.collision.native import native_collision, native_gradient, native_jacobian
from impactopt.collision.outputs import OF_SERVO, SCALARS, check_jacobian, check_outputs
from impactopt.collision.stepped import SteppedModel
from impactopt.errors import InputError, check_array, check_choice


@dataclass(frozen=True, kw_only=True, eq=False)
class SymbolicModel(SteppedModel):
    """A collision model that can be differentiated. Attributes and errors as of `SteppedModel`."""

    _functions: dict[tuple[Any, ...], Any] = field(init=False, repr=False, default_factory=dict)

    # ------------------------------------------------------------ functions
    def graph(self, outputs: tuple[str, ...] = ("impulse",), *, every: int = 1) -> Any:
        """The collision as a differentiable ca.Function that is not compiled, to build larger graphs with.

        Whatever the method, it takes Runge-Kutta steps of `step_of_graph` [s], which are exact to 1e-2. Its
        inputs are those of `function` with all settings as parameters.

        Raises
        ------
        InputError : the model has further freezes.
        """
        self._check_outputs(outputs, every)
        self.check_grips()
        if self.n_freezes:
            raise InputError(
                "graph: the times of further freezes depend on the contact's duration, which has no "
                "derivative "
                "in Runge-Kutta steps; give freezes=0, or take `function` and `gradient_function`"
            )
        return collision_graph(self, tuple(outputs), every=every)

    def function(
        self,
        outputs: tuple[str, ...] = ("impulse",),
        *,
        parameters: tuple[str, ...] = (),
        by: tuple[str, ...] | None = None,
        every: int = 1,
    ) -> Any:
        """The collision as a compiled ca.Function with the requested outputs.

        Inputs: q (nq), v (nv), Pinocchio's; feedforward (n) [N m] with effects.feedforward; then the settings
        that `parameters` name (any of `settings`), in their order. All other settings are fixed. The function
        computes only what its outputs need.

        All outputs are NaN, `separated` too, if an input is NaN or the constraints of the held frames depend
        on each other at q. They are also NaN if the contact has not ended at the horizon. But if `separated`
        or `duration` is among the outputs, which show this, they have the values reached so far. An optimizer
        whose initial guess may be such a contact needs `separated` among the outputs.

        CasADi can differentiate the function with respect to all inputs (jacobian, forward, reverse), and
        twice by differences. The code for this is compiled when it is first evaluated, which takes some ten
        seconds and is told by `report`. A single scalar output has an adjoint. Scalars and histories have
        tangents with respect to q, v and feedforward. All other derivatives are differences of two collisions
        with tight steps for each number of the input: those with respect to settings; those of models with
        further freezes or with "rk4", which is the method of all with friction at the striking point; and
        those of configuration, velocity and the target's results. The quaternion in q is normalized, so
        derivatives along its length are zero.

        Parameters
        ----------
        outputs : names out of `impactopt.collision.OUTPUTS`, which describes them; histories have a
            column an instant, and repeat the last one after separation.
        parameters : settings that are inputs, in this order.
        by : inputs to differentiate with respect to; None: all. Derivatives by others are zero, and cost
            nothing.
        every : histories keep every `every`-th instant, and the last.

        The function cannot be saved or pickled; `export` makes a library of it.
        """
        self._check_outputs(outputs, every)
        self._check_parameters(parameters)
        return differentiable(
            self, self._collision(tuple(outputs), every), parameters, by, every, self._compiled
        )

    def export(
        self,
        folder: Path | str,
        outputs: tuple[str, ...] = ("impulse",),
        *,
        parameters: tuple[str, ...] = (),
        by: tuple[str, ...] | None = None,
        every: int = 1,
        name: str = "blow",
    ) -> Path:
        """Writes a library with `function` and its first derivatives, for other processes; returns its path.

        ``ca.external("blow", str(path))`` loads it anywhere, without this package. Beside the library the
        folder has its C, `<name>.c`, `<name>.h` and `<name>_collision*.c`, for CPUs of another kind:
        ``cc -O3 -fPIC -shared blow*.c -o blow.so -lm``. Parameters are as of `function`. All derivatives are
        compiled at once, from seconds for an arm to a minute for a humanoid.

        Raises
        ------
        InputError : as of `function`; a name that is not valid in C, or reserved; no compiler; a folder that
            cannot be written.
        """
        self._check_outputs(outputs, every)
        self._check_parameters(parameters)
        whole = self._collision(tuple(outputs), every)
        return export(self, whole, parameters, by, every, self._compiled, Path(folder), name)

    def _collision(self, outputs: tuple[str, ...], every: int = 1) -> Any:
        """Function with all settings as inputs, in handwritten C if there is a compiler."""
        return self._compiled(
            "collision", (*outputs, every), lambda: native_collision(self, outputs, every=every)
        )

    def gradient_function(self, output: str = "impulse", *, parameters: tuple[str, ...] = ()) -> Any:
        """A compiled ca.Function with the inputs of `function`, to a scalar output and its gradients.

        Returns (value, d/dq (nv), d/dv (nv)): q's gradient is in the basis of v, as `pin.integrate` moves q.
        With further freezes it comes from differences, 4 nv collisions. If the contact has not ended at
        the horizon, all are of the values reached so far; `function` gives `separated`.
        """
        self._check_outputs((output,), 1)
        numbers = [name for name in SCALARS if name != "step_error"]
        if output not in numbers:
            raise InputError(f"gradient of {output!r}: only of a number: {', '.join(numbers)}")
        return self._with_parameters(self._gradient(output), parameters)

    def _gradient(self, output: str) -> Any:
        """Likewise, with all settings as inputs."""
        if not self.n_freezes:
            return self._compiled("collision_gradient", (output,), lambda: native_gradient(self, output))
        # The length of a segment, and the posture that it is frozen at, depend on the segment before: there
        # is no adjoint.
        part = Part("collision_differences", (output,), ("q", "v"))
        slopes = self._compiled(part.name, *native_part(self, part, 1))
        value = self._collision(tuple(dict.fromkeys((output, "separated"))))
        inputs = [ca.MX.sym(name, *value.size_in(name)) for name in value.name_in()]
        out = [value.call(inputs)[0], *map(ca.vec, slopes.call(inputs))]
        names = [output, f"{output}_by_q", f"{output}_by_v"]
        return ca.Function("collision_gradient", inputs, out, value.name_in(), names)

    def jacobian_function(
        self,
        outputs: tuple[str, ...] = ("zmp", "torque"),
        *,
        parameters: tuple[str, ...] = (),
        by: tuple[str, ...] = ("q", "v"),
        every: int = 1,
    ) -> Any:
        """A compiled ca.Function with the inputs of `function`, to outputs and their Jacobians.

        For each output there are its value, `<output>_by_q` and `<output>_by_v` (number of entries, nv),
        dense; `by` may have "feedforward", too. Rows are the entries column by column, one instant after the
        other. The Jacobian by q is in the basis of v, as `pin.integrate` moves q. The instants of a history
        are fixed in time, except that of separation, which moves with it, and those after it, which repeat
        it. A horizon that is not much longer than the contact keeps the Jacobians small. If the contact has
        not ended there, all are of the values reached so far; the output `separated` shows it.

        Raises
        ------
        InputError : a model with "rk4" or with further freezes; the target's results, configuration or
            velocity among the outputs; another name in `by`.
        """
        self._check_outputs(outputs, every)
        check_jacobian(outputs, self.stepping, self.n_freezes)
        whole = self._with_parameters(self._jacobian(tuple(outputs), every), parameters)
        inputs = [ca.MX.sym(name, *whole.size_in(name)) for name in whole.name_in()]
        found = dict(zip(whole.name_out(), whole.call(inputs), strict=True))
        possible = [name for name in ("q", "v", "feedforward") if name in whole.name_in()]
        for name in by:
            check_choice("no Jacobian by", name, possible)
        others = tuple(f"_by_{name}" for name in possible if name not in by)
        kept = {name: x for name, x in found.items() if not others or not name.endswith(others)}
        return ca.Function(whole.name(), inputs, [*kept.values()], whole.name_in(), [*kept])

    def _jacobian(self, outputs: tuple[str, ...], every: int) -> Any:
        """Likewise, with all settings as inputs."""
        return self._compiled(
            "collision_jacobian", (*outputs, every), lambda: native_jacobian(self, outputs, every=every)
        )

    def describe(
        self, outputs: tuple[str, ...] = ("impulse",), *, parameters: tuple[str, ...] = ()
    ) -> Description:
        """Description of `function` for these outputs: contents, instruction counts, omissions and reasons.

        str() gives it as text, `as_dict` as data.
        """
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
        """Many collisions in compiled code, on several cores: arrays by output name.

        Parameters
        ----------
        q, v : (N, nq), (N, nv) at contact.
        torque : (N, n), or (n) for all [N m]; needed with effects.feedforward.
        outputs : names out of `impactopt.collision.OUTPUTS`; or "freeze_error", which is not computed unless
            it is named: if frozen at contact only, it takes some six times as long as the impulse.
        every : histories keep every `every`-th instant, and the last.
        threads : cores to use; None: all.
        settings : other values of any of `settings`, shared, or with a first axis of N, one each.

        Returns
        -------
        Arrays (N, ...): numbers (N), vectors (N, size), histories (N, k), (N, k, size), wrenches (N, k,
        frames, 6), where the last instant is repeated after separation. `separated` (N) of bool is always
        included; it is False too where values are not finite. With "rk4" there is `step_error` (N), an
        estimate of the impulse's error by its steps. If this is above 1e-2, or the step is unstable,
        all values are nan. So are those of collisions that `collide` refuses, as constraints depend on each
        other, events use up the steps, or rounding hides the force.
        `freeze_error` (N) is that of `Collision`, nan if the contact has not ended.

        Raises
        ------
        InputError : wrong shapes, NaN, or numbers out of their range; a step that is unstable in every
            collision.
        """
        own = tuple(name for name in outputs if name != FREEZE_ERROR)
        if len(own) < len(outputs):
            own = tuple(dict.fromkeys((*own, "impulse")))
        self._check_outputs(own, every)
        key = ("batch", *own, every)
        if key not in self._functions:
            self._functions[key] = Batch(self, own, self._stability, every=every)
        found: dict[str, NDArray[np.float64]] = self._functions[key](q, v, torque, settings, threads=threads)
        if FREEZE_ERROR in outputs:
            found[FREEZE_ERROR] = np.full(len(found["impulse"]), np.nan)
            if self._more_often is not None:
                given: dict[str, Any] = {"outputs": ("impulse",), "threads": threads, **settings}
                better = self._more_often.batch(q, v, torque, **given)
                error = freeze_error(found["impulse"], better["impulse"], better["separated"])
                found[FREEZE_ERROR] = np.where(found["separated"], error, np.nan)
        return found

    def _compiled(self, name: str, what: tuple[Any, ...], build: Callable[[], Any]) -> Any:
        key = (name, *what)
        if key not in self._functions:
            functions = cached(name, (*self._recipe, *what), lambda: [build()], report=self.report)
            self._functions[key] = functions[name]
        return self._functions[key]

    def _check_parameters(self, parameters: tuple[str, ...]) -> None:
        self.check_grips()
        for name in parameters:
            # refuses an unknown name
            self.settings.override({name: self.settings.get(name, 0.0)})

    def _with_parameters(self, whole: Any, parameters: tuple[str, ...]) -> Any:
        self._check_parameters(parameters)
        inputs = {name: ca.MX.sym(name, *whole.size_in(name)) for name in whole.name_in()}
        kept = in_order(inputs, self.settings, parameters)
        values = [kept.get(name, self.settings.get(name)) for name in inputs]
        return ca.Function(
            whole.name(), list(kept.values()), whole.call(values), list(kept), whole.name_out()
        )

    def _check_outputs(self, outputs: tuple[str, ...], every: int) -> None:
        check_outputs(outputs)
        if every < 1:
            raise InputError(f"every: {every}; give a number of steps >= 1")
        for name in outputs:
            if name in self.available:
                continue
            if name in OF_SERVO and not self.n_servos:
                why = "a point mass knows nothing of it"
            elif name == "target_result":
                why = f"a {type(self.target).__name__} has none"
            elif name == "tangential_velocity":
                why = "no friction moves the target (`ContactFriction.moves_target`)"
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
        self.check_grips(v)
        values = self.settings.override(overrides)
        arguments: list[Any] = [q, v]
        if self.effects.feedforward and torque is None:
            raise InputError(
                "torque: give the feed-forward torque (n) [N m], or switch effects.feedforward off"
            )
        if torque is not None:
            given = check_array("torque [N m]", torque, (self.robot.n,))
            if self.effects.feedforward:
                arguments.append(given)
        result = self._by_steps(arguments, values)
        if require_separation:
            self.check_separation(result)
        if self._more_often is None or not result.separated:
            return result
        error = self._more_often._error_of(result.impulse, arguments, values)
        return replace(result, freeze_error=error, caution=self._caution(error))

    # ------------------------------------------------------------ error of freezing
    @property
    def _more_often(self) -> SymbolicModel | None:
        """Model with more freezes that the error of freezing is estimated from; None for no estimate."""
        return None

    def _caution(self, error: float) -> str:
        """Warning about a relative error of the impulse that freezing causes; "" if it is small."""
        return ""

    def _error_of(
        self, impulse: float, arguments: list[Any], values: dict[str, NDArray[np.float64]]
    ) -> float:
        """Estimated relative error, by freezing, of the impulse [N s] of a model with fewer freezes."""
        found = self._evaluate(("impulse", "separated"), arguments, values)
        return float(freeze_error(np.array(impulse), found["impulse"], found["separated"] > 0.5).item())

    def _evaluate(
        self, names: tuple[str, ...], arguments: list[Any], values: dict[str, NDArray[np.float64]]
    ) -> dict[str, NDArray[np.float64]]:
        """Outputs of one collision by name."""
        found = self._collision(names).call([ca.DM(x) for x in (*arguments, *values.values())])
        return {name: np.array(x) for name, x in zip(names, found, strict=True)}

    def _by_steps(self, arguments: list[Any], values: dict[str, NDArray[np.float64]]) -> Collision:
        implicit = self.stepping == "implicit"
        frozen = {} if implicit else self._stability.frozen(arguments[0], values)
        if not implicit:
            self.check_step(self._stability.longest(frozen, values))
        outputs = self._evaluate(self.available, arguments, values)
        if np.isnan(outputs["impulse"]).any():  # for the reason, if the frozen dynamics are it
            self._stability.frozen(arguments[0], values)
        check_finite(outputs, self.step_length)
        result = Collision.from_outputs(outputs, self.target)
        if implicit:
            check_steps(self, result, 0.0)
            return result
        error = float(outputs["step_error"].item())
        if breaks(self):
            force = values["target_breaking_force"]
            error += float(left_out_by_breaking(self, result.impulse, outputs["target_result"][:, 0], force))
        # If the contact is broken off early, the error is relative to the impulse of a plastic impact.
        # plastic impulse v_c / (m + 1 / m_t), after which hand and target have one speed
        parameters = {name: values[f"target_{name}"] for name in self.target.parameters}
        inverse_mass = float(frozen["m"].item()) + float(target_start(self.target, parameters)[0])
        plastic = float(result.hand_speed[0] - result.target_speed[0]) / max(inverse_mass, 1e-300)
        check_steps(self, result, error * result.impulse / max(result.impulse, plastic, 1e-300))
        return result

    def stable_step(self, q: ArrayLike, **overrides: ArrayLike) -> float:
        """Upper bound [s] of stable steps of "rk4" at q: 2.6 over the fastest rate, with no joint saturated.

        InputError if the constraints of the held frames depend on each other.
        """
        values = self.settings.override(overrides)
        return self._stability.longest(
            self._stability.frozen(self.robot.check_configuration(q), values), values
        )

    @cached_property
    def _stability(self) -> Stability:
        return Stability(self)
