"""Contacts from soft to steel on steel: what is planned is replayed, and what is not has a reason."""

import dataclasses

import numpy as np
import pytest
from support.causes import searched

from impactopt import (
    Board,
    FreeMass,
    FullDynamics,
    GearLoad,
    ImpactProblem,
    Impulse,
    KelvinVoigt,
    Nail,
    NotSolvedWarning,
    PeakForce,
    Solution,
    SpringDamper,
    Status,
    load_problem,
    optimize_strike,
    solve,
)
from impactopt.planning.budget import VIOLATED, Budget
from impactopt.planning.contact_replay import SOLVED_WITHIN, PlannedContact, checked
from impactopt.planning.diagnosis import ipopt_retry, with_reason
from impactopt.solvers.program import SolverResult
from impactopt.transcription.collision import Collision
from impactopt.transcription.contact_guess import effective_mass, fastest_at_contact, parting
from impactopt.transcription.contact_refinement import TOLERANCE_PCT
from impactopt.transcription.contact_state import shortest_phases
from impactopt.transcription.initial_guess import strike_iterate
from impactopt.transcription.strike import StrikeTranscription
from impactopt.transcription.transcription import block_functions

NAIL = Nail(mass=0.05, resistance=600.0, hardening=1e4)
PUSH = (Impulse(),)
BOARD = Board(mass=0.1, stiffness=1e5, breaking_force=700.0, damping=20.0)


def with_stiffness(name: str, stiffness: float, *, ratio: bool = True) -> ImpactProblem:
    """A problem with another contact stiffness [N/m]; its damping ratio stays, or else its damping. Its gears
    bear what they have to: steel that damps more makes a larger force at once.
    """
    problem = load_problem(name)
    k, d = problem.law.parameters["stiffness"], problem.law.parameters["damping"]
    law = KelvinVoigt(stiffness=stiffness, damping=d * np.sqrt(stiffness / k) if ratio else d)
    return dataclasses.replace(problem, law=law, terms=(*problem.terms, GearLoad(enabled=False)))


def contact_of(problem: ImpactProblem) -> StrikeTranscription:
    """The program of its strike."""
    functions = block_functions(problem)
    return StrikeTranscription(problem, functions)


def diagnosed(problem: ImpactProblem) -> SolverResult:
    """A short solve's result, with the reason that the problem is infeasible."""
    t, result, found = searched(problem)
    return with_reason(t, result, found.causes)


# ---- plans


@pytest.mark.slow
@pytest.mark.parametrize(("stiffness", "ratio"), [(1e6, False), (1e7, True), (1e8, True), (1e8, False)])
def test_a_stiff_contact_is_planned_as_it_is_replayed(stiffness: float, ratio: bool) -> None:
    """However stiff hammer and nail are, momentum and wood decide: the blow stays about as hard."""
    solution = solve(with_stiffness("arm_planar", stiffness, ratio=ratio))
    assert solution.status is Status.SOLVED
    assert solution.impulse == pytest.approx(3.9, rel=0.06)
    assert abs(solution.contact_error_pct or 0.0) < TOLERANCE_PCT
    replay = solution.validate()
    assert replay.impulse == pytest.approx(solution.impulse, rel=2e-3)
    followed = solution.contact_replay
    assert followed is not None
    if not followed.partings:
        assert replay.peak_force == pytest.approx(solution.plan.collision.force.max(), rel=0.1)
        assert "caution" not in solution.summary()
    else:
        assert replay.peak_force == pytest.approx(followed.peak, rel=0.02)
        assert solution.summary()["caution"] == str(followed)


@pytest.mark.slow
def test_a_contact_too_soft_for_its_nail_is_named() -> None:
    """`hit point, 48 mm away` alone would not say so; nor would a time of 15 ms a phase, which is not all."""
    problem = with_stiffness("arm_planar", 1e4, ratio=False)
    for contact_duration in ((0.0, 0.015), problem.contact_duration):
        with pytest.warns(NotSolvedWarning, match="a soft contact"):
            solution = solve(dataclasses.replace(problem, contact_duration=contact_duration))
        assert solution.status is Status.INFEASIBLE
        assert solution.result.message.startswith(
            "Infeasible: a soft contact. stiffness of the contact: 1e+05 N/m"
        )
        assert "Constraints that cannot be met: " in solution.result.message
    assert "takes 33 ms" not in solution.result.message  # 0.2 s are enough for that


@pytest.mark.slow
def test_a_time_far_too_short_for_its_contact_is_named() -> None:
    """Shorter than the least that a phase is given where no shortest time is asked for."""
    result = diagnosed(dataclasses.replace(load_problem("arm_planar"), contact_duration=(0.0, 5e-5)))
    assert result.status is Status.INFEASIBLE
    assert result.message.startswith("Infeasible: time. each phase of contact: ")
    assert "instead of 5e-05 s ([collision] duration_s)" in result.message


