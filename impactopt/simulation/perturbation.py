"""Differences between the world of a replay and the planned one."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from impactopt.contact.targets.base import scaled_numbers
from impactopt.errors import FARTHEST, InputError, check_array, check_positive, shortened
from impactopt.simulation.result import Scene

MAX_VALUE = 1e6  # of factors, friction and payload [kg]
MAX_TIME = 10.0  # [s] of period, delay, floor and push: longer than most motions
MIN_PAYLOAD = 1e-6  # [kg] if not 0: MuJoCo takes no body without inertia


@dataclass(frozen=True, kw_only=True)
class Perturbation:
    """Differences of a replay's world from the planned one; by default none, with a floor's friction of 0.9.

    mass : of the target, as a factor of the planned one.
    stiffness, damping : of the contact law, as factors.
    distance [m] : displacement of the target along the normal; < 0: nearer, so that it is hit early.
    missing : there is no target.
    payload [kg] : unplanned point mass at the striking point.
    friction : coefficient between soles and floor.
    floor_time [s] : time constant of the floor's contact (MuJoCo's solref), which sets the softness of floor
        and soles: a sole sinks in proportion to its square. MuJoCo takes at least two steps.
    kp, kd, torque_limit : of the servo, as factors of the robot's.
    period [s] : sampling period of the servo, which holds its torques between samples; 0: it samples in every
        step of the simulation.
    delay [s] : from reading the joints to setting the torque. Period and delay are rounded to steps. With a
        whole-body controller 0 stands for the controller's own.
    push [N] : horizontal force on the base, from push_start [s] for push_time [s], at an angle push_way [rad]
        from x.

    Raises
    ------
    InputError : a value is out of its range.
    """

    mass: float = 1.0
    stiffness: float = 1.0
    damping: float = 1.0
    distance: float = 0.0
    missing: bool = False
    payload: float = 0.0
    friction: float = 0.9
    floor_time: float = 2e-3
    kp: float = 1.0
    kd: float = 1.0
    torque_limit: float = 1.0
    period: float = 0.0
    delay: float = 0.0
    push: float = 0.0
    push_start: float = 0.0
    push_time: float = 0.1
    push_way: float = 0.0

    def __post_init__(self) -> None:
        most = {
            "distance": FARTHEST,
            **dict.fromkeys(("period", "delay", "floor_time", "push_start", "push_time"), MAX_TIME),
        }
        for f in fields(self):
            if f.name == "missing":
                if not isinstance(self.missing, (bool, np.bool_)):
                    raise InputError(
                        f"perturbation: missing is {shortened(repr(self.missing))}; give True or False"
                    )
                continue
            value = float(
                check_array(
                    f"perturbation: {f.name}", getattr(self, f.name), (), most=most.get(f.name, MAX_VALUE)
                )
            )
            if f.name not in ("distance", "push_way") and value < 0:
                raise InputError(f"perturbation: {f.name} is {value:g}; give a number >= 0")
        if 0 < self.payload < MIN_PAYLOAD:
            raise InputError(
                f"perturbation: payload is {self.payload:g}; give 0, or at least {MIN_PAYLOAD:g} kg"
            )
        for name in ("mass", "stiffness", "friction", "floor_time", "torque_limit"):
            check_positive(f"perturbation: {name}", getattr(self, name))

    def scene(self, planned: Scene) -> Scene:
        """The planned scene with this perturbation.

        Raises
        ------
        InputError : a factor for a parameter that the law or the target does not have.
        """
        law, target = planned.law, planned.target
        of_law, of_target = scaled_numbers(
            "perturbation", law, target, mass=self.mass, stiffness=self.stiffness, damping=self.damping
        )
        # away from the robot, as the normal is the way in which the target is pushed
        displacement = self.distance * planned.normal
        solids = planned.solids.moved(displacement) if self.distance else planned.solids
        solids = solids.without_target() if self.missing else solids
        return replace(
            planned,
            solids=solids,
            point=planned.point + displacement,
            second=None if planned.second is None else (planned.second[0], planned.second[1] + displacement),
            law=type(law)(**of_law),
            target=type(target)(**of_target),
        )
