"""Collisions: the simplified dynamics computation (SDC) and the effective mass."""

from .effective_mass import effective_mass
from .outputs import OUTPUTS
from .result import Collision
from .sdc import SDC
from .terms import JointFriction, Terms

__all__ = ["OUTPUTS", "SDC", "Collision", "JointFriction", "Terms", "effective_mass"]
