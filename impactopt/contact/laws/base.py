"""Contact laws: the normal force f between hand and target from the penetration and its rate.

The normal n is the direction in which the target is pushed: the force on it is +f n, that on the hand -f n.
The penetration x = n.(p_hand - p_contact) - x_target [m] grows while the two approach; its rate is n.v_hand -
v_target [m/s].
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from impactopt.contact.fields import (
    Described,
    Parameters,
    check_numbers,
    check_parameters_taken,
    choose,
    expressions_of,
    numbers_of,
    text_of,
    with_symbols,
)
from impactopt.errors import InputError

# [m] penetrations at which both branches are compared at rate zero, and relative difference allowed there
_DEPTHS, _SAME = (1e-4, 1e-3, 1e-2), 1e-6


class ContactLaw(Described, ABC):
    """A contact law with one smooth branch for compression (rate > 0) and one for restitution (rate <= 0).

    To write one, make a frozen dataclass whose fields are its parameters, and implement `branch`. The
    branches have to agree where the rate is zero; contact ends when the force of the restitution branch has
    fallen to zero. When a law is made, both branches are called with CasADi expressions and compared at rate
    zero. Its fields have to be numbers, in the ranges of `impactopt.contact.fields.about` as their metadata,
    or True and False.

    Attributes
    ----------
    word : its name in problem files; "" if they cannot name it.
    """

    word: ClassVar[str] = ""
    _symbolic: ClassVar[bool] = False  # True in the class of a law whose branches take CasADi expressions

    def __post_init__(self) -> None:
        check_numbers(self)
        self._check_branches("branch(penetration, rate, compressing, parameters)")

    def _check_branches(self, call: str) -> None:
        """InputError unless both branches take CasADi expressions, and push and agree where the rate is zero.

        call : how they are called, for the message.
        """
        name, phases = type(self).__name__, {True: "compression", False: "restitution"}
        if "_symbolic" not in vars(type(self)):  # whatever the numbers are, so once for each class
            x, rate, symbols = ca.SX.sym("x"), ca.SX.sym("rate"), {p: ca.SX.sym(p) for p in self.parameters}
            # a CustomLaw's functions get all parameters in any case
            own_fields = dataclasses.is_dataclass(type(self))
            law, found = with_symbols(self) if own_fields else self, []
            for compressing, phase in phases.items():
                force = partial(law.branch, x, rate, compressing, symbols)
                found += expressions_of(f"{name}: {phase}", call, force)
            end = partial(law.separation, x, rate, symbols)
            found += expressions_of(name, "separation(penetration, rate, parameters)", end)
            if own_fields:
                check_parameters_taken(self, found)
            type(self)._symbolic = True
        forces = {depth: [float(self.branch(depth, 0.0, c)) for c in phases] for depth in _DEPTHS}
        for depth, (there, back) in forces.items():
            of = f"{name}: the force at rate zero, {1e3 * depth:g} mm deep, is {there:g} N in compression"
            if not np.isfinite([there, back]).all():
                if depth == _DEPTHS[0]:
                    raise InputError(f"{of} and {back:g} N in restitution; give finite ones")
                break  # some laws, as of a foam, have no force at depths that they never reach
            if abs(there - back) > _SAME * max(abs(there), abs(back)):
                raise InputError(f"{of} and {back:g} N in restitution: write branches that agree there")
        first, last = (np.array(forces[depth]) for depth in (_DEPTHS[0], _DEPTHS[-1]))
        if (np.array([*forces.values()]) < 0).all() and (last <= first).all():
            raise InputError(
                f"{of}, and negative at smaller depths too, so that nothing is hit; give a force that "
                "pushes, which is positive"
            )

    @property
    def parameters(self) -> dict[str, float]:
        """Parameters of the law by name; a collision model takes each as an input named `contact_<name>`.

        `type(law)(**numbers)` is the same law with other parameters.
        """
        return numbers_of(self)

    @property
    def switches(self) -> bool:
        """True if compression and restitution are different branches."""
        compression, restitution, _ = self.formula()
        return compression != restitution

    @abstractmethod
    def branch(
        self, penetration: Any, rate: Any, compressing: bool, parameters: Parameters | None = None
    ) -> Any:
        """Force [N] of one phase, smooth in penetration [m] and rate [m/s] of either sign.

        Iterates of a solver may have negative penetrations, so write powers with `impactopt.contact.power`.

        `parameters` replace the law's own, and may be CasADi symbols.
        """

    def separation(self, penetration: Any, rate: Any, parameters: Parameters | None = None) -> Any:
        """Expression [N] that becomes negative at the end of contact: the force of restitution.

        Plans end contact where it is zero. Its slope there must not be zero: a law whose force has none
        returns another expression with the same zero.
        """
        return self.branch(penetration, rate, False, parameters)

    def formula(self) -> tuple[str, str, str]:
        """Both branches and `separation` as text in generic symbols, from which cache keys are made."""
        names = {name: ca.SX.sym(name) for name in self.parameters}
        x, rate = ca.SX.sym("x"), ca.SX.sym("rate")
        compression, restitution = (text_of([self.branch(x, rate, c, names)]) for c in (True, False))
        return compression, restitution, text_of([self.separation(x, rate, names)])

    def force(self, penetration: Any, rate: Any, parameters: Parameters | None = None) -> Any:
        """Force f [N] on the target: never adhesive (f >= 0), and zero without contact (penetration < 0).

        Arguments are floats, arrays or CasADi expressions.
        """
        compression = self.branch(penetration, rate, True, parameters)
        restitution = self.branch(penetration, rate, False, parameters)
        force = choose(rate > 0, compression, restitution)
        none = 0.0 * force
        return choose(penetration >= 0, choose(force > 0, force, none), none)


def rough_at(branches: Sequence[Callable[[Any, Any], Any]]) -> float | None:
    """First of the penetrations 0 and -1 mm [m] at which a branch has no finite force, slope or curvature.

    None if all are finite at both, as solvers need.  branches : functions of penetration and rate.
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
