"""A law of rounded bodies with a restitution that falls with speed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from impactopt.contact.fields import Parameters, about, described, power
from impactopt.contact.laws.base import ContactLaw


@dataclass(frozen=True, kw_only=True)
class HuntCrossley(ContactLaw):
    """A force that grows with depth and rate: k x^p (1 + 1.5 alpha dx/dt).

    Damping grows with penetration, so that f starts and ends at 0. Bodies that meet at the speed v part with
    e of it, whatever k, p and their masses: l v - ln(1 + l v) = -l e v - ln(1 - l e v) with l = 1.5 alpha,
    which is e = 1 - alpha v for small alpha v.
    Source: Hunt and Crossley, "Coefficient of restitution interpreted as damping in vibroimpact", ASME J.
    Appl. Mech. 42 (1975) 440-445.
    """

    word: ClassVar[str] = "Hunt-Crossley"
    stiffness: float = field(metadata=about("stiffness k; p is the exponent", unit="N/m^p", above=0))
    dissipation: float = field(metadata=about("dissipation alpha", unit="s/m", least=0))
    exponent: float = described(1.5, "exponent p; 1.5 for a sphere on a plane", least=1)

    def branch(
        self, penetration: Any, rate: Any, compressing: bool, parameters: Parameters | None = None
    ) -> Any:
        p = self.parameters if parameters is None else parameters
        spring = p["stiffness"] * power(penetration, p["exponent"])
        return spring * (1.0 + 1.5 * p["dissipation"] * rate)

    def separation(self, penetration: Any, rate: Any, parameters: Parameters | None = None) -> Any:
        """Expression k x (1 + 1.5 alpha dx/dt), as the force has no slope at x = 0.

        Contact ends there, unless something pulls the bodies apart faster than 1 / (1.5 alpha) before.
        """
        p = self.parameters if parameters is None else parameters
        return p["stiffness"] * penetration * (1.0 + 1.5 * p["dissipation"] * rate)
