"""Independent coordinates of a robot on fixed soles: the base's pose and the joints outside its legs.

A motion in these coordinates y keeps its soles in place at *every* instant, not only at an optimizer's nodes.
The legs follow from y by inverse kinematics, and their velocities and accelerations from the sole's
constraint

    J_leg qdot_leg = -V,      J_leg qddot_leg = -(A + Jdot qdot),

with V and A the twist and the acceleration that the sole would have if the leg's joints were at rest. Both
sides are written in the base's own frame, where J_leg depends on the joints between base and sole only.

The dependent joints of a chain are its last six. Those before them are coordinates: the first joint of a leg
of seven, or a waist that leads to both legs. A supporting hand is treated as a sole. Of a free-floating
robot the coordinates are the base's pose and all joints.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
from scipy.linalg.lapack import dgesv

from impactopt.arrays import Array, Index, Mask
from impactopt.errors import InputError, check_array
from impactopt.robots.build import joint_indices
from impactopt.robots.checks import LEG, check_arms, check_legs
from impactopt.robots.model import JointAngles, RpyCoordinates
from impactopt.robots.rigid_body import RigidBody
from impactopt.robots.robot import Robot, Sole, Striker
from impactopt.robots.tools import check_held

# [rad] at the start and in a plan, of a base that floats freely: near pi/2 roll and yaw turn about one axis
MAX_START_PITCH, MAX_PITCH = 1.2, 1.4
# Newton's method for a leg's inverse kinematics
_MAX_STEPS = 50
_LARGEST_STEP = 0.3  # [rad] of a joint
_CONVERGED = 1e-6  # [m, rad] error before the last step: quadratic convergence leaves about its square
_DAMPING = 1e-12 * np.eye(6)  # a stretched leg's Jacobian is singular
# Weights of the last one to four solutions that extrapolate them by a polynomial to the next instant. From
# four one Newton step mostly converges, from three it does not.
_EXTRAPOLATION = ((1.0,), (-1.0, 2.0), (1.0, -3.0, 3.0), (-1.0, 4.0, -6.0, 4.0))


class LegClosure:
    """Inverse kinematics of a stance's legs, and their rates and accelerations from the soles' constraint.

    It holds all that is common to the thousands of postures of references and clearance checks.
    """

    def __init__(self, c: StanceCoordinates, placements: Sequence[pin.SE3]) -> None:
        """placements : of the constrained frames in the world."""
        self._model, self._data, self._base, self._join = c.model, c.data, c.base, c.join
        self._frames = [c.model.getFrameId(frame) for frame in c.frames]
        self._limbs = [
            (frame, placement, c.base + leg.joints, slice(6 * k, 6 * k + 6))
            for k, (frame, placement, leg) in enumerate(zip(self._frames, placements, c.legs, strict=True))
        ]
        self._dependent, self._independent = c.base + c.dependent, c.base + c.independent
        self._leg_angles = JointAngles([c.robot.joint_models[j] for j in c.dependent])

    def legs(self, y: Array, guess: Array) -> Array:
        """`StanceCoordinates.solve_legs`."""
        return self._close(self._join(y, guess), guess)

    def _close(self, q: Array, guess: Array) -> Array:
        """Legs (nl,) by Newton's method; InputError if it does not converge.

        q (nq,) : a configuration with the coordinates; the legs are written to it.
        """
        legs = np.array(guess, dtype=float)
        if not self._limbs:
            return legs
        model, data, worst = self._model, self._data, np.inf
        for _ in range(_MAX_STEPS):
            self._leg_angles.put(q, legs)
            pin.computeJointJacobians(model, data, q)
            worst = 0.0
            for frame, placement, columns, own in self._limbs:
                m = pin.updateFramePlacement(model, data, frame)
                # The twist, in the frame's own axes, that leads to its placement in unit time;
                # LOCAL, as the Jacobian is.
                error = pin.log6(m.actInv(placement)).vector
                worst = max(worst, float(np.abs(error).max()))
                jac = pin.getFrameJacobian(model, data, frame, pin.LOCAL)[:, columns]
                # Levenberg-Marquardt with a damping that matters only where the Jacobian is singular.
                step = dgesv(jac.T @ jac + _DAMPING, jac.T @ error)[2]
                legs[own] += np.minimum(np.maximum(step, -_LARGEST_STEP), _LARGEST_STEP)
            if worst < _CONVERGED:
                self._leg_angles.put(q, legs)
                return legs
        raise InputError(
            f"the legs cannot hold the soles in place here (off by {worst:.2g} m or rad): the base is out of "
            "the legs' reach"
        )

    def follow(self, coordinates: Array, guess: Array) -> Iterator[tuple[Array, Array]]:
        """Configurations (nq,) and legs (nl,) along a continuous motion in coordinates (k, ny), one by one.

        guess (nl,) : of the first legs. Those of the others are extrapolated from up to four before.
        """
        # All configurations without legs in one call: one by one they take as long as the legs.
        q = self._join(coordinates, np.zeros((len(coordinates), len(self._dependent))))
        previous = [guess]
        for k in range(len(coordinates)):
            weights = np.array(_EXTRAPOLATION[len(previous) - 1])
            legs = self._close(q[k], weights @ np.array(previous))
            # The caller's guess is no solution of an instant, so it is not extrapolated from.
            previous = [*(previous if k else ())[-3:], legs]
            yield q[k], legs

    def jacobians(self, q: Array) -> Array:
        """(6 a sole, nv) of the fixed soles, each in its own frame, at a Pinocchio configuration."""
        model, data = self._model, self._data
        pin.computeJointJacobians(model, data, q)
        out = np.zeros((6 * len(self._frames), model.nv))
        for k, frame in enumerate(self._frames):
            out[6 * k : 6 * k + 6] = pin.getFrameJacobian(model, data, frame, pin.LOCAL)
        return out

    def motion(self, y: Array, yd: Array, ydd: Array, legs: Array) -> tuple[Array, Array, Array]:
        """`StanceCoordinates.complete_motion`."""
        q = self._join(y, legs)
        return q, *self.rates(q, y, yd, ydd)[:2]

    def rates(self, q: Array, y: Array, yd: Array, ydd: Array) -> tuple[Array, Array, Array]:
        """v and a (nv,) at a configuration q (nq,) of coordinates y (ny,), and Jacobians (6 a sole, nv)."""
        model, data, b = self._model, self._data, self._base
        v, a = np.zeros(model.nv), np.zeros(model.nv)
        if b:
            v[:6], a[:6] = base_motion(y[:6], yd[:6], ydd[:6])
        v[self._independent], a[self._independent] = yd[b:], ydd[b:]
        jac = self.jacobians(q)
        if self._frames:
            block = jac[:, self._dependent]
            # v has no leg rates yet: jac @ v is V, the soles' twists with the legs at rest.
            v[self._dependent] = solved(block, -jac @ v)
            pin.forwardKinematics(model, data, q, v, a)  # a has no legs yet: A + Jdot qdot
            drift = [pin.getFrameAcceleration(model, data, k, pin.LOCAL).vector for k in self._frames]
            a[self._dependent] = solved(block, -np.concatenate(drift))
        return v, a, jac


def solved(matrix: Array, right: Array) -> Array:
    """Solution of a linear system; `np.linalg.solve`'s checks would take longer than a small one."""
    _, _, found, singular = dgesv(matrix, right)
    if singular:
        raise np.linalg.LinAlgError("Singular matrix")
    return np.asarray(found)


