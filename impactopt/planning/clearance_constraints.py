"""Clearance constraints that enter while a program is solved, and clearance violations of its solution.

A nonlinear program begins with clearance constraints for bodies that are near in its initial guess. Others
enter at the iterate at which their bodies come near, before these can touch: the solver stops there and
continues, at the same barrier, on the program that has them. No step is so long that bodies without a
constraint penetrate at its end, or end on the other side of each other. So bodies stay on the side of each
other on which they began.

If two bodies violate their clearance between two nodes, the program gets a node at that instant, and
constraints there as its bodies are near. During contact all its collocation points become nodes. The required
clearance at the adjacent nodes is raised instead where nodes are too dense for another one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from impactopt.arrays import Array, Mask
from impactopt.bodies.clearance import DEEPEST, MISSED, SLACK, Bodies, Places
from impactopt.bodies.robot_bodies import NEIGHBOUR_JOINTS, Pair
from impactopt.bodies.separation import ROUNDING, Looked, Placed
from impactopt.planning.budget import Budget, one_after_the_other
from impactopt.planning.refinement import Evaluation, Guess, Outcome, Program
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import KeepOut, SelfCollision
from impactopt.solvers.program import SolverResult
from impactopt.solvers.run import BarrierState
from impactopt.transcription.clearance import ClearanceKey, SeparatingDirection
from impactopt.transcription.contact_program import ContactProgram
from impactopt.transcription.layout import stack
from impactopt.transcription.mesh import MoreNodes
from impactopt.transcription.plan import COARSE_STEP, Plan
from impactopt.transcription.transcription import Transcription

Constraints = dict[ClearanceKey, SeparatingDirection]
IN_CONTACT, AFTER_CONTACT = 1, 2  # phases, as of `Places.phase`
# [m] An iterate with an unconstrained pair nearer than TRIGGER interrupts the solve. Then all pairs nearer
# than INCLUDE get constraints.
INCLUDE, TRIGGER = 0.1, 0.03
# Links with fewer than NEIGHBOUR_JOINTS joints between them are always near and can hardly meet.
INCLUDE_NEIGHBOURS, TRIGGER_NEIGHBOURS = 0.03, 0.015
# A required clearance is at most this part of the distance at the start, which so is allowed.
START_FRACTION = 0.25
START_PENETRATION_SLACK = 2e-3  # [m] further penetration allowed to pairs that penetrate at the start
# [m] The rounded support of an edge exceeds the exact one by ROUNDING log 2 (`bodies.separation`), so the
# rounded distance of two edges is less than theirs by twice as much.
EDGE_ROUNDING = 2 * np.log(2) * ROUNDING
# A step is too long if an unconstrained pair ends nearer than MIN_GAP [m] and below GAP_FRACTION of its gap.
MIN_GAP, GAP_FRACTION = 0.01, 0.5
# [m] Constrained pairs that are clear before and after a step, and penetrate deeper half way, change sides.
MAX_MIDSTEP_PENETRATION = 5e-3
_MAX_HALVINGS = 8  # of one step
_MAX_INTERRUPTIONS = 25  # of one solve


def same_bodies(one: ImpactProblem, other: ImpactProblem) -> bool:
    """True if clearance constraints have the same meaning in two problems."""
    if not (one.keeps_apart and other.keeps_apart) or one.robot is not other.robot:
        return False
    phases = ((p.swing, p.follow, *(stance.phase for stance in p.stances)) for p in (one, other))
    if len({tuple(phase and phase.grading for phase in each) for each in phases}) > 1:
        return False  # they are at other nodes
    if [body.name for body in one.bodies.world] != [body.name for body in other.bodies.world]:
        return False
    # other links may touch, or be on the ground, in another start posture
    here, there = one.bodies.shapes, other.bodies.shapes
    return np.array_equal(here.pairs, there.pairs) and np.array_equal(here.pieces, there.pieces)


class Margins:
    """Required clearance [m] of each pair of bodies of a problem.

    Attributes
    ----------
    pieces (P,) [m] : required rounded distance of each pair of pieces of `Bodies.shapes`. Rounded distances
        are less than exact ones.
    wanted (P,) : mask of the pairs for which the problem requires a clearance.
    """

    def __init__(self, problem: ImpactProblem) -> None:
        self.bodies: Bodies = problem.bodies
        self.own, self.world = problem.self_collision, problem.keep_out
        self._start = Places.of(problem.robot, problem.start_posture[None], np.zeros(1, dtype=np.intp))
        self._required: dict[Pair, float] = {}
        shapes = self.bodies.shapes
        # The second entry is a joint, or -1 - index of a body of the world.
        own = shapes.pairs[:, 1] >= 0  # both bodies are links
        self.wanted = np.where(own, self.own.enabled, self.world.enabled)
        margin = np.where(own, self.own.margin, self.world.margin)
        # A rounded distance is less than the exact one; half of a margin is kept where the margin is small.
        self.pieces = np.maximum(margin - EDGE_ROUNDING, margin / 2)
        # the margin of a pair that is farther apart than this at the start is not reduced
        reduced_within = self.most / START_FRACTION
        # No separating direction is known yet: zeros.
        no_directions = np.zeros((1, len(shapes), 3))
        near = shapes.look(self.bodies.placed(self._start), reduced_within, no_directions, self.wanted)
        exact = np.array([self.bodies.exact_piece(self._start, 0, n) for n in near.pair.tolist()])
        # Constraints are on rounded distances, which are less than the exact ones by up to ROUNDING. Required
        # clearances are reduced by the same amount, or a posture that is allowed would violate them.
        at_start = START_FRACTION * exact - np.minimum(exact - near.gap, EDGE_ROUNDING)
        # At most half of the rounded gap, so that the start is inside its own constraint. A pair in
        # penetration may stay as deep, and a little deeper. One whose rounded shapes alone penetrate may lose
        # a part of its distance: the error of rounding differs between postures.
        deeper = np.where(exact > 0, START_FRACTION * exact, START_PENETRATION_SLACK)
        at_start = np.where(near.gap > 0, np.clip(at_start, 0.0, near.gap / 2), near.gap - deeper)
        self.pieces[near.pair] = np.minimum(self.pieces[near.pair], at_start)

    @property
    def most(self) -> float:
        """Largest margin [m] of any pair."""
        return max(self.own.margin, self.world.margin)

    def term(self, pair: Pair) -> SelfCollision | KeepOut:
        """Term of the problem that requires a pair's clearance."""
        return self.own if pair[1] >= 0 else self.world

    def of(self, pair: Pair) -> float:
        """Required exact clearance [m] of a pair of bodies: the term's margin, or less if they are nearer at
        the start.
        """
        if pair not in self._required:
            at_start = self.bodies.exact(self._start, 0, pair)
            self._required[pair] = min(self.term(pair).margin, max(START_FRACTION * at_start, 0.0))
        return self._required[pair]


