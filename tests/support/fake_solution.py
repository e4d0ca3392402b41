"""A solution that no solver was needed for: a small biped that stands still, and a made-up collision."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.integrate import cumulative_trapezoid

from impactopt import FreeMass, ImpactProblem, Impulse, Phase, Plan, Robot, Solution, SpringDamper, Status
from impactopt.files.record import Record
from impactopt.kinematics.operational_space import static_wrenches
from impactopt.kinematics.splines import CubicSpline
from impactopt.planning.refinement import Attempt
from impactopt.simulation import Simulation
from impactopt.solvers.program import IterationRecord, SolverResult, Violation
from impactopt.transcription.plan import PlannedCollision
from support.small_robots import biped

# a problem file, for tests whose solver is made up
PROBLEM_FILE = """\
[problem]
name = "stand still"
robot = "talos"
striker = "right_hand"
point_m = [0.6, -0.25, 1.1]
normal = [1.0, 0.0, 0.0]
[target]
mass_kg = 5.0
[contact]
stiffness_N_m = 1e4
damping_N_s_m = 300.0
"""
MASS, IMPULSE = 5.0, 10.0


def still_problem(**changes: Any) -> ImpactProblem:
    """The biped, and a target where its fist is."""
    robot = biped()
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.posture("half_sitting"))
    fist = np.array(data.oMf[robot.model.getFrameId("striker:fist")].translation)
    given: dict[str, Any] = {
        "robot": robot,
        "striker": "fist",
        "point": fist,
        "normal": [1.0, 0.0, 0.0],
        "law": SpringDamper(stiffness=1e4, damping=300.0),
        "target": FreeMass(mass=MASS),
        "swing": Phase(duration=0.1),
        "follow": Phase(duration=0.1),
        "name": "stand [still]",
    }
    return ImpactProblem(**{**given, **changes})


def still_plan(problem: ImpactProblem) -> Plan:
    """Stands still; the collision's numbers are made up."""
    c = problem.coordinates
    y, legs = c.split(problem.start_posture)
    wrench = static_wrenches(c, y, legs)
    breaks = np.linspace(0.0, 1.0, 7)

    def spline(duration: float) -> CubicSpline:
        return CubicSpline(control=np.tile(y, (len(breaks) + 2, 1)), breaks=breaks, duration=duration)

    time = np.array([0.0, 0.01, 0.02, 0.03, 0.04])
    ground = np.array([10.0, 0.0, 400.0, 0.0, -8.0, 0.0])
    collision = PlannedCollision(
        time=time,
        force=np.array([700.0, 400.0, 300.0, 150.0, 0.0]),
        target_speed=IMPULSE / MASS * time / time[-1],
        outcome={"speed_m_s": IMPULSE / MASS},
        target_state=np.array([IMPULSE / MASS]),
        torque=np.outer(np.linspace(0.1, 0.8, 5), problem.robot.torque_limit),
        ground=np.tile(ground, (4, 1)),
        sole_wrench=np.tile(wrench, (4, 1)),
    )
    return Plan(
        problem=problem,
        swing=spline(problem.swing.duration[0]),
        follow=spline(problem.follow.duration[0]),
        compression=0.02,
        restitution=0.02,
        swing_nodes=breaks,
        swing_wrench=np.tile(wrench, (7, 1)),
        follow_nodes=breaks,
        follow_wrench=np.tile(wrench, (7, 1)),
        collision=collision,
        hand_speed=2.5,
        impulse=IMPULSE,
    )


