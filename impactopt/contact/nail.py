"""A nail that is hammered in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from ._expressions import Parameters, choose, positive
from .targets import Target

__all__ = ["Nail"]

CREEP = 1e-3  # [m/s] of a nail at rest in a plan, with nothing pushing; see `Nail.smooth`


@dataclass(frozen=True, kw_only=True)
class Nail(Target):
    """A nail in wood, which resists with R = resistance + hardening (depth + z), z driven by this blow.

    m dv/dt = f - R while the nail moves (v > 0) or is pushed harder than that (f > R); else it stands still,
    as the wood holds on to it. It never comes back. The state is (v, z). Its result is `depth` [m], what the
    blow has driven once the nail has stopped: after separation it coasts on until R has used up its energy.
    The next blow of a series begins at this nail's `depth` plus that.

    Kind of model: Tsujita et al., "Analysis of nailing task motion for a humanoid robot", IROS 2008,
    1570-1575 (the paper's [10]).

    Attributes
    ----------
    mass : m [kg] > 0.
    resistance : [N] > 0, at the wood's surface.
    hardening : [N/m] >= 0, growth of the resistance with depth.
    depth : [m] >= 0 in the wood before the blow.

    Raises
    ------
    InputError : a number out of its range.
    """

    mass: float
    resistance: float
    hardening: float = 0.0
    depth: float = 0.0

    n_states = 2
    results: ClassVar[tuple[str, ...]] = ("depth",)
    typical: ClassVar[tuple[float, ...]] = (1.0, 0.01)
    helpers: ClassVar[tuple[str, ...]] = ("unused resistance",)
    forward_only: ClassVar[bool] = True

    def __post_init__(self) -> None:
        positive("Nail: mass [kg]", self.mass)
        positive("Nail: resistance [N]", self.resistance)
        positive("Nail: hardening [N/m]", self.hardening, zero=True)
        positive("Nail: depth [m]", self.depth, zero=True)

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
        """Of the nail that moves, v; of the one that stands, f - R."""
        p = self.parameters if parameters is None else parameters
        beyond = force - self._resistance(state, p)
        return [choose(state[0] > 0, state[0], choose(beyond > 0, state[0], beyond))]

    def smooth(
        self, state: Any, force: Any, helpers: Any, broken: bool, parameters: Parameters | None = None
    ) -> tuple[list[Any], list[Any]]:
        """The nail never quite stands: it creeps at v = CREEP / h under R (1 - h), h >= 0, v >= 0.

        The helper h is the fraction of the wood's resistance that is not used: nearly 0 while the nail moves
        and 1 - f / R while it stands, which is dry friction's complementarity v h = 0, relaxed. A nail that
        moves at v feels (1 - CREEP / v) R. Source: Scholtes, SIAM J. Optim. 11 (2001) 918-936.
        """
        p = self.parameters if parameters is None else parameters
        v, unused = state[0], helpers[0]
        resisted = self._resistance(state, p) * (1.0 - unused)
        meet = v + unused - ((v - unused) ** 2 + 4.0 * CREEP) ** 0.5
        return [(force - resisted) / p["mass"], v], [meet]

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