@pytest.mark.slow
def test_a_board_that_takes_more_than_one_contact_is_named() -> None:
    """The hammer is off again long before the board breaks; the frozen model ends there."""
    once = dataclasses.replace(with_stiffness("chop_arm", 1e7, ratio=False), collision="sdc")
    result = diagnosed(once)
    assert result.status is Status.INFEASIBLE
    assert result.message.startswith("Infeasible: a stiff contact. stiffness of the contact: ")
    assert "one contact is not enough" in result.message
    assert "'break'" in result.message
    assert "contact stiffness of 1e+05 would do" in result.message


def test_a_strike_tells_it_too() -> None:
    strike = optimize_strike(with_stiffness("arm_planar", 1e8, ratio=False))
    assert strike.status is Status.SOLVED
    followed = strike.contact_replay
    assert followed is not None
    assert followed.partings > 5
    assert followed.peak > 2 * strike.strike.collision.force.max()
    assert abs(followed.impulse_pct) < SOLVED_WITHIN  # hammer and nail end at rest in the wood in either case
    assert strike.summary()["caution"] == str(followed)


# ---- what is told


def test_a_damped_nail_does_not_rattle(hammered: Solution) -> None:
    """Under a contact that is damped enough."""
    followed = hammered.contact_replay
    assert followed is not None
    assert followed.partings == 0
    assert len(followed.events) == 2  # it starts, and it stops
    assert not hammered.caution


@pytest.mark.slow
def test_a_stiff_nail_rattles_with_the_force_of_the_first_impact(hammered: Solution) -> None:
    """Without damping: the spring takes the energy of the approach, v sqrt(k mu), and what wood holds."""
    p, plan = hammered.problem, hammered.plan
    weak = Nail(mass=0.05, resistance=60.0)
    bare = dataclasses.replace(p, law=KelvinVoigt(stiffness=1e8, damping=0.0), target=weak)
    followed = PlannedContact(problem=bare, planned=plan).replay
    assert followed is not None
    k = int(np.flatnonzero(hammered.trajectory.phase == 0)[-1])
    c, (y, legs) = p.coordinates, p.coordinates.split(hammered.trajectory.q[k])
    mass, speed = effective_mass(c, p.strikers, p.normal, y, legs, hammered.trajectory.v[k])
    reduced = 1 / (1 / mass + 1 / weak.mass)
    held = weak.resistance * reduced / weak.mass
    assert followed.peak == pytest.approx(held + np.sqrt(held**2 + speed**2 * 1e8 * reduced), rel=5e-3)
    assert followed.partings >= 1


# ---- events that come first


def soft_board(breaking: float) -> ImpactProblem:
    """It swings on its own while a soft contact pushes it: its first peak may break it, or a later one."""
    return dataclasses.replace(
        load_problem("arm7"),
        target=Board(mass=0.3, stiffness=5e4, breaking_force=breaking),
        law=SpringDamper(stiffness=1e4, damping=20.0),
        objectives=PUSH,
        contact_duration=(0.0, 0.1),
    )


def collided(solution: Solution) -> float:
    """Impulse [N s] of the same blow by the reference, a Runge-Kutta method with events of its own."""
    p, ref = solution.problem, solution.trajectory
    k = int(np.flatnonzero(ref.phase == 0)[-1])
    model = FullDynamics(
        robot=p.robot,
        striker=p.striker,
        normal=p.normal,
        law=p.law,
        target=p.target,
        stance=p.stance,
        horizon=0.2,
    )
    found = model.collide(ref.q[k], ref.v[k], solution.plan.collision.torque[0])
    return float(found.impulse)


@pytest.fixture(scope="module")
def broken() -> Solution:
    return solve(soft_board(250.0))


@pytest.mark.slow
def test_a_board_breaks_when_it_is_planned_to(broken: Solution) -> None:
    assert broken.status is Status.SOLVED
    assert collided(broken) == pytest.approx(broken.impulse, rel=2e-3)
    followed = broken.contact_replay
    assert followed is not None
    assert followed.impulse == pytest.approx(broken.impulse, rel=2e-3)
    assert followed.outcome == {"broken": 1.0}


@pytest.mark.parametrize("strength", [0.98, 1.01])
def test_a_board_that_is_a_little_weaker_or_stronger_breaks_too(broken: Solution, strength: float) -> None:
    """In the same swing: no earlier one is near the breaking force, and this one is not just at it."""
    problem = soft_board(strength * 250.0)
    followed = PlannedContact(problem=problem, planned=broken.plan).replay
    assert followed is not None
    assert followed.outcome == {"broken": 1.0}
    assert abs(followed.impulse_pct) < 8.0


def test_a_plan_whose_board_breaks_earlier_is_none(broken: Solution) -> None:
    """By a tenth of its impulse or more: an own integration says so too."""
    problem = soft_board(100.0)
    followed = PlannedContact(problem=problem, planned=broken.plan).replay
    assert followed is not None
    assert followed.impulse == pytest.approx(collided(dataclasses.replace(broken, problem=problem)), rel=2e-3)
    assert followed.impulse_pct > 10.0
    result = checked(broken.result, followed)
    assert result.status is Status.FAILED
    assert "break at" in result.message
    assert result.max_violation > VIOLATED


