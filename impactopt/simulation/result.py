"""Scene and result of a replay, and helpers of the engines: touches, stance phases, sole quantities."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.integrate import cumulative_trapezoid

from impactopt.arrays import Array, Index, Mask
from impactopt.contact.friction import ContactFriction, moves_target
from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import Target
from impactopt.errors import InputError, check_kind
from impactopt.robots.loads import DriveLoads, cop_margin, least_margins
from impactopt.robots.robot import Robot
from impactopt.simulation.collision_geometry import Solids, UnintendedContact
from impactopt.simulation.motors import MotorCut

FACE = 0.2  # [m] radius of the target's surface about where it may be hit, across the normal
MAX_GAP = 5e-3  # [s] between touches that belong to one impact
PHASES = ("swing", "collision", "follow")
PHASES_OF_MISS = ("swing", "missed")  # before and after the planned contact
# keys of `impactopt validate --json`
REPORT = (
    "engine",
    "standing",
    "reason",
    "impulse_Ns",
    "impulse_error_pct",
    "step_error_pct",
    "peak_force_N",
    "contact_ms",
    "zmp_margin_m",
    "sole_slip_mm",
    "sole_lift_mm",
    "torque_ratio",
    "saturated_ms",
    "final_posture_error_rad",
    "beyond_range_rad",
    "beyond_range",
    "impulses_Ns",
    "zmp_margin_by_phase_m",
    "torque_ratio_by_phase",
    "gear_ratio",
    "gear_joint",
    "motor_ratio",
    "motor_joint",
    "power_W",
    "power_joint",
    "velocity_jump_rad_s",
    "velocity_jump_joint",
    "motor_cut_ms",
    "motor_cut_joint",
    "motor_cuts",
    "sole_lift_collision_mm",
    "hand_speed_m_s",
    "sole_cop_margin_mm",
    "sole_force_N",
    "landing_speed_m_s",
    "target",
    "grip_force_N",
    "clearance_mm",
    "nearest",
    "contacts_besides",
)


def travelled(time: Array, speed: Array, contact_start: float) -> Array:
    """Travel (k,) [m] since contact began, from speeds (k,) [m/s]; without contact (nan), since the start."""
    gone = cumulative_trapezoid(speed, time, initial=0.0)
    return gone - np.interp(contact_start, time, gone) if np.isfinite(contact_start) else gone


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Target, contact and ground of a replay.

    point (3,) [m] : where the target's surface is to be hit
    normal (3,) : direction in which the target is pushed
    law, target : contact law and target dynamics
    striker : frame of the model that hits
    soles : frames of the model that the plan fixes to the ground
    corners : (k, 2) [m] of each sole, in the plane of its frame, counter-clockwise
    polygon (k, 2) [m] : support polygon on the ground, counter-clockwise
    solids : bodies that can touch each other
    hands : frames of the model that hold on to where the reference has them at first
    friction : of the striking points on the target
    second : frame and point (3,) [m] of another striker that hits the same target
    standing : (stances, soles) soles that stand in each stance phase; (0, 0): one stance, on all
    polygons : support polygon of each stance phase; (): one stance
    face [m] : radius of the target's surface about the point, across the normal
    """

    point: Array
    normal: Array
    law: ContactLaw
    target: Target
    striker: str
    soles: tuple[str, ...]
    corners: tuple[Array, ...]
    polygon: Array
    solids: Solids = field(default_factory=Solids)
    hands: tuple[str, ...] = ()
    friction: ContactFriction | None = None
    second: tuple[str, Array] | None = None
    standing: Mask = field(default_factory=lambda: np.zeros((0, 0), dtype=bool))
    polygons: tuple[Array, ...] = ()
    face: float = FACE

    @property
    def strikers(self) -> tuple[str, ...]:
        """Frames of the model that hit."""
        return (self.striker,) if self.second is None else (self.striker, self.second[0])

    def polygon_of(self, stance: int) -> Array:
        """Support polygon (c, 2) [m] of a stance phase."""
        return self.polygons[stance] if self.polygons else self.polygon

    def standing_soles(self, stance: int) -> Index:
        """Indices of the soles that stand in a stance phase."""
        return np.flatnonzero(self.standing[stance]) if self.standing.size else np.arange(len(self.soles))


