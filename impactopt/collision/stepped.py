"""Base of the stepped collision models: all that their functions and C code depend on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from math import ceil
from typing import Any

from numpy.typing import ArrayLike

from impactopt.codegen.cache import model_hash
from impactopt.collision.contact_slopes import law_is_linear, target_is_linear
from impactopt.collision.effects import Effects, JointFriction
from impactopt.collision.interface import CollisionModel
from impactopt.collision.outputs import OF_SERVO, OF_SOLES, OUTPUTS
from impactopt.collision.settings import Settings
from impactopt.errors import InputError, check_array, did_you_mean

__all__ = ["SteppedModel", "number_of_steps"]

# [s] by method: of the histories, where steps find their own length; and the paper's
STEPS = {"implicit": 1e-3, "rk4": 1e-4}
_MOST_STEPS = 50_000


@dataclass(frozen=True, kw_only=True, eq=False)
class SteppedModel(CollisionModel):
    """A collision model with frozen dynamics: its numbers, and how it is integrated.

    Attributes
    ----------
    effects : those that are taken into account.
    method : how the frozen system is integrated. "implicit" (None): A-stable steps of order eight that end on
        events and find their own length. Without a C compiler they are done in NumPy: the same numbers, a
        hundred times slower, and without derivatives. "rk4": the paper's fixed Runge-Kutta steps, exact to
        1e-2 of the impulse (where contact ends early, of a plastic blow's impulse). `collide` refuses steps
        whose estimated error is larger.
    step : [s]. With "rk4" the length of its steps, below `stable_step(q)`; None: the paper's 1e-4. With
        "implicit", which chooses its own steps, the spacing of histories; None: 1e-3.
    tolerance : of "implicit", the error of one step in the hand's speed and in the impulse, relative to their
        changes, and in what says when the target breaks, starts or stops, relative to its parts. The impulse
        is mostly as exact as that. Errors add up in long contacts, where a servo swings undamped or saturates
        again and again.
    report : called with a line of text while functions are compiled.

    Raises
    ------
    InputError : as `CollisionModel`; an unknown method; a step that is not positive, or makes too many steps.
    """

    effects: Effects = field(default_factory=Effects)
    method: str | None = None
    step: float | None = None
    tolerance: float = 1e-7
    report: Callable[[str], None] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.method is not None and self.method not in STEPS:
            raise InputError(
                f"method {self.method!r}{did_you_mean(self.method, STEPS)}; there are {', '.join(STEPS)}"
            )
        if not 1e-14 <= check_array("tolerance", self.tolerance, ()) <= 1e-2:
            raise InputError(f"tolerance: {self.tolerance:g}; give a number from 1e-14 to 1e-2")
        if not check_array("step [s]", self.step_length, ()) > 0:
            raise InputError(f"step [s]: {self.step_length:g}; give a number > 0")
        if self.step_length > self.horizon:
            raise InputError(f"step [s]: {self.step_length:g} is longer than the horizon, {self.horizon:g} s")
        steps = ceil(self.horizon / self.step_length)
        if steps > _MOST_STEPS:
            raise InputError(
                f"step [s]: {self.step_length:g} takes {steps} steps to the horizon, {self.horizon:g} s, and "
                f"{_MOST_STEPS} are the most: shorten the horizon, or lengthen the step"
            )
        # checks the numbers now, and not when they are first used
        _ = self.settings

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

    @property
    def stepping(self) -> str:
        """The method, or the usual one."""
        return self.method or "implicit"

    @property
    def step_length(self) -> float:
        """The step [s], or the method's own."""
        return min(STEPS[self.stepping], self.horizon) if self.step is None else self.step

    @property
    def step_of_graph(self) -> float:
        """[s] of the Runge-Kutta steps of `graph`: the model's, or the paper's, as a graph cannot find the
        lengths of implicit ones on the way."""
        return self.step_length if self.stepping == "rk4" else min(STEPS["rk4"], self.horizon)

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
        if self.stepping == "implicit":
            missing.add("step_error")
        return tuple(name for name in OUTPUTS if name not in missing)

    @cached_property
    def _recipe(self) -> tuple[Any, ...]:
        """All that shapes the functions; numbers that are inputs do not."""
        held = (self.held_by.sole_frames(self.robot), self.held_by.hand_frames(self.robot))
        held_by = (*held, tuple(self.held_by.compliance))
        transition = self.joint_friction.transition if self.effects.friction else None
        bends = (law_is_linear(self.law), target_is_linear(self.target))
        kinds = (self.law.formula(), self.target.formula(), *bends, self.effects, transition)
        shapes = tuple((name, value.shape) for name, value in self.settings.items())
        frame = self.robot.striker(self.striker).model_frame
        steps = (self.stepping, self.step_length, self.tolerance, self.step_of_graph)
        course = (*steps, self.horizon, self.n_freezes)
        return (model_hash(self.robot.model), self.n_servos, frame, *held_by, *kinds, shapes, *course)


def number_of_steps(collision: SteppedModel, fraction: float = 1.0) -> int:
    """Runge-Kutta steps that reach this fraction of the horizon."""
    return ceil(fraction * collision.horizon / collision.step_of_graph - 1e-9)
