"""A wall."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from impactopt.contact.fields import Parameters
from impactopt.contact.targets.base import Target


@dataclass(frozen=True, kw_only=True)
class RigidWall(Target):
    """A wall that never moves.

    It takes impulse, but no energy. It has no state and no numbers.
    """

    word: ClassVar[str] = "wall"
    n_states = 0
    stays: ClassVar[bool] = True

    def velocity(self, state: Any, parameters: Parameters | None = None) -> Any:
        return 0.0

    def derivative(self, state: Any, force: Any, parameters: Parameters | None = None) -> list[Any]:
        return []

    def energy(self, state: Any, parameters: Parameters | None = None) -> Any:
        return 0.0
