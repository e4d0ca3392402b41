"""`Robot`: a Pinocchio model with what a URDF lacks: armature, servo, limits, soles, strikers, postures."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from os import PathLike
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from impactopt.errors import Mistakes, check_array, raw_array
from impactopt.robots import build, checks, tools
from impactopt.robots import mjcf as _mjcf
from impactopt.robots import urdf as _urdf
from impactopt.robots.actuators import MOMENTARY_PEAK, Actuator, known, numbers_of, with_classes
from impactopt.robots.attachments import SoftGrip, Sole, Source, Striker, Tool, read_only
from impactopt.robots.checks import GIVEN, REPAIRED, check_inertias, tell_apart
from impactopt.robots.couplings import Coupling, couplings_of, follower_axes, restore_followers
from impactopt.robots.forward_kinematics import ForwardKinematics
from impactopt.robots.tendons import Ranges, Tendon, check_tendons
from impactopt.robots.tools import check_sole, with_hinges

__all__ = ["Robot", "Sole", "Striker", "Tool"]

Array = NDArray[np.float64]
STRONGEST = 1e3  # [m/s2] of gravity
PerJoint = float | Mapping[str, float] | ArrayLike | None


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Robot:
    """A robot ready to strike; checked when built. Arrays are read-only; `dataclasses.replace` makes a
    changed copy.

    Arrays of length n run over the joints without the free-flyer and without followers (`couplings`), in the
    order of Pinocchio's v. Units are those of revolute joints; for a prismatic joint read m, m/s, N, kg.

    Attributes
    ----------
    name : of the robot.
    model : pin.Model without locked joints, with armature and an OP_FRAME per striker and added sole.
    kp, kd : (n,) servo stiffness [N m/rad] and damping [N m s/rad].
    torque_limit, velocity_limit : (n,) [N m], [rad/s], largest magnitudes.
    lower, upper : (n,) position limits [rad]; infinite for a continuous joint.
    tendons : ranges of sums of joint angles.
    actuators : one a joint, of which nothing may be known; armature is None there, it is in `armature`.
    soles : flat feet, in a fixed order.
    strikers : by name.
    postures : named configurations, (nq,) in Pinocchio's convention. A floating robot's are placed so that
        the mean of the soles it stands on is at the origin of the ground, at yaw 0 (`place`).
    disable_collisions : pairs of links that may pass through each other: an SRDF's, and one's own.
    tools : what it holds.
    source : what it was made from, None where that was a model in Python.
    urdf, mjcf : file whose shapes are its bodies and a picture shows, None for simple ones.

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
        at = [pin.neutral(self.model), *postures.values()]
        checks.check_gains(self.model, self.joint_names, self.kp, self.kd, at)

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
        path, srdf : the files. Meshes are read by who draws the robot only.
        name : the URDF's own name when left out.
        floating : with a free-flyer at the root; else the root link is fixed to the world.
        locked : joints to remove from the model: names (at angle 0), or angles [rad] by name.
        inertias : "given", or "repaired" where no body can have them: `source.repairs` lists these.
        options : as of `from_model`.

        Raises
        ------
        InputError : no such file; Gazebo's loops, and joints that cannot follow another by <mimic>, unless
            they are locked.
        """
        read = _urdf.read_urdf(path, srdf, floating=floating, repaired=inertias == REPAIRED)
        given = {"srdf": srdf, "name": name, "floating": floating, "locked": locked, "inertias": inertias}
        model, every, source = read.made(path, given, options)
        robot = cls.from_model(model, **every)
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
        floating : with a free-flyer at the root, or fixed to the world; None: as the file has it.
        name, locked, inertias : as of `from_urdf`.
        options : as of `from_model`. MJCF has no velocity limits. Each site on a link that moves is a
            striker; postures are the keyframes inside the limits.

        Raises
        ------
        InputError : no MuJoCo; no robot; ball joints; tendons and loops that move; joints that follow others
            otherwise than linearly.
        """
        read = _mjcf.read_mjcf(path, floating=floating)
        given = {"name": name, "floating": floating, "locked": locked, "inertias": inertias}
        model, every, source = read.made(path, given, options)
        return dataclasses.replace(cls.from_model(model, **every), source=source)

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
        that a mapping leaves out keep the default.

        Parameters
        ----------
        armature : reflected rotor inertia [kg m2]; default the model's own (an SRDF's rotors).
        rotor : (rotor inertia [kg m2], gear ratio) by joint: armature = inertia x ratio^2. `armature` wins
            over it.
        kd : servo damping [N m s/rad]; default 1.5 s/rad times the torque limit, but at most 150.
        kp : servo stiffness [N m/rad]; default 30 1/s times kd.
        torque_limit, velocity_limit : default the model's.
        position_limit : (lower, upper) [rad] by joint, or (n, 2); default the model's.
        soles, strikers : as they are.
        postures : by name: (nq,) configurations, or joint angles [rad] by name on top of the model's posture
            of that name (an SRDF's), or else of zero. The model's other postures are kept.
        disable_collisions : pairs of links that may pass through each other.
        urdf, mjcf : file whose visual shapes a picture shows, and whose collision shapes keep apart.
        actuators : motors and gears, as of `with_actuators`; friction is the model's where they have none.
        gravity (3,) : [m/s2], world axes; default the model's.
        tendons : ranges of sums of joint angles.
        """
        build.check_count("sole", soles)
        build.check_count("striker", strikers)
        model = model.copy()
        tell_apart(model)
        checks.check_joint_types(model)
        if gravity is not None:
            model.gravity.linear = check_array("gravity [m/s2]", gravity, (3,), most=STRONGEST)
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
        """One line: its model and arrays would fill pages."""
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
        """Placements of its joints at many configurations at once."""
        return ForwardKinematics(self.model)

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        return build.joint_names(self.model)

    @property
    def joint_models(self) -> tuple[Any, ...]:
        """(n,) Pinocchio's models of its joints."""
        return tuple(build.moving_joints(self.model))

    @cached_property
    def couplings(self) -> dict[str, Coupling]:
        """Laws of the joints that follow others and have no motor, by name; `joint_names` has them not."""
        return couplings_of(self.model)

    @cached_property
    def ranges(self) -> Ranges:
        """Position limits of the joints, and ranges of the tendons."""
        return Ranges.of(self.joint_names, self.lower, self.upper, self.tendons)

    @property
    def armature(self) -> Array:
        """(n,) reflected rotor inertia [kg m2]; it lives in `model.armature`."""
        return read_only(np.array(self.model.armature[self.nv - self.n :], dtype=np.float64))

    @property
    def gear_limit(self) -> Array:
        """(n,) Gears' peak in a blow over the torque limit, 2 where not known; inf: there is no gear."""
        known = numbers_of(self.actuators, "momentary_torque") / self.torque_limit
        limit = np.where(np.isnan(known), MOMENTARY_PEAK, known)
        return read_only(np.where(self.passive, np.inf, limit))

    @cached_property
    def springs(self) -> dict[str, tuple[float, float]]:
        """Stiffness [N m/rad] and angle at rest [rad] of springs beside the motors, by joint."""
        return {
            joint: (float(actuator.spring_stiffness), float(actuator.spring_rest or 0.0))
            for joint, actuator in zip(self.joint_names, self.actuators, strict=True)
            if actuator.spring_stiffness
        }

    def spring_torque(self, q: Array) -> Array:
        """(n,) [N m] with which motors bend the springs at q (nq,): stiffness times the angle from rest."""
        out = np.zeros(self.n)
        for joint, (stiffness, rest) in self.springs.items():
            at = self.model.joints[self.model.getJointId(joint)]
            out[at.idx_v - self.nv + self.n] = stiffness * (q[at.idx_q] - rest)
        return out

    def inverse_dynamics(self, data: Any, q: Array, v: Array, a: Array) -> Array:
        """Forces (nv,) [N, N m] of a motion q (nq), v, a (nv): `pin.rnea` and the springs' torques."""
        return self._sprung(q, pin.rnea(self.model, data, q, v, a))

    def nonlinear_effects(self, data: Any, q: Array, v: Array) -> Array:
        """Forces (nv,) [N, N m] without acceleration: `pin.nonLinearEffects` and the springs' torques."""
        return self._sprung(q, pin.nonLinearEffects(self.model, data, q, v))

    def generalized_gravity(self, data: Any, q: Array) -> Array:
        """Forces (nv,) [N, N m] at rest: `pin.computeGeneralizedGravity` and the springs' torques."""
        return self._sprung(q, pin.computeGeneralizedGravity(self.model, data, q))

    def _sprung(self, q: Array, forces: Any) -> Array:
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

    def with_striker(self, striker: Striker) -> Robot:
        """A copy of the robot that has `striker` too (or instead of its own one of that name)."""
        model = self.model.copy()
        build.add_striker(model, striker)
        return dataclasses.replace(self, model=model, strikers={**self.strikers, striker.name: striker})

    def with_tool(self, tool: Tool) -> Robot:
        """A copy of the robot that holds `tool`: its mass on the link, and a striker of its name."""
        return dataclasses.replace(self, **tools.holding(self, tool))

    def with_grip(self, name: str, grip: SoftGrip) -> Robot:
        """A copy of the robot that holds its tool of that name so softly, and no longer firmly."""
        return dataclasses.replace(self, **tools.holding_softly(self, name, grip))

    @property
    def passive(self) -> NDArray[np.bool_]:
        """(n,) Whether no motor moves a joint: it is `sprung`, or one of the `hinges`."""
        return self.sprung | self.hinges

    @property
    def sprung(self) -> NDArray[np.bool_]:
        """(n,) Whether nothing but a spring and a damper moves a joint, as that of a soft grip."""
        return np.isin(self.joint_names, [tool.grip_joint for tool in self.tools if tool.grip is not None])

    @property
    def hinges(self) -> NDArray[np.bool_]:
        """(n,) Whether nothing moves a joint, as a sole's hinge."""
        return np.isin(self.joint_names, [sole.hinge_joint for sole in self.soles if sole.hinge is not None])

    def with_actuators(self, actuators: Mapping[str, Actuator]) -> Robot:
        """A copy of the robot with these motors and gears, of joints by name or pattern.

        Of the joints that fit several patterns, such as ``arm_*_4_joint``, the last one holds. Those that fit
        none keep what they have. Their armature takes the place of the model's.

        Raises
        ------
        InputError : what fits no joint; gains too fast for the armature.
        """
        model = self.model.copy()
        drives = with_classes(actuators, self.joint_names, self.actuators, model)
        return dataclasses.replace(self, model=model, actuators=drives)

    def joint_positions(self, q: ArrayLike) -> Array:
        """Joint angles (n,) [rad] of a configuration (nq,), or (k, n) of several (k, nq).

        A continuous joint's lies in [-pi, pi].
        """
        shape = (None,) * (raw_array("q", q).ndim - 1) + (self.nq,)
        return build.joint_positions(self.model, check_array("q", q, shape, finite=False).T).T

    def place(self, q: ArrayLike, soles: Sequence[Sole] | None = None) -> Array:
        """The configuration with the base moved: mean of the soles at the origin of the ground, at yaw 0.

        Roll and pitch of the base stay as they are. `soles` are those that it stands on; when left out, those
        of the robot's own that are not higher than its lowest one by more than a centimetre.
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
        own = self.ranges
        checks.check_positions(own.names, own.positions(self.joint_positions(q)), own.lower, own.upper, name)

    def check_stance(
        self,
        q: ArrayLike,
        soles: Sequence[Sole | str] | None = None,
        *,
        height: float = 1e-3,
        tilt: float = 1e-3,
    ) -> None:
        """InputError unless the soles lie flat on the ground, z = 0, within `height` [m] and `tilt` [rad].

        `soles` are the robot's own, or some of them, or their names.
        """
        q = self.check_configuration(q)
        chosen = self.soles if soles is None else [self.sole(s) if isinstance(s, str) else s for s in soles]
        checks.check_stance(self.model, q, [(sole.name, sole.frame) for sole in chosen], height, tilt)
