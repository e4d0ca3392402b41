"""What goes through gears in a blow: planned, by hand, by Pinocchio, and in replays."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from support.small_motions import strike
from support.small_plans import changed, struck

from impactopt import (
    Actuator,
    GearLoad,
    HandOrientation,
    InputError,
    MotorCurve,
    Nail,
    PowerLimit,
    Scenario,
    Solution,
    Status,
    VelocityJump,
    load_problem,
    solve,
)
from impactopt.robots.loads import motor_power, motor_use
from impactopt.simulation import simulate_mujoco, simulate_pinocchio
from impactopt.solvers.ipopt import solve_ipopt
from impactopt.transcription.collision import jump_at_contact
from impactopt.transcription.initial_guess import first_iterate, strike_iterate
from impactopt.transcription.plan import motion_loads
from impactopt.transcription.transcription import Transcription

Array = NDArray[np.float64]
GEARS = (GearLoad(limit=1.0), HandOrientation(axis=(1.0, 0.0, 0.0), angle=0.1))
ENGINES = {"pinocchio": simulate_pinocchio, "mujoco": simulate_mujoco}


def test_a_limit_by_joint_is_not_changed_by_its_caller() -> None:
    limit = {"joint_1": 1.0}
    load = GearLoad(limit=limit)
    limit["joint_1"] = 9.0
    assert load.limit == {"joint_1": 1.0}


def test_an_empty_table_of_limits_is_refused() -> None:
    for kind in (GearLoad, PowerLimit, VelocityJump):
        with pytest.raises(InputError, match=f"{kind.__name__}.limit names no joint, and would bound none"):
            kind(limit={})


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("damping", [0.0, 300.0])
def test_one_joint_hits_a_spring_and_a_damper(engine: str, damping: float) -> None:
    """Of 6 kg, 5 are the rotor's: 5/6 of the force goes through the gear; with the damper most at once."""
    sim, exact = strike(damping, rotor=5.0, simulate=ENGINES[engine])
    expected = 5.0 / 6.0 * exact["peak"]
    if damping:
        assert exact["peak"] == pytest.approx(damping * exact["speed"])
    # the force is followed within the step, from where it is zero
    assert np.abs(sim.gear).max() == pytest.approx(expected, rel=5e-3)
    assert sim.loads is not None
    assert sim.loads.gear[0] * 1e4 == pytest.approx(expected, rel=5e-3)
    assert sim.loads.velocity_jump[0] == pytest.approx(exact["speed"] - exact["own_after"], rel=2e-3)


@pytest.fixture(scope="module")
def bounded(arm_transcription: Transcription) -> tuple[Transcription, Array]:
    """A plan of the small arm whose gears bear 0.6 of their torque limits."""
    t = changed(arm_transcription, terms=(GearLoad(limit=0.6),))
    result = solve_ipopt(t.program, first_iterate(t))
    assert result.status is Status.SOLVED
    return t, result.x


def rows_of(t: Transcription, x: Array, place: str) -> Array:
    """(k n,) values of the rows of gears at places whose names begin so."""
    g = t.program.constraints(x)
    chosen = [r.term == "gear load" and r.place.name.startswith(place) for r in t.program.origins]
    return np.asarray(g[np.flatnonzero(chosen)])


def test_planned_gear_torques_are_those_of_inverse_dynamics(bounded: Any) -> None:
    """In contact, of links without rotors, which their gears and the contact's force move."""
    t, x = bounded
    robot, hit = t.robot, t.hit.expected
    model = robot.model.copy()
    model.armature[:] = 0.0
    data, hand = model.createData(), model.getFrameId(f"striker:{t.problem.striker}")
    points = t.drive_points()[-len(hit.stages) :]
    found = []
    for point, force in zip(points, hit.f.read(x)[:, 0], strict=True):
        y0, d1, T1, d, T, rate, slope, S, _ = (part.evaluate(x) for part in point.slots)
        q = t.coordinates.join(y0 + T1 * d1 + T * d, np.zeros(0))
        torque = pin.rnea(model, data, q, rate / S, slope / (S * T))
        J = pin.computeFrameJacobian(model, data, q, hand, pin.LOCAL_WORLD_ALIGNED)[:3]
        found.append((torque + J.T @ t.problem.normal * force) / robot.torque_limit)
    values = np.concatenate([rows_of(t, x, phase) for phase in ("compression", "restitution")])
    np.testing.assert_allclose(values, np.ravel(found), atol=1e-6)
    assert np.abs(values).max() == pytest.approx(0.6, abs=1e-6)


