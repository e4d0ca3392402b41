"""Impact motions of humanoid robots: planned by the impulse they deliver, checked in full dynamics.

Names are imported when they are first used, so that `import impactopt` and the command line start at once.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

# public name -> module that defines it
_EXPORTS = {
    "Actuator": "robots.actuators",
    "BothSoles": "kinematics.stance",
    "CacheWarning": "errors",
    "ContactFriction": "contact",
    "Perturbation": "simulation.perturbation",
    "FixedBase": "kinematics.stance",
    "Free": "kinematics.stance",
    "FullDynamics": "simulation.reference",
    "GainFactor": "robots.gains",
    "Ground": "bodies.world",
    "ImpactProblem": "problem.problem",
    "InputError": "errors",
    "JointFriction": "collision",
    "MujocoDynamics": "simulation.reference",
    "NoCompilerWarning": "errors",
    "NotSolvedWarning": "errors",
    "Obstacle": "bodies.world",
    "OneSole": "kinematics.stance",
    "Phase": "problem.problem",
    "Plan": "transcription.plan",
    "RigidBody": "robots.rigid_body",
    "RigidImpact": "collision",
    "Robot": "robots.robot",
    "Robustness": "simulation.robustness",
    "SDC": "collision",
    "Scenario": "problem.scenario",
    "SecondStriker": "problem.scenario",
    "Sole": "robots.robot",
    "Solution": "api",
    "PerturbationRanges": "simulation.robustness",
    "StancePhase": "problem.stances",
    "Status": "solvers.program",
    "StrikeSolution": "planning.strike",
    "SoftGrip": "robots.attachments",
    "Striker": "robots.robot",
    "TargetBody": "bodies.world",
    "Effects": "collision",
    "Tool": "robots.robot",
    "Trajectory": "transcription.plan",
    "VirtualMass": "collision",
    "animate": "report.animation",
    "arm7": "robots.presets",
    "coasting_reference": "collision.settings",
    "collide_many": "sweeps.collisions",
    "draw_perturbations": "simulation.robustness",
    "drive_nail": "api",
    "effective_mass": "collision",
    "export": "files.export",
    "g1": "robots.presets",
    "holding_torque": "kinematics.operational_space",
    "Identification": "identification",
    "ImpactLog": "identification",
    "LawFit": "identification",
    "identify": "identification",
    "load_problem": "files.problem_file",
    "load_record": "files.record",
    "load_robot": "robots.presets",
    "load_solution": "api",
    "moved_solution": "api",
    "optimize_strike": "api",
    "planar_arm": "robots.presets",
    "plot": "report.pictures",
    "posture_of_effective_mass": "simulation.cases",
    "problem_names": "files.problem_file",
    "read_log": "identification",
    "scaled_gains": "robots.gains",
    "report_page": "report.report",
    "robot_names": "robots.presets",
    "sensitivity_of": "planning.replanning",
    "solve": "api",
    "space_arm": "robots.presets",
    "standin": "robots.presets",
    "striking_velocity": "kinematics.operational_space",
    "sweep": "sweeps",
    "talos": "robots.presets",
    "write_problem": "files.problem_file",
}

# families of one class a file: the classes that their packages list
_FAMILIES = ("contact.laws", "contact.targets", "problem.objectives", "problem.terms")


def _all_exports() -> dict[str, str]:
    """Public name -> module, those of the families too, which are imported for it."""
    found = dict(_EXPORTS)
    for module in _FAMILIES:
        family = importlib.import_module(f"impactopt.{module}")
        found |= {name: module for name in family.__all__ if isinstance(getattr(family, name), type)}
    return found


def __getattr__(name: str) -> Any:
    if name == "__all__":
        return ["__version__", *sorted(_all_exports())]
    exports = _EXPORTS
    if name not in exports and name[:1].isupper():  # else it is a module of the package, or nothing
        exports = _all_exports()
    module = exports.get(name)
    if module is None:
        from impactopt.errors import did_you_mean

        raise AttributeError(f"module 'impactopt' has no attribute {name!r}{did_you_mean(name, exports)}")
    value = getattr(importlib.import_module(f"impactopt.{module}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_all_exports()})
