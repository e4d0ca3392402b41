"""`Description`: contents of a URDF or an MJCF, with the features that plans do not support."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from os import PathLike, fspath
from typing import Any

import numpy as np
import pinocchio as pin

from impactopt.errors import InputError, Mistakes, check_choice, named_table
from impactopt.robots.actuators import Actuator
from impactopt.robots.attachments import Source, Striker
from impactopt.robots.build import (
    effort_limit,
    joint_names,
    lock_joints,
    locked_angles,
    moving_joints,
    position_limit,
    reference_configurations,
    set_velocity_limit,
    velocity_limit,
)
from impactopt.robots.checks import INERTIAS, POSITION_SLACK, REPAIRED, repair_inertias
from impactopt.robots.couplings import Coupling, Ranges, Tendon, coupled, couplings_of, with_followers
from impactopt.robots.model import JointAngles


@dataclass(frozen=True, kw_only=True)
class Tie:
    """A constraint or force on joints that the equations of motion do not have.

    It is supported only if it is a linear law of two joints (`coupling`). Otherwise joints must be locked.

    joints : by name.  free : how many of them may stay unlocked.
    text : beginning of a message: the thing and its name.  fix : another fix than to lock joints.
    follower : the joint that follows, "" if there is no such law.  follows : its angle, a polynomial of the
        other joint's angle [rad], lowest coefficient first.
    note : a message for a follower that is supported, "" for none.
    """

    text: str
    joints: tuple[str, ...]
    free: int = 1
    fix: str = ""
    follower: str = ""
    follows: tuple[float, ...] = (0.0,)
    note: str = ""

    @property
    def coupling(self) -> Coupling | None:
        """Law of the follower; None if it is not linear, or there is no follower."""
        if not self.follower or len(self.joints) != 2 or any(self.follows[2:]):
            return None
        (leader,) = {*self.joints} - {self.follower} or {self.follower}  # a file may have it follow itself
        offset, ratio = (*self.follows, 0.0)[:2]
        return Coupling(leader, ratio, offset)

    def broken(self, joints: tuple[str, ...]) -> str:
        """Message for a robot with these joints, if it does not support the tie; else ""."""
        unlocked = [joint for joint in self.joints if joint in joints]
        if len(unlocked) <= self.free:
            return ""
        which = (
            "it" if len(unlocked) == 1 else "one of them" if self.free else f"all of {', '.join(unlocked)}"
        )
        return f"{self.text}; {self.fix and f'{self.fix}, or '}lock {which} (`locked`)"


@dataclass(kw_only=True)
class Description:
    """A robot as described by a file.

    kind : "URDF" or "MJCF".
    model : with armature, friction, limits, gravity and named configurations; a frame of type BODY for each
        link or body, and an OP_FRAME for each site, by their names.
    kp, kd, torque : servo gains and torque limits of the file's actuators, by joint.
    springs : stiffness [N m/rad] and rest angle [rad] by joint.
    tendons : ranges of sums of joint angles.
    unranged : revolute joints of a file without ranges: they have an empty one, from 0 to 0.
    sites : names of those on moving links.  driven : joints with an actuator.  idle : joints without one, in
        a file that has actuators.
    ties : constraints and forces for which joints have to be locked or coupled.
    notes : messages about features that were left out or interpreted differently.
    """

    kind: str
    model: pin.Model
    kp: dict[str, float] = field(default_factory=dict)
    kd: dict[str, float] = field(default_factory=dict)
    torque: dict[str, float] = field(default_factory=dict)
    springs: dict[str, tuple[float, float]] = field(default_factory=dict)
    tendons: list[Tendon] = field(default_factory=list)
    unranged: list[str] = field(default_factory=list)
    sites: list[str] = field(default_factory=list)
    driven: list[str] = field(default_factory=list)
    idle: list[str] = field(default_factory=list)
    ties: list[Tie] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def lead_from_root(self, locked: Iterable[str] | Mapping[str, float]) -> None:
        """Invert couplings whose leader comes after the follower in the tree, in place.

        Pinocchio needs leaders first. The motor's numbers (gains, torque and velocity limits) move from the
        old leader to the new one, reflected by the ratio, unless only the new one has an actuator. A coupling
        with a locked joint is not inverted: the other joint keeps its own motor.
        """
        model, fixed = self.model, set(locked)
        followers = {tie.follower for tie in self.ties if fixed.isdisjoint(tie.joints)}
        # the first of several followers leads, so that the others come after it
        for k in sorted(range(len(self.ties)), key=lambda k: model.getJointId(self.ties[k].follower)):
            tie = self.ties[k]
            law = tie.coupling
            if (
                law is None
                or not fixed.isdisjoint(tie.joints)
                or not law.ratio
                or law.leader in followers
                or not model.existJointName(law.leader)
            ):
                continue
            own, other = (model.joints[model.getJointId(joint)] for joint in (tie.follower, law.leader))
            if own.id > other.id or not own.nq == other.nq == 1:
                continue
            drives, driven = (joint in self.driven for joint in (law.leader, tie.follower))
            motor = f"the motor of {law.leader!r}" if drives or not driven else "its own motor"
            left_out = f"; the actuator of {tie.follower!r} is left out" if drives and driven else ""
            leads = f"{tie.follower!r} leads, with {motor}{left_out}"
            note = f"{tie.text}, which comes after it in the tree: {leads}"
            inverse = (-law.offset / law.ratio, 1 / law.ratio)
            self.ties[k] = replace(tie, follower=law.leader, follows=inverse, note=note)
            followers ^= {tie.follower, law.leader}
            if driven and not drives:
                self.idle = [joint for joint in self.idle if joint != law.leader]
                continue
            ratio, speed = abs(law.ratio), velocity_limit(model)
            effort = float(effort_limit(model)[other.idx_v])
            if 0 < effort < np.finfo(float).max:  # Pinocchio has the largest double for a missing limit
                self.torque.setdefault(law.leader, effort)
            # a torque is reflected by the ratio, a stiffness or damping by its square
            for numbers, power in ((self.torque, 1), (self.kp, 2), (self.kd, 2)):
                numbers.pop(tie.follower, None)
                if law.leader in numbers:
                    numbers[tie.follower] = numbers.pop(law.leader) / ratio**power
            if not speed[own.idx_v] > 0:  # many files have no velocity limit, or 0, for a follower
                speed[own.idx_v] = ratio * speed[other.idx_v]
                set_velocity_limit(model, speed)
            for names in (self.driven, self.idle):
                others = [joint for joint in names if joint != tie.follower]
                names[:] = [tie.follower if joint == law.leader else joint for joint in others]

    def moving(self, locked: Iterable[str] | Mapping[str, float]) -> pin.Model:
        """The model without locked joints, with the supported couplings.

        Raises
        ------
        InputError : a joint that cannot follow another one, or follows two.
        """
        model = lock_joints(self.model, locked)
        joints, couplings = joint_names(model), dict[str, Coupling]()
        for tie in self.ties:
            if tie.coupling is not None and set(tie.joints) <= set(joints):
                if tie.follower in couplings:
                    raise InputError(
                        f"{self.kind}: joint {tie.follower!r} follows {couplings[tie.follower].leader!r} and "
                        f"{tie.coupling.leader!r}; it can follow one: take the other <mimic> or equality out"
                    )
                couplings[tie.follower] = tie.coupling
        return coupled(model, couplings) if couplings else model

    def options(self, model: pin.Model, given: Mapping[str, Any]) -> dict[str, Any]:
        """Options of `Robot.from_model` for a model with some of these joints; those given take precedence.

        Raises
        ------
        InputError : unsupported ties between joints that are not locked.
        """
        joints, found = joint_names(model), Mistakes()
        found.found += [f"{self.kind}: {mistake}" for tie in self.ties if (mistake := tie.broken(joints))]
        found.raise_if_any(f"the {self.kind}")
        out = dict(given)
        for key, numbers in (("kp", self.kp), ("kd", self.kd), ("torque_limit", self.torque)):
            own = {joint: value for joint, value in numbers.items() if joint in joints}
            if own and isinstance(table := named_table(given.get(key, {})), Mapping):
                out[key] = {**own, **table}
        springs = {
            joint: Actuator(spring_stiffness=stiffness, spring_rest=rest)
            for joint, (stiffness, rest) in with_followers(self.springs, couplings_of(model)).items()
            if joint in joints
        }
        if springs:
            out["actuators"] = {**springs, **given.get("actuators", {})}
        named = {striker.name for striker in given.get("strikers", ())}
        sites = [Striker(name=s, frame=s, point=np.zeros(3)) for s in self.sites if s not in named]
        return {**out, "strikers": [*sites, *given.get("strikers", ())]}

    def tendons_of(self, model: pin.Model, locked: Iterable[str] | Mapping[str, float]) -> list[Tendon]:
        """Tendons of a model with locked joints and couplings."""
        angles = locked_angles(locked)
        tendons = [tendon.without(angles, couplings_of(model)) for tendon in self.tendons]
        # Those with all joints locked inside their range are dropped; one outside it is kept, so that
        # `check_tendons` refuses it.
        return [tendon for tendon in tendons if tendon.coefficients or not tendon.lower <= 0 <= tendon.upper]

    def made(
        self, path: str | PathLike[str], given: Mapping[str, Any], options: Mapping[str, Any]
    ) -> tuple[pin.Model, dict[str, Any], Source]:
        """The model without locked joints, all options of `Robot.from_model` for it, and its source.

        given : name, locked and inertias, as of `Robot.from_urdf`, and other arguments to record.
        options : arguments for `Robot.from_model`.
        """
        check_choice("inertias", given["inertias"], INERTIAS)
        model, kind = self.moving(given["locked"]), self.kind.lower()
        repairs = tuple(repair_inertias(model)) if given["inertias"] == REPAIRED else ()
        every = {"name": given["name"] or model.name, kind: path, **self.options(model, options)}
        every["tendons"] = [*self.tendons_of(model, given["locked"]), *options.get("tendons", ())]
        notes = (*self.notes, *self._approximated(model), *self._unreachable(model, every))
        own: dict[str, Any] = {kind: fspath(path), "options": {**given, **options}}
        return model, every, Source(repairs=repairs, notes=notes, **own)

    def _approximated(self, model: pin.Model) -> Iterator[str]:
        """Notes on actuators and ties that a model without the locked joints treats differently."""
        joints, followers = joint_names(model), couplings_of(model)
        if idle := [repr(joint) for joint in self.idle if joint in joints]:
            yield f"no actuator moves {', '.join(idle)}: plans have a motor there all the same"
        for name in [joint for joint in self.driven if joint in followers]:
            yield f"the actuator of {name!r} is left out: the motor of {followers[name].leader!r} moves both"
        for tie in self.ties:
            if tie.follower in followers:
                yield from [tie.note] if tie.note else []
                continue
            unlocked = [joint for joint in tie.joints if joint in joints]
            if unlocked and len(unlocked) < len(tie.joints):
                locked = ", ".join(repr(joint) for joint in tie.joints if joint not in joints)
                moving = ", ".join(map(repr, unlocked))
                yield f"{tie.text}; {locked} is locked, and does not move with {moving}"

    def _unreachable(self, model: pin.Model, options: Mapping[str, Any]) -> Iterator[str]:
        """Drop an MJCF's keyframes outside the ranges of joints and tendons from a model, with a note each.

        A user's own postures, and an SRDF's, are refused there instead.
        """
        names = joint_names(model)
        if self.kind != "MJCF" or not names:
            return
        limits = position_limit(model, names, options.get("position_limit"))
        ranges = Ranges.of(names, *limits, options["tendons"])
        angles = JointAngles(moving_joints(model))
        for name, q in reference_configurations(model).items():
            worst, excess = ranges.excess(angles.of(q)[None])
            if excess > POSITION_SLACK and name not in (options.get("postures") or {}):
                del model.referenceConfigurations[name]
                yield f"keyframe {name!r} is left out: {worst} is out of its range there"


def between(model: pin.Model, one: int, other: int) -> tuple[str, ...]:
    """Names of the joints on the path in the tree from one joint of a model to another."""
    a, b = (set(model.supports[joint]) for joint in (one, other))
    return tuple(str(model.names[j]) for j in sorted(a ^ b) if model.joints[j].nv == 1)
