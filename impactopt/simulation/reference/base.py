"""Base of the reference models: gains, friction, tolerance, and the search for the step that meets it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from impactopt.collision.interface import Collision, CollisionModel
from impactopt.collision.settings import Effects, JointFriction, Settings, no_bend, servo_settings
from impactopt.errors import InputError, check_array
from impactopt.robots.robot import Robot
from impactopt.simulation.reference.forces import Forces

__all__ = ["ReferenceModel", "converge"]

Array = NDArray[np.float64]
Outcome = TypeVar("Outcome", bound="_HasImpulse")


@dataclass(frozen=True, kw_only=True, eq=False)
class ReferenceModel(CollisionModel):
    """A collision with nothing frozen, integrated until its impulse is known within a tolerance.

    Attributes
    ----------
    friction : of the joints.
    kp, kd : (n) or (n, n) gains in place of the robot's.
    step : [s] the longest.
    tolerance : relative, of the impulse.
    """

    friction: JointFriction | None = None
    kp: ArrayLike | None = None
    kd: ArrayLike | None = None
    step: float = 5e-5
    tolerance: float = 1e-6

    def __post_init__(self) -> None:
        super().__post_init__()
        _positive("step [s]", self.step)
        _positive("tolerance", self.tolerance)
        self._settings(self.kp, self.kd)

    @abstractmethod
    def _controlled(
        self, q: Array, v: Array, forces: Forces, normal: Array, tolerance: float
    ) -> tuple[Collision, float]:
        """(the collision, what is not known of its impulse [N s]), from checked numbers."""

    def collide(
        self,
        q: ArrayLike,
        v: ArrayLike,
        torque: ArrayLike | None = None,
        *,
        require_separation: bool = True,
        **overrides: ArrayLike,
    ) -> Collision:
        """One collision, in numbers, as of `CollisionModel.collide`.

        `overrides` are normal, contact_<number of the law>, target_<number of the target>, kp, kd,
        torque_limit, reference, reference_until, and with friction viscous, coulomb.

        Raises
        ------
        InputError : wrong shapes or NaN; torque missing; unknown overrides; a contact that does not end; an
            impulse that is not found within the tolerance.
        """
        given: dict[str, Any] = {"require_separation": require_separation, **overrides}
        return self.converged(q, v, torque, **given)[0]

    def converged(
        self,
        q: ArrayLike,
        v: ArrayLike,
        torque: ArrayLike | None = None,
        *,
        tolerance: float | None = None,
        require_separation: bool = True,
        **overrides: Any,
    ) -> tuple[Collision, float]:
        """(the collision as `collide` gives it; what its impulse changed by when it was integrated more
        exactly [N s]).

        tolerance : relative, of the impulse; None: the model's.

        Raises
        ------
        InputError : as of `collide`.
        """
        tolerance = _positive("tolerance", self.tolerance if tolerance is None else tolerance)
        q, v = self.robot.check_configuration(q), self.robot.check_velocity(v)
        forces, normal = self._forces(v, torque, overrides)
        result, change = self._controlled(q, v, forces, normal, tolerance)
        if require_separation:
            self.check_separation(result)
        return result, change

    @property
    def _held(self) -> tuple[Robot, tuple[str, ...], Array, str]:
        """Robot, constrained frames, their compliance, and striking frame."""
        robot, held_by = self.robot, self.held_by
        striker = robot.striker(self.striker).model_frame
        return robot, held_by.constraint_frames(robot), held_by.compliance, striker

    # ------------------------------------------------------------ numbers
    def _settings(self, kp: ArrayLike | None, kd: ArrayLike | None) -> Settings:
        effects = Effects(friction=self.friction is not None)
        servo = servo_settings(self.robot, effects, self._friction, kp, kd)
        servo |= no_bend(self.robot.n)  # with friction too
        return Settings(self.law, self.target, np.asarray(self.normal), servo)

    @property
    def _friction(self) -> JointFriction:
        return self.friction or JointFriction()

    def _forces(
        self, v: Array, torque: ArrayLike | None, overrides: Mapping[str, ArrayLike]
    ) -> tuple[Forces, Array]:
        """The forces, and the normal."""
        n = self.robot.n
        if torque is None:
            raise InputError(
                "torque: give the feed-forward torque (n) [N m]; `holding_torque` has one that keeps the "
                "robot's velocities, np.zeros(n) is none"
            )
        # gains may change their shape too, from one a joint to a matrix
        settings = self._settings(overrides.get("kp", self.kp), overrides.get("kd", self.kd))
        rest = {name: x for name, x in overrides.items() if name not in ("kp", "kd")}
        values = settings.override(rest)
        none = np.zeros(n)
        forces = Forces(
            law=self.law,
            target=self.target,
            law_numbers={name: float(values[f"contact_{name}"]) for name in self.law.parameters},
            target_numbers={name: float(values[f"target_{name}"]) for name in self.target.parameters},
            kp=values["kp"],
            kd=values["kd"],
            limit=values["torque_limit"],
            viscous=values.get("viscous", none),
            coulomb=values.get("coulomb", none),
            transition=self._friction.transition,
            feedforward=check_array("torque [N m]", torque, (n,)),
            velocity=v[-n:],
            reference=values["reference"],
            reference_until=float(values["reference_until"]),
        )
        return forces, values["normal"]


def _positive(name: str, value: float) -> float:
    """A number above zero, or InputError."""
    if not check_array(name, value, ()) > 0:
        raise InputError(f"{name}: {value:g}; give a number > 0")
    return float(value)


class _HasImpulse(Protocol):
    @property
    def impulse(self) -> float: ...


def converge(
    at: Callable[[int], Outcome],
    tolerance: float,
    *,
    levels: int,
    better: Callable[[Outcome, Outcome], Outcome] | None = None,
) -> tuple[Outcome, float]:
    """(outcome, what its impulse has changed by at last [N s]), when that is within a relative tolerance.

    at : the outcome of a level, which is more exact each time.
    levels : the most of them.
    better : makes an outcome of those of a level and of the one before; None: the first of them.
    """
    runs = [at(0)]
    found = [] if better else runs
    change = np.inf
    for level in range(1, levels):
        runs.append(at(level))
        if better:
            found = [*found, better(runs[-1], runs[-2])]
        if len(found) > 1:
            change = abs(found[-1].impulse - found[-2].impulse)
        if change <= tolerance * abs(found[-1].impulse):
            return found[-1], float(change)
    raise InputError(
        f"tolerance: {tolerance:g} is not met, the last time the impulse changed by {change:.2g} of "
        f"{found[-1].impulse:.4g} N s: raise it; or the collision hangs on a hair, as where contact nearly "
        "ends, or a board nearly breaks"
    )
