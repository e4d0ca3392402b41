"""Reads a `pin.Model` and other data of a robot from an MJCF, by MuJoCo's own compiler.

The compiler knows all of the language: defaults, includes, angles, inertias of geoms and meshes. What it has
compiled is taken over number by number, so both engines have the same robot. Pinocchio's own reader (4.1)
gives the same for plain files, but leaves out the mass of geoms that do not collide, refuses keyframes of
scenes, and says nothing of actuators.
"""

from __future__ import annotations

from collections.abc import Iterator
from os import PathLike
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from impactopt.errors import InputError, missing_package
from impactopt.robots.build import ROOT, existing, friction, set_friction
from impactopt.robots.description import Description, Tie, between
from impactopt.robots.tendons import Tendon

__all__ = ["Compiled", "compile_mjcf", "gravity_of", "notes_of", "read_mjcf", "tendons_of", "ties_of"]

Array = NDArray[np.float64]
_OUT = "take it out"


class Compiled:
    """A compiled MJCF, and which of its bodies and joints the robot has.

    mj : mujoco.MjModel.  what : the file, in messages.  model : the pin.Model made of it.
    body : of MuJoCo's index, the joint that moves a body, its placement there and its frame.
    joint : of MuJoCo's index, that of the model.
    """

    def __init__(self, mj: Any, what: str) -> None:
        import mujoco

        self.mj, self.what, self.mujoco = mj, what, mujoco
        self.floating = False
        self.model = pin.Model()
        self.body: dict[int, tuple[int, Any, int]] = {0: (0, pin.SE3.Identity(), 0)}
        self.joint: dict[int, int] = {}

    def name(self, kind: str, i: int) -> str:
        """Name of an object; its kind and number if it has none."""
        found = self.mujoco.mj_id2name(self.mj, getattr(self.mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), i)
        return str(found) if found else f"{kind}{i}"

    def off(self, *flags: str) -> bool:
        """True if one of these flags of <option><flag> is disabled."""
        bits = (int(getattr(self.mujoco.mjtDisableBit, f"mjDSBL_{flag.upper()}", 0)) for flag in flags)
        return any(int(self.mj.opt.disableflags) & bit for bit in bits)

    def moving(self) -> list[int]:
        """Bodies with mass that a joint of the robot moves."""
        return [b for b, (joint, _, _) in self.body.items() if b and joint and self.mj.body_mass[b] > 0]

    def numbers(self, name: str) -> Array:
        """Array of the compiled model, (count, ...); empty if this MuJoCo has no such array."""
        return np.asarray(getattr(self.mj, name, np.zeros(0)))


def ties_of(c: Compiled) -> Iterator[Tie]:
    """Ties between joints and bodies that the robot has."""
    yield from _of_joints(c)
    if not c.off("equality", "constraint"):
        yield from _equalities(c)
    yield from _tendons(c)
    yield from _partly_weightless(c)


def gravity_of(c: Compiled) -> Array:
    """(3,) [m/s2], less what the same `gravcomp` of all bodies takes of it."""
    if c.off("gravity"):
        return np.zeros(3)
    shares = _gravcomp(c)
    share = shares.pop() if len(shares) == 1 else 0.0
    return np.array(c.mj.opt.gravity) * (1.0 - share)


def notes_of(c: Compiled) -> Iterator[str]:
    """Notes on features that were left out, or are treated otherwise than by MuJoCo."""
    mj = c.mj
    shares = _gravcomp(c)
    if len(shares) == 1 and (share := shares.pop()) and not c.off("gravity"):
        yield f"all bodies have gravcomp {share:g}: motors bear {1 - share:g} times the weight, as in MuJoCo"
    if mj.opt.density > 0 or mj.opt.viscosity > 0:
        yield "the drag of a medium is left out: <option density, viscosity>"
    for j in range(mj.njnt):
        dofs = slice(int(mj.jnt_dofadr[j]), int(mj.jnt_dofadr[j]) + 6)
        if c.floating and mj.jnt_bodyid[j] in c.body and mj.jnt_type[j] == c.mujoco.mjtJoint.mjJNT_FREE:
            own = [
                name
                for name in ("damping", "frictionloss", "armature")
                if c.numbers(f"dof_{name}")[dofs].any()
            ]
            own += ["stiffness"] if np.any(mj.jnt_stiffness[j]) else []
            if own:
                yield f"{' and '.join(own)} of the free joint {c.name('joint', j)!r}: left out"
    if getattr(mj, "nflex", 0):
        yield "deformable bodies (flex) are left out"
    plugged = [c.name("body", b) for b in c.body if c.numbers("body_plugin")[b : b + 1].max(initial=-1) >= 0]
    if plugged:
        yield f"plugins of {', '.join(plugged)} are left out"


