"""Layout of an NLP: variables, affine expressions, constraints, limits, order of elimination.

**Units.** The solver sees scaled variables. Expressions of a :class:`Group` carry its scale, so that
everything built from them is in physical units.

**Messages.** A constraint has a term, a place (whose time depends on the solution's durations), a component
and a measure of its violation: "torque limit, swing at 0.61 s, arm_right_4_joint: 12 % over its limit".

**Elimination.** Each part of a program lists variables that its equality constraints determine, with a
`Turn`. The turn fixes the order in which variables are eliminated, since some follow from others. A second
order (`by_choice`) fixes which variables are assigned constraints first, if a constraint could determine
several.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields
from enum import IntEnum
from typing import Any, ClassVar, NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from impactopt.arrays import Array, Index
from impactopt.errors import InputError, check_kind, shortened
from impactopt.kinematics.coordinates import MAX_PITCH, StanceCoordinates
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
from impactopt.problem.terms.grip import WRENCH
from impactopt.problem.violation import Measure, Place, degrees, millimetres
from impactopt.robots.tools import inside
from impactopt.solvers.program import Determined


@dataclass(frozen=True)
class Affine:
    """``size`` affine expressions  const + V x  of the decision vector x; sparse V (size, n) as triplets."""

    size: int
    rows: Index
    cols: Index
    vals: Array
    const: Array

    __array_ufunc__: ClassVar[None] = None  # arrays leave sums and products with them to this class

    @classmethod
    def constant(cls, values: ArrayLike) -> Affine:
        c = np.atleast_1d(np.asarray(values, dtype=float)).ravel()
        none = np.zeros(0, dtype=np.intp)
        return cls(c.size, none, none, np.zeros(0), c)

    @classmethod
    def zeros(cls, size: int) -> Affine:
        return cls.constant(np.zeros(size))

    @classmethod
    def of_matrix(cls, matrix: Any, const: Array) -> Affine:
        """Expressions  matrix x + const  of a sparse matrix (size, n) and const (size,)."""
        entries = sp.coo_array(matrix)
        rows, cols = (np.asarray(i, dtype=np.intp) for i in (entries.row, entries.col))
        return cls(len(const), rows, cols, np.asarray(entries.data), np.asarray(const))

    def __add__(self, other: Affine | ArrayLike) -> Affine:
        if isinstance(other, Affine):
            return add([self, other])
        const = (self.const + np.asarray(other, dtype=float)).ravel()
        _check_sizes([self.size, const.size])
        return Affine(self.size, self.rows, self.cols, self.vals, const)

    __radd__ = __add__  # `sum` begins at 0

    def __mul__(self, factor: ArrayLike) -> Affine:
        if isinstance(factor, Affine):
            raise InputError("a product of affine expressions is not affine: `lift` the output of a block")
        k = np.asarray(factor, dtype=float)
        by_row = k if k.ndim == 0 else np.broadcast_to(k, self.const.shape)[self.rows]
        return Affine(self.size, self.rows, self.cols, self.vals * by_row, self.const * k)

    __rmul__ = __mul__

    def __truediv__(self, divisor: ArrayLike) -> Affine:
        if isinstance(divisor, Affine):
            raise InputError("a quotient of affine expressions is not affine: `lift` the output of a block")
        return self * (1.0 / np.asarray(divisor, dtype=float))

    def __neg__(self) -> Affine:
        return self * -1.0

    def __sub__(self, other: Affine | ArrayLike) -> Affine:
        return self + (-other if isinstance(other, Affine) else -np.asarray(other, dtype=float))

    def __rsub__(self, other: ArrayLike) -> Affine:
        return -self + other

    def __getitem__(self, index: Index | slice) -> Affine:
        keep = np.atleast_1d(np.arange(self.size)[index])
        return select(self, keep)

    @property
    def finite(self) -> bool:
        return bool(np.isfinite(self.vals).all() and np.isfinite(self.const).all())

    def matrix(self, n: int) -> sp.csr_array:
        return sp.csr_array((self.vals, (self.rows, self.cols)), shape=(self.size, n))

    def apply(self, matrix: ArrayLike) -> Affine:
        """The affine expressions ``matrix @ self``."""
        m = np.asarray(matrix, dtype=float)
        # column j of m[:, rows] multiplies triplet j
        r, c = np.nonzero(m[:, self.rows])
        return Affine(m.shape[0], r, self.cols[c], m[r, self.rows[c]] * self.vals[c], m @ self.const)

    def evaluate(self, x: Array) -> Array:
        # A place (row, column) may stand in several triplets, as sums are not merged: all of them count.
        return self.const + np.bincount(self.rows, self.vals * x[self.cols], self.size)


def select(expression: Affine, keep: Index) -> Affine:
    """Expressions with numbers ``keep``, in this order; a number may be repeated."""
    order = np.argsort(expression.rows, kind="stable")
    of_row = expression.rows[order]
    first = np.searchsorted(of_row, keep)
    counts = np.searchsorted(of_row, keep, side="right") - first
    rows = np.repeat(np.arange(len(keep)), counts)
    # each chosen row's triplets are consecutive in `order`, from `first` on
    triplets = order[np.arange(len(rows)) + np.repeat(first - np.cumsum(counts) + counts, counts)]
    cols, vals = expression.cols[triplets], expression.vals[triplets]
    return Affine(len(keep), rows, cols, vals, expression.const[keep])


def add(parts: Sequence[Affine]) -> Affine:
    """Sum of one or more expressions of the same size."""
    _check_sizes([p.size for p in parts])
    return Affine(
        parts[0].size,
        np.concatenate([p.rows for p in parts]),
        np.concatenate([p.cols for p in parts]),
        np.concatenate([p.vals for p in parts]),
        np.asarray(sum(p.const for p in parts)),
    )


def _check_sizes(sizes: Sequence[int]) -> None:
    if len(set(sizes)) > 1:
        raise ValueError(
            f"affine expressions of sizes {' and '.join(map(str, dict.fromkeys(sizes)))} do not add"
        )


def stack(parts: Sequence[Affine]) -> Affine:
    """Concatenation of several expressions."""
    offset = np.cumsum([0] + [p.size for p in parts])
    none = np.zeros(0, dtype=np.intp)
    return Affine(
        int(offset[-1]),
        np.concatenate([none] + [p.rows + o for p, o in zip(parts, offset, strict=False)]),
        np.concatenate([none] + [p.cols for p in parts]),
        np.concatenate([np.zeros(0)] + [p.vals for p in parts]),
        np.concatenate([np.zeros(0)] + [p.const for p in parts]),
    )


@dataclass(frozen=True)
class Group:
    """Variables of one kind: ``count`` vectors of length ``size``, from ``offset`` on in the decision vector.

    Physical values are the solver's times ``scale`` (size,).

    measures (size,) : of the bounds, for messages; () if there is none.
    """

    name: str
    offset: int
    count: int
    size: int
    scale: Array  # (size,)
    labels: tuple[str, ...]
    measures: tuple[Measure, ...] = ()
    _members: dict[int, Affine] = field(default_factory=dict, repr=False, compare=False)

    def index(self, k: int) -> Index:
        if not -self.count <= k < self.count:
            raise IndexError(f"{self.name} has {self.count} members, not {k}")
        first = self.offset + (k % self.count) * self.size
        return np.arange(first, first + self.size)

    def __getitem__(self, k: int) -> Affine:
        if k not in self._members:  # many constraints use the same ones
            rows, index = np.arange(self.size), self.index(k)
            self._members[k] = Affine(self.size, rows, index, self.scale, np.zeros(self.size))
        return self._members[k]

    def read(self, x: Array) -> Array:
        """Physical values, shape (count, size)."""
        return (
            x[self.offset : self.offset + self.count * self.size].reshape(self.count, self.size) * self.scale
        )

    def write(self, x: Array, values: ArrayLike) -> None:
        v = np.broadcast_to(np.asarray(values, dtype=float), (self.count, self.size)) / self.scale
        x[self.offset : self.offset + self.count * self.size] = v.ravel()


@dataclass
class Layout:
    """Decision vector of n variables: consecutive groups, with their bounds in solver units."""

    groups: dict[str, Group] = field(default_factory=dict)
    n: int = 0
    _lower: list[Array] = field(default_factory=list)
    _upper: list[Array] = field(default_factory=list)

    def add(
        self,
        name: str,
        count: int,
        size: int,
        *,
        lower: ArrayLike = -np.inf,
        upper: ArrayLike = np.inf,
        scale: ArrayLike = 1.0,
        labels: Sequence[str] | None = None,
        measure: Measure | Sequence[Measure] | None = None,
    ) -> Group:
        """Append ``count`` vectors of ``size`` variables; bounds (physical) broadcast to (count, size).

        measure : of the bounds, one for all components, or one for each.

        Raises
        ------
        InputError : the name is taken.
        """
        if name in self.groups:
            raise InputError(f"there are variables {name!r} already: give others a name of their own")
        s = np.broadcast_to(np.asarray(scale, dtype=float), (size,)).copy()
        tags = tuple(labels) if labels is not None else tuple(str(i) for i in range(size))
        measures = (measure,) * size if isinstance(measure, Measure) else tuple(measure or ())
        group = Group(name, self.n, count, size, s, tags, measures)
        self.groups[name] = group
        for store, bound in ((self._lower, lower), (self._upper, upper)):
            store.append((np.broadcast_to(np.asarray(bound, dtype=float), (count, size)) / s).ravel())
        self.n += count * size
        return group

    @property
    def lower(self) -> Array:
        return np.concatenate([np.zeros(0), *self._lower])

    @property
    def upper(self) -> Array:
        return np.concatenate([np.zeros(0), *self._upper])

    def bounds(self, group: Group) -> tuple[float, float]:
        """Bounds of a group of one variable, in physical units."""
        if group.count * group.size != 1:
            raise ValueError(f"{group.name} has more than one variable")
        scale = float(group.scale[0])
        return float(self.lower[group.offset]) * scale, float(self.upper[group.offset]) * scale

    def bound(self, group: Group, lower: ArrayLike, upper: ArrayLike) -> None:
        """Replace a group's bounds; as of :meth:`add`."""
        # the stores have one entry a group, in the same order
        k = list(self.groups).index(group.name)
        for store, bound in ((self._lower, lower), (self._upper, upper)):
            shape = group.count, group.size
            store[k] = (np.broadcast_to(np.asarray(bound, dtype=float), shape) / group.scale).ravel()

    def group_of(self, j: int) -> Group:
        """Group of variable j."""
        for group in self.groups.values():
            if 0 <= j - group.offset < group.count * group.size:
                return group
        raise IndexError(j)

    def name(self, j: int) -> str:
        g = self.group_of(j)
        k = j - g.offset
        return f"{g.name}[{k // g.size}], {g.labels[k % g.size]}"


