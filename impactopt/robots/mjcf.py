"""Reads a `pin.Model` and other data of a robot from an MJCF, by MuJoCo's own compiler.

The compiler supports the whole language: defaults, includes, angles, inertias of geoms and meshes. Its
numbers are copied, so that both engines have the same robot. Pinocchio's own reader (4.1) gives the same for
plain files, but leaves out the mass of geoms that do not collide, refuses keyframes of scenes, and does not
read actuators.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from os import PathLike
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
from numpy.polynomial import Polynomial

from impactopt.arrays import Array
from impactopt.codegen.files import is_plain_file
from impactopt.errors import InputError, missing_package
from impactopt.robots.build import ROOT, existing, friction, set_friction
from impactopt.robots.couplings import Tendon
from impactopt.robots.description import Description, Tie, between
from impactopt.robots.gravity_compensation import CompensatedBody, Compensation, compensation
from impactopt.robots.model import JointAngles

_OUT = "take it out"
_SPAN = 0.1  # least determinant of three axes that move a body in all directions


class Compiled:
    """A compiled MJCF, and the bodies and joints of it that the robot has.

    mj : mujoco.MjModel.  what : the file, in messages.  model : the pin.Model made of it.
    body : by MuJoCo's index of a body of the robot: its joint's index in `model`, its placement (pin.SE3) in
        that joint, the index of its frame.
    joint : by MuJoCo's index of a joint of the robot: its index in `model`.
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

    def of_base(self, j: int) -> str:
        """Names of what acts on the six degrees of freedom of a root from joint j on; "" if nothing does."""
        first, names = int(self.mj.jnt_dofadr[j]), ("damping", "frictionloss", "armature")
        own = [name for name in names if self.numbers(f"dof_{name}")[first : first + 6].any()]
        joints = self.mj.jnt_bodyid == self.mj.jnt_bodyid[j]
        own += ["stiffness"] if np.any(self.mj.jnt_stiffness[joints]) else []
        return " and ".join(own)

    def numbers(self, name: str) -> Array:
        """Array of the compiled model, (count, ...); empty if this MuJoCo has no such array."""
        return np.asarray(getattr(self.mj, name, np.zeros(0)))


def ties_of(c: Compiled, gravcomp: Compensation, torque: Mapping[str, float]) -> Iterator[Tie]:
    """Ties of the robot's joints: nonlinear forces, equalities, tendons, and partial gravity compensation.

    gravcomp : as of `gravcomp_of`.
    torque [N m] : limits by joint, over which the compensation of light bodies is neglected.
    """
    yield from _nonlinear_joints(c)
    if not c.off("equality", "constraint"):
        yield from _equalities(c)
    yield from _tendons(c)
    yield from _partly_weightless(gravcomp, {} if c.floating else torque)


def notes_of(c: Compiled, gravcomp: Compensation, torque: Mapping[str, float]) -> Iterator[str]:
    """Notes on features that are left out, or are treated differently than by MuJoCo.

    gravcomp : as of `gravcomp_of`.  torque [N m] : limits by joint.
    """
    mj, fraction = c.mj, gravcomp.fraction
    if fraction:
        which = f"{'most' if gravcomp.others else 'all'} bodies that joints lift have gravcomp {fraction:g}"
        yield f"{which}: motors carry {1 - fraction:g} times the weight, as in MuJoCo"
    if shares := gravcomp.negligible(torque):
        joint = max(shares, key=lambda joint: shares[joint])
        yield (
            f"{_differing(gravcomp)}, and is left out: at most {gravcomp.loads[joint]:.2g} N m of {joint!r}, "
            f"{100 * shares[joint]:.2g} % of the file's limit"
        )
    if mj.opt.density > 0 or mj.opt.viscosity > 0:
        yield "fluid drag is left out: <option density, viscosity>"
    for j in range(mj.njnt):
        free = c.floating and mj.jnt_bodyid[j] in c.body and mj.jnt_type[j] == c.mujoco.mjtJoint.mjJNT_FREE
        if free and (own := c.of_base(j)):
            yield f"{own} of the free joint {c.name('joint', j)!r}: left out"
    if getattr(mj, "nflex", 0):
        yield "deformable bodies (flex) are left out"
    if not c.off("equality", "constraint"):
        for e in (e for e in range(mj.neq) if mj.eq_active0[e] and _by_mocap(c, e)):
            yield f"the equality {c.name('equality', e)!r} to a mocap body is left out: motors move the robot"
    plugged = [c.name("body", b) for b in c.body if c.numbers("body_plugin")[b : b + 1].max(initial=-1) >= 0]
    if plugged:
        yield f"plugins of {', '.join(plugged)} are left out"