def _gravcomp(c: Compiled) -> set[float]:
    """The shares of its weight that a body does not have, without those that motors make up for."""
    mj = c.mj
    made_up = c.numbers("jnt_actgravcomp")[sorted(c.joint)]
    if made_up.size and made_up.all() and not c.floating:
        return {0.0}  # the motors' torque has it, inside its limits: this is ordinary gravity
    return {float(mj.body_gravcomp[b]) for b in c.moving()}


def _partly_weightless(c: Compiled) -> Iterator[Tie]:
    if len(_gravcomp(c)) < 2 or c.off("gravity"):
        return
    bodies = [b for b in c.moving() if c.mj.body_gravcomp[b]]
    above = sorted({j for b in bodies for j in map(int, c.model.supports[c.body[b][0]]) if j})
    names = ", ".join(repr(c.name("body", b)) for b in bodies)
    yield Tie(
        text=f"bodies {names} have a gravcomp that the others do not have",
        joints=tuple(str(c.model.names[j]) for j in above),
        free=0,
        fix="give all of them the same",
    )


def _of_joints(c: Compiled) -> Iterator[Tie]:
    mj = c.mj
    for j in c.joint:
        name = c.name("joint", j)
        stiffens = any(c.numbers(f"jnt_{key}")[j : j + 1].any() for key in ("stiffnesspoly", "springyield"))
        if stiffens and not c.off("spring", "passive"):
            text = f"joint {name!r} has a spring whose torque is not linear in its angle, which no plan has"
            yield Tie(text=text, joints=(name,), free=0, fix=_OUT)
        bent = c.numbers("dof_dampingpoly")[int(mj.jnt_dofadr[j]) :][:1]
        if bent.any() and not c.off("damper", "passive"):
            text = f"joint {name!r} has damping that is not linear in its speed, which no plan has"
            yield Tie(text=text, joints=(name,), free=0, fix=_OUT)


def _equalities(c: Compiled) -> Iterator[Tie]:
    mj, kinds = c.mj, c.mujoco.mjtEq
    for e in range(mj.neq):
        kind, one, other = int(mj.eq_type[e]), int(mj.eq_obj1id[e]), int(mj.eq_obj2id[e])
        name = c.name("equality", e)
        if not mj.eq_active0[e]:
            continue
        if kind in (int(kinds.mjEQ_CONNECT), int(kinds.mjEQ_WELD)):
            yield from _loop(c, name, *(_body(c, e, i) for i in (one, other)))
        elif kind == int(kinds.mjEQ_JOINT) and one in c.joint:
            first = c.name("joint", one)
            if other < 0:
                text = f"joint {first!r} is held by the equality {name!r}"
                held = _held_at(c, e, one)
                yield Tie(text=text, joints=(first,), free=0, follower=first, follows=tuple(held.coef))
            elif other in c.joint:
                second = c.name("joint", other)
                text = f"joint {first!r} follows {second!r} by the equality {name!r}"
                zero = float(mj.qpos0[mj.jnt_qposadr[other]])
                held = _held_at(c, e, one)(Polynomial([-zero, 1.0]))
                yield Tie(text=text, joints=(first, second), follower=first, follows=tuple(held.coef))


def _held_at(c: Compiled, equality: int, joint: int) -> Any:
    """Angle of a joint, a polynomial of how far the other one is from where it is compiled."""
    return Polynomial(c.mj.eq_data[equality][:5]) + float(c.mj.qpos0[c.mj.jnt_qposadr[joint]])


