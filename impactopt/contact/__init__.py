"""What is hit and how contact works: laws (force from penetration) and targets (motion from force).

One class a file, in `laws/` and `targets/`; `factors.py` is for numbers that differ from the expected ones.
"""

from impactopt.contact._expressions import power
from impactopt.contact.laws import (
    ContactLaw,
    CustomLaw,
    HertzDamped,
    HuntCrossley,
    KelvinVoigt,
    SpringDamper,
)
from impactopt.contact.targets import Board, FreeMass, Nail, RigidWall, Target

__all__ = [
    "Board",
    "ContactLaw",
    "CustomLaw",
    "FreeMass",
    "HertzDamped",
    "HuntCrossley",
    "KelvinVoigt",
    "Nail",
    "RigidWall",
    "SpringDamper",
    "Target",
    "power",
]
