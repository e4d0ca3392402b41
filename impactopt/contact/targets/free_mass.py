"""A mass that is pushed away."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from impactopt.contact.fields import Parameters, about, described
from impactopt.contact.targets.base import Target


@dataclass(frozen=True, kw_only=True)
class FreeMass(Target):
    """A mass that moves freely along the normal, and with friction's `moves_target` across it.

    A point mass (paper, figs. 1 and 9); its state is the change of its velocity along the normal. It may come
    with a velocity, as a ball does. Its result is `speed` [m/s] along the normal, after the blow.
    """

    word: ClassVar[str] = "free mass"
    mass: float = field(metadata=about("mass of the target", unit="kg", above=0))
    initial_velocity: float = described(
        0.0, "velocity along the normal before contact; below zero: towards the striker", unit="m/s"
    )

    n_states = 1
    results: ClassVar[tuple[str, ...]] = ("speed",)

    def velocity(self, state: Any, parameters: Parameters | None = None) -> Any:
        p = self.parameters if parameters is None else parameters
        return p["initial_velocity"] + state[0]

    def tangential_mass(self, parameters: Parameters | None = None) -> Any:
        return (self.parameters if parameters is None else parameters)["mass"]

    def derivative(self, state: Any, force: Any, parameters: Parameters | None = None) -> list[Any]:
        p = self.parameters if parameters is None else parameters
        return [force / p["mass"]]

    def energy(self, state: Any, parameters: Parameters | None = None) -> Any:
        p = self.parameters if parameters is None else parameters
        return p["mass"] * state[0] * (p["initial_velocity"] + 0.5 * state[0])

    def result(self, state: Any, parameters: Parameters | None = None) -> list[Any]:
        return [self.velocity(state, parameters)]
