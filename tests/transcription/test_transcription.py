"""From problem to program and back: derivatives, names, and plans that are true of the robot.

The programs and plans of both small robots are in `small_plans.py`.
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from support.derivative_checks import check_derivatives
from support.small_plans import LAW, Planned, changed

from impactopt import (
    ContactWrenchCone,
    Incidence,
    MotorCurve,
    Phase,
    Scenario,
    Status,
    TorqueLimit,
    TorqueRate,
    VelocityLimit,
)
from impactopt.kinematics.splines import Radau
from impactopt.kinematics.stance import contact_wrench_cone, zmp
from impactopt.solvers.ipopt import solve_ipopt
from impactopt.solvers.program import check_program
from impactopt.transcription.contact_conditions import rotation_rows
from impactopt.transcription.initial_guess import first_iterate
from impactopt.transcription.mesh import collision_mesh, with_middles
from impactopt.transcription.plan import total_ground_wrench
from impactopt.transcription.transcription import Transcription

Array = NDArray[np.float64]


VARIANTS: dict[str, dict[str, Any]] = {
    "as it is": {},
    "with scenarios": {
        "scenarios": (
            Scenario(name="heavy", mass=2.0),
            Scenario(name="missing", missing=True),
            Scenario(name="hard", stiffness=3.0, damping=0.5),
        )
    },
    "rigid": {"collision": "rigid", "coefficient_of_restitution": 0.3},
    "virtual-mass": {"collision": "virtual-mass"},
}


@pytest.fixture(
    scope="module", params=[(robot, kind) for kind in VARIANTS for robot in ("biped", "arm")], ids=", ".join
)
def transcription(request: pytest.FixtureRequest) -> Transcription:
    robot, kind = request.param
    return changed(request.getfixturevalue(f"{robot}_transcription"), **VARIANTS[kind])


@pytest.fixture(params=["biped", "arm"])
def solved(request: pytest.FixtureRequest) -> Planned:
    return request.getfixturevalue(f"{request.param}_plan")


# ---- the program


def test_the_first_iterate_is_inside_its_bounds_and_all_constraints_finite(
    transcription: Transcription,
) -> None:
    program, x = transcription.program, first_iterate(transcription)
    check_program(program, x)
    assert (x >= program.x_lower).all()
    assert (x <= program.x_upper).all()
    assert np.isfinite(program.constraints(x)).all()
    assert np.isfinite(program.jacobian(x).data).all()


@pytest.mark.parametrize("speed", [4.0, 6.0])
def test_the_first_iterate_of_a_fast_strike_keeps_the_knees_bent(
    biped_transcription: Transcription, speed: float
) -> None:
    """Such speeds once took the base out of the legs' reach on the way."""
    t = biped_transcription
    x, c = first_iterate(t, speed=speed), t.coordinates
    for phase in (t.swing, *t.follows):
        spline = phase.spline(x)
        for y in spline.sample(phase.nodes * spline.duration)[0]:
            assert c.leg_extension(c.solve_legs(y, c.start_legs)).min() > 0.1


@pytest.mark.parametrize("away", [0.0, 0.02], ids=["at the first iterate", "near it"])
def test_jacobian_and_hessian_agree_with_differences(transcription: Transcription, away: float) -> None:
    program = transcription.program
    x = first_iterate(transcription)
    check_derivatives(program, x + away * np.random.default_rng(0).standard_normal(program.n))


def test_every_constraint_and_every_variable_has_a_unique_name(transcription: Transcription) -> None:
    program = transcription.program
    for count, name in ((program.m, program.constraint_name), (program.n, program.variable_name)):
        names = [name(i) for i in range(count)]
        assert all(names)
        assert len(set(names)) == count


