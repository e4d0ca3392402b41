"""Re-simulation of plans in full dynamics, by engines that share no code with the planner."""

from impactopt.validation.pinocchio_engine import simulate_pinocchio
from impactopt.validation.result import Scene, Simulation
from impactopt.validation.scene import scene_of

__all__ = ["Scene", "Simulation", "scene_of", "simulate_pinocchio"]
