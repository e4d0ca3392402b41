"""A robot and its floor as a MuJoCo model, built body by body from the robot's numbers."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.contact.friction import ContactFriction
from impactopt.errors import missing_package
from impactopt.robots.build import parent_body
from impactopt.robots.couplings import axis_of
from impactopt.robots.robot import Robot
from impactopt.simulation.collision_geometry import FLOOR
from impactopt.simulation.perturbation import Perturbation
from impactopt.simulation.result import Scene

__all__ = [
    "MujocoOptions",
    "MujocoRobot",
    "Welds",
    "add_welds",
    "build_world",
    "mujoco_module",
    "no_log_file",
    "primitive",
    "put_followers",
    "quaternion",
    "robot_bodies",
    "robot_on_floor",
    "site_name",
    "spec_of",
]

Array = NDArray[np.float64]
# of a weld, MuJoCo's own limits: impedance, and time constant in steps
_IMPEDANCE, _TIME_CONSTANT = 0.9999, 2.0
FOOT = 0.005  # [m] radius of the spheres under a sole's corners; they touch the floor where the corner is


@dataclass(frozen=True)
class MujocoOptions:
    """MuJoCo's own settings: step [s], iterations and tolerance of its contact solver."""

    step: float = 2e-4
    iterations: int = 100
    tolerance: float = 1e-10


def mujoco_module() -> Any:
    """MuJoCo, or an error that says how to get it."""
    try:
        import mujoco
    except ImportError as error:
        raise missing_package("the engine 'mujoco'", "mujoco", "validate") from error
    return mujoco


@contextlib.contextmanager
def no_log_file() -> Iterator[None]:
    """MuJoCo's warnings are not written to a file in the user's directory: the engine raises its own."""
    mujoco = mujoco_module()
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def build_world(
    robot: Robot,
    scene: Scene,
    perturbation: Perturbation,
    solver: MujocoOptions,
    near: Sequence[tuple[int, int]] = (),
    struck: Sequence[int] = (),
) -> Any:
    """The compiled mujoco.MjModel.

    Joints have the model's names; striking points are the sites ``striker`` and ``striker 2``; each sole of
    the robot, held by the plan or not, has a sphere ``sole <frame> <k>`` under each of its corners. Nothing
    else touches anything, but the pairs of solids (`near`), which push each other back: hulls of links, named
    ``solid <number>``, and bodies of the world; those that move with the target are on the mocap body
    ``target``. Other solids (`struck`) are there to be asked for their distance. The contact law between
    target and striker is the engine's business. Hands that hold on are welded.
    """
    spec, bodies = robot_on_floor(robot, scene.strikers, perturbation, solver, scene.solids.floor)
    _solids(mujoco_module(), spec, bodies, scene, near, struck)
    add_welds(spec, bodies, robot, scene.hands, solver.step)
    return spec.compile()


def robot_on_floor(
    robot: Robot,
    strikers: Sequence[str],
    perturbation: Perturbation,
    solver: MujocoOptions,
    height: float | None = 0.0,
) -> tuple[Any, list[Any]]:
    """The world of :func:`build_world` before it is compiled, without target and solids; and its bodies, as
    of :func:`robot_bodies`.

    strikers : frames of the model that hit.  height : of the floor [m]; None: nothing can touch it.
    """
    mujoco = mujoco_module()
    spec = spec_of(robot, solver)
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0  # friction as hard as the normal direction: no creep
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    floor = spec.worldbody.add_geom(
        name="floor", type=plane, size=[5.0, 5.0, 0.1], pos=[0.0, 0.0, height or 0.0]
    )
    _surface(floor, perturbation, sole=False)
    return spec, _robot_bodies(mujoco, spec, robot, strikers, perturbation)


def spec_of(robot: Robot, solver: MujocoOptions) -> Any:
    """An empty world with the robot's gravity, that is integrated and solved so."""
    mujoco = mujoco_module()
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.compiler.balanceinertia = False
    spec.option.timestep = solver.step
    spec.option.iterations, spec.option.tolerance = solver.iterations, solver.tolerance
    spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    # the engine says so itself when it diverges, and does not begin anew
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_AUTORESET
    spec.option.gravity = robot.model.gravity.linear
    return spec


