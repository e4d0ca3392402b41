"""Targets, one a file: `base` has the interface, TARGETS the targets that problem files can name.

A new target is a file here and its lines below.
"""

from impactopt.contact.targets.base import UNITS, Target
from impactopt.contact.targets.board import Board
from impactopt.contact.targets.free_mass import FreeMass
from impactopt.contact.targets.nail import Nail
from impactopt.contact.targets.rigid_wall import RigidWall

# the first is the default of problem files
TARGETS: tuple[type[Target], ...] = (FreeMass, RigidWall, Nail, Board)

__all__ = ["TARGETS", "UNITS", "Board", "FreeMass", "Nail", "RigidWall", "Target"]
