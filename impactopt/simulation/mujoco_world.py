"""A robot and its floor as a MuJoCo model, built body by body from the robot's numbers."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.errors import missing_package
from impactopt.robots.robot import Robot
from impactopt.simulation.collision_geometry import FLOOR
from impactopt.simulation.perturbation import Perturbation
from impactopt.simulation.result import Scene

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
) -> Any:
    """The compiled mujoco.MjModel.

    Joints have the model's names; striking points are the sites ``striker`` and ``striker 2``; each sole of
    the robot, held by the plan or not, has a sphere ``sole <frame> <k>`` under each of its corners. Nothing
    else touches anything, but the pairs of solids (`near`), which push each other back: hulls of links, named
    ``solid <number>``, and bodies of the world; those that move with the target are on the mocap body
    ``target``. The contact law between target and striker is the engine's business. Hands that hold on are
    welded.
    """
    spec, bodies = robot_on_floor(robot, scene.strikers, perturbation, solver, scene.solids.floor)
    _solids(mujoco_module(), spec, bodies, scene, near)
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


def _solids(mujoco: Any, spec: Any, bodies: list[Any], scene: Scene, near: Sequence[tuple[int, int]]) -> None:
    """Geometry of the solids that are in a pair, and the pairs."""
    solids = scene.solids.solids
    target = spec.worldbody.add_body(name="target", mocap=True)
    for k in sorted({k for pair in near for k in pair if k != FLOOR}):
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
    """The robot's links and joints, without anything that touches; one body a joint of the model, in its
    order, the world first. Names are ``body <joint>`` and the joints' own."""
    model = robot.model
    bodies = [spec.worldbody]
    for j in range(1, model.njoints):
        placement = model.jointPlacements[j]
        body = bodies[model.parents[j]].add_body(
            name=f"body {model.names[j]}", pos=placement.translation, quat=quaternion(placement.rotation)
        )
        bodies.append(body)
        inertia = model.inertias[j]
        _inertial(body, inertia.mass, inertia.lever, inertia.inertia)
        if model.joints[j].nv == 6:
            body.add_freejoint(name=model.names[j])
            continue
        data = model.joints[j].createData()
        model.joints[j].calc(data, pin.neutral(model))
        subspace = np.asarray(data.S).reshape(6)
        turns = bool(np.any(subspace[3:]))
        body.add_joint(
            name=model.names[j],
            type=mujoco.mjtJoint.mjJNT_HINGE if turns else mujoco.mjtJoint.mjJNT_SLIDE,
            axis=subspace[3:] if turns else subspace[:3],
            armature=float(model.armature[model.joints[j].idx_v]),
        )
    return bodies


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
        weld = spec.add_equality()
        weld.type, weld.objtype = mujoco.mjtEq.mjEQ_WELD, mujoco.mjtObj.mjOBJ_SITE
        weld.name1, weld.name2 = name, f"ground {name}"
        weld.solref = [_TIME_CONSTANT * step, 1.0]
        weld.solimp = [_IMPEDANCE, _IMPEDANCE, 1e-3, 0.5, 2.0]
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