def base_motion(y: Array, yd: Array, ydd: Array) -> tuple[Array, Array]:
    """Velocity and acceleration (6,) of the free-flyer, in its own frame.

    y, yd, ydd (6,) : (p, roll, pitch, yaw) and time derivatives. `StanceCoordinates.base_motion` is symbolic.
    """
    rotation = pin.rpy.rpyToMatrix(y[3:6])
    jac = pin.rpy.computeRpyJacobian(y[3:6], pin.LOCAL)
    omega = jac @ yd[3:6]
    alpha = jac @ ydd[3:6] + pin.rpy.computeRpyJacobianTimeDerivative(y[3:6], yd[3:6], pin.LOCAL) @ yd[3:6]
    linear = rotation.T @ yd[:3]
    # body components of a vector that turns with the base: d/dt (R' pdot) = R' pddot - omega x (R' pdot)
    return np.concatenate([linear, omega]), np.concatenate(
        [rotation.T @ ydd[:3] - pin.skew(omega) @ linear, alpha]
    )


def base_rates(y: Array, v: Array) -> Array:
    """ydot (6,) of the base from a Pinocchio velocity v (nv,); inverts `base_motion`."""
    jac = pin.rpy.computeRpyJacobian(y[3:6], pin.LOCAL)
    return np.concatenate([pin.rpy.rpyToMatrix(y[3:6]) @ v[:3], solved(jac, v[3:6])])


