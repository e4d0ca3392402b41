"""An impact without duration in the program: what planners without a collision model use.

H (u+ - u-) = -J^T n I + J_c^T w, joints without torque: the generalized impulse balance. The impulse I comes
from Newton's restitution ("rigid"), or from the two-mass collision of the virtual mass with the contact law
("virtual-mass"; paper, sec. 2 and fig. 1), in closed form for the spring-damper.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from impactopt.solvers.program import Determined
from impactopt.transcription.builder import Builder
from impactopt.transcription.constraints import Measure, Place, percent
from impactopt.transcription.contact_state import Contact, ContactEnd, still
from impactopt.transcription.elimination import Turn, determined
from impactopt.transcription.layout import Affine, Array, Group
from impactopt.transcription.limits import DIRECTIONS
from impactopt.transcription.plan import PlannedCollision


class InstantImpact:
    """Variables and constraints of an impact in no time; no constraint of torque or wrench while it lasts.

    mass : of a target that hand and robot have met, when they move on together; None: the problem's, which
    parts as its model of the collision says.  named : begin of the variables' names.
    """

    def __init__(self, b: Builder, contact: Contact, *, mass: float | None = None, named: str = "") -> None:
        self._b, self.contact, self._meets = b, contact, mass is not None
        c = b.coordinates
        self.target = b.problem.target
        # a wall takes any impulse without moving
        self.mass = self.target.parameters.get("mass", np.inf) if mass is None else mass
        self.before = float(self.target.speed_before())

        def add(name: str, size: int, **options: Any) -> Group:
            return b.layout.add(named + name, 1, size, **options)

        self.du = add("change of rate", b.ny, labels=c.labels)
        self.blow = add("impulse", 1, lower=1e-3, scale=10.0)
        scale = 0.05 * b.limits.wrench_scale
        self.w = add("impulsive sole wrench", b.nw, **{**b.limits.of_wrenches, "scale": scale})

    @property
    def impulse(self) -> Affine:
        """Impulse to the target [N s]."""
        return self.blow[0]

    @property
    def target_state(self) -> Affine:
        """State of the target after the impact."""
        return self.blow[0] * (1 / self.mass)

    def instances(self) -> dict[str, tuple[list[list[Affine]], list[Any]]]:
        """Slots and parameters of the block ``impact``."""
        b, p, state = self._b, self._b.problem, self.contact.state
        slots = [state.y, state.legs, self.contact.u0[0], self.du[0], self.w[0], self.blow[0]]
        rigid = float(self._meets or p.collision == "rigid")
        law = [p.law.parameters.get(name, 1.0) for name in ("stiffness", "damping")]
        numbers = [*p.normal, rigid, p.coefficient_of_restitution, *law, 1 / self.mass, self.before]
        return {"impact": ([slots], [np.concatenate([numbers, b.robot.torque_limit, b.limits.units])])}

    def determined(self) -> list[Determined]:
        """All of it, as of one element."""
        return [determined(Turn.ELEMENT, np.concatenate([g.index(0) for g in (self.du, self.w, self.blow)]))]

    def add_rows(self, at: dict[str, tuple[int, int]]) -> None:
        b, (start, _) = self._b, at["impact"]
        part = b.parts("impact")
        base, joints = start + part["base"], start + part["joints"]
        units = {"N": "N s", "N m": "N m s"}  # constraints are over a tenth of a second of the weight
        unbalanced = [Measure(units[m.unit], 0.1 * m.factor, "off") for m in b.limits.unbalanced]
        share = percent("off, of its limit for 0.1 s")
        b.equal("impulse balance", "impact", DIRECTIONS[: b.coordinates.base], base, unbalanced)
        b.equal("impulse balance", "impact", b.robot.joint_names, joints, share)
        off = Measure("m/s", 1.0, "off")
        b.equal("law of the impact", "impact", ["impulse"], start + part["blow"], off)

    def link(self, start: tuple[Affine, Affine, Affine]) -> list[list[Affine]]:
        """Linking constraints (:meth:`impactopt.transcription.collision.Collision.link`); no time passes."""
        none, still = Affine.zeros(1), Affine.zeros(self._b.ny)
        return self.contact.link(start, (none, none), (still, still), self._rate)

    @property
    def state_after(self) -> list[Affine]:
        """State after contact (:meth:`impactopt.transcription.collision.Collision.state_after`)."""
        state = self.contact.state
        return [state.y, self._rate, state.legs, Affine.constant(1.0)]

    def contact_end(self) -> ContactEnd:
        state, none, one = self.contact.state, Affine.zeros(self._b.ny), Affine.constant(1.0)
        before = still(state.y, self.contact.u0[0], none, one, state.legs)
        after = still(state.y, self._rate, none, one, state.legs)
        return ContactEnd(Place.plain("after contact"), before, after, self.du[0])

    @property
    def _rate(self) -> Affine:
        """ydot after it."""
        return self.contact.u0[0] + self.du[0]

    def guess(self, x: Array, y: Array, rates: Array, legs: Array) -> None:
        self.du.write(x, -0.3 * rates)
        self.blow.write(x, 0.5 * self.mass if np.isfinite(self.mass) else 1.0)

    def durations(self, x: Array) -> tuple[float, float]:
        return 0.0, 0.0

    def decode(self, x: Array, outputs: dict[str, Array], approaches: Array) -> PlannedCollision:
        b = self._b
        gained = float(self.blow.read(x)[0, 0]) / self.mass
        outcome = self.target.outcome([gained] * self.target.n_states)
        return PlannedCollision(
            time=np.zeros(2),
            force=np.zeros(2),
            target_speed=self.before + np.array([0.0, gained]),
            outcome=outcome,
            torque=np.repeat(self.contact.feedforward.read(x), 2, axis=0) * b.robot.torque_limit,
            sole_wrench=np.zeros((0, b.nw)),
            ground=np.zeros((0, 6)),
        )
