"""Situations in which collision models are compared: the paper's nine motions.

They are three postures, whose virtual masses are 4, 6 and 8 kg, at three speeds (its Table I). It does not
give the postures; `posture_of_effective_mass` finds some by optimization.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from impactopt.collision import Collision, CollisionModel, effective_mass
from impactopt.errors import check_array
from impactopt.kinematics.operational_space import holding_torque, striking_velocity
from impactopt.kinematics.stance import BothSoles
from impactopt.robots.robot import Robot
from impactopt.simulation.cases import posture_of_effective_mass

Array = NDArray[np.float64]

PAPER_MASSES = {"A": 4.0, "B": 6.0, "C": 8.0}  # [kg] by the motions' letters (paper, Table I)
PAPER_SPEEDS = (0.4, 0.7, 1.0)  # [m/s] of the motions 1, 2, 3


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """A robot at the moment of contact.

    Attributes
    ----------
    robot : what strikes.
    name : of the motion, such as "A-1".
    striker : name of the robot's striking point.
    normal : (3,) unit vector along the blow, world axes.
    q, v : (nq), (nv) at contact, Pinocchio's.
    torque : (n) [N m] feed-forward.
    effective_mass : [kg] along the normal.
    speed : [m/s] of the striking point along the normal.
    overrides : numbers of the collision other than the model's, by name, as of `CollisionModel.collide`; of
        those, a model is given the ones that it has.
    """

    robot: Robot
    name: str
    striker: str
    normal: Array
    q: Array
    v: Array
    torque: Array
    effective_mass: float
    speed: float
    overrides: Mapping[str, ArrayLike] = field(default_factory=dict)

    def collide(self, model: CollisionModel, *, require_separation: bool = False) -> Collision:
        """What a model says of it; a contact may outlast the horizon.

        Raises
        ------
        InputError : as of `CollisionModel.collide`.
        """
        # a point mass has no servo, and the paper's SDC no stiffness
        known = getattr(model, "settings", self.overrides)
        given = {name: value for name, value in self.overrides.items() if name in known}
        return model.collide(self.q, self.v, self.torque, require_separation=require_separation, **given)


def paper_motions(
    robot: Robot,
    *,
    striker: str = "right_hand",
    normal: ArrayLike = (1.0, 0.0, 0.0),
    masses: Mapping[str, float] = PAPER_MASSES,
    speeds: Sequence[float] = PAPER_SPEEDS,
) -> list[Case]:
    """The paper's nine motions, A-1 to C-3 (its Table I), on a robot that stands on both soles.

    Velocities are those of `striking_velocity`, torques those of `holding_torque`.

    Raises
    ------
    InputError : as of `posture_of_effective_mass` and `striking_velocity`.
    """
    n, stance = check_array("normal", normal, (3,)), BothSoles()
    mass = effective_mass(robot, striker=striker, normal=n, stance=stance)
    postures = {
        letter: posture_of_effective_mass(robot, wanted, striker, n, stance=stance)
        for letter, wanted in masses.items()
    }
    cases = []
    for (letter, q), (k, speed) in product(postures.items(), enumerate(speeds, 1)):
        v = striking_velocity(robot, q, striker, n, speed, stance=stance)
        cases.append(
            Case(
                robot=robot,
                name=f"{letter}-{k}",
                striker=striker,
                normal=n,
                q=q,
                v=v,
                torque=holding_torque(robot, q, v, stance=stance),
                effective_mass=float(mass(q)),
                speed=float(speed),
            )
        )
    return cases
