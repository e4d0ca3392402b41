"""`Description`: what a URDF or an MJCF says of a robot, and what of it no plan can have."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from os import PathLike, fspath
from typing import Any

import numpy as np
import pinocchio as pin

from impactopt.errors import InputError, Mistakes, check_choice
from impactopt.robots.actuators import Actuator
from impactopt.robots.attachments import Source, Striker
from impactopt.robots.build import joint_names, lock_joints
from impactopt.robots.checks import INERTIAS, REPAIRED, repair_inertias
from impactopt.robots.couplings import Coupling, coupled, couplings_of, with_followers

__all__ = ["Description", "Tie", "between"]


@dataclass(frozen=True, kw_only=True)
class Tie:
    """Forces or constraints between joints, or on one, that a plan does not have.

    joints : by name.  free : how many of them may move all the same; the others have to be locked.
    text : of a message; begins with the thing and its name.  fix : another one than to lock.
    follower : the joint that has no motor, "" if none is meant; follows : a polynomial of the other joint's
        angle [rad], the lowest coefficient first, which is the follower's.
    """

    text: str
    joints: tuple[str, ...]
    free: int = 1
    fix: str = ""
    follower: str = ""
    follows: tuple[float, ...] = (0.0,)

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
    sites: list[str] = field(default_factory=list)
    driven: list[str] = field(default_factory=list)
    idle: list[str] = field(default_factory=list)
    ties: list[Tie] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

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
                continue
            left = [joint for joint in tie.joints if joint in joints]
            if left and len(left) < len(tie.joints):
                locked = ", ".join(repr(joint) for joint in tie.joints if joint not in joints)
                yield f"{tie.text}; {locked} is locked, and does not move with {', '.join(map(repr, left))}"


def between(model: pin.Model, one: int, other: int) -> tuple[str, ...]:
    """Names of the joints on the way in the tree from one joint of a model to another."""
    a, b = (list(model.supports[joint]) for joint in (one, other))
    return tuple(str(model.names[j]) for j in sorted(set(a) ^ set(b)) if model.joints[j].nv == 1)
