"""A contact on finer elements than it was planned on: its polynomials at their points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from impactopt.transcription.collision import Collision
from impactopt.transcription.layout import Array
from impactopt.transcription.mesh import CollocationPoint, lagrange


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
