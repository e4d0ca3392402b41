"""The contact of a strike by shooting: constraints and variables of collisions that the SDC predicts.

What `Hit` and `Collision` are to a collocated contact. The collision is eliminated: its impulse and what it
leaves behind are variables that constraints determine, its torques and wrenches are constraints alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from impactopt.errors import InputError
from impactopt.kinematics.wrench_cone import contact_wrench_cone
from impactopt.problem.scenario import Scenario
from impactopt.transcription.builder import Builder
from impactopt.transcription.contact import Contact
from impactopt.transcription.contacts import Contacts
from impactopt.transcription.drives import ContactEnd, DrivePoint, still
from impactopt.transcription.guess import natural_durations
from impactopt.transcription.layout import Affine, Array, stack
from impactopt.transcription.plan import PlannedCollision, PlannedScenario
from impactopt.transcription.reference import total_ground_wrench
from impactopt.transcription.rows import Index, Measure, Place, percent
from impactopt.transcription.shooting import FORCE, INSTANTS, Shooting, horizon_of, shot_block

# a robot's contact against that of a point mass of 1 m/s in its place, at most
_SLOWER, _DRIVEN = 1.6, 4.0
_ENDED = 0.98  # of the horizon


class Shot:
    """The contact with one target. Attributes as of `Collision`, so far as a strike asks for them."""

    def __init__(
        self, b: Builder, contact: Contact, mass: float, number: int, scenario: Scenario | None = None
    ):
        self._b, self.contact, self.number, self.scenario = b, contact, number, scenario
        self.suffix = f", if {scenario.name}" if scenario is not None else ""
        self.law, self.target = b.problem.law.parameters, b.problem.target.parameters
        if scenario is not None:
            self.law, self.target = scenario.numbers(b.problem.law, b.problem.target)
        self.torque_fraction = scenario.torque if scenario else b.limits.torque.collision
        p = b.problem
        law, target = type(p.law)(**self.law), type(p.target)(**self.target)
        natural = float(natural_durations(law, target, mass).sum())
        cone, self._least = self._cone()
        # a target that is driven takes the longer the harder it is hit
        slower = _SLOWER * natural if p.target.turns else _DRIVEN * natural
        horizon = horizon_of(min(slower, 2 * p.contact_duration[1]))
        self.shooting = Shooting(p, b.coordinates, law, target, horizon=horizon, cone=cone)
        self.w = b.layout.add(f"sole wrenches in collision{self.suffix}", 0, b.nw)

    def _cone(self) -> tuple[Array, Array]:
        """Rows of all soles' wrenches over the weight (k, 6 a sole), and their lower bounds."""
        b, cone = self._b, self._b.limits.cone
        margin = self.scenario.cone_margin if self.scenario else cone.collision_margin
        minimum = 0.0 if self.scenario else cone.minimum_force
        rows, least = [np.zeros((0, b.nw))], [np.zeros(0)]
        for k, leg in enumerate(b.coordinates.legs):
            if margin is None or leg.sole is None:  # a hand, which strikes by shooting refuse
                continue
            own = np.vstack(
                [contact_wrench_cone(leg.sole.polygon, cone.friction, margin=margin), np.eye(6)[2]]
            )
            wide = np.zeros((len(own), b.nw))
            wide[:, 6 * k : 6 * k + 6] = own / b.limits.weight
            rows.append(wide)
            least.append(np.append(np.zeros(len(own) - 1), minimum / b.limits.weight))
        return np.vstack(rows), np.concatenate(least)

    @property
    def _z(self) -> Affine:
        """Arguments of the shooting."""
        state = self.contact.state
        return stack([state.y, self.contact.u0[0], state.legs, self.contact.feedforward[0]])

    def outputs(self, part: str) -> Index:
        """Numbers of the outputs of this part, once constraints are there."""
        return np.asarray(self._at + self.shooting.parts[part])

    def add_rows(self) -> None:
        """The block, variables that equal its outputs, constraints of torque, wrenches and duration."""
        b, c, limits = self._b, self._b.coordinates, self._b.limits
        self._at = sum(block.count * block.n_out for block in b.blocks)
        b.blocks.append(shot_block(self.shooting, self._z))
        name = self.scenario.name + ": " if self.scenario else ""
        place = f"contact{self.suffix}"
        self._impulse = b.lift(f"{name}impulse", self.outputs("impulse"), place=place)
        self._y = b.lift(f"{name}position after contact", self.outputs("y"), place=place, **limits.of_y)
        self._rate = b.lift(f"{name}rate after contact", self.outputs("rate"), place=place, labels=c.labels)
        self._legs = None
        if c.legs:
            self._legs = b.lift(
                f"{name}legs after contact", self.outputs("legs"), place=place, **limits.of_legs
            )
        instants = [f"instant {k}" for k in range(INSTANTS)]
        b.rows.add(
            term=f"{limits.torque.name} in collision",
            place=place,
            components=[f"{joint}, {at}" for at in instants for joint in b.robot.joint_names],
            outputs=self.outputs("torque"),
            lower=-self.torque_fraction,
            upper=self.torque_fraction,
            measure=percent("over its limit", of=self.torque_fraction),
        )
        count = len(self._least)
        b.rows.add(
            term=limits.cone.name,
            place=place,
            components=[f"row {k}, {at}" for at in instants for k in range(count)],
            outputs=self.outputs("cone"),
            lower=np.tile(self._least, INSTANTS),
            measure=percent("of the weight outside"),
        )
        b.rows.add(
            term="end of contact",
            place=place,
            components=["duration"],
            outputs=self.outputs("duration"),
            upper=_ENDED,
            measure=Measure("ms", 1e3 * self.shooting.horizon, "too late"),
        )

    # ------------------------------------------------------------------ for terms and objectives
    @property
    def impulse(self) -> Affine:
        """Impulse to the target [N s]."""
        return self._impulse[0]

    def target_energy(self) -> Affine:
        """[J] at separation, as a variable."""
        return self._b.lift("target energy", self.outputs("energy"))[0]

    def peak_force(self) -> Affine:
        """[N], as a variable."""
        return self._b.lift("peak force", self.outputs("peak"))[0] * FORCE

    @property
    def state_after(self) -> list[Affine]:
        """Coordinates, rates, legs and T (1 s) after contact."""
        legs = Affine.zeros(0) if self._legs is None else self._legs[0]
        return [self._y[0], self._rate[0], legs, Affine.constant(1.0)]

    def contact_end(self) -> ContactEnd:
        state, u0, one = self.contact.state, self.contact.u0[0], Affine.constant(1.0)
        y, rate, legs, _ = self.state_after
        before, after = still(state.y, u0, u0 * 0.0, one, state.legs), still(y, rate, u0 * 0.0, one, legs)
        return ContactEnd(Place.plain(f"after contact{self.suffix}"), before, after, rate - u0)

    # ------------------------------------------------------------------ numbers
    def durations(self, x: Array) -> tuple[float, float]:
        """Compression and restitution [s]."""
        hit, compression, _ = self.decode(x)
        return compression, float(hit.time[-1]) - compression

    def decode(self, x: Array) -> tuple[PlannedCollision, float, float]:
        """The collision that solver variables (n,) stand for; compression [s]; hand speed [m/s]."""
        b, c = self._b, self._b.coordinates
        found = self.shooting.collide(self._z.evaluate(x))
        time = found["time"]
        last = int(np.argmax(time >= time[-1] - 1e-12))
        kept = slice(0, last + 1)
        closing = (found["hand_speed"] - found["target_speed"])[kept]
        parting = np.flatnonzero(closing <= 0)
        k = int(parting[0]) if parting.size else last
        share = closing[k - 1] / max(closing[k - 1] - closing[k], 1e-12) if k else 0.0
        compression = float(time[k - 1] + share * (time[k] - time[k - 1])) if k else 0.0
        wrench = np.zeros((last, b.nw))
        if c.legs:
            wrench = found["sole_wrench"][1 : last + 1] @ self.shooting.to_sole.T
        results = np.atleast_1d(found.get("target_result", np.zeros(0)))
        hit = PlannedCollision(
            time=time[kept],
            force=found["force"][kept],
            target_speed=found["target_speed"][kept],
            torque=found["demand"][kept],
            sole_wrench=wrench,
            ground=total_ground_wrench(c, wrench) if c.legs else np.zeros((0, 6)),
            outcome=b.problem.target.with_units(results),
        )
        return hit, compression, float(found["hand_speed"][0])