@dataclass(frozen=True, kw_only=True)
class NodePlacements:
    """Names and instants (K,) [s] of a program's K nodes, and the placements of the bodies there."""

    names: tuple[str, ...]
    time: Array
    at: Places


def node_placements(t: ContactProgram, x: Array) -> NodePlacements:
    """Placements of all bodies at all nodes of a program, for solver variables x (n,)."""
    states = t.body_states(x)
    phase, time = np.array([s.phase for s in states], dtype=np.intp), np.array([s.time for s in states])
    q, moved = np.array([s.q for s in states]), np.array([d.evaluate(x) for d in t.displacements])
    at = Places.of(t.robot, q, phase, moved)
    return NodePlacements(names=tuple(s.name for s in states), time=time, at=at)


class Watch:
    """Step limit and interruption of the solver (`solvers.run.Watch`) where bodies without a clearance
    constraint come near.

    Arrays over nodes and pairs of pieces are (K, P).

    Attributes
    ----------
    left : whether the last iterate that was checked lacks constraints.
    state : the solver's state when it stopped there.
    """

    def __init__(self, t: ContactProgram, margins: Margins, x: Array) -> None:
        """x (n,) : initial guess."""
        self._t, self._margins, self._shapes = t, margins, margins.bodies.shapes
        placements = node_placements(t, x)
        self._names, self._phase = placements.names, placements.at.phase
        spots = zip(t.body_spots, t.displacements, strict=True)
        lift = stack([part for (_, slots), moved in spots for part in (*slots, moved)])
        # coordinates, legs and the target's displacement at all nodes are self._lift @ x + self._const
        self._lift, self._const = lift.matrix(t.layout.n), lift.const
        shape = len(self._names), len(self._shapes)
        # separating directions (K, P, 3), zero if unknown; mask (K, P) of the pairs that have a constraint
        self._directions, self._has = np.zeros((*shape, 3)), np.zeros(shape, dtype=bool)
        number = {name: k for k, name in enumerate(self._names)}
        for key, held in t.clearance_constraints.items():
            at = number[key.place], self._shapes.index[key[1:]]
            self._has[at], self._directions[at] = True, held.vector
        neighbours = self._shapes.between < NEIGHBOUR_JOINTS
        self._include = np.where(neighbours, INCLUDE_NEIGHBOURS, INCLUDE)
        self._trigger = np.where(neighbours, TRIGGER_NEIGHBOURS, TRIGGER)
        self._x = x.copy()
        # placements and gaps at the last iterate
        self._found = self._gaps_at(self._placed(x), self._directions, None)
        # the last accepted trial: variables, directions, placements and gaps
        self._next: tuple[Array, Array, tuple[Placed, Looked]] | None = None
        self._interruptions, self.left = 0, False
        self.state: BarrierState | None = None

    def constraints(self, within: float = INCLUDE) -> Constraints:
        """New constraints for all pairs that are near at the last iterate and have none. They count as
        constrained from then on.

        within [m] : distance that is near; neighbouring links are near at a proportional part of it.
        """
        near = self._gaps_at(self._found[0], self._directions, self._found, within)[1]
        new = (near.gap < within / INCLUDE * self._include[near.pair]) & ~self._has[near.spot, near.pair]
        out = Constraints()
        for k, n in zip(near.spot[new].tolist(), near.pair[new].tolist(), strict=True):
            (joint, other), number = self._shapes.pairs[n].tolist(), int(self._shapes.number[n])
            direction, distance = self._directions[k, n].tolist(), float(self._margins.pieces[n])
            key = ClearanceKey(self._names[k], joint, other, number)
            out[key] = SeparatingDirection(tuple(direction), distance)
        # Each (instant, pair) occurs once in `near`, so that fancy assignment is safe.
        self._has[near.spot, near.pair] |= new
        self.left = False
        return out

    def leave(self, state: BarrierState) -> None:
        self.state = state

    def lacks(self, x: Array) -> bool:
        self._go_to(x)
        self.left, self.state = False, None
        # Beyond that the solve goes on without further constraints: what penetrates is found in its solution.
        if self._interruptions < _MAX_INTERRUPTIONS and self._bare(self._found[1], self._trigger).any():
            self._interruptions += 1
            self.left = True
        return self.left

    def limit(self, x: Array, step: Array, most: float) -> float:
        self._go_to(x)
        # Distances are checked at the step's end and half way, not along the step.
        here, length = self._found, most
        for _ in range(_MAX_HALVINGS):
            trial = x + length * step
            directions = self._directions.copy()
            found = self._gaps_at(self._placed(trial), directions, here)
            clear = not self._violates_clearance(here[1], found[1])
            if clear and not self._passes(x + 0.5 * length * step, here, found):
                self._next = trial, directions, found
                break
            # After the last halving the step is taken as it is, 2^-8 of the first: no step
            # at all would end the solve.
            length *= 0.5
        return length

    # ------------------------------------------------------------------ placements and gaps
    def _go_to(self, x: Array) -> None:
        """Update placements, gaps and separating directions to an iterate (n,)."""
        if np.array_equal(self._x, x):
            return
        # The solver mostly moves to the trial that `limit` accepted last: its placements are known.
        if self._next is not None and np.array_equal(self._next[0], x):
            _, self._directions, self._found = self._next
        else:
            self._found = self._gaps_at(self._placed(x), self._directions, self._found)
        self._x, self._next = x.copy(), None

    def _placed(self, x: Array) -> Placed:
        c, ny = self._t.coordinates, self._t.builder.ny
        z = (self._lift @ x + self._const).reshape(len(self._names), -1)
        q = c.join(z[:, :ny], z[:, ny:-3])
        return self._margins.bodies.placed(Places.of(self._t.robot, q, self._phase, z[:, -3:]))

    def _gaps_at(
        self, at: Placed, directions: Array, before: tuple[Placed, Looked] | None, within: float = TRIGGER
    ) -> tuple[Placed, Looked]:
        """Gaps of all pairs; updates directions in place.

        Those without a constraint are exact if less than ``within``. The others are lower bounds, by how far
        the bodies have moved, while these are positive: the program keeps such pairs apart.
        """
        exact_within = np.where(self._has, 0.0, within)
        return at, self._shapes.look(at, exact_within, directions, self._margins.wanted, before)

    # ------------------------------------------------------------------ clearance violations
    def _bare(self, found: Looked, within: Array | float) -> Mask:
        """Mask (m,) of the pairs found that are nearer than ``within`` [m], a number or (P,), and have no
        constraint.
        """
        limit = np.broadcast_to(within, len(self._shapes))[found.pair]
        return np.asarray(~self._has[found.spot, found.pair] & (found.gap < limit))

    def _violates_clearance(self, before: Looked, found: Looked) -> bool:
        """True if a step has brought bodies without a constraint too close to each other."""
        # Gaps of far pairs are lower bounds above TRIGGER, half of which is above MIN_GAP: no fall is missed.
        fell = found.gap < GAP_FRACTION * before.gaps[found.spot, found.pair]
        return bool((fell & self._bare(found, MIN_GAP)).any())

    def _passes(self, half_way: Array, one: tuple[Placed, Looked], two: tuple[Placed, Looked]) -> bool:
        """True if bodies are clear before and after a step, but penetrate each other half way, at variables
        (n,).
        """
        clear = (one[1].gaps > 0) & (two[1].gaps > 0)
        allowed = np.where(self._has, -MAX_MIDSTEP_PENETRATION, 0.0)
        within, directions = np.where(clear, allowed, -np.inf), self._directions.copy()
        found = self._shapes.look(self._placed(half_way), within, directions, self._margins.wanted, one)
        return len(found.spot) > 0


