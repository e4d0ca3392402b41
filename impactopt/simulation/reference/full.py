"""Full dynamics of a collision, in numbers: the reference of the simplified models."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.collision.result import Collision
from impactopt.errors import InputError, did_you_mean
from impactopt.simulation.pinocchio_robot import FORMS
from impactopt.simulation.reference.base import ReferenceModel
from impactopt.simulation.reference.forces import Forces
from impactopt.simulation.reference.motion import Instant, Motion
from impactopt.simulation.reference.record import collision_from

__all__ = ["FullDynamics"]

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class FullDynamics(ReferenceModel):
    """A robot hits a target, with nothing frozen: H, J and bias anew at every stage of every step.

    The equations are the paper's (5), (10), (12), (14), (16), (17), integrated by the classical Runge-Kutta
    method with steps that end on events (end of compression, separation, a joint entering or leaving
    saturation or its friction's transition band, a switch of the target). It has no derivatives.

    Attributes
    ----------
    friction : of the joints.
    kp, kd : (n) or (n, n) gains in place of the robot's.
    step : [s] of the integration.
    form : "lagrange", the paper's steps 1a to 6a with dense matrices (fig. 2a); or "pinocchio", its
        constrained dynamics along the tree. Their results agree to rounding.

    Raises
    ------
    InputError : as of `CollisionModel`; an unknown form; gains of a wrong shape or sign; a step that is not
        positive; in `collide`, a step too long for the servo's fastest mode.
    """

    form: str = "lagrange"
    _stable: ClassVar[float] = 2.6  # of the classical Runge-Kutta method: 2.79

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.form not in FORMS:
            raise InputError(
                f"form {self.form!r}{did_you_mean(self.form, FORMS)}; there are {', '.join(FORMS)}"
            )

    def _run(self, step: float, q: Array, v: Array, forces: Forces, normal: Array) -> Collision:
        motion = Motion(FORMS[self.form](*self._held, normal), forces, q, v)
        instants: list[Instant] = []
        with np.errstate(over="ignore", invalid="ignore"):  # a motion that diverges says so itself
            last, separated = motion.run(step, self.horizon, instants.append)
        nv = self.robot.nv
        return collision_from(
            instants,
            np.array(pin.integrate(self.robot.model, q, last[:nv])),
            last[nv : 2 * nv].copy(),
            float(last[2 * nv + 1]),
            last[2 * nv + 2 :],
            len(self.held_by.sole_names(self.robot)),
            forces,
            separated,
        )
