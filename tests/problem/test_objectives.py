"""What a plan is for: each objective is the quantity it says, more of it is reached than by others, and what
nobody asks for is not in the program."""

from __future__ import annotations

import dataclasses
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from scipy.integrate import trapezoid
from support.small_plans import Planned, arm_problem, changed

from impactopt import (
    AngularMomentum,
    Balance,
    Board,
    Effort,
    Impulse,
    InputError,
    Objective,
    PeakForce,
    Penetration,
    Plan,
    RigidWall,
    Status,
    TargetEnergy,
)
from impactopt.kinematics.splines import Radau
from impactopt.solvers.ipm.interior_point import solve_ipm
from impactopt.transcription.blocks import extra_blocks
from impactopt.transcription.initial_guess import first_iterate
from impactopt.transcription.transcription import Transcription

Array = NDArray[np.float64]
ALL = (Impulse(), PeakForce(), TargetEnergy(), Penetration(), Effort())


def solved(transcription: Transcription, start: Array) -> tuple[Array, Plan]:
    result = solve_ipm(transcription.program, start)
    assert result.status is Status.SOLVED
    return result.x, transcription.decode(result.x)


@pytest.fixture(scope="module")
def arm_plans(arm_transcription: Transcription) -> dict[str, tuple[dict[str, float], Plan]]:
    """The arm's plans by what they are for, each with what all objectives come to."""
    out = {}
    for name, objectives in {
        "impulse": (Impulse(),),
        "force": (PeakForce(),),
        "energy": (TargetEnergy(),),
        "depth": (Penetration(),),
        "gentle": (Impulse(), PeakForce(weight=-0.02)),
        "easy": (Impulse(), Effort(weight=10.0)),
    }.items():
        transcription = changed(arm_transcription, objectives=objectives)
        x, plan = solved(transcription, first_iterate(transcription))
        # the same motion in the program that knows all quantities
        whole = changed(arm_transcription, objectives=ALL)
        at = np.zeros(whole.layout.n)
        for key, group in transcription.layout.groups.items():
            whole.layout.groups[key].write(at, group.read(x))
        out[name] = whole.achieved(whole.with_lifted(at)), plan
        for o in objectives:
            assert transcription.achieved(x)[o.name] == pytest.approx(out[name][0][o.name], rel=1e-6)
    return out


@pytest.mark.slow
def test_each_objective_gets_more_of_its_own_quantity(
    arm_plans: dict[str, tuple[dict[str, float], Plan]],
) -> None:
    for name, quantity in (("force", PeakForce), ("depth", Penetration)):
        assert arm_plans[name][0][quantity.name] > 1.0005 * arm_plans["impulse"][0][quantity.name]
        assert arm_plans[name][1].impulse < arm_plans["impulse"][1].impulse
    assert arm_plans["gentle"][0]["smooth peak force"] < 0.95 * arm_plans["impulse"][0]["smooth peak force"]
    assert arm_plans["easy"][0]["effort"] < 0.98 * arm_plans["impulse"][0]["effort"]
    # of a free mass, energy is a function of the impulse alone
    assert arm_plans["energy"][1].impulse == pytest.approx(arm_plans["impulse"][1].impulse, rel=1e-3)


def test_quantities_are_what_they_say(
    arm_plans: dict[str, tuple[dict[str, float], Plan]], arm_plan: Planned
) -> None:
    problem = arm_plan.problem
    law = problem.law
    for got, plan in arm_plans.values():
        hit = plan.collision
        speed = hit.target_speed[-1]
        assert got["impulse"] == pytest.approx(plan.impulse)
        assert got["target energy"] == pytest.approx(0.5 * problem.target.mass * speed**2)
        largest = hit.force.max()
        assert 0.95 * largest < got["smooth peak force"] <= largest * (1 + 1e-9)
        # approach has ended, so there is no damping
        at = int(np.argmin(np.abs(hit.time - plan.compression)))
        assert got["penetration"] == pytest.approx(hit.force[at] / law.parameters["stiffness"], rel=1e-4)


