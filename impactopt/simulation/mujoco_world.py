"""MuJoCo model of a robot and its floor, built body by body from the robot's parameters."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from impactopt.arrays import Array
from impactopt.contact.friction import ContactFriction
from impactopt.errors import InputError, missing_package
from impactopt.robots.model import axis_of, principal_moments
from impactopt.robots.robot import Robot
from impactopt.simulation.collision_geometry import FLOOR
from impactopt.simulation.perturbation import Perturbation
from impactopt.simulation.result import Scene
from impactopt.simulation.target_dynamics import SlidingPoints

# hardest equality that MuJoCo accepts: impedance, and time constant in steps
_MAX_IMPEDANCE, _MIN_TIME_CONSTANT = 0.9999, 2.0
CONTACTS = ("point", "link")  # a striker touches by its striking point, or by the hulls of its link
CORNER_RADIUS = 0.005  # [m] of the spheres at a sole's corners; they touch the floor where the corner is
# of a link without mass, as MuJoCo has no moving body without: a microgram, which moves nothing
MASSLESS = pin.Inertia.FromSphere(1e-9, 0.05)
MAX_DISTANCE = 0.05  # [m] between link and target; larger distances are not computed
# least second moment of mass of a body, over its largest: more than the rounding of an exported scene
MIN_SECOND_MOMENT = 1e-5


@dataclass(frozen=True)
class MujocoOptions:
    """Settings of MuJoCo: step [s], iterations and tolerance of its contact solver."""

    step: float = 2e-4
    iterations: int = 100
    tolerance: float = 1e-10


def mujoco_module() -> Any:
    """MuJoCo's module.

    Raises
    ------
    InputError : it is not installed, with the command that installs it.
    """
    try:
        import mujoco
    except ImportError as error:
        raise missing_package("the engine 'mujoco'", "mujoco", "validate") from error
    return mujoco


@contextlib.contextmanager
def no_log_file() -> Iterator[None]:
    """Suppresses MuJoCo's log file in the working directory: the engine raises errors of its own."""
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
    in_contact: Sequence[int] = (),
) -> Any:
    """Compiled mujoco.MjModel of a robot in a scene.

    near : pairs of solids that collide.
    in_contact : other solids, of which only distances are computed.

    * Joints have the names of the robot's model.
    * Striking points are the sites ``striker`` and ``striker 2``. The contact law at them is not part of the
      model: the engine applies its force.
    * Every sole of the robot, whether the plan uses it or not, has a sphere ``sole <frame> <k>`` at each of
      its corners, which collides with the floor.
    * Solids are the geoms ``solid <number>``: hulls of links, and bodies of the world. Those that move with
      the target are on the mocap body ``target``.
    * Supporting hands are welded.
    """
    spec, bodies = robot_on_floor(robot, scene.strikers, perturbation, solver, scene.solids.floor)
    _solids(mujoco_module(), spec, bodies, scene, near, in_contact)
    add_welds(spec, bodies, robot, scene.hands, solver.step)
    world = spec.compile()
    _tighten_balls(mujoco_module(), world)
    return world


def _tighten_balls(mujoco: Any, world: Any) -> None:
    """Sets the enclosing balls of meshes, outside which MuJoCo computes no contact, to their vertices.

    MuJoCo's own enclose the meshes' boxes: twice as many pairs of links come near enough for an exact test.
    """
    for geom in np.flatnonzero(world.geom_type == mujoco.mjtGeom.mjGEOM_MESH):
        mesh = world.geom_dataid[geom]
        first, count = world.mesh_vertadr[mesh], world.mesh_vertnum[mesh]
        vertices = world.mesh_vert[first : first + count].astype(np.float64)
        world.geom_rbound[geom] = np.linalg.norm(vertices, axis=1).max() * (1 + 1e-9)


