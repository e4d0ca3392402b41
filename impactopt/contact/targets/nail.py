"""A nail that is hammered in."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from impactopt.contact.fields import Parameters, about, choose, described
from impactopt.contact.targets.base import Target

SOON, LEFT = 1e-3, 1e-4  # time scale [s] and relaxation of the complementarity condition in `Nail.guard`


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
    hardening: float = described(0.0, "growth of the resistance with depth", unit="N/m", least=0)
    depth: float = described(0.0, "how deep it is in the wood before the blow", unit="m", least=0)

    n_states = 2
    results: ClassVar[tuple[str, ...]] = ("depth",)
    typical: ClassVar[tuple[float, ...]] = (1.0, 0.01)
    guards: ClassVar[tuple[str, ...]] = ("start", "stop")
    phases: ClassVar[tuple[str, ...]] = ("press", "drive", "release")
    at_once: ClassVar[bool] = True
    stays: ClassVar[bool] = True
    met_again: ClassVar[bool] = True

    def _resistance(self, state: Any, p: Parameters) -> Any:
        return p["resistance"] + p["hardening"] * (p["depth"] + state[1])

    def velocity(self, state: Any, parameters: Parameters | None = None) -> Any:
        # A step that ends just beyond the stop leaves v slightly below zero. Zero belongs to the branch on
        # which v starts to grow.
        return choose(state[0] >= 0, state[0], 0.0 * state[0])

    def derivative(self, state: Any, force: Any, parameters: Parameters | None = None) -> list[Any]:
        p = self.parameters if parameters is None else parameters
        push = (force - self._resistance(state, p)) / p["mass"]
        driven = choose(state[0] > 0, push, choose(push > 0, push, 0.0 * push))
        return [driven, self.velocity(state, p)]

    def switches(self, state: Any, force: Any, parameters: Parameters | None = None) -> list[Any]:
        """Velocity v while the nail moves, f - R while it is at rest."""
        p = self.parameters if parameters is None else parameters
        beyond = force - self._resistance(state, p)
        return [choose(state[0] > 0, state[0], choose(beyond > 0, state[0], beyond))]

    def smooth(
        self, state: Any, force: Any, phase: int, parameters: Parameters | None = None
    ) -> tuple[Any, list[Any]]:
        """Velocity and rates of the nail: at rest, driven, and at rest again. It moves once in an impact."""
        p = self.parameters if parameters is None else parameters
        if phase != 1:
            return 0.0 * state[0], [0.0 * state[0], 0.0 * state[0]]
        return state[0], [(force - self._resistance(state, p)) / p["mass"], state[0]]

    def guard(
        self, state: Any, force: Any, late: Any, phase: int, parameters: Parameters | None = None
    ) -> Any:
        """Start of the nail, as the force reaches the resistance or is above it at first touch; and its stop.

        The two starts, f = R with late > 0 and late = 0 with f > R, are complementary. The condition is
        relaxed to late (f / R - 1) = SOON LEFT with both factors positive. The nail stops at v = 0.
        Source: Scholtes, SIAM J. Optim. 11 (2001) 918-936.
        """
        p = self.parameters if parameters is None else parameters
        if phase == 1:
            return -state[0]
        wait, beyond = late / SOON, force / self._resistance(state, p) - 1.0
        return wait + beyond - ((wait - beyond) ** 2 + 4.0 * LEFT) ** 0.5

    def invariant(
        self, state: Any, force: Any, phase: int, parameters: Parameters | None = None
    ) -> list[Any]:
        """Velocity v while it is driven, which is not negative; then R - f over R."""
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
        # the root s of R s + hardening s^2 / 2 = m v^2 / 2, in a form that is valid without hardening too
        R, twice_energy = self._resistance(state, p), p["mass"] * self.velocity(state, p) ** 2
        coasted = twice_energy / (R + (R**2 + p["hardening"] * twice_energy) ** 0.5)
        return [state[1] + coasted]
