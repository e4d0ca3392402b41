"""Servo, joint friction, contact and target as numbers, in the phases between which they are smooth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from impactopt.contact import ContactLaw, Target

__all__ = ["Forces", "Phase"]

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