def robot_on_floor(
    robot: Robot,
    strikers: Sequence[str],
    perturbation: Perturbation,
    solver: MujocoOptions,
    height: float | None = 0.0,
) -> tuple[Any, list[Any]]:
    """Specification of :func:`build_world`'s model without target and solids, and its bodies.

    strikers : frames of the model that hit.  height : of the floor [m]; None: nothing can touch it.

    The bodies are those of :func:`robot_bodies`.
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
    """Specification of an empty world with the robot's gravity and these options."""
    mujoco = mujoco_module()
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    # inertias are taken as they are: balancing would change those that are not physical, without a word
    spec.compiler.balanceinertia = False
    spec.option.timestep = solver.step
    spec.option.iterations, spec.option.tolerance = solver.iterations, solver.tolerance
    spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    # no automatic reset on divergence: the engine raises an error
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_AUTORESET
    spec.option.gravity = robot.model.gravity.linear
    return spec


def _solids(
    mujoco: Any,
    spec: Any,
    bodies: list[Any],
    scene: Scene,
    near: Sequence[tuple[int, int]],
    in_contact: Sequence[int],
) -> None:
    """Adds the geoms of the solids that are needed, and their colliding pairs."""
    solids = scene.solids.solids
    target = spec.worldbody.add_body(name="target", mocap=True)
    for k in sorted({*in_contact, *(k for pair in near for k in pair if k != FLOOR)}):
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
        # no general collisions: only the explicit pairs below collide
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
    """Shape and placement of a geom that is an inflated box: sphere, capsule or box.

    solid : a `Solid` without vertices, or a body of the world.
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
    """The bodies of :func:`robot_bodies`, with spheres at the soles' corners, striking points and payload."""
    model = robot.model
    bodies = robot_bodies(mujoco, spec, robot)
    for sole in robot.soles:
        frame = model.frames[model.getFrameId(sole.frame)]
        for k, corner in enumerate(sole.polygon):
            centre = frame.placement.act(np.array([*corner, CORNER_RADIUS]))
            sphere = bodies[frame.parentJoint].add_geom(
                name=f"sole {sole.frame} {k}",
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=[CORNER_RADIUS, 0.0, 0.0],
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
        # a radius of gyration of 1 cm, as a body needs an inertia
        _inertial(load, perturbation.payload, np.zeros(3), 1e-4 * perturbation.payload * np.eye(3))
    return bodies


def robot_bodies(mujoco: Any, spec: Any, robot: Robot) -> list[Any]:
    """Adds the robot's links and joints; returns the body of each joint of the model, the world first.

    The bodies are named ``body <joint>``, and have no geoms. A joint without a link of its own, as of an
    MJCF's body with several, becomes a joint of the next body in the chain. A link without mass is a body
    of its own, of `MASSLESS`, as strikers and soles may be on it.
    """
    model = robot.model
    bodies = [spec.worldbody] * model.njoints
    of_links = {frame.parentJoint for frame in model.frames if frame.type != pin.FrameType.JOINT}
    made = {0}
    for j in range(1, model.njoints):
        inertia, chain = model.inertias[j], list(model.supports[j])
        if not inertia.mass:
            if j not in of_links:
                continue
            inertia = MASSLESS
        parent = max(made.intersection(chain))  # joints are numbered along their chain
        made.add(j)
        joints, placement, placements = chain[chain.index(parent) + 1 :], pin.SE3.Identity(), list[Any]()
        for i in joints:
            # placements of all joints of the chain in the body's parent, at zero angles
            placement = placement * model.jointPlacements[i]
            placements.append(placement)
        body = bodies[parent].add_body(
            name=f"body {model.names[j]}", pos=placement.translation, quat=quaternion(placement.rotation)
        )
        bodies[j] = body
        _inertial(body, inertia.mass, inertia.lever, inertia.inertia)
        if model.joints[j].nv == 6:
            body.add_freejoint(name=model.names[j])
            continue
        for i, joint_placement in zip(joints, placements, strict=True):
            _add_joint(mujoco, spec, body, robot, i, placement.actInv(joint_placement))
    return bodies


def _add_joint(mujoco: Any, spec: Any, body: Any, robot: Robot, j: int, at: Any) -> None:
    """Adds joint j of the model to a body, at this placement in it.

    A joint that follows another gets an equality constraint with its law, and no armature of its own.
    """
    model, subspace = robot.model, axis_of(robot.model, j).subspace
    turns, coupling = bool(np.any(subspace[3:])), robot.couplings.get(str(model.names[j]))
    stiffness, rest = robot.springs.get(str(model.names[j]), (0.0, 0.0))
    spring = {"stiffness": stiffness, "springref": rest} if stiffness else {}
    body.add_joint(
        name=model.names[j],
        type=mujoco.mjtJoint.mjJNT_HINGE if turns else mujoco.mjtJoint.mjJNT_SLIDE,
        axis=at.rotation @ (subspace[3:] if turns else subspace[:3]),
        pos=at.translation,
        # a follower's armature is already in that of its leader
        armature=0.0 if coupling else float(model.armature[model.joints[j].idx_v]),
        **spring,
    )
    if coupling is not None:
        law = _as_hard_as_possible(spec.add_equality(), spec.option.timestep)
        law.type, law.name1, law.name2 = mujoco.mjtEq.mjEQ_JOINT, model.names[j], coupling.leader
        law.data[:5] = [coupling.offset, coupling.ratio, 0.0, 0.0, 0.0]


def _as_hard_as_possible(equality: Any, step: float) -> Any:
    """The equality constraint, as hard as MuJoCo permits with this step [s]."""
    equality.solref = [_MIN_TIME_CONSTANT * step, 1.0]
    equality.solimp = [_MAX_IMPEDANCE, _MAX_IMPEDANCE, 1e-3, 0.5, 2.0]
    return equality


def put_followers(world: Any, robot: Robot, qpos: Array, qvel: Array) -> None:
    """Sets positions and velocities, in place, of joints that follow others, by their laws."""
    for name, (leader, ratio, offset) in robot.couplings.items():
        own, other = world.joint(name), world.joint(leader)
        qpos[own.qposadr[0]] = ratio * qpos[other.qposadr[0]] + offset
        qvel[own.dofadr[0]] = ratio * qvel[other.dofadr[0]]


def add_welds(spec: Any, bodies: Sequence[Any], robot: Robot, frames: Sequence[str], step: float) -> None:
    """Welds these frames of the robot to the ground, as hard as MuJoCo permits with this step [s].

    bodies : of :func:`robot_bodies`.
    """
    mujoco = mujoco_module()
    for name in frames:
        frame = robot.model.frames[robot.model.getFrameId(name)]
        bodies[frame.parentJoint].add_site(
            name=name, pos=frame.placement.translation, quat=quaternion(frame.placement.rotation)
        )
        spec.worldbody.add_site(name=f"ground {name}")
        weld = _as_hard_as_possible(spec.add_equality(), step)
        weld.type, weld.objtype = mujoco.mjtEq.mjEQ_WELD, mujoco.mjtObj.mjOBJ_SITE
        weld.name1, weld.name2 = name, f"ground {name}"
    if frames:
        spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE  # `Welds.wrenches` reads it


def _surface(geom: Any, perturbation: Perturbation, *, sole: bool) -> None:
    """Sets the contact parameters of the floor, or of a corner of a sole."""
    geom.contype, geom.conaffinity = int(sole), int(not sole)  # soles touch the floor, not each other
    # of two geoms MuJoCo takes the larger friction, so floor and soles have the same
    geom.friction = [perturbation.friction, 1e-3, 1e-4]
    geom.condim = 3
    geom.solref = [perturbation.floor_time, 1.0]
    # As soft as a rubber sole: with a higher impedance the corners leave the floor by micrometres, many times
    # in a millisecond, and force and ZMP of a single step are meaningless (the motion hardly changes). The
    # same impedance at all depths makes the floor linear.
    geom.solimp = [0.5, 0.5, 5e-4, 0.5, 2.0]


def _inertial(body: Any, mass: float, centre: Any, inertia: Any) -> None:
    """Sets mass [kg], centre (3,) [m] and inertia (3, 3) [kg m^2] about it, in the body's axes."""
    body.explicitinertial = True
    body.mass = float(mass)
    body.ipos = centre
    _, second, axes = principal_moments(inertia)
    least = MIN_SECOND_MOMENT * second.max()
    # MuJoCo refuses plates and rods without thickness, and their rounded decimals, which a robot may have
    if second.min() < least:
        second = np.maximum(second, least)
        inertia = axes @ np.diag(second.sum() - second) @ axes.T
    i = np.asarray(inertia)
    body.fullinertia = [i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]]


