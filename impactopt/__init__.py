"""Impact motions of humanoid robots: planned by the impulse they deliver, checked in full dynamics.

Names are imported when they are first used, so that `import impactopt` and the command line start at once.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

# public name -> module that defines it
_EXPORTS = {
    "AngularMomentum": "objectives",
    "Balance": "terms",
    "Board": "contact.board",
    "BothSoles": "stance",
    "CacheWarning": "errors",
    "Conditions": "validation.conditions",
    "ContactLaw": "contact.laws",
    "ContactWrenchCone": "terms",
    "CustomLaw": "contact.custom",
    "Effort": "objectives",
    "FixedBase": "stance",
    "FreeMass": "contact.targets",
    "FullDynamics": "reference",
    "Gaze": "extra_terms",
    "HandOrientation": "extra_terms",
    "HertzDamped": "contact.nonlinear",
    "HitCone": "extra_terms",
    "HitRegion": "extra_terms",
    "HuntCrossley": "contact.nonlinear",
    "ImpactProblem": "problem",
    "Impulse": "objectives",
    "Incidence": "terms",
    "InputError": "errors",
    "JointFriction": "collision",
    "KeepOut": "terms",
    "KelvinVoigt": "contact.laws",
    "LegExtension": "terms",
    "MujocoDynamics": "reference",
    "Nail": "contact.nail",
    "NoCompilerWarning": "errors",
    "Objective": "objectives",
    "Obstacle": "shapes",
    "OneSole": "stance",
    "PeakForce": "objectives",
    "Penetration": "objectives",
    "Phase": "problem",
    "Plan": "plan",
    "PositionLimit": "terms",
    "RigidBody": "rigid_body",
    "RigidWall": "contact.targets",
    "Robot": "robot",
    "Robustness": "robustness",
    "SDC": "collision",
    "Scenario": "scenario",
    "SelfCollision": "terms",
    "Sole": "robot",
    "Solution": "solution",
    "Spread": "robustness",
    "SpringDamper": "contact.laws",
    "Status": "program",
    "StrikeSolution": "strike",
    "Striker": "robot",
    "Target": "contact.targets",
    "TargetBody": "shapes",
    "TargetEnergy": "objectives",
    "Term": "terms",
    "Terms": "collision",
    "Tool": "robot",
    "TorqueLimit": "terms",
    "TorqueRate": "extra_terms",
    "Trajectory": "plan",
    "VelocityLimit": "terms",
    "VirtualMass": "collision",
    "animate": "report",
    "arm7": "presets",
    "coasting_reference": "reference.coasting",
    "collide_many": "sweeps.collisions",
    "draw_conditions": "robustness",
    "drive_nail": "blows",
    "effective_mass": "collision",
    "g1": "presets",
    "holding_torque": "reference.holding",
    "load_problem": "problem_file",
    "load_record": "output",
    "load_robot": "presets",
    "optimize_strike": "strike",
    "planar_arm": "presets",
    "plot": "plotting",
    "posture_of_effective_mass": "cases",
    "problem_names": "problem_file",
    "report_page": "report",
    "robot_names": "presets",
    "solve": "planner",
    "standin": "presets",
    "striking_velocity": "cases",
    "sweep": "sweeps",
    "talos": "presets",
    "write_problem": "problem_file",
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
