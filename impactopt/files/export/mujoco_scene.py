"""MuJoCo: a scene with robot, floor and target, the reference, and a script that plays it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.optimize import brentq

from impactopt.arrays import Array
from impactopt.bodies.solids import Solid, simplified
from impactopt.bodies.visuals import joined_visuals
from impactopt.bodies.world import face_axes
from impactopt.contact.laws import ContactLaw, HertzDamped, HuntCrossley, KelvinVoigt, SpringDamper
from impactopt.contact.targets import Board, FreeMass, Nail, RigidWall
from impactopt.errors import InputError
from impactopt.files.export.content import Export
from impactopt.files.export.motion import Motion
from impactopt.problem.problem import ImpactProblem
from impactopt.simulation.mujoco_world import (
    MujocoOptions,
    mujoco_module,
    no_log_file,
    primitive,
    put_followers,
    quaternion,
    robot_on_floor,
)
from impactopt.simulation.perturbation import Perturbation

SCENE, REFERENCE, PLAYER, MESHES = "scene.xml", "reference.npz", "play.py", "meshes"
MAX_STEP = 2e-4  # [s]
HAND_MASS = 1.0  # [kg] for the contact's fastest time, if the target is heavier
MAX_TRIANGLES, CELL = 20_000, 0.004  # of a mesh, and the cells [m] to which a finer one is simplified
MIN_VERTICES = 4  # of a mesh, by MuJoCo
TARGET_COLOUR, WORLD_COLOUR = (0.72, 0.55, 0.35, 1.0), (0.6, 0.6, 0.65, 0.35)
# contact force [N] at a penetration x [m] and its rate [m/s]; negative values are replaced by zero
LAWS: Mapping[type[ContactLaw], str] = {
    SpringDamper: "stiffness * x + damping * rate * (rate > 0)",
    KelvinVoigt: "stiffness * x + damping * rate",
    HuntCrossley: "stiffness * x**exponent * (1 + 1.5 * dissipation * rate)",
    HertzDamped: "stiffness * x**1.5 + damping * x**0.25 * rate",
}
PLAYER_TEXT = '''\
"""Plays a planned impact motion. Needs mujoco and numpy. Run: python play.py, or python play.py missing"""

import sys
from pathlib import Path

import mujoco
import numpy as np

here, missing = Path(__file__).parent, "missing" in sys.argv[1:]
model = mujoco.MjModel.from_xml_path(str(here / "scene.xml"))
data, ref = mujoco.MjData(model), np.load(here / "reference.npz")
mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
of = "missed_" if missing and "missed_time" in ref else ""  # the same until the target is missed
time, table = ref[of + "time"], np.hstack([ref[of + x] for x in ("position", "velocity", "effort")])
joints, kp, kd, impulse = [model.joint(name) for name in ref["joints"]], ref["kp"], ref["kd"], 0.0
place, dof, n = [j.qposadr[0] for j in joints], [j.dofadr[0] for j in joints], len(joints)
{numbers}

while data.time < time[-1] + 0.5:
{before}    mujoco.mj_step1(model, data)
    i = min(int(np.searchsorted(time, data.time, side="right")), len(time) - 1)
    s = min((data.time - time[i - 1]) / (time[i] - time[i - 1]), 1.0)
    q, v, effort = np.split((1 - s) * table[i - 1] + s * table[i], 3)
    data.ctrl[:n] = effort + kp * (q - data.qpos[place]) + kd * (v - data.qvel[dof])
    x, rate = data.actuator_length[n], data.actuator_velocity[n]  # how deep, and how fast deeper
    force = 0.0 if missing or x < 0 else max(0.0, {law})
    data.ctrl[n], impulse = -force, impulse + force * model.opt.timestep
    mujoco.mj_step2(model, data)
print(f"impulse {{impulse:.3f}} N s, planned {{float(ref['impulse']):.3f}} N s")
{after}'''
NAIL = """\
    nail_now = nail_depth + data.joint("target").qpos
    model.joint("target").frictionloss = nail_resistance + nail_hardening * nail_now
"""
BOARD = """\
    if stiffness_board * data.joint("target").qpos[0] > breaking_force:  # from then on two free halves
        model.joint("target").stiffness = model.joint("target").damping = 0.0