def _solids(
    mujoco: Any,
    spec: Any,
    bodies: list[Any],
    scene: Scene,
    near: Sequence[tuple[int, int]],
    struck: Sequence[int],
) -> None:
    """Geometry of the solids that are in a pair, and the pairs."""
    solids = scene.solids.solids
    target = spec.worldbody.add_body(name="target", mocap=True)
    for k in sorted({*struck, *(k for pair in near for k in pair if k != FLOOR)}):
        solid = solids[k]
        body = bodies[solid.joint] if solid.joint else (target if solid.moves else spec.worldbody)
        if solid.vertices is not None:
            spec.add_mesh(
                name=f"solid {k}",
                uservert=solid.vertices.astype(np.float32).ravel(),
                inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX,
            )
            shape = {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": f"solid {k}"}
        else:
            shape = primitive(mujoco, solid)
        body.add_geom(name=f"solid {k}", contype=0, conaffinity=0, mass=0.0, **shape)
    for one, other in near:
        spec.add_pair(
            name=f"pair {one} {other}",
            geomname1=f"solid {one}",
            geomname2="floor" if other == FLOOR else f"solid {other}",
            condim=3,
            friction=[0.5, 0.5, 1e-3, 1e-4, 1e-4],
            solref=[5e-3, 1.0],
        )


def primitive(mujoco: Any, solid: Any) -> dict[str, Any]:
    """Shape and place of a geom that is a box, inflated: of a `Solid` without vertices, or of a body of the
    world.
    """
    half, radius = np.asarray(solid.half), solid.radius
    place = {"pos": solid.place, "quat": quaternion(solid.rotation)}
    if not radius:
        return {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": half, **place}
    if half[2] > 0:
        return {"type": mujoco.mjtGeom.mjGEOM_CAPSULE, "size": [radius, half[2], 0.0], **place}
    return {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [radius, 0.0, 0.0], **place}


def site_name(number: int) -> str:
    """Name of a striker's site; the first striker is 1."""
    return "striker" if number == 1 else f"striker {number}"


def _robot_bodies(
    mujoco: Any, spec: Any, robot: Robot, strikers: Sequence[str], perturbation: Perturbation
) -> list[Any]:
    model = robot.model
    bodies = robot_bodies(mujoco, spec, robot)
    for sole in robot.soles:
        frame = model.frames[model.getFrameId(sole.frame)]
        for k, corner in enumerate(sole.polygon):
            centre = frame.placement.act(np.array([*corner, FOOT]))
            sphere = bodies[frame.parentJoint].add_geom(
                name=f"sole {sole.frame} {k}",
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=[FOOT, 0.0, 0.0],
                pos=centre,
                mass=0.0,
            )
            _surface(sphere, perturbation, sole=True)
    for k, striker in reversed(list(enumerate(strikers, start=1))):  # the first one carries the payload
        frame = model.frames[model.getFrameId(striker)]
        hand = bodies[frame.parentJoint]
        hand.add_site(name=site_name(k), pos=frame.placement.translation)
    if perturbation.payload > 0:
        load = hand.add_body(name="payload", pos=frame.placement.translation)
        _inertial(load, perturbation.payload, np.zeros(3), 1e-4 * perturbation.payload * np.eye(3))
    return bodies


def robot_bodies(mujoco: Any, spec: Any, robot: Robot) -> list[Any]:
    """The robot's links and joints, without anything that touches; the body of each joint of the model, in
    its order, the world first. Names are ``body <joint>`` and the joints' own.

    MuJoCo has no moving body without mass: joints that move nothing of their own move the next one's body.
    """
    model = robot.model
    bodies = [spec.worldbody] * model.njoints
    for j in range(1, model.njoints):
        inertia, above, way = model.inertias[j], parent_body(model, j), list(model.supports[j])
        if not inertia.mass:
            continue
        joints, placement, places = way[way.index(above) + 1 :], pin.SE3.Identity(), list[Any]()
        for i in joints:
            placement = placement * model.jointPlacements[i]
            places.append(placement)
        body = bodies[above].add_body(
            name=f"body {model.names[j]}", pos=placement.translation, quat=quaternion(placement.rotation)
        )
        bodies[j] = body
        _inertial(body, inertia.mass, inertia.lever, inertia.inertia)
        if model.joints[j].nv == 6:
            body.add_freejoint(name=model.names[j])
            continue
        for i, place in zip(joints, places, strict=True):
            _add_joint(mujoco, spec, body, robot, i, placement.actInv(place))
    return bodies


def _add_joint(mujoco: Any, spec: Any, body: Any, robot: Robot, j: int, at: Any) -> None:
    """Joint j of the model, which is there in the body's frame; a follower's law is an equality."""
    model, subspace = robot.model, axis_of(robot.model, j).subspace
    turns, coupling = bool(np.any(subspace[3:])), robot.couplings.get(str(model.names[j]))
    stiffness, rest = robot.springs.get(str(model.names[j]), (0.0, 0.0))
    spring = {"stiffness": stiffness, "springref": rest} if stiffness else {}
    body.add_joint(
        name=model.names[j],
        type=mujoco.mjtJoint.mjJNT_HINGE if turns else mujoco.mjtJoint.mjJNT_SLIDE,
        axis=at.rotation @ (subspace[3:] if turns else subspace[:3]),
        pos=at.translation,
        armature=0.0 if coupling else float(model.armature[model.joints[j].idx_v]),
        **spring,
    )
    if coupling is not None:
        law = _hard(spec.add_equality(), spec.option.timestep)
        law.type, law.name1, law.name2 = mujoco.mjtEq.mjEQ_JOINT, model.names[j], coupling.leader
        law.data[:5] = [coupling.offset, coupling.ratio, 0.0, 0.0, 0.0]


def _hard(equality: Any, step: float) -> Any:
    """The equality, as hard as MuJoCo lets it be in steps [s] of this length."""
    equality.solref = [_TIME_CONSTANT * step, 1.0]
    equality.solimp = [_IMPEDANCE, _IMPEDANCE, 1e-3, 0.5, 2.0]
    return equality


def put_followers(world: Any, robot: Robot, qpos: Array, qvel: Array) -> None:
    """Put joints that follow others, in place, where their laws have them and as fast."""
    for name, (leader, ratio, offset) in robot.couplings.items():
        own, other = world.joint(name), world.joint(leader)
        qpos[own.qposadr[0]] = ratio * qpos[other.qposadr[0]] + offset
        qvel[own.dofadr[0]] = ratio * qvel[other.dofadr[0]]


def add_welds(spec: Any, bodies: Sequence[Any], robot: Robot, frames: Sequence[str], step: float) -> None:
    """Sites at these frames of the robot, welded as hard as MuJoCo lets them be in steps [s] of this length.

    bodies : of :func:`robot_bodies`.
    """
    mujoco = mujoco_module()
    for name in frames:
        frame = robot.model.frames[robot.model.getFrameId(name)]
        bodies[frame.parentJoint].add_site(
            name=name, pos=frame.placement.translation, quat=quaternion(frame.placement.rotation)
        )
        spec.worldbody.add_site(name=f"ground {name}")
        weld = _hard(spec.add_equality(), step)
        weld.type, weld.objtype = mujoco.mjtEq.mjEQ_WELD, mujoco.mjtObj.mjOBJ_SITE
        weld.name1, weld.name2 = name, f"ground {name}"
    if frames:
        spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE  # their rows are read


def _surface(geom: Any, perturbation: Perturbation, *, sole: bool) -> None:
    geom.contype, geom.conaffinity = int(sole), int(not sole)  # soles meet the floor, not each other
    geom.friction = [perturbation.friction, 1e-3, 1e-4]
    geom.condim = 3
    geom.solref = [perturbation.floor_time, 1.0]
    # as soft as a rubber sole: with more impedance the corners leave the floor by micrometres, many times a
    # millisecond, and the force and ZMP of one step say nothing (the motion hardly changes). One impedance at
    # all depths makes a linear floor.
    geom.solimp = [0.5, 0.5, 5e-4, 0.5, 2.0]


def _inertial(body: Any, mass: float, centre: Any, inertia: Any) -> None:
    body.explicitinertial = True
    body.mass = float(mass)
    body.ipos = centre
    i = np.asarray(inertia)
    body.fullinertia = [i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]]


def quaternion(rotation: Any) -> list[float]:
    """(w, x, y, z), as MuJoCo has it."""
    x, y, z, w = pin.Quaternion(np.asarray(rotation)).normalized().coeffs()
    return [w, x, y, z]


class MujocoRobot:
    """A robot in a compiled MuJoCo model, struck at one of its sites.

    world, data : MuJoCo's model and its data.  dof, place : where the joints' rates and angles are in qvel
    and qpos.  sites : of the striking points, and along (h, nv): their Jacobians along the normal, where they
    have been last; pushes (h, nv): the forces of a unit of normal force, which are these without friction.
    """

    def __init__(
        self, robot: Robot, world: Any, *strikers: str, friction: ContactFriction | None = None
    ) -> None:
        self.mujoco, self.robot, self.world = mujoco_module(), robot, world
        self.data = self.mujoco.MjData(world)
        self.floating = robot.floating
        self._n, self._nq, self._nv = robot.n, robot.nq, robot.nv
        joints = [world.joint(name) for name in robot.joint_names]
        self.dof = np.array([joint.dofadr[0] for joint in joints])
        self.place = np.array([joint.qposadr[0] for joint in joints])
        own = robot.joint_models
        self._place = np.array([joint.idx_q for joint in own], dtype=np.intp)
        # a continuous joint's angle is (cosine, sine) in Pinocchio
        self._continuous = np.flatnonzero([joint.nq == 2 for joint in own])
        self.sites = np.array([world.site(striker).id for striker in strikers], dtype=np.intp)
        self._rows, self.along = np.zeros((3, world.nv)), np.zeros((len(strikers), world.nv))
        self.friction = friction
        self.pushes = self.along if friction is None else np.zeros_like(self.along)

    def put(self, q: Array, v: Array | None = None) -> None:
        """Go to q (nq), v (nv; None: the rates stay); what depends on them is not computed yet."""
        d, robot = self.data, self.robot
        if self.floating:
            d.qpos[:3], d.qpos[3:7] = q[:3], q[[6, 3, 4, 5]]
        d.qpos[self.place] = robot.joint_positions(q)
        if v is not None:
            if self.floating:
                d.qvel[:3], d.qvel[3:6] = self.base_rotation() @ v[:3], v[3:6]
            d.qvel[self.dof] = v[-robot.n :]
        put_followers(self.world, robot, d.qpos, d.qvel)

    def state(self) -> tuple[Array, Array]:
        """q (nq), v (nv)."""
        qpos, qvel = self.data.qpos, self.data.qvel
        q, v = np.zeros(self._nq), np.zeros(self._nv)
        if self.floating:
            q[:3], q[3:6], q[6] = qpos[:3], qpos[4:7], qpos[3]
            v[:3], v[3:6] = self.base_rotation().T @ qvel[:3], qvel[3:6]
        angles = qpos[self.place]
        q[self._place] = angles
        for k in self._continuous:
            at = self._place[k]
            q[at], q[at + 1] = np.cos(angles[k]), np.sin(angles[k])
        v[-self._n :] = qvel[self.dof]
        return q, v

    def base_rotation(self) -> Array:
        """(3, 3) of a floating base."""
        rotation = np.zeros(9)
        self.mujoco.mju_quat2Mat(rotation, self.data.qpos[3:7])
        return rotation.reshape(3, 3)

    def places(self) -> Array:
        """(h, 3) [m] of the striking points."""
        return np.asarray(self.data.site_xpos[self.sites])

    def speeds_along(self, normal: Array) -> Array:
        """Speeds (h,) [m/s] of the striking points along a normal (3,); leaves their rows in `along`, and
        what a unit of the contacts' normal forces does in `pushes`.
        """
        for k, site in enumerate(self.sites):
            self.mujoco.mj_jacSite(self.world, self.data, self._rows, None, site)
            self.along[k] = normal @ self._rows
            if self.friction is not None:
                self.pushes[k] = self.friction.way(normal, self._rows @ self.data.qvel) @ self._rows
        return np.asarray(self.along @ self.data.qvel)

    def apply(self, torque: Array, forces: Array | float) -> None:
        """Torque (n) [N m] at the joints, and the contacts' forces (h,) [N], against the normal."""
        applied = self.data.qfrc_applied
        applied[:] = -np.atleast_1d(forces) @ self.pushes
        applied[self.dof] += torque


class Welds:
    """The welds of a compiled world, whose other equalities are the laws of joints that follow others.

    frames : as :func:`impactopt.simulation.mujoco_world.add_welds` has added them.
    """

    def __init__(self, world: Any, frames: Sequence[str]) -> None:
        self.mujoco, self.world = mujoco_module(), world
        self.frames = [world.site(name).id for name in frames]
        self.ground = [world.site(f"ground {name}").id for name in frames]
        world.site_sameframe[self.ground] = self.mujoco.mjtSameFrame.mjSAMEFRAME_NONE  # they are moved
        self._map = np.zeros((6, world.nv))

    def put(self, data: Any) -> None:
        """They hold the frames where they are; needs kinematics."""
        for frame, ground in zip(self.frames, self.ground, strict=True):
            self.world.site_pos[ground] = data.site_xpos[frame]
            rotation = np.zeros(4)
            self.mujoco.mju_mat2Quat(rotation, data.site_xmat[frame])
            self.world.site_quat[ground] = rotation

    def wrenches(self, data: Any) -> tuple[Array, Array]:
        """Wrenches of the world on the frames (frames, 6), world axes, and their places, at the last step's
        start.
        """
        d, J = data, self._map
        out, places = np.empty((len(self.frames), 6)), np.empty((len(self.frames), 3))
        if not self.frames:
            return out, places
        rows = np.reshape(d.efc_J, (-1, self.world.nv))
        for k, frame in enumerate(self.frames):
            first = 6 * k + self.world.neq - len(self.frames)
            its = slice(first, first + 6)
            self.mujoco.mj_jacSite(self.world, d, J[:3], J[3:], frame)
            # the rows of a weld are in coordinates of its own
            out[k] = np.linalg.lstsq(J.T, rows[its].T @ d.efc_force[its], rcond=None)[0]
            places[k] = d.site_xpos[frame]
        return out, places
