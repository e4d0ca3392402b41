"""From an impact problem to a nonlinear program, and from its solution back to a plan.

Phases: swing (rest to contact), compression, restitution, follow-through (the predicted state after contact
to rest).  Swing and follow-through are cubic splines in the independent coordinates; their legs and sole
wrenches are variables of the nodes.  The two contact phases are Radau IIA collocation of the frozen dynamics
with their durations as variables.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from impactopt.codegen import cached, model_hash
from impactopt.cone import contact_wrench_cone, inward_edges
from impactopt.coordinates import StanceCoordinates
from impactopt.extra_terms import HitCone, HitRegion, TorqueRate
from impactopt.motion import CubicSpline, Radau, basis, graded_breaks, knots, rate_weights
from impactopt.nlp import blocks as symbolic
from impactopt.nlp.collision import DIRECTIONS, Collision
from impactopt.nlp.extra_blocks import ExtraBlock, extra_blocks
from impactopt.nlp.extra_terms import add_extra_terms
from impactopt.nlp.follow import FollowThrough
from impactopt.nlp.impulse import InstantImpact
from impactopt.nlp.layout import Affine, Array, Group, Layout, stack
from impactopt.nlp.mesh import collision_mesh, with_middles
from impactopt.nlp.objective import assemble, quantities
from impactopt.nlp.rows import (
    Index,
    Measure,
    Place,
    Rows,
    along,
    degrees,
    millimetres,
    percent,
    rates,
)
from impactopt.nlp.structured import Block, StructuredProgram, derivative_functions
from impactopt.objectives import AngularMomentum, Effort
from impactopt.plan import Plan, PlannedScenario
from impactopt.problem import ImpactProblem
from impactopt.statics import static_wrenches
from impactopt.support import support_polygon
from impactopt.terms import (
    Balance,
    ContactWrenchCone,
    Incidence,
    LegExtension,
    PositionLimit,
    TorqueLimit,
    VelocityLimit,
)

GRAVITY = 9.81
# the striking point stays this far behind the target [m], and less only at this speed [m/s] towards it: what
# hovers at the plane would touch it between the nodes
CLEARANCE, HASTE = 0.02, 0.04
LEVER = 0.1  # [m] scale of sole moments against forces
BASE_BOX = np.array([0.6, 0.6, 0.6, 0.8, 0.8, 1.2])  # [m, rad] how far the base may go from its start


def rotation_rows(normal: Array) -> Array:
    """(3, 3) rows: the normal and two tangents."""
    _, _, vt = np.linalg.svd(normal.reshape(1, 3))
    rows = np.vstack([normal, vt[1:]])
    return rows


def block_functions(
    problem: ImpactProblem, coordinates: StanceCoordinates, report: Callable[[str], None] | None = None
) -> dict[str, Any]:
    """The compiled blocks (value, Jacobian, Hessian) of a problem, from the cache where they are in it."""
    robot = problem.robot
    edges = len(support_polygon(robot, coordinates))
    recipe = (
        model_hash(robot.model),
        tuple(
            (leg.sole.frame, tuple(np.round(leg.placement.homogeneous.ravel(), 12)))
            for leg in coordinates.legs
        ),
        tuple(tuple(o.tolist()) for leg in coordinates.legs for o in leg.order),
        problem.striker,
        problem.law.formula(),
        edges,
    )
    out: dict[str, Any] = {}
    instant = problem.collision != "dynamics"
    builders = symbolic.builders(coordinates, problem.striker, problem.law, edges, instant=instant)
    found = {name: ExtraBlock((), build) for name, build in builders.items()}
    for name, block in {**found, **extra_blocks(problem, coordinates)}.items():

        def functions(block: ExtraBlock = block, name: str = name) -> list[Any]:
            b = block.build()
            return derivative_functions(name, b.z, b.p, b.out)

        out |= cached(f"{robot.name}-{name}", (name, *recipe, *block.key), functions, report=report)
    return out


class Transcription:
    """The program of one problem, with the groups that its solution is read from."""

    def __init__(
        self, problem: ImpactProblem, coordinates: StanceCoordinates, functions: dict[str, Any]
    ) -> None:
        self.problem, self.coordinates = problem, coordinates
        self.robot = problem.robot
        self.functions = functions
        self.weight = GRAVITY * float(sum(i.mass for i in self.robot.model.inertias))
        self.ny, self.nl, self.nw = coordinates.ny, coordinates.nl, 6 * len(coordinates.legs)
        self.y0, self.legs0 = coordinates.split(problem.start_posture)
        self.swing_breaks = graded_breaks(problem.swing.intervals, problem.swing.grading, fine_end=True)
        self.follow_breaks = graded_breaks(problem.follow.intervals, problem.follow.grading, fine_end=False)
        # nodes: ends and middles of the intervals; the swing's start is given
        self.swing_nodes = with_middles(self.swing_breaks)[1:]
        self.follow_nodes = with_middles(self.follow_breaks)
        self.stages = collision_mesh(problem.collision_elements, Radau.of_stages(problem.collision_stages))
        self.layout, self.rows = Layout(), Rows()
        self.blocks: list[Block] = []
        self._lifted: list[tuple[Group, Index]] = []
        self.torques: list[Affine] = []  # over limit, at each node of the block "node", if `torques_lifted`
        self.angular_momentum: Group | None = None  # after contact, if an objective asks for it
        self._limits()
        self._variables()
        self.contact_state = self.at(self.swing_control, self.swing_breaks, 1.0)
        self._swing_and_follow()
        self._contact()
        self._collisions()
        self._after()
        add_extra_terms(self)
        self.objectives = quantities(self)
        objective, quadratic, linear = assemble(self, self.objectives)
        self.program = StructuredProgram(
            self.layout, self.blocks, self.rows, objective=objective, quadratic=quadratic, linear=linear
        )

    # ------------------------------------------------------------------ variables
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

    def _variables(self) -> None:
        p, add = self.problem, self.layout.add
        c, ny, nl, nw = self.coordinates, self.ny, self.nl, self.nw
        ns, ms = p.swing.intervals, len(self.swing_nodes)
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
        self.swing_c = add("swing control point", ns - 1, ny, **self.of_y)
        self.swing_legs = add("swing legs", ms, nl, **self.of_legs)
        self.swing_w = add("swing sole wrench", ms, nw, **self.of_wrenches)
        limit = self.torque.fraction
        self.feedforward = add(
            "feed-forward at contact",
            1,
            self.robot.n,
            lower=-limit,
            upper=limit,
            labels=self.robot.joint_names,
        )
        self.swing_T = self.duration("swing duration", p.swing.duration, 0.1)
        self.u0 = add("rate at contact", 1, ny, labels=c.labels)
        self.collisions: list[Collision | InstantImpact]
        if p.collision == "dynamics":
            self.scenarios = [Collision(self, s) for s in p.scenarios if not s.missing]
            self.collisions = [Collision(self), *self.scenarios]
        else:
            self.scenarios, self.collisions = [], [InstantImpact(self)]
        self.follow = FollowThrough(self, "follow", "follow-through")
        self.brake_after = p.brake_after
        self.brake = FollowThrough(self, "brake", "brake") if self.brake_after is not None else None
        self.follows = [self.follow, *([self.brake] if self.brake is not None else [])]
        self.coast_w = add("coasting sole wrench", int(self.brake is not None), nw, **self.of_wrenches)

    def duration(self, name: str, bounds: tuple[float, float], scale: float) -> Group:
        return self.layout.add(name, 1, 1, lower=bounds[0], upper=bounds[1], scale=scale, labels=["T"])

    def swing_control(self, j: int) -> Affine:
        """Control point j = 0 .. N+2 of the swing.

        The first three make a start at rest, the last one an end without acceleration.
        The reference coasts from contact on, so the torque that the swing ends with is the feed-forward of
        the collision: it does not jump, and a target that comes late meets the same motion.
        """
        if j <= 2:
            return Affine.constant(self.y0)
        if j < self.problem.swing.intervals + 2:
            return self.swing_c[j - 3]
        factors = rate_weights(self.swing_breaks)
        step = self.swing_control(j - 1) - self.swing_control(j - 2)
        return self.swing_control(j - 1) + step * float(factors[-2] / factors[-1])

    def at(self, control: Callable[[int], Affine], breaks: Array, s: float) -> tuple[Affine, Affine, Affine]:
        """y, y', y'' at s of the spline with these control points."""
        out = []
        for weights in basis(breaks, s):
            expression = Affine.zeros(self.ny)
            for j in np.flatnonzero(weights[0]):
                expression = expression + control(int(j)) * weights[0, j]
            out.append(expression)
        return out[0], out[1], out[2]

    def swing_place(self, s: float) -> Place:
        return Place(f"swing, {100 * s:.0f} %", "swing at {s}", self.swing_T[0] * s)

    # ------------------------------------------------------------------ rows
    def add_block(self, name: str, instances: list[Any], parameters: Array) -> int:
        """Append a block; the index of its first output."""
        at = sum(b.count * b.n_out for b in self.blocks)
        self.blocks.append(Block.make(name, self.functions, instances, parameters))
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

    def _node_parameters(self) -> Array:
        c = self.coordinates
        rates = self.robot.velocity_limit[c.dependent]
        return np.concatenate([self.robot.torque_limit, rates, self.units, c.start_determinants])

    def _swing_and_follow(self) -> None:
        """Nodes of swing, contact (coasting) and follow-through: one block for all of them."""
        p = self.problem
        instances, places = [], []
        for k, at in enumerate(self.swing_nodes):
            y, y1, y2 = self.at(self.swing_control, self.swing_breaks, at)
            instances.append([y, y1, y2, self.swing_legs[k], self.swing_w[k], self.swing_T[0]])
            places.append(self.swing_place(at))
        for follow in self.follows:
            slots, names = follow.nodes()
            instances += slots
            places += names
        groups = [self.swing_w, *[follow.w for follow in self.follows]]
        if self.brake is not None:
            coasting, name = self.brake.coasting_node(self.coast_w)
            instances.append(coasting)
            places.append(name)
            groups.append(self.coast_w)
        self.add_block("node", instances, self._node_parameters())
        self._node_rows(places, self.blocks[-1].n_out)
        wrenches = [group[k] for group in groups for k in range(group.count)]
        for place, wrench in zip(places, wrenches, strict=True):
            self.cone_rows(wrench, place, self.cone.margin, self.cone.minimum_force)
        joints = np.arange(self.coordinates.base, self.ny)
        self.rows.add(
            term=self.position.name,
            place="contact",
            components=self.coordinates.labels[self.coordinates.base :],
            affine=self.contact_state[0][joints],
            lower=self.y_lower[joints],
            upper=self.y_upper[joints],
            measure=degrees("outside"),
        )
        # the first two velocity control points are zero by construction
        last = p.swing.intervals + 2
        self.rate_rows("swing", self.swing_control, range(2, last), self.swing_breaks, self.swing_T)
        for follow in self.follows:
            follow.add_rate_rows()

    @property
    def torques_lifted(self) -> bool:
        """Whether the torques at the nodes are variables, as something beside their limit asks for them."""
        p = self.problem
        return p.extra(TorqueRate) is not None or any(isinstance(o, Effort) for o in p.objectives)

    def _node_rows(self, places: list[Place], n_out: int) -> None:
        c, r = self.coordinates, self.robot
        part = self.parts("node")
        closure = [f"{leg.sole.name} sole {d}" for leg in c.legs for d in DIRECTIONS]
        fast = percent("over its limit", of=self.velocity.fraction)
        strong = percent("over its limit", of=self.torque.fraction)
        last = len(self.swing_nodes) - 1
        for i, place in enumerate(places):
            at = i * n_out
            for term, name, components, bound, measure in (
                ("closed legs", "closure", closure, 0.0, along(closure, "open")),
                (self.velocity.name, "leg_rate", c.leg_labels, self.velocity.fraction, fast),
                ("equation of motion of the base", "base", DIRECTIONS[: c.base], 0.0, self.unbalanced),
            ):
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
            if i == last:  # at contact it is the variable `feedforward`, which has the limit as its bounds
                self.torques.append(self.feedforward[0])
            elif self.torques_lifted:
                torque = self.lift(
                    f"torque, {place.name}",
                    at + part["torque"],
                    term=self.torque.name,
                    place=place,
                    measure=strong,
                    labels=r.joint_names,
                    lower=-self.torque.fraction,
                    upper=self.torque.fraction,
                )
                self.torques.append(torque[0])
            else:
                self.rows.add(
                    term=self.torque.name,
                    place=place,
                    components=r.joint_names,
                    outputs=at + part["torque"],
                    lower=-self.torque.fraction,
                    upper=self.torque.fraction,
                    measure=strong,
                )
        self.rows.add(
            term="feed-forward that makes the robot coast",
            place="contact",
            components=r.joint_names,
            outputs=last * n_out + part["torque"],
            affine=-self.feedforward[0],
            lower=0,
            upper=0,
            measure=percent("of the joint's limit off"),
        )

    def cone_rows(self, wrench: Affine, place: Place, margin: float, minimum_force: float) -> None:
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

    def rate_rows(
        self, phase: str, control: Callable[[int], Affine], js: range, breaks: Array, duration: Group
    ) -> None:
        """Velocity control points within the limit; multiplied by T they are linear."""
        c = self.coordinates
        joints = np.arange(c.base, c.ny)
        limit = self.rate_limit[c.independent]
        names = c.labels[c.base :]
        factors = rate_weights(breaks)
        shortest, longest = self.layout.bounds(duration)
        fixed = shortest == longest
        for j in js:
            step = (control(j + 1) - control(j))[joints] * (factors[j] / limit)
            # where the velocity's control point pulls most: the mean of its knots
            s = float(knots(breaks)[j + 2 : j + 4].mean())
            name = f"{phase}, control point {j}"
            place = Place(name, f"{phase} at about {{s}}", duration[0] * s)
            fast = Measure("%", 100.0, "over its limit", duration[0])
            if fixed:
                bound = float(longest)
                self.rows.add(
                    term=self.velocity.name,
                    place=place,
                    components=names,
                    affine=step,
                    lower=-bound,
                    upper=bound,
                    measure=fast,
                )
                continue
            time = stack([duration[0]] * len(joints))
            for sign, way in ((1.0, "forward"), (-1.0, "backward")):
                self.rows.add(
                    term=self.velocity.name,
                    place=replace(place, name=f"{name}, {way}"),
                    components=names,
                    affine=step * sign - time,
                    upper=0,
                    measure=fast,
                )

    def _contact(self) -> None:
        p = self.problem
        y, y1, _ = self.contact_state
        at = self.add_block("contact", [[y, y1, self.swing_T[0]]], rotation_rows(p.normal).ravel())
        if p.extra(HitRegion) is None:
            self.rows.add(
                term="hit point",
                place=Place("contact", ""),
                components=["x", "y", "z"],
                outputs=at + np.arange(3),
                lower=p.point,
                upper=p.point,
                measure=millimetres("away"),
            )
        self.rows.add(
            term="approach speed",
            place="contact",
            components=["normal"],
            outputs=np.array([at + 3]),
            lower=0.05,
            measure=Measure("m/s", 1.0, "too slow"),
        )
        if p.extra(HitCone) is None:
            self.rows.add(
                term=self.incidence.name,
                place="contact",
                components=["tangent 1", "tangent 2"],
                outputs=at + np.array([4, 5]),
                lower=-self.incidence.speed,
                upper=self.incidence.speed,
                measure=Measure("m/s", 1.0, "too fast across the normal"),
                whole="",
            )
        nodes = self.swing_nodes[:-1]
        instances = [[self.at(self.swing_control, self.swing_breaks, s)[0]] for s in nodes]
        at = self.add_block("approach", instances, p.normal)
        plane, ahead = float(p.normal @ p.point), float(np.mean(p.swing.duration))
        nearest = min(CLEARANCE, self._start_gap())
        for i, s in enumerate(nodes):
            self.rows.add(
                term="no touch before contact",
                place=self.swing_place(s),
                components=[p.striker],
                outputs=np.array([at + i]),
                upper=plane - min(nearest, HASTE * (1 - s) * ahead),
                measure=millimetres("too near"),
            )

    def _start_gap(self) -> float:
        """How far [m] behind the target's plane the striking point starts: it may stay as near as that."""
        p, c = self.problem, self.coordinates
        pin.framesForwardKinematics(c.model, c.data, p.start_posture)
        at = c.data.oMf[c.model.getFrameId(f"striker:{p.striker}")].translation
        return max(float(p.normal @ (p.point - at)), 0.0)

    def _collisions(self) -> None:
        """One block for all collisions, each with its rows."""
        slots: dict[str, list[Any]] = {}
        parameters: dict[str, list[Any]] = {}
        first: list[dict[str, int]] = []
        for collision in self.collisions:
            found = collision.instances()
            first.append({name: len(slots.get(name, ())) for name in found})
            for name, (instances, numbers) in found.items():
                slots.setdefault(name, []).extend(instances)
                parameters.setdefault(name, []).extend(numbers)
        at = {name: self.add_block(name, slots[name], np.array(parameters[name])) for name in slots}
        sizes = {block.name: block.n_out for block in self.blocks}
        expected = self.collisions[0]
        if isinstance(expected, Collision):
            self.deepest = at["force"] + expected.end[0] * sizes["force"] + self.parts("force")["penetration"]
        for collision, index in zip(self.collisions, first, strict=True):
            collision.add_rows({name: (at[name] + k * sizes[name], sizes[name]) for name, k in index.items()})

    def parts(self, block: str) -> dict[str, Any]:
        """Indices of the named slices of a block's output."""
        size = symbolic.sizes(self.coordinates, block)
        offset = np.cumsum([0, *size.values()])
        return {k: np.arange(offset[i], offset[i + 1]) for i, k in enumerate(size)}

    def _after(self) -> None:
        """What comes after contact: the follow-through starts there, and the robot keeps its balance."""
        yf, yf1 = self.follow.start
        instances = self.collisions[0].link((yf, yf1, self.follow.T[0]))
        one = Affine.constant(1.0)
        for other in self.scenarios:
            instances += other.link((other.after[0], other.u[other.end[1]], one))
        if self.brake is not None and self.brake_after is not None:
            instances += self.brake.link_from_coasting(self.brake_after)
        at = self.add_block("link", instances, np.zeros(0))
        labels, places = self.coordinates.labels, at + 3 * np.arange(self.ny)
        far, fast = along(labels, "off"), rates(labels)
        self.equal("collision starts from the swing's end", "rate", labels, places, fast)
        self.equal("follow-through starts from the predicted state", "position", labels, places + 1, far)
        self.equal("follow-through starts from the predicted state", "rate", labels, places + 2, fast)
        if self.brake is not None:
            after = places + 3 * self.ny * (1 + len(self.scenarios))
            self.equal("brake starts where coasting ends", "position", labels, after + 1, far)
            self.equal("brake starts where coasting ends", "rate", labels, after + 2, fast)
        for k, other in enumerate(self.scenarios, start=1):
            place = f"position{other.suffix}"
            self.equal("state after contact", place, labels, places + 1 + 3 * self.ny * k, far)
        if self.coordinates.legs:
            self._balance_rows(yf, yf1)

    def _balance_rows(self, yf: Affine, yf1: Affine) -> None:
        margin, one = self.balance.capture_margin, Affine.constant(1.0)
        y, y1, _ = self.contact_state
        found = [([yf, yf1, self.follow.legs[0], self.follow.T[0]], margin, "after contact")]
        for other in self.scenarios:
            slots = [other.after[0], other.u[other.end[1]], other.legs[other.end[1]], one]
            assert other.scenario is not None
            found.append((slots, other.scenario.capture_margin, f"after contact{other.suffix}"))
        for s in self.problem.scenarios:
            if s.missing:
                slots = [y, y1, self.swing_legs[-1], self.swing_T[0]]
                found.append((slots, s.capture_margin, f"contact, if {s.name}"))
        inward, offset = inward_edges(support_polygon(self.robot, self.coordinates))
        parameters = [np.column_stack([inward, offset + (m or 0.0)]).ravel() for _, m, _ in found]
        at = self.add_block("balance", [slots for slots, _, _ in found], np.array(parameters))
        k = len(inward)
        wanted = any(isinstance(o, AngularMomentum) for o in self.problem.objectives)
        for i, (_, margin, place) in enumerate(found):
            start = at + i * (k + 4)
            if margin is not None:
                self.rows.add(
                    term="capture point",
                    place=place,
                    components=[f"edge {e}" for e in range(k)],
                    outputs=start + np.arange(k),
                    lower=0,
                    measure=millimetres("outside"),
                    whole="",
                )
            slow, still = self.balance.vertical_speed, self.balance.angular_momentum
            self.rows.add(
                term="vertical speed",
                place=place,
                components=["z"],
                outputs=np.array([start + k]),
                lower=-slow,
                upper=slow,
                measure=Measure("m/s", 1.0, "too fast"),
            )
            outputs, turning = start + k + 1 + np.arange(3), Measure("N m s", 1.0, "too much")
            if wanted and i == 0:
                self.angular_momentum = self.lift(
                    "angular momentum",
                    outputs,
                    place=place,
                    labels=["x", "y", "z"],
                    measure=turning,
                    lower=-still,
                    upper=still,
                )
                continue
            self.rows.add(
                term="angular momentum",
                place=place,
                components=["x", "y", "z"],
                outputs=outputs,
                lower=-still,
                upper=still,
                measure=turning,
            )

    def link_slots(
        self,
        start: tuple[Affine, Affine, Affine],
        times: tuple[Affine, Affine],
        travel: tuple[Affine, Affine],
        rate: Affine,
    ) -> list[list[Affine]]:
        """Slots of the block ``link``, coordinate by coordinate: from the state at contact to a later start.

        start : y and d y/ds of what starts, and its duration [s].  times [s], travel : of two phases between,
        whose ways are time x travel.  rate : ydot after them.
        """
        y, y1, _ = self.contact_state
        out = []
        for k in range(self.ny):
            yk, rk, a, b, one, two, u0, u = (
                e[k : k + 1] for e in (*start[:2], y, y1, *travel, self.u0[0], rate)
            )
            out.append([yk, rk, start[2], a, b, self.swing_T[0], *times, one, two, u0, u])
        return out

    # ------------------------------------------------------------------ solution
    def spline(
        self, x: Array, control: Callable[[int], Affine], breaks: Array, duration: Group
    ) -> CubicSpline:
        """The spline that solver variables (n,) stand for."""
        points = np.array([control(j).evaluate(x) for j in range(len(breaks) + 2)])
        return CubicSpline(control=points, breaks=breaks, duration=float(duration.read(x)[0, 0]))

    def achieved(self, x: Array) -> dict[str, float]:
        """What the objectives' quantities come to, by their names, for solver variables (n,)."""
        return {o.name: quantity.evaluate(x) for o, quantity in self.objectives}

    def decode(self, x: Array) -> Plan:
        """The plan that solver variables (n,) stand for."""
        p, c = self.problem, self.coordinates

        swing = self.spline(x, self.swing_control, self.swing_breaks, self.swing_T)
        follow, follow_w = self.follow.decode(x)
        brake, brake_w = self.brake.decode(x) if self.brake is not None else (None, None)
        outputs = self.program.outputs(x)
        approach = float(outputs["contact"][0, 3])
        expected = self.collisions[0]
        compression, restitution = expected.durations(x)
        swing_w = self.swing_w.read(x)
        start_w = static_wrenches(c, self.y0, self.legs0)
        return Plan(
            problem=p,
            swing=swing,
            follow=follow,
            compression=compression,
            restitution=restitution,
            swing_nodes=np.concatenate([[0.0], self.swing_nodes]),
            swing_wrench=np.vstack([start_w, swing_w]),
            follow_nodes=self.follow_nodes,
            follow_wrench=follow_w,
            brake=brake,
            brake_wrench=brake_w,
            collision=expected.decode(x, outputs, approach),
            hand_speed=approach,
            impulse=float(expected.impulse.evaluate(x)[0]),
            scenarios=tuple(self._decode_scenario(other, x, outputs, approach) for other in self.scenarios),
        )

    def _decode_scenario(
        self, other: Collision, x: Array, outputs: dict[str, Array], approach: float
    ) -> PlannedScenario:
        assert other.scenario is not None
        return PlannedScenario(
            name=other.scenario.name,
            impulse=float(other.impulse.evaluate(x)[0]),
            collision=other.decode(x, outputs, approach),
        )
