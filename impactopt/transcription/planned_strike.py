"""The state at contact and the collision that it leads to, as numbers: a plan's heart without its limbs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.kinematics.support import margin, support_polygon, zmp
from impactopt.problem.problem import ImpactProblem
from impactopt.robots.loads import DriveLoads
from impactopt.transcription.plan import PlannedCollision, PlannedScenario
from impactopt.transcription.planned_loads import strike_loads

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class PlannedStrike:
    """State in which a robot hits, and the plan's prediction of the impact.

    posture (nq,) and velocity (nv,), pin's, at contact; posture_after, velocity_after at separation. torque
    (n,) [N m] that makes the robot coast at contact, and ground (6,) [N, N m], the total ground wrench about
    the world's origin then. compression, restitution [s]; hand_speed [m/s] along the normal at contact;
    impulse [N s] to the target; collision, scenarios: as of :class:`impactopt.Plan`.
    """

    problem: ImpactProblem
    posture: Array
    velocity: Array
    posture_after: Array
    velocity_after: Array
    torque: Array
    ground: Array
    compression: float
    restitution: float
    collision: PlannedCollision
    hand_speed: float
    impulse: float
    scenarios: tuple[PlannedScenario, ...] = ()

    def margins(self) -> dict[str, Any]:
        """Torque demand over limit and ZMP margin [m] at contact and in the collision; capture point [m].

        The capture point's is that of the state after contact. An impact without duration has no torque and
        no ZMP.
        """
        limit, hit = self.problem.robot.torque_limit, self.collision
        lasts = len(hit.ground) > 0 or not self.problem.robot.floating
        torques = {"contact": self.torque, "collision": hit.torque if lasts else hit.torque[:0]}
        out: dict[str, Any] = {
            "torque_ratio": {name: float(np.abs(t / limit).max()) for name, t in torques.items() if len(t)}
        }
        polygon = support_polygon(self.problem.robot, self.problem.coordinates)
        if not len(polygon):
            return out
        grounds = {"contact": self.ground[None], "collision": hit.ground}
        out["zmp_margin_m"] = {
            name: float(margin(polygon, zmp(wrench)).min()) for name, wrench in grounds.items() if len(wrench)
        }
        out["capture_margin_m"] = float(margin(polygon, self._capture_point()[None])[0])
        return out

    def loads(self) -> DriveLoads:
        """Peak loads of gears and motors in the impact."""
        before, after = self.velocity, self.velocity_after
        return strike_loads(self.problem.robot, before, after, self.collision)

    def _capture_point(self) -> Array:
        """(2,) [m] after contact: c + cdot sqrt(c_z / g) (Koolen et al., IJRR 2012)."""
        model = self.problem.robot.model
        data = model.createData()
        pin.centerOfMass(model, data, self.posture_after, self.velocity_after)
        com, rate = np.array(data.com[0]), np.array(data.vcom[0])
        return np.asarray(com[:2] + rate[:2] * np.sqrt(com[2] / np.linalg.norm(model.gravity.linear)))
