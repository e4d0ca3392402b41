"""Stances: soles and hands that are fixed, exactly or by the paper's virtual base, or a fixed base.

The virtual base (paper, eqs. 1-4) adds a mass M_g and an inertia I_g E to each fixed sole. This is equivalent
to a constraint with the compliances 1/M_g and 1/I_g on the diagonal of its inverse inertia J H^-1 J^T, which
avoids the rounding errors of huge masses in H. M_g to infinity is the exact constraint.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from impactopt.errors import InputError, check_array, check_kind
from impactopt.robots.robot import Robot, Sole, Striker

USUAL_POSTURE = "half_sitting"  # name of the start posture where none is given


class Stance(ABC):
    """Base class of stances: frames of the robot that are fixed to the world."""

    @abstractmethod
    def soles(self, robot: Robot) -> tuple[Sole, ...]:
        """Fixed soles, in the robot's order; InputError if the robot cannot stand like this."""

    def sole_names(self, robot: Robot) -> tuple[str, ...]:
        """Names of the fixed soles."""
        return tuple(sole.name for sole in self.soles(robot))

    def sole_frames(self, robot: Robot) -> tuple[str, ...]:
        """Frames of the fixed soles."""
        return tuple(sole.frame for sole in self.soles(robot))

    def held_hands(self, robot: Robot) -> tuple[Striker, ...]:
        """Supporting hands; InputError for an unknown one."""
        return ()

    def hand_frames(self, robot: Robot) -> tuple[str, ...]:
        """Frames of the supporting hands; InputError for an unknown one."""
        return tuple(hand.model_frame for hand in self.held_hands(robot))

    def constraint_frames(self, robot: Robot) -> tuple[str, ...]:
        """Frames of the model that are fixed in all six directions: soles first, then hands."""
        return self.sole_frames(robot) + self.hand_frames(robot)

    @property
    def compliance(self) -> NDArray[np.float64]:
        """Compliance (6,) of each fixed frame in world axes, acceleration over force.

        [1/kg] in translation, [1/(kg m2)] in rotation.
        """
        return np.zeros(6)


@dataclass(frozen=True, kw_only=True)
class _OnSoles(Stance):
    """Fixed soles, and hands that support the robot; exactly, or by a virtual base.

    Attributes
    ----------
    base_mass, base_inertia : M_g [kg] and I_g [kg m2] added to each fixed sole and hand (paper, eqs. 1, 2);
        None: exact.
    hands : names of strikers with which the robot holds on to the world, in all six directions (paper,
        section II-A).

    Raises
    ------
    InputError : one of the two is missing, or is not a positive number.
    """

    base_mass: float | None = None
    base_inertia: float | None = None
    hands: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.hands, (tuple, list)) or len(set(self.hands)) != len(self.hands):
            raise InputError(f"hands: {self.hands!r}; give a tuple of strikers' names, each once")
        object.__setattr__(self, "hands", tuple(self.hands))
        if (self.base_mass is None) != (self.base_inertia is None):
            raise InputError(
                "virtual base: give both base_mass [kg] and base_inertia [kg m2], or neither (exact)"
            )
        for name, value in (("base_mass [kg]", self.base_mass), ("base_inertia [kg m2]", self.base_inertia)):
            if value is not None and not check_array(f"virtual base: {name}", value, ()) > 0:
                raise InputError(
                    f"virtual base: {name}: {value:g}; give a number > 0, or None for exactly fixed soles"
                )

    def held_hands(self, robot: Robot) -> tuple[Striker, ...]:
        return tuple(robot.striker(name) for name in self.hands)

    @property
    def compliance(self) -> NDArray[np.float64]:
        if self.base_mass is None or self.base_inertia is None:
            return np.zeros(6)
        return np.array([1.0 / self.base_mass] * 3 + [1.0 / self.base_inertia] * 3)


@dataclass(frozen=True, kw_only=True)
class BothSoles(_OnSoles):
    """All soles of the robot are fixed."""

    def soles(self, robot: Robot) -> tuple[Sole, ...]:
        _check_floating(robot)
        if not robot.soles:
            raise InputError(f"robot {robot.name!r} has no soles to stand on; give it some (Robot's soles=)")
        return tuple(robot.soles)


@dataclass(frozen=True, kw_only=True)
class OneSole(_OnSoles):
    """One sole, given by its name, is fixed; the others are free."""

    name: str = field(kw_only=False)

    def soles(self, robot: Robot) -> tuple[Sole, ...]:
        _check_floating(robot)
        return (robot.sole(self.name),)


@dataclass(frozen=True, kw_only=True)
class FixedBase(Stance):
    """Root link fixed to the ground: for robots without a free-flyer."""

    def soles(self, robot: Robot) -> tuple[Sole, ...]:
        if robot.floating:
            raise InputError(
                f"robot {robot.name!r} has a free-flyer: give stance=BothSoles() or OneSole(name), "
                "or build it with floating=False"
            )
        return ()


@dataclass(frozen=True, kw_only=True)
class Free(Stance):
    """Free-floating robot, such as one in space or in flight.

    The joints' reaction, gravity and the impact move its base.
    """

    def soles(self, robot: Robot) -> tuple[Sole, ...]:
        _check_floating(robot)
        return ()


def stance_of(robot: Robot, stance: Stance | None) -> Stance:
    """The stance; None: both soles of a robot with a free-flyer, else its fixed base.

    Raises
    ------
    InputError : no robot, or no stance.
    """
    check_kind("robot", robot, Robot)
    if stance is None:
        return BothSoles() if robot.floating else FixedBase()
    check_kind("stance", stance, Stance)
    return stance


def _check_floating(robot: Robot) -> None:
    if not robot.floating:
        raise InputError(
            f"robot {robot.name!r} has a fixed base: give stance=FixedBase(), or build it with floating=True"
        )
