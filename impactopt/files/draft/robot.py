"""Robot of a draft: locked joints, guessed drives and repaired inertias; its legs and arms."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from impactopt.bodies.convex_hulls import Piece, pieces_of
from impactopt.codegen.files import is_plain_file
from impactopt.errors import InputError, did_you_mean, shortened
from impactopt.files.draft.default_drives import RANGE, Drives, guess_drives
from impactopt.files.draft.limbs import (
    Limb,
    arms_of,
    legs_of,
    limbs_of,
    range_of,
    renumbered,
    to_lock,
    toes,
    unshared,
)
from impactopt.robots.build import ROOT, is_floating, lock_joints, neutral
from impactopt.robots.checks import LEG, REPAIRED, check_inertias
from impactopt.robots.couplings import unfit
from impactopt.robots.description import Description, Tie
from impactopt.robots.mjcf import read_mjcf
from impactopt.robots.presets import example_robots
from impactopt.robots.robot import Robot
from impactopt.robots.urdf import read_urdf

# reasons for which a joint is locked; many files have no effort of joints that have a motor
FIXED = "fixed in the file"
NO_MOTOR = "no motor, as the file has no effort: else unlock it, with torque_limit_N_m"
UPRIGHT = 0.7  # cosine of the largest angle between a leg that stands and the vertical
SUFFIXES = (".urdf", ".xml", ".mjcf", ".xacro")  # of files; a robot's name may have another dot


@dataclass(frozen=True, kw_only=True)
class Drafted:
    """A robot of a draft, still without soles, strikers and postures.

    options : of `Robot.from_urdf` or `Robot.from_mjcf`.  locked : reasons, by locked joint.
    wrong : messages about non-physical inertias, which are repaired here.
    pieces : convex hulls of the links, by the joint that moves them.
    fixed : True if its MJCF has a free joint, but no legs to stand on.
    turn : the turn of the root, in words, with which it would have legs; "" if there is none.
    """

    robot: Robot
    path: Path
    options: Mapping[str, Any]
    locked: Mapping[str, str]
    drives: Drives
    wrong: tuple[str, ...]
    legs: tuple[Limb, ...]
    arms: tuple[Limb, ...]
    pieces: Mapping[int, tuple[Piece, ...]] = field(repr=False)
    fixed: bool = False
    turn: str = ""

    @property
    def mjcf(self) -> bool:
        """True if the description is an MJCF."""
        return self.robot.mjcf is not None

    @property
    def kind(self) -> str:
        """Format of the description."""
        return "MJCF" if self.mjcf else "URDF"

    @property
    def freed(self) -> bool:
        """True if the robot stands although its MJCF has no free joint."""
        return self.mjcf and self.robot.floating and not is_floating(read_mjcf(self.path).model)

    def made(self, **more: Any) -> Robot:
        """The robot read again, with additional options."""
        return _robot(self.path, self.mjcf, {**self.options, **more})


def find_description(given: str) -> Path:
    """The file at a path, or the URDF of a name in example-robot-data, such as "panda" or "ur5_robot".

    Raises
    ------
    InputError : there is none, or there are several; the message lists them.
    """
    path = Path(given).expanduser()
    if is_plain_file(path):
        return path
    if path.suffix.lower() in SUFFIXES or len(path.parts) != 1:
        raise InputError(f"there is no file {shortened(given, 300)}")
    known = _examples()
    if given in known:
        return known[given]
    near = sorted(name for name in known if name.startswith(f"{given}_"))
    if f"{given}_robot" in near or len(near) == 1:
        return known[f"{given}_robot" if f"{given}_robot" in near else near[0]]
    if near:
        raise InputError(f"example-robot-data has several robots {given!r}: {', '.join(near)}; name one")
    raise InputError(
        f"there is no file {shortened(given)!r}, and no such robot in example-robot-data"
        f"{did_you_mean(given, known)}; it has {', '.join(sorted(known))}"
    )


def _examples() -> dict[str, Path]:
    """URDFs by their names without suffix."""
    folder = example_robots("a robot by its name")
    return {path.stem: path for path in sorted(folder.glob("*/*/*.urdf"))}


def draft_robot(path: Path, *, mjcf: bool = False, bolted: bool = False) -> Drafted:
    """The robot of a file, on two legs if it has them, else bolted to the ground.

    bolted : to the ground, even if it has legs.

    Raises
    ------
    InputError : it cannot be read; its legs cannot be planned for, with the reason; it stands on legs, and
        its root has no mass, or bodies have their own `gravcomp`; it is bolted, and no limb can strike.
    """
    first, ties = _floating(path, mjcf, bolted)
    locked = _locked(first)
    if not any(body.mass for body in list(first.model.inertias)[1 + is_floating(first.model) :]):
        raise InputError(
            f"{path}: its links have no mass, so no motion can be planned; give each an <inertial>, with "
            "mass and inertia"
        )
    if locked and len(locked) == first.model.njoints - 1 - is_floating(first.model):
        why = ", ".join(f"{joint} ({reason})" for joint, reason in locked.items())
        raise InputError(f"{path}: no joint is left to move; locked: {why}")
    floats = is_floating(first.model) and float(first.model.inertias[1].mass) > 0 and not ties
    found = _made(path, mjcf, floats, locked)
    if is_floating(first.model) and not floats:
        _check_bolted(first, found, ties)
    legs = legs_of(found.robot.model, found.pieces) if floats else ()
    if coupled := _coupled_legs(found.robot, legs):
        locked |= coupled
        found = _made(path, mjcf, True, locked)
        legs = legs_of(found.robot.model, found.pieces)
    if legs:
        _check_legs(found.robot, legs)
        extra = dict.fromkeys(toes(found.robot.model, legs, found.pieces), "a toe")
        extra |= dict.fromkeys(_undriven(found, legs, extra), NO_MOTOR)
        locked = {**locked, **extra}
        carrying = {str(found.robot.model.names[j]) for leg in legs for j in leg.path} - extra.keys()
        if extra or carrying & found.drives.torque.keys():
            found = _made(path, mjcf, True, locked, carrying)
            legs = legs_of(found.robot.model, found.pieces)
    turn = "" if legs or not floats else _turn(found)
    if floats and not legs:
        found = _made(path, mjcf, False, locked)
    arms = arms_of(found.robot.model, legs)
    if bolted:  # a punch with a foot is for robots without arms
        arms = arms_of(found.robot.model, _legs_if_free(found))
    if idle := {} if legs else _idle(found.robot.model, arms):
        found = _made(path, mjcf, False, {**found.locked, **idle})
        arms = arms_of(found.robot.model, legs)
    if not arms and not legs:
        raise InputError(f"{path}: there is no limb to strike with")
    fixed = mjcf and not legs and not bolted and is_floating(read_mjcf(path).model)
    return replace(found, legs=legs, arms=arms, fixed=fixed, turn=turn)


def _legs_if_free(found: Drafted) -> tuple[Limb, ...]:
    """Limbs of a bolted robot that would be its legs if it had a free root, unless no arm is left beside
    them.
    """
    free, bolted = _floating(found.path, found.mjcf, False)[0].model, found.robot.model
    if not is_floating(free):
        return ()
    free = lock_joints(free, found.options["locked"])
    legs = legs_of(free, {joint + 1: pieces for joint, pieces in found.pieces.items()})
    legs = tuple(renumbered(leg, free, bolted) for leg in legs)
    return legs if any(len(arm.own) > 1 for arm in arms_of(bolted, legs)) else ()


def _turn(found: Drafted) -> str:
    """The turn of a floating robot's root with which two of its limbs, but not all, would be legs.

    Files of simulators with y up are read as robots that lie on their side.
    """
    for axis, degrees in (("x", 90), ("x", -90), ("y", 90), ("y", -90), ("x", 180)):
        model = found.robot.model.copy()
        q = neutral(model)
        now = pin.Quaternion(*q[[6, 3, 4, 5]])
        q[3:7] = pin.Quaternion(pin.utils.rotate(axis, np.radians(degrees)) @ now.matrix()).coeffs()
        model.referenceConfigurations[ROOT] = q
        data, legs = model.createData(), legs_of(model, found.pieces)
        pin.forwardKinematics(model, data, q)
        # the feet of a robot that lies may be lowest, too
        ways = [data.oMi[1].translation - data.oMi[leg.tip].translation for leg in legs]
        upright = all(way[2] > UPRIGHT * np.linalg.norm(way) for way in ways)
        enough = upright and len(legs) == 2 and min(map(len, unshared(model, legs))) >= LEG - 1
        if enough and any(len(arm.own) > 1 for arm in arms_of(model, legs)):
            quat = " ".join(f"{part:.7g}" for part in q[[6, 3, 4, 5]].round(7) + 0.0)
            how = f", by quat='{quat}' of its <body>" if found.mjcf else ""
            return f"by {degrees} degrees about {axis}{how}"
    return ""


def _coupled_legs(robot: Robot, legs: tuple[Limb, ...]) -> dict[str, str]:
    """Reasons to lock followers on legs whose leaders are not in the same leg only, and these leaders.

    A leg has to fix its sole by its own motors. Both are locked, as with one leg turned and the other not a
    robot stands badly.
    """
    names, out = [str(name) for name in robot.model.names], dict[str, str]()
    for leg, own in zip(legs, unshared(robot.model, legs), strict=True):
        for follower in sorted({names[j] for j in leg.path} & robot.couplings.keys()):
            leader = robot.couplings[follower].leader
            if leader not in {names[j] for j in own}:
                out |= dict.fromkeys((leader, follower), f"{follower} follows {leader}")
    return out


def _undriven(found: Drafted, legs: tuple[Limb, ...], toes: Collection[str]) -> list[str]:
    """Joints without a torque limit on legs of more than six joints of which others have one, such as Digit's
    tarsi, which springs and rods hold; without its toes each leg keeps six.
    """
    out = list[str]()
    for own in unshared(found.robot.model, legs):
        names = [name for j in own if (name := str(found.robot.model.names[j])) not in toes]
        free = [name for name in names if name in found.drives.undriven]
        out += free[: max(len(names) - LEG, 0)] if len(free) < len(names) else []
    return out


def _idle(model: pin.Model, arms: tuple[Limb, ...]) -> dict[str, str]:
    """Reasons to lock joints of a bolted robot's limbs that cannot strike, such as heads and sensors.

    For a robot on legs such joints help to balance.
    """
    striking = {arm.tip for arm in arms}
    return {
        str(model.names[joint]): "in no limb that strikes, as a head"
        for limb in limbs_of(model)
        if limb.tip not in striking
        for joint in limb.own
    }


def _floating(path: Path, mjcf: bool, bolted: bool) -> tuple[Description, list[Tie]]:
    """The robot with a free-flyer at its root, unless it is bolted or has several roots; and the ties of an
    added free-flyer, those of `gravcomp`.

    Many MJCFs of humanoids have no free joint, as the scene adds it.
    """
    if bolted or not mjcf:
        return _read(path, mjcf, not bolted), []
    read = read_mjcf(path)
    if is_floating(read.model):
        return read, []
    try:
        floating = read_mjcf(path, floating=True)
    except InputError:  # several bodies on the ground
        return read, []
    return floating, [tie for tie in floating.ties if tie not in read.ties]


def _check_bolted(first: Description, found: Drafted, ties: Sequence[Tie]) -> None:
    """InputError for a robot on legs that cannot have a free-flyer.

    first : with a free-flyer.  found : without.  ties : that it has with a free-flyer only; if there are
        none, the root of the floating robot has no mass.
    """
    what, fix = "the root link has no mass", "give it an <inertial>, or bolt it to the ground (--bolted)"
    free = [
        str(name) for name, joint in zip(first.model.names, first.model.joints, strict=True) if joint.nv == 6
    ]
    if found.mjcf:  # a planar model, as MuJoCo has no moving bodies without mass
        heavy = next(j for j, body in enumerate(first.model.inertias) if j and body.mass)
        what = f"joints {', '.join(map(str, list(first.model.names)[2 : heavy + 1]))} move its root"
        fix = "replace them by a <freejoint/>, or bolt it to the ground (--bolted)"
    if len(free) > 1:
        what, fix = f"joint {free[1]!r} is floating", "remove it and its parent link"
    if ties:
        what, fix = ties[0].text, f"{ties[0].fix}, or bolt it to the ground (--bolted)"
    model = lock_joints(first.model, found.options["locked"])
    if legs_of(model, {joint + 1: pieces for joint, pieces in found.pieces.items()}):
        raise InputError(f"{found.path}: {what}, and the robot stands on legs; {fix}")


def _read(path: Path, mjcf: bool, floating: bool | None, locked: Collection[str] = ()) -> Description:
    if mjcf:
        return read_mjcf(path, floating=floating, locked=locked)
    out = read_urdf(path, floating=bool(floating), locked=locked, repaired=True)
    lower, upper = out.model.lowerPositionLimit, out.model.upperPositionLimit
    for joint in out.unranged:
        k = out.model.joints[out.model.getJointId(joint)].idx_q
        lower[k], upper[k] = RANGE
    out.model.lowerPositionLimit, out.model.upperPositionLimit = lower, upper
    return out


def _locked(read: Description) -> dict[str, str]:
    """Reasons to lock joints: those of `to_lock`, and followers that plans do not support."""
    out = to_lock(read.model)
    ties = [tie for tie in read.ties if tie.follower]
    while stuck := [tie for tie in ties if tie.follower not in out and not _follows(read.model, tie, out)]:
        out |= {tie.follower: _why_locked(tie) for tie in stuck}
    return out


def _follows(model: pin.Model, tie: Tie, locked: Collection[str]) -> bool:
    """True if the tie is a coupling that plans support, with an unlocked leader."""
    law = tie.coupling
    return law is not None and law.leader not in locked and not unfit(model, tie.follower, law)


def _why_locked(tie: Tie) -> str:
    others = [joint for joint in tie.joints if joint != tie.follower]
    return f"{tie.follower} follows {others[0]}" if others else FIXED


def _made(
    path: Path, mjcf: bool, floating: bool, locked: Mapping[str, str], carrying: Collection[str] = ()
) -> Drafted:
    read = _read(path, mjcf, floating, locked)
    angles = {joint: _rest(read.model, joint) for joint in locked}
    for tie in _read(path, mjcf, floating).ties if locked else ():  # their followers `_locked` has chosen
        if tie.follower in locked:
            angles[tie.follower] = _followed(read.model, tie, angles)
    model = read.moving(angles)
    drives = guess_drives(model, read.torque, carrying, read.unranged, read.kd)
    wrong: tuple[str, ...] = ()
    try:
        check_inertias(model)
    except InputError as error:
        wrong = error.mistakes
    options: dict[str, Any] = {"locked": angles} | ({} if floating and not mjcf else {"floating": floating})
    for key, values in (
        ("armature", drives.armature),
        ("torque_limit", drives.torque),
        ("velocity_limit", drives.velocity),
        ("position_limit", drives.position),
    ):
        options |= {key: values} if values else {}
    out = Drafted(
        robot=_robot(path, mjcf, options),
        path=path,
        options=options,
        locked=locked,
        drives=drives,
        wrong=wrong,
        legs=(),
        arms=(),
        pieces={},
    )
    pieces: dict[int, list[Piece]] = {}
    for piece in pieces_of(out.robot)[0]:
        pieces.setdefault(piece.joint, []).append(piece)
    return replace(out, pieces={joint: tuple(several) for joint, several in pieces.items()})


def _robot(path: Path, mjcf: bool, options: Mapping[str, Any]) -> Robot:
    """The robot of a file, with repaired inertias."""
    return (Robot.from_mjcf if mjcf else Robot.from_urdf)(path, inertias=REPAIRED, **options)


def _rest(model: pin.Model, name: str) -> float:
    """The angle nearest to zero inside the limits."""
    low, high = range_of(model, model.getJointId(name))
    return float(np.clip(0.0, low, high)) if low <= high else 0.0


def _followed(model: pin.Model, tie: Tie, angles: Mapping[str, float]) -> float:
    """The angle at which a follower is locked: that for its leader's locked angle, or a quarter of its range.

    An arm with a follower that is locked straight has little reach.
    """
    leader = next((joint for joint in tie.joints if joint != tie.follower), None)
    angle = 0.0 if leader is None else angles.get(leader, _bent(model, leader))
    low, high = range_of(model, model.getJointId(tie.follower))
    followed = float(np.polynomial.polynomial.polyval(angle, tie.follows))
    return float(np.clip(followed, low, high)) if low <= high else followed


def _bent(model: pin.Model, name: str) -> float:
    """The angle of a joint at a quarter of its range; 0 without limits."""
    low, high = range_of(model, model.getJointId(name)) if model.existJointName(name) else (0.0, 0.0)
    return low + 0.25 * (high - low) if np.isfinite([low, high]).all() else 0.0


def _check_legs(robot: Robot, legs: tuple[Limb, ...]) -> None:
    """InputError unless there are two legs with enough joints of their own."""
    model = robot.model
    own = unshared(model, legs)
    listed = "; ".join(", ".join(str(model.names[j]) for j in joints) for joints in own)
    counts = " or ".join(str(count) for count in sorted({len(joints) for joints in own}))
    if len(legs) != 2 or min(map(len, own)) < LEG - 1:
        raise InputError(
            f"{robot.name!r} has {len(legs)} legs of {counts} joints of their own each ({listed}), and "
            f"impactopt plans for robots on two legs of {LEG} or more, which fix a sole in all its {LEG} "
            f"directions, on two of {LEG - 1}, whose soles turn about one axis, or on a fixed base (--bolted)"
        )