def by_leg(joints: Index) -> list[Index]:
    """Indices of leg joints (6 a leg), split by leg."""
    return list(joints.reshape(-1, 6))


def along(labels: Sequence[str], phrase: str) -> list[Measure]:
    """Measures of constraints in [m] for labels that end in x, y or z, else in [rad]."""
    return [millimetres(phrase) if _is_length(name) else degrees(phrase) for name in labels]


def rates(labels: Sequence[str]) -> list[Measure]:
    """Measures of constraints in [m/s] for labels that end in x, y or z, else in [rad/s]."""
    return [Measure("m/s" if _is_length(name) else "rad/s", 1.0, "off") for name in labels]


def _is_length(label: str) -> bool:
    return label.split()[-1] in ("x", "y", "z")


class ConstraintOrigin(NamedTuple):
    """Origin of a constraint: its term, place and component, and the measure of its violation.

    whole : name that messages use in place of the component, such as the sole of a facet; None: the
    component.
    """

    term: str
    place: Place
    component: str
    measure: Measure | None = None
    whole: str | None = None

    def __str__(self) -> str:
        return _joined(self.term, self.place.name, self.component)

    def describe(self, x: Array, amount: float) -> tuple[str, str]:
        """Name of this constraint, and the amount of its violation in words, at solver variables x (n,)."""
        by = f"by {amount:.3g}" if self.measure is None else self.measure.describe(x, amount)
        component = self.component if self.whole is None else self.whole
        return _joined(self.term, self.place.describe(x), component), by