def independent_rates(c: StanceCoordinates, y: Array, v: Array) -> Array:
    """ydot (ny,) from a Pinocchio velocity v (nv,)."""
    own = v[c.base + c.independent]
    return np.concatenate([base_rates(y, v), own]) if c.base else own


def elimination_order(matrices: list[Array]) -> tuple[Index, Index]:
    """Row and column order in which Gaussian elimination needs no pivoting at any of the sample matrices.

    Complete pivoting on the least of the samples' normalised magnitudes. With a fixed order a symbolic
    elimination has no branches.
    """
    work = [m / np.abs(m).max() for m in matrices]
    n = work[0].shape[0]
    rows, cols = np.arange(n), np.arange(n)
    for k in range(n):
        size = np.min([np.abs(w[k:, k:]) for w in work], axis=0)
        r, c = np.unravel_index(int(np.argmax(size)), size.shape)
        rows[[k, k + r]], cols[[k, k + c]] = rows[[k + r, k]], cols[[k + c, k]]
        for w in work:
            w[[k, k + r]] = w[[k + r, k]]
            w[:, [k, k + c]] = w[:, [k + c, k]]
            # The samples are eliminated too, for the sizes of the pivots that follow.
            w[k + 1 :, k:] -= np.outer(w[k + 1 :, k] / w[k, k], w[k, k:])
    return rows, cols


def solve_in_order(a: Any, b: Any, order: tuple[Index, Index]) -> tuple[Any, Any]:
    """Solution x (n, k) of  a x = b  (SX) by Gaussian elimination in a fixed order, and the pivots' product.

    a (n, n), b (n, k). The product is the determinant up to its sign. Structural zeros are skipped.
    """
    rows, cols = order
    n, k_rhs = a.shape[0], b.shape[1]
    m = [[a[int(r), int(c)] for c in cols] for r in rows]
    y = [[b[int(r), j] for j in range(k_rhs)] for r in rows]
    for k in range(n):
        for i in range(k + 1, n):
            if m[i][k].is_zero():
                continue
            f = m[i][k] / m[k][k]
            for j in range(k + 1, n):
                if not m[k][j].is_zero():
                    m[i][j] = m[i][j] - f * m[k][j]
            for j in range(k_rhs):
                y[i][j] = y[i][j] - f * y[k][j]
    x = ca.SX(n, k_rhs)
    for j in range(k_rhs):
        back: list[Any] = [None] * n
        for i in range(n - 1, -1, -1):
            s = y[i][j]
            for c in range(i + 1, n):
                if not m[i][c].is_zero():
                    s = s - m[i][c] * back[c]
            back[i] = s / m[i][i]
            x[int(cols[i]), j] = back[i]
    pivots = m[0][0]
    for k in range(1, n):
        pivots = pivots * m[k][k]
    return x, pivots


