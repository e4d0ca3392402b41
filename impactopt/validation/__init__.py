"""Re-simulation of plans in full dynamics, by engines that share no code with the planner."""

from impactopt.validation.conditions import Conditions
from impactopt.validation.engines import ENGINES, simulate
from impactopt.validation.mujoco_engine import simulate_mujoco
from impactopt.validation.pinocchio_engine import simulate_pinocchio
from impactopt.validation.result import Scene, Simulation
from impactopt.validation.scene import scene_of

__all__ = [
    "ENGINES",
    "Conditions",
    "Scene",
    "Simulation",
    "scene_of",
    "simulate",
    "simulate_mujoco",
    "simulate_pinocchio",
]
