"""From an impact problem to a nonlinear program, and from its solution back to a plan.

Phases: swing (rest to contact), compression, restitution, follow-through (the predicted state after contact
to rest).  Swing and follow-through are cubic splines in the independent coordinates; their legs and sole
wrenches are variables of the nodes.  The two contact phases are Radau IIA collocation of the frozen dynamics
with their durations as variables.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from impactopt.codegen.cache import cached
from impactopt.codegen.hashing import model_hash
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.kinematics.splines import CubicSpline, basis, graded_breaks, knots, rate_weights
from impactopt.kinematics.statics import static_wrenches
from impactopt.kinematics.support import support_polygon
from impactopt.problem.problem import ImpactProblem
from impactopt.transcription import blocks as symbolic
from impactopt.transcription.apart import apart_functions
from impactopt.transcription.at_contact import BodyState, ContactProgram
from impactopt.transcription.clearance import add_clearance
from impactopt.transcription.courses import TorqueCourse, torque_courses
from impactopt.transcription.extra_blocks import ExtraBlock, extra_blocks
from impactopt.transcription.follow import FollowThrough
from impactopt.transcription.lanes import in_lanes
from impactopt.transcription.layout import Affine, Array, Group, add, stack
from impactopt.transcription.mesh import Elements, percentage, with_middles
from impactopt.transcription.mesh_refinement import NO_MORE, MoreNodes
from impactopt.transcription.objective import Prices, motion_prices
from impactopt.transcription.plan import Plan
from impactopt.transcription.rows import Index, Measure, Place, Rank, along, by_leg, degrees, percent, rates
from impactopt.transcription.structured import derivative_functions


def block_functions(
    problem: ImpactProblem,
    coordinates: StanceCoordinates,
    report: Callable[[str], None] | None = None,
    elements: Elements = (),
) -> dict[str, Any]:
    """The compiled blocks (value, Jacobian, Hessian) of a problem, from the cache where they are in it.

    elements : of the contact, if not those that the problem asks for; a peak of its forces depends on them.
    """
    robot = problem.robot
    edges = len(support_polygon(robot, coordinates))
    recipe = (
        model_hash(robot.model),
        tuple(
            (leg.sole.frame, tuple(np.round(leg.placement.homogeneous.ravel(), 12)))
            for leg in coordinates.legs
        ),
        tuple(tuple(o.tolist()) for leg in coordinates.legs for o in leg.order),
        problem.striker,
        edges,
    )
    target = problem.target
    contact = (problem.law.formula(), target.formula(), symbolic.typical_state(target))
    out: dict[str, Any] = {}
    instant = problem.collision != "dynamics"
    builders = symbolic.builders(coordinates, problem.striker, problem.law, target, edges, instant=instant)
    found = {name: ExtraBlock(contact if name == "force" else (), build) for name, build in builders.items()}
    for name, block in {**found, **extra_blocks(problem, coordinates, elements)}.items():

        def functions(block: ExtraBlock = block, name: str = name) -> list[Any]:
            b = block.build()
            found = derivative_functions(name, b.z, b.p, b.out, b.through)
            return [in_lanes(function, b.lanes) for function in found]

        out |= cached(f"{robot.name}-{name}", (name, *recipe, *block.key), functions, report=report)
    return out | apart_functions(report)


class Transcription(ContactProgram):
    """The program of one problem, with the groups that its solution is read from.

    nodes : beside the ends and middles of the splines' intervals.
    elements : of the contact; none: those that the problem asks for.
    """

    def __init__(
        self,
        problem: ImpactProblem,
        coordinates: StanceCoordinates,
        functions: dict[str, Any],
        nodes: MoreNodes = NO_MORE,
        elements: Elements = (),
    ) -> None:
        super().__init__(problem, coordinates, functions)
        self.nodes, self.elements = nodes, elements
        self.swing_breaks = graded_breaks(problem.swing.intervals, problem.swing.grading, fine_end=True)
        self.follow_breaks = graded_breaks(problem.follow.intervals, problem.follow.grading, fine_end=False)
        # the swing's start is given
        self.swing_nodes = np.union1d(with_middles(self.swing_breaks)[1:], nodes.swing)
        self.follow_nodes = np.union1d(with_middles(self.follow_breaks), nodes.follow)
        self.torques: list[Affine] = []  # over limit, at each node of the block "node", if `torques_lifted`
        self._variables()
        self._swing_and_follow()
        self._contact_rows()
        add_clearance(self)
        self._collision_rows()
        self._after()
        self._finish(problem.terms, problem.objectives)

    # ------------------------------------------------------------------ variables
    def _variables(self) -> None:
        p, add = self.problem, self.layout.add
        ny, nl, nw = self.ny, self.nl, self.nw
        ns, ms = p.swing.intervals, len(self.swing_nodes)
        self.swing_c = add("swing control point", ns - 1, ny, **self.of_y)
        self.swing_legs = add("swing legs", ms, nl, **self.of_legs)
        self.swing_w = add("swing sole wrench", ms, nw, **self.of_wrenches)
        self.swing_T = self.duration("swing duration", p.swing.duration, 0.1)
        self.contact_state = self.at(self.swing_control, self.swing_breaks, 1.0)
        self.contact_T = self.swing_T[0]
        self.contact_legs, self.contact_w = self.swing_legs[-1], self.swing_w[-1]
        self._hit(after=False)
        self.follow = FollowThrough(self, "follow", "follow-through")
        self.brake_after = p.brake_after
        self.brake = FollowThrough(self, "brake", "brake") if self.brake_after is not None else None
        self.follows = [self.follow, *([self.brake] if self.brake is not None else [])]
        self.coast_w = add("coasting sole wrench", int(self.brake is not None), nw, **self.of_wrenches)

    def swing_control(self, j: int) -> Affine:
        """Control point j = 0 .. N+2 of the swing.

        The first three make a start at rest, the last one an end without acceleration.
        The reference coasts from contact on, so the torque that the swing ends with is the feed-forward of
        the collision: it does not jump, and a target that comes late meets the same motion.
        """
        if j <= 2:
            return Affine.constant(self.y0)
        if j < self.problem.swing.intervals + 2:
            return self.swing_c[j - 3]
        factors = rate_weights(self.swing_breaks)
        step = self.swing_control(j - 1) - self.swing_control(j - 2)
        return self.swing_control(j - 1) + step * float(factors[-2] / factors[-1])

    def at(self, control: Callable[[int], Affine], breaks: Array, s: float) -> tuple[Affine, Affine, Affine]:
        """y, y', y'' at s of the spline with these control points."""
        y, yd, ydd = (
            add([control(int(j)) * row[0, j] for j in np.flatnonzero(row[0])]) for row in basis(breaks, s)
        )
        return y, yd, ydd

    def swing_place(self, s: float) -> Place:
        return Place(f"swing, {percentage(s, self.nodes.swing)}", "swing at {s}", self.swing_T[0] * s)

    def swing_spots(self, since: float = 0.0) -> list[tuple[Place, list[Affine]]]:
        return [
            (self.swing_place(s), [self.at(self.swing_control, self.swing_breaks, s)[0], self.swing_legs[k]])
            for k, s in enumerate(self.swing_nodes)
            if s >= since
        ]

    def swing_motion(self) -> list[tuple[Place, list[Affine]]]:
        """Places of the swing's nodes with y, y', y'', legs and T [s], that y' and y'' are of."""
        out = []
        for k, s in enumerate(self.swing_nodes):
            y, y1, y2 = self.at(self.swing_control, self.swing_breaks, s)
            out.append((self.swing_place(s), [y, y1, y2, self.swing_legs[k], self.swing_T[0]]))
        return out

    def torque_courses(self) -> list[TorqueCourse]:
        """Torques over limit of swing, follow-through and brake, of a program that has them as variables."""
        return torque_courses(self)

    def follow_spots(self) -> list[tuple[Place, list[Affine]]]:
        return [spot for follow in self.follows for spot in follow.spots()]

    def body_states(self, x: Array) -> list[BodyState]:
        plan, found = self.decode(x), self.swing_spots()
        out = [
            BodyState(0, place.name, s * plan.swing.duration, self.posture(x, slots))
            for s, (place, slots) in zip(self.swing_nodes, found, strict=True)
        ]
        for missed, follow in enumerate(self.follows):
            curve, begin, nodes, _ = plan.way(2, missed=bool(missed))
            out += [
                BodyState(2 + missed, place.name, begin + s * curve.duration, self.posture(x, slots))
                for s, (place, slots) in zip(nodes, follow.spots(), strict=True)
            ]
        return out

    def travel(self, x: Array, time: Array) -> Array:
        return self.decode(x).travel(time)

    # ------------------------------------------------------------------ rows
    def _swing_and_follow(self) -> None:
        """Nodes of swing, contact (coasting) and follow-through: one block for all of them."""
        p = self.problem
        instances, places = [], []
        for k, at in enumerate(self.swing_nodes):
            y, y1, y2 = self.at(self.swing_control, self.swing_breaks, at)
            instances.append([y, y1, y2, self.swing_legs[k], self.swing_w[k], self.swing_T[0]])
            places.append(self.swing_place(at))
        for follow in self.follows:
            slots, names = follow.nodes()
            instances += slots
            places += names
        if self.brake is not None:
            coasting, name = self.brake.coasting_node(self.coast_w)
            instances.append(coasting)
            places.append(name)
        outputs = self.add_nodes(instances, places, closed=int(self.brake is not None))
        self._torque_rows(places, outputs)
        joints = np.arange(self.coordinates.base, self.ny)
        self.rows.add(
            term=self.position.name,
            place="contact",
            components=self.coordinates.labels[self.coordinates.base :],
            affine=self.contact_state[0][joints],
            lower=self.y_lower[joints],
            upper=self.y_upper[joints],
            measure=degrees("outside"),
        )
        # the first two velocity control points are zero by construction
        last = p.swing.intervals + 2
        self.rate_rows("swing", self.swing_control, range(2, last), self.swing_breaks, self.swing_T)
        for follow in self.follows:
            follow.add_rate_rows()

    @property
    def torques_lifted(self) -> bool:
        """Whether the torques at the nodes are variables, as something beside their limit asks for them."""
        p = self.problem
        return any(term.needs_torques for term in p.terms) or any(o.needs_torques for o in p.objectives)

    def _torque_rows(self, places: list[Place], outputs: list[Index]) -> None:
        """``outputs``: the torques over limit at each node."""
        limit, names = self.torque.fraction, self.robot.joint_names
        strong = percent("over its limit", of=limit)
        contact = len(self.swing_nodes) - 1
        for i, (place, torque) in enumerate(zip(places, outputs, strict=True)):
            if i == contact:  # there it is the variable `feedforward`, which has the limit as its bounds
                self.torques.append(self.feedforward[0])
            elif self.torques_lifted:
                group = self.lift(
                    f"torque, {place.name}",
                    torque,
                    term=self.torque.name,
                    place=place,
                    measure=strong,
                    labels=names,
                    lower=-limit,
                    upper=limit,
                )
                self.torques.append(group[0])
            else:
                self.rows.add(
                    term=self.torque.name,
                    place=place,
                    components=names,
                    outputs=torque,
                    lower=-limit,
                    upper=limit,
                    measure=strong,
                )
        self._feedforward_rows(outputs[contact])

    def rate_rows(
        self, phase: str, control: Callable[[int], Affine], js: range, breaks: Array, duration: Group
    ) -> None:
        """Velocity control points within the limit; multiplied by T they are linear."""
        c = self.coordinates
        joints = np.arange(c.base, c.ny)
        limit = self.rate_limit[c.independent]
        names = c.labels[c.base :]
        factors = rate_weights(breaks)
        shortest, longest = self.layout.bounds(duration)
        fixed = shortest == longest
        for j in js:
            step = (control(j + 1) - control(j))[joints] * (factors[j] / limit)
            # where the velocity's control point pulls most: the mean of its knots
            s = float(knots(breaks)[j + 2 : j + 4].mean())
            name = f"{phase}, control point {j}"
            place = Place(name, f"{phase} at about {{s}}", duration[0] * s)
            fast = Measure("%", 100.0, "over its limit", duration[0])
            if fixed:
                bound = float(longest)
                self.rows.add(
                    term=self.velocity.name,
                    place=place,
                    components=names,
                    affine=step,
                    lower=-bound,
                    upper=bound,
                    measure=fast,
                )
                continue
            time = stack([duration[0]] * len(joints))
            for sign, way in ((1.0, "forward"), (-1.0, "backward")):
                self.rows.add(
                    term=self.velocity.name,
                    place=replace(place, name=f"{name}, {way}"),
                    components=names,
                    affine=step * sign - time,
                    upper=0,
                    measure=fast,
                )

    def _after(self) -> None:
        """What comes after contact: the follow-through starts there, and the robot keeps its balance."""
        yf, yf1 = self.follow.start
        instances = self.expected.link((yf, yf1, self.follow.T[0]))
        for other in self.scenarios:
            instances += other.link_after()
        if self.brake is not None and self.brake_after is not None:
            instances += self.brake.link_from_coasting(self.brake_after)
        at = self.add_block("link", instances, np.zeros(0))
        labels, places = self.coordinates.labels, at + 3 * np.arange(self.ny)
        far, fast = along(labels, "off"), rates(labels)
        self.equal("collision starts from the swing's end", "rate", labels, places, fast)
        self.equal("follow-through starts from the predicted state", "position", labels, places + 1, far)
        self.equal("follow-through starts from the predicted state", "rate", labels, places + 2, fast)
        if self.brake is not None:
            after = places + 3 * self.ny * (1 + len(self.scenarios))
            self.equal("brake starts where coasting ends", "position", labels, after + 1, far)
            self.equal("brake starts where coasting ends", "rate", labels, after + 2, fast)
        for k, other in enumerate(self.scenarios, start=1):
            place = f"position{other.suffix}"
            self.equal("state after contact", place, labels, places + 1 + 3 * self.ny * k, far)
        if self.coordinates.legs:
            self._balance_rows([yf, yf1, self.follow.legs[0], self.follow.T[0]])

    def _prices(self) -> Prices:
        return motion_prices(self)

    # ------------------------------------------------------------------ structure
    def _determined(self) -> list[tuple[Rank, Index]]:
        return [*super()._determined(), ((2, 0), self.u0.index(0))]

    def _nodes(self) -> list[list[Index]]:
        nodes = [(self.swing_legs, self.swing_w), *[(f.legs, f.w) for f in self.follows]]
        out = [[*by_leg(legs.index(k)), w.index(k)[:6]] for legs, w in nodes for k in range(w.count)]
        return out + [[self.coast_w.index(k)[:6]] for k in range(self.coast_w.count)]

    def _starts(self) -> list[Index]:
        return [follow.determined() for follow in self.follows]

    # ------------------------------------------------------------------ solution
    def spline(
        self, x: Array, control: Callable[[int], Affine], breaks: Array, duration: Group
    ) -> CubicSpline:
        """The spline that solver variables (n,) stand for."""
        points = np.array([control(j).evaluate(x) for j in range(len(breaks) + 2)])
        return CubicSpline(control=points, breaks=breaks, duration=float(duration.read(x)[0, 0]))

    def decode(self, x: Array) -> Plan:
        """The plan that solver variables (n,) stand for."""
        p, c = self.problem, self.coordinates

        swing = self.spline(x, self.swing_control, self.swing_breaks, self.swing_T)
        follow, follow_w = self.follow.decode(x)
        brake, brake_w = self.brake.decode(x) if self.brake is not None else (None, None)
        swing_w = self.swing_w.read(x)
        start_w = static_wrenches(c, self.y0, self.legs0)
        return Plan(
            problem=p,
            swing=swing,
            follow=follow,
            swing_nodes=np.concatenate([[0.0], self.swing_nodes]),
            swing_wrench=np.vstack([start_w, swing_w]),
            follow_nodes=self.follow_nodes,
            follow_wrench=follow_w,
            brake=brake,
            brake_wrench=brake_w,
            **self._decode_hit(x),
        )
