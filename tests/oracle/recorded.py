"""What else a result has in its file, against its variables: splines, reference, blow, summary, bodies."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from impactopt.bodies.clearance import MISSED, Places
from impactopt.kinematics.splines import Radau
from impactopt.kinematics.stance import margin, support_polygon, zmp
from impactopt.problem.objectives import Impulse
from impactopt.problem.terms import ContactWrenchCone
from impactopt.robots.loads import SHARE, cop_margin, margin_between_nodes
from oracle.motions import Way
from oracle.program import Program
from oracle.stances import fading_soles
from oracle.variables import Variables

Array = NDArray[np.float64]
Arrays = Mapping[str, NDArray[Any]]
FINER = 0.005  # of impulse and duration: by how much they may be others on elements half as long


class Off(NamedTuple):
    """By how much a part of a record is off, and where: rows beside the program's."""

    name: str
    amount: float
    where: str


def off_in_record(p: Program, v: Variables, arrays: Arrays, summary: Mapping[str, Any]) -> Iterator[Off]:
    """All of it; only of what a record has."""
    yield from _splines(p, v, arrays)
    for prefix, last in (("reference", 1), ("missed", 2)):
        if f"{prefix}_time" in arrays and last < len(p.ways):
            yield from _reference(p, v, arrays, prefix, last)
    if p.blows:
        yield from _blow(p, v, arrays)
        yield from _summary(p, v, summary)
    if p.problem.keeps_apart and "reference_time" in arrays:
        yield from _bodies(p, v, arrays)


def _gap(found: Any, wanted: Any, scale: float | Array = 1.0) -> float:
    """Largest difference over a scale; inf for other shapes and what is no number."""
    one, two = np.asarray(found, dtype=float), np.asarray(wanted, dtype=float)
    if one.shape != two.shape:
        return np.inf
    off = np.abs(one - two) / scale
    return float(np.max(np.where(np.isnan(off), np.inf, off), initial=0.0))


def _splines(p: Program, v: Variables, arrays: Arrays) -> Iterator[Off]:
    for way in p.ways[:2]:
        control = np.array([way.control(v, j) for j in range(len(way.breaks) + 2)])
        for key, value in (
            ("control", control),
            ("breaks", way.breaks),
            ("duration", v.one(way.T)),
        ):
            if f"{way.kind}_{key}" in arrays:
                yield Off("spline", _gap(arrays[f"{way.kind}_{key}"], value), f"{way.kind}_{key}")
        if f"plan_{way.kind}_wrench" in arrays and p.robot.soles:
            found = arrays[f"plan_{way.kind}_wrench"][int(way.nodes[0] > 0) :]
            wanted = [way.wrench(v, k) for k in range(len(way.nodes))]
            yield Off("spline", _gap(found, wanted, p.robot.wrench_scale), f"plan_{way.kind}_wrench")


class _Worst:
    """Keeps where something is worst."""

    def __init__(self) -> None:
        self.found: dict[str, tuple[float, str]] = {}

    def note(self, name: str, amount: float, where: str) -> None:
        if name not in self.found or not amount <= self.found[name][0]:
            self.found[name] = amount, where

    def all(self) -> Iterator[Off]:
        yield from (Off(name, amount, where) for name, (amount, where) in self.found.items())


def _start(p: Program, v: Variables) -> float:
    """Contact [s] since the motion's start."""
    return sum(v.one(way.T) for way in p.courses[0].values())


