"""`Description`: what a URDF or an MJCF says of a robot, and what of it no plan can have."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from os import PathLike, fspath
from typing import Any

import numpy as np
import pinocchio as pin

from impactopt.errors import InputError, Mistakes, check_choice
from impactopt.robots.actuators import Actuator
from impactopt.robots.attachments import Source, Striker
from impactopt.robots.build import (
    effort_limit,
    joint_names,
    lock_joints,
    set_velocity_limit,
    velocity_limit,
)
from impactopt.robots.checks import INERTIAS, REPAIRED, repair_inertias
from impactopt.robots.couplings import Coupling, coupled, couplings_of, with_followers
from impactopt.robots.tendons import Tendon

__all__ = ["Description", "Tie", "between"]


@dataclass(frozen=True, kw_only=True)
class Tie:
    """Forces or constraints between joints, or on one, that a plan does not have.

    joints : by name.  free : how many of them may move all the same; the others have to be locked.
    text : of a message; begins with the thing and its name.  fix : another one than to lock.
    follower : the joint that has no motor, "" if none is meant; follows : a polynomial of the other joint's
        angle [rad], the lowest coefficient first, which is the follower's.
    note : what is told where it follows.
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
        """Law of the follower, if it is one that plans have."""
        if not self.follower or len(self.joints) != 2 or any(self.follows[2:]):
            return None
        (leader,) = {*self.joints} - {self.follower} or {self.follower}
        offset, ratio = (*self.follows, 0.0)[:2]
        return Coupling(leader, ratio, offset)

    def broken(self, joints: tuple[str, ...]) -> str:
        """The mistake of a robot whose joints these are; "" if there is none."""
        left = [joint for joint in self.joints if joint in joints]
        if len(left) <= self.free:
            return ""
        which = "it" if len(left) == 1 else "one of them" if self.free else f"all of {', '.join(left)}"
        return f"{self.text}; {self.fix and f'{self.fix}, or '}lock {which} (`locked`)"