def test_effort_is_the_integral_of_torque_over_limit(
    arm_plans: dict[str, tuple[dict[str, float], Plan]], arm_plan: Planned
) -> None:
    """By the finely sampled reference, which the trapezoidal rule on the nodes comes near to."""
    limit = arm_plan.problem.robot.torque_limit
    for got, plan in arm_plans.values():
        t = plan.trajectory(hold=0.0)
        total = 0.0
        for phase in (0, 2):
            k = t.phase == phase
            total += float(trapezoid(np.sum((t.torque[k] / limit) ** 2, axis=1), t.time[k]))
        assert got["effort"] == pytest.approx(total, rel=0.05)


@pytest.mark.slow
def test_angular_momentum_is_kept_small(biped_transcription: Transcription, biped_plan: Planned) -> None:
    """Beside the impulse, and squared in the program: what the follow-through starts with."""
    objectives = (Impulse(), AngularMomentum(weight=1.0))
    transcription = changed(biped_transcription, objectives=objectives)
    x, plan = solved(transcription, first_iterate(transcription))
    before, after = momentum_after_contact(biped_plan.plan), momentum_after_contact(plan)
    assert transcription.achieved(x)[AngularMomentum.name] == pytest.approx(after @ after, rel=1e-4)
    assert after @ after < 0.9 * (before @ before)
    assert plan.impulse < biped_plan.plan.impulse


def momentum_after_contact(plan: Plan) -> Array:
    """By Pinocchio, of the reference's first state after contact."""
    t, model = plan.trajectory(), plan.problem.robot.model
    k = int(np.flatnonzero(t.phase == 2)[0])
    return np.array(pin.computeCentroidalMomentum(model, model.createData(), t.q[k], t.v[k]).angular)


@pytest.mark.parametrize("robot", ["arm", "biped"])
def test_derivatives_with_all_objectives_agree_with_differences(
    robot: str, request: pytest.FixtureRequest
) -> None:
    objectives = ALL if robot == "arm" else (*ALL, AngularMomentum())
    transcription = changed(request.getfixturevalue(f"{robot}_transcription"), objectives=objectives)
    program, rng, h = transcription.program, np.random.default_rng(0), 1e-6
    x = first_iterate(transcription)
    x += 0.02 * rng.standard_normal(program.n)
    y, sigma = rng.standard_normal(program.m), 0.7

    def slope(at: Array) -> Array:
        return np.asarray(sigma * program.gradient(at) + program.jacobian(at).T @ y)

    jacobian, hessian = program.jacobian(x), program.hessian(x, sigma, y)
    for _ in range(3):
        d = rng.standard_normal(program.n)
        of_rows = (program.constraints(x + h * d) - program.constraints(x - h * d)) / (2 * h)
        assert (np.abs(jacobian @ d - of_rows) <= 1e-6 * (abs(jacobian) @ np.abs(d)) + 1e-6).all()
        of_slope = (slope(x + h * d) - slope(x - h * d)) / (2 * h)
        size = abs(hessian) @ np.abs(d)
        assert (np.abs(hessian @ d - of_slope) <= 1e-5 * size + 1e-5 * size.max()).all()
        of_f = (program.objective(x + h * d) - program.objective(x - h * d)) / (2 * h)
        assert of_f == pytest.approx(program.gradient(x) @ d, rel=1e-6, abs=1e-6)


def test_first_iterates_agree_with_what_is_lifted(biped_transcription: Transcription) -> None:
    transcription = changed(biped_transcription, objectives=(*ALL, AngularMomentum()), terms=(Balance(),))
    program, x = transcription.program, first_iterate(transcription)
    g = program.constraints(x)
    of = ("peak force", "target energy", "deepest penetration", "effort of a node")
    rows = [i for i in range(program.m) if program.constraint_name(i).startswith(of)]
    assert len(rows) == 3 + len(transcription.swing_nodes) + len(transcription.follow_nodes)
    np.testing.assert_allclose(g[rows], 0, atol=1e-9)


def test_only_what_is_asked_for_is_in_the_program(arm_transcription: Transcription) -> None:
    plain = arm_transcription
    assert not {"peak", "energy", "effort"} & {b.name for b in plain.program.blocks}
    for objective, added in ((PeakForce(), 1), (TargetEnergy(), 1), (Penetration(), 1)):
        more = changed(plain, objectives=(objective,))
        assert more.program.n == plain.program.n + added
        assert more.program.m == plain.program.m + added
    more = changed(plain, objectives=(Impulse(weight=2.0),))
    assert (more.program.n, more.program.m) == (plain.program.n, plain.program.m)


