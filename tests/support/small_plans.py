"""Programs and plans of the small robots, for all tests that need one.

Their functions run in CasADi's virtual machine: building them for the small biped takes some ten seconds, and
compiling them would take longer.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.contact.laws import SpringDamper
from impactopt.contact.targets import FreeMass
from impactopt.kinematics.stance import FixedBase
from impactopt.kinematics.support import support_polygon
from impactopt.problem.problem import ImpactProblem, Phase
from impactopt.problem.terms import KeepOut, SelfCollision, Term
from impactopt.robots.robot import Robot
from impactopt.simulation import Scene, Simulation, scene_of, simulate_pinocchio
from impactopt.solvers.ipopt import solve_ipopt
from impactopt.solvers.program import SolverResult
from impactopt.transcription.blocks import BlockExpression, builders, extra_blocks, own_blocks, stance_blocks
from impactopt.transcription.initial_guess import first_iterate
from impactopt.transcription.plan import Plan, Trajectory
from impactopt.transcription.strike import StrikeTranscription
from impactopt.transcription.structured import derivative_functions
from impactopt.transcription.transcription import Transcription
from support.small_robots import arm, biped, striking_point

Array = NDArray[np.float64]
LAW = SpringDamper(stiffness=1e4, damping=300.0)
OPTIONS: dict[str, Any] = {"tol": 1e-4}  # of IPOPT, on the biped
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


def transcribed(problem: ImpactProblem) -> Transcription:
    """The problem's program; all blocks are built, those of every model of the collision."""
    c = problem.coordinates
    edges = len(support_polygon(problem.robot, c))
    found: dict[str, Callable[[], BlockExpression]] = {}
    if problem.frozen is not None:
        return Transcription(
            problem, c, _functions(found | own_blocks(problem, c, edges)) | _extra_functions(problem)
        )
    for instant in (False, True):
        given = c, problem.striker, problem.law, problem.target, edges
        found |= builders(*given, instant=instant, first=True, friction=problem.friction is not None)
    found |= {name: build for name, (_, build) in stance_blocks(problem).items()}
    return Transcription(problem, c, _functions(found) | _extra_functions(problem))


def struck(problem: ImpactProblem) -> StrikeTranscription:
    """The problem's strike; only the blocks of its own model of the collision are built."""
    c = problem.coordinates
    own = own_blocks(problem, c, len(support_polygon(problem.robot, c)))
    return StrikeTranscription(problem, c, _functions(own) | _extra_functions(problem))


def _functions(builders: Mapping[str, Callable[[], BlockExpression]]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for name, build in builders.items():
        block = build()
        out |= {f.name(): f for f in derivative_functions(name, block.z, block.p, block.out, block.through)}
    return out


def _extra_functions(problem: ImpactProblem) -> dict[str, Any]:
    return _functions({name: b.build for name, b in extra_blocks(problem, problem.coordinates).items()})


def changed(transcription: Transcription, **changes: Any) -> Transcription:
    """The program of the same problem with changes, on the same functions but for the extra ones."""
    problem = dataclasses.replace(transcription.problem, **changes)
    return Transcription(problem, problem.coordinates, transcription.functions | _extra_functions(problem))


@dataclasses.dataclass
class Planned:
    problem: ImpactProblem
    transcription: Transcription
    start: Array
    result: SolverResult
    plan: Plan
    trajectory: Trajectory
    simulation: Simulation


def planned(transcription: Transcription, options: dict[str, Any], scene: Scene | None = None) -> Planned:
    """Solved and simulated; ``scene``: if not the problem's."""
    problem = transcription.problem
    start = first_iterate(transcription)
    result = solve_ipopt(transcription.program, start, options=options)
    plan = transcription.decode(result.x)
    trajectory = plan.trajectory()
    simulation = simulate_pinocchio(problem.robot, trajectory, scene or scene_of(problem), settle=0.0)
    return Planned(problem, transcription, start, result, plan, trajectory, simulation)


def rod_hammer(problem: ImpactProblem) -> ImpactProblem:
    """The problem with a hammer that is a rod, without the bar across its end."""
    tools = tuple(dataclasses.replace(tool, bar=None) for tool in problem.robot.tools)
    return dataclasses.replace(problem, robot=dataclasses.replace(problem.robot, tools=tools))