"""
BASE = """\
print(f"root link at the end: {data.qpos[2]:.3f} m high, planned {ref[of + 'base_position'][-1, 2]:.3f} m")
"""


def write(export: Export, directory: Path) -> None:
    """`scene.xml` with its meshes, `reference.npz`, and `play.py`.

    The joint ``target`` slides along the normal. The actuator ``contact`` applies the contact force; its
    length is the penetration of the striking point.

    Raises
    ------
    InputError : MuJoCo is not installed; a law or a target without a formula here; two strikers, supporting
        hands, friction, a moving board.
    """
    p = export.problem
    if type(p.law) not in LAWS or type(p.target) not in (FreeMass, RigidWall, Nail, Board):
        raise InputError(
            f"mujoco: there is no formula for {type(p.law).__name__} on {type(p.target).__name__}; scenes "
            f"have the laws {', '.join(law.__name__ for law in LAWS)}, and the package's targets: export to "
            "csv instead"
        )
    if p.second is not None or p.stance.held_hands(p.robot):
        raise InputError(
            "mujoco: the scene has one striker, and no supporting hand; export to csv instead, or replay "
            "here (impactopt validate)"
        )
    if p.friction is not None:
        raise InputError(
            "mujoco: the scene's contact has no friction at the target, the plan has: export to csv instead, "
            "or replay here (impactopt validate)"
        )
    if isinstance(p.target, Board) and p.target.initial_velocity:
        raise InputError("mujoco: the scene's board stands still before contact; export to csv instead")
    try:
        with no_log_file():
            _write_scene(export, directory)
    except ValueError as error:  # of MuJoCo's compiler
        if isinstance(error, InputError):
            raise
        raise InputError(f"MuJoCo refuses the scene of {p.name or p.robot.name!r}: {error}") from error
    np.savez(directory / REFERENCE, **_reference(export))
    (directory / PLAYER).write_text(_player(p), encoding="utf-8")


def _write_scene(export: Export, directory: Path) -> None:
    p, mujoco, step = export.problem, mujoco_module(), _step(export)
    striker = p.robot.striker(p.striker).model_frame
    spec, bodies = robot_on_floor(
        p.robot, (striker,), Perturbation(), MujocoOptions(step=step), p.ground_height
    )
    spec.modelname, spec.meshdir = p.name or p.robot.name, MESHES
    _draw_robot(mujoco, spec, bodies, export, directory / MESHES)
    _add_target(mujoco, spec, p, step)
    _add_world(mujoco, spec, p)
    _add_actuators(mujoco, spec, export)
    _add_keyframes(spec, export)
    (directory / SCENE).write_text(spec.to_xml(), encoding="utf-8")
    mujoco.MjModel.from_xml_path(str(directory / SCENE))  # raises a ValueError if it cannot be read


def _step(export: Export) -> float:
    """Step [s] for which explicit integration of the contact is accurate: a fraction of its fastest time.

    Stiffness and damping are those of the law at the planned peak force.
    """
    p, summary = export.problem, export.planned.record.summary
    peak = float(summary.get("peak_force_N") or 1e3)

    def force(depth: float, rate: float = 0.0) -> float:
        return float(p.law.force(depth, rate))

    depth = float(brentq(lambda x: force(x) - peak, 0.0, 10.0)) if force(10.0) > peak else 1e-3
    stiffness = (force(1.01 * depth) - force(depth)) / (0.01 * depth)
    damping = (force(depth, 1e-3) - force(depth)) / 1e-3
    mass = min(HAND_MASS, p.target.parameters.get("mass", HAND_MASS))
    fastest = (0.04 * np.sqrt(mass / max(stiffness, 1e-9)), 0.1 * mass / max(damping, 1e-9))
    return float(f"{min(MAX_STEP, *fastest):.2g}")


def _draw_robot(mujoco: Any, spec: Any, bodies: list[Any], export: Export, meshes: Path) -> None:
    """Add the robot's visual shapes, one mesh for each joint and colour, without contacts and mass."""
    meshes.mkdir()
    for k, ((joint, colour), solid) in enumerate(joined_visuals(export.robot).items()):
        if len(solid.triangles) > MAX_TRIANGLES:
            solid = simplified(solid, CELL)
        if len(np.unique(solid.vertices.astype(np.float32), axis=0)) < MIN_VERTICES:
            continue  # nothing to see, such as a box without size
        name = f"{k:02d}"
        _write_stl(meshes / f"{name}.stl", solid)
        # inertia of a shell, as MuJoCo refuses meshes without volume
        spec.add_mesh(name=name, file=f"{name}.stl", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        bodies[joint].add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, rgba=[*colour, 1.0], **_visual_only()
        )
    spec.assets = {path.name: path.read_bytes() for path in meshes.iterdir()}


