"""Impact motions of humanoid robots: planned by the impulse they deliver, checked in full dynamics.

Names are imported when they are first used, so that `import impactopt` and the command line start at once.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

# public names by the module that defines them, in the order of imports
_PUBLIC = {
    "errors": ("CacheWarning", "InputError", "NoCompilerWarning", "NotSolvedWarning"),
    "contact": ("ContactFriction",),
    "robots.actuators": ("Actuator",),
    "robots.attachments": ("SoftGrip",),
    "robots.gains": ("GainFactor", "scaled_gains"),
    "robots.presets": (
        "arm7",
        "g1",
        "load_robot",
        "planar_arm",
        "robot_names",
        "space_arm",
        "standin",
        "talos",
    ),
    "robots.rigid_body": ("RigidBody",),
    "robots.robot": ("Robot", "Sole", "Striker", "Tool"),
    "kinematics.operational_space": ("holding_torque", "striking_velocity"),
    "kinematics.stance": ("BothSoles", "FixedBase", "Free", "OneSole"),
    "collision": ("Effects", "JointFriction", "RigidImpact", "SDC", "VirtualMass", "effective_mass"),
    "collision.settings": ("coasting_reference",),
    "bodies.world": ("Ground", "Obstacle", "TargetBody"),
    "problem.problem": ("ImpactProblem",),
    "problem.scenario": ("Scenario", "SecondStriker"),
    "problem.phases": ("Phase", "StancePhase"),
    "solvers.program": ("Status",),
    "transcription.plan": ("Plan", "Trajectory"),
    "simulation.cases": ("posture_of_effective_mass",),
    "simulation.perturbation": ("Perturbation",),
    "simulation.reference": ("FullDynamics", "MujocoDynamics"),
    "simulation.robustness": ("PerturbationRanges", "Robustness", "draw_perturbations"),
    "planning.replanning": ("sensitivity_of",),
    "planning.strike": ("StrikeSolution",),
    "files.export": ("export",),
    "files.problem_file": ("load_problem", "problem_names", "write_problem"),
    "files.record": ("load_record",),
    "sweeps": ("sweep",),
    "sweeps.collisions": ("collide_many",),
    "identification": ("Identification", "ImpactLog", "LawFit", "identify", "read_log"),
    "report.animation": ("animate",),
    "report.pictures": ("plot",),
    "report.report": ("report_page",),
    "api": ("Solution", "drive_nail", "load_solution", "moved_solution", "optimize_strike", "solve"),
}
_EXPORTS = {name: module for module, names in _PUBLIC.items() for name in names}

# families: a module, and the class whose subclasses there are public
_FAMILIES = {
    "contact.laws": "ContactLaw",
    "contact.targets": "Target",
    "problem.objectives": "Objective",
    "problem.terms": "Term",
}


def _all_exports() -> dict[str, str]:
    """Public name -> module, those of the families too, which are imported for it."""
    found = dict(_EXPORTS)
    for module, base in _FAMILIES.items():
        family = importlib.import_module(f"impactopt.{module}")
        classes = {name: thing for name, thing in vars(family).items() if isinstance(thing, type)}
        own = {name for name, kind in classes.items() if issubclass(kind, vars(family)[base])}
        found |= dict.fromkeys(own, module)
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