def quaternion(rotation: Any) -> list[float]:
    """Quaternion (w, x, y, z), in MuJoCo's order, of a rotation (3, 3)."""
    x, y, z, w = pin.Quaternion(np.asarray(rotation)).normalized().coeffs()
    return [w, x, y, z]


class MujocoRobot:
    """A robot in a compiled MuJoCo model, with contact forces at striking points.

    world, data : MuJoCo's model and its data
    dof, qpos_index : indices of the joints' rates in qvel and angles in qpos
    sites : of the h striking points
    normal_jacobian (h, nv) : of their speeds along the normal, at the last call of `speeds_along`
    force_map (h, nv) : generalized forces of a unit of normal force at each, friction included;
        without friction the same array; with friction, `update_friction` and `bend` set it
    deflections (h, 3), normal_forces (h,) : of the bristles [m], and the last forces [N] of `bend`
    mobility : inverse mass [1/kg] of the target across the normal, see `tangential_mobility`
    tangential (2, 3) : displacement [m] and velocity [m/s] of the target across the normal
    """

    def __init__(
        self,
        robot: Robot,
        world: Any,
        *strikers: str,
        friction: ContactFriction | None = None,
        mobility: float = 0.0,
    ) -> None:
        self.mujoco, self.robot, self.world = mujoco_module(), robot, world
        self.data = self.mujoco.MjData(world)
        self.floating = robot.floating
        self._n, self._nq, self._nv = robot.n, robot.nq, robot.nv
        joints = [world.joint(name) for name in robot.joint_names]
        self.dof = np.array([joint.dofadr[0] for joint in joints])
        self.qpos_index = np.array([joint.qposadr[0] for joint in joints])
        self.sites = np.array([world.site(striker).id for striker in strikers], dtype=np.intp)
        self._jacobians = np.zeros((len(strikers), 3, world.nv))  # of the striking points' velocities
        self.normal_jacobian = np.zeros((len(strikers), world.nv))
        self.sliding = None if friction is None else SlidingPoints(friction)
        self.deflections, self.normal_forces = np.zeros((len(strikers), 3)), np.zeros(len(strikers))
        self.mobility, self.tangential = mobility, np.zeros((2, 3))
        self.force_map = self.normal_jacobian if friction is None else np.zeros_like(self.normal_jacobian)

    def put(self, q: Array, v: Array | None = None) -> None:
        """Sets q (nq,) and v (nv,), None: v stays; quantities that depend on them are not updated."""
        d, robot = self.data, self.robot
        if self.floating:
            d.qpos[:3], d.qpos[3:7] = q[:3], q[[6, 3, 4, 5]]  # MuJoCo's quaternions begin with w
        d.qpos[self.qpos_index] = robot.angles.of(q)
        if v is not None:
            if self.floating:
                # MuJoCo's linear velocity is in world axes, Pinocchio's in those of the base
                d.qvel[:3], d.qvel[3:6] = self.base_rotation() @ v[:3], v[3:6]
            d.qvel[self.dof] = v[-robot.n :]
        put_followers(self.world, robot, d.qpos, d.qvel)

    def state(self) -> tuple[Array, Array]:
        """q (nq,), v (nv,), in Pinocchio's conventions."""
        qpos, qvel = self.data.qpos, self.data.qvel
        q, v = np.zeros(self._nq), np.zeros(self._nv)
        if self.floating:
            q[:3], q[3:6], q[6] = qpos[:3], qpos[4:7], qpos[3]
            v[:3], v[3:6] = self.base_rotation().T @ qvel[:3], qvel[3:6]
        self.robot.angles.put(q, qpos[self.qpos_index])
        v[-self._n :] = qvel[self.dof]
        return q, v

    def base_rotation(self) -> Array:
        """Rotation (3, 3) of a floating base."""
        rotation = np.zeros(9)
        self.mujoco.mju_quat2Mat(rotation, self.data.qpos[3:7])
        return rotation.reshape(3, 3)

    def striking_points(self) -> Array:
        """Positions (h, 3) [m] of the striking points."""
        return np.asarray(self.data.site_xpos[self.sites])

    def speeds_along(self, normal: Array) -> Array:
        """Speeds (h,) [m/s] of the striking points along a normal (3,); updates `normal_jacobian`."""
        for k, site in enumerate(self.sites):
            self.mujoco.mj_jacSite(self.world, self.data, self._jacobians[k], None, site)
            self.normal_jacobian[k] = normal @ self._jacobians[k]
        return np.asarray(self.normal_jacobian @ self.data.qvel)

    def update_friction(self, normal: Array) -> None:
        """Updates the force map of friction, that of bristles for the last normal forces.

        normal (3,) : of the last `speeds_along`.
        """
        if self.sliding is not None:
            self.sliding.surface = self.tangential[1]
            self.sliding.update(normal, self._jacobians, self.data.qvel)
            self.force_map = self.sliding.force_map(self.deflections, self.normal_forces)

    def release(self, step: float) -> None:
        """Advances a target that moves across the normal by a step [s] without contact; releases bristles."""
        if self.sliding is not None:
            self.deflections, self.normal_forces = 0.0 * self.deflections, 0.0 * self.normal_forces
            self.tangential = np.array([self.tangential[0] + step * self.tangential[1], self.tangential[1]])

    def bend(self, forces: Array, step: float) -> None:
        """Advances the bristles by a step [s] under normal forces (h,) [N], and sets `force_map`.

        Advances a target that friction moves across the normal, too.
        """
        if self.sliding is not None and self.sliding.bristles:
            self.normal_forces = forces
            self.deflections = self.sliding.deflected(self.deflections, forces, step)
            self.force_map = self.sliding.force_map(self.deflections, forces)
        if self.sliding is not None and self.mobility:
            # semi-implicit Euler, as MuJoCo's: the displacement follows from the new velocity
            velocity = self.tangential[1] + step * self.mobility * self.sliding.on_target(forces)
            self.tangential = np.array([self.tangential[0] + step * velocity, velocity])

    def apply(self, torque: Array, forces: Array | None) -> None:
        """Applies torques (n,) [N m] at the joints, and contact forces (h,) [N] against the normal."""
        applied = self.data.qfrc_applied
        applied[:] = 0.0 if forces is None else -forces @ self.force_map
        applied[self.dof] += torque


