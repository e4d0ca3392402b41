"""Collocated contact phases: Radau IIA collocation of the whole equation of motion, and the impact's onset.

The phases are compression and restitution, each of which is smooth, or those of a target with events. There
is one collision with the expected target, and one for each scenario. They share the state at contact, the
feed-forward and the servo. Each has its own durations, motion, force and wrenches.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from impactopt.arrays import Array, Index
from impactopt.contact.friction import moves_target, tangential_mobility, tangential_outcome
from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets.base import SEPARATION, TOUCH, TURN
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.problem.objectives import PeakForce
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.scenario import Scenario
from impactopt.problem.violation import Measure, Place, millimetres, percent
from impactopt.robots.model import mass_matrix
from impactopt.solvers.program import Determined
from impactopt.transcription.builder import Builder
from impactopt.transcription.contact_blocks import DEPTH_SCALE, FORCE_SCALE
from impactopt.transcription.contact_guess import coasted, effective_mass, guessed_contact
from impactopt.transcription.contact_state import (
    Contact,
    ContactEnd,
    ContactParameters,
    DrivePoint,
    joint_motion_slots,
    pulls_apart,
)
from impactopt.transcription.layout import (
    DIRECTIONS,
    Affine,
    Group,
    Turn,
    add,
    along,
    by_leg,
    determined,
    rates,
    stack,
)
from impactopt.transcription.mesh import CollocationPoint
from impactopt.transcription.motion_phase import add_cone_constraints
from impactopt.transcription.plan import PlannedCollision, total_ground_wrench

ACCELERATION_SCALE = 100.0  # [rad/s^2] of the jump


class FirstInstant:
    """Variables and constraints of the first instant of contact, at which accelerations jump.

    A damped contact law has a force as soon as bodies touch. Terms about gears and motors need the
    accelerations there; collocation points begin later.

    law : parameters of the contact law, by name.
    suffix : appended to the names of the place and of the variables.
    """

    def __init__(self, b: Builder, contact: Contact, law: dict[str, float], suffix: str) -> None:
        self._b, self.contact, self.law = b, contact, law
        self.place = Place.plain(f"first instant of contact{suffix}")

        def add(name: str, size: int, **options: Any) -> Group:
            return b.layout.add(name + suffix, 1, size, **options)

        self.change = add("jump of acceleration", b.ny, scale=ACCELERATION_SCALE, labels=b.coordinates.labels)
        of_wrenches = {name: b.limits.of_wrenches[name] for name in ("scale", "labels")}
        self.w = add("jump of sole wrench", b.nw, **of_wrenches)
        self.f = add("first force", 1, scale=FORCE_SCALE)

    def instance(self) -> tuple[list[Affine], Array]:
        """Slots and parameters of the block ``first``."""
        b, state = self._b, self.contact.state
        slots = [state.y, state.legs, self.contact.u0[0], self.change[0], self.w[0], self.f[0]]
        law, robot = np.array([*self.law.values()]), b.robot
        before = np.array([float(b.problem.target.speed_before())])
        parameters = [b.problem.normal, law, before, robot.armature, robot.torque_limit, b.limits.units]
        return slots, np.concatenate([*parameters, friction_parameters(b.problem)])

    def add_constraints(self, at: int) -> None:
        """Add the constraints.  at : index of the first output of this instance of the block ``first``."""
        b, part = self._b, self._b.parts("first")
        term, of_limit = "jump of acceleration", percent("of the joint's limit off")
        b.equal(term, self.place, DIRECTIONS[: b.coordinates.base], at + part["base"], b.limits.unbalanced)
        b.equal(term, self.place, b.robot.joint_names, at + part["joints"], of_limit)
        b.equal("contact law", self.place, ["force"], at + part["law"], Measure("N", FORCE_SCALE, "off"))
        self._rotors = at + part["rotors"]

    @property
    def rotors(self) -> Index:
        """Indices of the outputs (n,) that are the rotors' part of the gears' load.

        They are known after :meth:`add_constraints`.
        """
        return np.asarray(self._rotors)

    def determined(self) -> list[Determined]:
        """All variables: their constraints determine them together, as those of a collocation element."""
        groups = (self.change, self.w, self.f)
        return [determined(Turn.ELEMENT, np.concatenate([g.index(0) for g in groups]))]

    def guess(self, x: Array, y: Array, rates: Array, legs: Array) -> None:
        """Write the initial guess for coordinates and rates (ny,) and legs (nl,) at contact to x (n,)."""
        b, law = self._b, type(self._b.problem.law)(**self.law)
        force, change, w, _ = jump_at_contact(b.problem, b.coordinates, law, y, rates, legs)
        self.f.write(x, force)
        self.change.write(x, change)
        self.w.write(x, w)


def friction_parameters(problem: ImpactProblem) -> Array:
    """Parameters of the striking points' friction (2,); (3,) with bristles; (0,) without friction."""
    return np.array(() if problem.friction is None else problem.friction.parameters, dtype=float)