def _body(c: Compiled, equality: int, i: int) -> int:
    """Body of an object that a loop constrains."""
    kinds = c.numbers("eq_objtype")  # MuJoCo 3.2 has bodies only
    is_site = bool(kinds.size) and kinds[equality] == int(c.mujoco.mjtObj.mjOBJ_SITE)
    return int(c.mj.site_bodyid[i]) if is_site else max(i, 0)


def _loop(c: Compiled, name: str, one: int, other: int) -> Iterator[Tie]:
    inside = [b for b in (one, other) if b and b in c.body]
    if not inside:
        return
    outside = [b for b in (one, other) if b not in c.body or (c.floating and not b)]
    if outside:
        raise InputError(
            f"{c.what} holds {c.name('body', inside[0])!r} to {c.name('body', outside[0])!r} by the equality "
            f"{name!r}, which no plan has; {_OUT}"
        )
    ends = (c.body[b][0] for b in (one, other))
    text = f"it closes a loop by the equality {name!r}, and robots here are trees"
    yield Tie(text=text, joints=between(c.model, *ends), free=0, fix=f"{_OUT}, with the rods that it holds")


def tendons_of(c: Compiled) -> Iterator[Tendon]:
    """Fixed tendons that have a range, and do nothing else."""
    mj = c.mj
    for t in range(mj.ntendon):
        if sum_of := _sum_of(c, t):
            low, high = map(float, mj.tendon_range[t])
            yield Tendon(name=c.name("tendon", t), coefficients=sum_of, lower=low, upper=high)


def _tendons(c: Compiled) -> Iterator[Tie]:
    for t in range(c.mj.ntendon):
        does, joints = _actions(c, t), _joints_of_tendon(c, t)
        if does and joints and not _sum_of(c, t):
            yield Tie(
                text=f"tendon {c.name('tendon', t)!r} acts on {', '.join(joints)} ({', '.join(does)}), which "
                "no plan has",
                joints=joints,
                free=0,
                fix=_OUT,
            )


def _actions(c: Compiled, t: int) -> list[str]:
    """Effects of a tendon on its joints, in words."""
    mj = c.mj
    driven = [
        int(mj.actuator_trnid[a, 0])
        for a in range(len(mj.actuator_trntype))
        if mj.actuator_trntype[a] == c.mujoco.mjtTrn.mjTRN_TENDON
    ]
    equal = [e for e in range(mj.neq) if mj.eq_type[e] == c.mujoco.mjtEq.mjEQ_TENDON]
    held = [int(i) for e in equal for i in (mj.eq_obj1id[e], mj.eq_obj2id[e])]
    does = [
        key
        for key in ("stiffness", "damping", "frictionloss", "armature", "limited")
        if c.numbers(f"tendon_{key}")[t : t + 1].any()
    ]
    return [*does, *(["an actuator"] if t in driven else []), *(["an equality"] if t in held else [])]


def _sum_of(c: Compiled, t: int) -> dict[str, float]:
    """Coefficients by joint of a fixed tendon that has a range, and does nothing else; empty for another one,
    and for joints that turn without end or are not the robot's.
    """
    mj, out = c.mj, dict[str, float]()
    if _actions(c, t) != ["limited"]:
        return out
    first = int(mj.tendon_adr[t])
    for w in range(first, first + int(mj.tendon_num[t])):
        joint = c.joint.get(int(mj.wrap_objid[w]), 0)
        if mj.wrap_type[w] != c.mujoco.mjtWrap.mjWRAP_JOINT or not joint or c.model.joints[joint].nq != 1:
            return {}
        out[c.name("joint", int(mj.wrap_objid[w]))] = float(mj.wrap_prm[w])
    return out