class Welds:
    """Welds of a compiled world, added last by :func:`impactopt.simulation.mujoco_world.add_welds`.

    frames : the welded ones, in the order in which they were added. Equalities before them are the laws of
        joints that follow others.
    """

    def __init__(self, world: Any, frames: Sequence[str]) -> None:
        self.mujoco, self.world = mujoco_module(), world
        self.frames = [world.site(name).id for name in frames]
        self.ground = [world.site(f"ground {name}").id for name in frames]
        world.site_sameframe[self.ground] = self.mujoco.mjtSameFrame.mjSAMEFRAME_NONE  # `put` moves them
        self._jacobian = np.zeros((6, world.nv))

    def put(self, data: Any) -> None:
        """Sets the welds to the frames' present placements; data must have updated kinematics."""
        for frame, ground in zip(self.frames, self.ground, strict=True):
            self.world.site_pos[ground] = data.site_xpos[frame]
            rotation = np.zeros(4)
            self.mujoco.mju_mat2Quat(rotation, data.site_xmat[frame])
            self.world.site_quat[ground] = rotation

    def wrenches(self, data: Any) -> tuple[Array, Array]:
        """Wrenches (frames, 6) of the world on the frames, world axes, and positions (frames, 3) [m] of them.

        Both are those at the start of the last step.
        """
        d, J = data, self._jacobian
        out, places = np.empty((len(self.frames), 6)), np.empty((len(self.frames), 3))
        if not self.frames:
            return out, places
        efc_J = np.reshape(d.efc_J, (-1, self.world.nv))
        for k, frame in enumerate(self.frames):
            # constraints of MuJoCo: first one for each law of a follower, then six for each weld
            first = 6 * k + self.world.neq - len(self.frames)
            its = slice(first, first + 6)
            self.mujoco.mj_jacSite(self.world, d, J[:3], J[3:], frame)
            # MuJoCo's constraints of a weld are in coordinates of its own: find the wrench with the same
            # generalized forces
            out[k] = np.linalg.lstsq(J.T, efc_J[its].T @ d.efc_force[its], rcond=None)[0]
            places[k] = d.site_xpos[frame]
        return out, places


