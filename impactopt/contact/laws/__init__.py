"""Contact laws, one a file: `base` has the interface, LAWS the laws that problem files can name.

A new law is a file here and its lines below.
"""

from impactopt.contact.laws.base import ContactLaw, rough_at
from impactopt.contact.laws.custom import CustomLaw
from impactopt.contact.laws.hertz_damped import HertzDamped
from impactopt.contact.laws.hunt_crossley import HuntCrossley
from impactopt.contact.laws.kelvin_voigt import KelvinVoigt
from impactopt.contact.laws.spring_damper import SpringDamper

# the first is the default of problem files
LAWS: tuple[type[ContactLaw], ...] = (SpringDamper, KelvinVoigt, HuntCrossley, HertzDamped)

__all__ = [
    "LAWS",
    "ContactLaw",
    "CustomLaw",
    "HertzDamped",
    "HuntCrossley",
    "KelvinVoigt",
    "SpringDamper",
    "rough_at",
]
