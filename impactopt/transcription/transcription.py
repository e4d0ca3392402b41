"""Transcribes an impact problem to a nonlinear program, and its solution back to a plan.

Phases: swing (rest to contact), compression, restitution, follow-through (the predicted state after contact
to rest).  Swing and follow-through are cubic splines in the independent coordinates; their legs and sole
wrenches are variables of the nodes.  The two contact phases are Radau IIA collocation of the frozen dynamics
with their durations as variables.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import groupby
from typing import Any, cast

import numpy as np

from impactopt.codegen.cache import FunctionGroup, cached_groups, model_hash
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.kinematics.support import support_polygon
from impactopt.problem.block import BlockExpression
from impactopt.problem.problem import ImpactProblem
from impactopt.solvers.program import Determined
from impactopt.transcription.blocks import ExtraBlock, extra_blocks, own_blocks, stance_blocks
from impactopt.transcription.builder import Builder
from impactopt.transcription.clearance import SeparationBlock
from impactopt.transcription.collision import Collision
from impactopt.transcription.contact_blocks import typical_state
from impactopt.transcription.contact_conditions import add_balance, add_clearance, add_conditions
from impactopt.transcription.contact_program import BodyState, ContactProgram
from impactopt.transcription.contact_set import ContactSet
from impactopt.transcription.contact_state import Contact, add_coasting
from impactopt.transcription.layout import (
    Affine,
    Array,
    Group,
    Index,
    Place,
    Turn,
    along,
    degrees,
    determined,
    percent,
    rates,
)
from impactopt.transcription.mesh import NO_MORE, Elements, MoreNodes, Shares
from impactopt.transcription.motion_phase import AbortMotion, FollowThrough, Swing, add_nodes
from impactopt.transcription.objective import Prices, motion_prices, style_prices
from impactopt.transcription.plan import Piece, Plan
from impactopt.transcription.simd import in_lanes
from impactopt.transcription.springs import (
    SpringPoint,
    TorqueCourse,
    follow_springs,
    swing_springs,
    torque_courses,
)
from impactopt.transcription.stance_change import Course
from impactopt.transcription.structured import derivative_functions

__all__ = ["Transcription", "block_functions", "statement_of"]

SECOND_BLOCKS = ("second_contact", "second_approach")


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
    recipe = (*_coordinates_recipe(coordinates), problem.striker, edges)
    target = problem.target
    frozen = () if problem.frozen is None else (problem.frozen,)
    contact = (problem.law.formula(), target.formula(), typical_state(target), *frozen[:1])
    groups: list[FunctionGroup] = []
    springs = tuple(np.flatnonzero(robot.sprung).tolist())
    second = () if problem.second is None else (problem.second.striker,)
    rubs = () if problem.friction is None else ("rubs",)
    keys = {"force": (*contact, *second), "first": (*contact[:1], *rubs), "coasting": frozen}
    keys |= {"collision": (*frozen, *springs, *second, *rubs), **dict.fromkeys(SECOND_BLOCKS, second)}
    if chosen := problem.gain_joints:
        keys |= {name: (*keys.get(name, ()), chosen) for name in ("collision", "spring")}
    found = {
        name: ExtraBlock(keys.get(name, ()), build)
        for name, build in own_blocks(problem, coordinates, edges).items()
    }
    for name, block in {**found, **extra_blocks(problem, coordinates, elements)}.items():

        def functions(block: ExtraBlock = block, name: str = name) -> list[Any]:
            b = block.build()
            return in_lanes(derivative_functions(name, b.z, b.p, b.out, b.through), b.lanes)

        groups.append(
            FunctionGroup(name=f"{robot.name}-{name}", recipe=(name, *recipe, *block.key), build=functions)
        )
    for name, (c, build) in stance_blocks(problem).items():

        def of_stance(name: str = name, build: Callable[[], BlockExpression] = build) -> list[Any]:
            b = build()
            return in_lanes(derivative_functions(name, b.z, b.p, b.out, b.through), b.lanes)

        key = name, *_coordinates_recipe(c), *((sole.frame, len(sole.polygon)) for sole in problem.soles)
        groups.append(FunctionGroup(name=f"{robot.name}-{name}", recipe=key, build=of_stance))
    return cached_groups(groups, report=report)


def _coordinates_recipe(c: StanceCoordinates) -> tuple[Any, ...]:
    """Recipe of a block beside its formula: the model, and what its legs hold how."""
    return (
        model_hash(c.robot.model, c.robot.springs),
        tuple((leg.frame, tuple(np.round(leg.placement.homogeneous.ravel(), 12))) for leg in c.legs),
        tuple(np.round(c.start, 12)) if any(leg.before.size for leg in c.legs) else (),
        tuple(tuple(o.tolist()) for leg in c.legs for o in leg.order),
    )


class Transcription(ContactProgram):
    """The program of one problem, with the parts that its solution is read from.

    nodes : beside the ends and middles of the splines' intervals.
    elements, shares : of the contact, as of `ContactSet`.

    Attributes
    ----------
    swing, follow, abort : the motions; the last one for a blow that meets nothing, if a scenario asks for it.
    follows : those after contact.
    before, after : the stance phases up to contact, and those after it, of each of `follows`.
    torques : over limit, at each node of swing and follows, if something asks for torques as variables; else
        at contact alone.
    """

    def __init__(
        self,
        problem: ImpactProblem,
        coordinates: StanceCoordinates,
        functions: dict[str, Any],
        nodes: MoreNodes = NO_MORE,
        elements: Elements = (),
        shares: Shares = (),
    ) -> None:
        b, self.nodes = Builder(problem, coordinates, functions), nodes
        before, after = range(problem.blow + 1), range(problem.blow, max(1, len(problem.stances)))
        self.before = Course(b, before, lambda begins, _: Swing(b, nodes.swing, begins), nodes)
        self.swing = cast(Swing, self.before.phases[problem.blow])
        contact = Contact(self.swing.end, *add_coasting(b))
        super().__init__(b, ContactSet(b, contact, elements, shares, after=False))
        self.after = [Course(b, after, lambda _, ends: FollowThrough(b, nodes.follow, ends=ends), nodes)]
        self.follow = cast(FollowThrough, self.after[0].phases[problem.blow])
        self.abort: AbortMotion | None = None
        if (late := problem.abort_after) is not None:
            aborted = Course(
                b,
                after,
                lambda _, ends: AbortMotion(b, nodes.follow, after=late, ends=ends),
                nodes,
                missed=True,
            )
            self.abort = cast(AbortMotion, aborted.phases[problem.blow])
            self.after.append(aborted)
        self.follows = [self.follow] if self.abort is None else [self.follow, self.abort]
        self.torques: list[Affine] = []
        self._add_motions()
        add_conditions(b, contact.state)
        add_clearance(b, self.swing, self.follow, self.hit.expected.target_state)
        self.hit.add_rows()
        self._add_links()
        if coordinates.drifts:  # after the links, which determine where the follow-through starts
            self.swing.add_momentum_rows(b)
            self.follow.add_momentum_rows(b)
        if coordinates.legs:
            y, y1, T = self.follow.start
            left = [y, y1, self.follow.legs[0], T]
            self.angular_momentum = add_balance(b, contact.state, left, self.hit.scenarios)
        self._finish(problem.active_terms, problem.objectives)

    # ------------------------------------------------------------------ for terms and objectives
    @property
    def swing_T(self) -> Group:
        """The swing's duration [s]."""
        return self.swing.T

    @property
    def swing_nodes(self) -> Array:
        """Places of the swing's nodes in it, from 0 to 1."""
        return self.swing.nodes

    @property
    def follow_nodes(self) -> Array:
        """Places of the nodes of the motions to rest in them, from 0 to 1."""
        return self.follow.nodes

    def swing_place(self, s: float) -> Place:
        """A place in the swing."""
        return self.swing.place_at(s)

    def swing_spots(self, since: float = 0.0) -> list[tuple[Place, list[Affine]]]:
        return self.swing.spots(since)

    def swing_motion(self) -> list[tuple[Place, list[Affine]]]:
        """Places of the swing's nodes with y, y', y'', legs and T [s], that y' and y'' are of."""
        return self.swing.motion()

    def follow_spots(self) -> list[tuple[Place, list[Affine]]]:
        return [spot for follow in self.follows for spot in follow.spots()]

    def torque_courses(self) -> list[TorqueCourse]:
        """Torques over limit of all motions, of a program that has them as variables."""
        return torque_courses(self.builder, self.swing, self.follows, self.torques)

    # ------------------------------------------------------------------ constraints
    def _add_motions(self) -> None:
        """One block for the nodes of all motions, and of coasting in contact; and what bounds the splines."""
        b, limits = self.builder, self.builder.limits
        instances, places = self.swing.instances()
        for follow in self.follows:
            slots, names = follow.instances()
            instances += slots
            places += names
        if self.abort is not None:
            coasting, name = self.abort.coasting_node()
            instances.append(coasting)
            places.append(name)
        outputs = add_nodes(
            b,
            instances,
            places,
            closed=int(self.abort is not None),
            fading=self.before.fading(self.problem.blow),
        )
        self._slots = instances, places
        self._add_torque_rows(places, outputs)
        joints = np.arange(self.coordinates.base, b.ny)
        b.rows.add(
            term=limits.position.name,
            place="contact",
            components=self.coordinates.labels[self.coordinates.base :],
            affine=self.contact_state[0][joints],
            lower=limits.y_lower[joints],
            upper=limits.y_upper[joints],
            measure=degrees("outside"),
        )
        self.swing.add_rate_rows(b)
        for follow in self.follows:
            follow.add_rate_rows(b)
        for course in (self.before, *self.after):
            course.add_stands()
            course.add_changes()

    @property
    def torques_lifted(self) -> bool:
        """True if the torques at the nodes are variables, as a term beside their limit needs them."""
        p = self.problem
        if self.robot.passive.any() or any(term.needs_torques for term in p.active_terms):
            return True
        return any(o.needs_torques for o in p.objectives)

    def _add_torque_rows(self, places: list[Place], outputs: list[Index]) -> None:
        """``outputs``: the torques over limit at each node."""
        b, torque_limit = self.builder, self.builder.limits.torque
        limit, names = torque_limit.fraction, self.robot.joint_names
        strong = percent("over its limit", of=limit)
        contact = len(self.swing.nodes) - 1
        for i, (place, torque) in enumerate(zip(places, outputs, strict=True)):
            if i == contact:  # there it is the variable `feedforward`, which has the limit as its bounds
                self.torques.append(self.feedforward[0])
            elif self.torques_lifted:
                group = b.lift(
                    f"torque, {place.name}",
                    torque,
                    term=torque_limit.name,
                    place=place,
                    measure=strong,
                    labels=names,
                    lower=-limit,
                    upper=limit,
                )
                self.torques.append(group[0])
            else:
                b.rows.add(
                    term=torque_limit.name,
                    place=place,
                    components=names,
                    outputs=torque,
                    lower=-limit,
                    upper=limit,
                    measure=strong,
                )
        self.hit.add_feedforward_rows(outputs[contact])

    def _add_links(self) -> None:
        """Links the motions after contact to the end of the contact, or of coasting."""
        b, hit = self.builder, self.hit
        instances = hit.expected.link(self.follow.start)
        for other in hit.scenarios:
            instances += other.link_after()
        if self.abort is not None:
            instances += self.abort.link(hit.contact)
        at = b.add_block("link", instances, np.zeros(0))
        labels, places = self.coordinates.labels, at + 3 * np.arange(b.ny)
        far, fast = along(labels, "off"), rates(labels)
        b.equal("collision starts from the swing's end", "rate", labels, places, fast)
        b.equal("follow-through starts from the predicted state", "position", labels, places + 1, far)
        b.equal("follow-through starts from the predicted state", "rate", labels, places + 2, fast)
        if self.abort is not None:
            after = places + 3 * b.ny * len(hit.collisions)
            b.equal("abort motion starts where coasting ends", "position", labels, after + 1, far)
            b.equal("abort motion starts where coasting ends", "rate", labels, after + 2, fast)
        for other in hit.scenarios:
            outputs = places + 1 + 3 * b.ny * other.number
            b.equal("state after contact", f"position{other.suffix}", labels, outputs, far)

    # ------------------------------------------------------------------ structure
    def _nodes(self) -> list[tuple[Place, Affine, list[Affine]]]:
        slots, places = self._slots
        return list(zip(places, self.torques, slots, strict=True))

    def _node_slots(self) -> list[tuple[Place, list[Affine]]]:
        slots, places = self._slots
        return list(zip(places, slots, strict=True))

    def _spring_points(self) -> list[SpringPoint]:
        if not self.robot.sprung.any():
            return []
        first = len(self.swing.nodes)
        out = swing_springs(self.builder, self.swing, self.torques[:first])
        for follow in self.follows:
            last = first + len(follow.nodes)
            out += follow_springs(follow, self.torques[first:last])
            first = last
        return out

    def _prices(self) -> Prices:
        coasting = [] if self.abort is None else [self.abort.coast_w]
        wrenches = [part.w for part in (self.swing, *self.follows, *self.hit.collisions)]
        motions, b = [self.swing, *self.follows], self.builder
        to_rest = self.follows if len(self.after[0].numbers) == 1 else []
        self._style = style_prices(b, motions, to_rest)
        prices = motion_prices(b, motions, to_rest, [*wrenches, *coasting])
        for course in (self.before, *self.after):
            for k, phase in course.stands.items():
                last = [phase] if k == len(self.problem.stances) - 1 else []
                prices = prices + motion_prices(course.builders[k], [phase], last, [phase.w])
                self._style = self._style + style_prices(course.builders[k], [phase], last)
        return prices + self._style

    def _determined(self) -> list[Determined]:
        found = [*self.swing.determined(), *self.hit.determined()]
        for follow in self.follows:
            found += follow.determined()
        for course in (self.before, *self.after):
            found += [each for phase in course.stands.values() for each in phase.determined()]
        return [*found, determined(Turn.RATE, self.u0.index(0))]

    # ------------------------------------------------------------------ solution
    def worth(self, x: Array) -> float:
        """Weighted sum of the objectives [N s], without prices, for solver variables (n,)."""
        return sum((-o.weight if o.cost else o.weight) * q.evaluate(x) for o, q in self.objectives)

    def price_shares(self, x: Array) -> tuple[float, float]:
        """Shares of the objectives that all prices on motion take, and those of its style alone, for solver
        variables (n,).
        """
        worth = self.worth(x)
        if not worth:
            return np.inf, np.inf
        return (self.program.objective(x) + worth) / abs(worth), self._style.evaluate(x) / abs(worth)

    def body_states(self, x: Array) -> list[BodyState]:
        plan, found = self.decode(x), self.swing_spots()
        begin, swing = plan.segment(0)[1], plan.swing.duration
        out = [
            BodyState(0, place.name, begin + s * swing, self.posture(x, slots))
            for s, (place, slots) in zip(self.swing.nodes, found, strict=True)
        ]
        for missed, follow in enumerate(self.follows):
            curve, begin, nodes, _ = plan.segment(2, missed=bool(missed))
            out += [
                BodyState(2 + missed, place.name, begin + s * curve.duration, self.posture(x, slots))
                for s, (place, slots) in zip(nodes, follow.spots(), strict=True)
            ]
        for missed, course in enumerate(self.after):
            out += self._stand_states(x, course, plan.pieces(missed=bool(missed)), 2 + missed)
        return out + self._stand_states(x, self.before, plan.pieces(), 0)

    def _stand_states(self, x: Array, course: Course, pieces: list[Piece], phase: int) -> list[BodyState]:
        found = iter(course.spots())
        of_number = {piece.number: piece for piece in pieces}
        return [
            BodyState(
                phase,
                place.name,
                of_number[k].start + s * of_number[k].spline.duration,
                self.posture(x, slots),
            )
            for k, stand in course.stands.items()
            for s, (place, slots) in zip(stand.nodes, found, strict=False)
        ]

    def body_spots(self) -> list[tuple[Place, list[Affine]]]:
        stands = [spot for course in (self.before, *self.after) for spot in course.spots()]
        return [*super().body_spots(), *stands]

    def travel(self, x: Array, time: Array) -> Array:
        return self.decode(x).travel(time)

    def decode(self, x: Array) -> Plan:
        """The plan that solver variables (n,) stand for."""
        abort, nodes, wrench = self.abort, self.swing.nodes, self.swing.wrenches(x)
        if nodes[0]:
            nodes = np.append(0.0, nodes)
            # that of the first node, which the torque limits allow; the reference balances it
            wrench = np.vstack([wrench[:1], wrench])
        return Plan(
            problem=self.problem,
            swing=self.swing.spline(x),
            follow=self.follow.spline(x),
            swing_nodes=nodes,
            swing_wrench=wrench,
            follow_nodes=self.follow.nodes,
            follow_wrench=self.follow.wrenches(x),
            abort=None if abort is None else abort.spline(x),
            abort_wrench=None if abort is None else abort.wrenches(x),
            coast_wrench=None if abort is None else abort.coast_w.read(x)[0],
            before=self.before.decode(x),
            after=self.after[0].decode(x),
            after_abort=self.after[-1].decode(x) if abort is not None else (),
            **self.hit.decode(x, self.program.outputs(x)),
        )


