"""Targets, one a file: `base` says what a target has; TARGETS are those that problem files know.

A new one is a file here and its lines below.
"""

from impactopt.contact.targets.base import UNITS, Target
from impactopt.contact.targets.board import Board
from impactopt.contact.targets.free_mass import FreeMass
from impactopt.contact.targets.nail import Nail
from impactopt.contact.targets.rigid_wall import RigidWall

# the first is what a file means that names none
TARGETS: tuple[type[Target], ...] = (FreeMass, RigidWall, Nail, Board)

__all__ = ["TARGETS", "UNITS", "Board", "FreeMass", "Nail", "RigidWall", "Target"]
