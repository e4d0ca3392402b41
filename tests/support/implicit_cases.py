"""Cases and helpers that several tests share: those of `test_implicit_gradient.py`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from impactopt import SDC
from support.exact import ExactCollision
from support.native_cases import LAW, ROBOTS, TARGET, X, call, robot_named

# of the steps: their errors do not count beside those of differences
TIGHT = 1e-12


def implicit(name: str, kind: Any = SDC, **options: Any) -> Any:
    given = {"robot": robot_named(name), "striker": ROBOTS[name][1], "normal": X, "law": LAW}
    return kind(**{**given, "target": TARGET, "method": "implicit", "tolerance": TIGHT, **options})


def gradient(model: Any, output: str, values: list[Any]) -> tuple[float, Any, Any]:
    found = call(model._gradient(output), values)
    return found[output].item(), found[f"{output}_by_q"].ravel(), found[f"{output}_by_v"].ravel()


def exact(model: Any, values: list[Any]) -> Callable[[Any, Any], Any]:
    """The collision at q and v, exact; what it is for the gradient's functions is in `values`."""
    true = ExactCollision(model)
    first = 3 if model.effects.feedforward else 2
    torque = values[2] if first == 3 else None
    others = dict(zip(model.settings, values[first:], strict=True))
    return lambda q, v: true.collide(q, v, torque, require_separation=False, **others)
