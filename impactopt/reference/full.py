"""Full dynamics of a collision, in numbers: the reference of the simplified models."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..collision.interface import CollisionModel
from ..collision.result import Collision
from ..collision.settings import Settings
from ..collision.terms import JointFriction, Terms
from ..errors import InputError, check_array, did_you_mean
from .bodies import FORMS, DenseBody
from .forces import Forces
from .motion import Instant, Motion
from .record import collision_from

__all__ = ["FullDynamics"]

Array = NDArray[np.float64]
_STABLE = 2.6  # times the fastest rate: where the classical Runge-Kutta method turns unstable, with some room
_MOST_HALVINGS = 8


@dataclass(frozen=True, kw_only=True, eq=False)
class FullDynamics(CollisionModel):
    """A robot hits a target, with nothing frozen: H, J and bias anew at every stage of every step.

    The equations are the paper's (5), (10), (12), (14), (16), (17), integrated by the classical Runge-Kutta
    method with steps that end on events (end of compression, separation, a joint entering or leaving
    saturation or its friction's transition band). It has no derivatives.

    Attributes
    ----------
    friction : of the joints.
    kp, kd : (n) or (n, n) gains in place of the robot's.
    form : "lagrange", the paper's steps 1a to 6a with dense matrices (fig. 2a); or "pinocchio", its
        constrained dynamics along the tree. Their results agree to rounding.
    step : [s] of the integration.

    Raises
    ------
    InputError : as of `CollisionModel`; an unknown form; gains of a wrong shape or sign; a step that is not
        positive.
    """

    friction: JointFriction | None = None
    kp: ArrayLike | None = None
    kd: ArrayLike | None = None
    form: str = "lagrange"
    step: float = 5e-5

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.form not in FORMS:
            raise InputError(
                f"form {self.form!r}{did_you_mean(self.form, FORMS)}; there are {', '.join(FORMS)}"
            )
        if not check_array("step [s]", self.step, ()) > 0:
            raise InputError(f"step [s]: {self.step:g}; give a number > 0")
        for name in ("kp", "kd"):
            given = getattr(self, name)
            object.__setattr__(
                self, name, self._gain(name, getattr(self.robot, name) if given is None else given)
            )
        self._settings()

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
        torque_limit, and with friction viscous, coulomb.

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
        if not check_array("tolerance", tolerance, ()) > 0:
            raise InputError(f"tolerance: {tolerance:g}; give a number > 0")
        step = self.step
        before = self._collide(step, q, v, torque, require_separation, overrides)
        for _ in range(_MOST_HALVINGS):
            step /= 2
            result = self._collide(step, q, v, torque, require_separation, overrides)
            change = abs(result.impulse - before.impulse)
            if change <= tolerance * abs(result.impulse):
                return result, change
            before = result
        raise InputError(
            f"tolerance: {tolerance:g} is not met with steps of {step:.2g} s (the last halving changed the "
            f"impulse by {change:.2g} N s): raise it"
        )

    def _collide(
        self,
        step: float,
        q: ArrayLike,
        v: ArrayLike,
        torque: ArrayLike | None,
        require_separation: bool,
        overrides: dict[str, ArrayLike],
    ) -> Collision:
        q, v = self.robot.check_configuration(q), self.robot.check_velocity(v)
        forces, normal = self._forces(v, torque, overrides)
        robot, held_by = self.robot, self.held_by
        given = (robot, held_by.constraint_frames(robot), held_by.compliance)
        striker = robot.striker(self.striker).model_frame
        _check_step(step, DenseBody(*given, striker, normal), forces, q, v)
        motion = Motion(FORMS[self.form](*given, striker, normal), forces, q, v)
        instants: list[Instant] = []
        with np.errstate(over="ignore", invalid="ignore"):  # a motion that diverges says so itself
            last, separated = motion.run(step, self.horizon, instants.append)
        if require_separation and not separated:
            raise InputError(
                f"horizon [s]: the contact has not ended after {instants[-1].time:.3g} s: raise the horizon, "
                "or pass require_separation=False for what happened so far"
            )
        soles = len(held_by.sole_names(robot))
        return collision_from(instants, last, robot.nv, soles, forces, separated)

    # ------------------------------------------------------------ numbers
    def _settings(self) -> Settings:
        terms = Terms(friction=self.friction is not None)
        friction = self.friction or JointFriction()
        return Settings(self.robot, self.law, self.target, np.asarray(self.normal), terms, friction)

    def _forces(
        self, v: Array, torque: ArrayLike | None, overrides: dict[str, ArrayLike]
    ) -> tuple[Forces, Array]:
        """The forces, and the normal."""
        n = self.robot.n
        if torque is None:
            raise InputError(
                "torque: give the feed-forward torque (n) [N m]; `holding_torque` has one that keeps the "
                "robot's velocities, np.zeros(n) is none"
            )
        gains: dict[str, Any] = {
            name: self._gain(name, overrides[name]) if name in overrides else getattr(self, name)
            for name in ("kp", "kd")
        }
        rest = {name: x for name, x in overrides.items() if name not in gains}
        values = self._settings().override(rest)
        friction = self.friction or JointFriction()
        viscous, coulomb = friction.arrays(n)
        forces = Forces(
            law=self.law,
            target=self.target,
            law_numbers={name: float(values[f"contact_{name}"]) for name in self.law.parameters},
            target_numbers={name: float(values[f"target_{name}"]) for name in self.target.parameters},
            **gains,
            limit=values["torque_limit"],
            viscous=values.get("viscous", viscous),
            coulomb=values.get("coulomb", coulomb),
            transition=friction.transition,
            feedforward=check_array("torque [N m]", torque, (n,)),
            velocity=v[-n:],
        )
        return forces, values["normal"]

    def _gain(self, name: str, value: ArrayLike) -> Array:
        """(n) or (n, n)."""
        n = self.robot.n
        if np.ndim(value) == 0:
            value = np.full(n, value)
        gain = check_array(name, value, (n,) if np.ndim(value) == 1 else (n, n))
        smallest = gain.min() if gain.ndim == 1 else np.linalg.eigvalsh(gain + gain.T).min() / 2
        if smallest < -1e-9 * np.abs(gain).max():
            what = "has" if gain.ndim == 1 else "its symmetric part has the eigenvalue"
            raise InputError(f"{name}: {what} {smallest:g}; all must be >= 0")
        return gain


def _check_step(step: float, body: DenseBody, forces: Forces, q: Array, v: Array) -> None:
    """InputError for a step beyond what the servo and the friction's band allow."""
    body.look(q, v)
    damping = np.diag(forces.kd) if forces.kd.ndim == 1 else forces.kd
    rate = body.fastest_rate(damping + np.diag(forces.viscous + forces.coulomb / forces.transition))
    if step * rate > _STABLE:
        raise InputError(
            f"step [s]: {step:g} is unstable here, where the fastest mode allows {_STABLE / rate:.2g}: "
            "give FullDynamics a step below that, or the joints less kd or more armature"
        )
