"""Collisions: a hierarchy of models from a point mass to the simplified dynamics computation (SDC)."""

from impactopt.collision.frozen import effective_mass
from impactopt.collision.interface import Collision, CollisionModel
from impactopt.collision.outputs import OUTPUTS
from impactopt.collision.rigid import RigidImpact
from impactopt.collision.sdc import SDC, VirtualMass
from impactopt.collision.settings import Effects, JointFriction

__all__ = [
    "OUTPUTS",
    "SDC",
    "Collision",
    "CollisionModel",
    "Effects",
    "JointFriction",
    "RigidImpact",
    "VirtualMass",
    "effective_mass",
]