def jump_at_contact(
    problem: ImpactProblem, c: StanceCoordinates, law: ContactLaw, y: Array, rates: Array, legs: Array
) -> tuple[float, Array, Array, Array]:
    """First contact force and the changes that it causes, of a robot that coasts until contact.

    Returns
    -------
    Sum of the strikers' forces [N]; changes of yddot (ny,) and of the sole wrenches (6 a sole);
    accelerations (n,) of the joints just after contact.
    """
    model = problem.robot.model
    q, v, a = c.complete_motion(y, rates, np.zeros(c.ny), legs)
    data: Any = model.createData()
    H = mass_matrix(model, data, q)
    J_c = c.sole_jacobians(q)[0] if c.legs else np.zeros((0, model.nv))
    frames = [model.getFrameId(problem.robot.striker(name).model_frame) for name in problem.strikers]
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    axes = pin.LOCAL_WORLD_ALIGNED
    jacobians = [np.reshape(pin.getFrameJacobian(model, data, k, axes), (6, model.nv))[:3] for k in frames]
    normals = np.array([problem.normal @ jacobian for jacobian in jacobians])  # (strikers, nv)
    pushes = normals  # generalized force of a unit normal force, with its friction
    if problem.friction is not None:
        pushes = np.array([problem.friction.way(problem.normal, J @ v) @ J for J in jacobians])
    # rate of the penetration, whose depth is zero: only the law's damper has a force there
    approach = normals @ v - float(problem.target.speed_before())
    forces = np.array([float(law.branch(0.0, float(rate), True)) for rate in approach])
    # H da = J_c' dw - j' f, with J_c da = 0: dw by least squares, as a straight knee makes J_c H^-1 J_c'
    # singular
    solved = np.linalg.solve(H, np.column_stack([J_c.T, -forces @ pushes]))
    of_wrenches, of_forces = solved[:, :-1], solved[:, -1]
    dw: Array = np.zeros(0)
    if len(J_c):
        dw = np.asarray(np.linalg.lstsq(J_c @ of_wrenches, -J_c @ of_forces, rcond=None)[0])
    da = of_forces + of_wrenches @ dw
    base = da[: c.base].copy()
    if c.base:  # from the base's own frame to rates of its coordinates
        # Velocities do not jump, so products of velocities cancel in the change: a rotation and a matrix are
        # enough.
        base[:3] = pin.rpy.rpyToMatrix(y[3:6]) @ base[:3]
        base[3:] = np.linalg.solve(pin.rpy.computeRpyJacobian(y[3:6], pin.LOCAL), base[3:])
    independent = np.concatenate([base, da[c.base :][c.independent]])
    return float(forces.sum()), independent, dw, np.asarray((a + da)[c.base :])


