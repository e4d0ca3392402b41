"""What every program of an impact is built with: limits, variables, blocks and rows at a node."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.kinematics.wrench_cone import contact_wrench_cone
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import (
    Balance,
    ContactWrenchCone,
    Incidence,
    LegExtension,
    PositionLimit,
    TorqueLimit,
    VelocityLimit,
)
from impactopt.transcription import blocks as symbolic
from impactopt.transcription.batched import Block
from impactopt.transcription.collision import DIRECTIONS
from impactopt.transcription.layout import Affine, Array, Group, Layout
from impactopt.transcription.rows import Index, Measure, Place, Rows, along, percent

GRAVITY = 9.81
LEVER = 0.1  # [m] scale of sole moments against forces
BASE_BOX = np.array([0.6, 0.6, 0.6, 0.8, 0.8, 1.2])  # [m, rad] how far the base may go from its start


class Builder:
    """A program under construction; ``program`` is there at its end."""

    program: Any  # StructuredProgram, in whoever completes it

    def __init__(
        self, problem: ImpactProblem, coordinates: StanceCoordinates, functions: dict[str, Any]
    ) -> None:
        self.problem, self.coordinates = problem, coordinates
        self.robot = problem.robot
        self.functions = functions
        self.weight = GRAVITY * float(sum(i.mass for i in self.robot.model.inertias))
        self.ny, self.nl, self.nw = coordinates.ny, coordinates.nl, 6 * len(coordinates.legs)
        self.y0, self.legs0 = coordinates.split(problem.start_posture)
        self.layout, self.rows = Layout(), Rows()
        self.blocks: list[Block] = []
        self._lifted: list[tuple[Group, Index]] = []
        self._limits()

    def _limits(self) -> None:
        p, c, r = self.problem, self.coordinates, self.robot
        self.torque, self.velocity = p.term(TorqueLimit), p.term(VelocityLimit)
        self.position, self.cone = p.term(PositionLimit), p.term(ContactWrenchCone)
        self.balance, self.incidence = p.term(Balance), p.term(Incidence)
        self.extension = p.term(LegExtension)
        lower, upper = r.lower + self.position.margin, r.upper - self.position.margin
        box = BASE_BOX[: c.base]
        self.y_lower = np.concatenate([self.y0[: c.base] - box, lower[c.independent]])
        self.y_upper = np.concatenate([self.y0[: c.base] + box, upper[c.independent]])
        self.legs_lower, self.legs_upper = lower[c.dependent], upper[c.dependent]
        self.rate_limit = self.velocity.fraction * r.velocity_limit
        self.units = np.array([self.weight, LEVER])
        force, moment = Measure("N", self.weight, "off"), Measure("N m", self.weight * LEVER, "off")
        self.unbalanced = [force if name in "xyz" else moment for name in DIRECTIONS[: c.base]]
        self.wrench_scale = self.weight * np.array([1, 1, 1, LEVER, LEVER, LEVER] * len(c.legs))
        # what every group of coordinates, of legs and of sole wrenches has
        self.of_y: dict[str, Any] = {"lower": self.y_lower, "upper": self.y_upper, "labels": c.labels}
        self.of_legs: dict[str, Any] = {
            "lower": self.legs_lower,
            "upper": self.legs_upper,
            "labels": c.leg_labels,
        }
        wrench_labels = [
            f"{leg.sole.name} sole {k}" for leg in c.legs for k in ("fx", "fy", "fz", "mx", "my", "mz")
        ]
        self.of_wrenches: dict[str, Any] = {"scale": self.wrench_scale, "labels": wrench_labels}

    def duration(self, name: str, bounds: tuple[float, float], scale: float) -> Group:
        return self.layout.add(name, 1, 1, lower=bounds[0], upper=bounds[1], scale=scale, labels=["T"])

    def add_block(self, name: str, instances: list[Any], parameters: Array) -> int:
        """Append a block; the index of its first output."""
        at = sum(b.count * b.n_out for b in self.blocks)
        self.blocks.append(Block.make(name, self.functions, instances, parameters))
        return at

    def add_lifted(self, name: str, lift: Affine, count: int, parameters: Array) -> int:
        """As :meth:`add_block`, of all instances' z as one expression."""
        at = sum(b.count * b.n_out for b in self.blocks)
        self.blocks.append(Block.of_lift(name, self.functions, lift, count, parameters))
        return at

    def lift(
        self,
        name: str,
        outputs: Index,
        *,
        term: str = "",
        place: Place | str = "",
        labels: Sequence[str] | None = None,
        measure: Measure | None = None,
        scale: float = 1.0,
        lower: ArrayLike = -np.inf,
        upper: ArrayLike = np.inf,
    ) -> Group:
        """One vector of variables that equals outputs of blocks, so that rows and objective can take it.

        term, place, measure : of the rows that say so; the term is the variables' name if not given.
        scale, lower, upper : of the variables.
        """
        size = len(outputs)
        labels = labels or ([name] if size == 1 else [f"{name} {k}" for k in range(size)])
        group = self.layout.add(name, 1, size, lower=lower, upper=upper, scale=scale, labels=labels)
        self.rows.add(
            term=term or name,
            place=place,
            components=labels,
            outputs=outputs,
            affine=-group[0],
            lower=0,
            upper=0,
            measure=measure,
        )
        self._lifted.append((group, np.asarray(outputs, dtype=np.intp)))
        return group

    def with_lifted(self, x: Array) -> Array:
        """The variables (n,) with those of :meth:`lift` made equal to what they stand for."""
        x = x.copy()
        for group, outputs in self._lifted:  # in order: a later one may be a function of an earlier one
            found = np.concatenate([out.ravel() for out in self.program.outputs(x).values()])[outputs]
            group.write(x, np.where(np.isfinite(found), found, 0.0))
        return x

    def equal(
        self,
        term: str,
        place: Place | str,
        components: Sequence[str],
        outputs: Any,
        measure: Measure | Sequence[Measure] | None = None,
    ) -> None:
        """Rows: outputs of blocks are zero."""
        self.rows.add(
            term=term,
            place=place,
            components=components,
            outputs=outputs,
            lower=0,
            upper=0,
            measure=measure,
        )

    def parts(self, block: str) -> dict[str, Any]:
        """Indices of the named slices of a block's output."""
        size = symbolic.sizes(self.coordinates, self.problem.target, block)
        offset = np.cumsum([0, *size.values()])
        return {k: np.arange(offset[i], offset[i + 1]) for i, k in enumerate(size)}

    def add_nodes(
        self, instances: list[list[Affine]], places: Sequence[Place | str], *, closed: int = 0
    ) -> list[Index]:
        """Nodes of the block ``node`` with their rows, but for those of torque; the torques' outputs.

        instances : y, y', y'', legs, sole wrench, T of each.  closed : so many of the last have the posture
        of another, whose rows close their legs.
        """
        c, part = self.coordinates, self.parts("node")
        limits, rates = self.robot.torque_limit, self.robot.velocity_limit[c.dependent]
        numbers = np.concatenate([limits, rates, self.units, c.start_determinants])
        first, torques = self.add_block("node", instances, numbers), []
        closure = [f"{leg.sole.name} sole {d}" for leg in c.legs for d in DIRECTIONS]
        fast = percent("over its limit", of=self.velocity.fraction)
        for i, (place, slots) in enumerate(zip(places, instances, strict=True)):
            at = first + i * self.blocks[-1].n_out
            for term, name, components, bound, measure in (
                ("closed legs", "closure", closure, 0.0, along(closure, "open")),
                (self.velocity.name, "leg_rate", c.leg_labels, self.velocity.fraction, fast),
                ("equation of motion of the base", "base", DIRECTIONS[: c.base], 0.0, self.unbalanced),
            ):
                if name == "closure" and i >= len(instances) - closed:
                    continue
                self.rows.add(
                    term=term,
                    place=place,
                    components=components,
                    outputs=at + part[name],
                    lower=-bound,
                    upper=bound,
                    measure=measure,
                )
            self.rows.add(
                term=self.extension.name,
                place=place,
                components=[f"{leg.sole.name} leg" for leg in c.legs],
                outputs=at + part["extension"],
                lower=self.extension.minimum,
                measure=percent("too near to straight", of=self.extension.minimum),
            )
            self.cone_rows(slots[4], place, self.cone.margin, self.cone.minimum_force)
            torques.append(at + part["torque"])
        return torques

    def cone_rows(self, wrench: Affine, place: Place | str, margin: float, minimum_force: float) -> None:
        """Rows: each sole's wrench (6 a sole) is in its cone, its normal force [N] no less than the least."""
        for k, leg in enumerate(self.coordinates.legs):
            w = wrench[6 * k : 6 * k + 6]
            rows = contact_wrench_cone(leg.sole.polygon, self.cone.friction, margin=margin) / self.weight
            normal, sole = w[2:3] * (1 / self.weight), f"{leg.sole.name} sole"
            self.rows.add(
                term=self.cone.name,
                place=place,
                components=[f"{sole}, facet {i}" for i in range(len(rows))],
                affine=w.apply(rows),
                lower=0,
                measure=[self._outside_cone(row * self.weight, normal) for row in rows],
                whole=sole,
            )
            self.rows.add(
                term="normal force",
                place=place,
                components=[sole],
                affine=normal,
                lower=minimum_force / self.weight,
                measure=Measure("N", self.weight, "too light"),
            )

    def _outside_cone(self, facet: Array, normal: Affine) -> Measure:
        """Of a facet (6,) of the cone of corners' forces; ``normal``: the normal force over the weight."""
        along_sole, tilting = np.hypot(*facet[:2]), np.hypot(*facet[3:5])
        if along_sole < 1e-9 and abs(facet[5]) < 1e-9:
            return Measure("mm", 1e3 / tilting, "outside", normal, 0.05)  # moment over force: the CoP
        if tilting < 1e-9 and abs(facet[5]) < 1e-9:
            return Measure("%", 100 / along_sole / self.cone.friction, "beyond its friction", normal, 0.05)
        return Measure("%", 100 / max(facet[2], 1e-3), "beyond its friction and torsion", normal, 0.05)
