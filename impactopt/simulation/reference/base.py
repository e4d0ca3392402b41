"""Base class of the reference models: forces, tolerance, and refinement until the impulse converges."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from impactopt.arrays import Array, Mask
from impactopt.collision.interface import Collision, CollisionModel
from impactopt.collision.settings import Effects, JointFriction, Settings, constant_reference, servo_settings
from impactopt.contact import ContactFriction, ContactLaw, Target
from impactopt.contact.friction import check_friction, tangential_mobility
from impactopt.errors import InputError, check_array, check_kind, check_positive
from impactopt.robots.robot import Robot


class Phase(NamedTuple):
    """Active branch of each piecewise smooth force law.

    touching, compressing : of the contact.
    saturated (n,) : -1 or 1 at a torque limit, else 0.
    sliding (n,) : -1 or 1 outside the friction's transition band, else 0.
    switches : signs of the target's switches.
    """

    touching: bool
    compressing: bool
    saturated: Array
    sliding: Array
    switches: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Forces:
    """Forces on joints, hand and target (paper, eqs. 5, 10, 12, 17).

    Attributes
    ----------
    law, target : with their parameters `law_parameters`, `target_parameters`.
    kp, kd : (n,) or (n, n) gains of the servo.
    limit : (n,) [N m].
    viscous, coulomb, transition : joint friction, as in `JointFriction`.
    feedforward : (n,) [N m].
    velocity : (n,) [rad/s] at contact; the servo's reference starts with it.
    sprung : (n,) mask of soft grips, whose reference is their spring's angle of rest.
    mobility : [1/kg] of the target across the normal, see `tangential_mobility`.
    reference, reference_until : (n, k) [rad/s^(k + 1)], [s]: polynomial by which the reference's joint
        velocities change; see `Settings`.
    """

    law: ContactLaw
    target: Target
    law_parameters: Mapping[str, Any]
    target_parameters: Mapping[str, Any]
    kp: Array
    kd: Array
    limit: Array
    viscous: Array
    coulomb: Array
    transition: float
    feedforward: Array
    velocity: Array
    sprung: Mask
    reference: Array
    reference_until: float
    mobility: float

    # ------------------------------------------------------------ joints
    @cached_property
    def _changes(self) -> bool:
        """True if the reference's velocity changes."""
        return bool(self.reference.any())

    def demand(self, time: float, moved: Array, velocity: Array) -> Array:
        """Torque (n,) [N m] of the servo before saturation; `moved`: angles (n,) [rad] since contact."""
        rate_error = self.velocity - velocity
        # an angle of rest does not coast; the damper's torque at contact is in the feed-forward, as in plans
        error = np.where(self.sprung, 0.0, self.velocity) * time - moved
        if self._changes:
            t, powers = min(time, self.reference_until), np.arange(1, self.reference.shape[1] + 1)
            # change of the reference's velocity up to t, after which it is constant, by powers; and its
            # integral; column k: coefficient times t^k, (n, k)
            velocity_change = self.reference * t**powers
            rate_error += velocity_change.sum(axis=1)
            error += velocity_change @ (t / (powers + 1) + (time - t))
        return self.feedforward + _times(self.kp, error) + _times(self.kd, rate_error)

    def torque(self, demand: Array, phase: Phase) -> Array:
        """Torque (n,) [N m] after saturation, by the phase's branches."""
        return np.where(phase.saturated == 0, demand, phase.saturated * self.limit)

    def friction(self, velocity: Array, phase: Phase) -> Array:
        """Friction torque (n,) [N m], by the phase's branches."""
        sign = np.where(phase.sliding == 0, velocity / self.transition, phase.sliding)
        return self.viscous * velocity + self.coulomb * sign

    # ------------------------------------------------------------ contact
    def target_speed(self, state: Array) -> float:
        """Speed [m/s] of the hit surface along the normal."""
        return float(self.target.velocity(state, self.target_parameters))

    def contact(self, penetration: float, rate: float, compressing: bool) -> float:
        """Force [N] of one branch of the law, in compression never below zero, as `ContactLaw.force`."""
        # in restitution a force that falls to zero ends contact
        force = float(self.law.branch(penetration, rate, compressing, self.law_parameters))
        return max(force, 0.0) if compressing else force

    def contact_slopes(
        self, penetration: float, rate: float, compressing: bool, depth: float, speed: float
    ) -> tuple[float, float]:
        """Stiffness [N/m] and damping [N s/m] of one branch of the law, by differences of depth and speed."""
        here = self.contact(penetration, rate, compressing)
        deeper = self.contact(penetration + depth, rate, compressing)
        faster = self.contact(penetration, rate + speed, compressing)
        return (deeper - here) / depth, (faster - here) / speed

    def switches(self, state: Array, force: float) -> Array:
        """Values of the target's switches."""
        return np.array(self.target.switches(state, force, self.target_parameters), dtype=float)

    def target_rates(self, state: Array, force: float) -> list[Any]:
        """Time derivative of the target's state."""
        return self.target.derivative(state, force, self.target_parameters)

    # ------------------------------------------------------------ phases
    def phase(self, demand: Array, velocity: Array, penetration: float, rate: float, target: Array) -> Phase:
        """Phase of a state. Contact ends when, in restitution, the force vanishes."""
        compressing = rate > 0
        force = self.contact(penetration, rate, compressing)
        return Phase(
            touching=compressing or force > 0,
            compressing=compressing,
            saturated=np.where(np.abs(demand) > self.limit, np.sign(demand), 0.0),
            sliding=np.where(np.abs(velocity) > self.transition, np.sign(velocity), 0.0),
            switches=np.sign(self.switches(target, force)),
        )

    def margins(self, phase: Phase, demand: Array, velocity: Array, penetration: float, rate: float) -> Array:
        """Event functions of servo, friction and contact: none is negative during `phase`."""
        saturated, sliding = phase.saturated, phase.sliding
        # distance of each joint's demand from its limit, on its side of it; likewise of the transition band
        out = [np.where(saturated == 0, self.limit - np.abs(demand), saturated * demand - self.limit)]
        if self.coulomb.any():
            band = self.transition
            out.append(np.where(sliding == 0, band - np.abs(velocity), sliding * velocity - band))
        if phase.compressing:  # ends when the rate changes its sign
            return np.concatenate([*out, [rate]])
        # restitution ends when the force vanishes, or the two approach again
        force = self.contact(penetration, rate, False)
        if force <= 0:
            # Beyond separation a law may be constant at zero. A negative value makes it an event all the
            # same.
            force = min(force, penetration, -1e-12)
        return np.concatenate([*out, [-rate, force]])


