"""Base class of objectives, and checks of their parameters.

A weight converts a quantity's unit to N s, so that objectives compare: with TargetEnergy(weight=0.5) beside
Impulse(), one more joule in the target counts as half a newton second.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from impactopt.contact.fields import Described, about
from impactopt.errors import MOST, InputError, check_array
from impactopt.problem.terms.base import check_known, kind_of

WEIGHT = about("value of one unit", unit="N s", key="weight")


@dataclass(frozen=True, kw_only=True)
class Objective(Described):
    """Base of all objectives. ``name`` stands in reports; ``unit`` is that of the quantity.

    An objective has :meth:`quantity`, and :meth:`blocks` if the quantity is not linear. ``whole_motion`` and
    ``needs_torques`` are as in :class:`impactopt.problem.terms.Term`.

    The weight is not zero; that of a cost is positive, as a price.
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
        """The quantity, before its weight: an affine expression of a program's variables, or with their
        squares a :class:`impactopt.transcription.objective.Quantity`, as by `program.squares`.

        program : under construction, :class:`impactopt.transcription.contact_program.ContactProgram`.
        """
        raise NotImplementedError

    def check_fits(self, *, turns: bool, balance: bool) -> None:
        """InputError if a problem does not have the quantity.

        turns : the compression ends once in the impact.  balance : the robot stands on soles.
        """


def check_objectives(
    objectives: object, *, contact: bool, turns: bool, balance: bool
) -> tuple[Objective, ...]:
    """Objectives as a tuple, checked.

    contact : the contact has a duration.  turns, balance : as of `Objective.check_fits`.

    Raises
    ------
    InputError : no objectives, other objects, two of a kind or name, a quantity that the problem does not
        have, or a user's own objective without `quantity` or name.
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
