"""A board that is broken."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from impactopt.contact._expressions import Parameters, choose
from impactopt.contact.fields import about
from impactopt.contact.targets.base import Target

__all__ = ["Board"]


@dataclass(frozen=True, kw_only=True)
class Board(Target):
    """A board held at its edges: a modal mass on a spring that breaks.

    m dv/dt = f - k w - d v up to the deflection w = breaking_force / k, and m dv/dt = f beyond it: the pieces
    are a free mass. As f >= 0, and v > 0 at the break, they only move on: broken is broken. The state is
    (v, w). Its result is `broken`, 1 where the board broke before separation, else 0; whether one that is
    left swinging breaks later is not looked at.

    Source: lowest mode of a brittle beam, as in Walker, "Karate strikes", Am. J. Phys. 43 (1975) 845-849.
    """

    word: ClassVar[str] = "board"
    mass: float = field(metadata=about("modal mass where it is hit", unit="kg", above=0))
    stiffness: float = field(metadata=about("of the bending", unit="N/m", above=0))
    breaking_force: float = field(metadata=about("of the spring", unit="N", above=0))
    damping: float = field(default=0.0, metadata=about("of the bending", unit="N s/m", least=0))

    n_states = 2
    results: ClassVar[tuple[str, ...]] = ("broken",)
    typical: ClassVar[tuple[float, ...]] = (1.0, 0.01)
    events: ClassVar[tuple[str, ...]] = ("break",)
    phases: ClassVar[tuple[str, ...]] = ("compression", "compression after the break", "restitution")

    def velocity(self, state: Any, parameters: Parameters | None = None) -> Any:
        return state[0]

    def derivative(self, state: Any, force: Any, parameters: Parameters | None = None) -> list[Any]:
        p = self.parameters if parameters is None else parameters
        bending = p["stiffness"] * state[1] + p["damping"] * state[0]
        held = choose(self._beyond(state, p) > 0, 0.0 * bending, bending)
        return [(force - held) / p["mass"], state[0]]

    def smooth(
        self, state: Any, force: Any, phase: int, parameters: Parameters | None = None
    ) -> tuple[Any, list[Any]]:
        """One branch until it breaks, one after."""
        p = self.parameters if parameters is None else parameters
        bending = p["stiffness"] * state[1] + p["damping"] * state[0]
        return state[0], [(force - (0.0 if phase else bending)) / p["mass"], state[0]]

    def event(
        self, state: Any, force: Any, late: Any, phase: int, parameters: Parameters | None = None
    ) -> Any:
        """The spring's force over that of the break, less 1."""
        p = self.parameters if parameters is None else parameters
        return p["stiffness"] * state[1] / p["breaking_force"] - 1.0

    def lasting(self, state: Any, force: Any, phase: int, parameters: Parameters | None = None) -> list[Any]:
        """It does not break too early."""
        return [] if phase else [-self.event(state, force, 0.0, phase, parameters)]

    def _beyond(self, state: Any, p: Parameters) -> Any:
        return state[1] - p["breaking_force"] / p["stiffness"]

    def switches(self, state: Any, force: Any, parameters: Parameters | None = None) -> list[Any]:
        """Deflection beyond that of the break."""
        return [self._beyond(state, self.parameters if parameters is None else parameters)]

    def energy(self, state: Any, parameters: Parameters | None = None) -> Any:
        """Kinetic energy, and that of bending: after the break, what it took to break."""
        p = self.parameters if parameters is None else parameters
        beyond, at_break = self._beyond(state, p), p["breaking_force"] / p["stiffness"]
        bent = choose(beyond > 0, at_break + 0.0 * beyond, state[1])
        return 0.5 * p["mass"] * state[0] ** 2 + 0.5 * p["stiffness"] * bent**2

    def result(self, state: Any, parameters: Parameters | None = None) -> list[Any]:
        p = self.parameters if parameters is None else parameters
        beyond = self._beyond(state, p)
        return [choose(beyond > 0, 1.0 + 0.0 * beyond, 0.0 * beyond)]
