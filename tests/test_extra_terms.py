"""Terms that only some problems have: plans obey them, they bind, and loosening them raises the optimum.

What a plan does is measured by Pinocchio and SciPy, not by the program.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize
from small_plans import changed

from impactopt.errors import InputError
from impactopt.extra_terms import (
    Gaze,
    HandOrientation,
    HitCone,
    HitRegion,
    KeepOut,
    SelfCollision,
    TorqueRate,
)
from impactopt.ipopt import solve_ipopt
from impactopt.nlp.extra_blocks import squared_distance
from impactopt.nlp.start import first_iterate
from impactopt.nlp.transcription import Transcription
from impactopt.plan import Plan
from impactopt.presets import g1, standin, talos
from impactopt.problem import Phase
from impactopt.program import SolverResult, Status
from impactopt.shapes import Capsule, face_axes
from impactopt.skeleton import skeleton_pairs
from impactopt.terms import Incidence, Term

Array = NDArray[np.float64]
WRIST = Capsule(frame="wrist", radius=0.02)
FOREARM = Capsule(frame="elbow", radius=0.05, end=(0.0, 0.0, 0.3))


def solve(t: Transcription) -> SolverResult:
    return solve_ipopt(t.program, first_iterate(t))


@dataclass
class Solved:
    transcription: Transcription
    result: SolverResult
    plan: Plan

    def posture(self, s: float, phase: str = "swing") -> Array:
        """q (nq,) at a fraction of a phase of the arm's plan."""
        spline = getattr(self.plan, phase)
        return np.asarray(self.plan.coordinates.join(spline.sample(s * spline.duration)[0][0], np.zeros(0)))

    def frame(self, name: str, q: Array) -> Any:
        model = self.plan.problem.robot.model
        data = model.createData()
        pin.framesForwardKinematics(model, data, q)
        return data.oMf[model.getFrameId(name)]

    @property
    def hit(self) -> Array:
        return np.array(self.frame(f"striker:{self.plan.problem.striker}", self.posture(1.0)).translation)


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


def gap(first: Capsule, second: Capsule) -> SelfCollision:
    return SelfCollision(pairs=((first, second),), margin=0.005)


BINDING: dict[str, tuple[Term, Term]] = {
    "torque rate": (TorqueRate(limit=20.0), TorqueRate(limit=30.0)),
    "rate of some joints": (
        TorqueRate(limit={"wrist": 5.0, "elbow": 20.0}),
        TorqueRate(limit={"wrist": 8.0, "elbow": 30.0}),
    ),
    "self-collision of spheres": (
        gap(Capsule(frame="hand", radius=0.1), Capsule(frame="elbow", radius=0.275)),
        gap(Capsule(frame="hand", radius=0.1), Capsule(frame="elbow", radius=0.27)),
    ),
    "keep out": (KeepOut(shapes=(WRIST,), margin=0.02), KeepOut(shapes=(WRIST,))),
    "keep a line out": (KeepOut(shapes=(FOREARM,), margin=0.0), KeepOut(shapes=(FOREARM,), margin=0.0)),
    "hand orientation": (
        HandOrientation(axis=(0, 0, 1), angle=1.15),
        HandOrientation(axis=(0, 0, 1), angle=1.2),
    ),
    "gaze": (Gaze(frame="elbow", axis=(0, 0, 1), angle=0.05), Gaze(frame="elbow", axis=(0, 0, 1), angle=0.1)),
    "disc": (HitRegion(radius=0.02), HitRegion(radius=0.05)),
    "rectangle": (HitRegion(size=(0.1, 0.02)), HitRegion(size=(0.1, 0.05))),
    "hit cone": (HitCone(angle=0.05), HitCone(angle=0.2)),
}


