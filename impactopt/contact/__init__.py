"""What is hit and how contact works: laws (force from penetration) and targets (motion from force)."""

from ._expressions import power
from .board import Board
from .custom import CustomLaw
from .laws import ContactLaw, KelvinVoigt, SpringDamper
from .nail import Nail
from .nonlinear import HertzDamped, HuntCrossley
from .targets import FreeMass, RigidWall, Target

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
