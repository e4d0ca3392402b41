"""Base of the reference models: gains, friction, tolerance, and the search for the step that meets it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from impactopt.collision.interface import Collision, CollisionModel
from impactopt.collision.settings import Effects, JointFriction, Settings, constant_reference, servo_settings
from impactopt.contact import ContactFriction, ContactLaw, Target
from impactopt.contact.friction import check_friction
from impactopt.errors import InputError, check_array, check_positive
from impactopt.robots.robot import Robot

__all__ = ["Forces", "Phase", "ReferenceModel", "converge"]

Array = NDArray[np.float64]


class Phase(NamedTuple):
    """Branch of each law of force, on which it is smooth.

    touching, compressing : of the contact.
    saturated, sliding : (n) -1, 0 or 1: at which torque limit, or in which direction out of the friction's
        transition band.
    switches : signs of the target's.
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
    law, target : with their numbers `law_numbers`, `target_numbers`.
    kp, kd : (n) or (n, n) gains of the servo.
    limit : (n) [N m].
    viscous, coulomb, transition : joint friction, as of `JointFriction`.
    feedforward, velocity : (n) [N m]; (n) [rad/s] at contact, at which the reference coasts.
    reference, reference_until : (n, k) [rad/s^(k + 1)]; [s], what its joint velocities gain; see `Settings`.
    """

    law: ContactLaw
    target: Target
    law_numbers: Mapping[str, Any]
    target_numbers: Mapping[str, Any]
    kp: Array
    kd: Array
    limit: Array
    viscous: Array
    coulomb: Array
    transition: float
    feedforward: Array
    velocity: Array
    reference: Array
    reference_until: float

    # ------------------------------------------------------------ joints
    def demand(self, time: float, moved: Array, velocity: Array) -> Array:
        """Torque (n) [N m] of the servo before saturation; `moved` are the angles (n) [rad] since contact."""
        t, powers = min(time, self.reference_until), np.arange(1, self.reference.shape[1] + 1)
        gained = self.reference * t**powers
        further = gained @ (t / (powers + 1) + (time - t))
        behind = self.velocity + gained.sum(axis=1) - velocity
        deviation = self.velocity * time + further - moved
        return self.feedforward + _times(self.kp, deviation) + _times(self.kd, behind)

    def torque(self, demand: Array, phase: Phase) -> Array:
        return np.where(phase.saturated == 0, demand, phase.saturated * self.limit)

    def friction(self, velocity: Array, phase: Phase) -> Array:
        sign = np.where(phase.sliding == 0, velocity / self.transition, phase.sliding)
        return self.viscous * velocity + self.coulomb * sign

    # ------------------------------------------------------------ contact
    def target_speed(self, state: Array) -> float:
        return float(self.target.velocity(state, self.target_numbers))

    def contact(self, penetration: float, rate: float, compressing: bool) -> float:
        """Force [N] of one branch of the law."""
        return float(self.law.branch(penetration, rate, compressing, self.law_numbers))

    def contact_slopes(
        self, penetration: float, rate: float, compressing: bool, way: float, speed: float
    ) -> tuple[float, float]:
        """Stiffness [N/m] and damping [N s/m] of one branch of the law, by differences of that size."""
        here = self.contact(penetration, rate, compressing)
        deeper = self.contact(penetration + way, rate, compressing)
        faster = self.contact(penetration, rate + speed, compressing)
        return (deeper - here) / way, (faster - here) / speed

    def switches(self, state: Array, force: float) -> Array:
        return np.array(self.target.switches(state, force, self.target_numbers), dtype=float)

    def target_rates(self, state: Array, force: float) -> list[Any]:
        return self.target.derivative(state, force, self.target_numbers)

    # ------------------------------------------------------------ phases
    def phase(self, demand: Array, velocity: Array, penetration: float, rate: float, target: Array) -> Phase:
        """The phase of a state. Contact is over when, in restitution, no force is left."""
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
        """Numbers of which none is negative as long as servo, friction and contact are in `phase`."""
        saturated, sliding = phase.saturated, phase.sliding
        out = [np.where(saturated == 0, self.limit - np.abs(demand), saturated * demand - self.limit)]
        if self.coulomb.any():
            band = self.transition
            out.append(np.where(sliding == 0, band - np.abs(velocity), sliding * velocity - band))
        if phase.compressing:
            return np.concatenate([*out, [rate]])
        force = self.contact(penetration, rate, False)
        if force <= 0:
            # a law may be flat at zero beyond separation
            force = min(force, penetration, -1e-12)
        return np.concatenate([*out, [-rate, force]])


def _times(gain: Array, x: Array) -> Array:
    return gain * x if gain.ndim == 1 else gain @ x


Outcome = TypeVar("Outcome", bound="_HasImpulse")


@dataclass(frozen=True, kw_only=True, eq=False)
class ReferenceModel(CollisionModel):
    """A collision with nothing frozen, integrated until its impulse is known within a tolerance.

    Attributes
    ----------
    friction : of the joints.  contact_friction : of the striking point on the target.
    kp, kd : (n) or (n, n) gains in place of the robot's.
    step : [s] the longest.
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
        check_friction("contact_friction", self.contact_friction)
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
        tolerance = check_positive("tolerance", self.tolerance if tolerance is None else tolerance)
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
        servo |= constant_reference(self.robot.n)  # with friction too
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