def test_the_first_instant_is_that_of_forward_dynamics(bounded: Any) -> None:
    """The damper's force is there at once, and the servo's torque is still what it was."""
    t, x = bounded
    robot, model, problem = t.robot, t.robot.model, t.problem
    data, hand = model.createData(), model.getFrameId(f"striker:{problem.striker}")
    q, v = t.coordinates.join(t.contact_state[0].evaluate(x), np.zeros(0)), t.u0.read(x)[0]
    row = problem.normal @ pin.computeFrameJacobian(model, data, q, hand, pin.LOCAL_WORLD_ALIGNED)[:3]
    force = problem.law.damping * float(row @ v)
    assert force > 100.0
    torque = t.feedforward.read(x)[0] * robot.torque_limit
    a = pin.aba(model, data, q, v, torque - row * force)
    expected = (torque - robot.armature * a) / robot.torque_limit
    np.testing.assert_allclose(rows_of(t, x, "first instant"), expected, atol=1e-6)
    hit = t.decode(x).collision
    np.testing.assert_allclose(hit.acceleration[0], a, rtol=1e-6, atol=1e-4)


def test_on_two_soles_the_first_instant_is_what_the_numbers_say(biped_transcription: Transcription) -> None:
    """Symbolic rows against NumPy's: base, joints and law are met by what is found without them."""
    t = changed(biped_transcription, terms=(GearLoad(),))
    x = first_iterate(t)
    y, rates, legs = t.contact_state[0].evaluate(x), t.u0.read(x)[0], t.contact_legs.evaluate(x)
    t.hit.first[0].guess(x, y, rates, legs)
    g, origins = t.program.constraints(x), t.program.origins
    rows = [i for i, r in enumerate(origins) if r.place.name == "first instant of contact"]
    equal = [i for i in rows if origins[i].term in ("jump of acceleration", "contact law")]
    assert len(equal) == t.coordinates.rb.nv + 1
    assert np.abs(g[equal]).max() < 1e-8
    force, _, wrench, a = jump_at_contact(t.problem, t.coordinates, t.problem.law, y, rates, legs)
    assert force > 10.0 and np.abs(wrench).max() > 1.0
    load = [i for i in rows if origins[i].term == "gear load"]
    torque = t.feedforward.read(x)[0]
    np.testing.assert_allclose(g[load], torque - t.robot.armature * a / t.robot.torque_limit, atol=1e-9)


def test_a_law_without_a_force_at_once_has_no_first_instant(arm_transcription: Transcription) -> None:
    undamped = replace(arm_transcription.problem.law, damping=0.0)
    t = changed(arm_transcription, terms=(GearLoad(),), law=undamped)
    assert not t.hit.first
    assert not [r for r in t.program.origins if r.place.name.startswith("first instant")]


def test_every_contact_and_every_motion_is_bounded(arm_transcription: Transcription) -> None:
    scenarios = (Scenario(name="heavy", mass=1.5), Scenario(name="missing", missing=True, abort_after=0.02))
    t = changed(arm_transcription, terms=(GearLoad(), VelocityJump(limit=3.0)), scenarios=scenarios)
    places = {r.place.name for r in t.program.origins if r.term == "gear load"}
    jumps = {r.place.name for r in t.program.origins if r.term == "velocity jump"}
    assert {"first instant of contact", "first instant of contact, if heavy"} <= places
    assert {
        "end of coasting, if nothing is hit",
        "abort, 0 %",
        "swing, 100 %",
        "follow-through, 0 %",
    } <= places
    assert {"compression, 100 %", "compression, 100 %, if heavy", "restitution, 100 %, if heavy"} <= places
    assert jumps == {"after contact", "after contact, if heavy"}


def test_a_strike_keeps_its_gears_too(bounded: Any) -> None:
    problem = bounded[0].problem
    t = struck(problem)
    result = solve_ipopt(t.program, strike_iterate(t))
    assert result.status is Status.SOLVED
    strike = t.decode(result.x)
    assert strike.loads().gear.max() == pytest.approx(0.6, abs=1e-4)
    # no swing has to lead there, so it is an upper bound
    assert strike.impulse > bounded[0].decode(bounded[1]).impulse - 1e-3