@pytest.mark.parametrize(
    ("too_large", "known", "status"),
    [
        (0.28, 28.0, Status.SOLVED),  # as its model's error says
        (0.02, 28.0, Status.SOLVED),  # more accurate than its model: it was refused for 26 %
        (-0.03, 28.0, Status.ACCEPTABLE),
        (-0.03, -2.5, Status.SOLVED),
        (0.34, 28.0, Status.FAILED),
        (0.0, 0.0, Status.SOLVED),
        (-0.03, 0.0, Status.ACCEPTABLE),
    ],
)
def test_a_plan_is_not_refused_for_being_more_accurate_than_its_model(
    broken: Solution, too_large: float, known: float, status: Status
) -> None:
    assert broken.contact_replay is not None
    replay = dataclasses.replace(broken.contact_replay, planned=1.0 + too_large, impulse=1.0, known=known)
    result = checked(broken.result, replay)
    assert result.status is status
    if status is not Status.SOLVED:
        assert f"is off by {100 * abs(too_large):.2g} %" in result.message


def test_forces_that_are_asked_for_never_pull() -> None:
    """An objective on the largest force makes no use of a contact that holds."""
    problem = with_stiffness("arm_planar", 1e7)
    held = contact_of(problem).expected
    asked = contact_of(dataclasses.replace(problem, objectives=(PeakForce(),)))
    assert isinstance(held, Collision)
    assert isinstance(asked.expected, Collision)
    assert held.holds
    assert not asked.expected.holds
    force = asked.expected.f
    assert (asked.layout.lower[force.offset : force.offset + force.count] == 0).all()


# ---- how short


def test_a_shortest_duration_is_kept_and_none_follows_the_contact() -> None:
    """As sqrt(1/k), where it is short; where it is long, 2 ms as ever."""
    given = dataclasses.replace(with_stiffness("arm_planar", 1e8), contact_duration=(5e-4, 0.015))
    assert shortest_phases(given, 1e-4)[-1] == 5e-4
    free = [contact_of(with_stiffness("arm_planar", k)).expected for k in (1e6, 1e8)]
    stiff = [hit.shortest[-1] for hit in free if isinstance(hit, Collision)]
    assert stiff[0] / stiff[1] == pytest.approx(10.0, rel=0.1)
    soft = dataclasses.replace(given, contact_duration=(0.0, 0.2))
    assert shortest_phases(soft, 1.0)[-1] == 2e-3


# ---- verdicts


def test_a_board_parts_early_only_where_contact_is_stiff() -> None:
    assert parting(KelvinVoigt(stiffness=1e5, damping=50.0), BOARD, 0.9, 8.0) is None
    found = parting(KelvinVoigt(stiffness=1e7, damping=50.0), BOARD, 0.9, 8.0)
    assert found is not None
    assert found.event == "break"
    assert 1e-4 < found.time < 1e-3
    assert found.needed is not None
    assert found.needed > 50.0
    assert found.stiffness == pytest.approx(1e5)


def test_the_fastest_is_where_all_joints_are() -> None:
    """On a fixed base rates are free of each other: the sum of what each of them gives."""
    problem = load_problem("arm_planar")
    t, c = contact_of(problem), problem.coordinates
    y, legs = c.split(problem.contact_posture)

    def along(rates: np.ndarray) -> float:
        import pinocchio as pin

        model, data = c.model, c.model.createData()
        pin.computeJointJacobians(model, data, c.join(y, legs))
        frame = model.getFrameId(f"striker:{problem.striker}")
        jacobian = pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)[:3]
        return float(problem.normal @ jacobian @ rates)

    rates = t.builder.limits.rate_limit
    expected = sum(abs(along(e)) * limit for e, limit in zip(np.eye(c.ny), rates, strict=True))
    assert fastest_at_contact(problem) == pytest.approx(expected)


def test_a_solve_without_a_verdict_gets_another_solvers() -> None:
    problem = dataclasses.replace(load_problem("arm_planar"), target=FreeMass(mass=1.0), objectives=PUSH)
    t = contact_of(problem)
    start = strike_iterate(t)
    budget = Budget(solver="ipm", options=None, time_limit=None, callback=None)
    stopped = Budget(solver="ipm", options={"max_iterations": 1}, time_limit=None, callback=None)
    old = stopped.run(t.program, start)
    assert old.status is Status.ITERATION_LIMIT
    assert ipopt_retry(stopped, t.program, start, old) is old  # a limit that was asked for is an answer
    # nobody has asked for a limit with the options of a warm start
    assert ipopt_retry(budget.near_by(), t.program, start, old).status is Status.SOLVED
    given_up = dataclasses.replace(old, status=Status.FAILED)
    assert ipopt_retry(budget, t.program, start, given_up).status is Status.SOLVED
    solved = budget.run(t.program, start)
    assert ipopt_retry(budget, t.program, start, solved) is solved
    short = dataclasses.replace(solved, status=Status.FAILED)
    assert ipopt_retry(budget, t.program, start, short).status is Status.SOLVED  # rows met, no optimum yet
    refused = dataclasses.replace(short, max_violation=0.1)
    assert ipopt_retry(budget, t.program, start, refused) is refused  # its rows are met: no row's fault