def statement_of(t: Transcription) -> str:
    """JSON summary of a program, for a reader that knows nothing of this package.

    `groups`: name, count and size of the variables, in their order. `rows`: term, place and the number of a
    list of `components`. `more`: nodes beside those of the mesh, as of `MoreNodes`. `elements`, `guarded`,
    `shares`, `shortest`: of the contact, its least durations [s] by collision. `apart`: rows between bodies.
    """
    lists: dict[tuple[str, ...], int] = {}
    rows = []
    for (term, place), found in groupby(t.rows.origins, lambda row: (row.term, row.place.name)):
        components = tuple(row.component for row in found)
        rows.append([term, place, lists.setdefault(components, len(lists))])
    collisions = [c for c in t.hit.collisions if isinstance(c, Collision)]
    # directions as they are now: begun at those of a first round, other distances than the least are found
    ways = [way.tolist() for block in t.blocks if isinstance(block, SeparationBlock) for way in block.of.ways]
    held: list[dict[str, Any]] = [
        {**row._asdict(), **kept._asdict(), "way": way}
        for (row, kept), way in zip(t.apart_rows.items(), ways, strict=True)
    ]
    return json.dumps(
        {
            "groups": [[g.name, g.count, g.size] for g in t.layout.groups.values()],
            "rows": rows,
            "components": list(lists),
            "more": [list(t.nodes.swing), list(t.nodes.follow), *map(list, t.nodes.stands)],
            "elements": t.hit.elements if collisions else [],
            "guarded": t.hit.guarded,
            "shares": list(t.hit.shares),
            "shortest": [c.shortest for c in collisions],
            "apart": held,
        }
    )