@pytest.mark.parametrize("name", [n for n in BINDING if n != "keep a line out"])
def test_loosening_a_term_that_binds_raises_the_optimum(solved: Any, name: str) -> None:
    """From the tight one's plan: there are several local optima."""
    tight = solved(BINDING[name][0])
    looser = changed(tight.transcription, terms=(BINDING[name][1],))
    loose = solve_ipopt(looser.program, tight.result.x)
    assert loose.status is Status.SOLVED
    assert tight.result.objective > loose.objective + 1e-4
    program, term = tight.transcription.program, BINDING[name][0].name
    rows = [i for i in range(program.m) if program.row_name(i).startswith(term)]
    g = program.constraints(tight.result.x)[rows]
    slack = np.minimum(g - program.g_lower[rows], program.g_upper[rows] - g)
    assert slack.min() == pytest.approx(0, abs=1e-5)


@pytest.mark.parametrize("name", ["torque rate", "rate of some joints"])
def test_torques_change_no_faster_than_they_may(solved: Any, name: str) -> None:
    """By inverse dynamics at the nodes."""
    tight, term = solved(BINDING[name][0]), BINDING[name][0]
    t, model = tight.transcription, tight.plan.problem.robot.model
    limit = np.array(
        [
            term.limit.get(j, np.inf) if isinstance(term.limit, dict) else term.limit
            for j in t.robot.joint_names
        ]
    )
    fastest = 0.0
    for spline, nodes in ((tight.plan.swing, [0, *t.swing_nodes]), (tight.plan.follow, t.follow_nodes)):
        times, torque = np.array(nodes) * spline.duration, []
        for y, v, a in zip(*spline.sample(times), strict=True):
            q = t.coordinates.join(y, np.zeros(0))
            torque.append(pin.rnea(model, model.createData(), q, v, a).copy())
        rate = np.abs(np.diff(torque, axis=0)) / np.diff(times)[:, None]
        assert (rate <= limit * (1 + 1e-4) + 1e-3).all()
        fastest = max(fastest, float((rate / limit).max()))
    assert fastest == pytest.approx(1.0, abs=1e-3)


def test_shapes_stay_apart_at_all_nodes(solved: Any) -> None:
    tight = solved(BINDING["self-collision of spheres"][0])
    least = 0.1 + 0.275 + 0.005
    found = []
    for phase, nodes in (
        ("swing", tight.transcription.swing_nodes),
        ("follow", tight.transcription.follow_nodes),
    ):
        for s in nodes:
            q = tight.posture(s, phase)
            a, b = (tight.frame(name, q).translation for name in ("hand", "elbow"))
            found.append(float(np.linalg.norm(a - b)))
    assert min(found) == pytest.approx(least, abs=1e-5)


@pytest.mark.parametrize(("ends_a", "ends_b"), [(1, 1), (1, 2), (2, 1), (2, 2)])
def test_the_distance_of_lines_is_the_least_there_is(ends_a: int, ends_b: int) -> None:
    """Against SciPy's minimum over both lines; also where an end is nearest, and its slope by differences."""
    a = [ca.SX.sym(f"a{i}", 3) for i in range(ends_a)]
    b = [ca.SX.sym(f"b{i}", 3) for i in range(ends_b)]
    z = ca.vertcat(*a, *b)
    d = squared_distance(a, b)
    f, slope = ca.Function("f", [z], [d]), ca.Function("g", [z], [ca.gradient(d, z)])
    rng, h = np.random.default_rng(ends_a + 2 * ends_b), 1e-6
    for _ in range(40):
        points = rng.standard_normal((ends_a + ends_b, 3))

        def away(st: Array, points: Array = points) -> float:
            one, two = points[:ends_a], points[ends_a:]
            p = one[0] + (st[0] * (one[1] - one[0]) if ends_a == 2 else 0)
            q = two[0] + (st[1] * (two[1] - two[0]) if ends_b == 2 else 0)
            return float(np.sum((p - q) ** 2))

        best = min(
            minimize(away, start, bounds=[(0, 1)] * 2, tol=1e-12).fun
            for start in itertools.product((0.1, 0.9), repeat=2)
        )
        x = points.ravel()
        assert float(f(x)) == pytest.approx(best, abs=1e-6)
        way = rng.standard_normal(x.size)
        by_difference = (float(f(x + h * way)) - float(f(x - h * way))) / (2 * h)
        assert float(np.array(slope(x)).ravel() @ way) == pytest.approx(by_difference, rel=1e-4, abs=1e-6)


