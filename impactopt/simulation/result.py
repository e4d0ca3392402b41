"""Result of a replay, and how an engine records it: contact times, histories, sole wrenches."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.contact.friction import ContactFriction
from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import Target
from impactopt.errors import InputError
from impactopt.robots.loads import DriveLoads, cop_margin, least_margins
from impactopt.robots.robot import Robot
from impactopt.simulation.collision_geometry import Solids, UnintendedContact
from impactopt.simulation.motors import MotorCut

Array = NDArray[np.float64]
ONE_BLOW = 5e-3  # [s] apart: touches of one blow
PHASES = ("swing", "collision", "follow")
PHASES_OF_MISS = ("swing", "missed")  # up to the planned contact, and from there on
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
    """(k,) [m] that something with these speeds [m/s] has gone since contact began; nan: since the start."""
    gone = np.concatenate([[0.0], np.cumsum(np.diff(time) * (speed[1:] + speed[:-1]) / 2)])
    return gone - np.interp(contact_start, time, gone) if np.isfinite(contact_start) else gone


@dataclass(frozen=True, kw_only=True)
class Scene:
    """The target, its contact and the ground.

    point (3,) [m], normal (3,): where the target's surface is to be hit, and the way it is pushed; law,
    target: the contact's force and the target's motion; striker: frame of the model that hits; soles: frames
    of the model that the plan holds to the ground; corners: (k, 2) [m] of each, in the plane of its frame,
    counter-clockwise; polygon (k, 2) [m]: support polygon on the ground, counter-clockwise. solids: what
    else can touch. hands: frames of the model that hold on to where the reference has them at first.
    friction: of the striking points on the target.
    second: of another striker that hits the same target, its frame of the model and its point (3,) [m].
    standing (stances, soles): which soles stand in each stance phase, and polygons of each; (0, 0), (): there
    is one stance, on all of them.
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
    standing: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((0, 0), dtype=bool))
    polygons: tuple[Array, ...] = ()

    @property
    def strikers(self) -> tuple[str, ...]:
        """Frames of the model that hit."""
        return (self.striker,) if self.second is None else (self.striker, self.second[0])


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """Histories over ``time`` (k,) [s] of a re-simulated motion, and when contact began and ended.

    q (k, nq) and v (k, nv), pin's; force (k,) [N]; target_speed, hand_speed (k,) [m/s]; demand (k, n) [N m]
    servo torque before saturation; torque (k, n) after it; sole_ground (k, soles, 6) wrench of the ground on
    each sole of the scene about the world's origin [N, N m], pulling where the engine holds the soles; soles:
    their names; cop_margin (k, soles) [m]: from each sole's centre of pressure to its own nearest edge, as
    of :func:`impactopt.robots.loads.cop_margin`; slip, lift (k, soles) [m]: how far the corner of a
    sole that moved most went along the ground, and rose.
    contact_start, contact_end [s]: of the blow, whose touches are less than 5 ms apart; nan if the target
    was not hit.  impulse [N s]: the contact force's
    integral over the whole motion.  peak_force [N]: its largest value, which may lie within a step.
    outcome: the target's result after the last touch, by name and unit (``speed_m_s``, ``depth_m``,
    ``broken``).  saturated [s]: how long the demand of some joint was above its torque limit.  fall: why the
    robot does not stand at the end, "" if it stands; None where the engine holds the soles and cannot say.
    posture_error [rad]: of the joint, or of the base's orientation, that ends farthest from the reference's
    last posture.  beyond_range: joint or tendon that was farthest out of its range, and by how much [rad];
    "" if none was.  touched: pairs of bodies that touched and should not have, if the engine has solids that
    push back.  clearance [m], nearest: the least distance of any two bodies that are not to touch, by exact
    geometry, and which two.  missed: there was no target.  expected [s]: when the reference has contact
    begin.  touches: start and end [s] and impulse [N s] of
    each.  step_error: estimated error of the impulse by the engine's steps, relative; nan if it was not
    computed, or nothing was hit.
    gear (k, n) [N m]: torque through the gears, that of largest magnitude in all steps since the instant
    before.  loads: what gears and motors carry at most.  cuts: joints whose demand the line of their motor
    has cut, the longest first; None where no motor's line is known.
    grip_force (k, hands) [N]: on each hand that holds on.  impulses (strikers,) [N s]: of each.
    stance (k,): number of the stance phase that the reference is in, stands (stances, soles) and polygons:
    the scene's; (0,): there is one. slip and lift are those since a sole has come to stand; landing_speed
    (soles,) [m/s]: of the corner that is fastest as a sole touches down, nan of one that does not.
    """

    engine: str
    time: Array = field(repr=False)
    q: Array = field(repr=False)
    v: Array = field(repr=False)
    force: Array = field(repr=False)
    target_speed: Array = field(repr=False)
    hand_speed: Array = field(repr=False)
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
    touches: tuple[tuple[float, float, float], ...] = ()
    step_error: float = np.nan
    gear: Array = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    loads: DriveLoads | None = field(default=None, repr=False)
    cuts: tuple[MotorCut, ...] | None = None
    grip_force: Array = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    impulses: Array = field(default_factory=lambda: np.zeros(0), repr=False)
    stance: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp), repr=False)
    stands: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((0, 0), dtype=bool), repr=False)
    polygons: tuple[Array, ...] = field(default=(), repr=False)
    landing_speed: Array = field(default_factory=lambda: np.zeros(0), repr=False)

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

    def travel(self) -> Array:
        """(k,) [m] of the target along its normal, from where contact began."""
        return travelled(self.time, self.target_speed, self.contact_start)

    def phase(self) -> NDArray[np.intp]:
        """0 swing, 1 collision, 2 follow-through, by the contact that happened."""
        start = self.contact_start if np.isfinite(self.contact_start) else np.inf
        end = self.contact_end if np.isfinite(self.contact_end) else np.inf
        return np.asarray((self.time >= start).astype(int) + (self.time >= end).astype(int))

    def summary(self, *, torque_limit: Array, polygon: Array, planned_impulse: float) -> dict[str, Any]:
        """Impulse, force, margins and demand by phase, soles, standing; keys as in ``summary.json``.

        Without contact there is no speed at contact and no error of its impulse: None.
        """
        hit = bool(np.isfinite(self.contact_start))
        if not hit and self.fall is None and not self.missed:
            raise InputError("the simulated motion never touched the target")
        known = bool(np.isfinite(self.clearance))
        phase = self.phase() if hit else (self.time >= self.expected).astype(int)
        names = PHASES if hit else PHASES_OF_MISS
        out: dict[str, Any] = {
            "engine": self.engine,
            "standing": self.standing,
            "reason": "the soles are held: only an engine with free soles can tell"
            if self.fall is None
            else self.fall,
            "impulse_Ns": self.impulse,
            "impulse_error_pct": 100 * (self.impulse / planned_impulse - 1) if hit else None,
            "target": self.outcome if hit else {},
            "step_error_pct": None if np.isnan(self.step_error) else 100 * self.step_error,
            "peak_force_N": self.peak_force,
            "contact_ms": 1e3 * (self.contact_end - self.contact_start) if hit else 0.0,
            # a target that comes early may touch at once
            "hand_speed_m_s": float(self.hand_speed[max(int((phase == 0).sum()) - 1, 0)]) if hit else None,
            "saturated_ms": 1e3 * self.saturated,
            "final_posture_error_rad": self.posture_error,
            # None: no joint is out of its range
            "beyond_range_rad": self.beyond_range[1] or None,
            "beyond_range": self.beyond_range[0] or None,
            "clearance_mm": 1e3 * self.clearance if known else None,
            "nearest": " and ".join(self.nearest),
            "contacts_besides": [touched.summary() for touched in self.touched] if known else None,
            **({} if self.loads is None else self.loads.summary()),
            **self._cut_numbers(),
        }
        if len(self.impulses) > 1:
            out["impulses_Ns"] = self.impulses.tolist()
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
            if self.grip_force.size:
                out["grip_force_N"] = float(self.grip_force.max())
            out["sole_slip_mm"] = 1e3 * float(self.slip.max())
            out["sole_lift_mm"] = 1e3 * float(self.lift.max())
            collision = self.lift[phase == 1]
            out["sole_lift_collision_mm"] = 1e3 * float(collision.max()) if collision.size else 0.0
        return out

    def _inside(self, polygon: Array) -> Array:
        """Distance (k,) [m] of the ZMP from the edges of what stands, or presses on the ground all the same;
        polygon : of one stance.
        """
        zmp = self.zmp()
        if not self.stance.size:
            return distance_inside(polygon, zmp)
        found = np.array([distance_inside(own, zmp) for own in self.polygons])
        on = self.stands[self.stance] | (self.sole_normal > 0)
        # the smallest stance that has all of these soles; of several, which a step parts, the nearest in time
        lacks = (on[:, None] & ~self.stands).any(axis=2)
        size = np.where(lacks, self.stands.shape[1] + 1.0, self.stands.sum(axis=1))
        number = np.arange(len(found))
        begins = self.time[np.searchsorted(self.stance, number).clip(max=len(self.time) - 1)]
        at = np.interp(self.time, [*begins, self.time[-1]], [*number, len(number)]) - 0.5
        size += np.abs(at[:, None] - number) / (len(number) + 1)
        return np.asarray(found[size.argmin(axis=1), np.arange(len(zmp))])

    def _cut_numbers(self) -> dict[str, Any]:
        """Summary of the joint that was cut longest; None if no motor's line is known, 0 if none was cut."""
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
        """The summary with one number for the whole motion where that one has one for each phase.

        Keys as `impactopt validate --json` prints them: ``zmp_margin_m`` is the least, ``torque_ratio`` the
        largest; ``zmp_margin_by_phase_m`` and ``torque_ratio_by_phase`` are the summary's.
        """
        given = self.summary(torque_limit=torque_limit, polygon=polygon, planned_impulse=planned_impulse)
        margins, ratios = given.get("zmp_margin_m", {}), given["torque_ratio"]
        given["zmp_margin_m"] = min(margins.values(), default=None)
        given["torque_ratio"] = max(ratios.values())
        given |= {"zmp_margin_by_phase_m": margins, "torque_ratio_by_phase": ratios}
        return {name: given.get(name) for name in REPORT}


