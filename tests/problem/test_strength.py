"""Postures at contact that are chosen for initial guesses."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from support import urdfs

from impactopt import (
    CustomLaw,
    FirstTouch,
    FreeMass,
    HandOrientation,
    NotSolvedWarning,
    Robot,
    SpringDamper,
    Striker,
    load_problem,
    solve,
)
from impactopt.bodies.robot_bodies import bodies_of, striker_face
from impactopt.errors import InputError
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.strength import (
    MAX_BEYOND,
    Strength,
    best_share,
    drawn_impacts,
    random_postures,
    strongest_posture,
    touches,
)
from impactopt.transcription import initial_guess


def _off(problem: ImpactProblem, q: np.ndarray) -> tuple[float, float]:
    """Distance [m] of the striking point from the hit point, and angle [rad] of the hand's axis to the
    normal.
    """
    model, data = problem.robot.model, problem.robot.model.createData()
    pin.framesForwardKinematics(model, data, q)
    at = data.oMf[model.getFrameId(f"striker:{problem.striker}")]
    hand = problem.extra(HandOrientation)
    assert hand is not None
    cosine = (at.rotation @ np.array(hand.axis)) @ problem.normal
    return float(np.linalg.norm(at.translation - problem.point)), float(np.arccos(np.clip(cosine, -1, 1)))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_chosen_posture_reaches_and_faces_the_target(seed: int) -> None:
    """That of inverse kinematics from the start posture is turned away from it."""
    problem = load_problem("arm7")
    hand = problem.extra(HandOrientation)
    assert hand is not None and _off(problem, problem.contact_posture)[1] > hand.angle
    q = strongest_posture(problem, seed)
    distance, angle = _off(problem, q)
    assert distance < 1e-6 and angle <= hand.angle + 1e-9 and not touches(problem, q)
    angles = problem.robot.joint_positions(q)
    assert np.all(angles >= problem.robot.lower) and np.all(angles <= problem.robot.upper)


def test_robots_on_soles_have_the_nearest_posture() -> None:
    problem = load_problem("punch_standin")
    assert np.array_equal(strongest_posture(problem, 1), problem.contact_posture)


def _aside(*shift: float) -> ImpactProblem:
    """Hit point whose nearest posture faces the target."""
    problem = load_problem("arm7")
    problem = replace(problem, point=problem.point + np.array(shift or [0.05, -0.03, -0.077]))
    hand = problem.extra(HandOrientation)
    assert hand is not None and _off(problem, problem.contact_posture)[1] <= hand.angle
    return problem


def test_a_posture_given_near_contact_goes_first() -> None:
    problem = _aside()
    other = strongest_posture(problem, 1)
    given = replace(problem, near_contact=other)
    assert np.abs(strongest_posture(problem) - other).max() > 0.1
    assert np.array_equal(strongest_posture(given), given.contact_posture)
    np.testing.assert_allclose(given.contact_posture, other, atol=0.2)
    assert not np.array_equal(strongest_posture(given, 2), other), "further starts have others"
    with pytest.raises(InputError, match="near_contact"):
        replace(problem, near_contact=other[1:])
    with pytest.raises(InputError, match="near_contact"):
        replace(problem, near_contact=np.degrees(other))


def test_further_starts_have_other_postures() -> None:
    problem = _aside()
    postures = [strongest_posture(problem, seed) for seed in range(3)]
    assert np.array_equal(postures[0], problem.contact_posture)
    for one, other in pairwise(postures):
        assert np.abs(one - other).max() > 0.1
    for q in postures:
        assert _off(problem, q)[0] < 1e-6


@pytest.mark.filterwarnings("error")
def test_a_law_without_force_at_first_has_postures() -> None:
    """Its stiffness was a divisor."""
    soft = CustomLaw(compression=lambda depth, _: 1e5 * ca.fmax(depth - 2e-3, 0.0))
    q = strongest_posture(replace(_aside(), law=soft), 1)
    assert _off(_aside(), q)[0] < 1e-6


@pytest.mark.slow
def test_an_arm_begins_from_a_posture_that_its_swing_reaches() -> None:
    """From the nearest one it was "infeasible: time", with 20 % more time that would do."""
    problem = _aside(-0.0255, 0.0739, 0.0271)
    assert not np.array_equal(strongest_posture(problem), problem.contact_posture)
    solution = solve(problem)
    assert solution.status.usable and solution.impulse > 8.0 and len(solution.attempts) == 1


@pytest.mark.slow
def test_an_arm_without_a_motion_from_one_posture_is_tried_from_another() -> None:
    solution = solve(_aside(-0.028, 0.131, 0.08))
    assert solution.status.usable and solution.impulse > 7.0
    assert [(a.start, a.kept) for a in solution.attempts] == [("reach 1", False), ("other posture", True)]


@pytest.mark.slow
def test_the_attempts_hold_another_posture_that_fails_too() -> None:
    with pytest.warns(NotSolvedWarning):
        attempts = solve(_aside(-0.13, 0.137, -0.097)).attempts
    assert [a.start for a in attempts] == ["reach 1", "other posture"]
    assert not any(a.status.usable for a in attempts)


@pytest.mark.slow
def test_one_initial_guess_is_as_good_as_several() -> None:
    problem = load_problem("arm7")
    plain, several = solve(problem), solve(problem, starts=3)
    assert plain.status.usable and plain.impulse > 0.98 * several.impulse


@pytest.mark.slow
def test_a_solve_searches_its_posture_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The scale of the prices and the initial guess take the same one."""
    searched = list[int]()

    def counted(problem: ImpactProblem, seed: int = 0) -> np.ndarray:
        searched.append(seed)
        return strongest_posture(problem, seed)

    monkeypatch.setattr(initial_guess, "strongest_posture", counted)
    assert solve(load_problem("arm7")).status.usable and searched == [0]


