"""Programs and plans of the small robots, for all tests that need one."""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt import (
    FixedBase,
    FreeMass,
    ImpactProblem,
    KeepOut,
    Phase,
    Plan,
    Robot,
    SelfCollision,
    Solution,
    SpringDamper,
    Term,
    Trajectory,
)
from impactopt.simulation import Scene, Simulation, scene_of, simulate_pinocchio
from impactopt.solvers.ipm.interior_point import IPMOptions, solve_ipm
from impactopt.solvers.program import SolverResult
from impactopt.transcription.initial_guess import first_iterate
from impactopt.transcription.mesh import NO_MORE, MoreNodes
from impactopt.transcription.strike import StrikeTranscription
from impactopt.transcription.transcription import Transcription, block_functions
from support.small_robots import arm, biped, striking_point

Array = NDArray[np.float64]
LAW = SpringDamper(stiffness=1e4, damping=300.0)
EXACT = IPMOptions(complementarity_tolerance=1e-7)  # bounds that are active are so to a millionth
STEP = 5e-4  # [s] of simulations
# for tests of something else, where a robot's boxes are in the way or cost time
BODILESS: tuple[Term, ...] = (SelfCollision(enabled=False), KeepOut(enabled=False))


def biped_problem(robot: Robot | None = None) -> ImpactProblem:
    robot = robot or biped()
    return ImpactProblem(
        robot=robot,
        striker="fist",
        point=striking_point(robot, "half_sitting", "fist") + np.array([0.06, 0.03, 0.0]),
        normal=[1.0, 0.0, 0.0],
        law=LAW,
        target=FreeMass(mass=3.0),
        swing=Phase(duration=0.6, intervals=6),
        follow=Phase(duration=(0.5, 0.8), intervals=6),
        smoothness=1e-4,
        wrench_price=0.1,
        style="strongest",
    )


def arm_problem() -> ImpactProblem:
    robot = arm()
    return ImpactProblem(
        robot=robot,
        striker="hand",
        start="start",
        stance=FixedBase(),
        point=striking_point(robot, "start", "hand") + np.array([0.05, 0.05, 0.1]),
        normal=[0.0, 1.0, 0.0],
        law=LAW,
        target=FreeMass(mass=3.0),
        swing=Phase(duration=(0.4, 0.6), intervals=8),
        follow=Phase(duration=0.8, intervals=8),
        style="strongest",
    )


def transcribed(problem: ImpactProblem, nodes: MoreNodes = NO_MORE) -> Transcription:
    return Transcription(problem, block_functions(problem), nodes)


def struck(problem: ImpactProblem) -> StrikeTranscription:
    """The problem's strike."""
    return StrikeTranscription(problem, block_functions(problem))


def changed(transcription: Transcription, **changes: Any) -> Transcription:
    """The program of the same problem with changes."""
    return transcribed(dataclasses.replace(transcription.problem, **changes))


@dataclasses.dataclass
class Planned:
    problem: ImpactProblem
    transcription: Transcription
    start: Array
    result: SolverResult
    plan: Plan
    trajectory: Trajectory
    scene: Scene

    @cached_property
    def simulation(self) -> Simulation:
        """Computed for those who look at it: it takes longer than the solve."""
        return simulate_pinocchio(self.problem.robot, self.trajectory, self.scene, step=STEP, settle=0.0)


def planned(transcription: Transcription, scene: Scene | None = None) -> Planned:
    """Solved, to be simulated; ``scene``: if not the problem's."""
    problem = transcription.problem
    start = first_iterate(transcription)
    result = solve_ipm(transcription.program, start, options=EXACT)
    plan = transcription.decode(result.x)
    scene = scene or scene_of(problem)
    return Planned(problem, transcription, start, result, plan, plan.trajectory(), scene)


def solution_of(planned: Planned) -> Solution:
    """The plan as users get it."""
    return Solution(
        problem=planned.problem,
        plan=planned.plan,
        result=planned.result,
        solver="ipm",
        build_seconds=0.0,
        solve_seconds=0.0,
        violations=(),
    )


def rod_hammer(problem: ImpactProblem) -> ImpactProblem:
    """The problem with a hammer that is a rod, without the bar across its end."""
    tools = tuple(dataclasses.replace(tool, bar=None) for tool in problem.robot.tools)
    return dataclasses.replace(problem, robot=dataclasses.replace(problem.robot, tools=tools))
