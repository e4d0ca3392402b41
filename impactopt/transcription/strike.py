"""NLP of an impact alone: the state at contact and the collision.

Without swing and follow-through it has a fraction of a whole motion's variables. Its optimum bounds that of
the motion, and is an initial guess for it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp

from impactopt.arrays import Array
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.violation import Measure, Place
from impactopt.solvers.program import Determined
from impactopt.transcription.builder import Builder
from impactopt.transcription.clearance import TargetDisplacement
from impactopt.transcription.collision import Collision
from impactopt.transcription.contact_conditions import add_balance, add_conditions
from impactopt.transcription.contact_program import BodyState, ContactProgram
from impactopt.transcription.contact_set import ContactSet
from impactopt.transcription.contact_state import Contact, ContactState, add_coasting
from impactopt.transcription.layout import Affine, along, by_leg, rates
from impactopt.transcription.mesh import Elements, Shares
from impactopt.transcription.motion_phase import add_nodes, at_node
from impactopt.transcription.objective import Prices, wrench_prices
from impactopt.transcription.plan import PlannedStrike, total_ground_wrench


class StrikeTranscription(ContactProgram):
    """NLP of a problem's impact, and the groups that its solution is decoded from.

    It has the problem's terms and objectives, except those of a whole motion only.
    elements, shares : of the contact, as of `ContactSet`.
    """

    def __init__(
        self,
        problem: ImpactProblem,
        functions: dict[str, Any],
        elements: Elements = (),
        shares: Shares = (),
    ) -> None:
        b, c = Builder(problem, functions), problem.coordinates
        add, limits = b.layout.add, b.limits
        self.y = add("posture at contact", 1, b.ny, **limits.of_y)
        self.legs = add("legs at contact", 1, b.nl, **limits.of_legs)
        self.w = add("sole wrench at contact", 1, b.nw, **limits.of_wrenches)
        # the base has no rate limit of its own
        fastest = np.full(b.ny, np.inf)
        fastest[c.base :] = limits.rate_limit[c.independent]
        coasting = add_coasting(b, {"lower": -fastest, "upper": fastest, "measure": rates(c.labels)})
        # T = 1 s, so that y' is the rate; no acceleration, as at the end of a swing
        still, one = Affine.zeros(b.ny), Affine.constant(1.0)
        state = ContactState(self.y[0], coasting.u0[0], still, one, self.legs[0], self.w[0])
        super().__init__(b, ContactSet(b, Contact(state, *coasting), elements, shares, after=True))
        node = [state.y, state.y1, state.y2, state.legs, state.w, state.T]
        (torque,) = add_nodes(b, [node], ["contact"])
        self._node = node
        self.hit.add_feedforward_constraints(torque)
        add_conditions(b, state)
        self.hit.add_constraints()
        self._add_after(fastest)
        if c.legs:
            after = self.expected.state_after
            self.angular_momentum = add_balance(b, state, after, self.hit.scenarios)
        self._finish(
            tuple(term for term in problem.active_terms if not term.whole_motion),
            tuple(o for o in problem.objectives if not o.whole_motion),
        )

    def _nodes(self) -> list[tuple[Place, Affine, list[Affine]]]:
        return [(Place.plain("contact"), self.feedforward[0], self._node)]

    def _node_slots(self) -> list[tuple[Place, list[Affine]]]:
        return [(Place.plain("contact"), self._node)]

    def _determined(self) -> list[Determined]:
        return [*at_node([*by_leg(self.legs.index(0)), self.w.index(0)[:6]]), *self.hit.determined()]

    def _add_after(self, fastest: Array) -> None:
        """Adds the position after each collision as a variable, and rate limits after the expected one.

        fastest (ny,) : rate limits.  Of the three outputs a coordinate of the block ``link``, the second is
        the position's equation.
        """
        b, labels, far = self.builder, self.coordinates.labels, along(self.coordinates.labels, "off")
        hits = [hit for hit in self.hit.collisions if isinstance(hit, Collision)]
        if hits:
            at = b.add_block("link", [slots for hit in hits for slots in hit.link_after()], np.zeros(0))
            for k, hit in enumerate(hits):
                outputs = at + 3 * (k * b.ny + np.arange(b.ny)) + 1
                b.equal("state after contact", f"position{hit.suffix}", labels, outputs, far)
        b.constraints.add(
            term=b.limits.velocity.name,
            place="after contact",
            components=labels,
            affine=self.expected.state_after[1],
            lower=-fastest,
            upper=fastest,
            measure=Measure("rad/s", 1.0, "too fast"),
        )

    def _prices(self) -> Prices:
        """Prices of sole wrenches, and of the least accelerations from rest to the state at contact.

        A coordinate that moves by d from rest to the rate u in time T has at least
        integral a^2 dt = 12 d^2/T^3 - 12 d u/T^2 + 4 u^2/T, which a cubic attains.
        """
        p, n = self.problem, self.layout.n
        T, linear, diagonal = float(np.mean(p.swing.duration)), np.zeros(n), np.zeros(n)
        # in solver units, as coordinates and rates have a scale of one
        y, u = self.y.index(0), self.u0.index(0)
        # second derivatives by d, by d and u, and by u, with d = y - y0
        dd, du, uu = (2 * p.smoothness * k for k in (12 / T**3, -6 / T**2, 4 / T))
        diagonal[y], diagonal[u] = dd, uu
        linear[y], linear[u] = -dd * self.y0, -du * self.y0
        # the mixed derivative by d and u stands at (y, u) and, by the transpose, at (u, y)
        mixed = sp.csr_array((np.full(len(y), du), (y, u)), shape=(n, n))
        # a swing has a node at the end and in the middle of each interval
        of_swing = (self.w, 2 * p.swing.intervals)  # priced as one of the swing's nodes
        diagonal += wrench_prices(
            self.builder, [of_swing, *[(hit.w, hit.w.count) for hit in self.hit.collisions]]
        )
        quadratic = sp.diags_array(diagonal) + mixed + mixed.T
        return Prices(quadratic, linear, dd / 2 * float(self.y0 @ self.y0))

    def swing_spots(self, since: float = 0.0) -> list[tuple[Place, list[Affine]]]:
        return [(Place.plain("contact"), [self.contact_state[0], self.contact_legs])]

    def follow_spots(self) -> list[tuple[Place, list[Affine]]]:
        y, _, legs, _ = self.expected.state_after
        return [(Place.plain("after contact"), [y, legs])]

    def body_states(self, x: Array) -> list[BodyState]:
        places = [*self.swing_spots(), *self.follow_spots()]
        end = sum(self.expected.durations(x))
        return [
            BodyState(phase, place.name, time, self.posture(x, slots))
            for (place, slots), phase, time in zip(places, (0, 2), (0.0, end), strict=True)
        ]

    def _displacements(self, target: TargetDisplacement) -> list[Affine]:
        return [Affine.zeros(3), *(target.after(None, place) for place, _ in self.follow_spots())]

    # ------------------------------------------------------------------ solution
    def decode(self, x: Array) -> PlannedStrike:
        """The planned impact of solver variables x (n,)."""
        c, still = self.coordinates, np.zeros(len(self.y0))
        before = self.y[0], self.u0[0], self.contact_legs
        states = [[e.evaluate(x) for e in state] for state in (before, self.expected.state_after[:3])]
        (q, v), (q_after, v_after) = (
            c.complete_motion(y, rates, still, legs)[:2] for y, rates, legs in states
        )
        return PlannedStrike(
            problem=self.problem,
            posture=q,
            velocity=v,
            posture_after=q_after,
            velocity_after=v_after,
            torque=self.feedforward.read(x)[0] * self.robot.torque_limit,
            ground=total_ground_wrench(c, self.w.read(x))[0],
            **self.hit.decode(x, self.program.outputs(x)),
        )