def test_parallel_lines_have_a_distance() -> None:
    a, b = [ca.DM([0, 0, 0]), ca.DM([0, 0, 1])], [ca.DM([3, 0, 0.2]), ca.DM([3, 0, 0.8])]
    assert float(squared_distance(a, b)) == pytest.approx(9.0)


@pytest.mark.parametrize("name", ["keep out", "keep a line out"])
def test_shapes_stay_before_the_face_until_contact(solved: Any, name: str) -> None:
    tight, term = solved(BINDING[name][0]), BINDING[name][0]
    problem, shape = tight.plan.problem, term.shapes[0]
    found = []
    for s in tight.transcription.swing_nodes[:-1]:
        frame = tight.frame(shape.frame, tight.posture(s))
        for end in (shape.start, shape.end or shape.start):
            way = problem.normal @ (frame.act(np.array(end)) - problem.point)
            found.append(way + shape.radius + term.margin)
    assert max(found) <= 1e-5


def test_a_sphere_stays_out_of_a_box(arm_transcription: Transcription) -> None:
    """A box that leaves the wrist less room than the whole half-space does not exist: it costs less."""
    half_space = KeepOut(shapes=(WRIST,), margin=0.02)
    size = (0.06, 0.04, 0.1)
    box = KeepOut(shapes=(WRIST,), size=size, margin=0.02)
    t = changed(arm_transcription, terms=(box,))
    result = solve(t)
    assert result.status is Status.SOLVED
    assert result.objective <= solve(changed(arm_transcription, terms=(half_space,))).objective + 1e-6
    plan = Solved(t, result, t.decode(result.x))
    axes = face_axes(t.problem.normal)
    for s in t.swing_nodes[:-1]:
        way = axes @ (plan.frame("wrist", plan.posture(s)).translation - t.problem.point)
        beyond = np.maximum(np.abs(way - [size[2] / 2, 0, 0]) - np.array([size[2], *size[:2]]) / 2, 0)
        assert np.linalg.norm(beyond) >= 0.04 - 1e-4


def test_the_hand_is_turned_at_contact(solved: Any) -> None:
    tight, term = solved(BINDING["hand orientation"][0]), BINDING["hand orientation"][0]
    axis = tight.frame("striker:hand", tight.posture(1.0)).rotation @ np.array(term.axis)
    assert np.arccos(axis @ tight.plan.problem.normal) == pytest.approx(term.angle, abs=1e-5)


def test_the_frame_looks_at_the_point(solved: Any) -> None:
    tight, term = solved(BINDING["gaze"][0]), BINDING["gaze"][0]
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
    tight, term = solved(BINDING[name][0]), BINDING[name][0]
    problem = tight.plan.problem
    depth, across, up = face_axes(problem.normal) @ (tight.hit - problem.point)
    assert depth == pytest.approx(0, abs=1e-5)
    if term.radius is not None:
        assert np.hypot(across, up) == pytest.approx(term.radius, abs=1e-4)
    else:
        assert abs(across) <= term.size[0] / 2 + 1e-5
        assert abs(up) <= term.size[1] / 2 + 1e-5
    assert tight.result.objective < solved().result.objective - 1e-3


