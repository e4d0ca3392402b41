"""Reference models: full dynamics of a collision, against which the simplified models are measured."""

from impactopt.simulation.reference.full import FullDynamics
from impactopt.simulation.reference.mujoco_dynamics import MujocoDynamics

__all__ = ["FullDynamics", "MujocoDynamics"]
