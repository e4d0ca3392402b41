"""A collocated contact with one target: its equations of motion, law and events, as rows."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from impactopt.contact.laws import ContactLaw
from impactopt.kinematics.splines import Radau
from impactopt.problem.objectives import PeakForce
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.scenario import Scenario
from oracle.motions import DIRECTIONS, Limits
from oracle.robot_motion import RobotMotion
from oracle.variables import Piece, Variables

Array = NDArray[np.float64]
FORCE, DEPTH = 100.0, 0.01  # [N], [m] by which rows weigh forces and depths
_PROBES = [(x, rate) for x in (1e-4, 1e-3, 1e-2) for rate in (-1.0, -0.1, 0.1, 1.0)]


@dataclass(frozen=True)
class Stage:
    """A collocation point: its phase, place s in it, and what its element's stages weigh."""

    phase: int
    place: float
    members: tuple[int, ...]
    slope: Array  # of the stages in d/ds
    integral: Array  # of the stages' rates in the integral from the element's begin
    previous: int  # the stage it begins at; -1: contact
    begins: bool  # whether its element is a phase's first


def stages_of(elements: Sequence[Sequence[float]], stages: int) -> list[Stage]:
    """Radau IIA points of all phases; elements : lengths as fractions of their phase."""
    radau = Radau.of_stages(stages)
    inverse = np.linalg.inv(radau.a)
    out: list[Stage] = []
    for phase, lengths in enumerate(elements):
        start = 0.0
        for e, h in enumerate(lengths):
            first = len(out)
            members = tuple(range(first, first + stages))
            out += [
                Stage(phase, start + c * h, members, inverse[i] / h, radau.a[i] * h, first - 1, e == 0)
                for i, c in enumerate(radau.c)
            ]
            start += h
    return out


class Spell(NamedTuple):
    """A phase: its name, the target's phase in it, what ends it, whether striker and target are apart, and
    whether they recede under a law that has a branch for that.
    """

    name: str
    mode: int
    end: str
    apart: bool = False
    recede: bool = False


def spells_of(problem: ImpactProblem) -> list[Spell]:
    """All phases: the target's; or each touch and each gap, as the problem lists what ends them."""
    target = problem.target
    guards, listed = list(target.guards), problem.touches
    if listed is None or listed == 1:
        turn = ["end of compression"] if len(target.phases) > len(guards) + 1 else []
        ends = [*guards, *turn, "separation"]
        last = len(target.phases) - 1
        return [Spell(name, k, ends[k], recede=k == last) for k, name in enumerate(target.phases)]
    if isinstance(listed, int):
        once = ["end of compression", "separation"] if _switches(problem.law) else ["separation"]
        listed = (*[*once, "touch"] * (listed - 1), *guards, *once)
    out = list[Spell]()
    for k, end in enumerate(listed):
        since = listed[:k]
        touch, mode = since.count("touch") + 1, sum(since.count(guard) for guard in guards)
        here = [each for each in since if each not in guards]
        apart = bool(here) and here[-1] == "separation"
        turns = 0
        for each in here:
            turns = turns + 1 if each == "end of compression" else 0
        name = f"{'apart after ' if apart else ''}touch {touch}"
        name += f", after the {guards[mode - 1]}" if mode else ""
        if turns:
            name += f", {['compression', 'restitution'][turns % 2]} {turns // 2 + 1}"
        out.append(Spell(name, mode, end, apart, bool(turns % 2)))
    return out