def test_the_velocity_at_contact_is_in_its_cone(solved: Any) -> None:
    tight, term = solved(BINDING["hit cone"][0]), BINDING["hit cone"][0]
    problem, plan = tight.plan.problem, tight.plan
    model = problem.robot.model
    data = model.createData()
    v = plan.swing.sample(plan.swing.duration)[1][0]
    pin.forwardKinematics(model, data, tight.posture(1.0), v)
    frame = model.getFrameId("striker:hand")
    velocity = pin.getFrameVelocity(model, data, frame, pin.LOCAL_WORLD_ALIGNED).linear
    angle = np.arccos(problem.normal @ velocity / np.linalg.norm(velocity))
    assert angle == pytest.approx(term.angle, abs=1e-4)
    free = solved(Incidence(speed=float("inf")))  # any direction
    assert free.result.objective <= solved(BINDING["hit cone"][1]).result.objective + 1e-6


@pytest.mark.parametrize("robot", ["arm", "biped"])
def test_derivatives_with_all_terms_agree_with_differences(
    robot: str, request: pytest.FixtureRequest
) -> None:
    """Legs and free durations too."""
    hand, chest = ("hand", "turn") if robot == "arm" else ("fist", "root")
    leg = "shoulder" if robot == "arm" else "right knee"
    pairs = (
        (Capsule(frame=hand, radius=0.05), Capsule(frame=chest, radius=0.1, end=(0.0, 0.0, 0.4))),
        (Capsule(frame=hand, radius=0.05, end=(0.1, 0, 0)), Capsule(frame=leg, radius=0.1, end=(0, 0, -0.3))),
    )
    terms = (
        TorqueRate(limit=500.0),
        SelfCollision(pairs=pairs),
        KeepOut(shapes=(Capsule(frame=leg, radius=0.1),), size=(0.3, 0.4, 0.5)),
        HandOrientation(axis=(0, 0.6, 0.8)),
        Gaze(frame=leg, axis=(1, 0, 0)),
        HitRegion(radius=0.1),
        HitCone(angle=0.2),
    )
    swing = Phase(duration=(0.4, 0.7), intervals=6)
    t = changed(request.getfixturevalue(f"{robot}_transcription"), terms=terms, swing=swing)
    program, rng, h = t.program, np.random.default_rng(0), 1e-6
    names = [program.row_name(i) for i in range(program.m)]
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
    """A forearm thicker than the way it has; a hand that cannot be turned so far."""
    thick = KeepOut(shapes=(Capsule(frame="wrist", radius=0.4),))
    result = solve(changed(arm_transcription, terms=(thick,)))
    assert result.status is Status.INFEASIBLE
    assert "keep out, swing at 0." in result.message and " mm too near" in result.message
    turned = HandOrientation(axis=(0, 0, 1), angle=0.6)
    result = solve(changed(arm_transcription, terms=(turned,)))
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
        (lambda: Capsule(frame="a", radius=-0.1), "radius"),
        (lambda: Capsule(frame="a", radius=0.1, start=(0, 0)), "start"),
        (lambda: Capsule(frame="a", radius=0.1, end=(0, 0, 0)), "coincide"),
        (lambda: gap(Capsule(frame="a", radius=0.0), Capsule(frame="b", radius=float("nan"))), "radius"),
        (
            lambda: SelfCollision(
                pairs=((Capsule(frame="a", radius=0.0), Capsule(frame="b", radius=0.0)),), margin=0.0
            ),
            "no size",
        ),
        (lambda: KeepOut(shapes=(FOREARM,), size=(1, 1, 1)), "as a sphere"),
        (lambda: KeepOut(shapes=(WRIST,), size=(1, 0, 1)), "three lengths"),
        (lambda: HandOrientation(axis=(0, 0, 2)), "unit vector"),
        (lambda: HandOrientation(axis=(0, 0, 1), direction=(1, 1, 0)), "direction must be a unit"),
        (lambda: HandOrientation(axis=(0, 0, 1), angle=0.0), "between 0 and pi/2"),
        (lambda: Gaze(frame="a", axis=(0, 0, 1), since=2.0), "fraction"),
        (lambda: HitRegion(), "either radius"),
        (lambda: HitRegion(radius=0.1, size=(0.1, 0.1)), "either radius"),
        (lambda: HitRegion(radius=0.3), "0.2 m"),
        (lambda: HitRegion(size=(0.3, 0.3)), "0.2 m"),
        (lambda: HitRegion(size=(0.1, -0.1)), "> 0"),
        (lambda: HitCone(angle=float("nan")), "between 0 and pi/2"),
    ],
)
def test_terms_that_make_no_sense_are_refused(make: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        make()


def test_names_that_the_robot_does_not_have_are_refused(arm_transcription: Transcription) -> None:
    for term, words in (
        (Gaze(frame="elbw", axis=(0, 0, 1)), "no frame 'elbw'.*did you mean 'elbow'"),
        (KeepOut(shapes=(Capsule(frame="head", radius=0.1),)), "no frame 'head'"),
        (gap(WRIST, Capsule(frame="tors", radius=0.1)), "no frame 'tors'"),
        (TorqueRate(limit={"wrst": 1.0}), "no joint 'wrst'.*did you mean 'wrist'"),
    ):
        with pytest.raises(InputError, match=words):
            changed(arm_transcription, terms=(term,))
    with pytest.raises(InputError, match="takes the place of Incidence"):
        changed(arm_transcription, terms=(HitCone(), Incidence()))


@pytest.mark.parametrize("normal", [[1.0, 0, 0], [0, 0, -1.0], [0.6, 0.0, 0.8]])
def test_the_faces_axes_are_level_and_at_right_angles(normal: list[float]) -> None:
    axes = face_axes(np.array(normal))
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(axes[0], normal)
    assert axes[1, 2] == 0 and axes[2, 2] >= 0
    assert np.linalg.det(axes) == pytest.approx(1.0)


@pytest.mark.parametrize("make", [talos, g1, standin])
def test_bones_tell_of_torso_and_thighs(make: Any) -> None:
    """One of each thigh and a torso between hips and shoulders; in half-sitting the hand is clear of all."""
    robot = make()
    model, data = robot.model, robot.model.createData()
    pin.framesForwardKinematics(model, data, robot.posture("half_sitting"))
    for striker in robot.strikers:
        pairs = skeleton_pairs(robot, striker)
        assert len(pairs) == 1 + len(robot.soles)
        hand = data.oMf[model.getFrameId(robot.striker(striker).frame)].translation
        assert {first.frame for first, _ in pairs} == {robot.striker(striker).frame}
        for first, second in pairs:
            placement = data.oMf[model.getFrameId(second.frame)]
            a, b = (placement.act(np.array(end)) for end in (second.start, second.end))
            assert 0.15 < np.linalg.norm(b - a) < 0.5
            along = np.clip((hand - a) @ (b - a) / np.sum((b - a) ** 2), 0, 1)
            assert np.linalg.norm(hand - a - along * (b - a)) > first.radius + second.radius + 0.01
        torso, *thighs = (second for _, second in pairs)
        low = max(data.oMf[model.getFrameId(thigh.frame)].translation[2] for thigh in thighs)
        assert data.oMf[model.getFrameId(torso.frame)].translation[2] > low
        assert abs(data.oMf[model.getFrameId(torso.frame)].translation[1]) < 0.01


def test_a_problem_finds_the_pairs_of_its_robot_itself(biped_transcription: Transcription) -> None:
    problem = changed(biped_transcription, terms=(SelfCollision(margin=0.02),)).problem
    term = problem.extra(SelfCollision)
    assert term is not None and term.margin == 0.02
    assert term.pairs == skeleton_pairs(problem.robot, "fist")
    assert {second.frame for _, second in term.pairs} == {"root", "left hip pitch", "right hip pitch"}


def test_a_robot_without_a_body_needs_pairs(arm_transcription: Transcription) -> None:
    with pytest.raises(InputError, match="give SelfCollision its pairs"):
        changed(arm_transcription, terms=(SelfCollision(),))