def _reference(p: Program, v: Variables, arrays: Arrays, prefix: str, course: int) -> Iterator[Off]:
    """The servo's reference: the splines', on fixed soles, with the torque that it needs, within limits.

    course : number of that from contact to rest.
    """
    last = p.ways[course]
    a = {name: arrays[f"{prefix}_{name}"] for name in ("time", "phase", "q", "v", "a", "torque", "ground")}
    robot, worst = p.robot, _Worst()
    r, n = robot.robot, robot.n
    start, end = (float(arrays[f"{prefix}_contact_{side}"]) for side in ("start", "end"))
    worst.note(f"{prefix} times", _gap(start, _start(p, v)), "contact")
    lasts = blow = sum(v.one(name) for name in p.blows[0].durations) if p.blows else end - start
    if not p.problem.lasts:
        lasts = blow = 0.0
    if last.kind == "abort":
        lasts = float(p.problem.abort_after or 0.0)
    worst.note(f"{prefix} times", _gap(end - start, lasts), "end of contact")
    # phases before contact and after it, with when each begins, its spline and its support polygon
    parts = dict[tuple[int, int], tuple[Way, float, Any, Array]]()
    begin = 0.0
    for phase, ways in ((0, p.courses[0]), (2, p.courses[course])):
        for k, way in ways.items():
            held = p.problem.stance_coordinates[k]
            polygon = support_polygon(r, held) if way.robot.soles else np.zeros((0, 2))
            parts[phase, k] = way, begin, way.curve(v), polygon
            begin += v.one(way.T)
        begin = begin if phase else end
    numbers = arrays[f"{prefix}_stance"] if p.stands else np.zeros(len(a["time"]), dtype=int)
    worst.note(f"{prefix} times", _gap(float(arrays[f"{prefix}_end"]), begin), "end")
    angles = np.array([r.joint_positions(q) for q in a["q"]])
    if "reference_angle" in arrays and prefix == "reference":
        worst.note(f"{prefix} angles", _gap(arrays["reference_angle"], angles), "reference_angle")
    y0, u0, ff = p.at_contact(v), p.state_at_contact(v)[1], v.get("feed-forward at contact")
    left = v.get(f"{last.kind} momentum") if robot.drifts else np.zeros(0)
    drifted: tuple[Any, ...] = ()
    for k, time in enumerate(map(float, a["time"])):
        where = f"{prefix} at {time:.4g} s"
        phase = int(a["phase"][k])
        way, begin, curve, polygon = parts[2 if phase == 2 else 0, int(numbers[k])]
        robot = way.robot
        if phase == 1:
            y, u, slope = y0 + u0 * (time - start), u0, 0 * u0
        else:
            T = v.one(way.T)
            s = min(max((time - begin) / T, 0.0), 1.0)
            y, u, slope = (c(s) / T**order for order, c in enumerate(curve))
        found, legs = robot.split(a["q"][k])
        if robot.drifts:
            y, u, slope = _with_base(p, (y, u, slope), found, a["v"][k], a["a"][k])
        q, qd, qdd = robot.motion(y, legs, u, slope)
        if robot.drifts:
            first = phase == 0 or (phase == 1 and time == start)
            lasted, before = (time, 0.0) if first else (time - end, left)
            if phase != 1 or time == start:
                momentum = robot.weighed_momentum(q, qd) - before - lasted * robot.pull
                worst.note(f"{prefix} momentum", _gap(momentum, 0 * momentum), where)
            if time == start:
                worst.note(f"{prefix} posture", _gap(y, y0), where)
            if drifted and drifted[0] == phase:
                h, ends = time - drifted[1], drifted[2:]
                # the trapezoidal rule with its end correction, of fourth order
                moved = h * (ends[1] + u[:6]) / 2 + h**2 * (ends[2] - slope[:6]) / 12
                worst.note(f"{prefix} posture", _gap(y[:6] - ends[0], moved), where)
            drifted = phase, time, y[:6], u[:6], slope[:6]
        worst.note(f"{prefix} posture", _gap(found, y), where)
        tau = robot.torque(q, qd, qdd, np.zeros(6 * len(robot.soles)))
        worst.note(f"{prefix} rates", _gap(a["v"][k], qd), where)
        worst.note(f"{prefix} accelerations", _gap(a["a"][k], qdd, max(1.0, np.abs(qdd).max())), where)
        demand = a["torque"][k] / r.torque_limit
        if phase == 1 and time <= start + blow + 1e-9:  # its last instant is rounded otherwise
            worst.note(f"{prefix} torque", _gap(demand, ff), where)
        else:
            for what, off in _balanced(p, way, q, tau, a["torque"][k], a["ground"][k]):
                worst.note(f"{prefix} {what}", off, where)
        worst.note(f"{prefix} closed legs", _gap(robot.closure(q), 0 * robot.closure(q)), where)
        worst.note(f"{prefix} torque limit", float(np.abs(demand).max() - 1), where)
        fast = np.abs(a["v"][k][-n:]) / r.velocity_limit
        worst.note(f"{prefix} velocity limit", float(fast.max() - 1), where)
        # in contact the reference coasts, and hinges follow none: rows bound how far they turn there
        outside = np.maximum(r.lower - angles[k], angles[k] - r.upper)[~(r.hinges & (phase == 1))]
        worst.note(f"{prefix} position limit", float(outside.max()), where)
        # in contact the hand bears force too: what the coasting reference stands on is nobody's
        if len(polygon) and (phase != 1 or prefix == "missed"):
            inside = float(margin(polygon, zmp(a["ground"][k : k + 1]))[0])
            worst.note(f"{prefix} ZMP", -inside, where)
    yield from worst.all()


