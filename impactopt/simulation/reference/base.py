"""What the reference models share: gains, friction, step, and the search for a step that is short enough."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from impactopt.collision.effects import Effects, JointFriction
from impactopt.collision.interface import CollisionModel
from impactopt.collision.result import Collision
from impactopt.collision.settings import Settings, no_bend, servo_settings
from impactopt.errors import InputError, check_array
from impactopt.robots.robot import Robot
from impactopt.simulation.pinocchio_robot import DenseBody
from impactopt.simulation.reference.forces import Forces

__all__ = ["ReferenceModel", "converge"]

Array = NDArray[np.float64]
_MOST_HALVINGS = 8


@dataclass(frozen=True, kw_only=True, eq=False)
class ReferenceModel(CollisionModel):
    """A collision with nothing frozen, integrated in steps of a given length.

    Attributes
    ----------
    friction : of the joints.
    kp, kd : (n) or (n, n) gains in place of the robot's.
    step : [s] of the integration.
    """

    # step times the fastest rate, up to which its integrator is stable
    _stable: ClassVar[float]

    friction: JointFriction | None = None
    kp: ArrayLike | None = None
    kd: ArrayLike | None = None
    step: float = 5e-5

    def __post_init__(self) -> None:
        super().__post_init__()
        if not check_array("step [s]", self.step, ()) > 0:
            raise InputError(f"step [s]: {self.step:g}; give a number > 0")
        self._settings(self.kp, self.kd)

    @abstractmethod
    def _run(self, step: float, q: Array, v: Array, forces: Forces, normal: Array) -> Collision:
        """The collision in steps of that length [s], from checked numbers."""

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
        InputError : wrong shapes or NaN; torque missing; unknown overrides; a step too long for the servo's
            fastest mode; a contact that does not end.
        """
        return self._collide(self.step, q, v, torque, require_separation, overrides)

    def converged(
        self,
        q: ArrayLike,
        v: ArrayLike,
        torque: ArrayLike | None = None,
        *,
        tolerance: float = 1e-6,
        require_separation: bool = True,
        **overrides: ArrayLike,
    ) -> tuple[Collision, float]:
        """(the collision with its step halved until halving changes the impulse by less than `tolerance`,
        relative; the last change [N s]).

        Raises
        ------
        InputError : as of `collide`; no convergence after eight halvings.
        """

        def at(step: float) -> Collision:
            return self._collide(step, q, v, torque, require_separation, overrides)

        return converge(self.step, at, tolerance)

    def _collide(
        self,
        step: float,
        q: ArrayLike,
        v: ArrayLike,
        torque: ArrayLike | None,
        require_separation: bool,
        overrides: Mapping[str, ArrayLike],
    ) -> Collision:
        q, v = self.robot.check_configuration(q), self.robot.check_velocity(v)
        forces, normal = self._forces(v, torque, overrides)
        self._check_step(step, q, v, forces, normal)
        result = self._run(step, q, v, forces, normal)
        if require_separation:
            self.check_separation(result)
        return result

    @property
    def _held(self) -> tuple[Robot, tuple[str, ...], Array, str]:
        """Robot, held frames, their compliance, and striking frame."""
        robot, held_by = self.robot, self.held_by
        striker = robot.striker(self.striker).model_frame
        return robot, held_by.constraint_frames(robot), held_by.compliance, striker

    def _check_step(self, step: float, q: Array, v: Array, forces: Forces, normal: Array) -> None:
        """InputError for a step beyond what the servo and the friction's band allow."""
        body = DenseBody(*self._held, normal)
        body.look(q, v)
        damping = np.diag(forces.kd) if forces.kd.ndim == 1 else forces.kd
        rate = body.fastest_rate(damping + np.diag(forces.viscous + forces.coulomb / forces.transition))
        self.check_step(step, self._stable / rate if rate > 0 else np.inf)

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


def converge(
    step: float,
    at: Callable[[float], Collision],
    tolerance: float,
    better: Callable[[Collision, Collision], Collision] | None = None,
) -> tuple[Collision, float]:
    """(result, last change of its impulse [N s]) with the step halved until that is within a tolerance.

    step : [s] the longest.
    at : the collision in such steps.
    better : makes the result of collisions with a step and with twice that step; None: the first of them.
    """
    if not check_array("tolerance", tolerance, ()) > 0:
        raise InputError(f"tolerance: {tolerance:g}; give a number > 0")
    runs: list[Collision] = [at(step)]
    found: list[Collision] = []
    change = np.inf
    for _ in range(_MOST_HALVINGS):
        step /= 2
        runs.append(at(step))
        found = runs if better is None else [*found, better(runs[-1], runs[-2])]
        if len(found) > 1:
            change = abs(found[-1].impulse - found[-2].impulse)
        if change <= tolerance * abs(found[-1].impulse):
            return found[-1], float(change)
    raise InputError(
        f"tolerance: {tolerance:g} is not met with steps of {step:.2g} s (the last halving changed the "
        f"impulse by {change:.2g} N s): raise it"
    )
