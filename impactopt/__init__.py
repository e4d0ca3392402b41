"""Impact motions of humanoid robots: planned by the impulse they deliver, checked in full dynamics.

Names are imported when they are first used, so that `import impactopt` and the command line start at once.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

# public name -> module that defines it
_EXPORTS = {
    "AngularMomentum": "problem.objectives",
    "Balance": "problem.terms",
    "Board": "contact.targets",
    "BothSoles": "kinematics.stance",
    "CacheWarning": "errors",
    "Conditions": "simulation.conditions",
    "ContactLaw": "contact.laws",
    "ContactWrenchCone": "problem.terms",
    "CustomLaw": "contact.laws",
    "Effort": "problem.objectives",
    "FixedBase": "kinematics.stance",
    "FreeMass": "contact.targets",
    "FullDynamics": "simulation.reference",
    "Gaze": "problem.terms",
    "HandOrientation": "problem.terms",
    "HertzDamped": "contact.laws",
    "HitCone": "problem.terms",
    "HitRegion": "problem.terms",
    "HuntCrossley": "contact.laws",
    "ImpactProblem": "problem.problem",
    "Impulse": "problem.objectives",
    "Incidence": "problem.terms",
    "InputError": "errors",
    "JointFriction": "collision",
    "KeepOut": "problem.terms",
    "KelvinVoigt": "contact.laws",
    "LegExtension": "problem.terms",
    "MujocoDynamics": "simulation.reference",
    "Nail": "contact.targets",
    "NoCompilerWarning": "errors",
    "Objective": "problem.objectives",
    "Obstacle": "bodies.shapes",
    "OneSole": "kinematics.stance",
    "PeakForce": "problem.objectives",
    "Penetration": "problem.objectives",
    "Phase": "problem.problem",
    "Plan": "transcription.plan",
    "PositionLimit": "problem.terms",
    "RigidBody": "rigid_body",
    "RigidWall": "contact.targets",
    "Robot": "robots.robot",
    "Robustness": "simulation.robustness",
    "SDC": "collision",
    "Scenario": "problem.scenario",
    "SelfCollision": "problem.terms",
    "Sole": "robots.robot",
    "Solution": "planning.solution",
    "Spread": "simulation.robustness",
    "SpringDamper": "contact.laws",
    "Status": "solvers.program",
    "StrikeSolution": "planning.strike",
    "Striker": "robots.robot",
    "Target": "contact.targets",
    "TargetBody": "bodies.shapes",
    "TargetEnergy": "problem.objectives",
    "Term": "problem.terms",
    "Terms": "collision",
    "Tool": "robots.robot",
    "TorqueLimit": "problem.terms",
    "TorqueRate": "problem.terms",
    "Trajectory": "transcription.plan",
    "VelocityLimit": "problem.terms",
    "VirtualMass": "collision",
    "animate": "report",
    "arm7": "robots.presets",
    "coasting_reference": "simulation.reference.coasting",
    "collide_many": "sweeps.collisions",
    "draw_conditions": "simulation.robustness",
    "drive_nail": "planning.nail_driving",
    "effective_mass": "collision",
    "g1": "robots.presets",
    "holding_torque": "simulation.reference.holding",
    "load_problem": "files.problem_file",
    "load_record": "files.output",
    "load_robot": "robots.presets",
    "optimize_strike": "planning.strike",
    "planar_arm": "robots.presets",
    "plot": "pictures",
    "posture_of_effective_mass": "simulation.cases",
    "problem_names": "files.problem_file",
    "report_page": "report",
    "robot_names": "robots.presets",
    "solve": "planning.planner",
    "standin": "robots.presets",
    "striking_velocity": "simulation.cases",
    "sweep": "sweeps",
    "talos": "robots.presets",
    "write_problem": "files.problem_file",
}

__all__ = ["__version__", *sorted(_EXPORTS)]


def __getattr__(name: str) -> Any:
    module = _EXPORTS.get(name)
    if module is None:
        from impactopt.errors import did_you_mean

        raise AttributeError(f"module 'impactopt' has no attribute {name!r}{did_you_mean(name, _EXPORTS)}")
    value = getattr(importlib.import_module(f"impactopt.{module}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_EXPORTS})