def _with_base(
    p: Program, planned: tuple[Array, Array, Array], found: Array, v: Array, a: Array
) -> tuple[Array, Array, Array]:
    """Planned y, rates and second rates with a record's base, which nothing holds: the joints move it."""
    y, u, slope = (part.copy() for part in planned)
    y[:6] = found[:6]
    rates = p.robot.base_rates(y)
    u[:6] = np.linalg.solve(rates, v[:6])
    drift = p.robot.motion(y, np.zeros(0), u, np.append(np.zeros(6), slope[6:]))[2][:6]
    slope[:6] = np.linalg.solve(rates, a[:6] - drift)
    return y, u, slope


def _balanced(
    p: Program, way: Way, q: Array, tau: Array, torque: Array, ground: Array
) -> Iterator[tuple[str, float]]:
    """Whether torques and the ground's wrench are what a motion needs, that needs tau (nv,) without soles.

    Each sole's wrench follows from its leg's torques; together they have to be the ground's, and each has to
    keep half of the margins that the problem asks for.
    """
    robot, limit = way.robot, p.problem.robot.torque_limit
    free, rest = np.setdiff1d(np.arange(robot.n), robot.dependent), tau.copy()
    wrenches = np.zeros(0)
    if robot.soles:
        wrenches = robot.wrenches(q, tau - np.concatenate([np.zeros(robot.base), torque]))
        robot.relieve(rest, q, wrenches)  # a hand that holds on is borne by the waist, too
    yield "torque", _gap(torque[free] / limit[free], rest[robot.base + free] / limit[free])
    if robot.drifts:
        yield "equation of motion of the base", _gap(rest[:6] / robot.base_scale, np.zeros(6))
    if not robot.soles:
        return
    world = robot.ground(wrenches)
    six = robot.wrench_scale[:6]
    yield "ground wrench", _gap(world, ground, six)
    yield "equation of motion of the base", _gap(rest[: robot.base] / six, np.zeros(robot.base))
    if robot.standing:
        corners = [leg.sole.polygon for leg, *_ in robot.soles if leg.sole is not None]
        own, cone = wrenches.reshape(-1, 6)[: robot.standing], p.problem.term(ContactWrenchCone)
        kept = float(cop_margin(robot.robot, corners, own[None]).min())
        yield "margin of a sole's centre of pressure", margin_between_nodes(cone.margin) - kept
        fades = fading_soles(p.problem, way.number)
        bears = [k for k in range(robot.standing) if robot.soles[k][0].name not in fades]
        if bears:
            least = float(own[bears, 2].min())
            yield "normal force of a sole", (SHARE * cone.minimum_force - least) / robot.weight


def _blow(p: Program, v: Variables, arrays: Arrays) -> Iterator[Off]:
    """What a record says of the blow on the expected target; it may be computed again, on a finer mesh."""
    blow = p.blows[0]
    if "collision_time" not in arrays:
        return
    time, force = arrays["collision_time"], arrays["collision_force"]
    impulse = float(blow.get(v, "impulse so far", blow.end[-1])[0])
    durations = [v.one(name) for name in blow.durations]
    own = [sum(durations[: s.phase]) + s.place * durations[s.phase] for s in blow.stages]
    if len(time) == len(own) + 1:
        forces = np.array([blow.get(v, "contact force", i).sum() for i in range(len(own))])
        yield Off("blow", _gap(time[1:], own), "collision_time")
        yield Off("blow", _gap(force[1:], forces, 100.0), "collision_force")
    else:
        off_times, given = _quadrature(time, force, p.problem.collision_stages)
        yield Off("blow", off_times, "collision_time")
        for what, found, planned in (("end", time[-1], own[-1]), ("impulse", given, impulse)):
            off = max(_gap(found, planned, abs(planned)) - FINER, 0.0)
            yield Off("blow", off, f"{what} of the finer contact")
    limits = p.problem.robot.torque_limit
    start = v.get("feed-forward at contact")
    yield Off("blow", _gap(arrays["collision_torque"][0] / limits, start), "collision_torque at contact")


def _quadrature(time: Array, force: Array, stages: int) -> tuple[float, float]:
    """By how much instants [s] after the first are no Radau points of elements; the impulse [N s] of forces
    [N] there, as exact as the collocation is.
    """
    radau = Radau.of_stages(stages)
    if (len(time) - 1) % stages:
        return np.inf, np.nan
    ends = time[::stages]
    lengths = np.diff(ends)
    points = ends[:-1, None] + lengths[:, None] * radau.c
    forces = np.reshape(force[1:], (-1, stages))
    return _gap(np.reshape(time[1:], (-1, stages)), points), float(lengths @ (forces @ radau.a[-1]))


