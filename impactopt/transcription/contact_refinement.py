"""Estimates the discretization error of a planned contact, and selects the elements that reduce it.

The contact is integrated once more from the plan's state at contact, by the same equations on elements half
as long, over the same time, and by the contact law with its switches in place of one branch a phase. What
its impulse then is another by, the plan is wrong by. Where its force falls below zero within a phase, or does
not fall to zero at the end, the plan has missed an event: the bodies part, and may meet again.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from impactopt.transcription.builder import Builder
from impactopt.transcription.collision import Collision
from impactopt.transcription.contact_blocks import DEPTH_SCALE, RESTITUTING
from impactopt.transcription.contact_program import ContactProgram
from impactopt.transcription.contact_set import Hit, approaches
from impactopt.transcription.contact_state import Contact, ContactState, add_coasting, switches
from impactopt.transcription.layout import Affine, Array, Index
from impactopt.transcription.mesh import GEAR, CollocationPoint, Elements, halved, lagrange
from impactopt.transcription.plan import PlannedCollision, gear_share
from impactopt.transcription.structured import StructuredProgram

ASKED = 0.5  # [%] of the impulse: the error that does not justify another solve
_MISSED = 0.02  # of the peak force: how far it may be below zero within a phase, or above it at the end
_TURNED = 1e-3  # of the peak force: what the law's other branch may differ by where it is the right one
_STEPS, _MET = 8, 1e-7  # of Newton's method, and the residual at which it is done
_SWITCHES = 6  # at most: how often points change the branch of the law that they are on
_ORDER = 5  # of which the error of an element is in its length, at best
_PARTS = 4  # an element is cut into, at most
_MOST = 16  # elements of a phase


@dataclass(frozen=True, kw_only=True)
class ContactError:
    """Error of a plan's contact, the worst over its targets.

    pct : error of the impulse [%]; inf where an event is missed, or no contact was found.
    coarse : what of it is the elements'; the rest is that phases hold to one branch of the law.
    of_elements : what each element of each phase adds to `coarse` [%].
    missed : whether an event is missed.
    strained : in which elements of each phase a gear carries more than it may, between the plan's own points.
    finer : the collisions as they are on elements half as long, in the program's order: torque and ZMP are
        worst between the plan's own points. Empty if none was found.
    """

    pct: float
    coarse: float
    of_elements: Elements
    missed: bool
    strained: tuple[tuple[bool, ...], ...] = ()
    finer: tuple[PlannedCollision, ...] = field(default=(), repr=False, compare=False)


def contact_error(t: ContactProgram, x: Array) -> ContactError | None:
    """The error of the contact of solver variables (n,); None of an impact without duration."""
    if not isinstance(t.hit.expected, Collision):
        return None
    again = _Again(t, x)
    try:
        branches, law = again.integrated(x)
    except ArithmeticError:
        unknown = tuple((np.inf,) * len(phase) for phase in t.hit.elements)
        return ContactError(pct=np.inf, coarse=np.inf, of_elements=unknown, missed=False)
    coarse, grown, errors = [], [], []
    finer, outputs = list[PlannedCollision](), again.program.outputs(branches)
    approach = approaches(t.program.outputs(x))
    for new, old in zip(again.hit.collisions, t.hit.collisions, strict=True):
        assert isinstance(new, Collision) and isinstance(old, Collision)
        finer.append(new.decode(branches, outputs, approach))
        coarse.append(_off(new, old, branches, x))
        grown.append(_grown(new, old, branches, x))
        errors.append(_off(new, old, law, x))
    ends = np.cumsum([len(phase) for phase in t.hit.elements])[:-1]
    strained = np.any([_strained(t, hit, again.hit.stages) for hit in finer], axis=0)
    return ContactError(
        pct=max(errors, key=abs),
        coarse=max(coarse, key=abs),
        of_elements=tuple(tuple(map(float, phase)) for phase in np.split(np.max(grown, axis=0), ends)),
        missed=bool(np.isinf(errors).any()),
        strained=tuple(tuple(map(bool, phase)) for phase in np.split(strained, ends)),
        finer=tuple(finer),
    )


def refined_elements(error: ContactError | None, elements: Elements, asked: float = ASKED) -> Elements | None:
    """Elements for a contact with less error than is asked for [%]; None where it has less, or no more help.

    Those with much of the error are cut, into more parts the more they have, and those in which a gear
    carries too much; all where an event is missed.
    """
    strained = error is not None and any(map(any, error.strained))
    if error is None or (abs(error.coarse) <= asked and not error.missed and not strained):
        return None
    share = asked / sum(map(len, elements))
    out = []
    none = [(False,) * len(lengths) for lengths in elements]
    for lengths, errors, loads in zip(elements, error.of_elements, error.strained or none, strict=True):
        phase: list[float] = []
        for h, e, load in zip(lengths, errors, loads, strict=True):
            # p parts of an element have 1 / p^order of its error: as many as bring it to its share
            parts = int(np.clip(np.ceil((e / share) ** (1 / _ORDER)), 1, _PARTS))
            parts = max(parts, 2) if error.missed or load else parts
            phase += [h / parts] * parts
        out.append(tuple(phase) if len(phase) <= max(_MOST, len(lengths)) else lengths)
    refined = tuple(out)
    return None if refined == elements else refined


def all_halved(elements: Elements) -> Elements | None:
    """All of them in two, where a phase may have so many; None where none may."""
    finer = tuple(
        new if len(new) <= _MOST else old for new, old in zip(halved(elements), elements, strict=True)
    )
    return None if finer == elements else finer


class _Again:
    """The contact alone on elements half as long, from a state at contact that is given, for as long."""

    def __init__(self, t: ContactProgram, x: Array) -> None:
        self._of, b = t.hit, Builder(t.problem, t.coordinates, t.functions)
        given = ContactState(*(Affine.constant(e.evaluate(x)) for e in t.hit.contact.state))
        self._builder = b
        self.hit = Hit(b, Contact(given, *add_coasting(b)), halved(t.hit.elements), t.hit.shares, after=False)
        self.hit.add_rows()
        # a plan has no law where contact ends, as force is zero there; here it is what it comes to
        last = len(self.hit.stages) - 1
        for k in range(len(self.hit.collisions)):
            b.equal("contact law", "end", ["force"], self.hit.output(k, last, "law"))
            if t.problem.second is not None:
                b.equal("contact law", "end", ["second force"], self.hit.output(k, last, "second law"))
        n = b.layout.n
        self.program = StructuredProgram(
            b.layout,
            b.blocks,
            b.rows,
            objective=Affine.zeros(1),
            quadratic=sp.csr_array((n, n)),
            linear=np.zeros(n),
        )

    def integrated(self, x: Array) -> tuple[Array, Array]:
        """Variables (n,) of the contact that starts as in those of the plan: with the branches of the law
        that its phases hold to, and with those that its rates ask for.

        Raises
        ------
        ArithmeticError : Newton's method finds none.
        """
        program, held = self.program, []
        z = np.zeros(program.n)
        for mine, its in zip(self.hit.contact[1:], self._of.contact[1:], strict=True):
            mine.write(z, its.read(x))
            held.append(mine.index(0))
        for new, old in zip(self.hit.collisions, self._of.collisions, strict=True):
            assert isinstance(new, Collision) and isinstance(old, Collision)
            carry_contact(new, old, z, x)
            held += [new.after.index(0)] if new.after.count else []
            held += [new.f.index(int(i)) for i in np.flatnonzero(new.forceless[:-1])]
        ends = {phase.end for phase in self._builder.problem.contact_phases}
        equal = program.g_lower == program.g_upper
        events = np.array([o.term in ends for o in program.origins])

        def parts(*, timed: bool) -> tuple[Index, Index]:
            """Free variables, and the constraints that determine them; whether events end phases when they
            come.
            """
            times = [] if timed else [g.index(0) for hit in self.hit.collisions for g in hit.T]
            free = np.setdiff1d(np.arange(program.n), np.concatenate([*held, *times]))
            return free, np.flatnonzero(equal & (timed | ~events))

        # With free durations each phase ends at its event; where an event does not come, or two strikers have
        # one each, phases last as long as in the plan.
        before = z.copy()
        try:
            if self._builder.problem.second is not None:
                raise ArithmeticError("two strikers end one phase")
            free, rows = parts(timed=True)
            self._newton(z, free, rows)
        except ArithmeticError:
            z = before
            free, rows = parts(timed=False)
            self._newton(z, free, rows)
        branches = z.copy()
        for _ in range(_SWITCHES if switches(self._builder.problem.law) else 0):
            if not self._turned(z):
                break
            self._newton(z, free, rows)
        return branches, z

    def _newton(self, z: Array, free: Index, rows: Index) -> None:
        """Change the free ones among the variables until these constraints are met."""
        program = self.program
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")  # a matrix that is singular is a method that fails
            for _ in range(_STEPS):
                off = (program.constraints(z) - program.g_lower)[rows]
                if np.abs(off).max() < _MET:
                    return
                try:
                    z[free] -= splu(sp.csc_matrix(program.jacobian(z)[rows][:, free])).solve(off)
                except RuntimeError as error:
                    raise ArithmeticError("no contact: the matrix is singular") from error
        raise ArithmeticError(f"no contact after {_STEPS} steps")

    def _turned(self, z: Array) -> bool:
        """Put points on the branch of the law that their rates ask for; whether any was on the other."""
        block = next(b for b in self._builder.blocks if b.name == "force")
        part = self._builder.parts("force")
        of = self.program.outputs(z)["force"]
        depth, rate = DEPTH_SCALE * of[:, part["penetration"][0]], of[:, part["rate"][0]]
        restituting = block.value.inputs[1][: block.count, RESTITUTING] > 0
        law, n = self._builder.problem.law, len(self.hit.stages)
        wrong = np.zeros(block.count, dtype=bool)  # of two strikers by the first: both turn at one instant
        for k, collision in enumerate(self.hit.collisions):
            assert isinstance(collision, Collision)
            mine = slice(k * n, (k + 1) * n)
            force = collision.f.read(z)[:, 0]
            other = [
                float(law.branch(a, b, bool(back), collision.law))
                for a, b, back in zip(depth[mine], rate[mine], restituting[mine], strict=True)
            ]
            differs = np.abs(np.array(other) - force) > _TURNED * np.abs(force).max()
            wrong[mine] = differs & (restituting[mine] == (rate[mine] > 0))
        for function in (block.value, block.jacobian):
            function.inputs[1][: block.count, RESTITUTING] = restituting ^ wrong
        return bool(wrong.any())


def _strained(t: ContactProgram, hit: PlannedCollision, stages: Sequence[CollocationPoint]) -> Array:
    """Elements of the program in which a gear carries too much, in a collision on elements half as long."""
    share = gear_share(t.problem, hit.torque, hit.acceleration)[1:] > 1.0 + GEAR
    elements = sorted({s.members for s in stages})
    out = np.zeros(len(elements) // 2, dtype=bool)
    for s, over in zip(stages, share, strict=True):
        out[elements.index(s.members) // 2] |= over
    return out


def _scale(old: Collision, x: Array) -> float:
    """Factor of impulses [N s] to [%] of the impulse of a plan (n,)."""
    return 100 / max(abs(float(old.p.read(x)[-1, 0])), 1e-9)


def _grown(new: Collision, old: Collision, z: Array, x: Array) -> Array:
    """Contribution of each element to the error of the impulse [%]: (elements,)."""
    planned, found = old.p.read(x)[:, 0], new.p.read(z)[:, 0]
    ends = [
        float(found[i] - planned[k])
        for i, k in same_places(new.stages, old.stages)
        if k == old.stages[k].members[-1]
    ]
    return np.asarray(np.abs(np.diff([0.0, *ends])) * _scale(old, x))


def _off(new: Collision, old: Collision, z: Array, x: Array) -> float:
    """Error of the impulse [%]; inf where bodies part within a phase, or do not part at its end."""
    each, last = new.f.read(z), list(new.stages[-1].members)
    force = each.sum(axis=1)
    duration, peak = float(new.T[-1].read(z)[0, 0]), float(np.abs(force).max())
    # it falls to zero a little earlier or later than planned
    places = duration * np.array([new.stages[k].place for k in last])
    slope = float(np.polyval(np.polyder(np.polyfit(places, force[last], len(last) - 1)), places[-1]))
    apart = not new.holds and each[: last[0]].min(initial=0.0) < -_MISSED * peak
    if apart or (slope >= 0 and force[-1] > _MISSED * peak):
        return float(np.inf)
    left = 0.5 * float(force[-1]) ** 2 / -slope if slope < 0 else 0.0
    return _scale(old, x) * (float(new.p.read(z)[-1, 0] - old.p.read(x)[-1, 0]) + left)


def carry_contact(new: Collision, old: Collision, into: Array, x: Array) -> None:
    """Write what a collision's collocation polynomials are at the points of elements that part its own.

    into : solver variables of the new one's program.  x : of the old one's.
    """
    start = {"u": old.contact.u0.read(x), "state": np.zeros((1, old.state.size))}
    start |= {name: np.zeros((1, 1)) for name in ("xt", "p")}
    for name, at_contact in start.items():
        weights = _weights(new.stages, old.stages, anew=name == "xt")
        of_old = np.vstack([getattr(old, name).read(x), at_contact])
        getattr(new, name).write(into, weights @ of_old)
    loose = _weights(new.stages, old.stages, known=False)[:, :-1]
    for mine, its in zip(new.loose(), old.loose(), strict=True):
        mine.write(into, loose @ its.read(x))
    for integral, rate in new.integrated():
        u = rate.read(into)
        d = np.zeros_like(u)
        for i, s in enumerate(new.stages):  # by their constraints, which are linear
            d[i] = s.quadrature @ u[list(s.members)] + (0.0 if s.new_phase else d[s.previous])
        integral.write(into, d)
    for mine, its in zip(new.held_over(), old.held_over(), strict=True):
        mine.write(into, its.read(x))


def same_places(new: Sequence[CollocationPoint], old: Sequence[CollocationPoint]) -> list[tuple[int, int]]:
    """Indices of stages that are at one place in one phase."""
    known = {(s.phase, round(s.place, 9)): k for k, s in enumerate(old)}
    pairs = ((i, known.get((s.phase, round(s.place, 9)))) for i, s in enumerate(new))
    return [(i, k) for i, k in pairs if k is not None]


def _weights(
    new: Sequence[CollocationPoint],
    old: Sequence[CollocationPoint],
    *,
    anew: bool = False,
    known: bool = True,
) -> Array:
    """Weights (new, old + 1) of the old stages' values, and of that at contact, in those at the new ones.

    anew : of what begins at zero in each phase.  known : whether the value at contact is.
    """
    out = np.zeros((len(new), len(old) + 1))
    for i, s in enumerate(new):
        own = next(
            e.members for e in old if e.phase == s.phase and old[e.members[-1]].place >= s.place - 1e-9
        )
        first = old[own[0]]
        at, places = list(own), [old[k].place for k in own]
        if known or first.previous >= 0:
            begins = first.previous < 0 or (anew and first.new_phase)
            at.append(len(old) if begins else first.previous)
            places.append(0.0 if first.new_phase else old[first.previous].place)
        out[i, at] = lagrange(places, s.place)
    return out