@dataclass(frozen=True, kw_only=True, eq=False)
class Simulation:
    """Result of a replay: histories over ``time`` (k,) [s], contact, and summary quantities.

    Histories:

    q (k, nq), v (k, nv) : Pinocchio's
    force (k,) [N] : contact force of all strikers, at the instant
    target_speed, hand_speed (k,) : [m/s] along the normal
    target_travel (k,) [m] : displacement of the target along the normal from its place at the planned contact
        In MuJoCo it agrees with the robot's place, which steps of first order leave behind: by 0.4 mm of 14
        of a nail with 0.2 ms, in proportion to the step. The depth in `outcome` has no such error.
    target_aside (k, 3) [m] : displacement of the target across the normal; (0, 3): friction does not move it
    demand, torque (k, n) [N m] : of the servo before saturation, and of the motors
    gear (k, n) [N m] : torque of largest magnitude through each gear since the instant before
    sole_ground (k, soles, 6) : [N, N m] wrench of the ground on each sole about the world's origin; it may
        pull where the engine fixes the soles
    cop_margin (k, soles) [m] : from each sole's centre of pressure to its own nearest edge, as in
        :func:`impactopt.robots.loads.cop_margin`
    slip, lift (k, soles) [m] : motion along the ground, and rise, of the corner that moved most since the
        sole began to stand
    grip_force (k, hands) [N] : on each supporting hand
    stance (k,) : number of the reference's stance phase; (0,): there is one

    Contact and target:

    contact_start, contact_end [s] : of the impact, whose touches are less than 5 ms apart; nan if the target
        was not hit
    touches : start [s], end [s] and impulse [N s] of each
    contact_time (m,) [s], contact_force (m,) [N] : the contact force of all strikers at the instants of its
        own integration, which is finer than ``time``, on both sides of each begin and end of contact; zero
        between touches. Its largest value is ``peak_force``, and its integral the impulse.
    impulse, impulses [N s] : integral of the contact force over the whole motion; of each striker
    peak_force [N] : largest force, which may occur within a step
    outcome : the target's result after the last touch, by name and unit (``speed_m_s``, ``depth_m``,
        ``broken``)
    missed : there was no target
    expected [s] : begin of contact in the reference
    expected_state (nq + nv,) : configuration and velocity of the reference there
    step_error : estimated relative error of the impulse by the engine's steps; nan if it was not computed, or
        nothing was hit

    Robot:

    fall : reason why the robot does not stand at the end, "" if it stands; None if the engine fixes the soles
    posture_error [rad] : of the joint, or of the base's orientation, that ends farthest from the reference's
        last posture
    beyond_range : joint or tendon that was farthest out of its range, and by how much [rad]
    saturated [s] : time in which the demand of some joint was above its torque limit
    loads, cuts : largest loads of gears and motors; joints whose demand was cut by their motor's line, the
        longest first, None if no motor's line is known
    landing_speed (soles,) [m/s] : of the fastest corner as a sole touches down; nan if it does not

    Bodies and scene:

    touched : unintended contacts
    clearance [m], nearest : least exact distance of two bodies that must not touch, and their names; no
        names if all stay farther apart than 0.1 m
    soles, stands, polygons : names of the soles; the scene's ``standing`` and ``polygons``
    """

    engine: str
    time: Array = field(repr=False)
    q: Array = field(repr=False)
    v: Array = field(repr=False)
    force: Array = field(repr=False)
    target_speed: Array = field(repr=False)
    hand_speed: Array = field(repr=False)
    target_travel: Array = field(repr=False)
    demand: Array = field(repr=False)
    torque: Array = field(repr=False)
    sole_ground: Array = field(repr=False)
    soles: tuple[str, ...]
    cop_margin: Array = field(repr=False)
    slip: Array = field(repr=False)
    lift: Array = field(repr=False)
    contact_start: float
    contact_end: float
    impulse: float
    peak_force: float
    outcome: dict[str, float]
    saturated: float
    posture_error: float
    fall: str | None
    beyond_range: tuple[str, float] = ("", 0.0)
    touched: tuple[UnintendedContact, ...] = ()
    clearance: float = np.nan
    nearest: tuple[str, ...] = ()
    missed: bool = False
    expected: float = np.nan
    expected_state: Array = field(default_factory=lambda: np.zeros(0), repr=False)
    touches: tuple[tuple[float, float, float], ...] = ()
    contact_time: Array = field(default_factory=lambda: np.zeros(0), repr=False)
    contact_force: Array = field(default_factory=lambda: np.zeros(0), repr=False)
    step_error: float = np.nan
    gear: Array = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    loads: DriveLoads | None = field(default=None, repr=False)
    cuts: tuple[MotorCut, ...] | None = None
    grip_force: Array = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    impulses: Array = field(default_factory=lambda: np.zeros(0), repr=False)
    stance: Index = field(default_factory=lambda: np.zeros(0, dtype=np.intp), repr=False)
    stands: Mask = field(default_factory=lambda: np.zeros((0, 0), dtype=bool), repr=False)
    polygons: tuple[Array, ...] = field(default=(), repr=False)
    landing_speed: Array = field(default_factory=lambda: np.zeros(0), repr=False)
    target_aside: Array = field(default_factory=lambda: np.zeros((0, 3)), repr=False)

    @property
    def ground(self) -> Array:
        """Ground wrench (k, 6) about the world's origin [N, N m]."""
        return np.asarray(self.sole_ground.sum(axis=1))

    @property
    def sole_normal(self) -> Array:
        """Normal force (k, soles) [N] of each sole, negative where the ground would have to pull."""
        return self.sole_ground[:, :, 2]

    @property
    def standing(self) -> bool | None:
        """True if the robot stands at the end; None if the engine constrains its soles to the ground."""
        return None if self.fall is None else not self.fall

    def zmp(self) -> Array:
        """Zero moment point (k, 2) [m] on the ground; nan where nothing presses on it."""
        return centre_of_pressure(self.ground)

    def sole_cop(self) -> Array:
        """Centre of pressure (k, soles, 2) [m] of each sole, world; nan where it does not press."""
        return centre_of_pressure(self.sole_ground)

    def impulse_until(self, last: float) -> float:
        """Impulse [N s] up to a time [s], at which a touch may last."""
        total = 0.0
        for start, end, whole in self.touches:
            if end <= last:
                total += whole
            elif start < last:
                impulse = cumulative_trapezoid(self.contact_force, self.contact_time, initial=0.0)
                before, now, after = np.interp([start, last, end], self.contact_time, impulse)
                total += whole * (now - before) / (after - before) if after > before else 0.0
        return total

    def aside(self) -> Array:
        """Displacement (k, 3) [m] of the target across its normal; zero if friction does not move it."""
        return self.target_aside if len(self.target_aside) else np.zeros((len(self.time), 3))

    def phase(self) -> Index:
        """Phase (k,) by the contact that happened: 0 swing, 1 collision, 2 follow-through."""
        start = self.contact_start if np.isfinite(self.contact_start) else np.inf
        end = self.contact_end if np.isfinite(self.contact_end) else np.inf
        return np.asarray((self.time >= start).astype(int) + (self.time >= end).astype(int))

    def summary(self, *, torque_limit: Array, polygon: Array, planned_impulse: float) -> dict[str, Any]:
        """Impulse, force, margins and demand by phase, soles, standing; keys as in ``summary.json``.

        Without contact, the speed at contact and the error of the impulse are None.

        Raises
        ------
        InputError : the target was not hit, though there was one and the engine fixes the soles.
        """
        if np.isnan(self.contact_start) and self.fall is None and not self.missed:
            raise InputError("the simulated motion never touched the target")
        return self._summary(torque_limit, polygon, planned_impulse)

    def _summary(self, torque_limit: Array, polygon: Array, planned_impulse: float) -> dict[str, Any]:
        hit = bool(np.isfinite(self.contact_start))
        known = bool(np.isfinite(self.clearance))
        # without contact, the motion is divided at the planned one
        phase = self.phase() if hit else (self.time >= self.expected).astype(int)
        names = PHASES if hit else PHASES_OF_MISS
        out: dict[str, Any] = {
            "engine": self.engine,
            "standing": self.standing,
            "reason": "the soles are fixed: only an engine with free soles can tell"
            if self.fall is None
            else self.fall,
            "impulse_Ns": self.impulse,
            "impulse_error_pct": 100 * (self.impulse / planned_impulse - 1) if hit else None,
            "target": self.outcome if hit else {},
            "step_error_pct": None if np.isnan(self.step_error) else 100 * self.step_error,
            "peak_force_N": self.peak_force,
            "contact_ms": 1e3 * (self.contact_end - self.contact_start) if hit else 0.0,
            # of the last instant before contact; a target that comes early may touch at once
            "hand_speed_m_s": float(self.hand_speed[max(int((phase == 0).sum()) - 1, 0)]) if hit else None,
            "saturated_ms": 1e3 * self.saturated,
            "final_posture_error_rad": self.posture_error,
            # None: no joint is out of its range
            "beyond_range_rad": self.beyond_range[1] or None,
            "beyond_range": self.beyond_range[0] or None,
            "clearance_mm": 1e3 * self.clearance if known and self.nearest else None,
            "nearest": " and ".join(self.nearest),
            "contacts_besides": [contact.summary() for contact in self.touched] if known else None,
            **({} if self.loads is None else self.loads.summary()),
            **self._cut_summary(),
        }
        if len(self.impulses) > 1:
            out["impulses_Ns"] = self.impulses.tolist()
        if self.grip_force.size:
            out["grip_force_N"] = float(self.grip_force.max())
        ratio = np.abs(self.demand / torque_limit).max(axis=1)
        out["torque_ratio"] = {
            n: float(ratio[phase == k].max()) for k, n in enumerate(names) if (phase == k).any()
        }
        if len(polygon):
            inside = self._inside(polygon)
            out["zmp_margin_m"] = {
                n: float(np.nanmin(inside[phase == k]))
                for k, n in enumerate(names)
                if np.isfinite(inside[phase == k]).any()
            }
            out |= least_margins(
                self.soles,
                self.cop_margin,
                self.sole_normal,
                {n: phase == k for k, n in enumerate(names)},
                *((self.stands, self.stance) if self.stance.size else ()),
            )
            if self.stance.size:
                speeds = zip(self.soles, self.landing_speed, strict=True)
                out["landing_speed_m_s"] = {name: float(v) for name, v in speeds if np.isfinite(v)}
            out["sole_slip_mm"] = 1e3 * float(self.slip.max())
            out["sole_lift_mm"] = 1e3 * float(self.lift.max())
            collision = self.lift[phase == 1]
            out["sole_lift_collision_mm"] = 1e3 * float(collision.max()) if collision.size else 0.0
        return out

    def _inside(self, polygon: Array) -> Array:
        """Distance (k,) [m] of the ZMP from the edges of the support polygon at each instant, < 0 outside.

        polygon : support polygon of a motion with one stance. With several, each instant takes the polygon of
            a stance with all soles that stand as planned, or carry load all the same.
        """
        zmp = self.zmp()
        if not self.stance.size:
            return distance_inside(polygon, zmp)
        distances = np.array([distance_inside(own, zmp) for own in self.polygons])  # (stances, k)
        loaded = self.stands[self.stance] | (self.sole_normal > 0)
        # Take the stance with the lowest cost: the number of its soles, if it has all that are needed. Ties,
        # as of two stances before and after a step, go to the nearest in time: that part of the cost is below
        # 1.
        lacks = (loaded[:, None] & ~self.stands).any(axis=2)
        cost = np.where(lacks, self.stands.shape[1] + 1.0, self.stands.sum(axis=1))
        number = np.arange(len(distances))
        begins = self.time[np.searchsorted(self.stance, number).clip(max=len(self.time) - 1)]
        progress = np.interp(self.time, [*begins, self.time[-1]], [*number, len(number)]) - 0.5
        cost += np.abs(progress[:, None] - number) / (len(number) + 1)
        return np.asarray(distances[cost.argmin(axis=1), np.arange(len(zmp))])

    def _cut_summary(self) -> dict[str, Any]:
        """Summary of motor cuts; ``motor_cut_ms`` is None if no motor's line is known, 0 if none was cut."""
        if not self.cuts:
            return {
                "motor_cut_ms": None if self.cuts is None else 0.0,
                "motor_cut_joint": None,
                "motor_cuts": [],
            }
        return {
            "motor_cut_ms": 1e3 * self.cuts[0].duration,
            "motor_cut_joint": self.cuts[0].joint,
            "motor_cuts": [cut.describe() for cut in self.cuts],
        }

    def report(self, *, torque_limit: Array, polygon: Array, planned_impulse: float) -> dict[str, Any]:
        """Summary as `impactopt validate --json` prints it, with the worst value of all phases; also of a
        target that was not hit, whichever the engine.

        ``zmp_margin_m`` is the least, ``torque_ratio`` the largest; ``zmp_margin_by_phase_m`` and
        ``torque_ratio_by_phase`` are those of `summary`.
        """
        given = self._summary(torque_limit, polygon, planned_impulse)
        margins, ratios = given.get("zmp_margin_m", {}), given["torque_ratio"]
        given["zmp_margin_m"] = min(margins.values(), default=None)
        given["torque_ratio"] = max(ratios.values())
        given |= {"zmp_margin_by_phase_m": margins, "torque_ratio_by_phase": ratios}
        return {name: given.get(name) for name in REPORT}


