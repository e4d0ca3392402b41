"""Postures of a given effective mass, and errors of one collision against another."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize

from impactopt.collision import Collision, effective_mass
from impactopt.errors import InputError, check_positive
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.kinematics.stance import Stance, usual_stance
from impactopt.kinematics.support import margin as margin_in
from impactopt.kinematics.support import support_polygon
from impactopt.robots.robot import Robot

__all__ = [
    "errors_against",
    "posture_of_effective_mass",
]

Array = NDArray[np.float64]

LEAST_WEIGHT = 50.0  # [N] on the ground; with less the ZMP is a quotient of small numbers
_MASS_TOLERANCE = 1e-6  # [kg]
_AXES = pin.LOCAL_WORLD_ALIGNED


# ---------------------------------------------------------------- posture
def posture_of_effective_mass(
    robot: Robot,
    mass: float,
    striker: str,
    normal: ArrayLike,
    *,
    stance: Stance | None = None,
    start: ArrayLike | None = None,
    inside: float = 0.06,
) -> Array:
    """A configuration (nq,) whose effective mass at the striking point is `mass` [kg], within 1e-6 kg.

    The one found nearest to `start` (None: the posture half_sitting) by SLSQP, in the sum of squares of what
    the joints move [rad], with held soles where they are, joints inside their limits by 0.02 rad, and the
    centre of mass over the soles, `inside` [m] from their edge. Deterministic.

    Raises
    ------
    InputError : a mass that is not positive; an unknown striker; a stance the robot cannot take; no such
        posture found (with the nearest mass).
    """
    check_positive("mass [kg]", mass)
    if start is None and "half_sitting" not in robot.postures:
        raise InputError(f"robot {robot.name!r} has no posture half_sitting; give start=")
    q0 = robot.posture("half_sitting") if start is None else robot.check_configuration(start, name="start")
    search = _PostureSearch(robot, float(mass), striker, normal, stance, q0, inside)
    d, off = np.zeros(robot.nv), np.inf
    for _ in range(4):  # SLSQP gives up early where its estimate of curvature is off; from there it goes on
        d = search.from_here(d)
        off = search.mass_error(d)
        if search.violation(d) <= 1.0:
            return np.array(pin.integrate(robot.model, q0, d))
    raise InputError(
        f"mass [kg]: no posture near the start has an effective mass of {mass:g} kg at {striker!r} (nearest: "
        f"{mass + off:.4g} kg): choose another mass or start"
    )


class _PostureSearch:
    """Motions d (nv) from a configuration, in the basis of v, and what is asked of where they lead."""

    def __init__(
        self,
        robot: Robot,
        mass: float,
        striker: str,
        normal: ArrayLike,
        stance: Stance | None,
        q0: Array,
        inside: float,
    ) -> None:
        self.robot, self.model, self.q0, self.inside = robot, robot.model, q0, inside
        self.wanted, self.data = mass, robot.model.createData()
        held_by = usual_stance(robot) if stance is None else stance
        self._mass = effective_mass(robot, striker=striker, normal=normal, stance=held_by)
        frames = held_by.constraint_frames(robot)
        pin.framesForwardKinematics(self.model, self.data, q0)
        ids = [self.model.getFrameId(frame) for frame in frames]
        self.held = [(i, self.data.oMf[i].copy()) for i in ids]
        soles = held_by.soles(robot)
        self.standing = bool(soles)
        self.polygon = support_polygon(robot, StanceCoordinates(robot, soles, q0)) if soles else np.zeros(0)
        joints = robot.joint_positions(q0)
        free = np.full(robot.nv - robot.n, np.inf)
        self.low = np.concatenate([-free, np.minimum(robot.lower + 0.02 - joints, 0.0)])
        self.high = np.concatenate([free, np.maximum(robot.upper - 0.02 - joints, 0.0)])
        # the base goes where the legs let it; a little weight keeps the search well posed
        self.weight = np.concatenate([np.full(robot.nv - robot.n, 0.1), np.ones(robot.n)])

    def mass_error(self, d: Array) -> float:
        """[kg]"""
        return float(self._mass(pin.integrate(self.model, self.q0, d))) - self.wanted

    def equalities(self, d: Array) -> Array:
        q = pin.integrate(self.model, self.q0, d)
        pin.framesForwardKinematics(self.model, self.data, q)
        off = [pin.log6(at.actInv(self.data.oMf[i])).vector for i, at in self.held]
        return np.concatenate([*off, [np.log(float(self._mass(q)) / self.wanted)]])

    def balance(self, d: Array) -> Array:
        """(1,) [m] by which the centre of mass is farther inside the soles' hull than asked."""
        com = pin.centerOfMass(self.model, self.data, pin.integrate(self.model, self.q0, d))
        return np.asarray(margin_in(self.polygon, com[None, :2]) - self.inside)

    def from_here(self, d: Array) -> Array:
        """Point (nv,) that SLSQP goes to."""
        rules: list[dict[str, Any]] = [
            {"type": "eq", "fun": self.equalities, "jac": lambda x: _slopes(self.equalities, x)}
        ]
        if self.standing:
            rules.append({"type": "ineq", "fun": self.balance, "jac": lambda x: _slopes(self.balance, x)})
        found = minimize(
            lambda x: 0.5 * float(self.weight @ x**2),
            d,
            jac=lambda x: self.weight * x,
            bounds=list(zip(self.low, self.high, strict=True)),
            constraints=rules,
            method="SLSQP",
            options={"maxiter": 200, "ftol": 1e-12},
        )
        return np.clip(found.x, self.low, self.high)

    def violation(self, d: Array) -> float:
        """Largest violation over what is tolerated: 1e-6 kg, and 1e-8 m and rad."""
        worst = abs(self.mass_error(d)) / _MASS_TOLERANCE
        held = self.equalities(d)[:-1]
        if held.size:
            worst = max(worst, float(np.abs(held).max()) / 1e-8)
        if self.standing:
            worst = max(worst, -float(self.balance(d)[0]) / 1e-8)
        return worst if np.isfinite(worst) else np.inf


