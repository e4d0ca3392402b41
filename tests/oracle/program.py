"""The program of a whole motion, written down a second time: variables with bounds, rows, objective."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.bodies.robot_bodies import striker_face
from impactopt.kinematics.stance import inward_edges, support_polygon
from impactopt.problem.objectives import (
    AngularMomentum,
    Effort,
    Impulse,
    PeakForce,
    Penetration,
    TargetEnergy,
)
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import (
    DEFAULT_TERMS,
    Balance,
    FirstTouch,
    Gaze,
    GearLoad,
    Grip,
    GroundForce,
    HandOrientation,
    Incidence,
    ReferenceRange,
    Slide,
    TargetSpeed,
)
from oracle.apart import apart_pieces
from oracle.blow import Blow, spells_of
from oracle.drives import COASTED, Drives, node_torque
from oracle.motions import NONE, Limits, Way, momentum_pieces, node_piece, rate_pieces
from oracle.robot_motion import RobotMotion
from oracle.stances import change_pieces, course, fading_soles, height_pieces
from oracle.variables import Piece, Variables
from oracle.worth import (
    GONE,
    gaze_pieces,
    orientation_pieces,
    price_pieces,
    speed_pieces,
    worth_pieces,
)

Array = NDArray[np.float64]
EARLY = 0.12  # [s] before contact: from then on no corner of the striking link is beyond the target's plane
# [m], [m/s], [m/s] how far the striker keeps off the target's plane; and a tool in a soft grip after contact
CLEARANCE, HASTE, PARTING = 0.02, 0.04, 0.12
IN_CONTACT = "position in contact"  # of variables and their rows
_KNOWN_TERMS = (
    *map(type, DEFAULT_TERMS),
    FirstTouch,
    Gaze,
    GearLoad,
    Grip,
    GroundForce,
    HandOrientation,
    ReferenceRange,
    Slide,
    TargetSpeed,
)
_KNOWN_OBJECTIVES = (Impulse, TargetEnergy, PeakForce, Penetration, AngularMomentum, Effort)

UNIT = 10.0  # [m] of the displacements of the target, as variables


@dataclass(frozen=True, kw_only=True)
class Claims:
    """How a result says that its program was made: what no problem states.

    groups : names, counts and sizes of its variables, in their order.  rows : terms, places and components.
    more : nodes beside those of the mesh, of swing, follow-through and each stance phase.
    elements : of the contact's phases.
    shortest : of each collision, least durations [s] of its phases.  guarded : whether elements are finer.
    apart : rows between bodies, as `impactopt.transcription.clearance` has them.
    """

    groups: Sequence[tuple[str, int, int]]
    rows: Sequence[tuple[str, str, str]]
    more: Sequence[tuple[float, ...]]
    elements: Sequence[Sequence[float]]
    shortest: Sequence[Sequence[float]]
    guarded: bool
    apart: Sequence[Mapping[str, Any]]


class Program:
    """All pieces of a motion's program.

    Attributes
    ----------
    rows : with bounds and names.  worth : parts of the objective, one number each.
    scales, bounds : of variables, by the names of their groups; bounds (count, size) in physical units.
    missing : what is asked for and not known here.
    ways : swing, follow-through, and the abort motion if there is one.  courses : those of each with the
    stance phases before it, or after it.  stands : all of these phases.  blows : with all targets.
    """

    def __init__(self, problem: ImpactProblem, claims: Claims) -> None:
        phases = len(problem.stance_coordinates)
        robots = [RobotMotion(problem, k) for k in range(phases)]
        self.problem, self.robot = problem, robots[problem.blow]
        self.limits = Limits(problem, self.robot)
        self._names = {name for name, _, _ in claims.groups}
        self.missing = unknown(problem)
        self.rows: list[Piece] = []
        self.worth: list[Piece] = []
        swing, follow, *stands = claims.more
        after = range(problem.blow, phases)
        self.courses = [
            course(problem, robots, range(problem.blow + 1), ("swing", "swing"), [swing, *stands]),
            course(problem, robots, after, ("follow", "follow-through"), [follow, *stands]),
        ]
        if problem.abort_after is not None:
            self.courses.append(course(problem, robots, after, ("abort", "abort"), [follow, *stands]))
        self.ways = [each[problem.blow] for each in self.courses]
        self.stands = [way for each in self.courses for k, way in each.items() if k != problem.blow]
        self.scales = {"coasting sole wrench": self.robot.wrench_scale}
        for way in (*self.ways, *self.stands):
            self.scales |= {way.T: np.array([0.1]), f"{way.kind} sole wrench": way.robot.wrench_scale}
        fraction = self.limits.torque.fraction
        self.bounds: dict[str, tuple[Array, Array]] = {
            "feed-forward at contact": (np.array([-fraction]), np.array([fraction]))
        }
        self.blows: list[Blow] = []
        self._stages = 0  # with positions in contact
        self._coasting: Callable[[Variables], Any] | None = None
        if problem.lasts and problem.frozen is None:
            self._blows(claims)
        self._ways()
        self._tendons()
        for each in self.courses:
            self.rows += [*change_pieces(each, self.node), *height_pieces(problem, each)]
        self._touch()
        self._clearance()
        self._first_touch()
        self._ground_force()
        found, strange = apart_pieces(
            problem, self.robot, self._postures(), self._displacements(), claims.apart
        )
        self.rows += found
        self.missing += strange
        self.rows += orientation_pieces(problem, self.robot, self.at_contact)
        self.rows += gaze_pieces(problem, self.ways[0])
        if self.blows:
            self._slide()
            self._reference_range()
            self._links()
            self._balance()
            drives = Drives(self, self._names, self._coasting)
            self.rows += drives.rows
            self.worth += drives.worth
            self.scales |= drives.scales
            self.missing += drives.missing
            rows, worth = worth_pieces(problem, self.blows[0], self._approach)
            self.worth += worth
            self.rows += [*rows, *speed_pieces(problem, self.blows[0], self.ways[1])]
            self.worth += price_pieces(problem, [*self.ways, *self.stands], self.blows)

    # ------------------------------------------------------------------ parts
    def _blows(self, claims: Claims) -> None:
        scenarios = [None, *(s for s in self.problem.scenarios if not s.missing)]
        for scenario, shortest in zip(scenarios, claims.shortest, strict=True):
            common = self.problem, self.robot, self.limits, claims.elements
            blow = Blow(*common, shortest, self.at_contact, scenario, self._names)
            self.blows.append(blow)
            self.scales |= blow.scales()
            self.bounds |= blow.bounds(claims.guarded)
            self.rows += blow.pieces()
        self._stages = sum(count for name, count, _ in claims.groups if name == IN_CONTACT)

    def at_contact(self, v: Variables) -> Array:
        """Coordinates at contact."""
        return self.ways[0].control(v, self.ways[0].phase.intervals + 2)

    def state_at_contact(self, v: Variables) -> tuple[Array, Array]:
        """And their rates."""
        swing = self.ways[0]
        y, y1, _ = swing.at(1.0)(v)
        return y, y1 / v.one(swing.T)

    def _ways(self) -> None:
        problem, fading = self.problem, fading_soles(self.problem, self.problem.blow)
        for way in (*self.ways, *self.stands):
            robot, limits = way.robot, Limits(problem, way.robot)
            self.bounds |= {
                way.control_group: limits.y,
                f"{way.kind} legs": limits.legs,
                way.T: (np.array([way.phase.duration[0]]), np.array([way.phase.duration[1]])),
            }
            for k, s in enumerate(way.nodes):
                last = way.swings and k == len(way.nodes) - 1
                node, place = self.node(way, k), way.place(float(s))
                lifted = None if last else self._lifted(place)
                soles = fading_soles(problem, way.number), way.lifted.get(k, NONE)
                self.rows.append(
                    node_piece(robot, limits, place, node, feedforward=last, lifted=lifted, soles=soles)
                )
            self.rows += rate_pieces(robot, limits, way)
            if robot.drifts:
                self.rows += momentum_pieces(robot, way)
                self.bounds[f"{way.kind} base control point"] = limits.y[0][:6], limits.y[1][:6]
        base, names = self.robot.base, self.robot.labels[self.robot.base :]
        lower, upper = (bound[base:] for bound in self.limits.y)
        self.rows.append(
            Piece.of(
                lambda v: self.at_contact(v)[base:], [("position limit", "contact", names, lower, upper)]
            )
        )
        if problem.abort_after is not None:
            abort = self.ways[-1]
            begin = abort.at(0.0)

            def coasting(v: Variables) -> tuple[Array, Array, Array, Array, Array, float]:
                y, y1, _ = begin(v)
                return y, y1, 0 * y, v.get("abort legs"), v.get("coasting sole wrench"), v.one(abort.T)

            lifted = self._lifted(COASTED)
            self.rows.append(
                node_piece(
                    self.robot,
                    self.limits,
                    COASTED,
                    coasting,
                    closed=False,
                    lifted=lifted,
                    soles=(fading, NONE),
                )
            )
            self._coasting = coasting

    def _lifted(self, place: str) -> str | None:
        """The torque over limit at a node, with its bounds, if that is a variable."""
        name, fraction = node_torque(place), np.array([self.limits.torque.fraction])
        if name not in self._names:
            return None
        self.bounds[name] = -fraction, fraction
        return name

    def node(self, way: Way, k: int) -> Callable[[Variables], Any]:
        """y, y', y'', legs, sole wrenches and T at node k of a motion."""
        at = way.at_node(float(way.nodes[k]), k)

        def state(v: Variables) -> tuple[Array, Array, Array, Array, Array, float]:
            return (*at(v), v.get(f"{way.kind} legs", k), way.wrench(v, k), v.one(way.T))

        return state

    def nodes(self) -> dict[str, Callable[[Variables], Any]]:
        """y, y', y'', legs, sole wrenches and T at each node of the phases with the blow, by its place."""
        return {way.place(float(s)): self.node(way, k) for way in self.ways for k, s in enumerate(way.nodes)}

    def _postures(self) -> dict[str, Callable[[Variables], Array]]:
        """Configuration (nq,) at each node of all phases, by its place."""

        def posture(way: Way, at: Callable[[Variables], Any], k: int, v: Variables) -> Array:
            return way.robot.posture(at(v)[0], v.get(f"{way.kind} legs", k))

        def in_contact(i: int, v: Variables) -> Array:
            return self.robot.posture(v.get(IN_CONTACT, i), self.blows[0].get(v, "collision legs", i))

        return {
            way.place(float(s)): partial(posture, way, way.at(float(s)), k)
            for way in (*self.ways, *self.stands)
            for k, s in enumerate(way.nodes)
        } | {self.blows[0].place(i): partial(in_contact, i) for i in range(self._stages)}

    def _displacements(self) -> dict[str, Callable[[Variables], Array]]:
        """Displacement (3,) [m] of the target at each node of all phases, by its place; adds its rows."""
        p, term = self.problem, "displacement of the target"
        moving = [body for body in p.bodies.world if body.moves] if p.keep_out.enabled else []
        rubbed = p.friction is not None and p.friction.moves_target
        labels = ["along the normal", *(f"across it, {x}" for x in "xyz" if rubbed)]
        axes = UNIT * np.column_stack([p.normal, *(np.eye(3) if rubbed else ())])
        before, still = float(p.target.speed_before()) * bool(moving) * p.normal, np.zeros(len(labels))

        def known(v: Variables, time: Callable[[Variables], float]) -> Array:
            return -before * time(v)

        out: dict[str, Callable[[Variables], Array]] = {
            place: partial(known, time=time) for place, time in self._since(0)
        }
        others = [*self._since(1), *(self._since(2) if len(self.courses) > 2 else ())]
        out |= {place: lambda v: np.zeros(3) for place, _ in others}
        if all(body.before for body in moving):  # nothing moves, or a board, which the impact takes away
            return out | {self.blows[0].place(i): out[others[0][0]] for i in range(self._stages)}
        if not self.blows:  # what its displacements are, is not known: they are taken for right
            first = f"{term}, end of {spells_of(p)[-1].name}"
            names = {place: f"{term}, {place}" for place, _ in self._since(1)}
            names |= dict.fromkeys([self.ways[1].place(0.0), *(names if p.target.stays else ())], first)
            known_there = {place: name for place, name in names.items() if name in self._names}
            return out | {
                place: lambda v, name=name: axes @ v.get(name) for place, name in known_there.items()
            }
        blow = self.blows[0]

        def across(v: Variables, i: int) -> Array:
            s = blow.stages[i]
            begin = np.zeros(3) if s.begins else across(v, s.previous)
            rates = (blow.get(v, "target tangential velocity", m) for m in s.members)
            return begin + sum(w * rate for w, rate in zip(s.integral, rates, strict=True))

        def within(v: Variables, i: int) -> Array:
            mean = blow.get(v, "target travel", i)
            mean = np.append(mean, across(v, i)) if rubbed else mean
            return v.one(blow.durations[blow.stages[i].phase]) * mean / UNIT

        def last(v: Variables) -> Array:
            rate = blow.slope(v, "target travel", blow.end[-1], np.zeros(1), anew=True)
            return np.append(rate, blow.get(v, "target tangential velocity", -1)) if rubbed else rate

        def add(place: str, value: Callable[[Variables], Array]) -> Callable[[Variables], Array]:
            name = f"{term}, {place}"
            rows: list[Any] = [(term, place, labels, 0.0, 0.0)]
            self.rows.append(Piece.of(lambda v: value(v) - v.get(name), rows))
            return lambda v: v.get(name)

        ends: list[Callable[[Variables], Array]] = [lambda v: still]
        for spell, i in zip(blow.spells, blow.end, strict=True):
            ends.append(add(f"end of {spell.name}", lambda v, i=i, begin=ends[-1]: begin(v) + within(v, i)))
        for i in range(self._stages):
            begin = ends[blow.stages[i].phase]
            found = add(blow.place(i), lambda v, i=i, begin=begin: begin(v) + within(v, i))
            out[blow.place(i)] = lambda v, found=found: axes @ found(v)
        for place, time in self._since(1):
            found = ends[-1]
            if not p.target.stays and place != self.ways[1].place(0.0):
                found = add(place, lambda v, time=time: ends[-1](v) + time(v) * last(v) / UNIT)
            out[place] = lambda v, found=found: axes @ found(v)
        return out

    def _since(self, course: int) -> list[tuple[str, Callable[[Variables], float]]]:
        """Place, and time [s] from it to contact or since contact, of each node of a course."""
        blow, ways, out = self.problem.blow, self.courses[course], []
        for k, way in ways.items():
            between = [ways[j].T for j in (range(k + 1, blow + 1) if course == 0 else range(blow, k))]
            for s in map(float, way.nodes):
                part = 1 - s if course == 0 else s

                def time(v: Variables, way: Way = way, part: float = part, names: Any = between) -> float:
                    return part * v.one(way.T) + sum(v.one(name) for name in names)

                out.append((way.place(s), time))
        return out

    def _tendons(self) -> None:
        """Sums of joint angles in their ranges, at all nodes."""
        r = self.problem.robot
        names = [f"tendon {tendon.name}" for tendon in r.tendons]
        for place, posture in self._postures().items():

            def value(v: Variables, posture: Callable[[Variables], Array] = posture) -> Array:
                angle = dict(zip(r.joint_names, r.joint_positions(posture(v)), strict=True))
                return np.array([sum(k * angle[j] for j, k in t.coefficients.items()) for t in r.tendons])

            if names:
                self.rows.append(Piece.of(value, [("position limit", place, names, *self.limits.tendons)]))

    @property
    def _tangents(self) -> Array:
        """(2, 3) across the normal."""
        return np.asarray(np.linalg.svd(self.problem.normal.reshape(1, 3))[2][1:])

    def _touch(self) -> None:
        p, incidence = self.problem, self.problem.term(Incidence)
        axes = np.vstack([p.normal, self._tangents])
        slow = 0.05 + float(p.target.speed_before())
        for k, (name, point) in enumerate(p.contacts):

            def value(v: Variables, k: int = k) -> Array:
                place, fast, _ = self.robot.striking(*self.state_at_contact(v), k)
                return np.concatenate([place, axes @ fast])

            own = f"{name} " if k else ""
            tangents = [f"{own}tangent 1", f"{own}tangent 2"]
            rows: list[Any] = [
                ("hit point", "contact", [f"{own}{axis}" for axis in "xyz"], point, point),
                ("approach speed", "contact", [f"{own}normal"], slow, np.inf),
                (incidence.name, "contact", tangents, -incidence.speed, incidence.speed),
            ]
            self.rows.append(Piece.of(value, rows))

    def _approach(self, v: Variables) -> float:
        """Speed of the striker along the normal at contact [m/s]."""
        return float(self.problem.normal @ self.robot.striking(*self.state_at_contact(v))[1])

    def _slide(self) -> None:
        """How far across the target the striker has moved at each stage of the expected blow."""
        term, blow, still = self.problem.extra(Slide), self.blows[0], np.zeros(self.robot.ny)
        if term is None or not term.enabled:
            return
        tangents, names = self._tangents, ["tangent 1", "tangent 2"]
        for i in range(len(blow.stages)):

            def value(v: Variables, i: int = i) -> Array:
                begin = self.at_contact(v)
                places = (begin, blow.moved(v, i, begin)[0])
                hit, now = (self.robot.striking(y, still)[0] for y in places)
                return tangents @ (now - hit)

            rows = [(term.name, blow.place(i), names, -term.most, term.most)]
            self.rows.append(Piece.of(value, rows))

    def _reference_range(self) -> None:
        """How far the joints are of a reference that has coasted until contact ends."""
        term, r, blow = self.problem.extra(ReferenceRange), self.problem.robot, self.blows[0]
        if term is None or not term.enabled:
            return
        c, base, last = self.problem.coordinates, self.robot.base, len(blow.stages) - 1
        lower = np.where(r.passive, -np.inf, r.lower + term.margin)
        upper = np.where(r.passive, np.inf, r.upper - term.margin)
        kept = np.isfinite(lower) | np.isfinite(upper)

        def independent(v: Variables) -> Array:
            time = sum(v.one(name) for name in blow.durations)
            y = self.at_contact(v) + v.get("rate at contact") * time
            return y[base:][kept[c.independent]]

        def dependent(v: Variables) -> Array:
            return blow.get(v, "coasting legs", last)[kept[c.dependent]]

        for value, joints in ((independent, c.independent), (dependent, c.dependent)):
            own = [int(j) for j in joints if kept[j]]
            if own:
                names = [r.joint_names[j] for j in own]
                self.rows.append(
                    Piece.of(value, [(term.name, "end of contact", names, lower[own], upper[own])])
                )

    def _first_touch(self) -> None:
        """How far the striking link's corners are beyond the target's plane, and where its face looks."""
        p, term, swing = self.problem, self.problem.term(FirstTouch), self.ways[0]
        if not term.active or not p.keep_out.enabled:
            return
        turned = p.extra(HandOrientation)
        # a target that comes has another plane before contact
        since = 1.0 if p.target.speed_before() else 1 - EARLY / float(np.mean(p.swing.duration))
        for k, (striker, point) in enumerate(p.contacts):
            # the face that the hand is turned by, or else the one about its striking point
            by_axis = striker == p.striker and turned is not None and turned.direction is None
            axis = np.array(turned.axis) if turned and by_axis else None
            face = striker_face(p.robot, striker, axis, assumed=term.assumed)
            if face is None:
                continue
            names = [f"{striker}, corner {i}" for i in range(len(face.corners))]
            for s in (float(s) for s in swing.nodes if s >= since):
                at = swing.at(s)

                def value(
                    v: Variables, k: int = k, point: Array = point, face: Any = face, at: Any = at
                ) -> Array:
                    place, _, turn = self.robot.striking(at(v)[0], np.zeros(self.robot.ny), k)
                    beyond = (place - point + face.corners @ turn.T) @ p.normal
                    return np.append(beyond, p.normal @ turn @ face.normal / np.sin(term.angle))

                least = 1 / np.tan(term.angle) if s == swing.nodes[-1] else -np.inf
                place = swing.place(s)
                rows: list[Any] = [(term.name, place, names, -np.inf, term.depth + face.ahead)]
                rows.append((term.name, place, [f"{striker}'s face"], least, np.inf))
                self.rows.append(Piece.of(value, rows))

    def _ground_force(self) -> None:
        """Normal forces of the soles over the weight, at the nodes and in contact."""
        term, robot = self.problem.term(GroundForce), self.robot
        soles = [k for k, (leg, *_) in enumerate(robot.soles) if leg.sole is not None]
        if not term.active or not soles:
            return
        fades = fading_soles(self.problem, self.problem.blow)
        held = [(k, leg.end) for k, (leg, *_) in enumerate(robot.soles) if leg.sole and leg.name not in fades]
        own, named = [6 * k + 2 for k, _ in held], [name for _, name in held]
        if len(soles) == 1:
            own, named = [], []

        def add(place: str, wrench: Callable[[Variables], Array]) -> None:
            def value(v: Variables) -> Array:
                normal = wrench(v) / robot.weight
                return np.array([normal[[6 * k + 2 for k in soles]].sum(), *normal[own]])

            rows: list[Any] = [(term.name, place, ["all soles"], term.least, term.most)]
            rows.append((term.name, place, named, term.sole, np.inf))
            self.rows.append(Piece.of(value, rows))

        for place, node in self.nodes().items():
            add(place, lambda v, node=node: node(v)[4])
        if self._coasting is not None:
            add(COASTED, lambda v: v.get("coasting sole wrench"))
        for blow in self.blows:
            for i in range(len(blow.stages)):
                add(blow.place(i), lambda v, blow=blow, i=i: blow.get(v, "collision sole wrench", i))

    def _clearance(self) -> None:
        for k, (striker, point) in enumerate(self.problem.contacts):
            self._clearance_of(k, striker, point)

    def _clearance_of(self, k: int, striker: str, point: Array) -> None:
        p, robot = self.problem, self.robot
        swing, follow = self.ways[:2]
        start = robot.striking(robot.split(p.start_posture)[0], np.zeros(robot.ny), k)[0]
        nearest = min(CLEARANCE, max(float(p.normal @ (point - start)), 0.0))

        def along(y: Array) -> float:
            return float(p.normal @ robot.striking(y, np.zeros(robot.ny), k)[0])

        def add(term: str, way: Way, s: float, apart: float, plane: Callable[[Variables], float]) -> None:
            at = way.at(s)

            def value(v: Variables) -> Array:
                return np.array([along(at(v)[0]) - plane(v)])

            most = -min(nearest, apart)
            self.rows.append(Piece.of(value, [(term, way.place(s), [striker], -np.inf, most)]))

        def surface(s: float, v: Variables) -> float:
            """[m] of the target along the normal at a fraction of the swing, which it may come in."""
            return float(p.normal @ point) - float(p.target.speed_before()) * (1 - s) * v.one(swing.T)

        soft = any(tool.name == striker and tool.grip is not None for tool in p.robot.tools)
        ahead = HASTE * float(np.mean(p.swing.duration))
        behind = (PARTING if soft else HASTE) * float(np.mean(p.follow.duration))
        for s in map(float, swing.nodes[:-1]):
            add("no touch before contact", swing, s, (1 - s) * ahead, partial(surface, s))
        slow = not p.target.stays and p.extra(TargetSpeed) is not None
        if not (p.target.stays or slow):
            return
        name, first = f"target left by {striker}" if k else "target left", follow.at(0.0)

        def left_at(s: float, v: Variables) -> float:
            return v.one(name) + (s * v.one(GONE) if slow else 0.0)

        for s in map(float, follow.nodes[1:]):
            add("no touch after contact", follow, s, s * behind, partial(left_at, s))

        def left(v: Variables) -> Array:
            return np.array([along(first(v)[0]) - v.one(name)])

        rows = [(name, follow.place(0.0), [name], 0.0, 0.0)]
        self.rows.append(Piece.of(left, rows))

    def _links(self) -> None:
        p, labels = self.problem, self.robot.labels
        blow = self.blows[0]
        starts = [(way.at(0.0), way.T) for way in self.ways[1:]]

        def hit(v: Variables) -> Array:
            y, u = self.state_at_contact(v)
            begin, T = starts[0]
            after, rate, _ = begin(v)
            moved = blow.moved(v, blow.end[-1], y)[0]
            u0, left = v.get("rate at contact"), blow.get(v, "collision rate", blow.end[-1])
            return np.concatenate([u - u0, after - moved, rate / v.one(T) - left])

        follows = "follow-through starts from the predicted state"
        rows: list[Any] = [("collision starts from the swing's end", "rate", labels, 0.0, 0.0)]
        rows += [(follows, part, labels, 0.0, 0.0) for part in ("position", "rate")]
        self.rows.append(Piece.of(hit, rows))
        for other in self.blows[1:]:

            def after(v: Variables, other: Blow = other) -> Array:
                y = self.at_contact(v)
                return other.get(v, "position after contact") - other.moved(v, other.end[-1], y)[0]

            rows = [("state after contact", f"position{other.suffix}", labels, 0.0, 0.0)]
            self.rows.append(Piece.of(after, rows))
        for i in range(self._stages):

            def lies(v: Variables, i: int = i) -> Array:
                return v.get(IN_CONTACT, i) - blow.moved(v, i, self.at_contact(v))[0]

            self.rows.append(Piece.of(lies, [(IN_CONTACT, blow.place(i), labels, 0.0, 0.0)]))
        if p.abort_after is None:
            return
        late: float = p.abort_after

        def missed(v: Variables) -> Array:
            begin, T = starts[1]
            y, rate, _ = begin(v)
            u0 = v.get("rate at contact")
            return np.concatenate([y - self.at_contact(v) - late * u0, rate / v.one(T) - u0])

        coasts = "abort motion starts where coasting ends"
        rows = [(coasts, part, labels, 0.0, 0.0) for part in ("position", "rate")]
        self.rows.append(Piece.of(missed, rows))

    def _balance(self) -> None:
        robot, p = self.robot, self.problem
        if not robot.soles:
            return
        balance, swing, follow = p.term(Balance), self.ways[0], self.ways[1]
        inward, offset = inward_edges(support_polygon(p.robot, p.coordinates))
        begin = follow.at(0.0)

        def left(v: Variables) -> tuple[Array, Array, Array]:
            y, y1, _ = begin(v)
            return y, v.get("follow legs"), y1 / v.one(follow.T)

        states: list[tuple[Any, float | None, str]] = [(left, balance.capture_margin, "after contact")]
        for other in self.blows[1:]:

            def after(v: Variables, other: Blow = other) -> tuple[Array, Array, Array]:
                legs = other.get(v, "collision legs", other.end[-1])
                rate = other.get(v, "collision rate", other.end[-1])
                return other.get(v, "position after contact"), legs, rate

            assert other.scenario is not None
            states.append((after, other.scenario.capture_margin, f"after contact{other.suffix}"))
        for s in p.scenarios:
            if s.missing:

                def at(v: Variables) -> tuple[Array, Array, Array]:
                    y, u = self.state_at_contact(v)
                    return y, v.get("swing legs", len(swing.nodes) - 1), u

                states.append((at, s.capture_margin, f"contact, if {s.name}"))
        slow, still = balance.vertical_speed, balance.angular_momentum
        lifted = any(isinstance(o, AngularMomentum) for o in p.objectives)
        if lifted:
            self.bounds["angular momentum"] = np.array([-still]), np.array([still])
        for state, margin, place in states:
            equal = lifted and state is left

            def value(
                v: Variables, state: Any = state, margin: float | None = margin, equal: bool = equal
            ) -> Array:
                y, legs, u = state(v)
                q, qd, _ = robot.motion(y, legs, u, np.zeros(robot.ny))
                com, fast, turning = robot.momentum(q, qd)
                capture = com[:2] + fast[:2] * np.sqrt(-com[2] / robot.model.gravity.linear[2])
                edges = inward @ capture - offset - (margin or 0.0)
                if equal:
                    turning = turning - v.get("angular momentum")
                return np.concatenate([edges if margin is not None else [], fast[2:], turning])

            rows: list[Any] = [
                ("vertical speed", place, ["z"], -slow, slow),
                ("angular momentum", place, ["x", "y", "z"], *((0.0, 0.0) if equal else (-still, still))),
            ]
            if margin is not None:
                edges = [f"edge {e}" for e in range(len(inward))]
                rows.insert(0, ("capture point", place, edges, 0.0, np.inf))
            self.rows.append(Piece.of(value, rows))


def unknown(problem: ImpactProblem) -> list[str]:
    """What a problem asks for that nothing here knows."""
    out = []
    if not problem.lasts or problem.frozen is not None:
        out.append(f"the model {problem.collision!r} of the collision")
    out += [f"the term {type(t).__name__}" for t in problem.terms if type(t) not in _KNOWN_TERMS]
    out += [
        f"the objective {type(o).__name__}" for o in problem.objectives if type(o) not in _KNOWN_OBJECTIVES
    ]
    return out
