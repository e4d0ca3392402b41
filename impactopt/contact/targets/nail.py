"""A nail that is hammered in."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from impactopt.contact.fields import Parameters, about, choose
from impactopt.contact.targets.base import Target

__all__ = ["Nail"]

SOON, LEFT = 1e-3, 1e-4  # of a plan's start: the unit of time [s], and what is left; see `Nail.guard`


@dataclass(frozen=True, kw_only=True)
class Nail(Target):
    """A nail in wood, which resists with resistance + hardening x depth.

    The resistance is R = resistance + hardening (depth + z), where z is how far this blow has driven the
    nail. m dv/dt = f - R while the nail moves (v > 0) or is pushed harder than the wood holds (f > R).
    Otherwise it stands still. It never comes back. The state is (v, z). Its result is `depth` [m]: how far
    the blow drives it until it stops, the distance that it coasts after separation included. The next blow of
    a series begins at this nail's `depth` plus that.

    Kind of model: Tsujita et al., "Analysis of nailing task motion for a humanoid robot", IROS 2008,
    1570-1575 (the paper's [10]).
    """

    word: ClassVar[str] = "nail"
    mass: float = field(metadata=about("mass of the nail", unit="kg", above=0))
    resistance: float = field(metadata=about("resistance of the wood at its surface", unit="N", above=0))
    hardening: float = field(
        default=0.0, metadata=about("growth of the resistance with depth", unit="N/m", least=0)
    )
    depth: float = field(
        default=0.0, metadata=about("how deep it is in the wood before the blow", unit="m", least=0)
    )

    n_states = 2
    results: ClassVar[tuple[str, ...]] = ("depth",)
    typical: ClassVar[tuple[float, ...]] = (1.0, 0.01)
    guards: ClassVar[tuple[str, ...]] = ("start", "stop")
    phases: ClassVar[tuple[str, ...]] = ("press", "drive", "release")
    at_once: ClassVar[bool] = True
    stays: ClassVar[bool] = True

    def _resistance(self, state: Any, p: Parameters) -> Any:
        return p["resistance"] + p["hardening"] * (p["depth"] + state[1])

    def velocity(self, state: Any, parameters: Parameters | None = None) -> Any:
        # a step that ends just beyond the stop leaves v a little below zero; and zero belongs to the side
        # on which v starts to grow
        return choose(state[0] >= 0, state[0], 0.0 * state[0])

    def derivative(self, state: Any, force: Any, parameters: Parameters | None = None) -> list[Any]:
        p = self.parameters if parameters is None else parameters
        push = (force - self._resistance(state, p)) / p["mass"]
        driven = choose(state[0] > 0, push, choose(push > 0, push, 0.0 * push))
        return [driven, self.velocity(state, p)]

    def switches(self, state: Any, force: Any, parameters: Parameters | None = None) -> list[Any]:
        """v while the nail moves, f - R while it stands."""
        p = self.parameters if parameters is None else parameters
        beyond = force - self._resistance(state, p)
        return [choose(state[0] > 0, state[0], choose(beyond > 0, state[0], beyond))]

    def smooth(
        self, state: Any, force: Any, phase: int, parameters: Parameters | None = None
    ) -> tuple[Any, list[Any]]:
        """It stands, is driven, and stands again: it moves once in a blow."""
        p = self.parameters if parameters is None else parameters
        if phase != 1:
            return 0.0 * state[0], [0.0 * state[0], 0.0 * state[0]]
        return state[0], [(force - self._resistance(state, p)) / p["mass"], state[0]]

    def guard(
        self, state: Any, force: Any, late: Any, phase: int, parameters: Parameters | None = None
    ) -> Any:
        """The nail starts where the force reaches the resistance, or at once if the first force is above it.

        The first is f = R and late > 0, the second late = 0 and f > R: complementarity, relaxed to
        late (f / R - 1) = SOON LEFT, both above zero. It stops at v = 0.
        Source: Scholtes, SIAM J. Optim. 11 (2001) 918-936.
        """
        p = self.parameters if parameters is None else parameters
        if phase == 1:
            return state[0]
        wait, beyond = late / SOON, force / self._resistance(state, p) - 1.0
        return wait + beyond - ((wait - beyond) ** 2 + 4.0 * LEFT) ** 0.5

    def invariant(
        self, state: Any, force: Any, phase: int, parameters: Parameters | None = None
    ) -> list[Any]:
        """While driven it does not move back; after that the force stays below the resistance."""
        p = self.parameters if parameters is None else parameters
        return [[], [state[0]], [1.0 - force / self._resistance(state, p)]][phase]

    def energy(self, state: Any, parameters: Parameters | None = None) -> Any:
        """Kinetic energy, and the work done against the wood."""
        p = self.parameters if parameters is None else parameters
        at_start = p["resistance"] + p["hardening"] * p["depth"]
        work = at_start * state[1] + 0.5 * p["hardening"] * state[1] ** 2
        return 0.5 * p["mass"] * self.velocity(state, p) ** 2 + work

    def result(self, state: Any, parameters: Parameters | None = None) -> list[Any]:
        p = self.parameters if parameters is None else parameters
        # R s + hardening s^2 / 2 = m v^2 / 2, written so that it holds without hardening too
        R, twice_energy = self._resistance(state, p), p["mass"] * self.velocity(state, p) ** 2
        coasted = twice_energy / (R + (R**2 + p["hardening"] * twice_energy) ** 0.5)
        return [state[1] + coasted]