def test_the_energy_of_an_impact_without_duration(arm_transcription: Transcription) -> None:
    rigid = changed(arm_transcription, objectives=(TargetEnergy(),), collision="rigid")
    x, plan = solved(rigid, first_iterate(rigid))
    mass = rigid.problem.target.mass
    assert rigid.achieved(x)["target energy"] == pytest.approx(plan.impulse**2 / (2 * mass))
    wall = changed(arm_transcription, target=RigidWall(), objectives=(TargetEnergy(),), collision="rigid")
    assert wall.achieved(first_iterate(wall))["target energy"] == 0.0


@pytest.mark.parametrize(
    ("objectives", "parts"),
    [
        ((), ["empty"]),
        (Impulse(), ["must be a tuple"]),
        (("impulse",), ["must be a tuple", "impulse"]),
        ((Impulse(), Impulse(weight=2.0)), ["two objectives of kind Impulse"]),
        ((AngularMomentum(),), ["fixed base"]),
    ],
)
def test_objectives_that_make_no_sense_are_refused(
    arm_transcription: Transcription, objectives: Any, parts: list[str]
) -> None:
    with pytest.raises(InputError) as caught:
        changed(arm_transcription, objectives=objectives)
    assert all(part in str(caught.value) for part in parts)


def test_a_damped_board_has_no_energy_as_an_objective() -> None:
    """Its energy would lack what the damping takes."""
    board = Board(mass=0.5, stiffness=2e4, breaking_force=400.0)
    problem = dataclasses.replace(arm_problem(), target=board, objectives=(TargetEnergy(),))
    with pytest.raises(InputError, match=r"TargetEnergy lacks the work of a board's damping"):
        dataclasses.replace(problem, target=dataclasses.replace(board, damping=5.0))


def test_a_contact_without_duration_has_no_force(arm_transcription: Transcription) -> None:
    for objective in (PeakForce(), Penetration()):
        with pytest.raises(InputError, match="a contact that lasts"):
            changed(arm_transcription, collision="rigid", objectives=(objective,))


@pytest.mark.parametrize("kind", [Impulse, PeakForce, TargetEnergy, Penetration, AngularMomentum, Effort])
def test_weights_are_numbers_and_prices_are_positive(kind: type[Objective]) -> None:
    for weight in (0.0, float("nan"), float("inf"), *([-1.0] if kind.cost else [])):
        with pytest.raises(InputError, match="weight"):
            kind(weight=weight)
    assert kind.name and kind.unit and kind().weight


def test_the_peak_force_of_a_damped_contact_has_its_jump_at_first_touch(
    arm_transcription: Transcription,
) -> None:
    law = dataclasses.replace(arm_transcription.problem.law, damping=2e3)
    t = changed(arm_transcription, law=law, objectives=(PeakForce(weight=-1.0),))
    x = t.with_lifted(first_iterate(t))
    force = t.decode(x).collision.force
    assert force[0] > 1.1 * force[1:].max()
    assert t.achieved(x)["smooth peak force"] == pytest.approx(force[0], rel=0.05)
    # the same program, moved to another law
    t.move_to(dataclasses.replace(t.problem, law=dataclasses.replace(law, damping=4e3)))
    assert t.achieved(t.with_lifted(x))["smooth peak force"] == pytest.approx(2.0 * force[0], rel=0.05)


def test_the_smooth_maximum_of_a_half_sine(arm_transcription: Transcription) -> None:
    """At collocation points of three elements: as near to the largest as its docstring says."""
    problem = dataclasses.replace(arm_transcription.problem, objectives=(PeakForce(),))
    peak = extra_blocks(problem)["peak"].build()
    function = ca.Function("peak", [peak.z, peak.p], [peak.out])
    c = Radau.of_stages(3).c
    places = np.concatenate([0.5 * 0.2 * c, 0.1 + 0.5 * 0.8 * c, 0.5 + 0.5 * c])
    f = 800.0 * np.sin(np.pi * places)
    # without a jump at first touch: y = y' = 0, T = 1 s, and all parameters zero
    at_rest = np.append(np.zeros(peak.z.numel() - len(f) - 1), 1.0)
    got = 100.0 * float(function(np.concatenate([at_rest, f]), np.zeros(peak.p.numel())))
    assert 0.96 * f.max() < got < f.max()