def gravcomp_of(c: Compiled) -> Compensation:
    """Gravity compensation of the moving bodies; none without gravity, and if motors apply it."""
    mj, gravity = c.mj, np.array(c.mj.opt.gravity)
    by_motors = c.numbers("jnt_actgravcomp")[sorted(c.joint)]
    # that of motors is part of their torque, inside its limits: this is ordinary gravity
    if c.off("gravity") or not gravity.any() or (by_motors.size and by_motors.all() and not c.floating):
        return Compensation()
    bodies = [
        CompensatedBody(
            name=c.name("body", b),
            joint=c.body[b][0],
            mass=float(mj.body_mass[b]),
            centre=c.body[b][1].act(np.array(mj.body_ipos[b])),
            fraction=float(mj.body_gravcomp[b]),
        )
        for b in c.moving()
    ]
    return compensation(c.model, gravity, bodies)


def _partly_weightless(gravcomp: Compensation, torque: Mapping[str, float]) -> Iterator[Tie]:
    """Different `gravcomp` of bodies, for which the equations of motion have no gravity vector."""
    light = gravcomp.negligible(torque)
    if heavy := tuple(joint for joint in gravcomp.loads if joint not in light):
        yield Tie(text=_differing(gravcomp), joints=heavy, free=0, fix="give all of them the same")


def _differing(gravcomp: Compensation) -> str:
    """The bodies with another `gravcomp`, as the beginning of a message."""
    return f"the gravcomp of {', '.join(map(repr, gravcomp.others))} is not that of the rest"


def _nonlinear_joints(c: Compiled) -> Iterator[Tie]:
    """Nonlinear springs and dampers of joints."""
    mj = c.mj
    for j in c.joint:
        name = c.name("joint", j)
        stiffens = any(c.numbers(f"jnt_{key}")[j : j + 1].any() for key in ("stiffnesspoly", "springyield"))
        if stiffens and not c.off("spring", "passive"):
            text = f"joint {name!r} has a spring whose torque is not linear in its angle, which plans lack"
            yield Tie(text=text, joints=(name,), free=0, fix=_OUT)
        nonlinear = c.numbers("dof_dampingpoly")[int(mj.jnt_dofadr[j]) :][:1]
        if nonlinear.any() and not c.off("damper", "passive"):
            text = f"joint {name!r} has damping that is not linear in its speed, which plans lack"
            yield Tie(text=text, joints=(name,), free=0, fix=_OUT)


def _equalities(c: Compiled) -> Iterator[Tie]:
    """Active equality constraints: closed loops, joints fixed at an angle, joints that follow others."""
    mj, kinds = c.mj, c.mujoco.mjtEq
    for e in range(mj.neq):
        kind, one, other = int(mj.eq_type[e]), int(mj.eq_obj1id[e]), int(mj.eq_obj2id[e])
        name = c.name("equality", e)
        if not mj.eq_active0[e] or _by_mocap(c, e):
            continue
        if kind in (int(kinds.mjEQ_CONNECT), int(kinds.mjEQ_WELD)):
            yield from _loop(c, name, *(_body(c, e, i) for i in (one, other)))
        elif kind == int(kinds.mjEQ_JOINT) and one in c.joint:
            first = c.name("joint", one)
            # y - y0 is a polynomial of x - x0, where y is the first joint, x the other one (0 without one),
            # and x0, y0 are their reference angles
            law = Polynomial(mj.eq_data[e][:5]) + float(mj.qpos0[mj.jnt_qposadr[one]])
            if other < 0:
                text = f"joint {first!r} is fixed by the equality {name!r}"
                yield Tie(text=text, joints=(first,), free=0, follower=first, follows=tuple(law.coef))
            elif other in c.joint:
                second = c.name("joint", other)
                text = f"joint {first!r} follows {second!r} by the equality {name!r}"
                law = law(Polynomial([-float(mj.qpos0[mj.jnt_qposadr[other]]), 1.0]))
                yield Tie(text=text, joints=(first, second), follower=first, follows=tuple(law.coef))


