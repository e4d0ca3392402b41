"""Terms that only some problems have: plans obey them, they bind, and loosening them raises the optimum.

What a plan does is measured by Pinocchio and SciPy, not by the program.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.small_plans import changed
from support.term_cases import CASES, MILD, Solved, hit_cone

from impactopt import (
    FreeMass,
    Gaze,
    HandOrientation,
    HitCone,
    HitRegion,
    Impulse,
    Incidence,
    InputError,
    JointJerk,
    Phase,
    Status,
    Term,
    TorqueRate,
)
from impactopt.bodies.world import face_axes
from impactopt.solvers.ipm.interior_point import solve_ipm
from impactopt.solvers.ipopt import solve_ipopt
from impactopt.solvers.program import SolverResult
from impactopt.transcription.initial_guess import first_iterate
from impactopt.transcription.transcription import Transcription

Array = NDArray[np.float64]


def solve(t: Transcription) -> SolverResult:
    return solve_ipm(t.program, first_iterate(t))


@pytest.fixture(scope="module")
def solved(arm_transcription: Transcription) -> Any:
    """Plans of the arm by their terms, each solved once."""
    done: dict[str, Solved] = {}

    def plan(*terms: Term) -> Solved:
        key = repr(terms)
        if key not in done:
            t = changed(arm_transcription, terms=terms)
            result = solve(t)
            assert result.status is Status.SOLVED, result.message
            done[key] = Solved(t, result, t.decode(result.x))
        return done[key]

    return plan


@pytest.mark.parametrize("name", CASES)
def test_loosening_a_term_that_binds_raises_the_optimum(solved: Any, name: str) -> None:
    """From the tight one's plan: there are several local optima."""
    tight = solved(CASES[name].tight)
    looser = changed(tight.transcription, terms=(CASES[name].loose,))
    loose = solve_ipm(looser.program, tight.result.x)
    assert loose.status is Status.SOLVED
    assert tight.result.objective > loose.objective + 1e-4
    program, term = tight.transcription.program, CASES[name].tight.name
    rows = [i for i in range(program.m) if program.constraint_name(i).startswith(term)]
    g = program.constraints(tight.result.x)[rows]
    slack = np.minimum(g - program.g_lower[rows], program.g_upper[rows] - g)
    assert slack.min() == pytest.approx(0, abs=1e-5)


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.reaches is not None])
def test_a_plan_goes_as_far_as_its_term_allows(solved: Any, name: str) -> None:
    case = CASES[name]
    assert case.reaches is not None
    assert case.reaches(solved(case.tight), case.tight) == pytest.approx(1.0, abs=1e-3)


def test_the_frame_looks_at_the_point(solved: Any) -> None:
    tight, term = solved(CASES["gaze"].tight), CASES["gaze"].tight
    angles = []
    for s in tight.transcription.swing_nodes:
        frame = tight.frame(term.frame, tight.posture(s))
        way = tight.plan.problem.point - frame.translation
        angles.append((s, np.arccos(frame.rotation @ np.array(term.axis) @ way / np.linalg.norm(way))))
    late = [angle for s, angle in angles if s >= term.since]
    assert max(late) == pytest.approx(term.angle, abs=1e-4)
    assert max(angle for s, angle in angles if s < term.since) > term.angle


@pytest.mark.parametrize("name", ["disc", "rectangle"])
def test_the_hit_point_is_free_in_its_region(solved: Any, name: str) -> None:
    tight, term = solved(CASES[name].tight), CASES[name].tight
    problem = tight.plan.problem
    depth, across, up = face_axes(problem.normal) @ (tight.hit - problem.point)
    assert depth == pytest.approx(0, abs=1e-5)
    if term.radius is not None:
        assert np.hypot(across, up) == pytest.approx(term.radius, abs=1e-4)
    else:
        assert abs(across) <= term.size[0] / 2 + 1e-5
        assert abs(up) <= term.size[1] / 2 + 1e-5
    assert tight.result.objective < solved().result.objective - 1e-3


def test_any_direction_is_no_better_than_a_cone(solved: Any) -> None:
    free = solved(Incidence(speed=float("inf")))
    assert free.result.objective <= solved(CASES["hit cone"].loose).result.objective + 1e-6


def test_a_target_that_comes_meets_a_cone_about_its_own_way(arm_transcription: Transcription) -> None:
    """A weak impact, for which the hand recedes."""
    term, ball = HitCone(angle=0.1), FreeMass(mass=1.0, initial_velocity=-1.0)
    t = changed(arm_transcription, terms=(term,), target=ball, objectives=(Impulse(weight=-1.0),))
    result = solve(t)
    assert result.status is Status.SOLVED
    found = Solved(t, result, t.decode(result.x))
    assert found.plan.hand_speed < 0
    assert hit_cone(found, term) <= 1 + 1e-3