def _slopes(function: Any, x: Array, by: float = 1e-6) -> Array:
    """Jacobian by central differences: a search asks no more of it than its direction."""
    steps = by * np.eye(len(x))
    return np.stack([(function(x + s) - function(x - s)) / (2 * by) for s in steps], axis=1)


# ---------------------------------------------------------------- errors
def errors_against(
    result: Collision, reference: Collision, *, torque_limit: ArrayLike | None = None
) -> dict[str, float | None]:
    """Errors of a model's collision against a reference's; None where one of them has no such history.

    * impulse_error_pct, f_max_error_pct : 100 (result - reference) / reference, so positive where the model
      promises too much. The paper's eq. (24) has the other sign.
    * zmp_error_mm : largest distance of the ZMPs.
    * torque_error_pct : largest difference of the servos' torques over `torque_limit` (n) [N m], all joints;
      None without limits.

    The last two are taken at the result's own instants while both are in contact, at equal times since
    contact, between the reference's instants by straight lines; ZMPs only while both press on the ground with
    more than 50 N.
    """
    time = result.time[result.time <= reference.time[-1]]
    k = time.size

    def of_reference(history: Array) -> Array:
        return np.stack([np.interp(time, reference.time, column) for column in history.T], axis=1)

    out: dict[str, float | None] = {
        "impulse_error_pct": 100 * (result.impulse / reference.impulse - 1),
        "f_max_error_pct": 100 * (result.peak_force / reference.peak_force - 1),
        "zmp_error_mm": None,
        "torque_error_pct": None,
    }
    if result.ground_wrench is not None and reference.ground_wrench is not None:
        # the ZMP anew from wrenches: where the force is near zero it is not to be interpolated
        ground = result.ground_wrench[:k], of_reference(reference.ground_wrench)
        loaded = np.logical_and(*(wrench[:, 2] > LEAST_WEIGHT for wrench in ground))
        if loaded.any():
            own, true = (np.stack([-w[loaded, 4], w[loaded, 3]]) / w[loaded, 2] for w in ground)
            out["zmp_error_mm"] = 1e3 * float(np.linalg.norm(own - true, axis=0).max())
    if result.torque is not None and reference.torque is not None and torque_limit is not None:
        off = np.abs(result.torque[:k] - of_reference(reference.torque))
        out["torque_error_pct"] = 100 * float((off / np.asarray(torque_limit)).max())
    return out
