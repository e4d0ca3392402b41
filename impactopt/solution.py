"""What a solve gives back, and the record that it leaves on disk."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt import __version__
from impactopt.plan import Plan, Trajectory
from impactopt.problem import ImpactProblem
from impactopt.program import SolverResult, Status, Violation

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Solution:
    """A solved (or stopped) impact problem.

    plan : the motion; for a status that is not usable, that of the best iterate.
    result : the solver's own record, its history included.
    build_seconds : compiling or loading functions and assembling the program; solve_seconds : the solver.
    violations : what is not met, worst first.
    objectives : what each of the problem's objectives comes to, by name, in its own unit.
    """

    problem: ImpactProblem
    plan: Plan
    result: SolverResult
    solver: str
    build_seconds: float
    solve_seconds: float
    violations: tuple[Violation, ...]
    objectives: Mapping[str, float] = field(default_factory=dict)

    @property
    def status(self) -> Status:
        return self.result.status

    @property
    def impulse(self) -> float:
        """Planned impulse to the target [N s]."""
        return self.plan.impulse

    @cached_property
    def trajectory(self) -> Trajectory:
        """The servo's reference, sampled."""
        return self.plan.trajectory()

    @cached_property
    def missed_trajectory(self) -> Trajectory:
        """The servo's reference if nothing is hit; InputError if the plan has no brake."""
        return self.plan.trajectory(missed=True)

    def validate(self, *, engine: str = "pinocchio", **options: Any) -> Any:
        """Re-simulate the plan in full dynamics; a :class:`impactopt.validation.Simulation`.

        engine : "pinocchio" holds the soles to the ground; "mujoco" holds nothing, the robot can fall (extra
        ``validate``).  options : of the engine, such as ``step`` [s].

        Raises
        ------
        InputError : an unknown engine or option; a contact law or target that the engines do not have.
        """
        from impactopt.validation import simulate

        if engine == "mujoco" and self.plan.brake is not None:
            options.setdefault("missed", self.missed_trajectory)
        return simulate(self.problem, self.trajectory, engine=engine, **options)

    def outcome(self) -> dict[str, Any]:
        """How the solve ended: what ``summary.json`` says even of a plan whose motion cannot be completed."""
        return {
            "status": self.status.value,
            "message": self.result.message,
            "solver": self.solver,
            "iterations": self.result.iterations,
            "solve_seconds": self.solve_seconds,
            "build_seconds": self.build_seconds,
            "max_violation": self.result.max_violation,
            "violations": [{"row": v.what, "by": v.by, "amount": v.amount} for v in self.violations],
            "problem": self.problem.describe(),
        }

    def summary(self, simulation: Any | None = None, replay: Any | None = None) -> dict[str, Any]:
        """The numbers of ``summary.json``; ``simulated``, and ``replayed`` on free soles, if given."""
        plan = self.plan
        out: dict[str, Any] = {
            **self.outcome(),
            "impulse_Ns": plan.impulse,
            "objectives": dict(self.objectives),
            "target": plan.collision.outcome,
            # a plan of an impact without duration knows no force
            "peak_force_N": float(plan.collision.force.max()) if len(plan.collision.ground) else None,
            "contact_ms": 1e3 * (plan.compression + plan.restitution),
            "hand_speed_m_s": plan.hand_speed,
            "duration_s": plan.duration,
            **plan.margins(self.trajectory),
            "versions": versions(),
        }
        known: dict[str, Any] = {
            "torque_limit": self.problem.robot.torque_limit,
            "polygon": plan.polygon,
            "planned_impulse": plan.impulse,
        }
        if plan.scenarios:
            limits = {name: known[name] for name in ("torque_limit", "polygon")}
            out["scenarios"] = [scenario.summary(**limits) for scenario in plan.scenarios]
        if simulation is not None:
            out["simulated"] = simulation.summary(**known)
        if replay is not None:
            out["replayed"] = replay.report(**known)
        return out


def versions() -> dict[str, str]:
    """Versions of what made the numbers."""
    names = ("casadi", "pin", "numpy", "scipy", "osqp")
    return {"impactopt": __version__, "python": platform.python_version(), **{n: version(n) for n in names}}