@dataclass(frozen=True)
class Leg:
    """Fixed sole or hand, and the chain from the base to it.

    sole : None of a hand.  frame : its frame, which is fixed.  placement : pin.SE3 of the frame in the world.
    joints (6,) : dependent joints, the chain's last, as indices of the robot's joints.  before (k,) : those
        before them.
    order : elimination order of their Jacobian.
    """

    name: str
    sole: Sole | None
    frame: str
    joints: Index
    before: Index
    order: tuple[Index, Index]
    placement: Any

    @property
    def end(self) -> str:
        """Name of the constrained end in constraints and variables."""
        return f"{self.name} {'grip' if self.sole is None else 'sole'}"

    @property
    def limb(self) -> str:
        """Name of the constrained limb in constraints."""
        return f"{self.name} {'arm' if self.sole is None else 'leg'}"


class StanceCoordinates:
    """Map from independent coordinates to the robot's full motion, symbolic and numeric.

    Attributes
    ----------
    ny, nl : number of independent coordinates, and of dependent leg joints (6 a fixed sole or hand).
    soles, legs, hands : fixed soles; legs of soles and, after them, of hands; the legs of hands alone.
    drifts : True of a free-floating robot: joints move its base, and momentum is conserved.
    independent : (ny - 6 or ny,) indices of the independent joints among the robot's joints.
    undriven : indices in v of unactuated coordinates, which only the soles' wrenches move: base, soles'
        hinges.
    labels : names of the independent coordinates.
    posture : (nq,) the given one.
    """

    def __init__(
        self, robot: Robot, soles: tuple[Sole, ...], posture: Array, hands: tuple[Striker, ...] = ()
    ) -> None:
        """posture (nq,) : Pinocchio configuration; its placements of soles and hands are the fixed ones."""
        self.robot, self.soles, self.posture = robot, soles, posture
        self.model, self.data = robot.model, robot.model.createData()
        self.base, self._rpy = 6 if robot.floating else 0, RpyCoordinates(self.model)
        check_legs(self.model, [(sole.name, sole.frame) for sole in soles])
        lifted = [sole.name for sole in robot.soles if sole.hinge is not None and sole not in soles]
        if lifted:
            raise InputError(
                f"sole {lifted[0]!r} turns on a hinge that nothing drives, so it cannot be lifted: stand on "
                "both soles"
            )
        check_arms(robot, [sole.frame for sole in soles], [(hand.name, hand.model_frame) for hand in hands])
        pin.framesForwardKinematics(self.model, self.data, posture)
        self.legs: list[Leg] = []
        for name, sole, frame in (
            *((sole.name, sole, sole.frame) for sole in soles),
            *((hand.name, None, hand.model_frame) for hand in hands),
        ):
            chain = np.array(robot.limb(frame), dtype=np.intp)
            placement = self.data.oMf[self.model.getFrameId(frame)].copy()
            if sole is not None:
                check_held(self.model, sole, posture, self.base + chain[-LEG:])
            # Pivots that are large at all samples: elimination in this order is stable near the posture.
            order = elimination_order(self._leg_samples(frame, chain, posture))
            self.legs.append(Leg(name, sole, frame, chain[-LEG:], chain[:-LEG], order, placement))
        self.hands = [leg for leg in self.legs if leg.sole is None]
        self.drifts = bool(self.base) and not self.legs
        self.dependent = np.array([j for leg in self.legs for j in leg.joints], dtype=np.intp)
        self.independent = np.setdiff1d(np.arange(robot.n, dtype=np.intp), self.dependent)
        self.undriven = np.append(np.arange(self.base), self.base + np.flatnonzero(robot.hinges))
        self.ny, self.nl = self.base + len(self.independent), len(self.dependent)
        base_labels = ["base x", "base y", "base z", "base roll", "base pitch", "base yaw"][: self.base]
        self.labels = (*base_labels, *(robot.joint_names[j] for j in self.independent))
        self.leg_labels = tuple(robot.joint_names[j] for j in self.dependent)

    def _leg_samples(self, frame: str, chain: Index, posture: Array) -> list[Array]:
        """Jacobians (6, 6) of a chain's last joints, at this posture and four random ones near it."""
        # A fixed seed, as the order is a part of compiled functions, which are cached on disk.
        rng = np.random.default_rng(0)
        out = []
        angles = self.robot.joint_positions(posture)[chain]
        for k in range(5):
            step = np.zeros(self.model.nv)
            if k:
                near = angles + 0.15 * rng.standard_normal(len(chain))
                step[self.base + chain] = np.clip(near, self.robot.lower[chain], self.robot.upper[chain])
                step[self.base + chain] -= angles
            qk = pin.integrate(self.model, posture, step)
            if self.robot.floating:
                # As in `sole_terms`, the base at the world's origin: world axes are then the base's own.
                qk[:7] = [0, 0, 0, 0, 0, 0, 1]
            jac = pin.computeFrameJacobian(
                self.model, self.data, qk, self.model.getFrameId(frame), pin.LOCAL_WORLD_ALIGNED
            )
            out.append(np.array(jac[:, self.base + chain[-LEG:]]))
        return out

    @property
    def frames(self) -> tuple[str, ...]:
        """Constrained frames of the model: soles first, then hands."""
        return tuple(leg.frame for leg in self.legs)

    # ------------------------------------------------------------------ symbolic
    @cached_property
    def rb(self) -> RigidBody:
        """Expressions of the robot's dynamics, in coordinates whose base has roll, pitch and yaw."""
        return RigidBody(self.model, base="rpy", springs=self.robot.springs)

    @cached_property
    def base_motion(self) -> Any:
        """ca.Function (q, qd, qdd) -> velocity and acceleration (6,) of the free-flyer, in its own frame."""
        rb, qd, qdd = self.rb, ca.SX.sym("qd", self.rb.nv), ca.SX.sym("qdd", self.rb.nv)
        v, a = ca.mtimes(rb.velocity_map(), qd)[:6], rb.acceleration(qd, qdd)[:6]
        return ca.Function("base_motion", [rb.q, qd, qdd], [v, a])

    @cached_property
    def _sole(self) -> list[Any]:
        """Kinematics of each leg's frame, for calls with the base at the world's origin, without rotation.

        There all is in the base's own frame.
        """
        rb, out = self.rb, []
        for leg in self.legs:
            rotation, point = rb.frame(leg.frame)
            chain = [self.base + int(j) for j in (*leg.before, *leg.joints)]
            jac = rb.jacobian(leg.frame)[:, chain]
            twist = rb.frame_velocity(leg.frame, rb.v)
            acc = rb.frame_acceleration(leg.frame, rb.v, rb.a)
            found = [rotation, point, ca.densify(jac), twist, acc]
            out.append(ca.Function("sole", [rb.q, rb.v, rb.a], found))
        return out

    @cached_property
    def start_determinants(self) -> Array:
        """`leg_determinants` (legs,) of the given posture."""
        return np.array(self._determinants(self.start_legs)).ravel()

    @cached_property
    def _determinants(self) -> Any:
        legs = ca.SX.sym("legs", self.nl)
        found = self.leg_determinants(legs) if self.legs else ca.SX(0, 1)
        return ca.Function("determinants", [legs], [found])

    def leg_extension(self, legs: Array) -> Array:
        """Determinants (soles + hands,) of the Jacobians of legs (nl,) over those at the start."""
        return np.array(self._determinants(legs)).ravel() / self.start_determinants

    def embed(self, base: Any, independent: Any, dependent: Any) -> Any:
        """Vector over base and joints (nv) from its three parts (SX)."""
        full = [None] * self.robot.n
        for i, j in enumerate(self.independent):
            full[j] = independent[i]
        for i, j in enumerate(self.dependent):
            full[j] = dependent[i]
        return ca.vertcat(base, *full) if self.base else ca.vertcat(*full)

    def configuration(self, y: Any, legs: Any) -> Any:
        """q of the "rpy" coordinates (nv,) from y (ny,) and the leg joints (nl,), SX."""
        return self.embed(y[: self.base], y[self.base :], legs)

    def sole_terms(self, k: int, y: Any, legs: Any, v: Any, a: Any) -> Any:
        """Kinematics of sole k in the base's own frame, SX.

        Rotation, position, Jacobian of the dependent joints, twist, acceleration, and Jacobian of the joints
        before these.
        """
        # With the base at the origin the terms depend on joints only, and the
        # base's pose costs no operations.
        q = self.embed(ca.SX.zeros(self.base), y[self.base :], legs)
        rotation, point, jac, twist, acc = self._sole[k](q, v, a)
        return rotation, point, jac[:, -LEG:], twist, acc, jac[:, :-LEG]

    def velocity(self, y: Any, legs: Any, rates: Any) -> Any:
        """Pinocchio velocities v = N(y) ydot (nv, k) that keep the fixed soles at rest, SX.

        rates (ny, k) : a ydot in each column.
        """
        k = rates.shape[1]
        if not self.base:
            return ca.horzcat(*[self.embed(None, rates[:, i], ca.SX(0, 1)) for i in range(k)])
        still = ca.SX.zeros(self.nl)
        q = self.configuration(y, legs)
        nothing = ca.SX.zeros(self.rb.nv)
        base = [
            self.base_motion(q, self.embed(rates[:6, i], rates[6:, i], still), nothing)[0] for i in range(k)
        ]
        leg_rates = []
        for s, leg in enumerate(self.legs):
            jac = self.sole_terms(s, y, legs, nothing, nothing)[2]
            # The twist is linear in v: with leg rates of zero it is V of the module's docstring.
            twists = [
                self.sole_terms(s, y, legs, self.embed(b, rates[6:, i], still), nothing)[3]
                for i, b in enumerate(base)
            ]
            leg_rates.append(solve_in_order(jac, -ca.horzcat(*twists), leg.order)[0])
        parts = ca.vertcat(*leg_rates)
        return ca.horzcat(*[self.embed(base[i], rates[6:, i], parts[:, i]) for i in range(k)])

    def motion(self, y: Any, legs: Any, yd: Any, ydd: Any) -> tuple[Any, Any]:
        """Pinocchio v and a (nv,) that keep the fixed soles at rest, SX.

        y (ny,), legs (nl,) : coordinates and dependent joints.  yd, ydd (ny,) : time derivatives of y.
        """
        v = self.velocity(y, legs, yd)
        if not self.base:
            return v, self.embed(None, ydd, ca.SX(0, 1))
        still = ca.SX.zeros(self.nl)
        q = self.configuration(y, legs)
        qd, qdd = self.embed(yd[:6], yd[6:], still), self.embed(ydd[:6], ydd[6:], still)
        a_base = self.base_motion(q, qd, qdd)[1]
        accs = []
        for s, leg in enumerate(self.legs):
            # v is whole and a has no legs yet: acc is A + Jdot qdot of the module's docstring.
            _, _, jac, _, acc, _ = self.sole_terms(s, y, legs, v, self.embed(a_base, ydd[6:], still))
            accs.append(solve_in_order(jac, -acc, leg.order)[0])
        return v, self.embed(a_base, ydd[6:], ca.vertcat(*accs))

    def leg_determinants(self, legs: Any) -> Any:
        """Determinants (legs,), up to their signs, of the legs' Jacobians, SX; zero at a straight knee."""
        # any coordinates: joints before a leg's own rotate its Jacobian, which leaves the determinant
        nothing, anywhere = ca.SX.zeros(self.rb.nv), ca.SX(self.start)
        out = []
        for s, leg in enumerate(self.legs):
            jac = self.sole_terms(s, anywhere, legs, nothing, nothing)[2]
            out.append(solve_in_order(jac, ca.SX(6, 0), leg.order)[1])
        return ca.vertcat(*out)

    def sole_twists(self, y: Any, legs: Any, yd: Any, rates: Any) -> Any:
        """Twists (6 a fixed sole) [m/s, rad/s] in the base's own frame, SX.

        rates (nl,) : of the legs; these need not keep the soles at rest.
        """
        still, nothing = ca.SX.zeros(self.nl), ca.SX.zeros(self.rb.nv)
        base = self.base_motion(self.configuration(y, still), self.embed(yd[:6], yd[6:], still), nothing)[0]
        v = self.embed(base, yd[6:], rates)
        return ca.vertcat(*[self.sole_terms(k, y, legs, v, nothing)[3] for k in range(len(self.legs))])

    def upper_motion(self, y: Any, yd: Any, ydd: Any) -> tuple[Any, Any, Any]:
        """q, v, a (nv,) with leg joints at zero, SX; right for frames that no leg of the stance moves."""
        still = ca.SX.zeros(self.nl)
        q = self.configuration(y, still)
        if not self.base:
            return q, self.embed(None, yd, still), self.embed(None, ydd, still)
        qd, qdd = self.embed(yd[:6], yd[6:], still), self.embed(ydd[:6], ydd[6:], still)
        v, a = self.base_motion(q, qd, qdd)
        return q, self.embed(v, yd[6:], still), self.embed(a, ydd[6:], still)

    def closure(self, y: Any, legs: Any) -> Any:
        """Pose errors of the fixed soles (6 a sole), SX: position [m]; rotation [rad], to first order."""
        q = self.configuration(y, legs)
        out = []
        for leg in self.legs:
            rotation, point = self.rb_frame(leg.frame, q)
            # error rotation, and the vector of its antisymmetric part
            d = ca.mtimes(rotation, ca.DM(leg.placement.rotation.T))
            w = 0.5 * ca.vertcat(d[2, 1] - d[1, 2], d[0, 2] - d[2, 0], d[1, 0] - d[0, 1])
            out += [point - ca.DM(leg.placement.translation), w]
        return ca.vertcat(*out)

    def rb_frame(self, name: str, q: Any) -> tuple[Any, Any]:
        """Rotation and position of a frame at the symbolic configuration q ("rpy" coordinates)."""
        f = ca.Function("frame", [self.rb.q], list(self.rb.frame(name)))
        return f(q)

    def sole_wrench_map(self, y: Any, legs: Any, wrenches: Any) -> Any:
        """Generalized force (nv,) J_soles^T w of the soles' wrenches, SX.

        wrenches (6 a sole): force [N] and moment [N m] in each sole's own frame.
        """
        nv = self.rb.nv
        if not self.legs:
            return ca.SX.zeros(nv)
        zero_v, base, leg_tau = ca.SX.zeros(nv), ca.SX.zeros(6), []
        others = [ca.SX(0.0)] * self.robot.n  # torques of joints that are coordinates
        for k, leg in enumerate(self.legs):
            rotation, point, jac, _, _, before = self.sole_terms(k, y, legs, zero_v, zero_v)
            w = wrenches[6 * k : 6 * k + 6]
            f, n = ca.mtimes(rotation, w[:3]), ca.mtimes(rotation, w[3:])
            # Moved to the base's origin, in the base's own axes, as Pinocchio's free-flyer has its force.
            base = base + ca.vertcat(f, n + ca.cross(point, f))
            leg_tau.append(ca.mtimes(jac.T, ca.vertcat(f, n)))
            tau = ca.mtimes(before.T, ca.vertcat(f, n))
            for i, j in enumerate(leg.before):
                others[j] = others[j] + tau[i]
        of_independent = ca.vertcat(ca.SX(0, 1), *[others[j] for j in self.independent])
        return self.embed(base, of_independent, ca.vertcat(*leg_tau))

    # ------------------------------------------------------------------ numeric
    @cached_property
    def leg_closure(self) -> LegClosure:
        """Numerical solver of the legs' closure."""
        return LegClosure(self, [leg.placement for leg in self.legs])

    @cached_property
    def start(self) -> Array:
        """Coordinates (ny,) of the given posture."""
        return self.split(self.posture)[0]

    @cached_property
    def start_legs(self) -> Array:
        """Legs (nl,) of the given posture."""
        return self.split(self.posture)[1]

    def split(self, q_pin: Array) -> tuple[Array, Array]:
        """Coordinates y (ny,) and legs (nl,) of a Pinocchio configuration (nq,).

        Angles without limits are the equivalent ones nearest to those of the given posture. Else a robot
        whose root faces backwards, with a yaw of pi, would turn round once in a motion across it.
        """
        q = self._rpy.from_pin(self.robot.check_configuration(q_pin))
        turns = 2 * np.pi * np.round((self._rpy.from_pin(self.posture) - q) / (2 * np.pi))
        q = q + np.where(self._unlimited, turns, 0.0)
        joints = q[self.base :]
        return np.concatenate([q[: self.base], joints[self.independent]]), joints[self.dependent]

    @cached_property
    def _unlimited(self) -> Mask:
        """Mask of the base's roll and yaw and of continuous joints without limits among all coordinates."""
        base = np.isin(np.arange(self.base), (3, 5))
        continuous = [self.model.joints[j].nq == 2 for j in joint_indices(self.model)]
        return np.append(base, continuous & np.isinf(self.robot.lower) & np.isinf(self.robot.upper))

    def join(self, y: Array, legs: Array) -> Array:
        """Pinocchio configuration (nq,) of y (ny,) and legs (nl,), or (k, nq) of k of them."""
        joints = np.zeros((*y.shape[:-1], self.robot.n))
        joints[..., self.independent], joints[..., self.dependent] = y[..., self.base :], legs
        q = np.concatenate([y[..., : self.base], joints], axis=-1)
        return self._rpy.to_pin(check_array("coordinates", q, (None,) * q.ndim))  # NaN of a failed solve

    def solve_legs(self, y: Array, guess: Array) -> Array:
        """Leg joints (nl,) that put every fixed sole in its place, by Newton's method from ``guess``.

        Raises InputError if a sole cannot be reached.
        """
        return self.leg_closure.legs(y, guess)

    def sole_jacobians(self, q: Array) -> tuple[Array, list[Any]]:
        """Jacobians (6 a sole, nv) of the fixed soles and their placements, at a Pinocchio configuration.

        The Jacobians are in each sole's own frame, the placements in the world.
        """
        jac = self.leg_closure.jacobians(q)
        # `jacobians` has placed the joints; frames follow from them.
        pin.updateFramePlacements(self.model, self.data)
        return jac, [self.data.oMf[self.model.getFrameId(leg.frame)].copy() for leg in self.legs]

    def complete_motion(self, y: Array, yd: Array, ydd: Array, legs: Array) -> tuple[Array, Array, Array]:
        """Pinocchio's q, v, a of coordinates and derivatives; those of legs by the soles' constraint."""
        return self.leg_closure.motion(y, yd, ydd, legs)


def striker_kinematics(c: StanceCoordinates, striker: str) -> Any:
    """CasADi function (q, v, a) -> position, velocity, acceleration of the striking point.

    (3,) each, along the world's axes [m], [m/s], [m/s^2].
    """
    rb, frame = c.rb, f"striker:{striker}"
    _, point = rb.frame(frame)
    outs = [point, rb.frame_velocity(frame, rb.v)[:3], rb.frame_acceleration(frame, rb.v, rb.a)[:3]]
    return ca.Function("striker", [rb.q, rb.v, rb.a], outs)