def solids_in_contact(robot: Robot, scene: Scene) -> list[list[tuple[int, int]]]:
    """Pairs of solids that can touch, of each striker: a piece of its link, and a body of the target.

    Raises
    ------
    InputError : a striking link or the target has no body.
    """
    solids, out = scene.solids.solids, []
    targets = [k for k, solid in enumerate(solids) if solid.strikable]
    for striker in scene.strikers:
        joint = robot.model.frames[robot.model.getFrameId(striker)].parentJoint
        links = [k for k, solid in enumerate(solids) if solid.vertices is not None and solid.joint == joint]
        if not links or not targets:
            what = "the striking link" if targets else "the target"
            raise InputError(
                f"contact 'link' needs bodies, and {what} has none: switch on [terms.keep_out] and give "
                "[target.body] a shape, or take contact 'point'"
            )
        out.append([(link, body) for link in links for body in targets])
    return out


class LinkContact:
    """Deepest point of each striking link in the target, by MuJoCo's distances between convex bodies.

    pairs : of :func:`solids_in_contact`.
    """

    def __init__(self, mujoco: Any, world: Any, pairs: list[list[tuple[int, int]]]) -> None:
        self._mujoco, self._world = mujoco, world
        geom = {k: int(world.geom(f"solid {k}").id) for of_one in pairs for pair in of_one for k in pair}
        self._pairs = [[(geom[link], geom[body]) for link, body in of_one] for of_one in pairs]
        self._ends = np.zeros(6)

    def deepest(self, data: Any, striker: int) -> tuple[float, Array | None]:
        """Depth [m] of a striker's link in the target, and its deepest point (3,) [m].

        Without a touch the depth is negative. The point is None beyond `MAX_DISTANCE`.
        """
        distance, point = MAX_DISTANCE, None
        for link, body in self._pairs[striker]:
            # the distance up to a limit, negative in penetration; `_ends` gets the nearest points, first that
            # of the link
            of_pair = self._mujoco.mj_geomDistance(self._world, data, link, body, MAX_DISTANCE, self._ends)
            if of_pair < distance:
                distance, point = of_pair, self._ends[:3].copy()
        return -distance, point