class Blow:
    """Rows and bounds of the contact with the expected target, or with a scenario's.

    elements : of its phases.  shortest [s] : how long each lasts at least.  start : y at contact.
    lifted : names of torques that are variables.
    """

    def __init__(
        self,
        problem: ImpactProblem,
        robot: RobotMotion,
        limits: Limits,
        elements: Sequence[Sequence[float]],
        shortest: Sequence[float],
        start: Callable[[Variables], Array],
        scenario: Scenario | None = None,
        lifted: Collection[str] = (),
    ) -> None:
        self.problem, self.robot, self.limits, self.scenario = problem, robot, limits, scenario
        self._start, self.lifted = start, frozenset(lifted)
        self.stages, self.shortest = stages_of(elements, problem.collision_stages), list(shortest)
        self.prefix = "" if scenario is None else f"{scenario.name}: "
        self.suffix = "" if scenario is None else f", if {scenario.name}"
        law, target = problem.law, problem.target
        self.law, self.target = law.parameters, target.parameters
        self.fraction, self.margin = limits.torque.collision, limits.cone.collision_margin
        self.least = limits.cone.minimum_force
        if scenario is not None:
            self.law, self.target = scenario.numbers(law, target)
            self.fraction, self.margin, self.least = scenario.torque, scenario.cone_margin, 0.0
        self.points = [point for _, point in problem.contacts]
        self.spells = spells_of(problem)
        self.phases = len(self.spells)
        self.end = [max(i for i, s in enumerate(self.stages) if s.phase == k) for k in range(self.phases)]
        self.typical = np.array(target.typical or (1.0,) * target.n_states)
        self.durations = [f"{self.prefix}{spell.name} duration" for spell in self.spells]
        self.free = [  # of force
            self.spells[s.phase].apart or (i in self.end and self.spells[s.phase].end == "separation")
            for i, s in enumerate(self.stages)
        ]

    @property
    def _each(self) -> list[str]:
        """What names of rows begin with, of each striker."""
        return ["", "second "][: len(self.points)]

    # ------------------------------------------------------------------ variables
    def scales(self) -> dict[str, Array]:
        p = self.prefix
        out = {
            f"{p}contact force": np.array([FORCE]),
            f"{p}target state": self.typical,
            f"{p}bristle deflection": np.array([DEPTH]),
            f"{p}collision sole wrench": self.robot.wrench_scale,
        }
        return out | {name: np.array([0.01]) for name in self.durations}

    def bounds(self, guarded: bool) -> dict[str, tuple[Array, Array]]:
        """Physical (count, size), of groups that have them; guarded : no force may pull, whatever the law."""
        p, target, n = self.problem, self.problem.target, len(self.stages)
        free = np.array(self.free)
        pulls = float(type(p.law)(**self.problem.law.parameters).branch(1e-6, -10.0, False)) < 0
        least = np.zeros(n) if target.guards or pulls or guarded else np.where(free, 0.0, -np.inf)
        if not (target.turns or p.order or any(isinstance(o, PeakForce) for o in p.objectives)):
            least = np.where([0 < s.phase < self.phases - 1 for s in self.stages], -np.inf, 0.0)
        most = np.where(free, 0.0, np.inf)
        longest = p.contact_duration[1]
        most_torque = np.array([self.fraction])
        torques = {self.torque(i) for i in range(n)} & self.lifted
        out = {
            f"{self.prefix}contact force": (least[:, None], most[:, None]),
            f"{self.prefix}collision legs": self.limits.legs,
        }
        times = zip(self.durations, self.shortest, strict=True)
        if p.friction is not None and p.friction.stiffness > 0:  # nothing bends bristles in a gap
            bent = np.where([self.spells[s.phase].apart for s in self.stages], 0.0, np.inf)[:, None]
            out[f"{self.prefix}bristle deflection"] = (-bent, bent)
        out |= dict.fromkeys(torques, (-most_torque, most_torque))
        return out | {name: (np.array([least]), np.array([longest])) for name, least in times}

    def place(self, i: int) -> str:
        s = self.stages[i]
        return f"{self.spells[s.phase].name}, {100 * s.place:.3g} %{self.suffix}"

    def get(self, v: Variables, name: str, i: int = 0) -> Array:
        return v.get(self.prefix + name, i)

    def slope(self, v: Variables, name: str, i: int, start: Array, *, anew: bool = False) -> Array:
        """d/ds of a collocated group at stage i; start : its value at contact; anew : in each phase."""
        s = self.stages[i]
        begins = s.previous < 0 or (anew and s.begins)
        before = start if begins else self.get(v, name, s.previous)
        return np.sum(
            [w * (self.get(v, name, m) - before) for m, w in zip(s.members, s.slope, strict=True)], 0
        )

    def before(self, v: Variables, phase: int) -> tuple[float, Array, float]:
        """Time [s] of the phases before one; travel of coordinates and of the target in them over that."""
        time = sum(v.one(name) for name in self.durations[:phase])
        if phase == 0:
            return 0.0, np.zeros(self.robot.ny), 0.0
        if phase == 1:
            at = self.end[0]
            return time, self.get(v, "collision travel", at), float(self.get(v, "target travel", at)[0])
        joined = self.get(v, "travel in compression", phase - 2)
        return time, joined, float(self.get(v, "target travel in compression", phase - 2)[0])

    def moved(self, v: Variables, i: int, y0: Array) -> tuple[Array, float, float, float]:
        """At stage i: coordinates, time [s] since contact, duration [s] of its phase, target's travel [m]."""
        s = self.stages[i]
        time, d1, x1 = self.before(v, s.phase)
        T = v.one(self.durations[s.phase])
        y = y0 + time * d1 + T * self.get(v, "collision travel", i)
        gone = time * x1 + T * float(self.get(v, "target travel", i)[0])
        return y, time + T * s.place, T, gone

    # ------------------------------------------------------------------ rows
    def pieces(self) -> list[Piece]:
        """All rows."""
        out = []
        for i in range(len(self.stages)):
            out += [self._kinematics(i), self._dynamics(i), *self._of_target(i)]
            if self.robot.soles:
                out.append(self._coasting(i))
        return [*out, *self._ends()]

    def _kinematics(self, i: int) -> Piece:
        s, labels = self.stages[i], self.robot.labels

        def value(v: Variables) -> Array:
            rates = [w * self.get(v, "collision rate", m) for m, w in zip(s.members, s.integral, strict=True)]
            travel = self.get(v, "collision travel", i) - np.sum(rates, 0)
            return travel if s.begins else travel - self.get(v, "collision travel", s.previous)

        return Piece.of(value, [("collision kinematics", self.place(i), labels, 0.0, 0.0)])

    def _coasting(self, i: int) -> Piece:
        s, robot = self.stages[i], self.robot

        def value(v: Variables) -> Array:
            time, _, _ = self.before(v, s.phase)
            u0 = v.get("rate at contact")
            y = self._start(v) + u0 * (time + v.one(self.durations[s.phase]) * s.place)
            rates = self.get(v, "coasting leg rates", i)
            return robot.coasting(y, self.get(v, "coasting legs", i), u0, rates)

        closure = [f"{leg.end} {d}" for leg, *_ in robot.soles for d in DIRECTIONS]
        names = [*closure, *[f"{name} rate" for name in closure]]
        return Piece.of(value, [("legs of the coasting reference", self.place(i), names, 0.0, 0.0)])

    def _dynamics(self, i: int) -> Piece:
        robot, limits, place = self.robot, self.limits, self.place(i)
        r = robot.robot
        dependent = robot.dependent

        def joints(independent: Array, legs: Array) -> Array:
            out = np.empty(robot.n)
            out[robot.independent], out[dependent] = independent[robot.base :], legs
            return out

        # a spring's rest does not move
        driven = np.concatenate([np.ones(robot.base), np.where(r.sprung, 0.0, 1.0)[robot.independent]])
        lifted = self.torque(i) if self.torque(i) in self.lifted else None
        bristles = robot.friction is not None and robot.friction.stiffness > 0
        bends = bristles and not self.spells[self.stages[i].phase].apart
        carried = robot.friction is not None and robot.friction.moves_target

        def value(v: Variables) -> Array:
            y0, u0, ff = self._start(v), v.get("rate at contact"), v.get("feed-forward at contact")
            y, time, _, _ = self.moved(v, i, y0)
            u, legs = self.get(v, "collision rate", i), self.get(v, "collision legs", i)
            w, f = self.get(v, "collision sole wrench", i), self.get(v, "contact force", i)
            q, qd, qdd = self.motion(v, i)
            bent = self.get(v, "bristle deflection", i).reshape(-1, 3) if bristles else np.zeros((0, 3))
            side = self.get(v, "target tangential velocity", i) if carried else np.zeros(3)
            tau = robot.torque(q, qd, qdd, w, f, bent, side)
            lag = self.get(v, "coasting legs", i) - legs
            slower = self.get(v, "coasting leg rates", i) - qd[robot.base + dependent]
            ahead, faster = joints(y0 + driven * u0 * time - y, lag), joints(u0 - u, slower)
            servo = ff + (r.kp * ahead + r.kd * faster) / r.torque_limit
            found = [robot.closure(q), tau[: robot.base] / robot.base_scale]
            bounded = servo if lifted is None else servo - v.get(lifted)
            out = np.concatenate([*found, tau[robot.base :] / r.torque_limit - servo, bounded, inside(w)])
            T = v.one(self.durations[self.stages[i].phase])
            if bends:
                slope = self.slope(v, "bristle deflection", i, np.zeros(bent.size))
                out = np.concatenate([out, (slope - T * robot.bending(q, qd, f, bent, side)) / DEPTH])
            if carried:
                given = np.sum([push for _, push in robot.pushes(q, qd, f, bent, side)], axis=0)
                given -= robot.normal * f.sum()
                slope = self.slope(v, "target tangential velocity", i, np.zeros(3))
                out = np.concatenate([out, slope - T * given / self.target["mass"]])
            return out

        closure = [f"{leg.end} {d}" for leg, *_ in robot.soles for d in DIRECTIONS]
        inside, cone = limits.cone_rows(robot, place, self.margin or 0.0, self.least)
        if self.margin is None:
            inside, cone = (lambda w: np.zeros(0)), []
        most = self.fraction if lifted is None else 0.0
        rows: list[Any] = [
            ("closed legs", place, closure, 0.0, 0.0),
            ("collision dynamics", place, [*DIRECTIONS[: robot.base], *r.joint_names], 0.0, 0.0),
            (f"{limits.torque.name} in collision", place, r.joint_names, -most, most),
        ]
        if bends:
            each = [f"bristle {k}" for k in range(3 * len(robot.hands))]
            cone = [*cone, ("bristles", place, each, 0.0, 0.0)]
        if carried:
            cone = [*cone, ("target's motion", place, [f"tangential {x}" for x in "xyz"], 0.0, 0.0)]
        return Piece.of(value, [*rows, *cone])

    def torque(self, i: int) -> str:
        """Name of the servos' torques over limit at stage i, where they are variables."""
        return f"torque in collision, {self.place(i)}"

    def motion(self, v: Variables, i: int) -> tuple[Array, Array, Array]:
        """q, v, a at stage i."""
        y, _, T, _ = self.moved(v, i, self._start(v))
        slope = self.slope(v, "collision rate", i, v.get("rate at contact")) / T
        legs = self.get(v, "collision legs", i)
        return self.robot.motion(y, legs, self.get(v, "collision rate", i), slope)

    def contact(self, v: Variables, i: int, k: int = 0) -> tuple[float, float, float, float, Array]:
        """At stage i: penetration [m] of striker k and its rate [m/s], force [N] of all, duration [s] of its
        phase, the target's state.
        """
        y, _, T, gone = self.moved(v, i, self._start(v))
        place, fast, _ = self.robot.striking(y, self.get(v, "collision rate", i), k)
        normal, state = self.robot.normal, self.get(v, "target state", i)
        f = float(self.get(v, "contact force", i).sum())
        speed = float(self._smooth(i, state, f)[0])
        way = float(normal @ (place - self.points[k]))
        return way - gone, float(normal @ fast) - speed, f, T, state

    def _smooth(self, i: int, state: Array, f: float) -> tuple[Any, Array]:
        mode = self.spells[self.stages[i].phase].mode if self.problem.target.guards else 0
        speed, rates = self.problem.target.smooth(state, f, mode, self.target)
        return speed, np.array([float(rate) for rate in rates]).reshape(self.problem.target.n_states)

    def _of_target(self, i: int) -> list[Piece]:
        target, law, place = self.problem.target, self.problem.law, self.place(i)
        number = self.stages[i].phase
        spell, n = self.spells[number], target.n_states
        phase, inner, one = spell.mode, i not in self.end, self.problem.touches in (None, 1)
        to_event = spell.end in target.guards
        guarded = (inner or not (one or to_event)) and bool(target.invariant([0.0] * n, 0.0, phase))
        reserved = not inner and to_event and bool(target.reserve([0.0] * n, 0.0, phase))
        turned = not inner and (one or to_event or spell.end == "end of compression")
        signed = not (turned or spell.apart) and bool(target.guards) and _switches(law)
        releases = spell.recede

        def value(v: Variables) -> Array:
            _, rate, f, T, now = self.contact(v, i)
            speed, moves = self._smooth(i, now, f)
            slopes = self.slope(v, "target state", i, np.zeros(n)) - T * moves
            travel = self.slope(v, "target travel", i, np.zeros(1), anew=True) - float(speed)
            given = self.slope(v, "impulse so far", i, np.zeros(1)) - T * f
            parts = [slopes / self.typical, travel, given]
            own = () if self.free[i] else self.get(v, "contact force", i)
            for k, force in enumerate(own):
                deep, fast, *_ = self.contact(v, i, k)
                parts.append(
                    np.array([(force - float(law.branch(deep, fast, not releases, self.law))) / FORCE])
                )
            if signed:
                parts.append(np.array([rate]))
            if guarded:
                parts.append(np.array([float(x) for x in target.invariant(now, f, phase, self.target)]))
            if reserved:
                parts.append(np.array([float(x) for x in target.reserve(now, f, phase, self.target)]))
            return np.concatenate(parts)

        states = [f"state {k}" for k in range(n)]
        rows: list[Any] = [
            ("target's motion", place, [*states, "travel"], 0.0, 0.0),
            ("impulse", place, ["target"], 0.0, 0.0),
        ]
        if not self.free[i]:
            rows.append(("contact law", place, [f"{one}force" for one in self._each], 0.0, 0.0))
        if signed:
            way = (-np.inf, 0.0) if releases else (0.0, np.inf)
            rows.append(("approach speed", place, ["striker and target"], *way))
        if guarded:
            name = target.guards[min(phase, len(target.guards) - 1)]
            least = target.margin(phase, self.stages[i].place if one or to_event else 0.0)
            rows.append((name, place, ["target"], least, np.inf))
        if reserved:
            rows.append((spell.end, place, ["reserve"], 0.0, np.inf))
        return [Piece.of(value, rows)]

    def _ends(self) -> list[Piece]:
        target, law, where = self.problem.target, self.problem.law, self.suffix.lstrip(", ")
        out = []
        for number, (spell, i) in enumerate(zip(self.spells, self.end, strict=True)):

            def ended(v: Variables, number: int = number, spell: Spell = spell, i: int = i) -> Array:
                if spell.end in target.guards:
                    _, _, f, T, now = self.contact(v, i)
                    late = T - self.shortest[number]
                    return np.array([float(target.guard(now, f, late, spell.mode, self.target))])
                found = [self.contact(v, i, k)[:2] for k in range(len(self.points))]
                if spell.end == "separation":
                    return np.array([float(law.separation(*each, self.law)) / FORCE for each in found])
                if spell.end == "touch":
                    return np.array([deep / DEPTH for deep, _ in found])
                return np.array([rate for _, rate in found])

            each = {"separation": "force", "touch": "penetration", "end of compression": "approach speed"}
            names = [f"{one}{each[spell.end]}" for one in self._each] if spell.end in each else ["target"]
            out.append(Piece.of(ended, [(spell.end, where, names, 0.0, 0.0)]))
            meets, parts = spell.end == "touch", spell.apart and number == self.phases - 1
            if meets or parts:

                def comes(v: Variables, i: int = i) -> Array:
                    return np.array([self.contact(v, i)[1]])

                way = (0.0, np.inf) if meets else (-np.inf, 0.0)
                out.append(Piece.of(comes, [("approach speed", self.place(i), ["striker and target"], *way)]))
        return [*out, *(self._joined(where, k) for k in range(1, self.phases - 1))]

    def _joined(self, where: str, k: int) -> Piece:
        """Travel in all phases to a number k is that in those before it and in k itself."""

        def value(v: Variables) -> Array:
            time, y, x = self.before(v, k)
            own, (together, whole, gone) = v.one(self.durations[k]), self.before(v, k + 1)
            at = self.end[k]
            moved = time * y + own * self.get(v, "collision travel", at) - together * whole
            travel = time * x + own * float(self.get(v, "target travel", at)[0]) - together * gone
            return np.concatenate([moved, [travel]])

        names = [*self.robot.labels, "target"]
        return Piece.of(value, [("travel in compression", where, names, 0.0, 0.0)])


def _switches(law: ContactLaw) -> bool:
    """Whether compression and restitution differ."""
    return any(float(law.branch(x, r, True)) != float(law.branch(x, r, False)) for x, r in _PROBES)
