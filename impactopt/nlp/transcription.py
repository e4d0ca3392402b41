"""From an impact problem to a nonlinear program, and from its solution back to a plan.

Phases: swing (rest to contact), compression, restitution, follow-through (the predicted state after contact
to rest).  Swing and follow-through are cubic splines in the independent coordinates; their legs and sole
wrenches are variables of the nodes.  The two contact phases are Radau IIA collocation of the frozen dynamics
with their durations as variables.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp

from impactopt.codegen import cached, model_hash
from impactopt.cone import contact_wrench_cone, inward_edges
from impactopt.coordinates import StanceCoordinates
from impactopt.motion import CubicSpline, Radau, basis, graded_breaks, rate_weights
from impactopt.nlp import blocks as symbolic
from impactopt.nlp.layout import Affine, Array, Group, Layout, stack
from impactopt.nlp.structured import Block, Rows, StructuredProgram, derivative_functions
from impactopt.plan import Plan, PlannedCollision, total_ground_wrench
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
DIRECTIONS = ("x", "y", "z", "roll", "pitch", "yaw")
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
    for name, build in symbolic.builders(coordinates, problem.striker, problem.law, edges).items():

        def functions(build: Callable[[], symbolic.BlockExpression] = build, name: str = name) -> list[Any]:
            b = build()
            return derivative_functions(name, b.z, b.p, b.out)

        out |= cached(f"{robot.name}-{name}", (name, *recipe), functions, report=report)
    return out


@dataclass(frozen=True)
class Stage:
    """One collocation point of the collision."""

    phase: int  # 0 compression, 1 restitution
    place: float  # s in the phase
    weights: Array  # (stages,) of this element's stages in u', d u/ds
    start: float  # weight of the element's start value in u'
    members: tuple[int, ...]  # indices of this element's stages
    previous: int  # index of the stage the element starts from, -1 at contact
    quadrature: Array  # (stages,) weights of the element's u in d
    new_phase: bool  # the element begins a phase, so d starts from zero


def collision_mesh(elements: tuple[tuple[float, ...], tuple[float, ...]], radau: Radau) -> list[Stage]:
    """Stages of both contact phases; ``elements`` are the elements' lengths as fractions of each phase."""
    inverse = np.linalg.inv(radau.a)
    stages: list[Stage] = []
    for phase, lengths in enumerate(elements):
        s = 0.0
        for e, h in enumerate(lengths):
            first = len(stages)
            members = tuple(range(first, first + len(radau.c)))
            for i, c in enumerate(radau.c):
                stages.append(
                    Stage(
                        phase,
                        s + c * h,
                        inverse[i] / h,
                        -float(inverse[i].sum()) / h,
                        members,
                        first - 1,
                        radau.a[i] * h,
                        e == 0,
                    )
                )
            s += h
    return stages


