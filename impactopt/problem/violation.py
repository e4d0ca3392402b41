"""Description of a violated constraint in messages: its place in the motion, and the amount."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from impactopt.arrays import Array


class Expression(Protocol):
    """An expression in a program's variables: `impactopt.transcription.layout.Affine`."""

    def evaluate(self, x: Array) -> Array:
        """Its values for solver variables (n,)."""
        ...


@dataclass(frozen=True, eq=False)
class Place:
    """Place in the motion at which a constraint holds.

    name : unique name in the program, such as "swing, 93 %".
    text : for messages; ``{s}`` and ``{ms}`` stand for the time in [s] and [ms].
    time [s] : expression in the program's variables; None if the text has no time.
    """

    name: str
    text: str
    time: Expression | None = None

    @classmethod
    def plain(cls, name: str) -> Place:
        """Place without a time, whose text is its name."""
        return cls(name, name.replace("{", "{{").replace("}", "}}"))

    def describe(self, x: Array) -> str:
        """Text with the time at solver variables (n,)."""
        t = float(self.time.evaluate(x)[0]) if self.time is not None else np.nan
        return self.text.format(s=f"{t:.2f} s", ms=f"{1e3 * t:.0f} ms")


@dataclass(frozen=True, eq=False)
class Measure:
    """Text for the amount of a violation: the amount x ``factor`` in ``unit``, and a ``phrase``.

    over : divisor of the amount, such as a sole's normal force; at least ``least``.
    """

    unit: str
    factor: float
    phrase: str
    over: Expression | None = None
    least: float = 1e-3

    def describe(self, x: Array, amount: float) -> str:
        """Text for an amount, at solver variables (n,)."""
        by = max(float(self.over.evaluate(x)[0]), self.least) if self.over is not None else 1.0
        value = abs(amount * self.factor / by)
        number = f"{value:.0f}" if 9.5 <= value < np.inf else f"{value:.2g}"
        return f"{number} {self.unit} {self.phrase}"


def millimetres(phrase: str, *, scale: float = 1.0) -> Measure:
    """Measure of constraints in ``scale`` [m]."""
    return Measure("mm", 1e3 * scale, phrase)


def degrees(phrase: str) -> Measure:
    """Measure of constraints in [rad]."""
    return Measure("deg", float(np.degrees(1)), phrase)


def percent(phrase: str, *, of: float = 1.0) -> Measure:
    """Measure of constraints in per cent of a value ``of``."""
    return Measure("%", 100 / of if of > 0 else 100.0, phrase)
