"""Re-simulation of plans in full dynamics, by engines that share no code with the planner."""

from impactopt.simulation.controller import ControllerSettings
from impactopt.simulation.engines import ENGINES, scene_of, simulate
from impactopt.simulation.mujoco_engine import simulate_mujoco
from impactopt.simulation.perturbation import Perturbation
from impactopt.simulation.pinocchio_engine import simulate_pinocchio
from impactopt.simulation.result import Scene, Simulation

__all__ = [
    "ENGINES",
    "ControllerSettings",
    "Perturbation",
    "Scene",
    "Simulation",
    "scene_of",
    "simulate",
    "simulate_mujoco",
    "simulate_pinocchio",
]
