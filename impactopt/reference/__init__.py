"""Full dynamics of a collision, with nothing frozen: what the simplified models are measured against."""

from .coasting import coasting_reference
from .full import FullDynamics
from .holding import holding_torque
from .mujoco_dynamics import MujocoDynamics

__all__ = ["FullDynamics", "MujocoDynamics", "coasting_reference", "holding_torque"]
