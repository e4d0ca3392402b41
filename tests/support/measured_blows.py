"""Logs of blows by SciPy's integrator and formulas of their own: nothing of the package makes them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from impactopt import ImpactLog

Array = NDArray[np.float64]
Numbers = Mapping[str, float]


def spring_damper(x: Any, rate: Any, p: Numbers) -> Any:
    return p["stiffness"] * x + p["damping"] * np.maximum(rate, 0.0)


def kelvin_voigt(x: Any, rate: Any, p: Numbers) -> Any:
    return p["stiffness"] * x + p["damping"] * rate


def hunt_crossley(x: Any, rate: Any, p: Numbers) -> Any:
    return p["stiffness"] * np.maximum(x, 0.0) ** 1.5 * (1.0 + 1.5 * p["dissipation"] * rate)


def hertz(x: Any, rate: Any, p: Numbers) -> Any:
    x = np.maximum(x, 0.0)
    return p["stiffness"] * x**1.5 + p["damping"] * x**0.25 * rate


# by the words of problem files: force, and numbers of a blow of some 10 ms with 3 kg
TRUE: dict[str, tuple[Callable[..., Any], dict[str, float]]] = {
    "spring damper": (spring_damper, {"stiffness": 1e5, "damping": 150.0}),
    "Kelvin-Voigt": (kelvin_voigt, {"stiffness": 1e5, "damping": 150.0}),
    "Hunt-Crossley": (hunt_crossley, {"stiffness": 5e6, "dissipation": 0.3}),
    "Hertz": (hertz, {"stiffness": 5e6, "damping": 1000.0}),
}


@dataclass(frozen=True)
class TrueBlow:
    """A hand of `mass` [kg] at `speed` [m/s] on a target of `target_mass`, integrated once."""

    law: str
    mass: float = 3.0
    speed: float = 1.0
    target_mass: float = np.inf
    numbers: Numbers | None = None

    def __post_init__(self) -> None:
        force, usual = TRUE[self.law]
        numbers = self.numbers or usual
        reduced = 1 / (1 / self.mass + 1 / self.target_mass)

        def rates(_t: float, y: Array) -> list[float]:
            f = max(float(force(y[0], y[1], numbers)), 0.0)
            return [y[1], -f / reduced, f, y[2]]

        def over(_t: float, y: Array) -> float:
            return 1.0 if y[1] >= 0 else float(min(force(y[0], y[1], numbers), 1e9 * y[0]))

        over.terminal = True  # type: ignore[attr-defined]
        start = [0.0, self.speed, 0.0, 0.0]
        run = solve_ivp(rates, (0, 1), start, "DOP853", rtol=1e-9, atol=1e-12, events=over, dense_output=True)
        assert run.status == 1
        object.__setattr__(self, "_run", run)
        object.__setattr__(self, "_force", lambda x, v: np.maximum(force(x, v, numbers), 0.0))

    def at(self, t: Array) -> tuple[Array, Array, Array]:
        """Force [N], speed [m/s] and travel [m] of the hand at times since the touch."""
        run: Any = vars(self)["_run"]
        end = run.t[-1]
        x, v, impulse, carried = run.sol(np.clip(t, 0.0, end))
        carried = carried + impulse * np.maximum(t - end, 0.0)
        force = np.where((t >= 0) & (t < end), vars(self)["_force"](x, v), 0.0)
        return force, self.speed - impulse / self.mass, self.speed * t - carried / self.mass


def log_of(
    *blows: TrueBlow, noise: float = 0.02, seed: int = 0, rate: float = 1e4, apart: float = 0.08
) -> ImpactLog:
    """A log of blows one after the other, with white noise on force and speed, of their largest values; where
    touches fall between the samples is drawn too."""
    drawn = np.random.default_rng(seed)
    parts = []
    for k, blow in enumerate(blows):
        t = np.arange(-0.02, 0.04, 1 / rate)
        force, speed, _ = blow.at(t - drawn.uniform(0, 1 / rate))
        parts.append((t + k * apart, force, speed))
    t, force, speed = (np.concatenate(part) for part in zip(*parts, strict=True))
    return ImpactLog(
        time=t,
        force=force + noise * force.max() * drawn.normal(size=len(t)),
        speed=speed + noise * np.abs(speed).max() * drawn.normal(size=len(t)),
    )
