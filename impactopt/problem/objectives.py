"""What a plan is to bring: a weighted sum of quantities, the impulse by default.

A weight turns a quantity's unit into N s, so that weights compare: TargetEnergy(weight=0.5) beside Impulse()
gives up half a newton second for a joule more in the target.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from impactopt.errors import MOST, InputError, check_array
from impactopt.problem.terms import check_known, kind_of


@dataclass(frozen=True, kw_only=True)
class Objective:
    """Base of all objectives: ``name`` is what reports call it, ``unit`` is that of its quantity.

    One of a user's own has :meth:`quantity`, and :meth:`blocks` if that is not linear; ``whole_motion`` and
    ``needs_torques`` are as of :class:`impactopt.problem.terms.Term`.

    weight [N s a unit] : what one unit of it is worth, or of a cost, what it takes off.

    Raises
    ------
    InputError : a weight that is zero or not finite; a negative one of a cost.
    """

    name: ClassVar[str] = ""
    unit: ClassVar[str] = ""
    cost: ClassVar[bool] = False  # less of it is better
    contact: ClassVar[bool] = False  # it is a quantity of a contact that lasts
    whole_motion: ClassVar[bool] = False
    needs_torques: ClassVar[bool] = False
    weight: float

    def __post_init__(self) -> None:
        kind = type(self).__name__
        if not check_array(f"{kind}.weight", self.weight, (), most=MOST):
            raise InputError(f"{kind}.weight is {self.weight}; give a number, or leave {kind} out")
        if self.cost and self.weight < 0:
            raise InputError(
                f"{kind}.weight is {self.weight:g}; give a number > 0, the price: {kind} is kept small"
            )

    def blocks(self, problem: Any, coordinates: Any) -> Mapping[str, Any]:
        """Nonlinear functions that the quantity needs, by name:
        :func:`impactopt.transcription.blocks.make_block`.
        """
        return {}

    def quantity(self, program: Any) -> Any:
        """What is weighed: one affine expression of a program's variables, or with squares of variables a
        :class:`impactopt.transcription.objective.Quantity`.

        program : under construction, :class:`impactopt.transcription.at_contact.ContactProgram`. The
        package's own objectives have theirs there.
        """
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class Impulse(Objective):
    """The impulse to the target [N s]."""

    name: ClassVar[str] = "impulse"
    unit: ClassVar[str] = "N s"
    weight: float = 1.0


@dataclass(frozen=True, kw_only=True)
class PeakForce(Objective):
    """The largest contact force [N], of the collocated ones; a weight below zero keeps it small.

    Smooth: sum f^9 / sum f^8 (Lehmer's mean). It is the largest where the others are small beside it or as
    large, and never above it; of a half sine it is some 2 % below. The force in the first instant of a law
    with damping is not among the collocated ones.
    """

    name: ClassVar[str] = "peak force"
    unit: ClassVar[str] = "N"
    contact: ClassVar[bool] = True
    weight: float = 0.01


@dataclass(frozen=True, kw_only=True)
class TargetEnergy(Objective):
    """What the target holds at separation, or has used up in what it was hit for [J]: ``Target.energy``."""

    name: ClassVar[str] = "target energy"
    unit: ClassVar[str] = "J"
    weight: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Penetration(Objective):
    """The deepest penetration [m], at the end of compression; a weight below zero keeps it small."""

    name: ClassVar[str] = "penetration"
    unit: ClassVar[str] = "m"
    contact: ClassVar[bool] = True
    weight: float = 1000.0


@dataclass(frozen=True, kw_only=True)
class AngularMomentum(Objective):
    """Cost: |angular momentum|^2 about the centre of mass after contact [(N m s)^2].

    Not for a robot on a fixed base, whose balance nobody asks about.
    """

    name: ClassVar[str] = "angular momentum after contact, squared"
    unit: ClassVar[str] = "(N m s)^2"
    cost: ClassVar[bool] = True
    weight: float = 0.01


@dataclass(frozen=True, kw_only=True)
class Effort(Objective):
    """Cost: integral of the sum over the joints of (torque / limit)^2 [s], in swing and follow-through.

    By the trapezoidal rule on the nodes. To be kept small beside what is really wanted.
    """

    name: ClassVar[str] = "effort"
    unit: ClassVar[str] = "s"
    cost: ClassVar[bool] = True
    whole_motion: ClassVar[bool] = True
    needs_torques: ClassVar[bool] = True
    weight: float = 0.01


DEFAULT_OBJECTIVES: tuple[Objective, ...] = (Impulse(),)


def check_objectives(
    objectives: object, *, contact: bool, turns: bool, balance: bool
) -> tuple[Objective, ...]:
    """The objectives as a tuple.

    ``contact``: it lasts; ``turns``: its compression has one end; ``balance``: the robot has one to keep.

    Raises
    ------
    InputError : none, something else, two of a kind, one that the problem has no quantity for, one of a
        user's own that says not what it is.
    """
    if not isinstance(objectives, (list, tuple)) or not all(isinstance(o, Objective) for o in objectives):
        raise InputError(
            f"objectives must be a tuple of objectives, such as (Impulse(),), not {objectives!r}"
        )
    if not objectives:
        raise InputError("objectives is empty: give what the plan is for, such as (Impulse(),)")
    check_known(objectives, Objective, "quantity")
    kinds, names = [kind_of(o, Objective) for o in objectives], [o.name for o in objectives]
    for o, kind in zip(objectives, kinds, strict=True):
        if kinds.count(kind) > 1:
            raise InputError(f"two objectives of kind {kind.__name__}: give one")
        if names.count(o.name) > 1:
            raise InputError(f"two objectives are called {o.name!r}: give {type(o).__name__} another name")
        if o.contact and not contact:
            raise InputError(
                f'{kind.__name__} is of a contact that lasts: give collision="dynamics", or leave it out'
            )
        if isinstance(o, Penetration) and not turns:
            raise InputError("Penetration has no peak in the blow on a nail: take PeakForce or TargetEnergy")
        if isinstance(o, AngularMomentum) and not balance:
            raise InputError("AngularMomentum is of a robot that stands: leave it out on a fixed base")
    return tuple(objectives)