def _times(gain: Array, x: Array) -> Array:
    return gain * x if gain.ndim == 1 else gain @ x


Outcome = TypeVar("Outcome", bound="_HasImpulse")


@dataclass(frozen=True, kw_only=True, eq=False)
class ReferenceModel(CollisionModel):
    """Collision model without frozen quantities, refined until its impulse converges to a tolerance.

    Attributes
    ----------
    friction : of the joints.
    contact_friction : of the striking point on the target.
    kp, kd : (n,) or (n, n) gains in place of the robot's.
    step : [s] at most.
    tolerance : relative, of the impulse.
    """

    friction: JointFriction | None = None
    contact_friction: ContactFriction | None = None
    kp: ArrayLike | None = None
    kd: ArrayLike | None = None
    step: float = 5e-5
    tolerance: float = 1e-6

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive("step [s]", self.step)
        check_positive("tolerance", self.tolerance)
        if self.friction is not None:
            check_kind("friction", self.friction, JointFriction)
        check_friction("contact_friction", self.contact_friction, self.target)
        self._settings(self.kp, self.kd)

    @abstractmethod
    def _controlled(
        self, q: Array, v: Array, forces: Forces, normal: Array, tolerance: float
    ) -> tuple[Collision, float]:
        """Collision, and uncertainty of its impulse [N s], from checked arguments."""

    def collide(
        self,
        q: ArrayLike,
        v: ArrayLike,
        torque: ArrayLike | None = None,
        *,
        require_separation: bool = True,
        **overrides: ArrayLike,
    ) -> Collision:
        """Simulates one collision, as `CollisionModel.collide`.

        `overrides` are normal, contact_<parameter of the law>, target_<parameter of the target>, kp, kd,
        torque_limit, reference, reference_until, and with friction viscous, coulomb.

        Raises
        ------
        InputError : wrong shapes or NaN; torque missing; unknown overrides; a contact that does not end; an
            impulse that does not converge to the tolerance.
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
        """Collision as in `collide`, and change of its impulse [N s] by the last refinement.

        tolerance : relative, of the impulse; None: the model's.

        Raises
        ------
        InputError : as in `collide`.
        """
        tolerance = check_positive("tolerance", self.tolerance if tolerance is None else tolerance)
        q, v = self.robot.check_configuration(q), self.robot.check_velocity(v)
        forces, normal = self._forces(v, torque, overrides)
        result, change = self._controlled(q, v, forces, normal, tolerance)
        if require_separation:
            self.check_separation(result)
        return result, change

    @property
    def _body_arguments(self) -> tuple[Robot, tuple[str, ...], Array, str]:
        """Robot, fixed frames, their compliance, and striking frame: the first arguments of `Body`."""
        robot, held_by = self.robot, self.held_by
        striker = robot.striker(self.striker).model_frame
        return robot, held_by.constraint_frames(robot), held_by.compliance, striker

    # ------------------------------------------------------------ settings
    def _settings(self, kp: ArrayLike | None, kd: ArrayLike | None) -> Settings:
        effects = Effects(friction=self.friction is not None)
        servo = servo_settings(self.robot, effects, self._friction, kp, kd)
        servo |= constant_reference(self.robot.n)  # with friction too
        return Settings(self.law, self.target, np.asarray(self.normal), servo)

    @property
    def _friction(self) -> JointFriction:
        return self.friction or JointFriction()

    def _forces(
        self, v: Array, torque: ArrayLike | None, overrides: Mapping[str, ArrayLike]
    ) -> tuple[Forces, Array]:
        """Forces with their overridden parameters, and the normal (3,)."""
        n = self.robot.n
        if torque is None:
            raise InputError(
                "torque: give the feed-forward torque (n,) [N m]; `holding_torque` has one that keeps the "
                "robot's velocities, np.zeros(n) is none"
            )
        # overridden gains may have another shape: (n,) or (n, n)
        settings = self._settings(overrides.get("kp", self.kp), overrides.get("kd", self.kd))
        other = {name: x for name, x in overrides.items() if name not in ("kp", "kd")}
        values = settings.override(other)
        zero = np.zeros(n)
        of_target = {name: float(values[f"target_{name}"]) for name in self.target.parameters}
        forces = Forces(
            law=self.law,
            target=self.target,
            law_parameters={name: float(values[f"contact_{name}"]) for name in self.law.parameters},
            target_parameters=of_target,
            kp=values["kp"],
            kd=values["kd"],
            limit=values["torque_limit"],
            viscous=values.get("viscous", zero),
            coulomb=values.get("coulomb", zero),
            transition=self._friction.transition,
            feedforward=check_array("torque [N m]", torque, (n,)),
            velocity=v[-n:],
            sprung=self.robot.sprung,
            reference=values["reference"],
            reference_until=float(values["reference_until"]),
            mobility=tangential_mobility(self.contact_friction, self.target, of_target),
        )
        return forces, values["normal"]


class _HasImpulse(Protocol):
    @property
    def impulse(self) -> float: ...


def converge(
    at: Callable[[int], Outcome],
    tolerance: float,
    *,
    levels: int,
    extrapolate: Callable[[Outcome, Outcome], Outcome] | None = None,
) -> tuple[Outcome, float]:
    """Refines an outcome until the change of its impulse is within a relative tolerance.

    at : computes the outcome of a level of refinement, 0, 1, ...
    levels : number of levels at most.
    extrapolate : makes an outcome of those of a level and of the coarser one before; None: no extrapolation.

    Returns
    -------
    The outcome, and the last change of its impulse [N s].

    Raises
    ------
    InputError : the impulse does not converge.
    """
    runs = [at(0)]
    outcomes = [] if extrapolate else runs
    change = np.inf
    for level in range(1, levels):
        runs.append(at(level))
        if extrapolate:
            outcomes = [*outcomes, extrapolate(runs[-1], runs[-2])]
        if len(outcomes) > 1:
            change = abs(outcomes[-1].impulse - outcomes[-2].impulse)
        if change <= tolerance * abs(outcomes[-1].impulse):
            return outcomes[-1], float(change)
    raise InputError(
        f"tolerance: {tolerance:g} is not met; the last refinement changed the impulse by {change:.2g} of "
        f"{outcomes[-1].impulse:.4g} N s: raise it. Or the collision is close to a bifurcation, as where "
        "contact nearly ends or a board nearly breaks"
    )
