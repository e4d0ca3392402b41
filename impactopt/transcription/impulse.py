"""An impact without duration in the program: what planners without a collision model use.

H (u+ - u-) = -J^T n I + J_c^T w, joints without torque: the generalized impulse balance. The impulse I comes
from Newton's restitution ("rigid"), or from the two-mass collision of the virtual mass with the contact law
("virtual mass"; paper, sec. 2 and fig. 1), in closed form for the spring-damper.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from impactopt.transcription.collision import DIRECTIONS
from impactopt.transcription.layout import Affine, Array
from impactopt.transcription.plan import PlannedCollision
from impactopt.transcription.rows import Index, Measure, percent

if TYPE_CHECKING:
    from impactopt.transcription.at_contact import ContactProgram


class InstantImpact:
    """Variables and rows of an impact in no time; no row of torque or wrench while it lasts."""

    def __init__(self, t: ContactProgram) -> None:
        self.t, c = t, t.coordinates
        add = t.layout.add
        self.target = t.problem.target
        # a wall takes any impulse without moving
        self.mass = self.target.parameters.get("mass", np.inf)
        self.du = add("change of rate", 1, t.ny, labels=c.labels)
        self.blow = add("impulse", 1, 1, lower=1e-3, scale=10.0)
        self.w = add("impulsive sole wrench", 1, t.nw, **{**t.of_wrenches, "scale": 0.05 * t.wrench_scale})

    @property
    def impulse(self) -> Affine:
        """To the target [N s]."""
        return self.blow[0]

    @property
    def target_state(self) -> Affine:
        """Of the target, after it."""
        return self.blow[0] * (1 / self.mass)

    def instances(self) -> dict[str, tuple[list[list[Affine]], list[Any]]]:
        """Slots and parameters of the block ``impact``."""
        t, p = self.t, self.t.problem
        y = t.contact_state[0]
        slots = [y, t.contact_legs, t.u0[0], self.du[0], self.w[0], self.blow[0]]
        rigid = float(p.collision == "rigid")
        law = [p.law.parameters.get(name, 1.0) for name in ("stiffness", "damping")]
        numbers = [*p.normal, rigid, p.coefficient_of_restitution, *law, 1 / self.mass]
        return {"impact": ([slots], [np.concatenate([numbers, t.robot.torque_limit, t.units])])}

    def determined(self) -> tuple[list[list[Index]], list[list[Index]]]:
        """As of :meth:`impactopt.transcription.collision.Collision.determined`."""
        return [], [[np.concatenate([g.index(0) for g in (self.du, self.w, self.blow)])]]

    def add_rows(self, at: dict[str, tuple[int, int]]) -> None:
        t, (start, _) = self.t, at["impact"]
        part = t.parts("impact")
        base, joints = start + part["base"], start + part["joints"]
        units = {"N": "N s", "N m": "N m s"}  # rows are over a tenth of a second of the weight
        unbalanced = [Measure(units[m.unit], 0.1 * m.factor, "off") for m in t.unbalanced]
        share = percent("off, of its limit for 0.1 s")
        t.equal("impulse balance", "impact", DIRECTIONS[: t.coordinates.base], base, unbalanced)
        t.equal("impulse balance", "impact", t.robot.joint_names, joints, share)
        off = Measure("m/s", 1.0, "off")
        t.equal("law of the impact", "impact", ["impulse"], start + part["blow"], off)

    def link(self, start: tuple[Affine, Affine, Affine]) -> list[list[Affine]]:
        """As of :meth:`impactopt.transcription.collision.Collision.link`; no time passes."""
        none, still = Affine.zeros(1), Affine.zeros(self.t.ny)
        return self.t.link_slots(start, (none, none), (still, still), self.t.u0[0] + self.du[0])

    @property
    def state_after(self) -> list[Affine]:
        """As of :meth:`impactopt.transcription.collision.Collision.state_after`."""
        t = self.t
        return [t.contact_state[0], t.u0[0] + self.du[0], t.contact_legs, Affine.constant(1.0)]

    def guess(self, x: Array, y: Array, rates: Array, legs: Array) -> None:
        self.du.write(x, -0.3 * rates)
        self.blow.write(x, 0.5 * self.mass if np.isfinite(self.mass) else 1.0)

    def durations(self, x: Array) -> tuple[float, float]:
        return 0.0, 0.0

    def decode(self, x: Array, outputs: dict[str, Array], approach: float) -> PlannedCollision:
        t = self.t
        speed = float(self.blow.read(x)[0, 0]) / self.mass
        outcome = self.target.outcome([speed] * self.target.n_states)
        return PlannedCollision(
            time=np.zeros(2),
            force=np.zeros(2),
            target_speed=np.array([0.0, speed]),
            outcome=outcome,
            torque=np.repeat(t.feedforward.read(x), 2, axis=0) * t.robot.torque_limit,
            sole_wrench=np.zeros((0, t.nw)),
            ground=np.zeros((0, 6)),
        )