def centre_of_pressure(wrench: Array) -> Array:
    """(..., 2) [m] on the ground of (..., 6) wrenches about the world's origin; nan where f_z <= 0."""
    normal = np.where(wrench[..., 2] > 1e-6, wrench[..., 2], np.nan)
    return np.stack([-wrench[..., 4], wrench[..., 3]], axis=-1) / normal[..., None]


def distance_inside(polygon: Array, points: Array) -> Array:
    """Distance (k,) [m] of points (k, 2) from a counter-clockwise polygon's nearest edge, < 0 outside."""
    edge = np.roll(polygon, -1, axis=0) - polygon
    inward = np.stack([-edge[:, 1], edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
    return np.asarray((points @ inward.T - (inward * polygon).sum(axis=1)).min(axis=1))


def parts_from(reference: Any, missed: Any) -> float:
    """Time [s] from which a robot that has felt no contact follows ``missed``, and not ``reference``.

    Both coast from the planned contact on. The one goes on to the follow-through at its ``contact_end``; the
    other goes on coasting, until the robot notices at its own ``contact_end``, and is the abort motion then.
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
    """Choice of the servo's reference, by whether the robot has felt a contact.

    A robot knows that it has hit something when it feels it, but that it has hit nothing only at
    ``missed.contact_end``: until then it goes over to ``reference`` when it is late.

    reference, missed : as of :class:`impactopt.transcription.plan.Trajectory`.  missed None: it does not
        notice, and ``reference`` is all that it has.
    """

    def __init__(self, reference: Any, missed: Any = None) -> None:
        self._reference, self._missed = reference, missed
        self._parts = np.inf if missed is None else parts_from(reference, missed)
        self._aborts = False

    def at(self, t: float, felt: bool) -> Any:
        """The reference from a time [s] on; felt : whether there has been a contact yet."""
        if t < self._parts:
            return self._reference
        self._aborts = self._aborts or (not felt and t >= self._missed.contact_end)
        return self._reference if felt and not self._aborts else self._missed


class Touches:
    """Intervals of contact, told step by step.

    A graze before or after the blow is one of its own, and so is each touch of a blow in which bodies part
    and meet again.

    touched : whether there was contact in the step that was told last, or in the one before it.
    """

    def __init__(self) -> None:
        self.intervals: list[list[float]] = []  # start [s], end [s], impulse [N s]
        self.touching = self.touched = False

    def add(self, t: float, force: float, step: float, since: float = 0.0) -> None:
        """The contact's mean force [N] in the step that begins at time t [s]; since [s]: when in it there was
        one first."""
        if force > 0:
            if not self.touching:
                self.intervals.append([t + since, t + since, 0.0])
            self.intervals[-1][2] += force * step
        self.touched = self.touching or force > 0
        if self.touched:
            self.intervals[-1][1] = max(t, self.intervals[-1][0])
        self.touching = force > 0

    def blow(self) -> tuple[float, float]:
        """Start and end [s] of the blow with the largest impulse; nan if there was none."""
        blows = list[list[float]]()
        for start, end, impulse in self.intervals:
            if blows and start - blows[-1][1] < ONE_BLOW:
                blows[-1][1:] = end, blows[-1][2] + impulse
            else:
                blows.append([start, end, impulse])
        start, end, _ = max(blows, key=lambda blow: blow[2], default=[np.nan] * 3)
        return start, end


def sole_names(robot: Robot, scene: Scene) -> tuple[str, ...]:
    """The robot's names of the scene's soles, in the scene's order."""
    names = {sole.frame: sole.name for sole in robot.soles}
    return tuple(names.get(frame, frame) for frame in scene.soles)


def cop_margins(robot: Robot, scene: Scene, q: Array, sole_ground: Array) -> Array:
    """Distance (k, soles) [m] of each sole's centre of pressure from its own edges, as of `cop_margin`.

    q (k, nq); sole_ground (k, soles, 6) about the world's origin [N, N m].
    """
    model, data = robot.model, robot.model.createData()
    frames = [model.getFrameId(name) for name in scene.soles]
    wrenches = np.empty_like(sole_ground)
    for k, posture in enumerate(q if frames else ()):
        pin.forwardKinematics(model, data, posture)
        for i, frame in enumerate(frames):
            place = pin.updateFramePlacement(model, data, frame)
            # in the sole's own frame, so that a tilted sole's edges are its edges
            wrenches[k, i] = place.actInv(pin.Force(sole_ground[k, i])).vector
    return cop_margin(robot, scene.corners, wrenches)


def slip_and_lift(scene: Scene, corners: Array, stance: NDArray[np.intp]) -> tuple[Array, Array]:
    """(k, soles) [m] of each sole, of the corner that moved most since the first instant, from the places
    (k, corners, 3) of all soles' corners, in the scene's order; since it stands, by the stance phases (k,).
    """
    slip, lift = np.zeros((2, len(corners), len(scene.corners)))
    for i, its in enumerate(_corners_of(scene)):
        for begin, end in _spells(scene, stance, i, len(corners)):
            moves = corners[begin:end, its] - corners[begin, its]
            slip[begin:end, i] = np.linalg.norm(moves[..., :2], axis=2).max(axis=1)
            lift[begin:end, i] = np.maximum(moves[..., 2], 0.0).max(axis=1)
    return slip, lift


def _corners_of(scene: Scene) -> list[slice]:
    """Slices of each sole's corners among all."""
    return [slice(a, b) for a, b in itertools.pairwise(np.cumsum([0, *(len(c) for c in scene.corners)]))]


def _spells(scene: Scene, stance: NDArray[np.intp], sole: int, count: int) -> list[tuple[int, int]]:
    """First instant and the one after the last, of each time that a sole stands, of so many instants."""
    if not stance.size:
        return [(0, count)]
    on = np.pad(scene.standing[stance, sole].astype(int), 1)
    return list(zip(np.flatnonzero(np.diff(on) > 0), np.flatnonzero(np.diff(on) < 0), strict=True))


def landing_speeds(
    scene: Scene, time: Array, corners: Array, sole_ground: Array, stance: NDArray[np.intp]
) -> Array:
    """(soles,) [m/s] Largest speed of a sole's corners as it touches the ground again; nan: it does not.

    That is when the ground first presses on it, in the later half of its time in the air or after that.
    """
    out = np.full(len(scene.corners), np.nan)
    for i, its in enumerate(_corners_of(scene)):
        spells = _spells(scene, stance, i, len(time))
        for (_, left), (back, end) in itertools.pairwise(spells):
            since = int(np.searchsorted(time, (time[left] + time[back]) / 2))
            pressed = np.flatnonzero(sole_ground[since:end, i, 2] > 0)
            if not pressed.size:
                continue
            k = since + int(pressed[0])
            gone = np.linalg.norm(corners[k, its] - corners[k - 1, its], axis=1).max()
            out[i] = np.nanmax([out[i], gone / (time[k] - time[k - 1])])
    return out


def check_not_diverged(rates: Array, t: float, step: float) -> None:
    """InputError with the time [s] if the rates [rad/s, m/s] are of no robot."""
    if not np.abs(rates).max() <= 1e4:  # nan is not, either
        raise InputError(
            f"the simulation diverged at t = {t:.4f} s: take a smaller step than {step:g} s, or softer gains"
        )


def posture_error(model: Any, q: Array, planned: Array) -> float:
    """[rad] of the joint, or of the base's orientation, that is farthest from where it should be."""
    error = np.abs(pin.difference(model, planned, q))
    if model.joints[1].nv == 6:
        return float(max(np.linalg.norm(error[3:6]), error[6:].max(initial=0.0)))
    return float(error.max())


def simulation_of(
    robot: Robot, scene: Scene, rows: list[tuple[Any, ...]], touches: Touches, **rest: Any
) -> Simulation:
    """Histories of recorded instants: rows of time, q, v, force, target speed, hand speed, demand, torque,
    wrench of each sole and each hand that holds on, places of the soles' corners, torque through the gears
    since the row before, number of the stance phase; ``rest``: the other fields.
    """
    if not rows:
        raise InputError("the step of the simulation is longer than its motion: give a shorter one (--step)")
    columns = [np.array(c) for c in zip(*rows, strict=True)]
    time, q, v, force, target_speed, hand_speed, demand, torque, sole_ground, corners, gear, stance = columns
    stance = stance if scene.standing.size else stance[:0]
    slip, lift = slip_and_lift(scene, corners, stance)
    landings = landing_speeds(scene, time, corners, sole_ground, stance) if stance.size else np.zeros(0)
    contact_start, contact_end = touches.blow()
    joints, soles = v[:, -robot.n :], len(scene.soles)
    sole_ground, grips = sole_ground[:, :soles], sole_ground[:, soles:]
    return Simulation(
        time=time,
        q=q,
        v=v,
        force=force,
        target_speed=target_speed,
        hand_speed=hand_speed,
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
        stance=stance,
        stands=scene.standing,
        polygons=scene.polygons,
        landing_speed=landings,
        **rest,
    )


def _jump(time: Array, rates: Array, start: float, end: float) -> Array:
    """(n,) Change of the joints' rates (k, n) from before the contact to after it; nan: there was none."""
    if not (np.isfinite(start) and end <= time[-1]):
        return np.full(rates.shape[1], np.nan)
    before = max(int(np.searchsorted(time, start, side="right")) - 1, 0)
    return np.asarray(rates[int(np.searchsorted(time, end))] - rates[before])