@pytest.mark.parametrize("term", [MotorCurve(fraction=0.2), PowerLimit(limit=30.0)])
def test_motors_keep_to_their_line_and_their_power(arm_transcription: Transcription, term: Any) -> None:
    """In the formulas of `impactopt.robots.loads`, friction included."""
    t = changed(arm_transcription, terms=(term,))
    result = solve_ipopt(t.program, first_iterate(t))
    assert result.status is Status.SOLVED
    robot, points = t.robot, t.drive_points()
    assert all(a.coulomb_friction > 0 and a.viscous_friction > 0 for a in robot.actuators)
    torque = [p.torque.evaluate(result.x) * robot.torque_limit for p in points]
    rates = [p.slots[5].evaluate(result.x) / p.slots[7].evaluate(result.x) for p in points]
    if isinstance(term, MotorCurve):
        share = motor_use(robot, torque, rates) / term.fraction
    else:
        share = motor_power(robot, torque, rates) / 30.0
    assert share.max() == pytest.approx(1.0, abs=1e-4)


def test_friction_that_takes_all_of_a_motor_is_refused(arm_transcription: Transcription) -> None:
    robot = arm_transcription.robot.with_actuators(
        {"elbow": Actuator(stall_torque=10.0, no_load_speed=9.0, coulomb_friction=6.0)}
    )
    with pytest.raises(InputError, match="stall torque of elbow is 5 N m, which its friction, 6 N m, takes"):
        changed(arm_transcription, terms=(MotorCurve(fraction=0.5),), robot=robot)


@pytest.mark.parametrize(("term", "other"), [(MotorCurve(), ""), (PowerLimit(), "a limit, or ")])
def test_a_bound_on_motors_without_data_is_refused(term: MotorCurve | PowerLimit, other: str) -> None:
    problem = load_problem("arm_planar")
    data: dict[str, Any] = {"stall_torque": 200.0, "no_load_speed": 10.0, "power_limit": 100.0}
    known = problem.robot.with_actuators({"elbow": Actuator(**data)})
    assert replace(problem, terms=(term,), robot=known).terms == (term,)  # of one motor is enough
    with pytest.raises(InputError, match=rf"none of 'planar_arm' is: give {other}their data as .*robot.act"):
        replace(problem, terms=(term,))


def test_an_impact_without_duration_has_no_gear_load_but_a_jump(arm_transcription: Transcription) -> None:
    terms = (GearLoad(limit=0.9), VelocityJump(limit=0.5))
    t = changed(arm_transcription, terms=terms, collision="virtual-mass")
    result = solve_ipopt(t.program, first_iterate(t))
    assert result.status is Status.SOLVED
    assert not t.hit.first
    plan = t.decode(result.x)
    loads = motion_loads(t.robot, plan.trajectory(), plan.collision)
    assert loads.velocity_jump.max() == pytest.approx(0.5, abs=1e-5)


@pytest.fixture(scope="module")
def nailed() -> Solution:
    """A soft nail, which the planar arm can drive with what its gears bear all the time."""
    problem = load_problem("arm_planar")
    return solve(replace(problem, target=Nail(mass=0.05, resistance=200.0, hardening=1e4), terms=GEARS))


@pytest.mark.slow
def test_a_limit_of_one_holds_in_replays(nailed: Solution) -> None:
    """First instant included: Kelvin-Voigt's damper has a force at once."""
    assert nailed.status.usable
    planned = nailed.loads.summary()
    assert planned["gear_ratio"] == pytest.approx(1.0, abs=0.03)
    for engine in ENGINES:
        found = nailed.validate(engine=engine).loads.summary()
        assert found["gear_ratio"] == pytest.approx(planned["gear_ratio"], rel=0.05)
        assert found["gear_joint"] == planned["gear_joint"]
        assert found["velocity_jump_rad_s"] == pytest.approx(planned["velocity_jump_rad_s"], rel=0.05)
    assert nailed.plan.collision.outcome["depth_m"] > 1e-3


def test_where_the_term_is_off_it_is_told_which_gear_bears_too_much(nailed: Solution) -> None:
    """Of plans that do not bound them."""
    assert "gear_caution" not in nailed.summary()
    weak = nailed.problem.robot.with_actuators({"wrist": Actuator(momentary_torque=20.0)})
    terms = (GearLoad(enabled=False), *nailed.problem.terms[1:])
    free = replace(nailed, problem=replace(nailed.problem, robot=weak, terms=terms))
    assert "gear of wrist" in free.summary()["gear_caution"]
