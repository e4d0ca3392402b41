"""Simplified dynamics computation of a collision (paper, section II-B)."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..codegen import cached, model_hash
from ..contact import ContactLaw, FreeMass, SpringDamper, Target
from ..errors import InputError, check_array, did_you_mean
from ..robot import Robot
from ..stance import BothSoles, FixedBase, Stance, usual_stance
from .graph import (
    METHODS,
    collision_graph,
    frozen_dynamics,
    gradient_graph,
    joint_space_model,
    number_of_steps,
)
from .outputs import OF_SOLES, OUTPUTS, SCALARS, check_outputs
from .result import Collision
from .settings import Settings
from .stability import longest_stable_step, slope_function
from .terms import JointFriction, Terms

__all__ = ["SDC"]

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class SDC:
    """A robot hits a target: what both do from contact to separation, with H and J frozen at contact.

    The servo holds on to a reference that coasts at the joint velocity at contact; the collision ends at
    separation, for good.

    Attributes
    ----------
    robot : with servo gains kp, kd and torque limits.
    striker : name of the robot's striking point.
    normal : (3,) unit vector along the blow, world axes; the target moves along it.
    law, target : contact law, and what is hit.
    stance : what holds the robot; None: all soles, or the fixed base.
    terms : effects that are taken into account.
    friction : of the joints, with terms.friction.
    method : "events", Taylor steps of order six that end on events (impulse within 1e-6 relative of the exact
        solution, most often within 1e-9); or "rk4", the paper's fixed Runge-Kutta steps.
    step : [s] length of a step, below `stable_step(q)`; the fastest mode of the servo limits it, accuracy
        does not.
    horizon : [s] the contact should end before this; a contact that ends sooner costs no more for it.
    report : told what is going on while functions are compiled, one line a call.

    Raises
    ------
    InputError : an unknown striker or method; a normal that is not a unit vector; a stance the robot cannot
        take; friction with no numbers; a step or horizon that is not positive.
    """

    robot: Robot
    striker: str
    normal: ArrayLike
    law: ContactLaw
    target: Target
    stance: Stance | None = None
    terms: Terms = field(default_factory=Terms)
    friction: JointFriction | None = None
    method: str = "events"
    step: float = 2.5e-4
    horizon: float = 0.2
    report: Callable[[str], None] | None = None
    _functions: dict[tuple[Any, ...], Any] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        self.robot.striker(self.striker)
        self.held_by.soles(self.robot)
        if self.terms.friction and self.friction is None:
            raise InputError("terms.friction is on: give friction=JointFriction(viscous=..., coulomb=...)")
        if self.friction is not None and not self.terms.friction:
            raise InputError(
                "friction is given, but terms.friction is off: switch it on, or leave friction out"
            )
        if self.method not in METHODS:
            raise InputError(
                f"method {self.method!r}{did_you_mean(self.method, METHODS)}; there are {', '.join(METHODS)}"
            )
        for name in ("step", "horizon"):
            if not check_array(f"{name} [s]", getattr(self, name), ()) > 0:
                raise InputError(f"{name} [s]: {getattr(self, name):g}; give a number > 0")
        if self.step > self.horizon:
            raise InputError(f"step [s]: {self.step:g} is longer than the horizon, {self.horizon:g} s")
        # checks the numbers now, and not when they are first used
        object.__setattr__(self, "normal", self.settings["normal"])

    @classmethod
    def paper(
        cls,
        robot: Robot,
        *,
        striker: str,
        normal: ArrayLike,
        law: ContactLaw | None = None,
        target: Target | None = None,
        stance: Stance | None = None,
        friction: JointFriction | None = None,
        horizon: float = 0.1,
        report: Callable[[str], None] | None = None,
    ) -> SDC:
        """The paper's model: servo damping and saturation (eqs. 11, 12), and friction where it is given.

        Runge-Kutta steps of 1e-4 s, as in its section III.

        Law, target and stance are the paper's unless given: k = 1e4 N/m, d = 300 N s/m, a free
        mass of 5 kg, and virtual bases of 1e5 kg and 1e5 kg m2.
        """
        if stance is None:
            stance = BothSoles(base_mass=1e5, base_inertia=1e5) if robot.floating else FixedBase()
        return cls(
            robot=robot,
            striker=striker,
            normal=normal,
            law=law or SpringDamper(stiffness=1e4, damping=300.0),
            target=target or FreeMass(mass=5.0),
            stance=stance,
            terms=Terms.paper(friction=friction is not None),
            friction=friction,
            method="rk4",
            step=1e-4,
            horizon=horizon,
            report=report,
        )

    @property
    def held_by(self) -> Stance:
        """The stance, or the robot's usual one."""
        return usual_stance(self.robot) if self.stance is None else self.stance

    @property
    def joint_friction(self) -> JointFriction:
        """The friction, or none."""
        return self.friction or JointFriction()

    @cached_property
    def settings(self) -> Settings:
        """Numbers that are inputs of the functions, with their defaults."""
        return Settings(self.robot, self.law, self.target, self.normal, self.terms, self.joint_friction)

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
        output needs, and has no derivatives.

        Parameters
        ----------
        outputs : names out of `impactopt.collision.OUTPUTS`, which says what they are; histories have a
            column an instant, and repeat the last one after separation.
        parameters : settings that are inputs.
        every : keep every so many steps, and the last, of the histories.
        """
        self._check_outputs(outputs, every)
        whole = self._compiled("collision", (*outputs, every), lambda: self.graph(outputs, every=every))
        return self._with_parameters(whole, parameters)

    def gradient_function(self, output: str = "impulse", *, parameters: tuple[str, ...] = ()) -> Any:
        """A compiled ca.Function with the inputs of `function`, to a scalar output and its gradients.

        Returns (value, d/dq (nv), d/dv (nv)): q's gradient is in the basis of v, as `pin.integrate` moves q.
        """
        self._check_outputs((output,), 1)
        if output not in SCALARS:
            raise InputError(f"gradient of {output!r}: only of a number: {', '.join(SCALARS)}")
        whole = self._compiled("collision_gradient", (output,), lambda: gradient_graph(self, output))
        return self._with_parameters(whole, parameters)

    def _compiled(self, name: str, what: tuple[Any, ...], build: Callable[[], Any]) -> Any:
        key = (name, *what)
        if key not in self._functions:
            functions = cached(name, (*self._recipe, *what), lambda: [build()], report=self.report)
            self._functions[key] = functions[name]
        return self._functions[key]

    @cached_property
    def _recipe(self) -> tuple[Any, ...]:
        model = model_hash(self.robot.model)
        stance = (repr(self.held_by), self.held_by.constraint_frames(self.robot))
        transition = self.joint_friction.transition if self.terms.friction else None
        kinds = (_source(self.law), _source(self.target), self.terms, transition)
        return (model, self.striker, *stance, *kinds, self.method, self.step, number_of_steps(self))

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
        if every < 1:
            raise InputError(f"every: {every}; give a number of steps >= 1")
        if not self.held_by.soles(self.robot):
            for name in outputs:
                if name in OF_SOLES:
                    raise InputError(f"output {name!r}: a robot on a fixed base has no soles; leave it out")

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
        """One collision, in numbers.

        Parameters
        ----------
        q, v : (nq), (nv) at contact, Pinocchio's; v should leave the held soles at rest.
        torque : (n) [N m] feed-forward, with terms.feedforward.
        require_separation : refuse a contact that has not ended at the horizon.
        overrides : settings other than the defaults, by name.

        Raises
        ------
        InputError : wrong shapes or NaN; torque missing, or not wanted; unknown settings; a step too long
            for the servo's fastest mode; a contact that does not end.
        """
        q, v = self.robot.check_configuration(q), self.robot.check_velocity(v)
        values = self.settings.override(overrides)
        longest = self.stable_step(q, **overrides)
        if self.step >= longest:
            raise InputError(
                f"step [s]: {self.step:g} is unstable here, where the fastest mode allows {longest:.2g}: "
                "give SDC a step below that, or the joints less kd or more armature"
            )
        names = tuple(name for name in OUTPUTS if name not in OF_SOLES or self.held_by.soles(self.robot))
        whole = self._compiled("collision", (*names, 1), lambda: self.graph(names))
        arguments: list[Any] = [q, v]
        if self.terms.feedforward:
            if torque is None:
                raise InputError(
                    "torque: give the feed-forward torque (n) [N m], or switch terms.feedforward off"
                )
            arguments.append(check_array("torque [N m]", torque, (self.robot.n,)))
        elif torque is not None:
            raise InputError("torque: terms.feedforward is off: switch it on, or leave the torque out")
        found = whole.call([ca.DM(x) for x in (*arguments, *values.values())])
        result = Collision.from_outputs({name: np.array(x) for name, x in zip(names, found, strict=True)})
        if require_separation and not result.separated:
            raise InputError(
                f"horizon [s]: the contact has not ended after {result.duration:.3g} s: raise SDC's horizon, "
                "or pass require_separation=False for what happened so far"
            )
        return result

    def stable_step(self, q: ArrayLike, **overrides: ArrayLike) -> float:
        """[s] that the step has to stay below at q: 2.6 over the fastest mode's rate, no joint saturated."""
        q = self.robot.check_configuration(q)
        values = self.settings.override(overrides)
        frozen, slope = self._stability
        found = frozen(q, np.zeros(self.robot.nv), values["normal"])
        data = dict(zip(frozen.name_out(), found, strict=True)) | values
        if self.terms.bias or self.terms.jdot:
            data |= {"d": np.zeros(self.robot.n), "e": 0.0}
        return longest_stable_step(joint_space_model(self), slope, data)

    @cached_property
    def _stability(self) -> tuple[Any, Any]:
        frozen = frozen_dynamics(self).function("frozen", ("A", "s", "m"))
        return frozen, slope_function(joint_space_model(self))


def _source(thing: Any) -> str:
    """What tells two laws, or two targets, apart besides their numbers: the class, and a user's text."""
    kind = type(thing)
    name = f"{kind.__module__}.{kind.__qualname__}"
    if kind.__module__.startswith("impactopt."):
        return name
    try:
        return f"{name} {hashlib.sha256(inspect.getsource(kind).encode()).hexdigest()}"
    except (OSError, TypeError):
        return f"{name} {id(kind)}"
