"""Full dynamics of a collision in Pinocchio: the reference of the simplified models."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from impactopt.arrays import Array
from impactopt.collision.interface import Collision
from impactopt.errors import check_choice
from impactopt.simulation.pinocchio_robot import FORMS
from impactopt.simulation.reference.base import Forces, ReferenceModel, converge
from impactopt.simulation.reference.equations_of_motion import Motion, Run, collision_from

# Tolerance of a step: fraction of the impulse's tolerance in the first run, and factor from run to run
_STEP_FRACTION, _FACTOR = 1e-3, 1e-2
_MIN_TOLERANCE = 3e-14  # of a step; below, rounding errors are larger
_RUNS = 3


@dataclass(frozen=True, kw_only=True, eq=False)
class FullDynamics(ReferenceModel):
    """Collision without frozen quantities: H, J and bias are evaluated at every stage of every step.

    The equations are the paper's (5), (10), (12), (14), (16), (17), integrated by SciPy's DOP853 with errors
    below the tolerance, in steps that end on events (end of compression, separation, a joint that enters or
    leaves saturation or its friction's transition band). The model has no derivatives.

    Attributes
    ----------
    friction : of the joints.
    contact_friction : of the striking point on the target.
    kp, kd : (n,) or (n, n) gains in place of the robot's.
    step : [s] at most between instants of the histories, which have fifty at least.
    tolerance : relative, of the impulse.
    form : "lagrange", the paper's steps 1a to 6a with dense matrices (fig. 2a); or "pinocchio", its recursive
        constrained dynamics. Their results agree to rounding.

    Raises
    ------
    InputError : as in `CollisionModel`; an unknown form; gains of a wrong shape or sign; a step or tolerance
        that is not positive; in `collide`, a contact that is too fast to integrate.
    """

    form: str = "lagrange"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("form", self.form, FORMS)

    def _controlled(
        self, q: Array, v: Array, forces: Forces, normal: Array, tolerance: float
    ) -> tuple[Collision, float]:
        with np.errstate(over="ignore", invalid="ignore"):  # a motion that diverges raises an error
            motion = Motion(
                FORMS[self.form](*self._body_arguments, normal, self.contact_friction),
                forces,
                q,
                v,
                self.horizon,
            )

            def at(level: int) -> Run:
                return motion.run(max(_STEP_FRACTION * tolerance * _FACTOR**level, _MIN_TOLERANCE))

            run, change = converge(at, tolerance, levels=_RUNS)
            instants, peak = motion.instants(run, self.step), motion.peak(run)
        nv = self.robot.nv
        result = collision_from(
            instants,
            np.array(pin.integrate(self.robot.model, q, run.final[:nv])),
            run.final[nv : 2 * nv].copy(),
            run.impulse,
            peak,
            run.final[motion.target_part],
            len(self.held_by.sole_names(self.robot)),
            forces,
            run.separated,
            run.final[motion.tangential_part].copy(),
        )
        return result, change