def solve_with_clearance(budget: Budget, margins: Margins | None, guess: Guess[Program]) -> Outcome[Program]:
    """Outcome of a program with clearance constraints for all bodies that come near in its initial guess or
    in an iterate.

    margins : None to solve the program as it is.
    """
    t, start = guess.program, guess.warm or guess.x
    if margins is None:
        return Outcome.of(t, budget.run(t.program, start, guess.barrier, guess.most), guess)
    watch = Watch(t, margins, guess.x)
    t, start = _with_near_pairs(t, watch, start)
    result = budget.run(t.program, start, guess.barrier, guess.most, watch=watch)
    # only the interior-point method calls the watch during the solve; other solvers' results are checked here
    while watch.left or (not budget.interior and result.status.usable and watch.lacks(result.x)):
        last, before, state = result, t, watch.state
        t, start = _with_near_pairs(t, watch, last)
        if state is not None:
            state = replace(
                state, constraints=_by_constraint(state.constraints, before, t, np.nan)
            )  # NaN: a new slack
        new = budget.run(t.program, start, None, guess.most, watch=watch, state=state)
        result = one_after_the_other(last, new)
    return Outcome.of(t, result, guess)


def _with_near_pairs(
    t: Program, watch: Watch, start: Array | SolverResult
) -> tuple[Program, Array | SolverResult]:
    """The program with constraints for pairs that are near, and its initial guess or warm start."""
    constraints = watch.constraints()
    if not constraints:
        return t, start
    new = t.with_clearance({**t.clearance_constraints, **constraints})
    if isinstance(start, SolverResult):
        start = replace(start, multipliers=_by_constraint(start.multipliers, t, new, 0.0))
    return new, start