def simulation_of(solution: Solution, *, touches: bool = True, peak: float = 0.9) -> Simulation:
    """A replay that follows the plan exactly, with a torque demand of `peak` of the limit in contact."""
    plan, reference = solution.plan, solution.trajectory
    time, first = np.unique(reference.time, return_index=True)
    start, end = (plan.contact_start, plan.contact_end) if touches else (np.nan, np.nan)
    contact = (time >= start) & (time < end)
    fraction = np.clip((time - plan.contact_start) / (plan.contact_end - plan.contact_start), 0.0, 1.0)
    limit = solution.problem.robot.torque_limit
    demand = reference.torque[first].copy()
    demand[contact] = peak * limit
    return Simulation(
        engine="made up",
        time=time,
        q=reference.q[first],
        v=reference.v[first],
        force=np.where(contact, 700.0 * (1 - fraction), 0.0),
        target_speed=1.01 * IMPULSE / MASS * fraction,
        hand_speed=np.full(len(time), 2.5),
        target_travel=cumulative_trapezoid(1.01 * IMPULSE / MASS * fraction, time, initial=0.0),
        demand=demand,
        torque=demand,
        sole_ground=np.repeat(reference.ground[first][:, None] / 2, 2, axis=1),
        soles=("left", "right"),
        cop_margin=np.full((len(time), 2), 0.05),
        slip=np.zeros((len(time), 2)),
        lift=np.zeros((len(time), 2)),
        contact_start=start,
        contact_end=end,
        contact_time=np.array([start, start, end] if touches else []),
        contact_force=np.array([0.0, 700.0, 0.0] if touches else []),
        impulse=1.01 * IMPULSE if touches else 0.0,
        peak_force=700.0 if touches else 0.0,
        outcome={"speed_m_s": 1.01 * IMPULSE / MASS if touches else 0.0},
        saturated=0.0,
        posture_error=0.0,
        fall=None,
    )


class FakeSolution(Solution):
    """`validate` gives the made-up replay, `clearance` a made-up distance."""

    def clearance(self) -> dict[str, Any]:
        return {"clearance_mm": 50.0, "nearest": "fist and thigh", "contacts_besides": []}

    def validate(self, *, engine: str = "pinocchio", **options: Any) -> Simulation:
        made = simulation_of(self)
        return replace(made, engine=engine, fall=None if engine == "pinocchio" else "")


class MissingSolution(FakeSolution):
    """A plan that misses the target when it is replayed."""

    def validate(self, **options: Any) -> Simulation:
        return simulation_of(self, touches=False)


def still_solution(
    *,
    problem: ImpactProblem | None = None,
    status: Status = Status.SOLVED,
    violations: tuple[Violation, ...] = (),
    kind: type[Solution] = FakeSolution,
    solver: str = "ipopt",
    attempts: tuple[Attempt, ...] = (),
) -> Solution:
    problem = still_problem() if problem is None else problem
    worst = violations[0].amount if violations else 1e-9
    history = tuple(
        IterationRecord(
            iteration=i, objective=-float(i), max_violation=1.0, kkt=np.nan, step=0.1, seconds=0.1 * i
        )
        for i in range(3)
    )
    result = SolverResult(
        x=np.arange(4.0),
        multipliers=np.zeros(3),
        bound_multipliers=np.zeros(4),
        objective=-IMPULSE,
        status=status,
        iterations=2,
        seconds=0.3,
        seconds_functions=0.1,
        seconds_qp=0.0,
        max_violation=worst,
        kkt=1e-9,
        message=status.message,
        history=history,
    )
    return kind(
        problem=problem,
        plan=still_plan(problem),
        result=result,
        solver=solver,
        build_seconds=0.2,
        solve_seconds=0.3,
        violations=violations,
        objectives={o.name: IMPULSE for o in problem.objectives if isinstance(o, Impulse)},
        attempts=attempts,
    )


def strike_record(robot: Robot, q: Any, v: Any, torque: Any, **given: Any) -> Record:
    """What is kept of a strike that hits with these, with all that a record has to have."""
    arrays = {
        "joints": np.array(robot.joint_names),
        "torque_limit": robot.torque_limit,
        "velocity_limit": robot.velocity_limit,
        "polygon": np.zeros((0, 2)),
        "strike_posture": q,
        "strike_velocity": v,
        "strike_torque": torque,
    }
    summary: dict[str, Any] = dict.fromkeys(("status", "message", "solver"), "")
    summary |= {"violations": [], "starts": [], "iterations": 0, "problem": {}}
    summary |= dict.fromkeys(("solve_seconds", "build_seconds", "max_violation"))
    return Record(summary=summary, arrays=arrays, **given)
