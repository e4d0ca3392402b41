"""A spring and a damper."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from impactopt.contact.fields import Parameters, about
from impactopt.contact.laws.base import ContactLaw


@dataclass(frozen=True, kw_only=True)
class KelvinVoigt(ContactLaw):
    """A spring and a damper, in compression and restitution.

    f = k x + d dx/dt in both phases, until the force has fallen to zero: it never pulls. Two masses part with
    e = exp(-2 zeta acos(zeta) / sqrt(1 - zeta^2)) of their speed of approach, where zeta = d / (2 sqrt(k mu))
    < 1 and 1/mu = 1/m_1 + 1/m_2; they part while the spring is still compressed.
    """

    word: ClassVar[str] = "Kelvin-Voigt"
    stiffness: float = field(metadata=about("stiffness k", unit="N/m", above=0))
    damping: float = field(metadata=about("damping d", unit="N s/m", least=0))

    def branch(
        self, penetration: Any, rate: Any, compressing: bool, parameters: Parameters | None = None
    ) -> Any:
        p = self.parameters if parameters is None else parameters
        return p["stiffness"] * penetration + p["damping"] * rate