@dataclass(kw_only=True)
class Description:
    """A robot in a file.

    kind : "URDF" or "MJCF".
    model : with its armature, friction, limits and gravity, and named configurations; a frame of type BODY
        for each link or body, and an OP_FRAME for each site, by their names.
    kp, kd, torque : by joint, what its actuators say.
    springs : stiffness [N m/rad] and angle at rest [rad] by joint.
    tendons : ranges of sums of joint angles.
    sites : names of those on links that move.  driven : joints that actuators move.  idle : joints that no
        actuator moves, where some have one.
    ties : what no plan has, unless joints are locked.
    notes : what was left out or taken otherwise than the file says, in words.
    """

    kind: str
    model: pin.Model
    kp: dict[str, float] = field(default_factory=dict)
    kd: dict[str, float] = field(default_factory=dict)
    torque: dict[str, float] = field(default_factory=dict)
    springs: dict[str, tuple[float, float]] = field(default_factory=dict)
    tendons: list[Tendon] = field(default_factory=list)
    sites: list[str] = field(default_factory=list)
    driven: list[str] = field(default_factory=list)
    idle: list[str] = field(default_factory=list)
    ties: list[Tie] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def lead_from_root(self) -> None:
        """Let joints that come before their leader in the tree lead, by the inverse law, with its motor."""
        model, followers = self.model, {tie.follower for tie in self.ties}
        for k, tie in enumerate(self.ties):
            law = tie.coupling
            if (
                law is None
                or not law.ratio
                or law.leader in followers
                or not model.existJointName(law.leader)
            ):
                continue
            own, other = (model.joints[model.getJointId(joint)] for joint in (tie.follower, law.leader))
            if own.id > other.id or not own.nq == other.nq == 1:
                continue
            note = f"{tie.text}, which comes after it in the tree: {tie.follower!r} leads, with its motor"
            inverse = (-law.offset / law.ratio, 1 / law.ratio)
            self.ties[k] = replace(tie, follower=law.leader, follows=inverse, note=note)
            followers ^= {tie.follower, law.leader}
            gain, speed = abs(law.ratio), velocity_limit(model)
            effort = float(effort_limit(model)[other.idx_v])
            if 0 < effort < np.finfo(float).max:  # Pinocchio's largest double stands for none
                self.torque.setdefault(law.leader, effort)
            for numbers, power in ((self.torque, 1), (self.kp, 2), (self.kd, 2)):
                numbers.pop(tie.follower, None)
                if law.leader in numbers:
                    numbers[tie.follower] = numbers.pop(law.leader) / gain**power
            if not speed[own.idx_v] > 0:  # many files give a follower none
                speed[own.idx_v] = gain * speed[other.idx_v]
                set_velocity_limit(model, speed)
            self.idle = [joint for joint in self.idle if joint != tie.follower]
            for names in (self.driven, self.idle):
                names[:] = [tie.follower if joint == law.leader else joint for joint in names]

    def moving(self, locked: Iterable[str] | Mapping[str, float]) -> pin.Model:
        """The model without locked joints, whose followers follow.

        Raises
        ------
        InputError : a joint that cannot follow another one, or two of them.
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
        """Options of `Robot.from_model` for a model with some of these joints, under those that are given.

        Raises
        ------
        InputError : joints are left whose ties a plan does not have.
        """
        joints, found = joint_names(model), Mistakes()
        found.found += [f"{self.kind}: {mistake}" for tie in self.ties if (mistake := tie.broken(joints))]
        found.raise_if_any(f"the {self.kind}")
        out = dict(given)
        for key, numbers in (("kp", self.kp), ("kd", self.kd), ("torque_limit", self.torque)):
            own = {joint: value for joint, value in numbers.items() if joint in joints}
            if own and isinstance(given.get(key, {}), Mapping):
                out[key] = {**own, **given.get(key, {})}
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
        """Tendons of a model with locked joints, whose followers follow."""
        angles = locked if isinstance(locked, Mapping) else dict.fromkeys(locked, 0.0)
        left = [tendon.without(angles, couplings_of(model)) for tendon in self.tendons]
        # one that is too long or too short with all of its joints locked is refused by the robot
        return [tendon for tendon in left if tendon.coefficients or not tendon.lower <= 0 <= tendon.upper]

    def made(
        self, path: str | PathLike[str], given: Mapping[str, Any], options: Mapping[str, Any]
    ) -> tuple[pin.Model, dict[str, Any], Source]:
        """The model without locked joints, all options of `Robot.from_model` for it, and its source.

        given : name, locked and inertias, as of `Robot.from_urdf`, and what is recorded beside them.
        options : of `Robot.from_model`, that were given.
        """
        check_choice("inertias", given["inertias"], INERTIAS)
        model, kind = self.moving(given["locked"]), self.kind.lower()
        repairs = tuple(repair_inertias(model)) if given["inertias"] == REPAIRED else ()
        every = {"name": given["name"] or model.name, kind: path, **self.options(model, options)}
        every["tendons"] = [*self.tendons_of(model, given["locked"]), *options.get("tendons", ())]
        notes = (*self.notes, *self._approximated(model))
        own: dict[str, Any] = {kind: fspath(path), "options": {**given, **options}}
        return model, every, Source(repairs=repairs, notes=notes, **own)

    def _approximated(self, model: pin.Model) -> Iterator[str]:
        joints, followers = joint_names(model), couplings_of(model)
        if idle := [repr(joint) for joint in self.idle if joint in joints]:
            yield f"no actuator moves {', '.join(idle)}: plans have a motor there all the same"
        for name in [joint for joint in self.driven if joint in followers]:
            yield f"the actuator of {name!r} is left out: the motor of {followers[name].leader!r} moves both"
        for tie in self.ties:
            if tie.follower in followers:
                yield from [tie.note] if tie.note else []
                continue
            left = [joint for joint in tie.joints if joint in joints]
            if left and len(left) < len(tie.joints):
                locked = ", ".join(repr(joint) for joint in tie.joints if joint not in joints)
                yield f"{tie.text}; {locked} is locked, and does not move with {', '.join(map(repr, left))}"


def between(model: pin.Model, one: int, other: int) -> tuple[str, ...]:
    """Names of the joints on the way in the tree from one joint of a model to another."""
    a, b = (list(model.supports[joint]) for joint in (one, other))
    return tuple(str(model.names[j]) for j in sorted(set(a) ^ set(b)) if model.joints[j].nv == 1)
