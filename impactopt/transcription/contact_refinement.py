"""Estimates the discretization error of a planned contact, and selects collocation elements that reduce it.

The contact is integrated again from the plan's state at contact: by the same equations on elements half as
long, and by the contact law with its switches in place of one branch a phase. The difference of the impulses
estimates the plan's error. If the force falls below zero within a phase, or does not fall to zero at the end,
the plan has missed an event: the bodies separate, and may meet again.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from impactopt.arrays import Array, Index
from impactopt.contact.targets.base import Target
from impactopt.transcription.builder import Builder
from impactopt.transcription.collision import Collision
from impactopt.transcription.contact_blocks import DEPTH_SCALE, RESTITUTING
from impactopt.transcription.contact_program import ContactProgram
from impactopt.transcription.contact_set import ContactSet, approaches
from impactopt.transcription.contact_state import Contact, ContactState, add_coasting
from impactopt.transcription.layout import Affine
from impactopt.transcription.mesh import GEAR, CollocationPoint, Elements, halved, lagrange
from impactopt.transcription.plan import Plan, PlannedCollision, PlannedStrike, gear_share
from impactopt.transcription.structured import StructuredProgram

TOLERANCE_PCT = 0.5  # [%] of the impulse: an error that does not justify another solve
# Fractions of the peak force: force below zero within a phase, or above zero at the end, that shows a missed
# event; difference between the law's branches that makes a point change to the other one.
_MISSED_EVENT_FORCE, _BRANCH_DIFFERENCE = 0.02, 1e-3
_NEWTON_STEPS, _NEWTON_RESIDUAL = 8, 1e-7
_MAX_BRANCH_CHANGES = 6  # rounds in which points change the branch of the law
_ORDER = 5  # of the error of an element in its length, at best: of Radau IIA with three stages
_MAX_PARTS = 4  # that an element is cut into
_MAX_ELEMENTS = 16  # of a phase


@dataclass(frozen=True, kw_only=True)
class ContactError:
    """Discretization error of a plan's contact, the largest over its targets.

    pct : error of the impulse [%]; inf if an event is missed, or the finer contact was not found.
    coarse : the part of it [%] that longer elements cause, or what they change of the momentum across the
        normal that friction gives the target, over the impulse, if that is more. The rest comes from phases
        that keep to one branch of the law.
    of_elements : contribution of each element of each phase to `coarse` [%].
    missed : an event is missed.
    strained : by phase and element, a gear carries more than it may between the plan's collocation points.
    finer : the collisions on elements half as long, in the program's order, as torque and ZMP may be worse
        between the plan's points. Empty if they were not found, or are other contacts as an event is
        missed.
    """

    pct: float
    coarse: float
    of_elements: Elements
    missed: bool
    strained: tuple[tuple[bool, ...], ...] = ()
    finer: tuple[PlannedCollision, ...] = field(default=(), repr=False, compare=False)


def finest(planned: Plan | PlannedStrike, error: ContactError | None) -> list[PlannedCollision]:
    """The expected collision and those of the scenarios, on the finer mesh of the error estimate if there is
    one, as torque and ZMP may be worse between the program's points. The outcomes are those of the plan.
    """
    collisions = [planned.collision, *(scenario.collision for scenario in planned.scenarios)]
    if error is None or not error.finer:
        return collisions
    return [replace(new, outcome=old.outcome) for new, old in zip(error.finer, collisions, strict=True)]


def contact_error(t: ContactProgram, x: Array) -> ContactError | None:
    """Error of the contact in solver variables x (n,); None for an impact without duration."""
    if not isinstance(t.hit.expected, Collision):
        return None
    contact = _FinerContact(t, x)
    try:
        by_phases, by_law = contact.integrated(x)
    except ArithmeticError:
        unknown = tuple((np.inf,) * len(phase) for phase in t.hit.elements)
        return ContactError(pct=np.inf, coarse=np.inf, of_elements=unknown, missed=False)
    coarse, of_elements, errors = [], [], []
    finer, outputs = list[PlannedCollision](), contact.program.outputs(by_phases)
    # `decode` needs the outputs of the finer program, but contact begins at the plan's own speed.
    approach = approaches(t.program.outputs(x))
    for new, old in zip(contact.hit.lasting, t.hit.lasting, strict=True):
        finer.append(new.decode(by_phases, outputs, approach))
        of_element = _element_errors(new, old, by_phases, x, t.problem.target)
        across = float(np.linalg.norm(of_element[:, 1:].sum(axis=0)))
        coarse.append(max(_impulse_error(new, old, by_phases, x), across, key=abs))
        of_elements.append(np.linalg.norm(of_element, axis=1))
        errors.append(_impulse_error(new, old, by_law, x))
    ends = np.cumsum([len(phase) for phase in t.hit.elements])[:-1]
    missed = bool(np.isinf(errors).any())
    strained = np.any([_strained(t, hit, contact.hit.stages) for hit in finer], axis=0)
    return ContactError(
        pct=max(errors, key=abs),
        coarse=max(coarse, key=abs),
        of_elements=tuple(tuple(map(float, phase)) for phase in np.split(np.max(of_elements, axis=0), ends)),
        missed=missed,
        strained=tuple(tuple(map(bool, phase)) for phase in np.split(strained, ends)),
        finer=() if missed else tuple(finer),
    )


def refined_elements(error: ContactError | None, elements: Elements) -> Elements | None:
    """Elements that bring the error of a contact below `TOLERANCE_PCT`.

    An element is cut into the more parts, the larger its error, and in two if a gear carries too much in it;
    all are cut if an event is missed.

    None if the error is below it already, or phases may have no more elements.
    """
    strained = error is not None and any(map(any, error.strained))
    if error is None or (abs(error.coarse) <= TOLERANCE_PCT and not error.missed and not strained):
        return None
    # Errors of elements add up, so each gets an equal part of the tolerance.
    most = TOLERANCE_PCT / sum(map(len, elements))  # of an element
    out = []
    none = [(False,) * len(lengths) for lengths in elements]
    for lengths, errors, loads in zip(elements, error.of_elements, error.strained or none, strict=True):
        phase: list[float] = []
        for h, e, load in zip(lengths, errors, loads, strict=True):
            # p parts of an element have 1 / p^order of its error
            parts = int(np.clip(np.ceil((e / most) ** (1 / _ORDER)), 1, _MAX_PARTS))
            parts = max(parts, 2) if error.missed or load else parts
            phase += [h / parts] * parts
        out.append(tuple(phase) if len(phase) <= max(_MAX_ELEMENTS, len(lengths)) else lengths)
    refined = tuple(out)
    return None if refined == elements else refined


def all_halved(elements: Elements) -> Elements | None:
    """Elements cut in two, in phases that may have as many; None if no phase may."""
    finer = tuple(
        new if len(new) <= _MAX_ELEMENTS else old for new, old in zip(halved(elements), elements, strict=True)
    )
    return None if finer == elements else finer


class _FinerContact:
    """Program of the contact alone, on elements half as long, from a given state at contact."""

    def __init__(self, t: ContactProgram, x: Array) -> None:
        self._planned, b = t.hit, Builder(t.problem, t.functions)
        # the state at contact is no variable here: expressions without terms in x
        given = ContactState(*(Affine.constant(e.evaluate(x)) for e in t.hit.contact.state))
        self._builder = b
        self.hit = ContactSet(
            b, Contact(given, *add_coasting(b)), halved(t.hit.elements), t.hit.shares, after=False
        )
        self.hit.add_constraints()
        # In a plan contact ends where the force is zero, without a constraint of the law. Here the last stage
        # may be elsewhere, and has the law, unless it is in a gap.
        last = len(self.hit.stages) - 1
        self._apart = t.problem.contact_phases[-1].apart
        for k in range(0 if self._apart else len(self.hit.collisions)):
            b.equal("contact law", "end", ["force"], self.hit.output(k, last, "law"))
            if t.problem.second is not None:
                b.equal("contact law", "end", ["second force"], self.hit.output(k, last, "second law"))
        n = b.layout.n
        self.program = StructuredProgram(
            b.layout,
            b.blocks,
            b.constraints,
            objective=Affine.zeros(1),
            quadratic=sp.csr_array((n, n)),
            linear=np.zeros(n),
        )

    def integrated(self, x: Array) -> tuple[Array, Array]:
        """Variables (n,) of the finer contact from those of the plan, x.

        Returns
        -------
        With one branch of the law in each phase, as the plan; and with the branch that each point's rate has.

        Raises
        ------
        ArithmeticError : Newton's method does not converge.
        """
        program, fixed = self.program, []
        z = np.zeros(program.n)
        for new_group, old_group in zip(self.hit.contact[1:], self._planned.contact[1:], strict=True):
            new_group.write(z, old_group.read(x))
            fixed.append(new_group.index(0))
        for new, old in zip(self.hit.lasting, self._planned.lasting, strict=True):
            map_stages(new, old, z, x)
            for new_group, old_group in zip(new.kept_groups(), old.kept_groups(), strict=True):
                new_group.write(z, old_group.read(x))
            # positions after contact follow from the solution, and what is zero by its bounds is not
            # determined
            fixed += [new.after.index(0)] if new.after.count else []
            fixed.append(np.setdiff1d(new.zeros(), [] if self._apart else new.f.index(-1)))
        ends = {phase.end for phase in self._builder.problem.contact_phases}
        # Inequalities do not matter here: the contact runs as it does, and `contact_error` looks at the
        # result.
        equal = program.g_lower == program.g_upper
        events = np.array([o.term in ends for o in program.origins])

        def system(*, free_durations: bool) -> tuple[Index, Index]:
            """Free variables, and the constraints that determine them."""
            times = [] if free_durations else [g.index(0) for hit in self.hit.lasting for g in hit.T]
            free = np.setdiff1d(np.arange(program.n), np.concatenate([*fixed, *times]))
            return free, np.flatnonzero(equal & (free_durations | ~events))

        # With free durations each phase ends at its event. If an event does not happen, or two strikers have
        # one each, phases last as long as in the plan.
        before = z.copy()
        try:
            if self._builder.problem.second is not None:
                raise ArithmeticError("two strikers end one phase")
            free, constraints = system(free_durations=True)
            self._newton(z, free, constraints)
        except ArithmeticError:
            z = before
            free, constraints = system(free_durations=False)
            self._newton(z, free, constraints)
        by_phases = z.copy()
        for _ in range(_MAX_BRANCH_CHANGES if self._builder.problem.law.switches else 0):
            if not self._change_branches(z):
                break
            self._newton(z, free, constraints)
        return by_phases, z

    def _newton(self, z: Array, free: Index, constraints: Index) -> None:
        """Change the free variables until these constraints hold; ArithmeticError if they do not."""
        program = self.program
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")  # a singular matrix is reported below
            for _ in range(_NEWTON_STEPS):
                residual = (program.constraints(z) - program.g_lower)[constraints]
                if np.abs(residual).max() < _NEWTON_RESIDUAL:
                    return
                jacobian = program.jacobian(z)[constraints][:, free]
                try:
                    # `system` gives as many constraints as free variables
                    z[free] -= splu(sp.csc_matrix(jacobian)).solve(residual)
                except RuntimeError as error:
                    raise ArithmeticError("no contact: the matrix is singular") from error
        raise ArithmeticError(f"no contact after {_NEWTON_STEPS} steps")

    def _change_branches(self, z: Array) -> bool:
        """Put each point on the branch of the law that its rate has; False if all are there."""
        block = next(b for b in self._builder.blocks if b.name == "force")
        part = self._builder.parts("force")
        outputs = self.program.outputs(z)["force"]
        depth, rate = DEPTH_SCALE * outputs[:, part["penetration"][0]], outputs[:, part["rate"][0]]
        restituting = block.value.inputs[1][: block.count, RESTITUTING] > 0
        law, n = self._builder.problem.law, len(self.hit.stages)
        # two strikers have one branch: by the first, as both end compression at one instant
        wrong = np.zeros(block.count, dtype=bool)
        for k, collision in enumerate(self.hit.lasting):
            mine = slice(k * n, (k + 1) * n)
            force = collision.f.read(z)[:, 0]
            other = [
                # `compressing` is what restitutes: the force on the other branch
                float(law.branch(a, b, bool(back), collision.law))
                for a, b, back in zip(depth[mine], rate[mine], restituting[mine], strict=True)
            ]
            differs = np.abs(np.array(other) - force) > _BRANCH_DIFFERENCE * np.abs(force).max()
            # A point is wrong if it restitutes while bodies approach, or compresses while they recede, and if
            # its force is then noticeably another. Near a rate of zero it is not, and rounding would move
            # points to and fro.
            wrong[mine] = differs & (restituting[mine] == (rate[mine] > 0))
        # not of the Hessian, which Newton's method on a square system does not call
        for function in (block.value, block.jacobian):
            function.inputs[1][: block.count, RESTITUTING] = restituting ^ wrong
        return bool(wrong.any())


def _strained(t: ContactProgram, hit: PlannedCollision, stages: Sequence[CollocationPoint]) -> Array:
    """Mask of the program's elements in which a gear carries too much, from a finer collision."""
    share = gear_share(t.problem, hit.torque, hit.acceleration)[1:] > 1.0 + GEAR
    elements = sorted({s.members for s in stages})
    # each element of the program is two of the finer ones
    out = np.zeros(len(elements) // 2, dtype=bool)
    for s, over in zip(stages, share, strict=True):
        out[elements.index(s.members) // 2] |= over
    return out


def _scale(old: Collision, x: Array) -> float:
    """Factor from impulses [N s] to percent of the planned impulse."""
    return 100 / max(abs(float(old.p.read(x)[-1, 0])), 1e-9)


def _element_errors(new: Collision, old: Collision, z: Array, x: Array, target: Target) -> Array:
    """Contributions (elements, 1 or 4) of each element to the error of the impulse [%], and of the momentum
    across the normal of a target that friction moves.
    """
    mass = target.tangential_mass(old.target) or 0.0
    planned, found = (
        np.hstack([hit.p.read(values), mass * hit.tangential.read(values)])
        for hit, values in ((old, x), (new, z))
    )
    ends = [
        found[i] - planned[k]
        for i, k in same_places(new.stages, old.stages)
        # Radau's last stage is the element's end, which both meshes have, as elements are halved
        if k == old.stages[k].members[-1]
    ]
    return np.diff(ends, axis=0, prepend=0.0) * _scale(old, x)


def _impulse_error(new: Collision, old: Collision, z: Array, x: Array) -> float:
    """Error of the impulse [%]; inf if bodies separate within a phase, or do not at the end of the last."""
    each, last = new.f.read(z), list(new.stages[-1].members)
    force = each.sum(axis=1)
    duration, peak = float(new.T[-1].read(z)[0, 0]), float(np.abs(force).max())
    # The force falls to zero a little earlier or later than planned: its slope at the planned end, of the
    # polynomial through the last element's stages, gives the impulse until then.
    places = duration * np.array([new.stages[k].place for k in last])
    slope = float(np.polyval(np.polyder(np.polyfit(places, force[last], len(last) - 1)), places[-1]))
    apart = not new.holds and each[: last[0]].min(initial=0.0) < -_MISSED_EVENT_FORCE * peak
    if apart or (slope >= 0 and force[-1] > _MISSED_EVENT_FORCE * peak):
        return float(np.inf)
    # impulse under a line from the force at the end down to zero: a triangle
    rest = 0.5 * float(force[-1]) ** 2 / -slope if slope < 0 else 0.0
    return _scale(old, x) * (float(new.p.read(z)[-1, 0] - old.p.read(x)[-1, 0]) + rest)


def map_stages(new: Collision, old: Collision, into: Array, x: Array) -> None:
    """Map a collision to other elements: sample its collocation polynomials at their stages.

    Variables that the old collision's model has not are left as they are.

    into : solver variables of the new collision's program, which are written.  x : of the old one's.
    """
    for name in ("u", "state", "xt", "p", "bristles", "tangential"):
        group, old_group = getattr(new, name), getattr(old, name)
        if group.size == old_group.size:
            at_contact = old.contact.u0.read(x) if name == "u" else np.zeros((1, group.size))
            weights = _weights(new.stages, old.stages, each_phase=name == "xt")
            group.write(into, weights @ np.vstack([old_group.read(x), at_contact]))
    weights = _weights(new.stages, old.stages, known=False)[:, :-1]
    known = {group.name: group for group in old.groups_without_start()}
    for group in new.groups_without_start():
        if group.name in known:
            group.write(into, weights @ known[group.name].read(x))
    for integral, rate in new.integrated():
        u = rate.read(into)
        d = np.zeros_like(u)
        for i, s in enumerate(new.stages):  # by the constraints of integrals, which are linear
            d[i] = s.quadrature @ u[list(s.members)] + (0.0 if s.new_phase else d[s.previous])
        integral.write(into, d)
    # bristles jump where they are released: there is no polynomial from a touch into a gap
    into[new.zeros()] = 0.0


def same_places(new: Sequence[CollocationPoint], old: Sequence[CollocationPoint]) -> list[tuple[int, int]]:
    """Indices (new, old) of stages at the same place of the same phase."""
    known = {(s.phase, round(s.place, 9)): k for k, s in enumerate(old)}
    pairs = ((i, known.get((s.phase, round(s.place, 9)))) for i, s in enumerate(new))
    return [(i, k) for i, k in pairs if k is not None]


def _weights(
    new: Sequence[CollocationPoint],
    old: Sequence[CollocationPoint],
    *,
    each_phase: bool = False,
    known: bool = True,
) -> Array:
    """Interpolation matrix (new, old + 1) from values at the old stages and at contact to the new stages.

    each_phase : quantities begin each phase with their value at contact.
    known : there is a value at contact, else its weights are zero.
    """
    out = np.zeros((len(new), len(old) + 1))
    for i, s in enumerate(new):
        # element of the old mesh that contains the new stage
        own = next(
            e.members for e in old if e.phase == s.phase and old[e.members[-1]].place >= s.place - 1e-9
        )
        first = old[own[0]]
        at, places = list(own), [old[k].place for k in own]
        if known or first.previous >= 0:
            # the polynomial of an element goes through its beginning too; column len(old) has the value at
            # contact
            begins = first.previous < 0 or (each_phase and first.new_phase)
            at.append(len(old) if begins else first.previous)
            places.append(0.0 if first.new_phase else old[first.previous].place)
        out[i, at] = lagrange(places, s.place)
    return out
