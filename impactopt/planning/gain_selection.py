"""Servo gains as variables of a plan: programs that choose gains, and the program of the robot with the
chosen ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from impactopt.arrays import Array
from impactopt.planning.budget import Budget, one_after_the_other
from impactopt.planning.refinement import Evaluation, Outcome, Program, carried, program_for
from impactopt.problem.problem import ImpactProblem
from impactopt.robots.gains import scaled_gains, with_room
from impactopt.robots.robot import Robot
from impactopt.solvers.program import SolverResult
from impactopt.transcription.contact_program import ContactProgram

_BARRIER = 1e-7  # first one of the program with fixed gains, whose initial guess is a solution
_AT_BOUND = 1e-3  # largest distance of a factor's logarithm from its bound's that counts as at it


@dataclass(frozen=True, kw_only=True)
class ChosenGains:
    """Servo gains that a plan has chosen for a `GainFactor`.

    joints : their names.  factor : of their stiffness; that of their damping is its square root.
    between : bounds (least, largest) of the factor.  stiffness [N m/rad], damping [N m s/rad] : by joint, as
    chosen.
    """

    joints: tuple[str, ...]
    factor: float
    between: tuple[float, float]
    stiffness: dict[str, float]
    damping: dict[str, float]

    @classmethod
    def from_summary(cls, summary: Mapping[str, Any]) -> ChosenGains:
        """Gains of which this is the `summary`."""
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


def with_room_for_gains(problem: ImpactProblem) -> ImpactProblem:
    """Problem whose robot has room for the stiffest gains that its program may choose (`gains.with_room`)."""
    if not problem.gains:
        return problem
    names, each = problem.robot.joint_names, zip(problem.gain_joints, problem.gains, strict=True)
    largest = {names[k]: gain.factor[1] for joints, gain in each for k in joints}
    return replace(problem, robot=with_room(problem.robot, largest))


def with_chosen(problem: ImpactProblem, factors: Sequence[float]) -> ImpactProblem:
    """Problem whose robot has gains with these factors (len(problem.gains),) in place of the open ones;
    itself if it has no open gains.
    """
    if not problem.gains:
        return problem
    names, each = problem.robot.joint_names, zip(factors, problem.gain_joints, strict=True)
    by_joint = {names[k]: float(factor) for factor, joints in each for k in joints}
    return replace(problem, robot=scaled_gains(problem.robot, by_joint), gains=())


def with_factors_of(t: ContactProgram, robot: Robot, start: SolverResult) -> SolverResult:
    """Initial guess of a program that chooses gains, from a solution of the same robot with other gains: with
    these as its choice, within their bounds.

    robot : of the solution.  start : the solution, mapped to the program.
    """
    own, logs = t.problem.robot, []
    for joints, gain in zip(t.problem.gain_joints, t.problem.gains, strict=True):
        # The joints of one factor may have other ratios in the solution's robot: the median stands for them.
        ratios = np.array([robot.kp[k] / own.kp[k] for k in joints if own.kp[k] > 0])
        factor = float(np.median(ratios)) if ratios.size and np.all(ratios > 0) else 1.0
        logs.append(np.log(np.clip(factor, *gain.factor)))
    # The room for stiffer gains changes the torque limits, by which torques are scaled.
    start = _with_rescaled_torques(t, robot, start)
    t.hit.contact.gains.write(start.x, logs)
    return start


def _with_rescaled_torques(t: ContactProgram, robot: Robot, start: SolverResult) -> SolverResult:
    """Initial guess with the torques of a solution for a robot with other torque limits, by which the torque
    variables are scaled.
    """
    x = start.x.copy()
    t.feedforward.write(x, t.feedforward.read(x) * robot.torque_limit / t.robot.torque_limit)
    return replace(start, x=t.with_lifted(x))


def chosen_gains(t: ContactProgram, x: Array) -> tuple[ChosenGains, ...]:
    """Gains that solver variables (n,) choose for the problem's open ones."""
    if not t.problem.gains:
        return ()
    # Variables are logarithms of factors: halving and doubling are alike, and a factor stays positive.
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


def with_gains_fixed(
    outcome: Outcome[Program], chosen: Sequence[ChosenGains], budget: Budget
) -> Outcome[Program]:
    """Outcome of the program of the robot with the chosen gains, fixed.

    At the best gains the motion is optimal for fixed gains, too. So this program is solved from there, which
    refines the solution, and all that follows, such as replays, sees a robot with its gains.
    """
    if not chosen:
        return outcome
    t, old = outcome.program, outcome.result
    factors = "; ".join(f"{', '.join(c.joints)} x {c.factor:.3g}" for c in chosen)
    budget.say(f"gains are chosen: {factors}; solving again with these fixed")
    new = program_for(t, with_chosen(t.problem, [c.factor for c in chosen]))
    # The robot with chosen gains may have other torque limits than the one with room for the stiffest.
    result = _with_rescaled_torques(new, t.robot, carried(new, t, old))
    # Without a solution, or time, the last iterate stays, on the robot with its gains.
    if old.status.usable and not budget.is_over():
        polished = budget.near_by().run(new.program, result, _BARRIER)
        if polished.status.usable:
            result = one_after_the_other(old, polished)
    return replace(outcome, at=Evaluation(new, result.x), result=result)
