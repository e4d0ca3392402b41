"""`RigidBody`: symbolic kinematics and dynamics of one model. Its methods return SX expressions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from impactopt.errors import InputError
from impactopt.robots.rigid_body import _dynamics
from impactopt.robots.rigid_body._dynamics import Accelerations, Factor, Kinematics, Velocities
from impactopt.robots.rigid_body._spatial import (
    Scalar,
    Vector,
    as_sx,
    pack_dense,
    pack_entries,
    pack_symmetric,
    pack_vector,
    unpack_vector,
)
from impactopt.robots.rigid_body._tree import Coordinates, Tree


class RigidBody:
    """Symbolic kinematics and dynamics of a robot: CasADi SX expressions of q and of the methods' arguments.

    Parameters
    ----------
    model : pin.Model with a free-flyer at the root or a fixed base, and revolute, continuous or prismatic
        joints about any axes. Inertias, placements, armature and gravity are read once, here.
    base : "quaternion": q is Pinocchio's, (p, quaternion x y z w, joints), a continuous joint being (cos,
        sin); "rpy": one number for each velocity, (p, roll, pitch, yaw, joints), a continuous joint being its
        angle. Without a free-flyer the two differ in continuous joints only.
    springs : stiffness and position at rest by joint, of joints that are not continuous.

    Attributes
    ----------
    q, v, a : SX symbols (nq), (nv), (nv). Every method uses this q; v and a are arguments, and these symbols
        are for callers that need some.
    nq, nv : number of coordinates (of the chosen kind) and of velocities.

    Notes
    -----
    Velocities v and accelerations a = dv/dt are Pinocchio's in both cases: the free-flyer's six, [linear
    [m/s]; angular [rad/s]] in its own frame, then the joints'. Arguments `v` and `a` are SX or numbers, (nv),
    dense or sparse; structural zeros make the expressions smaller. Subexpressions are built on demand and
    shared between methods.

    Raises
    ------
    InputError : a joint type that is not supported; an unknown base; and from the methods, an unknown frame
        or an argument of the wrong shape.
    """

    def __init__(
        self, model: Any, base: str = "quaternion", springs: Mapping[str, tuple[float, float]] | None = None
    ) -> None:
        self.model, self._springs = model, springs or {}
        self._tree = Tree(model)
        self._coordinates = Coordinates(self._tree, base)
        self._kinematics = Kinematics(self._tree, self._coordinates)
        self._composites = _dynamics.CompositeInertias(self._kinematics)
        self._mass_matrix: _dynamics.MassMatrix | None = None
        self._velocities: dict[tuple[Any, ...], Velocities] = {}
        self._accelerations: dict[tuple[Any, ...], Accelerations] = {}
        self.base, self.floating = base, self._tree.floating
        self.nq, self.nv = self._coordinates.nq, self._tree.nv
        self.q = self._coordinates.q
        self.v, self.a = ca.SX.sym("v", self.nv), ca.SX.sym("a", self.nv)

    # ------------------------------------------------------------ kinematics
    def frame(self, name: str) -> tuple[Any, Any]:
        """Rotation R, SX (3, 3), and position p, SX (3) [m], of a frame in the world."""
        R, p = self._kinematics.frame(name)
        return pack_dense(R), pack_vector(p)

    def jacobian(self, name: str) -> Any:
        """J, SX (6, nv) sparse, LOCAL_WORLD_ALIGNED: [linear; angular] velocity of the frame is J v."""
        return pack_entries((6, self.nv), self._kinematics.jacobian(name))

    def frame_velocity(self, name: str, v: Any) -> Any:
        """J v, SX (6), without forming J: the frame's velocity [m/s; rad/s], LOCAL_WORLD_ALIGNED."""
        return pack_vector(self._link_velocities(v).frame(name))

    def frame_acceleration(self, name: str, v: Any, a: Any) -> Any:
        """J a + dJ/dt v, SX (6): classical acceleration [m/s2; rad/s2] of the frame, along the world's axes.

        The linear part is the acceleration of the frame's origin as a point. None stands for zero v or a, so
        `frame_acceleration(name, v, None)` is dJ/dt v.
        """
        return pack_vector(self._link_accelerations(v, a).frame(name))

    # ------------------------------------------------------------ dynamics
    def mass_matrix(self) -> Any:
        """H, SX (nv, nv) sparse and symmetric, armature on its diagonal (as `pin.crba`)."""
        return pack_symmetric(self.nv, self._crba().entries)

    def rnea(self, v: Any, a: Any, gravity: bool = True) -> Any:
        """H a + C v + g, SX (nv) [N, N m], armature in H (as `pin.rnea`), springs in g.

        None stands for zero v or a: `rnea(None, None)` is gravity's torque alone, and the springs'.
        """
        out = pack_vector(_dynamics.rnea(self._link_accelerations(v, a), gravity=gravity))
        for name, (stiffness, rest) in self._springs.items() if gravity else ():
            joint = self.model.joints[self.model.getJointId(name)]
            at = joint.idx_v if self.base == "rpy" else joint.idx_q
            out[joint.idx_v] += stiffness * (self.q[at] - rest)
        return out

    def factorize(self, H: Any = None) -> Factor:
        """H = L' D L, sparse and without fill-in.

        Parameters
        ----------
        H : SX (nv, nv) symmetric, mostly with the pattern of `mass_matrix()`; None: the mass matrix.
        """
        H = self.mass_matrix() if H is None else as_sx("H", H)
        if H.shape != (self.nv, self.nv):
            raise InputError(f"H: expected shape {(self.nv, self.nv)}, got {H.shape}")
        return Factor(H)

    # ------------------------------------------------------------ momentum
    def com(self) -> Any:
        """Centre of mass, SX (3) [m]."""
        return pack_vector(_dynamics.com(self._composites))

    def centroidal_map(self) -> Any:
        """A_g, SX (6, nv) sparse: centroidal momentum is A_g v (as `pin.computeCentroidalMap`)."""
        return pack_entries((6, self.nv), _dynamics.centroidal_map(self._crba()))

    def centroidal_momentum(self, v: Any) -> Any:
        """A_g v, SX (6), without A_g: [linear [kg m/s]; angular, about the centre of mass [kg m2/s]]."""
        return pack_vector(_dynamics.centroidal_momentum(self._composites, self._link_velocities(v)))

    # ------------------------------------------------------------ coordinates
    def velocity_map(self) -> Any:
        """T, SX (nv, nq) sparse, with v = T dq/dt; needs nq = nv ("rpy")."""
        return self._coordinates.velocity_map()

    def acceleration(self, qdot: Any, qddot: Any) -> Any:
        """a = T d2q/dt2 + dT/dt dq/dt, SX (nv), from dq/dt and d2q/dt2, both (nq); needs nq = nv ("rpy")."""
        return self._coordinates.acceleration(self._numbers("qdot", qdot), self._numbers("qddot", qddot))

    def tangent_map(self) -> Any:
        """Matrix G, SX (nq, nv) sparse, with dq/dt = G v. So `jacobian(f, q) @ G` is df/dt for each unit
        velocity.

        With "rpy" it is singular at pitch = +-90 deg.
        """
        return self._coordinates.tangent_map()

    def integrate(self, d: Any) -> Any:
        """q, SX (nq), after moving with the constant velocity d (nv) for one second, as pin.integrate.

        For base="quaternion" only.
        """
        return self._coordinates.integrate(as_sx("d", d))

    def from_pin(self, q: ArrayLike) -> NDArray[np.float64]:
        """These coordinates, (nq), of Pinocchio's q, (model.nq)."""
        return self._coordinates.from_pin(q)

    def to_pin(self, q: ArrayLike) -> NDArray[np.float64]:
        """Pinocchio's q, (model.nq) or (k, model.nq), of these coordinates, (nq) or (k, nq)."""
        return self._coordinates.to_pin(q)

    # ------------------------------------------------------------ shared subexpressions
    def _crba(self) -> _dynamics.MassMatrix:
        if self._mass_matrix is None:
            self._mass_matrix = _dynamics.MassMatrix(self._composites)
        return self._mass_matrix

    def _numbers(self, name: str, value: Any) -> Vector:
        if value is None:
            return [0.0] * self.nv
        value = as_sx(name, value)
        if value.shape != (self.nv, 1):
            raise InputError(f"{name}: expected a column of {self.nv} numbers, got shape {value.shape}")
        return unpack_vector(value)

    def _link_velocities(self, v: Any) -> Velocities:
        numbers = self._numbers("v", v)
        return self._velocities.setdefault(_key(numbers), Velocities(self._kinematics, numbers))

    def _link_accelerations(self, v: Any, a: Any) -> Accelerations:
        velocities, numbers = self._link_velocities(v), self._numbers("a", a)
        key = (*_key(velocities.v), *_key(numbers))
        return self._accelerations.setdefault(key, Accelerations(velocities, numbers))


def _key(numbers: Vector) -> tuple[Any, ...]:
    """Dictionary key of a list of numbers, equal for equal lists.

    The hash of an SX entry identifies its node. The cached object keeps the list, and so the nodes, alive;
    otherwise another node could get the same hash.
    """
    return tuple((x.x.element_hash(),) if isinstance(x, Scalar) else x for x in numbers)