def with_middles(breaks: Array) -> Array:
    """Breaks and the middles between them, in order."""
    return np.sort(np.concatenate([breaks, (breaks[1:] + breaks[:-1]) / 2]))


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
        self.end = [max(i for i, s in enumerate(self.stages) if s.phase == p) for p in (0, 1)]
        self.layout, self.rows = Layout(), Rows()
        self.blocks: list[Block] = []
        self._limits()
        self._variables()
        self.contact_state = self.at(self.swing_control, self.swing_breaks, 1.0)
        self._swing_and_follow()
        self._contact()
        self._collision()
        self._after()
        objective, quadratic, linear = self._objective()
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
        self.wrench_scale = self.weight * np.array([1, 1, 1, LEVER, LEVER, LEVER] * len(c.legs))

    def _variables(self) -> None:
        p, add = self.problem, self.layout.add
        c, ny, nl, nw = self.coordinates, self.ny, self.nl, self.nw
        ns, nf, nc = p.swing.intervals, p.follow.intervals, len(self.stages)
        ms, mf = len(self.swing_nodes), len(self.follow_nodes)
        wrench_labels = [
            f"{leg.sole.name} sole {k}" for leg in c.legs for k in ("fx", "fy", "fz", "mx", "my", "mz")
        ]
        y: dict[str, Any] = {"lower": self.y_lower, "upper": self.y_upper, "labels": c.labels}
        legs: dict[str, Any] = {"lower": self.legs_lower, "upper": self.legs_upper, "labels": c.leg_labels}
        w: dict[str, Any] = {"scale": self.wrench_scale, "labels": wrench_labels}
        self.swing_c = add("swing control point", ns - 1, ny, **y)
        self.swing_legs = add("swing legs", ms, nl, **legs)
        self.swing_w = add("swing sole wrench", ms, nw, **w)
        limit = self.torque.fraction
        self.feedforward = add(
            "feed-forward at contact",
            1,
            self.robot.n,
            lower=-limit,
            upper=limit,
            labels=self.robot.joint_names,
        )
        self.swing_T = self._duration("swing duration", p.swing.duration, 0.1)
        self.phase_T = [
            self._duration(f"{name} duration", p.contact_duration, 0.01)
            for name in ("compression", "restitution")
        ]
        self.u0 = add("rate at contact", 1, ny, labels=c.labels)
        self.coast_legs = add("coasting legs", nc, nl, labels=c.leg_labels)
        self.coast_rates = add("coasting leg rates", nc, nl, labels=c.leg_labels)
        self.u = add("collision rate", nc, ny, labels=c.labels)
        self.d = add("collision travel", nc, ny, labels=c.labels)
        self.hit_legs = add("collision legs", nc, nl, **legs)
        self.f = add("contact force", nc, 1, scale=symbolic.FORCE_SCALE)
        self.vt = add("target speed", nc, 1)
        self.xt = add("target travel", nc, 1)
        self.hit_w = add("collision sole wrench", nc, nw, **w)
        self.follow_c = add("follow control point", nf + 1, ny, **y)
        self.follow_legs = add("follow legs", mf, nl, **legs)
        self.follow_w = add("follow sole wrench", mf, nw, **w)
        self.follow_T = self._duration("follow duration", p.follow.duration, 0.1)

    def _duration(self, name: str, bounds: tuple[float, float], scale: float) -> Group:
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

    def follow_control(self, j: int) -> Affine:
        """Control point j = 0 .. N+2 of the follow-through; the last three coincide: it ends at rest."""
        return self.follow_c[min(j, self.follow_c.count - 1)]

    def at(self, control: Callable[[int], Affine], breaks: Array, s: float) -> tuple[Affine, Affine, Affine]:
        """y, y', y'' at s of the spline with these control points."""
        out = []
        for weights in basis(breaks, s):
            expression = Affine.zeros(self.ny)
            for j in np.flatnonzero(weights[0]):
                expression = expression + control(int(j)) * weights[0, j]
            out.append(expression)
        return out[0], out[1], out[2]

    # ------------------------------------------------------------------ rows
    def _node_parameters(self) -> Array:
        c = self.coordinates
        rates = self.robot.velocity_limit[c.dependent]
        return np.concatenate([self.robot.torque_limit, rates, [self.weight, LEVER], c.start_determinants])

    def _swing_and_follow(self) -> None:
        """Nodes of swing, contact (coasting) and follow-through: one block for all of them."""
        p = self.problem
        instances, places = [], []
        for k, at in enumerate(self.swing_nodes):
            y, y1, y2 = self.at(self.swing_control, self.swing_breaks, at)
            instances.append([y, y1, y2, self.swing_legs[k], self.swing_w[k], self.swing_T[0]])
            places.append(f"swing, {100 * at:.0f} %")
        for k, at in enumerate(self.follow_nodes):
            y, y1, y2 = self.at(self.follow_control, self.follow_breaks, at)
            instances.append([y, y1, y2, self.follow_legs[k], self.follow_w[k], self.follow_T[0]])
            places.append(f"follow-through, {100 * at:.0f} %")
        block = Block.make("node", self.functions, instances, self._node_parameters())
        self.blocks.append(block)
        self._node_rows(places, block.n_out)
        wrenches = [group[k] for group in (self.swing_w, self.follow_w) for k in range(group.count)]
        for place, wrench in zip(places, wrenches, strict=True):
            self._cone_rows(wrench, place, self.cone.margin)
        joints = np.arange(self.coordinates.base, self.ny)
        self.rows.add(
            term=self.position.name,
            place="contact",
            components=self.coordinates.labels[self.coordinates.base :],
            affine=self.contact_state[0][joints],
            lower=self.y_lower[joints],
            upper=self.y_upper[joints],
        )
        # the first two and the last two velocity control points are zero by construction
        last = [p.swing.intervals + 2, p.follow.intervals]
        self._rate_rows("swing", self.swing_control, range(2, last[0]), self.swing_breaks, self.swing_T)
        self._rate_rows(
            "follow-through", self.follow_control, range(last[1]), self.follow_breaks, self.follow_T
        )

    def _node_rows(self, places: list[str], n_out: int) -> None:
        c, r = self.coordinates, self.robot
        part = self._parts("node")
        closure = [f"{leg.sole.name} sole {d}" for leg in c.legs for d in DIRECTIONS]
        last = len(self.swing_nodes) - 1
        for i, place in enumerate(places):
            at = i * n_out
            for term, name, components, bound in (
                ("closed legs", "closure", closure, 0.0),
                (self.velocity.name, "leg_rate", c.leg_labels, self.velocity.fraction),
                ("equation of motion of the base", "base", DIRECTIONS[: c.base], 0.0),
            ):
                self.rows.add(
                    term=term,
                    place=place,
                    components=components,
                    outputs=at + part[name],
                    lower=-bound,
                    upper=bound,
                )
            self.rows.add(
                term=self.extension.name,
                place=place,
                components=[f"{leg.sole.name} leg" for leg in c.legs],
                outputs=at + part["extension"],
                lower=self.extension.minimum,
            )
            if i != last:  # at contact it is the variable `feedforward`, which has the limit as its bounds
                self.rows.add(
                    term=self.torque.name,
                    place=place,
                    components=r.joint_names,
                    outputs=at + part["torque"],
                    lower=-self.torque.fraction,
                    upper=self.torque.fraction,
                )
        self.rows.add(
            term="feed-forward that makes the robot coast",
            place="contact",
            components=r.joint_names,
            outputs=last * n_out + part["torque"],
            affine=-self.feedforward[0],
            lower=0,
            upper=0,
        )

    def _cone_rows(self, wrench: Affine, place: str, margin: float) -> None:
        for k, leg in enumerate(self.coordinates.legs):
            w = wrench[6 * k : 6 * k + 6]
            rows = contact_wrench_cone(leg.sole.polygon, self.cone.friction, margin=margin) / self.weight
            self.rows.add(
                term=self.cone.name,
                place=place,
                components=[f"{leg.sole.name} sole, facet {i}" for i in range(len(rows))],
                affine=w.apply(rows),
                lower=0,
            )
            self.rows.add(
                term="normal force",
                place=place,
                components=[f"{leg.sole.name} sole"],
                affine=w[2:3] * (1 / self.weight),
                lower=self.cone.minimum_force / self.weight,
            )

    def _rate_rows(
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
            place = f"{phase}, control point {j}"
            if fixed:
                bound = float(longest)
                self.rows.add(
                    term=self.velocity.name,
                    place=place,
                    components=names,
                    affine=step,
                    lower=-bound,
                    upper=bound,
                )
                continue
            time = stack([duration[0]] * len(joints))
            for sign, way in ((1.0, "forward"), (-1.0, "backward")):
                self.rows.add(
                    term=self.velocity.name,
                    place=f"{place}, {way}",
                    components=names,
                    affine=step * sign - time,
                    upper=0,
                )

    def _contact(self) -> None:
        p = self.problem
        y, y1, _ = self.contact_state
        at = sum(b.count * b.n_out for b in self.blocks)
        block = Block.make(
            "contact", self.functions, [[y, y1, self.swing_T[0]]], rotation_rows(p.normal).ravel()
        )
        self.blocks.append(block)
        self.rows.add(
            term="hit point",
            place="contact",
            components=["x", "y", "z"],
            outputs=at + np.arange(3),
            lower=p.point,
            upper=p.point,
        )
        self.rows.add(
            term="approach speed",
            place="contact",
            components=["normal"],
            outputs=np.array([at + 3]),
            lower=0.05,
        )
        self.rows.add(
            term=self.incidence.name,
            place="contact",
            components=["tangent 1", "tangent 2"],
            outputs=at + np.array([4, 5]),
            lower=-self.incidence.speed,
            upper=self.incidence.speed,
        )
        at += block.n_out
        nodes = self.swing_nodes[:-1]
        instances = [[self.at(self.swing_control, self.swing_breaks, s)[0]] for s in nodes]
        block = Block.make("approach", self.functions, instances, p.normal)
        self.blocks.append(block)
        for i, s in enumerate(nodes):
            self.rows.add(
                term="no touch before contact",
                place=f"swing, {100 * s:.0f} %",
                components=[p.striker],
                outputs=np.array([at + i]),
                upper=float(p.normal @ p.point),
            )

    def _stage_slots(self, group: Group, i: int, start: Affine) -> tuple[Affine, Affine]:
        """Value and d/ds of a collocated group (u or target speed) at stage i.

        ``start``: its value at contact.
        """
        s = self.stages[i]
        slope = Affine.zeros(group.size)
        for m, w in zip(s.members, s.weights, strict=True):
            slope = slope + group[m] * w
        before = group[s.previous] if s.previous >= 0 else start
        return group[i], slope + before * s.start

    def _collision(self) -> None:
        p, r, c = self.problem, self.robot, self.coordinates
        y, _, _ = self.contact_state
        u0 = self.u0[0]
        zero, none = Affine.zeros(self.ny), Affine.zeros(1)
        coasting, collision, force, coasting_p, collision_p, force_p = [], [], [], [], [], []
        gains = np.concatenate([r.kp, r.kd, r.torque_limit, [self.weight, LEVER]])
        for i, s in enumerate(self.stages):
            u, u1 = self._stage_slots(self.u, i, u0)
            v, v1 = self._stage_slots(self.vt, i, none)
            T = self.phase_T[s.phase][0]
            T1 = self.phase_T[0][0] if s.phase else none
            d1 = self.d[self.end[0]] if s.phase else zero
            x1 = self.xt[self.end[0]] if s.phase else none
            coast = [self.coast_legs[i], self.coast_rates[i]]
            travel = [d1, T1, self.d[i], T]
            coasting.append([y, u0, T1, T, *coast])
            coasting_p.append([s.place, float(s.phase)])
            ff, hit = self.feedforward[0], [self.hit_legs[i], self.f[i], self.hit_w[i]]
            collision.append([y, u0, *coast, ff, *travel, u, u1, *hit])
            force.append([y, *travel, u, self.f[i], v, v1, self.xt[i], x1])
            collision_p.append(np.concatenate([p.normal, [s.place, float(s.phase)], gains]))
            force_p.append(
                [*p.point, *p.normal, float(s.phase), 1 / p.target.mass, *p.law.parameters.values()]
            )
            self._integral_rows(i)
        at = sum(b.count * b.n_out for b in self.blocks)
        if c.legs:
            block = Block.make("coasting", self.functions, coasting, np.array(coasting_p))
            self.blocks.append(block)
            names = [f"{leg.sole.name} sole {d}" for leg in c.legs for d in DIRECTIONS]
            for i in range(block.count):
                self.rows.add(
                    term="legs of the coasting reference",
                    place=self.stage_name(i),
                    components=[*names, *[f"{n} rate" for n in names]],
                    outputs=at + i * block.n_out + np.arange(block.n_out),
                    lower=0,
                    upper=0,
                )
            at += block.count * block.n_out
        block = Block.make("collision", self.functions, collision, np.array(collision_p))
        self.blocks.append(block)
        self._collision_rows(at, block.n_out)
        at += block.count * block.n_out
        block = Block.make("force", self.functions, force, np.array(force_p))
        self.blocks.append(block)
        self._force_rows(at, block.n_out)

    def _integral_rows(self, i: int) -> None:
        """d and the target's travel are the integrals of u and of the target's speed in the phase so far."""
        s = self.stages[i]
        names = self.coordinates.labels
        for term, integral, rate, labels in (
            ("collision kinematics", self.d, self.u, names),
            ("target kinematics", self.xt, self.vt, ("target",)),
        ):
            expression = integral[i]
            for m, w in zip(s.members, s.quadrature, strict=True):
                expression = expression - rate[m] * w
            if not s.new_phase:
                expression = expression - integral[s.previous]
            self.rows.add(
                term=term, place=self.stage_name(i), components=labels, affine=expression, lower=0, upper=0
            )

    def stage_name(self, i: int) -> str:
        s = self.stages[i]
        return f"{('compression', 'restitution')[s.phase]}, {100 * s.place:.0f} %"

    def _collision_rows(self, at: int, n_out: int) -> None:
        c, r = self.coordinates, self.robot
        part = self._parts("collision")
        directions = DIRECTIONS[: c.base]
        closure = [f"{leg.sole.name} sole {d}" for leg in c.legs for d in DIRECTIONS]
        for i in range(len(self.stages)):
            start, place = at + i * n_out, self.stage_name(i)
            for term, name, components in (
                ("closed legs", "closure", closure),
                ("collision dynamics", "base", directions),
                ("collision dynamics", "joints", r.joint_names),
            ):
                self.rows.add(
                    term=term,
                    place=place,
                    components=components,
                    outputs=start + part[name],
                    lower=0,
                    upper=0,
                )
            self.rows.add(
                term=f"{self.torque.name} in collision",
                place=place,
                components=r.joint_names,
                outputs=start + part["torque"],
                lower=-self.torque.collision,
                upper=self.torque.collision,
            )
            self._cone_rows(self.hit_w[i], f"collision, {place}", self.cone.collision_margin)

    def _parts(self, block: str) -> dict[str, Any]:
        """Indices of the named slices of a block's output."""
        size = symbolic.sizes(self.coordinates, block)
        offset = np.cumsum([0, *size.values()])
        return {k: np.arange(offset[i], offset[i + 1]) for i, k in enumerate(size)}

    def _force_rows(self, at: int, n_out: int) -> None:
        for i in range(len(self.stages)):
            start, place = at + i * n_out, self.stage_name(i)
            self.rows.add(
                term="contact law",
                place=place,
                components=["force"],
                outputs=np.array([start]),
                lower=0,
                upper=0,
            )
            self.rows.add(
                term="target's motion",
                place=place,
                components=["speed"],
                outputs=np.array([start + 1]),
                lower=0,
                upper=0,
            )
        self.rows.add(
            term="end of compression",
            components=["approach speed"],
            outputs=np.array([at + self.end[0] * n_out + 2]),
            lower=0,
            upper=0,
        )
        self.rows.add(
            term="separation",
            components=["penetration"],
            outputs=np.array([at + self.end[1] * n_out + 3]),
            lower=0,
            upper=0,
        )

    def _after(self) -> None:
        c = self.coordinates
        y, y1, _ = self.contact_state
        yf, yf1, _ = self.at(self.follow_control, self.follow_breaks, 0.0)
        d1, d2, u = self.d[self.end[0]], self.d[self.end[1]], self.u[self.end[1]]
        times = [self.swing_T[0], self.phase_T[0][0], self.phase_T[1][0]]
        instances = []
        for k in range(self.ny):
            yf_k, yf1_k, y_k, y1_k, d1_k, d2_k, u0_k, u_k = (
                e[k : k + 1] for e in (yf, yf1, y, y1, d1, d2, self.u0[0], u)
            )
            instances.append([yf_k, yf1_k, self.follow_T[0], y_k, y1_k, *times, d1_k, d2_k, u0_k, u_k])
        at = sum(b.count * b.n_out for b in self.blocks)
        block = Block.make("link", self.functions, instances, np.zeros(0))
        self.blocks.append(block)
        for k, (term, what) in enumerate(
            (
                ("collision starts from the swing's end", "rate"),
                ("follow-through starts from the predicted state", "position"),
                ("follow-through starts from the predicted state", "rate"),
            )
        ):
            self.rows.add(
                term=term,
                place=what,
                components=c.labels,
                outputs=at + k + 3 * np.arange(self.ny),
                lower=0,
                upper=0,
            )
        if not c.legs:
            return
        at += block.count * block.n_out
        inward, offset = inward_edges(support_polygon(self.robot, c))
        edges = np.column_stack([inward, offset + self.balance.capture_margin])
        instance = [yf, yf1, self.follow_legs[0], self.follow_T[0]]
        self.blocks.append(Block.make("balance", self.functions, [instance], edges.ravel()))
        k = len(edges)
        self.rows.add(
            term="capture point",
            place="after contact",
            components=[f"edge {i}" for i in range(k)],
            outputs=at + np.arange(k),
            lower=0,
        )
        limits = (self.balance.vertical_speed, *[self.balance.angular_momentum] * 3)
        for i, (term, component, limit) in enumerate(
            zip(("vertical speed", *["angular momentum"] * 3), ("z", "x", "y", "z"), limits, strict=True)
        ):
            self.rows.add(
                term=term,
                place="after contact",
                components=[component],
                outputs=np.array([at + k + i]),
                lower=-limit,
                upper=limit,
            )

    # ------------------------------------------------------------------ objective
    def _objective(self) -> tuple[Affine, Any, Array]:
        """- impulse [N s], plus a small price on accelerations and on sole wrenches.

        The price makes the optimum unique.
        """
        p, n = self.problem, self.layout.n
        impulse = self.vt[self.end[1]] * p.target.mass
        quadratic = sp.csr_array((n, n))
        linear = np.zeros(n)
        for control, breaks, nodes, bounds in (
            (self.swing_control, self.swing_breaks, self.swing_nodes, p.swing.duration),
            (self.follow_control, self.follow_breaks, self.follow_nodes, p.follow.duration),
        ):
            typical = float(np.mean(bounds))
            lengths = np.gradient(nodes)
            for at, length in zip(nodes, lengths, strict=True):
                acc = self.at(control, breaks, at)[2] * (1 / typical**2)
                weight = p.smoothness * typical * length
                m = acc.matrix(n)
                quadratic = quadratic + 2 * weight * (m.T @ m)
                linear += 2 * weight * (m.T @ acc.const)
        diagonal = np.zeros(n)
        for group in (self.swing_w, self.follow_w, self.hit_w):
            span = slice(group.offset, group.offset + group.count * group.size)
            diagonal[span] = p.wrench_price / max(1, group.count)
        end = self.follow_c.index(-1)  # price (y_end - y_start)^2: rest near the start posture
        diagonal[end] += 2 * p.return_price
        linear[end] -= 2 * p.return_price * self.y0
        away = Affine.constant(p.return_price * float(self.y0 @ self.y0))
        return away - impulse, quadratic + sp.diags_array(diagonal), linear

    # ------------------------------------------------------------------ solution
    def decode(self, x: Array) -> Plan:
        """The plan that solver variables (n,) stand for."""
        p, c = self.problem, self.coordinates

        def spline(source: Callable[[int], Affine], breaks: Array, duration: Group) -> CubicSpline:
            control = np.array([source(j).evaluate(x) for j in range(len(breaks) + 2)])
            return CubicSpline(control=control, breaks=breaks, duration=float(duration.read(x)[0, 0]))

        swing = spline(self.swing_control, self.swing_breaks, self.swing_T)
        follow = spline(self.follow_control, self.follow_breaks, self.follow_T)
        durations = [float(g.read(x)[0, 0]) for g in self.phase_T]
        outputs = self.program.outputs(x)
        approach = float(outputs["contact"][0, 3])
        swing_w = self.swing_w.read(x)
        start_w = static_wrenches(c, self.y0, self.legs0)
        return Plan(
            problem=p,
            swing=swing,
            follow=follow,
            compression=durations[0],
            restitution=durations[1],
            swing_nodes=np.concatenate([[0.0], self.swing_nodes]),
            swing_wrench=np.vstack([start_w, swing_w]),
            follow_nodes=self.follow_nodes,
            follow_wrench=self.follow_w.read(x),
            collision=self._decode_collision(x, outputs, approach, durations),
            hand_speed=approach,
            impulse=float(self.vt.read(x)[self.end[1], 0]) * p.target.mass,
        )

    def _decode_collision(
        self, x: Array, outputs: dict[str, Array], approach: float, durations: list[float]
    ) -> PlannedCollision:
        time = [(durations[0] if s.phase else 0.0) + s.place * durations[s.phase] for s in self.stages]
        first = float(self.problem.law.branch(0.0, approach, True))
        wrench = self.hit_w.read(x)
        return PlannedCollision(
            time=np.array([0.0, *time]),
            force=np.array([first, *self.f.read(x)[:, 0]]),
            target_speed=np.array([0.0, *self.vt.read(x)[:, 0]]),
            torque=np.vstack(
                [self.feedforward.read(x), outputs["collision"][:, self._parts("collision")["torque"]]]
            )
            * self.robot.torque_limit,
            sole_wrench=wrench,
            ground=total_ground_wrench(self.coordinates, wrench),
        )