def _by_constraint(values: Array, old: ContactProgram, new: ContactProgram, fill: float) -> Array:
    """Values of a program's constraints (m,), for a program with more clearance constraints.

    Clearance constraints come last, and a new one may come between the old ones.
    fill : value of the new constraints.
    """
    others = len(values) - len(old.clearance_constraints)
    known = dict(zip(old.clearance_constraints, values[others:].tolist(), strict=True))
    return np.append(values[:others], [known.get(key, fill) for key in new.clearance_constraints])


# parts of a margin that a solution may lose without a violation: between nodes, and at them
LOST_BETWEEN_NODES, LOST_AT_NODES = 0.5, 0.25
MAX_RAISE = 0.02  # [m] of the clearance required at a node, in one round
# [m] only pieces of a pair that are nearer than its nearest two plus this get a raised clearance
RAISED_WITHIN = 0.01
MIN_NODE_INTERVAL = 2e-3  # [s] between a new node and its neighbours
END_FRACTION = 0.2  # of the interval of two nodes: a new one stays so far from either


class ClearanceViolations(NamedTuple):
    """Clearance violations of a solution, and the additions to its program that they require.

    constraints : to replace the program's own of the same keys.  nearest [m] : least distance of the bodies
    that violate their clearance.  nodes : all further nodes of the program, those to add included.
    """

    constraints: Constraints
    nearest: Mapping[Pair, float]
    nodes: MoreNodes

    @property
    def depth(self) -> float:
        """Deepest penetration [m], negative if there is none."""
        return -min(self.nearest.values())


