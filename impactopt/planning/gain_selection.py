"""Gains that a plan has chosen: from a program with them as variables to that of a robot that has them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.planning.budget import Budget, one_after_the_other
from impactopt.planning.refinement import Evaluation, Outcome, Program, carried, program_for
from impactopt.problem.problem import ImpactProblem
from impactopt.robots.gains import scaled_gains, with_room
from impactopt.robots.robot import Robot
from impactopt.solvers.program import SolverResult
from impactopt.transcription.contact_program import ContactProgram

__all__ = ["ChosenGains", "chosen_of", "roomy", "settled", "with_chosen", "with_factors_of"]

Array = NDArray[np.float64]
_BARRIER = 1e-7  # of the settled program, whose start is a solution
_AT_BOUND = 1e-3  # of a factor's logarithm


@dataclass(frozen=True, kw_only=True)
class ChosenGains:
    """Servo gains that a plan has chosen for a `GainFactor`.

    joints : their names.  factor : on their stiffness; its root is that on their damping.  between : (least,
    largest) that it might be.  stiffness [N m/rad], damping [N m s/rad] : by joint, as chosen.
    """

    joints: tuple[str, ...]
    factor: float
    between: tuple[float, float]
    stiffness: dict[str, float]
    damping: dict[str, float]

    @classmethod
    def told(cls, summary: Mapping[str, Any]) -> ChosenGains:
        """Reads the gains back from their `summary`."""
        least, largest = summary["between"]
        return cls(
            joints=tuple(summary["joints"]),
            factor=summary["factor"],
            between=(least, largest),
            stiffness=dict(summary["stiffness_N_m_rad"]),
            damping=dict(summary["damping_N_m_s_rad"]),
        )

    @property
    def at_bound(self) -> bool:
        """True if the factor is at one of its bounds, so that another bound would change it."""
        return bool(np.abs(np.log(np.array(self.between) / self.factor)).min() < _AT_BOUND)

    def summary(self) -> dict[str, Any]:
        """JSON form, as it stands in ``summary.json``."""
        return {
            "joints": list(self.joints),
            "factor": self.factor,
            "between": list(self.between),
            "at_bound": self.at_bound,
            "stiffness_N_m_rad": dict(self.stiffness),
            "damping_N_m_s_rad": dict(self.damping),
        }


def roomy(problem: ImpactProblem) -> ImpactProblem:
    """The same for a program that chooses gains: its robot's springs have room for the stiffest."""
    if not problem.gains:
        return problem
    names, each = problem.robot.joint_names, zip(problem.gain_joints, problem.gains, strict=True)
    largest = {names[k]: gain.factor[1] for joints, gain in each for k in joints}
    return replace(problem, robot=with_room(problem.robot, largest))


def with_chosen(problem: ImpactProblem, factors: Sequence[float]) -> ImpactProblem:
    """A problem whose robot has gains with these factors in place of those that it leaves open; itself if it
    leaves none.
    """
    if not problem.gains:
        return problem
    names, each = problem.robot.joint_names, zip(factors, problem.gain_joints, strict=True)
    by_joint = {names[k]: float(factor) for factor, joints in each for k in joints}
    return replace(problem, robot=scaled_gains(problem.robot, by_joint), gains=())


def with_factors_of(t: ContactProgram, robot: Robot, start: SolverResult) -> SolverResult:
    """A start of a program that chooses gains, with those of the robot that it is of, where bounds let it."""
    own, logs = t.problem.robot, []
    for joints, gain in zip(t.problem.gain_joints, t.problem.gains, strict=True):
        there = np.array([robot.kp[k] / own.kp[k] for k in joints if own.kp[k] > 0])
        factor = float(np.median(there)) if there.size and np.all(there > 0) else 1.0
        logs.append(np.log(np.clip(factor, *gain.factor)))
    start = _in_torques_of(t, robot, start)
    t.hit.contact.gains.write(start.x, logs)
    return start


def _in_torques_of(t: ContactProgram, robot: Robot, start: SolverResult) -> SolverResult:
    """A start of a program that is of the same robot but for torque limits, which its torques are over."""
    x = start.x.copy()
    t.feedforward.write(x, t.feedforward.read(x) * robot.torque_limit / t.robot.torque_limit)
    return replace(start, x=t.with_lifted(x))


def chosen_of(t: ContactProgram, x: Array) -> tuple[ChosenGains, ...]:
    """Gains that variables (n,) choose for what the problem leaves open."""
    if not t.problem.gains:
        return ()
    factors = np.exp(t.hit.contact.gains.read(x)[0])
    names, robot = t.robot.joint_names, with_chosen(t.problem, factors).robot
    return tuple(
        ChosenGains(
            joints=tuple(names[k] for k in joints),
            factor=float(factor),
            between=gain.factor,
            stiffness={names[k]: float(robot.kp[k]) for k in joints},
            damping={names[k]: float(robot.kd[k]) for k in joints},
        )
        for factor, joints, gain in zip(factors, t.problem.gain_joints, t.problem.gains, strict=True)
    )


def settled(outcome: Outcome[Program], chosen: Sequence[ChosenGains], budget: Budget) -> Outcome[Program]:
    """Outcome of the program of the robot with the gains that a solution has chosen.

    Where gains are best, the same motion is best for them as they are: it is solved once more from there, to
    be so to the last digit. What comes after, such as replays, knows of no choice.
    """
    if not chosen:
        return outcome
    t, old = outcome.program, outcome.result
    words = "; ".join(f"{', '.join(c.joints)} x {c.factor:.3g}" for c in chosen)
    budget.say(f"gains are chosen: {words}; on with these")
    new = program_for(t, with_chosen(t.problem, [c.factor for c in chosen]))
    result = _in_torques_of(new, t.robot, carried(new, t, old))
    if old.status.usable and budget.left != 0:
        polished = budget.near_by().run(new.program, result, _BARRIER)
        if polished.status.usable:
            result = one_after_the_other(old, polished)
    return replace(outcome, at=Evaluation(new, result.x), result=result)