def _body(c: Compiled, equality: int, i: int) -> int:
    """Index of the body, or of the body of the site, that a loop constrains."""
    kinds = c.numbers("eq_objtype")  # MuJoCo 3.2 has no sites there
    is_site = bool(kinds.size) and kinds[equality] == int(c.mujoco.mjtObj.mjOBJ_SITE)
    return int(c.mj.site_bodyid[i]) if is_site else max(i, 0)


def _by_mocap(c: Compiled, equality: int) -> bool:
    """True if a <connect> or <weld> ties the robot to a mocap body, by which a simulation drags it."""
    mj, kinds = c.mj, c.mujoco.mjtEq
    if int(mj.eq_type[equality]) not in (int(kinds.mjEQ_CONNECT), int(kinds.mjEQ_WELD)):
        return False
    bodies = [_body(c, equality, int(i)) for i in (mj.eq_obj1id[equality], mj.eq_obj2id[equality])]
    dragged = any(b and b in c.body for b in bodies)
    return dragged and any(b not in c.body and mj.body_mocapid[mj.body_rootid[b]] >= 0 for b in bodies)


def _loop(c: Compiled, name: str, one: int, other: int) -> Iterator[Tie]:
    """Closed loop through two bodies (0: the world); InputError if one of them is not the robot's."""
    inside = [b for b in (one, other) if b and b in c.body]
    if not inside:
        return
    # a robot on a fixed base has the world's body
    outside = [b for b in (one, other) if b not in c.body or (c.floating and not b)]
    if outside:
        raise InputError(
            f"{c.what} connects {c.name('body', inside[0])!r} to {c.name('body', outside[0])!r} by the "
            f"equality {name!r}, which plans lack; {_OUT}"
        )
    ends = (c.body[b][0] for b in (one, other))
    text = f"it closes a loop by the equality {name!r}, and robots here are trees"
    yield Tie(
        text=text, joints=between(c.model, *ends), free=0, fix=f"{_OUT}, with the rods that it connects"
    )


def tendons_of(c: Compiled) -> Iterator[Tendon]:
    """Fixed tendons with a range and no other effect."""
    mj = c.mj
    for t in range(mj.ntendon):
        if coefficients := _coefficients(c, t):
            low, high = map(float, mj.tendon_range[t])
            yield Tendon(name=c.name("tendon", t), coefficients=coefficients, lower=low, upper=high)


def _tendons(c: Compiled) -> Iterator[Tie]:
    """Tendons with other effects than a range on a sum of angles."""
    for t in range(c.mj.ntendon):
        effects, joints = _effects(c, t), _joints_of_tendon(c, t)
        if effects and joints and not _coefficients(c, t):
            yield Tie(
                text=f"tendon {c.name('tendon', t)!r} acts on {', '.join(joints)} ({', '.join(effects)}), "
                "which plans lack",
                joints=joints,
                free=0,
                fix=_OUT,
            )


def _effects(c: Compiled, t: int) -> list[str]:
    """Effects of a tendon on its joints, in words; "limited" is that it has a range."""
    mj = c.mj
    driven = [
        int(mj.actuator_trnid[a, 0])
        for a in range(len(mj.actuator_trntype))
        if mj.actuator_trntype[a] == c.mujoco.mjtTrn.mjTRN_TENDON
    ]
    equalities = [e for e in range(mj.neq) if mj.eq_type[e] == c.mujoco.mjtEq.mjEQ_TENDON]
    constrained = [int(i) for e in equalities for i in (mj.eq_obj1id[e], mj.eq_obj2id[e])]
    own = [
        key
        for key in ("stiffness", "damping", "frictionloss", "armature", "limited")
        if c.numbers(f"tendon_{key}")[t : t + 1].any()
    ]
    return [*own, *(["an actuator"] if t in driven else []), *(["an equality"] if t in constrained else [])]