@pytest.mark.slow
def test_names_on_a_fine_mesh_differ_too(arm_transcription: Transcription) -> None:
    # intervals and elements of less than one per cent, and torques that are variables of each node and stage
    fine = (0.95, *[0.001] * 50)
    t = changed(
        arm_transcription,
        swing=Phase(duration=0.4, intervals=60),
        collision_elements=(fine, fine),
        terms=(TorqueRate(limit=1e6), MotorCurve()),
    )
    program = t.program
    for count, name in ((program.m, program.constraint_name), (program.n, program.variable_name)):
        assert len({name(i) for i in range(count)}) == count
    # nodes, by whose names clearance constraints and warm starts find them
    assert len({place.name for place, _ in t.body_spots}) == len(t.body_spots)


def test_names_say_what_where_and_which(biped_transcription: Transcription) -> None:
    program = biped_transcription.program
    names = [program.constraint_name(i) for i in range(program.m)]
    problem = biped_transcription.problem
    for term in (TorqueLimit, VelocityLimit, ContactWrenchCone, Incidence):
        assert any(name.startswith(problem.term(term).name) for name in names)
    for joint in problem.robot.joint_names:
        assert any(name.startswith("torque limit, swing") and name.endswith(joint) for name in names)
        assert any(
            name.startswith("torque limit in collision, compression") and name.endswith(joint)
            for name in names
        )
    assert any(name.startswith("capture point") for name in names)
    assert any("elbow" in program.variable_name(j) for j in range(program.n))


def test_every_variable_is_in_a_constraint_or_in_the_objective(transcription: Transcription) -> None:
    program, rng = transcription.program, np.random.default_rng(1)
    x = first_iterate(transcription) + 0.01 * rng.standard_normal(program.n)
    used = np.asarray(abs(program.jacobian(x)).sum(axis=0)).ravel() + np.abs(program.gradient(x))
    idle = [program.variable_name(int(j)) for j in np.flatnonzero(used == 0)]
    assert idle == []


# ---- its pieces


@pytest.mark.parametrize("stages", [2, 3])
def test_the_mesh_differentiates_and_integrates_polynomials(stages: int) -> None:
    rng = np.random.default_rng(2)
    mesh = collision_mesh(((0.2, 0.5, 0.3), (0.4, 0.6)), Radau.of_stages(stages))
    assert len(mesh) == 5 * stages
    for phase in (0, 1):
        poly = np.polynomial.Polynomial(rng.standard_normal(stages + 1))  # u, of degree `stages`
        slope = poly.deriv()
        # of the degree that each quadrature is exact for: lower inside an element, 2 s - 2 at its end
        low = np.polynomial.Polynomial(rng.standard_normal(stages))
        low_area = low.integ()
        members = [i for i, s in enumerate(mesh) if s.phase == phase]
        assert mesh[members[-1]].place == pytest.approx(1.0)
        before = 0.0
        for i in members:
            s = mesh[i]
            assert i in s.members
            at = np.array([mesh[k].place for k in s.members])
            entry = mesh[s.previous].place if not s.new_phase else 0.0
            assert s.new_phase == (s.members[0] == members[0])
            got = s.weights @ poly(at) + s.start * poly(entry)
            assert got == pytest.approx(slope(s.place), abs=1e-10)
            assert s.quadrature @ low(at) == pytest.approx(low_area(s.place) - low_area(entry), abs=1e-12)
            if i == s.members[-1]:
                degree = np.polynomial.Polynomial(rng.standard_normal(2 * stages - 1))
                exact = degree.integ()
                assert s.quadrature @ degree(at) == pytest.approx(exact(s.place) - exact(entry), abs=1e-12)
            assert s.place > before
            before = s.place


def test_restitution_goes_on_where_compression_ends() -> None:
    mesh = collision_mesh(((1.0,), (0.5, 0.5)), Radau.of_stages(2))
    assert [s.phase for s in mesh] == [0, 0, 1, 1, 1, 1]
    assert [s.previous for s in mesh] == [-1, -1, 1, 1, 3, 3]
    assert [s.new_phase for s in mesh] == [True, True, True, True, False, False]