def state_at_contact(reference: Any) -> Array:
    """Configuration and velocity (nq + nv,) of a reference at the begin of contact."""
    k = np.flatnonzero(reference.phase == 0)[-1]
    return np.concatenate([reference.q[k], reference.v[k]])


SAME_STATE = 1e-6  # [rad], [rad/s], [m], [m/s] between the states of one plan at contact, computed twice


def check_simulations(reference: Any, **simulations: Any) -> None:
    """InputError unless all simulations that are given (not None) are of a plan with this reference."""
    for name, given in simulations.items():
        if given is None:
            continue
        check_kind(name, given, Simulation)
        other = given.q.shape[1] != reference.q.shape[1]
        if not (other or np.isnan(given.expected)):  # nan: unknown
            # the begin alone is that of all plans whose swing has a given duration
            other = given.expected != reference.contact_start or not np.allclose(
                given.expected_state, state_at_contact(reference), rtol=0.0, atol=SAME_STATE
            )
        if other:
            raise InputError(f"{name} is of another plan: give this solution's, of validate()")


_NEXT, _PREVIOUS = [1, 2, 0], [2, 0, 1]  # axes


def cross(a: Array, b: Array) -> Array:
    """Products a x b (..., 3); np.cross takes several times as long."""
    return a[..., _NEXT] * b[..., _PREVIOUS] - a[..., _PREVIOUS] * b[..., _NEXT]


