"""Full dynamics of a collision, with nothing frozen: what the simplified models are measured against."""

from .full import FullDynamics
from .holding import holding_torque

__all__ = ["FullDynamics", "holding_torque"]
