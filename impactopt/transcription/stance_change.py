"""Sequences of stance phases, and the constraints where soles lift off or touch down.

Each phase is a spline in the coordinates of its own stance, so its soles stay in place at every instant. Of
two neighbouring phases the *lighter* one stands on fewer soles and has more coordinates. Its spline begins,
or ends, at the *heavier* one's posture. Further constraints at the change:

* Rates are continuous: the heavier phase's rates of coordinates and leg joints equal the lighter one's.
* Torques are continuous, and the sole that changes carries no load. So accelerations are continuous too: the
  sole leaves the ground, and meets it, at rest and without acceleration.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import pairwise

import numpy as np

from impactopt.arrays import Array, Index
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.problem.violation import Place, millimetres, percent
from impactopt.robots.loads import fading
from impactopt.transcription.builder import Builder
from impactopt.transcription.layout import Affine, rates, select, stack
from impactopt.transcription.mesh import MoreNodes
from impactopt.transcription.motion_phase import FREE, REST, MotionPhase, add_nodes, node_numbers
from impactopt.transcription.plan import PlannedStand

# Clearance of a swing foot. Within RAMP_TIME after lift-off and before touch-down it rises from zero as the
# cube of time, since the foot starts and lands at rest without acceleration; between these it is CLEARANCE.
CLEARANCE = 0.01  # [m] of a sole's corners above the ground
RAMP_TIME = 0.2  # [s]
# [m] Largest horizontal distance from the foothold at RAMP_TIME before touch-down. It decreases likewise, so
# a foot that touches down a millimetre too early hardly slides.
FOOTHOLD_DISTANCE = 0.02


class Stand(MotionPhase):
    """Stance phase other than the one with the impact."""

    def __init__(
        self,
        b: Builder,
        number: int,
        more: tuple[float, ...],
        missed: bool,
        begins: str | Affine,
        ends: str | Affine,
    ) -> None:
        p = b.problem
        stance = p.stances[number]
        assert stance.phase is not None
        soles = " and ".join(stance.soles)
        names = (f"stance{number}", f"on {soles}, phase {number + 1}")
        if missed:
            names = (f"{names[0]}-abort", f"{names[1]}, if nothing is hit")
        super().__init__(b, names, stance.phase, more, begins, ends, fine_end=number < p.blow)


def posture_in(c: StanceCoordinates, other: StanceCoordinates, y: Affine, legs: Affine) -> list[Affine]:
    """Coordinates and legs, in stance c, of the posture of ``y`` and ``legs`` in the ``other`` stance."""
    # for base and joints, in the robot's order: their positions in `whole`
    position = np.zeros(c.base + c.robot.n, dtype=np.intp)
    position[: c.base] = np.arange(c.base)
    position[c.base + other.independent] = c.base + np.arange(len(other.independent))
    position[c.base + other.dependent] = other.ny + np.arange(other.nl)
    whole = stack([y, legs])
    own = np.concatenate([np.arange(c.base), c.base + c.independent])
    return [select(whole, position[own]), select(whole, position[c.base + c.dependent])]


class PhaseSequence:
    """Consecutive stance phases: those up to contact, including the swing, or those from contact to rest.

    Attributes
    ----------
    numbers : indices of the phases in the problem.  builders, phases : of each, by index.
    """

    def __init__(
        self,
        b: Builder,
        numbers: range,
        main: Callable[[str | Affine, str | Affine], MotionPhase],
        nodes: MoreNodes,
        *,
        missed: bool = False,
    ) -> None:
        """main : makes the phase with the impact; its arguments are `begins` and `ends` of `MotionPhase`."""
        p = b.problem
        self._b, self.numbers = b, numbers
        self.builders = {
            k: b if c is b.coordinates else b.standing(c, f"stance{k}_node")
            for k, c in enumerate(p.stance_coordinates)
            if k in numbers
        }
        self.phases: dict[int, MotionPhase] = {}
        # heavier phases first: a lighter neighbour begins or ends at a posture of theirs
        for k in sorted(numbers, key=lambda k: -len(self._soles(k))):
            ends = [
                REST if other not in numbers else self._end_condition(k, other) for other in (k - 1, k + 1)
            ]
            if k == p.blow:
                self.phases[k] = main(ends[0], ends[1])
            else:
                self.phases[k] = Stand(self.builders[k], k, nodes.of_stand(k), missed, *ends)
        for one, other in self._changes():
            heavy = max(one, other, key=lambda k: len(self._soles(k)))
            node, phase = self._node(heavy, one, other), self.phases[heavy]
            names = [leg.name for leg in self.builders[heavy].coordinates.legs]
            light = self._soles(one + other - heavy)
            # components of the heavier phase's soles that the lighter one has not
            changing = [6 * k + np.arange(6) for k, name in enumerate(names) if name not in light]
            phase.unloaded[node] = np.concatenate(changing)

    @property
    def stands(self) -> dict[int, MotionPhase]:
        """Phases without the impact, by index."""
        return {k: self.phases[k] for k in self.numbers if k != self._b.problem.blow}

    def fading(self, number: int) -> set[str]:
        """Names of a phase's soles that do not stand in the phase before or after it."""
        p = self._b.problem
        return {sole.name for sole, fades in zip(p.soles, fading(p.standing)[number], strict=True) if fades}

    def _soles(self, number: int) -> tuple[str, ...]:
        stances = self._b.problem.stances
        return stances[number].soles if stances else ()

    def _changes(self) -> Iterable[tuple[int, int]]:
        return pairwise(self.numbers)

    def _node(self, k: int, one: int, other: int) -> int:
        """Number of phase k's node at the change between phases ``one`` and ``other``, of which k is one."""
        return len(self.phases[k].nodes) - 1 if k == one else 0

    def _end_condition(self, k: int, other: int) -> str | Affine:
        """End condition of phase k at a neighbour: free if k is heavier, else the neighbour's posture."""
        if len(self._soles(k)) > len(self._soles(other)):
            return FREE
        phase, before = self.phases[other], other < k
        y = phase.at(1.0 if before else 0.0)[0]
        light, heavy = self.builders[k].coordinates, self.builders[other].coordinates
        return posture_in(light, heavy, y, phase.legs[-1 if before else 0])[0]

    # ------------------------------------------------------------------ constraints
    def add_stands(self) -> None:
        """Adds nodes and constraints of the phases without the impact."""
        limit, names = self._b.limits.torque.fraction, self._b.robot.joint_names
        for k, phase in self.stands.items():
            b, (slots, places) = self.builders[k], phase.instances()
            torques = add_nodes(b, slots, places, fading=self.fading(k))
            for place, torque in zip(places, torques, strict=True):
                b.constraints.add(
                    term=b.limits.torque.name,
                    place=place,
                    components=names,
                    outputs=torque,
                    lower=-limit,
                    upper=limit,
                    measure=percent("over its limit", of=limit),
                )
            phase.add_rate_limits(b)

    def add_changes(self) -> None:
        """Adds constraints where soles lift off or touch down, and while they are in the air."""
        for one, other in self._changes():
            self._add_change(one, other)
        for k in self.numbers:
            self._add_swing_feet(k)

    def _add_change(self, one: int, other: int) -> None:
        """Adds the continuity of rates and torques between phases ``one`` and ``other``."""
        light = min(one, other, key=lambda k: len(self._soles(k)))
        heavy, b = one + other - light, self._b
        term, place = "change of stance", f"between {self.phases[one].name} and {self.phases[other].name}"
        mine, its = (self.builders[k].coordinates for k in (light, heavy))
        at = {k: self._rates(k, 1.0 if k == one else 0.0) for k in (light, heavy)}
        rate = b.lift(f"rate {place}", at[light], term=term, place=place, labels=mine.labels)[0]
        # for base and joints, in the robot's order: their positions in `rate`
        position = np.zeros(mine.base + b.robot.n, dtype=np.intp)
        position[np.append(np.arange(mine.base), mine.base + mine.independent)] = np.arange(mine.ny)
        shared = select(rate, np.append(position[: its.base], position[its.base + its.independent]))
        b.equal(term, place, its.labels, at[heavy], rates(its.labels), affine=-shared)
        # The block ``node`` is evaluated again here: an output may be in one constraint only, and those of
        # the phases' own nodes are in others already.
        node = {
            k: self.builders[k].add_block(
                "node",
                [self.phases[k].instances()[0][self._node(k, one, other)]],
                node_numbers(self.builders[k]),
            )
            for k in (light, heavy)
        }
        torques = {k: at + self.builders[k].parts("node")["torque"] for k, at in node.items()}
        # joints that are a closed leg's in the heavier phase, and independent in the lighter one; the block
        # gives the rates of leg joints over their limits
        legs = node[heavy] + self.builders[heavy].parts("node")["leg_rate"]
        freed = np.flatnonzero(~np.isin(its.dependent, mine.dependent))
        limit = b.robot.velocity_limit[its.dependent[freed]]
        labels = [its.leg_labels[k] for k in freed]
        b.equal(
            term,
            place,
            labels,
            legs[freed],
            percent("off"),
            affine=-select(rate, position[its.base + its.dependent[freed]]) * (1 / limit),
        )
        strong = percent("off its limit")
        names = [f"torque of {name}" for name in b.robot.joint_names]
        torque = b.lift(
            f"torque {place}", torques[heavy], term=term, place=place, labels=names, measure=strong
        )[0]
        b.equal(term, place, names, torques[light], strong, affine=-torque)

    def _rates(self, k: int, s: float) -> Index:
        """Indices (ny,) of block outputs: the rates y'/T of a phase at s."""
        b, phase = self.builders[k], self.phases[k]
        y1, T = phase.at(s)[1], phase.T[0]
        return b.add_block("pace", [[y1[i : i + 1], T] for i in range(b.ny)], np.zeros(0)) + np.arange(b.ny)

    def _add_swing_feet(self, k: int) -> None:
        """Adds constraints on soles in the air: clearance of the ground, distance from the foothold."""
        b, phase, p = self.builders[k], self.phases[k], self._b.problem
        # the duration is a variable, but bounds have to be constant: those of the mean of its limits
        T = float(np.mean(phase.phase.duration))
        for i, sole in enumerate(p.soles):
            if sole in b.coordinates.soles:
                continue
            lifted, lands = (j in self.numbers and sole.name in self._soles(j) for j in (k - 1, k + 1))
            if k == 0 and self.numbers[-1] == p.blow:  # the motion's start, where all soles are on the ground
                lifted = True
            # inf if the sole was not on the ground before, or does not come down after: no ramp there
            since = np.where(lifted, phase.nodes * T, np.inf)  # [s] lift-off
            until = np.where(lands, (1 - phase.nodes) * T, np.inf)  # [s] touch-down
            ramp = np.minimum(np.minimum(since, until) / RAMP_TIME, 1.0)
            airborne = np.flatnonzero(ramp > 0)
            spots = [[phase.at(float(phase.nodes[j]))[0]] for j in airborne]
            at, corners = b.add_block(f"stance{k}_heights{i}", spots, sole.polygon.ravel()), len(sole.polygon)
            # the next phase has the foothold: the placement at which it fixes the sole
            legs = self.builders[k + 1].coordinates.legs if lands else ()
            foothold = [leg.placement.translation[:2] for leg in legs if leg.name == sole.name]
            for number, j in enumerate(airborne):
                outputs, place = at + number * (corners + 2), phase.place_at(float(phase.nodes[j]))
                b.constraints.add(
                    term="swing foot off the ground",
                    place=place,
                    components=[f"{sole.name}, corner {corner}" for corner in range(corners)],
                    outputs=outputs + np.arange(corners),
                    lower=CLEARANCE * ramp[j] ** 3,
                    measure=millimetres("too low"),
                    whole=sole.name,
                )
                if until[j] >= RAMP_TIME:
                    continue
                distance = FOOTHOLD_DISTANCE * (until[j] / RAMP_TIME) ** 3
                b.constraints.add(
                    term="swing foot above its foothold",
                    place=place,
                    components=[f"{sole.name}, {axis}" for axis in "xy"],
                    outputs=outputs + corners + np.arange(2),
                    lower=foothold[0] - distance,
                    upper=foothold[0] + distance,
                    measure=millimetres("beside it"),
                    whole=sole.name,
                )

    # ------------------------------------------------------------------ nodes and solution
    def spots(self) -> list[tuple[Place, list[Affine]]]:
        """Places of the nodes of `stands`, with coordinates and legs in the stance of the impact."""
        c, out = self._b.coordinates, list[tuple[Place, list[Affine]]]()
        for k, phase in self.stands.items():
            its = self.builders[k].coordinates
            out += [(place, posture_in(c, its, y, legs)) for place, (y, legs) in phase.spots()]
        return out

    def times_from_contact(self) -> list[Affine]:
        """Time [s] between contact and each of `spots`."""
        out, blow = list[Affine](), self._b.problem.blow
        for k, phase in self.stands.items():
            between = range(k + 1, blow + 1) if k < blow else range(blow, k)
            whole = sum(self.phases[j].T[0] for j in between)
            out += [phase.T[0] * (1 - s if k < blow else s) + whole for s in phase.nodes]
        return out

    def decode(self, x: Array) -> tuple[PlannedStand, ...]:
        """Solution of the phases without the impact, from solver variables (n,)."""
        out = []
        for k, phase in self.stands.items():
            nodes, wrench = phase.nodes, phase.wrenches(x)
            if nodes[0]:  # a phase from rest has no node at its start: the first wrench holds there too
                nodes, wrench = np.append(0.0, nodes), np.vstack([wrench[:1], wrench])
            out.append(PlannedStand(number=k, spline=phase.spline(x), nodes=nodes, wrench=wrench))
        return tuple(out)
