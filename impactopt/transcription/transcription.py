"""Transcription of an impact problem to a nonlinear program (NLP), and of its solution to a plan.

Phases: swing (rest to contact), contact (compression and restitution), follow-through (from the predicted
state after contact to rest). Swing and follow-through are cubic splines in the independent coordinates, with
legs and sole wrenches as variables of their nodes. The contact phases are Radau IIA collocation, with their
durations as variables.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property, partial
from itertools import groupby
from typing import Any, cast

import numpy as np

from impactopt.arrays import Array, Index
from impactopt.codegen.cache import FunctionGroup, cached_groups, model_hash
from impactopt.contact.friction import moves_target
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.kinematics.stance import support_polygon
from impactopt.problem.block import BlockExpression
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.violation import Place, degrees, percent
from impactopt.solvers.program import Determined
from impactopt.transcription.blocks import ExtraBlock, extra_blocks, own_blocks, stance_blocks
from impactopt.transcription.builder import Builder
from impactopt.transcription.clearance import SeparationBlock, TargetDisplacement
from impactopt.transcription.collision import Collision
from impactopt.transcription.contact_conditions import add_balance, add_clearance, add_conditions
from impactopt.transcription.contact_program import BodyState, ContactProgram
from impactopt.transcription.contact_set import ContactSet
from impactopt.transcription.contact_state import Contact, add_coasting
from impactopt.transcription.layout import Affine, Group, Turn, along, determined, rates
from impactopt.transcription.mesh import NO_MORE, Elements, MoreNodes, Shares
from impactopt.transcription.motion_phase import AbortMotion, FollowThrough, Swing, add_nodes
from impactopt.transcription.objective import Prices, assemble, cost_of_motion, motion_prices
from impactopt.transcription.plan import Piece, Plan
from impactopt.transcription.simd import in_lanes
from impactopt.transcription.springs import (
    SpringPoint,
    TorqueProfile,
    follow_springs,
    swing_springs,
    torque_profiles,
)
from impactopt.transcription.stance_change import PhaseSequence
from impactopt.transcription.structured import derivative_functions

USER_PREFIX = "user_"  # of users' blocks in C, which has functions of its own, such as floor
SECOND_BLOCKS = ("second_contact", "second_approach")


def block_functions(
    problem: ImpactProblem,
    report: Callable[[str], None] | None = None,
    elements: Elements = (),
) -> dict[str, Any]:
    """The compiled blocks (value, Jacobian, Hessian) of a problem; from the cache, if they are in it.

    elements : of the contact, if not the problem's; the block of the peak force depends on them.
    """
    robot, coordinates = problem.robot, problem.coordinates
    edges = len(support_polygon(robot, coordinates))
    # `recipe` has what shapes every block, and `keys` what shapes single ones besides: the key of the cache
    recipe = (*_coordinates_recipe(coordinates), problem.striker, edges)
    target = problem.target
    frozen = () if problem.frozen is None else (problem.frozen,)
    contact = (problem.law.formula(), target.formula(), target.typical_state, *frozen)
    springs = tuple(np.flatnonzero(robot.sprung).tolist())
    second = () if problem.second is None else (problem.second.striker,)
    rubs = () if problem.friction is None else ("rubs", len(problem.friction.parameters))
    moves = ("moves",) if moves_target(problem.friction) else ()
    keys = {"force": (*contact, *second), "first": (*contact[:1], *rubs), "coasting": frozen}
    keys |= {"collision": (*frozen, *springs, *second, *rubs, *moves), **dict.fromkeys(SECOND_BLOCKS, second)}
    if chosen := problem.gain_joints:
        keys |= {name: (*keys.get(name, ()), chosen) for name in ("collision", "spring")}
    found = {
        name: ExtraBlock(keys.get(name, ()), build) for name, build in own_blocks(problem, edges).items()
    }
    found |= extra_blocks(problem, elements)
    blocks = [
        (f"{USER_PREFIX}{name}" if block.user else name, (*recipe, *block.key), block.build)
        for name, block in found.items()
    ]
    soles = [(sole.frame, len(sole.polygon)) for sole in problem.soles]
    blocks += [
        (name, (*_coordinates_recipe(c), *soles), build)
        for name, (c, build) in stance_blocks(problem).items()
    ]
    groups = [
        FunctionGroup(
            name=f"{robot.name}-{name}", recipe=(name, *key), build=partial(_functions, name, build)
        )
        for name, key, build in blocks
    ]
    functions = cached_groups(groups, report=report)
    return {name.removeprefix(USER_PREFIX): function for name, function in functions.items()}


def _functions(name: str, build: Callable[[], BlockExpression]) -> list[Any]:
    """Value, Jacobian and Hessian of a block, for several instances at once."""
    b = build()
    return in_lanes(derivative_functions(name, b.z, b.p, b.out, b.through), b.lanes)


def _coordinates_recipe(c: StanceCoordinates) -> tuple[Any, ...]:
    """Part of a block's cache key: robot model, and the frames and placements of the closed legs.

    Placements are rounded, so that rounding errors of a stance compile nothing anew.
    """
    return (
        model_hash(c.robot.model, c.robot.springs),
        tuple((leg.frame, tuple(np.round(leg.placement.homogeneous.ravel(), 12))) for leg in c.legs),
        tuple(np.round(c.start, 12)) if any(leg.before.size for leg in c.legs) else (),
        tuple(tuple(o.tolist()) for leg in c.legs for o in leg.order),
    )


class Transcription(ContactProgram):
    """NLP of a whole motion, and the parts that its solution is decoded from.

    nodes : nodes in addition to the ends and middles of the splines' intervals.
    elements, shares : of the contact, as of `ContactSet`.

    Attributes
    ----------
    swing, follow, abort : the motions; `abort` is None unless a scenario requires an abort motion.
    follows : the motions after contact.
    before, after : sequence of stance phases up to contact, and those after it, one for each of `follows`.
    torques : over limit (n,), at each node of the swing and of `follows` if a term or an objective needs
        torques as variables, else at contact only.
    """

    def __init__(
        self,
        problem: ImpactProblem,
        functions: dict[str, Any],
        nodes: MoreNodes = NO_MORE,
        elements: Elements = (),
        shares: Shares = (),
    ) -> None:
        b, self.nodes = Builder(problem, functions), nodes
        # The phase with the impact is in both: its swing ends the first sequence, its follow-through begins
        # the second.
        before, after = range(problem.blow + 1), range(problem.blow, max(1, len(problem.stances)))
        self.before = PhaseSequence(b, before, lambda begins, _: Swing(b, nodes.swing, begins), nodes)
        self.swing = cast(Swing, self.before.phases[problem.blow])
        contact = Contact(self.swing.end, *add_coasting(b))
        super().__init__(b, ContactSet(b, contact, elements, shares, after=False, lifted=nodes.contact))
        self.after = [
            PhaseSequence(b, after, lambda _, ends: FollowThrough(b, nodes.follow, ends=ends), nodes)
        ]
        self.follow = cast(FollowThrough, self.after[0].phases[problem.blow])
        self.abort: AbortMotion | None = None
        if (late := problem.abort_after) is not None:
            aborted = PhaseSequence(
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
        self.hit.add_constraints()
        self._add_links()
        # after the links, whose constraints determine the start of the follow-through
        if problem.coordinates.drifts:
            self.swing.add_momentum_conservation(b)
            self.follow.add_momentum_conservation(b)
        if b.coordinates.legs:
            y, y1, T = self.follow.start
            separation = [y, y1, self.follow.legs[0], T]
            self.angular_momentum = add_balance(b, contact.state, separation, self.hit.scenarios)
        self._finish(problem.active_terms, problem.objectives)

    # ------------------------------------------------------------------ for terms and objectives
    @property
    def swing_T(self) -> Group:
        """The swing's duration [s]."""
        return self.swing.T

    @property
    def swing_nodes(self) -> Array:
        """Nodes of the swing, fractions of it."""
        return self.swing.nodes

    @property
    def follow_nodes(self) -> Array:
        """Nodes of the motions to rest, fractions of these."""
        return self.follow.nodes

    def swing_place(self, s: float) -> Place:
        """Place of fraction s of the swing, for messages."""
        return self.swing.place_at(s)

    def swing_spots(self, since: float = 0.0) -> list[tuple[Place, list[Affine]]]:
        return self.swing.spots(since)

    def motion(self) -> list[tuple[Place, list[Affine]]]:
        """Nodes of swing, follow-through and abort motion, as of `MotionPhase.motion`."""
        return [spot for phase in (self.swing, *self.follows) for spot in phase.motion()]

    def third_derivatives(self) -> list[tuple[Place, list[Affine]]]:
        """Intervals of swing, follow-through and abort motion, as of `MotionPhase.third_derivatives`."""
        return [part for phase in (self.swing, *self.follows) for part in phase.third_derivatives()]

    def follow_spots(self) -> list[tuple[Place, list[Affine]]]:
        return [spot for follow in self.follows for spot in follow.spots()]

    def torque_profiles(self) -> list[TorqueProfile]:
        """Torques over limit of all motions; the program must have them as variables."""
        return torque_profiles(self.builder, self.swing, self.follows, self.torques)

    # ------------------------------------------------------------------ constraints
    def _add_motions(self) -> None:
        """Adds one block for the nodes of all motions and the end of coasting, and bounds of the splines."""
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
        self._add_torque_limits(places, outputs)
        joints = np.arange(self.coordinates.base, b.ny)
        # the swing's last control point is no variable, so its position limits are no bounds of variables
        b.constraints.add(
            term=limits.position.name,
            place="contact",
            components=self.coordinates.labels[self.coordinates.base :],
            affine=self.contact_state[0][joints],
            lower=limits.y_lower[joints],
            upper=limits.y_upper[joints],
            measure=degrees("outside"),
        )
        self.swing.add_rate_limits(b)
        for follow in self.follows:
            follow.add_rate_limits(b)
        for sequence in (self.before, *self.after):
            sequence.add_stands()
            sequence.add_changes()

    @property
    def torques_lifted(self) -> bool:
        """True if torques at the nodes are variables, because more than the torque limit needs them."""
        p = self.problem
        if self.robot.passive.any() or any(term.needs_torques for term in p.active_terms):
            return True
        return any(o.needs_torques for o in p.objectives)

    def _add_torque_limits(self, places: list[Place], outputs: list[Index]) -> None:
        """Adds torque limits.  outputs : for each node, indices (n,) of its torques among block outputs."""
        b, torque_limit = self.builder, self.builder.limits.torque
        limit, names = torque_limit.fraction, self.robot.joint_names
        strong = percent("over its limit", of=limit)
        contact = len(self.swing.nodes) - 1
        for i, (place, torque) in enumerate(zip(places, outputs, strict=True)):
            if i == contact:  # the torque is the variable `feedforward`, whose bounds are the limit
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
                b.constraints.add(
                    term=torque_limit.name,
                    place=place,
                    components=names,
                    outputs=torque,
                    lower=-limit,
                    upper=limit,
                    measure=strong,
                )
        self.hit.add_feedforward_constraints(outputs[contact])

    def _add_links(self) -> None:
        """Adds constraints that link motions after contact to the end of the contact, or of coasting.

        An instance of the block ``link`` has three outputs for each coordinate: the rate at contact, then
        position and rate after contact.
        """
        b, hit = self.builder, self.hit
        instances = hit.expected.link(self.follow.start)
        for other in hit.scenarios:
            instances += other.link_after()
        if self.abort is not None:
            instances += self.abort.link(hit.contact)
        at_stages = 3 * len(instances)
        instances += hit.expected.link_positions() if isinstance(hit.expected, Collision) else []
        at = b.add_block("link", instances, np.zeros(0))
        labels, first = self.coordinates.labels, at + 3 * np.arange(b.ny)
        far, fast = along(labels, "off"), rates(labels)
        b.equal("collision starts from the swing's end", "rate", labels, first, fast)
        b.equal("follow-through starts from the predicted state", "position", labels, first + 1, far)
        b.equal("follow-through starts from the predicted state", "rate", labels, first + 2, fast)
        if self.abort is not None:
            # instances: expected collision, scenarios by number, abort motion; three outputs for each
            # coordinate
            after = first + 3 * b.ny * len(hit.collisions)
            b.equal("abort motion starts where coasting ends", "position", labels, after + 1, far)
            b.equal("abort motion starts where coasting ends", "rate", labels, after + 2, fast)
        for other in hit.scenarios:
            outputs = first + 1 + 3 * b.ny * other.number
            b.equal("state after contact", f"position{other.suffix}", labels, outputs, far)
        for i, (place, _) in enumerate(self._contact_spots):
            outputs = first + 1 + at_stages + 3 * b.ny * i
            b.equal("position in contact", place, labels, outputs, far)

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
        motions, b, style = [self.swing, *self.follows], self.builder, self.problem.style_prices
        # the price of coming to rest is on the last stance phase: the follow-through, if none comes after it
        to_rest = self.follows if len(self.after[0].numbers) == 1 else []
        self._style = cost_of_motion(b, style, motions, to_rest)
        prices = motion_prices(b, motions, to_rest, [*wrenches, *coasting])
        for sequence in (self.before, *self.after):
            for k, phase in sequence.stands.items():
                last = [phase] if k == len(self.problem.stances) - 1 else []
                prices = prices + motion_prices(sequence.builders[k], [phase], last, [phase.w])
                self._style = self._style + cost_of_motion(sequence.builders[k], style, [phase], last)
        return prices + self._style

    def _determined(self) -> list[Determined]:
        found = [*self.swing.determined(), *self.hit.determined()]
        for follow in self.follows:
            found += follow.determined()
        for sequence in (self.before, *self.after):
            found += [each for phase in sequence.stands.values() for each in phase.determined()]
        return [*found, determined(Turn.RATE, self.u0.index(0))]

    # ------------------------------------------------------------------ solution
    def objective_sum(self, x: Array) -> float:
        """Weighted sum of the objectives [N s] at solver variables x (n,), without prices."""
        return sum((-o.weight if o.cost else o.weight) * q.evaluate(x) for o, q in self.objectives)

    def repriced(self, scale: float) -> Transcription:
        """The same program with another `ImpactProblem.price_scale`."""
        other = copy.copy(self)
        other.problem = replace(self.problem, price_scale=scale)
        other._objective = assemble(other.layout, other.objectives, other._prices())
        other._base = None  # it has the old prices
        return other.with_clearance(self.clearance_constraints)

    def price_shares(self, x: Array) -> tuple[float, float]:
        """Prices of the motion over the objectives' sum, at solver variables x (n,): all, and style only."""
        total = self.objective_sum(x)
        if not total:
            return np.inf, np.inf
        # the program minimizes prices minus the sum
        return (self.program.objective(x) + total) / abs(total), self._style.evaluate(x) / abs(total)

    def body_states(self, x: Array) -> list[BodyState]:
        plan, found = self.decode(x), self.swing_spots()
        begin, swing = plan.segment(0)[1], plan.swing.duration
        out = [
            BodyState(0, place.name, begin + s * swing, self.posture(x, slots))
            for s, (place, slots) in zip(self.swing.nodes, found, strict=True)
        ]
        out += [
            BodyState(1, place.name, plan.contact_start + float(since), self.posture(x, slots))
            for since, (place, slots) in zip(plan.collision.time[1:], self._contact_spots, strict=False)
        ]
        for missed, follow in enumerate(self.follows):
            curve, begin, nodes, _ = plan.segment(2, missed=bool(missed))
            out += [
                BodyState(2 + missed, place.name, begin + s * curve.duration, self.posture(x, slots))
                for s, (place, slots) in zip(nodes, follow.spots(), strict=True)
            ]
        out += self._stand_states(x, self.before, plan.pieces(), 0)
        for missed, sequence in enumerate(self.after):
            out += self._stand_states(x, sequence, plan.pieces(missed=bool(missed)), 2 + missed)
        return out

    def _stand_states(
        self, x: Array, sequence: PhaseSequence, pieces: list[Piece], phase: int
    ) -> list[BodyState]:
        """States of the phases without the impact."""
        found = iter(sequence.spots())  # of all these phases; each takes as many as it has nodes
        of_number = {piece.number: piece for piece in pieces}
        return [
            BodyState(
                phase,
                place.name,
                of_number[k].start + s * of_number[k].spline.duration,
                self.posture(x, slots),
            )
            for k, stand in sequence.stands.items()
            for s, (place, slots) in zip(stand.nodes, found, strict=False)
        ]

    @cached_property
    def body_spots(self) -> list[tuple[Place, list[Affine]]]:
        stands = [spot for sequence in (self.before, *self.after) for spot in sequence.spots()]
        return [*self.swing_spots(), *self._contact_spots, *self.follow_spots(), *stands]

    @property
    def _contact_spots(self) -> list[tuple[Place, list[Affine]]]:
        expected = self.hit.expected
        return expected.spots() if isinstance(expected, Collision) else []

    def _displacements(self, target: TargetDisplacement) -> list[Affine]:
        swing, none = self.swing.T[0], Affine.zeros(3)
        out = [target.before(swing * (1 - s)) for s in self.swing.nodes]
        out += [target.in_contact(i, place) for i, (place, _) in enumerate(self._contact_spots)]
        for follow in self.follows:
            out += [
                none if follow is self.abort else target.after(follow.T[0] * s if s else None, place)
                for s, (place, _) in zip(follow.nodes, follow.spots(), strict=True)
            ]
        out += [target.before(T) for T in self.before.times_from_contact()]
        after, *missed = self.after
        spots = zip(after.times_from_contact(), after.spots(), strict=True)
        out += [target.after(T, place) for T, (place, _) in spots]
        return out + [none for sequence in missed for _ in sequence.spots()]

    def decode(self, x: Array) -> Plan:
        """The plan of solver variables x (n,)."""
        abort, nodes, wrench = self.abort, self.swing.nodes, self.swing.wrenches(x)
        if nodes[0]:
            # A swing from rest has no node at its start: the first node's wrench, which respects the torque
            # limits, holds there too, and the reference corrects it to balance the robot.
            nodes = np.append(0.0, nodes)
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
    """JSON summary of a program, which a reader understands without this package.

    `groups`: name, count and size of the groups of variables, in their order. `constraints`: by term, place
    and the index of a list in `components`. `added_nodes`, `nodes_in_contact`: beside the mesh's own, as of
    `MoreNodes`.
    `elements`, `guarded`, `shares`, `shortest`: of the contact; its least durations [s] by collision.
    `clearance`: fields of `ClearanceKey` and `SeparatingDirection`.
    """
    component_lists: dict[tuple[str, ...], int] = {}  # each list once, with its index
    constraints = []
    for (term, place), found in groupby(
        t.constraints.origins, lambda origin: (origin.term, origin.place.name)
    ):
        components = tuple(origin.component for origin in found)
        constraints.append([term, place, component_lists.setdefault(components, len(component_lists))])
    collisions = [c for c in t.hit.collisions if isinstance(c, Collision)]
    # Separating directions at the solution. An evaluation that starts from those of an earlier round may find
    # a local maximum of the separation, which is not the distance.
    directions = [
        d.tolist() for block in t.blocks if isinstance(block, SeparationBlock) for d in block.of.directions
    ]
    clearance: list[dict[str, Any]] = [
        {**constraint._asdict(), **held._asdict(), "vector": direction}
        for (constraint, held), direction in zip(t.clearance_constraints.items(), directions, strict=True)
    ]
    return json.dumps(
        {
            "groups": [[g.name, g.count, g.size] for g in t.layout.groups.values()],
            "constraints": constraints,
            "components": list(component_lists),
            "added_nodes": [list(t.nodes.swing), list(t.nodes.follow), *map(list, t.nodes.stands)],
            "nodes_in_contact": t.nodes.contact,
            "elements": t.hit.elements if collisions else [],
            "guarded": t.hit.guarded,
            "shares": list(t.hit.shares),
            "shortest": [c.shortest for c in collisions],
            "clearance": clearance,
        }
    )