@pytest.mark.parametrize("robot", ["arm", "biped"])
def test_derivatives_with_all_terms_agree_with_differences(
    robot: str, request: pytest.FixtureRequest
) -> None:
    """Legs and free durations too."""
    leg = "shoulder" if robot == "arm" else "right knee"
    terms = tuple(replace(term, frame=leg) if isinstance(term, Gaze) else term for term in MILD.values())
    swing = Phase(duration=(0.4, 0.7), intervals=6)
    t = changed(request.getfixturevalue(f"{robot}_transcription"), terms=terms, swing=swing)
    program, rng, h = t.program, np.random.default_rng(0), 1e-6
    names = [program.constraint_name(i) for i in range(program.m)]
    assert len(set(names)) == len(names)
    assert all(any(name.startswith(term.name) for name in names) for term in terms)
    x = first_iterate(t)
    assert np.isfinite(program.constraints(x)).all()
    x += 0.02 * rng.standard_normal(program.n)
    y = rng.standard_normal(program.m)
    jacobian, hessian = program.jacobian(x), program.hessian(x, 1.0, y)
    for _ in range(3):
        d = rng.standard_normal(program.n)
        of_rows = (program.constraints(x + h * d) - program.constraints(x - h * d)) / (2 * h)
        assert (np.abs(jacobian @ d - of_rows) <= 1e-6 * (abs(jacobian) @ np.abs(d)) + 1e-6).all()
        ahead, behind = (
            program.gradient(x + step * d) + program.jacobian(x + step * d).T @ y for step in (h, -h)
        )
        size = abs(hessian) @ np.abs(d)
        assert (np.abs(hessian @ d - (ahead - behind) / (2 * h)) <= 1e-5 * size + 1e-5 * size.max()).all()
    for i in range(program.m):
        what, by = program.describe_violation(i, x, 0.1)
        assert "{" not in what and not by.startswith("by ")


def test_what_cannot_be_met_names_term_and_time(arm_transcription: Transcription) -> None:
    """A hand that cannot be turned so far."""
    turned = HandOrientation(axis=(0, 0, 1), angle=0.6)
    t = changed(arm_transcription, terms=(turned,))
    result = solve_ipopt(t.program, first_iterate(t))
    assert result.status is Status.INFEASIBLE
    assert "hand orientation, contact, hand: " in result.message and " deg too far off" in result.message


def test_only_what_is_given_is_in_the_program(arm_transcription: Transcription) -> None:
    plain = arm_transcription.program
    blocks = {b.name for b in plain.blocks}
    for term, block, rows in (
        (HitRegion(radius=0.1), "hit_region", 2 - 3),
        (HitRegion(size=(0.1, 0.1)), "hit_region", 3 - 3),
        (HitCone(), "hit_cone", 1 - 2),
        (HandOrientation(axis=(0, 0, 1)), "hand_orientation", 1),
    ):
        program = changed(arm_transcription, terms=(term,)).program
        assert {b.name for b in program.blocks} - blocks == {block}
        assert (program.n, program.m) == (plain.n, plain.m + rows)
    assert "torque, swing" not in " ".join(arm_transcription.layout.groups)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: TorqueRate(limit=-1.0), "TorqueRate.limit"),
        (lambda: TorqueRate(limit={"elbow": float("nan")}), "TorqueRate.limit"),
        (lambda: HandOrientation(axis=(0, 0, 2)), "unit vector"),
        (lambda: HandOrientation(axis=(0, 0, 1), direction=(1, 1, 0)), "direction must be a unit"),
        (lambda: HandOrientation(axis=(0, 0, 1), angle=0.0), "between 0 and pi/2"),
        (lambda: Gaze(frame="a", axis=(0, 0, 1), since=2.0), "fraction"),
        (lambda: HitRegion(), "either radius"),
        (lambda: HitRegion(radius=0.1, size=(0.1, 0.1)), "either radius"),
        (lambda: HitRegion(radius=0.3), "0.2 m"),
        (lambda: HitRegion(size=(0.3, 0.3)), "0.2 m"),
        (lambda: HitRegion(size=(0.1, -0.1)), "> 0"),
        (lambda: HitCone(angle=float("nan")), "HitCone.angle: nan"),
    ],
)
def test_terms_that_make_no_sense_are_refused(make: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        make()


def test_names_that_the_robot_does_not_have_are_refused(arm_transcription: Transcription) -> None:
    for term, words in (
        (Gaze(frame="elbw", axis=(0, 0, 1)), "no frame 'elbw'.*did you mean 'elbow'"),
        (TorqueRate(limit={"wrst": 1.0}), "no joint 'wrst'.*did you mean 'wrist'"),
    ):
        with pytest.raises(InputError, match=words):
            changed(arm_transcription, terms=(term,))
    with pytest.raises(InputError, match="takes the place of Incidence"):
        changed(arm_transcription, terms=(HitCone(), Incidence()))


def test_a_jerk_that_others_determine_is_refused_with_the_problem(biped_transcription: Transcription) -> None:
    """A leg's, whose sole stands; before anything is compiled."""
    problem = biped_transcription.problem
    names, c = problem.robot.joint_names, problem.coordinates
    leg, free = names[c.dependent[0]], names[c.independent[0]]
    with pytest.raises(InputError, match=f"JointJerk.limit: {leg!r} is determined by .*leave it out"):
        replace(problem, terms=(JointJerk(limit={leg: 1e3, free: 1e3}),))
    for fine in ({free: 1e3}, 1e3):
        assert replace(problem, terms=(JointJerk(limit=fine),)).extra(JointJerk) is not None


@pytest.mark.parametrize("normal", [[1.0, 0, 0], [0, 0, -1.0], [0.6, 0.0, 0.8]])
def test_the_faces_axes_are_level_and_at_right_angles(normal: list[float]) -> None:
    axes = face_axes(np.array(normal))
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(axes[0], normal)
    assert axes[1, 2] == 0 and axes[2, 2] >= 0
    assert np.linalg.det(axes) == pytest.approx(1.0)
