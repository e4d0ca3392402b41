"""Search for postures of a given effective mass, and errors of one collision against another."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike
from scipy.optimize import minimize

from impactopt.arrays import Array
from impactopt.collision import Collision, effective_mass
from impactopt.errors import InputError, check_positive
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.kinematics.stance import USUAL_POSTURE, Stance, stance_of, support_polygon
from impactopt.kinematics.stance import margin as margin_in
from impactopt.robots.robot import Robot

MIN_NORMAL_FORCE = 50.0  # [N] of the ground; with less the ZMP is a quotient of small numbers
_MASS_TOLERANCE = 1e-6  # [kg]
_POSITION_TOLERANCE = 1e-8  # [m, rad]
_RANGE_MARGIN = 0.02  # [rad] that joints keep from their limits
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
    """Configuration (nq,) whose effective mass at the striking point is `mass` [kg], within 1e-6 kg.

    SLSQP minimizes the sum of squares of the joints' displacements [rad] from `start` (None: the posture
    half_sitting). Fixed soles stay in place, joints stay inside their limits by 0.02 rad, and the centre of
    mass stays over the soles, `inside` [m] from their edge. The result is deterministic.

    Raises
    ------
    InputError : a mass that is not positive; an unknown striker; a stance the robot cannot take; no such
        posture found (with the nearest mass).
    """
    taken = stance_of(robot, stance)
    check_positive("mass [kg]", mass)
    if start is None and USUAL_POSTURE not in robot.postures:
        raise InputError(f"robot {robot.name!r} has no posture {USUAL_POSTURE}; give start=")
    q0 = robot.posture(USUAL_POSTURE) if start is None else robot.check_configuration(start, name="start")
    search = _PostureSearch(robot, float(mass), striker, normal, taken, q0, inside)
    d, error = np.zeros(robot.nv), np.inf
    for _ in range(4):  # SLSQP may stop early by a bad estimate of the Hessian: restart it from there
        d = search.improve(d)
        error = search.mass_error(d)
        if search.violation(d) <= 1.0:
            return np.array(pin.integrate(robot.model, q0, d))
    raise InputError(
        f"mass [kg]: no posture near the start has an effective mass of {mass:g} kg at {striker!r} (nearest: "
        f"{mass + error:.4g} kg): choose another mass or start"
    )


class _PostureSearch:
    """Optimization problem of a posture, in displacements d (nv,) from q0, in the tangent space."""

    def __init__(
        self,
        robot: Robot,
        mass: float,
        striker: str,
        normal: ArrayLike,
        taken: Stance,
        q0: Array,
        inside: float,
    ) -> None:
        self.robot, self.model, self.q0, self.inside = robot, robot.model, q0, inside
        self.mass, self.data = mass, robot.model.createData()
        self._effective_mass = effective_mass(robot, striker=striker, normal=normal, stance=taken)
        frames = taken.constraint_frames(robot)
        pin.framesForwardKinematics(self.model, self.data, q0)
        ids = [self.model.getFrameId(frame) for frame in frames]
        self.fixed = [(i, self.data.oMf[i].copy()) for i in ids]
        soles = taken.soles(robot)
        self.standing = bool(soles)
        self.polygon = support_polygon(robot, StanceCoordinates(robot, soles, q0)) if soles else np.zeros(0)
        joints = robot.joint_positions(q0)
        free = np.full(robot.nv - robot.n, np.inf)
        # a start outside of its range may stay there, but go no farther out
        self.low = np.concatenate([-free, np.minimum(robot.lower + _RANGE_MARGIN - joints, 0.0)])
        self.high = np.concatenate([free, np.maximum(robot.upper - _RANGE_MARGIN - joints, 0.0)])
        # the base follows from the legs; a small weight makes the Hessian regular
        self.weight = np.concatenate([np.full(robot.nv - robot.n, 0.1), np.ones(robot.n)])

    def mass_error(self, d: Array) -> float:
        """Error [kg] of the effective mass."""
        return float(self._effective_mass(pin.integrate(self.model, self.q0, d))) - self.mass

    def equalities(self, d: Array) -> Array:
        """Displacements of the fixed frames, and logarithmic error of the effective mass; 0 if feasible."""
        q = pin.integrate(self.model, self.q0, d)
        pin.framesForwardKinematics(self.model, self.data, q)
        # zero where a frame is in place, and smooth near it
        displacements = [pin.log6(at.actInv(self.data.oMf[i])).vector for i, at in self.fixed]
        # the logarithm, as masses differ by factors, and its slope is of order one at any mass
        return np.concatenate([*displacements, [np.log(float(self._effective_mass(q)) / self.mass)]])

    def balance(self, d: Array) -> Array:
        """Margin (1,) [m] of the centre of mass to the support polygon's edge, beyond the required one."""
        com = pin.centerOfMass(self.model, self.data, pin.integrate(self.model, self.q0, d))
        return np.asarray(margin_in(self.polygon, com[None, :2]) - self.inside)

    def improve(self, d: Array) -> Array:
        """Result (nv,) of SLSQP from the initial guess d."""
        constraints: list[dict[str, Any]] = [
            {"type": "eq", "fun": self.equalities, "jac": lambda x: _jacobian(self.equalities, x)}
        ]
        if self.standing:
            constraints.append(
                {"type": "ineq", "fun": self.balance, "jac": lambda x: _jacobian(self.balance, x)}
            )
        found = minimize(
            lambda x: 0.5 * float(self.weight @ x**2),
            d,
            jac=lambda x: self.weight * x,
            bounds=list(zip(self.low, self.high, strict=True)),
            constraints=constraints,
            method="SLSQP",
            options={"maxiter": 200, "ftol": 1e-12},
        )
        return np.clip(found.x, self.low, self.high)

    def violation(self, d: Array) -> float:
        """Largest violation of a constraint, relative to its tolerance."""
        worst = abs(self.mass_error(d)) / _MASS_TOLERANCE
        displacements = self.equalities(d)[:-1]
        if displacements.size:
            worst = max(worst, float(np.abs(displacements).max()) / _POSITION_TOLERANCE)
        if self.standing:
            worst = max(worst, -float(self.balance(d)[0]) / _POSITION_TOLERANCE)
        return worst if np.isfinite(worst) else np.inf


