"""Contact laws: the normal force between hand and target from penetration and its rate.

The normal n is the direction of the blow; the penetration x = n.(p_hand - p_contact) - x_target [m] grows
while the two approach, its rate is n.v_hand - v_target [m/s]. The target is pushed by +f n, the hand by -f
n.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ..errors import InputError, check_array

Parameters = Mapping[str, Any]


class ContactLaw(ABC):
    """A contact law with one smooth branch for compression (rate > 0) and one for restitution (rate <= 0).

    To write one, make a frozen dataclass whose fields are its numbers, and give `branch`. The branches have
    to agree where the rate is zero; contact ends when, in restitution, the branch's force has fallen to
    zero.
    """

    @property
    def parameters(self) -> dict[str, float]:
        """The law's numbers by name; a collision model takes each as an input named `contact_<name>`."""
        return _numbers(self)

    @abstractmethod
    def branch(
        self, penetration: Any, rate: Any, compressing: bool, parameters: Parameters | None = None
    ) -> Any:
        """Force [N] of one phase, smooth in penetration [m] and rate [m/s], whatever their signs.

        `parameters` replace the law's own numbers, and may be CasADi symbols.
        """

    def formula(self) -> tuple[str, str]:
        """Both branches as text in symbols of their own: what a compiled model of this law depends on."""
        names = {name: ca.SX.sym(name) for name in self.parameters}
        x, rate = ca.SX.sym("x"), ca.SX.sym("rate")
        return str(self.branch(x, rate, True, names)), str(self.branch(x, rate, False, names))

    def force(self, penetration: Any, rate: Any, parameters: Parameters | None = None) -> Any:
        """Force f [N] on the target: never adhesive (f >= 0), and zero while apart (penetration < 0).

        Arguments are floats, arrays or CasADi expressions.
        """
        compression = self.branch(penetration, rate, True, parameters)
        restitution = self.branch(penetration, rate, False, parameters)
        force = _choose(rate > 0, compression, restitution)
        none = 0.0 * force
        return _choose(penetration >= 0, _choose(force > 0, force, none), none)


@dataclass(frozen=True, kw_only=True)
class SpringDamper(ContactLaw):
    """f = k x + d dx/dt while compressing, f = k x in restitution (paper, figs. 1 and 9).

    That the damper acts in compression only is not written in the paper, but it is what its Table III
    needs: with it all nine impulses come out to the printed digit, with a Kelvin-Voigt element none does.

    Attributes
    ----------
    stiffness : k [N/m] > 0.
    damping : d [N s/m] >= 0.

    Raises
    ------
    InputError : a number out of its range.
    """

    stiffness: float
    damping: float

    def __post_init__(self) -> None:
        positive("SpringDamper: stiffness [N/m]", self.stiffness)
        positive("SpringDamper: damping [N s/m]", self.damping, zero=True)

    def branch(
        self, penetration: Any, rate: Any, compressing: bool, parameters: Parameters | None = None
    ) -> Any:
        p = self.parameters if parameters is None else parameters
        spring = p["stiffness"] * penetration
        return spring + p["damping"] * rate if compressing else spring


def positive(name: str, value: Any, *, zero: bool = False) -> float:
    """`value` as a float; InputError unless it is one finite number > 0 (or >= 0 where `zero`)."""
    number = float(check_array(name, value, ()))
    if number < 0 or (number == 0 and not zero):
        raise InputError(f"{name}: {number:g}; give a number {'>= 0' if zero else '> 0'}")
    return number


def _numbers(instance: Any) -> dict[str, float]:
    return {field.name: getattr(instance, field.name) for field in dataclasses.fields(instance)}


def _choose(condition: Any, yes: Any, no: Any) -> Any:
    if isinstance(condition, (bool, np.bool_)):
        return yes if condition else no
    if isinstance(condition, np.ndarray):
        return np.where(condition, yes, no)
    return ca.if_else(condition, yes, no)