def _coefficients(c: Compiled, t: int) -> dict[str, float]:
    """Coefficients, by joint, of a fixed tendon with a range and no other effect.

    Empty for other tendons, and if one of the joints is continuous or not the robot's.
    """
    mj, out = c.mj, dict[str, float]()
    if _effects(c, t) != ["limited"]:
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
    # A spatial tendon is changed by all joints between the bodies that it passes. One to a body that is not
    # the robot's would fix a floating robot.
    inside = [c.body[b][0] for b in bodies if b in c.body]
    if c.floating and any(inside) and len(inside) < len(bodies) + bodies.count(0):
        raise InputError(
            f"{c.what} ties the robot to a body that is not the robot's by the tendon "
            f"{c.name('tendon', t)!r}, which plans lack; {_OUT}"
        )
    for one in inside[1:]:
        joints.update(between(c.model, inside[0], one))
    return tuple(sorted(joints))


_HINGES = (pin.JointModelRX, pin.JointModelRY, pin.JointModelRZ)
_CONTINUOUS = (pin.JointModelRUBX, pin.JointModelRUBY, pin.JointModelRUBZ)
_SLIDES = (pin.JointModelPX, pin.JointModelPY, pin.JointModelPZ)


def compile_mjcf(path: str | PathLike[str]) -> Any:
    """The mujoco.MjModel of a file, shared by all callers; InputError if there is none, with the compiler's
    message."""
    file = existing(path, "MJCF")
    try:
        import mujoco  # noqa: F401
    except ImportError as error:
        raise missing_package("a robot from an MJCF", "mujoco", "validate") from error
    try:
        return _compiled(file, frozenset(_sources(Path(file))))
    except (OSError, ValueError) as error:
        whole = _including(Path(file))
        fix = f"; {whole} includes this file: give that one" if whole else ""
        raise InputError(f"MJCF {file}: {error}{fix}") from error


@lru_cache(maxsize=4)  # hulls of large meshes take seconds, and a draft reads its file ten times
def _compiled(file: str, _sources: frozenset[tuple[Path, object]]) -> Any:
    import mujoco

    with contextlib.suppress(ElementTree.ParseError):  # MuJoCo reads a URDF too, without its speed limits
        if ElementTree.parse(file).getroot().tag == "robot":
            raise ValueError("it is a URDF: give it by --urdf, or `urdf` in [robot]")
    return mujoco.MjModel.from_xml_path(file)


def _sources(file: Path) -> Iterator[tuple[Path, object]]:
    """Files that an MJCF is compiled from, with the content of XML files and the time of change of others."""
    folders, names, left, done = {"."}, set[str](), {file}, set[Path]()
    while left:
        done |= left
        for source in left:
            text = source == file or source.suffix.lower() in (".xml", ".mjcf")
            content = source.read_bytes() if text else source.stat().st_mtime_ns
            yield source, content
            with contextlib.suppress(ElementTree.ParseError):
                for part in ElementTree.fromstring(content).iter() if isinstance(content, bytes) else ():
                    folders.update(part.get(key, ".") for key in ("assetdir", "meshdir", "texturedir"))
                    names.add(part.get("file", "."))
        named = {file.parent / folder / name for folder in folders for name in names}
        left = {source for source in named - done if is_plain_file(source)}


def _including(file: Path) -> str:
    """Name of a file beside an MJCF that includes it and has what it lacks; "" if there is none."""
    for other in sorted(file.parent.glob("*.xml")):
        with contextlib.suppress(OSError, ElementTree.ParseError, ValueError):
            included = (part.get("file") for part in ElementTree.parse(other).iter("include"))
            if other != file and file.name in included and _compiled(str(other), frozenset(_sources(other))):
                return other.name
    return ""


def read_mjcf(
    path: str | PathLike[str],
    *,
    floating: bool | None = None,
    locked: Iterable[str] | Mapping[str, float] = (),
) -> Description:
    """The robot of an MJCF: the subtree of the body with a free joint; else all bodies with joints.

    floating : with a free-flyer at the root, or without; None: as in the file.
    locked : joints that will be removed; couplings to them do not move a motor's numbers.

    Raises
    ------
    InputError : no robot, or several; ball joints; equality constraints with other bodies.
    """
    mj = compile_mjcf(path)
    out = _Reader(mj, f"MJCF {path}", floating).read()
    out.lead_from_root(locked)
    return out