@pytest.mark.parametrize("normal", [[1.0, 0, 0], [0, 0, 1.0], [0.6, -0.8, 0.0]])
def test_rotation_rows_are_the_normal_and_two_tangents(normal: list[float]) -> None:
    rows = rotation_rows(np.array(normal))
    np.testing.assert_allclose(rows @ rows.T, np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(rows[0], normal)


def test_middles_are_between_the_breaks() -> None:
    np.testing.assert_allclose(with_middles(np.array([0.0, 0.2, 1.0])), [0, 0.1, 0.2, 0.6, 1.0])


# ---- plans


@pytest.mark.slow
def test_it_solves(solved: Planned) -> None:
    assert solved.result.status is Status.SOLVED
    assert solved.result.max_violation <= 1e-5
    assert solved.plan.impulse > 1.0
    assert solved.result.objective < solved.transcription.program.objective(solved.start)


def test_the_plan_starts_and_ends_at_rest(solved: Planned) -> None:
    plan, c = solved.plan, solved.plan.coordinates
    y0 = c.split(solved.problem.start_posture)[0]
    y, v, _ = plan.swing.sample([0.0])
    np.testing.assert_allclose(y[0], y0, atol=1e-12)
    np.testing.assert_allclose(v, 0, atol=1e-9)
    _, v, a = plan.follow.sample([plan.follow.duration])
    np.testing.assert_allclose(v, 0, atol=1e-9)
    np.testing.assert_allclose(a, 0, atol=1e-8)
    assert plan.duration == pytest.approx(
        plan.swing.duration + plan.compression + plan.restitution + plan.follow.duration
    )
    for phase, duration in (
        (solved.problem.swing, plan.swing.duration),
        (solved.problem.follow, plan.follow.duration),
    ):
        assert phase.duration[0] - 1e-6 <= duration <= phase.duration[1] + 1e-6


def test_the_hand_meets_the_point_along_the_normal(solved: Planned) -> None:
    """By Pinocchio, on the trajectory that the servo gets."""
    problem, t = solved.problem, solved.trajectory
    model = problem.robot.model
    data = model.createData()
    k = int(np.flatnonzero(t.phase == 0)[-1])
    pin.forwardKinematics(model, data, t.q[k], t.v[k])
    pin.updateFramePlacements(model, data)
    frame = model.getFrameId(f"striker:{problem.striker}")
    np.testing.assert_allclose(data.oMf[frame].translation, problem.point, atol=1e-5)
    speed = pin.getFrameVelocity(model, data, frame, pin.LOCAL_WORLD_ALIGNED).linear
    assert problem.normal @ speed == pytest.approx(solved.plan.hand_speed, rel=1e-5)
    # one constraint for each tangent, so the length of both is within sqrt(2)
    across = speed - problem.normal * (problem.normal @ speed)
    assert np.linalg.norm(across) <= np.sqrt(2) * problem.term(Incidence).speed + 1e-5


def test_the_hand_does_not_touch_the_target_before_contact(solved: Planned) -> None:
    """Between the nodes too, but for a millimetre."""
    problem, t = solved.problem, solved.trajectory
    model = problem.robot.model
    data = model.createData()
    frame = model.getFrameId(f"striker:{problem.striker}")
    for q in t.q[t.phase == 0]:
        pin.framesForwardKinematics(model, data, q)
        assert problem.normal @ (data.oMf[frame].translation - problem.point) < 1e-3


def test_the_planned_impulse_is_momentum_and_the_integral_of_force(solved: Planned) -> None:
    plan, mass = solved.plan, solved.problem.target.mass
    hit = plan.collision
    assert plan.impulse == pytest.approx(mass * hit.target_speed[-1], rel=1e-12)
    radau = Radau.of_stages(solved.problem.collision_stages)
    durations = (plan.compression, plan.restitution)
    impulse, k = 0.0, 1
    for lengths, duration in zip(solved.problem.collision_elements, durations, strict=True):
        for length in lengths:
            count = len(radau.c)
            impulse += length * duration * float(radau.a[-1] @ hit.force[k : k + count])
            k += count
    assert k == len(hit.force)
    assert impulse == pytest.approx(plan.impulse, rel=1e-5)
    assert hit.time[-1] == pytest.approx(sum(durations))
    assert (np.diff(hit.time) > 0).all()
    assert (hit.force[:-1] > 0).all()
    assert hit.force[-1] == pytest.approx(0, abs=0.1)  # separation
    assert hit.force[0] == pytest.approx(LAW.damping * plan.hand_speed)


def test_the_planned_collision_is_inside_its_limits(solved: Planned) -> None:
    problem, hit = solved.problem, solved.plan.collision
    ratio = np.abs(hit.torque) / problem.robot.torque_limit
    assert ratio.max() <= problem.term(TorqueLimit).collision + 1e-5
    cone = problem.term(ContactWrenchCone)
    weight = 9.81 * sum(i.mass for i in problem.robot.model.inertias)
    for k, leg in enumerate(problem.coordinates.legs):
        rows = contact_wrench_cone(leg.sole.polygon, cone.friction, margin=cone.collision_margin)
        assert (hit.sole_wrench[:, 6 * k : 6 * k + 6] @ rows.T / weight).min() > -1e-5
    if problem.coordinates.legs:
        np.testing.assert_allclose(hit.ground, total_ground_wrench(problem.coordinates, hit.sole_wrench))


def test_the_trajectory_is_the_robots_own_dynamics(solved: Planned) -> None:
    """Feed-forward and ground wrench carry the motion: rnea = S'tau + J'w, soles in place."""
    problem, t = solved.problem, solved.trajectory
    robot, c = problem.robot, problem.coordinates
    model, data = robot.model, robot.model.createData()
    assert (np.diff(t.time) >= 0).all()
    assert np.count_nonzero(np.diff(t.time) == 0) == 2  # contact, and its end
    assert (np.diff(t.phase) >= 0).all()
    held = t.torque[t.phase == 1]
    np.testing.assert_array_equal(held, np.tile(held[0], (len(held), 1)))
    # feed-forward does not jump when contact begins
    np.testing.assert_allclose(t.torque[t.phase == 0][-1], held[0], atol=1e-3 * robot.torque_limit.max())
    rng = np.random.default_rng(4)
    weight = 9.81 * sum(i.mass for i in model.inertias)
    for k in rng.choice(np.flatnonzero(t.phase != 1), size=20, replace=False):
        tau = pin.rnea(model, data, t.q[k], t.v[k], t.a[k])
        if not c.legs:
            np.testing.assert_allclose(tau, t.torque[k], atol=1e-9)
            continue
        # seen from the world's origin the base's six equations are the whole robot's balance
        pin.forwardKinematics(model, data, t.q[k], t.v[k], t.a[k])
        base = data.oMi[1]
        wrench = base.act(pin.Force(tau[:6])).vector
        np.testing.assert_allclose(t.ground[k], wrench, atol=1e-6 * weight)
        pin.updateFramePlacements(model, data)
        for leg in c.legs:
            frame = model.getFrameId(leg.sole.frame)
            np.testing.assert_allclose(data.oMf[frame].homogeneous, leg.placement.homogeneous, atol=1e-8)
            assert np.abs(pin.getFrameVelocity(model, data, frame, pin.LOCAL).vector).max() < 1e-8


def test_reference_velocities_are_those_of_its_positions(solved: Planned) -> None:
    t, model = solved.trajectory, solved.problem.robot.model
    for phase in (0, 1, 2):
        k = np.flatnonzero(t.phase == phase)
        step = np.diff(t.time[k])
        moved = [pin.difference(model, t.q[a], t.q[b]) for a, b in itertools.pairwise(k)]
        rate = np.array(moved) / step[:, None]
        np.testing.assert_allclose(rate, (t.v[k[:-1]] + t.v[k[1:]]) / 2, atol=2e-3 * np.abs(t.v).max())


def test_a_motion_begins_with_the_inner_forces_of_its_first_node(biped_plan: Planned) -> None:
    """Soles that push each other apart do so at rest, too, and together they carry the weight."""
    t, x = biped_plan.transcription, biped_plan.result.x.copy()
    wrenches = t.swing.w.read(x).copy()
    wrenches[:, [1, 7]] += [40.0, -40.0]
    t.swing.w.write(x, wrenches)
    plain, pushed = biped_plan.plan.trajectory(), t.decode(x).trajectory()
    np.testing.assert_allclose(pushed.ground[0], plain.ground[0], atol=1e-6)
    first = pushed.sole_wrench[0, [1, 7]] - plain.sole_wrench[0, [1, 7]]
    assert first == pytest.approx([40.0, -40.0], rel=0.1)
    assert np.abs(pushed.torque[0] - plain.torque[0]).max() > 1.0


def test_the_servos_reference_coasts_through_the_contact(solved: Planned) -> None:
    """Independent coordinates at their velocity at contact; legs that keep the soles where they are."""
    t, c, model = solved.trajectory, solved.plan.coordinates, solved.problem.robot.model
    data = model.createData()
    k = np.flatnonzero(t.phase == 1)
    y0, _ = c.split(t.q[k[0]])
    rate = solved.plan.swing.sample(solved.plan.contact_start)[1][0]
    for i in k:
        np.testing.assert_allclose(c.split(t.q[i])[0], y0 + rate * (t.time[i] - t.time[k[0]]), atol=1e-9)
        pin.forwardKinematics(model, data, t.q[i], t.v[i])
        pin.updateFramePlacements(model, data)
        for leg in c.legs:
            frame = model.getFrameId(leg.sole.frame)
            np.testing.assert_allclose(data.oMf[frame].homogeneous, leg.placement.homogeneous, atol=1e-8)
            assert np.abs(pin.getFrameVelocity(model, data, frame, pin.LOCAL).vector).max() < 1e-8


# ---- and the simulation agrees


def test_the_simulated_impulse_is_the_planned_one(solved: Planned) -> None:
    sim, plan = solved.simulation, solved.plan
    assert sim.impulse == pytest.approx(plan.impulse, rel=0.01)
    assert sim.contact_end - sim.contact_start == pytest.approx(plan.compression + plan.restitution, rel=0.03)
    assert sim.contact_start == pytest.approx(plan.contact_start, abs=2e-3)
    assert sim.peak_force == pytest.approx(plan.collision.peak_force, rel=0.01)


def test_the_simulated_demand_is_the_planned_one(solved: Planned) -> None:
    limit = solved.problem.robot.torque_limit
    planned_ratio = solved.plan.margins()["torque_ratio"]
    ratio = np.abs(solved.simulation.demand / limit).max(axis=1)
    demand = [float(ratio[solved.simulation.phase() == k].max()) for k in range(3)]
    assert demand[0] == pytest.approx(planned_ratio["swing"], abs=5e-3)
    # the largest one may come between two of the plan's collocation points
    assert demand[1] == pytest.approx(planned_ratio["collision"], abs=0.06)
    assert demand[2] == pytest.approx(planned_ratio["follow"], abs=5e-3)


def test_the_simulated_ground_wrench_is_the_planned_one(biped_plan: Planned) -> None:
    """During the collision, and after it: ZMP within a centimetre, soles where they are."""
    sim, plan = biped_plan.simulation, biped_plan.plan
    since = sim.time - sim.contact_start
    contact = sim.phase() == 1
    point = zmp(sim.ground)
    for t, wanted in zip(plan.collision.time[1:-1], zmp(plan.collision.ground), strict=False):
        k = int(np.argmin(np.abs(since - t) + np.where(contact, 0, 1)))
        np.testing.assert_allclose(point[k], wanted, atol=0.01)
    t = biped_plan.trajectory
    follow = t.phase == 2
    planned_zmp = np.stack([np.interp(sim.time, t.time[follow], z) for z in zmp(t.ground[follow]).T], axis=1)
    late = sim.time > plan.contact_end + 0.02  # the servo has got over the end of contact
    np.testing.assert_allclose(point[late], planned_zmp[late], atol=0.01)
    assert max(sim.slip.max(), sim.lift.max()) < 1e-4


def test_a_better_bounded_problem_gives_less(arm_plan: Planned) -> None:
    """Half the torque cannot hit harder."""
    problem = dataclasses.replace(arm_plan.problem, terms=(TorqueLimit(fraction=0.4, collision=0.4),))
    weaker = Transcription(problem, arm_plan.transcription.functions)
    result = solve_ipopt(weaker.program, arm_plan.result.x)
    assert result.status is Status.SOLVED
    plan = weaker.decode(result.x)
    assert plan.impulse < arm_plan.plan.impulse - 0.05
    assert np.abs(plan.collision.torque / problem.robot.torque_limit).max() <= 0.4 + 1e-5


def test_a_free_duration_is_chosen_within_its_range(arm_transcription: Transcription) -> None:
    """The more time the arm may take for its swing, the harder it hits, until it needs no more."""
    found = []
    for longest in (0.15, 0.3, 0.6):
        t = changed(arm_transcription, swing=Phase(duration=(0.15, longest), intervals=8))
        result = solve_ipopt(t.program, first_iterate(t))
        assert result.status is Status.SOLVED
        found.append(t.decode(result.x))
    hasty, limited, free = found
    assert hasty.impulse + 0.03 < limited.impulse < free.impulse - 0.1
    assert hasty.swing.duration == pytest.approx(0.15, abs=1e-6)
    assert limited.swing.duration == pytest.approx(0.3, abs=1e-4)
    assert 0.31 < free.swing.duration < 0.59


def test_what_cannot_be_met_is_named(arm_plan: Planned) -> None:
    """An arm that would have to get there at a tenth of its speed."""
    slow = dataclasses.replace(
        arm_plan.problem, terms=(VelocityLimit(fraction=0.02),), swing=Phase(duration=0.1, intervals=8)
    )
    transcription = Transcription(slow, arm_plan.transcription.functions)
    result = solve_ipopt(transcription.program, first_iterate(transcription))
    assert result.status is Status.INFEASIBLE
    assert "Constraints that cannot be met" in result.message
    assert "hit point" in result.message or "velocity limit" in result.message


def test_the_soles_constraints_in_contact_can_be_left_out(biped_transcription: Transcription) -> None:
    """And no others: the rest are the same constraints, in the same order."""
    cone = dataclasses.replace(biped_transcription.problem.term(ContactWrenchCone), collision_margin=None)
    others = [t for t in biped_transcription.problem.terms if not isinstance(t, ContactWrenchCone)]
    without = changed(biped_transcription, terms=(*others, cone))

    def in_contact(row: Any) -> bool:
        swinging = row.place.name.startswith(("swing", "follow", "start", "end"))
        return row.term in (cone.name, "normal force") and not swinging

    names = [str(row) for row in biped_transcription.constraints.origins if not in_contact(row)]
    assert [str(row) for row in without.constraints.origins] == names
    assert without.program.m < biped_transcription.program.m


def test_a_contact_is_guessed_with_integrals_of_its_own_speeds(arm_transcription: Transcription) -> None:
    """Of the robot's coordinates, and of the target, whose state is its speed: slower at first."""
    t = arm_transcription
    x, hit = first_iterate(t), t.hit.expected
    for integral, rate in (*hit.integrated(), (hit.xt, hit.state)):
        reached, speed = integral.read(x), rate.read(x)
        for i, s in enumerate(hit.stages):
            so_far = sum(w * speed[m] for m, w in zip(s.members, s.quadrature, strict=True))
            so_far = so_far + (0.0 if s.new_phase else reached[s.previous])
            np.testing.assert_allclose(reached[i], so_far, atol=0.02 * np.abs(reached).max(), err_msg=s.name)
