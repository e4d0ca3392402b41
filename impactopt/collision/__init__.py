"""Collisions: a hierarchy of models from a point mass to the simplified dynamics computation (SDC)."""

from impactopt.collision.effective_mass import effective_mass
from impactopt.collision.effects import Effects, JointFriction
from impactopt.collision.interface import CollisionModel
from impactopt.collision.outputs import OUTPUTS
from impactopt.collision.result import Collision
from impactopt.collision.sdc import SDC
from impactopt.collision.virtual_mass import VirtualMass

__all__ = [
    "OUTPUTS",
    "SDC",
    "Collision",
    "CollisionModel",
    "Effects",
    "JointFriction",
    "VirtualMass",
    "effective_mass",
]
