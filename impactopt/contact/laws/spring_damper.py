"""A spring, and a damper in compression."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from impactopt.contact.fields import Parameters, about
from impactopt.contact.laws.base import ContactLaw


@dataclass(frozen=True, kw_only=True)
class SpringDamper(ContactLaw):
    """A spring, and a damper that acts in compression only.

    f = k x + d dx/dt while compressing, f = k x in restitution (paper, figs. 1 and 9). The paper does
    not say that the damper acts in compression only. Its Table III does: with such a damper all nine
    impulses come out to the printed digit, with a Kelvin-Voigt element none.
    """

    word: ClassVar[str] = "spring damper"
    stiffness: float = field(metadata=about("stiffness k", unit="N/m", above=0))
    damping: float = field(metadata=about("damping d", unit="N s/m", least=0))

    def branch(
        self, penetration: Any, rate: Any, compressing: bool, parameters: Parameters | None = None
    ) -> Any:
        p = self.parameters if parameters is None else parameters
        spring = p["stiffness"] * penetration
        return spring + p["damping"] * rate if compressing else spring