def _summary(p: Program, v: Variables, summary: Mapping[str, Any]) -> Iterator[Off]:
    blow = p.blows[0]
    contact = sum(v.one(name) for name in blow.durations)
    swings_on = v.one(blow.durations[-1]) if blow.spells[-1].apart else 0.0
    y, u = p.state_at_contact(v)
    moving = sum(v.one(way.T) for course in p.courses[:2] for way in course.values())
    wanted = {
        "impulse_Ns": float(blow.get(v, "impulse so far", blow.end[-1])[0]),
        "contact_ms": 1e3 * (contact - swings_on),
        "hand_speed_m_s": float(p.robot.normal @ p.robot.striking(y, u)[1]),
        "duration_s": contact + moving,
    }
    for key, value in wanted.items():
        if key in summary:
            yield Off("summary", _gap(_number(summary[key]), value, max(abs(value), 1e-3)), key)
    state, target = blow.get(v, "target state", blow.end[-1]), p.problem.target
    for key, value in target.outcome(state, blow.target).items():
        told = summary.get("target") or {}
        if key in told:
            yield Off("summary", _gap(_number(told[key]), value, max(abs(value), 1e-3)), f"target.{key}")
    told = summary.get("objectives") or {}
    if Impulse.name in told:
        value = wanted["impulse_Ns"]
        yield Off("summary", _gap(_number(told[Impulse.name]), value, abs(value)), "objectives.impulse")
    for scenario, other in zip(summary.get("scenarios") or (), p.blows[1:], strict=False):
        value = float(other.get(v, "impulse so far", other.end[-1])[0])
        off = _gap(_number(scenario.get("impulse_Ns")), value, abs(value))
        yield Off("summary", off, f"impulse_Ns, if {scenario.get('name')}")


def _number(value: Any) -> float:
    return float("nan") if value is None else float(value)


def _bodies(p: Program, v: Variables, arrays: Arrays) -> Iterator[Off]:
    """Exact distances between all bodies that are not to touch, at all instants that a record has."""
    phase, q = np.asarray(arrays["reference_phase"]), np.asarray(arrays["reference_q"])
    time = np.asarray(arrays["reference_time"])
    # without a known contact, nothing is known of the target's motion after it
    known = (0, 2) if p.blows else (0,)
    parts = [(time[k], q[k], np.full(int(k.sum()), n), n) for n in known if (k := phase == n).any()]
    bodies = p.problem.bodies
    gone, speed, across, drift = 0.0, 0.0, np.zeros(3), np.zeros(3)
    if p.blows:
        blow, y0 = p.blows[0], p.at_contact(v)
        stages = [blow.moved(v, i, y0) for i in range(len(blow.stages))]
        legs = [blow.get(v, "collision legs", i) for i in range(len(stages))]
        postures = np.array([p.robot.posture(s[0], leg) for s, leg in zip(stages, legs, strict=True)])
        times = np.array([s[1] for s in stages]) + _start(p, v)
        asides = np.zeros((len(stages), 3))
        if p.problem.friction is not None and p.problem.friction.moves_target:
            rates = np.array([blow.get(v, "target tangential velocity", i) for i in range(len(stages))])
            before, steps = np.vstack([np.zeros(3), rates[:-1]]), np.diff([0.0, *(s[1] for s in stages)])
            asides, drift = np.cumsum(steps[:, None] * (before + rates) / 2, axis=0), rates[-1]
        gone, across = stages[-1][3], asides[-1]
        travels, phases = np.array([s[3] for s in stages]), np.ones(len(stages), dtype=np.intp)
        shifts = np.outer(travels, p.problem.normal) + asides
        survey = bodies.survey(times, Places.of(p.problem.robot, postures, phases, shifts))
        yield Off("distance of bodies", max(-survey.clearance, 0.0), " and ".join(survey.nearest))
        state = blow.get(v, "target state", blow.end[-1])
        speed = float(p.problem.target.velocity(state, blow.target))
        if p.problem.target.stays:
            speed = 0.0
    if "missed_q" in arrays:
        after = np.asarray(arrays["missed_phase"]) == 2
        postures = np.asarray(arrays["missed_q"])[after]
        parts.append(
            (np.asarray(arrays["missed_time"])[after], postures, np.full(len(postures), MISSED), MISSED)
        )
    for times, postures, phases, n in parts:
        shifts = np.zeros((len(times), 3))
        if n == 0:  # it comes at a constant speed
            before = float(p.problem.target.speed_before()) * (times - _start(p, v))
            shifts = np.outer(before, p.problem.normal)
        if n == 2:
            since = times - float(arrays["reference_contact_end"])
            shifts = np.outer(gone + speed * since, p.problem.normal) + across + np.outer(since, drift)
        at = Places.of(p.problem.robot, postures, phases, shifts)
        survey = bodies.survey(times, at)
        where = f"{' and '.join(survey.nearest)} at {survey.time:.4g} s"
        yield Off("distance of bodies", max(-survey.clearance, 0.0), where)