class _Approach(NamedTuple):
    """Closest approach of two bodies between two nodes: distance [m], time [s], and whether it is of the
    motion that misses the target.
    """

    distance: float
    time: float
    missed: bool


def clearance_violations(solution: Evaluation[Transcription], margins: Margins) -> ClearanceViolations | None:
    """Clearance violations of a solution, at its nodes or between them; None if there are none."""
    t, plan, bodies = solution.program, solution.planned, margins.bodies
    approaches = list[tuple[Pair, _Approach]]()
    # The motion after a missed target exists only with an abort motion.
    for missed in (False, True) if plan.abort is not None else (False,):
        # the coarse references: loads and the replay of the contact use them, too
        reference = plan.coarse_missed_reference if missed else plan.coarse_reference
        motion = plan.motion(reference, step=COARSE_STEP, missed=missed)
        phase = np.where(missed, MISSED, motion.phase)
        at = Places.of(t.robot, motion.q, phase, motion.displacement)
        approaches += [
            (pair, _Approach(distance, float(motion.time[k]), missed))
            for k, pair, distance in _near(margins, at, LOST_BETWEEN_NODES)
        ]
    if not approaches:
        return None
    nodes, worst = node_placements(t, solution.x), dict[tuple[tuple[int, ...], Pair], _Approach]()
    for pair, approach in approaches:
        # One node for all instants of an interval: the deepest of a pair counts.
        key = tuple(_adjacent_nodes(nodes, approach.time, approach.missed)), pair
        worst[key] = min(worst.get(key, approach), approach)
    raised, added = _RaisedClearances(t, nodes, margins), _AddedNodes(t, plan)
    # The deepest first: its node may serve the others of the interval.
    for (adjacent, pair), approach in sorted(worst.items(), key=lambda item: item[1].distance):
        allowed = (1 - LOST_AT_NODES) * margins.of(pair) + DEEPEST
        at_nodes = [k for k in adjacent if bodies.exact(nodes.at, k, pair) < allowed]
        if at_nodes:  # the pair is near there, so the node has a constraint for it in the next solve
            raised.add(at_nodes, pair, approach.distance)
            continue
        # A violation between nodes needs a node: constraints at the adjacent nodes are met already. Their
        # clearance is raised only if no node fits. Normals that turn round from one node to the next mean
        # that one body passes through the other.
        normals = [bodies.closest(nodes.at, k, pair).normal for k in adjacent]
        if not added.add(approach, bool(normals[0] @ normals[-1] < 0)):
            raised.add(adjacent, pair, approach.distance)
    # the nearest approach of a pair last: it stays in the table
    nearest = {pair: near.distance for pair, near in sorted(approaches, key=lambda a: -a[1].distance)}
    return ClearanceViolations(raised.constraints, nearest, added.all)


def deepest_penetration(t: ContactProgram, x: Array, margins: Margins) -> tuple[float, list[Pair]]:
    """Deepest penetration [m] at a program's nodes, < 0 if there is none, and the pairs that penetrate."""
    touching = list(_near(margins, node_placements(t, x).at, 1.0))
    return max((-distance for _, _, distance in touching), default=-np.inf), [pair for _, pair, _ in touching]


def _near(margins: Margins, at: Places, share: float) -> list[tuple[int, Pair, float]]:
    """Instants and pairs that lose more than a share of their margin, with their exact distances [m]."""
    bodies, shapes, out = margins.bodies, margins.bodies.shapes, list[tuple[int, Pair, float]]()
    directions = np.zeros((len(at), len(shapes), 3))

    def allowed(pair: Pair) -> float:
        return (1 - share) * margins.of(pair) + DEEPEST

    # Smooth distances may exceed the exact ones by the thinning; what is near by them is checked exactly.
    within = (1 - share) * margins.most + DEEPEST + SLACK
    found = shapes.look(bodies.placed(at), within, directions, margins.wanted)
    places = zip(found.spot.tolist(), map(tuple, shapes.pairs[found.pair].tolist()), found.gap, strict=True)
    candidates = {(k, pair) for k, pair, gap in places if gap < allowed(pair) + SLACK}
    for k, pair in sorted(candidates):
        distance = bodies.exact(at, k, pair)
        if distance < allowed(pair):
            out.append((k, pair, distance))
    return out


