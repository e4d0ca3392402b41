"""Physics of an MJCF that no plan has: tendons, loops, springs, couplings, fluids, and partial `gravcomp`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from impactopt.errors import InputError
from impactopt.robots.description import Tie, between

__all__ = ["Compiled", "gravity_of", "notes_of", "ties_of"]

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
        spring = max(
            np.max(np.abs(c.numbers(key)[j]), initial=0.0)
            for key in ("jnt_stiffness", "jnt_stiffnesspoly")
            if c.numbers(key).size
        )
        if spring and not c.off("spring", "passive"):
            yield Tie(
                text=f"joint {name!r} has a spring, stiffness {spring:g}, which no plan has",
                joints=(name,),
                free=0,
                fix=_OUT,
            )
        bent = c.numbers("dof_dampingpoly")[int(mj.jnt_dofadr[j]) :][:1]
        if bent.any() and not c.off("damper", "passive"):
            text = f"joint {name!r} has damping that is not linear in its speed, which no plan has"
            yield Tie(text=text, joints=(name,), free=0, fix=_OUT)
    for b in c.body:
        first, count = int(mj.body_jntadr[b]), int(mj.body_jntnum[b])
        names = [c.name("joint", j) for j in range(first, first + count) if j in c.joint]
        if len(names) > 1:
            text = f"joints {', '.join(map(repr, names))} move the same body, with no mass between them"
            yield Tie(text=text, joints=tuple(names), fix="put bodies with mass between them")


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


def _tendons(c: Compiled) -> Iterator[Tie]:
    mj = c.mj
    driven = (
        {
            int(i)
            for i, kind in zip(
                c.numbers("actuator_trnid")[:, :1].ravel(), c.numbers("actuator_trntype"), strict=True
            )
            if kind == c.mujoco.mjtTrn.mjTRN_TENDON
        }
        if mj.nu
        else set()
    )
    equal = c.mujoco.mjtEq.mjEQ_TENDON
    held = {
        int(i) for e in range(mj.neq) if mj.eq_type[e] == equal for i in (mj.eq_obj1id[e], mj.eq_obj2id[e])
    }
    for t in range(mj.ntendon):
        does = [
            key
            for key in ("stiffness", "damping", "frictionloss", "armature", "limited")
            if c.numbers(f"tendon_{key}")[t : t + 1].any()
        ]
        does += ["an actuator"] if t in driven else []
        does += ["an equality"] if t in held else []
        joints = _joints_of_tendon(c, t)
        if does and joints:
            yield Tie(
                text=f"tendon {c.name('tendon', t)!r} acts on {', '.join(joints)} ({', '.join(does)}), which "
                "no plan has",
                joints=joints,
                free=0,
                fix=_OUT,
            )


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
