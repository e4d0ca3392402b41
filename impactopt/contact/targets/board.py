"""A board that is broken."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from impactopt.contact.fields import Parameters, about, choose, described, function
from impactopt.contact.targets.base import Target

MARGIN = 0.1  # relative to the breaking force, at the touch; zero at the break
RESERVE = 0.02  # relative to the deflection at the break
ROUNDED = 1e-12  # added to |1 - damping ratio^2|, by which is divided


@dataclass(frozen=True, kw_only=True)
class Board(Target):
    """A board held at its edges: a modal mass on a spring that breaks.

    m dv/dt = f - k w - d v up to the deflection w = breaking_force / k, and m dv/dt = f beyond it, where its
    two halves are a free mass. As f >= 0, and v > 0 at the break, the deflection never comes back: a broken
    board stays broken. The state is (v, w). A board that is swung at the striker moves with its holders at
    the initial velocity, and v and w are against them. Its result is `broken`: 1 if the board broke before
    separation, or swings on until it breaks, else 0.

    Source: lowest mode of a brittle beam, as in Walker, "Karate strikes", Am. J. Phys. 43 (1975) 845-849.
    """

    word: ClassVar[str] = "board"
    mass: float = field(metadata=about("modal mass at the hit point", unit="kg", above=0))
    stiffness: float = field(metadata=about("stiffness of the bending", unit="N/m", above=0))
    breaking_force: float = field(metadata=about("spring force at which it breaks", unit="N", above=0))
    damping: float = described(0.0, "damping of the bending", unit="N s/m", least=0)
    initial_velocity: float = described(
        0.0, "velocity along the normal before contact; below zero: towards the striker", unit="m/s"
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
        """Gain of kinetic energy, and elastic energy; after the break that at the break.

        The work of the damping is not in it, as it is no function of the state.
        """
        p = self.parameters if parameters is None else parameters
        beyond, at_break = self._beyond(state, p), p["breaking_force"] / p["stiffness"]
        bent = choose(beyond > 0, at_break + 0.0 * beyond, state[1])
        return (
            p["mass"] * state[0] * (p["initial_velocity"] + 0.5 * state[0]) + 0.5 * p["stiffness"] * bent**2
        )

    def result(self, state: Any, parameters: Parameters | None = None) -> list[Any]:
        p = self.parameters if parameters is None else parameters
        highest = self._swing(state, p) - p["breaking_force"] / p["stiffness"]
        return [choose(highest > 0, 1.0 + 0.0 * highest, 0.0 * highest)]

    def _swing(self, state: Any, p: Parameters) -> Any:
        """Deflection [m] at which an unbroken board turns, without a force; now, if it does not bend on.

        A damped oscillation with rate O and damping ratio z, from (v, w), turns at the phase a with
        tan a = s v / (O w + z v), s = sqrt(1 - z^2), where it is exp(-a z / s) sqrt(w^2 + 2 z w v / O +
        (v / O)^2). For z > 1 tan is tanh, and s = sqrt(z^2 - 1); without an a it only creeps back.
        """
        v, w, rate = state[0], state[1], (p["stiffness"] / p["mass"]) ** 0.5
        z = p["damping"] / (2.0 * rate * p["mass"])
        apart = 1.0 - z**2
        slow = apart < 0
        s = (choose(slow, -apart, apart) + ROUNDED) ** 0.5
        up, along = choose(v > 0, v, 0.0 * v) + 0.0, rate * w + z * v  # + 0.0: no minus zero
        turns = along > s * up
        ratio = choose(turns, s * up, 0.0 * up) / choose(turns, along, 1.0 + 0.0 * along)
        phase = choose(slow, function("arctanh", ratio), function("arctan2", s * up, along))
        square = w**2 + 2.0 * z * w * up / rate + (up / rate) ** 2
        size = choose(slow, choose(turns, square, w**2), square) ** 0.5
        on = choose(slow, choose(turns, size, w), size)
        return choose(v > 0, function("exp", -phase * z / s) * on, w)