@pytest.mark.slow
def test_drawn_postures_turn_the_links_face_to_the_normal() -> None:
    """No vertex of the link is farther beyond the target's plane, at any normal, oblique ones too."""
    problem = load_problem("arm7")
    robot, name = problem.robot, problem.striker
    impacts = drawn_impacts(
        Strength(robot=robot, striker=name, law=problem.law, target=problem.target), problem.start_posture
    )
    striker, data, face = robot.striker(name), robot.model.createData(), striker_face(robot, name)
    assert face is not None
    joint = robot.model.frames[robot.model.getFrameId(striker.frame)].parentJoint
    pieces = bodies_of(robot).of_joint[int(joint)]
    vertices = np.concatenate([piece.vertices for piece in pieces if not piece.assumed])
    for impact in impacts:
        pin.forwardKinematics(robot.model, data, impact.q)
        along = (np.array([data.oMi[joint].act(v) for v in vertices]) - impact.point) @ impact.normal
        assert along.max() <= face.ahead + FirstTouch().depth + MAX_BEYOND + 1e-9
        assert np.linalg.norm(impact.normal) == pytest.approx(1.0, abs=1e-8)
    assert len({np.count_nonzero(impact.normal) for impact in impacts}) == 2


def test_joints_far_from_zero_are_drawn_in_their_ranges(tmp_path: Path) -> None:
    """A gantry's rail begins at 4 m."""
    drive = {"kind": "prismatic", "effort": 100.0, "velocity": 2.0}
    rail = urdfs.joint("rail", "base", "hand", "1 0 0", (0.0, 0.0, 0.5), (4.0, 6.0), **drive)
    links = (urdfs.link(name, 1.0, (0.1, 0.1, 0.1), (0.0, 0.0, 0.0)) for name in ("base", "hand"))
    (tmp_path / "gantry.urdf").write_text(urdfs.robot("gantry", *links, rail))
    robot = Robot.from_urdf(
        tmp_path / "gantry.urdf",
        floating=False,
        armature=0.0,
        strikers=[Striker(name="tip", frame="hand", point=np.zeros(3))],
        postures={"middle": {"rail": 5.0}},
    )
    drawn = np.ravel(list(random_postures(robot, "tip", robot.posture("middle"), 20)))
    assert drawn.min() >= 4.0 and drawn.max() <= 6.0 and np.ptp(drawn) > 1.0


def test_of_the_hardest_impact_nearby_it_is_said_that_none_is_harder() -> None:
    """An arm with a joint to spare reaches the point in many postures, of which few are so strong."""
    problem = replace(
        load_problem("arm7"), target=FreeMass(mass=3.0), law=SpringDamper(stiffness=1e4, damping=230.0)
    )
    for _ in range(5):
        found = best_share(problem)
        assert found is not None
        share, best = found
        if np.allclose(best.point, problem.point) and np.allclose(best.normal, problem.normal):
            break
        problem = replace(problem, point=best.point, normal=best.normal)
    assert np.allclose(best.point, problem.point) and share == pytest.approx(1.0)
