"""Targets: how what is hit moves along the normal under the contact force."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from .laws import _numbers, positive

Parameters = Mapping[str, Any]


class Target(ABC):
    """Something that is hit, at rest when contact begins; motion is along the contact normal only.

    To write one, make a frozen dataclass whose fields are its numbers, and give the methods below, which
    have to be smooth; `state` is a column of `n_states` numbers or CasADi symbols, zero at rest.
    """

    n_states: int

    @property
    def parameters(self) -> dict[str, float]:
        """The target's numbers by name; a collision model takes each as an input named `target_<name>`."""
        return _numbers(self)

    @abstractmethod
    def velocity(self, state: Any, parameters: Parameters | None = None) -> Any:
        """Velocity of the hit surface along the normal [m/s]."""

    @abstractmethod
    def derivative(self, state: Any, force: Any, parameters: Parameters | None = None) -> list[Any]:
        """d(state)/dt, a list of `n_states` expressions, under the contact force [N]."""

    @abstractmethod
    def energy(self, state: Any, parameters: Parameters | None = None) -> Any:
        """Energy [J] that the target holds."""


@dataclass(frozen=True, kw_only=True)
class FreeMass(Target):
    """A point mass that moves freely along the normal (paper, figs. 1 and 9); its state is its velocity.

    Attributes
    ----------
    mass : [kg] > 0.

    Raises
    ------
    InputError : a mass that is not a positive number.
    """

    mass: float

    n_states = 1

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