def _joined(*parts: str) -> str:
    return ", ".join(part for part in parts if part)


@dataclass
class Constraints:
    """Constraints under construction.

    A constraint is  lower <= out[output] + affine <= upper,  with one output of a block (index -1: none) and
    an affine expression. Each call of :meth:`add` appends an entry to the lists, and as many origins as
    constraints.

    unbounded : outputs of constraints that were dropped, as they had no finite bound.
    """

    outputs: list[Index] = field(default_factory=list)
    affine: list[Affine] = field(default_factory=list)
    lower: list[Array] = field(default_factory=list)
    upper: list[Array] = field(default_factory=list)
    origins: list[ConstraintOrigin] = field(default_factory=list)
    unbounded: list[Index] = field(default_factory=list)

    def copy(self) -> Constraints:
        """Copy to which other constraints can be added."""
        return Constraints(*(list(getattr(self, f.name)) for f in fields(self)))

    def measured(self, since: int, term: str, unit: str) -> None:
        """Give a term's constraints from number ``since`` on, if they have no measure, one in their unit."""
        measure = Measure(unit, 1.0, "beyond its bound")
        for k, origin in enumerate(self.origins[since:], since):
            if origin.term == term and origin.measure is None:
                self.origins[k] = origin._replace(measure=measure)

    def bound(self, k: int, lower: ArrayLike, upper: ArrayLike) -> None:
        """Replace the bounds of the constraints of call number ``k`` of :meth:`add`, which dropped none."""
        for sides, given in ((self.lower, lower), (self.upper, upper)):
            sides[k] = np.broadcast_to(np.asarray(given, dtype=float), sides[k].shape)

    def add_each(self, origins: Sequence[ConstraintOrigin], *, outputs: Index, lower: float) -> None:
        """Append constraints  lower <= out[outputs],  with their origins."""
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

        measure : one for all constraints, or one for each.  place : text is a place without a time.
        whole : as of :class:`ConstraintOrigin`. Constraints without a finite bound are dropped.
        """
        check_kind("term", term, str)
        spot = Place.plain(place) if isinstance(place, str) else place
        check_kind(f"{term}: place", spot, Place)
        n = len(components)
        measures = [*measure] if isinstance(measure, Iterable) else [measure] * n
        if len(measures) != n or not all(each is None or isinstance(each, Measure) for each in measures):
            raise InputError(f"{term}: measure must be a Measure, or one for each component")
        try:
            lo, hi = (np.full(n, np.asarray(x, dtype=float)) for x in (lower, upper))
        except ValueError:
            raise InputError(
                f"{term}: a bound of its {n} constraints is {shortened(repr((lower, upper)))}; "
                "give one number, or as many as components"
            ) from None
        if np.isnan(lo).any() or np.isnan(hi).any():
            raise InputError(f"{term}: a bound of its constraints is NaN; give numbers, or inf for no bound")
        if outputs is None and affine is None:
            raise InputError(f"{term}: constraints of nothing; give outputs of a block, or affine, or both")
        out = np.full(n, -1) if outputs is None else np.atleast_1d(np.asarray(outputs, dtype=np.intp))
        lin = Affine.zeros(n) if affine is None else affine
        if not lin.finite:
            raise InputError(f"{term}: an affine expression has a number that is not finite")
        for what, count in (("outputs", out.size), ("affine", lin.size)):
            if count != n:
                raise InputError(f"{term}: {what} are {count}, components {n}; give as many of both")
        # what a term leaves unlimited has infinite bounds
        bounded = np.isfinite(lo) | np.isfinite(hi)
        kept: Iterable[int] = range(n)
        if not bounded.all():
            keep = np.flatnonzero(bounded)
            self.unbounded.append(out[~bounded])
            out, lin, lo, hi, kept = out[keep], lin[keep], lo[keep], hi[keep], keep.tolist()
        if not lo.size:
            return
        self.outputs.append(out)
        self.affine.append(lin)
        self.lower.append(lo)
        self.upper.append(hi)
        self.origins.extend(ConstraintOrigin(term, spot, components[k], measures[k], whole) for k in kept)


GRAVITY = 9.81  # [m/s^2] for the robot's weight, which scales forces; its model may have another gravity
# [m] scale of sole moments relative to forces; with 0.01 to 1 m punch has the same optimum within 0.01 %, in
# 40 to 57 iterations
LEVER = 0.1
# [m, rad] largest deviation of the base from its start: of a robot on soles, and of a free-floating one,
# which may fall and drift any distance
BASE_BOX = np.array([0.6, 0.6, 0.6, 0.8, 0.8, 1.2])
FREE_BOX = np.array([np.inf, np.inf, np.inf, 3.0, 1.2, 3.0])
DIRECTIONS = ("x", "y", "z", "roll", "pitch", "yaw")


class Limits:
    """Bounds and scales that all parts of a program share.

    Attributes
    ----------
    torque, velocity, position, cone, balance, incidence, extension : the problem's terms.
    weight : of the robot [N].
    units (2,) : scales of the base's equations of motion, weight [N] and lever [m].
    unbalanced : measures of their violations.
    wrench_scale (6 a sole) : of sole wrenches [N, N m].
    y_lower, y_upper (ny,), legs_lower, legs_upper (nl,) : of the coordinates and the legs.
    rate_limit (n,) : of the joints [rad/s].
    of_y, of_legs, of_wrenches : arguments of `Layout.add` for groups of coordinates, legs and sole wrenches.
    """

    def __init__(self, problem: ImpactProblem, coordinates: StanceCoordinates) -> None:
        p, c, r = problem, coordinates, problem.robot
        self.torque, self.velocity = p.term(TorqueLimit), p.term(VelocityLimit)
        self.position, self.cone = p.term(PositionLimit), p.term(ContactWrenchCone)
        self.balance, self.incidence = p.term(Balance), p.term(Incidence)
        self.extension = p.term(LegExtension)
        self.weight = GRAVITY * float(sum(i.mass for i in r.model.inertias))
        lower, upper = inside(r, self.position.margin)
        box, y0 = (FREE_BOX if c.drifts else BASE_BOX)[: c.base], c.start
        self.y_lower = np.concatenate([y0[: c.base] - box, lower[c.independent]])
        self.y_upper = np.concatenate([y0[: c.base] + box, upper[c.independent]])
        if c.drifts:
            for bounds in (self.y_lower, self.y_upper):
                bounds[4] = np.clip(bounds[4], -MAX_PITCH, MAX_PITCH)
        self.legs_lower, self.legs_upper = lower[c.dependent], upper[c.dependent]
        self.rate_limit = self.velocity.most(r)
        self.units = np.array([self.weight, LEVER])
        force, moment = Measure("N", self.weight, "off"), Measure("N m", self.weight * LEVER, "off")
        self.unbalanced = [force if name in "xyz" else moment for name in DIRECTIONS[: c.base]]
        self.wrench_scale = self.weight * np.array([1, 1, 1, LEVER, LEVER, LEVER] * len(c.legs))
        self.of_y: dict[str, Any] = {
            "lower": self.y_lower,
            "upper": self.y_upper,
            "labels": c.labels,
            "measure": along(c.labels, "off"),
        }
        self.of_legs: dict[str, Any] = {
            "lower": self.legs_lower,
            "upper": self.legs_upper,
            "labels": c.leg_labels,
            "measure": degrees("off"),
        }
        wrench_labels = [f"{leg.end} {k}" for leg in c.legs for k in WRENCH]
        self.of_wrenches: dict[str, Any] = {"scale": self.wrench_scale, "labels": wrench_labels}


class Turn(IntEnum):
    """Order of elimination of determined variables; lower ones are eliminated first."""

    NODE = 0  # legs at a node, and the first sole's wrench
    LIFTED = 1  # variables that equal outputs of blocks
    RATE = 2  # the rate at contact
    FEEDFORWARD = 3  # the torque that makes the robot coast
    STAGE_LEGS = 4  # legs and reference's legs at a collocation point
    ELEMENT = 5  # motion, force, target and wrenches of an element, one element after the other
    AFTER = 6  # state after a collision: start of a follow-through, or a position


# Order in which variables are assigned the constraints that determine them.
_ASSIGNMENT_ORDER = (
    Turn.NODE,
    Turn.LIFTED,
    Turn.STAGE_LEGS,
    Turn.ELEMENT,
    Turn.FEEDFORWARD,
    Turn.AFTER,
    Turn.RATE,  # last: it takes a constraint that a collision's legs and motion have left
)


def determined(turn: Turn, variables: Index, step: int = 0) -> Determined:
    """Variables of one system of constraints.  step : order of elimination within a turn."""
    return Determined((turn, step), variables)


def by_choice(found: Iterable[Determined]) -> list[Determined]:
    """Determined variables in the order in which they are assigned constraints: by turn, then as given."""
    return sorted(found, key=lambda each: _ASSIGNMENT_ORDER.index(Turn(each.rank[0])))
