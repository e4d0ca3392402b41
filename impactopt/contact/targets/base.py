"""Targets: their motion along the normal under the contact force, and the phases of a contact."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import casadi as ca

from impactopt.contact.fields import (
    Described,
    Parameters,
    check_numbers,
    check_parameters_taken,
    expressions_of,
    numbers_of,
    text_of,
    with_symbols,
)
from impactopt.contact.laws.base import ContactLaw
from impactopt.errors import InputError, check_array

UNITS = {"speed": "m_s", "depth": "m"}  # units of targets' results

_OTHER_METHODS = ("switches", "tangential_mass", "speed_before", "smooth", "guard", "invariant", "reserve")


class Target(Described, ABC):
    """A body that is hit and moves along the contact normal. Before contact its speed is constant.

    To write one, make a frozen dataclass whose fields are its parameters, and implement the methods below.
    They have to be smooth, except where one of `switches` changes its sign. `state` is a column of `n_states`
    numbers or CasADi symbols; it is zero when contact begins. When a target is made, its methods are called
    with CasADi expressions. Its fields have to be numbers, in the ranges of `impactopt.contact.fields.about`
    as their metadata, or True and False.

    Attributes
    ----------
    word : its name in problem files; "" if they cannot name it.
    n_states : size of the state.
    results : names of the values of `result`.
    typical : typical magnitudes of the state, for scaling; ones if not given.
    guards : names of the transitions in a plan, in order, in the place of switches. Each ends
        a phase of the contact, where `guard` is zero; see `smooth`.
    phases : names of the contact's phases in a plan: two, or three if there are guards. Guards end the first
        ones. If one more is left before the last, it ends with compression. The last ends at separation.
    at_once : the first guard may be zero at the first touch, so that the phase before it has no duration.
    stays : the target stays in place after the impact. The striker must then keep off it.
    met_again : in a plan the striker may separate from it, and touch it again, before a guard and after it.
    """

    word: ClassVar[str] = ""
    n_states: int
    results: ClassVar[tuple[str, ...]] = ()
    typical: ClassVar[tuple[float, ...]] = ()
    guards: ClassVar[tuple[str, ...]] = ()
    phases: ClassVar[tuple[str, ...]] = ("compression", "restitution")
    at_once: ClassVar[bool] = False
    stays: ClassVar[bool] = False
    met_again: ClassVar[bool] = False
    _checked: ClassVar[bool] = False  # True in the class of a target whose methods give what they should

    def __post_init__(self) -> None:
        check_numbers(self)
        if "_checked" not in vars(type(self)):  # whatever the numbers are, so once for each class
            self._check_methods()
            type(self)._checked = True

    def _check_methods(self) -> None:
        """InputError unless the methods take CasADi expressions, give as many as they should, and take all
        fields from their argument `parameters`.
        """
        name, target = type(self).__name__, with_symbols(self)
        n_states = getattr(self, "n_states", None)
        if not isinstance(n_states, int) or n_states < 0:
            raise InputError(f"{name}: n_states is {n_states!r}; give the size of the state, a whole number")
        if len({*self.results}) < len(self.results):
            raise InputError(f"{name}: results has a name twice: {', '.join(self.results)}")
        state, force, numbers = self._symbols()
        rates = [f"the rate of state[{i}]" for i in range(self.n_states)]
        for method, call, arguments, names in (
            ("velocity", "(state, parameters)", (state, numbers), None),
            ("derivative", "(state, force, parameters)", (state, force, numbers), rates),
            ("energy", "(state, parameters)", (state, numbers), None),
            ("result", "(state, parameters)", (state, numbers), self.results),
        ):
            expressions_of(name, method + call, partial(getattr(target, method), *arguments), names)
        if self.typical and len(self.typical) != self.n_states:
            raise InputError(
                f"{name}: typical has {len(self.typical)} numbers; give {self.n_states}, one for each of the "
                "state"
            )
        if self.typical and not (check_array(f"{name}: typical", self.typical, (None,)) > 0).all():
            raise InputError(f"{name}: typical is {self.typical}; give numbers > 0")
        try:
            every = [x for part in target._expressions().values() for x in part]
            ca.veccat(*every)
        except Exception as error:
            raise InputError(
                f"{name}: {', '.join(_OTHER_METHODS[:-1])} or {_OTHER_METHODS[-1]} cannot be called with "
                "CasADi expressions, with casadi.fmax and casadi.if_else in the place of max and if, or "
                f"gives something else than `Target` says: {error}"
            ) from error
        check_parameters_taken(self, every)

    @property
    def turns(self) -> bool:
        """True if a phase of a plan ends with compression: guards do not end all phases before the last."""
        return len(self.guards) < len(self.phases) - 1

    @property
    def typical_state(self) -> tuple[float, ...]:
        """``typical``, or ones if it is not given."""
        return self.typical or (1.0,) * self.n_states

    @property
    def parameters(self) -> dict[str, float]:
        """Parameters of the target by name; a collision model takes each as an input named `target_<name>`.

        `type(target)(**numbers)` is the same target with other parameters.
        """
        return numbers_of(self)

    @abstractmethod
    def velocity(self, state: Any, parameters: Parameters | None = None) -> Any:
        """Velocity of the hit surface along the normal [m/s]."""

    def tangential_mass(self, parameters: Parameters | None = None) -> Any:
        """Mass [kg] that friction accelerates across the normal; None: the target is held there."""
        return None

    def speed_before(self, parameters: Parameters | None = None) -> Any:
        """Velocity of the surface along the normal [m/s] until contact begins; 0: at rest."""
        return self.velocity([0.0] * self.n_states, parameters)

    @abstractmethod
    def derivative(self, state: Any, force: Any, parameters: Parameters | None = None) -> list[Any]:
        """Time derivative of the state under the contact force [N], a list of `n_states` expressions."""

    @abstractmethod
    def energy(self, state: Any, parameters: Parameters | None = None) -> Any:
        """Energy [J] that the target has absorbed: its own, and the dissipated work that follows from the
        state, as a nail's against wood; not that of a board's damping.
        """

    def switches(self, state: Any, force: Any, parameters: Parameters | None = None) -> list[Any]:
        """Switching functions: their changes of sign separate smooth modes of the motion. Steps end there."""
        return []

    def smooth(
        self, state: Any, force: Any, phase: int, parameters: Parameters | None = None
    ) -> tuple[Any, list[Any]]:
        """Velocity [m/s] and d(state)/dt in one phase of a plan's contact, without switches.

        By default they are `velocity` and `derivative`. In a plan, a target with switches passes its
        `guards` in order, and is smooth in each phase between them.

        phase : 0 for the first.

        Raises
        ------
        InputError : it has switches, but no implementation of `smooth`.
        """
        if self.switches(state, force, parameters):
            raise InputError(
                f"the target {type(self).__name__} has switches, which a plan cannot have: give it a method "
                "`smooth`, or plan for FreeMass, RigidWall, Nail or Board"
            )
        return self.velocity(state, parameters), self.derivative(state, force, parameters)

    def guard(
        self, state: Any, force: Any, late: Any, phase: int, parameters: Parameters | None = None
    ) -> Any:
        """Expression of order 1 that rises to zero at the end of a phase which one of `guards` ends.

        phase : 0 for the first.  late [s] : time by which the phase exceeds its shortest duration.
        """
        raise NotImplementedError(f"{type(self).__name__} has no guards")

    def invariant(
        self, state: Any, force: Any, phase: int, parameters: Parameters | None = None
    ) -> list[Any]:
        """Expressions (one or none) of order 1 that are not negative during a phase."""
        return []

    def reserve(self, state: Any, force: Any, phase: int, parameters: Parameters | None = None) -> list[Any]:
        """Expressions (one or none) of order 1 that are not negative at the end of a phase.

        They ensure that a slightly weaker impact reaches this end too.
        """
        return []

    def margin(self, phase: int, place: float) -> float:
        """Lower bound of `invariant` at a place in a phase, from 0, its start, to 1, its end.

        With it a small error cannot cause the event that ends the phase to occur earlier.
        """
        return 0.0

    def result(self, state: Any, parameters: Parameters | None = None) -> list[Any]:
        """Effects of the impact on the target, named by `results`, from the state at separation."""
        return []

    def outcome(self, state: Any, parameters: Parameters | None = None) -> dict[str, float]:
        """Numeric `result` by name and unit, as in reports: `speed_m_s`, `depth_m`, `broken`."""
        return self.with_units(self.result([float(x) for x in state], parameters))

    def with_units(self, values: Iterable[Any]) -> dict[str, float]:
        """Values of `results`, in their order, by name and unit."""
        named = zip(self.result_names, values, strict=True)
        return {name: float(value) + 0.0 for name, value in named}  # no minus zero

    @property
    def result_names(self) -> list[str]:
        """Names of `results` with their units."""
        return [f"{name}_{UNITS[name]}" if name in UNITS else name for name in self.results]

    def formula(self) -> tuple[str, ...]:
        """All expressions of the target as text in generic symbols, from which cache keys are made."""
        made = [f"{name}: {text_of(expressions)}" for name, expressions in self._expressions().items()]
        return (*made, f"results: {', '.join(self.results)}")

    def _symbols(self) -> tuple[list[Any], Any, dict[str, Any]]:
        """Generic symbols of the state, the force and the parameters."""
        state = [ca.SX.sym(f"state_{i}") for i in range(self.n_states)]
        return state, ca.SX.sym("force"), {name: ca.SX.sym(name) for name in self.parameters}

    def _expressions(self) -> dict[str, list[Any]]:
        """All expressions of the target in generic symbols."""
        state, force, numbers = self._symbols()
        across = self.tangential_mass(numbers)
        parts = {
            "derivative": self.derivative(state, force, numbers),
            "velocity": [self.velocity(state, numbers)],
            "speed before": [self.speed_before(numbers)],
            "tangential mass": [] if across is None else [across],
            "energy": [self.energy(state, numbers)],
            "switches": self.switches(state, force, numbers),
            "result": self.result(state, numbers),
        }
        for k, phase in enumerate(self.phases if self.guards else ()):
            speed, rates = self.smooth(state, force, k, numbers)
            parts[phase] = [
                speed,
                *rates,
                *([self.guard(state, force, ca.SX.sym("T"), k, numbers)] if k < len(self.guards) else []),
                *self.invariant(state, force, k, numbers),
                *self.reserve(state, force, k, numbers),
            ]
        return parts


def scaled_numbers(
    where: str,
    law: ContactLaw,
    target: Target,
    *,
    mass: float = 1.0,
    stiffness: float = 1.0,
    damping: float = 1.0,
) -> tuple[dict[str, float], dict[str, float]]:
    """Parameters of the contact law and of the target by name, some of them scaled.

    where : source of the factors, for messages.  mass : factor of the target's.  stiffness, damping : of the
        law's.

    Raises
    ------
    InputError : a factor of a parameter that they do not have.
    """
    of_law, of_target = dict(law.parameters), dict(target.parameters)
    for name, factor, of, numbers in (
        ("stiffness", stiffness, law, of_law),
        ("damping", damping, law, of_law),
        ("mass", mass, target, of_target),
    ):
        if name in numbers:
            numbers[name] *= factor
        elif factor != 1:
            what = "law" if of is law else "target"
            raise InputError(f"{where}: the {what} {type(of).__name__} has no {name}; leave it out")
    return of_law, of_target


TURN, SEPARATION, TOUCH = "end of compression", "separation", "touch"  # ends of phases other than guards


@dataclass(frozen=True)
class ContactPhase:
    """One phase of a contact.

    mode : phase of the target's motion in it (`impactopt.contact.targets.Target.smooth`).
    end : one of the target's guards, `TURN`, `SEPARATION` or `TOUCH`.
    apart : striker and target do not touch in it.
    restituting : the contact law has its branch of restitution in it.
    """

    name: str
    mode: int
    end: str
    apart: bool = False
    restituting: bool = False


def contact_phases(target: Target, order: Sequence[str] = ()) -> tuple[ContactPhase, ...]:
    """Phases of a contact.

    order : their ends. (): those of the target's own phases, in one touch.
    """
    out = list[ContactPhase]()
    if not order:
        last = len(target.phases) - 1
        ends = [*target.guards, *[TURN] * (last - len(target.guards)), SEPARATION]
        for k, (name, end) in enumerate(zip(target.phases, ends, strict=True)):
            out.append(ContactPhase(name, k, end, restituting=k == last))
        return tuple(out)
    touch, mode, apart, turns = 1, 0, False, 0
    for end in order:
        name = f"apart after touch {touch}" if apart else f"touch {touch}"
        name += f", after the {target.guards[mode - 1]}" if mode else ""
        if turns:
            name += f", {'restitution' if turns % 2 else 'compression'} {turns // 2 + 1}"
        out.append(ContactPhase(name, mode, end, apart, restituting=turns % 2 == 1))
        mode += end in target.guards
        touch += end == TOUCH
        if end in (SEPARATION, TOUCH):
            apart = end == SEPARATION
        if end not in target.guards:
            turns = turns + 1 if end == TURN else 0
    return tuple(out)


def order_of_touches(law: ContactLaw, target: Target, touches: int) -> tuple[str, ...]:
    """Ends of the phases of a contact with several touches; () for one touch.

    All guards are passed in the last touch, but for one that may be zero at the first touch. Compression and
    restitution are phases of their own if they are different branches of the law.
    """
    if touches == 1:
        return ()
    touch = (TURN, SEPARATION) if law.switches else (SEPARATION,)
    first, last = (target.guards[:1], target.guards[1:]) if target.at_once else ((), target.guards)
    return (*first, *((*touch, TOUCH) * (touches - 1)), *last, *touch)


def is_order(law: ContactLaw, target: Target, order: Sequence[str]) -> bool:
    """True if these can be the ends of a contact's phases.

    Striker and target touch, part and touch again, and pass the guards in turn. The last end is the last
    guard in a gap, or a separation after it. A guard that may be zero at first touch ends the first phase.
    With a law that switches, compression and restitution alternate in a touch, with a `TURN` between them.
    """
    guards = [end for end in order if end in target.guards]
    letters = {TURN: "C", SEPARATION: "S", TOUCH: "T"} | dict.fromkeys(target.guards, "G")
    touch = "G*C(G*CG*C)*G*S" if law.switches else "G*S"
    text = "".join(letters.get(end, "?") for end in order)
    begins = not target.at_once or list(order[:1]) == list(target.guards[:1])
    return begins and guards == list(target.guards) and bool(re.fullmatch(f"({touch}G*T)*{touch}G*", text))