class _RaisedClearances:
    """Constraints of a program with a larger required distance than they have."""

    def __init__(self, t: ContactProgram, nodes: NodePlacements, margins: Margins) -> None:
        self._t, self._nodes, self._margins, self.constraints = t, nodes, margins, Constraints()
        shapes = margins.bodies.shapes
        directions = np.zeros((len(nodes.names), len(shapes), 3))
        self._gaps = shapes.look(margins.bodies.placed(nodes.at), np.inf, directions, margins.wanted).gaps

    def add(self, adjacent: Sequence[int], pair: Pair, distance: float) -> None:
        """Raise the required clearance of two bodies at these nodes by what their distance [m] lacks."""
        missing, index = min(self._margins.of(pair) - distance, MAX_RAISE), self._margins.bodies.shapes.index
        for k in adjacent:
            own = {
                key: held
                for key, held in self._t.clearance_constraints.items()
                if key[:3] == (self._nodes.names[k], *pair)
            }
            gaps = {key: float(self._gaps[k, index[key[1:]]]) for key in own}
            nearest = min(gaps.values(), default=0.0)
            for key, held in own.items():
                if gaps[key] < nearest + RAISED_WITHIN:
                    raised = self.constraints.get(key, held).least_distance
                    least = max(held.least_distance, raised, nearest + missing)
                    self.constraints[ClearanceKey(*key)] = held._replace(least_distance=least)


class _AddedNodes:
    """Further nodes of a program, inside its mesh intervals: those that it has and those to add."""

    def __init__(self, t: Transcription, plan: Plan) -> None:
        # fractions of the phase's duration (0 to 1), by phase: before contact (0), and after it
        self._plan, self._fractions = plan, {0: set(t.nodes.swing), AFTER_CONTACT: set(t.nodes.follow)}
        self._known, self._contact = t.nodes, t.nodes.contact

    @property
    def all(self) -> MoreNodes:
        swing, follow = self._fractions[0], self._fractions[AFTER_CONTACT]
        return MoreNodes(tuple(sorted(swing)), tuple(sorted(follow)), self._known.stands, self._contact)

    def add(self, approach: _Approach, jumps: bool) -> bool:
        """Add a node at an instant, or as near to it as other nodes allow.

        jumps : bodies change sides between the nodes; the new one gets one more on either side.
        An instant in contact gets all collocation points as nodes.

        Returns False if there is no room for a node: the neighbours are too close to each other, or the
        collocation points are nodes already.
        """
        for phase, fractions in self._fractions.items():
            curve, begin, nodes, _ = self._plan.segment(phase, missed=approach.missed)
            fraction = (approach.time - begin) / curve.duration
            if not 0.0 < fraction < 1.0 or (approach.missed and not phase):
                continue
            k = int(np.clip(np.searchsorted(nodes, fraction), 1, len(nodes) - 1))
            first, last = float(nodes[k - 1]), float(nodes[k])
            span = (last - first) * curve.duration
            if span < 2 * MIN_NODE_INTERVAL:
                return False
            if not any(first < s < last for s in fractions):  # not added for another pair yet
                inner = END_FRACTION * (last - first)
                fraction = float(np.clip(fraction, first + inner, last - inner))
                both = [(first + fraction) / 2, (fraction + last) / 2]
                sides = both if jumps and span > 4 * MIN_NODE_INTERVAL else []
                fractions.update(round(s, 4) for s in (fraction, *sides))
            return True
        in_contact = self._plan.contact_start < approach.time < self._plan.contact_end
        room = in_contact and not approach.missed and not self._known.contact
        self._contact |= room
        return room


def _adjacent_nodes(nodes: NodePlacements, time: float, missed: bool) -> list[int]:
    """Indices of the nodes before and after a time [s] of the motion, or of the one that misses the
    target.
    """
    others = (IN_CONTACT, AFTER_CONTACT) if missed else (MISSED,)
    of_motion = ~np.isin(nodes.at.phase, others)
    # The two motions after contact overlap in time: the nodes of one of them are searched.
    order = np.flatnonzero(of_motion)[np.argsort(nodes.time[of_motion], kind="stable")]
    k = int(np.searchsorted(nodes.time[order], time))
    return [int(order[j]) for j in sorted({max(k - 1, 0), min(k, len(order) - 1)})]