class _Reader(Compiled):
    """Reader of a compiled MJCF; `read` fills `out`."""

    def __init__(self, mj: Any, what: str, floating: bool | None) -> None:
        super().__init__(mj, what)
        roots = [b for b in range(1, mj.nbody) if mj.body_parentid[b] == 0 and self._has_joints(b)]
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
        gravcomp = gravcomp_of(self)
        gravity = np.zeros(3) if self.off("gravity") else np.array(self.mj.opt.gravity)
        self.model.gravity = pin.Motion((1.0 - gravcomp.fraction) * gravity, np.zeros(3))
        self.out.ties += ties_of(self, gravcomp, self.out.torque)
        self.out.tendons += tendons_of(self)
        self.out.notes += notes_of(self, gravcomp, self.out.torque)
        return self.out

    def _has_joints(self, root: int) -> bool:
        """True if the subtree of a root body has joints besides a free one, or the six of `_six`."""
        kinds = self.mj.jnt_type[self.mj.body_rootid[self.mj.jnt_bodyid] == root]
        return int((kinds != self.mujoco.mjtJoint.mjJNT_FREE).sum()) > 6 * self._six(root)

    def _free(self, b: int) -> bool:
        """True if the body has a free joint, or six on the ground that move it likewise."""
        first, count = int(self.mj.body_jntadr[b]), int(self.mj.body_jntnum[b])
        free = count > 0 and self.mj.jnt_type[first] == self.mujoco.mjtJoint.mjJNT_FREE
        return free or self._six(b)

    def _six(self, b: int) -> bool:
        """True if three slides and three hinges move a body on the ground, without limits, motors, tendons
        or equalities.
        """
        mj, first, kinds = self.mj, int(self.mj.body_jntadr[b]), self.mujoco.mjtJoint
        joints = np.s_[first : first + 6]
        slides = mj.jnt_type[joints] == kinds.mjJNT_SLIDE
        if mj.body_parentid[b] != 0 or mj.body_jntnum[b] != 6 or slides.sum() != 3:
            return False
        axes = mj.jnt_axis[joints]
        turns = np.all(mj.jnt_type[joints][~slides] == kinds.mjJNT_HINGE)
        spans = all(abs(np.linalg.det(axes[some])) > _SPAN for some in (slides, ~slides))
        driven = mj.actuator_trnid[mj.actuator_trntype == self.mujoco.mjtTrn.mjTRN_JOINT, 0]
        wrapped = mj.wrap_objid[mj.wrap_type == self.mujoco.mjtWrap.mjWRAP_JOINT]
        equal = mj.eq_type == self.mujoco.mjtEq.mjEQ_JOINT
        tied = np.concatenate([driven, wrapped, mj.eq_obj1id[equal], mj.eq_obj2id[equal]])
        held = mj.jnt_limited[joints].any() or np.isin(tied, np.arange(first, first + 6)).any()
        return bool(turns and spans and not held)

    def _add_body(self, b: int) -> None:
        """Add a body with its joints, in the order of the file, to the one that its parent hangs on."""
        mj, model = self.mj, self.model
        joint, place, above = self.body[int(mj.body_parentid[b])]
        place = place * _placement(mj.body_pos[b], mj.body_quat[b])  # in `joint`
        first, count = int(mj.body_jntadr[b]), int(mj.body_jntnum[b])
        free = self._free(b)
        if self.floating and b == self.roots[0]:
            name = self.name("joint", first) if free and count == 1 else "root_joint"
            joint, place = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), name), _none()
            above = model.addJointFrame(joint, 0)
        if self.floating and free and count > 1:
            names = ", ".join(self.name("joint", j) for j in range(first, first + count))
            note = f"joints {names} are read as a free joint of body {self.name('body', b)!r}"
            self.out.notes.append(note + (f", {own} left out" if (own := self.of_base(first)) else ""))
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
        """Name of an object, prefixed by its kind if a link or a site of the model has that name already."""
        name = self.name(kind, i)
        taken = [str(f.name) for f in self.model.frames if f.type != pin.FrameType.JOINT]
        return name if name not in taken else f"{kind} {name}"

    def _add_joint(self, j: int, parent: int, place: Any, above: int) -> tuple[int, int, Any]:
        """Index of the added joint, index of its frame, and rotation (pin.SE3) to the frame in which it turns
        about or along its axis.

        parent, place : joint that it hangs on, and its placement there.  above : the parent's frame.
        """
        mj, model, name = self.mj, self.model, self.name("joint", j)
        hinge = mj.jnt_type[j] == self.mujoco.mjtJoint.mjJNT_HINGE
        if not hinge and mj.jnt_type[j] != self.mujoco.mjtJoint.mjJNT_SLIDE:
            raise InputError(
                f"{self.what}: joint {name!r} is a ball or a free joint inside the robot; make hinges of it"
            )
        axis, zero = np.array(mj.jnt_axis[j]), float(mj.qpos0[mj.jnt_qposadr[j]])
        # placements of an MJCF are those at the joint's reference angle, Pinocchio's those at zero
        place = place * (
            pin.SE3(pin.exp3(-zero * axis), np.zeros(3)) if hinge else pin.SE3(np.eye(3), -zero * axis)
        )
        limited, dof = bool(mj.jnt_limited[j]), int(mj.jnt_dofadr[j])
        stiffness = 0.0 if self.off("spring", "passive") else _first(mj.jnt_stiffness[j])
        # one coordinate, which counts turns, not Pinocchio's (cos, sin) of continuous joints
        kind, turn = _kind(axis, hinge, limited or bool(stiffness) or j in self.followers)
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
            armature=mj.dof_armature[dof],
            viscous=0.0 if self.off("damper", "passive") else _first(mj.dof_damping[dof]),
            dry=0.0 if self.off("frictionloss", "constraint") else mj.dof_frictionloss[dof],
        )
        if stiffness:
            self.out.springs[name] = stiffness, float(mj.qpos_spring[mj.jnt_qposadr[j]])
        return added, int(model.addJointFrame(added, above)), turn

    def _add_to_joint(self, j: int, *, armature: float = 0.0, viscous: float = 0.0, dry: float = 0.0) -> None:
        """Add armature and friction, which may be negative, to those of a joint."""
        model, at = self.model, self.model.joints[self.joint[j]].idx_v
        own = np.array(model.armature), *friction(model)
        for numbers, added in zip(own, (armature, viscous, dry), strict=True):
            numbers[at] += added
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
        """Read gains, torque limits, armature and damping of the actuators, several of which add up."""
        mj, kinds = self.mj, self.mujoco.mjtTrn
        of_joints = (int(kinds.mjTRN_JOINT), int(kinds.mjTRN_JOINTINPARENT))
        most: dict[str, float] = {}  # torque [N m] of all enabled actuators, by joint
        for a in range(len(mj.actuator_trntype)):
            j = int(mj.actuator_trnid[a, 0])
            if int(mj.actuator_trntype[a]) not in of_joints:
                if mj.actuator_trntype[a] != kinds.mjTRN_TENDON:  # reported with the tendon
                    self.out.notes.append(f"actuator {self.name('actuator', a)!r}, of no joint, is left out")
                continue
            if j not in self.joint:
                continue
            out = int(mj.actuator_outadr[a]) if hasattr(mj, "actuator_outadr") else a
            name, gear = self.name("joint", j), abs(float(mj.actuator_gear[out, 0]))
            # An affine actuator's force is gain x control + b0 + b1 length + b2 speed. At the joint, forces
            # are multiplied by the gear ratio, gains and armature by its square.
            affine = mj.actuator_biastype[a] == self.mujoco.mjtBias.mjBIAS_AFFINE
            kp, kd = (-float(mj.actuator_biasprm[a, k]) * gear**2 if affine else 0.0 for k in (1, 2))
            rotor, viscous = (
                gear**2 * float(numbers[a]) if (numbers := self.numbers(f"actuator_{key}")).size else 0.0
                for key in ("armature", "damping")
            )
            self._add_to_joint(j, armature=rotor, viscous=0.0 if self.off("damper", "passive") else viscous)
            if self._disabled(a):
                continue
            most[name] = most.get(name, 0.0) + _force_limit(mj, a, affine) * gear
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
                # a servo without Kd is damped by the joint's damping, which becomes Kd instead of friction
                self.out.kd[name] = viscous
                self._add_to_joint(j, viscous=-viscous)

    def _disabled(self, a: int) -> bool:
        """True if the actuator's group is disabled."""
        group = int(self.mj.actuator_group[a])
        return 0 <= group < 31 and bool(int(self.mj.opt.disableactuator) >> group & 1)

    def _simple(self, a: int) -> bool:
        """True if an actuator's force is an instantaneous function of control, position and velocity, as of a
        motor or a servo.
        """
        mj, m = self.mj, self.mujoco
        return bool(
            mj.actuator_gaintype[a] == m.mjtGain.mjGAIN_FIXED
            and int(mj.actuator_biastype[a]) in (int(m.mjtBias.mjBIAS_NONE), int(m.mjtBias.mjBIAS_AFFINE))
            and mj.actuator_dyntype[a] == m.mjtDyn.mjDYN_NONE
            and not self.numbers("actuator_delay")[a : a + 1].any()
            and not self.numbers("actuator_dampingpoly")[a : a + 1].any()
        )

    def _keyframes(self) -> None:
        """Read the keyframes as reference configurations."""
        mj = self.mj
        for k in range(mj.nkey):
            q = pin.neutral(self.model)
            angles = [float(mj.key_qpos[k][mj.jnt_qposadr[j]]) for j in self.joint]
            JointAngles([self.model.joints[i] for i in self.joint.values()]).put(q, angles)
            if self.floating and self._free(self.roots[0]):
                data = self.mujoco.MjData(mj)
                data.qpos = mj.key_qpos[k]
                self.mujoco.mj_kinematics(mj, data)
                root = self.roots[0]
                q[:7] = pin.SE3ToXYZQUAT(_placement(data.xpos[root], data.xquat[root]))
            self.model.referenceConfigurations[self.name("key", k)] = q