class Collision(ContactParameters):
    """Variables and constraints of the collision with one target.

    Time in a phase of duration T is s T, with s in [0, 1]. The integral of a rate u over the phase so far is
    T d, with d = integral of u ds. The contact begins at y0, so the position in a phase is
    y = y0 + T1 d1 + T d, where T1 is the time of all phases before and d1 the mean rate in that time.

    contact : state at contact, which all collisions of a program share.
    stages : collocation points of the contact phases.
    number : index of this collision in the program; 0: that with the expected target.
    mass : effective mass of the robot at its striker [kg].
    guarded : forbid a force that pulls within a phase, whatever the law.
    scenario : of the target; None: the expected one.
    after : labels and bounds of the variables of the position after contact. None: there are no such
        variables, as a follow-through starts there.
    lifted : add the positions at the stages but the last one as variables, for clearance constraints.

    Attributes
    ----------
    end : index of the last stage of each phase.
    T : durations of the phases [s].
    u, d : rates ydot of the robot, and their integrals.
    xt : integral of the target's speed, as d is of u.
    joined, joined_x : d1 of the first two phases, of the first three, and so on to all but the last; of the
        robot and of the target.
    suffix : appended to the names of places.
    legs, w : joint angles of the constrained legs and sole wrenches, at the stages.
    torques : torques over limit at the stages, as variables if a term is about drives; else empty.
    apart (stages,) : mask of the stages in a gap between touches.
    forceless (stages,) : mask of the stages at which the contact force is zero.
    holds : the force may pull while a nail is driven.
    coast_legs, coast_rates : joint angles and rates of the legs of the coasting reference.
    f : contact forces [N], one a striker.
    state : of the target.
    p : impulse to the target since contact [N s].
    after : position y after contact.
    y : positions at the stages but the last one, if ``lifted``; else empty.
    """

    def __init__(
        self,
        b: Builder,
        contact: Contact,
        stages: Sequence[CollocationPoint],
        *,
        number: int,
        mass: float,
        guarded: bool,
        scenario: Scenario | None = None,
        after: dict[str, Any] | None,
        lifted: bool = False,
    ) -> None:
        self._b, self.contact, self.stages = b, contact, stages
        self.number, self.scenario = number, scenario
        self.torques: list[Affine] = []
        self._prefixes = ["", "second "][: len(b.problem.strikers)]  # of the block's outputs, by striker
        p, c, limits = b.problem, b.coordinates, b.limits
        self.phases = p.contact_phases
        self.end = [max(i for i, s in enumerate(stages) if s.phase == k) for k in range(len(self.phases))]
        self.apart = np.array([self.phases[s.phase].apart for s in stages])
        # A touch ends where the law's `separation` is zero. That is a constraint of its last stage, so the
        # force there is zero by its bounds, and the law is no constraint.
        self.forceless = self.apart.copy()
        self.forceless[[i for i, f in zip(self.end, self.phases, strict=True) if f.end == SEPARATION]] = True
        self._prefix = prefix = f"{scenario.name}: " if scenario is not None else ""
        self.suffix = f", if {scenario.name}" if scenario is not None else ""
        self.mass = mass
        # sets `shortest`, which the bounds of the durations below need
        self.update_parameters()
        self.torque_fraction = scenario.torque if scenario else limits.torque.collision
        self.cone_margin = scenario.cone_margin if scenario else limits.cone.collision_margin
        n = len(stages)

        def add(name: str, size: int, **options: Any) -> Group:
            """Add variables at every stage."""
            return b.layout.add(prefix + name, n, size, **options)

        longest = p.contact_duration[1]
        self.T = [
            b.duration(f"{prefix}{phase.name} duration", (least, longest), 0.01)
            for phase, least in zip(self.phases, self.shortest, strict=True)
        ]
        self._add_reference(n)
        self.u = add("collision rate", b.ny, labels=c.labels)
        self.d = add("collision travel", b.ny, labels=c.labels)
        self.legs = add("collision legs", b.nl, **limits.of_legs)
        # In contact chatter a driven nail jumps ahead of the hammer. A plan of one touch has no events for
        # that: the force may pull meanwhile, and the check of the plan in full dynamics reports the
        # difference. The peak force of such a plan is wrong, so an objective on it excludes this.
        by_peak = any(isinstance(o, PeakForce) for o in p.objectives)
        self.holds = not (p.target.turns or p.order or by_peak)
        least, most = self._least_force(guarded), np.where(self.forceless, 0.0, np.inf)[:, None]
        newtons = Measure("N", 1.0, "off")
        self.f = add(
            "contact force", len(p.strikers), scale=FORCE_SCALE, lower=least, upper=most, measure=newtons
        )
        self.state = add("target state", p.target.n_states, scale=p.target.typical_state)
        self.xt = add("target travel", 1, labels=["target"])
        bent = 3 * len(p.strikers) if len(friction_parameters(p)) > 2 else 0
        # in a gap the bristles are not bent, by their bounds, so that each touch begins with unbent ones
        most = np.where(self.apart, 0.0, np.inf)[:, None]
        depth = millimetres("off")
        self.bristles = add(
            "bristle deflection", bent, scale=DEPTH_SCALE, lower=-most, upper=most, measure=depth
        )
        self.tangential = add("target tangential velocity", 3 * moves_target(p.friction))
        self.p = add("impulse so far", 1)
        self.w = add("collision sole wrench", b.nw, **limits.of_wrenches)
        # from the third phase on: before the second one the mean rate is the d of the first
        joined = len(self.phases) - 2
        self.joined = b.layout.add(f"{prefix}travel in compression", joined, b.ny, labels=c.labels)
        self.joined_x = b.layout.add(f"{prefix}target travel in compression", joined, 1)
        count = int(after is not None)
        self.after = b.layout.add(f"{prefix}position after contact", count, b.ny, **(after or {}))
        # The last stage is where the follow-through starts, which has a node there.
        self.y = b.layout.add(f"{prefix}position in contact", lifted * (n - 1), b.ny, labels=c.labels)

    def _least_force(self, guarded: bool) -> Any:
        """Lower bound of the forces at the stages [N]: zero if law or target might make bodies pull.

        There is none while a nail is driven, if the collision ``holds``.
        """
        p = self._b.problem
        # phases between the first and the last are those in which the nail is driven
        if self.holds:
            driven = np.array([0 < s.phase < len(self.end) - 1 for s in self.stages])
            return np.where(driven, -np.inf, 0.0)[:, None]
        if p.target.guards or pulls_apart(p.law) or guarded:
            return 0.0
        return np.where(self.forceless, 0.0, -np.inf)[:, None]

    def _add_reference(self, count: int) -> None:
        """Add variables of the coasting reference: angles and rates of its legs, at ``count`` instants."""
        nl, add, labels = self._b.nl, self._b.layout.add, {"labels": self._b.coordinates.leg_labels}
        self.coast_legs = add(f"{self._prefix}coasting legs", count, nl, **labels)
        self.coast_rates = add(f"{self._prefix}coasting leg rates", count, nl, **labels)

    @property
    def impulse(self) -> Affine:
        """Impulse to the target [N s]."""
        return self.p[self.end[-1]]

    @property
    def target_state(self) -> Affine:
        """State of the target at separation."""
        return self.state[self.end[-1]]

    def target_moved(self, i: int) -> tuple[Affine, Affine]:
        """Duration T [s] of a stage's phase, and v of the target's displacement T v in this phase so far.

        v : along the normal [m/s], and (3,) across it in the world if friction moves the target.
        """
        across = [self._integral(self.tangential, i)] if self.tangential.size else []
        return self.T[self.stages[i].phase][0], stack([self.xt[i], *across])

    def _integral(self, rate: Group, i: int) -> Affine:
        """Integral of a rate over the phase so far at a stage, by Radau quadrature."""
        s = self.stages[i]
        begin = Affine.zeros(rate.size) if s.new_phase else self._integral(rate, s.previous)
        return begin + sum(rate[m] * w for m, w in zip(s.members, s.quadrature, strict=True))

    @property
    def target_velocity(self) -> Affine:
        """Velocity of the target after contact [m/s], in the directions of `target_moved`."""
        last = self.end[-1]
        along = self._slots(self.xt, last, Affine.zeros(1), each_phase=True)[1]
        return stack([along, *([self.tangential[last]] if self.tangential.size else [])])

    def instances(self) -> dict[str, tuple[list[list[Affine]], list[Any]]]:
        """Slots and parameters of each block's instances, one a stage."""
        p = self._b.problem
        zero, at_rest = Affine.zeros(1), Affine.zeros(p.target.n_states)
        collision, force = [], []
        for i, s in enumerate(self.stages):
            state = self._slots(self.state, i, at_rest)
            # the travel is an integral over the phase so far, and begins each one at zero; states go on
            travel = self._slots(self.xt, i, zero, each_phase=True)
            impulse_slope, x1 = self._slots(self.p, i, zero)[1], self._before(s.phase)[2]
            collision.append(self._dynamics(i))
            force.append([*self._hand_slots(i), self.f[i], *state, *travel, x1, impulse_slope])
        out: dict[str, tuple[list[list[Affine]], list[Any]]] = {
            "collision": (collision, self.dynamics_parameters()),
            "force": (force, self.force_parameters()),
            **self._reference(),
        }
        if self.joined.count:
            join = self._join()
            out["join"] = join, [np.zeros(0)] * len(join)
        return out

    def dynamics_parameters(self) -> list[Array]:
        """Parameters of the block ``collision`` at each stage."""
        b, p = self._b, self._b.problem
        mobility = [tangential_mobility(p.friction, p.target, self.target)] if self.tangential.size else []
        common = [*self._gains(), b.robot.torque_limit, b.limits.units, friction_parameters(p), mobility]
        return [np.concatenate([p.normal, [s.place], *common]) for s in self.stages]

    def _dynamics(self, i: int) -> list[Affine]:
        """Slots of the block ``collision``."""
        y, u0, ff = self.contact.state.y, self.contact.u0[0], self._feedforward()
        reference = [self.coast_legs[i], self.coast_rates[i]]
        motion = [*self._travel(i), *self._slots(self.u, i, u0), self.legs[i]]
        bent = self._slots(self.bristles, i, Affine.zeros(self.bristles.size))
        moved = self._slots(self.tangential, i, Affine.zeros(self.tangential.size))
        forces = [self.f[i], self.w[i]]
        return [y, u0, *reference, ff, *motion, *forces, *bent, *moved, self.contact.gains[0]]

    def _hand_slots(self, i: int) -> list[Affine]:
        """Slots of the block ``force`` that determine the hand's position and speed."""
        return [self.contact.state.y, *self._travel(i), self.u[i]]

    def _feedforward(self) -> Affine:
        """Feed-forward torques over limit (n)."""
        return self.contact.feedforward[0]

    def integrated(self) -> list[tuple[Group, Group]]:
        """Integrals over the phase so far, each with the rates that are integrated."""
        return [(self.d, self.u)]

    def states(self) -> tuple[Group, ...]:
        """Collocated variables whose value at contact is known, beside those of `integrated`."""
        return self.state, self.xt, self.p, self.bristles, self.tangential

    def kept_groups(self) -> list[Group]:
        """Variables that are not at stages: a mesh of finer elements keeps their values."""
        return [*self.T, self.joined, self.joined_x, self.after]

    def _leg_groups(self) -> tuple[Group, ...]:
        """Variables of the legs at each stage, in the order of their constraints."""
        return self.coast_legs, self.coast_rates, self.legs

    def groups_without_start(self) -> list[Group]:
        """Variables at each stage that have no known value at contact."""
        return [self.coast_legs, self.coast_rates, self.legs, self.f, self.w]

    def zeros(self) -> Index:
        """Indices (k,) of variables that are zero by their bounds, so that no constraint determines them."""
        masks = (self.f, self.forceless), (self.bristles, self.apart)
        each = [group.index(int(i)) for group, mask in masks for i in np.flatnonzero(mask)]
        return np.concatenate([np.zeros(0, dtype=np.intp), *each])

    def _gains(self) -> tuple[Array, Array]:
        """Servo gains Kp and Kd (n,)."""
        return self._b.robot.kp, self._b.robot.kd

    def _reference(self) -> dict[str, tuple[list[list[Affine]], list[Any]]]:
        """Slots and parameters of the block ``coasting``; none without constrained legs."""
        if not self._b.coordinates.legs:
            return {}
        start = [self.contact.state.y, self.contact.u0[0]]
        slots = [
            [*start, self._before(s.phase)[0], self.T[s.phase][0], self.coast_legs[i], self.coast_rates[i]]
            for i, s in enumerate(self.stages)
        ]
        return {"coasting": (slots, [[s.place] for s in self.stages])}

    def determined(self) -> list[Determined]:
        """Variables in the order in which the constraints determine them.

        The legs at each stage, leg by leg; then element by element, first its integrals, by linear
        constraints, and then its other variables as one system. `joined` is last.
        """
        out: list[Determined] = []
        for i in range(len(self.stages)):
            legs = [leg for g in self._leg_groups() for leg in by_leg(g.index(i))]
            out += [determined(Turn.STAGE_LEGS, leg, k) for k, leg in enumerate(legs)]
        # Given an element's beginning, stages of one element depend on each other (Radau's A is full), on
        # those of later ones nothing: so elements are eliminated one after the other, as one small system
        # each.
        integrals, states = zip(*self.integrated(), strict=True)
        groups = (*states, self.w, self.f, *self.states())
        step = 0
        zeros = self.zeros()
        for members in sorted({s.members for s in self.stages}):
            part = np.concatenate([g.index(i) for i in members for g in groups])
            out += [determined(Turn.ELEMENT, one.index(i), step) for i in members for one in integrals]
            out.append(determined(Turn.ELEMENT, part[~np.isin(part, zeros)], step + 1))
            step += 2
        if self.joined.count:
            joined = [group for _, group in self._integrals()]
            whole = np.concatenate([group.index(k) for k in range(self.joined.count) for group in joined])
            out.append(determined(Turn.ELEMENT, whole, step))
        if self.scenario is not None:
            out.append(determined(Turn.AFTER, self.after.index(0)))
        return [*out, *(determined(Turn.AFTER, self.y.index(i)) for i in range(self.y.count))]

    # ------------------------------------------------------------------ collocation
    def _before(self, phase: int) -> tuple[Affine, Affine, Affine]:
        """T1 [s], d1 of the robot and d1 of the target."""
        time = Affine.zeros(1)
        for T in self.T[:phase]:
            time = time + T[0]
        return (
            time,
            self._mean_before(self.d, self.joined, phase),
            self._mean_before(self.xt, self.joined_x, phase),
        )

    def _mean_before(self, integral: Group, joined: Group, phase: int) -> Affine:
        """Mean rate in the phases before one; zero before the first."""
        if phase == 0:
            return Affine.zeros(integral.size)
        return integral[self.end[0]] if phase == 1 else joined[phase - 2]

    def _time(self, phase: int, place: float) -> Affine:
        """Time [s] since contact."""
        return self._before(phase)[0] + self.T[phase][0] * place

    def _integrals(self) -> list[tuple[Group, Group]]:
        """Integrals over the phase so far, each with its mean rates over several phases (`joined`)."""
        return [(self.d, self.joined), (self.xt, self.joined_x)]

    def _join(self) -> list[list[Affine]]:
        """Slots of the block ``join``, which determines `joined` phase by phase, component by component."""
        out = []
        for phase in range(1, len(self.end) - 1):
            times = self._before(phase)[0], self.T[phase][0]
            for integral, joined in self._integrals():
                parts = (
                    self._mean_before(integral, joined, phase),
                    integral[self.end[phase]],
                    joined[phase - 1],
                )
                out += [[*times, *(part[k : k + 1] for part in parts)] for k in range(integral.size)]
        return out

    def _slots(
        self, group: Group, i: int, start: Affine, *, each_phase: bool = False
    ) -> tuple[Affine, Affine]:
        """Value and slope d/ds of a collocated group at stage i.

        start : value at contact.  each_phase : the group has this value at the beginning of each phase.
        """
        s = self.stages[i]
        # Slope of the polynomial through the element's beginning and its stages, by the inverse of Radau's A:
        # `weights` of the stages' values, weight `start` of the beginning's.
        begins = s.previous < 0 or (each_phase and s.new_phase)
        before = start if begins else group[s.previous]
        of_stages = [group[m] * w for m, w in zip(s.members, s.weights, strict=True)]
        return group[i], add([*of_stages, before * s.start])

    def _place(self, s: CollocationPoint) -> Place:
        # a scenario's name may have braces, and the text is a format for the time
        suffix = self.suffix.replace("{", "{{").replace("}", "}}")
        return Place(f"{s.name}{self.suffix}", f"{{ms}} after contact{suffix}", self._time(s.phase, s.place))

    def _travel(self, i: int) -> list[Affine]:
        """Slots d1, T1, d, T of y = y0 + T1 d1 + T d at a stage."""
        s = self.stages[i]
        T1, d1, _ = self._before(s.phase)
        return [d1, T1, self.d[i], self.T[s.phase][0]]

    def _bound_torques(self, place: Place, outputs: Index, most: float) -> None:
        """Bound servo torques over limit (n) at a stage; add them as variables if a term is about drives."""
        b, term = self._b, f"{self._b.limits.torque.name} in collision"
        common: dict[str, Any] = {"term": term, "place": place, "lower": -most, "upper": most}
        common["measure"] = percent("over its limit", of=most)
        if b.problem.of_drives:
            # terms use these torques again, and an output of a block may be in one constraint only
            name = f"torque in collision, {place.name}"
            self.torques.append(b.lift(name, outputs, labels=b.robot.joint_names, **common)[0])
        else:
            b.constraints.add(components=b.robot.joint_names, outputs=outputs, **common)

    def drives(self) -> list[DrivePoint]:
        """Torques and joint motions at each stage, if a term is about drives.

        Call it after `Collision.add_constraints`.
        """
        pairs = zip(self.stages, self.torques, strict=True)
        return [DrivePoint(self._place(s), torque, self._motion(i)) for i, (s, torque) in enumerate(pairs)]

    def wrenches(self) -> list[tuple[Place, Affine]]:
        """Wrenches on soles and supporting hands at each stage."""
        return [(self._place(s), self.w[i]) for i, s in enumerate(self.stages)]

    def positions(self) -> list[tuple[Place, list[Affine]]]:
        """Place, and the first slots of `_motion`, which are y, at each stage."""
        return [(self._place(s), self._motion(i)[:5]) for i, s in enumerate(self.stages)]

    def spots(self) -> list[tuple[Place, list[Affine]]]:
        """Place, coordinates and legs at each stage whose position is a variable."""
        return [(self._place(self.stages[i]), [self.y[i], self.legs[i]]) for i in range(self.y.count)]

    def _motion(self, i: int) -> list[Affine]:
        """Slots of `impactopt.problem.block.joint_motion` at a stage."""
        # value and slope of u, which is ydot already: so the S of ydot = r/S is one
        rates = self._slots(self.u, i, self.contact.u0[0])
        return [self.contact.state.y, *self._travel(i), *rates, Affine.constant(1.0), self.legs[i]]

    def contact_end(self) -> ContactEnd:
        state, u0, last = self.contact.state, self.contact.u0[0], self.end[-1]
        before = joint_motion_slots(state.y, u0, u0 * 0.0, Affine.constant(1.0), state.legs)
        place = Place.plain(f"after contact{self.suffix}")
        return ContactEnd(place, before, self._motion(last), self.u[last] - u0)

    def _joints(self, x: Array, law: ContactLaw) -> dict[str, Array]:
        """Fields of `PlannedCollision` about the robot's motion, for solver variables."""
        b, c, state = self._b, self._b.coordinates, self.contact.state
        y, rates, legs = (e.evaluate(x) for e in (state.y, self.contact.u0[0], state.legs))
        motion = [(y, rates)]
        velocity = [c.complete_motion(y, rates, 0 * rates, legs)[1][c.base :]]
        acceleration = [jump_at_contact(b.problem, c, law, y, rates, legs)[3]]
        for i in range(len(self.stages)):
            # slots of `_motion`; the S among them is one
            T, u, slope, _, legs_there = (e.evaluate(x) for e in self._motion(i)[4:])
            y = self._position(x, i)
            _, v, a = c.complete_motion(y, u, slope / T, legs_there)
            motion.append((y, u))
            velocity.append(v[c.base :])
            acceleration.append(a[c.base :])
        return {
            "motion": np.array(motion),
            "velocity": np.array(velocity),
            "acceleration": np.array(acceleration),
        }

    def _add_integral(self, i: int, place: Place, integrals: Group, rate: Group) -> None:
        """Add the constraints of integrals over the phase so far: Radau quadrature of the rates' values."""
        s, labels = self.stages[i], integrals.labels
        integral = integrals[i]
        for m, w in zip(s.members, s.quadrature, strict=True):
            # d_i = d_start + h sum_j a_ij u_j, with the A whose inverse gives the slopes of u
            integral = integral - rate[m] * w
        if not s.new_phase:
            integral = integral - integrals[s.previous]
        self._b.equal("collision kinematics", place, labels, measure=rates(labels), affine=integral)

    # ------------------------------------------------------------------ constraints
    def add_constraints(self, at: dict[str, tuple[int, int]]) -> None:
        """Add the constraints of all stages and of the ends of phases.

        at : by block, the index of this collision's first output, and the number of outputs a stage.
        """
        for i, s in enumerate(self.stages):
            place = self._place(s)
            for integral, rate in self.integrated():
                self._add_integral(i, place, integral, rate)
            first = {name: start + i * size for name, (start, size) in at.items()}
            self._add_dynamics(i, place, first)
        (start, size), order = at["force"], percent("off")
        part, where = self._b.parts("force"), self.suffix.lstrip(", ")
        if self.joined.count:  # before the ends of phases, as these constraints determine `joined`
            names = [label for one, _ in self._integrals() for label in one.labels] * self.joined.count
            outputs = at["join"][0] + np.arange(len(names))
            self._b.equal("travel in compression", where, names, outputs, along(names, "off"))
        # end that is no event of the target -> component, output of the block ``force``, measure
        ends = {
            TURN: ("approach speed", "rate", Measure("m/s", 1.0, "left")),
            SEPARATION: ("force", "separation", Measure("N", FORCE_SCALE, "left")),
            TOUCH: ("penetration", "penetration", Measure("mm", 1e3 * DEPTH_SCALE, "left")),
        }
        for last, phase in zip(self.end, self.phases, strict=True):
            # any other end is an event of the target, which has one, whatever the number of strikers
            component, name, measure = ends.get(phase.end, ("target", "event", order))
            for prefix in self._prefixes if phase.end in ends else self._prefixes[:1]:
                outputs = start + last * size + part[prefix + name]
                self._b.equal(phase.end, where, [prefix + component], outputs, measure)
            # a gap ends where the two meet; zero penetration alone would also hold where they part
            if phase.end == TOUCH:
                self._bound_rate(last, start + last * size, receding=False)
        if self.phases[-1].apart:  # or they would touch again
            self._bound_rate(self.end[-1], start + self.end[-1] * size, receding=True)

    def _add_dynamics(self, i: int, place: Place, first: dict[str, int]) -> None:
        """Add the constraints of the robot at a stage, and those of the target.

        first : index of the stage's first output of each block.
        """
        b, c, joints = self._b, self._b.coordinates, self._b.robot.joint_names
        closure = [f"{leg.end} {d}" for leg in c.legs for d in DIRECTIONS]
        if "coasting" in first:
            names = [*closure, *[f"{n} rate" for n in closure]]
            measures = [*along(closure, "off"), *rates(closure)]
            outputs = first["coasting"] + np.arange(len(names))
            b.equal("legs of the coasting reference", place, names, outputs, measures)
        part = b.parts("collision")
        b.equal("closed legs", place, closure, first["collision"] + part["closure"], along(closure, "open"))
        base, joint = first["collision"] + part["base"], first["collision"] + part["joints"]
        b.equal("collision dynamics", place, DIRECTIONS[: c.base], base, b.limits.unbalanced)
        b.equal("collision dynamics", place, joints, joint, percent("of the joint's limit off"))
        if self.bristles.size and not self.apart[i]:
            bristles = [f"bristle {k}" for k in range(self.bristles.size)]
            outputs = first["collision"] + part["bristles"]
            b.equal("bristles", place, bristles, outputs, Measure("mm", 1e3 * DEPTH_SCALE, "off"))
        if self.tangential.size:
            outputs, off = first["collision"] + part["tangential"], Measure("m/s", 1.0, "off")
            b.equal("target's motion", place, [f"tangential {x}" for x in "xyz"], outputs, off)
        self._bound_torques(place, first["collision"] + part["torque"], self.torque_fraction)
        if self.cone_margin is not None:
            minimum = b.limits.cone.minimum_force if self.scenario is None else 0.0
            add_cone_constraints(b, self.w[i], place, self.cone_margin, minimum)
        self._add_target(i, place, first["force"])

    def _add_target(self, i: int, place: Place, first: int) -> None:
        """Add contact law, target dynamics and the conditions of the phase at a stage.

        first : index of the stage's first output of the block ``force``.
        """
        b, target, phase = self._b, self._b.problem.target, self.phases[self.stages[i].phase]
        part, fast = b.parts("force"), Measure("m/s", 1.0, "off")
        if not self.forceless[i]:  # else the force is zero by its bounds
            force = Measure("N", FORCE_SCALE, "off")
            for prefix in self._prefixes:
                b.equal("contact law", place, [f"{prefix}force"], first + part[f"{prefix}law"], force)
        states = [f"state {k}" for k in range(target.n_states)]
        of_size = percent("of its size off")
        b.equal("target's motion", place, states, first + part["target"], of_size)
        b.equal("target's motion", place, ["travel"], first + part["travel"], fast)
        b.equal("impulse", place, ["target"], first + part["impulse"], Measure("N s", 1.0, "off"))
        k, at_rest = phase.mode, [0.0] * target.n_states  # a state, to ask which expressions the target has
        ends_by_guard, once = phase.end in target.guards, not self._b.problem.order
        if i in self.end and (ends_by_guard or once):
            # The constraint that ends the phase stands for rate and invariant there.
            if ends_by_guard and target.reserve(at_rest, 0.0, k):
                b.constraints.add(
                    term=phase.end,
                    place=place,
                    components=["reserve"],
                    outputs=first + part["reserve"],
                    lower=0,
                    measure=percent("short"),
                )
            return
        turned = i in self.end and phase.end == TURN
        if self._b.problem.law.switches and target.guards and not (phase.apart or turned):
            # the phase's branch of the law is right while bodies approach, or recede
            self._bound_rate(i, first, receding=phase.restituting)
        if target.invariant(at_rest, 0.0, k):
            b.constraints.add(
                term=target.guards[min(k, len(target.guards) - 1)],
                place=place,
                components=["target"],
                outputs=first + part["invariant"],
                lower=target.margin(k, self.stages[i].place if ends_by_guard or once else 0.0),
                measure=percent("too early"),
            )

    def _bound_rate(self, i: int, first: int, *, receding: bool) -> None:
        """Constrain striker and target to approach each other at a stage, or to recede.

        first : index of the stage's first output of the block ``force``.
        """
        self._b.constraints.add(
            term="approach speed",
            place=self._place(self.stages[i]),
            components=["striker and target"],
            outputs=first + self._b.parts("force")["rate"],
            lower=-np.inf if receding else 0.0,
            upper=0.0 if receding else np.inf,
            measure=Measure("m/s", 1.0, "in the wrong direction"),
        )

    def link(self, start: tuple[Affine, Affine, Affine]) -> list[list[Affine]]:
        """Slots of the block ``link``, from the state after contact to the start of the next phase.

        start : y, y' and duration [s] of that phase.
        """
        return self._link(self.end[-1], start)

    def _link(self, i: int, start: tuple[Affine, Affine, Affine]) -> list[list[Affine]]:
        """Slots of the block ``link`` from a stage."""
        d1, T1, d, T = self._travel(i)
        return self.contact.link(start, (T1, T), (d1, d), self.u[i])

    def link_positions(self) -> list[list[Affine]]:
        """Slots of the block ``link`` that determine the positions `y`, stage by stage."""
        one, each = Affine.constant(1.0), range(self.y.count)
        return [slots for i in each for slots in self._link(i, (self.y[i], self.u[i], one))]

    def write_positions(self, x: Array) -> None:
        """Write the positions `y` that the other variables determine to x (n,)."""
        for i in range(self.y.count):
            x[self.y.index(i)] = self._position(x, i)

    def _position(self, x: Array, i: int) -> Array:
        """Position (ny,) at a stage, for solver variables x (n,)."""
        y0, d1, T1, d, T = (e.evaluate(x) for e in [self.contact.state.y, *self._travel(i)])
        return y0 + T1 * d1 + T * d

    @property
    def state_after(self) -> list[Affine]:
        """y, ydot, legs and T (1 s) after contact, if the position after contact is a variable."""
        end = self.end[-1]
        return [self.after[0], self.u[end], self.legs[end], Affine.constant(1.0)]

    def link_after(self) -> list[list[Affine]]:
        """Slots of the block ``link`` that determine the position after contact."""
        y, rate, _, one = self.state_after
        return self.link((y, rate, one))

    # ------------------------------------------------------------------ initial guess and solution
    def guess(self, x: Array, y: Array, rates: Array, legs: Array) -> None:
        """Write the initial guess to x (n,): all rates of the robot fall as a point mass's speed does.

        y, rates (ny,), legs (nl,) : at contact.
        """
        c, p, layout = self._b.coordinates, self._b.problem, self._b.layout
        place = np.array([s.place for s in self.stages])
        phase = np.array([s.phase for s in self.stages])
        mass, speed = effective_mass(c, p.strikers, p.normal, y, legs, rates)
        found = guessed_contact(*self.per_striker(), mass, speed, phase, place, p.order)
        times = np.clip(found.durations, *np.transpose([layout.bounds(group) for group in self.T]))
        for group, value in zip(self.T, times, strict=True):
            group.write(x, value)
        before = np.concatenate([[0.0], np.cumsum(times)])
        # d and xt are integrals over s: by the duration of the guess, not the clipped one, so that d is the
        # integral of u ds
        per_time = (1 / found.durations[phase])[:, None]
        d = found.moved[:, None] * per_time * rates
        self.u.write(x, found.speed[:, None] * rates)
        self.d.write(x, d)
        self.state.write(x, found.state)
        self.xt.write(x, found.travel[:, None] * per_time)
        self.f.write(x, np.where(self.forceless, 0.0, found.force)[:, None])
        # the point mass is in place of each striker
        self.p.write(x, len(p.strikers) * found.impulse[:, None])
        for joined, each in ((self.joined, d[self.end]), (self.joined_x, self.xt.read(x)[self.end])):
            # mean rate in the first k phases: their mean rates, weighted by their durations
            means = [(times[:k, None] / before[k] * each[:k]).sum(axis=0) for k in range(2, len(times))]
            joined.write(x, np.reshape(means, (joined.count, joined.size)))
        self.after.write(x, y + float(found.moved[self.end].sum()) * rates)
        self.write_positions(x)
        self.guess_model(x, y, rates, legs)
        if c.legs:
            self.legs.write(x, legs)
            self.w.write(x, self.contact.state.w.evaluate(x))

    def guess_model(self, x: Array, y: Array, rates: Array, legs: Array) -> None:
        """Write the initial guess of variables that only this collision model has: the reference's legs."""
        if not legs.size:
            return
        elapsed = np.ravel([self._time(s.phase, s.place).evaluate(x) for s in self.stages])
        for k, (angles, motion) in enumerate(coasted(self._b.coordinates, elapsed, y, rates, legs)):
            x[self.coast_legs.index(k)], x[self.coast_rates.index(k)] = angles, motion[0]

    def durations(self, x: Array) -> tuple[float, float]:
        """Durations of compression, with all phases before the last, and of restitution [s]."""
        *before, last = (float(g.read(x)[0, 0]) for g in self.T)
        return sum(before), last

    def decode(self, x: Array, outputs: dict[str, Array], approaches: Array) -> PlannedCollision:
        """Collision of a plan, from solver variables (n,).

        outputs : of the blocks, by name.  approaches (strikers,) : speeds along the normal at contact [m/s].
        """
        b, target = self._b, self._b.problem.target
        durations = [float(g.read(x)[0, 0]) for g in self.T]
        time = [sum(durations[: s.phase]) + s.place * durations[s.phase] for s in self.stages]
        before = float(target.speed_before(self.target))
        # the limit from the right at contact, where collocation has no point
        first = [float(b.problem.law.branch(0.0, float(v) - before, True, self.law)) for v in approaches]
        forces, wrench = np.vstack([first, self.f.read(x)]), self.w.read(x)
        start = self.number * len(self.stages)  # the blocks' instances are collision by collision
        own = slice(start, start + len(self.stages))
        torque = outputs["collision"][own, b.parts("collision")["torque"]]
        speed = outputs["force"][own, b.parts("force")["speed"][0]]
        state = self.state.read(x)[-1]
        outcome, tangential = target.outcome(state, self.target), None
        if self.tangential.size:
            tangential = np.vstack([np.zeros(3), self.tangential.read(x)])
            outcome |= tangential_outcome(tangential[-1])
        return PlannedCollision(
            time=np.array([0.0, *time]),
            force=forces.sum(axis=1),
            forces=forces,
            target_speed=np.array([before, *speed]),
            torque=np.vstack([self.contact.feedforward[0].evaluate(x), torque]) * b.robot.torque_limit,
            sole_wrench=wrench,
            ground=total_ground_wrench(b.coordinates, wrench),
            outcome=outcome,
            tangential_velocity=tangential,
            target_state=state,
            **self._joints(x, type(b.problem.law)(**self.law)),
        )
