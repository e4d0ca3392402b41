"""Contact law from user-defined functions, without a class."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import FrozenInstanceError
from functools import partial
from typing import Any, ClassVar

import casadi as ca

from impactopt.contact.fields import Parameters, choose
from impactopt.contact.laws.base import ContactLaw, rough_at
from impactopt.errors import InputError, check_array

Branch = Callable[..., Any]

# [m] Below this penetration a law that is not smooth at zero continues along its tangent; and the step of the
# difference that gives the tangent, relative to it.
_TANGENT_BELOW, _DIFFERENCE_STEP = 1e-6, 1e-3


class CustomLaw(ContactLaw):
    """A contact law from functions of penetration [m], rate [m/s] and named numbers, to a force [N].

    Each number becomes an input `contact_<name>` of a collision, with the value given here as its default.
    The functions are called as ``function(penetration, rate, **numbers)``, with CasADi expressions too:
    write ``casadi.fmax`` and ``casadi.if_else`` in the place of ``max`` and ``if``. They have to agree where
    the rate is zero. A force below zero is cut, but in plans with full dynamics, which take the functions as
    they are; at penetration and rate zero it must not be above.

    A plan's search passes through penetrations below zero. There x**1.5 is no number, and at zero it has no
    curvature. Such a force is continued along its tangent below 1e-6 m.

    >>> law = CustomLaw(
    ...     compression=lambda x, rate, stiffness, hardening, damping: (
    ...         stiffness * x + hardening * x**3 + damping * rate
    ...     ),
    ...     restitution=lambda x, rate, stiffness, hardening, damping: stiffness * x + hardening * x**3,
    ...     analytic=True,
    ...     stiffness=1e4,
    ...     hardening=4e8,
    ...     damping=200.0,
    ... )
    >>> law.force(0.001, 0.5)
    110.4
    >>> law.parameters
    {'stiffness': 10000.0, 'hardening': 400000000.0, 'damping': 200.0}

    Parameters
    ----------
    compression : force while the rate is > 0.
    restitution : force after that; None: the same.
    analytic : whether both have derivatives of all orders at and around x = 0; else they are rounded there.
    numbers : finite; the functions' own arguments.

    Raises
    ------
    InputError : no function; numbers that are not finite; a function that does not take just these numbers,
        or gives anything but one expression; functions that differ at rate zero, or have a force there at
        penetration zero; "analytic" for one that has no curvature at zero.
    """

    # Each instance gets a class of its own with these functions, so that type(law)(**numbers) is the same law
    # with other parameters, as for all laws.
    _branches: ClassVar[tuple[Branch, Branch] | None] = None
    analytic: ClassVar[bool] = False
    _numbers: dict[str, float]
    _rough: bool  # not smooth at or below zero

    def __new__(
        cls,
        *,
        compression: Branch | None = None,
        restitution: Branch | None = None,
        analytic: bool = False,
        **numbers: float,
    ) -> CustomLaw:
        if cls._branches is not None:
            return super().__new__(cls)
        for name, function in (("compression", compression), ("restitution", restitution)):
            if not callable(function) and not (name == "restitution" and function is None):
                raise InputError(
                    f"CustomLaw: {name}: {function!r}; give a function of penetration, rate and numbers"
                )
        branches = (compression, restitution or compression)
        space = {"_branches": branches, "analytic": bool(analytic), "__module__": cls.__module__}
        return super().__new__(type(cls.__name__, (cls,), space))

    def __init__(
        self,
        *,
        compression: Branch | None = None,
        restitution: Branch | None = None,
        analytic: bool = False,
        **numbers: float,
    ) -> None:
        checked = {name: float(check_array(f"CustomLaw: {name}", x, ())) for name, x in numbers.items()}
        object.__setattr__(self, "_numbers", checked)
        object.__setattr__(self, "_rough", False)
        self._check_branches(f"function({', '.join(['penetration', 'rate', *checked])})")
        for function in self._branches or ():
            preload = float(ca.SX(function(ca.SX(0), ca.SX(0), **checked)))
            if preload > 0:
                raise InputError(
                    f"CustomLaw: the force is {preload:g} N where contact begins, at penetration and "
                    "rate zero: write functions that are zero there, or below"
                )
        rough = rough_at([partial(function, **checked) for function in self._branches or ()])
        if self.analytic and rough == 0.0:
            raise InputError(
                "CustomLaw: analytic: a function has no finite slope or curvature at penetration 0; say "
                "analytic=False"
            )
        object.__setattr__(self, "_rough", rough is not None and not self.analytic)

    @property
    def parameters(self) -> dict[str, float]:
        return dict(self._numbers)

    def branch(
        self, penetration: Any, rate: Any, compressing: bool, parameters: Parameters | None = None
    ) -> Any:
        assert self._branches is not None
        numbers = self._numbers if parameters is None else parameters
        function = self._branches[0 if compressing else 1]
        if not self._rough:
            return function(penetration, rate, **numbers)
        return _rounded(lambda x: function(x, rate, **numbers), penetration)

    def __setattr__(self, name: str, value: Any) -> None:
        raise FrozenInstanceError(f"cannot assign to field {name!r}")

    def __repr__(self) -> str:
        return f"CustomLaw({', '.join(f'{name}={value!r}' for name, value in self._numbers.items())})"

    def __reduce__(self) -> tuple[Any, ...]:
        # pickle cannot find its class, which is made at runtime
        assert self._branches is not None
        compression, restitution = self._branches
        return _remake, (compression, restitution, self.analytic, self._numbers)


def _rounded(function: Callable[[Any], Any], x: Any) -> Any:
    """`function` above `_TANGENT_BELOW`, and its tangent there for smaller x."""
    safe = choose(x > _TANGENT_BELOW, x, _TANGENT_BELOW)
    less, more = _TANGENT_BELOW * (1 - _DIFFERENCE_STEP), _TANGENT_BELOW * (1 + _DIFFERENCE_STEP)
    return function(safe) + (function(more) - function(less)) / (more - less) * (x - safe)


def _remake(compression: Branch, restitution: Branch, analytic: bool, numbers: dict[str, float]) -> CustomLaw:
    return CustomLaw(compression=compression, restitution=restitution, analytic=analytic, **numbers)
