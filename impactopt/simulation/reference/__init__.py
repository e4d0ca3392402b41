"""Full dynamics of a collision, with nothing frozen: what the simplified models are measured against."""

from impactopt.simulation.reference.coasting import coasting_reference
from impactopt.simulation.reference.full import FullDynamics
from impactopt.simulation.reference.mujoco_dynamics import MujocoDynamics

__all__ = ["FullDynamics", "MujocoDynamics", "coasting_reference"]
