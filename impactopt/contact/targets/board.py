"""A board that is broken."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from impactopt.contact.fields import Parameters, about, choose
from impactopt.contact.targets.base import Target

__all__ = ["Board"]

MARGIN = 0.1  # relative to the breaking force, at the touch; zero at the break
RESERVE = 0.02  # relative to the deflection at the break


@dataclass(frozen=True, kw_only=True)
class Board(Target):
    """A board held at its edges: a modal mass on a spring that breaks.

    m dv/dt = f - k w - d v up to the deflection w = breaking_force / k, and m dv/dt = f beyond it, where its
    two halves are a free mass. As f >= 0, and v > 0 at the break, the deflection never comes back: a broken
    board stays broken. The state is (v, w). A board that is swung at the striker moves with its holders at
    the initial velocity, and v and w are against them. Its result is `broken`: 1 if the board broke before
    separation, else 0. A board that swings on and breaks after separation counts as not broken.

    Source: lowest mode of a brittle beam, as in Walker, "Karate strikes", Am. J. Phys. 43 (1975) 845-849.
    """

    word: ClassVar[str] = "board"
    mass: float = field(metadata=about("modal mass at the hit point", unit="kg", above=0))
    stiffness: float = field(metadata=about("stiffness of the bending", unit="N/m", above=0))
    breaking_force: float = field(metadata=about("spring force at which it breaks", unit="N", above=0))
    damping: float = field(default=0.0, metadata=about("damping of the bending", unit="N s/m", least=0))
    initial_velocity: float = field(
        default=0.0,
        metadata=about(
            "velocity along the normal before contact; below zero: towards the striker", unit="m/s"
        ),
    )

    n_states = 2
    results: ClassVar[tuple[str, ...]] = ("broken",)
    typical: ClassVar[tuple[float, ...]] = (1.0, 0.01)
    guards: ClassVar[tuple[str, ...]] = ("break",)
    phases: ClassVar[tuple[str, ...]] = ("compression", "compression after the break", "restitution")
    met_again: ClassVar[bool] = True

    def velocity(self, state: Any, parameters: Parameters | None = None) -> Any:
        p = self.parameters if parameters is None else parameters
        return p["initial_velocity"] + state[0]

    def derivative(self, state: Any, force: Any, parameters: Parameters | None = None) -> list[Any]:
        p = self.parameters if parameters is None else parameters
        bending = p["stiffness"] * state[1] + p["damping"] * state[0]
        held = choose(self._beyond(state, p) > 0, 0.0 * bending, bending)
        return [(force - held) / p["mass"], state[0]]

    def smooth(
        self, state: Any, force: Any, phase: int, parameters: Parameters | None = None
    ) -> tuple[Any, list[Any]]:
        """Velocity and rates of the board, on its spring until it breaks, and free after that."""
        p = self.parameters if parameters is None else parameters
        bending = p["stiffness"] * state[1] + p["damping"] * state[0]
        return self.velocity(state, p), [(force - (0.0 if phase else bending)) / p["mass"], state[0]]

    def guard(
        self, state: Any, force: Any, late: Any, phase: int, parameters: Parameters | None = None
    ) -> Any:
        """Spring force over breaking force, minus 1."""
        p = self.parameters if parameters is None else parameters
        return p["stiffness"] * state[1] / p["breaking_force"] - 1.0

    def invariant(
        self, state: Any, force: Any, phase: int, parameters: Parameters | None = None
    ) -> list[Any]:
        """Ratio 1 - spring force / breaking force, positive before the break."""
        return [] if phase else [-self.guard(state, force, 0.0, phase, parameters)]

    def reserve(self, state: Any, force: Any, phase: int, parameters: Parameters | None = None) -> list[Any]:
        """Condition that an unbroken board would swing on at this force, by a fraction of its deflection.

        If it decelerates, v^2 / (2 |dv/dt|) >= RESERVE F / k.
        """
        if phase:
            return []
        p = self.parameters if parameters is None else parameters
        F, v = p["breaking_force"], state[0]
        slows = 1.0 + (p["damping"] * v - force) / F
        return [p["stiffness"] * p["mass"] * v**2 / F**2 - 2.0 * RESERVE * slows]

    def margin(self, phase: int, place: float) -> float:
        """Margin that decreases from the touch to the break.

        A board that nearly breaks may break, so earlier peaks of its oscillation stay below the break.
        """
        return MARGIN * (1.0 - place) if phase == 0 else 0.0

    def _beyond(self, state: Any, p: Parameters) -> Any:
        return state[1] - p["breaking_force"] / p["stiffness"]

    def switches(self, state: Any, force: Any, parameters: Parameters | None = None) -> list[Any]:
        """Deflection minus that of the break."""
        return [self._beyond(state, self.parameters if parameters is None else parameters)]

    def energy(self, state: Any, parameters: Parameters | None = None) -> Any:
        """Gain of kinetic energy, and elastic energy; after the break that at the break."""
        p = self.parameters if parameters is None else parameters
        beyond, at_break = self._beyond(state, p), p["breaking_force"] / p["stiffness"]
        bent = choose(beyond > 0, at_break + 0.0 * beyond, state[1])
        return (
            p["mass"] * state[0] * (p["initial_velocity"] + 0.5 * state[0]) + 0.5 * p["stiffness"] * bent**2
        )

    def result(self, state: Any, parameters: Parameters | None = None) -> list[Any]:
        p = self.parameters if parameters is None else parameters
        beyond = self._beyond(state, p)
        return [choose(beyond > 0, 1.0 + 0.0 * beyond, 0.0 * beyond)]