def _write_stl(path: Path, solid: Solid) -> None:
    """Write a solid as binary STL."""
    corners = solid.vertices[solid.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-30
    table = np.zeros(len(corners), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
    table["normal"], table["corners"] = normal, corners
    path.write_bytes(bytes(80) + np.uint32(len(table)).tobytes() + table.tobytes())


def _visual_only() -> dict[str, Any]:
    """Attributes of geoms without contacts and mass."""
    return {"contype": 0, "conaffinity": 0, "mass": 0.0, "group": 2}


def _add_target(mujoco: Any, spec: Any, p: ImpactProblem, step: float) -> None:
    """Add a body whose z axis is the normal, with its face at the origin, on a slide joint if it moves."""
    normal, across, up = face_axes(p.normal)
    axes = np.column_stack([across, up, normal])
    body = spec.worldbody.add_body(name="target", pos=p.point, quat=quaternion(axes))
    body.add_site(name="face")
    target = p.target
    if not isinstance(target, RigidWall):
        body.gravcomp, body.explicitinertial, body.ipos = 1.0, True, np.zeros(3)
        body.mass = float(target.parameters["mass"])
        body.inertia = np.full(3, 1e-3 * body.mass)  # any: it does not rotate
        spring = (
            {"stiffness": target.stiffness, "damping": target.damping} if isinstance(target, Board) else {}
        )
        joint = body.add_joint(
            name="target", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0.0, 0.0, 1.0], **spring
        )
        if isinstance(target, Nail):
            joint.frictionloss = target.resistance + target.hardening * target.depth
            # as stiff as the step allows: softer friction creeps under forces below the resistance
            joint.solref_friction = [2 * step, 1.0]
            joint.solimp_friction = [0.999, 0.9999, 1e-3, 0.5, 2.0]
    place = pin.SE3(axes, np.asarray(p.point)).inverse()
    for solid in p.world:
        if solid.of_target and solid.moves and not solid.core:
            shape = primitive(mujoco, solid)
            moved = place * pin.SE3(solid.rotation, solid.place)
            shape |= {"pos": moved.translation, "quat": quaternion(moved.rotation)}
            body.add_geom(name=solid.name, rgba=TARGET_COLOUR, **shape, **_visual_only())


def _add_world(mujoco: Any, spec: Any, p: ImpactProblem) -> None:
    """Add the bodies of the world, light, and a grid on the floor."""
    for k, solid in enumerate(p.world):
        if not (solid.ground or solid.core or (solid.of_target and solid.moves)):
            shape = primitive(mujoco, solid)
            spec.worldbody.add_geom(name=f"{solid.name} {k}", rgba=WORLD_COLOUR, **shape, **_visual_only())
    spec.worldbody.add_light(pos=[1.0, -2.0, 5.0], dir=[-0.2, 0.4, -1.0], castshadow=True)
    texture, builtin = mujoco.mjtTexture, mujoco.mjtBuiltin
    spec.add_texture(
        name="sky",
        type=texture.mjTEXTURE_SKYBOX,
        builtin=builtin.mjBUILTIN_GRADIENT,
        rgb1=[1.0, 1.0, 1.0],
        rgb2=[0.85, 0.9, 0.95],
        width=64,
        height=384,
    )
    spec.add_texture(
        name="grid",
        type=texture.mjTEXTURE_2D,
        builtin=builtin.mjBUILTIN_CHECKER,
        rgb1=[0.82, 0.84, 0.86],
        rgb2=[0.75, 0.77, 0.80],
        width=200,
        height=200,
    )
    grid = spec.add_material(name="grid", texrepeat=[2, 2], texuniform=True)
    grid.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "grid"
    if p.ground_height is not None:
        spec.geom("floor").material = "grid"
    else:
        spec.geom("floor").rgba = [0.0, 0.0, 0.0, 0.0]


def _add_actuators(mujoco: Any, spec: Any, export: Export) -> None:
    """Add a motor for each joint, in the order of the export, and the contact last."""
    for name, limit in zip(export.joints, export.per_joint(export.robot.torque_limit), strict=True):
        spec.add_actuator(
            name=name,
            target=name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
            forcerange=[-limit, limit],
        )
    # its length is the striker's position along the face's normal; its force acts on both
    spec.add_actuator(
        name="contact",
        target="striker",
        refsite="face",
        trntype=mujoco.mjtTrn.mjTRN_SITE,
        gear=[0.0, 0.0, 1.0, 0.0, 0.0, 0.0],
    )


def _add_keyframes(spec: Any, export: Export) -> None:
    """Add keyframes: `start`, at rest, and `contact`, the planned state just before it."""
    motion, model = export.motion, spec.compile()
    before_contact = int(np.flatnonzero(motion.phase == 0)[-1])
    target_speed = float(export.problem.target.speed_before())
    for name, k in (("start", 0), ("contact", before_contact)):
        qpos, qvel = np.zeros(model.nq), np.zeros(model.nv)
        for column, joint in enumerate(export.joints):
            qpos[model.joint(joint).qposadr[0]] = motion.position[k, column]
            qvel[model.joint(joint).dofadr[0]] = motion.velocity[k, column]
        put_followers(model, export.robot, qpos, qvel)
        if (base := motion.base) is not None:
            qpos[:3], qpos[3:7] = base.position[k], base.quaternion[k]
            turned = pin.Quaternion(*base.quaternion[k]).toRotationMatrix()
            qvel[:3], qvel[3:6] = base.linear[k], turned.T @ base.angular[k]
        if target_speed:
            slide, until = model.joint("target"), float(motion.time[k]) - motion.contact_start
            qpos[slide.qposadr[0]], qvel[slide.dofadr[0]] = target_speed * until, target_speed
        spec.add_key(name=name, qpos=qpos, qvel=qvel, time=float(motion.time[k]))


def _reference(export: Export) -> dict[str, Any]:
    """Arrays of the motion, and of the abort motion with `missed_` before their names."""
    robot = export.robot
    out = {
        "joints": np.array(export.joints),
        **{name: export.per_joint(getattr(robot, name)) for name in ("kp", "kd", "torque_limit")},
        "contact": np.array([export.motion.contact_start, export.motion.contact_end]),
        "impulse": np.array(float(export.planned.record.summary["impulse_Ns"])),
    }
    motions = export.motions
    for prefix, motion in (("", motions["motion"]), ("missed_", motions.get("missed"))):
        out |= {f"{prefix}{name}": value for name, value in _histories(motion)}
    return out


def _histories(motion: Motion | None) -> Iterator[tuple[str, Array]]:
    """Names and arrays of a motion's histories; none for None."""
    names = ("time", "phase", "position", "velocity", "acceleration", "effort", "force", "zmp")
    for name in names if motion is not None else ():
        if getattr(motion, name) is not None:
            yield name, getattr(motion, name)
    if motion is not None and motion.base is not None:
        for field in dataclasses.fields(motion.base):
            yield f"base_{field.name}", getattr(motion.base, field.name)


def _player(problem: ImpactProblem) -> str:
    """The text of `play.py` for a problem whose law is one of `LAWS`."""
    numbers, before, target = dict(problem.law.parameters), "", problem.target
    if isinstance(target, Nail) and target.hardening:
        before = NAIL
        # apart from the parameters of the law
        numbers |= {f"nail_{name}": target.parameters[name] for name in ("resistance", "hardening", "depth")}
    if isinstance(target, Board):
        before = BOARD
        numbers |= {"stiffness_board": target.stiffness, "breaking_force": target.breaking_force}
    return PLAYER_TEXT.format(
        numbers=f"{', '.join(numbers)} = {', '.join(repr(float(x)) for x in numbers.values())}",
        before=before,
        law=LAWS[type(problem.law)],
        after=BASE if problem.soles else "",
    )
