"""`Robot`: a Pinocchio model with armature, servo gains, limits, soles, strikers, tools and postures."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from os import PathLike
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from impactopt.arrays import Array, Mask
from impactopt.errors import Mistakes, check_array, check_kind, raw_array
from impactopt.robots import build, checks, tools
from impactopt.robots import mjcf as _mjcf
from impactopt.robots import urdf as _urdf
from impactopt.robots.actuators import MOMENTARY_PEAK, Actuator, known, numbers_of, with_classes
from impactopt.robots.attachments import SoftGrip, Sole, Source, Striker, Tool, read_only
from impactopt.robots.checks import GIVEN, REPAIRED, check_inertias, tell_apart
from impactopt.robots.couplings import (
    Coupling,
    Ranges,
    Tendon,
    check_tendons,
    couplings_of,
    follower_axes,
    restore_followers,
)
from impactopt.robots.model import ForwardKinematics, JointAngles
from impactopt.robots.tools import check_sole, with_hinges

__all__ = ["Robot", "Sole", "Striker", "Tool"]

MAX_GRAVITY = 1e3  # [m/s2]
PerJoint = float | Mapping[str, float] | ArrayLike | None


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Robot:
    """A robot, checked when built. Arrays are read-only; `dataclasses.replace` makes a changed copy.

    Arrays of length n are of the joints without the free-flyer and without followers (`couplings`), in the
    order of Pinocchio's v. Units are those of revolute joints; for a prismatic joint read m, m/s, N, kg.

    Attributes
    ----------
    name : of the robot.
    model : pin.Model without locked joints, with armature and an OP_FRAME per striker and added sole.
    kp, kd : (n,) servo stiffness [N m/rad] and damping [N m s/rad].
    torque_limit, velocity_limit : (n,) [N m], [rad/s], largest magnitudes.
    lower, upper : (n,) position limits [rad]; infinite for a continuous joint.
    tendons : ranges of sums of joint angles.
    actuators : one per joint, with the known fields; their `armature` is None, as `armature` has it.
    soles : flat feet, in a fixed order.
    strikers : by name.
    postures : named configurations, (nq,) in Pinocchio's convention. Those of a floating robot are placed so
        that the mean of the soles on the ground is at the origin, at yaw 0 (`place`).
    disable_collisions : pairs of links that may pass through each other: an SRDF's and additional ones.
    tools : tools attached to links.
    source : preset or file that it is from, None for a model made in Python.
    urdf, mjcf : file with the shapes of the links, for collisions and pictures; None: boxes of their
        inertias.

    Raises
    ------
    InputError : naming the link, joint or frame and the fix: non-physical inertias; limits that are missing,
        zero or crossed; joints with several degrees of freedom; gains too fast for the inertia they act on;
        postures outside the limits; unknown frames.
    """

    name: str
    model: pin.Model
    kp: Array
    kd: Array
    torque_limit: Array
    velocity_limit: Array
    lower: Array
    upper: Array
    soles: tuple[Sole, ...] = ()
    strikers: Mapping[str, Striker] = field(default_factory=dict)
    postures: Mapping[str, Array] = field(default_factory=dict)
    disable_collisions: tuple[tuple[str, str], ...] = ()
    tools: tuple[Tool, ...] = ()
    source: Source | None = None
    urdf: str | None = None
    mjcf: str | None = None
    actuators: tuple[Actuator, ...] = ()
    tendons: tuple[Tendon, ...] = ()

    def __post_init__(self) -> None:
        check_kind("model", self.model, pin.Model)
        check_kind("strikers", self.strikers, Mapping)
        check_kind("postures", self.postures, Mapping)
        build.check_parts("soles", self.soles, Sole)
        checks.check_joint_types(self.model)
        checks.check_joints(self.joint_names, self.name)
        for name in ("kp", "kd", "torque_limit", "velocity_limit", "lower", "upper"):
            value = check_array(f"{name} of {self.name!r}", getattr(self, name), (self.n,), finite=False)
            object.__setattr__(self, name, read_only(value))
        object.__setattr__(self, "soles", tuple(self.soles))
        object.__setattr__(self, "tendons", tuple(self.tendons))
        object.__setattr__(self, "strikers", dict(self.strikers))
        found, limits = Mistakes(), (self.torque_limit, self.velocity_limit, self.lower, self.upper)
        found.attempt(lambda: check_inertias(self.model))
        kind = "URDF" if self.urdf else "MJCF" if self.mjcf else ""
        found.attempt(lambda: checks.check_limits(self.joint_names, *limits, kind))
        found.raise_if_any(f"robot {self.name!r}")
        object.__setattr__(self, "actuators", known(self.actuators or (Actuator(),) * self.n))
        checks.check_actuators(self.joint_names, self.actuators)
        check_tendons(self.tendons, self.joint_names)
        checks.check_springs(self.model, self.springs)
        for sole in self.soles:
            check_sole(self.model, sole)
        for striker in self.strikers.values():
            checks.check_frame(
                self.model, striker.model_frame, f"striker {striker.name!r} (see Robot.with_striker)"
            )
        postures = {}
        for name, q in self.postures.items():
            posture = self.check_configuration(q, name=f"posture {name!r}")
            self.check_limits(posture, name=f"posture {name!r}")
            postures[name] = read_only(posture)
        object.__setattr__(self, "postures", postures)
        configurations = [pin.neutral(self.model), *postures.values()]
        checks.check_gains(self.model, self.joint_names, self.kp, self.kd, configurations)

    @classmethod
    def from_urdf(
        cls,
        path: str | PathLike[str],
        *,
        srdf: str | PathLike[str] | None = None,
        name: str | None = None,
        floating: bool = True,
        locked: Iterable[str] | Mapping[str, float] = (),
        inertias: str = GIVEN,
        **options: Any,
    ) -> Robot:
        """A robot from its URDF, and its SRDF's named postures and rotors when there is one.

        Parameters
        ----------
        path, srdf : the files. Meshes are read later, when the bodies or a picture need them.
        name : default the URDF's own name.
        floating : with a free-flyer at the root; else the root link is fixed to the world.
        locked : joints to remove from the model: names (at angle 0), or angles [rad] by name.
        inertias : "given", or "repaired" to change non-physical ones, which `source.repairs` lists.
        options : as of `from_model`.

        Raises
        ------
        InputError : no such file; unless their joints are locked, Gazebo's loops, and a <mimic> that is not
            supported.
        """
        read = _urdf.read_urdf(path, srdf, floating=floating, locked=locked, repaired=inertias == REPAIRED)
        given = {"srdf": srdf, "name": name, "floating": floating, "locked": locked, "inertias": inertias}
        model, all_options, source = read.made(path, given, options)
        robot = cls.from_model(model, **all_options)
        pairs = (*build.srdf_pairs(srdf), *robot.disable_collisions)
        return dataclasses.replace(robot, disable_collisions=pairs, source=source)

    @classmethod
    def from_mjcf(
        cls,
        path: str | PathLike[str],
        *,
        name: str | None = None,
        floating: bool | None = None,
        locked: Iterable[str] | Mapping[str, float] = (),
        inertias: str = GIVEN,
        **options: Any,
    ) -> Robot:
        """A robot from MuJoCo's MJCF: its armature, friction, actuators' limits and gains, keyframes, sites.

        Parameters
        ----------
        path : the file, which MuJoCo compiles.
        floating : with a free-flyer at the root, or fixed to the world; None: as in the file.
        name, locked, inertias : as of `from_urdf`.
        options : as of `from_model`. MJCF has no velocity limits. Each site on a moving link becomes a
            striker, each keyframe inside the limits a posture.

        Raises
        ------
        InputError : no MuJoCo; no robot; ball joints; unless their joints are locked, tendons, loops, and
            joints that follow others nonlinearly.
        """
        read = _mjcf.read_mjcf(path, floating=floating, locked=locked)
        given = {"name": name, "floating": floating, "locked": locked, "inertias": inertias}
        model, all_options, source = read.made(path, given, options)
        return dataclasses.replace(cls.from_model(model, **all_options), source=source)

    @classmethod
    def from_model(
        cls,
        model: pin.Model,
        *,
        name: str | None = None,
        armature: PerJoint = None,
        rotor: Mapping[str, tuple[float, float]] | None = None,
        kp: PerJoint = None,
        kd: PerJoint = None,
        torque_limit: PerJoint = None,
        velocity_limit: PerJoint = None,
        position_limit: Mapping[str, tuple[float, float]] | ArrayLike | None = None,
        soles: Sequence[Sole] = (),
        strikers: Sequence[Striker] = (),
        postures: Mapping[str, Mapping[str, float] | ArrayLike] | None = None,
        disable_collisions: Sequence[tuple[str, str]] = (),
        urdf: str | PathLike[str] | None = None,
        mjcf: str | PathLike[str] | None = None,
        actuators: Mapping[str, Actuator] | None = None,
        gravity: ArrayLike | None = None,
        tendons: Sequence[Tendon] = (),
    ) -> Robot:
        """A robot from a pin.Model (which is copied): a free-flyer, if any, first, and then one-DOF joints.

        Values by joint are one number for all joints, a mapping from joint names, or (n,) numbers; joints
        that are not in a mapping keep the default.

        Parameters
        ----------
        armature : reflected rotor inertia [kg m2]; default the model's own (an SRDF's rotors).
        rotor : (rotor inertia [kg m2], gear ratio) by joint: armature = inertia x ratio^2. `armature` takes
            precedence.
        kd : servo damping [N m s/rad]; default 1.5 s/rad times the torque limit, but at most 150.
        kp : servo stiffness [N m/rad]; default 30 1/s times kd.
        torque_limit, velocity_limit : default the model's.
        position_limit : (lower, upper) [rad] by joint, or (n, 2); default the model's.
        soles, strikers : contact surfaces and striking points.
        postures : by name: (nq,) configurations, or joint angles [rad] by name, which change the model's
            posture of that name (an SRDF's), or else zero. The model's other postures are kept.
        disable_collisions : pairs of links that may pass through each other.
        urdf, mjcf : file with the links' visual shapes, for pictures, and collision shapes, for clearance.
        actuators : motors and gears, as of `with_actuators`; default friction is the model's.
        gravity (3,) : [m/s2], world axes; default the model's.
        tendons : ranges of sums of joint angles.
        """
        check_kind("model", model, pin.Model)
        build.check_parts("soles", soles, Sole)
        build.check_parts("strikers", strikers, Striker)
        model = model.copy()
        tell_apart(model)
        checks.check_joint_types(model)
        if gravity is not None:
            model.gravity.linear = check_array("gravity [m/s2]", gravity, (3,), most=MAX_GRAVITY)
        joints = build.joint_names(model)
        base = model.nv - len(joints)
        model.armature[base:] = build.armature(model, joints, armature, rotor or {})
        drives = with_classes(actuators or {}, joints, build.frictions(model, joints), model)
        limit = build.per_joint("torque_limit", torque_limit, joints, build.effort_limit(model)[base:])
        speed = build.per_joint("velocity_limit", velocity_limit, joints, build.velocity_limit(model)[base:])
        lower, upper = build.position_limit(model, joints, position_limit)
        damping = build.per_joint("kd", kd, joints, build.default_kd(limit))
        for sole in soles:
            if sole.parent is not None:
                build.add_frame(model, sole.frame, sole.parent, sole.placement, f"sole {sole.name!r}")
        for striker in strikers:
            build.add_striker(model, striker)
        numbers: dict[str, Any] = {"torque_limit": limit, "velocity_limit": speed, "lower": lower}
        stiffness = build.per_joint("kp", kp, joints, build.default_kp(damping))
        numbers |= {"upper": upper, "kp": stiffness, "kd": damping, "actuators": drives}
        read = build.read_postures(model, postures or {})
        model, numbers, read = with_hinges(model, soles, numbers, read)
        robot = cls(
            name=name or model.name,
            model=model,
            **numbers,
            soles=tuple(build.by_name("sole", soles).values()),
            strikers=build.by_name("striker", strikers),
            disable_collisions=build.link_pairs(model, disable_collisions),
            urdf=None if urdf is None else str(urdf),
            mjcf=None if mjcf is None else str(mjcf),
            tendons=tuple(tendons),
        )
        return dataclasses.replace(robot, postures={pose: robot.place(q) for pose, q in read.items()})

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_axes": follower_axes(self.model)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        axes = state.pop("_axes")
        self.__dict__.update(state)
        restore_followers(self.model, axes)

    def __repr__(self) -> str:
        """One line, without model and arrays."""
        return f"<Robot {self.name!r}: {self.n} joints, strikes with {', '.join(self.strikers) or 'nothing'}>"

    @cached_property
    def floating(self) -> bool:
        """True if the root is a free-flyer."""
        return build.is_floating(self.model)

    @cached_property
    def n(self) -> int:
        """Number of joints, the free-flyer left out."""
        return int(self.model.nv) - (6 if self.floating else 0)

    @cached_property
    def nq(self) -> int:
        return int(self.model.nq)

    @cached_property
    def nv(self) -> int:
        return int(self.model.nv)

    @cached_property
    def forward_kinematics(self) -> ForwardKinematics:
        """Placements of its joints at many configurations."""
        return ForwardKinematics(self.model)

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        return build.joint_names(self.model)

    @property
    def joint_models(self) -> tuple[Any, ...]:
        """(n,) Pinocchio's models of its joints."""
        return tuple(build.moving_joints(self.model))

    @property
    def prismatic(self) -> Mask:
        """(n,) mask of prismatic joints: their SI units are m, N and kg."""
        return build.prismatic(self.model)

    @cached_property
    def angles(self) -> JointAngles:
        """Angles of its joints in configurations."""
        return JointAngles(self.joint_models)

    @cached_property
    def couplings(self) -> dict[str, Coupling]:
        """Couplings by the follower's name. Followers have no motor, and are not in `joint_names`."""
        return couplings_of(self.model)

    @cached_property
    def ranges(self) -> Ranges:
        """Position limits of the joints, and ranges of the tendons."""
        return Ranges.of(self.joint_names, self.lower, self.upper, self.tendons)

    @property
    def armature(self) -> Array:
        """(n,) reflected rotor inertia [kg m2], a copy from `model.armature`."""
        return read_only(np.array(self.model.armature[self.nv - self.n :], dtype=np.float64))

    @property
    def gear_limit(self) -> Array:
        """(n,) momentary peak torque of gears over the torque limit, 2 if not known; inf without a gear."""
        known = numbers_of(self.actuators, "momentary_torque") / self.torque_limit
        limit = np.where(np.isnan(known), MOMENTARY_PEAK, known)
        return read_only(np.where(self.passive, np.inf, limit))

    @cached_property
    def springs(self) -> dict[str, tuple[float, float]]:
        """Stiffness [N m/rad] and rest angle [rad] of springs in parallel to the motors, by joint."""
        return {
            joint: (float(actuator.spring_stiffness), float(actuator.spring_rest or 0.0))
            for joint, actuator in zip(self.joint_names, self.actuators, strict=True)
            if actuator.spring_stiffness
        }

    @cached_property
    def _spring_parameters(self) -> Array:
        """(2, n) stiffness and rest angle of each joint's spring, zero without one."""
        return np.array([self.springs.get(joint, (0.0, 0.0)) for joint in self.joint_names]).T

    def spring_torque(self, q: Array) -> Array:
        """(n,) [N m] of the motors against the springs at q (nq,): stiffness times the angle from rest."""
        # as arrays: for a person's 41 springs, Pinocchio's joints one by one take 0.1 ms
        stiffness, rest = self._spring_parameters
        return np.asarray(stiffness * (self.angles.of(q) - rest))

    def inverse_dynamics(self, data: Any, q: Array, v: Array, a: Array) -> Array:
        """Forces (nv,) [N, N m] of a motion q (nq), v, a (nv): `pin.rnea` and the springs' torques."""
        return self._plus_springs(q, pin.rnea(self.model, data, q, v, a))

    def nonlinear_effects(self, data: Any, q: Array, v: Array) -> Array:
        """Forces (nv,) [N, N m] without acceleration: `pin.nonLinearEffects` and the springs' torques."""
        return self._plus_springs(q, pin.nonLinearEffects(self.model, data, q, v))

    def generalized_gravity(self, data: Any, q: Array) -> Array:
        """Forces (nv,) [N, N m] at rest: `pin.computeGeneralizedGravity` and the springs' torques."""
        return self._plus_springs(q, pin.computeGeneralizedGravity(self.model, data, q))

    def capture_point(self, data: Any, q: Array, v: Array) -> Array:
        """Capture point (2,) [m] on the ground: c + cdot sqrt(c_z / g) (Koolen et al., IJRR 2012)."""
        com = pin.centerOfMass(self.model, data, q, v)
        fall = np.sqrt(com[2] / np.linalg.norm(self.model.gravity.linear))
        return np.asarray(com[:2] + data.vcom[0][:2] * fall)

    def _plus_springs(self, q: Array, forces: Any) -> Array:
        out = np.array(forces)
        if self.springs:
            out[self.nv - self.n :] += self.spring_torque(q)
        return out

    def joint_index(self, name: str) -> int:
        """Index of a joint in arrays of length n."""
        return build.joint_index(self.joint_names, name, f"robot {self.name!r}")

    def limb(self, frame: str) -> tuple[int, ...]:
        """Indices (into arrays of length n) of the joints from the root to a frame."""
        parent = self.model.frames[checks.check_frame(self.model, frame, f"robot {self.name!r}")].parentJoint
        return tuple(k - self.nv + self.n for k in checks.columns_above(self.model, parent))

    def striker(self, name: str) -> Striker:
        return build.pick("striker", name, self.strikers, self.name)

    def sole(self, name: str) -> Sole:
        return build.pick("sole", name, {sole.name: sole for sole in self.soles}, self.name)

    def posture(self, name: str) -> Array:
        """A named configuration, (nq,), as a copy."""
        return build.pick("posture", name, self.postures, self.name).copy()

    def given_posture(self, given: str | ArrayLike, *, name: str) -> Array:
        """A configuration (nq,), given by its name or itself, as a copy; InputError as of
        `check_configuration`, or for an unknown name.
        """
        return self.posture(given) if isinstance(given, str) else self.check_configuration(given, name=name)

    def with_striker(self, striker: Striker) -> Robot:
        """A copy of the robot with `striker`, which replaces one of the same name."""
        check_kind("striker", striker, Striker)
        model = self.model.copy()
        build.add_striker(model, striker)
        return dataclasses.replace(self, model=model, strikers={**self.strikers, striker.name: striker})

    def with_tool(self, tool: Tool) -> Robot:
        """A copy of the robot that holds `tool`: its mass on the link, and a striker of its name."""
        check_kind("tool", tool, Tool)
        return dataclasses.replace(self, **tools.fields_with_tool(self, tool))

    def with_grip(self, name: str, grip: SoftGrip) -> Robot:
        """A copy of the robot with a soft grip for its rigidly held tool of that name."""
        check_kind("grip", grip, SoftGrip)
        return dataclasses.replace(self, **tools.fields_with_grip(self, name, grip))

    @property
    def passive(self) -> Mask:
        """(n,) mask of joints without a motor: `sprung` ones and `hinges`."""
        return self.sprung | self.hinges

    @property
    def sprung(self) -> Mask:
        """(n,) mask of joints of soft grips, which have a spring and a damper and no motor."""
        return np.isin(self.joint_names, [tool.grip_joint for tool in self.tools if tool.grip is not None])

    @property
    def hinges(self) -> Mask:
        """(n,) mask of hinges of soles, which have neither motor nor spring."""
        return np.isin(self.joint_names, [sole.hinge_joint for sole in self.soles if sole.hinge is not None])

    def with_actuators(self, actuators: Mapping[str, Actuator]) -> Robot:
        """A copy of the robot with these motors and gears, by names or patterns of joints.

        For a joint that several patterns (such as ``arm_*_4_joint``) match, the last one holds. Other joints
        keep their actuators. An armature given replaces the model's.

        Raises
        ------
        InputError : a name that matches no joint; gains too fast for the armature.
        """
        model = self.model.copy()
        drives = with_classes(actuators, self.joint_names, self.actuators, model)
        return dataclasses.replace(self, model=model, actuators=drives)

    def joint_positions(self, q: ArrayLike) -> Array:
        """Joint angles (n,) [rad] of a configuration (nq,), or (k, n) of several (k, nq).

        A continuous joint's lies in [-pi, pi].
        """
        shape = (None,) * (raw_array("q", q).ndim - 1) + (self.nq,)
        return self.angles.of(check_array("q", q, shape, finite=False))

    def place(self, q: ArrayLike, soles: Sequence[Sole] | None = None) -> Array:
        """The configuration with the base moved: mean of the soles at the origin of the ground, at yaw 0.

        Roll and pitch of the base are kept. `soles` are those on the ground; default: those of the robot at
        most 1 cm higher than its lowest one.
        """
        q = self.check_configuration(q)
        frames = [sole.frame for sole in (self.soles if soles is None else soles)]
        if not self.floating or not frames:
            return q
        return build.place(self.model, q, build.lowest(self.model, q, frames) if soles is None else frames)

    def check_configuration(self, q: ArrayLike, *, name: str = "q") -> Array:
        """`q` as a float64 copy (nq,); InputError for another shape, NaN, or a quaternion not of norm 1."""
        return checks.check_configuration(self.model, q, name)

    def check_velocity(self, v: ArrayLike, *, name: str = "v") -> Array:
        """`v` as a float64 copy (nv,); InputError if its shape is wrong or it has NaN."""
        return check_array(name, v, (self.nv,))

    def check_limits(self, q: ArrayLike, *, name: str = "q") -> None:
        """InputError unless all joints and tendons of the configuration are inside their position limits."""
        ranges, angles = self.ranges, self.joint_positions(q)
        checks.check_positions(ranges.names, ranges.positions(angles), ranges.lower, ranges.upper, name)

    def check_stance(
        self,
        q: ArrayLike,
        soles: Sequence[Sole | str] | None = None,
        *,
        height: float = 1e-3,
        tilt: float = 1e-3,
    ) -> None:
        """InputError unless the soles lie flat on the ground, z = 0, within `height` [m] and `tilt` [rad].

        soles : default all of the robot's; or soles, or names of its soles.
        """
        q = self.check_configuration(q)
        chosen = self.soles if soles is None else [self.sole(s) if isinstance(s, str) else s for s in soles]
        checks.check_stance(self.model, q, [(sole.name, sole.frame) for sole in chosen], height, tilt)
