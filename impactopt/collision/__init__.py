"""Collisions: a ladder of models from a point mass to the simplified dynamics computation (SDC)."""

from .effective_mass import effective_mass
from .interface import CollisionModel
from .outputs import OUTPUTS
from .result import Collision
from .sdc import SDC
from .terms import JointFriction, Terms
from .virtual_mass import VirtualMass

__all__ = [
    "OUTPUTS",
    "SDC",
    "Collision",
    "CollisionModel",
    "JointFriction",
    "Terms",
    "VirtualMass",
    "effective_mass",
]
