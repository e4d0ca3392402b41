"""Targets: how what is hit moves along the normal under the contact force."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca

from ..errors import InputError
from ._expressions import Parameters, numbers_of, positive, text_of

__all__ = ["FreeMass", "RigidWall", "Target"]

UNITS = {"speed": "m_s", "depth": "m"}  # of targets' results


class Target(ABC):
    """Something that is hit, at rest when contact begins; motion is along the contact normal only.

    To write one, make a frozen dataclass whose fields are its numbers, and give the methods below. They have
    to be smooth but where one of `switches` changes its sign; `state` is a column of `n_states` numbers or
    CasADi symbols, zero at rest.

    Attributes
    ----------
    n_states : size of the state.
    results : names of what `result` gives.
    analytic : whether there are derivatives of all orders between switches, as Taylor steps need them.
    typical : sizes of the state's numbers, for scaling; ones if not given.
    breaks : whether it breaks: it switches once, in the first half of a blow, and for good. A plan breaks it.
    helpers : names of what a plan finds beside the state at each instant, all >= 0; see `smooth`.
    forward_only : whether the state's numbers and the helpers are never below zero.
    """

    n_states: int
    results: ClassVar[tuple[str, ...]] = ()
    analytic: ClassVar[bool] = True
    typical: ClassVar[tuple[float, ...]] = ()
    breaks: ClassVar[bool] = False
    helpers: ClassVar[tuple[str, ...]] = ()
    forward_only: ClassVar[bool] = False

    @property
    def switching(self) -> bool:
        """Whether its motion has switches, so that a plan has something in their place."""
        return self.breaks or bool(self.helpers)

    @property
    def parameters(self) -> dict[str, float]:
        """The target's numbers by name; a collision model takes each as an input named `target_<name>`.

        `type(target)(**numbers)` is the same target with other numbers.
        """
        return numbers_of(self)

    @abstractmethod
    def velocity(self, state: Any, parameters: Parameters | None = None) -> Any:
        """Velocity of the hit surface along the normal [m/s]."""

    @abstractmethod
    def derivative(self, state: Any, force: Any, parameters: Parameters | None = None) -> list[Any]:
        """d(state)/dt, a list of `n_states` expressions, under the contact force [N]."""

    @abstractmethod
    def energy(self, state: Any, parameters: Parameters | None = None) -> Any:
        """Energy [J] that the target holds, or has used up in what it was hit for."""

    def switches(self, state: Any, force: Any, parameters: Parameters | None = None) -> list[Any]:
        """Expressions whose changes of sign part the motion into smooth pieces; steps end on them."""
        return []

    def smooth(
        self, state: Any, force: Any, helpers: Any, broken: bool, parameters: Parameters | None = None
    ) -> tuple[list[Any], list[Any]]:
        """The motion as a plan has it, where nothing may switch: d(state)/dt, and what is zero [of order 1].

        A target without switches moves as it is. One with switches says here what takes their place: a branch
        before and one after the break (`broken`), or a smooth law with as many equations as `helpers`.

        Raises
        ------
        InputError : it has switches and does not say.
        """
        if self.switches(state, force, parameters):
            raise InputError(
                f"the target {type(self).__name__} has switches, which a plan cannot have: give it a method "
                "`smooth`, or plan for FreeMass, RigidWall, Nail or Board"
            )
        return self.derivative(state, force, parameters), []

    def breaking(self, state: Any, parameters: Parameters | None = None) -> Any:
        """Of a target that `breaks`: below zero until it does, zero when it does; of order 1."""
        raise NotImplementedError(f"{type(self).__name__} does not break")

    def result(self, state: Any, parameters: Parameters | None = None) -> list[Any]:
        """What the blow has brought, from the state at separation; named by `results`."""
        return []

    def outcome(self, state: Any, parameters: Parameters | None = None) -> dict[str, float]:
        """`result` as numbers by name and unit, as reports have them: `speed_m_s`, `depth_m`, `broken`."""
        values = self.result([float(x) for x in state], parameters)
        names = [f"{name}_{UNITS[name]}" if name in UNITS else name for name in self.results]
        return {name: float(value) + 0.0 for name, value in zip(names, values, strict=True)}  # no minus zero

    def formula(self) -> tuple[str, ...]:
        """The target as text in symbols of its own: what a compiled model of it depends on."""
        numbers = {name: ca.SX.sym(name) for name in self.parameters}
        state = [ca.SX.sym(f"state_{i}") for i in range(self.n_states)]
        force = ca.SX.sym("force")
        parts = {
            "derivative": self.derivative(state, force, numbers),
            "velocity": [self.velocity(state, numbers)],
            "energy": [self.energy(state, numbers)],
            "switches": self.switches(state, force, numbers),
            "result": self.result(state, numbers),
        }
        helpers = [ca.SX.sym(f"helper_{i}") for i in range(len(self.helpers))]
        if self.helpers or self.breaks:
            for broken in (False, True):
                moves, rows = self.smooth(state, force, helpers, broken, numbers)
                parts[f"smooth, {'after' if broken else 'before'} a break"] = [*moves, *rows]
        if self.breaks:
            parts["breaking"] = [self.breaking(state, numbers)]
        made = [f"{name}: {text_of(expressions)}" for name, expressions in parts.items()]
        return (*made, f"results: {', '.join(self.results)}")


@dataclass(frozen=True, kw_only=True)
class FreeMass(Target):
    """A point mass that moves freely along the normal (paper, figs. 1 and 9); its state is its velocity.

    Its result is `speed` [m/s], after the blow.

    Attributes
    ----------
    mass : [kg] > 0.

    Raises
    ------
    InputError : a mass that is not a positive number.
    """

    mass: float

    n_states = 1
    results: ClassVar[tuple[str, ...]] = ("speed",)

    def __post_init__(self) -> None:
        positive("FreeMass: mass [kg]", self.mass)

    def velocity(self, state: Any, parameters: Parameters | None = None) -> Any:
        return state[0]

    def derivative(self, state: Any, force: Any, parameters: Parameters | None = None) -> list[Any]:
        p = self.parameters if parameters is None else parameters
        return [force / p["mass"]]

    def energy(self, state: Any, parameters: Parameters | None = None) -> Any:
        p = self.parameters if parameters is None else parameters
        return 0.5 * p["mass"] * state[0] ** 2

    def result(self, state: Any, parameters: Parameters | None = None) -> list[Any]:
        return [state[0]]


@dataclass(frozen=True, kw_only=True)
class RigidWall(Target):
    """A wall that never moves: it takes impulse, but no energy. It has no state and no numbers."""

    n_states = 0

    def velocity(self, state: Any, parameters: Parameters | None = None) -> Any:
        return 0.0

    def derivative(self, state: Any, force: Any, parameters: Parameters | None = None) -> list[Any]:
        return []

    def energy(self, state: Any, parameters: Parameters | None = None) -> Any:
        return 0.0
