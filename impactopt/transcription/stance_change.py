"""Phases of a motion on other soles than those at the contact, and what holds where soles lift off or touch
down.

Each phase is a spline in its own stance's coordinates, so its soles stay where they are at every instant. Of
two neighbours one stands on fewer soles: it is the *lighter* one, which has more coordinates. Its spline
begins, or ends, at the posture that the other has there. What else holds there:

* its rates are those of the other, whose own are of its coordinates and of the legs that it holds;
* torques do not jump, and the sole that changes bears nothing. So accelerations do not jump either: it leaves
  the ground, and meets it, at rest and without acceleration.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import pairwise

import numpy as np

from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.kinematics.splines import graded_breaks
from impactopt.robots.loads import fading
from impactopt.transcription.builder import Builder
from impactopt.transcription.layout import (
    Affine,
    Array,
    Index,
    Place,
    millimetres,
    percent,
    rates,
    select,
    stack,
)
from impactopt.transcription.mesh import MoreNodes, with_middles
from impactopt.transcription.motion_phase import FREE, REST, MotionPhase, add_nodes, node_numbers
from impactopt.transcription.plan import PlannedStand

# [m] that a sole in the air is above the ground, from so long [s] after it has left it until so long before
# it is back
HEIGHT, WITHIN = 0.01, 0.2
ASIDE = 0.02  # [m] that it is beside its foothold at most then: who is early by a millimetre hardly slides


class Stand(MotionPhase):
    """A phase on other soles, before or after those with the blow."""

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
        breaks = graded_breaks(stance.phase.intervals, stance.phase.grading, fine_end=number < p.blow)
        places = with_middles(breaks)
        mesh = breaks, np.union1d(places[1:] if begins == REST else places, more), more
        soles = " and ".join(stance.soles)
        names = (f"stance{number}", f"on {soles}, phase {number + 1}")
        if missed:
            names = (f"{names[0]}-abort", f"{names[1]}, if nothing is hit")
        super().__init__(b, names, stance.phase, mesh, begins, ends)


def posture_in(c: StanceCoordinates, other: StanceCoordinates, y: Affine, legs: Affine) -> list[Affine]:
    """Coordinates and legs of a stance of the posture that another stance has these of."""
    places = np.zeros(c.base + c.robot.n, dtype=np.intp)  # of base and joints in y followed by legs
    places[: c.base] = np.arange(c.base)
    places[c.base + other.independent] = c.base + np.arange(len(other.independent))
    places[c.base + other.dependent] = other.ny + np.arange(other.nl)
    whole = stack([y, legs])
    own = np.concatenate([np.arange(c.base), c.base + c.independent])
    return [select(whole, places[own]), select(whole, places[c.base + c.dependent])]


class Course:
    """Stance phases one after the other: those up to contact with the swing, or those from it to rest.

    Attributes
    ----------
    numbers : of the phases.  builders, phases : of each.
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
        """main : makes the phase with the blow, from how it begins and ends."""
        p = b.problem
        self._b, self.numbers = b, numbers
        self.builders = {
            k: b if c is b.coordinates else b.standing(c, f"stance{k}_node")
            for k, c in enumerate(p.stance_coordinates)
            if k in numbers
        }
        self.phases: dict[int, MotionPhase] = {}
        for k in sorted(numbers, key=lambda k: -len(self._soles(k))):  # of neighbours the heavier one first
            ends = [REST if other not in numbers else self._meets(k, other) for other in (k - 1, k + 1)]
            stand = k != p.blow
            more = nodes.of_stand(k)
            self.phases[k] = (
                Stand(self.builders[k], k, more, missed, *ends) if stand else main(ends[0], ends[1])
            )
        for one, other in self._changes():
            heavy = max(one, other, key=lambda k: len(self._soles(k)))
            node, phase = self._node(heavy, one, other), self.phases[heavy]
            names = [leg.name for leg in self.builders[heavy].coordinates.legs]
            light = self._soles(one + other - heavy)
            gone = [6 * k + np.arange(6) for k, name in enumerate(names) if name not in light]
            phase.unloaded[node] = np.concatenate(gone)

    @property
    def stands(self) -> dict[int, MotionPhase]:
        """The phases beside the one with the blow."""
        return {k: self.phases[k] for k in self.numbers if k != self._b.problem.blow}

    def fading(self, number: int) -> set[str]:
        """Soles of a phase that do not stand in a neighbour of it."""
        p = self._b.problem
        return {sole.name for sole, fades in zip(p.soles, fading(p.standing)[number], strict=True) if fades}

    def _soles(self, number: int) -> tuple[str, ...]:
        stances = self._b.problem.stances
        return stances[number].soles if stances else ()

    def _changes(self) -> Iterable[tuple[int, int]]:
        return pairwise(self.numbers)

    def _node(self, k: int, one: int, other: int) -> int:
        """Number of the node of phase k, one of two neighbours, where they meet."""
        return len(self.phases[k].nodes) - 1 if k == one else 0

    def _meets(self, k: int, other: int) -> str | Affine:
        """Beginning or end of phase k at a neighbour."""
        if len(self._soles(k)) > len(self._soles(other)):
            return FREE
        phase, before = self.phases[other], other < k
        mine, its = (self.builders[i].coordinates for i in (k, other))
        y = phase.at(1.0 if before else 0.0)[0]
        return posture_in(mine, its, y, phase.legs[-1 if before else 0])[0]

    # ------------------------------------------------------------------ constraints
    def add_stands(self) -> None:
        """Nodes of the phases beside the one with the blow, with all their constraints."""
        limit, names = self._b.limits.torque.fraction, self._b.robot.joint_names
        for k, phase in self.stands.items():
            b, (slots, places) = self.builders[k], phase.instances()
            torques = add_nodes(b, slots, places, fading=self.fading(k))
            for place, torque in zip(places, torques, strict=True):
                b.rows.add(
                    term=b.limits.torque.name,
                    place=place,
                    components=names,
                    outputs=torque,
                    lower=-limit,
                    upper=limit,
                    measure=percent("over its limit", of=limit),
                )
            phase.add_rate_rows(b)

    def add_changes(self) -> None:
        """Rows where soles lift off or touch down, and while they are in the air."""
        for one, other in self._changes():
            self._add_change(one, other)
        for k in self.numbers if len(self.numbers) > 1 else ():
            self._add_heights(k)

    def _add_change(self, one: int, other: int) -> None:
        light = min(one, other, key=lambda k: len(self._soles(k)))
        heavy, b = one + other - light, self._b
        term, place = "change of stance", f"between {self.phases[one].name} and {self.phases[other].name}"
        mine, its = (self.builders[k].coordinates for k in (light, heavy))
        at = {k: self._paces(k, 1.0 if k == one else 0.0) for k in (light, heavy)}
        rate = b.lift(f"rate {place}", at[light], term=term, place=place, labels=mine.labels)[0]
        column = np.zeros(mine.base + b.robot.n, dtype=np.intp)
        column[np.append(np.arange(mine.base), mine.base + mine.independent)] = np.arange(mine.ny)
        shared = select(rate, np.append(column[: its.base], column[its.base + its.independent]))
        b.rows.add(
            term=term,
            place=place,
            components=its.labels,
            outputs=at[heavy],
            affine=-shared,
            lower=0,
            upper=0,
            measure=rates(its.labels),
        )
        # once more by itself: an output is of one row, and those of the nodes have theirs
        node = {
            k: self.builders[k].add_block(
                "node",
                [self.phases[k].instances()[0][self._node(k, one, other)]],
                node_numbers(self.builders[k]),
            )
            for k in (light, heavy)
        }
        torques = {k: at + self.builders[k].parts("node")["torque"] for k, at in node.items()}
        legs = node[heavy] + self.builders[heavy].parts("node")["leg_rate"]
        freed = np.flatnonzero(~np.isin(its.dependent, mine.dependent))
        limit = b.robot.velocity_limit[its.dependent[freed]]
        labels = [its.leg_labels[k] for k in freed]
        b.rows.add(
            term=term,
            place=place,
            components=labels,
            outputs=legs[freed],
            affine=-select(rate, column[its.base + its.dependent[freed]]) * (1 / limit),
            lower=0,
            upper=0,
            measure=percent("off"),
        )
        strong = percent("off its limit")
        names = [f"torque of {name}" for name in b.robot.joint_names]
        torque = b.lift(
            f"torque {place}", torques[heavy], term=term, place=place, labels=names, measure=strong
        )[0]
        b.rows.add(
            term=term,
            place=place,
            components=names,
            outputs=torques[light],
            affine=-torque,
            lower=0,
            upper=0,
            measure=strong,
        )

    def _paces(self, k: int, s: float) -> Index:
        """Outputs (ny) that are the rates of a phase at s."""
        b, phase = self.builders[k], self.phases[k]
        y1, T = phase.at(s)[1], phase.T[0]
        return b.add_block("pace", [[y1[i : i + 1], T] for i in range(b.ny)], np.zeros(0)) + np.arange(b.ny)

    def _add_heights(self, k: int) -> None:
        """Soles in the air are above the ground, and come down from above their footholds."""
        b, phase, p = self.builders[k], self.phases[k], self._b.problem
        T = float(np.mean(phase.phase.duration))
        for i, sole in enumerate(p.soles):
            if sole in b.coordinates.soles:
                continue
            left, meets = (j in self.numbers and sole.name in self._soles(j) for j in (k - 1, k + 1))
            since = np.where(left, phase.nodes * T, np.inf)
            until = np.where(meets, (1 - phase.nodes) * T, np.inf)
            way = np.minimum(np.minimum(since, until) / WITHIN, 1.0)
            up = np.flatnonzero(way > 0)
            spots = [[phase.at(float(phase.nodes[j]))[0]] for j in up]
            at, corners = b.add_block(f"stance{k}_heights{i}", spots, sole.polygon.ravel()), len(sole.polygon)
            legs = self.builders[k + 1].coordinates.legs if meets else ()
            foothold = [leg.placement.translation[:2] for leg in legs if leg.name == sole.name]
            for number, j in enumerate(up):
                outputs, place = at + number * (corners + 2), phase.place_at(float(phase.nodes[j]))
                b.rows.add(
                    term="swing foot off the ground",
                    place=place,
                    components=[f"{sole.name}, corner {corner}" for corner in range(corners)],
                    outputs=outputs + np.arange(corners),
                    lower=HEIGHT * way[j] ** 3,
                    measure=millimetres("too low"),
                    whole=sole.name,
                )
                if until[j] >= WITHIN:
                    continue
                most = ASIDE * (until[j] / WITHIN) ** 3
                b.rows.add(
                    term="swing foot above its foothold",
                    place=place,
                    components=[f"{sole.name}, {axis}" for axis in "xy"],
                    outputs=outputs + corners + np.arange(2),
                    lower=foothold[0] - most,
                    upper=foothold[0] + most,
                    measure=millimetres("beside it"),
                    whole=sole.name,
                )

    # ------------------------------------------------------------------ what others ask for
    def spots(self) -> list[tuple[Place, list[Affine]]]:
        """Places of nodes of phases beside the one with the blow, with coordinates and legs of its stance."""
        c, out = self._b.coordinates, list[tuple[Place, list[Affine]]]()
        for k, phase in self.stands.items():
            its = self.builders[k].coordinates
            out += [(place, posture_in(c, its, y, legs)) for place, (y, legs) in phase.spots()]
        return out

    def decode(self, x: Array) -> tuple[PlannedStand, ...]:
        """The phases beside the one with the blow, for solver variables (n,)."""
        out = []
        for k, phase in self.stands.items():
            nodes, wrench = phase.nodes, phase.wrenches(x)
            if nodes[0]:
                nodes, wrench = np.append(0.0, nodes), np.vstack([wrench[:1], wrench])
            out.append(PlannedStand(number=k, spline=phase.spline(x), nodes=nodes, wrench=wrench))
        return tuple(out)
