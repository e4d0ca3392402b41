"""The constraints of a program: what they bound, and how a person reads one that is not met.

A constraint knows its term, its component, its place, whose time is a function of the solution's durations,
and the measure of its violation: "torque limit, swing at 0.61 s, arm_right_4_joint: 12 % over its limit".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from impactopt.problem.violation import Measure, Place, degrees, millimetres, percent
from impactopt.transcription.layout import Affine, Array

__all__ = [
    "Index",
    "Measure",
    "Place",
    "Row",
    "Rows",
    "along",
    "by_leg",
    "degrees",
    "millimetres",
    "percent",
    "rates",
]

Index = NDArray[np.intp]


def by_leg(joints: Index) -> list[Index]:
    """Numbers of leg joints (6 a leg), leg by leg."""
    return list(joints.reshape(-1, 6))


def along(labels: Sequence[str], phrase: str) -> list[Measure]:
    """Measures of constraints in [m] for directions x, y, z, else in [rad], told apart by the labels' last
    words.
    """
    return [millimetres(phrase) if _straight(name) else degrees(phrase) for name in labels]


def rates(labels: Sequence[str]) -> list[Measure]:
    """Measures of constraints in [m/s] or [rad/s], likewise."""
    return [Measure("m/s" if _straight(name) else "rad/s", 1.0, "off") for name in labels]


def _straight(label: str) -> bool:
    return label.split()[-1] in ("x", "y", "z")


@dataclass(frozen=True, eq=False)
class Row:
    """A constraint's origin: term, place and component, and how its violation is reported.

    whole : what the component is a part of, and what messages name in its place; None: the component.
    """

    term: str
    place: Place
    component: str
    measure: Measure | None = None
    whole: str | None = None

    def __str__(self) -> str:
        return _joined(self.term, self.place.name, self.component)

    def told(self, x: Array, amount: float) -> tuple[str, str]:
        """Name of this constraint and amount of its violation in words, at solver variables (n,)."""
        by = f"by {amount:.3g}" if self.measure is None else self.measure.told(x, amount)
        component = self.component if self.whole is None else self.whole
        return _joined(self.term, self.place.told(x), component), by


def _joined(*parts: str) -> str:
    return ", ".join(part for part in parts if part)


@dataclass
class Rows:
    """Constraints under construction: each is at most one block output plus an affine expression of x."""

    outputs: list[Index] = field(default_factory=list)
    affine: list[Affine] = field(default_factory=list)
    lower: list[Array] = field(default_factory=list)
    upper: list[Array] = field(default_factory=list)
    origins: list[Row] = field(default_factory=list)

    def copy(self) -> Rows:
        """The same constraints, to which others can be added."""
        return Rows(*(list(getattr(self, f.name)) for f in fields(self)))

    def bound(self, k: int, lower: ArrayLike, upper: ArrayLike) -> None:
        """Other bounds for what call number ``k`` of :meth:`add` added, none of which it dropped."""
        for sides, given in ((self.lower, lower), (self.upper, upper)):
            sides[k] = np.broadcast_to(np.asarray(given, dtype=float), sides[k].shape)

    def add_each(self, origins: Sequence[Row], *, outputs: Index, lower: float) -> None:
        """Append constraints of these origins:  lower <= out[outputs]."""
        n = len(origins)
        self.outputs.append(np.asarray(outputs, dtype=np.intp))
        self.affine.append(Affine.zeros(n))
        self.lower.append(np.full(n, lower))
        self.upper.append(np.full(n, np.inf))
        self.origins.extend(origins)

    def add(
        self,
        *,
        term: str,
        place: Place | str = "",
        components: Sequence[str],
        outputs: Index | None = None,
        affine: Affine | None = None,
        lower: ArrayLike = -np.inf,
        upper: ArrayLike = np.inf,
        measure: Measure | Sequence[Measure] | None = None,
        whole: str | None = None,
    ) -> None:
        """Append ``len(components)`` constraints  lower <= out[outputs] + affine <= upper.

        measure : of all, or one a constraint; place as text: one without a time; whole : of :class:`Row`.
        Rows that are unbounded on both sides are dropped.
        """
        n = len(components)
        lo = np.broadcast_to(np.asarray(lower, dtype=float), (n,))
        hi = np.broadcast_to(np.asarray(upper, dtype=float), (n,))
        keep = np.flatnonzero(np.isfinite(lo) | np.isfinite(hi))
        if not keep.size:
            return
        out = np.full(n, -1, dtype=np.intp) if outputs is None else np.asarray(outputs, dtype=np.intp)
        lin = Affine.zeros(n) if affine is None else affine
        if keep.size < n:
            out, lin, lo, hi = out[keep], lin[keep], lo[keep], hi[keep]
        self.outputs.append(out)
        self.affine.append(lin)
        self.lower.append(lo)
        self.upper.append(hi)
        where = Place.plain(place) if isinstance(place, str) else place
        measures = [measure] * n if measure is None or isinstance(measure, Measure) else measure
        self.origins.extend(Row(term, where, components[int(k)], measures[int(k)], whole) for k in keep)