def _jacobian(function: Any, x: Array, step: float = 1e-6) -> Array:
    """Jacobian by central differences, exact enough for a search direction."""
    steps = step * np.eye(len(x))
    return np.stack([(function(x + s) - function(x - s)) / (2 * step) for s in steps], axis=1)


# ---------------------------------------------------------------- errors
def errors_against(
    result: Collision, reference: Collision, *, torque_limit: ArrayLike | None = None
) -> dict[str, float | None]:
    """Errors of a model's collision against that of a reference; None if one of them lacks the history.

    * impulse_error_pct, f_max_error_pct : 100 (result - reference) / reference, positive for an overestimate.
      The paper's eq. (24) has the opposite sign.
    * zmp_error_mm : largest distance of the ZMPs.
    * torque_error_pct : largest difference of the servos' torques over `torque_limit` (n,) [N m], of all
      joints; None without limits.

    The last two are evaluated at the result's instants while both are in contact, at equal times since
    contact, with linear interpolation of the reference; ZMPs only while both normal forces exceed 50 N.
    """
    # both histories begin at contact, so these are the first k instants
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
        # the ZMP from interpolated wrenches: near zero force it cannot be interpolated itself
        ground = result.ground_wrench[:k], of_reference(reference.ground_wrench)
        loaded = np.logical_and(*(wrench[:, 2] > MIN_NORMAL_FORCE for wrench in ground))
        if loaded.any():
            own, true = (np.stack([-w[loaded, 4], w[loaded, 3]]) / w[loaded, 2] for w in ground)
            out["zmp_error_mm"] = 1e3 * float(np.linalg.norm(own - true, axis=0).max())
    if result.torque is not None and reference.torque is not None and torque_limit is not None:
        error = np.abs(result.torque[:k] - of_reference(reference.torque))
        out["torque_error_pct"] = 100 * float((error / np.asarray(torque_limit)).max())
    return out