class Shots(Contacts):
    """The contact with all targets, by shooting: what `Hit` is to a collocated one."""

    def __init__(self, b: Builder, contact: Contact):
        super().__init__(b, contact)
        p = b.problem
        if p.target.guards and p.target.turns:
            raise InputError(
                f'method "shooting": whether a {p.target.word} breaks has no slope; take "collocation"'
            )
        if p.collision not in ("full", "sdc") or p.freezes:
            frozen = f" with {p.freezes} freezes" if p.freezes else ""
            raise InputError(
                'method "shooting" predicts what the SDC does, frozen at contact: collision is '
                f'{p.collision!r}{frozen}; take "sdc" without freezes, or method "collocation"'
            )
        self.expected = Shot(b, contact, self.mass, 0)
        self.scenarios = [Shot(b, contact, self.mass, k, s) for k, s in enumerate(self.hit, start=1)]

    def add_rows(self) -> None:
        """Adds the constraints of all collisions."""
        for shot in self.collisions:
            shot.add_rows()

    def drives(self) -> list[DrivePoint]:
        """They are not known."""
        raise InputError(
            'method "shooting" does not know how joints accelerate in contact, so it bounds no gears and '
            'motors there; take "collocation"'
        )

    @property
    def deepest(self) -> Index:
        """There is no such output."""
        raise InputError('method "shooting" has no slope of the deepest penetration; take "collocation"')

    def decode(self, x: Array, outputs: dict[str, Array]) -> dict[str, Any]:
        """Contact data of plans and strikes (see `Hit.decode`)."""
        hit, compression, speed = self.expected.decode(x)
        scenarios = []
        for other in self.scenarios:
            assert other.scenario is not None
            impulse = float(other.impulse.evaluate(x)[0])
            scenarios.append(
                PlannedScenario(name=other.scenario.name, impulse=impulse, collision=other.decode(x)[0])
            )
        return {
            "compression": compression,
            "restitution": float(hit.time[-1]) - compression,
            "collision": hit,
            "hand_speed": speed,
            "impulse": self.impulse(x),
            "scenarios": tuple(scenarios),
        }
