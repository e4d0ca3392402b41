"""Content of an export: motions, servo, target and metadata of a plan; its directory."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import secrets
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pinocchio as pin

from impactopt import __version__
from impactopt.arrays import Array, Index, Mask
from impactopt.contact.fields import abouts
from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import Target
from impactopt.errors import InputError, check_choice, check_kind, check_number
from impactopt.files.export.motion import JUMP, Motion, motion_at, with_passive_at_rest
from impactopt.files.export.smooth import Smoothness, smoothed
from impactopt.files.record import plain, read_json
from impactopt.files.replay import Planned
from impactopt.problem.problem import ImpactProblem
from impactopt.robots.robot import Robot
from impactopt.simulation import simulate
from impactopt.simulation.result import MAX_GAP, Simulation, parts_from
from impactopt.solvers.program import Status
from impactopt.transcription.plan import Trajectory

META = "meta.json"
MADE_BY = "impactopt export"
LARGEST = 1 << 24  # bytes of a meta.json


def write_directory(
    directory: Path, to: str, meta: Mapping[str, Any], write: Callable[[Path], object]
) -> list[Path]:
    """Have `write` fill a new directory, which then replaces `directory`; paths of the files, `META` first.

    to : the format's name.

    Raises
    ------
    InputError : it exists and is no earlier export of this format, or it cannot be written. Then nothing is
        changed.
    """
    _check_replaceable(directory, to)
    directory = Path(os.path.abspath(directory))
    new, old = (
        directory.with_name(f".{directory.name[:64]}.{secrets.token_hex(8)}.{x}") for x in ("new", "old")
    )
    new_parents = [folder for folder in directory.parents if not folder.exists()]  # the nearest first
    try:
        directory.parent.mkdir(parents=True, exist_ok=True)
        new.mkdir()
        write(new)
        names = sorted(str(p.relative_to(new)) for p in new.rglob("*") if p.is_file())
        whole = {"made_by": MADE_BY, "to": to, "files": [META, *names], **meta}
        (new / META).write_text(f"{json.dumps(whole, indent=2, allow_nan=False)}\n", encoding="utf-8")
        if directory.exists():
            directory.rename(old)
        new.rename(directory)
    except BaseException as error:
        shutil.rmtree(new, ignore_errors=True)
        with contextlib.suppress(OSError):
            if old.exists() and not directory.exists():
                old.rename(directory)
            for folder in new_parents:
                folder.rmdir()
        if not isinstance(error, OSError):
            raise
        raise InputError(f"cannot write {directory}: {error.strerror or error}; give another one") from error
    shutil.rmtree(old, ignore_errors=True)
    return [directory / name for name in whole["files"]]


def _check_replaceable(directory: Path, to: str) -> None:
    """InputError unless a directory does not exist, is empty or contains only an export of this format."""
    if not os.path.lexists(directory):
        return
    if directory.is_symlink() or not directory.is_dir():
        raise InputError(f"{directory} exists and is no directory; give another one with --out")
    try:
        names = sorted(str(p.relative_to(directory)) for p in directory.rglob("*") if not p.is_dir())
    except OSError as error:
        raise InputError(f"cannot read {directory}: {error.strerror}; give another one") from error
    if not names:
        return
    meta = read_json(directory / META, LARGEST)
    exported = meta.get("files") if meta.get("made_by") == MADE_BY else None
    if not isinstance(exported, list):
        raise InputError(f"{directory} holds something else ({names[0]}); give another directory with --out")
    if meta.get("to") != to:
        raise InputError(
            f"{directory} holds an export to {meta.get('to')}; give another directory with --out"
        )
    others = [name for name in names if name not in exported]
    if others:
        raise InputError(f"{directory} holds {others[0]} too, which no export made; give another directory")
    # Such a folder could be renamed, but not removed: the old export would stay beside the new one, hidden.
    for folder in (directory, *filter(Path.is_dir, directory.rglob("*"))):
        if not os.access(folder, os.W_OK):
            raise InputError(f"cannot write {folder}: it is read-only; give another directory with --out")


MIN_RATE, MAX_RATE = 1.0, 1e5  # [Hz]
PHASES = ("swing", "contact", "follow-through")
EXPECTED = ("impulse_Ns", "peak_force_N", "contact_ms", "hand_speed_m_s", "target")


@dataclass(frozen=True, kw_only=True, eq=False)
class Export:
    """Input of all writers.

    planned : the plan, its problem and its references.  joints : names, in the order of all columns.
    order (n,) : indices of these in the robot's own arrays.  rate [Hz].  gravity : effort includes it.
    smooth : limits of a smoothed motion and its impulses in a replay; None: it is not smoothed.
    motion : as planned, or smoothed.
    missed : the motion if nothing is hit, on the same time axis; None for a plan without an abort motion.
        From contact on both coast, `motion` until its contact ends, `missed` until the abort motion begins.
    """

    planned: Planned
    joints: tuple[str, ...]
    order: Index
    rate: float
    gravity: bool
    smooth: Mapping[str, Any] | None
    motion: Motion
    missed: Motion | None

    def standing(self, motion: Motion) -> dict[str, Mask]:
        """Mask (k,) of the instants at which each sole stands, by its name; {} without stance phases."""
        p = self.problem
        if motion.stance is None:
            return {}
        return dict(zip((sole.name for sole in p.soles), p.standing[motion.stance].T, strict=True))

    @property
    def problem(self) -> ImpactProblem:
        return self.planned.problem

    @property
    def robot(self) -> Robot:
        return self.planned.problem.robot

    @property
    def motions(self) -> dict[str, Motion]:
        """References of the servos by the names of their files; passive joints, as of soft grips, stay."""
        passive = self.robot.passive[self.order]
        motions = {"motion": self.motion, **({} if self.missed is None else {"missed": self.missed})}
        return {name: with_passive_at_rest(motion, passive) for name, motion in motions.items()}

    def per_joint(self, values: Array) -> Array:
        """Numbers (n,) of the robot in the order of the export."""
        return np.asarray(values)[self.order]

    @cached_property
    def meta(self) -> dict[str, Any]:
        """Content of `meta.json`: everything but histories."""
        p, robot, s = self.problem, self.robot, self.planned.record.summary
        return plain(
            {
                "problem": p.name,
                "hash": p.hash,
                "robot": robot.name,
                "rate_Hz": self.rate,
                "jump_s": JUMP,
                "effort_holds_gravity": self.gravity,
                "smooth": self.smooth,
                "phases": list(PHASES),
                **({"stances": s["stances"]} if "stances" in s else {}),
                "joints": self._joints(),
                "followers": [
                    {"name": name, "joint": law.leader, "multiplier": law.ratio, "offset": law.offset}
                    for name, law in robot.couplings.items()
                ],
                "base": None
                if self.motion.base is None
                else {"link": body_name(robot, 1), "quaternion": "w, x, y, z", "axes": "world"},
                "contact_s": [self.motion.contact_start, self.motion.contact_end],
                "end_s": self.motion.end,
                "missed": None
                if self.missed is None
                else {
                    "from_s": parts_from(self.motion, self.missed),
                    "abort_s": self.missed.contact_end,
                    "end_s": self.missed.end,
                },
                "target": {
                    "point_m": p.point,
                    "normal": p.normal,
                    "kind": p.target.word or type(p.target).__name__,
                    **_numbers(p.target),
                },
                "contact_law": {"law": p.law.word or type(p.law).__name__, **_numbers(p.law)},
                "striker": self._striker(p.striker),
                "second": None
                if p.second is None
                else {"target_point_m": p.second.point, "striker": self._striker(p.second.striker)},
                "expected": {name: s.get(name) for name in EXPECTED},
                "support_polygon_m": self.planned.record.arrays["polygon"],
                "versions": {**s.get("versions", {}), "export": __version__},
            }
        )

    def _striker(self, name: str) -> dict[str, Any]:
        robot = self.robot
        frame = robot.model.frames[robot.model.getFrameId(robot.striker(name).model_frame)]
        link, point = body_name(robot, int(frame.parentJoint)), np.array(frame.placement.translation)
        return {"name": name, "link": link, "point_m": point}

    def _joints(self) -> list[dict[str, Any]]:
        robot, out = self.robot, []
        for name, k in zip(self.joints, self.order, strict=True):
            out.append(
                {
                    "name": name,
                    **({"passive": True} if robot.passive[k] else {}),
                    "kind": "prismatic" if robot.prismatic[k] else "revolute",
                    "kp": robot.kp[k],
                    "kd": robot.kd[k],
                    "effort_limit": robot.torque_limit[k],
                    "velocity_limit": robot.velocity_limit[k],
                    "position_limits": [robot.lower[k], robot.upper[k]],
                }
            )
        return out


def export_of(
    planned: Planned,
    *,
    rate: float,
    joints: Sequence[str] | None = None,
    gravity: bool = True,
    smooth: Literal["terms"] | tuple[float, float] | None = None,
) -> Export:
    """A plan sampled at a rate [Hz].

    joints : order in all columns; default the robot's own.  gravity : effort includes it.
    smooth : largest acceleration [rad/s^2] and jerk [rad/s^3] of all joints; "terms": those of the problem's
        terms; None: not smoothed.

    Raises
    ------
    InputError : the plan is not solved; joints that are no permutation of the robot's; a rate out of range;
        a robot that is not bolted, without gravity or smoothed; limits that no motion satisfies, or none that
        hits.
    """
    check_kind("gravity", gravity, bool)
    robot = planned.problem.robot
    order = check_export(planned.record.summary.get("status"), robot, rate, joints)
    smoothing: dict[str, Any] | None = None
    if smooth is not None:
        planned, smoothing, replayed = _smoothed(planned, smooth)
    reference, missed = planned.reference, planned.missed
    if not gravity:
        reference = _without_gravity(reference, robot)
        missed = None if missed is None else _without_gravity(missed, robot)
    motion = motion_at(reference, robot, rate, order, planned.record.arrays, jumps=smooth is None)
    if smooth is not None:
        force = np.interp(motion.time, replayed.contact_time, replayed.contact_force)
        motion = dataclasses.replace(motion, force=force)
    return Export(
        planned=planned,
        joints=tuple(robot.joint_names[k] for k in order),
        order=order,
        rate=rate,
        gravity=gravity,
        smooth=smoothing,
        motion=motion,
        missed=None if missed is None else motion_at(missed, robot, rate, order, {}),
    )


def _smoothed(
    planned: Planned, limits: Literal["terms"] | tuple[float, float]
) -> tuple[Planned, dict[str, Any], Simulation]:
    """The plan with a smoothed reference and without its abort motion, which would begin with a jump; limits
    and impulses of the smoothed motion in a replay; the replay, whose contact the plan's summary has.

    A motion that cannot brake at contact has its reference behind the target, and presses on it after the
    impact. That impulse is `pressing_Ns`; `pressing_ms` is the time from the impact to the last contact.
    `feed_forward_ratio` is the largest feed-forward torque, with gravity, over its joint's limit.

    Raises
    ------
    InputError : no motion satisfies the limits; it does not hit the target, or presses more than it hits; it
        does not break a board that the plan breaks.
    """
    within = Smoothness.of(planned.problem, limits)
    reference = smoothed(planned.reference, planned.problem, within)
    replayed = simulate(planned.problem, reference)
    if not replayed.impulse:
        swing = planned.reference.phase == 0
        time, own = planned.reference.time[swing], planned.reference.a[swing, -planned.problem.robot.n :]
        jerk = np.diff(own, axis=0) / np.diff(time)[:, None]
        most, fastest = (float(f"{np.abs(x).max():.2g}") for x in (own, jerk))
        raise InputError(
            f"smooth: the motion with {within} does not hit the target; the plan's swing has up to "
            f"{most:g} rad/s^2 and {fastest:g} rad/s^3: "
            "give larger limits, or plan with [terms.joint_acceleration]"
        )
    touches = np.array(replayed.touches)
    impact_end = touches[0, 0] + reference.contact_end - reference.contact_start + MAX_GAP
    impulse, whole = (replayed.impulse_until(t) for t in (impact_end, np.inf))
    pressing = whole - impulse
    if pressing > impulse:
        raise InputError(
            f"smooth: the motion with {within} brakes too late: it gives the target {impulse:.3g} N s in the "
            "impact, and then presses on it "
            f"with {pressing:.3g} N s, until {touches[-1, 1] - touches[0, 0]:.2g} s after the first touch; "
            "give larger limits, or plan with a smaller fraction in [terms.velocity_limit]"
        )
    outcome = planned.record.summary.get("target") or {}
    if outcome.get("broken") and not replayed.outcome.get("broken", True):
        raise InputError(
            f"smooth: the motion with {within} does not break the board: it presses with "
            f"{replayed.peak_force:.3g} N, the plan with "
            f"{planned.record.summary['peak_force_N']:.3g} N; give larger limits"
        )
    driven = ~planned.problem.robot.passive
    ratio = np.abs(reference.torque[:, driven]) / planned.problem.robot.torque_limit[driven]
    names = planned.problem.robot.joint_names
    acceleration, jerk = (
        dict(zip(names, most, strict=True)) if isinstance(limits, str) else most[0] for most in within.limits
    )
    smoothing: dict[str, Any] = {
        "acceleration_rad_s2": acceleration,
        "jerk_rad_s3": jerk,
        "impulse_Ns": impulse,
        "planned_impulse_Ns": float(planned.record.summary["impulse_Ns"]),
        "pressing_Ns": pressing,
        "pressing_ms": 1e3 * max(float(touches[-1, 1] - impact_end), 0.0),
        "touches": len(replayed.touched),
        "feed_forward_ratio": float(ratio.max()),
    }
    record, limit = planned.record, planned.problem.robot.torque_limit
    report = replayed.report(
        torque_limit=limit, polygon=record.arrays["polygon"], planned_impulse=smoothing["planned_impulse_Ns"]
    )
    summary = {**record.summary, **{name: report[name] for name in EXPECTED}}
    record = dataclasses.replace(record, summary=summary)
    return dataclasses.replace(planned, record=record, reference=reference, missed=None), smoothing, replayed


def _without_gravity(reference: Trajectory, robot: Robot) -> Trajectory:
    """The reference with feed-forward less g(q), for joints with a motor."""
    if robot.floating:
        raise InputError(
            "gravity: only torques of a bolted robot have a part for gravity alone, those of one on soles "
            "depend on the contact forces: leave it at its default"
        )
    model, data = robot.model, robot.model.createData()
    weight = np.array([pin.computeGeneralizedGravity(model, data, q) for q in reference.q])
    return dataclasses.replace(reference, torque=reference.torque - np.where(robot.passive, 0.0, weight))


def check_export(status: Any, robot: Robot, rate: float, joints: Sequence[str] | None) -> Index:
    """Indices of the joints in the order of the export; InputError as of `export_of`."""
    unusable = {s.value: s.message for s in Status if not s.usable}
    if status in unusable:
        raise InputError(
            f"this plan is not solved ({status}), and a robot should not follow it: {unusable[status]} "
            "Solve the problem first"
        )
    rate = check_number("rate [Hz]", rate)
    if not MIN_RATE <= rate <= MAX_RATE:
        raise InputError(f"rate [Hz]: {rate:g}; give a number from {MIN_RATE:g} to {MAX_RATE:g}")
    return joint_order(robot, joints)


def joint_order(robot: Robot, joints: Sequence[str] | None) -> Index:
    """Indices of an export's joints in the robot's arrays.

    Raises
    ------
    InputError : a name that is unknown, given twice, or left out.
    """
    if joints is None:
        return np.arange(robot.n)
    own, given = robot.joint_names, list(joints)
    for name in given:
        check_choice(f"joints: the robot {robot.name!r} has no joint", name, own)
    for what, names in (
        ("named twice", [name for name in own if given.count(name) > 1]),
        ("left out", [name for name in own if name not in given]),
    ):
        if names:
            raise InputError(f"joints: {', '.join(names)} {what}; give each of {robot.n} joints once")
    return np.array([own.index(name) for name in given], dtype=np.intp)


def body_name(robot: Robot, joint: int) -> str:
    """Name of the link that a joint of the model moves; of joint 0, the link fixed to the world."""
    for frame in robot.model.frames:
        if frame.type == pin.FrameType.BODY and frame.parentJoint == joint and frame.name != "universe":
            return str(frame.name)
    return str(robot.model.names[joint])


def _numbers(thing: ContactLaw | Target) -> dict[str, float]:
    """Parameters of a law or a target, by their keys in problem files."""
    kind: Any = type(thing)
    known = dataclasses.is_dataclass(kind)  # a user's own law may be none
    keys = {field.name: about.key_of(field.name) for field, about in (abouts(kind) if known else ())}
    return {keys.get(name, name): value for name, value in thing.parameters.items()}