def _joints_of_tendon(c: Compiled, t: int) -> tuple[str, ...]:
    """Names of the joints that change a tendon's length."""
    mj, kinds = c.mj, c.mujoco.mjtWrap
    first = int(mj.tendon_adr[t])
    joints: set[str] = set()
    bodies: list[int] = []
    for w in range(first, first + int(mj.tendon_num[t])):
        kind, i = int(mj.wrap_type[w]), int(mj.wrap_objid[w])
        if kind == int(kinds.mjWRAP_JOINT) and i in c.joint:
            joints.add(c.name("joint", i))
        elif kind == int(kinds.mjWRAP_SITE):
            bodies.append(int(mj.site_bodyid[i]))
        elif kind in (int(kinds.mjWRAP_SPHERE), int(kinds.mjWRAP_CYLINDER)):
            bodies.append(int(mj.geom_bodyid[i]))
    inside = [c.body[b][0] for b in bodies if b in c.body]
    if c.floating and any(inside) and len(inside) < len(bodies) + bodies.count(0):
        raise InputError(
            f"{c.what} ties the robot to what is not of it by the tendon {c.name('tendon', t)!r}, which no "
            f"plan has; {_OUT}"
        )
    for one in inside[1:]:
        joints.update(between(c.model, inside[0], one))
    return tuple(sorted(joints))


_HINGES = (pin.JointModelRX, pin.JointModelRY, pin.JointModelRZ)
_TURNS = (pin.JointModelRUBX, pin.JointModelRUBY, pin.JointModelRUBZ)  # without limits
_SLIDES = (pin.JointModelPX, pin.JointModelPY, pin.JointModelPZ)


def compile_mjcf(path: str | PathLike[str]) -> Any:
    """The mujoco.MjModel of a file; InputError if there is none, with the compiler's message."""
    file = existing(path, "MJCF")
    try:
        import mujoco
    except ImportError as error:
        raise missing_package("a robot from an MJCF", "mujoco", "validate") from error
    try:
        return mujoco.MjModel.from_xml_path(file)
    except ValueError as error:
        raise InputError(f"MJCF {file}: {error}") from error


def read_mjcf(path: str | PathLike[str], *, floating: bool | None = None) -> Description:
    """The robot of an MJCF: the body with a free joint, and joints below it; else all that have joints.

    floating : whether its root has a free joint; None: as the file says.

    Raises
    ------
    InputError : no robot, or several; ball joints; equality constraints that hold it to other bodies.
    """
    mj = compile_mjcf(path)
    return _Reader(mj, f"MJCF {path}", floating).read()