def centre_of_pressure(wrench: Array) -> Array:
    """Centre of pressure (..., 2) [m] on the ground of wrenches (..., 6) about the origin; nan at no load."""
    # moment about the origin over normal force: (-M_y, M_x) / F_z on the plane z = 0
    normal = np.where(wrench[..., 2] > 1e-6, wrench[..., 2], np.nan)
    return np.stack([-wrench[..., 4], wrench[..., 3]], axis=-1) / normal[..., None]


def distance_inside(polygon: Array, points: Array) -> Array:
    """Distance (k,) [m] of points (k, 2) from a counter-clockwise polygon's nearest edge, < 0 outside."""
    edge = np.roll(polygon, -1, axis=0) - polygon
    # As `kinematics.stance.margin`, which engines do not import: they share no code with the planner. Edges
    # of a counter-clockwise polygon have the inside on their left.
    inward = np.stack([-edge[:, 1], edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
    return np.asarray((points @ inward.T - (inward * polygon).sum(axis=1)).min(axis=1))


def parts_from(reference: Any, missed: Any) -> float:
    """Time [s] from which a robot that has sensed no contact follows ``missed`` instead of ``reference``.

    Both coast from the planned contact on. At its ``contact_end``, ``reference`` passes into the
    follow-through. ``missed`` coasts until its own ``contact_end``, when the robot notices the miss, and is
    then the abort motion.
    """
    return min(float(reference.contact_end), float(missed.contact_end))


def stance_begins(reference: Any, stance: int) -> int:
    """Index of a reference's first instant in a stance phase; 0 where there is one stance."""
    stances = np.asarray(getattr(reference, "stance", ()))
    return int(np.argmax(stances == stance)) if stances.size else 0


def stance_at(reference: Any, t: float) -> int:
    """Number of the stance phase of a reference at a time [s]; 0 where there is one stance."""
    stance = getattr(reference, "stance", ())
    if not len(stance):
        return 0
    return int(stance[max(int(np.searchsorted(reference.time, t, side="right")) - 1, 0)])


class FollowedReference:
    """Choice of the servo's reference, by whether the robot has sensed a contact.

    The robot senses a contact at once. It notices a miss only at ``missed.contact_end``: up to then, a late
    contact still makes it follow ``reference``.

    reference, missed : as :class:`impactopt.transcription.plan.Trajectory`.  missed None: the robot does not
        notice a miss, and always follows ``reference``.
    """

    def __init__(self, reference: Any, missed: Any = None) -> None:
        self._reference, self._missed = reference, missed
        self._parts = np.inf if missed is None else parts_from(reference, missed)
        self._aborts = False

    def at(self, t: float, felt: bool) -> Any:
        """Reference to follow at a time [s]; felt : whether there was a contact before."""
        if t < self._parts:
            return self._reference
        self._aborts = self._aborts or (not felt and t >= self._missed.contact_end)
        return self._reference if felt and not self._aborts else self._missed


class Touches:
    """Intervals of contact and its force, recorded step by step.

    A graze before or after the impact is an interval of its own, and so is each touch of an impact in which
    bodies separate and touch again.

    touched : whether there was contact in the last recorded step, or at the end of the one before it.
    """

    def __init__(self) -> None:
        self.intervals: list[list[float]] = []  # start [s], end [s], impulse [N s]
        self.touching = self.touched = False
        self._parts: list[tuple[Array, Array]] = []

    def add(self, t: float, push: Any) -> None:
        """Records a step that begins at a time [s].

        push : :class:`impactopt.simulation.target_dynamics.Push` of the step; None: no contact is near.
        """
        if push is None and not self.touching:  # most steps
            self.touched = False
            return
        none = np.zeros(1)
        times, force, given = (
            (t + none, none, none) if push is None else (t + push.times, push.total, push.given)
        )
        on = force > 0
        self.touched = self.touching or bool(on.any())
        if not self.touched:
            return
        self._parts.append((times, force))
        for k in np.flatnonzero(np.diff(on, prepend=self.touching)):
            if on[k]:
                self.intervals.append([float(times[k]), float(times[k]), -float(given[k])])
            else:
                self._until(times[k], given[k])
        if on[-1]:
            self._until(times[-1], given[-1])
        self.touching = bool(on[-1])

    def _until(self, time: float, given: float) -> None:
        self.intervals[-1][1] = float(time)
        self.intervals[-1][2] += float(given)

    def curve(self) -> tuple[Array, Array]:
        """Times (m,) [s] and contact force (m,) [N] of all steps with contact; zero before and after each."""
        time, force = (np.concatenate([np.zeros(0), *(part[i] for part in self._parts)]) for i in (0, 1))
        # a step's end and the next one's start differ by rounding
        return np.maximum.accumulate(time), force

    def impact(self) -> tuple[float, float]:
        """Start and end [s] of the impact with the largest impulse; nan if there was none."""
        impacts = list[list[float]]()
        for start, end, impulse in self.intervals:
            if impacts and start - impacts[-1][1] < MAX_GAP:
                impacts[-1][1:] = end, impacts[-1][2] + impulse
            else:
                impacts.append([start, end, impulse])
        start, end, _ = max(impacts, key=lambda impact: impact[2], default=[np.nan] * 3)
        return start, end


def sole_names(robot: Robot, scene: Scene) -> tuple[str, ...]:
    """The robot's names of the scene's soles, in the scene's order."""
    names = {sole.frame: sole.name for sole in robot.soles}
    return tuple(names.get(frame, frame) for frame in scene.soles)


def cop_margins(robot: Robot, scene: Scene, q: Array, sole_ground: Array) -> Array:
    """Distance (k, soles) [m] of each sole's centre of pressure from its own edges, as in `cop_margin`.

    q (k, nq); sole_ground (k, soles, 6) about the world's origin [N, N m].
    """
    model, data = robot.model, robot.model.createData()
    frames = [model.getFrameId(name) for name in scene.soles]
    wrenches = np.empty_like(sole_ground)
    for k, posture in enumerate(q if frames else ()):
        pin.forwardKinematics(model, data, posture)
        for i, frame in enumerate(frames):
            place = pin.updateFramePlacement(model, data, frame)
            # in the sole's own frame, in which the edges are known for a tilted sole too
            wrenches[k, i] = place.actInv(pin.Force(sole_ground[k, i])).vector
    return cop_margin(robot, scene.corners, wrenches)


def slip_and_lift(scene: Scene, corners: Array, stance: Index) -> tuple[Array, Array]:
    """Slip and lift (k, soles) [m] of the corner of each sole that moved most since the sole began to stand.

    corners (k, corners, 3) [m] : positions of all soles' corners, in the scene's order.
    stance (k,) : number of the stance phase; (0,): there is one.
    """
    slip, lift = np.zeros((2, len(corners), len(scene.corners)))
    for i, its in enumerate(_corners_of(scene)):
        for begin, end in _standing_intervals(scene, stance, i, len(corners)):
            moves = corners[begin:end, its] - corners[begin, its]
            slip[begin:end, i] = np.linalg.norm(moves[..., :2], axis=2).max(axis=1)
            lift[begin:end, i] = np.maximum(moves[..., 2], 0.0).max(axis=1)
    return slip, lift


def _corners_of(scene: Scene) -> list[slice]:
    """Slice of each sole's corners in an array of all."""
    return [slice(a, b) for a, b in itertools.pairwise(np.cumsum([0, *(len(c) for c in scene.corners)]))]


def _standing_intervals(scene: Scene, stance: Index, sole: int, count: int) -> list[tuple[int, int]]:
    """Index of the first instant, and that after the last, of each interval in which a sole stands.

    count : number of instants.
    """
    if not stance.size:
        return [(0, count)]
    # zeros at both ends, so that a stance that begins or ends the motion has edges too
    on = np.pad(scene.standing[stance, sole].astype(int), 1)
    return list(zip(np.flatnonzero(np.diff(on) > 0), np.flatnonzero(np.diff(on) < 0), strict=True))


def landing_speeds(scene: Scene, time: Array, corners: Array, sole_ground: Array, stance: Index) -> Array:
    """Largest speed (soles,) [m/s] of a sole's corners at touchdown; nan without one.

    Touchdown is when the sole first carries load, but not in the first half of its planned time in the air.
    """
    out = np.full(len(scene.corners), np.nan)
    for i, its in enumerate(_corners_of(scene)):
        intervals = _standing_intervals(scene, stance, i, len(time))
        for (_, lift_off), (planned, end) in itertools.pairwise(intervals):
            middle = int(np.searchsorted(time, (time[lift_off] + time[planned]) / 2))
            loaded = np.flatnonzero(sole_ground[middle:end, i, 2] > 0)
            if not loaded.size:
                continue
            k = middle + int(loaded[0])
            distance = np.linalg.norm(corners[k, its] - corners[k - 1, its], axis=1).max()
            out[i] = np.nanmax([out[i], distance / (time[k] - time[k - 1])])
    return out


def check_not_diverged(rates: Array, t: float, step: float) -> None:
    """Raises an InputError with the time [s] if the rates [rad/s, m/s] are not those of a robot."""
    if not np.abs(rates).max() <= 1e4:  # true for nan, too
        raise InputError(
            f"the simulation diverged at t = {t:.4f} s: take a smaller step than {step:g} s, or softer gains"
        )


def posture_error(model: Any, q: Array, planned: Array) -> float:
    """Largest error [rad] of a joint or of the base's orientation at q (nq,)."""
    # in the tangent space, whose components 3 to 5 are the base's rotation vector
    error = np.abs(pin.difference(model, planned, q))
    if model.joints[1].nv == 6:
        return float(max(np.linalg.norm(error[3:6]), error[6:].max(initial=0.0)))
    return float(error.max())


def simulation_of(
    robot: Robot, scene: Scene, recorded: list[tuple[Any, ...]], touches: Touches, **rest: Any
) -> Simulation:
    """Simulation from recorded instants.

    recorded : of each instant: time, q, v, force, target speed, hand speed, target's displacement along
        and across the normal, demand, torque, wrenches of soles and of supporting hands, positions of the
        soles' corners, torque through the gears since the instant before, number of the stance phase.
    rest : the other fields of the simulation.

    Raises
    ------
    InputError : there is no instant.
    """
    if not recorded:
        raise InputError("the step of the simulation is longer than its motion: give a shorter one (--step)")
    columns = [np.array(c) for c in zip(*recorded, strict=True)]  # one array for each quantity
    time, q, v, force, target_speed, hand_speed, travel, aside, *more = columns
    demand, torque, sole_ground, corners, gear, stance = more
    stance = stance if scene.standing.size else stance[:0]
    slip, lift = slip_and_lift(scene, corners, stance)
    landings = landing_speeds(scene, time, corners, sole_ground, stance) if stance.size else np.zeros(0)
    contact_start, contact_end = touches.impact()
    contact_time, contact_force = touches.curve()
    joints, soles = v[:, -robot.n :], len(scene.soles)
    sole_ground, grips = sole_ground[:, :soles], sole_ground[:, soles:]
    return Simulation(
        time=time,
        q=q,
        v=v,
        force=force,
        target_speed=target_speed,
        hand_speed=hand_speed,
        target_travel=travel,
        target_aside=aside if moves_target(scene.friction) else aside[:0],
        demand=demand,
        torque=torque,
        sole_ground=sole_ground,
        soles=sole_names(robot, scene),
        cop_margin=cop_margins(robot, scene, q, sole_ground),
        slip=slip,
        lift=lift,
        grip_force=np.linalg.norm(grips[:, :, :3], axis=2),
        gear=gear,
        loads=DriveLoads.of(
            robot,
            gear=gear,
            torque=torque,
            velocity=joints,
            jump=_jump(time, joints, contact_start, contact_end),
        ),
        contact_start=contact_start,
        contact_end=contact_end,
        touches=tuple((start, end, impulse) for start, end, impulse in touches.intervals),
        contact_time=contact_time,
        contact_force=contact_force,
        peak_force=float(contact_force.max(initial=0.0)),
        stance=stance,
        stands=scene.standing,
        polygons=scene.polygons,
        landing_speed=landings,
        **rest,
    )


def _jump(time: Array, rates: Array, start: float, end: float) -> Array:
    """Change (n,) of the joints' rates (k, n) from before the contact to after it; nan without contact."""
    if not (np.isfinite(start) and end <= time[-1]):  # no contact, or it has not ended
        return np.full(rates.shape[1], np.nan)
    before = max(int(np.searchsorted(time, start, side="right")) - 1, 0)
    return np.asarray(rates[int(np.searchsorted(time, end))] - rates[before])
