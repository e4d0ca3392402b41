"""What is hit and how contact works: laws (force from penetration) and targets (motion from force)."""

from impactopt.contact._expressions import power
from impactopt.contact.board import Board
from impactopt.contact.custom import CustomLaw
from impactopt.contact.laws import ContactLaw, KelvinVoigt, SpringDamper
from impactopt.contact.nail import Nail
from impactopt.contact.nonlinear import HertzDamped, HuntCrossley
from impactopt.contact.targets import FreeMass, RigidWall, Target

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