def _force_limit(mj: Any, a: int, affine: bool) -> float:
    """The largest force [N m] of an actuator, before the gear; infinite without a limit.

    A control limit bounds the force of a motor only: for a servo (affine) it bounds the reference.
    """
    out = np.inf
    if mj.actuator_forcelimited[a]:
        out = float(np.abs(mj.actuator_forcerange[a]).min())
    k = int(mj.actuator_ctrladr[a]) if hasattr(mj, "actuator_ctrladr") else a
    if mj.actuator_ctrllimited[k] and not affine:
        out = min(out, float(np.abs(mj.actuator_ctrlrange[k]).min()) * abs(float(mj.actuator_gainprm[a, 0])))
    return out


def _kind(axis: Array, hinge: bool, limited: bool) -> tuple[Any, Any]:
    """Pinocchio's joint model about or along an axis, and its placement (pin.SE3) in the joint's frame."""
    along = [k for k in range(3) if axis[k] == 1 and not np.delete(axis, k).any()]
    if along:
        return ((_HINGES if limited else _CONTINUOUS) if hinge else _SLIDES)[along[0]](), _none()
    if not hinge:
        return pin.JointModelPrismaticUnaligned(axis), _none()
    if limited:
        return pin.JointModelRevoluteUnaligned(axis), _none()
    # Pinocchio's Python has no continuous joint with an axis as an argument: turn one about z
    to_axis = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), axis)
    return pin.JointModelRUBZ(), pin.SE3(to_axis.matrix(), np.zeros(3))


def _placement(position: Any, quaternion: Any) -> Any:
    return pin.SE3(_rotation(quaternion), np.array(position, dtype=np.float64))


def _rotation(quaternion: Any) -> Array:
    """Rotation matrix of a unit quaternion (w, x, y, z)."""
    w, x, y, z = (float(a) for a in quaternion)
    return np.array(pin.Quaternion(w, x, y, z).normalized().matrix())


def _turned(quaternion: Any, moments: Array) -> Array:
    """Inertia (3, 3) along a body's axes, of principal moments (3,) and the orientation of their axes."""
    turn = _rotation(quaternion)
    return turn @ np.diag(moments) @ turn.T


def _first(value: Any) -> float:
    """Linear coefficient of a stiffness or damping: MuJoCo 4 has polynomials, of which it is the first."""
    return float(np.ravel(value)[0])


def _none() -> Any:
    return pin.SE3.Identity()
