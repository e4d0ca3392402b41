"""Interface of all collision models, from the point mass to full dynamics."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from numpy.typing import ArrayLike

from impactopt.collision.result import Collision
from impactopt.contact import ContactLaw, Target
from impactopt.errors import InputError, check_array, check_direction
from impactopt.kinematics.stance import Stance, usual_stance
from impactopt.robots.robot import Robot

__all__ = ["CollisionModel"]


@dataclass(frozen=True, kw_only=True, eq=False)
class CollisionModel(ABC):
    """A robot hits a target: what both do from contact to separation.

    The servo follows a reference that goes on at the joint velocity at contact, unless the setting
    `reference` says otherwise. With such a reference, legs that move do not keep their soles in place. A
    plan's reference does; `impactopt.coasting_reference` gives it. The collision ends at the first
    separation.

    Attributes
    ----------
    robot : with servo gains kp, kd and torque limits.
    striker : name of the robot's striking point.
    normal : (3,) unit vector along the blow, world axes; the target moves along it.
    law, target : contact law, and what is hit.
    stance : what holds the robot; None: all soles, or the fixed base.
    horizon : [s] the contact should end before this.

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
        frame = self.robot.striker(self.striker).model_frame
        if frame in self.held_by.constraint_frames(self.robot):
            raise InputError(f"striker {self.striker!r}: it is held by the stance; strike with another")
        object.__setattr__(self, "normal", check_direction("normal", self.normal))
        if not check_array("horizon [s]", self.horizon, ()) > 0:
            raise InputError(f"horizon [s]: {self.horizon:g}; give a number > 0")

    @property
    def held_by(self) -> Stance:
        """The stance, or the robot's usual one."""
        return usual_stance(self.robot) if self.stance is None else self.stance

    # ------------------------------------------------------------ what all of them refuse
    def check_step(self, step: float, longest: float, where: str = "here") -> None:
        """InputError for a step [s] that is not below the longest stable one."""
        if step >= longest:
            raise InputError(
                f"step [s]: {step:g} is unstable {where}, where the fastest mode allows {longest:.2g}: give "
                f"{type(self).__name__} a step below that, or the joints less kd or more armature"
            )

    @staticmethod
    def check_separation(result: Collision) -> None:
        """InputError for a contact that has not ended."""
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
        """One collision, in numbers.

        Parameters
        ----------
        q, v : (nq), (nv) at contact, Pinocchio's; v should leave what is held at rest.
        torque : (n) [N m] feed-forward; a model that has none in it does not use it.
        require_separation : refuse a contact that has not ended at the horizon.
        overrides : numbers other than the defaults, by name (see `SDC.settings`).

        Raises
        ------
        InputError : wrong shapes or NaN; a torque that the model needs and does not get; unknown settings; a
            contact that does not end.
        """
