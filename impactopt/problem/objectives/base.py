"""Base class of objectives, and checks of their parameters.

A weight turns a quantity's unit into N s, so that weights compare: TargetEnergy(weight=0.5) beside Impulse()
gives up half a newton second for a joule more in the target.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from impactopt.contact.fields import Described, about
from impactopt.errors import MOST, InputError, check_array
from impactopt.problem.terms.base import check_known, kind_of

__all__ = ["WEIGHT", "Objective", "check_objectives"]

WEIGHT = about("value of one unit", unit="N s", key="weight")


@dataclass(frozen=True, kw_only=True)
class Objective(Described):
    """Base of all objectives: ``name`` is what reports call it, ``unit`` is that of its quantity.

    An objective has :meth:`quantity`, and :meth:`blocks` if that is not linear; ``whole_motion`` and
    ``needs_torques`` are as in :class:`impactopt.problem.terms.Term`.

    A weight is not zero; that of a cost is its price, and positive.
    """

    name: ClassVar[str] = ""
    unit: ClassVar[str] = ""
    cost: ClassVar[bool] = False  # less of it is better
    contact: ClassVar[bool] = False  # it is a quantity of a contact that lasts
    whole_motion: ClassVar[bool] = False
    needs_torques: ClassVar[bool] = False
    weight: float = field(metadata=WEIGHT)

    def __post_init__(self) -> None:
        kind = type(self).__name__
        if not check_array(f"{kind}.weight", self.weight, (), most=MOST):
            raise InputError(f"{kind}.weight is {self.weight}; give a number, or leave {kind} out")
        if self.cost and self.weight < 0:
            raise InputError(
                f"{kind}.weight is {self.weight:g}; give a number > 0, the price: {kind} is kept small"
            )

    def blocks(self, problem: Any, coordinates: Any) -> Mapping[str, Any]:
        """Nonlinear functions that the quantity needs, by name: `impactopt.problem.block.make_block`."""
        return {}

    def quantity(self, program: Any) -> Any:
        """Weighed quantity: an affine expression of a program's variables, or with squares of variables a
        :class:`impactopt.transcription.objective.Quantity`, as `program.squares` gives it.

        program : under construction, :class:`impactopt.transcription.contact_program.ContactProgram`.
        """
        raise NotImplementedError

    def check_fits(self, *, turns: bool, balance: bool) -> None:
        """InputError if a problem has no such quantity.

        turns : its compression has one end.  balance : the robot has one to keep.
        """


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
                f'{kind.__name__} is of a contact that lasts: give collision="full", or leave it out'
            )
        o.check_fits(turns=turns, balance=balance)
    return tuple(objectives)