class _Reader(Compiled):
    def __init__(self, mj: Any, what: str, floating: bool | None) -> None:
        super().__init__(mj, what)
        roots = [b for b in range(1, mj.nbody) if mj.body_parentid[b] == 0 and self._driven(b)]
        free = [b for b in roots if self._free(b)]
        if not roots:
            raise InputError(f"{what} has no hinges or slides: there is nothing to plan")
        if len(free) > 1:
            names = ", ".join(repr(self.name("body", b)) for b in free)
            raise InputError(f"{what} has several robots, {names}; take all but one out")
        self.roots = free or roots
        if len(self.roots) > 1 and floating:
            raise InputError(f"{what} has several bodies with joints on the ground: it cannot float")
        self.floating = bool(free) if floating is None else floating
        # of joints, which have one number for an angle without limits
        joints = (mj.eq_type == self.mujoco.mjtEq.mjEQ_JOINT) & (mj.eq_obj2id >= 0)
        self.followers = set(map(int, mj.eq_obj1id[joints]))
        self.model.name = mj.names[: mj.names.index(b"\0")].decode() or "robot"
        self.out = Description(kind="MJCF", model=self.model)

    def read(self) -> Description:
        inside = set(self.roots)
        for b in range(1, self.mj.nbody):  # parents come first
            if b in inside or int(self.mj.body_parentid[b]) in inside:
                inside.add(b)
                self._add_body(b)
        for s in range(self.mj.nsite):
            if int(self.mj.site_bodyid[s]) in inside:
                self._add_site(s)
        self._actuators()
        self._keyframes()
        if self.floating:
            q = pin.neutral(self.model)
            q[3:7] = pin.Quaternion(_rotation(self.mj.body_quat[self.roots[0]])).coeffs()
            self.model.referenceConfigurations[ROOT] = q
        self.model.gravity = pin.Motion(gravity_of(self), np.zeros(3))
        self.out.ties += ties_of(self)
        self.out.tendons += tendons_of(self)
        self.out.notes += notes_of(self)
        self.out.lead_from_root()
        return self.out

    def _driven(self, root: int) -> bool:
        kinds = self.mj.jnt_type[self.mj.body_rootid[self.mj.jnt_bodyid] == root]
        return bool((kinds != self.mujoco.mjtJoint.mjJNT_FREE).any())

    def _free(self, b: int) -> bool:
        first, count = int(self.mj.body_jntadr[b]), int(self.mj.body_jntnum[b])
        return count > 0 and self.mj.jnt_type[first] == self.mujoco.mjtJoint.mjJNT_FREE

    def _add_body(self, b: int) -> None:
        mj, model = self.mj, self.model
        joint, place, above = self.body[int(mj.body_parentid[b])]
        place = place * _placement(mj.body_pos[b], mj.body_quat[b])
        first, count = int(mj.body_jntadr[b]), int(mj.body_jntnum[b])
        free = self._free(b)
        if self.floating and b == self.roots[0]:
            name = self.name("joint", first) if free else "root_joint"
            joint, place = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), name), _none()
            above = model.addJointFrame(joint, 0)
        for j in () if free else range(first, first + count):
            at = pin.SE3(np.eye(3), np.array(mj.jnt_pos[j]))
            joint, above, turn = self._add_joint(j, joint, place * at, above)
            place = (at * turn).inverse()
        body = pin.Inertia(
            float(mj.body_mass[b]),
            np.array(mj.body_ipos[b]),
            _turned(mj.body_iquat[b], np.array(mj.body_inertia[b])),
        )
        model.appendBodyToJoint(joint, body, place)
        frame = pin.Frame(self._apart("body", b), joint, above, place, pin.FrameType.BODY)
        self.body[b] = (joint, place, int(model.addFrame(frame, False)))

    def _apart(self, kind: str, i: int) -> str:
        """A name that no frame of the model has yet, other than a joint."""
        name = self.name(kind, i)
        taken = [str(f.name) for f in self.model.frames if f.type != pin.FrameType.JOINT]
        return name if name not in taken else f"{kind} {name}"

    def _add_joint(self, j: int, parent: int, place: Any, above: int) -> tuple[int, int, Any]:
        """The joint and its frame, and how it is turned to have its axis, in a parent's joint at a place."""
        mj, model, name = self.mj, self.model, self.name("joint", j)
        hinge = mj.jnt_type[j] == self.mujoco.mjtJoint.mjJNT_HINGE
        if not hinge and mj.jnt_type[j] != self.mujoco.mjtJoint.mjJNT_SLIDE:
            raise InputError(
                f"{self.what}: joint {name!r} is a ball or a free joint inside the robot; make hinges of it"
            )
        axis, zero = np.array(mj.jnt_axis[j]), float(mj.qpos0[mj.jnt_qposadr[j]])
        # MuJoCo's bodies are where the file has them at the joint's reference, Pinocchio's at zero
        place = place * (
            pin.SE3(pin.exp3(-zero * axis), np.zeros(3)) if hinge else pin.SE3(np.eye(3), -zero * axis)
        )
        limited, lasting = bool(mj.jnt_limited[j]), int(mj.jnt_dofadr[j])
        kind, turn = _kind(axis, hinge, limited or j in self.followers)
        added = int(model.addJoint(parent, kind, place * turn, name))
        at = model.joints[added]
        low, high = mj.jnt_range[j] if limited else (-np.inf, np.inf)
        if at.nq == 1:
            lower, upper = np.array(model.lowerPositionLimit), np.array(model.upperPositionLimit)
            lower[at.idx_q], upper[at.idx_q] = low, high
            model.lowerPositionLimit, model.upperPositionLimit = lower, upper
        self.joint[j] = added
        self._add_to_joint(
            j,
            armature=mj.dof_armature[lasting],
            viscous=0.0 if self.off("damper", "passive") else _first(mj.dof_damping[lasting]),
            dry=0.0 if self.off("frictionloss", "constraint") else mj.dof_frictionloss[lasting],
        )
        stiffness = _first(mj.jnt_stiffness[j])
        if stiffness and not self.off("spring", "passive"):
            self.out.springs[name] = stiffness, float(mj.qpos_spring[mj.jnt_qposadr[j]])
        return added, int(model.addJointFrame(added, above)), turn

    def _add_to_joint(self, j: int, *, armature: float = 0.0, viscous: float = 0.0, dry: float = 0.0) -> None:
        """More armature and friction; a negative one takes off."""
        model, at = self.model, self.model.joints[self.joint[j]].idx_v
        own = np.array(model.armature), *friction(model)
        for numbers, more in zip(own, (armature, viscous, dry), strict=True):
            numbers[at] += more
        model.armature = own[0]
        set_friction(model, *own[1:])

    def _add_site(self, s: int) -> None:
        joint, place, above = self.body[int(self.mj.site_bodyid[s])]
        place = place * _placement(self.mj.site_pos[s], self.mj.site_quat[s])
        name = self._apart("site", s)
        self.model.addFrame(pin.Frame(name, joint, above, place, pin.FrameType.OP_FRAME), False)
        if joint > int(self.floating):
            self.out.sites.append(name)

    def _actuators(self) -> None:
        mj, kinds = self.mj, self.mujoco.mjtTrn
        inside = (int(kinds.mjTRN_JOINT), int(kinds.mjTRN_JOINTINPARENT))
        most: dict[str, float] = {}
        for a in range(len(mj.actuator_trntype)):
            j = int(mj.actuator_trnid[a, 0])
            if int(mj.actuator_trntype[a]) not in inside:
                if mj.actuator_trntype[a] != kinds.mjTRN_TENDON:  # a tendon's is reported with it
                    self.out.notes.append(f"actuator {self.name('actuator', a)!r}, of no joint, is left out")
                continue
            if j not in self.joint:
                continue
            out = int(mj.actuator_outadr[a]) if hasattr(mj, "actuator_outadr") else a
            name, gear = self.name("joint", j), abs(float(mj.actuator_gear[out, 0]))
            affine = mj.actuator_biastype[a] == self.mujoco.mjtBias.mjBIAS_AFFINE
            kp, kd = (-float(mj.actuator_biasprm[a, k]) * gear**2 if affine else 0.0 for k in (1, 2))
            rotor, viscous = (
                gear**2 * float(numbers[a]) if (numbers := self.numbers(f"actuator_{key}")).size else 0.0
                for key in ("armature", "damping")
            )
            self._add_to_joint(j, armature=rotor, viscous=0.0 if self.off("damper", "passive") else viscous)
            if self._disabled(a):
                continue
            most[name] = most.get(name, 0.0) + _largest(mj, a, affine) * gear
            if kp > 0 or kd > 0:
                self.out.kp[name] = self.out.kp.get(name, 0.0) + kp
                self.out.kd[name] = self.out.kd.get(name, 0.0) + kd
            if not self._simple(a):
                self.out.notes.append(
                    f"actuator {self.name('actuator', a)!r} has dynamics of its own, which are left out: a "
                    "motor gives its torque at once, or with the `bandwidth` and `delay` that you give it"
                )
        self.out.driven += most
        for j in self.joint:
            name = self.name("joint", j)
            if self.out.driven and name not in most and not mj.jnt_actfrclimited[j]:
                self.out.idle.append(name)
            if mj.jnt_actfrclimited[j]:
                bound = float(np.abs(mj.jnt_actfrcrange[j]).min())
                most[name] = min(most[name], bound) if name in most else bound
            if np.isfinite(most.get(name, np.inf)):
                self.out.torque[name] = most[name]
            viscous = float(friction(self.model)[0][self.model.joints[self.joint[j]].idx_v])
            if self.out.kp.get(name, 0.0) > 0 and self.out.kd[name] == 0 and viscous:
                # a servo without damping of its own leans on the joint's, which is then no friction
                self.out.kd[name] = viscous
                self._add_to_joint(j, viscous=-viscous)

    def _disabled(self, a: int) -> bool:
        """True if the actuator's group is disabled."""
        group = int(self.mj.actuator_group[a])
        return 0 <= group < 31 and bool(int(self.mj.opt.disableactuator) >> group & 1)

    def _simple(self, a: int) -> bool:
        """True if an actuator's force is at once a control, or a servo of position and velocity."""
        mj, m = self.mj, self.mujoco
        return bool(
            mj.actuator_gaintype[a] == m.mjtGain.mjGAIN_FIXED
            and int(mj.actuator_biastype[a]) in (int(m.mjtBias.mjBIAS_NONE), int(m.mjtBias.mjBIAS_AFFINE))
            and mj.actuator_dyntype[a] == m.mjtDyn.mjDYN_NONE
            and not self.numbers("actuator_delay")[a : a + 1].any()
            and not self.numbers("actuator_dampingpoly")[a : a + 1].any()
        )

    def _keyframes(self) -> None:
        mj = self.mj
        for k in range(mj.nkey):
            q, inside = pin.neutral(self.model), True
            for j, i in self.joint.items():
                angle, at = float(mj.key_qpos[k][mj.jnt_qposadr[j]]), self.model.joints[i]
                inside &= not mj.jnt_limited[j] or mj.jnt_range[j][0] <= angle <= mj.jnt_range[j][1]
                q[at.idx_q : at.idx_q + at.nq] = angle if at.nq == 1 else (np.cos(angle), np.sin(angle))
            if self.floating and self._free(self.roots[0]):
                start = int(mj.jnt_qposadr[int(mj.body_jntadr[self.roots[0]])])
                where = mj.key_qpos[k][start : start + 7]
                q[:7] = pin.SE3ToXYZQUAT(_placement(where[:3], where[3:]))
            if inside:  # what is outside its limits is no posture
                self.model.referenceConfigurations[self.name("key", k)] = q


