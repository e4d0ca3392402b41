"""Rigid impact of the constrained robot, with a coefficient of restitution and without duration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from impactopt.arrays import Array
from impactopt.collision.interface import Collision, CollisionModel
from impactopt.contact import FreeMass, RigidWall
from impactopt.errors import InputError, check_array, check_choice, check_number
from impactopt.kinematics.operational_space import ConstrainedDynamics

MIN_MOBILITY = 1e-12  # [1/kg] of hand and target together; with less, rounding decides about the impulse


@dataclass(frozen=True, kw_only=True, eq=False)
class RigidImpact(CollisionModel):
    """Newton's law of restitution along the normal between robot and target, at constant positions.

    With P the inverse inertia of the constrained robot, v_c the speed of approach and m_t the target's mass,

        I = (1 + e) v_c / (n' J P J' n + 1 / m_t),      v+ = v - P J' n I.

    Finite forces have no effect without duration: servo, gravity and the contact law are not in the model,
    and torques, sole wrenches and ZMP are None in its results. The peak force is infinite.

    Attributes
    ----------
    coefficient_of_restitution : e, speed of separation over speed of approach: 0, plastic, to 1, elastic.
    law : not used; as an argument of all models.

    Others, and errors, as of `CollisionModel`; also

    Raises
    ------
    InputError : a coefficient outside [0, 1]; a target that is neither a free mass nor a wall.
    """

    law: Any = None
    coefficient_of_restitution: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        e = check_number("coefficient_of_restitution", self.coefficient_of_restitution)
        if not 0 <= e <= 1:
            raise InputError(f"coefficient_of_restitution must be between 0 and 1, not {e:g}")
        if not isinstance(self.target, (FreeMass, RigidWall)):
            raise InputError(
                f"a rigid impact knows the targets FreeMass and RigidWall only, not "
                f"{type(self.target).__name__}: take another model"
            )

    @property
    def settings(self) -> dict[str, Any]:
        """Parameters that `collide` can override: those of the target, such as ``target_mass``."""
        return {f"target_{name}": value for name, value in self.target.parameters.items()}

    def _by_unit_impulse(self, q: Array) -> tuple[Array, Array]:
        """Jacobian n' J (nv,), and P J' n (nv,), the decrease of velocity by a unit impulse."""
        frames = self.held_by.constraint_frames(self.robot)
        body = ConstrainedDynamics.at(
            self.robot.model, q, frames, self.robot.striker(self.striker).model_frame
        )
        hand = np.asarray(self.normal) @ body.hand
        compliance = np.tile(self.held_by.compliance, len(frames))
        return hand, body.by_impulses(hand[None], compliance)[:, 0]

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
        for name in overrides:
            check_choice("there is no setting", name, self.settings)
        changes = {n.removeprefix("target_"): float(check_array(n, x, ())) for n, x in overrides.items()}
        target = type(self.target)(**{**self.target.parameters, **changes})  # which checks the numbers
        numbers, state = target.parameters, np.zeros(target.n_states)
        before = float(target.velocity(state, numbers))
        hand, change = self._by_unit_impulse(q)
        speed, inverse_mass = float(hand @ v), float(hand @ change)
        # change of the target's state, and of its velocity [1/kg], by a unit impulse
        # both targets are linear in the force, so a unit force for a unit of time is a unit impulse
        gain = np.array(target.derivative(state, 1.0, numbers), dtype=float)
        # the velocity is linear in the state, with `before` at zero
        of_target = float(target.velocity(gain, numbers)) - before
        e = self.coefficient_of_restitution
        if not inverse_mass + of_target > MIN_MOBILITY:
            raise InputError(
                "q: the held frames leave the striking point no motion along the normal here, and a wall has "
                "none either; bend the arm, or turn the normal"
            )
        # a hand that does not approach does not hit
        impulse = max((1 + e) * (speed - before) / (inverse_mass + of_target), 0.0)
        after, state = v - change * impulse, gain * impulse
        values = target.result(state, numbers)
        at = np.zeros(1)
        return Collision(
            impulse=impulse,
            peak_force=np.inf if impulse else 0.0,
            duration=0.0,
            energy=float(target.energy(state, numbers)),
            separated=True,
            velocity=after,
            configuration=q,
            target_result=dict(zip(target.results, map(float, values), strict=True)),
            time=at,
            force=at,
            penetration=at,
            hand_speed=np.array([speed - inverse_mass * impulse]),
            target_speed=np.array([float(target.velocity(state, numbers))]),
        )
