"""Contact laws: the normal force between hand and target from penetration and its rate.

The normal n is the direction of the blow; the penetration x = n.(p_hand - p_contact) - x_target [m] grows
while the two approach, its rate is n.v_hand - v_target [m/s]. The target is pushed by +f n, the hand by -f
n.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from impactopt.contact.fields import Described, Parameters, check_numbers, choose, numbers_of, text_of
from impactopt.errors import InputError

__all__ = ["ContactLaw", "rough_at"]


class ContactLaw(Described, ABC):
    """A contact law with one smooth branch for compression (rate > 0) and one for restitution (rate <= 0).

    To write one, make a frozen dataclass whose fields are its numbers, and give `branch`. The branches have
    to agree where the rate is zero; contact ends when, in restitution, the branch's force has fallen to
    zero. Fields with `impactopt.contact.fields.about` as metadata are checked when a law is made.

    Attributes
    ----------
    word : what problem files call it; "" for one that they do not know.
    """

    word: ClassVar[str] = ""

    def __post_init__(self) -> None:
        check_numbers(self)

    @property
    def parameters(self) -> dict[str, float]:
        """The law's numbers by name; a collision model takes each as an input named `contact_<name>`.

        `type(law)(**numbers)` is the same law with other parameters.
        """
        return numbers_of(self)

    @abstractmethod
    def branch(
        self, penetration: Any, rate: Any, compressing: bool, parameters: Parameters | None = None
    ) -> Any:
        """Force [N] of one phase, smooth in penetration [m] and rate [m/s], whatever their signs.

        A search passes through penetrations below zero, so write powers with `impactopt.contact.power`.

        `parameters` replace the law's own numbers, and may be CasADi symbols.
        """

    def separation(self, penetration: Any, rate: Any, parameters: Parameters | None = None) -> Any:
        """Expression [N] that falls through zero, with a slope, where contact ends: the force of restitution.

        Plans end contact on it. A law whose force has no slope there gives another expression that is zero at
        the same place and has one.
        """
        return self.branch(penetration, rate, False, parameters)

    def formula(self) -> tuple[str, str, str]:
        """Both branches, and `separation`, as text in symbols of their own: what a compiled model of this law
        depends on.
        """
        names = {name: ca.SX.sym(name) for name in self.parameters}
        x, rate = ca.SX.sym("x"), ca.SX.sym("rate")
        forces = [self.branch(x, rate, c, names) for c in (True, False)]
        used = {symbol.name() for symbol in ca.symvar(ca.SX(ca.vertcat(*forces)))}
        unused = [name for name in names if name not in used]
        own_fields = dataclasses.is_dataclass(type(self))  # a CustomLaw's functions are given all numbers
        if unused and own_fields:
            raise InputError(
                f"{type(self).__name__}.branch does not take {', '.join(unused)} from its argument "
                '`parameters`, so changing it would do nothing: write parameters["..."], not self'
            )
        compression, restitution = (text_of([force]) for force in forces)
        return compression, restitution, text_of([self.separation(x, rate, names)])

    def force(self, penetration: Any, rate: Any, parameters: Parameters | None = None) -> Any:
        """Force f [N] on the target: never adhesive (f >= 0), and zero while apart (penetration < 0).

        Arguments are floats, arrays or CasADi expressions.
        """
        compression = self.branch(penetration, rate, True, parameters)
        restitution = self.branch(penetration, rate, False, parameters)
        force = choose(rate > 0, compression, restitution)
        none = 0.0 * force
        return choose(penetration >= 0, choose(force > 0, force, none), none)


def rough_at(branches: Sequence[Callable[[Any, Any], Any]]) -> float | None:
    """The first penetration [m] of 0 and -1 mm at which a branch has no finite force, slope or curvature.

    branches : functions of penetration and rate.  None: they are smooth at both, as a search needs them.
    """
    x, rate = ca.SX.sym("x"), ca.SX.sym("rate")
    both, found = ca.vertcat(x, rate), []
    for branch in branches:
        force = ca.SX(branch(x, rate))
        curvature, slope = ca.hessian(force, both)
        found += [force, slope, ca.vec(ca.densify(curvature))]
    values = ca.Function("law", [x, rate], [ca.densify(ca.vertcat(*found))])
    for depth in (0.0, -1e-3):
        if not all(np.isfinite(np.array(values(depth, speed))).all() for speed in (0.1, -0.1)):
            return depth
    return None