def _largest(mj: Any, a: int, affine: bool) -> float:
    """The largest force [N m] of an actuator; infinite where nothing bounds it."""
    out = np.inf
    if mj.actuator_forcelimited[a]:
        out = float(np.abs(mj.actuator_forcerange[a]).min())
    k = int(mj.actuator_ctrladr[a]) if hasattr(mj, "actuator_ctrladr") else a
    if mj.actuator_ctrllimited[k] and not affine:
        out = min(out, float(np.abs(mj.actuator_ctrlrange[k]).min()) * abs(float(mj.actuator_gainprm[a, 0])))
    return out


def _kind(axis: Array, hinge: bool, limited: bool) -> tuple[Any, Any]:
    """Pinocchio's joint about or along an axis, and the placement in which it is that."""
    along = [k for k in range(3) if axis[k] == 1 and not np.delete(axis, k).any()]
    if along:
        return ((_HINGES if limited else _TURNS) if hinge else _SLIDES)[along[0]](), _none()
    if not hinge:
        return pin.JointModelPrismaticUnaligned(axis), _none()
    if limited:
        return pin.JointModelRevoluteUnaligned(axis), _none()
    # Python cannot give the axis of an unbounded one
    to_axis = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), axis)
    return pin.JointModelRUBZ(), pin.SE3(to_axis.matrix(), np.zeros(3))


def _placement(position: Any, quaternion: Any) -> Any:
    return pin.SE3(_rotation(quaternion), np.array(position, dtype=np.float64))


def _rotation(quaternion: Any) -> Array:
    """Rotation matrix of a unit quaternion (w, x, y, z)."""
    w, x, y, z = (float(a) for a in quaternion)
    return np.array(pin.Quaternion(w, x, y, z).normalized().matrix())


def _turned(quaternion: Any, moments: Array) -> Array:
    """Principal moments (3,) in the axes of a body."""
    turn = _rotation(quaternion)
    return turn @ np.diag(moments) @ turn.T


def _first(value: Any) -> float:
    """MuJoCo 4 has polynomials of damping, whose first coefficient is the linear one."""
    return float(np.ravel(value)[0])


def _none() -> Any:
    return pin.SE3.Identity()
