"""Interface of the collision models, from the point mass to full dynamics, and the result of a collision."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from impactopt.arrays import Array
from impactopt.collision.outputs import HISTORIES, OUTPUTS, SCALARS
from impactopt.contact import ContactLaw, Target
from impactopt.errors import InputError, check_direction, check_positive
from impactopt.kinematics.stance import Stance, stance_of
from impactopt.robots.robot import Robot


@dataclass(frozen=True, kw_only=True, eq=False)
class Collision:
    """Result of a collision from contact to separation.

    Histories have k entries, at the steps; the first is at contact, the last at separation.

    Attributes
    ----------
    impulse : [N s] delivered to the target.
    peak_force : [N] largest contact force; of 'rk4' at the steps; infinite of a rigid impact.
    duration : [s] from contact to separation.
    energy : [J] given to the target, without the work of a board's damping.
    separated : whether the contact ended within the horizon.
    velocity : (nv) Pinocchio's v after the collision.
    configuration : (nq) Pinocchio's q after the collision.
    target_result : results of the target at separation, by the names in its `results`.
    tangential_velocity : (3) [m/s] of a target that friction moves, across the normal at separation; else
        None.
    time : (k) [s] since contact.
    force : (k) [N] on the target along the normal.
    penetration : (k) [m] of the contact law.
    hand_speed, target_speed : (k) [m/s] along the normal.
    joint_velocity : (k, n) [rad/s].
    torque, demand : (k, n) [N m] of the servo, after and before saturation. These, the joint velocities and
        all wrenches are None of a point mass and a rigid impact.
    sole_wrench : (k, soles, 6) [N, N m] of the ground on each fixed sole, world axes, at the sole's frame;
        in the stance's order of soles. None on a fixed base. Without `Effects.bias` they lack what carries
        the weight, which ground_wrench and zmp have.
    hand_wrench : (k, hands, 6) [N, N m] of the world on each supporting hand, world axes, at its striking
        point; in the stance's order of hands. None without supporting hands.
    ground_wrench : (k, 6) [N, N m] of the ground on the robot, world axes, about the world's origin; None
        on a fixed base.
    zmp : (k, 2) [m] x and y of the zero-moment point on the ground z = 0; None on a fixed base.
    freeze_error : estimated relative error of the impulse by freezing, from the same collision frozen more
        often (see `SDC`): infinite if that does not end by the horizon; 0 if nothing is frozen, nan if it is
        not estimated, as of a point mass.
    caution : advice if freeze_error is above the required accuracy of the model; else "".
    """

    impulse: float
    peak_force: float
    duration: float
    energy: float
    separated: bool
    velocity: Array
    configuration: Array
    target_result: dict[str, float]
    time: Array
    force: Array
    penetration: Array
    hand_speed: Array
    target_speed: Array
    joint_velocity: Array | None = None
    torque: Array | None = None
    demand: Array | None = None
    sole_wrench: Array | None = None
    hand_wrench: Array | None = None
    ground_wrench: Array | None = None
    zmp: Array | None = None
    tangential_velocity: Array | None = None
    freeze_error: float = np.nan
    caution: str = ""

    def __repr__(self) -> str:
        """One line without arrays, which would fill pages."""
        end = "" if self.separated else ", not separated"
        size = f"{self.impulse:.4g} N s, {self.peak_force:.4g} N, {1e3 * self.duration:.4g} ms"
        return f"<Collision: {size}{end}>"

    @classmethod
    def from_outputs(cls, found: dict[str, Array], target: Target) -> Collision:
        """Makes a result from the arrays of a collision function.

        Instants that repeat the one before are left out, and `step_error`, which serves to check a result.
        """
        time = found["time"].ravel()
        kept = np.concatenate([[True], np.diff(time) > 0])
        out: dict[str, Any] = {}
        for name, value in found.items():
            if name == "step_error":
                continue
            if name in HISTORIES:
                columns = value.T if value.shape == (time.size, 1) else value
                history = np.ascontiguousarray(columns[:, kept].T)
                out[name] = history.ravel() if OUTPUTS[name].startswith("(k)") else history
            else:
                out[name] = float(value.item()) if name in SCALARS else value.ravel()
        out["separated"] = bool(round(out["separated"]))
        given = out.pop("target_result", np.zeros(0))
        out["target_result"] = dict(zip(target.results, map(float, given), strict=True))
        for name in {"sole_wrench", "hand_wrench"} & {*out}:
            out[name] = out[name].reshape(int(kept.sum()), -1, 6)
        return cls(**out)


@dataclass(frozen=True, kw_only=True, eq=False)
class CollisionModel(ABC):
    """A model of the collision of a robot with a target, from contact to the first separation.

    The servo follows a reference that continues at the joint velocity at contact, unless the setting
    `reference` gives another one. With constant joint velocities, moving legs would not keep their soles in
    place. A plan's reference does; `impactopt.coasting_reference` gives it. The spring of a soft grip has a
    fixed angle of rest, and its torque at contact is in the feed-forward; `SDC` refuses a grip that moves.

    Attributes
    ----------
    robot : with servo gains kp, kd and torque limits.
    striker : name of the robot's striking point.
    normal : (3,) unit vector along which the target is hit and moves, world axes.
    law, target : contact law, and target.
    stance : constraints of the robot; None: all soles, or the fixed base.
    horizon : [s] time by which the contact should end.

    Raises
    ------
    InputError : an unknown striker; a normal that is not a unit vector; a stance the robot cannot take; a
        horizon that is not positive.
    """

    robot: Robot
    striker: str
    normal: ArrayLike
    law: ContactLaw
    target: Target
    stance: Stance | None = None
    horizon: float = 0.2

    def __post_init__(self) -> None:
        held = self.held_by.constraint_frames(self.robot)
        if self.robot.striker(self.striker).model_frame in held:
            raise InputError(f"striker {self.striker!r}: it is held by the stance; strike with another")
        object.__setattr__(self, "normal", check_direction("normal", self.normal))
        check_positive("horizon [s]", self.horizon)

    @property
    def held_by(self) -> Stance:
        """The stance, or the robot's default one."""
        return stance_of(self.robot, self.stance)

    @staticmethod
    def check_separation(result: Collision) -> None:
        """InputError if the contact has not ended."""
        if not result.separated:
            raise InputError(
                f"horizon [s]: the contact has not ended after {result.duration:.3g} s: raise the horizon, "
                "or pass require_separation=False for what happened so far"
            )

    @abstractmethod
    def collide(
        self,
        q: ArrayLike,
        v: ArrayLike,
        torque: ArrayLike | None = None,
        *,
        require_separation: bool = True,
        **overrides: ArrayLike,
    ) -> Collision:
        """One collision, evaluated numerically.

        Parameters
        ----------
        q, v : (nq), (nv) at contact, Pinocchio's; constrained frames should be at rest.
        torque : (n) [N m] feed-forward; ignored by models without it.
        require_separation : refuse a contact that has not ended at the horizon.
        overrides : values in the place of the default settings, by name (see `SDC.settings`).

        Raises
        ------
        InputError : wrong shapes or NaN; a torque that the model needs and does not get; unknown settings; a
            contact that does not end.
        """
