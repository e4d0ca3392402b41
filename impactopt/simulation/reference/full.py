"""Full dynamics of a collision, in numbers: the reference of the simplified models."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.collision.interface import Collision
from impactopt.errors import check_choice
from impactopt.simulation.pinocchio_robot import FORMS
from impactopt.simulation.reference.base import Forces, ReferenceModel, converge
from impactopt.simulation.reference.equations_of_motion import Motion, Run, collision_from

__all__ = ["FullDynamics"]

Array = NDArray[np.float64]
# a step's error, of what is allowed of the impulse; how much tighter it is each time, and at the most: beyond
# that rounding is larger
_OF_STEP, _TIGHTER, _LEAST, _LEVELS = 1e-3, 1e-2, 3e-14, 3


@dataclass(frozen=True, kw_only=True, eq=False)
class FullDynamics(ReferenceModel):
    """A robot hits a target, with nothing frozen: H, J and bias anew at every stage of every step.

    The equations are the paper's (5), (10), (12), (14), (16), (17), integrated by SciPy's DOP853 with errors
    below the tolerance, in steps that end on events (end of compression, separation, a joint entering or
    leaving saturation or its friction's transition band). It has no derivatives.

    Attributes
    ----------
    friction : of the joints.  contact_friction : of the striking point on the target.
    kp, kd : (n) or (n, n) gains in place of the robot's.
    step : [s] the longest between instants of the histories, of which there are fifty at least.
    tolerance : relative, of the impulse.
    form : "lagrange", the paper's steps 1a to 6a with dense matrices (fig. 2a); or "pinocchio", its
        constrained dynamics along the tree. Their results agree to rounding.

    Raises
    ------
    InputError : as of `CollisionModel`; an unknown form; gains of a wrong shape or sign; a step or tolerance
        that is not positive; in `collide`, a contact too fast to follow.
    """

    form: str = "lagrange"
    tolerance: float = 1e-6

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("form", self.form, FORMS)

    def _controlled(
        self, q: Array, v: Array, forces: Forces, normal: Array, tolerance: float
    ) -> tuple[Collision, float]:
        with np.errstate(over="ignore", invalid="ignore"):  # a motion that diverges says so itself
            motion = Motion(
                FORMS[self.form](*self._held, normal, self.contact_friction), forces, q, v, self.horizon
            )

            def at(level: int) -> Run:
                return motion.run(max(_OF_STEP * tolerance * _TIGHTER**level, _LEAST))

            run, change = converge(at, tolerance, levels=_LEVELS)
            instants, peak = motion.instants(run, self.step), motion.peak(run)
        nv = self.robot.nv
        result = collision_from(
            instants,
            np.array(pin.integrate(self.robot.model, q, run.final[:nv])),
            run.final[nv : 2 * nv].copy(),
            run.impulse,
            peak,
            run.final[2 * nv + 1 : -1],
            len(self.held_by.sole_names(self.robot)),
            forces,
            run.separated,
        )
        return result, change
